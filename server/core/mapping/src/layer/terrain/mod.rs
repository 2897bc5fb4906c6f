//! The layer `terrain` (Neuhaus 2009, section 2): where the ground is flat, by hierarchical principal component
//! analysis, and how rough it is there.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer, square cells about the vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | points -> cells; sums over any region in O(1) | section 2.2 | [`moments`] |
//! | principal components, local height disturbance h | section 2.1, eq. 1 | [`eigen`] |
//! | hierarchical division into flat regions, or each cell by itself | sections 2.2 and 2.3 | [`regions`] |
//! | regions that join the ground under the vehicle; bounded inference | not in the paper | [`ground`] |
//! | which of this ground the vehicle can reach | not in the paper | [`shadow`], [`reach`] |
//! | roughness of flat cells | sections 2.4 and 2.5, eq. 3 and 4 | [`crate::sensor::distance_series`], [`roughness`] |
//!
//! There are three variants ([`Variant`]):
//! - `paper`: as published. Car roofs are flat, and cells far beyond the last point are inferred.
//! - `grounded`: no point of a flat region lies off its plane; the region joins the ground under the vehicle without a
//!   step, through passages that the vehicle fits through; only holes in seen ground are inferred.
//! - `grid`: each cell by itself, with the shape of its points.
//!
//! The result does not depend on the order of the points: all sums are over whole numbers.

pub mod class;
pub mod config;
pub mod eigen;
pub mod ground;
pub mod moments;
pub mod reach;
pub mod regions;
pub mod roughness;
pub mod shadow;

use crate::layer::channel::TypedChannel;
use crate::layer::class::drivable_share;
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker, ScanExtras};
use crate::sensor::sweep::Sweep;

use class::{PLANE, ROUGHNESS, SHAPE, TerrainClass};
use config::{TerrainConfig, Variant};
use ground::Ground;
use moments::{Cells, half_width};
use reach::{CellKind, Reach};
use regions::{FIRST_FLAT, NOT_FLAT, Plane, Regions};
use roughness::Roughness;
use shadow::Shadow;

/// Least height of an obstacle that casts a shadow, metres. Ours: kerbs cast none; not tuned.
const SHADOW_HEIGHT_M_MIN: f32 = 0.5;

/// Maker of the layer `terrain`. It reuses its buffers from map to map.
pub struct Terrain {
    config: TerrainConfig,
    cells: Cells,
    regions: Regions,
    ground: Ground,
    shadow: Shadow,
    reach: Reach,
    roughness: Roughness,
    /// By cell: true if a point fell into it.
    seen: Vec<bool>,
    /// By cell.
    class: Vec<TerrainClass>,
}

impl Terrain {
    /// A maker with validated parameters.
    pub fn new(config: &TerrainConfig) -> Self {
        Self {
            config: config.clone(),
            cells: Cells::new(config.range_m_max, config.cell_m),
            regions: Regions::default(),
            ground: Ground::default(),
            shadow: Shadow::default(),
            reach: Reach::default(),
            roughness: Roughness::default(),
            seen: Vec::new(),
            class: Vec::new(),
        }
    }

    /// Fills `class` from the regions; `sensor_m` is the height of the sensor over the ground.
    fn classify(&mut self, sensor_m: f32) {
        let mut class = std::mem::take(&mut self.class);
        class.clear();
        let region_of = self.regions.of_cell();
        if self.config.variant == Variant::Grounded {
            let joined = self.ground.joined();
            // Cells that are neither seen nor filled stay unknown.
            class.resize(region_of.len(), TerrainClass::Unknown);
            for &cell in self.regions.cell_of_slot() {
                class[cell as usize] = match region_of[cell as usize] {
                    NOT_FLAT => TerrainClass::Obstacle,
                    region @ FIRST_FLAT.. if joined[(region - FIRST_FLAT) as usize] => TerrainClass::Flat,
                    FIRST_FLAT.. => TerrainClass::FlatElevated,
                    _ => TerrainClass::Unknown,
                };
            }
            for &cell in self.ground.filled() {
                let class = &mut class[cell as usize];
                if *class == TerrainClass::Unknown {
                    *class = if self.seen[cell as usize] { TerrainClass::Flat } else { TerrainClass::FlatInferred };
                }
            }
            self.remove_unreached(&mut class, sensor_m);
        } else {
            class.extend(region_of.iter().zip(&self.seen).map(|(&region, &seen)| match (region, seen) {
                (NOT_FLAT, _) => TerrainClass::Obstacle,
                (FIRST_FLAT.., true) => TerrainClass::Flat,
                (FIRST_FLAT.., false) => TerrainClass::FlatInferred,
                _ => TerrainClass::Unknown,
            }));
        }
        self.class = class;
    }

