//! The points of one scan in the ego frame.
//!
//! In: a [`Revolution`] or [`Scan`] in the sensor frame, how the sensor is mounted, how the vehicle moved, and the self
//! filter. Out: a [`Sweep`]: the returns of the surroundings, ego frame at the last firing, metres, and what the rows
//! of radial maps depend on. Compaction, motion compensation and transform are one pass; each firing has one rigid
//! transform.

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

use crate::sensor::deviation::Deviation;
use crate::sensor::distance_series::DistanceSeries;
use crate::sensor::motion::{ScanKnots, knots};
use crate::sensor::observation::{POSITION_M_MAX, Scan};
use crate::sensor::self_filter::{FilterReason, RemovedPoints, SelfFilter};
use crate::sensor::transform::Transform;
use crate::wide::{WideLoop, run_wide};

/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 1024;

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
    /// Number of returns before the vehicle's own were removed.
    pub returns: u32,
    /// Elevations of the lasers that define the rows of radial maps; `None` if they are unknown. Then all
    /// rows have the same depth.
    pub calibration: Option<Arc<Calibration>>,
    /// Number of points at the end that no sensor has measured in this sweep: those of its memory.
    pub remembered: usize,
    /// Height of the sensor over the ground, metres.
    pub mount_height_m: f32,
    /// Position (x, y) of the sensor, ego frame, metres: the centre of radial maps.
    pub mount_m: [f32; 2],
}

impl Sweep {
    /// Replaces the points by those of a revolution of a vehicle at rest, without a self filter.
    pub fn set_revolution(&mut self, revolution: &Revolution, mount: &Mount) {
        self.set_moving_revolution(revolution, mount, &[], None);
    }

    /// Replaces the points by those of a revolution and returns the number of points that the filter removed.
    /// `end_from_ego` is [`crate::sensor::motion::EgoTrajectory::end_from_ego`] of this revolution; if it is empty, the
    /// points are not moved.
    pub fn set_moving_revolution(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        filter: Option<&SelfFilter>,
    ) -> RemovedPoints {
        match filter {
            None => self.fill(revolution, mount, end_from_ego, |_| None),
            Some(filter) => self.fill(revolution, mount, end_from_ego, check(mount, filter)),
        }
    }

    fn fill(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        check: impl Fn([f32; 3]) -> Option<FilterReason>,
    ) -> RemovedPoints {
        self.prepare(Some(&revolution.calibration), mount);
        let at_rest = Transform::new(&mount.ego_from_sensor);
        let moving = transforms(mount, end_from_ego);
        let slots: usize = revolution.echoes.iter().map(|echo| echo.range_m.len()).sum();
        self.reserve(slots);
        let mut kept = 0;
        let mut returns = 0;
        let mut removed = RemovedPoints::default();
        for echo in &revolution.echoes {
            let mut push = |slots: std::ops::Range<usize>, transform: Transform| {
                let n = slots.len();
                let range_m = &echo.range_m[slots.clone()][..n];
                let (x, y, z) = (&echo.x[slots.clone()][..n], &echo.y[slots.clone()][..n], &echo.z[slots][..n]);
                for i in 0..n {
                    let range = range_m[i];
                    let [ex, ey, ez] = transform.apply(x[i], y[i], z[i]);
                    (self.x[kept], self.y[kept], self.z[kept]) = (ex, ey, ez);
                    // A slot that has not fired is NaN, one without a return is 0: neither is kept. Every slot is
                    // written, and `kept` advances past those that are kept, so that the loop has no branch.
                    returns += u32::from(range > 0.0);
                    let is_far = range > 0.0 && range >= mount.range_m_min;
                    let reason = check([x[i], y[i], z[i]]).filter(|_| is_far);
                    removed.count(reason);
                    kept += usize::from(is_far && reason.is_none());
                }
            };
            if moving.is_empty() {
                push(0..echo.range_m.len(), at_rest);
            } else {
                for_each_firing(revolution, &moving, &mut push);
            }
        }
        self.returns = returns;
        self.truncate(kept);
        removed
    }

    /// Fills in the deviation of each point that [`Sweep::set_moving_revolution`] kept of the same revolution with the
    /// same filter. `noise_m` is the standard deviation of the sensor's range noise, metres. The deviations of a second
    /// echo are unknown: it has no series.
    pub fn set_deviations(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        series: &mut DistanceSeries,
        noise_m: f32,
        filter: Option<&SelfFilter>,
    ) {
        let first = series.deviations(revolution);
        match filter {
            None => self.fill_deviations(revolution, mount, first, noise_m, |_| None),
            Some(filter) => self.fill_deviations(revolution, mount, first, noise_m, check(mount, filter)),
        }
    }

