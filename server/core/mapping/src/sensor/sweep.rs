//! The points of one turn in the ego frame.
//!
//! In: a [`Revolution`] or [`Scan`] in the sensor's frame, how the sensor is mounted, how the vehicle moved, and where
//! the vehicle itself is. Out: a [`Sweep`], only returns of the surroundings, ego frame at the turn's last firing,
//! metres, with what the grid's rows follow from. Compaction, motion and transform are one pass; each firing has one
//! rigid transform.

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

use crate::sensor::self_filter::{Hidden, Screen};
use crate::event::Scan;
use crate::ledger::Dropped;
use crate::sensor::motion::{ScanKnots, knots};
use crate::sensor::distance_series::Series;

/// No sensor of the family reaches half as far; a coordinate beyond is not a position.
const POSITION_M_MAX: f32 = 1000.0;

/// How a sensor sits on its vehicle.
#[derive(Clone, Debug, PartialEq)]
pub struct Mount {
    /// Carries points of the sensor's frame into the ego frame.
    pub ego_from_sensor: Isometry3<f64>,
    /// Returns nearer to the sensor are the vehicle itself and are dropped.
    pub range_m_min: f32,
}

/// Points of one turn, ego frame, metres; both echoes of a dual return. Same index, same point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// Forward.
    pub x: Vec<f32>,
    /// Left.
    pub y: Vec<f32>,
    /// Up, over the ground under the vehicle.
    pub z: Vec<f32>,
    /// How far each range lies from the mean of its laser's neighbouring ones, metres (NaN: not known); empty unless
    /// [`Sweep::take_deviations`] filled it.
    pub deviation_m: Vec<f32>,
    /// Returns of the turn before those of the vehicle itself were dropped.
    pub returns: u32,
    /// Elevations of the lasers the rows of radial maps come from; `None` where nobody knows them: those maps are
    /// unknown.
    pub calibration: Option<Arc<Calibration>>,
    /// Height of the sensor over the ground.
    pub mount_height_m: f32,
}

impl Sweep {
    /// Fills the sweep from a revolution of a vehicle at rest, in place of what it held.
    pub fn take_revolution(&mut self, revolution: &Revolution, mount: &Mount) {
        self.take_revolution_around(revolution, mount, &[], None);
    }

    /// Fills the sweep from a revolution, in place of what it held; `end_from_ego` is
    /// [`crate::sensor::motion::Moved::end_from_ego`] of this revolution, or empty to leave the points where they were seen.
    /// Returns that the vehicle's own body or a blind sector hides are left out; gives how many those are.
    pub fn take_revolution_around(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        screen: Option<&Screen>,
    ) -> Dropped {
        match screen {
            None => self.fill(revolution, mount, end_from_ego, |_| None),
            Some(screen) => self.fill(revolution, mount, end_from_ego, hides(mount, screen)),
        }
    }

    fn fill(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        hides: impl Fn([f32; 3]) -> Option<Hidden>,
    ) -> Dropped {
        self.prepare(Some(&revolution.calibration), mount);
        let at_rest = Transform::new(&mount.ego_from_sensor);
        let moving = transforms(mount, end_from_ego);
        let slots: usize = revolution.echoes.iter().map(|echo| echo.range_m.len()).sum();
        self.open(slots);
        let mut kept = 0;
        let mut returns = 0;
        let mut dropped = Dropped::default();
        for echo in &revolution.echoes {
            let mut take = |slots: std::ops::Range<usize>, transform: Transform| {
                let n = slots.len();
                let range_m = &echo.range_m[slots.clone()][..n];
                let (x, y, z) = (&echo.x[slots.clone()][..n], &echo.y[slots.clone()][..n], &echo.z[slots][..n]);
                for i in 0..n {
                    let range = range_m[i];
                    let [ex, ey, ez] = transform.apply(x[i], y[i], z[i]);
                    (self.x[kept], self.y[kept], self.z[kept]) = (ex, ey, ez);
                    // Not fired is NaN and no return is 0: neither passes. Written always, kept by moving on: no
                    // branch.
                    returns += u32::from(range > 0.0);
                    let far = range > 0.0 && range >= mount.range_m_min;
                    let hidden = hides([x[i], y[i], z[i]]).filter(|_| far);
                    dropped.count(hidden);
                    kept += usize::from(far && hidden.is_none());
                }
            };
            if moving.is_empty() {
                take(0..echo.range_m.len(), at_rest);
            } else {
                for_each_firing(revolution, &moving, &mut take);
            }
        }
        self.returns = returns;
        self.close(kept);
        dropped
    }

