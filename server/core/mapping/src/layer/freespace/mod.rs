//! The layer `freespace`, the layer to plan on: where the whole vehicle can drive. Not in the papers.
//!
//! In: the local ground, and what the vehicle can reach on it ([`Reach`]), by cell of 0.25 m to 64 m, ego frame. Out:
//! the layer on the same cells. The papers' layers judge a cell only if a return fell into it; here a cell is free if
//! the vehicle gets there and nothing closes it, whether a return fell into it or into the seen ground around it. The
//! vehicle's own outline is never occupied. Without a local ground all other cells are unknown. The steps:
//!
//! | step | where |
//! |---|---|
//! | what stands over the ground on both sides of it -> low cells | `low_things` |
//! | returns that lie deeper than the ground before them -> cells of drops | `drops` |
//! | the same that earlier maps found, where poses are known -> cells that this map does not show | `remembered` |
//! | the reach stage's flood, with these cells as barriers -> covered cells | [`crate::reach`] |
//! | gaps between rays that pass too high -> cells that are not free | `unproved` |
//! | even cells beside a step -> free cells | `releases` |
//! | gaps and patches too small for a vehicle -> occupied and hidden cells | `patches` |
//! | all of it -> the class of each cell, and if configured its height and its reason | `cells` |

mod cells;
pub mod class;
pub mod config;
mod drops;
mod low_things;
mod patches;
mod releases;
mod remembered;
mod unproved;

use crate::layer::channel::TypedChannel;
use crate::layer::class::count_cells;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::{CELL_M, SIDE, centre_m};
use crate::reach::config::ReachConfig;
use crate::reach::flood::Flood;
use crate::sensor::rays::ScanExtras;
use crate::sensor::sweep::Sweep;
use crate::vehicle_outline::Outline;

use cells::Findings;
use class::{FreespaceClass, HEIGHT, WHY};
use config::FreespaceConfig;
use drops::Drops;
use low_things::LowThings;
use patches::Patches;
use remembered::Remembered;
use unproved::Unproved;

/// Distance to the vehicle's outline within which nothing is low and no drop is found, metres. Ours: the returns of the
/// vehicle's own sides.
const OWN_M: f32 = 0.5;
/// Distance below which an outline touches a cell, metres: more than the rounding errors of a centre.
const ROUNDING_M: f32 = 1e-3;

/// Maker of the layer `freespace`. It reuses its buffers.
#[derive(Clone)]
pub struct Freespace {
    config: FreespaceConfig,
    low_things: LowThings,
    drops: Drops,
    remembered: Remembered,
    unproved: Unproved,
    patches: Patches,
    flood: Flood,
    barred: Bits,
    low: Bits,
    drop: Bits,
    free: Bits,
    /// The cells that only a step closes; in `released`, the free cells among them.
    stepped: Bits,
    released: Bits,
    /// The outline whose cells are known, the cells with their centres in it, the other cells that it touches, and the
    /// cells in it and around it.
    outline: Outline,
    vehicle: Vec<usize>,
    touched: Vec<usize>,
    own: Bits,
}

impl Freespace {
    /// A maker with validated parameters.
    pub fn new(config: &FreespaceConfig) -> Self {
        let bits = Bits::square(SIDE);
        let mut freespace = Self {
            config: config.clone(),
            low_things: LowThings::new(),
            drops: Drops::new(),
            remembered: Remembered::default(),
            unproved: Unproved::new(),
            patches: Patches::new(),
            flood: Flood::new(SIDE),
            barred: bits.clone(),
            low: bits.clone(),
            drop: bits.clone(),
            free: bits.clone(),
            stepped: bits.clone(),
            released: bits.clone(),
            outline: ReachConfig::default().outline(),
            vehicle: Vec::new(),
            touched: Vec::new(),
            own: bits,
        };
        freespace.set_outline(freespace.outline);
        freespace
    }

    fn geometry() -> Geometry {
        Geometry::about_vehicle(SIDE as u32, CELL_M)
    }

    fn set_outline(&mut self, outline: Outline) {
        self.outline = outline;
        self.vehicle.clear();
        self.touched.clear();
        self.own.clear();
        let (wide, touching) = (outline.grown_by(OWN_M), outline.grown_by(CELL_M / 2.0 + ROUNDING_M));
        for cell in 0..SIDE * SIDE {
            let [x, y] = centre_m(cell);
            if wide.contains(x, y) {
                self.own.set(cell % SIDE, cell / SIDE);
            }
            if outline.contains(x, y) {
                self.vehicle.push(cell);
            } else if touching.contains(x, y) {
                self.touched.push(cell);
            }
        }
    }

