//! One estimate of the local ground, made once from the points of a map and shared by all layers.
//!
//! In: a sweep, ego frame, metres. Out: [`Ground`]: the height of the ground at each position to 64 m, with its
//! [`Confidence`], and the height of each point of the sweep over it. The papers take heights over the plane under the
//! vehicle; the world bends. The steps:
//!
//! | step | where |
//! |---|---|
//! | points -> polar cells with their lowest returns | [`polar`] |
//! | the plane of the ground near the vehicle | [`plane`] |
//! | the ground grows outward from that plane, row by row | [`growth`] |
//! | gaps are bridged, edges extrapolated, heights smoothed | [`surface`], `neighbourhood` |
//! | returns under ground that other rays met before are mirror images | `mirrored` |
//!
//! The result does not depend on the order of the points: a cell keeps the lowest of whole numbers.

pub mod config;
pub mod growth;
mod mirrored;
mod neighbourhood;
pub mod plane;
pub mod polar;
pub mod surface;

use nalgebra::{Isometry3, Point3};

use crate::azimuth_columns::floor_to_whole;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;
use crate::wide::{WideLoop, run_wide};

use growth::Growth;
use plane::NearPlane;
use polar::{COLUMNS, PolarCells, RANGE_M_MIN, ROWS, Return};
use surface::{Confidence, Surface};

/// The local ground around the vehicle, ego frame.
#[derive(Clone)]
pub struct Ground {
    cells: PolarCells,
    plane: NearPlane,
    /// Row and column of the seen cells near the vehicle; a buffer.
    near: Vec<(usize, usize)>,
    growth: Growth,
    surface: Surface,
    /// Heights of the surface's nodes with one more column at each end, so that a look-up needs no wrapping; the first
    /// row lies on the near plane.
    nodes: Vec<f32>,
    /// By point of the sweep: height over the ground, metres.
    heights_m: Vec<f32>,
}

/// Least height over the near plane of a point that may be an object where no ground was seen, metres. Ours: one unit
/// of the layer `drivability`.
const OBJECT_M_MIN: f32 = 0.25;
/// Number of points that are processed together. Ours: their intermediate values fit into the first-level cache.
const CHUNK: usize = 1024;
/// Columns of [`Ground::nodes`].
const WIDTH: usize = COLUMNS + 2;

impl Ground {
    /// The ground before the first sweep, around a vehicle with this outline.
    pub fn new(outline: Outline) -> Self {
        Self {
            cells: PolarCells::new(outline),
            plane: NearPlane::default(),
            near: Vec::new(),
            growth: Growth::default(),
            surface: Surface::default(),
            nodes: Vec::new(),
            heights_m: Vec::new(),
        }
    }

    /// Estimates the ground from the points of a sweep.
    pub fn estimate(&mut self, sweep: &Sweep) {
        self.cells.sort_points(sweep);
        self.plane = NearPlane::fit(&self.cells, &mut self.near);
        self.growth.grow(&self.cells, &self.plane);
        self.surface.cover(&self.growth, &self.plane);
        self.write_nodes();
        let mut heights_m = std::mem::take(&mut self.heights_m);
        heights_m.resize(sweep.x.len(), 0.0);
        run_wide(MeasurePoints { ground: self, sweep, heights_m: &mut heights_m });
        self.heights_m = heights_m;
        self.leave_out_mirrored(sweep);
    }

    /// Makes the heights of the sweep's mirror images NaN; what is remembered was not seen from here.
    fn leave_out_mirrored(&mut self, sweep: &Sweep) {
        for point in 0..sweep.x.len() - sweep.remembered {
            let height_m = self.heights_m[point];
            if height_m < -mirrored::DEPTH_M_MIN {
                let column = self.azimuths()[point] as usize % COLUMNS;
                let range_m = (sweep.x[point] * sweep.x[point] + sweep.y[point] * sweep.y[point]).sqrt();
                let found = Return { range_m, z_m: sweep.z[point] };
                if self.is_mirrored(column, &found, height_m, sweep.mount_height_m) {
                    self.heights_m[point] = f32::NAN;
                }
            }
        }
    }

