//! Which ground the vehicle can reach, found once for each map and shared by all layers.
//!
//! In: the sweep and its local ground. Out: [`Reach`]: by cell of 0.25 m to 64 m whether something closes it (an
//! obstacle, or a step of the ground), and whether the vehicle can get there. Ground behind a closed fence is as free
//! as the road, and joins it where the sensor sees between two slats, but no vehicle fits through there. So the flood
//! fill starts under the vehicle, and moves a disc of the vehicle's width over ground that was seen, or that lies in a
//! gap of seen ground that no obstacle hides; no closed cell may lie in the disc.
//!
//! | step | where |
//! |---|---|
//! | points -> cells with an obstacle | `obstacles` |
//! | points -> cells beside a step of the ground | `steps` |
//! | points -> cells in a trough of the ground | `troughs` |
//! | cells beside a step or in a trough -> those between two of them | `joins` |
//! | cells beside a step ahead and behind -> those between them, beside the vehicle | `blind_zone` |
//! | the nearest ground, high over the plane under the vehicle -> its cells, beside the vehicle | `blind_zone` |
//! | cells beside a step near the vehicle -> those on straight continuations of their line | `edges` |
//! | obstacles -> the ground that they hide | `shadow` |
//! | open and closed cells -> reached cells | `flood` |
//! | reached cells -> those without a detour over farther ground | `directions` |

mod bits;
mod blind_zone;
pub(crate) mod cells;
pub mod config;
mod directions;
mod edges;
mod flood;
mod joins;
mod obstacles;
mod polar_runs;
mod shadow;
mod steps;
mod troughs;

use crate::ground::Ground;
use crate::ground::polar::{CELLS, COLUMNS, PolarIndex, ROWS, beside};
use crate::ground::surface::Confidence;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;

use bits::Bits;
use blind_zone::BlindZone;
use cells::{CELL_M, SIDE};
use config::ReachConfig;
use directions::Directions;
use edges::Edges;
use flood::Flood;
use joins::Joins;
use obstacles::Obstacles;
use polar_runs::{PolarRuns, WORD};
use shadow::Shadow;
use steps::Steps;
use troughs::Troughs;

/// Number of points that are processed together. Ours: their cells fit into the first-level cache.
const CHUNK: usize = 1024;
/// Least height that an obstacle's returns span if it casts a shadow, metres. Ours: kerbs cast none; not tuned.
const SHADOW_HEIGHT_M_MIN: f32 = 0.5;

/// Greatest width of the strip under the vehicle that is open without a return, metres. Ours: narrower than a car.
const STRIP_M: f32 = 1.0;

/// Whether unseen ground of a polar cell counts as free of obstacles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum View {
    /// It does not: no ground was seen around it.
    Closed = 0,
    /// It does.
    Clear = 0b01,
    /// It does where no obstacle casts a shadow on it.
    BesideObstacle = 0b10,
    /// It does not, because an obstacle hides it.
    Hidden = 0b100,
}

/// Cell of [`Reach`] that contains a position; [`ReachCell::at`] finds it once for a fixed position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReachCell(u32);

impl ReachCell {
    /// The cell that contains a position, ego frame, metres.
    #[inline(always)]
    pub fn at(x: f32, y: f32) -> Self {
        Self(cells::cell(x, y))
    }

    /// Index of the cell; `None` beyond the grid.
    #[inline(always)]
    fn index(self) -> Option<usize> {
        (self.0 != cells::NOWHERE).then_some(self.0 as usize)
    }
}

/// What the reach stage knows of its cells: a bit each, 64 cells a word, the first cell in the lowest bit, row by row.
#[derive(Clone, Copy)]
pub(crate) struct ReachRows<'a> {
    /// The vehicle gets there: the disc covers the cell somewhere on its path.
    pub reached: &'a [u64],
    /// An obstacle stands there, or a step of the ground ends there.
    pub closed: &'a [u64],
    /// Ground that was seen, or that lies in a gap of seen ground which no obstacle hides.
    pub open: &'a [u64],
    /// Unseen ground behind or right beside an obstacle.
    pub hidden: &'a [u64],
}

/// Closed cells and reached ground around the vehicle, ego frame.
#[derive(Clone)]
pub struct Reach {
    config: ReachConfig,
    /// By cell: the polar cell of its centre.
    polar_of_cell: Vec<PolarIndex>,
    polar_runs: PolarRuns,
    /// Indices of the cells under the vehicle.
    under_vehicle: Vec<usize>,
    obstacles: Obstacles,
    steps: Steps,
    troughs: Troughs,
    shadow: Shadow,
    /// True by polar cell if an obstacle stands in it.
    has_obstacle: Vec<bool>,
    /// By polar cell.
    views: Vec<View>,
    open: Bits,
    /// The cells whose ground an obstacle hides.
    hidden: Bits,
    closed: Bits,
    joins: Joins,
    blind_zone: BlindZone,
    edges: Edges,
    /// Closed cells, those between two cells beside a step, and those on the continuation of an edge.
    barred: Bits,
    directions: Directions,
    flood: Flood,
}

