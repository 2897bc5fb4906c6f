//! Memory: ground and obstacles that earlier maps have seen, carried into the newest one. Not in the papers.
//!
//! In: the points of each map with their heights over the ground, and the ego pose. Out: [`Memory::extended`]: the
//! points of the newest map, and one more for each remembered cell of 0.25 m. A sensor with few lasers on a moving
//! vehicle so knows the ground between its rings.
//!
//! - A cell remembers its lowest ground until a return shows it again, for `ground_s_max`.
//! - An obstacle removes the ground of its cell. It is itself remembered for `obstacle_s_max`; then the cell is
//!   unknown, so that a moving object leaves no trail, and ground under it is free only when it is seen again.
//! - In a direction in which the newest map has no return nothing is remembered, for the sensor may be covered there;
//!   nor is it far beyond the farthest return. A near return proves no more: from the vehicle's middle it may be seen
//!   in another direction than from the sensor.
//! - The cells belong to the world. If a pose is missing or jumps, everything is forgotten.

mod cell;
pub mod config;

use std::ops::{Range, RangeInclusive};

use nalgebra::{Isometry3, Point3};

use crate::azimuth_columns::{AzimuthColumns, floor_to_whole};
use crate::sensor::sweep::Sweep;
use crate::wide::{WideLoop, run_wide};

use cell::{CELL_M, DIRECTIONS, MemoryCell, NS_PER_S};
use config::{MemoryConfig, RANGE_M_MAX};

const CELLS_A_M: f32 = (1.0 / CELL_M) as f32;
/// Number of stored cells along a side, a power of two: 64 m.
const SIDE: i64 = 256;
/// Largest height of ground over or under the local ground, metres. Ours; not tuned.
const GROUND_M_MAX: f32 = 0.2;
/// Least and greatest height of an obstacle over the local ground, metres: the heights of the reach stage.
const OBSTACLE_M: RangeInclusive<f32> = 0.25..=2.5;
/// Greatest distance and turn between two poses, metres and radians, and how much more a second of time allows. Ours:
/// no vehicle on wheels is faster.
const JUMP_M: [f64; 2] = [1.0, 60.0];
const JUMP_RAD: [f64; 2] = [0.2, 3.0];
/// A place that is farther away than [`RANGE_M_MAX`].
const NOWHERE: u32 = u32::MAX;
/// Number of cells that make each offset from the vehicle's cell positive: a multiple of [`SIDE`].
const POSITIVE: u32 = 1024;

/// The memory of one vehicle.
#[derive(Clone)]
pub(crate) struct Memory {
    cells: Vec<MemoryCell>,
    /// One bit for each stored cell, set if it holds something, or held it when it was last asked for.
    listed: Vec<u64>,
    /// Pose and stamp of the newest map; `None` without a pose.
    newest: Option<(Isometry3<f64>, i64)>,
    /// Points of the newest map and the remembered ones.
    extended: Sweep,
    azimuths: AzimuthColumns,
    /// By point of the newest map's own: index of its stored cell, or [`NOWHERE`].
    places: Vec<u32>,
    /// The newest map's own points that follow each other in one cell, and their stored cell. Neighbours of a ring
    /// mostly share one.
    runs: Vec<(u32, Range<usize>)>,
    /// One bit for each stored cell, set if the newest map has a point there.
    seen: Vec<u64>,
    /// What the newest map got.
    state: MemoryState,
}

/// What a map got from memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MemoryState {
    /// Number of remembered points in the map.
    pub points: usize,
    /// Number of times everything was forgotten because a pose was missing or jumped.
    pub drops: u64,
}

impl Memory {
    /// An empty memory; `None` if the configuration disables it.
    pub fn new(config: &MemoryConfig) -> Option<Self> {
        config.enabled.then(|| Self {
            cells: vec![MemoryCell::default(); (SIDE * SIDE) as usize],
            listed: vec![0; (SIDE * SIDE / 64) as usize],
            newest: None,
            extended: Sweep::default(),
            azimuths: AzimuthColumns::new(AzimuthColumns::TWO_DEGREES),
            places: Vec::new(),
            runs: Vec::new(),
            seen: vec![0; (SIDE * SIDE / 64) as usize],
            state: MemoryState::default(),
        })
    }

    /// The points of the newest map, followed by the remembered ones; `own` are the former alone.
    pub fn extended<'a>(&'a self, own: &'a Sweep) -> &'a Sweep {
        if self.newest.is_some() { &self.extended } else { own }
    }

    /// What the newest map got.
    pub fn state(&self) -> MemoryState {
        self.state
    }

