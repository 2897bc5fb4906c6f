//! The speed each place allows (Lindström 2005): from the ground's bumps and steps, with the road painted in as a
//! bonus.
//!
//! In: a [`Sweep`], ego frame, metres; the newest road and route, if any. Out: the layer `speed`, a Cartesian grid
//! about the vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | height map, its steps and bumpiness | §2 | [`bumpiness`] |
//! | whether a road may be painted now | §3.3 | [`gates`] |
//! | the road's polygon, scan-converted; how much bonus each cell gets | §3.2 | [`painting`] |
//!
//! The bonus is added where the ground was seen to be passable, never elsewhere: a road over an obstacle or over ground
//! nobody saw changes nothing there. The speed of an unknown cell is low, as configured, and its raw value is the
//! channel's `unknown`: no known cell has it.

pub mod config;
pub mod bumpiness;
pub mod gates;
pub mod painting;

use crate::config::SpeedConfig;
use crate::map::{Cells, Channel, Context, Geometry, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use bumpiness::{HeightMap, OBSTACLE_BUMPINESS};
use gates::{Gate, Gates};
use painting::{NO_ROAD, Painter};

/// No point fell into the cell: nothing is known of it.
pub const UNKNOWN: u8 = 0;
/// Seen, and even enough to drive over at the cell's speed.
pub const PASSABLE: u8 = 1;
/// A step or an object: speed 0.
pub const OBSTACLE: u8 = 2;
/// Passable, and on the painted road.
pub const ROAD: u8 = 3;
/// Names of the classes, by value.
pub const LEGEND: &[&str] = &["unknown", "passable", "obstacle", "road"];
/// Speed of one raw step, metres a second: steps coarser than a planner's choices would be, so that runs stay long.
pub const SPEED_SCALE_MPS: f32 = 0.25;

/// Makes the layer from sweep after sweep, reusing its buffers.
pub struct Speed {
    config: SpeedConfig,
    heights: HeightMap,
    gates: Gates,
    painter: Painter,
}

impl Speed {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
    pub fn new(config: &SpeedConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        Self {
            config: config.clone(),
            heights: HeightMap::new(side),
            gates: Gates::default(),
            painter: Painter::new(side, config),
        }
    }

    fn unknown(&self) -> u8 {
        (self.config.unknown_mps / SPEED_SCALE_MPS) as u8
    }

    /// Speed of a known cell off the road, m/s: falls linearly with bumpiness.
    fn off_road_mps(&self, bumpiness_m: f32) -> f32 {
        let SpeedConfig { smooth_m, rough_m, crawl_mps, off_road_mps, .. } = self.config;
        let evenness = ((rough_m - bumpiness_m) / (rough_m - smooth_m)).clamp(0.0, 1.0);
        crawl_mps + (off_road_mps - crawl_mps) * evenness
    }

    fn write(&self, layer: &mut Layer) {
        layer.clear_lists();
        let [class, speed] = &mut layer.channels[..] else { unreachable!("layer() gives two channels") };
        let (Cells::U8(class), Cells::U8(speed)) = (&mut class.cells, &mut speed.cells) else {
            unreachable!("layer() gives u8 and u8")
        };
        let (mut passable, mut road) = (0u32, 0u32);
        class.clear();
        class.resize(self.heights.bumpiness_m().len(), UNKNOWN);
        speed.clear();
        speed.resize(class.len(), self.unknown());
        for cell in self.heights.known() {
            let (bumpiness, bonus) = (self.heights.bumpiness_m()[cell], self.painter.bonus_mps()[cell]);
            if bumpiness == OBSTACLE_BUMPINESS {
                (class[cell], speed[cell]) = (OBSTACLE, 0);
                continue;
            }
            let on_road = bonus != NO_ROAD;
            let mps = self.off_road_mps(bumpiness) + if on_road { bonus } else { 0.0 };
            (class[cell], speed[cell]) = (if on_road { ROAD } else { PASSABLE }, (mps / SPEED_SCALE_MPS) as u8);
            (passable, road) = (passable + 1, road + u32::from(on_road));
        }
        let known = self.heights.known().len() as u32;
        let share = |part: u32| if known == 0 { 0.0 } else { f64::from(part) / f64::from(known) };
        let flag = |set: bool| f64::from(u8::from(set));
        let gates = &self.gates;
        layer.figures.extend([
            ("passable_share", share(passable)),
            ("road_share", share(road)),
            ("painting", flag(gates.painting())),
            ("stopped_by_age", flag(gates.closed(Gate::Age))),
            ("stopped_by_missing_pose", flag(gates.closed(Gate::Pose))),
            ("stopped_by_divergence", flag(gates.closed(Gate::Divergence))),
            ("stopped_by_curvature", flag(gates.closed(Gate::Curvature))),
        ]);
        layer.figures.extend(gates.divergence.map(|value| ("orientation_divergence", value)));
        layer.figures.extend(gates.curvature_per_m.map(|value| ("route_curvature_per_m", value)));
    }
}

impl LayerMaker for Speed {
    fn layer(&self) -> Layer {
        let geometry = Geometry::about_vehicle(self.heights.side() as u32, self.config.cell_m);
        let speed = Channel::u8("speed", "m/s", SPEED_SCALE_MPS, self.unknown());
        Layer::new("speed", geometry, LEGEND, vec![Channel::class(), speed])
    }

    /// Without a road.
    fn make(&mut self, sweep: &Sweep, layer: &mut Layer) {
        self.make_with(sweep, &Context::default(), layer);
    }

    fn make_with(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        self.heights.fill(sweep, &self.config);
        self.heights.judge(&self.config);
        self.gates.judge(context, &self.config);
        self.painter.clear();
        if self.gates.painting() {
            let widths_m = context.road.map_or(&[][..], |taken| &taken.road.widths_m);
            self.painter.paint(self.gates.road_m(), widths_m);
        }
        layer.geometry = self.layer().geometry;
        self.write(layer);
    }
}