impl Reach {
    /// A maker with validated parameters.
    pub fn new(config: &ReachConfig) -> Self {
        // A wider vehicle shall not be given more ground to move over.
        let outline = Outline { width_m: config.vehicle_width_m.min(STRIP_M), ..config.outline() };
        let centres_m = (0..SIDE * SIDE).map(|cell| (cell, cells::centre_m(cell)));
        let bits = Bits::square(SIDE);
        let polar_of_cell: Vec<_> = centres_m.clone().map(|(_, [x, y])| PolarIndex::at(x, y)).collect();
        Self {
            config: config.clone(),
            polar_runs: PolarRuns::new(&polar_of_cell),
            polar_of_cell,
            under_vehicle: centres_m.filter(|(_, [x, y])| outline.contains(*x, *y)).map(|(cell, _)| cell).collect(),
            obstacles: Obstacles::new(),
            steps: Steps::new(),
            troughs: Troughs::new(),
            shadow: Shadow::new((0..SIDE * SIDE).map(cells::centre_m)),
            has_obstacle: vec![false; CELLS],
            views: vec![View::Closed; CELLS],
            open: bits.clone(),
            hidden: bits.clone(),
            closed: bits.clone(),
            joins: Joins::new(),
            blind_zone: BlindZone::new(),
            edges: Edges::new(),
            barred: bits,
            directions: Directions::new(),
            flood: Flood::new(SIDE),
        }
    }

    /// The vehicle's outline, and what it cannot drive over or under.
    pub fn config(&self) -> &ReachConfig {
        &self.config
    }

    /// Finds closed cells and reached ground. `ground` is that of `sweep`.
    pub fn update(&mut self, sweep: &Sweep, ground: &Ground) {
        self.sort_points(sweep, ground.heights_m());
        self.closed.clear();
        let closed = &mut self.closed;
        self.steps.find(&self.config, |cell| closed.set(cell % SIDE, cell / SIDE));
        let steps = &self.steps;
        self.troughs.find(steps.seen(), |cell| steps.low_mm(cell), |ix, iy| closed.set(ix, iy));
        self.barred.copy_from(closed);
        let barred = &mut self.barred;
        self.joins.find(closed, &self.polar_of_cell, ground.confidences(), |ix, iy| barred.set(ix, iy));
        let obstacle_m = |cell| self.obstacles.height_m(cell);
        self.blind_zone.find(closed, obstacle_m, ground.confidences(), |ix, iy| barred.set(ix, iy));
        let plane = ground.near_plane();
        let over_plane_m = |[x, y]: [f32; 2]| ground.height_m(x, y) - plane.height_m(x, y);
        self.blind_zone.find_rises(over_plane_m, ground.confidences(), |ix, iy| barred.set(ix, iy));
        let ground_m =
            |cell| Some(steps.low_mm(cell)).filter(|low| *low != i16::MAX).map(|low| f32::from(low) / 1000.0);
        self.edges.find(closed, &self.obstacles, ground_m, |ix, iy| barred.set(ix, iy));
        for (cell, _) in self.obstacles.cells() {
            closed.set(cell % SIDE, cell / SIDE);
            barred.set(cell % SIDE, cell / SIDE);
        }
        self.open_seen_ground(sweep.mount_height_m, ground.confidences());
        // Radius, in cells, of the largest disc sure to fit through a passage of the vehicle's width.
        let radius = ((self.config.vehicle_width_m / CELL_M - 2.0) / 2.0).max(0.0) as usize;
        self.flood.run(&self.open, &self.barred, radius, self.directions.near());
        self.directions.close(&self.open, &mut self.flood);
    }

    /// Sorts the points into those of obstacles and those of the ground; the vehicle's own obstacles are left out.
    fn sort_points(&mut self, sweep: &Sweep, heights_m: &[f32]) {
        self.obstacles.clear();
        self.steps.clear();
        let ReachConfig { obstacle_m_min, overhang_m, .. } = self.config;
        let outline = self.config.outline();
        let mut cells = [cells::NOWHERE; CHUNK];
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(sweep.z.chunks(CHUNK));
        for (((xs, ys), zs), heights_m) in chunks.zip(heights_m.chunks(CHUNK)) {
            cells::find(xs, ys, &mut cells);
            for ((((&cell, &height), &x), &y), &z) in cells.iter().zip(heights_m).zip(xs).zip(ys).zip(zs) {
                if cell == cells::NOWHERE {
                    continue;
                }
                // NaN fails every comparison.
                if height < obstacle_m_min {
                    self.steps.add_point(cell, z, height);
                } else if height <= overhang_m && !outline.contains(x, y) {
                    self.obstacles.add_point(cell, height);
                }
            }
        }
    }

    /// True if an obstacle stands in a cell, or a step of the ground ends there.
    #[inline(always)]
    pub fn is_closed(&self, cell: ReachCell) -> bool {
        cell.index().is_some_and(|cell| self.closed.get(cell % SIDE, cell / SIDE))
    }

