//! Low things and drops that earlier maps found, and that this one does not show.
//!
//! In: the cells of low things and of drops of each map, and the ego pose. Out: the same with the cells that were found
//! again and again in the last five seconds. Too few returns fall onto a log far ahead to find it in every map, and
//! none when it lies nearer than the first ring. A cell is kept if it was found in two fifths of a second at least, and
//! in no more of them shown to be even. Things at the foot of something taller are left to the map that shows them:
//! they are the wheels and feet of what moves. So are steps, which every map shows at their place to a cell.
//!
//! Cells lie in the world frame. If a pose is missing or jumps, everything is forgotten.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3};

use crate::layer::maker::Context;
use crate::memory::config::GROUND_S_MAX;
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::blind_zone::is_of_ground;
use crate::reach::cells::{CELL_M, SIDE, cell, centre_m};

/// Time in which maps count once, ns. Ours: a sensor's rings move by a cell's side in it at 1.25 m/s.
const SLOT_NS: i64 = 200_000_000;
/// Number of slots that are remembered: as long as the ground is.
const SLOTS: u32 = (GROUND_S_MAX * 1e9 / SLOT_NS as f32) as u32;
/// Least number of slots in which a cell was found. Ours: one map may err; 3 finds a log seen by 32 lasers 1 m later.
const FOUND_MIN: u32 = 2;

/// Low, and a drop.
const KINDS: usize = 2;

/// When a cell was found, and when it was seen to be even: a bit for each slot, the newest first.
#[derive(Clone, Copy, Default)]
struct Sightings {
    /// The slot of the first bit.
    newest: i64,
    found: [u32; KINDS],
    even: u32,
}

impl Sightings {
    /// The same at a later slot.
    fn at(self, slot: i64) -> Self {
        let slots_later = (slot - self.newest).clamp(0, i64::from(SLOTS)) as u32;
        let later = |bits: u32| bits.checked_shl(slots_later).unwrap_or(0) & ((1 << SLOTS) - 1);
        Self { newest: slot, found: self.found.map(later), even: later(self.even) }
    }

    /// True if no map of the last five seconds found the cell.
    fn is_forgotten(self) -> bool {
        self.found == [0; KINDS]
    }

    /// Whether the cell is kept as low, and as a drop.
    fn kept(self) -> [bool; KINDS] {
        self.found.map(|found| {
            // What was even before it was first found says nothing: a memory that began later does not know of it.
            let since = found.checked_ilog2().map_or(0, |oldest| (1 << oldest) - 1);
            found.count_ones() >= FOUND_MIN && (self.even & since).count_ones() <= found.count_ones()
        })
    }
}

/// The memory of low things and drops.
#[derive(Clone, Default)]
pub struct Remembered {
    /// By cell of the world.
    cells: BTreeMap<[i32; 2], Sightings>,
    /// How often the memory of the ground had forgotten everything at the newest map.
    forgotten: u64,
}

impl Remembered {
    /// Remembers what the newest map found, and adds what earlier maps found. Without a pose or a memory nothing is.
    pub fn add(&mut self, context: &Context<'_>, reach: &Reach, found: [&mut Bits; KINDS]) {
        let (Some(memory), Some(map_from_ego)) = (context.memory, &context.map_from_ego) else {
            self.cells.clear();
            return;
        };
        if std::mem::replace(&mut self.forgotten, memory.drops) != memory.drops {
            self.cells.clear();
        }
        let slot = context.stamp_ns.div_euclid(SLOT_NS);
        self.cells.values_mut().for_each(|sightings| *sightings = sightings.at(slot));
        self.cells.retain(|_, sightings| !sightings.is_forgotten());
        self.remember(map_from_ego, reach, [&*found[0], &*found[1]], slot);
        self.recall(map_from_ego, found);
    }

    fn remember(&mut self, map_from_ego: &Isometry3<f64>, reach: &Reach, found: [&Bits; KINDS], slot: i64) {
        for (kind, found) in found.into_iter().enumerate() {
            found.each(|ix, iy| {
                if is_of_ground(ix, iy, |cell| reach.obstacles().height_m(cell)) {
                    let new = Sightings { newest: slot, ..Sightings::default() };
                    self.cells.entry(world_cell(map_from_ego, ix, iy)).or_insert(new).found[kind] |= 1;
                }
            });
        }
        for (world, sightings) in &mut self.cells {
            let Some([ix, iy]) = ego_cell(map_from_ego, *world) else { continue };
            let is_found = found.iter().any(|found| found.get(ix, iy));
            sightings.even |= u32::from(!is_found && reach.seen_now().get(ix, iy));
        }
    }

    /// Adds the cells whose middles lie in a cell of the world that is kept: the axes of both grids differ.
    fn recall(&self, map_from_ego: &Isometry3<f64>, mut found: [&mut Bits; KINDS]) {
        for (world, sightings) in &self.cells {
            let Some([ix, iy]) = ego_cell(map_from_ego, *world).filter(|cell| is_inside(*cell)) else { continue };
            let around = (iy - 1..=iy + 1).flat_map(|iy| (ix - 1..=ix + 1).map(move |ix| [ix, iy]));
            for (found, _) in found.iter_mut().zip(sightings.kept()).filter(|(_, is_kept)| *is_kept) {
                let is_in_it = |[x, y]: &[usize; 2]| world_cell(map_from_ego, *x, *y) == *world;
                around.clone().filter(is_in_it).for_each(|[ix, iy]| found.set(ix, iy));
            }
        }
    }
}

/// True if a cell is not at the border of the grid.
fn is_inside(cell: [usize; 2]) -> bool {
    cell.iter().all(|index| (1..SIDE - 1).contains(index))
}

/// The world's cell in which the middle of a cell lies.
fn world_cell(map_from_ego: &Isometry3<f64>, ix: usize, iy: usize) -> [i32; 2] {
    let [x, y] = centre_m(iy * SIDE + ix).map(f64::from);
    let point = map_from_ego * Point3::new(x, y, 0.0);
    [point.x, point.y].map(|metres| (metres / f64::from(CELL_M)).floor() as i32)
}

/// Column and row of the cell in which the middle of a world's cell lies; `None` beyond the grid.
fn ego_cell(map_from_ego: &Isometry3<f64>, world: [i32; 2]) -> Option<[usize; 2]> {
    let [x, y] = world.map(|index| (f64::from(index) + 0.5) * f64::from(CELL_M));
    let level_m = map_from_ego.translation.z;
    let point = map_from_ego.inverse_transform_point(&Point3::new(x, y, level_m)).cast::<f32>();
    let cell = cell(point.x, point.y) as usize;
    (cell < SIDE * SIDE).then_some([cell % SIDE, cell / SIDE])
}
