//! The layer `height_difference` (UT Austin thesis, section V), the baseline of the thesis on the same r-θ grid: a cell
//! is an obstacle if the heights of its highest and lowest points differ by more than a threshold.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer. It serves for comparison: it calls a steep road, or one under
//! branches, an obstacle, and calls ground behind a fence drivable, as the thesis shows.

pub mod class;
pub mod config;

use crate::layer::channel::TypedChannel;
use crate::layer::class::drivable_share;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::layer::radial_points::{RadialPoints, RadialSize};
use crate::sensor::rays::ScanExtras;
use crate::sensor::sweep::Sweep;

use class::{DIFFERENCE, HeightDifferenceClass};
use config::HeightDifferenceConfig;

/// Maker of the layer `height_difference`. It reuses its buffers from map to map.
#[derive(Clone)]
pub struct HeightDifference {
    config: HeightDifferenceConfig,
    points: RadialPoints,
    /// Highest and lowest z of each cell, metres, and of one more row for points beyond the grid.
    span: Vec<[f32; 2]>,
}

impl HeightDifference {
    /// A maker with validated parameters.
    pub fn new(config: &HeightDifferenceConfig) -> Self {
        Self { config: config.clone(), points: RadialPoints::new(Self::size(config)), span: Vec::new() }
    }

    fn size(config: &HeightDifferenceConfig) -> RadialSize {
        RadialSize { range_m_max: config.range_m_max, columns: config.columns }
    }
}

impl LayerMaker for HeightDifference {
    fn layer(&self) -> Layer {
        let channels = vec![TypedChannel::CLASS.empty(), DIFFERENCE.empty()];
        let geometry = Geometry::radial(self.config.columns);
        Layer::new("height_difference", geometry, HeightDifferenceClass::LEGEND, channels)
    }

    fn uses(&self) -> ScanExtras {
        ScanExtras::default()
    }

    fn radial_size(&self) -> Option<RadialSize> {
        Some(self.points.size())
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        let points = context.radial_points(sweep, &mut self.points);
        let grid = points.grid();
        self.span.clear();
        self.span.resize(grid.cells() + grid.columns(), [f32::NEG_INFINITY, f32::INFINITY]);
        for (cell, &z) in points.cells().iter().zip(&sweep.z) {
            let [highest, lowest] = &mut self.span[*cell as usize];
            *highest = if z > *highest { z } else { *highest };
            *lowest = if z < *lowest { z } else { *lowest };
        }

        grid.write_geometry(&mut layer.geometry);
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        let mut difference = DIFFERENCE.reuse(&mut layer.channels);
        let spans = &self.span[..grid.cells()];
        class.extend(spans.iter().map(|[highest, lowest]| {
            let class = match highest - lowest {
                apart if apart > self.config.difference_m_max => HeightDifferenceClass::Obstacle,
                // Without points highest is -∞ and lowest +∞.
                apart if apart >= 0.0 => HeightDifferenceClass::Drivable,
                _ => HeightDifferenceClass::Unknown,
            };
            class.value()
        }));
        difference.extend(spans.iter().map(|[highest, lowest]| match highest - lowest {
            apart if apart >= 0.0 => ((apart * 100.0).round() as u16).min(DIFFERENCE.unknown - 1),
            _ => DIFFERENCE.unknown,
        }));
        layer.metrics.push(("drivable_share", drivable_share(layer.legend, &class)));
        TypedChannel::CLASS.store(&mut layer.channels, class);
        DIFFERENCE.store(&mut layer.channels, difference);
    }
}
