//! The layer `speed` (Lindström 2005): the speed that each cell allows, from bumps and steps of the ground, with a
//! bonus on the painted road.
//!
//! In: a [`Sweep`], ego frame, metres, with the deviations of its points; the newest road and route, if any. Out: the
//! layer, a Cartesian grid about the vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | height map, its steps and bumpiness | section 2 | [`bumpiness`] |
//! | roughness of the ground | Neuhaus 2009, section 2.4 | [`rough_ground`] |
//! | width and lateral offset of the road, where no road is sent | section 3.1 | [`measured_road`] |
//! | whether a road may be painted now | section 3.3 | [`painting_conditions`] |
//! | scan conversion of the road's polygon; bonus of each cell | section 3.2 | [`painting`] |
//! | corridor and speed limits of the route | sections 3.2.1 and 3.3 | [`corridor`] |
//!
//! The bonus is added only to cells that were seen to be passable: a road over an obstacle or over unseen ground
//! changes nothing there. Unknown cells have the configured low speed. Its raw value is the channel's `unknown`, and no
//! known cell has this value.

pub mod bumpiness;
pub mod class;
pub mod config;
pub mod corridor;
pub mod measured_road;
pub mod painting;
pub mod painting_conditions;
pub mod rough_ground;

use crate::layer::channel::TypedChannel;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::rays::ScanExtras;
use crate::sensor::sweep::Sweep;

use bumpiness::{HeightMap, OBSTACLE_BUMPINESS};
use class::{SPEED_SCALE_MPS, SpeedClass};
use config::{ROUGH_M, SMOOTH_M, SpeedConfig};
use corridor::{Corridor, OUTSIDE};
use measured_road::MeasuredRoad;
use painting::{NO_ROAD, Painter};
use painting_conditions::{Condition, PaintingConditions, RoadSource};

/// Maker of the layer `speed`. It reuses its buffers from map to map.
#[derive(Clone)]
pub struct Speed {
    config: SpeedConfig,
    heights: HeightMap,
    measured_road: MeasuredRoad,
    conditions: PaintingConditions,
    painter: Painter,
    corridor: Corridor,
}

