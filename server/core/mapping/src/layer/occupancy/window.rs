//! The square of cells around the vehicle, along the axes of the world, scrolled by whole cells.
//!
//! In: ego poses; returns. Out: the state of each cell.
//!
//! World cell (i, j) is stored at (i mod n, j mod n), where n is the power of two at or above the window's side, so
//! that no cell is copied when the vehicle moves. Only cells with returns have a state from map to map; they are
//! listed.

use nalgebra::Isometry3;

use super::config::Hits;
use super::states::{Cell, evidence};
use crate::azimuth_columns::floor_to_whole;

/// Bit of a cell whose other bits are its state, not evidence. It is above all evidence bits.
const STATE: u8 = 8;

/// Pose of the ego frame in the window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgoPose {
    /// Origin of the ego frame, in cells from the window's corner.
    pub cells: [f64; 2],
    /// Heading of the ego frame in the window's axes, radians.
    pub yaw_rad: f64,
}

/// The window and its cells.
#[derive(Clone)]
pub struct Window {
    /// Number of cells along a side.
    side: usize,
    cell_m: f64,
    /// Bits of a stored index along one axis.
    bits: u32,
    /// World index (x, y) of the window's first cell.
    corner: [i64; 2],
    /// True if the axes are the world's; without a pose they are the vehicle's.
    anchored: bool,
    ego_pose: EgoPose,
    cells: Vec<Cell>,
    /// Number of returns from each cell since the last map.
    fresh: Vec<u8>,
    /// Indices of the cells with returns, new or earlier, each once.
    listed: Vec<u32>,
}

/// Transform from the ego frame, metres, into the window, cells from its corner.
pub struct WindowFromEgo {
    origin: [f32; 2],
    /// Cosine and sine of the heading, in cells per metre.
    rotation: [f32; 2],
}

impl WindowFromEgo {
    /// Transforms a position.
    #[inline(always)]
    pub fn apply(&self, x: f32, y: f32) -> [f32; 2] {
        let ([px, py], [cos, sin]) = (self.origin, self.rotation);
        [px + x * cos - y * sin, py + x * sin + y * cos]
    }
}

impl Window {
    /// A window of `side` x `side` cells without evidence.
    pub fn new(side: usize, cell_m: f64) -> Self {
        let bits = side.next_power_of_two().trailing_zeros();
        Self {
            side,
            cell_m,
            bits,
            corner: [0, 0],
            anchored: false,
            ego_pose: EgoPose { cells: [side as f64 / 2.0; 2], yaw_rad: 0.0 },
            cells: vec![Cell::default(); 1 << (2 * bits)],
            fresh: vec![0; 1 << (2 * bits)],
            listed: Vec::new(),
        }
    }

    /// Number of cells along a side.
    pub fn side(&self) -> usize {
        self.side
    }

    /// World index (x, y) of the first cell.
    pub fn corner(&self) -> [i64; 2] {
        self.corner
    }

    /// Pose of the ego frame in the window.
    pub fn ego_pose(&self) -> EgoPose {
        self.ego_pose
    }

    /// True if the axes are the world's.
    pub fn anchored(&self) -> bool {
        self.anchored
    }

    /// Scrolls to the vehicle. Without a pose the window has the vehicle's axes. Returns false if earlier evidence no
    /// longer fits the window: if the first pose arrives, or if poses stop.
    pub fn move_to(&mut self, map_from_ego: Option<&Isometry3<f64>>) -> bool {
        let half = (self.side / 2) as i64;
        let continues = self.anchored == map_from_ego.is_some();
        if !continues {
            self.clear();
        }
        self.anchored = map_from_ego.is_some();
        let Some(pose) = map_from_ego else {
            self.corner = [0, 0];
            self.ego_pose = EgoPose { cells: [half as f64; 2], yaw_rad: 0.0 };
            return continues;
        };
        let forward = pose.rotation * nalgebra::Vector3::x();
        let at = [pose.translation.x / self.cell_m, pose.translation.y / self.cell_m];
        self.scroll(at.map(|cells| cells.floor() as i64 - half));
        let cells = [0, 1].map(|i| at[i] - self.corner[i] as f64);
        self.ego_pose = EgoPose { cells, yaw_rad: libm::atan2(forward.y, forward.x) };
        continues
    }

    /// Removes all returns and states.
    fn clear(&mut self) {
        for index in self.listed.drain(..) {
            (self.cells[index as usize], self.fresh[index as usize]) = (Cell::default(), 0);
        }
    }

    /// Moves the corner, and removes the cells that leave the window.
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

    /// Indices (x, y) of a listed cell, from the corner.
    fn cell(&self, index: u32) -> [usize; 2] {
        let mask = (1 << self.bits) - 1;
        let from = |at: u32, i: usize| ((i64::from(at) - self.corner[i]) & mask) as usize;
        [from(index, 0), from(index >> self.bits, 1)]
    }

    /// The transform from the ego frame into the window, valid until the window moves.
    pub fn window_from_ego(&self) -> WindowFromEgo {
        let (sin, cos) = libm::sincos(self.ego_pose.yaw_rad);
        let rotation = [cos, sin].map(|part| (part / self.cell_m) as f32);
        WindowFromEgo { origin: self.ego_pose.cells.map(|cells| cells as f32), rotation }
    }

    /// Counts a return at a position, in cells from the window's corner.
    #[inline(always)]
    pub fn record_hit(&mut self, [x, y]: [f32; 2]) {
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

    /// Computes the state of each cell. In: in `class` the evidence bits since the last map
    /// ([`super::states::LOOKED_AT`], …), and `any`, true if a sensor sent a scan. Out: the states in `class`, the
    /// published hits in `hits`.
    pub fn update_states(
        &mut self,
        [needed, hold_maps]: [u8; 2],
        any: bool,
        published: Hits,
        class: &mut [u8],
        hits: &mut [u8],
    ) {
        hits.fill(0);
        let mut listed = std::mem::take(&mut self.listed);
        listed.retain(|index| {
            let ([x, y], index) = (self.cell(*index), *index as usize);
            let (at, fresh) = (y * self.side + x, std::mem::take(&mut self.fresh[index]));
            let cell = self.cells[index].next(fresh, evidence(class[at], any), needed, hold_maps);
            (class[at], hits[at]) = (STATE | cell.state.value(), cell.level(published));
            self.cells[index] = if cell.hits > 0 { cell } else { Cell::default() };
            cell.hits > 0
        });
        self.listed = listed;
        let states: [u8; 16] = std::array::from_fn(|bits| match bits as u8 {
            bits if bits & STATE != 0 => bits & !STATE,
            bits => Cell::default().next(0, evidence(bits, any), needed, hold_maps).state.value(),
        });
        class.iter_mut().for_each(|class| *class = states[usize::from(*class & 15)]);
        if !self.anchored {
            // Without a pose these cells cannot be related to the cells of the next map.
            self.clear();
        }
    }
}
