//! The thesis' drivability map (§IV): which ground the vehicle can get to, on a radial grid.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer `drivability`. The steps, in the paper's order, each a function:
//!
//! | step | thesis | where |
//! |---|---|---|
//! | rows and columns, `r_bench` | §IV.1 | [`crate::layer::radial_grid`] |
//! | highest point and unit height of each cell, overhangs cut off | §IV.1-2 | [`heights`] |
//! | segments grow from the vehicle | §IV.3 | [`segments`] |
//! | one plane a segment | §IV.4 | [`planes`] |
//! | which segments are drivable from one another, breadth first from segment 0 | §IV.5 | [`search`] |
//!
//! Nothing depends on the order of the points: a cell keeps its highest point, and of equally high ones the one with
//! the largest x, then y; everything after runs over cells in the order of the grid.

pub mod heights;
pub mod planes;
pub mod search;
pub mod segments;

use crate::config::DrivabilityConfig;
use crate::map::{Cells, Channel, Geometry, Layer, LayerMaker};
use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

use heights::Heights;
use planes::Planes;
use search::Search;
use segments::Segments;

/// No point fell into the cell: nothing is known of it.
pub const UNKNOWN: u8 = 0;
/// The vehicle can drive there from where it stands.
pub const DRIVABLE: u8 = 1;
/// Reached step by step, but over an edge, a slope or a gap that the vehicle cannot take.
pub const NOT_DRIVABLE: u8 = 2;
/// Not reached: too high, or behind something that is.
pub const OBSTACLE: u8 = 3;
/// Names of the classes, by value.
pub const LEGEND: &[&str] = &["unknown", "drivable", "not_drivable", "obstacle"];
/// Raw `unit_height` of a cell without points.
pub const UNIT_HEIGHT_UNKNOWN: i8 = i8::MIN;
/// Raw `segment` of a cell without points.
pub const SEGMENT_UNKNOWN: u16 = u16::MAX;

/// Makes the layer from sweep after sweep, reusing its buffers.
pub struct Drivability {
    config: DrivabilityConfig,
    grid: RadialGrid,
    heights: Heights,
    segments: Segments,
    planes: Planes,
    search: Search,
}

impl Drivability {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
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
        self.grid.describe(&mut layer.geometry);
        layer.clear_lists();
        let [class, unit_height, segment] = &mut layer.channels[..] else { unreachable!("layer() gives three") };
        let (Cells::U8(class), Cells::I8(unit_height), Cells::U16(segment)) =
            (&mut class.cells, &mut unit_height.cells, &mut segment.cells)
        else {
            unreachable!("layer() gives u8, i8 and u16")
        };
        segment.clear();
        segment.extend_from_slice(self.segments.of_cell());
        unit_height.clear();
        unit_height.extend_from_slice(self.heights.units());
        let (unreachable, drivable) = (self.segments.unreachable(), self.search.drivable());
        class.clear();
        class.extend(segment.iter().map(|&segment| match segment {
            SEGMENT_UNKNOWN => UNKNOWN,
            segment if segment == unreachable => OBSTACLE,
            segment if drivable[usize::from(segment)] => DRIVABLE,
            _ => NOT_DRIVABLE,
        }));
        let known = class.iter().filter(|c| **c != UNKNOWN).count();
        let drivable = class.iter().filter(|c| **c == DRIVABLE).count();
        layer.planes.extend_from_slice(self.planes.of_segment());
        layer.figures.push(("drivable_share", if known == 0 { 0.0 } else { drivable as f64 / known as f64 }));
    }
}

impl LayerMaker for Drivability {
    fn layer(&self) -> Layer {
        let channels = vec![
            Channel::class(),
            Channel::i8("unit_height", "m", self.config.unit_height_m, UNIT_HEIGHT_UNKNOWN),
            Channel::u16("segment", "", 1.0, SEGMENT_UNKNOWN),
        ];
        Layer::new("drivability", Geometry::radial(self.config.columns), LEGEND, channels)
    }

    fn make(&mut self, sweep: &Sweep, layer: &mut Layer) {
        self.grid.follow(sweep, self.config.range_m_max, self.config.columns);
        self.heights.set_up(&self.grid, sweep, &self.config);
        self.segments.grow(&self.grid, &self.heights, &self.config);
        self.planes.fit(&self.heights, &self.segments);
        self.search.run(&self.grid, &self.heights, &self.segments, &self.planes, &self.config);
        self.write(layer);
    }
}
