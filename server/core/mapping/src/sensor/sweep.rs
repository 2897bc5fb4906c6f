//! The points of one scan in the ego frame.
//!
//! In: a [`Revolution`] or [`Scan`] in the sensor frame, how the sensor is mounted, how the vehicle moved, and the self
//! filter. Out: a [`Sweep`]: the returns of the surroundings, ego frame at the last firing, metres, and what the rows
//! of radial maps depend on. Compaction, motion compensation and transform are one pass; each firing has one rigid
//! transform.

use std::ops::Range;
use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

use crate::sensor::deviation::{Deviation, PointDeviations, ReturnDeviations, kept};
use crate::sensor::distance_series::DistanceSeries;
use crate::sensor::motion::{ScanKnots, knots};
use crate::sensor::observation::Scan;
use crate::sensor::self_filter::{FilterReason, RemovedPoints, SelfFilter};
use crate::sensor::transform::{CHUNK, MoveAtRest, MoveReturns, MovedPoints, Transform, classify, is_far};
use crate::wide::run_wide;

/// How a sensor is mounted on its vehicle.
#[derive(Clone, Debug, PartialEq)]
pub struct Mount {
    /// Transform from the sensor frame to the ego frame.
    pub ego_from_sensor: Isometry3<f64>,
    /// Least range of a return, metres. Nearer returns are the vehicle itself and are removed.
    pub range_m_min: f32,
}

impl Mount {
    /// Position of the sensor, ego frame, metres.
    pub fn origin_m(&self) -> [f32; 3] {
        let origin = self.ego_from_sensor.translation;
        [origin.x, origin.y, origin.z].map(|metres| metres as f32)
    }
}

/// Points of one scan or of one map, ego frame; both echoes of a dual return. The arrays have one entry a point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// Distance forward of the ego origin, metres.
    pub x: Vec<f32>,
    /// Distance to the left of the ego origin, metres.
    pub y: Vec<f32>,
    /// Height over the ground under the vehicle, metres.
    pub z: Vec<f32>,
    /// Deviation of each range from its neighbours. Empty until [`Sweep::set_deviations`] or
    /// [`Sweep::set_scan_deviations`] fills it.
    pub deviation: Vec<Deviation>,
    /// Whether the sweep has each slot of its revolution, echo after echo, or each point of its scan. Unspecified in a
    /// sweep of several scans.
    pub are_kept: Vec<bool>,
    /// Number of returns before the vehicle's own were removed.
    pub returns: u32,
    /// Elevations of the lasers that define the rows of radial maps; `None` if they are unknown. Then all
    /// rows have the same depth.
    pub calibration: Option<Arc<Calibration>>,
    /// Number of points at the end that no sensor has measured in this sweep: its remembered points.
    pub remembered: usize,
    /// Height of the sensor over the ground, metres.
    pub mount_height_m: f32,
    /// Position (x, y) of the sensor, ego frame, metres: the centre of radial maps.
    pub mount_m: [f32; 2],
}

impl Sweep {
    /// Replaces the points by the points of a revolution of a vehicle at rest, without a self filter.
    pub fn set_revolution(&mut self, revolution: &Revolution, mount: &Mount) {
        self.set_moving_revolution(revolution, mount, &[], None);
    }

    /// Replaces the points by the points of a revolution and returns the number of points that the filter removed.
    /// `end_from_ego` is [`crate::sensor::motion::EgoTrajectory::end_from_ego`] of this revolution; if it is empty, the
    /// points are not moved.
    pub fn set_moving_revolution(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        filter: Option<&SelfFilter>,
    ) -> RemovedPoints {
        self.prepare(Some(&revolution.calibration), mount);
        let at_rest = Transform::new(&mount.ego_from_sensor);
        let moving = transforms(mount, end_from_ego);
        let check = filter.map(|filter| check(mount, filter));
        let range_m_min = mount.range_m_min;
        let mut moved = MovedPoints::default();
        let mut removed = RemovedPoints::default();
        for echo in &revolution.echoes {
            let mut push = |slots: Range<usize>, transform: Transform| {
                let [range_m, x, y, z] = [&echo.range_m, &echo.x, &echo.y, &echo.z].map(|all| &all[slots.clone()]);
                let points = [x, y, z];
                let returns = &mut self.returns;
                run_wide(MoveReturns { range_m, points, range_m_min, transform, moved: &mut moved, returns });
                self.push_kept(&mut moved, points, check.as_ref(), &mut removed);
            };
            if moving.is_empty() {
                let slots = echo.range_m.len();
                (0..slots).step_by(CHUNK).for_each(|start| push(start..slots.min(start + CHUNK), at_rest));
            } else {
                for_each_firing(revolution, &moving, &mut push);
            }
        }
        removed
    }

