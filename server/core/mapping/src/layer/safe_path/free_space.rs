//! Free space: which cells of a Cartesian grid about the vehicle are free.
//!
//! In: the layers `drivability`, radial, and `occupancy`, the sweep, and what the vehicle can reach. Out: a [`State`]
//! for each cell: the state of the radial cell in which the cell's centre lies, unless an obstacle stands in the cell
//! or the vehicle cannot reach it. Rows of the radial grid are metres long far away: where the radial cell is unknown
//! or an obstacle, a cell that the vehicle reaches is free if its own ground was seen apart from what is closed; safe
//! points keep away from it. A radial cell with returns only from the vehicle's own outline (its bonnet) is unknown.
//! Unseen ground is not free, with two exceptions:
//! - The blind zone: if the innermost seen cell of a column is drivable and begins within the zone, the ground nearer
//!   to the vehicle, which no laser reaches, is assumed to be free too, as the UT Austin thesis assumes when segments
//!   grow from the vehicle (section IV.3).
//! - Narrow holes in drivable ground: a cell or two in which a return was lost.
//!
//! Cells of the two exceptions are not called drivable, and no safe point lies in them. They are only no obstacles.

use crate::layer::channel::TypedChannel;
use crate::layer::drivability::class::DrivabilityClass;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer};
use crate::layer::occupancy::class::OccupancyClass;
use crate::layer::radial_grid::{RadialGrid, near_edge_of};
use crate::reach::ReachCell;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;

use super::config::{BLIND_ZONE_M, HOLE_M_MAX};

/// State of a cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// Not seen.
    #[default]
    Unknown,
    /// The vehicle can get there.
    Drivable,
    /// Something stands in the cell, or it is no ground.
    Obstacle,
    /// Free ground that the vehicle does not reach.
    NotReached,
    /// Ground that was seen and is reached, in a radial cell that is unknown or an obstacle. Safe points keep away from
    /// it, as from unseen ground.
    Apart,
    /// Not seen, in the blind zone before drivable ground.
    Blind,
    /// Not seen, between drivable or blind cells of one ring or one azimuth.
    Hole,
}

impl State {
    /// True if the vehicle may drive over the cell.
    pub fn is_free(self) -> bool {
        matches!(self, Self::Drivable | Self::Blind | Self::Hole)
    }
}

/// Which returns a radial cell has.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Returns {
    /// From within the vehicle's outline.
    own: bool,
    /// From outside it.
    other: bool,
}

/// States of a grid of `side` cells along x and y with the vehicle in the middle: index = iy * side + ix.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeSpace {
    side: usize,
    cell_m: f64,
    states: Vec<State>,
    /// By cell: the cell of the reach stage that contains its centre.
    reach_cell: Vec<ReachCell>,
    of_radial_cell: Vec<State>,
    grid: RadialGrid,
    /// By radial cell near the vehicle's outline.
    returns: Vec<Returns>,
    /// Radial cell of each cell's centre; one past the last if the centre lies beyond the radial grid.
    radial_cell: Vec<u32>,
    /// Range within which ground begins that the blind zone lies before, metres.
    blind_zone_m: f32,
    /// The radial grid for which `radial_cell` was computed.
    made_for: Option<Geometry>,
}

impl FreeSpace {
    /// A grid of unknown cells.
    pub fn new(side: usize, cell_m: f64) -> Self {
        let at = |index| ReachCell::at(centre_m(index % side, side, cell_m), centre_m(index / side, side, cell_m));
        Self {
            side,
            cell_m,
            states: vec![State::Unknown; side * side],
            reach_cell: (0..side * side).map(at).collect(),
            of_radial_cell: Vec::new(),
            grid: RadialGrid::default(),
            returns: Vec::new(),
            radial_cell: Vec::new(),
            blind_zone_m: BLIND_ZONE_M,
            made_for: None,
        }
    }

    /// Number of cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// States by cell.
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Computes the states from a map's layers `drivability` and `occupancy` and from what the vehicle can reach;
    /// without `drivability` all cells are unknown.
    pub fn update(&mut self, sweep: &Sweep, context: &Context<'_>, outline: &Outline) {
        let layer = |name| context.earlier.iter().find(move |layer| layer.name == name);
        self.project(layer("drivability"), sweep, outline);
        self.add_obstacles(context);
        self.add_occupied_cells(layer("occupancy"));
        self.free_outline(outline);
    }

