//! The list of the layers, their configuration, and which layers are active.
//!
//! In: the configuration, the names of the layers with subscribers, scans and map sweeps. Out: the active layers,
//! in the order of the list. A layer that is not active has no maker: it costs no time and no memory.

use serde::{Deserialize, Serialize};

use crate::ground::config::GroundConfig;
use crate::layer::drivability::Drivability;
use crate::layer::drivability::config::DrivabilityConfig;
use crate::layer::freespace::Freespace;
use crate::layer::freespace::config::FreespaceConfig;
use crate::layer::height_difference::HeightDifference;
use crate::layer::height_difference::config::HeightDifferenceConfig;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::layer::occupancy::Occupancy;
use crate::layer::occupancy::config::{OccupancyConfig, OccupancyVariant};
use crate::layer::own_outline;
use crate::layer::radial_points::RadialPoints;
use crate::layer::safe_path::SafePath;
use crate::layer::safe_path::config::SafePathConfig;
use crate::layer::speed::Speed;
use crate::layer::speed::config::SpeedConfig;
use crate::layer::terrain::Terrain;
use crate::layer::terrain::config::TerrainConfig;
use crate::memory::config::MemoryConfig;
use crate::reach::config::ReachConfig;
use crate::sensor::motion::MotionConfig;
use crate::sensor::rays::{Rays, ScanExtras};
use crate::sensor::sweep::Sweep;
use crate::value_check::{ConfigValueError, check};

/// Creates the maker of one layer; `None` if the configuration disables the layer.
type Create = fn(&MapsConfig) -> Option<Box<dyn LayerMaker>>;