    /// Adds the remembered points to the points of a map that ends at `stamp_ns`.
    pub fn extend(&mut self, sweep: &Sweep, map_from_ego: Option<&Isometry3<f64>>, stamp_ns: i64) {
        if self.newest.is_some_and(|newest| !continues(newest, map_from_ego, stamp_ns)) {
            self.forget();
        }
        self.newest = map_from_ego.map(|pose| (*pose, stamp_ns));
        self.state.points = 0;
        if let Some(pose) = map_from_ego {
            self.extended.copy_from(sweep);
            self.recall(pose, stamp_ns);
            self.state.points = self.extended.x.len() - sweep.x.len();
        }
    }

    /// Remembers the points of the newest map's own sweep, which have these heights over the ground.
    pub fn remember(&mut self, heights_m: &[f32]) {
        let Some((pose, stamp_ns)) = self.newest else { return };
        let (runs, sweep) = (std::mem::take(&mut self.runs), std::mem::take(&mut self.extended));
        let (rotation, corner) = (pose.rotation.to_rotation_matrix(), corner(&pose));
        let up = [0, 1, 2].map(|i| rotation[(2, i)] as f32);
        for (place, points) in &runs {
            let (mut lowest_m, mut highest_m, mut tall_m) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
            let [xs, ys, zs, heights_m] = [&sweep.x, &sweep.y, &sweep.z, heights_m].map(|axis| &axis[points.clone()]);
            for (((x, y), z), &height_m) in xs.iter().zip(ys).zip(zs).zip(heights_m) {
                let over_pose_m = up[0] * x + up[1] * y + up[2] * z;
                // NaN fails every comparison.
                if height_m.abs() <= GROUND_M_MAX {
                    lowest_m = over_pose_m.min(lowest_m);
                } else if OBSTACLE_M.contains(&height_m) && over_pose_m > highest_m {
                    (highest_m, tall_m) = (over_pose_m, height_m);
                }
            }
            let [lowest_m, highest_m] = [lowest_m, highest_m].map(|m| pose.translation.z + f64::from(m));
            if lowest_m.is_finite() {
                self.cell(*place, corner).add_ground(lowest_m, stamp_ns);
            }
            if highest_m.is_finite() {
                self.cell(*place, corner).add_obstacle(highest_m, tall_m, stamp_ns);
            }
        }
        (self.runs, self.extended) = (runs, sweep);
    }

    /// The stored cell of a place of the square with this corner.
    fn cell(&mut self, place: u32, corner: [i64; 2]) -> &mut MemoryCell {
        let (world, cell) = (world_cell(corner, i64::from(place)), &mut self.cells[place as usize]);
        self.listed[place as usize / 64] |= 1 << (place % 64);
        if cell.world != world {
            *cell = MemoryCell { world, ..MemoryCell::default() };
        }
        cell
    }

    /// Adds a point for each remembered cell near the vehicle in which the map has no point itself.
    fn recall(&mut self, map_from_ego: &Isometry3<f64>, stamp_ns: i64) {
        let ego_from_map = map_from_ego.inverse();
        self.find_seen_cells(map_from_ego);
        let view_m = self.view_m(&ego_from_map, map_from_ego);
        for word in 0..self.listed.len() {
            for index in bits(word, self.listed[word] & !self.seen[word]) {
                if self.cells[index].expire(stamp_ns) {
                    let point = self.cells[index].recalled(&ego_from_map, &view_m, &self.azimuths);
                    point.into_iter().for_each(|point| self.extended.push_remembered(point));
                } else {
                    self.listed[word] &= !(1 << (index % 64));
                }
            }
        }
    }

    /// Finds the stored cell of each point of the map, and those in which it has one.
    fn find_seen_cells(&mut self, map_from_ego: &Isometry3<f64>) {
        let Self { places, runs, seen, extended, .. } = self;
        places.resize(extended.x.len(), NOWHERE);
        run_wide(FindPlaces { map_from_ego, sweep: extended, places });
        seen.fill(0);
        runs.clear();
        let mut first = 0;
        for run in places.chunk_by(|place, next| place == next) {
            if run[0] != NOWHERE {
                seen[run[0] as usize / 64] |= 1 << (run[0] % 64);
                runs.push((run[0], first..first + run.len()));
            }
            first += run.len();
        }
    }

    /// By direction of two degrees: the range of the farthest point that the map has there, within the range of the
    /// memory, metres; 0 without a point.
    fn view_m(&self, ego_from_map: &Isometry3<f64>, map_from_ego: &Isometry3<f64>) -> [f32; DIRECTIONS] {
        let (middle, corner) = (map_from_ego.translation.vector, corner(map_from_ego));
        let mut view_m = [0f32; DIRECTIONS];
        for index in self.seen.iter().enumerate().flat_map(|(word, seen)| bits(word, *seen)) {
            let [x, y] = world_cell(corner, index as i64).map(|cell| (cell as f64 + 0.5) * CELL_M);
            let point = (ego_from_map * Point3::new(x, y, middle.z)).cast::<f32>();
            let farthest_m = &mut view_m[self.azimuths.column(point.x, point.y) as usize];
            *farthest_m = farthest_m.max(libm::hypotf(point.x, point.y));
        }
        view_m
    }

