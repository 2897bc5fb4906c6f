//! The layer `freespace`, the one to plan on: where the whole vehicle can drive. Not in the papers.
//!
//! In: what the vehicle can reach ([`Reach`](crate::reach::Reach)), by cell of 0.25 m to 64 m, ego frame. Out: the
//! layer on the same cells. A cell is free if the vehicle gets there and nothing closes it, whether a return fell into
//! it or into the seen ground around it; the papers' layers know only cells with a return. The vehicle's own outline is
//! never occupied. Without a local ground all other cells are unknown.

pub mod class;
pub mod config;

use crate::layer::channel::TypedChannel;
use crate::layer::class::count_cells;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::reach::ReachRows;
use crate::reach::cells::{CELL_M, SIDE, centre_m};
use crate::reach::config::ReachConfig;
use crate::sensor::sweep::Sweep;

use class::FreespaceClass;
use config::FreespaceConfig;

/// Number of cells of a word of bits.
const WORD: usize = 64;

/// Maker of the layer `freespace`.
#[derive(Clone)]
pub struct Freespace {}

impl Freespace {
    /// A maker with validated parameters.
    pub fn new(_config: &FreespaceConfig) -> Self {
        Self {}
    }

    fn geometry() -> Geometry {
        Geometry::about_vehicle(SIDE as u32, CELL_M)
    }
}

impl LayerMaker for Freespace {
    fn layer(&self) -> Layer {
        Layer::new("freespace", Self::geometry(), FreespaceClass::LEGEND, vec![TypedChannel::CLASS.empty()])
    }

    fn make(&mut self, _sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        match context.reach {
            Some(reach) => write_classes(&reach.rows(), &mut class),
            None => class.resize(SIDE * SIDE, FreespaceClass::Unknown.value()),
        }
        let outline = context.reach.map_or_else(|| ReachConfig::default().outline(), |reach| reach.config().outline());
        let is_vehicle = |cell: &usize| {
            let [x, y] = centre_m(*cell);
            outline.contains(x, y)
        };
        (0..SIDE * SIDE).filter(is_vehicle).for_each(|cell| class[cell] = FreespaceClass::Vehicle.value());
        layer.geometry = Self::geometry();
        layer.clear_lists();
        let free = count_cells(&class, FreespaceClass::Free.value());
        layer.metrics.push(("free_m2", free as f64 * f64::from(CELL_M * CELL_M)));
        TypedChannel::CLASS.store(&mut layer.channels, class);
    }
}

/// Writes the class of each cell but those of the vehicle.
fn write_classes(rows: &ReachRows<'_>, class: &mut Vec<u8>) {
    let words = rows.reached.iter().zip(rows.closed).zip(rows.open).zip(rows.hidden);
    class.extend(words.flat_map(|(((reached, closed), open), hidden)| {
        (0..WORD).map(move |bit| {
            let is = |word: &u64| word >> bit & 1 != 0;
            let class = match () {
                () if is(closed) => FreespaceClass::Occupied,
                () if is(reached) => FreespaceClass::Free,
                () if is(open) => FreespaceClass::NotReached,
                () if is(hidden) => FreespaceClass::Hidden,
                () => FreespaceClass::Unknown,
            };
            class.value()
        })
    }));
}
