//! The layer `terrain` (Neuhaus 2009, section 2): where the ground is flat, by hierarchical principal component
//! analysis, and how rough it is there.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer, square cells about the vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | points -> cells; sums over any region in O(1) | section 2.2 | [`moments`] |
//! | principal components, local height disturbance h | section 2.1, eq. 1 | [`eigen`] |
//! | the whole grid, then two pieces along the longest axis; or four quarters | section 2.3 | [`division`] |
//! | hierarchical division into flat regions, or each cell by itself | sections 2.2 and 2.3 | [`regions`] |
//! | regions on the local ground that the vehicle can reach | not in the paper | [`crate::ground`], [`crate::reach`] |
//! | bounded inference | not in the paper | [`holes`] |
//! | roughness of flat cells | sections 2.4 and 2.5, eq. 3 and 4 | [`crate::sensor::distance_series`], [`roughness`] |
//!
//! There are three variants ([`Variant`]):
//! - `paper`: as published. Car roofs are flat, and cells far beyond the last point are inferred.
//! - `grounded`: no point of a flat region lies off its plane; its cells lie on the local ground, and the vehicle can
//!   reach them; only holes in seen ground are inferred.
//! - `grid`: each cell by itself, with the shape of its points.
//!
//! The result does not depend on the order of the points: all sums are over whole numbers.
//!
//! [`roughness`]: crate::layer::roughness

pub mod class;
pub mod config;
pub mod division;
pub mod eigen;
pub mod holes;
pub mod moments;
pub mod regions;

use crate::layer::channel::TypedChannel;
use crate::layer::class::{count_cells, drivable_share};
use crate::layer::grid::Geometry;
use crate::layer::maker::{Context, Layer, LayerMaker};
use crate::sensor::rays::ScanExtras;
use crate::sensor::sweep::Sweep;

use class::{PLANE, ROUGHNESS, SHAPE, TerrainClass};
use config::{STEP_M_MAX, TerrainConfig, Variant};
use holes::{Holes, Role};
use moments::{Cells, half_width};
use regions::{FIRST_FLAT, NOT_FLAT, Plane, Regions};

/// Maker of the layer `terrain`. It reuses its buffers from map to map.
#[derive(Clone)]
pub struct Terrain {
    config: TerrainConfig,
    cells: Cells,
    regions: Regions,
    holes: Holes,
    /// One bit for each cell, set if a point fell into it.
    seen: Vec<u64>,
    /// By cell.
    class: Vec<TerrainClass>,
}

impl Terrain {
    /// A maker with validated parameters.
    pub fn new(config: &TerrainConfig) -> Self {
        Self {
            config: config.of_variant(),
            cells: Cells::new(config.range_m_max, config.cell_m, config.variant.division()),
            regions: Regions::default(),
            holes: Holes::default(),
            seen: Vec::new(),
            class: Vec::new(),
        }
    }

    /// Fills `class` from the regions.
    fn classify(&mut self, context: &Context<'_>) {
        let mut class = std::mem::take(&mut self.class);
        class.clear();
        let region_of = self.regions.of_cell();
        if self.config.variant == Variant::Grounded {
            // Cells that are neither seen nor filled stay unknown.
            class.resize(region_of.len(), TerrainClass::Unknown);
            for (slot, &cell) in self.regions.cell_of_slot().iter().enumerate() {
                class[cell as usize] = self.class_of_slot(slot, region_of[cell as usize], context);
            }
            self.fill_holes(&mut class, context);
        } else {
            let seen = (0..region_of.len()).map(|cell| self.is_seen(cell));
            class.extend(region_of.iter().zip(seen).map(|(&region, seen)| match (region, seen) {
                (NOT_FLAT, _) => TerrainClass::Obstacle,
                (FIRST_FLAT.., true) => TerrainClass::Flat,
                (FIRST_FLAT.., false) => TerrainClass::FlatInferred,
                _ => TerrainClass::Unknown,
            }));
        }
        self.class = class;
    }

    /// True if a point fell into a cell.
    fn is_seen(&self, cell: usize) -> bool {
        self.seen[cell / 64] >> (cell % 64) & 1 != 0
    }

