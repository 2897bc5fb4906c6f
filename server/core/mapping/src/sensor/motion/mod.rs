//! How the vehicle moved through a scan, so that each firing can be expressed at the scan's end.
//!
//! In: ego poses, and the speed in the sensor's own GPRMC sentences, in the order of the events. Out: the ego pose at a
//! stamp, and for each revolution or scan an [`EgoTrajectory`]: `end_from_ego` along its firings, which transforms the
//! ego frame at a firing into the ego frame at the last firing.
//!
//! | case | motion |
//! |---|---|
//! | between two poses | linear translation, spherical interpolation of the rotation |
//! | beyond the newest pose, for at most `extrapolation_ms` | the motion of the last 50 ms before it goes on |
//! | no pose near enough or of its clock, or the poses jump within the scan | straight ahead with the newest speed |
//! | no speed either | the points are not moved |
//!
//! The result is a function of the events so far. No map waits for a pose that may arrive later, so a replay moves each
//! firing as the drive did. A pose that arrives after the revolution it belongs to is used for the next one.

use std::collections::VecDeque;

use clearway_lidar::nmea::Gprmc;
use clearway_lidar::revolution::Revolution;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::sensor::observation::{EgoPose, Scan};
pub(crate) use knots::{KNOT_FIRINGS, ScanKnots, knots};
use stamp_clock::{ClockReading, PoseClock, ScanClock, agree};

mod knots;
pub(super) mod stamp_clock;

/// Number of poses that are kept. Ours: a second at 1 kHz, which is longer than a revolution of any sensor.
const POSES_MAX: usize = 1024;
/// Greatest time between two poses that are interpolated, ns. Ours: at 15 m/s in a bend of 50 m the path is 0.6 m
/// beside the chord of one second.
const GAP_NS_MAX: i64 = 1_000_000_000;
/// Least time over which the velocity beyond the newest pose is measured, ns. Ours: a millimetre of noise then makes 2
/// cm/s.
const BASELINE_NS: i64 = 50_000_000;
/// Greatest speed between two poses, m/s. Ours: no vehicle on wheels is faster; poses that are farther apart have
/// jumped, as they do when a receiver finds its satellites again.
const SPEED_MPS_MAX: f64 = 100.0;
/// Distance that two poses may be apart at any speed without counting as a jump, metres. Ours: the step of a receiver
/// that changes its set of satellites.
const JUMP_M_MAX: f64 = 0.5;
/// Time for which the motion is extrapolated after the newest pose (and before the oldest), milliseconds. 200 is
/// ours: two revolutions at 10 Hz.
pub(super) const EXTRAPOLATION_MS: u32 = 200;

/// Largest age of a speed that is used if no poses are near enough, milliseconds; 0 leaves such scans
/// uncompensated. 2000 is ours: two sentences of a GPS receiver that sends one each second.
pub(super) const SPEED_AGE_MS: u32 = 2000;

/// Parameters of the motion compensation, the table `[vehicle.maps.motion]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionConfig {
    /// True if points are moved to the end of their scan: a constant but in tests. The pose in a map's header is
    /// interpolated in any case.
    #[serde(skip)]
    pub enabled: bool,
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self { enabled: true }
    }
}

/// What moved the points of a sweep to one stamp. Ordered from least to most accurate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Compensation {
    /// Nothing: no motion is known, compensation is switched off, or the scan does not state the times of its points.
    #[default]
    None,
    /// The newest speed, straight ahead.
    Speed,
    /// Ego poses.
    Poses,
}

impl Compensation {
    /// Name of the value on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Poses => "poses",
            Self::Speed => "speed",
        }
    }
}

/// How the ego frame moved through one revolution or scan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EgoTrajectory {
    /// What the trajectory was computed from.
    pub compensation: Compensation,
    /// Forward speed at the end, m/s; `None` if it is unknown.
    pub speed_mps: Option<f64>,
    /// `end_from_ego` at firings 0, 16, 32, and so on, and at the last one; for a scan at 2 to 257 evenly spaced times.
    /// Empty if the points are not trajectory.
    pub end_from_ego: Vec<Isometry3<f64>>,
}

/// The newest speed from a sensor's telemetry.
#[derive(Clone, Copy, Debug, PartialEq)]
struct SpeedMeasurement {
    /// End of the sensor's newest scan when the sentence arrived, ns since the Unix epoch; `None` until a scan has
    /// ended. The age of the speed counts from it and not from the host's clock, so that a step of that clock does not
    /// age it.
    stamp_ns: Option<i64>,
    /// UTC of the sentence; repeats of the sentence are ignored.
    utc_ns: Option<i64>,
    speed_mps: f64,
}

