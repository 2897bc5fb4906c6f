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

pub(crate) mod bits;
pub(crate) mod blind_zone;
pub(crate) mod cells;
pub mod config;
mod directions;
mod edges;
pub(crate) mod flood;
mod joins;
mod obstacles;
mod places;
mod points;
mod shadow;
mod steps;
mod troughs;

use std::sync::Arc;

use crate::ground::Ground;
use crate::ground::polar::{CELLS, COLUMNS, PolarIndex, mark_around};
use crate::ground::surface::Confidence;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;

use bits::Bits;
use blind_zone::BlindZone;
use cells::{CELL_M, SIDE};
use config::ReachConfig;
use edges::Edges;
use flood::Flood;
use joins::Joins;
use obstacles::Obstacles;
use places::{CellPlaces, PLACES, WORD};
use shadow::Shadow;
use steps::Steps;
use troughs::Troughs;

/// Half the width of a shadow that is open, in cells. Ours: half a metre to each side.
const CLOSING: usize = 2;
/// Greatest width of the strip under the vehicle that is open without a return, metres. Ours: narrower than a car.
const STRIP_M: f32 = 1.0;

/// Whether unseen ground of a polar cell counts as free of obstacles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum View {
    /// It does not: no ground was seen around it.
    Closed,
    /// It does.
    Clear,
    /// It does where no obstacle casts a shadow on it.
    BesideObstacle,
    /// It does not, because an obstacle hides it: where no ground is known, and in a gap of seen ground.
    Hidden,
    HiddenGap,
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

/// What the reach stage knows of its cells, a bit each.
#[derive(Clone, Copy)]
pub(crate) struct ReachBits<'a> {
    /// An obstacle stands there, or a step of the ground ends there.
    pub closed: &'a Bits,
    /// Ground that was seen, or that lies in a gap of seen ground which no obstacle hides.
    pub open: &'a Bits,
    /// Unseen ground behind or right beside an obstacle.
    pub hidden: &'a Bits,
    /// The cells in a trough of the ground.
    pub in_trough: &'a Bits,
    /// The cells with a return from the ground.
    pub seen: &'a Bits,
}

/// Closed cells and reached ground around the vehicle, ego frame.
#[derive(Clone)]
pub struct Reach {
    config: ReachConfig,
    places: &'static CellPlaces,
    /// Indices of the cells under the vehicle.
    under_vehicle: Vec<usize>,
    obstacles: Obstacles,
    steps: Steps,
    /// The cells with a return from the ground in the newest map itself, not in its memory.
    seen_now: Bits,
    troughs: Troughs,
    shadow: Shadow,
    /// True by polar cell if an obstacle stands in it; in it or in one of the eight around it.
    has_obstacle: Vec<bool>,
    beside_obstacle: Vec<bool>,
    /// By polar cell.
    views: Vec<View>,
    open: Bits,
    /// The cells whose ground an obstacle hides.
    hidden: Bits,
    /// The cells of `hidden` that lie in a gap of seen ground.
    hidden_gaps: Bits,
    closed: Bits,
    /// The closed cells beside a step of the ground, and those in a trough.
    stepped: Bits,
    in_trough: Bits,
    /// Buffers of the closing of open ground.
    dilated: Bits,
    outside: Bits,
    wide: Vec<u64>,
    joins: Joins,
    blind_zone: BlindZone,
    edges: Edges,
    /// Closed cells, those between two cells beside a step, and those on the continuation of an edge.
    barred: Bits,
    flood: Flood,
    /// The cells with a closed one among the 5 x 5 cells around each.
    near_closed: Bits,
}

impl Reach {
    /// A maker with validated parameters.
    pub fn new(config: &ReachConfig) -> Self {
        // A wider vehicle shall not be given more ground to move over.
        let outline = Outline { width_m: config.vehicle_width_m.min(STRIP_M), ..config.outline() };
        let centres_m = (0..SIDE * SIDE).map(|cell| (cell, cells::centre_m(cell)));
        let bits = Bits::square(SIDE);
        Self {
            config: config.clone(),
            places: &PLACES,
            under_vehicle: centres_m.filter(|(_, [x, y])| outline.contains(*x, *y)).map(|(cell, _)| cell).collect(),
            obstacles: Obstacles::new(),
            steps: Steps::new(),
            seen_now: bits.clone(),
            troughs: Troughs::new(),
            shadow: Shadow::new(Arc::clone(&PLACES.of_shadows)),
            has_obstacle: vec![false; CELLS],
            beside_obstacle: vec![false; CELLS],
            views: vec![View::Closed; CELLS],
            open: bits.clone(),
            hidden: bits.clone(),
            hidden_gaps: bits.clone(),
            closed: bits.clone(),
            stepped: bits.clone(),
            in_trough: bits.clone(),
            dilated: bits.clone(),
            outside: bits.clone(),
            wide: Vec::new(),
            joins: Joins::new(),
            blind_zone: BlindZone::new(),
            edges: Edges::new(),
            barred: bits.clone(),
            flood: Flood::new(SIDE),
            near_closed: bits,
        }
    }

