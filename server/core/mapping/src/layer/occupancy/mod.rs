//! Omni-directional view of what is about the vehicle (Seo 2014 §2): which cells are free, taken, hidden or out of
//! sight, from every scan of any number of LIDARs at their own rates.
//!
//! In: [`Rays`], one sensor's turn or scan after the other. Out: the layer `occupancy`, 400 x 400 cells of 0.25 m about
//! the vehicle, their axes the world's. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | a square that scrolls with the vehicle | §2 ("ScrollingByteMap") | [`window`] |
//! | rays to hits, and to lines traced outward from the sensor | algorithm 1 | [`fan`], [`way`] |
//! | evidence to states; hits fade | figure 4 | [`states`] |
//! | how many hits make a cell occupied | figure 5 | [`Occupancy::hits_needed`] |
//!
//! Three readings go beyond the paper's words. (1) A ray proves a cell free only where it is low over it, so that a
//! sensor on the roof, whose rays pass over cars, serves like one in the bumper ([`fan`]). (2) Cells are judged when
//! the map is written: a scan costs its points, a map one set of lines a sensor and one pass over the grid. (3) A
//! vehicle whose speed nobody knows is taken to be fast, where two hits suffice: the other way an obstacle would wait
//! for twenty.
//!
//! Hits add up over maps, so a single Velodyne at 10 Hz on a standing vehicle names near cars at once and far ones
//! after some turns; until then their cells are unknown, with the power of two that their hits reach beside, or
//! occluded where something hides them as well. Heights of returns are over the plane under the vehicle, or over the
//! ground about them where that dips; those of rays that come back from the ground, over the line from there to the
//! return.
//!
//! Without an ego pose nobody can say where last map's cells are now: the grid is then the vehicle's own and holds only
//! what was seen since the last map (`world_aligned` is 0).

pub mod class;
pub mod config;
pub mod fan;
pub mod states;
pub mod way;
pub mod window;

use crate::layer::occupancy::config::OccupancyConfig;
use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker, Rays, ScanExtras};
use crate::sensor::sweep::Sweep;

use class::{HITS, OccupancyClass};
use fan::Fan;
use window::Window;

/// Gathers rays, makes the layer.
pub struct Occupancy {
    config: OccupancyConfig,
    window: Window,
    fan: Fan,
    speed_mps: Option<f64>,
}

impl Occupancy {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
    pub fn new(config: &OccupancyConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        // Sensors sit within the grid's quarter about the vehicle; one farther out traces as far as this.
        let reach_m = 1.5 * std::f32::consts::SQRT_2 * config.extent_m;
        Self {
            config: config.clone(),
            window: Window::new(side, f64::from(config.cell_m)),
            fan: Fan::new(reach_m.min(config.range_m_max), config.cell_m),
            speed_mps: None,
        }
    }

    /// Returns that make a cell occupied at a speed (figure 5): linear between the two configured, constant beyond.
    pub fn hits_needed(config: &OccupancyConfig, speed_mps: Option<f64>) -> u8 {
        let (slow, fast) = (f64::from(config.speed_mps_slow), f64::from(config.speed_mps_fast));
        let share = speed_mps.map_or(1.0, |speed| ((speed.abs() - slow) / (fast - slow)).clamp(0.0, 1.0));
        let (at_slow, at_fast) = (f64::from(config.hits_slow), f64::from(config.hits_fast));
        (at_slow + share * (at_fast - at_slow)).ceil() as u8
    }

    fn geometry(&self) -> Geometry {
        let (side, place) = (self.window.side() as u32, self.window.place());
        let corner = place.cells.map(|cells| -cells * f64::from(self.config.cell_m));
        Geometry::Cartesian {
            origin_x_m: corner[0],
            origin_y_m: corner[1],
            width: side,
            height: side,
            cell_m: self.config.cell_m,
            yaw_rad: place.yaw_rad,
            first_cell: self.window.corner(),
        }
    }

    /// The layer of the rays taken since the last map and since `earliest_ns`, where the window is now.
    fn write(&mut self, earliest_ns: i64, layer: &mut Layer) {
        let needed = Self::hits_needed(&self.config, self.speed_mps);
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut hits = HITS.reuse(&mut layer.channels);
        let cells = self.window.side() * self.window.side();
        class.resize(cells, 0);
        hits.resize(cells, 0);
        let any = self.fan.tell(&self.config, earliest_ns, &self.window, &mut class);
        self.window.judge([needed, self.config.hold_maps], any, &mut class, &mut hits);
        let share = |of: OccupancyClass| class.iter().filter(|class| **class == of.value()).count() as f64 / cells as f64;
        layer.metrics.extend([
            ("clear_share", share(OccupancyClass::Clear)),
            ("occupied_share", share(OccupancyClass::Occupied)),
            ("hits_needed", f64::from(needed)),
            ("world_aligned", f64::from(u8::from(self.window.anchored()))),
        ]);
        TypedChannel::CLASS.store(&mut layer.channels, class);
        HITS.store(&mut layer.channels, hits);
        layer.geometry = self.geometry();
    }
}

impl LayerMaker for Occupancy {
    fn layer(&self) -> Layer {
        let channels = vec![TypedChannel::CLASS.empty(), HITS.empty()];
        Layer::new("occupancy", self.geometry(), OccupancyClass::LEGEND, channels)
    }

    fn uses(&self) -> ScanExtras {
        ScanExtras { no_returns: self.config.no_return_m > 0.0, ..ScanExtras::default() }
    }

    fn integrate(&mut self, rays: &Rays<'_>) {
        // An empty scan is no evidence of free space.
        if rays.returns.x.is_empty() && rays.no_returns.is_empty() {
            return;
        }
        self.speed_mps = rays.speed_mps;
        if !self.window.follow(rays.map_from_ego.as_ref()) {
            self.fan.forget();
        }
        self.fan.take(rays, &self.config, &mut self.window);
    }

    fn make(&mut self, _: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        // The map may be some way on from the last rays. Where no pose says so, the grid stays where they were taken.
        if let Some(pose) = context.map_from_ego.as_ref().filter(|_| self.window.anchored()) {
            self.window.follow(Some(pose));
        }
        self.write(context.earliest_ns, layer);
    }
}