    /// Adds one deviation a point, in step with the points that [`Sweep::take_revolution_around`] took from the same
    /// revolution with the same screen; a second echo has no series.
    pub fn take_deviations(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        series: &mut Series,
        screen: Option<&Screen>,
    ) {
        let first = series.take(revolution);
        match screen {
            None => self.fill_deviations(revolution, mount, first, |_| None),
            Some(screen) => self.fill_deviations(revolution, mount, first, hides(mount, screen)),
        }
    }

    fn fill_deviations(
        &mut self,
        revolution: &Revolution,
        mount: &Mount,
        first: &[f32],
        hides: impl Fn([f32; 3]) -> Option<Hidden>,
    ) {
        // As the points: written always, kept by moving on.
        self.deviation_m.resize(revolution.echoes.iter().map(|echo| echo.range_m.len()).sum::<usize>() + 1, f32::NAN);
        let mut kept = 0;
        for (number, echo) in revolution.echoes.iter().enumerate() {
            let slots = echo.range_m.iter().zip(first).zip(&echo.x).zip(&echo.y).zip(&echo.z);
            for ((((&range, &deviation), &x), &y), &z) in slots {
                self.deviation_m[kept] = if number == 0 { deviation } else { f32::NAN };
                let far = range > 0.0 && range >= mount.range_m_min;
                kept += usize::from(far && hides([x, y, z]).is_none());
            }
        }
        self.deviation_m.truncate(kept);
    }

    /// Fills the sweep from a scan, in place of what it held; gives the number of points left out because a coordinate
    /// is not finite or lies beyond 1 km. The four arrays must be equally long.
    pub fn take_scan(&mut self, scan: &Scan, calibration: &Arc<Calibration>, mount: &Mount) -> u64 {
        self.take_scan_around(scan, Some(calibration), mount, &[], None).no_position
    }

    /// The same of a sensor whose elevations may not be known, each point moved from when it was seen (`end_from_ego`
    /// is [`crate::sensor::motion::Moved::end_from_ego`] of this scan, or empty), without what the vehicle's own body or a
    /// blind sector hides.
    pub fn take_scan_around(
        &mut self,
        scan: &Scan,
        calibration: Option<&Arc<Calibration>>,
        mount: &Mount,
        end_from_ego: &[Isometry3<f64>],
        screen: Option<&Screen>,
    ) -> Dropped {
        self.prepare(calibration, mount);
        let at_rest = Transform::new(&mount.ego_from_sensor);
        let moving = transforms(mount, end_from_ego);
        let knots = ScanKnots::of(scan);
        let hides = screen.map(|screen| hides(mount, screen));
        self.open(scan.x.len());
        let mut kept = 0;
        let mut returns = 0;
        let mut dropped = Dropped::default();
        for (index, ((&x, &y), &z)) in scan.x.iter().zip(&scan.y).zip(&scan.z).enumerate() {
            let transform = if moving.is_empty() {
                at_rest
            } else {
                let (knot, share) = knots.place(scan.offset_ns[index]);
                moving[knot].towards(&moving[knot + 1], share)
            };
            let [ex, ey, ez] = transform.apply(x, y, z);
            (self.x[kept], self.y[kept], self.z[kept]) = (ex, ey, ez);
            let (position, seen) = is_return(x, y, z);
            let far = seen && squared_range(x, y, z) >= mount.range_m_min * mount.range_m_min;
            let hidden = hides.as_ref().and_then(|hides| hides([x, y, z])).filter(|_| far);
            dropped.no_position += u64::from(!position);
            dropped.count(hidden);
            returns += u32::from(seen);
            kept += usize::from(far && hidden.is_none());
        }
        self.returns = returns;
        self.close(kept);
        dropped
    }

    /// Becomes a copy of another sweep, keeping its memory.
    pub(crate) fn copy(&mut self, other: &Sweep) {
        for (axis, of) in [(&mut self.x, &other.x), (&mut self.y, &other.y), (&mut self.z, &other.z)] {
            axis.clone_from(of);
        }
        self.deviation_m.clone_from(&other.deviation_m);
        self.calibration.clone_from(&other.calibration);
        (self.returns, self.mount_height_m) = (other.returns, other.mount_height_m);
    }

    /// Adds another sensor's points, carried by `carried`; their distance series are not known here. The rows of radial
    /// maps become the other's where this sweep has none.
    pub(crate) fn append(&mut self, other: &Sweep, carried: &Isometry3<f64>) {
        let transform = Transform::new(carried);
        for ((&x, &y), &z) in other.x.iter().zip(&other.y).zip(&other.z) {
            let [x, y, z] = transform.apply(x, y, z);
            self.x.push(x);
            self.y.push(y);
            self.z.push(z);
        }
        self.returns += other.returns;
        if !self.deviation_m.is_empty() {
            self.deviation_m.resize(self.x.len(), f32::NAN);
        }
        if self.calibration.is_none() && other.calibration.is_some() {
            self.take_rows(other);
        }
    }