    /// Gives each cell the state of its radial cell.
    fn project(&mut self, drivability: Option<&Layer>, sweep: &Sweep, outline: &Outline) {
        let class = drivability.and_then(|layer| TypedChannel::CLASS.values(&layer.channels));
        let (Some(layer), Some(class)) = (drivability, class) else { return self.states.fill(State::Unknown) };
        let Geometry::Radial { centre_m, row_radius_m, columns } = &layer.geometry else {
            return self.states.fill(State::Unknown);
        };
        if self.made_for.as_ref() != Some(&layer.geometry) {
            self.find_radial_cells(*centre_m, row_radius_m, *columns);
            self.blind_zone_m = BLIND_ZONE_M.max(near_edge_of(sweep));
            self.made_for = Some(layer.geometry.clone());
        }
        self.of_radial_cell.clear();
        const UNKNOWN: u8 = DrivabilityClass::Unknown.value();
        const DRIVABLE: u8 = DrivabilityClass::Drivable.value();
        const NOT_DRIVABLE: u8 = DrivabilityClass::NotDrivable.value();
        self.of_radial_cell.extend(class.iter().map(|&class| match class {
            UNKNOWN => State::Unknown,
            DRIVABLE => State::Drivable,
            NOT_DRIVABLE => State::NotReached,
            _ => State::Obstacle,
        }));
        self.remove_own_returns(sweep, outline);
        let columns = usize::from(*columns);
        mark_blind_zone(&mut self.of_radial_cell, row_radius_m, columns, self.blind_zone_m);
        mark_holes(&mut self.of_radial_cell, row_radius_m, columns, HOLE_M_MAX);
        // State of the cells beyond the radial grid.
        self.of_radial_cell.push(State::Unknown);
        for (state, &cell) in self.states.iter_mut().zip(&self.radial_cell) {
            *state = self.of_radial_cell[cell as usize];
        }
    }

    /// Closes the cells in which an obstacle stands, and the cells that the vehicle cannot reach.
    fn add_obstacles(&mut self, context: &Context<'_>) {
        let Some(reach) = context.reach else { return };
        for (state, &cell) in self.states.iter_mut().zip(&self.reach_cell) {
            *state = match *state {
                _ if reach.is_closed(cell) => State::Obstacle,
                State::Obstacle | State::Unknown if reach.is_open_ground(cell) => State::Apart,
                // The obstacle stands in another part of the radial cell.
                State::Obstacle => State::Unknown,
                free if free.is_free() && !reach.is_reached(cell) => State::NotReached,
                unchanged => unchanged,
            };
        }
    }