    /// Fills in the deviation of each point that [`Sweep::set_moving_revolution`] kept of the same revolution.
    /// `noise_m` is the standard deviation of the sensor's range noise, metres. The deviations of a second echo are
    /// unknown: it has no series.
    pub fn set_deviations(&mut self, revolution: &Revolution, series: &mut DistanceSeries, noise_m: f32) {
        let first = series.deviations(revolution);
        let Self { deviation, are_kept, .. } = self;
        let (mut are_kept, mut found) = (&are_kept[..], [Deviation::UNKNOWN; CHUNK]);
        deviation.clear();
        for (number, echo) in revolution.echoes.iter().enumerate() {
            let scale = if number == 0 { 1.0 } else { f32::NAN };
            for (range_m, deviation_m) in echo.range_m.chunks(CHUNK).zip(first.chunks(CHUNK)) {
                run_wide(ReturnDeviations { range_m, deviation_m, scale, noise_m, found: &mut found });
                let (of_chunk, rest) = are_kept.split_at(range_m.len());
                deviation.extend_from_slice(kept(&mut found, of_chunk));
                are_kept = rest;
            }
        }
    }

    /// Fills in the deviation of each point that [`Sweep::set_moving_scan`] kept of the same scan. `deviations_m` has
    /// one entry for each point of the scan, metres ([`crate::sensor::ring_series`]).
    pub fn set_scan_deviations(&mut self, scan: &Scan, deviations_m: &[f32], noise_m: f32) {
        let Self { deviation, are_kept, .. } = self;
        let mut found = [Deviation::UNKNOWN; CHUNK];
        deviation.clear();
        let points = scan.x.chunks(CHUNK).zip(scan.y.chunks(CHUNK)).zip(scan.z.chunks(CHUNK));
        let of_points = deviations_m.chunks(CHUNK).zip(are_kept.chunks(CHUNK));
        for (((x, y), z), (deviation_m, are_kept)) in points.zip(of_points) {
            run_wide(PointDeviations { points: [x, y, z], deviation_m, noise_m, found: &mut found });
            deviation.extend_from_slice(kept(&mut found, are_kept));
        }
    }

    /// Replaces the points by the points of a scan of a vehicle at rest, without a self filter. Returns the number of
    /// points that were removed because a coordinate is not finite or beyond 1 km. The four arrays of the scan must
    /// have the same length.
    pub fn set_scan(&mut self, scan: &Scan, calibration: &Arc<Calibration>, mount: &Mount) -> u64 {
        self.set_moving_scan(scan, Some(calibration), mount, &[], None).no_position
    }

    /// Replaces the points by the points of a scan and returns the number of points that were removed. `calibration` is
    /// `None` if the elevations are unknown; `end_from_ego` is [`crate::sensor::motion::EgoTrajectory::end_from_ego`]
    /// of this scan; if it is empty, the points are not moved.
    pub fn set_moving_scan(
        &mut self,
        scan: &Scan,
        calibration: Option<&Arc<Calibration>>,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        filter: Option<&SelfFilter>,
    ) -> RemovedPoints {
        self.prepare(calibration, mount);
        let (transform, range_m_min) = (Transform::new(&mount.ego_from_sensor), mount.range_m_min);
        let moving = transforms(mount, end_from_ego);
        let knots = ScanKnots::from_scan(scan);
        let check = filter.map(|filter| check(mount, filter));
        let mut moved = MovedPoints::default();
        let mut removed = RemovedPoints::default();
        let chunks = scan.x.chunks(CHUNK).zip(scan.y.chunks(CHUNK)).zip(scan.z.chunks(CHUNK));
        for (chunk, ((x, y), z)) in chunks.enumerate() {
            let points = [x, y, z];
            let mut positions = 0;
            let counts = [&mut positions, &mut self.returns];
            run_wide(MoveAtRest { points, range_m_min, transform, moved: &mut moved, counts });
            removed.no_position += x.len() as u64 - u64::from(positions);
            for i in (0..x.len()).filter(|_| !moving.is_empty()) {
                let (knot, share) = knots.position(scan.offset_ns[chunk * CHUNK + i]);
                let between = moving[knot].towards(&moving[knot + 1], share);
                [moved.x[i], moved.y[i], moved.z[i]] = between.apply(x[i], y[i], z[i]);
            }
            self.push_kept(&mut moved, points, check.as_ref(), &mut removed);
        }
        removed
    }

    /// Replaces all values by the values of another sweep; the memory is reused.
    pub(crate) fn copy_from(&mut self, other: &Sweep) {
        for (axis, from) in [(&mut self.x, &other.x), (&mut self.y, &other.y), (&mut self.z, &other.z)] {
            axis.clone_from(from);
        }
        self.deviation.clone_from(&other.deviation);
        self.calibration.clone_from(&other.calibration);
        (self.returns, self.remembered) = (other.returns, other.remembered);
        self.copy_mount(other);
    }

