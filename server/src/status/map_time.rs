//! How long the engine worked on the newest maps -> how long a map of so many points takes on this machine.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::time::Duration;

use crate::base::sync::locked;

/// Maps that are remembered. The least of their times counts, because other work on the machine only adds to it.
const MAPS: usize = 4;
/// Points that take as long as what does not depend on the number of points. Ours: a sixth of a revolution of an
/// HDL-64E.
const FIXED_POINTS: usize = 20_000;
/// Time for one point before the first map. Ours: all layers of an HDL-64E take about 12 ms for 123,000 points.
const FIRST_NS: f64 = 100.0;

/// The time that a vehicle's maps take for each point, as measured.
#[derive(Debug, Default)]
pub struct MapTime(Mutex<VecDeque<f64>>);

impl MapTime {
    /// Remembers that the engine worked on a map of `points` points for so long.
    pub fn record(&self, points: usize, worked: Duration) {
        let mut newest = locked(&self.0);
        if newest.len() == MAPS {
            newest.pop_front();
        }
        newest.push_back(worked.as_nanos() as f64 / (points + FIXED_POINTS) as f64);
    }

    /// How long the engine works on a map of `points` points.
    pub fn of(&self, points: usize) -> Duration {
        let least_ns = locked(&self.0).iter().copied().reduce(f64::min).unwrap_or(FIRST_NS);
        Duration::from_nanos((least_ns * points.saturating_add(FIXED_POINTS) as f64) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_takes_as_long_for_each_point_as_the_fastest_of_the_newest_maps() {
        let time = MapTime::default();
        assert_eq!(time.of(980_000), Duration::from_millis(100), "before the first map");
        for took_ms in [30, 20, 9_000, 25] {
            time.record(80_000, Duration::from_millis(took_ms));
        }
        assert_eq!(time.of(80_000), Duration::from_millis(20));
        assert_eq!(time.of(980_000), Duration::from_millis(200));
        for _ in 0..3 {
            time.record(80_000, Duration::from_millis(40));
        }
        assert_eq!(time.of(80_000), Duration::from_millis(25), "the first three are forgotten");
    }
}
