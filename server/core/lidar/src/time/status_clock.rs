//! The time that an HDL-64E S2 or S3 sends in its status bytes, one byte per packet.
//!
//! In: the status type and value at the end of every packet. Out: [`Telemetry`] with time and date of the last GPRMC
//! and the state of the pulse. Source: HDL-64E S3 manual 63-HDL64ES3 rev K, "Packet Format and Status Byte for GPS Time
//! Stamping" and appendix E: the types H M S D N Y G begin each cycle of 16 packets, and the values are binary.

use crate::datagram::nmea::{Gprmc, unix_ns};
use crate::datagram::telemetry::{Pps, Telemetry};

const TYPES: &[u8; 7] = b"HMSDNYG";

/// Collector of the first seven status bytes of each cycle.
#[derive(Clone, Debug, Default)]
pub(crate) struct StatusClock {
    cycle: [u8; TYPES.len()],
    position: usize,
    before: Option<[u8; TYPES.len()]>,
}

impl StatusClock {
    /// Adds the status of the next packet, whose device time is `device_us`. Returns telemetry at the end of a cycle
    /// with the same bytes as the cycle before, so that hour and minute belong to the same second, and if the receiver
    /// has a time.
    pub fn push(&mut self, (status_type, value): (u8, u8), device_us: u32) -> Option<Telemetry> {
        if status_type != TYPES[self.position] {
            self.position = 0;
        }
        if status_type != TYPES[self.position] {
            return None;
        }
        self.cycle[self.position] = value;
        self.position = (self.position + 1) % TYPES.len();
        if self.position > 0 || self.before.replace(self.cycle) != Some(self.cycle) {
            return None;
        }
        let [hour, minute, second, day, month, year, gps] = self.cycle;
        let pps = match gps {
            b'A' => Pps::Locked,
            b'V' => Pps::Absent,
            // With `P` or 0 the date comes from the sensor's own clock, which counts from 2000.
            _ => return None,
        };
        let utc_ns = unix_ns([year, month, day].map(i64::from), [hour, minute, second].map(i64::from))?;
        let gprmc = Gprmc { valid: true, utc_ns: Some(utc_ns), ..Gprmc::default() };
        Some(Telemetry { device_us, pps, gprmc: Some(gprmc) })
    }
}
