//! Differences between azimuths, in counts of a hundredth of a degree.

use crate::model::AZIMUTHS_PER_REVOLUTION;

/// Counts by which the sensor turns forward from one azimuth to the next, in `0..36000`.
pub(super) fn forward(from: u32, to: u32) -> u32 {
    (to + AZIMUTHS_PER_REVOLUTION - from) % AZIMUTHS_PER_REVOLUTION
}
