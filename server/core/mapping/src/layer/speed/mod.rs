//! The layer `speed` (Lindström 2005): the speed that each cell allows, from bumps and steps of the ground, with a
//! bonus on the painted road.
//!
//! In: a [`Sweep`], ego frame, metres; the newest road and route, if any. Out: the layer, a Cartesian grid about the
//! vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | height map, its steps and bumpiness | section 2 | [`bumpiness`] |
//! | whether a road may be painted now | section 3.3 | [`painting_conditions`] |
//! | scan conversion of the road's polygon; bonus of each cell | section 3.2 | [`painting`] |
//!
//! The bonus is added only to cells that were seen to be passable: a road over an obstacle or over unseen ground
//! changes nothing there. Unknown cells have the configured low speed. Its raw value is the channel's `unknown`, and no
//! known cell has this value.

pub mod bumpiness;
pub mod class;
pub mod config;
pub mod painting;
pub mod painting_conditions;

use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use bumpiness::{HeightMap, OBSTACLE_BUMPINESS};
use class::{SPEED_SCALE_MPS, SpeedClass};
use config::SpeedConfig;
use painting::{NO_ROAD, Painter};
use painting_conditions::{Condition, PaintingConditions};

/// Maker of the layer `speed`. It reuses its buffers from map to map.
pub struct Speed {
    config: SpeedConfig,
    heights: HeightMap,
    conditions: PaintingConditions,
    painter: Painter,
}

impl Speed {
    /// A maker with validated parameters.
    pub fn new(config: &SpeedConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        Self {
            config: config.clone(),
            heights: HeightMap::new(side),
            conditions: PaintingConditions::default(),
            painter: Painter::new(side, config),
        }
    }

    /// Channel for the speed of a cell.
    fn channel(&self) -> TypedChannel<u8> {
        TypedChannel { name: "speed", unit: "m/s", scale: SPEED_SCALE_MPS, unknown: self.unknown() }
    }

    /// Raw speed of an unknown cell.
    fn unknown(&self) -> u8 {
        (self.config.unknown_mps / SPEED_SCALE_MPS) as u8
    }

    /// Speed of a known cell off the road, m/s. It falls linearly with bumpiness.
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
        let conditions = &self.conditions;
        layer.metrics.extend([
            ("passable_share", share(passable)),
            ("road_share", share(road)),
            ("painting", flag(conditions.painting())),
            ("stopped_by_age", flag(conditions.violated(Condition::Age))),
            ("stopped_by_missing_pose", flag(conditions.violated(Condition::Pose))),
            ("stopped_by_divergence", flag(conditions.violated(Condition::Divergence))),
            ("stopped_by_curvature", flag(conditions.violated(Condition::Curvature))),
        ]);
        layer.metrics.extend(conditions.divergence.map(|value| ("orientation_divergence", value)));
        layer.metrics.extend(conditions.curvature_per_m.map(|value| ("route_curvature_per_m", value)));
    }
}

impl LayerMaker for Speed {
    fn layer(&self) -> Layer {
        let geometry = Geometry::about_vehicle(self.heights.side() as u32, self.config.cell_m);
        let channels = vec![TypedChannel::CLASS.empty(), self.channel().empty()];
        Layer::new("speed", geometry, SpeedClass::LEGEND, channels)
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        self.heights.update(sweep, &self.config);
        self.heights.judge(&self.config);
        self.conditions.check(context, &self.config);
        self.painter.clear();
        if self.conditions.painting() {
            let widths_m = context.road.map_or(&[][..], |stored| &stored.road.widths_m);
            self.painter.paint(self.conditions.road_m(), widths_m);
        }
        layer.geometry = self.layer().geometry;
        self.write(layer);
    }
}
