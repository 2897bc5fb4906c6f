//! What the memory holds of one cell of the world: ground, an obstacle, and when they were seen.

use nalgebra::{Isometry3, Point3};

use crate::azimuth_columns::AzimuthColumns;

use super::config::{GROUND_S_MAX, OBSTACLE_S_MAX, RANGE_M_MAX};

/// Side of a cell, metres. Ours: the cells of the reach stage.
pub const CELL_M: f64 = 0.25;
pub const NS_PER_S: f64 = 1e9;
/// Number of directions in which the map may have no return.
pub const DIRECTIONS: usize = AzimuthColumns::TWO_DEGREES as usize;
/// Nothing is remembered beyond this many times the range of the farthest return of the newest map in that direction.
/// Ours: the rings of 16 lasers on flat ground are at 7, 8, 11, 15, 21 and 38 m.
const VIEW: f32 = 2.0;
/// Least height over the ground, as a share of its range, and least range, metres, of an obstacle that is forgotten if
/// the newest map has no point in it, but one behind it. Ours: the lasers of a VLP-16 are 2 degrees apart, so that one
/// meets it if it still stands there.
const TALL_MIN: f32 = 0.035;
pub const TALL_RANGE_M_MIN: f32 = 5.0;
/// Least distance of the point behind it, metres. Ours: a car is longer.
const BEHIND_M: f32 = 1.0;

/// What one cell of the world holds.
#[derive(Clone, Copy, Debug, Default)]
pub struct MemoryCell {
    /// World index (x, y) of the cell that is stored here.
    pub world: [i64; 2],
    /// Height of the lowest ground of the newest map that saw it, world frame, metres.
    pub ground_m: f64,
    /// Stamp of that map, ns; 0 without ground.
    pub ground_ns: i64,
    /// Height of the highest obstacle of the newest map that saw one, world frame, metres.
    pub obstacle_m: f64,
    /// Stamp of that map, ns; 0 without an obstacle.
    pub obstacle_ns: i64,
    /// Height of that obstacle over the ground, metres.
    pub tall_m: f32,
}

impl MemoryCell {
    /// Remembers ground at this height of the world, metres; the lowest of a map.
    pub fn add_ground(&mut self, ground_m: f64, stamp_ns: i64) {
        if self.ground_ns != stamp_ns || ground_m < self.ground_m {
            (self.ground_m, self.ground_ns) = (ground_m, stamp_ns);
        }
    }

    /// Removes what is too old, and ground that is older than an obstacle. Returns true if something is left.
    pub fn expire(&mut self, stamp_ns: i64) -> bool {
        let is_old = |since_ns: i64, s_max: f32| stamp_ns - since_ns > (f64::from(s_max) * NS_PER_S) as i64;
        if self.obstacle_ns != 0 && self.ground_ns <= self.obstacle_ns || is_old(self.ground_ns, GROUND_S_MAX) {
            self.ground_ns = 0;
        }
        if is_old(self.obstacle_ns, OBSTACLE_S_MAX) {
            self.obstacle_ns = 0;
        }
        self.ground_ns != 0 || self.obstacle_ns != 0
    }

    /// The remembered point, ego frame, metres; `None` if it is out of the view of the newest map, or no longer there.
    pub fn recalled(
        &self,
        ego_from_map: &Isometry3<f64>,
        view_m: &[f32; DIRECTIONS],
        azimuths: &AzimuthColumns,
    ) -> Option<[f32; 3]> {
        let [x, y] = self.world.map(|world| (world as f64 + 0.5) * CELL_M);
        let holds_obstacle = self.obstacle_ns != 0;
        let at = |z: f64| (ego_from_map * Point3::new(x, y, z)).cast::<f32>();
        let point = at(if holds_obstacle { self.obstacle_m } else { self.ground_m });
        let range_m = libm::hypotf(point.x, point.y);
        let direction = azimuths.column(point.x, point.y) as usize;
        let beside = [DIRECTIONS - 1, 0, 1].map(|beside| view_m[(direction + beside) % DIRECTIONS]);
        let in_view = beside.into_iter().any(|view_m| VIEW * view_m >= range_m);
        let is_tall = self.tall_m >= TALL_MIN * range_m && range_m >= TALL_RANGE_M_MIN;
        let has_moved = holds_obstacle && is_tall && view_m[direction] >= range_m + BEHIND_M;
        // Ground that is still there was seen after the obstacle.
        let is_known = !has_moved || self.ground_ns != 0;
        let point = if has_moved { at(self.ground_m) } else { point };
        (range_m <= RANGE_M_MAX && in_view && is_known).then(|| [point.x, point.y, point.z])
    }

    /// Remembers an obstacle up to this height of the world that is this tall, metres; the highest of a map.
    pub fn add_obstacle(&mut self, obstacle_m: f64, tall_m: f32, stamp_ns: i64) {
        if self.obstacle_ns != stamp_ns || obstacle_m > self.obstacle_m {
            (self.obstacle_m, self.tall_m, self.obstacle_ns) = (obstacle_m, tall_m, stamp_ns);
        }
    }
}