    /// The vehicle's outline, and what it cannot drive over or under.
    pub fn config(&self) -> &ReachConfig {
        &self.config
    }

    /// Finds closed cells and open ground. `ground` was estimated from `sweep`. What the vehicle reaches is old until
    /// [`Self::flood`].
    pub fn update(&mut self, sweep: &Sweep, ground: &Ground) {
        let own = sweep.x.len() - sweep.remembered;
        self.obstacles.clear();
        self.steps.clear();
        points::sort(sweep, ground.heights_m(), 0..own, &self.config, (&mut self.steps, &mut self.obstacles));
        self.seen_now.copy_from(self.steps.seen());
        points::sort(
            sweep,
            ground.heights_m(),
            own..sweep.x.len(),
            &self.config,
            (&mut self.steps, &mut self.obstacles),
        );
        self.closed.clear();
        let closed = &mut self.closed;
        let stepped = &mut self.stepped;
        stepped.clear();
        self.steps.find(self.config.step_m_max, SIDE / 2, |higher, lower| {
            stepped.set(higher % SIDE, higher / SIDE);
            stepped.set(lower % SIDE, lower / SIDE);
        });
        let (steps, in_trough) = (&self.steps, &mut self.in_trough);
        in_trough.clear();
        self.troughs.find(steps.seen(), |cell| steps.low_mm(cell), |ix, iy| in_trough.set(ix, iy));
        closed.add(stepped);
        closed.add(in_trough);
        self.barred.copy_from(closed);
        let barred = &mut self.barred;
        self.joins.find(closed, &self.places.polar_of_cell, ground.confidences(), |ix, iy| barred.set(ix, iy));
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
    }

    /// Finds the ground that the vehicle reaches.
    pub fn flood(&mut self) {
        self.dilated.grow(&self.closed, &mut self.wide);
        self.near_closed.grow(&self.dilated, &mut self.wide);
        let radius = self.disc_radius();
        self.flood.run(&self.open, &self.barred, radius, self.places.directions.near());
        self.places.directions.close(&self.open, &mut self.flood);
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
        self.flood.is_reached(ix, iy) && !self.near_closed.get(ix, iy)
    }

    /// True if the vehicle can get to a cell: if the disc covers it somewhere on its path.
    #[inline(always)]
    pub fn is_reached(&self, cell: ReachCell) -> bool {
        cell.index().is_some_and(|cell| self.flood.is_reached(cell % SIDE, cell / SIDE))
    }

    /// The cells with a return from the ground in the newest map itself, not in its memory.
    pub(crate) fn seen_now(&self) -> &Bits {
        &self.seen_now
    }

