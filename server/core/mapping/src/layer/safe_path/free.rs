//! Which cells of a Cartesian grid about the vehicle are free.
//!
//! In: the layer `drivability`, radial, and the sweep it was made from. Out: a [`State`] a cell, that of the radial
//! cell its middle lies in. A radial cell that holds nothing but returns of the vehicle's own outline (its bonnet) says
//! nothing. Ground nobody saw is not free, but for the blind zone: in a column whose innermost seen cell is drivable
//! and begins within it, the ground nearer to the vehicle, which no laser meets, is taken to be like it, as the thesis
//! does when segments grow from the vehicle (§IV.3); and for holes in drivable ground too narrow to matter, a cell or
//! two where a laser's return was lost. Neither is called drivable, and no safe point lies in one: they only are no
//! obstacles.

use crate::layer::safe_path::config::SafePathConfig;
use crate::layer::channel::TypedChannel;
use crate::layer::drivability::class::DrivabilityClass;
use crate::layer::grid::Geometry;
use crate::layer::maker::Layer;
use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

/// What a cell is to the vehicle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// Not seen.
    #[default]
    Unknown,
    /// The vehicle gets there.
    Drivable,
    /// Seen, and not drivable.
    Obstacle,
    /// Too near to the vehicle to be seen, before drivable ground.
    Blind,
    /// Not seen, between drivable or blind cells of one ring or one azimuth.
    Hole,
}

impl State {
    /// Whether the vehicle may pass.
    pub fn is_free(self) -> bool {
        matches!(self, Self::Drivable | Self::Blind | Self::Hole)
    }
}

/// What the points of a radial cell are.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Returns {
    own: bool,
    other: bool,
}

/// States row by row, `side` cells along x and y; the vehicle stands in the middle.
#[derive(Clone, Debug, PartialEq)]
pub struct Free {
    side: usize,
    cell_m: f64,
    states: Vec<State>,
    of_radial_cell: Vec<State>,
    grid: RadialGrid,
    /// By radial cell in reach of the vehicle's outline: what its points are.
    returns: Vec<Returns>,
    /// Radial cell of each cell's middle; past the last where the radial grid does not reach.
    radial_cell: Vec<u32>,
    /// What `radial_cell` was made for.
    made_for: Option<Geometry>,
}

impl Free {
    /// A grid of which nothing is known.
    pub fn new(side: usize, cell_m: f64) -> Self {
        Self {
            side,
            cell_m,
            states: vec![State::Unknown; side * side],
            of_radial_cell: Vec::new(),
            grid: RadialGrid::default(),
            returns: Vec::new(),
            radial_cell: Vec::new(),
            made_for: None,
        }
    }

    /// Cells along x, and along y.
    pub fn side(&self) -> usize {
        self.side
    }

    /// By cell.
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Takes the newest drivability, in place of the one before; without it nothing is known.
    pub fn fill(&mut self, drivability: Option<&Layer>, sweep: &Sweep, config: &SafePathConfig) {
        let class = drivability.and_then(|layer| TypedChannel::CLASS.values(&layer.channels));
        let (Some(layer), Some(class)) = (drivability, class) else { return self.states.fill(State::Unknown) };
        let Geometry::Radial { row_radius_m, columns } = &layer.geometry else {
            return self.states.fill(State::Unknown);
        };
        if self.made_for.as_ref() != Some(&layer.geometry) {
            self.look_up(row_radius_m, *columns);
            self.made_for = Some(layer.geometry.clone());
        }
        self.of_radial_cell.clear();
        const UNKNOWN: u8 = DrivabilityClass::Unknown.value();
        const DRIVABLE: u8 = DrivabilityClass::Drivable.value();
        self.of_radial_cell.extend(class.iter().map(|&class| match class {
            UNKNOWN => State::Unknown,
            DRIVABLE => State::Drivable,
            _ => State::Obstacle,
        }));
        self.forget_the_vehicle(sweep, config);
        let columns = usize::from(*columns);
        see_blind_zone(&mut self.of_radial_cell, row_radius_m, columns, config.blind_zone_m);
        close_holes(&mut self.of_radial_cell, row_radius_m, columns, config.hole_m_max);
        // Beyond the radial grid.
        self.of_radial_cell.push(State::Unknown);
        for (state, &cell) in self.states.iter_mut().zip(&self.radial_cell) {
            *state = self.of_radial_cell[cell as usize];
        }
        self.stand(config);
    }

