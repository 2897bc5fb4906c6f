//! Where the sensor's window is covered.
//!
//! In: finished revolutions. Out: [`Blocked`]: sectors and lasers that used to bring returns and now bring none, or only
//! such as lie on the window itself. One turn tells; until a return comes from there again, every turn does.

use crate::model::RETURNS_PER_BLOCK;
use crate::revolution::Revolution;

/// Whole degrees of encoder angle.
const DEGREES: usize = 360;
/// A sector narrower than this is a gap between things, not a covered window.
const SECTOR_DEG_MIN: usize = 5;
/// Turns in a row in which a degree, or a laser, must have brought returns before their absence means anything.
const TURNS_KNOWN: u8 = 5;
/// Returns nearer than this come from the window or the vehicle.
const RANGE_M_MIN: f32 = 1.0;
/// A laser that brought returns in fewer of its firings looked at the sky.
const LASER_SHARE_MIN: f32 = 0.25;

/// What of a sensor's view is covered.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Blocked {
    /// Sectors from which no laser brings returns.
    pub sectors: Vec<BlockedSector>,
    /// Lasers, by index in firing order, that bring returns from nowhere.
    pub lasers: Vec<u16>,
}

/// A sector of encoder angles, whole degrees, clockwise from above; it may go over 360.
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
}

/// What one sensor's degrees and lasers used to bring.
#[derive(Clone, Debug)]
pub(crate) struct View {
    degrees: [Known; DEGREES],
    lasers: Vec<Known>,
    /// Returns of each laser in the turn at hand, and its firings.
    counts: Vec<(u32, u32)>,
}

/// Turns in a row with returns, and whether they have ceased.
#[derive(Clone, Copy, Debug, Default)]
struct Known {
    turns: u8,
    dark: bool,
}

impl Default for View {
    fn default() -> Self {
        Self { degrees: [Known::default(); DEGREES], lasers: Vec::new(), counts: Vec::new() }
    }
}

impl View {
    /// Looks at a finished turn and writes in it what is blocked; gives its number of returns.
    pub fn take(&mut self, turn: &mut Revolution) -> u64 {
        self.lasers.resize(turn.lasers, Known::default());
        self.counts.clear();
        self.counts.resize(turn.lasers, (0, 0));
        let mut degrees: [Option<bool>; DEGREES] = [None; DEGREES];
        let width = RETURNS_PER_BLOCK.min(turn.lasers);
        let mut returns = 0;
        for echo in &turn.echoes {
            for (firing, ranges) in turn.firings.iter().zip(echo.range_m.chunks_exact(turn.lasers)) {
                let mut far = 0;
                for (ranges, counts) in ranges.chunks_exact(width).zip(self.counts.chunks_exact_mut(width)) {
                    for (range, (seen, fired)) in ranges.iter().zip(counts) {
                        returns += u32::from(*range > 0.0);
                        far += u32::from(*range >= RANGE_M_MIN);
                        *seen += u32::from(*range >= RANGE_M_MIN);
                        *fired += u32::from(*range >= 0.0);
                    }
                }
                let degree = (firing.azimuth_rad.to_degrees() as usize).min(DEGREES - 1);
                *degrees[degree].get_or_insert(false) |= far > 0;
            }
        }
        // A turn of which little came tells nothing of its lasers.
        let whole = degrees.iter().flatten().count() >= DEGREES / 2;
        for (known, seen) in self.degrees.iter_mut().zip(degrees) {
            known.take(seen);
        }
        for (known, (seen, fired)) in self.lasers.iter_mut().zip(&self.counts) {
            let often = *seen as f32 >= LASER_SHARE_MIN * *fired as f32;
            // Between none and often nothing is learned.
            known.take((whole && *fired > 0 && (often || *seen == 0)).then_some(*seen > 0));
            known.dark &= *seen == 0;
        }
        turn.blocked.sectors.clear();
        self.sectors(&mut turn.blocked.sectors);
        turn.blocked.lasers.clear();
        let dark = self.lasers.iter().enumerate().filter(|(_, known)| known.dark);
        turn.blocked.lasers.extend(dark.map(|(laser, _)| laser as u16));
        u64::from(returns)
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