    /// Indices of the cells into which a point fell, ascending.
    fn seen_cells(&self) -> impl Iterator<Item = usize> {
        self.seen.iter().enumerate().filter(|(_, bits)| **bits != 0).flat_map(|(word, &bits)| {
            let without_lowest = |bits: &u64| Some(bits & (bits - 1)).filter(|bits| *bits != 0);
            std::iter::successors(Some(bits), without_lowest)
                .map(move |bits| 64 * word + bits.trailing_zeros() as usize)
        })
    }

    /// Class of a cell with points, in the variant `grounded`: flat if all its points lie on the local ground.
    fn class_of_slot(&self, slot: usize, region: u32, context: &Context<'_>) -> TerrainClass {
        let [x, y] = self.cells.cell_centre_m(self.cells.cell_of_slot(slot));
        let highest_m = self.cells.span_m(slot)[1] - context.ground_m(x, y);
        match region {
            _ if highest_m > STEP_M_MAX && region == NOT_FLAT => TerrainClass::Obstacle,
            _ if highest_m > STEP_M_MAX && region >= FIRST_FLAT => TerrainClass::FlatElevated,
            _ if region != NOT_FLAT && region < FIRST_FLAT => TerrainClass::Unknown,
            _ if context.is_reached(x, y) => TerrainClass::Flat,
            _ => TerrainClass::FlatUnreachable,
        }
    }

    /// Infers narrow holes in flat ground that the vehicle can reach. A seen cell with too few points to be judged is
    /// flat in such a hole if they lie on the local ground.
    fn fill_holes(&mut self, class: &mut [TerrainClass], context: &Context<'_>) {
        let (cells, width) = (&self.cells, self.cells.width());
        let span = (self.config.inference_m_max / self.config.cell_m).round() as usize;
        let is_low = |cell: usize| {
            let [x, y] = cells.cell_centre_m(cell);
            cells.span_m(cells.slot_of_cell(cell))[1] - context.ground_m(x, y) <= STEP_M_MAX
        };
        let role = |cell: usize| match class[cell] {
            TerrainClass::Flat => Role::Flat,
            TerrainClass::Unknown if is_low(cell) => Role::Fillable,
            _ => Role::Barrier,
        };
        let mut holes = std::mem::take(&mut self.holes);
        holes.find(width, span, self.seen_cells().map(|cell| (cell, role(cell))));
        for &cell in holes.cells() {
            let cell = cell as usize;
            let [x, y] = self.cells.cell_centre_m(cell);
            if context.is_reached(x, y) {
                class[cell] = if self.is_seen(cell) { TerrainClass::Flat } else { TerrainClass::FlatInferred };
            }
        }
        self.holes = holes;
    }

    /// Writes the roughness of the flat cells (section 2.4); `raw` is empty before.
    fn write_roughness(&self, sweep: &Sweep, raw: &mut Vec<u8>) {
        raw.resize(self.class.len(), ROUGHNESS.unknown);
        if sweep.deviation.is_empty() {
            return;
        }
        for &cell in self.regions.cell_of_slot() {
            let cell = cell as usize;
            let is_flat = matches!(self.class[cell], TerrainClass::Flat | TerrainClass::FlatUnreachable);
            if is_flat && let Some(roughness) = self.cells.roughness(cell, self.config.roughness_points_min) {
                let steps = (roughness / ROUGHNESS.scale).round() as u32;
                raw[cell] = steps.min(u32::from(ROUGHNESS.unknown) - 1) as u8;
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
        let count = |of: TerrainClass| count_cells(&class, of.value()) as f64;
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
        ScanExtras { ground: true, reached: true, deviations: true, ..ScanExtras::default() }
    }

    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        // The paper takes heights over the plane under the vehicle, and has no memory.
        let is_ours = self.config.variant == Variant::Grounded;
        let own = sweep.x.len() - sweep.remembered;
        let heights_m = if is_ours { context.heights_m(sweep) } else { &sweep.z[..own] };
        self.cells.sort_points(sweep, heights_m, self.config.overhang_m);
        self.regions.divide(&self.cells, &self.config);
        self.seen.clear();
        self.seen.resize(self.regions.of_cell().len().div_ceil(64), 0);
        self.regions.cell_of_slot().iter().for_each(|cell| self.seen[*cell as usize / 64] |= 1 << (cell % 64));
        self.classify(context);
        self.write(sweep, layer);
    }
}