/// What is known of one vehicle's motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    config: MotionConfig,
    /// In the order of their stamps.
    poses: VecDeque<EgoPose>,
    /// Event time of the first of them, ns; `None` without poses.
    began_event_ns: Option<i64>,
    pose_clock: PoseClock,
    /// How far the clock of the scan that is being made has stepped, ns.
    scan_step_ns: i64,
    measured: Option<SpeedMeasurement>,
}

impl Motion {
    /// A motion without poses and speeds.
    pub fn new(config: &MotionConfig) -> Self {
        Self {
            config: config.clone(),
            poses: VecDeque::with_capacity(POSES_MAX),
            began_event_ns: None,
            pose_clock: PoseClock::default(),
            scan_step_ns: 0,
            measured: None,
        }
    }

    /// The newest pose; `None` if there is none.
    pub fn newest_pose(&self) -> Option<&EgoPose> {
        self.poses.back()
    }

    /// Removes all poses.
    pub fn forget_poses(&mut self) {
        self.poses.clear();
        self.began_event_ns = None;
        self.pose_clock.forget_poses();
    }

    /// Notes that a pose was refused at this event time because its stamp is older than the newest one.
    pub fn note_refused_pose(&mut self, stamp_ns: i64, event_ns: i64) {
        self.pose_clock.note_refused(ClockReading { stamp_ns, event_ns });
    }

    /// Removes the poses if their stamps have stepped back and the scan that was completed at this event time has been
    /// stamped after the step: its stamp is nearer to the refused poses than to the poses before them. Unless the clock
    /// of the poses has stepped as far as the `clock` of the scan, no pose is of this scan's clock.
    pub(crate) fn note_scan(&mut self, stamp_ns: i64, event_ns: i64, clock: &mut ScanClock) {
        if self.map_from_ego(stamp_ns).is_some() {
            clock.note_pose(self.pose_clock.step_ns());
        }
        self.scan_step_ns = clock.step_ns();
        if self.pose_clock.has_stepped_back_with(ClockReading { stamp_ns, event_ns }) {
            self.forget_poses();
        }
    }

    /// Removes the poses if a sensor's stamps have begun an epoch and the poses have not: the first of them is older
    /// than the sensor's last scan before the epoch, at this event time.
    pub fn begin_epoch(&mut self, last_scan_event_ns: i64) {
        if self.began_event_ns.is_some_and(|began_ns| began_ns <= last_scan_event_ns) {
            self.forget_poses();
        }
    }

    /// Adds a pose, which must be newer than those before; they are removed if the stamps have stepped back. The oldest
    /// pose is removed if there are too many.
    pub fn push_pose(&mut self, pose: &EgoPose, event_ns: i64) {
        if self.pose_clock.stepped_back().is_some() {
            self.forget_poses();
        }
        self.began_event_ns.get_or_insert(event_ns);
        self.pose_clock.note(ClockReading { stamp_ns: pose.stamp_ns, event_ns });
        debug_assert!(self.newest_pose().is_none_or(|newest| newest.stamp_ns < pose.stamp_ns), "poses in order");
        if self.poses.len() == POSES_MAX {
            self.poses.pop_front();
        }
        self.poses.push_back(pose.clone());
    }

    /// Sets the newest speed to the speed over ground of a GPRMC sentence, if the receiver marks it as valid.
    /// `stamp_ns` is the end of the newest scan of the same sensor; `None` before its first. The speed has no sign: a
    /// vehicle that often drives backwards sends poses, or sets `speed_age_ms` to 0.
    pub fn apply_gprmc(&mut self, gprmc: &Gprmc, stamp_ns: Option<i64>) {
        let is_repeated = self.measured.is_some_and(|before| before.utc_ns.is_some() && before.utc_ns == gprmc.utc_ns);
        if let (true, false, Some(speed_mps)) = (gprmc.valid, is_repeated, gprmc.speed_mps()) {
            self.measured = Some(SpeedMeasurement { stamp_ns, utc_ns: gprmc.utc_ns, speed_mps });
        }
    }

    /// Notes the end of a scan. A speed that arrived before the first scan counts as measured at this end.
    pub fn note_scan_end(&mut self, stamp_ns: i64) {
        if let Some(measured) = &mut self.measured {
            measured.stamp_ns.get_or_insert(stamp_ns);
        }
    }

