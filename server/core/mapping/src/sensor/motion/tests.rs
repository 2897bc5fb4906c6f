//! The clocks of scans and poses, as a motion sees them.

use super::*;

const STEP_NS: i64 = 300_000_000;
/// Event time after the scans of [`stepped_clock`].
const AFTER_NS: i64 = 2_000_000_000;

fn pose(stamp_ns: i64) -> EgoPose {
    EgoPose { stamp_ns, map_from_ego: Isometry3::identity(), speed_mps: 0.0 }
}

/// A clock that was 0.3 s behind for a second, and right for the second after it.
fn stepped_clock() -> ScanClock {
    let mut clock = ScanClock::default();
    for scan in 0..20 {
        let behind_ns = if scan < 10 { STEP_NS } else { 0 };
        clock.note([scan * 100_000_000 - behind_ns; 2], scan * 100_000_000);
    }
    clock
}

#[test]
fn without_poses_no_clock_of_poses_differs_from_the_clock_of_the_scan() {
    let (mut motion, mut clock) = (Motion::new(&MotionConfig::default()), stepped_clock());
    motion.note_scan(AFTER_NS, AFTER_NS, &mut clock);
    assert_eq!(motion.ahead_of_scan_ns(), None);
    motion.push_pose(&pose(0), 0);
    assert_eq!(motion.ahead_of_scan_ns(), Some(-STEP_NS));
}

#[test]
fn a_clock_that_is_set_right_by_a_step_agrees_from_then_on_and_not_after_the_next_step() {
    let (mut motion, mut clock) = (Motion::new(&MotionConfig::default()), stepped_clock());
    let mut ahead_ns = |scan: i64, ahead_ns: i64| {
        let event_ns = AFTER_NS + scan * 100_000_000;
        motion.push_pose(&pose(event_ns), event_ns);
        clock.note([event_ns + ahead_ns; 2], event_ns);
        motion.note_scan(event_ns + ahead_ns, event_ns, &mut clock);
        motion.ahead_of_scan_ns()
    };
    // No scan before the step had a pose.
    (0..20).for_each(|scan| assert_eq!(ahead_ns(scan, 0), None, "scan {scan}"));
    (20..30).for_each(|scan| assert_eq!(ahead_ns(scan, 400_000_000), Some(-400_000_000), "scan {scan}"));
    (30..40).for_each(|scan| assert_eq!(ahead_ns(scan, 0), None, "scan {scan}"));
}