    /// Finds which cells are free, and what closes the others.
    fn find<'a>(&'a mut self, sweep: &Sweep, context: &Context<'_>, reach: &'a Reach) -> Findings<'a> {
        let Self {
            low_things,
            drops,
            remembered,
            unproved,
            patches,
            flood,
            barred,
            low,
            drop,
            free,
            stepped,
            released,
            vehicle,
            own,
            ..
        } = self;
        let [things, steps] = low_things.find(reach);
        low.copy_from(things);
        match context.ground {
            Some(ground) => drop.copy_from(drops.find(ground, reach, sweep.mount_height_m)),
            None => drop.clear(),
        }
        [&mut *low, &mut *drop].into_iter().for_each(|found| found.remove(own));
        remembered.add(context, reach, [low, drop]);
        barred.copy_from(steps);
        barred.remove(own);
        low.add(barred);
        low_things::find_backs(reach, low, barred);
        low.add(barred);
        // What the vehicle stands on does not close its way.
        for closed in [&mut *low, &mut *drop] {
            vehicle.iter().for_each(|cell| closed.clear_cell(cell % SIDE, cell / SIDE));
        }
        reach.flood_with([low, drop], barred, flood);
        let covered = flood.covered();
        free.copy_from(covered);
        [reach.bits().closed, &*low, &*drop].into_iter().for_each(|closed| free.remove(closed));
        free.remove(reach.outside());
        let unproved = unproved.find(context.ground, reach, sweep.mount_height_m);
        free.remove(unproved);
        reach.only_stepped(stepped);
        [&*low, &*drop].into_iter().for_each(|closed| stepped.remove(closed));
        released.clear();
        releases::find(reach, stepped, covered, free, |ix, iy| released.set(ix, iy));
        free.add(released);
        let blocked = patches.find(reach, unproved, [free, low, drop]);
        Findings { reach, blocked, low, drop, free }
    }
}

impl LayerMaker for Freespace {
    fn layer(&self) -> Layer {
        let mut channels = vec![TypedChannel::CLASS.empty()];
        channels.extend(self.config.height.then(|| HEIGHT.empty()));
        channels.extend(self.config.why.then(|| WHY.empty()));
        Layer::new("freespace", Self::geometry(), FreespaceClass::LEGEND, channels)
    }

    /// It floods the ground itself.
    fn uses(&self) -> ScanExtras {
        ScanExtras { ground: true, ..ScanExtras::default() }
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let outline = context.reach.map_or_else(|| ReachConfig::default().outline(), |reach| reach.config().outline());
        if outline != self.outline {
            self.set_outline(outline);
        }
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut height = self.config.height.then(|| HEIGHT.reuse(&mut layer.channels));
        let mut why = self.config.why.then(|| WHY.reuse(&mut layer.channels));
        match context.reach {
            Some(reach) => {
                let findings = self.find(sweep, context, reach);
                findings.write_classes(&mut class);
                height.iter_mut().for_each(|height| findings.write_heights(context, height));
                why.iter_mut().for_each(|why| findings.write_reasons(&class, why));
            }
            None => {
                class.resize(SIDE * SIDE, FreespaceClass::Unknown.value());
                height.iter_mut().for_each(|height| height.resize(SIDE * SIDE, HEIGHT.unknown));
                why.iter_mut().for_each(|why| why.resize(SIDE * SIDE, WHY.unknown));
            }
        }
        self.vehicle.iter().for_each(|cell| class[*cell] = FreespaceClass::Vehicle.value());
        // Of a cell that the vehicle fills in part a ray shows the rest at most; the vehicle itself stands there.
        let unseen =
            [FreespaceClass::Unknown, FreespaceClass::Hidden, FreespaceClass::NotReached].map(|unseen| unseen.value());
        for cell in &self.touched {
            if unseen.contains(&class[*cell]) {
                class[*cell] = FreespaceClass::Vehicle.value();
            }
        }
        layer.geometry = Self::geometry();
        layer.clear_lists();
        let free = count_cells(&class, FreespaceClass::Free.value());
        layer.metrics.push(("free_m2", free as f64 * f64::from(CELL_M * CELL_M)));
        TypedChannel::CLASS.store(&mut layer.channels, class);
        height.into_iter().for_each(|height| HEIGHT.store(&mut layer.channels, height));
        why.into_iter().for_each(|why| WHY.store(&mut layer.channels, why));
    }
}
