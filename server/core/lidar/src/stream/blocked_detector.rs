//! The detector of a blocked view: dirt on the window of the sensor, or an object close to it.
//!
//! In: finished revolutions. Out: [`Blocked`](crate::revolution::Blocked): sectors and lasers that had returns and now
//! have none, or only returns from the window itself. One revolution without returns is enough; the first return from a
//! sector or laser ends its blocking.

use crate::revolution::{BlockedSector, Revolution};

/// Number of directions: whole degrees, clockwise seen from above.
const DEGREES: usize = 360;
/// Least width of a blocked sector, in degrees. Ours: a narrower one is the space between two objects.
const SECTOR_DEG_MIN: usize = 5;
/// Number of consecutive revolutions in which a direction or laser must have had returns before it can be blocked.
/// Ours: half a second at 600 rpm.
const REVOLUTIONS_MIN: u8 = 5;
/// Least range of a return that counts, in m. Ours: nearer returns are from the window or the vehicle.
const RANGE_M_MIN: f32 = 1.0;
/// Least share of degrees with returns of a laser that counts as seeing. Ours: a laser with fewer returns points at the
/// sky.
const LASER_SHARE_MIN: f32 = 0.25;

/// The directions and lasers of one sensor, and the returns that they had.
#[derive(Clone, Debug)]
pub(super) struct BlockedDetector {
    degrees: [Returns; DEGREES],
    lasers: Vec<Returns>,
    /// Flags [`FIRED`] and [`FAR`] of this revolution, by degree of encoder angle and laser.
    flags: Vec<u8>,
}

/// Flag: the laser has fired in this degree.
const FIRED: u8 = 1;
/// Flag: the laser has a return that is not near.
const FAR: u8 = 2;

/// The number of consecutive revolutions in which a direction or laser had returns, and whether they have ceased.
#[derive(Clone, Copy, Debug, Default)]
struct Returns {
    revolutions: u8,
    ceased: bool,
}

impl Default for BlockedDetector {
    fn default() -> Self {
        Self { degrees: [Returns::default(); DEGREES], lasers: Vec::new(), flags: Vec::new() }
    }
}

impl BlockedDetector {
    /// Adds a finished revolution, sets its blocked sectors and lasers, and returns its number of returns.
    pub fn push(&mut self, revolution: &mut Revolution) -> u64 {
        let returns = self.collect_flags(revolution);
        let mut directions = [0; DEGREES];
        let mut lasers = vec![(0, 0); revolution.lasers];
        for (laser, (fired, far)) in lasers.iter_mut().enumerate() {
            // The direction of the laser is the encoder angle less its azimuth offset.
            let offset_deg =
                revolution.calibration.lasers[laser % revolution.calibration.lasers.len()].rot_correction.to_degrees();
            let offset = (offset_deg.round() as i64).rem_euclid(DEGREES as i64) as usize;
            for degree in 0..DEGREES {
                let flags = self.flags[degree * revolution.lasers + laser];
                directions[(degree + DEGREES - offset) % DEGREES] |= flags;
                *fired += u32::from(flags & FIRED);
                *far += u32::from(flags & FAR) / u32::from(FAR);
            }
        }
        for (known, flags) in self.degrees.iter_mut().zip(directions) {
            known.update((flags & FIRED > 0).then_some(flags & FAR > 0));
        }
        for (known, (fired, far)) in self.lasers.iter_mut().zip(lasers) {
            let often = far as f32 >= LASER_SHARE_MIN * fired as f32;
            // Nothing changes if little of the revolution arrived, or if the returns are neither none nor frequent.
            known.update((fired >= DEGREES as u32 / 2 && (often || far == 0)).then_some(far > 0));
            known.ceased &= far == 0;
        }
        revolution.blocked.sectors.clear();
        self.write_sectors(&mut revolution.blocked.sectors);
        revolution.blocked.lasers.clear();
        let ceased = self.lasers.iter().enumerate().filter(|(_, known)| known.ceased);
        revolution.blocked.lasers.extend(ceased.map(|(laser, _)| laser as u16));
        returns
    }

    /// Sets the flags of a revolution, and returns its number of returns.
    fn collect_flags(&mut self, revolution: &Revolution) -> u64 {
        self.lasers.resize(revolution.lasers, Returns::default());
        self.flags.clear();
        self.flags.resize(DEGREES * revolution.lasers, 0);
        let mut returns = 0;
        for echo in &revolution.echoes {
            for (firing, ranges) in revolution.firings.iter().zip(echo.range_m.chunks_exact(revolution.lasers)) {
                let degree = (firing.azimuth_rad.to_degrees() as usize).min(DEGREES - 1);
                let flags = &mut self.flags[degree * revolution.lasers..(degree + 1) * revolution.lasers];
                let mut here = 0;
                for (flags, range) in flags.iter_mut().zip(ranges) {
                    *flags |= (u8::from(*range >= 0.0) * FIRED) | (u8::from(*range >= RANGE_M_MIN) * FAR);
                    here += u32::from(*range > 0.0);
                }
                returns += u64::from(here);
            }
        }
        returns
    }

    /// Writes the sectors of consecutive blocked degrees that are wide enough. A sector over the encoder's zero is one
    /// sector.
    fn write_sectors(&self, sectors: &mut Vec<BlockedSector>) {
        let ceased = |degree: usize| self.degrees[degree % DEGREES].ceased;
        let Some(first) = (0..DEGREES).find(|degree| !ceased(*degree)) else {
            sectors.push(BlockedSector { from_deg: 0, to_deg: DEGREES as u16 });
            return;
        };
        let mut from = first;
        for degree in first..=first + DEGREES {
            if ceased(degree) {
                continue;
            }
            if degree - from > SECTOR_DEG_MIN {
                let from_deg = (from + 1) % DEGREES;
                sectors
                    .push(BlockedSector { from_deg: from_deg as u16, to_deg: (from_deg + degree - from - 1) as u16 });
            }
            from = degree;
        }
    }
}

impl Returns {
    /// Adds a revolution: true with returns, false without, `None` if nothing was fired, which changes nothing.
    fn update(&mut self, has_returns: Option<bool>) {
        match has_returns {
            None => {}
            Some(true) => *self = Self { revolutions: self.revolutions.saturating_add(1), ceased: false },
            Some(false) if self.ceased || self.revolutions >= REVOLUTIONS_MIN => self.ceased = true,
            Some(false) => self.revolutions = 0,
        }
    }
}
