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
//! the one with the largest x, then y; all later steps visit the cells in the order of the grid.

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
use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

use class::{DrivabilityClass, SEGMENT, UNIT_HEIGHT_UNKNOWN};
use config::DrivabilityConfig;
use heights::Heights;
use planes::Planes;
use search::Search;
use segments::Segments;

/// Maker of the layer `drivability`. It reuses its buffers from map to map.
pub struct Drivability {
    config: DrivabilityConfig,
    grid: RadialGrid,
    heights: Heights,
    segments: Segments,
    planes: Planes,
    search: Search,
}

impl Drivability {
    /// A maker with validated parameters.
    pub fn new(config: &DrivabilityConfig) -> Self {
        Self {
            config: config.clone(),
            grid: RadialGrid::default(),
            heights: Heights::default(),
            segments: Segments::default(),
            planes: Planes::default(),
            search: Search::default(),
        }
    }

    fn write(&self, layer: &mut Layer) {
        self.grid.write_geometry(&mut layer.geometry);
        layer.clear_lists();
        let mut unit_height = self.unit_height().reuse(&mut layer.channels);
        let mut segment = SEGMENT.reuse(&mut layer.channels);
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        unit_height.extend_from_slice(self.heights.units());
        segment.extend_from_slice(self.segments.of_cell());
        let (unreachable, drivable) = (self.segments.unreachable(), self.search.drivable());
        class.extend(segment.iter().map(|&segment| {
            let class = match segment {
                _ if segment == SEGMENT.unknown => DrivabilityClass::Unknown,
                _ if segment == unreachable => DrivabilityClass::Obstacle,
                _ if drivable[usize::from(segment)] => DrivabilityClass::Drivable,
                _ => DrivabilityClass::NotDrivable,
            };
            class.value()
        }));
        layer.planes.extend_from_slice(self.planes.of_segment());
        layer.metrics.push(("drivable_share", drivable_share(layer.legend, &class)));
        TypedChannel::CLASS.store(&mut layer.channels, class);
        self.unit_height().store(&mut layer.channels, unit_height);
        SEGMENT.store(&mut layer.channels, segment);
    }

    /// Channel for the height of a cell's highest point, in units of the configured height.
    fn unit_height(&self) -> TypedChannel<i8> {
        let scale = self.config.unit_height_m;
        TypedChannel { name: "unit_height", unit: "m", scale, unknown: UNIT_HEIGHT_UNKNOWN }
    }
}

impl LayerMaker for Drivability {
    fn layer(&self) -> Layer {
        let channels = vec![TypedChannel::CLASS.empty(), self.unit_height().empty(), SEGMENT.empty()];
        Layer::new("drivability", Geometry::radial(self.config.columns), DrivabilityClass::LEGEND, channels)
    }

    fn make(&mut self, sweep: &Sweep, _: &Context<'_>, layer: &mut Layer) {
        self.grid.update_rows(sweep, self.config.range_m_max, self.config.columns);
        self.heights.compute(&self.grid, sweep, &self.config);
        self.segments.grow(&self.grid, &self.heights, &self.config);
        self.planes.fit(&self.heights, &self.segments);
        self.search.run(&self.grid, &self.heights, &self.segments, &self.planes, &self.config);
        self.write(layer);
    }
}
