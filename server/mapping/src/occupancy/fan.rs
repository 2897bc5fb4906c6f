//! The rays of one scan about their sensor: in each direction, how far the view goes and where it proves the ground free.
//!
//! In: [`Rays`], ego frame, metres. Out: hits counted in the [`Window`], and one trace for each direction that has rays.
//!
//! A ray proves a cell free where it passes low over it: at the height of a bumper, `clear_height_m_min` to `_max`. From the
//! roof over a car it proves nothing of the car's cells, and neither does it under the car's body. So every direction (a quarter of a degree) keeps a row of bits, one for each step of a
//! cell's side outward, of where some ray of it is low; rays only set bits, and their order says nothing.
//!
//! A trace ends at the nearest return from above the ground, of its own direction or of the two to either side: rays of one direction
//! differ by part of its width, some get lost, and the trace must not run along a thing just inside its edge. Behind it the
//! cells are hidden, but for those where a ray comes down on the ground: there from where it is under the vehicle's
//! clearance, if nothing stands on its way from there to its end, so that it has passed beneath nothing.

use super::window::Window;
use crate::config::OccupancyConfig;
use crate::map::Rays;
use crate::radial::Quadrants;

/// Directions about a sensor; a quarter of a degree each, as finely as the paper's units look.
const DIRECTIONS: usize = 1440;
/// Directions to either side whose hits end a trace too.
const BESIDE: isize = 2;
/// Steps after which a direction goes on as two lines: 112 cells out it is half a cell wide.
const FORK: usize = 112;
/// A return so far under the plane, and under the steepest road from the vehicle to it, is a mirror image: its ray proves
/// nothing.
const BELOW_M: f32 = 0.3;
const GRADE_MAX: f32 = 0.1;
/// Nearest hit of a direction without.
const NONE: u16 = u16::MAX;

/// A return from the ground, and steps of its ray: where it comes under the clearance, where it is too low to prove
/// anything, and where it ends.
struct Ground {
    direction: u16,
    from: u16,
    low: u16,
    end: u16,
}

/// Buffers reused from scan to scan.
pub struct Fan {
    directions: Quadrants,
    /// Each direction's middle, and the middles of its halves: far out a direction is wider than the spacing of lines that
    /// leave no cell between them.
    lines: Vec<[[f64; 2]; 3]>,
    steps: usize,
    words: usize,
    present: Vec<bool>,
    nearest_hit: Vec<u16>,
    /// One bit a step; `words` words a direction.
    low: Vec<u64>,
    hits: Vec<u64>,
    /// As `low`, behind the nearest hit.
    proved: Vec<u64>,
    ground: Vec<Ground>,
}

/// The part of a ray, by distance over the ground, between two heights.
#[inline(always)]
fn between_heights(origin_z: f32, climb: f32, low: f32, high: f32) -> (f32, f32) {
    // Level rays give infinities of the right signs; `max` and `min` pass over NaN.
    let (a, b) = ((low - origin_z) / climb, (high - origin_z) / climb);
    (a.min(b).max(0.0), a.max(b))
}

impl Fan {
    /// For a window whose far corner is `reach_m` from a sensor in its middle.
    pub fn new(reach_m: f32, cell_m: f32) -> Self {
        let steps = (reach_m / cell_m).ceil() as usize + 1;
        let words = steps.div_ceil(64);
        // Turned by whole quarters, so that a turned world gives a turned map to the bit.
        let line = |direction: usize, within: f64| {
            let angle = ((direction % (DIRECTIONS / 4)) as f64 + within) / DIRECTIONS as f64 * std::f64::consts::TAU;
            let (y, x) = angle.sin_cos();
            [[x, y], [-y, x], [-x, -y], [y, -x]][direction / (DIRECTIONS / 4)]
        };
        let lines = (0..DIRECTIONS).map(|direction| [0.5, 0.25, 0.75].map(|within| line(direction, within)));
        Self {
            directions: Quadrants::new(DIRECTIONS as u16),
            lines: lines.collect(),
            steps: words * 64,
            words,
            present: vec![false; DIRECTIONS],
            nearest_hit: vec![NONE; DIRECTIONS],
            low: vec![0; DIRECTIONS * words],
            hits: vec![0; DIRECTIONS * words],
            proved: vec![0; DIRECTIONS * words],
            ground: Vec::new(),
        }
    }

