//! The readings of a bag in an order in which scans have poses: a pose is logged when its computation has ended, up to
//! half a second after the scan of its stamp, and the next one of a slow source of poses comes later still.

use std::collections::VecDeque;

use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;

use crate::topics::available::NEAR_NS;

/// Greatest time by which a scan that waits is ahead of its arrival, ns. Ours: clocks that agree differ by less.
const SKEW_NS_MAX: i64 = 50_000_000;
/// Longest time, of the log, for which a scan waits for a pose, ns. Ours: the motion is interpolated between two poses
/// that are as far apart.
const WAIT_NS: i64 = 1_000_000_000;

/// Readings on their way. A pose goes before the scans that wait; everything else keeps its order. All readings keep
/// their stamps and arrivals, by which steps of their clocks are found.
#[derive(Default)]
pub(super) struct LatePoses {
    poses: VecDeque<Reading>,
    /// Scans that wait, and what came after them.
    held: VecDeque<Reading>,
    /// How many of them wait no longer.
    passed: usize,
    newest_pose_ns: Option<i64>,
    newest_arrival_ns: i64,
}

impl LatePoses {
    /// Adds the next reading of the log.
    pub(super) fn push(&mut self, reading: Reading) {
        self.newest_arrival_ns = reading.arrival_ns;
        let Body::EgoPose(pose) = &reading.body else { return self.held.push_back(reading) };
        let steps_back = self.newest_pose_ns.replace(pose.stamp_ns).is_some_and(|before_ns| pose.stamp_ns < before_ns);
        if steps_back || self.passed > 0 {
            // The scans before it belong to the poses before it.
            self.held.push_back(reading);
            self.passed = self.held.len();
        } else {
            self.poses.push_back(reading);
        }
    }

    /// The next reading; `None` if it waits for more of the log.
    pub(super) fn pop(&mut self) -> Option<Reading> {
        let is_next = |held: &Reading| self.passed > 0 || !self.waits(held);
        if self.poses.is_empty() && !self.held.front().is_some_and(is_next) { None } else { self.pop_waiting() }
    }

    /// The next reading, whether it waits or not.
    pub(super) fn pop_waiting(&mut self) -> Option<Reading> {
        self.poses.pop_front().or_else(|| {
            self.passed = self.passed.saturating_sub(1);
            self.held.pop_front()
        })
    }

    /// Arrival of the first reading that waits.
    pub(super) fn waiting_ns(&self) -> Option<i64> {
        self.held.front().map(|reading| reading.arrival_ns)
    }

    /// True while a scan may still have a pose near its stamp.
    fn waits(&self, reading: &Reading) -> bool {
        let stamp_ns = match &reading.body {
            Body::Scan(scan) => scan.stamp_ns,
            Body::Datagram(_) => reading.arrival_ns,
            _ => return false,
        };
        // A scan that is farther ahead of the poses, or ahead of its own arrival, has another clock than they.
        let ahead_ns = |of_ns: i64| stamp_ns.saturating_sub(of_ns);
        let may_come = |pose_ns: i64| (NEAR_NS + 1..=NEAR_NS + WAIT_NS).contains(&ahead_ns(pose_ns));
        self.newest_pose_ns.is_none_or(may_come)
            && ahead_ns(reading.arrival_ns) <= SKEW_NS_MAX
            && (0..WAIT_NS).contains(&self.newest_arrival_ns.saturating_sub(reading.arrival_ns))
    }
}

#[cfg(test)]
mod tests {
    use clearway_mapping::event::{EgoPose, Scan};
    use nalgebra::Isometry3;

    use super::*;

    /// The readings of a log in the order in which they are given. A scan is its stamp in ms, a pose its negative
    /// stamp; the log has the arrival of each before it, ms.
    fn order(log_ms: &[(i64, i64)]) -> Vec<i64> {
        let (mut late, mut given) = (LatePoses::default(), Vec::new());
        let number = |reading: &Reading| match &reading.body {
            Body::EgoPose(pose) => -pose.stamp_ns / 1_000_000,
            Body::Scan(scan) => scan.stamp_ns / 1_000_000,
            _ => 0,
        };
        for &(arrival_ms, signed_ms) in log_ms {
            let stamp_ns = signed_ms.abs() * 1_000_000;
            let body = match signed_ms {
                ..0 => Body::EgoPose(EgoPose { stamp_ns, map_from_ego: Isometry3::identity(), speed_mps: 0.0 }),
                0.. => Body::Scan(Scan { stamp_ns, ..Scan::default() }),
            };
            late.push(Reading { arrival_ns: arrival_ms * 1_000_000, source: 0, body });
            given.extend(std::iter::from_fn(|| late.pop()).map(|reading| number(&reading)));
        }
        given.extend(std::iter::from_fn(|| late.pop_waiting()).map(|reading| number(&reading)));
        given
    }

    #[test]
    fn a_scan_waits_for_the_first_pose_near_its_stamp_and_a_second_at_most() {
        // Poses in time: the order of the log.
        assert_eq!(order(&[(100, -100), (101, 101), (200, -200), (201, 201)]), [-100, 101, -200, 201]);
        // Each pose is logged 0.5 s after its stamp.
        assert_eq!(order(&[(600, -100), (610, 600), (900, -400), (910, 910)]), [-100, -400, 600, 910]);
        // A pose a second.
        assert_eq!(order(&[(0, -1), (150, 150), (300, 300), (400, 400), (1000, -1000)]), [-1, 150, -1000, 300, 400]);
        // The clock of the scans is ahead.
        assert_eq!(order(&[(0, -1), (100, 400), (150, -150), (200, 500)]), [-1, 400, -150, 500]);
        assert_eq!(order(&[(0, -1), (100, 1_300), (150, -150), (200, 1_400)]), [-1, 1_300, -150, 1_400]);
        // The poses have ended.
        let ended = [(0, -1), (500, 500), (1000, 1000), (1499, 1499), (1500, 1500), (2000, 2000)];
        assert_eq!(order(&ended), [-1, 500, 1000, 1499, 1500, 2000]);
        let mut late = LatePoses::default();
        for &(arrival_ms, given) in &[(0, true), (500, false), (1000, false), (1499, false), (1500, true)] {
            let body = Body::Scan(Scan { stamp_ns: 1_000_000 * arrival_ms, ..Scan::default() });
            late.newest_pose_ns = Some(0);
            late.push(Reading { arrival_ns: 1_000_000 * arrival_ms, source: 0, body });
            assert_eq!(late.pop().is_some(), given, "{arrival_ms}");
        }
    }

    #[test]
    fn a_pose_of_a_clock_that_steps_back_passes_no_scan() {
        let log = [(0, -9_000), (100, 9_900), (200, -1_000), (210, 1_010), (300, -1_100)];
        assert_eq!(order(&log), [-9_000, 9_900, -1_000, 1_010, -1_100]);
    }
}
