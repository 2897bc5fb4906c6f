//! How the vehicle moved while a turn was scanned, so that each firing can be moved to the turn's end.
//!
//! In: ego poses and the sensor's own GPRMC speed, as events brought them. Out: the ego pose at a stamp, and for a
//! revolution [`Moved`]: `end_from_ego` along its firings, ego frame at the firing -> ego frame at the last firing.
//!
//! Between two poses translation is linear and rotation a slerp; beyond the newest pose the motion of its last 50 ms
//! goes on unchanged, for at most `extrapolation_ms`. Where poses do not reach, or jump within the revolution, the
//! vehicle is taken to go straight ahead with the newest speed known; where none is known, nothing is moved. All of it
//! is a pure function of the events so far: no map waits for a pose that may yet come, so a replay moves each firing as
//! the drive did. A pose that arrives after the revolution it belongs to serves the next one.

use std::collections::VecDeque;

use clearway_lidar::revolution::Revolution;
use clearway_lidar::telemetry::Gprmc;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::config::MotionConfig;
use crate::event::{EgoPose, Scan};

/// Poses kept: a second at 1 kHz, and more than one revolution of any sensor at any rate.
const POSES_MAX: usize = 1024;
/// Poses farther apart say too little of what was between: at 15 m/s a vehicle in a bend of 50 m is 0.6 m beside the
/// chord of one second.
const GAP_NS_MAX: i64 = 1_000_000_000;
/// The velocity beyond the newest pose is measured over at least this long: a millimetre of noise then makes 2 cm/s.
const BASELINE_NS: i64 = 50_000_000;
/// Nothing on wheels is faster: poses that say so have jumped, as when a receiver finds its satellites again.
const SPEED_MPS_MAX: f64 = 100.0;
/// What a pose may be off by beside its neighbour without having jumped.
const JUMP_M_MAX: f64 = 0.5;
/// Firings from one exact pose to the next; between, the matrices are interpolated. A turn of 1 rad/s errs by less than
/// a tenth of a millimetre at 100 m in the millisecond of 16 firings.
pub(crate) const KNOT_FIRINGS: usize = 16;

/// What moved a sweep's firings to one stamp.
///
/// Of two, the lesser knows less.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Compensation {
    /// Nothing: no motion is known, it is switched off, or the points came as a scan and their times are not known.
    #[default]
    None,
    /// The newest speed, straight ahead.
    Speed,
    /// Ego poses.
    Poses,
}

impl Compensation {
    /// As the wire spells it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Poses => "poses",
            Self::Speed => "speed",
        }
    }
}

/// How the ego frame moved through one revolution.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moved {
    /// What is known of it.
    pub compensation: Compensation,
    /// Forward speed at the end, m/s, where known.
    pub speed_mps: Option<f64>,
    /// `end_from_ego` at firings 0, 16, 32, … and at the last one (of a scan: at 2 to 257 moments, evenly spaced);
    /// empty where nothing is moved.
    pub end_from_ego: Vec<Isometry3<f64>>,
}

/// Indices of the firings at which [`Moved::end_from_ego`] is exact.
pub(crate) fn knots(firings: usize) -> impl ExactSizeIterator<Item = usize> + Clone {
    let count = if firings == 0 { 0 } else { (firings - 1).div_ceil(KNOT_FIRINGS) + 1 };
    (0..count).map(move |knot| (knot * KNOT_FIRINGS).min(firings - 1))
}

/// A speed somebody told of.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Told {
    /// End of the sensor's turn it came after; `None` until a turn has ended. No clock of the host's tells its age, so
    /// none that steps makes it old.
    stamp_ns: Option<i64>,
    /// Of the sentence: one that is repeated is no news.
    utc_ns: Option<i64>,
    speed_mps: f64,
}

/// What is known of one vehicle's motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    config: MotionConfig,
    /// In the order of their stamps.
    poses: VecDeque<EgoPose>,
    told: Option<Told>,
}

impl Motion {
    /// Nothing is known yet.
    pub fn new(config: &MotionConfig) -> Self {
        Self { config: config.clone(), poses: VecDeque::with_capacity(POSES_MAX), told: None }
    }

