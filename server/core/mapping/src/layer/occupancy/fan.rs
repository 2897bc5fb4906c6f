//! The rays of each sensor's newest scan about that sensor: in each direction, how far the view goes and where it
//! proves the ground free.
//!
//! In: [`Rays`], ego frame, metres. Out: hits counted in the [`Window`] as scans come, and, when the map is made, what
//! each cell is told by one trace for each direction that has rays.
//!
//! A ray proves a cell free where it passes low over it: at the height of a bumper, `clear_height_m_min` to `_max`.
//! From the roof over a car it proves nothing of the car's cells, and neither does it under the car's body. So every
//! direction (a quarter of a degree) keeps a row of bits, one for each step of a cell's side outward, of where some ray
//! of it is low; rays only set bits, and their order says nothing.
//!
//! A trace ends at the nearest return from above the ground, of its own direction or of the two to either side: rays of
//! one direction differ by part of its width, some get lost, and the trace must not run along a thing just inside its
//! edge. Behind it the cells are hidden, but for those where a ray comes down on the ground: there from where it is
//! under the vehicle's clearance, if nothing stands on its way from there to its end, so that it has passed beneath
//! nothing.
//!
//! Heights are over the plane under the vehicle. Where the ground dips under it, what stands there may not reach over
//! the plane: there a return counts that is higher by the clearance than the lowest about it, a metre along its
//! direction and a degree across.
//!
//! Only a sensor's newest scan says what is clear and what is hidden now. So lines are drawn once a map, however many
//! scans came since the last one.

use std::ops::Range;

use super::states::{HIDDEN, LOOKED_AT, THROUGH};
use super::way::Way;
use super::window::Window;
use crate::layer::occupancy::config::OccupancyConfig;
use crate::layer::maker::Rays;
use crate::layer::radial_grid::{AzimuthColumns, floor_to_whole, round_to_whole};
use crate::sensor::sweep::Sweep;

/// Directions about a sensor; a quarter of a degree each, as finely as the paper's units look.
const DIRECTIONS: usize = 1440;
/// Directions to either side whose hits end a trace too.
const BESIDE: isize = 2;
/// Steps after which a direction goes on as two lines: 112 cells out it is half a cell wide.
const FORK: usize = 112;
/// A return so far under the plane, and under the steepest road from the vehicle to it, is a mirror image: its ray
/// proves nothing.
const BELOW_M: f32 = 0.3;
const GRADE_MAX: f32 = 0.1;
/// Directions and steps of a patch of ground.
const PATCH: [usize; 2] = [4, 4];
/// Nearest hit of a direction without.
const NONE: u16 = u16::MAX;
/// Steps are counted no farther, metres or miles beyond every window.
const STEPS_MAX: f32 = 65_000.0;
/// Points are taken in chunks of this many, so that what is worked out of them stays in the first cache level.
const CHUNK: usize = 256;

/// A return from the ground, and steps of its ray: where it comes under the clearance, where it is too low to prove
/// anything, and where it ends.
struct Ground {
    direction: u16,
    from: u16,
    low: u16,
    end: u16,
    point: u32,
}

/// What follows from points by arithmetic alone, in steps from the sensor.
struct Chunk {
    direction: [u32; CHUNK],
    range: [f32; CHUNK],
    step: [u32; CHUNK],
    /// From where to where their rays are at the height of a bumper.
    first: [u32; CHUNK],
    end: [u32; CHUNK],
    /// Where they come under the clearance, and where they are too low to prove anything.
    under: [u32; CHUNK],
    low: [u32; CHUNK],
}

/// All the sensors' newest scans.
pub struct Fan {
    compass: Compass,
    views: Vec<View>,
    /// What one direction's trace tells, step by step; reused.
    telling: Vec<u8>,
}

/// Directions about a sensor.
struct Compass {
    directions: AzimuthColumns,
    /// Each direction's middle, and the middles of its halves: far out a direction is wider than the spacing of lines
    /// that leave no cell between them.
    lines: Vec<[[f64; 2]; 3]>,
    steps: usize,
    words: usize,
}

