//! One `diagnostic_msgs/msg/DiagnosticArray` message.
//!
//! In: the states of components. Out: the bytes of a message.

use crate::cdr::{Header, Writer, length};

/// How well a component works.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DiagnosticLevel {
    /// The component works as it should.
    Ok = 0,
    /// The component works, but something is wrong.
    Warn = 1,
    /// The component does not work.
    Error = 2,
}

/// The state of one component.
#[derive(Clone, Debug, PartialEq)]
pub struct Diagnostic {
    /// Level of the component.
    pub level: DiagnosticLevel,
    /// Name of the component.
    pub name: String,
    /// The fault in words, or that there is none.
    pub message: String,
    /// Name of the hardware.
    pub hardware_id: String,
    /// Values by name.
    pub values: Vec<(&'static str, String)>,
}

/// Encodes the message, little-endian.
pub fn diagnostic_array_to_cdr(header: &Header, diagnostics: &[Diagnostic]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.header(header).u32(length(diagnostics.len()));
    for Diagnostic { level, name, message, hardware_id, values } in diagnostics {
        writer.bytes(&[*level as u8]).text(name).text(message).text(hardware_id).u32(length(values.len()));
        values.iter().fold(&mut writer, |writer, (key, value)| writer.text(key).text(value));
    }
    writer.finish()
}