    /// The newest pose.
    pub fn newest_pose(&self) -> Option<&EgoPose> {
        self.poses.back()
    }

    /// Forgets where the vehicle was.
    pub fn forget_poses(&mut self) {
        self.poses.clear();
    }

    /// Takes a pose, newer than those before; the oldest makes room.
    pub fn take_pose(&mut self, pose: &EgoPose) {
        debug_assert!(self.newest_pose().is_none_or(|newest| newest.stamp_ns < pose.stamp_ns), "poses in order");
        if self.poses.len() == POSES_MAX {
            self.poses.pop_front();
        }
        self.poses.push_back(pose.clone());
    }

    /// Takes the speed over ground of a GPRMC that came after the turn of its sensor that ended at `stamp_ns` (`None`:
    /// before its first), if the receiver calls it valid. It is a speed without a sign: who drives backwards for long
    /// switches the fall-back off or sends poses.
    pub fn take_gprmc(&mut self, gprmc: &Gprmc, stamp_ns: Option<i64>) {
        let repeated = self.told.is_some_and(|told| told.utc_ns.is_some() && told.utc_ns == gprmc.utc_ns);
        if let (true, false, Some(speed_mps)) = (gprmc.valid, repeated, gprmc.speed_mps()) {
            self.told = Some(Told { stamp_ns, utc_ns: gprmc.utc_ns, speed_mps });
        }
    }

    /// Takes note that a turn has ended: what was told before any had is taken to be of this moment.
    pub fn take_turn(&mut self, stamp_ns: i64) {
        if let Some(told) = &mut self.told {
            told.stamp_ns.get_or_insert(stamp_ns);
        }
    }

    /// `map_from_ego` at a stamp; `None` where the poses do not reach it.
    pub fn map_from_ego(&self, stamp_ns: i64) -> Option<Isometry3<f64>> {
        let next = self.poses.partition_point(|pose| pose.stamp_ns < stamp_ns);
        let reach_ns = i64::from(self.config.extrapolation_ms) * 1_000_000;
        let (first, last) = (self.poses.front()?, self.poses.back()?);
        if stamp_ns < first.stamp_ns {
            let near = first.stamp_ns.saturating_sub(stamp_ns) <= reach_ns;
            let since = self.poses.partition_point(|pose| pose.stamp_ns < first.stamp_ns.saturating_add(BASELINE_NS));
            let other = self.poses.get(since).or(Some(last));
            return near.then(|| along(first, other, stamp_ns));
        }
        match self.poses.get(next) {
            Some(after) if after.stamp_ns == stamp_ns => Some(after.map_from_ego),
            Some(after) => {
                let before = &self.poses[next - 1];
                (after.stamp_ns.saturating_sub(before.stamp_ns) <= GAP_NS_MAX).then(|| between(before, after, stamp_ns))
            }
            None => {
                let near = stamp_ns.saturating_sub(last.stamp_ns) <= reach_ns;
                let until = last.stamp_ns.saturating_sub(BASELINE_NS);
                let before = self.poses.partition_point(|pose| pose.stamp_ns <= until);
                near.then(|| along(last, self.poses.get(before.saturating_sub(1)), stamp_ns))
            }
        }
    }

    /// Forward speed at a stamp as the poses tell it; `None` where they do not reach it.
    fn pose_speed_mps(&self, stamp_ns: i64) -> Option<f64> {
        let next = self.poses.partition_point(|pose| pose.stamp_ns < stamp_ns);
        let (before, after) = (next.checked_sub(1).and_then(|i| self.poses.get(i)), self.poses.get(next));
        match (before, after) {
            (Some(before), Some(after)) => {
                let share = share(before.stamp_ns, after.stamp_ns, stamp_ns);
                Some(before.speed_mps + share * (after.speed_mps - before.speed_mps))
            }
            (only, other) => only.or(other).map(|pose| pose.speed_mps),
        }
    }