/// What one sensor's newest scan tells of the directions about it.
struct View {
    sensor: u16,
    /// Whether the scan came since the last map.
    fresh: bool,
    /// When it ended.
    stamp_ns: i64,
    /// The sensor's place, cells of the world.
    at: [f64; 2],
    /// Heading of the ego frame in the window's axes, rad.
    yaw_rad: f64,
    present: Vec<bool>,
    nearest_hit: Vec<u16>,
    /// One bit a step; `words` words a direction.
    low: Vec<u64>,
    hits: Vec<u64>,
    /// As `low`, behind the nearest hit.
    proved: Vec<u64>,
    ground: Vec<Ground>,
    /// Lowest return of each patch of ground, where it lies in a dip; else infinite.
    dips: Vec<f32>,
    dipped: bool,
}

impl Fan {
    /// For a window whose far corner is `reach_m` from a sensor in its middle.
    pub fn new(reach_m: f32, cell_m: f32) -> Self {
        let compass = Compass::new(reach_m, cell_m);
        Self { telling: vec![0; compass.steps], compass, views: Vec::new() }
    }

    /// Takes one scan in place of its sensor's last, and its hits into the window, which follows the vehicle already.
    pub fn take(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        let known = self.views.iter().position(|view| view.sensor == rays.sensor);
        let index = known.unwrap_or_else(|| {
            self.views.push(View::new(rays.sensor, &self.compass));
            self.views.len() - 1
        });
        let view = &mut self.views[index];
        view.clear(&self.compass);
        view.stand(rays, config, window);
        view.take_returns(rays, config, &self.compass, window);
        view.take_no_returns(rays, config, &self.compass);
    }

    /// Forgets all scans.
    pub fn forget(&mut self) {
        self.views.iter_mut().for_each(|view| view.fresh = false);
    }

    /// Adds what the scans since the last map, and since `earliest_ns`, tell to each cell of the window, row by row;
    /// whether there were any.
    pub fn tell(&mut self, config: &OccupancyConfig, earliest_ns: i64, window: &Window, told: &mut [u8]) -> bool {
        self.views.iter_mut().filter(|view| view.stamp_ns < earliest_ns).for_each(|view| view.fresh = false);
        let mut any = false;
        for view in self.views.iter_mut().filter(|view| view.fresh) {
            view.prove_ground(&self.compass);
            view.trace(config, &self.compass, window, &mut self.telling, told);
            (view.fresh, any) = (false, true);
        }
        any
    }
}

impl Compass {
    fn new(reach_m: f32, cell_m: f32) -> Self {
        let steps = (reach_m / cell_m).ceil() as usize + 1;
        let words = steps.div_ceil(64);
        // Turned by whole quarters, so that a turned world gives a turned map to the bit.
        let line = |direction: usize, within: f64| {
            let angle = ((direction % (DIRECTIONS / 4)) as f64 + within) / DIRECTIONS as f64 * std::f64::consts::TAU;
            let (y, x) = angle.sin_cos();
            [[x, y], [-y, x], [-x, -y], [y, -x]][direction / (DIRECTIONS / 4)]
        };
        let lines = (0..DIRECTIONS).map(|direction| [0.5, 0.25, 0.75].map(|within| line(direction, within)));
        let directions = AzimuthColumns::new(DIRECTIONS as u16);
        Self { directions, lines: lines.collect(), steps: words * 64, words }
    }

    /// Patches of ground about the sensor.
    fn patches(&self) -> usize {
        DIRECTIONS / PATCH[0] * self.steps / PATCH[1]
    }

    /// The patch that holds a step of a direction.
    fn patch(&self, direction: usize, step: usize) -> usize {
        direction / PATCH[0] * (self.steps / PATCH[1]) + step / PATCH[1]
    }

    fn row(&self, direction: usize) -> Range<usize> {
        direction * self.words..(direction + 1) * self.words
    }
}

impl View {
    fn new(sensor: u16, compass: &Compass) -> Self {
        let bits = || vec![0; DIRECTIONS * compass.words];
        Self {
            sensor,
            fresh: false,
            stamp_ns: 0,
            at: [0.0; 2],
            yaw_rad: 0.0,
            present: vec![false; DIRECTIONS],
            nearest_hit: vec![NONE; DIRECTIONS],
            low: bits(),
            hits: bits(),
            proved: bits(),
            ground: Vec::new(),
            dips: vec![f32::INFINITY; compass.patches()],
            dipped: false,
        }
    }