    /// Takes back what the vehicle's own returns said, where a cell holds no other.
    fn forget_the_vehicle(&mut self, sweep: &Sweep, config: &SafePathConfig) {
        let SafePathConfig { vehicle_front_m, vehicle_rear_m, vehicle_width_m, .. } = *config;
        let corner_m = vehicle_front_m.max(vehicle_rear_m).hypot(vehicle_width_m / 2.0);
        // Up to the end of the last row that reaches the outline.
        let rows = (0..self.grid.rows()).take_while(|row| self.grid.row_span_m(*row).0 < corner_m).count();
        let reach_m = rows.checked_sub(1).map_or(0.0, |last| self.grid.row_span_m(last).1);
        self.returns.clear();
        self.returns.resize(rows * self.grid.columns(), Returns::default());
        for (&x, &y) in sweep.x.iter().zip(&sweep.y).filter(|(x, y)| **x * **x + **y * **y <= reach_m * reach_m) {
            if let Some(returns) = self.grid.cell(x, y).and_then(|cell| self.returns.get_mut(cell)) {
                let own = is_within_the_vehicle(x, y, config);
                (returns.own, returns.other) = (returns.own | own, returns.other | !own);
            }
        }
        for (state, returns) in self.of_radial_cell.iter_mut().zip(&self.returns) {
            if returns.own && !returns.other {
                *state = State::Unknown;
            }
        }
    }

    /// Where the vehicle stands nothing else can, whatever was seen of the vehicle itself.
    fn stand(&mut self, config: &SafePathConfig) {
        let middle = |i: usize| ((i as f64 + 0.5 - self.side as f64 / 2.0) * self.cell_m) as f32;
        let longest_m = config.vehicle_front_m.max(config.vehicle_rear_m).max(config.vehicle_width_m);
        let reach = (f64::from(longest_m) / self.cell_m).ceil() as usize;
        let near = (self.side / 2).saturating_sub(reach)..(self.side / 2 + reach).min(self.side);
        for iy in near.clone() {
            for ix in near.clone() {
                let state = &mut self.states[iy * self.side + ix];
                if is_within_the_vehicle(middle(ix), middle(iy), config) && !state.is_free() {
                    *state = State::Blind;
                }
            }
        }
    }

    fn look_up(&mut self, row_radius_m: &[f32], columns: u16) {
        self.grid = RadialGrid::new(row_radius_m.to_vec(), columns);
        let middle = |i: usize| ((i as f64 + 0.5 - self.side as f64 / 2.0) * self.cell_m) as f32;
        let cell = |index: usize| self.grid.cell(middle(index % self.side), middle(index / self.side));
        let cells = 0..self.side * self.side;
        self.radial_cell = cells.map(|index| cell(index).unwrap_or(self.grid.cells()) as u32).collect();
    }
}

/// Whether a place lies within the vehicle's outline.
fn is_within_the_vehicle(x: f32, y: f32, config: &SafePathConfig) -> bool {
    (-config.vehicle_rear_m..=config.vehicle_front_m).contains(&x) && y.abs() <= config.vehicle_width_m / 2.0
}

fn see_blind_zone(of_radial_cell: &mut [State], row_radius_m: &[f32], columns: usize, blind_zone_m: f32) {
    for column in 0..columns {
        let seen = (0..row_radius_m.len()).find(|row| of_radial_cell[row * columns + column] != State::Unknown);
        let Some(seen) = seen else { continue };
        let begins_m = if seen == 0 { 0.0 } else { row_radius_m[seen - 1] };
        if begins_m <= blind_zone_m && of_radial_cell[seen * columns + column] == State::Drivable {
            (0..seen).for_each(|row| of_radial_cell[row * columns + column] = State::Blind);
        }
    }
}

fn close_holes(of_radial_cell: &mut [State], row_radius_m: &[f32], columns: usize, hole_m_max: f32) {
    let rows = row_radius_m.len();
    for (row, &r) in row_radius_m.iter().enumerate() {
        let column_m = r * std::f32::consts::TAU / columns as f32;
        let ring = &mut of_radial_cell[row * columns..][..columns];
        let Some(first) = ring.iter().position(|state| state.is_free()) else { continue };
        // Once around, from one drivable cell to itself.
        let around = |i: usize| if first + i < columns { first + i } else { first + i - columns };
        let width_m = |from: usize, to: usize| (to - from - 1) as f32 * column_m;
        close_along(columns + 1, around, |from, to| width_m(from, to) <= hole_m_max, ring);
    }
    for column in 0..columns {
        let width_m = |from: usize, to: usize| row_radius_m[to - 1] - row_radius_m[from];
        close_along(rows, |row| row * columns + column, |from, to| width_m(from, to) <= hole_m_max, of_radial_cell);
    }
}

/// Closes what is not seen between drivable cells along a way of `length` cells, where it is narrow enough.
fn close_along(
    length: usize,
    cell: impl Fn(usize) -> usize,
    is_narrow: impl Fn(usize, usize) -> bool,
    states: &mut [State],
) {
    let mut drivable = None;
    for i in 0..length {
        match states[cell(i)] {
            State::Unknown | State::Hole => continue,
            State::Drivable | State::Blind => {
                if let Some(before) = drivable
                    && i - before > 1
                    && is_narrow(before, i)
                {
                    (before + 1..i).for_each(|hole| states[cell(hole)] = State::Hole);
                }
                drivable = Some(i);
            }
            State::Obstacle => drivable = None,
        }
    }
}