    /// The ego frame and its speed at a turn's end.
    pub fn at(&self, stamp_ns: i64) -> (Option<Isometry3<f64>>, Option<f64>) {
        let pose = self.map_from_ego(stamp_ns);
        let speed_mps = match pose {
            Some(_) => self.pose_speed_mps(stamp_ns),
            None => self.newest_speed_mps(stamp_ns),
        };
        (pose, speed_mps)
    }

    /// The newest speed anybody told of, if it is no older than `speed_age_ms`: of the newest pose by its stamp, of the
    /// sensor's telemetry by the turn it came after (its receiver's second says little of when the car was that fast).
    fn newest_speed_mps(&self, stamp_ns: i64) -> Option<f64> {
        let pose = self.poses.back().map(|pose| (stamp_ns.saturating_sub(pose.stamp_ns), pose.speed_mps));
        let told_ns = |told: &Told| told.stamp_ns.unwrap_or(stamp_ns);
        let told = self.told.map(|told| (stamp_ns.saturating_sub(told_ns(&told)), told.speed_mps));
        let age_ns_max = i64::from(self.config.speed_age_ms) * 1_000_000;
        let fresh = [pose, told].into_iter().flatten().filter(|(age_ns, _)| age_ns.saturating_abs() <= age_ns_max);
        fresh.min_by_key(|(age_ns, _)| age_ns.saturating_abs()).map(|(_, speed_mps)| speed_mps)
    }

    /// How the ego frame moved through a revolution, in place of what `moved` held.
    pub fn through(&self, revolution: &Revolution, moved: &mut Moved) {
        let offset = |firing: usize| i64::from(revolution.firings[firing].offset_ns);
        let stamps = knots(revolution.firings.len()).map(|firing| revolution.start_ns + offset(firing));
        self.through_stamps(stamps, revolution.end_ns, moved);
    }

    /// The same for a scan; where its points' times are not known nothing is moved.
    pub fn through_scan(&self, scan: &Scan, moved: &mut Moved) {
        let knots = ScanKnots::of(scan);
        let stamps = (0..knots.count()).map(|knot| scan.stamp_ns.saturating_add(knots.offset_ns(knot)));
        self.through_stamps(stamps, scan.stamp_ns, moved);
    }

    fn through_stamps(&self, stamps: impl ExactSizeIterator<Item = i64> + Clone, end_ns: i64, moved: &mut Moved) {
        moved.end_from_ego.clear();
        let (pose, speed_mps) = self.at(end_ns);
        (moved.compensation, moved.speed_mps) = (Compensation::None, speed_mps);
        if !self.config.enabled || stamps.len() == 0 {
            return;
        }
        if let Some(map_from_end) = pose {
            let end_from_map = map_from_end.inverse();
            for stamp_ns in stamps.clone() {
                let Some(end_from_ego) = self.carry_by_poses(&end_from_map, stamp_ns, end_ns) else { break };
                moved.end_from_ego.push(end_from_ego);
            }
            if moved.end_from_ego.len() == stamps.len() {
                moved.compensation = Compensation::Poses;
                return;
            }
            moved.end_from_ego.clear();
        }
        if let Some(speed_mps) = self.newest_speed_mps(end_ns) {
            moved.speed_mps = Some(speed_mps);
            moved.compensation = Compensation::Speed;
            moved.end_from_ego.extend(stamps.map(|stamp_ns| straight_ahead(speed_mps, stamp_ns, end_ns)));
        }
    }

    /// `to_from_from`: carries points of the ego frame at one stamp into the one at another, and what is known of the
    /// way.
    pub fn carry(&self, from_ns: i64, to_ns: i64) -> (Isometry3<f64>, Compensation) {
        let by_poses = || self.carry_by_poses(&self.map_from_ego(to_ns)?.inverse(), from_ns, to_ns);
        let by_speed = || Some(straight_ahead(self.newest_speed_mps(to_ns)?, from_ns, to_ns));
        if !self.config.enabled {
            return (Isometry3::identity(), Compensation::None);
        }
        by_poses()
            .map(|carried| (carried, Compensation::Poses))
            .or_else(|| by_speed().map(|carried| (carried, Compensation::Speed)))
            .unwrap_or((Isometry3::identity(), Compensation::None))
    }