    fn clear(&mut self, compass: &Compass) {
        for direction in (0..DIRECTIONS).filter(|direction| self.present[*direction]) {
            for bits in [&mut self.low, &mut self.hits, &mut self.proved] {
                bits[compass.row(direction)].fill(0);
            }
        }
        self.present.fill(false);
        self.nearest_hit.fill(NONE);
        self.ground.clear();
        if std::mem::take(&mut self.dipped) {
            self.dips.fill(f32::INFINITY);
        }
    }

    /// Where the sensor is in the world, as the window knows it now.
    fn stand(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &Window) {
        let (place, corner) = (window.place(), window.corner());
        let (sin, cos) = place.yaw_rad.sin_cos();
        let [x, y] = [rays.origin_m[0], rays.origin_m[1]].map(|metres| f64::from(metres / config.cell_m));
        let from = [place.cells[0] + x * cos - y * sin, place.cells[1] + x * sin + y * cos];
        self.at = [0, 1].map(|i| corner[i] as f64 + from[i]);
        (self.yaw_rad, self.fresh, self.stamp_ns) = (place.yaw_rad, true, rays.stamp_ns);
    }

    fn take_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, compass: &Compass, window: &mut Window) {
        let range_max = config.range_m_max / config.cell_m;
        // Ground from here on down is deep enough for a thing on it to stay under `clear_height_m_min`.
        let dip = config.clear_height_m_min - config.clearance_m;
        let onto = window.from_ego();
        let sweep = rays.returns;
        let mut chunk = Chunk::default();
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        for (number, ((xs, ys), zs)) in chunks.enumerate() {
            chunk.fill([xs, ys, zs], rays.origin_m, config, compass);
            for (i, ((&x, &y), &z)) in xs.iter().zip(ys).zip(zs).enumerate() {
                let (direction, range) = (chunk.direction[i] as usize, chunk.range[i]);
                self.present[direction] = true;
                if z < -BELOW_M - GRADE_MAX * config.cell_m * range {
                    continue;
                }
                let row = compass.row(direction);
                set_bits(&mut self.low[row.clone()], chunk.first[i] as usize, chunk.end[i] as usize);
                if range > range_max || range.is_nan() || z >= config.overhang_m {
                    continue;
                }
                let step = chunk.step[i] as u16;
                let inside = usize::from(step) < compass.steps;
                if z >= config.clear_height_m_min {
                    if z >= config.clearance_m {
                        window.hit(onto.place(x, y));
                    }
                    self.meet(direction, step, compass);
                } else if inside {
                    let [from, low] = [chunk.under[i], chunk.low[i]].map(|value| value as u16);
                    let point = (number * CHUNK + i) as u32;
                    self.ground.push(Ground { direction: direction as u16, from, low, end: step + 1, point });
                    if z < dip {
                        let lowest = &mut self.dips[compass.patch(direction, step.into())];
                        (*lowest, self.dipped) = (lowest.min(z), true);
                    }
                }
            }
        }
        if self.dipped {
            self.take_things_in_dips(sweep, config, compass, window);
        }
    }

    /// A direction's ray meets a thing.
    #[inline(always)]
    fn meet(&mut self, direction: usize, step: u16, compass: &Compass) {
        self.nearest_hit[direction] = self.nearest_hit[direction].min(step);
        if usize::from(step) < compass.steps {
            self.hits[direction * compass.words + usize::from(step) / 64] |= 1 << (step % 64);
        }
    }

    /// Returns that were taken for the ground's, and lie too high over the ground about them.
    fn take_things_in_dips(&mut self, sweep: &Sweep, config: &OccupancyConfig, compass: &Compass, window: &mut Window) {
        let onto = window.from_ego();
        for index in 0..self.ground.len() {
            let Ground { direction, end, point, .. } = self.ground[index];
            let (direction, step, point) = (usize::from(direction), end - 1, point as usize);
            if sweep.z[point] - self.dips[compass.patch(direction, step.into())] >= config.clearance_m {
                window.hit(onto.place(sweep.x[point], sweep.y[point]));
                self.meet(direction, step, compass);
            }
        }
    }

    fn take_no_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, compass: &Compass) {
        let farthest = config.no_return_m.min(config.range_m_max) / config.cell_m;
        for &[dx, dy, dz] in rays.no_returns {
            let direction = compass.directions.column(dx, dy) as usize;
            self.present[direction] = true;
            let steps_a_m = (dx * dx + dy * dy).sqrt() / dz / config.cell_m;
            let height = |height_m: f32| (height_m - rays.origin_m[2]) * steps_a_m;
            let (from, to) = between(height(config.clear_height_m_min), height(config.clear_height_m_max));
            let steps = compass.steps as f32;
            let (first, end) = (round_to_whole(least(from, steps)), round_to_whole(least(to, least(farthest, steps))));
            set_bits(&mut self.low[compass.row(direction)], first as usize, end as usize);
        }
    }

    /// Nearest hit of a direction and those beside it.
    fn nearest(&self, direction: usize) -> usize {
        let nearest = about(direction).map(|direction| self.nearest_hit[direction]).min();
        usize::from(nearest.unwrap_or(NONE))
    }

    /// What returns from the ground prove behind the nearest hit.
    fn prove_ground(&mut self, compass: &Compass) {
        let nearest: Vec<usize> = (0..DIRECTIONS).map(|direction| self.nearest(direction)).collect();
        for &Ground { direction, from, low, end, .. } in &self.ground {
            let (direction, from, low, end) =
                (usize::from(direction), usize::from(from), usize::from(low), usize::from(end));
            if low <= nearest[direction] {
                continue;
            }
            let mut rows = about(direction).map(|direction| &self.hits[compass.row(direction)]);
            if !rows.any(|row| any_bit(row, from, end)) {
                set_bits(&mut self.proved[compass.row(direction)], from, low);
            }
        }
    }

    fn trace(&self, config: &OccupancyConfig, compass: &Compass, window: &Window, telling: &mut [u8], told: &mut [u8]) {
        let corner = window.corner();
        let from = [0, 1].map(|i| self.at[i] - corner[i] as f64);
        let (sin, cos) = self.yaw_rad.sin_cos();
        let reach = ((config.range_m_max / config.cell_m) as usize).min(compass.steps);
        if !from.iter().all(|at| (0.0..window.side() as f64).contains(at)) {
            return;
        }
        for direction in (0..DIRECTIONS).filter(|direction| self.looks(*direction)) {
            self.write_telling(direction, compass, telling);
            for (line, &[x, y]) in compass.lines[direction].iter().enumerate() {
                let way = Way::new(from, [x * cos - y * sin, x * sin + y * cos], window.side());
                let near = reach.min(FORK);
                let steps = if line == 0 { 0..way.steps(near) } else { near..way.steps(reach).max(near) };
                way.tell(steps, telling, told);
            }
        }
    }

    /// Whether anything is known of a direction. Rays farther apart than a direction is wide leave every other empty.
    fn looks(&self, direction: usize) -> bool {
        self.present[direction] || self.present[turned(direction, -1)] && self.present[turned(direction, 1)]
    }

    /// Writes what a direction tells of each of its steps.
    fn write_telling(&self, direction: usize, compass: &Compass, telling: &mut [u8]) {
        let nearest = self.nearest(direction);
        let (seen, hidden) = telling.split_at_mut(nearest.min(compass.steps));
        seen.fill(LOOKED_AT);
        hidden.fill(LOOKED_AT | HIDDEN);
        let [own, right, left] = [0, -1, 1].map(|beside| compass.row(turned(direction, beside)).start);
        for (word, telling) in telling.chunks_exact_mut(64).enumerate() {
            // An empty direction sees what both beside it see.
            let (low, proved) = match self.present[direction] {
                true => (self.low[own + word], self.proved[own + word]),
                false => (self.low[right + word] & self.low[left + word], 0),
            };
            let before = bits_of_word(word, 0, nearest);
            let mut free = low & before | proved & !before;
            while free != 0 {
                let first = free.trailing_zeros() as usize;
                let end = first + (!(free >> first)).trailing_zeros() as usize;
                telling[first..end].fill(LOOKED_AT | THROUGH);
                free &= !bits_of_word(0, first, end);
            }
        }
    }
}

