//! The time an HDL-64E S2 or S3 tells of itself, one byte a packet.
//!
//! In: the status type and value that end every packet. Out: what [`crate::telemetry`] would say of the same: time and
//! date of the last GPRMC, and whether the pulse is there. Source: HDL-64E S3 manual rev K, "Packet Format and Status
//! Byte for GPS Time Stamping" and appendix E: types H M S D N Y G begin each cycle of 16 packets, values are binary.

use crate::telemetry::{Gprmc, Pps, Telemetry, utc_ns_of};

const TYPES: &[u8; 7] = b"HMSDNYG";

/// Follows the first bytes of each cycle.
#[derive(Clone, Debug, Default)]
pub(crate) struct UnitClock {
    cycle: [u8; TYPES.len()],
    position: usize,
    before: Option<[u8; TYPES.len()]>,
}

impl UnitClock {
    /// Takes the status of the next packet, whose device time is `device_us`; gives what the unit says if it has said
    /// the same in the cycle before, so that no hour of one second stands beside the minute of the next, and if its
    /// receiver tells the time at all.
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
            // `P` and 0: the date is the unit's own, counted from 2000 on.
            _ => return None,
        };
        let utc_ns = utc_ns_of([year, month, day].map(i64::from), [hour, minute, second].map(i64::from))?;
        let gprmc = Gprmc { valid: true, utc_ns: Some(utc_ns), ..Gprmc::default() };
        Some(Telemetry { device_us, pps, gprmc: Some(gprmc) })
    }
}