/// Declares the layers: a name, the type of the maker and the type of the configuration each. The macro writes
/// [`MapsConfig`], with one table for each layer, and the list of their makers.
macro_rules! layers {
    ($($(#[$doc:meta])* $name:ident: $Maker:ty, $Config:ty;)+) => {
        /// The table `[vehicle.maps]`: which layers are made, each in its own table. A disabled layer costs nothing.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct MapsConfig {
            /// Age after capture from which a map is stale, milliseconds. 300 is ours: three revolutions at 10 Hz.
            pub valid_ms: u32,
            /// How the points of a scan are moved to its end. The file has no key of it.
            #[serde(skip_serializing)]
            pub motion: MotionConfig,
            /// Ground that is carried from map to map.
            pub memory: MemoryConfig,
            /// What heights over the ground are taken over.
            pub ground: GroundConfig,
            /// The vehicle's outline, and what it can reach.
            pub reach: ReachConfig,
            $($(#[$doc])* pub $name: $Config,)+
        }

        impl Default for MapsConfig {
            fn default() -> Self {
                Self {
                    valid_ms: 300,
                    motion: MotionConfig::default(),
                    memory: MemoryConfig::default(),
                    ground: GroundConfig::default(),
                    reach: ReachConfig::default(),
                    $($name: <$Config>::default(),)+
                }
            }
        }

        impl MapsConfig {
            /// A configuration that disables all layers.
            pub fn none() -> Self {
                let mut maps = Self::default();
                $(maps.$name.enabled = false;)+
                maps
            }

            /// The configuration in which the layers take the overhang of `reach`.
            pub(crate) fn with_one_overhang(&self) -> Self {
                let mut maps = self.clone();
                maps.drivability.overhang_m = self.reach.overhang_m;
                maps.terrain.overhang_m = self.reach.overhang_m;
                maps.speed.overhang_m = self.reach.overhang_m;
                if maps.occupancy.variant == OccupancyVariant::Polar {
                    maps.occupancy.overhang_m = self.reach.overhang_m;
                }
                maps
            }

            /// Checks all values of all layers, enabled or not.
            ///
            /// # Errors
            /// [`ConfigValueError`] for the first value that is not allowed.
            pub fn validate(&self) -> Result<(), ConfigValueError> {
                check(f64::from(self.valid_ms), 1.0..=60_000.0, || "vehicle.maps.valid_ms".into(), "1 to 60000")?;
                self.reach.validate("vehicle.maps.reach")?;
                let maps = self.with_one_overhang();
                $(maps.$name.validate(concat!("vehicle.maps.", stringify!($name)))?;)+
                Ok(())
            }
        }

        /// The page of each layer, Markdown with a table of its classes, by the layer's name.
        pub const PAGES: &[(&str, &str)] =
            &[$((stringify!($name), include_str!(concat!(stringify!($name), "/README.md")))),+];

        const LAYERS: &[Create] = &[$(|maps| {
            let config = &maps.$name;
            if config.enabled { Some(Box::new(<$Maker>::new(config))) } else { None }
        },)+];
    };
}

// A layer that is made from others comes after them.
layers! {
    /// The layer `drivability` (UT Austin thesis, section IV).
    drivability: Drivability, DrivabilityConfig;
    /// The layer `height_difference` (UT Austin thesis, section V).
    height_difference: HeightDifference, HeightDifferenceConfig;
    /// The layer `terrain` (Neuhaus 2009).
    terrain: Terrain, TerrainConfig;
    /// The layer `occupancy` (Seo 2014).
    occupancy: Occupancy, OccupancyConfig;
    /// The layer `speed` (Lindström 2005).
    speed: Speed, SpeedConfig;
    /// The layer `safe_path` (UT Austin thesis, section VI).
    safe_path: SafePath, SafePathConfig;
    /// The layer `freespace`, the layer to plan on.
    freespace: Freespace, FreespaceConfig;
}

/// The enabled layers, active or not.
#[derive(Clone)]
pub(crate) struct Layers {
    layers: Vec<EnabledLayer>,
    /// The radial cells of the newest map's points, for each size that active layers use.
    radial: Vec<RadialPoints>,
}

/// One layer that the configuration enables.
#[derive(Clone)]
struct EnabledLayer {
    name: &'static str,
    create: Create,
    /// True if the layer itself has a subscriber.
    subscribed: bool,
    /// How often the layer was made.
    made: u64,
    /// The layer's maker; `None` while the layer is not active.
    active: Option<Active>,
}

/// The maker of an active layer.
#[derive(Clone)]
struct Active {
    maker: Box<dyn LayerMaker>,
    /// The layer's memory while it is in no map.
    spare: Option<Layer>,
}

impl Active {
    fn new(maker: Box<dyn LayerMaker>) -> Self {
        Self { spare: Some(maker.layer()), maker }
    }
}

impl Layers {
    /// All enabled layers, all active.
    pub fn new(maps: &MapsConfig) -> Self {
        let enabled = |&create: &Create| {
            let maker = create(maps)?;
            let name = maker.layer().name;
            Some(EnabledLayer { name, create, subscribed: true, made: 0, active: Some(Active::new(maker)) })
        };
        Self { layers: LAYERS.iter().filter_map(enabled).collect(), radial: Vec::new() }
    }

    /// Name of each enabled layer, and how often it was made.
    pub fn made(&self) -> Vec<(&'static str, u64)> {
        self.layers.iter().map(|layer| (layer.name, layer.made)).collect()
    }

    /// True if any layer is active.
    pub fn any_active(&self) -> bool {
        self.layers.iter().any(|layer| layer.active.is_some())
    }

    /// The optional data of each scan that the active layers use.
    pub fn uses(&self) -> ScanExtras {
        let active = self.layers.iter().filter_map(|layer| layer.active.as_ref());
        active.map(|active| active.maker.uses()).fold(ScanExtras::default(), |all, uses| ScanExtras {
            ground: all.ground || uses.ground,
            reached: all.reached || uses.reached,
            deviations: all.deviations || uses.deviations,
            no_returns: all.no_returns || uses.no_returns,
        })
    }

    /// Activates the layers for which `is_subscribed` is true and those they are made from, and deactivates all others.
    /// A layer that was not active starts without evidence. Returns true if the subscriptions changed.
    pub fn set_active(&mut self, maps: &MapsConfig, is_subscribed: impl Fn(&str) -> bool) -> bool {
        let mut changed = false;
        for layer in &mut self.layers {
            let subscribed = is_subscribed(layer.name);
            changed |= layer.subscribed != subscribed;
            layer.subscribed = subscribed;
        }
        if changed {
            self.assign_makers(maps);
        }
        changed
    }

    /// Gives a maker to each layer that is subscribed to, or that an active layer is made from, and to no other.
    fn assign_makers(&mut self, maps: &MapsConfig) {
        let mut needed: Vec<&str> = Vec::new();
        // Backwards, because a layer is made from earlier ones only.
        for layer in self.layers.iter_mut().rev() {
            if !layer.subscribed && !needed.contains(&layer.name) {
                layer.active = None;
                continue;
            }
            if layer.active.is_none() {
                layer.active = (layer.create)(maps).map(Active::new);
            }
            needed.extend(layer.active.iter().flat_map(|active| active.maker.needs()));
        }
    }

    /// Adds the evidence of one sensor's scan to the active layers.
    pub fn integrate(&mut self, rays: &Rays<'_>) {
        self.layers
            .iter_mut()
            .filter_map(|layer| layer.active.as_mut())
            .for_each(|active| active.maker.integrate(rays));
    }

    /// Makes the active layers of one map, in place of those in `layers`, whose memory is used again.
    pub fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layers: &mut Vec<Layer>) {
        for made in layers.drain(..) {
            let layer = self.layers.iter_mut().find(|layer| layer.name == made.name);
            if let Some(active) = layer.and_then(|layer| layer.active.as_mut()) {
                active.spare = Some(made);
            }
        }
        self.find_radial_cells(sweep, context);
        for layer in &mut self.layers {
            let Some(Active { maker, spare }) = &mut layer.active else { continue };
            let mut made = spare.take().unwrap_or_else(|| maker.layer());
            maker.make(sweep, &Context { earlier: layers, radial: &self.radial, ..*context }, &mut made);
            if let Some(reach) = context.reach {
                own_outline::clear(&mut made, &reach.config().outline());
            }
            layers.push(made);
            layer.made += 1;
        }
    }

    /// Finds the radial cells of the points, once for each size.
    fn find_radial_cells(&mut self, sweep: &Sweep, context: &Context<'_>) {
        let makers = self.layers.iter().filter_map(|layer| layer.active.as_ref()).map(|active| &active.maker);
        let sizes = || makers.clone().filter_map(|maker| maker.radial_size());
        self.radial.retain(|shared| sizes().any(|size| size == shared.size()));
        for size in sizes() {
            if !self.radial.iter().any(|shared| shared.size() == size) {
                self.radial.push(RadialPoints::new(size));
            }
        }
        self.radial.iter_mut().for_each(|shared| shared.find(sweep, context.azimuths()));
    }
}
