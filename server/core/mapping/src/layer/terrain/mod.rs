//! Neuhaus' terrain map (Neuhaus 2009 §2): where the ground is flat, by hierarchical principal component analysis, and
//! how rough it is there.
//!
//! In: a [`Sweep`], ego frame, metres. Out: the layer `terrain`, square cells about the vehicle. The steps:
//!
//! | step | paper | where |
//! |---|---|---|
//! | points to cells; sums over any region in O(1) | §2.2 | [`moments`] |
//! | principal components, local height disturbance h | §2.1, eq. 1 | [`eigen`] |
//! | hierarchical division into flat regions (or each cell for itself) | §2.2, §2.3 | [`regions`] |
//! | regions that join the ground under the vehicle; bounded inference | beyond the paper | [`ground`] |
//! | which of it the vehicle gets to | beyond the paper | [`shadow`], [`reach`] |
//! | roughness of flat cells | §2.4, §2.5, eq. 3 and 4 | [`crate::sensor::distance_series`], [`roughness`] |
//!
//! Three forms stand side by side ([`Form`]). `paper`: as published; car roofs are flat, and cells far beyond the last
//! point are inferred. `grounded`: a flat region holds no point that stands out of its plane, joins the ground under
//! the vehicle without a step, by ways the vehicle fits through, and speaks only for holes in seen ground. `grid`: each
//! cell for itself, with the shape of its points.
//!
//! Nothing depends on the order of the points: all sums are over whole numbers.

pub mod eigen;
pub mod ground;
pub mod moments;
pub mod reach;
pub mod regions;
pub mod roughness;
pub mod shadow;

use crate::config::{Form, TerrainConfig};
use crate::map::{Cells as Raw, Channel, Geometry, Layer, LayerMaker};
use crate::sensor::sweep::Sweep;

use ground::Ground;
use moments::{Cells, half_width};
use reach::{Passage, Reach};
use regions::{FIRST_FLAT, OBSTACLE as NOT_FLAT, Plane, Regions};
use roughness::Roughness;
use shadow::Shadow;

/// No point fell into the cell, or too few to judge it by, and no flat region speaks for it.
pub const UNKNOWN: u8 = 0;
/// Points fell into the cell, and it is part of flat ground.
pub const FLAT: u8 = 1;
/// No point fell into the cell; the flat region about it speaks for it.
pub const FLAT_INFERRED: u8 = 2;
/// Flat, but not joined to the ground under the vehicle: a car's roof, a wall's top, a far bank.
pub const FLAT_ELEVATED: u8 = 3;
/// Not flat even by itself.
pub const OBSTACLE: u8 = 4;
/// Flat and as high as the ground under the vehicle, but no way the vehicle fits through leads there.
pub const FLAT_UNREACHABLE: u8 = 5;
/// Names of the classes, by value.
pub const LEGEND: &[&str] = &["unknown", "flat", "flat_inferred", "flat_elevated", "obstacle", "flat_unreachable"];

/// Raw `roughness` of a cell that is not flat, or has too few points with a distance series.
pub const ROUGHNESS_UNKNOWN: u8 = u8::MAX;
/// Raw `height` and slopes of a cell without a plane.
pub const PLANE_UNKNOWN: i8 = i8::MIN;

/// Raw `shape` of a cell that was not judged.
pub const SHAPE_UNKNOWN: u8 = 0;
/// Points without a direction.
pub const SHAPE_SCATTER: u8 = 1;
/// Points along a line.
pub const SHAPE_LINE: u8 = 2;
/// Points of a plane.
pub const SHAPE_PLANE: u8 = 3;

/// What stands lower than this hides no more than itself: a kerb is no fence.
const STANDS_M_MIN: f32 = 0.5;

/// Metres of a raw unit of `height`, and rise over run of one of `slope_x` and `slope_y`.
const PLANE_SCALES: [f32; 3] = [0.05, 0.02, 0.02];

/// Makes the layer from sweep after sweep, reusing its buffers.
pub struct Terrain {
    config: TerrainConfig,
    cells: Cells,
    regions: Regions,
    ground: Ground,
    shadow: Shadow,
    reach: Reach,
    roughness: Roughness,
    seen: Vec<bool>,
}

