//! The cut between two revolutions, and the continuity of the azimuth.
//!
//! In: the azimuths of firings, in time order. Out: the firing before which a revolution ends, and whether azimuths are
//! missing or run backwards. A revolution ends between two firings, anywhere in a packet.
//!
//! # Steps between two firings
//!
//! | turned since the firing before | step | ends the revolution |
//! |---|---|---|
//! | there is no firing before | even | no |
//! | backward by less than 0.2 degrees | even; the azimuth before is kept | no |
//! | backward by less than 36 degrees | reversal | no |
//! | forward by at most 1.5 steps and 8 counts | even | if it passes the cut |
//! | forward by more | gap; even if it is the field-of-view gap | if it passes the cut |
//!
//! # States of a revolution
//!
//! The decoder keeps the state: no firings (*empty*), [`Revolution::partial`](crate::Revolution) is `None` (*complete
//! so far*), or it is a reason (*partial*). The first reason stays. A firing before which a revolution ends begins the
//! next one.
//!
//! | state | event | action | next state |
//! |---|---|---|---|
//! | empty | a firing within 1.5 steps behind the cut | begin | complete so far |
//! | empty | another firing | begin | partial: `start` |
//! | any other | even step | add the firing | the same |
//! | any other | gap | add the firing | partial: `gap` |
//! | any other | reversal | add the firing | partial: `reversal` |
//! | any other | the step passes the cut | end before the firing | complete so far; partial: `gap` if it is a gap |
//! | any other | the step passes the cut again in the same datagram | add the firing | partial: `reversal` |
//! | any other | device time jumps; a revolution or 1 s is missing | end as partial: `gap` | partial: `gap` |
//! | any other | 12,500 firings | end as partial: `overlong` | partial: `overlong` |
//! | any other | the return mode changes | end as partial: `end` | empty |
//! | any other | the stream ends within 1.5 steps before the cut | end | empty |
//! | any other | the stream ends elsewhere | end as partial: `end` | empty |

use super::azimuth::forward;
use crate::model::AZIMUTHS_PER_REVOLUTION;

/// Greatest number of firings of a revolution, so that a sensor that stands still does not fill the memory. It is twice
/// the number of the slowest (300 rpm) sensor with the shortest firing period (HDL-64E S1).
pub(super) const MAX_FIRINGS_PER_REVOLUTION: usize = 12_500;

/// Greatest forward step, in counts: 324 degrees. A longer step is a step backward: packets are out of order. Ours: a
/// sensor with a field of view of less than 36 degrees is not supported.
pub(super) const FORWARD_MAX: u32 = AZIMUTHS_PER_REVOLUTION - AZIMUTHS_PER_REVOLUTION / 10;
/// Backward step, in counts, below which it is jitter of the encoder: 0.2 degrees, which is about one step of a sensor
/// at 600 rpm (ours).
const JITTER: u32 = 20;
/// Counts, besides one and a half steps, above which a step is a gap. Ours: at low rates half a step is only four
/// counts, which jitter and the rounding of azimuths to whole counts can reach.
const GAP_SLACK: u32 = 8;

/// The longest step, in counts, between two firings with the usual step `expected`. The loss of a packet with a single
/// firing doubles the step; the jitter of an encoder stays below half a step.
fn step_max(expected: u32) -> u32 {
    expected + expected / 2
}

/// The kind of a step between two firings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// The step has the expected length.
    Even,
    /// The step is longer: azimuths are missing.
    Gap,
    /// The step is backward.
    Reversal,
}

/// The position of one sensor's azimuth relative to the cut.
#[derive(Clone, Debug)]
pub(super) struct Cutter {
    /// Azimuth at which revolutions are cut.
    cut: u32,
    last: Option<u32>,
    /// Counts since the first firing of the revolution.
    travelled: u64,
}

impl Cutter {
    pub fn new(cut_azimuth_deg: f32) -> Self {
        let cut = (f64::from(cut_azimuth_deg).rem_euclid(360.0) * 100.0).round();
        Self { cut: cut as u32 % AZIMUTHS_PER_REVOLUTION, last: None, travelled: 0 }
    }

    /// Adds a firing and returns the kind of its step, and true if the step passes the cut. `expected`: the usual step,
    /// in counts.
    pub fn push(&mut self, azimuth: u32, expected: u32) -> (Step, bool) {
        let Some(last) = self.last.replace(azimuth) else { return (Step::Even, false) };
        let turned = forward(last, azimuth);
        if turned > AZIMUTHS_PER_REVOLUTION - JITTER {
            self.last = Some(last);
            return (Step::Even, false);
        }
        if turned > FORWARD_MAX {
            return (Step::Reversal, false);
        }
        self.travelled += u64::from(turned);
        let to_cut = match forward(last, self.cut) {
            0 => AZIMUTHS_PER_REVOLUTION,
            counts => counts,
        };
        let step = if turned > step_max(expected) + GAP_SLACK { Step::Gap } else { Step::Even };
        (step, to_cut <= turned)
    }

    /// Azimuth of the newest firing.
    pub fn last(&self) -> Option<u32> {
        self.last
    }

    /// Begins a revolution with the newest firing and returns the counts from the first firing of the revolution before
    /// to the newest firing.
    pub fn restart(&mut self) -> u64 {
        std::mem::take(&mut self.travelled)
    }

    /// Counts since the first firing of the revolution.
    pub fn travelled(&self) -> u64 {
        self.travelled
    }

    /// True if a revolution that begins at `azimuth` misses nothing.
    pub fn starts_at_cut(&self, azimuth: u32, expected: u32) -> bool {
        forward(self.cut, azimuth) <= step_max(expected)
    }

    /// True if the newest firing is the last of its revolution.
    pub fn ends_at_cut(&self, expected: u32) -> bool {
        self.last.is_some_and(|last| (1..=step_max(expected)).contains(&forward(last, self.cut)))
    }

    /// Forgets the newest azimuth and the counts travelled, as before the first firing.
    pub fn reset(&mut self) {
        (self.last, self.travelled) = (None, 0);
    }
}
