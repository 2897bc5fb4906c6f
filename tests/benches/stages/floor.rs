//! The least work on the same data that could do a stage.

use std::hint::black_box;

use clearway_mapping::event::Scan;

/// Side of the grid of the floors, in cells, and of a cell, metres.
const SIDE: usize = 400;
const CELL_M: f32 = 0.25;
/// Number of layers of a map.
const LAYERS: usize = 6;

/// The least work that could do a stage: each point, return or cell once, with the arithmetic that cannot be left out,
/// into buffers of the size of the result.
pub struct Floor {
    /// Sine and cosine of each hundredth of a degree.
    azimuths: Vec<[f32; 2]>,
    points: Vec<[f32; 3]>,
    /// Number, least and greatest height by cell.
    polar: Vec<[f32; 3]>,
    /// Number, sums and products of the coordinates by cell.
    moments: Vec<[f32; 10]>,
    classes: Vec<u8>,
}

impl Floor {
    pub fn new(scan: &Scan) -> Self {
        // One class where a point fell, another elsewhere: runs as long as in a map.
        let mut classes = vec![0; SIDE * SIDE];
        for (&x, &y) in scan.x.iter().zip(&scan.y) {
            if let Some(cell) = square_cell(x, y) {
                classes[cell] = 1;
            }
        }
        Self {
            azimuths: (0..36_000).map(|i| (i as f32 / 100.0).to_radians().sin_cos().into()).collect(),
            points: Vec::new(),
            polar: vec![[0.0; 3]; 360 * 64],
            moments: vec![[0.0; 10]; SIDE * SIDE],
            classes,
        }
    }

    /// Points of the returns, with one elevation for all.
    pub fn decode(&mut self, datagrams: &[Box<[u8]>]) -> usize {
        self.points.clear();
        for block in datagrams.iter().flat_map(|datagram| datagram[..1_200].chunks_exact(100)) {
            let azimuth = usize::from(u16::from_le_bytes([block[2], block[3]]));
            let [sin, cos] = self.azimuths[azimuth % 36_000];
            let ranges = block[4..].chunks_exact(3).map(|r| f32::from(u16::from_le_bytes([r[0], r[1]])) * 0.002);
            self.points.extend(ranges.map(|range| [range * cos, range * sin, range * 0.1]));
        }
        self.points.len()
    }

    /// Least and greatest height by sector of a degree and ring of a metre.
    pub fn scatter_polar(&mut self, scan: &Scan) -> f32 {
        self.polar.fill([0.0, f32::INFINITY, f32::NEG_INFINITY]);
        for ((&x, &y), &z) in scan.x.iter().zip(&scan.y).zip(&scan.z) {
            // A cubic is as near as a cell needs.
            let share = y / (x.abs() + y.abs()).max(1e-6);
            let eighth = share * (1.27 - 0.27 * share * share);
            let turn = if x >= 0.0 { 1.0 + eighth } else { 3.0 - eighth };
            let ring = ((x * x + y * y).sqrt() as usize).min(63);
            let cell = &mut self.polar[(turn * 89.0) as usize * 64 + ring];
            *cell = [cell[0] + 1.0, cell[1].min(z), cell[2].max(z)];
        }
        self.polar[0][0]
    }

    /// The ten sums from which the planes of cells follow.
    pub fn sum_moments(&mut self, scan: &Scan) -> f32 {
        self.moments.fill([0.0; 10]);
        for ((&x, &y), &z) in scan.x.iter().zip(&scan.y).zip(&scan.z) {
            if let Some(cell) = square_cell(x, y) {
                let terms = [1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z];
                self.moments[cell].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
            }
        }
        self.moments[0][0]
    }

    /// Number of runs in six grids.
    pub fn count_runs(&self) -> usize {
        (0..LAYERS).map(|_| black_box(&self.classes).windows(2).filter(|pair| pair[0] != pair[1]).count()).sum()
    }
}

/// The square cell of a point; `None` outside the grid.
fn square_cell(x: f32, y: f32) -> Option<usize> {
    let half = SIDE as f32 / 2.0;
    let (column, row) = (x / CELL_M + half, y / CELL_M + half);
    let inside = column >= 0.0 && row >= 0.0 && column < SIDE as f32 && row < SIDE as f32;
    inside.then(|| row as usize * SIDE + column as usize)
}