    /// Closes the cells that contain the centre of a cell that the layer `occupancy` calls occupied.
    fn add_occupied_cells(&mut self, occupancy: Option<&Layer>) {
        let class = occupancy.and_then(|layer| TypedChannel::CLASS.values(&layer.channels));
        let (Some(layer), Some(class)) = (occupancy, class) else { return };
        let Geometry::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } = layer.geometry else { return };
        let (sin, cos) = libm::sincos(yaw_rad);
        let occupied = (0..class.len()).filter(|cell| class[*cell] == OccupancyClass::Occupied.value());
        for cell in occupied {
            let (ix, iy) = (cell % width as usize, cell / width as usize);
            let (u, v) = (
                origin_x_m + (ix as f64 + 0.5) * f64::from(cell_m),
                origin_y_m + (iy as f64 + 0.5) * f64::from(cell_m),
            );
            let index = |metres: f64| (metres / self.cell_m + self.side as f64 / 2.0).floor();
            let (x, y) = (index(u * cos + v * sin), index(v * cos - u * sin));
            if (0.0..self.side as f64).contains(&x) && (0.0..self.side as f64).contains(&y) {
                self.states[y as usize * self.side + x as usize] = State::Obstacle;
            }
        }
    }

    /// Coordinate of the centre of a cell, metres.
    fn centre_m(&self, index: usize) -> f32 {
        centre_m(index, self.side, self.cell_m)
    }

    /// Makes radial cells unknown that have returns only from the vehicle itself.
    fn remove_own_returns(&mut self, sweep: &Sweep, outline: &Outline) {
        let corner_m = libm::hypotf(outline.front_m.max(outline.rear_m), outline.width_m / 2.0);
        // Rows up to the end of the last row that touches the outline.
        let rows = (0..self.grid.rows()).take_while(|row| self.grid.row_span_m(*row).0 < corner_m).count();
        let reach_m = rows.checked_sub(1).map_or(0.0, |last| self.grid.row_span_m(last).1);
        self.returns.clear();
        self.returns.resize(rows * self.grid.columns(), Returns::default());
        for (&x, &y) in sweep.x.iter().zip(&sweep.y).filter(|(x, y)| **x * **x + **y * **y <= reach_m * reach_m) {
            if let Some(returns) = self.grid.cell(x, y).and_then(|cell| self.returns.get_mut(cell)) {
                let own = outline.contains(x, y);
                (returns.own, returns.other) = (returns.own | own, returns.other | !own);
            }
        }
        for (state, returns) in self.of_radial_cell.iter_mut().zip(&self.returns) {
            if returns.own && !returns.other {
                *state = State::Unknown;
            }
        }
    }

    /// Makes the cells under the vehicle free: nothing else can stand there.
    fn free_outline(&mut self, outline: &Outline) {
        let longest_m = outline.front_m.max(outline.rear_m).max(outline.width_m);
        let reach = (f64::from(longest_m) / self.cell_m).ceil() as usize;
        let near = (self.side / 2).saturating_sub(reach)..(self.side / 2 + reach).min(self.side);
        for iy in near.clone() {
            for ix in near.clone() {
                let is_within = outline.contains(self.centre_m(ix), self.centre_m(iy));
                let state = &mut self.states[iy * self.side + ix];
                if is_within && !state.is_free() {
                    *state = State::Blind;
                }
            }
        }
    }

    /// Computes the radial cell of each cell.
    fn find_radial_cells(&mut self, centre_m: [f32; 2], row_radius_m: &[f32], columns: u16) {
        self.grid = RadialGrid::new(centre_m, row_radius_m.to_vec(), columns);
        let cell = |index: usize| self.grid.cell(self.centre_m(index % self.side), self.centre_m(index / self.side));
        let cells = 0..self.side * self.side;
        self.radial_cell = cells.map(|index| cell(index).unwrap_or(self.grid.cells()) as u32).collect();
    }
}

/// Coordinate of the centre of a cell of a grid with the vehicle in the middle, metres.
fn centre_m(index: usize, side: usize, cell_m: f64) -> f32 {
    ((index as f64 + 0.5 - side as f64 / 2.0) * cell_m) as f32
}

/// Marks unseen cells nearer to the vehicle than drivable ground that begins within the blind zone.
fn mark_blind_zone(of_radial_cell: &mut [State], row_radius_m: &[f32], columns: usize, blind_zone_m: f32) {
    for column in 0..columns {
        let seen = (0..row_radius_m.len()).find(|row| of_radial_cell[row * columns + column] != State::Unknown);
        let Some(seen) = seen else { continue };
        let begins_m = if seen == 0 { 0.0 } else { row_radius_m[seen - 1] };
        if begins_m <= blind_zone_m && of_radial_cell[seen * columns + column] == State::Drivable {
            (0..seen).for_each(|row| of_radial_cell[row * columns + column] = State::Blind);
        }
    }
}

/// Marks narrow holes along rings and along azimuths.
fn mark_holes(of_radial_cell: &mut [State], row_radius_m: &[f32], columns: usize, hole_m_max: f32) {
    let rows = row_radius_m.len();
    for (row, &r) in row_radius_m.iter().enumerate() {
        let column_m = r * std::f32::consts::TAU / columns as f32;
        let ring = &mut of_radial_cell[row * columns..][..columns];
        let Some(first) = ring.iter().position(|state| state.is_free()) else { continue };
        // The walk goes once around the ring, from one free cell to itself.
        let around = |i: usize| if first + i < columns { first + i } else { first + i - columns };
        let width_m = |from: usize, to: usize| (to - from - 1) as f32 * column_m;
        mark_along(columns + 1, around, |from, to| width_m(from, to) <= hole_m_max, ring);
    }
    for column in 0..columns {
        let width_m = |from: usize, to: usize| row_radius_m[to - 1] - row_radius_m[from];
        mark_along(rows, |row| row * columns + column, |from, to| width_m(from, to) <= hole_m_max, of_radial_cell);
    }
}

