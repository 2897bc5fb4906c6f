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

pub mod distance;
pub mod free;
pub mod links;
pub mod ridge;

use crate::config::SafePathConfig;
use crate::map::{Cells, Channel, Context, Geometry, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use distance::Distances;
use free::{Free, State};
use links::Links;
use ridge::Ridge;

/// Nothing is known of the cell.
pub const UNKNOWN: u8 = 0;
/// Drivable, says `drivability`.
pub const FREE: u8 = 1;
/// Seen, and not drivable.
pub const OBSTACLE: u8 = 2;
/// Drivable, and a safe point the vehicle gets to lies in it.
pub const PATH: u8 = 3;
/// Names of the classes, by value.
pub const LEGEND: &[&str] = &["unknown", "free", "obstacle", "path"];

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
        let [class] = &mut layer.channels[..] else { unreachable!("layer() gives one channel") };
        let Cells::U8(class) = &mut class.cells else { unreachable!("layer() gives u8") };
        class.clear();
        class.extend(self.free.states().iter().map(|state| match state {
            State::Unknown | State::Blind | State::Hole => UNKNOWN,
            State::Drivable => FREE,
            State::Obstacle => OBSTACLE,
        }));
        let side = self.free.side();
        let cell_m = f64::from(self.config.cell_m);
        layer.points.extend(self.links.points().iter().map(|point| point.in_metres(side, cell_m)));
        // The vehicle's own place lies between four cells.
        self.links.points().iter().skip(1).for_each(|point| class[point.cell] = PATH);
        layer.figures.extend([
            ("points", self.links.points().len() as f64),
            ("points_not_reached", self.links.not_reached() as f64),
        ]);
    }
}

impl LayerMaker for SafePath {
    fn layer(&self) -> Layer {
        let geometry = Geometry::about_vehicle(self.free.side() as u32, self.config.cell_m);
        Layer::new("safe_path", geometry, LEGEND, vec![Channel::class()])
    }

    fn needs(&self) -> &'static [&'static str] {
        &["drivability"]
    }

    /// Without another layer nothing is known.
    fn make(&mut self, sweep: &Sweep, layer: &mut Layer) {
        self.make_with(sweep, &Context::default(), layer);
    }

    fn make_with(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
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