    /// Adds another sensor's points after transforming them, with their deviations. If this sweep has no rows of radial
    /// maps, the rows of the other sweep are used.
    pub(crate) fn append(&mut self, other: &Sweep, self_from_other: &Isometry3<f64>) {
        let transform = Transform::new(self_from_other);
        // A sensor without deviations has an empty list.
        if !self.deviation.is_empty() || !other.deviation.is_empty() {
            self.deviation.resize(self.x.len(), Deviation::UNKNOWN);
            self.deviation.extend_from_slice(&other.deviation);
            self.deviation.resize(self.x.len() + other.x.len(), Deviation::UNKNOWN);
        }
        for ((&x, &y), &z) in other.x.iter().zip(&other.y).zip(&other.z) {
            let [x, y, z] = transform.apply(x, y, z);
            self.x.push(x);
            self.y.push(y);
            self.z.push(z);
        }
        self.returns += other.returns;
        if self.calibration.is_none() && other.calibration.is_some() {
            self.copy_rows(other);
        }
    }

    /// Adds a point that no sensor has measured in this sweep; its deviation is unknown.
    pub(crate) fn push_remembered(&mut self, [x, y, z]: [f32; 3]) {
        if !self.deviation.is_empty() {
            self.deviation.push(Deviation::UNKNOWN);
        }
        self.x.push(x);
        self.y.push(y);
        self.z.push(z);
        self.remembered += 1;
    }

    /// Copies what defines the rows of radial maps: the elevations and the position of the sensor.
    pub(crate) fn copy_rows(&mut self, other: &Sweep) {
        self.calibration.clone_from(&other.calibration);
        self.copy_mount(other);
    }

    fn copy_mount(&mut self, other: &Sweep) {
        (self.mount_height_m, self.mount_m) = (other.mount_height_m, other.mount_m);
    }

    /// True if [`Sweep::set_scan`] keeps a point at this position, sensor frame, metres.
    pub fn keeps(mount: &Mount, [x, y, z]: [f32; 3]) -> bool {
        classify(x, y, z).1 & is_far(mount.range_m_min, [x, y, z])
    }

    fn prepare(&mut self, calibration: Option<&Arc<Calibration>>, mount: &Mount) {
        self.calibration = calibration.map(Arc::clone);
        let at = mount.ego_from_sensor.translation;
        (self.mount_height_m, self.mount_m) = (at.z as f32, [at.x as f32, at.y as f32]);
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.clear();
        }
        self.deviation.clear();
        self.are_kept.clear();
        self.returns = 0;
    }

    /// Adds the points, sensor frame, that the filter does not refuse, as they were moved.
    #[inline(always)]
    fn push_kept(
        &mut self,
        moved: &mut MovedPoints,
        [x, y, z]: [&[f32]; 3],
        check: Option<&impl Fn([f32; 3]) -> Option<FilterReason>>,
        removed: &mut RemovedPoints,
    ) {
        if let Some(check) = check {
            for (i, is_kept) in moved.are_kept[..x.len()].iter_mut().enumerate().filter(|(_, is_kept)| **is_kept) {
                let reason = check([x[i], y[i], z[i]]);
                removed.count(reason);
                *is_kept = reason.is_none();
            }
        }
        self.are_kept.extend_from_slice(&moved.are_kept[..x.len()]);
        let kept = moved.close_up(x.len());
        self.x.extend_from_slice(&moved.x[..kept]);
        self.y.extend_from_slice(&moved.y[..kept]);
        self.z.extend_from_slice(&moved.z[..kept]);
    }
}

/// A function that applies the filter to a point of the sensor frame at the time of its firing.
fn check(mount: &Mount, filter: &SelfFilter) -> impl Fn([f32; 3]) -> Option<FilterReason> {
    let at_rest = Transform::new(&mount.ego_from_sensor);
    move |[x, y, z]| filter.check([x, y, z], || at_rest.apply(x, y, z))
}

/// `end_from_sensor` at each knot.
fn transforms(mount: &Mount, end_from_ego: &[Isometry3<f64>]) -> Vec<Transform> {
    end_from_ego.iter().map(|moved| Transform::new(&(moved * mount.ego_from_sensor))).collect()
}

/// Calls `push` for each firing with its slots and its transform, which is interpolated between the knots.
#[inline(always)]
fn for_each_firing(revolution: &Revolution, moving: &[Transform], push: &mut impl FnMut(Range<usize>, Transform)) {
    let (firings, lasers) = (&revolution.firings, revolution.lasers);
    let mut knot = knots(firings.len()).zip(moving);
    let Some(mut from) = knot.next() else { return };
    push(0..lasers, *from.1);
    for to in knot {
        let (start, end) = (firings[from.0].offset_ns, firings[to.0].offset_ns);
        let per_ns = 1.0 / end.saturating_sub(start).max(1) as f32;
        for (firing, slots) in (from.0 + 1..=to.0).map(|firing| (firing, firing * lasers..(firing + 1) * lasers)) {
            let share = firings[firing].offset_ns.saturating_sub(start) as f32 * per_ns;
            push(slots, from.1.towards(to.1, share));
        }
        from = to;
    }
}
