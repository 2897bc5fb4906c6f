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

pub mod bumpiness;
pub mod class;
pub mod config;
pub mod gates;
pub mod painting;

use crate::layer::speed::config::SpeedConfig;
use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use bumpiness::{HeightMap, OBSTACLE_BUMPINESS};
use class::{SPEED_SCALE_MPS, SpeedClass};
use gates::{Gate, Gates};
use painting::{NO_ROAD, Painter};

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

    /// Speed of a cell.
    fn channel(&self) -> TypedChannel<u8> {
        TypedChannel { name: "speed", unit: "m/s", scale: SPEED_SCALE_MPS, unknown: self.unknown() }
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
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut speed = self.channel().reuse(&mut layer.channels);
        let (mut passable, mut road) = (0u32, 0u32);
        class.resize(self.heights.bumpiness_m().len(), SpeedClass::Unknown.value());
        speed.resize(class.len(), self.unknown());
        for cell in self.heights.known() {
            let (bumpiness, bonus) = (self.heights.bumpiness_m()[cell], self.painter.bonus_mps()[cell]);
            if bumpiness == OBSTACLE_BUMPINESS {
                (class[cell], speed[cell]) = (SpeedClass::Obstacle.value(), 0);
                continue;
            }
            let on_road = bonus != NO_ROAD;
            let mps = self.off_road_mps(bumpiness) + if on_road { bonus } else { 0.0 };
            class[cell] = if on_road { SpeedClass::Road.value() } else { SpeedClass::Passable.value() };
            speed[cell] = (mps / SPEED_SCALE_MPS) as u8;
            (passable, road) = (passable + 1, road + u32::from(on_road));
        }
        TypedChannel::CLASS.store(&mut layer.channels, class);
        self.channel().store(&mut layer.channels, speed);
        let known = self.heights.known().len() as u32;
        let share = |part: u32| if known == 0 { 0.0 } else { f64::from(part) / f64::from(known) };
        let flag = |set: bool| f64::from(u8::from(set));
        let gates = &self.gates;
        layer.metrics.extend([
            ("passable_share", share(passable)),
            ("road_share", share(road)),
            ("painting", flag(gates.painting())),
            ("stopped_by_age", flag(gates.closed(Gate::Age))),
            ("stopped_by_missing_pose", flag(gates.closed(Gate::Pose))),
            ("stopped_by_divergence", flag(gates.closed(Gate::Divergence))),
            ("stopped_by_curvature", flag(gates.closed(Gate::Curvature))),
        ]);
        layer.metrics.extend(gates.divergence.map(|value| ("orientation_divergence", value)));
        layer.metrics.extend(gates.curvature_per_m.map(|value| ("route_curvature_per_m", value)));
    }
}

impl LayerMaker for Speed {
    fn layer(&self) -> Layer {
        let geometry = Geometry::about_vehicle(self.heights.side() as u32, self.config.cell_m);
        let channels = vec![TypedChannel::CLASS.empty(), self.channel().empty()];
        Layer::new("speed", geometry, SpeedClass::LEGEND, channels)
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
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