    fn fill_deviations(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        first: &[f32],
        noise_m: f32,
        check: impl Fn([f32; 3]) -> Option<FilterReason>,
    ) {
        // Without a branch, as in `fill`.
        let slots = revolution.echoes.iter().map(|echo| echo.range_m.len()).sum::<usize>() + 1;
        self.deviation.resize(slots, Deviation::UNKNOWN);
        let (mut kept, mut found) = (0, [Deviation::UNKNOWN; CHUNK]);
        for (number, echo) in revolution.echoes.iter().enumerate() {
            let unknown = if number == 0 { 1.0 } else { f32::NAN };
            for (chunk, (ranges_m, first)) in echo.range_m.chunks(CHUNK).zip(first.chunks(CHUNK)).enumerate() {
                for (found, (&range_m, &deviation_m)) in found.iter_mut().zip(ranges_m.iter().zip(first)) {
                    let per_m = unknown / range_m;
                    *found = Deviation::new(deviation_m * per_m, noise_m * per_m);
                }
                for (slot, (&range_m, &found)) in (chunk * CHUNK..).zip(ranges_m.iter().zip(&found)) {
                    self.deviation[kept] = found;
                    let is_far = range_m > 0.0 && range_m >= mount.range_m_min;
                    let at = || [echo.x[slot], echo.y[slot], echo.z[slot]];
                    kept += usize::from(is_far && check(at()).is_none());
                }
            }
        }
        self.deviation.truncate(kept);
    }

    /// Fills in the deviation of each point that [`Sweep::set_moving_scan`] kept of the same scan with the same filter.
    /// `deviations_m` has one entry for each point of the scan, metres ([`crate::sensor::ring_series`]).
    pub fn set_scan_deviations(
        &mut self,
        scan: &Scan,
        mount: &Mount,
        deviations_m: &[f32],
        noise_m: f32,
        filter: Option<&SelfFilter>,
    ) {
        let check = filter.map(|filter| check(mount, filter));
        // Without a branch, as in `fill`.
        self.deviation.resize(scan.x.len() + 1, Deviation::UNKNOWN);
        let (mut kept, mut found, mut keeps) = (0, [Deviation::UNKNOWN; CHUNK], [false; CHUNK]);
        let points = scan.x.chunks(CHUNK).zip(scan.y.chunks(CHUNK)).zip(scan.z.chunks(CHUNK));
        for (((xs, ys), zs), deviations_m) in points.zip(deviations_m.chunks(CHUNK)) {
            let n = xs.len();
            let (ys, zs, deviations_m) = (&ys[..n], &zs[..n], &deviations_m[..n]);
            for i in 0..n {
                let range_m = squared_range(xs[i], ys[i], zs[i]).sqrt();
                found[i] = Deviation::new(deviations_m[i] / range_m, noise_m / range_m);
                keeps[i] = Self::keeps(mount, [xs[i], ys[i], zs[i]]);
            }
            for i in 0..n {
                self.deviation[kept] = found[i];
                let is_removed = check.as_ref().is_some_and(|check| check([xs[i], ys[i], zs[i]]).is_some());
                kept += usize::from(keeps[i] & !is_removed);
            }
        }
        self.deviation.truncate(kept);
    }

    /// Replaces the points by those of a scan of a vehicle at rest, without a self filter. Returns the number of points
    /// that were removed because a coordinate is not finite or beyond 1 km. The four arrays of the scan must have the
    /// same length.
    pub fn set_scan(&mut self, scan: &Scan, calibration: &Arc<Calibration>, mount: &Mount) -> u64 {
        self.set_moving_scan(scan, Some(calibration), mount, &[], None).no_position
    }