    fn forget(&mut self) {
        for (word, listed) in self.listed.iter_mut().enumerate() {
            bits(word, std::mem::take(listed)).for_each(|index| self.cells[index] = MemoryCell::default());
        }
        self.state.drops += 1;
    }
}

/// Writes the stored cell of each point of a sweep, or [`NOWHERE`].
struct FindPlaces<'a> {
    map_from_ego: &'a Isometry3<f64>,
    sweep: &'a Sweep,
    places: &'a mut [u32],
}

impl WideLoop for FindPlaces<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { map_from_ego, sweep: Sweep { x: xs, y: ys, z: zs, .. }, places } = self;
        let rotation = map_from_ego.rotation.to_rotation_matrix();
        let [across, along] = [0, 1].map(|axis| [0, 1, 2].map(|i| rotation[(axis, i)] as f32 * CELLS_A_M));
        let [(first_x, in_x), (first_y, in_y)] = [0, 1].map(|axis| {
            let cells = map_from_ego.translation.vector[axis] / CELL_M;
            let first = (cells.floor() as i64).rem_euclid(SIDE) as u32;
            (first, (cells - cells.floor()) as f32 + POSITIVE as f32)
        });
        let n = places.len();
        let (xs, ys, zs) = (&xs[..n], &ys[..n], &zs[..n]);
        // Without a branch, so that the compiler vectorises it.
        for i in 0..n {
            let (x, y, z) = (xs[i], ys[i], zs[i]);
            let cell_x = first_x.wrapping_add(floor_to_whole(in_x + across[0] * x + across[1] * y + across[2] * z));
            let cell_y = first_y.wrapping_add(floor_to_whole(in_y + along[0] * x + along[1] * y + along[2] * z));
            let place = cell_y % SIDE as u32 * SIDE as u32 + cell_x % SIDE as u32;
            places[i] = if x * x + y * y <= RANGE_M_MAX * RANGE_M_MAX { place } else { NOWHERE };
        }
    }
}

/// Index of each set bit of a word of bits, the lowest first.
fn bits(word: usize, mut rest: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = (rest != 0).then(|| word * 64 + rest.trailing_zeros() as usize)?;
        rest &= rest - 1;
        Some(bit)
    })
}

/// The first cell of the world, along x and y, of the square of stored cells about the vehicle.
fn corner(map_from_ego: &Isometry3<f64>) -> [i64; 2] {
    let middle = map_from_ego.translation.vector;
    [middle.x, middle.y].map(|metres| (metres / CELL_M).floor() as i64 - SIDE / 2)
}

/// The world's cell that is stored at a place and lies in the square with this corner.
fn world_cell(corner: [i64; 2], place: i64) -> [i64; 2] {
    let stored = [place % SIDE, place / SIDE];
    [0, 1].map(|axis| corner[axis] + (stored[axis] - corner[axis]).rem_euclid(SIDE))
}

/// True if a pose follows from the newest one: a vehicle can have moved so far in the time between.
fn continues((newest, newest_ns): (Isometry3<f64>, i64), map_from_ego: Option<&Isometry3<f64>>, stamp_ns: i64) -> bool {
    let Some(pose) = map_from_ego else { return false };
    let seconds = stamp_ns.saturating_sub(newest_ns) as f64 / NS_PER_S;
    let moved = newest.inv_mul(pose);
    // A pose of a world far away gives infinities, which fail the comparisons.
    seconds >= 0.0
        && moved.translation.vector.norm() <= JUMP_M[0] + JUMP_M[1] * seconds
        && moved.rotation.angle() <= JUMP_RAD[0] + JUMP_RAD[1] * seconds
}

#[cfg(test)]
mod tests {
    use super::cell::TALL_RANGE_M_MIN;
    use super::config::{GROUND_S_MAX, OBSTACLE_S_MAX};
    use super::*;

    /// Seconds after the first map.
    fn at(seconds: f64) -> i64 {
        ((100.0 + seconds) * NS_PER_S) as i64
    }

    /// A point in each second cell about the vehicle, `z_m` over the ground.
    fn points(z_m: f32) -> Sweep {
        let places = || (0..1600).map(|i| ((i % 40) as f32 * 0.5 - 9.9, (i / 40) as f32 * 0.5 - 9.9));
        let (x, y) = places().unzip();
        Sweep { x, y, z: vec![z_m; 1600], ..Sweep::default() }
    }

