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
/// Time between two judgements without what was measured: maps that were slow for another reason, such as a busy
/// machine, must not refuse every scan after them.
const AGAIN_NS: i64 = 1_000_000_000;

/// The time that a vehicle's maps take for each point, as measured.
#[derive(Debug, Default)]
pub struct MapTime(Mutex<Newest>);

#[derive(Debug, Default)]
struct Newest {
    /// Time for one point of the newest maps, ns.
    ns: VecDeque<f64>,
    /// When more than allowed was last allowed as before the first map, ns since the Unix epoch.
    allowed_ns: Option<i64>,
}

impl Newest {
    fn least_ns(&self) -> f64 {
        self.ns.iter().copied().reduce(f64::min).unwrap_or(FIRST_NS)
    }
}

impl MapTime {
    /// Remembers that the engine worked on a map of `points` points for so long: all that arrived for it, also those
    /// that are filtered out and those without a return.
    pub fn record(&self, points: usize, worked: Duration) {
        let newest = &mut locked(&self.0).ns;
        if newest.len() == MAPS {
            newest.pop_front();
        }
        newest.push_back(worked.as_nanos() as f64 / (points + FIXED_POINTS) as f64);
    }

    /// How long the engine works on a map of `points` points.
    pub fn of(&self, points: usize) -> Duration {
        of_points(locked(&self.0).least_ns(), points.saturating_add(FIXED_POINTS))
    }

    /// How long the engine works on `points` points of a map.
    pub fn of_part(&self, points: usize) -> Duration {
        of_points(locked(&self.0).least_ns(), points)
    }

    /// True if a map of `points` points takes at most `most`. Once a second it is judged as before the first map.
    pub fn allows(&self, points: usize, most: Duration, now_ns: i64) -> bool {
        let mut newest = locked(&self.0);
        let takes = |ns: f64| of_points(ns, points.saturating_add(FIXED_POINTS));
        if takes(newest.least_ns()) <= most {
            return true;
        }
        let is_again = newest.allowed_ns.is_none_or(|allowed_ns| now_ns.saturating_sub(allowed_ns) >= AGAIN_NS);
        let allowed = is_again && takes(FIRST_NS) <= most;
        newest.allowed_ns = if allowed { Some(now_ns) } else { newest.allowed_ns };
        allowed
    }
}

fn of_points(ns: f64, points: usize) -> Duration {
    Duration::from_nanos((ns * points as f64) as u64)
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

    #[test]
    fn slow_maps_refuse_what_was_fast_for_a_second_and_not_for_ever() {
        let (time, most) = (MapTime::default(), Duration::from_millis(50));
        assert!(time.allows(480_000, most, 0) && !time.allows(480_001, most, 0), "before the first map");
        time.record(80_000, Duration::from_millis(1_000));
        assert!(time.allows(480_000, most, 5), "once");
        assert!(!time.allows(480_000, most, AGAIN_NS + 4) && !time.allows(480_001, most, AGAIN_NS + 5));
        assert!(time.allows(480_000, most, AGAIN_NS + 5), "again");
        time.record(480_000, Duration::from_millis(20));
        assert!(time.allows(480_000, most, AGAIN_NS + 6), "it was fast");
    }
}
