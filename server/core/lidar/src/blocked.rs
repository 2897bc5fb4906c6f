//! Where the sensor's window is covered.
//!
//! In: finished revolutions. Out: [`Blocked`]: sectors and lasers that used to bring returns and now bring none, or
//! only such as lie on the window itself. One turn tells; until a return comes from there again, every turn does.

use crate::revolution::Revolution;

/// Whole degrees of direction, clockwise from above.
const DEGREES: usize = 360;
/// A sector narrower than this is a gap between things, not a covered window.
const SECTOR_DEG_MIN: usize = 5;
/// Turns in a row in which a degree, or a laser, must have brought returns before their absence means anything.
const TURNS_KNOWN: u8 = 5;
/// Returns nearer than this come from the window or the vehicle.
const RANGE_M_MIN: f32 = 1.0;
/// A laser that brought returns from fewer of its degrees looked at the sky.
const LASER_SHARE_MIN: f32 = 0.25;

/// What of a sensor's view is covered.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Blocked {
    /// Sectors from which no laser brings returns.
    pub sectors: Vec<BlockedSector>,
    /// Lasers, by index in firing order, that bring returns from nowhere.
    pub lasers: Vec<u16>,
}

/// A sector of directions, whole degrees clockwise from the sensor's x axis seen from above: encoder angles less each
/// laser's own offset. It may go over 360.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockedSector {
    /// First degree, in `0..360`.
    pub from_deg: u16,
    /// The degree behind the last, in `from_deg + 1..=from_deg + 360`.
    pub to_deg: u16,
}

impl Blocked {
    /// Whether all is clear.
    pub fn is_empty(&self) -> bool {
        self.sectors.is_empty() && self.lasers.is_empty()
    }

    /// Whether what `laser` does not see at `azimuth_rad` (its encoder angle less its own offset) may be hidden rather
    /// than absent; the sectors' edges count as hidden for another degree.
    pub fn hides(&self, laser: usize, azimuth_rad: f32) -> bool {
        let azimuth_deg = azimuth_rad.to_degrees();
        let inside = |sector: &BlockedSector| {
            (azimuth_deg - f32::from(sector.from_deg) + 1.0).rem_euclid(360.0)
                <= f32::from(sector.to_deg - sector.from_deg) + 2.0
        };
        self.lasers.iter().any(|hidden| usize::from(*hidden) == laser) || self.sectors.iter().any(inside)
    }
}

/// What one sensor's degrees and lasers used to bring.
#[derive(Clone, Debug)]
pub(crate) struct View {
    degrees: [Known; DEGREES],
    lasers: Vec<Known>,
    /// Of the turn at hand, by degree of encoder angle and laser: [`FIRED`] and [`FAR`].
    seen: Vec<u8>,
}

const FIRED: u8 = 1;
const FAR: u8 = 2;

/// Turns in a row with returns, and whether they have ceased.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    turns: u8,
    dark: bool,
}

impl Default for View {
    fn default() -> Self {
        Self { degrees: [Known::default(); DEGREES], lasers: Vec::new(), seen: Vec::new() }
    }
}

impl View {
    /// Looks at a finished turn and writes in it what is blocked; gives its number of returns.
    pub fn take(&mut self, turn: &mut Revolution) -> u64 {
        let returns = self.look(turn);
        let mut directions = [0; DEGREES];
        let mut lasers = vec![(0, 0); turn.lasers];
        for (laser, (fired, far)) in lasers.iter_mut().enumerate() {
            // Where the laser looks is its encoder angle less its own offset.
            let offset_deg = turn.calibration.lasers[laser % turn.calibration.lasers.len()].rot_correction.to_degrees();
            let offset = (offset_deg.round() as i64).rem_euclid(DEGREES as i64) as usize;
            for degree in 0..DEGREES {
                let seen = self.seen[degree * turn.lasers + laser];
                directions[(degree + DEGREES - offset) % DEGREES] |= seen;
                *fired += u32::from(seen & FIRED);
                *far += u32::from(seen & FAR) / u32::from(FAR);
            }
        }
        for (known, seen) in self.degrees.iter_mut().zip(directions) {
            known.take((seen & FIRED > 0).then_some(seen & FAR > 0));
        }
        for (known, (fired, far)) in self.lasers.iter_mut().zip(lasers) {
            let often = far as f32 >= LASER_SHARE_MIN * fired as f32;
            // A turn of which little came tells nothing, and between none and often nothing is learned.
            known.take((fired >= DEGREES as u32 / 2 && (often || far == 0)).then_some(far > 0));
            known.dark &= far == 0;
        }
        turn.blocked.sectors.clear();
        self.sectors(&mut turn.blocked.sectors);
        turn.blocked.lasers.clear();
        let dark = self.lasers.iter().enumerate().filter(|(_, known)| known.dark);
        turn.blocked.lasers.extend(dark.map(|(laser, _)| laser as u16));
        returns
    }

    /// Fills `seen`; gives the number of returns.
    fn look(&mut self, turn: &Revolution) -> u64 {
        self.lasers.resize(turn.lasers, Known::default());
        self.seen.clear();
        self.seen.resize(DEGREES * turn.lasers, 0);
        let mut returns = 0;
        for echo in &turn.echoes {
            for (firing, ranges) in turn.firings.iter().zip(echo.range_m.chunks_exact(turn.lasers)) {
                let degree = (firing.azimuth_rad.to_degrees() as usize).min(DEGREES - 1);
                let seen = &mut self.seen[degree * turn.lasers..(degree + 1) * turn.lasers];
                let mut here = 0;
                for (seen, range) in seen.iter_mut().zip(ranges) {
                    *seen |= (u8::from(*range >= 0.0) * FIRED) | (u8::from(*range >= RANGE_M_MIN) * FAR);
                    here += u32::from(*range > 0.0);
                }
                returns += u64::from(here);
            }
        }
        returns
    }

    /// Runs of dark degrees, wide enough, the one over the encoder's zero as one.
    fn sectors(&self, sectors: &mut Vec<BlockedSector>) {
        let dark = |degree: usize| self.degrees[degree % DEGREES].dark;
        let Some(first) = (0..DEGREES).find(|degree| !dark(*degree)) else {
            sectors.push(BlockedSector { from_deg: 0, to_deg: DEGREES as u16 });
            return;
        };
        let mut from = first;
        for degree in first..=first + DEGREES {
            if dark(degree) {
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

impl Known {
    /// `None`: nothing was fired, and nothing is learned.
    fn take(&mut self, seen: Option<bool>) {
        match seen {
            None => {}
            Some(true) => *self = Self { turns: self.turns.saturating_add(1), dark: false },
            Some(false) if self.dark || self.turns >= TURNS_KNOWN => self.dark = true,
            Some(false) => self.turns = 0,
        }
    }
}