impl Speed {
    /// A maker with validated parameters.
    pub fn new(config: &SpeedConfig) -> Self {
        let side = 2 * (config.extent_m / config.cell_m).round() as usize;
        Self {
            config: config.clone(),
            heights: HeightMap::new(side, config.cell_m),
            measured_road: MeasuredRoad::default(),
            conditions: PaintingConditions::default(),
            painter: Painter::new(side, config),
            corridor: Corridor::new(side, config.cell_m),
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

    /// Class of a seen cell off the road, the worst of its four quarters.
    fn passage(&self, cell: usize, bumpiness: f32, context: &Context<'_>) -> SpeedClass {
        let [x, y] = self.heights.centre_m(cell);
        let quarter = self.config.cell_m / 4.0;
        let quarters =
            [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]].map(|[i, j]| [x + i * quarter, y + j * quarter]);
        match () {
            () if bumpiness == OBSTACLE_BUMPINESS => SpeedClass::Obstacle,
            () if quarters.iter().any(|[x, y]| context.is_closed(*x, *y)) => SpeedClass::Obstacle,
            () if !quarters.iter().any(|[x, y]| context.is_reached(*x, *y)) => SpeedClass::NotReached,
            () => SpeedClass::Passable,
        }
    }

    /// Speed of a known cell off the road, m/s. It falls linearly with bumpiness, and with the factor of the roughness.
    fn off_road_mps(&self, bumpiness_m: f32, factor: f32) -> f32 {
        let SpeedConfig { crawl_mps, off_road_mps, .. } = self.config;
        let evenness = ((ROUGH_M - bumpiness_m) / (ROUGH_M - SMOOTH_M)).clamp(0.0, 1.0);
        crawl_mps + (off_road_mps - crawl_mps) * evenness * factor
    }

    /// A speed with the limits of the route; `limit_mps` is the limit of the cell in the corridor.
    fn limited_mps(&self, mps: f32, limit_mps: f32) -> f32 {
        match limit_mps {
            OUTSIDE => mps,
            limit_mps if self.config.speed_limits => mps.min(limit_mps),
            _ => mps,
        }
    }

    /// Raw value of the speed of a passable cell: neither 0, which is an obstacle, nor the value of an unknown cell.
    fn raw(&self, mps: f32) -> u8 {
        match (mps / SPEED_SCALE_MPS) as u8 {
            0 if self.unknown() == 1 => 2,
            0 => 1,
            raw if raw != self.unknown() => raw,
            1 => 2,
            raw => raw - 1,
        }
    }

    /// Finds the road to paint, and paints it and the corridor of the route.
    fn paint(&mut self, sweep: &Sweep, context: &Context<'_>) {
        self.conditions.check(context);
        if self.config.measure_road && self.conditions.lacks_road() && self.measured_road.measure(sweep) {
            let (points_m, widths_m) = (self.measured_road.points_m(), self.measured_road.widths_m());
            self.conditions.offer(points_m, widths_m, context);
        }
        self.painter.clear();
        if self.conditions.painting() {
            self.painter.paint(self.conditions.road_m(), self.conditions.widths_m());
        }
        self.corridor.clear();
        if let (Some(route), Some(points_m)) = (context.route, self.conditions.route_m()) {
            self.corridor.paint(points_m, &route.road.widths_m, &route.road.speed_limits_mps);
        }
    }

    fn geometry(&self) -> Geometry {
        Geometry::about_vehicle(self.heights.side() as u32, self.config.cell_m)
    }

    fn write(&self, context: &Context<'_>, layer: &mut Layer) {
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut speed = self.channel().reuse(&mut layer.channels);
        let (mut passable, mut road) = (0u32, 0u32);
        class.resize(self.heights.bumpiness_m().len(), SpeedClass::Unknown.value());
        speed.resize(class.len(), self.unknown());
        for cell in self.heights.known() {
            let (bumpiness, bonus) = (self.heights.bumpiness_m()[cell], self.painter.bonus_mps()[cell]);
            match self.passage(cell, bumpiness, context) {
                SpeedClass::Passable => {}
                closed => {
                    (class[cell], speed[cell]) = (closed.value(), 0);
                    continue;
                }
            }
            let limit_mps = self.corridor.limit_mps(cell);
            let on_road = bonus != NO_ROAD && (limit_mps != OUTSIDE || !self.config.corridor);
            let ground_mps =
                self.off_road_mps(bumpiness, rough_ground::factor(self.heights.roughness(cell), &self.config));
            let mps = self.limited_mps(ground_mps + if on_road { bonus } else { 0.0 }, limit_mps);
            class[cell] = if on_road { SpeedClass::Road.value() } else { SpeedClass::Passable.value() };
            speed[cell] = self.raw(mps);
            (passable, road) = (passable + 1, road + u32::from(on_road));
        }
        TypedChannel::CLASS.store(&mut layer.channels, class);
        self.channel().store(&mut layer.channels, speed);
        let known = self.heights.known().len() as u32;
        let share = |part: u32| if known == 0 { 0.0 } else { f64::from(part) / f64::from(known) };
        let flag = |set: bool| f64::from(u8::from(set));
        let conditions = &self.conditions;
        let road_source = match conditions.painted_source() {
            RoadSource::None => 0.0,
            RoadSource::Sent => 1.0,
            RoadSource::Measured => 2.0,
        };
        layer.metrics.extend([
            ("passable_share", share(passable)),
            ("road_share", share(road)),
            ("painting", flag(conditions.painting())),
            ("road_source", road_source),
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
        let channels = vec![TypedChannel::CLASS.empty(), self.channel().empty()];
        Layer::new("speed", self.geometry(), SpeedClass::LEGEND, channels)
    }

    fn uses(&self) -> ScanExtras {
        ScanExtras { ground: true, reached: true, deviations: true, ..ScanExtras::default() }
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        self.heights.update(sweep, context, &self.config);
        self.heights.judge(context, &self.config);
        self.paint(sweep, context);
        layer.geometry = self.geometry();
        self.write(context, layer);
    }
}
