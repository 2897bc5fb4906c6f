//! The state of a sensor, as far as its datagrams show it.

use crate::datagram::nmea::Gprmc;
use crate::datagram::telemetry::Pps;
use crate::model::{Model, ReturnMode};
use crate::revolution::Blocked;
use crate::time::clock::Clock;

/// The source of the per-laser corrections in use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CalibrationSource {
    /// The nominal table of the model.
    #[default]
    Factory,
    /// The table of [`crate::SensorConfig::calibration`].
    Configured,
    /// The table in the status bytes of an HDL-64E S2 or S3.
    StatusBytes,
}

/// The state of a sensor, and what was counted of its datagrams.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorStatus {
    /// Model that is configured or was found in the data.
    pub model: Option<Model>,
    /// Return mode of the newest packet.
    pub return_mode: Option<ReturnMode>,
    /// Rate of rotation, in revolutions per minute: configured, or measured over the newest revolution.
    pub rpm: Option<f32>,
    /// Number of decoded data packets, without packets that wait.
    pub packets: u64,
    /// Number of data packets that wait until the model is known, or until the packets before them arrive.
    pub packets_waiting: usize,
    /// Number of data packets that waited for the model, did not fit it, and were not decoded.
    pub packets_unfit: u64,
    /// Number of data packets that never arrived or arrived too late, ±1 per gap. A long gap is counted one revolution
    /// later, if it is not repeated there as a field-of-view gap is. Of an HDL-64E S1, whose packets have no time, only
    /// gaps of less than half a revolution are counted.
    pub packets_lost: u64,
    /// Number of telemetry datagrams.
    pub telemetry: u64,
    /// Number of returns (echoes with a range) in all revolutions.
    pub returns: u64,
    /// Number of revolutions.
    pub revolutions: u64,
    /// Sectors and lasers without returns in the newest revolution.
    pub blocked: Blocked,
    /// Source of the per-laser corrections in use.
    pub calibration: CalibrationSource,
    /// Clock that the stamps of the newest revolution follow; `None` before the first revolution.
    pub clock: Option<Clock>,
    /// Time by which the host's clock is ahead of that clock, in ms ([`crate::Revolution::clock_offset_ms`]).
    pub clock_offset_ms: i64,
    /// Number of the epoch of the newest revolution ([`crate::Revolution::epoch`]).
    pub epoch: u32,
    /// True if the device time of the packets stands still: the stamps follow the arrival of the packets.
    pub device_time_stands: bool,
    /// Time by which GPS time is ahead of its arrival, in ns, if it is not used because it is too far away.
    pub gps_ahead_ns: Option<i64>,
    /// State of the pulse per second in the newest telemetry.
    pub pps: Option<Pps>,
    /// GPRMC of the newest telemetry.
    pub gprmc: Option<Gprmc>,
}

/// Rate above which no sensor of the family turns, in revolutions per minute: the fastest turn at 1,200.
const RPM_MAX: f32 = 1500.0;

impl SensorStatus {
    /// What is remarkable about the values that the sensor sends, for people: one line each.
    pub fn remarks(&self) -> Vec<String> {
        let still = self
            .device_time_stands
            .then(|| "its device time stands still, so its stamps follow the arrival of its packets".to_owned());
        let fast = self.rpm.filter(|rpm| *rpm > RPM_MAX && !self.device_time_stands).map(|rpm| {
            format!("it turns at {rpm:.0} rpm, faster than any model: packets of two sensors arrive as one stream")
        });
        let gps = self.gps_ahead_ns.map(|ahead_ns| {
            let (hours, way) =
                (ahead_ns.unsigned_abs() as f64 / 3.6e12, if ahead_ns > 0 { "ahead of" } else { "behind" });
            format!("GPS time is {hours:.1} h {way} its arrival and not used: see `gps_late_days_max`")
        });
        [still, fast, gps].into_iter().flatten().collect()
    }
}
