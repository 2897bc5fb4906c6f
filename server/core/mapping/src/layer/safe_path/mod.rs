//! Safe points (thesis §VI): places as far as can be from the obstacles on both sides, linked into paths that start at
//! the vehicle.
//!
//! In: the layer `drivability` of the same map, and its sweep. Out: the layer `safe_path`: points with radii and links,
//! and the Cartesian grid they were found on. The steps:
//!
//! | step | where |
//! |---|---|
//! | which cells are free: drivable ones, and those the sensor cannot see under the vehicle | [`free`] |
//! | exact distance to the nearest cell that is not free, and which one that is | [`distance`] |
//! | ridge: neighbouring cells with two nearest obstacles; its exact radii; thinned to one-cell lines | [`ridge`] |
//! | links between neighbours on the lines, from the vehicle on | [`links`] |
//!
//! Unknown ground is no way through: it counts like an obstacle, but for the blind zone and narrow holes ([`free`]).
//! The thesis keeps no more than the picture; here each point knows its radius (the thesis' safety radius), and is kept
//! where the vehicle fits: twice the radius is at least its width. What lies beyond the grid is not known to this map.

pub mod class;
pub mod config;
pub mod distance;
pub mod free;
pub mod links;
pub mod ridge;

use crate::layer::safe_path::config::SafePathConfig;
use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use class::SafePathClass;
use distance::Distances;
use free::{Free, State};
use links::Links;
use ridge::Ridge;

/// Makes the layer from map after map, reusing its buffers.
pub struct SafePath {
    config: SafePathConfig,
    free: Free,
    distances: Distances,
    ridge: Ridge,
    links: Links,
}

impl SafePath {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
    pub fn new(config: &SafePathConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        Self {
            config: config.clone(),
            free: Free::new(side, f64::from(config.cell_m)),
            distances: Distances::new(side),
            ridge: Ridge::new(side),
            links: Links::default(),
        }
    }

    fn write(&self, layer: &mut Layer) {
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        class.extend(self.free.states().iter().map(|state| {
            let class = match state {
                State::Unknown | State::Blind | State::Hole => SafePathClass::Unknown,
                State::Drivable => SafePathClass::Free,
                State::Obstacle => SafePathClass::Obstacle,
            };
            class.value()
        }));
        let side = self.free.side();
        let cell_m = f64::from(self.config.cell_m);
        layer.points.extend(self.links.points().iter().map(|point| point.in_metres(side, cell_m)));
        // The vehicle's own place lies between four cells.
        self.links.points().iter().skip(1).for_each(|point| class[point.cell] = SafePathClass::Path.value());
        TypedChannel::CLASS.store(&mut layer.channels, class);
        layer.metrics.extend([
            ("points", self.links.points().len() as f64),
            ("points_not_reached", self.links.not_reached() as f64),
        ]);
    }
}

impl LayerMaker for SafePath {
    fn layer(&self) -> Layer {
        let geometry = Geometry::about_vehicle(self.free.side() as u32, self.config.cell_m);
        Layer::new("safe_path", geometry, SafePathClass::LEGEND, vec![TypedChannel::CLASS.empty()])
    }

    fn needs(&self) -> &'static [&'static str] {
        &["drivability"]
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let drivability = context.earlier.iter().find(|layer| layer.name == "drivability");
        self.free.fill(drivability, sweep, &self.config);
        self.distances.measure(self.free.states());
        let width_cells = f64::from(self.config.vehicle_width_m) / f64::from(self.config.cell_m);
        self.ridge.find(self.free.states(), &self.distances, width_cells);
        let join_cells = f64::from(self.config.join_m_max) / f64::from(self.config.cell_m);
        self.links.link(&self.ridge, self.free.states(), &self.distances, width_cells, join_cells);
        layer.geometry = self.layer().geometry;
        self.write(layer);
    }
}