    /// One point in each direction, 20 m away.
    fn view() -> Sweep {
        let places = || (0..720).map(|i| libm::sincosf(i as f32 * std::f32::consts::TAU / 720.0));
        let (y, x): (Vec<f32>, Vec<f32>) = places().map(|(sin, cos)| (20.0 * sin, 20.0 * cos)).unzip();
        Sweep { z: vec![0.0; x.len()], x, y, ..Sweep::default() }
    }

    /// Adds a map with these points over the ground z = 0, and returns how many points it gets from memory.
    fn map(memory: &mut Memory, sweep: &Sweep, seconds: f64) -> usize {
        memory.extend(sweep, Some(&Isometry3::identity()), at(seconds));
        memory.remember(&sweep.z);
        memory.state().points
    }

    fn memory() -> Memory {
        Memory::new(&MemoryConfig { enabled: true }).unwrap()
    }

    #[test]
    fn a_cell_is_recalled_exactly_if_the_map_has_no_point_in_it() {
        let (mut memory, sweep) = (memory(), points(0.0));
        assert_eq!(map(&mut memory, &sweep, 0.0), 0);
        assert_eq!(map(&mut memory, &sweep, 0.1), 0, "the map sees all cells itself");
        let mut half = view();
        half.x.extend_from_slice(&sweep.x[..800]);
        half.y.extend_from_slice(&sweep.y[..800]);
        half.z.resize(half.x.len(), 0.0);
        assert_eq!(map(&mut memory, &half, 0.2), 800);
        assert_eq!(map(&mut memory, &view(), 0.3), 1600);
    }

    #[test]
    fn nothing_is_recalled_in_a_direction_without_a_return() {
        let mut memory = memory();
        map(&mut memory, &points(0.0), 0.0);
        let mut covered = view();
        // Nothing is seen to the left.
        let kept = |i: &usize| covered.y[*i] < 0.0;
        let kept: Vec<usize> = (0..covered.x.len()).filter(kept).collect();
        let pick = |axis: &[f32]| kept.iter().map(|i| axis[*i]).collect();
        covered = Sweep { x: pick(&covered.x), y: pick(&covered.y), z: vec![0.0; kept.len()], ..Sweep::default() };
        let own = covered.x.len();
        let recalled = map(&mut memory, &covered, 0.1);
        let places = memory.extended.x.iter().zip(&memory.extended.y).skip(own);
        assert!(recalled >= 790, "{recalled}");
        assert!(places.into_iter().all(|(x, y)| *y < 0.1 * x.abs() + 0.3), "a sector that is covered stays unknown");
    }

    #[test]
    fn near_returns_let_nothing_far_be_recalled() {
        let mut memory = memory();
        map(&mut memory, &points(0.0), 0.0);
        let places = (0..720).map(|i| libm::sincosf(i as f32 * std::f32::consts::TAU / 720.0));
        let (y, x): (Vec<f32>, Vec<f32>) = places.map(|(sin, cos)| (3.0 * sin, 3.0 * cos)).unzip();
        let near = Sweep { z: vec![0.0; x.len()], x, y, ..Sweep::default() };
        assert!(map(&mut memory, &near, 0.1) > 300);
        let recalled = || memory.extended.x.iter().zip(&memory.extended.y).skip(near.x.len());
        let farthest_m = recalled().map(|(x, y)| libm::hypotf(*x, *y)).fold(0.0, f32::max);
        assert!((5.0..=6.5).contains(&farthest_m), "{farthest_m}");
    }

    #[test]
    fn where_an_obstacle_stood_only_ground_seen_later_is_recalled() {
        let forgotten_s = 0.2 + f64::from(OBSTACLE_S_MAX);
        let sweep = points(1.0);
        let near = |(x, y): (&f32, &f32)| libm::hypotf(x + 0.025, y + 0.025) < TALL_RANGE_M_MIN;
        let near = sweep.x.iter().zip(&sweep.y).filter(|place| near(*place)).count();
        // A tall obstacle that is no longer met by a ray leaves no trail, but near the vehicle rays pass over it.
        for (heights_m, at_once, expected) in [([0.0, 1.0], near, 0), ([1.0, 0.0], 1600, 1600)] {
            let mut memory = memory();
            map(&mut memory, &points(heights_m[0]), 0.0);
            map(&mut memory, &points(heights_m[1]), 0.1);
            assert_eq!(map(&mut memory, &view(), 0.2), at_once, "{heights_m:?}");
            assert_eq!(map(&mut memory, &view(), forgotten_s), expected, "{heights_m:?}");
            assert_eq!(map(&mut memory, &view(), f64::from(GROUND_S_MAX) + 0.2), 0, "{heights_m:?}");
        }
    }
}