    /// Marks flat cells that the vehicle cannot reach; inferred cells there become unknown.
    fn remove_unreached(&mut self, class: &mut [TerrainClass], sensor_m: f32) {
        let TerrainConfig { passage_m_min, blind_zone_m, cell_m, .. } = self.config;
        let (cells, seen, bridged) = (&self.cells, &self.seen, self.ground.bridged());
        self.shadow.clear(class.len(), |cell| cells.cell_centre_m(cell));
        for (slot, &cell) in self
            .regions
            .cell_of_slot()
            .iter()
            .enumerate()
            .filter(|(_, cell)| class[**cell as usize] == TerrainClass::Obstacle)
        {
            let [lowest_m, highest_m] = cells.span_m(slot);
            if highest_m - lowest_m >= SHADOW_HEIGHT_M_MIN {
                self.shadow.cast(cell as usize, cell_m, [lowest_m, highest_m], sensor_m);
            }
        }

        let (regions, joined, shadow) = (self.regions.of_cell(), self.ground.joined(), &self.shadow);
        let is_ground = |region: u32| region >= FIRST_FLAT && joined[(region - FIRST_FLAT) as usize];
        let width = cells.width();
        let blind = (blind_zone_m / cell_m).ceil() as usize;
        let is_near = |ix: usize| ix + blind >= width / 2 && ix < width / 2 + blind;
        let kind = |ix: usize, iy: usize| match (iy * width + ix, class[iy * width + ix]) {
            (_, TerrainClass::Flat) => CellKind::Open,
            (_, TerrainClass::Obstacle | TerrainClass::FlatElevated) => CellKind::Closed,
            (cell, _) if seen[cell] => CellKind::NoGround,
            (_, TerrainClass::FlatInferred) => CellKind::Open,
            (cell, _) if (bridged[cell] || is_ground(regions[cell])) && !shadow.hides(cell) => CellKind::Open,
            (cell, _) if is_near(ix) && is_near(iy) && shadow.distance_m(cell) <= blind_zone_m => CellKind::Open,
            _ => CellKind::NoGround,
        };
        // Radius, in cells, of the largest disc sure to fit through a passage of `passage_m_min`.
        let radius = ((passage_m_min / cell_m - 2.0) / 2.0).max(0.0) as usize;
        self.reach.flood(width, radius, kind);
        for (iy, row) in class.chunks_exact_mut(width).enumerate() {
            for (ix, class) in row.iter_mut().enumerate() {
                if matches!(*class, TerrainClass::Flat | TerrainClass::FlatInferred) && !self.reach.reached(ix, iy) {
                    *class = if *class == TerrainClass::Flat {
                        TerrainClass::FlatUnreachable
                    } else {
                        TerrainClass::Unknown
                    };
                }
            }
        }
    }

    /// Writes the roughness of the flat cells (section 2.4); `raw` is empty before.
    fn write_roughness(&mut self, sweep: &Sweep, raw: &mut Vec<u8>) {
        raw.resize(self.class.len(), ROUGHNESS.unknown);
        if sweep.deviation_m.is_empty() {
            return;
        }
        self.roughness.sum(sweep, &self.cells);
        for (slot, &cell) in self.regions.cell_of_slot().iter().enumerate() {
            let cell = cell as usize;
            if self.class[cell] == TerrainClass::Flat {
                let [x, y] = self.cells.cell_centre_m(cell);
                let distance_m = (x * x + y * y + sweep.mount_height_m * sweep.mount_height_m).sqrt();
                raw[cell] = self.roughness.raw(slot, distance_m, &self.config);
            }
        }
    }

