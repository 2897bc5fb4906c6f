//! Which regions are flat (Neuhaus 2009 §2.2 and §2.3).
//!
//! In: [`Cells`] with their sums. Out: flat regions with a plane each, and for every cell of the grid the region it
//! lies in, or that it is an obstacle, or that nothing is known. Hierarchical: start with everything; a region whose
//! local height disturbance h is under the threshold is flat, another one is split, down to one cell, where not flat
//! means obstacle. The paper splits along the longest axis; a square has none, so it is cut along both: four quarters.

use crate::config::{Form, TerrainConfig};

use super::class::Shape;
use super::eigen::Principal;
use super::moments::{Cells, Moments, places};

/// The cell lies in no region that could be judged.
pub const NOTHING: u32 = 0;
/// The cell is not flat.
pub const OBSTACLE: u32 = 1;
/// Cells of flat region `i` hold `FIRST_FLAT + i`.
pub const FIRST_FLAT: u32 = 2;

/// z = a x + b y + c, ego frame, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Plane(pub [f32; 3]);

impl Plane {
    /// Height at a place, metres.
    pub fn height_m(&self, x: f32, y: f32) -> f32 {
        let [a, b, c] = self.0;
        (a * x + b * y) + c
    }

    /// Rise over run of the steepest way.
    pub fn grade(&self) -> f32 {
        let [a, b, _] = self.0;
        (a * a + b * b).sqrt()
    }

    /// The plane that misses the points' heights least, over a ground whose position is known to `noise_m2` only: a
    /// stretch of one ring says nothing of the slope across it, and then has none.
    fn fit(moments: &Moments, noise_m2: f64) -> Self {
        let [mut xx, mut yy, _, xy, xz, yz] = moments.covariance();
        (xx, yy) = (xx + noise_m2, yy + noise_m2);
        let determinant = xx * yy - xy * xy;
        let a = (yy * xz - xy * yz) / determinant;
        let b = (xx * yz - xy * xz) / determinant;
        let [x, y, z] = moments.mean();
        Self([a as f32, b as f32, (z - (a * x + b * y)) as f32])
    }
}

/// Flat regions and what each cell belongs to.
#[derive(Clone, Debug, Default)]
pub struct Regions {
    planes: Vec<Plane>,
    /// By flat region: its first column and row in the grid, and the first ones behind it.
    extents: Vec<[u32; 4]>,
    of_cell: Vec<u32>,
    /// By slot: the cell's place in the grid.
    cell_of_slot: Vec<u32>,
    shape_of_cell: Vec<Shape>,
    /// Regions still to be judged: code of the corner, side in cells.
    waiting: Vec<(u32, u32)>,
}

impl Regions {
    /// Divides and judges.
    pub fn find(&mut self, cells: &Cells, config: &TerrainConfig) {
        let width = cells.width();
        self.planes.clear();
        self.extents.clear();
        self.of_cell.clear();
        self.of_cell.resize(width * width, NOTHING);
        self.shape_of_cell.clear();
        self.cell_of_slot.clear();
        self.cell_of_slot.extend((0..cells.slots()).map(|slot| {
            let (x, y) = places(cells.code(slot));
            ((y - cells.margin()) * width + x - cells.margin()) as u32
        }));
        match config.form {
            Form::Grid => self.judge_cells(cells, config),
            Form::Paper | Form::Grounded => self.divide(cells, config),
        }
    }

    /// §2.2: every cell for itself, with its shape.
    fn judge_cells(&mut self, cells: &Cells, config: &TerrainConfig) {
        self.shape_of_cell.resize(self.of_cell.len(), Shape::Unknown);
        for slot in 0..cells.slots() {
            let moments = cells.moments(slot, slot + 1);
            if moments.points() < f64::from(config.points_min) {
                continue;
            }
            let principal = Principal::of(moments.covariance());
            let cell = self.cell_of_slot[slot] as usize;
            self.shape_of_cell[cell] = shape(principal.values);
            let flat = principal.height_disturbance() < f64::from(config.flatness_m2_max);
            self.of_cell[cell] = if flat { self.add(&moments, config) } else { OBSTACLE };
        }
    }