    /// True if the vehicle can get to a cell whose ground was seen, and no cell within half a metre of it is closed:
    /// the foot of a bank or of a bush looks like ground.
    pub fn is_open_ground(&self, cell: ReachCell) -> bool {
        let Some(cell) = cell.index().filter(|cell| self.steps.low_mm(*cell) != i16::MAX) else { return false };
        let (ix, iy) = (cell % SIDE, cell / SIDE);
        let near = |index: usize| index.saturating_sub(2)..(index + 3).min(SIDE);
        self.flood.is_reached(ix, iy) && !near(iy).any(|iy| near(ix).any(|ix| self.closed.get(ix, iy)))
    }

    /// True if the vehicle can get to a cell: if the disc covers it somewhere on its path.
    #[inline(always)]
    pub fn is_reached(&self, cell: ReachCell) -> bool {
        cell.index().is_some_and(|cell| self.flood.is_reached(cell % SIDE, cell / SIDE))
    }

    /// Closed cells and reached ground as rows of bits.
    pub(crate) fn rows(&self) -> ReachRows<'_> {
        ReachRows {
            reached: self.flood.reached(),
            closed: self.closed.words(),
            open: self.open.words(),
            hidden: self.hidden.words(),
        }
    }

    /// Opens the cells with a return from the ground, and the unseen ones between them. Unseen ground right behind an
    /// obstacle is not opened, nor is ground in a shadow beside an obstacle: they may hide the continuation of a fence.
    fn open_seen_ground(&mut self, sensor_m: f32, confidences: &[Confidence]) {
        self.shadow.clear();
        self.has_obstacle.fill(false);
        for (cell, span_m) in self.obstacles.cells() {
            if let Some(polar) = self.polar_of_cell[cell].index() {
                self.has_obstacle[polar] = true;
            }
            if span_m[1] - span_m[0] >= SHADOW_HEIGHT_M_MIN {
                self.shadow.cast(cell, CELL_M, span_m, sensor_m);
            }
        }
        self.classify_polar_cells(confidences);
        let (runs, shadow, views, hidden) = (&self.polar_runs, &self.shadow, &self.views, &mut self.hidden);
        self.open.fill_words(|cells| {
            let view_of = |polar: PolarIndex| polar.of(views).map_or(View::Closed as u8, |view| *view as u8);
            let [mut clear, mut beside, behind] = runs.bits(cells.start / WORD, view_of);
            hidden.set_word(cells.start / WORD, behind | beside);
            while beside != 0 {
                let bit = beside.trailing_zeros() as usize;
                clear |= u64::from(!shadow.hides(cells.start + bit)) << bit;
                beside &= beside - 1;
            }
            clear
        });
        self.hidden.remove(&self.open);
        self.open.add(self.steps.seen());
        for cell in &self.under_vehicle {
            self.open.set(cell % SIDE, cell / SIDE);
        }
    }

    /// Decides for each polar cell whether its unseen ground counts as free of obstacles.
    fn classify_polar_cells(&mut self, confidences: &[Confidence]) {
        for column in 0..COLUMNS {
            let mut is_hidden = false;
            for row in 0..ROWS {
                let cell = row * COLUMNS + column;
                is_hidden = self.has_obstacle[cell] || is_hidden && confidences[cell] != Confidence::Seen;
                self.views[cell] = match confidences[cell] {
                    Confidence::Bridged | Confidence::Extrapolated | Confidence::None if is_hidden => View::Hidden,
                    Confidence::Seen | Confidence::Bridged if self.is_beside_obstacle(row, column) => {
                        View::BesideObstacle
                    }
                    Confidence::Seen | Confidence::Bridged => View::Clear,
                    Confidence::Extrapolated | Confidence::None => View::Closed,
                };
            }
        }
    }

    fn is_beside_obstacle(&self, row: usize, column: usize) -> bool {
        let rows = row.saturating_sub(1)..(row + 2).min(ROWS);
        rows.flat_map(|row| [-1, 0, 1].map(|offset| row * COLUMNS + beside(column, offset)))
            .any(|cell| self.has_obstacle[cell])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cells_beside_an_obstacle_share_a_side_or_a_corner_with_it() {
        for (row, column) in [(0, 0), (1, 7), (20, COLUMNS - 1), (ROWS - 1, 100)] {
            let mut reach = Reach::new(&ReachConfig::default());
            reach.has_obstacle[row * COLUMNS + column] = true;
            let near = |a: usize, b: usize| a.abs_diff(b) <= 1;
            for cell in 0..ROWS * COLUMNS {
                let (other_row, other) = (cell / COLUMNS, cell % COLUMNS);
                let expected = near(row, other_row) && [0, 1, COLUMNS - 1].contains(&column.abs_diff(other));
                assert_eq!(reach.is_beside_obstacle(other_row, other), expected, "{row} {column}, {other_row} {other}");
            }
        }
    }
}