impl Terrain {
    /// Parameters must have passed [`crate::config::MapsConfig::validate`].
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
        }
    }

    fn classify(&mut self, sensor_m: f32, class: &mut Vec<u8>) {
        class.clear();
        let region_of = self.regions.of_cell();
        if self.config.form == Form::Grounded {
            let joined = self.ground.joined();
            // What is neither seen nor filled stays unknown.
            class.resize(region_of.len(), UNKNOWN);
            for &cell in self.regions.cell_of_slot() {
                class[cell as usize] = match region_of[cell as usize] {
                    NOT_FLAT => OBSTACLE,
                    region @ FIRST_FLAT.. if joined[(region - FIRST_FLAT) as usize] => FLAT,
                    FIRST_FLAT.. => FLAT_ELEVATED,
                    _ => UNKNOWN,
                };
            }
            for &cell in self.ground.filled() {
                let class = &mut class[cell as usize];
                if *class == UNKNOWN {
                    *class = if self.seen[cell as usize] { FLAT } else { FLAT_INFERRED };
                }
            }
            self.gate(class, sensor_m);
        } else {
            class.extend(region_of.iter().zip(&self.seen).map(|(&region, &seen)| match (region, seen) {
                (NOT_FLAT, _) => OBSTACLE,
                (FIRST_FLAT.., true) => FLAT,
                (FIRST_FLAT.., false) => FLAT_INFERRED,
                _ => UNKNOWN,
            }));
        }
    }

    /// Takes back ground the vehicle does not get to; what is only inferred there is not known.
    fn gate(&mut self, class: &mut [u8], sensor_m: f32) {
        let TerrainConfig { gate_m_min, blind_zone_m, cell_m, .. } = self.config;
        let (cells, seen, bridged) = (&self.cells, &self.seen, self.ground.bridged());
        self.shadow.clear(class.len(), |cell| cells.middle_m(cell));
        for (slot, &cell) in
            self.regions.cell_of_slot().iter().enumerate().filter(|(_, cell)| class[**cell as usize] == OBSTACLE)
        {
            let [lowest_m, highest_m] = cells.span_m(slot);
            if highest_m - lowest_m >= STANDS_M_MIN {
                self.shadow.cast(cell as usize, cell_m, [lowest_m, highest_m], sensor_m);
            }
        }

        let (regions, joined, shadow) = (self.regions.of_cell(), self.ground.joined(), &self.shadow);
        let is_ground = |region: u32| region >= FIRST_FLAT && joined[(region - FIRST_FLAT) as usize];
        let width = cells.width();
        let blind = (blind_zone_m / cell_m).ceil() as usize;
        let is_near = |ix: usize| ix + blind >= width / 2 && ix < width / 2 + blind;
        let passage = |ix: usize, iy: usize| match (iy * width + ix, class[iy * width + ix]) {
            (_, FLAT) => Passage::Open,
            (_, OBSTACLE | FLAT_ELEVATED) => Passage::Closed,
            (cell, _) if seen[cell] => Passage::None,
            (_, FLAT_INFERRED) => Passage::Open,
            (cell, _) if (bridged[cell] || is_ground(regions[cell])) && !shadow.hides(cell) => Passage::Open,
            (cell, _) if is_near(ix) && is_near(iy) && shadow.distance_m(cell) <= blind_zone_m => Passage::Open,
            _ => Passage::None,
        };
        // Between obstacles so far apart at least this many whole cells are free, less one: the disc's middle.
        let radius = ((gate_m_min / cell_m - 2.0) / 2.0).max(0.0) as usize;
        self.reach.find(width, radius, passage);
        for (iy, row) in class.chunks_exact_mut(width).enumerate() {
            for (ix, class) in row.iter_mut().enumerate() {
                if matches!(*class, FLAT | FLAT_INFERRED) && !self.reach.reached(ix, iy) {
                    *class = if *class == FLAT { FLAT_UNREACHABLE } else { UNKNOWN };
                }
            }
        }
    }

    /// Roughness of the flat cells (drivable regions are examined further, §2.4).
    fn write_roughness(&mut self, sweep: &Sweep, class: &[u8], raw: &mut Vec<u8>) {
        raw.clear();
        raw.resize(class.len(), ROUGHNESS_UNKNOWN);
        if sweep.deviation_m.is_empty() {
            return;
        }
        self.roughness.take(sweep, &self.cells);
        for (slot, &cell) in self.regions.cell_of_slot().iter().enumerate() {
            let cell = cell as usize;
            if class[cell] == FLAT {
                let [x, y] = self.cells.middle_m(cell);
                let distance_m = (x * x + y * y + sweep.mount_height_m * sweep.mount_height_m).sqrt();
                raw[cell] = self.roughness.raw(slot, distance_m, &self.config);
            }
        }
    }

    fn write_planes(&self, class: &[u8], channels: &mut [Channel]) {
        for (axis, channel) in channels.iter_mut().enumerate() {
            let Raw::I8(raw) = &mut channel.cells else { unreachable!("layer() gives i8") };
            raw.clear();
            raw.extend(class.iter().zip(self.regions.of_cell()).enumerate().map(|(cell, (&class, &region))| {
                if region < FIRST_FLAT || class == UNKNOWN {
                    return PLANE_UNKNOWN;
                }
                let plane @ Plane([a, b, _]) = &self.regions.planes()[(region - FIRST_FLAT) as usize];
                let [x, y] = self.cells.middle_m(cell);
                let value = [plane.height_m(x, y), *a, *b][axis] / PLANE_SCALES[axis];
                value.round().clamp(f32::from(i8::MIN + 1), f32::from(i8::MAX)) as i8
            }));
        }
    }
}