impl Default for Chunk {
    fn default() -> Self {
        let none = [0; CHUNK];
        Self { direction: none, range: [0.0; CHUNK], step: none, first: none, end: none, under: none, low: none }
    }
}

impl Chunk {
    /// Free of branches and tables, so that it runs four points at a time.
    #[inline(always)]
    fn fill(&mut self, [xs, ys, zs]: [&[f32]; 3], origin_m: [f32; 3], config: &OccupancyConfig, compass: &Compass) {
        let [ox, oy, oz] = origin_m;
        let (per_m, steps) = (1.0 / config.cell_m, compass.steps as f32);
        let [lowest, highest, clearance] =
            [config.clear_height_m_min, config.clear_height_m_max, config.clearance_m].map(|height_m| height_m - oz);
        let reliable = config.range_m_max * per_m;
        let n = xs.len();
        let (xs, ys, zs) = (&xs[..n], &ys[..n], &zs[..n]);
        let (direction, range_of, step) = (&mut self.direction[..n], &mut self.range[..n], &mut self.step[..n]);
        let (first, end) = (&mut self.first[..n], &mut self.end[..n]);
        let (under_of, low_of) = (&mut self.under[..n], &mut self.low[..n]);
        for i in 0..n {
            let (dx, dy, z) = (xs[i] - ox, ys[i] - oy, zs[i]);
            let range = (dx * dx + dy * dy).sqrt() * per_m;
            // The ground of a ray that comes back from the ground leads there, up or down, in a straight line.
            let rise = if z < config.clear_height_m_min { -oz } else { z - oz };
            let steps_a_m = range / rise;
            let (from, to) = between(lowest * steps_a_m, highest * steps_a_m);
            let (under, low) = between(lowest * steps_a_m, clearance * steps_a_m);
            direction[i] = compass.directions.column(dx, dy);
            range_of[i] = range;
            step[i] = floor_to_whole(least(range, STEPS_MAX));
            first[i] = round_to_whole(least(from, steps));
            end[i] = round_to_whole(least(to, least(least(reliable, range), steps)));
            under_of[i] = round_to_whole(least(under, least(range, steps)));
            low_of[i] = round_to_whole(least(low, least(range, steps)));
        }
    }
}

