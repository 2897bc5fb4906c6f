//! The square of cells about the vehicle, its axes the world's, scrolled by whole cells.
//!
//! In: where the vehicle is; what rays tell of cells. Out: every cell, judged and written row by row.
//!
//! World cell (i, j) is kept at (i mod n, j mod n), n the power of two over the window's side: nothing moves when the
//! vehicle does, and only the rows and columns that come into the window are cleared.

use nalgebra::Isometry3;

use super::states::{Cell, Evidence};

/// A cell's evidence: the number of the last scan that saw it clear, counted from 1 since the last map, and these.
const SCANS: u16 = (1 << 14) - 1;
const HIDDEN: u16 = 1 << 14;
const LOOKED_AT: u16 = 1 << 15;
/// Fraction bits of positions on a trace. So many, because a trace must fall on a border of cells never, not seldom.
const FRACTION: u32 = 32;

/// Where the ego frame lies in the window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// The ego frame's origin, cells from the window's corner.
    pub cells: [f64; 2],
    /// Heading of the ego frame in the window's axes, rad.
    pub yaw_rad: f64,
}

/// The window, what is known of its cells, and what has been told since the last map.
pub struct Window {
    side: usize,
    cell_m: f64,
    bits: u32,
    /// World index of the window's first cell.
    corner: [i64; 2],
    /// Whether the axes are the world's; without a pose they are the vehicle's own.
    anchored: bool,
    place: Place,
    cells: Vec<Cell>,
    told: Vec<u16>,
    fresh: Vec<u8>,
    /// The sensor of each scan since the last map, from scan 1 on.
    scans: Vec<u16>,
    /// Whether each of them is its sensor's last.
    newest: Vec<bool>,
}

/// A way of equal steps through the window; gives the index of the cell at the middle of each step.
pub struct Trace {
    at: [i64; 2],
    step: [i64; 2],
    mask: i64,
    bits: u32,
}

impl Trace {
    /// The cell in the middle of step `number`.
    #[inline(always)]
    pub fn cell(&self, number: usize) -> usize {
        let axis = |i: usize| ((self.at[i] + self.step[i] * number as i64) >> FRACTION) & self.mask;
        (axis(1) << self.bits | axis(0)) as usize
    }
}

impl Window {
    /// A window of `side` cells nobody has looked at.
    pub fn new(side: usize, cell_m: f64) -> Self {
        let bits = side.next_power_of_two().trailing_zeros();
        let cells = 1 << (2 * bits);
        Self {
            side,
            cell_m,
            bits,
            corner: [0, 0],
            anchored: false,
            place: Place { cells: [side as f64 / 2.0; 2], yaw_rad: 0.0 },
            cells: vec![Cell::default(); cells],
            told: vec![0; cells],
            fresh: vec![0; cells],
            scans: vec![0],
            newest: vec![false],
        }
    }

    /// Cells a side.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Where the ego frame lies.
    pub fn place(&self) -> Place {
        self.place
    }

    /// Whether the axes are the world's.
    pub fn anchored(&self) -> bool {
        self.anchored
    }

    /// Scrolls to the vehicle. Without a pose the window is the vehicle's own, and holds nothing of before.
    pub fn follow(&mut self, map_from_ego: Option<&Isometry3<f64>>) {
        let half = (self.side / 2) as i64;
        let Some(pose) = map_from_ego else {
            if self.anchored {
                self.forget();
                self.anchored = false;
                self.corner = [0, 0];
                self.place = Place { cells: [half as f64; 2], yaw_rad: 0.0 };
            }
            return;
        };
        let forward = pose.rotation * nalgebra::Vector3::x();
        let at = [pose.translation.x / self.cell_m, pose.translation.y / self.cell_m];
        let corner = at.map(|cells| cells.floor() as i64 - half);
        if self.anchored {
            self.scroll(corner);
        } else {
            self.forget();
            self.anchored = true;
        }
        self.corner = corner;
        let cells = [0, 1].map(|i| at[i] - corner[i] as f64);
        self.place = Place { cells, yaw_rad: forward.y.atan2(forward.x) };
    }

    fn forget(&mut self) {
        self.cells.fill(Cell::default());
        self.told.fill(0);
        self.fresh.fill(0);
    }

    /// Clears what comes into a window with this corner.
    fn scroll(&mut self, corner: [i64; 2]) {
        let side = self.side as i64;
        let entering = [0, 1].map(|i| {
            let moved = corner[i] - self.corner[i];
            if moved > 0 {
                (self.corner[i] + side).max(corner[i])..corner[i] + side
            } else {
                corner[i]..(corner[i] - moved).min(corner[i] + side)
            }
        });
        let [columns, rows] = entering;
        for y in corner[1]..corner[1] + side {
            for x in columns.clone() {
                self.clear(x, y);
            }
        }
        for y in rows {
            for x in corner[0]..corner[0] + side {
                self.clear(x, y);
            }
        }
    }

    fn clear(&mut self, x: i64, y: i64) {
        let index = self.index(x, y);
        (self.cells[index], self.told[index], self.fresh[index]) = (Cell::default(), 0, 0);
    }

