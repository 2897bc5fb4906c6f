//! One `visualization_msgs/msg/MarkerArray` message, of lists of lines.
//!
//! In: lines in one frame. Out: the bytes of a message with one marker of the type LINE_LIST for each list.

use nalgebra::Isometry3;

use crate::cdr::{Header, Writer, length};
use crate::pose::write_pose;

/// Value of `type` for separate straight lines, two points each.
const LINE_LIST: u32 = 5;
/// Values of `action`: to add or replace a marker; to remove it.
const ADD: u32 = 0;
const DELETE: u32 = 2;

/// Straight lines of one colour.
#[derive(Clone, Debug, PartialEq)]
pub struct Lines<'a> {
    /// Name of the marker; a later one of the same name replaces it.
    pub name: &'a str,
    /// Width of a line in metres.
    pub width_m: f64,
    /// Red, green, blue and opacity, 0 to 1.
    pub rgba: [f32; 4],
    /// Ends of the lines in metres, two for each. If there are none, the marker of this name is removed.
    pub points: Vec<[f64; 3]>,
}

/// Encodes the message, little-endian. A viewer removes the lines `lifetime_ns` after it received them; 0 keeps them.
/// They move with their frame.
pub fn marker_array_to_cdr(header: &Header, lifetime_ns: i64, markers: &[Lines]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.u32(length(markers.len()));
    for Lines { name, width_m, rgba, points } in markers {
        let action = if points.is_empty() { DELETE } else { ADD };
        writer.header(header).text(name).u32(0).u32(LINE_LIST).u32(action);
        write_pose(&mut writer, &Isometry3::identity()).f64s(&[*width_m, 0.0, 0.0]);
        rgba.iter().fold(&mut writer, |writer, value| writer.u32(value.to_bits()));
        // A duration has the members of a stamp. The last byte is frame_locked.
        writer.stamp(lifetime_ns).bytes(&[1]).u32(length(points.len()));
        points.iter().fold(&mut writer, |writer, point| writer.f64s(point));
        // No colours of single points, no texture (a name, an image, coordinates), no text and no mesh.
        writer.u32(0).text("").header(&Header { stamp_ns: 0, frame_id: "" }).text("").u32(0).u32(0);
        writer.text("").text("").text("").u32(0).bytes(&[0]);
    }
    writer.finish()
}
