//! The square of cells about the vehicle, its axes the world's, scrolled by whole cells.
//!
//! In: where the vehicle is; returns. Out: every cell, judged and written.
//!
//! World cell (i, j) is kept at (i mod n, j mod n), n the power of two over the window's side: nothing moves when the
//! vehicle does. Of most cells nothing is kept at all; those with returns are listed, and only they are looked after.

use nalgebra::Isometry3;

use super::states::{Cell, evidence};
use crate::layer::radial_grid::floor_to_whole;

/// Beside a state: it stands already. Beyond all that can be told of a cell.
const JUDGED: u8 = 8;

/// Where the ego frame lies in the window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// The ego frame's origin, cells from the window's corner.
    pub cells: [f64; 2],
    /// Heading of the ego frame in the window's axes, rad.
    pub yaw_rad: f64,
}

/// The window, and what is known of its cells.
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
    /// Returns from each cell since the last map.
    fresh: Vec<u8>,
    /// Indices of the cells with returns, then or before, each once.
    listed: Vec<u32>,
}

/// From the ego frame, metres, into the window, cells from its corner.
pub struct FromEgo {
    at: [f32; 2],
    turn: [f32; 2],
}

impl FromEgo {
    /// Where a place lies.
    #[inline(always)]
    pub fn place(&self, x: f32, y: f32) -> [f32; 2] {
        let ([px, py], [cos, sin]) = (self.at, self.turn);
        [px + x * cos - y * sin, py + x * sin + y * cos]
    }
}

impl Window {
    /// A window of `side` cells nobody has looked at.
    pub fn new(side: usize, cell_m: f64) -> Self {
        let bits = side.next_power_of_two().trailing_zeros();
        Self {
            side,
            cell_m,
            bits,
            corner: [0, 0],
            anchored: false,
            place: Place { cells: [side as f64 / 2.0; 2], yaw_rad: 0.0 },
            cells: vec![Cell::default(); 1 << (2 * bits)],
            fresh: vec![0; 1 << (2 * bits)],
            listed: Vec::new(),
        }
    }

    /// Cells a side.
    pub fn side(&self) -> usize {
        self.side
    }

    /// World index of the first cell.
    pub fn corner(&self) -> [i64; 2] {
        self.corner
    }

    /// Where the ego frame lies.
    pub fn place(&self) -> Place {
        self.place
    }

    /// Whether the axes are the world's.
    pub fn anchored(&self) -> bool {
        self.anchored
    }

    /// Scrolls to the vehicle. Without a pose the window is the vehicle's own. Whether what was seen before still has a
    /// place in it: not when a first pose comes, or none comes any more.
    pub fn follow(&mut self, map_from_ego: Option<&Isometry3<f64>>) -> bool {
        let half = (self.side / 2) as i64;
        let goes_on = self.anchored == map_from_ego.is_some();
        if !goes_on {
            self.forget();
        }
        self.anchored = map_from_ego.is_some();
        let Some(pose) = map_from_ego else {
            self.corner = [0, 0];
            self.place = Place { cells: [half as f64; 2], yaw_rad: 0.0 };
            return goes_on;
        };
        let forward = pose.rotation * nalgebra::Vector3::x();
        let at = [pose.translation.x / self.cell_m, pose.translation.y / self.cell_m];
        self.scroll(at.map(|cells| cells.floor() as i64 - half));
        let cells = [0, 1].map(|i| at[i] - self.corner[i] as f64);
        self.place = Place { cells, yaw_rad: forward.y.atan2(forward.x) };
        goes_on
    }

    fn forget(&mut self) {
        for index in self.listed.drain(..) {
            (self.cells[index as usize], self.fresh[index as usize]) = (Cell::default(), 0);
        }
    }

    /// Moves the corner; forgets what leaves the window.
    fn scroll(&mut self, corner: [i64; 2]) {
        if corner == self.corner {
            return;
        }
        let mut listed = std::mem::take(&mut self.listed);
        listed.retain(|index| {
            let cell = self.cell(*index);
            let stays = [0, 1].into_iter().all(|i| {
                let at = self.corner[i] + cell[i] as i64 - corner[i];
                (0..self.side as i64).contains(&at)
            });
            if !stays {
                (self.cells[*index as usize], self.fresh[*index as usize]) = (Cell::default(), 0);
            }
            stays
        });
        (self.listed, self.corner) = (listed, corner);
    }

    /// Where a listed cell lies from the corner.
    fn cell(&self, index: u32) -> [usize; 2] {
        let mask = (1 << self.bits) - 1;
        let from = |at: u32, i: usize| ((i64::from(at) - self.corner[i]) & mask) as usize;
        [from(index, 0), from(index >> self.bits, 1)]
    }

    /// The way from the ego frame into the window, for as long as the vehicle stays where it is.
    pub fn from_ego(&self) -> FromEgo {
        let (sin, cos) = self.place.yaw_rad.sin_cos();
        let turn = [cos, sin].map(|part| (part / self.cell_m) as f32);
        FromEgo { at: self.place.cells.map(|cells| cells as f32), turn }
    }

    /// Counts a return from a place, cells from the window's corner.
    #[inline(always)]
    pub fn hit(&mut self, [x, y]: [f32; 2]) {
        let side = self.side as f32;
        // NaN fails every comparison.
        if x >= 0.0 && y >= 0.0 && x < side && y < side {
            let mask = (1 << self.bits) - 1;
            let [x, y] = [(x, 0), (y, 1)].map(|(at, i)| (self.corner[i] + i64::from(floor_to_whole(at))) & mask);
            let index = (y << self.bits | x) as usize;
            let fresh = &mut self.fresh[index];
            if *fresh == 0 && self.cells[index].hits == 0 {
                self.listed.push(index as u32);
            }
            *fresh = fresh.saturating_add(1);
        }
    }

    /// Judges every cell. In: in `class` what was told of it since the last map ([`super::states::LOOKED_AT`] and so
    /// on), and whether any sensor sent anything. Out: the states in `class`, the returns in `hits`.
    pub fn judge(&mut self, [needed, hold_maps]: [u8; 2], any: bool, class: &mut [u8], hits: &mut [u8]) {
        hits.fill(0);
        let mut listed = std::mem::take(&mut self.listed);
        listed.retain(|index| {
            let ([x, y], index) = (self.cell(*index), *index as usize);
            let (at, fresh) = (y * self.side + x, std::mem::take(&mut self.fresh[index]));
            let cell = self.cells[index].judged(fresh, evidence(class[at], any), needed, hold_maps);
            (class[at], hits[at]) = (JUDGED | cell.state.value(), cell.level());
            self.cells[index] = if cell.hits > 0 { cell } else { Cell::default() };
            cell.hits > 0
        });
        self.listed = listed;
        let states: [u8; 16] = std::array::from_fn(|told| match told as u8 {
            told if told & JUDGED != 0 => told & !JUDGED,
            told => Cell::default().judged(0, evidence(told, any), needed, hold_maps).state.value(),
        });
        class.iter_mut().for_each(|class| *class = states[usize::from(*class & 15)]);
        if !self.anchored {
            // Nobody knows where these cells will be when the next map is made.
            self.forget();
        }
    }
}