    /// True if a return of a column, at this height over the ground, is a mirror image; the sensor is at this height,
    /// metres.
    pub(crate) fn is_mirrored(&self, column: usize, found: &Return, height_m: f32, sensor_m: f32) -> bool {
        mirrored::is_mirrored((&self.cells, &self.surface), column, found, height_m, sensor_m)
    }

    /// Height of each point of the sweep over the ground, metres; NaN where [`Self::height_over_m`] is, and for the
    /// mirror images of things that stand on the ground.
    pub fn heights_m(&self) -> &[f32] {
        &self.heights_m
    }

    /// Azimuth of each point of the sweep, in columns of two degrees with a fraction, counter-clockwise from the x
    /// axis.
    pub fn azimuths(&self) -> &[f32] {
        self.cells.point_coordinates()[1]
    }

    /// The lowest returns of the polar cells.
    pub(crate) fn cells(&self) -> &PolarCells {
        &self.cells
    }

    /// Height of the ground at the middle of a polar cell, metres; the near plane's where no ground was seen.
    pub(crate) fn surface_m(&self, polar: usize) -> f32 {
        self.surface.heights_m()[polar]
    }

    /// By polar cell; see [`polar`].
    pub fn confidences(&self) -> &[Confidence] {
        self.surface.confidences()
    }

    /// Writes the height of each point of another sweep over the ground, metres. `ground_from_sweep` relates their
    /// frames; `None` if both are the same.
    pub fn measure(&self, sweep: &Sweep, ground_from_sweep: Option<&Isometry3<f32>>, heights_m: &mut Vec<f32>) {
        heights_m.clear();
        let points = sweep.x.iter().zip(&sweep.y).zip(&sweep.z);
        match ground_from_sweep {
            None => heights_m.extend(points.map(|((&x, &y), &z)| self.height_over_m(x, y, z))),
            Some(moved) => heights_m.extend(points.map(|((&x, &y), &z)| {
                let point = moved * Point3::new(x, y, z);
                self.height_over_m(point.x, point.y, point.z)
            })),
        }
    }

    /// Height of a point over the ground, metres. Where no ground was seen near it, it is the height over the near
    /// plane if an object is that high, and NaN if not: a point may mark an obstacle there, but it proves nothing free.
    /// If no near plane was seen either, all heights are those over the plane under the vehicle, as in the papers.
    #[inline(always)]
    pub fn height_over_m(&self, x: f32, y: f32, z: f32) -> f32 {
        self.height_over(x, y, z, self.cells.coordinates(x, y))
    }

    #[inline(always)]
    fn height_over(&self, x: f32, y: f32, z: f32, at: [f32; 2]) -> f32 {
        let (ground_m, confidence) = self.look_up(x, y, at);
        let height_m = z - ground_m;
        let is_proof = confidence != Confidence::None || !self.plane.is_seen || height_m >= OBJECT_M_MIN;
        if is_proof { height_m } else { f32::NAN }
    }

    /// The plane of the ground near the vehicle.
    pub fn near_plane(&self) -> NearPlane {
        self.plane
    }

    fn write_nodes(&mut self) {
        let range_m = RANGE_M_MIN;
        self.nodes.clear();
        let directions = polar::column_directions();
        let first = directions.map(|[cos, sin]| self.plane.height_m(range_m * cos, range_m * sin));
        for row in std::iter::once(&first[..]).chain(self.surface.heights_m().chunks(COLUMNS)) {
            self.nodes.push(row[COLUMNS - 1]);
            self.nodes.extend_from_slice(row);
            self.nodes.push(row[0]);
        }
        // Positions beyond the last row's middle have its height.
        self.nodes.extend_from_within(ROWS * WIDTH..);
    }

    /// Height of the ground at a position, metres; the height of the near plane where no ground was seen.
    pub fn height_m(&self, x: f32, y: f32) -> f32 {
        self.look_up(x, y, self.cells.coordinates(x, y)).0
    }