/// Marks unseen cells between free ones along a line of `length` cells, if the hole is narrow enough.
fn mark_along(
    length: usize,
    cell: impl Fn(usize) -> usize,
    is_narrow: impl Fn(usize, usize) -> bool,
    states: &mut [State],
) {
    let mut last_free = None;
    for i in 0..length {
        match states[cell(i)] {
            State::Unknown | State::Hole => continue,
            State::Drivable | State::Blind => {
                if let Some(before) = last_free
                    && i - before > 1
                    && is_narrow(before, i)
                {
                    (before + 1..i).for_each(|hole| states[cell(hole)] = State::Hole);
                }
                last_free = Some(i);
            }
            State::Obstacle | State::NotReached | State::Apart => last_free = None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::Ground;
    use crate::reach::Reach;
    use crate::reach::config::ReachConfig;

    #[test]
    fn a_hole_is_closed_exactly_if_it_is_as_narrow_as_configured() {
        const COLUMNS: usize = 360;
        let row_radius_m: Vec<f32> = (1..=40).map(|row| row as f32 * 0.5).collect();
        let marked = |hole: &[usize], hole_m_max: f32| {
            let mut states = vec![State::Drivable; 40 * COLUMNS];
            hole.iter().for_each(|cell| states[*cell] = State::Unknown);
            mark_holes(&mut states, &row_radius_m, COLUMNS, hole_m_max);
            states.iter().filter(|state| **state == State::Hole).count()
        };
        for wide in 1..12 {
            // Across the first column of the last row, where only its ring can close it; and in whole rows, where only
            // the columns can.
            let ring: Vec<usize> = (0..wide).map(|k| 39 * COLUMNS + (COLUMNS - 2 + k) % COLUMNS).collect();
            let along: Vec<usize> = (0..wide).flat_map(|k| (0..COLUMNS).map(move |c| (20 + k) * COLUMNS + c)).collect();
            let widths_m = [wide as f32 * 20.0 * std::f32::consts::TAU / COLUMNS as f32, wide as f32 * 0.5];
            for (hole, width_m) in [ring, along].iter().zip(widths_m) {
                assert_eq!(marked(hole, width_m * 1.01), hole.len(), "{width_m} m");
                assert_eq!(marked(hole, width_m * 0.99), 0, "{width_m} m");
            }
        }
    }

    #[test]
    fn ground_with_a_return_is_free_though_an_obstacle_stands_elsewhere_in_its_radial_cell() {
        let config = ReachConfig::default();
        let (mut ground, mut reach) = (Ground::new(config.outline()), Reach::new(&config));
        let mut sweep = Sweep { mount_height_m: 1.9, ..Sweep::default() };
        // A return in the middle of each cell, but in a strip; a pole at (10, 5).
        let middles = (0..160).map(|index| centre_m(index, 160, 0.25));
        let is_unseen = |x: f32| (6.0..6.5).contains(&x);
        for (x, y) in middles.clone().flat_map(|x| middles.clone().map(move |y| (x, y))).filter(|(x, _)| !is_unseen(*x))
        {
            for z in [0.0, 0.6, 1.2].into_iter().take(if (x - 10.1).abs() + (y - 5.1).abs() < 0.1 { 3 } else { 1 }) {
                sweep.x.push(x);
                sweep.y.push(y);
                sweep.z.push(z);
            }
        }
        ground.estimate(&sweep);
        reach.update(&sweep, &ground);
        reach.flood();
        let mut space = FreeSpace::new(160, 0.25);
        space.states.fill(State::Obstacle);
        space.add_obstacles(&Context { reach: Some(&reach), ..Context::default() });
        let state = |x: f32, y: f32| space.states[(y * 4.0 + 80.0) as usize * 160 + (x * 4.0 + 80.0) as usize];
        assert_eq!(state(10.1, 5.1), State::Obstacle, "the pole");
        assert_eq!([state(10.6, 5.1), state(9.6, 4.6)], [State::Unknown; 2], "beside the pole");
        assert_eq!([state(10.9, 5.1), state(9.1, 4.4)], [State::Apart; 2], "three cells from the pole");
        assert_eq!(state(6.1, 5.1), State::Unknown, "no return");
    }
}
