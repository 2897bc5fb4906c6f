//! The layers of a vehicle's maps: which are switched on, which are wanted, and who makes them.
//!
//! In: the configuration, what readers want, turns and map sweeps. Out: the wanted layers, in the order of the
//! configuration, each behind those it is made from. What nobody wants has no maker: it takes no time and no memory.

use crate::config::MapsConfig;
use crate::layer::drivability::Drivability;
use crate::layer::height_difference::HeightDifference;
use crate::sensor::pipeline::Wanted;
use crate::map::{Context, Layer, LayerMaker, Rays};
use crate::layer::occupancy::Occupancy;
use crate::layer::safe_path::SafePath;
use crate::layer::speed::Speed;
use crate::sensor::sweep::Sweep;
use crate::layer::terrain::Terrain;

/// Makes the maker of one layer.
type New = fn(&MapsConfig) -> Box<dyn LayerMaker>;

/// All layers that are switched on.
pub(crate) struct Layers(Vec<Slot>);

/// One layer that is switched on.
struct Slot {
    name: &'static str,
    new: New,
    /// Whether somebody wants it for itself.
    asked: bool,
    made: u64,
    /// While it is wanted: its maker, and its cells while they are in no map.
    wanted: Option<(Box<dyn LayerMaker>, Option<Layer>)>,
}

impl Layers {
    /// All wanted.
    pub fn new(maps: &MapsConfig) -> Self {
        let all: [(bool, New); 6] = [
            (maps.drivability.enabled, |maps| Box::new(Drivability::new(&maps.drivability))),
            (maps.height_difference.enabled, |maps| Box::new(HeightDifference::new(&maps.height_difference))),
            (maps.terrain.enabled, |maps| Box::new(Terrain::new(&maps.terrain))),
            (maps.occupancy.enabled, |maps| Box::new(Occupancy::new(&maps.occupancy))),
            (maps.speed.enabled, |maps| Box::new(Speed::new(&maps.speed))),
            // Behind the layers whose obstacles it keeps away from.
            (maps.safe_path.enabled, |maps| Box::new(SafePath::new(&maps.safe_path))),
        ];
        let slot = |(_, new): (bool, New)| {
            let maker = new(maps);
            let layer = maker.layer();
            Slot { name: layer.name, new, asked: true, made: 0, wanted: Some((maker, Some(layer))) }
        };
        Self(all.into_iter().filter(|(enabled, _)| *enabled).map(slot).collect())
    }

    /// By layer: how often it was made.
    pub fn made(&self) -> Vec<(&'static str, u64)> {
        self.0.iter().map(|slot| (slot.name, slot.made)).collect()
    }

    /// Whether any layer is wanted.
    pub fn are_wanted(&self) -> bool {
        self.0.iter().any(|slot| slot.wanted.is_some())
    }

    /// What the wanted layers want of every turn.
    pub fn wanted(&self) -> Wanted {
        let any = |asks: fn(&dyn LayerMaker) -> bool| {
            self.0.iter().filter_map(|slot| slot.wanted.as_ref()).any(|(maker, _)| asks(&**maker))
        };
        Wanted { deviations: any(|maker| maker.wants_deviations()), no_returns: any(|maker| maker.wants_no_returns()) }
    }

    /// Wants these layers and those they are made from, and no other. One that was not wanted begins anew. Tells
    /// whether these are others than before.
    pub fn want(&mut self, maps: &MapsConfig, is_wanted: impl Fn(&str) -> bool) -> bool {
        let mut changed = false;
        for slot in &mut self.0 {
            let asked = is_wanted(slot.name);
            changed |= slot.asked != asked;
            slot.asked = asked;
        }
        if changed {
            self.assign(maps);
        }
        changed
    }

    /// A maker for each layer that is asked for or needed by one that is, and for no other.
    fn assign(&mut self, maps: &MapsConfig) {
        let mut needed: Vec<&str> = Vec::new();
        // A layer is made from earlier ones only.
        for slot in self.0.iter_mut().rev() {
            if !slot.asked && !needed.contains(&slot.name) {
                slot.wanted = None;
                continue;
            }
            let (maker, _) = slot.wanted.get_or_insert_with(|| {
                let maker = (slot.new)(maps);
                let layer = maker.layer();
                (maker, Some(layer))
            });
            needed.extend(maker.needs());
        }
    }

    /// Shows a sensor's turn to the layers that gather evidence.
    pub fn take(&mut self, rays: &Rays<'_>) {
        self.0.iter_mut().filter_map(|slot| slot.wanted.as_mut()).for_each(|(maker, _)| maker.take(rays));
    }

    /// Makes the wanted layers of one sweep, in place of those in `layers`, whose cells are used again.
    pub fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layers: &mut Vec<Layer>) {
        for layer in layers.drain(..) {
            let slot = self.0.iter_mut().find(|slot| slot.name == layer.name);
            if let Some((_, cells)) = slot.and_then(|slot| slot.wanted.as_mut()) {
                *cells = Some(layer);
            }
        }
        for slot in &mut self.0 {
            let Some((maker, cells)) = &mut slot.wanted else { continue };
            let mut layer = cells.take().unwrap_or_else(|| maker.layer());
            maker.make_with(sweep, &Context { earlier: layers, ..*context }, &mut layer);
            layers.push(layer);
            slot.made += 1;
        }
    }
}