    /// §2.3.
    fn divide(&mut self, cells: &Cells, config: &TerrainConfig) {
        self.waiting.clear();
        self.waiting.push((0, cells.root_width() as u32));
        while let Some((code, side)) = self.waiting.pop() {
            let (from, to) = (cells.slots_before(code), cells.slots_before(code + side * side));
            if from == to {
                continue;
            }
            let moments = cells.moments(from, to);
            // Of fewer points no part can be judged either.
            if moments.points() < f64::from(config.points_min) {
                continue;
            }
            if is_flat(&moments, f64::from(config.flatness_m2_max)) {
                let plane = Plane::fit(&moments, f64::from(config.noise_m).powi(2));
                if config.form == Form::Paper || is_ground_like(&plane, cells, from..to, config) {
                    self.planes.push(plane);
                    let region = FIRST_FLAT + self.planes.len() as u32 - 1;
                    self.paint(cells, code, side, region);
                    continue;
                }
            }
            if side == 1 {
                self.of_cell[self.cell_of_slot[from] as usize] = OBSTACLE;
            } else {
                let quarter = side / 2;
                // The last one pushed is judged first: the order of the codes.
                self.waiting.extend((0..4).rev().map(|part| (code + part * quarter * quarter, quarter)));
            }
        }
    }

    fn add(&mut self, moments: &Moments, config: &TerrainConfig) -> u32 {
        self.planes.push(Plane::fit(moments, f64::from(config.noise_m).powi(2)));
        FIRST_FLAT + self.planes.len() as u32 - 1
    }

    fn paint(&mut self, cells: &Cells, code: u32, side: u32, region: u32) {
        let (x, y) = places(code);
        let within = |first: usize| {
            let clip = |place: usize| place.saturating_sub(cells.margin()).min(cells.width());
            clip(first)..clip(first + side as usize)
        };
        let (columns, rows) = (within(x), within(y));
        self.extents.push([columns.start, rows.start, columns.end, rows.end].map(|place| place as u32));
        for row in rows {
            let first = row * cells.width();
            self.of_cell[first + columns.start..first + columns.end].fill(region);
        }
    }

    /// By cell of the grid: [`NOTHING`], [`OBSTACLE`], or [`FIRST_FLAT`] and the flat region's index.
    pub fn of_cell(&self) -> &[u32] {
        &self.of_cell
    }

    /// By flat region.
    pub fn planes(&self) -> &[Plane] {
        &self.planes
    }

    /// By flat region of the division: its first column and row in the grid, and the first ones behind it.
    pub fn extents(&self) -> &[[u32; 4]] {
        &self.extents
    }

    /// By slot: the cell's index in the grid.
    pub fn cell_of_slot(&self) -> &[u32] {
        &self.cell_of_slot
    }

    /// By cell of the grid; empty unless the form is [`Form::Grid`].
    pub fn shape_of_cell(&self) -> &[Shape] {
        &self.shape_of_cell
    }
}

/// Whether h is under the threshold; most regions are told without their eigenvalues.
fn is_flat(moments: &Moments, flatness_m2_max: f64) -> bool {
    // The most vertical of three axes holds a third of the vertical at least, so h is at most three times the variance
    // of z.
    if 3.0 * moments.variance_z() < flatness_m2_max {
        return true;
    }
    let covariance = moments.covariance();
    // Every eigenvalue is above the threshold where the matrix less the threshold is positive definite.
    let [xx, yy, zz, xy, xz, yz] = covariance;
    let (x, y, z) = (xx - flatness_m2_max, yy - flatness_m2_max, zz - flatness_m2_max);
    let minor = x * y - xy * xy;
    let determinant = ((x * y) * z + 2.0 * (xy * (xz * yz))) - (x * (yz * yz) + y * (xz * xz)) - z * (xy * xy);
    if x > 0.0 && y > 0.0 && minor > 0.0 && determinant > 0.0 {
        return false;
    }
    Principal::of(covariance).height_disturbance() < flatness_m2_max
}

/// Beyond the paper: no point of a flat region may stand out of its plane, and the plane must be one that can be
/// driven.
fn is_ground_like(plane: &Plane, cells: &Cells, slots: std::ops::Range<usize>, config: &TerrainConfig) -> bool {
    if plane.grade() > config.grade_max {
        return false;
    }
    let [a, b, _] = plane.0;
    let allowed = config.residual_m_max + (a.abs() + b.abs()) * cells.cell_m() / 2.0;
    slots.into_iter().all(|slot| {
        let (x, y) = places(cells.code(slot));
        let height = plane.height_m(cells.centre_m(x), cells.centre_m(y));
        let [lowest, highest] = cells.span_m(slot);
        highest - height <= allowed && height - lowest <= allowed
    })
}

/// Figure 1 of the paper: one value much larger than the two others is a line, one much smaller a plane.
fn shape([largest, middle, smallest]: [f64; 3]) -> Shape {
    const MUCH: f64 = 10.0;
    if largest > MUCH * middle {
        Shape::Line
    } else if middle > MUCH * smallest {
        Shape::Plane
    } else {
        Shape::Scatter
    }
}