    /// Takes over whose rows radial maps have.
    pub(crate) fn take_rows(&mut self, other: &Sweep) {
        self.calibration.clone_from(&other.calibration);
        self.mount_height_m = other.mount_height_m;
    }

    /// Whether [`Sweep::take_scan`] keeps this point (sensor frame, metres) of a sensor so mounted.
    pub fn keeps(mount: &Mount, [x, y, z]: [f32; 3]) -> bool {
        is_return(x, y, z).1 && squared_range(x, y, z) >= mount.range_m_min * mount.range_m_min
    }

    fn prepare(&mut self, calibration: Option<&Arc<Calibration>>, mount: &Mount) {
        self.calibration = calibration.map(Arc::clone);
        self.mount_height_m = mount.ego_from_sensor.translation.z as f32;
        self.deviation_m.clear();
    }

    /// Room for `slots` points and one more to write what is not kept.
    fn open(&mut self, slots: usize) {
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.resize(slots + 1, 0.0);
        }
    }

    fn close(&mut self, kept: usize) {
        for axis in [&mut self.x, &mut self.y, &mut self.z] {
            axis.truncate(kept);
        }
    }
}

/// What hides a point of the sensor's frame, at the moment it was seen.
fn hides(mount: &Mount, screen: &Screen) -> impl Fn([f32; 3]) -> Option<Hidden> {
    let at_rest = Transform::new(&mount.ego_from_sensor);
    move |[x, y, z]| screen.hides([x, y, z], || at_rest.apply(x, y, z))
}

/// `end_from_sensor` at each knot.
fn transforms(mount: &Mount, end_from_ego: &[Isometry3<f64>]) -> Vec<Transform> {
    end_from_ego.iter().map(|moved| Transform::new(&(moved * mount.ego_from_sensor))).collect()
}

/// Whether a scan's point is a position at all, and whether it is one with a return.
#[inline(always)]
pub(crate) fn is_return(x: f32, y: f32, z: f32) -> (bool, bool) {
    // NaN fails every comparison.
    let position = x.abs() <= POSITION_M_MAX && y.abs() <= POSITION_M_MAX && z.abs() <= POSITION_M_MAX;
    (position, position && squared_range(x, y, z) > 0.0)
}

#[inline(always)]
fn squared_range(x: f32, y: f32, z: f32) -> f32 {
    x * x + y * y + z * z
}

/// Calls `take` for each firing with its slots and its transform, interpolated between the knots.
#[inline(always)]
fn for_each_firing(
    revolution: &Revolution,
    moving: &[Transform],
    take: &mut impl FnMut(std::ops::Range<usize>, Transform),
) {
    let (firings, lasers) = (&revolution.firings, revolution.lasers);
    let mut knot = knots(firings.len()).zip(moving);
    let Some(mut from) = knot.next() else { return };
    take(0..lasers, *from.1);
    for to in knot {
        let (start, end) = (firings[from.0].offset_ns, firings[to.0].offset_ns);
        let per_ns = 1.0 / end.saturating_sub(start).max(1) as f32;
        for (firing, slots) in (from.0 + 1..=to.0).map(|firing| (firing, firing * lasers..(firing + 1) * lasers)) {
            let share = firings[firing].offset_ns.saturating_sub(start) as f32 * per_ns;
            take(slots, from.1.towards(to.1, share));
        }
        from = to;
    }
}

/// `ego_from_sensor` in single precision: 8 µm at 120 m, where the sensor's own step is 2 mm.
#[derive(Clone, Copy)]
struct Transform {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
}

impl Transform {
    fn new(ego_from_sensor: &Isometry3<f64>) -> Self {
        let rotation = ego_from_sensor.rotation.to_rotation_matrix();
        let translation = ego_from_sensor.translation;
        let row = |i: usize| [0, 1, 2].map(|j| rotation[(i, j)] as f32);
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [translation.x as f32, translation.y as f32, translation.z as f32],
        }
    }

    /// Between two transforms that differ by the motion of a millisecond, where a line serves for the arc.
    #[inline(always)]
    fn towards(&self, to: &Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + share * (b - a);
        let row = |i: usize| [0, 1, 2].map(|j| mix(self.rotation[i][j], to.rotation[i][j]));
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [0, 1, 2].map(|i| mix(self.translation[i], to.translation[i])),
        }
    }

    #[inline(always)]
    fn apply(&self, x: f32, y: f32, z: f32) -> [f32; 3] {
        let axis = |i: usize| {
            let [a, b, c] = self.rotation[i];
            a * x + b * y + c * z + self.translation[i]
        };
        [axis(0), axis(1), axis(2)]
    }
}