/// The part of a ray between two heights, from where it passes them. What lies behind the sensor becomes 0.
#[inline(always)]
fn between(a: f32, b: f32) -> (f32, f32) {
    // Level rays give infinities of the right signs. NaN fails every comparison.
    let (from, to) = if a < b { (a, b) } else { (b, a) };
    (if from > 0.0 { from } else { 0.0 }, if to > 0.0 { to } else { 0.0 })
}

/// The lesser of two; the second, where the first is NaN.
#[inline(always)]
fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// A direction, `beside` of them to the left (or less than 0 to the right).
#[inline(always)]
fn turned(direction: usize, beside: isize) -> usize {
    (direction + DIRECTIONS).wrapping_add_signed(beside) % DIRECTIONS
}

/// A direction and those whose hits end its trace.
#[inline(always)]
fn about(direction: usize) -> impl Iterator<Item = usize> {
    (-BESIDE..=BESIDE).map(move |beside| turned(direction, beside))
}

/// The bits of one word of a row that lie in `first..end`.
#[inline(always)]
fn bits_of_word(word: usize, first: usize, end: usize) -> u64 {
    let (first, end) = (first.max(word * 64), end.min(word * 64 + 64));
    if first >= end { 0 } else { u64::MAX >> (64 - (end - first)) << (first - word * 64) }
}

#[inline(always)]
fn set_bits(row: &mut [u64], first: usize, end: usize) {
    if first < end {
        let last = end - 1;
        let (from, to) = (u64::MAX << (first % 64), u64::MAX >> (63 - last % 64));
        if first / 64 == last / 64 {
            row[first / 64] |= from & to;
        } else {
            row[first / 64] |= from;
            row[first / 64 + 1..last / 64].fill(u64::MAX);
            row[last / 64] |= to;
        }
    }
}

#[inline(always)]
fn any_bit(row: &[u64], first: usize, end: usize) -> bool {
    first < end && (first / 64..end.div_ceil(64)).any(|word| row[word] & bits_of_word(word, first, end) != 0)
}
