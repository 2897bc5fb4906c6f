//! The layer `drivability` (UT Austin thesis, section IV): which ground the vehicle can get to, on a radial grid.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer. The steps, in the paper's order, each a function:
//!
//! | step | thesis | where |
//! |---|---|---|
//! | rows and columns of the grid | section IV.1 | [`crate::layer::radial_grid`] |
//! | highest point and unit height of each cell, without overhangs | sections IV.1 and IV.2 | [`heights`] |
//! | segments grow from the vehicle | section IV.3 | [`segments`] |
//! | one plane for each segment | section IV.4 | [`planes`] |
//! | which segments are drivable from one another, breadth first from segment 0 | section IV.5 | [`search`] |
//!
//! The result does not depend on the order of the points: a cell keeps its highest point, and of equally high points
//! the point with the largest x, then y; all later steps visit the cells in the order of the grid.

pub mod class;
pub mod config;
pub mod heights;
pub mod planes;
pub mod search;
pub mod segments;

use crate::layer::channel::TypedChannel;
use crate::layer::class::drivable_share;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::layer::radial_points::{RadialPoints, RadialSize};
use crate::reach::config::ReachConfig;
use crate::sensor::sweep::Sweep;

use class::{DrivabilityClass, SEGMENT, UNIT_HEIGHT_UNKNOWN};
use config::{DrivabilityConfig, DrivabilityVariant, UNIT_HEIGHT_M};
use heights::Heights;
use planes::Planes;
use search::Search;
use segments::Segments;

/// Maker of the layer `drivability`. It reuses its buffers from map to map.
#[derive(Clone)]
pub struct Drivability {
    config: DrivabilityConfig,
    points: RadialPoints,
    heights: Heights,
    segments: Segments,
    /// Planes of the heights over the ground, for the criteria.
    planes: Planes,
    /// Planes in the ego frame, for readers.
    ego_planes: Planes,
    search: Search,
}

impl Drivability {
    /// A maker with validated parameters.
    pub fn new(config: &DrivabilityConfig) -> Self {
        Self {
            config: config.of_variant(),
            points: RadialPoints::new(RadialSize { range_m_max: config.range_m_max, columns: config.columns }),
            heights: Heights::default(),
            segments: Segments::default(),
            planes: Planes::default(),
            ego_planes: Planes::default(),
            search: Search::default(),
        }
    }

    fn write(&self, context: &Context<'_>, layer: &mut Layer) {
        layer.clear_lists();
        let mut unit_height = self.unit_height().reuse(&mut layer.channels);
        let mut segment = SEGMENT.reuse(&mut layer.channels);
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let units = self.heights.units().iter().copied().enumerate();
        unit_height.extend(units.map(|(cell, of)| if self.heights.is_seen(cell) { of } else { UNIT_HEIGHT_UNKNOWN }));
        let segments = self.segments.of_cell().iter().copied().enumerate();
        segment.extend(segments.map(|(cell, of)| if self.heights.is_seen(cell) { of } else { SEGMENT.unknown }));
        class.extend(segment.iter().enumerate().map(|(cell, &segment)| self.class(cell, segment, context).value()));
        layer.planes.extend_from_slice(self.ego_planes.of_segment());
        layer.metrics.push(("drivable_share", drivable_share(layer.legend, &class)));
        if let Some(memory) = context.memory {
            layer.metrics.push(("remembered_points", memory.points as f64));
            layer.metrics.push(("memory_drops", memory.drops as f64));
        }
        TypedChannel::CLASS.store(&mut layer.channels, class);
        self.unit_height().store(&mut layer.channels, unit_height);
        SEGMENT.store(&mut layer.channels, segment);
    }

    /// Class of a cell: an obstacle if something stands in it; drivable if the criteria and the vehicle's width allow
    /// to get there.
    fn class(&self, cell: usize, segment: u16, context: &Context<'_>) -> DrivabilityClass {
        if segment == SEGMENT.unknown {
            return DrivabilityClass::Unknown;
        }
        let [x, y, height_m] = self.heights.points()[cell];
        let is_obstacle = match context.ground {
            Some(_) => height_m > UNIT_HEIGHT_M,
            None => segment == self.segments.unreachable(),
        };
        let is_joined = segment != self.segments.unreachable() && self.search.drivable()[usize::from(segment)];
        match () {
            () if is_obstacle => DrivabilityClass::Obstacle,
            () if is_joined && context.is_reached(x, y) => DrivabilityClass::Drivable,
            () => DrivabilityClass::NotDrivable,
        }
    }

    /// Channel for the height of a cell's highest point, in units of the configured height.
    fn unit_height(&self) -> TypedChannel<i8> {
        let scale = UNIT_HEIGHT_M;
        TypedChannel { name: "unit_height", unit: "m", scale, unknown: UNIT_HEIGHT_UNKNOWN }
    }
}

impl LayerMaker for Drivability {
    fn layer(&self) -> Layer {
        let channels = vec![TypedChannel::CLASS.empty(), self.unit_height().empty(), SEGMENT.empty()];
        Layer::new("drivability", Geometry::radial(self.config.columns), DrivabilityClass::LEGEND, channels)
    }

    fn radial_size(&self) -> Option<RadialSize> {
        (self.config.variant != DrivabilityVariant::Paper).then_some(self.points.size())
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        // The thesis takes heights over the plane under the vehicle, and has no width of a vehicle.
        let outline = context.reach.map_or_else(|| ReachConfig::default().outline(), |reach| reach.config().outline());
        let plane = Context { ground: None, radial: &[], reach: None, ..*context };
        let context = if self.config.variant == DrivabilityVariant::Paper { &plane } else { context };
        let points = context.radial_points(sweep, &mut self.points);
        let grid = points.grid();
        grid.write_geometry(&mut layer.geometry);
        self.heights.compute(points, sweep, context, &self.config);
        if self.config.variant == DrivabilityVariant::Paper {
            self.heights.fill_blind_zone(grid, &outline, &self.config);
        }
        self.segments.grow(grid, &self.heights, &self.config);
        let points = self.heights.points().iter().copied();
        self.planes.fit(points.clone(), &self.segments);
        self.ego_planes.fit(points.zip(self.heights.z_m()).map(|([x, y, _], &z)| [x, y, z]), &self.segments);
        self.search.run(grid, &self.heights, &self.segments, &self.planes, &self.config);
        self.write(context, layer);
    }
}