    /// `None` where the poses do not reach `from_ns`, or jump on the way.
    fn carry_by_poses(&self, to_from_map: &Isometry3<f64>, from_ns: i64, to_ns: i64) -> Option<Isometry3<f64>> {
        let to_from_ego = to_from_map * self.map_from_ego(from_ns)?;
        let seconds = to_ns.saturating_sub(from_ns).saturating_abs() as f64 * 1e-9;
        let near = to_from_ego.translation.vector.norm() <= JUMP_M_MAX + SPEED_MPS_MAX * seconds;
        near.then_some(to_from_ego)
    }
}

fn straight_ahead(speed_mps: f64, from_ns: i64, to_ns: i64) -> Isometry3<f64> {
    Isometry3::translation(from_ns.saturating_sub(to_ns) as f64 * 1e-9 * speed_mps, 0.0, 0.0)
}

/// The moments of a scan at which [`Moved::end_from_ego`] is exact: evenly spaced from its first point to its stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ScanKnots {
    /// From the first point to the stamp; `None` where the scan does not tell its points' times.
    span_ns: Option<i64>,
}

impl ScanKnots {
    /// A line serves for the arc of a millisecond, as between the knots of a revolution.
    const STEP_NS: i64 = 1_000_000;
    const STEPS_MAX: i64 = 256;

    pub(crate) fn of(scan: &Scan) -> Self {
        Self { span_ns: scan.offset_ns.iter().min().map(|first| -i64::from(*first)) }
    }

    fn steps(&self) -> i64 {
        self.span_ns.map_or(0, |span_ns| (span_ns / Self::STEP_NS).clamp(1, Self::STEPS_MAX))
    }

    fn count(&self) -> usize {
        self.span_ns.map_or(0, |_| self.steps() as usize + 1)
    }

    fn offset_ns(&self, knot: usize) -> i64 {
        let span_ns = self.span_ns.unwrap_or(0);
        span_ns * knot as i64 / self.steps().max(1) - span_ns
    }

    /// The knot before a point, of those that another follows, and the share of the way to it.
    #[inline(always)]
    pub(crate) fn place(&self, offset_ns: i32) -> (usize, f32) {
        let span_ns = self.span_ns.unwrap_or(0);
        let steps = (i64::from(offset_ns) + span_ns) as f32 * self.steps() as f32 / span_ns.max(1) as f32;
        let knot = (steps as usize).min((self.steps() as usize).saturating_sub(1));
        (knot, steps - knot as f32)
    }
}

fn share(from_ns: i64, to_ns: i64, stamp_ns: i64) -> f64 {
    stamp_ns.saturating_sub(from_ns) as f64 / to_ns.saturating_sub(from_ns) as f64
}

/// The pose at a stamp on the way from one pose to another; shares below 0 and above 1 go on beyond.
fn between(from: &EgoPose, to: &EgoPose, stamp_ns: i64) -> Isometry3<f64> {
    let share = share(from.stamp_ns, to.stamp_ns, stamp_ns);
    let (a, b) = (&from.map_from_ego, &to.map_from_ego);
    let translation = a.translation.vector.lerp(&b.translation.vector, share);
    // The shorter way round; the logarithm of a turn by exactly half is one of its two.
    let turned = a.rotation.rotation_to(&b.rotation).scaled_axis() * share;
    let rotation = UnitQuaternion::from_scaled_axis(turned) * a.rotation;
    Isometry3::from_parts(Translation3::from(translation), rotation)
}

/// The pose at a stamp beyond `pose`, with the motion between it and `other`; with its own speed straight ahead where
/// there is no other near enough.
fn along(pose: &EgoPose, other: Option<&EgoPose>, stamp_ns: i64) -> Isometry3<f64> {
    match other {
        Some(other) if (1..=GAP_NS_MAX).contains(&other.stamp_ns.saturating_sub(pose.stamp_ns).saturating_abs()) => {
            between(other, pose, stamp_ns)
        }
        _ => {
            let seconds = stamp_ns.saturating_sub(pose.stamp_ns) as f64 * 1e-9;
            pose.map_from_ego * Translation3::from(Vector3::x() * (seconds * pose.speed_mps))
        }
    }
}