    /// Replaces the points by those of a scan and returns the number of points that were removed. `calibration` is
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
        let at_rest = Transform::new(&mount.ego_from_sensor);
        let moving = transforms(mount, end_from_ego);
        let knots = ScanKnots::from_scan(scan);
        let check = filter.map(|filter| check(mount, filter));
        self.reserve(scan.x.len());
        let mut kept = 0;
        let mut returns = 0;
        let mut removed = RemovedPoints::default();
        let (mut moved, mut are_far) = ([[0.0; CHUNK]; 3], [false; CHUNK]);
        let chunks = scan.x.chunks(CHUNK).zip(scan.y.chunks(CHUNK)).zip(scan.z.chunks(CHUNK));
        for (chunk, ((xs, ys), zs)) in chunks.enumerate() {
            let n = xs.len();
            let (ys, zs) = (&ys[..n], &zs[..n]);
            let [ex, ey, ez] = &mut moved;
            let (ex, ey, ez, are_far) = (&mut ex[..n], &mut ey[..n], &mut ez[..n], &mut are_far[..n]);
            let (points, moved) = ([xs, ys, zs], [&mut *ex, &mut *ey, &mut *ez]);
            let mut positions = 0;
            let counts = [&mut positions, &mut returns];
            run_wide(MoveAtRest { points, mount, transform: at_rest, moved, are_far: &mut *are_far, counts });
            removed.no_position += n as u64 - u64::from(positions);
            for i in (0..n).filter(|_| !moving.is_empty()) {
                let (knot, share) = knots.position(scan.offset_ns[chunk * CHUNK + i]);
                [ex[i], ey[i], ez[i]] = moving[knot].towards(&moving[knot + 1], share).apply(xs[i], ys[i], zs[i]);
            }
            if let Some(check) = &check {
                for (i, is_far) in are_far.iter_mut().enumerate().filter(|(_, is_far)| **is_far) {
                    let reason = check([xs[i], ys[i], zs[i]]);
                    removed.count(reason);
                    *is_far = reason.is_none();
                }
            }
            for i in 0..n {
                (self.x[kept], self.y[kept], self.z[kept]) = (ex[i], ey[i], ez[i]);
                kept += usize::from(are_far[i]);
            }
        }
        self.returns = returns;
        self.truncate(kept);
        removed
    }

    /// Replaces all values by those of another sweep; the memory is reused.
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
    /// maps, those of the other sweep are used.
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
        classify(x, y, z).1 & is_far(mount, x, y, z)
    }

    fn prepare(&mut self, calibration: Option<&Arc<Calibration>>, mount: &Mount) {
        self.calibration = calibration.map(Arc::clone);
        let at = mount.ego_from_sensor.translation;
        (self.mount_height_m, self.mount_m) = (at.z as f32, [at.x as f32, at.y as f32]);
        self.deviation.clear();
    }

    /// Makes the arrays long enough for `slots` points, and for one more that is written and not kept.
    fn reserve(&mut self, slots: usize) {
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.resize(slots + 1, 0.0);
        }
    }

    /// Shortens the arrays to the points that were kept.
    fn truncate(&mut self, kept: usize) {
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.truncate(kept);
        }
    }
}

/// Moves points by one transform, finds which of them a sweep keeps, and counts the positions and the returns.
struct MoveAtRest<'a> {
    points: [&'a [f32]; 3],
    mount: &'a Mount,
    transform: Transform,
    moved: [&'a mut [f32]; 3],
    are_far: &'a mut [bool],
    counts: [&'a mut u32; 2],
}

impl WideLoop for MoveAtRest<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { points: [xs, ys, zs], mount, transform, moved: [ex, ey, ez], are_far, counts } = self;
        let n = are_far.len();
        let (xs, ys, zs, ex, ey, ez) = (&xs[..n], &ys[..n], &zs[..n], &mut ex[..n], &mut ey[..n], &mut ez[..n]);
        let [mut positions, mut returns] = [0; 2];
        // Without a branch, so that the compiler vectorises it.
        for i in 0..n {
            let (is_position, is_return) = classify(xs[i], ys[i], zs[i]);
            are_far[i] = is_return & is_far(mount, xs[i], ys[i], zs[i]);
            (positions, returns) = (positions + u32::from(is_position), returns + u32::from(is_return));
            [ex[i], ey[i], ez[i]] = transform.apply(xs[i], ys[i], zs[i]);
        }
        let [all_positions, all_returns] = counts;
        (*all_positions, *all_returns) = (*all_positions + positions, *all_returns + returns);
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

/// Whether a point of a scan is a position, and whether it is a return: a position other than the sensor's own.
#[inline(always)]
pub(crate) fn classify(x: f32, y: f32, z: f32) -> (bool, bool) {
    // NaN fails every comparison.
    let is_position = (x.abs() <= POSITION_M_MAX) & (y.abs() <= POSITION_M_MAX) & (z.abs() <= POSITION_M_MAX);
    (is_position, is_position & (squared_range(x, y, z) > 0.0))
}

/// True if a position, sensor frame, metres, is at least `range_m_min` away from the sensor.
#[inline(always)]
fn is_far(mount: &Mount, x: f32, y: f32, z: f32) -> bool {
    squared_range(x, y, z) >= mount.range_m_min * mount.range_m_min
}

#[inline(always)]
fn squared_range(x: f32, y: f32, z: f32) -> f32 {
    x * x + y * y + z * z
}

/// Calls `push` for each firing with its slots and its transform, which is interpolated between the knots.
#[inline(always)]
fn for_each_firing(
    revolution: &Revolution,
    moving: &[Transform],
    push: &mut impl FnMut(std::ops::Range<usize>, Transform),
) {
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