    /// Ego frame in the world frame at a stamp; `None` if no pose is near enough.
    pub fn map_from_ego(&self, stamp_ns: i64) -> Option<Isometry3<f64>> {
        let next = self.poses.partition_point(|pose| pose.stamp_ns < stamp_ns);
        let reach_ns = i64::from(EXTRAPOLATION_MS) * 1_000_000;
        let (first, last) = (self.poses.front()?, self.poses.back()?);
        if stamp_ns < first.stamp_ns {
            let is_near = first.stamp_ns.saturating_sub(stamp_ns) <= reach_ns;
            let since = self.poses.partition_point(|pose| pose.stamp_ns < first.stamp_ns.saturating_add(BASELINE_NS));
            let other = self.poses.get(since).or(Some(last));
            return is_near.then(|| extrapolate(first, other, stamp_ns));
        }
        match self.poses.get(next) {
            Some(after) if after.stamp_ns == stamp_ns => Some(after.map_from_ego),
            Some(after) => {
                let before = &self.poses[next - 1];
                (after.stamp_ns.saturating_sub(before.stamp_ns) <= GAP_NS_MAX)
                    .then(|| interpolate(before, after, stamp_ns))
            }
            None => {
                let is_near = stamp_ns.saturating_sub(last.stamp_ns) <= reach_ns;
                let until = last.stamp_ns.saturating_sub(BASELINE_NS);
                let before = self.poses.partition_point(|pose| pose.stamp_ns <= until);
                is_near.then(|| extrapolate(last, self.poses.get(before.saturating_sub(1)), stamp_ns))
            }
        }
    }

    /// Forward speed at a stamp, interpolated between the poses around it; `None` without poses.
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

    /// How far the clock of the poses has stepped ahead of the clock of the scan that is being made, ns; `None` if the
    /// two agree, or without poses.
    pub(super) fn ahead_of_scan_ns(&self) -> Option<i64> {
        self.newest_pose()?;
        let pose_step_ns = self.pose_clock.step_ns();
        (!agree(pose_step_ns, self.scan_step_ns)).then(|| pose_step_ns.saturating_sub(self.scan_step_ns))
    }

    /// Ego frame in the world frame and forward speed (m/s) at a stamp of the scan that is being made; `None` each if
    /// it is unknown.
    pub fn at(&self, stamp_ns: i64) -> (Option<Isometry3<f64>>, Option<f64>) {
        let pose = self.map_from_ego(stamp_ns).filter(|_| self.ahead_of_scan_ns().is_none());
        let speed_mps = match pose {
            Some(_) => self.pose_speed_mps(stamp_ns),
            None => self.newest_speed_mps(stamp_ns),
        };
        (pose, speed_mps)
    }

    /// The newest speed, m/s, of the newest pose or of telemetry; `None` if it is older than `speed_age_ms`. The age of
    /// a telemetry speed counts from the end of the scan before it, because a receiver reports only once a second.
    fn newest_speed_mps(&self, stamp_ns: i64) -> Option<f64> {
        let pose = self.poses.back().map(|pose| (stamp_ns.saturating_sub(pose.stamp_ns), pose.speed_mps));
        let age_ns = |measured: SpeedMeasurement| stamp_ns.saturating_sub(measured.stamp_ns.unwrap_or(stamp_ns));
        let measured = self.measured.map(|measured| (age_ns(measured), measured.speed_mps));
        let age_ns_max = i64::from(SPEED_AGE_MS) * 1_000_000;
        let fresh = [pose, measured].into_iter().flatten().filter(|(age_ns, _)| age_ns.saturating_abs() <= age_ns_max);
        fresh.min_by_key(|(age_ns, _)| age_ns.saturating_abs()).map(|(_, speed_mps)| speed_mps)
    }

    /// Writes how the ego frame moved through a revolution to `trajectory`.
    pub fn follow_revolution(&self, revolution: &Revolution, trajectory: &mut EgoTrajectory) {
        let offset = |firing: usize| i64::from(revolution.firings[firing].offset_ns);
        let stamps = knots(revolution.firings.len()).map(|firing| revolution.start_ns + offset(firing));
        self.follow_stamps(stamps, revolution.end_ns, trajectory);
    }

    /// Writes how the ego frame moved through a scan to `trajectory`. Without the times of its points the trajectory is
    /// empty.
    pub fn follow_scan(&self, scan: &Scan, trajectory: &mut EgoTrajectory) {
        let knots = ScanKnots::from_scan(scan);
        let stamps = (0..knots.count()).map(|knot| scan.stamp_ns.saturating_add(knots.offset_ns(knot)));
        self.follow_stamps(stamps, scan.stamp_ns, trajectory);
    }