    /// Confidence of the ground at a position.
    pub fn confidence(&self, x: f32, y: f32) -> Confidence {
        self.look_up(x, y, self.cells.coordinates(x, y)).1
    }

    /// Height of the surface behind a node, metres, at these shares of the way to the next row and the next column.
    #[inline(always)]
    fn between_nodes(&self, at: usize, [u, v]: [f32; 2]) -> f32 {
        // A cell of the surface has nodes on all sides.
        let square = &self.nodes[at..at + WIDTH + 2];
        let [a, b, c, d] = [square[0], square[1], square[WIDTH], square[WIDTH + 1]];
        let (inner, outer) = (a + v * (b - a), c + v * (d - c));
        inner + u * (outer - inner)
    }

    #[inline(always)]
    fn look_up(&self, x: f32, y: f32, [row, column]: [f32; 2]) -> (f32, Confidence) {
        if x * x + y * y < RANGE_M_MIN * RANGE_M_MIN {
            let confidence = if self.plane.is_seen { Confidence::Bridged } else { Confidence::None };
            return (self.plane.height_m(x, y), confidence);
        }
        let cell = floor_to_whole(row) as usize * COLUMNS + floor_to_whole(column) as usize;
        let confidence = self.surface.confidences().get(cell).copied().unwrap_or_default();
        if confidence == Confidence::None {
            return (self.plane.height_m(x, y), confidence);
        }
        // Nodes are the middles of the cells; node (0, 0) is half a row before the first cell's, half a column before.
        let (row, column) = (row + 0.5, column + 0.5);
        let (i, j) = (floor_to_whole(row), floor_to_whole(column));
        let (u, v) = (row - i as f32, column - j as f32);
        (self.between_nodes(i as usize * WIDTH + j as usize, [u, v]), confidence)
    }
}

/// Writes the height of each point of a sweep over its ground, as [`Ground::height_over_m`].
struct MeasurePoints<'a> {
    ground: &'a Ground,
    sweep: &'a Sweep,
    heights_m: &'a mut [f32],
}

impl WideLoop for MeasurePoints<'_> {
    #[inline(always)]
    fn run(self) {
        let (ground, Sweep { x, y, z, .. }, [rows, turns]) =
            (self.ground, self.sweep, self.ground.cells.point_coordinates());
        let (mut cells, mut nodes, [mut us, mut vs]) = ([0; CHUNK], [0; CHUNK], [[0.0; CHUNK]; 2]);
        let confidences = ground.surface.confidences();
        for (chunk, heights_m) in self.heights_m.chunks_mut(CHUNK).enumerate() {
            let (first, n) = (chunk * CHUNK, heights_m.len().min(CHUNK));
            let [xs, ys, zs] = [x, y, z].map(|axis| &axis[first..first + n]);
            let [rows, turns] = [rows, turns].map(|axis| &axis[first..first + n]);
            // What needs no table comes first and without branches, so that the compiler vectorises it.
            for i in 0..n {
                cells[i] = floor_to_whole(rows[i]) * COLUMNS as u32 + floor_to_whole(turns[i]);
                let (row, column) = (rows[i] + 0.5, turns[i] + 0.5);
                let (whole_row, whole_column) = (floor_to_whole(row), floor_to_whole(column));
                (us[i], vs[i]) = (row - whole_row as i32 as f32, column - whole_column as i32 as f32);
                nodes[i] = whole_row * WIDTH as u32 + whole_column;
            }
            for i in 0..n {
                let (x, y, z) = (xs[i], ys[i], zs[i]);
                let is_near = x * x + y * y < RANGE_M_MIN * RANGE_M_MIN;
                let confidence = confidences.get(cells[i] as usize).copied().unwrap_or_default();
                heights_m[i] = if is_near || confidence == Confidence::None {
                    ground.height_over(x, y, z, [rows[i], turns[i]])
                } else {
                    z - ground.between_nodes(nodes[i] as usize, [us[i], vs[i]])
                };
            }
        }
    }
}
