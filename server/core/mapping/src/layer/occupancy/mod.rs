//! The layer `occupancy` (Seo 2014, section 2): which cells around the vehicle are free, occupied, hidden or out of
//! range, from each scan of any number of LIDARs at their own rates.
//!
//! In: [`Rays`], one sensor's scan after the other. Out: the layer, by default 400 x 400 cells of 0.25 m around the
//! vehicle, along the axes of the world. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | a square that scrolls with the vehicle | section 2 ("ScrollingByteMap") | [`window`] |
//! | rays -> hits, and -> evidence along rays, outward | algorithm 1 | [`lines`]; [`polar_scan`], [`ray`] |
//! | evidence -> states; hits fade | figure 4 | [`states`] |
//! | cells at the border of a shadow do not flicker | not in the paper | [`flicker`] |
//! | number of hits that make a cell occupied | figure 5 | [`Occupancy::hits_needed`] |
//!
//! There are two variants ([`OccupancyVariant`]): `paper` traces a line for each return, as published; `polar` differs:
//! - A ray proves a cell free only if it passes low over it. So a sensor on the roof, whose rays pass over cars, can be
//!   used like one in the bumper ([`polar_scan`]).
//! - The returns of a scan are collected by azimuth, and one ray for each azimuth is traced when the map is made. A
//!   scan costs its points; a map costs one set of rays for each sensor and one pass over the grid.
//!
//! Where both differ from the paper:
//! - If the vehicle's speed is not known, it is assumed to be fast, so that two hits suffice. Otherwise an obstacle
//!   would need twenty.
//! - The channel `hits` has 255 in occupied cells and a power of two in unknown ones, unless `hits = "counted"`.
//!
//! Hits add up over maps. A single Velodyne at 10 Hz on a standing vehicle reports near cars as occupied at once, and
//! far ones after some scans. Until then their cells are unknown, or occluded if something hides them as well. Heights
//! are heights over the local ground ([`crate::ground`]).
//!
//! Without an ego pose the cells of the last map cannot be related to the cells of this map. The grid then has the
//! vehicle's axes and contains only evidence since the last map (the metric `world_aligned` is 0).

mod azimuth_bins;
mod bits;
mod chunk;
pub mod class;
pub mod config;
pub mod flicker;
pub mod lines;
pub mod polar_scan;
pub mod ray;
pub mod states;
pub mod window;

use crate::layer::channel::TypedChannel;
use crate::layer::class::count_cells;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::rays::{Rays, ScanExtras};
use crate::sensor::sweep::Sweep;

use class::{HITS, OccupancyClass};
use config::{CALM_MAPS, HITS_FAST, HITS_SLOW, OccupancyConfig, OccupancyVariant, SPEED_MPS_FAST, SPEED_MPS_SLOW};
use flicker::Flicker;
use lines::Lines;
use polar_scan::PolarScans;
use window::Window;

/// Maker of the layer `occupancy`. It keeps the evidence of the scans between two maps.
#[derive(Clone)]
pub struct Occupancy {
    config: OccupancyConfig,
    window: Window,
    scans: Scans,
    flicker: Flicker,
    /// Forward speed at the newest scan, m/s, if known.
    speed_mps: Option<f64>,
}

/// The newest scan of each sensor, as its variant keeps it.
#[derive(Clone)]
enum Scans {
    Polar(PolarScans),
    Paper(Lines),
}

impl Scans {
    fn insert(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        match self {
            Self::Polar(scans) => scans.insert(rays, config, window),
            Self::Paper(lines) => lines.insert(rays, config, window),
        }
    }

    fn clear(&mut self) {
        match self {
            Self::Polar(scans) => scans.clear(),
            Self::Paper(lines) => lines.clear(),
        }
    }
}

impl Occupancy {
    /// A maker with validated parameters.
    pub fn new(config: &OccupancyConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        // Largest distance from a sensor within half the grid's extent to a corner of the grid.
        let reach_m = 1.5 * std::f32::consts::SQRT_2 * config.extent_m;
        Self {
            config: config.of_variant(),
            window: Window::new(side, f64::from(config.cell_m)),
            scans: match config.variant {
                OccupancyVariant::Polar => {
                    Scans::Polar(PolarScans::new(reach_m.min(config.range_m_max), config.cell_m))
                }
                OccupancyVariant::Paper => Scans::Paper(Lines::default()),
            },
            flicker: Flicker::new(side, CALM_MAPS),
            speed_mps: None,
        }
    }

    /// Number of returns that make a cell occupied at a speed (Seo 2014, figure 5): linear between the two
    /// speeds, constant beyond them.
    pub fn hits_needed(speed_mps: Option<f64>) -> u8 {
        let (slow, fast) = (f64::from(SPEED_MPS_SLOW), f64::from(SPEED_MPS_FAST));
        let share = speed_mps.map_or(1.0, |speed| ((speed.abs() - slow) / (fast - slow)).clamp(0.0, 1.0));
        let (at_slow, at_fast) = (f64::from(HITS_SLOW), f64::from(HITS_FAST));
        (at_slow + share * (at_fast - at_slow)).ceil() as u8
    }

    fn geometry(&self) -> Geometry {
        let (side, pose) = (self.window.side() as u32, self.window.ego_pose());
        let corner = pose.cells.map(|cells| -cells * f64::from(self.config.cell_m));
        Geometry::Cartesian {
            origin_x_m: corner[0],
            origin_y_m: corner[1],
            width: side,
            height: side,
            cell_m: self.config.cell_m,
            yaw_rad: pose.yaw_rad,
            first_cell: self.window.corner(),
        }
    }

    /// Writes the layer from the scans since the last map and since `earliest_ns`, for the window's position.
    fn write(&mut self, earliest_ns: i64, layer: &mut Layer) {
        let needed = Self::hits_needed(self.speed_mps);
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut hits = HITS.reuse(&mut layer.channels);
        let cells = self.window.side() * self.window.side();
        class.resize(cells, 0);
        hits.resize(cells, 0);
        let any = match &mut self.scans {
            Scans::Polar(scans) => scans.write_evidence(&self.config, earliest_ns, &self.window, &mut class),
            Scans::Paper(lines) => lines.write_evidence(earliest_ns, &self.window, &mut class),
        };
        let limits = [needed, self.config.hold_maps()];
        self.window.update_states(limits, any, self.config.hits, &mut class, &mut hits);
        if self.window.anchored() && self.config.variant == OccupancyVariant::Polar {
            self.flicker.calm(self.window.corner(), &mut class);
        }
        let share = |of: OccupancyClass| count_cells(&class, of.value()) as f64 / cells as f64;
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
        ScanExtras {
            ground: true,
            no_returns: self.config.no_return_m > 0.0 && self.config.variant == OccupancyVariant::Polar,
            ..ScanExtras::default()
        }
    }

    fn integrate(&mut self, rays: &Rays<'_>) {
        // An empty scan is no evidence of free space.
        if rays.returns.x.is_empty() && rays.no_returns.is_empty() {
            return;
        }
        self.speed_mps = rays.speed_mps;
        if !self.window.move_to(rays.map_from_ego.as_ref()) {
            self.scans.clear();
            self.flicker.clear();
        }
        self.scans.insert(rays, &self.config, &mut self.window);
    }

    fn make(&mut self, _: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        // The vehicle may have moved since the last scan. Without a pose the grid stays at the position of that scan.
        if let Some(pose) = context.map_from_ego.as_ref().filter(|_| self.window.anchored()) {
            self.window.move_to(Some(pose));
        }
        self.write(context.earliest_ns, layer);
    }
}