    fn follow_stamps(
        &self,
        stamps: impl ExactSizeIterator<Item = i64> + Clone,
        end_ns: i64,
        trajectory: &mut EgoTrajectory,
    ) {
        trajectory.end_from_ego.clear();
        let (pose, speed_mps) = self.at(end_ns);
        (trajectory.compensation, trajectory.speed_mps) = (Compensation::None, speed_mps);
        if !self.config.enabled || stamps.len() == 0 {
            return;
        }
        if let Some(map_from_end) = pose {
            let end_from_map = map_from_end.inverse();
            for stamp_ns in stamps.clone() {
                let Some(end_from_ego) = self.propagate_by_poses(&end_from_map, stamp_ns, end_ns) else { break };
                trajectory.end_from_ego.push(end_from_ego);
            }
            if trajectory.end_from_ego.len() == stamps.len() {
                trajectory.compensation = Compensation::Poses;
                return;
            }
            trajectory.end_from_ego.clear();
        }
        if let Some(speed_mps) = self.newest_speed_mps(end_ns) {
            trajectory.speed_mps = Some(speed_mps);
            trajectory.compensation = Compensation::Speed;
            trajectory.end_from_ego.extend(stamps.map(|stamp_ns| straight_ahead(speed_mps, stamp_ns, end_ns)));
        }
    }

    /// Transform from the ego frame at `from_ns` to the ego frame at `to_ns`, and what it was computed from.
    pub fn propagate(&self, from_ns: i64, to_ns: i64) -> (Isometry3<f64>, Compensation) {
        let by_poses = || self.propagate_by_poses(&self.map_from_ego(to_ns)?.inverse(), from_ns, to_ns);
        let by_speed = || Some(straight_ahead(self.newest_speed_mps(to_ns)?, from_ns, to_ns));
        if !self.config.enabled {
            return (Isometry3::identity(), Compensation::None);
        }
        by_poses()
            .map(|to_from_ego| (to_from_ego, Compensation::Poses))
            .or_else(|| by_speed().map(|to_from_ego| (to_from_ego, Compensation::Speed)))
            .unwrap_or((Isometry3::identity(), Compensation::None))
    }

    /// `None` if no pose is near enough to `from_ns`, or if the poses jump on the way.
    fn propagate_by_poses(&self, to_from_map: &Isometry3<f64>, from_ns: i64, to_ns: i64) -> Option<Isometry3<f64>> {
        let to_from_ego = to_from_map * self.map_from_ego(from_ns)?;
        let seconds = to_ns.saturating_sub(from_ns).saturating_abs() as f64 * 1e-9;
        let is_near = to_from_ego.translation.vector.norm() <= JUMP_M_MAX + SPEED_MPS_MAX * seconds;
        is_near.then_some(to_from_ego)
    }
}

fn straight_ahead(speed_mps: f64, from_ns: i64, to_ns: i64) -> Isometry3<f64> {
    Isometry3::translation(from_ns.saturating_sub(to_ns) as f64 * 1e-9 * speed_mps, 0.0, 0.0)
}

fn share(from_ns: i64, to_ns: i64, stamp_ns: i64) -> f64 {
    stamp_ns.saturating_sub(from_ns) as f64 / to_ns.saturating_sub(from_ns) as f64
}

/// The pose at a stamp on the line through two poses; it may lie before the first or after the second.
fn interpolate(from: &EgoPose, to: &EgoPose, stamp_ns: i64) -> Isometry3<f64> {
    let share = share(from.stamp_ns, to.stamp_ns, stamp_ns);
    let (a, b) = (&from.map_from_ego, &to.map_from_ego);
    let translation = a.translation.vector.lerp(&b.translation.vector, share);
    // The shorter rotation; for exactly half a revolution one of the two.
    let rotated = a.rotation.rotation_to(&b.rotation).scaled_axis() * share;
    let rotation = UnitQuaternion::from_scaled_axis(rotated) * a.rotation;
    Isometry3::from_parts(Translation3::from(translation), rotation)
}

/// The pose at a stamp beyond `pose`, with the motion between it and `other`; straight ahead with its own speed if
/// there is no other pose near enough.
fn extrapolate(pose: &EgoPose, other: Option<&EgoPose>, stamp_ns: i64) -> Isometry3<f64> {
    match other {
        Some(other) if (1..=GAP_NS_MAX).contains(&other.stamp_ns.saturating_sub(pose.stamp_ns).saturating_abs()) => {
            interpolate(other, pose, stamp_ns)
        }
        _ => {
            let seconds = stamp_ns.saturating_sub(pose.stamp_ns) as f64 * 1e-9;
            pose.map_from_ego * Translation3::from(Vector3::x() * (seconds * pose.speed_mps))
        }
    }
}

#[cfg(test)]
mod tests;