    /// Takes one scan into the window, which follows the vehicle already.
    pub fn take(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        self.take_returns(rays, config, window);
        self.take_no_returns(rays, config);
        self.prove_ground();
        self.trace(rays, config, window);
        self.clear();
    }

    fn take_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        let [ox, oy, oz] = rays.origin_m;
        let place = window.place();
        let (sin, cos) = place.yaw_rad.sin_cos();
        let per_m = 1.0 / config.cell_m;
        let (turn_x, turn_y) = (cos as f32 * per_m, sin as f32 * per_m);
        let [px, py] = place.cells.map(|cells| cells as f32);
        let sweep = rays.returns;
        for ((&x, &y), &z) in sweep.x.iter().zip(&sweep.y).zip(&sweep.z) {
            let (dx, dy) = (x - ox, y - oy);
            let range = (dx * dx + dy * dy).sqrt();
            let direction = self.directions.column(dx, dy) as usize;
            self.present[direction] = true;
            if z < -BELOW_M - GRADE_MAX * range {
                continue;
            }
            // The ground of a ray that comes back from the ground leads there, up or down, in a straight line.
            let climb = if z < config.clear_height_m_min { -oz } else { z - oz } / range;
            let reliable = range <= config.range_m_max;
            let (from, to) = between_heights(oz, climb, config.clear_height_m_min, config.clear_height_m_max);
            self.set_low(direction, from * per_m, to.min(range).min(config.range_m_max) * per_m);
            if !reliable || z >= config.overhang_m {
                continue;
            }
            let step = (range * per_m) as usize;
            if z >= config.clearance_m {
                window.hit(px + x * turn_x - y * turn_y, py + x * turn_y + y * turn_x);
            }
            if z >= config.clear_height_m_min {
                self.nearest_hit[direction] = self.nearest_hit[direction].min(step.min(NONE as usize) as u16);
                if step < self.steps {
                    self.hits[direction * self.words + step / 64] |= 1 << (step % 64);
                }
            } else if step < self.steps {
                let (from, to) = between_heights(oz, climb, config.clear_height_m_min, config.clearance_m);
                let [from, low] = [from, to].map(|metres| (metres.min(range) * per_m + 0.5) as u16);
                self.ground.push(Ground { direction: direction as u16, from, low, end: step as u16 + 1 });
            }
        }
    }

    fn take_no_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig) {
        let per_m = 1.0 / config.cell_m;
        let farthest = config.no_return_m.min(config.range_m_max);
        for &[dx, dy, dz] in rays.no_returns {
            let direction = self.directions.column(dx, dy) as usize;
            self.present[direction] = true;
            let climb = dz / (dx * dx + dy * dy).sqrt();
            let (low, high) = (config.clear_height_m_min, config.clear_height_m_max);
            let (from, to) = between_heights(rays.origin_m[2], climb, low, high);
            self.set_low(direction, from * per_m, to.min(farthest) * per_m);
        }
    }

    /// Sets the bits of the steps whose middles lie between two distances, in cells.
    #[inline(always)]
    fn set_low(&mut self, direction: usize, from: f32, to: f32) {
        // NaN and what lies behind the sensor become 0, what is beyond the row its end.
        let (first, end) = ((from + 0.5) as usize, (to + 0.5) as usize);
        let row = &mut self.low[direction * self.words..][..self.words];
        set_bits(row, first, end.min(self.steps));
    }

    /// Nearest hit of a direction and those beside it.
    fn nearest(&self, direction: usize) -> usize {
        let nearest = about(direction).map(|direction| self.nearest_hit[direction]).min();
        usize::from(nearest.unwrap_or(NONE))
    }

    /// What returns from the ground prove behind the nearest hit.
    fn prove_ground(&mut self) {
        for &Ground { direction, from, low, end } in &self.ground {
            let (direction, from, low, end) =
                (usize::from(direction), usize::from(from), usize::from(low), usize::from(end));
            if low <= self.nearest(direction) {
                continue;
            }
            let mut rows = about(direction).map(|direction| &self.hits[direction * self.words..][..self.words]);
            if !rows.any(|row| any_bit(row, from, end)) {
                set_bits(&mut self.proved[direction * self.words..][..self.words], from, low);
            }
        }
    }

    fn trace(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        let place = window.place();
        let (sin, cos) = place.yaw_rad.sin_cos();
        let [ox, oy] = [rays.origin_m[0], rays.origin_m[1]].map(|metres| f64::from(metres / config.cell_m));
        let from = [place.cells[0] + ox * cos - oy * sin, place.cells[1] + ox * sin + oy * cos];
        let reach = ((config.range_m_max / config.cell_m) as usize).min(self.steps);
        let mut free = vec![0; self.words];
        window.begin_scan(rays.sensor);
        // What is hidden first: a cell that one direction sees and its neighbour does not has been seen.
        for hiding in [true, false] {
            for direction in (0..DIRECTIONS).filter(|direction| self.looks(*direction)) {
                let nearest = self.nearest(direction);
                let seen = if hiding { 0 } else { self.write_free(direction, nearest, &mut free) };
                for (line, &[x, y]) in self.lines[direction].iter().enumerate() {
                    let (trace, steps) = window.trace(from, [x * cos - y * sin, x * sin + y * cos]);
                    let steps = if line == 0 { 0..steps.min(reach).min(FORK) } else { FORK..steps.min(reach) };
                    if hiding {
                        window.hide(&trace, steps.start.max(nearest)..steps.end);
                    } else {
                        let clear = |step: usize| free[step / 64] >> (step % 64) & 1 == 1;
                        window.look(&trace, steps.start..steps.end.min(seen), clear);
                    }
                }
            }
        }
    }

    /// Whether anything is known of a direction. Rays farther apart than a direction is wide leave every other empty.
    fn looks(&self, direction: usize) -> bool {
        self.present[direction] || self.present[turned(direction, -1)] && self.present[turned(direction, 1)]
    }

    /// Writes one bit for each step a direction proves free; gives the first step from which on it sees nothing.
    fn write_free(&self, direction: usize, nearest: usize, free: &mut [u64]) -> usize {
        let [right, left] = [-1, 1].map(|beside| turned(direction, beside) * self.words);
        let own = direction * self.words;
        let mut seen = nearest;
        for (word, free) in free.iter_mut().enumerate() {
            // An empty direction sees what both beside it see.
            let (low, proved) = match self.present[direction] {
                true => (self.low[own + word], self.proved[own + word]),
                false => (self.low[right + word] & self.low[left + word], 0),
            };
            let before = bits_of_word(word, 0, nearest);
            *free = low & before | proved & !before;
            if proved != 0 {
                seen = seen.max((word + 1) * 64 - proved.leading_zeros() as usize);
            }
        }
        seen
    }

    fn clear(&mut self) {
        for direction in (0..DIRECTIONS).filter(|direction| self.present[*direction]) {
            let row = direction * self.words..(direction + 1) * self.words;
            for bits in [&mut self.low, &mut self.hits, &mut self.proved] {
                bits[row.clone()].fill(0);
            }
        }
        self.present.fill(false);
        self.nearest_hit.fill(NONE);
        self.ground.clear();
    }
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
        (first / 64..end.div_ceil(64)).for_each(|word| row[word] |= bits_of_word(word, first, end));
    }
}

#[inline(always)]
fn any_bit(row: &[u64], first: usize, end: usize) -> bool {
    first < end && (first / 64..end.div_ceil(64)).any(|word| row[word] & bits_of_word(word, first, end) != 0)
}