impl LayerMaker for Terrain {
    fn layer(&self) -> Layer {
        let mut channels = vec![Channel::class()];
        if self.config.form == Form::Grid {
            channels.push(Channel::u8("shape", "", 1.0, SHAPE_UNKNOWN));
        }
        channels.push(Channel::u8("roughness", "", roughness::SCALE, ROUGHNESS_UNKNOWN));
        if self.config.planes {
            let named = [("height", "m"), ("slope_x", ""), ("slope_y", "")];
            let plane = |((name, unit), scale)| Channel::i8(name, unit, scale, PLANE_UNKNOWN);
            channels.extend(named.into_iter().zip(PLANE_SCALES).map(plane));
        }
        let TerrainConfig { cell_m, range_m_max, .. } = self.config;
        let side = 2 * half_width(range_m_max, cell_m) as u32;
        Layer::new("terrain", Geometry::about_vehicle(side, cell_m), LEGEND, channels)
    }

    fn wants_deviations(&self) -> bool {
        true
    }

    fn make(&mut self, sweep: &Sweep, layer: &mut Layer) {
        self.cells.take(sweep, self.config.overhang_m);
        self.regions.find(&self.cells, &self.config);
        self.seen.clear();
        self.seen.resize(self.regions.of_cell().len(), false);
        self.regions.cell_of_slot().iter().for_each(|cell| self.seen[*cell as usize] = true);
        if self.config.form == Form::Grounded {
            self.ground.find(&self.cells, &self.regions, &self.seen, &self.config);
        }

        layer.clear_lists();
        let mut channels = layer.channels.iter_mut();
        let mut next = || match &mut channels.next().expect("a channel of layer()").cells {
            Raw::U8(cells) => cells,
            other => unreachable!("layer() gives u8, not {other:?}"),
        };
        let class = next();
        self.classify(sweep.mount_height_m, class);
        if self.config.form == Form::Grid {
            next().clone_from(self.regions.shape_of_cell());
        }
        self.write_roughness(sweep, class, next());
        self.write_planes(class, channels.into_slice());

        let count = |of: u8| class.iter().filter(|class| **class == of).count() as f64;
        let [flat, inferred] = [FLAT, FLAT_INFERRED].map(count);
        let judged = flat + [FLAT_ELEVATED, OBSTACLE, FLAT_UNREACHABLE].map(count).iter().sum::<f64>();
        layer.figures.push(("drivable_share", if judged == 0.0 { 0.0 } else { flat / judged }));
        layer.figures.push(("inferred_share", if flat == 0.0 { 0.0 } else { inferred / flat }));
        layer.figures.push(("flat_regions", self.regions.planes().len() as f64));
    }
}
