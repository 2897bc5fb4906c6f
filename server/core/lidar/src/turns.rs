//! Where one turn ends and the next begins.
//!
//! In: the azimuths of firings, in time order. Out: the firing at which to cut, and whether azimuths are missing or run
//! backwards. A cut lies between two firings, wherever in its packet that is.

use crate::firing::forward;
use crate::model::{AZIMUTHS_PER_TURN, ModelSpec, ReturnMode};

/// Firings after which a turn is ended whatever its azimuths say, so that a sensor that stands still fills no memory:
/// twice what the slowest (5 turns a second) and fastest-firing (HDL-64E S1) sensor needs.
pub const MAX_FIRINGS_PER_TURN: usize = 12_500;

/// Steps longer than this are taken as backward: packets out of order, not a sensor that sees a tenth of a turn.
pub(crate) const LONGEST_FORWARD: u32 = AZIMUTHS_PER_TURN - AZIMUTHS_PER_TURN / 10;
/// Backward steps up to this are the encoder's tremble.
const TREMBLE: u32 = 20;

/// What a step between two firings shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// As far as expected.
    Even,
    /// Farther: azimuths are missing.
    Gap,
    /// Backwards.
    Reversal,
}

/// Follows one sensor's azimuth.
#[derive(Clone, Debug)]
pub(crate) struct Turns {
    cut: u32,
    last: Option<u32>,
    /// Counts travelled since the turn began.
    travelled: u64,
}

impl Turns {
    pub fn new(cut_azimuth_deg: f32) -> Self {
        let cut = (f64::from(cut_azimuth_deg).rem_euclid(360.0) * 100.0).round();
        Self { cut: cut as u32 % AZIMUTHS_PER_TURN, last: None, travelled: 0 }
    }

    /// Follows one firing; gives the step and whether the turn ends before it. `expected`: counts a firing.
    pub fn follow(&mut self, azimuth: u32, expected: u32) -> (Step, bool) {
        let Some(last) = self.last.replace(azimuth) else { return (Step::Even, false) };
        let turned = forward(last, azimuth);
        if turned > AZIMUTHS_PER_TURN - TREMBLE {
            self.last = Some(last);
            return (Step::Even, false);
        }
        if turned > LONGEST_FORWARD {
            return (Step::Reversal, false);
        }
        self.travelled += u64::from(turned);
        let to_cut = match forward(last, self.cut) {
            0 => AZIMUTHS_PER_TURN,
            way => way,
        };
        // One packet of a single firing lost doubles the step; an encoder's jitter does not reach half of it.
        let step = if turned > expected + expected / 2 + 8 { Step::Gap } else { Step::Even };
        (step, to_cut <= turned)
    }

    /// Azimuth of the firing followed last.
    pub fn last(&self) -> Option<u32> {
        self.last
    }

    /// Counts travelled from the turn's first firing to its last; starts anew with the firing followed last.
    pub fn restart(&mut self) -> u64 {
        std::mem::take(&mut self.travelled)
    }

    /// Counts travelled since the turn's first firing.
    pub fn travelled(&self) -> u64 {
        self.travelled
    }

    /// Whether a turn that starts at `azimuth` misses nothing.
    pub fn starts_at_cut(&self, azimuth: u32, expected: u32) -> bool {
        forward(self.cut, azimuth) <= expected + expected / 2
    }

    /// Whether the firing followed last was the turn's last.
    pub fn ends_at_cut(&self, expected: u32) -> bool {
        self.last.is_some_and(|last| (1..=expected + expected / 2).contains(&forward(last, self.cut)))
    }

    /// Forgets where the sensor was.
    pub fn forget(&mut self) {
        (self.last, self.travelled) = (None, 0);
    }
}

/// Counts a firing at `rpm`.
pub(crate) fn expected_step(spec: &ModelSpec, mode: ReturnMode, rpm: f32) -> u32 {
    let per_ns = f64::from(rpm) / 60e9 * f64::from(AZIMUTHS_PER_TURN);
    (per_ns * f64::from(spec.period_ns(mode))).round() as u32
}
