//! The rays of one scan about their sensor: in each direction, how far the view goes and where it proves the ground free.
//!
//! In: [`Rays`], ego frame, metres. Out: hits counted in the [`Window`], and one trace for each direction that has rays.
//!
//! A ray proves a cell free where it passes low over it: at most `clear_height_m`. A ray from the roof over a car proves
//! nothing of the car's cells. So every direction (a quarter of a degree) keeps a row of bits, one for each step of a
//! cell's side outward, of where some ray of it is low; rays only set bits, and their order says nothing.
//!
//! A trace ends at the nearest return that counts, of its own direction or of either neighbour: rays of one direction
//! differ by part of its width, and the trace must not run along the edge of a thing just inside. Behind that return the
//! cells are hidden, but for those where a ray comes down on the ground, as far back as it is under the vehicle's
//! clearance, if nothing stands on that stretch: a ray that comes back from under a car proves nothing either.

use super::window::Window;
use crate::config::OccupancyConfig;
use crate::map::Rays;
use crate::radial::Quadrants;

/// Directions about a sensor; a quarter of a degree each, as finely as the paper's units look.
const DIRECTIONS: usize = 1440;
/// Steps after which a direction goes on as two lines: 128 cells out it is more than half a cell wide.
const FORK: usize = 128;
/// Nearest hit of a direction without.
const NONE: u16 = u16::MAX;

/// A return from the ground: its direction, and the steps from where its ray is under the clearance to the return.
struct Ground {
    direction: u16,
    steps: (u16, u16),
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

/// The part of a ray, by distance over the ground, that is at most `height` over or under the ground.
#[inline(always)]
fn within_height(origin_z: f32, climb: f32, height: f32) -> (f32, f32) {
    // Level rays give infinities of the right signs; `max` and `min` pass over NaN.
    let (a, b) = ((height - origin_z) / climb, (-height - origin_z) / climb);
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
            let climb = (z - oz) / range;
            let reliable = range <= config.range_m_max;
            let (from, to) = within_height(oz, climb, config.clear_height_m);
            self.set_low(direction, from * per_m, to.min(range).min(config.range_m_max) * per_m);
            if !reliable || z >= config.overhang_m {
                continue;
            }
            let step = (range * per_m) as usize;
            if z >= config.clearance_m {
                window.hit(px + x * turn_x - y * turn_y, py + x * turn_y + y * turn_x);
                self.nearest_hit[direction] = self.nearest_hit[direction].min(step.min(NONE as usize) as u16);
                if step < self.steps {
                    self.hits[direction * self.words + step / 64] |= 1 << (step % 64);
                }
            } else if step < self.steps {
                let (from, _) = within_height(oz, climb, config.clearance_m);
                let from = (from.min(range) * per_m) as u16;
                self.ground.push(Ground { direction: direction as u16, steps: (from, step as u16) });
            }
        }
    }

    fn take_no_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig) {
        let per_m = 1.0 / config.cell_m;
        let farthest = config.no_return_m.min(config.range_m_max);
        for &[dx, dy, dz] in rays.no_returns {
            let direction = self.directions.column(dx, dy) as usize;
            self.present[direction] = true;
            let (from, to) = within_height(rays.origin_m[2], dz / (dx * dx + dy * dy).sqrt(), config.clear_height_m);
            self.set_low(direction, from * per_m, to.min(farthest) * per_m);
        }
    }

    /// Sets the bits of the steps whose middles lie from one distance on, up to the step of the other (both in cells).
    #[inline(always)]
    fn set_low(&mut self, direction: usize, from: f32, to: f32) {
        // NaN and what lies behind the sensor become 0, what is beyond the row its end.
        let (first, end) = ((from + 0.5) as usize, if to > 0.0 { to as usize + 1 } else { 0 });
        let row = &mut self.low[direction * self.words..][..self.words];
        set_bits(row, first, end.min(self.steps));
    }

    /// Nearest hit of a direction and its neighbours.
    #[inline(always)]
    fn nearest(&self, direction: usize) -> usize {
        let [right, left] = neighbours(direction);
        usize::from(self.nearest_hit[direction].min(self.nearest_hit[right]).min(self.nearest_hit[left]))
    }

    /// What returns from the ground prove behind the nearest hit.
    fn prove_ground(&mut self) {
        for &Ground { direction, steps: (from, to) } in &self.ground {
            let (direction, from, to) = (usize::from(direction), usize::from(from), usize::from(to));
            if to <= self.nearest(direction) {
                continue;
            }
            let [right, left] = neighbours(direction);
            let stands = [right, direction, left]
                .into_iter()
                .any(|d| any_bit(&self.hits[d * self.words..][..self.words], from, to + 1));
            if !stands {
                set_bits(&mut self.proved[direction * self.words..][..self.words], from, to + 1);
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
        // What is hidden first: a cell that one direction sees and its neighbour does not has been seen.
        for hiding in [true, false] {
            for direction in (0..DIRECTIONS).filter(|direction| self.looks(*direction)) {
                let nearest = self.nearest(direction);
                let seen = if hiding { 0 } else { self.write_free(direction, nearest, &mut free) };
                for (line, &[x, y]) in self.lines[direction].iter().enumerate() {
                    let (trace, steps) = window.trace(from, [x * cos - y * sin, x * sin + y * cos]);
                    let steps = if line == 0 { 0..steps.min(reach).min(FORK) } else { FORK..steps.min(reach) };
                    if hiding {
                        window.hide(&trace, steps.start.max(nearest)..steps.end, rays.sensor);
                    } else {
                        let clear = |step: usize| free[step / 64] >> (step % 64) & 1 == 1;
                        window.look(&trace, steps.start..steps.end.min(seen), rays.sensor, clear);
                    }
                }
            }
        }
        window.speak();
    }

    /// Whether anything is known of a direction. Rays farther apart than a direction is wide leave every other empty.
    fn looks(&self, direction: usize) -> bool {
        let [right, left] = neighbours(direction);
        self.present[direction] || self.present[right] && self.present[left]
    }

    /// Writes one bit for each step a direction proves free; gives the first step from which on it sees nothing.
    fn write_free(&self, direction: usize, nearest: usize, free: &mut [u64]) -> usize {
        let [right, left] = neighbours(direction).map(|beside| beside * self.words);
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

#[inline(always)]
fn neighbours(direction: usize) -> [usize; 2] {
    let right = if direction == 0 { DIRECTIONS - 1 } else { direction - 1 };
    let left = if direction == DIRECTIONS - 1 { 0 } else { direction + 1 };
    [right, left]
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