    /// Index of a world cell.
    #[inline(always)]
    fn index(&self, x: i64, y: i64) -> usize {
        let mask = (1 << self.bits) - 1;
        ((y & mask) << self.bits | (x & mask)) as usize
    }

    /// Counts a return from a place, cells from the window's corner.
    #[inline(always)]
    pub fn hit(&mut self, x: f32, y: f32) {
        let side = self.side as f32;
        // NaN fails every comparison.
        if x >= 0.0 && y >= 0.0 && x < side && y < side {
            let index = self.index(self.corner[0] + x as i64, self.corner[1] + y as i64);
            self.fresh[index] = self.fresh[index].saturating_add(1);
        }
    }

    /// The way from a place (cells from the corner) in a direction (length 1), in steps of a cell; and how many of its
    /// steps lie in the window: none from a place outside.
    pub fn trace(&self, from: [f64; 2], direction: [f64; 2]) -> (Trace, usize) {
        let side = self.side as f64;
        let inside = from.iter().all(|at| (0.0..side).contains(at));
        let from = if inside { from } else { [0.0; 2] };
        let fixed = |cells: f64| (cells * (1_i64 << FRACTION) as f64).round() as i64;
        let mask = (1 << self.bits) - 1;
        let step = direction.map(fixed);
        let at = [0, 1].map(|i| ((self.corner[i] & mask) << FRACTION) + fixed(from[i]) + step[i] / 2);
        let way = |i: usize| {
            let (at, d) = (from[i], direction[i]);
            if d > 0.0 {
                (side - at) / d
            } else if d < 0.0 {
                at / -d
            } else {
                f64::INFINITY
            }
        };
        // The last middle of a step before the border.
        let steps = if inside { (way(0).min(way(1)) - 0.5).ceil().max(0.0) as usize } else { 0 };
        (Trace { at, step, mask, bits: self.bits }, steps)
    }

    /// Begins a sensor's next scan.
    pub fn begin_scan(&mut self, sensor: u16) {
        if self.scans.len() > usize::from(SCANS) {
            // Nobody has asked for a map for so long that what was seen is of no use.
            self.told.fill(0);
            self.scans.truncate(1);
        }
        self.scans.push(sensor);
    }

    /// These steps of a trace of the scan just begun are hidden from its sensor.
    #[inline(always)]
    pub fn hide(&mut self, trace: &Trace, steps: std::ops::Range<usize>) {
        let sensor = self.scans[self.scans.len() - 1];
        for step in steps {
            let told = &mut self.told[trace.cell(step)];
            // What this sensor saw clear a moment ago it does not see any more.
            let others = self.scans[usize::from(*told & SCANS)] != sensor;
            *told = *told & if others { SCANS } else { 0 } | HIDDEN | LOOKED_AT;
        }
    }

    /// The scan just begun looks over these steps of its trace; where `clear(step)`, it sees that nothing is there.
    #[inline(always)]
    pub fn look(&mut self, trace: &Trace, steps: std::ops::Range<usize>, clear: impl Fn(usize) -> bool) {
        let scan = self.scans.len() as u16 - 1;
        for step in steps {
            let told = &mut self.told[trace.cell(step)];
            *told = if clear(step) { *told & !SCANS | scan } else { *told } | LOOKED_AT;
        }
    }

    /// Marks the last scan of each sensor; only these say what is clear now.
    fn find_newest(&mut self) {
        self.newest.clear();
        self.newest.resize(self.scans.len(), false);
        for scan in (1..self.scans.len()).rev() {
            self.newest[scan] = !self.scans[scan + 1..].contains(&self.scans[scan]);
        }
    }

    /// Judges every cell by what was told of it since the last map, and gives each, row by row, to `write`.
    pub fn judge(&mut self, hits_needed: u8, hold_maps: u8, mut write: impl FnMut(Cell)) {
        self.find_newest();
        let nothing = if self.scans.len() > 1 { Evidence::Nothing } else { Evidence::Silence };
        let n = 1 << self.bits;
        let first = (self.corner[0] & (n as i64 - 1)) as usize;
        for y in 0..self.side as i64 {
            let row = self.index(0, self.corner[1] + y);
            // A row that reaches over the end goes on at the beginning.
            let before = (n - first).min(self.side);
            for part in [row + first..row + first + before, row..row + self.side - before] {
                let cells = self.cells[part.clone()].iter_mut();
                for ((cell, told), fresh) in cells.zip(&mut self.told[part.clone()]).zip(&mut self.fresh[part]) {
                    let strongest = match *told {
                        0 => nothing,
                        told if self.newest[usize::from(told & SCANS)] => Evidence::Through,
                        told if told & HIDDEN != 0 => Evidence::Hidden,
                        // Or seen clear, and then lost out of sight.
                        _ => Evidence::Overhead,
                    };
                    *cell = cell.judged(*fresh, strongest, hits_needed, hold_maps);
                    (*told, *fresh) = (0, 0);
                    write(*cell);
                }
            }
        }
        self.scans.truncate(1);
        if !self.anchored {
            // Nobody knows where these cells will be when the next map is made.
            self.cells.fill(Cell::default());
        }
    }
}
