//! One sensor behind one door: datagram in, revolution out.

use crate::calibration::Calibration;
use crate::model::{Model, ReturnMode};
use crate::revolution::Revolution;

/// What is known of a sensor before its first datagram. `Default`: everything found from the data.
#[derive(Clone, Debug, Default)]
pub struct SensorConfig {
    /// Overrides the model found from the data.
    pub model: Option<Model>,
    /// Overrides the rpm found from the data.
    pub rpm: Option<f32>,
    /// The sensor's own table; otherwise the factory's, or the one in an HDL-64E's status bytes.
    pub calibration: Option<Calibration>,
    /// Where turns are cut, degrees of encoder angle.
    pub cut_azimuth_deg: f32,
}

/// Decodes one sensor's datagrams.
pub struct Sensor {}

/// A datagram that was not taken. `reason()` is the ledger's key.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// Neither 1206 nor 512 bytes.
    #[error("{length} bytes; a data packet has 1206, telemetry 512")]
    Length {
        /// Bytes received.
        length: usize,
    },
}

impl Refusal {
    /// `length`, `block_flag`, `azimuth`, `model`, …
    pub fn reason(&self) -> &'static str {
        "length"
    }
}

/// What the sensor has shown of itself so far.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorStatus {
    /// Found or configured.
    pub model: Option<Model>,
    /// From the packets.
    pub return_mode: Option<ReturnMode>,
    /// Measured over the last turn.
    pub rpm: Option<f32>,
    /// Data packets decoded.
    pub packets: u64,
    /// Telemetry datagrams read.
    pub telemetry: u64,
    /// Returns (echoes with a range) decoded.
    pub returns: u64,
    /// Revolutions given.
    pub revolutions: u64,
}

impl Sensor {
    /// A sensor that has seen nothing.
    pub fn new(_config: SensorConfig) -> Self {
        Self {}
    }
    /// Takes one UDP payload that arrived at `arrival_ns` (ns since the Unix epoch); gives the revolution it completed, if any.
    ///
    /// # Errors
    /// [`Refusal`] with the value that was wrong; the sensor's state is as if the datagram had not come.
    pub fn push(&mut self, _payload: &[u8], _arrival_ns: i64) -> Result<Option<&Revolution>, Refusal> {
        unimplemented!()
    }
    /// Ends the stream: the unfinished revolution, flagged partial. The sensor can go on with a new turn afterwards.
    pub fn finish(&mut self) -> Option<&Revolution> {
        unimplemented!()
    }
    /// What is known so far.
    pub fn status(&self) -> SensorStatus {
        unimplemented!()
    }
}