    /// Writes one channel of [`PLANE`]; `raw` is empty before.
    fn write_plane(&self, axis: usize, raw: &mut Vec<i8>) {
        raw.extend(self.class.iter().zip(self.regions.of_cell()).enumerate().map(|(cell, (&class, &region))| {
            if region < FIRST_FLAT || class == TerrainClass::Unknown {
                return PLANE[axis].unknown;
            }
            let plane @ Plane([a, b, _]) = &self.regions.planes()[(region - FIRST_FLAT) as usize];
            let [x, y] = self.cells.cell_centre_m(cell);
            let value = [plane.height_m(x, y), *a, *b][axis] / PLANE[axis].scale;
            value.round().clamp(f32::from(i8::MIN + 1), f32::from(i8::MAX)) as i8
        }));
    }

    fn write(&mut self, sweep: &Sweep, layer: &mut Layer) {
        layer.clear_lists();
        let mut class = TypedChannel::CLASS.reuse(&mut layer.channels);
        class.extend(self.class.iter().map(|class| class.value()));
        let count = |of: TerrainClass| class.iter().filter(|class| **class == of.value()).count() as f64;
        let [flat, inferred] = [TerrainClass::Flat, TerrainClass::FlatInferred].map(count);
        layer.metrics.push(("drivable_share", drivable_share(layer.legend, &class)));
        layer.metrics.push(("inferred_share", if flat == 0.0 { 0.0 } else { inferred / flat }));
        layer.metrics.push(("flat_regions", self.regions.planes().len() as f64));
        TypedChannel::CLASS.store(&mut layer.channels, class);
        if self.config.variant == Variant::Grid {
            let mut shape = SHAPE.reuse(&mut layer.channels);
            shape.extend(self.regions.shape_of_cell().iter().map(|shape| *shape as u8));
            SHAPE.store(&mut layer.channels, shape);
        }
        let mut roughness = ROUGHNESS.reuse(&mut layer.channels);
        self.write_roughness(sweep, &mut roughness);
        ROUGHNESS.store(&mut layer.channels, roughness);
        for (axis, channel) in PLANE.iter().enumerate().filter(|_| self.config.planes) {
            let mut raw = channel.reuse(&mut layer.channels);
            self.write_plane(axis, &mut raw);
            channel.store(&mut layer.channels, raw);
        }
    }
}

impl LayerMaker for Terrain {
    fn layer(&self) -> Layer {
        let mut channels = vec![TypedChannel::CLASS.empty()];
        if self.config.variant == Variant::Grid {
            channels.push(SHAPE.empty());
        }
        channels.push(ROUGHNESS.empty());
        if self.config.planes {
            channels.extend(PLANE.iter().map(TypedChannel::empty));
        }
        let TerrainConfig { cell_m, range_m_max, .. } = self.config;
        let side = 2 * half_width(range_m_max, cell_m) as u32;
        Layer::new("terrain", Geometry::about_vehicle(side, cell_m), TerrainClass::LEGEND, channels)
    }

    fn uses(&self) -> ScanExtras {
        ScanExtras { deviations: true, ..ScanExtras::default() }
    }

    fn make(&mut self, sweep: &Sweep, _: &Context<'_>, layer: &mut Layer) {
        self.cells.sort_points(sweep, self.config.overhang_m);
        self.regions.divide(&self.cells, &self.config);
        self.seen.clear();
        self.seen.resize(self.regions.of_cell().len(), false);
        self.regions.cell_of_slot().iter().for_each(|cell| self.seen[*cell as usize] = true);
        if self.config.variant == Variant::Grounded {
            self.ground.join_and_fill(&self.cells, &self.regions, &self.seen, &self.config);
        }
        self.classify(sweep.mount_height_m);
        self.write(sweep, layer);
    }
}
