//! The layer `safe_path` (UT Austin thesis, section VI): safe points, which are as far as possible from the obstacles
//! on both sides, linked into paths that start at the vehicle.
//!
//! In: the layers `drivability` and `occupancy` of the same map, its sweep, and what the vehicle can reach. Out: the
//! layer: points with radii and links, and the Cartesian grid on which they were found. The steps:
//!
//! | step | where |
//! |---|---|
//! | free space: drivable cells, and cells near the vehicle that the sensor cannot see | [`free_space`] |
//! | distance transform: exact distance to the nearest cell that is not free, and that cell | [`distance`] |
//! | medial axis: cells with two nearest obstacles; its exact radii; thinned to lines one cell wide | [`medial_axis`] |
//! | links between neighbours on the lines, starting at the vehicle | [`links`] |
//!
//! Unknown ground counts as an obstacle, except in the blind zone and in narrow holes ([`free_space`]). The thesis
//! shows only a picture; here each point has its radius (the safety radius of the thesis), and is kept if the vehicle
//! fits there: if twice the radius is at least the vehicle's width. Ground beyond the grid is not considered.

pub mod class;
pub mod config;
pub mod distance;
pub mod free_space;
pub mod links;
pub mod medial_axis;

use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::reach::config::ReachConfig;
use crate::sensor::sweep::Sweep;

use class::SafePathClass;
use config::{JOIN_M_MAX, SafePathConfig};
use distance::Distances;
use free_space::{FreeSpace, State};
use links::Links;
use medial_axis::MedialAxis;

/// Maker of the layer `safe_path`. It reuses its buffers from map to map.
#[derive(Clone)]
pub struct SafePath {
    config: SafePathConfig,
    free_space: FreeSpace,
    distances: Distances,
    medial_axis: MedialAxis,
    links: Links,
    /// Memory of the links of the newest layer's points.
    spare: Vec<Vec<u32>>,
}

impl SafePath {
    /// A maker with validated parameters.
    pub fn new(config: &SafePathConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        Self {
            config: config.clone(),
            free_space: FreeSpace::new(side, f64::from(config.cell_m)),
            distances: Distances::new(side),
            medial_axis: MedialAxis::new(side),
            links: Links::default(),
            spare: Vec::new(),
        }
    }

    fn geometry(&self) -> Geometry {
        Geometry::about_vehicle(self.free_space.side() as u32, self.config.cell_m)
    }

    fn write(&mut self, layer: &mut Layer) {
        self.spare.extend(layer.points.drain(..).map(|point| point.links));
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        class.extend(self.free_space.states().iter().map(|state| {
            let class = match state {
                State::Unknown | State::Blind | State::Hole => SafePathClass::Unknown,
                State::Drivable | State::Apart => SafePathClass::Free,
                State::Obstacle => SafePathClass::Obstacle,
                State::NotReached => SafePathClass::NotReached,
            };
            class.value()
        }));
        let side = self.free_space.side();
        let cell_m = f64::from(self.config.cell_m);
        for point in self.links.points() {
            layer.points.push(point.in_metres(side, cell_m, self.spare.pop().unwrap_or_default()));
        }
        // The first point is the vehicle's own position, which lies between four cells.
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
        Layer::new("safe_path", self.geometry(), SafePathClass::LEGEND, vec![TypedChannel::CLASS.empty()])
    }

    fn needs(&self) -> &'static [&'static str] {
        &["drivability", "occupancy"]
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let outline = context.reach.map_or_else(|| ReachConfig::default().outline(), |reach| reach.config().outline());
        self.free_space.update(sweep, context, &outline);
        self.distances.compute(self.free_space.states());
        let width_cells = f64::from(outline.width_m) / f64::from(self.config.cell_m);
        self.medial_axis.find(self.free_space.states(), &self.distances, width_cells);
        let join_cells = f64::from(JOIN_M_MAX) / f64::from(self.config.cell_m);
        self.links.link(&self.medial_axis, self.free_space.states(), &self.distances, width_cells, join_cells);
        layer.geometry = self.geometry();
        self.write(layer);
    }
}