    /// Closed cells and reached ground as bits.
    pub(crate) fn bits(&self) -> ReachBits<'_> {
        ReachBits {
            closed: &self.closed,
            open: &self.open,
            hidden: &self.hidden,
            in_trough: &self.in_trough,
            seen: self.steps.seen(),
        }
    }

    /// The cells that are neither open nor filled by a closing of the open cells.
    pub(crate) fn outside(&self) -> &Bits {
        &self.outside
    }

    /// By cell: lowest and highest return from the ground, millimetres, ego frame; the lowest is the larger number
    /// without one.
    pub(crate) fn ground_spans_mm(&self) -> &[[i16; 2]] {
        self.steps.spans_mm()
    }

    /// Calls `mark` with the higher cell of each step of the ground of at least this height, up to `near` cells from
    /// the middle.
    pub(crate) fn each_step(&self, least_m: f32, near: usize, mut mark: impl FnMut(usize)) {
        self.steps.find(least_m, near, |higher, _| mark(higher));
    }

    /// Writes the closed cells that only a step closes.
    pub(crate) fn only_stepped(&self, cells: &mut Bits) {
        cells.copy_from(&self.stepped);
        cells.remove(&self.in_trough);
        self.obstacles.cells().for_each(|(cell, _)| cells.clear_cell(cell % SIDE, cell / SIDE));
    }

    /// What is too high to drive over and too low to drive under.
    pub(crate) fn obstacles(&self) -> &Obstacles {
        &self.obstacles
    }

    /// By polar cell: true if an obstacle stands in it.
    pub(crate) fn has_obstacle(&self) -> &[bool] {
        &self.has_obstacle
    }

    /// The polar cell of a cell's centre.
    pub(crate) fn polar(&self, cell: usize) -> PolarIndex {
        self.places.polar_of_cell[cell]
    }

    /// Sets the bits of the cells whose polar cell has the value 1, not 0, and clears the others.
    pub(crate) fn copy_polar(&self, value_of: impl Fn(PolarIndex) -> u8 + Copy, cells: &mut Bits) {
        cells.fill_words(|of_word| self.places.polar_runs.bits::<2>(of_word.start / WORD, value_of)[1]);
    }

    /// Floods the ground again with more barred cells; `flood` and `barred` are the caller's.
    pub(crate) fn flood_with(&self, barriers: [&Bits; 2], barred: &mut Bits, flood: &mut Flood) {
        barred.copy_from(&self.barred);
        barriers.into_iter().for_each(|barrier| barred.add(barrier));
        flood.run(&self.open, barred, self.disc_radius(), self.places.directions.near());
        self.places.directions.close(&self.open, flood);
    }

    /// Radius, in cells, of the largest disc sure to fit through a passage of the vehicle's width.
    fn disc_radius(&self) -> usize {
        ((self.config.vehicle_width_m / CELL_M - 2.0) / 2.0).max(0.0) as usize
    }

    /// Opens the cells with a return from the ground, and the unseen ones between them. Unseen ground right behind an
    /// obstacle is not opened, nor is ground in a shadow beside an obstacle: they may hide the continuation of a fence.
    fn open_seen_ground(&mut self, sensor_m: f32, confidences: &[Confidence]) {
        self.shadow.clear();
        self.has_obstacle.fill(false);
        for (cell, span_m) in self.obstacles.cells() {
            if let Some(polar) = self.places.polar_of_cell[cell].index() {
                self.has_obstacle[polar] = true;
            }
            self.shadow.cast(cells::centre_m(cell), CELL_M, span_m, sensor_m);
        }
        self.classify_polar_cells(confidences);
        self.assume_near_ground(confidences);
        let (runs, shadow, views) = (&self.places.polar_runs, &self.shadow, &self.views);
        let (hidden, gaps, seen) = (&mut self.hidden, &mut self.hidden_gaps, self.steps.seen().words());
        self.open.fill_words(|cells| {
            let view_of = |polar: PolarIndex| polar.of(views).map_or(View::Closed as u8, |view| *view as u8);
            let [_, mut clear, mut beside, behind, gap] = runs.bits(cells.start / WORD, view_of);
            hidden.set_word(cells.start / WORD, behind | gap | beside);
            gaps.set_word(cells.start / WORD, gap | beside);
            // Ground that was seen is open all the same.
            beside &= !seen[cells.start / WORD];
            while beside != 0 {
                let bit = beside.trailing_zeros() as usize;
                clear |= u64::from(!shadow.hides(cells.start + bit)) << bit;
                beside &= beside - 1;
            }
            clear
        });
        self.open.add(self.steps.seen());
        self.open_thin_shadows();
        self.hidden.remove(&self.open);
        for cell in &self.under_vehicle {
            self.open.set(cell % SIDE, cell / SIDE);
        }
    }

    /// Opens the hidden cells in gaps of seen ground that a closing of the open cells fills: the thin shadows of trunks
    /// and bushes, which would cut the way of the disc's middle. Near ground alone: [`directions::Directions::near`].
    fn open_thin_shadows(&mut self) {
        let Self { open, hidden_gaps, dilated, outside, wide, places, .. } = self;
        dilated.clear();
        dilated.dilate(open, CLOSING, wide);
        dilated.invert();
        outside.clear();
        outside.dilate(dilated, CLOSING, wide);
        hidden_gaps.remove(outside);
        // Farther away a fence returns nothing between its posts, and shadows would lead on behind it.
        places.directions.near().last().into_iter().for_each(|near| hidden_gaps.keep(near));
        open.add(hidden_gaps);
    }

    /// Decides for each polar cell whether its unseen ground counts as free of obstacles.
    fn classify_polar_cells(&mut self, confidences: &[Confidence]) {
        mark_around(&self.has_obstacle, &mut self.beside_obstacle);
        // An obstacle may hide a part of all ground behind it in its column.
        let (mut are_hidden, mut are_behind) = ([false; COLUMNS], [false; COLUMNS]);
        for cell in 0..CELLS {
            let (is_hidden, is_behind) = (&mut are_hidden[cell % COLUMNS], &mut are_behind[cell % COLUMNS]);
            *is_hidden = self.has_obstacle[cell] | *is_hidden & (confidences[cell] != Confidence::Seen);
            *is_behind |= self.has_obstacle[cell];
            self.views[cell] = match confidences[cell] {
                Confidence::Bridged if *is_hidden => View::HiddenGap,
                Confidence::Extrapolated | Confidence::None if *is_hidden => View::Hidden,
                Confidence::Seen | Confidence::Bridged if *is_behind | self.beside_obstacle[cell] => {
                    View::BesideObstacle
                }
                Confidence::Seen | Confidence::Bridged => View::Clear,
                Confidence::Extrapolated | Confidence::None => View::Closed,
            };
        }
    }

    /// Opens the ground before the first ground that was seen in each direction, if the configuration allows it so far.
    fn assume_near_ground(&mut self, confidences: &[Confidence]) {
        let rows =
            self.places.row_middles_m.iter().take_while(|range_m| **range_m <= self.config.assumed_ground_m).count();
        for column in 0..COLUMNS {
            let first = (0..rows).find(|row| {
                let cell = row * COLUMNS + column;
                self.has_obstacle[cell] || confidences[cell] == Confidence::Seen
            });
            let Some(seen) = first.filter(|row| !self.has_obstacle[row * COLUMNS + column]) else { continue };
            for row in 0..seen {
                let cell = row * COLUMNS + column;
                self.views[cell] = if self.beside_obstacle[cell] { View::BesideObstacle } else { View::Clear };
            }
        }
    }
}
