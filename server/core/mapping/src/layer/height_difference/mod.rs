//! The thesis' baseline (§V), on the same r-θ grid: a cell whose highest and lowest points differ by more than a
//! threshold is an obstacle.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer `height_difference`. Kept for comparison: it takes a steep road,
//! or one under branches, for an obstacle, and calls ground behind a fence drivable, as the thesis shows.

use crate::config::HeightDifferenceConfig;
use crate::map::{Cells, Channel, Geometry, Layer, LayerMaker};
use crate::layer::radial_grid::RadialGrid;
use crate::sensor::sweep::Sweep;

/// No point fell into the cell.
pub const UNKNOWN: u8 = 0;
/// Highest and lowest point differ by no more than the threshold. Says nothing of whether the vehicle can get there.
pub const DRIVABLE: u8 = 1;
/// They differ by more.
pub const OBSTACLE: u8 = 2;
/// Names of the classes, by value.
pub const LEGEND: &[&str] = &["unknown", "drivable", "obstacle"];
/// Raw `difference` of a cell without points.
pub const DIFFERENCE_UNKNOWN: u16 = u16::MAX;

/// Makes the layer from sweep after sweep, reusing its buffers.
pub struct HeightDifference {
    config: HeightDifferenceConfig,
    grid: RadialGrid,
    /// Highest and lowest z of each cell, and of one more row for points beyond the grid.
    span: Vec<[f32; 2]>,
}

impl HeightDifference {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
    pub fn new(config: &HeightDifferenceConfig) -> Self {
        Self { config: config.clone(), grid: RadialGrid::default(), span: Vec::new() }
    }
}

impl LayerMaker for HeightDifference {
    fn layer(&self) -> Layer {
        let channels = vec![Channel::class(), Channel::u16("difference", "m", 0.01, DIFFERENCE_UNKNOWN)];
        Layer::new("height_difference", Geometry::radial(self.config.columns), LEGEND, channels)
    }

    fn make(&mut self, sweep: &Sweep, layer: &mut Layer) {
        self.grid.follow(sweep, self.config.range_m_max, self.config.columns);
        self.span.clear();
        self.span.resize(self.grid.cells() + self.grid.columns(), [f32::NEG_INFINITY, f32::INFINITY]);
        let span = &mut self.span;
        self.grid.for_each_chunk(sweep, |first, cells| {
            for (cell, &z) in cells.iter().zip(&sweep.z[first..]) {
                let [highest, lowest] = &mut span[*cell as usize];
                *highest = if z > *highest { z } else { *highest };
                *lowest = if z < *lowest { z } else { *lowest };
            }
        });

        self.grid.describe(&mut layer.geometry);
        layer.clear_lists();
        let [class, difference] = &mut layer.channels[..] else { unreachable!("layer() gives two channels") };
        let (Cells::U8(class), Cells::U16(difference)) = (&mut class.cells, &mut difference.cells) else {
            unreachable!("layer() gives u8 and u16")
        };
        let spans = &self.span[..self.grid.cells()];
        class.clear();
        class.extend(spans.iter().map(|[highest, lowest]| match highest - lowest {
            apart if apart > self.config.difference_m_max => OBSTACLE,
            // Without points highest is -∞ and lowest +∞.
            apart if apart >= 0.0 => DRIVABLE,
            _ => UNKNOWN,
        }));
        difference.clear();
        difference.extend(spans.iter().map(|[highest, lowest]| match highest - lowest {
            apart if apart >= 0.0 => ((apart * 100.0).round() as u16).min(DIFFERENCE_UNKNOWN - 1),
            _ => DIFFERENCE_UNKNOWN,
        }));
        let known = class.iter().filter(|c| **c != UNKNOWN).count();
        let drivable = class.iter().filter(|c| **c == DRIVABLE).count();
        layer.figures.push(("drivable_share", if known == 0 { 0.0 } else { drivable as f64 / known as f64 }));
    }
}
