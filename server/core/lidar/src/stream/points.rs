//! Raw returns to corrected points, one block of 32 at a time.
//!
//! In: the 96 bytes of the returns of a block, its azimuth, and the step of the sensor from block to block. Out: 32
//! slots of range, x, y, z (m, sensor frame) and intensity. The loops run over separate arrays without branches, so
//! that the compiler vectorises them. Formula: HDL-64E S3 manual 63-HDL64ES3 rev K, appendix F, with zero offsets for
//! all other models. The manual's y axis is our x, and its x axis is our -y. VeloView computes the same.

use std::sync::LazyLock;

use crate::calibration::Calibration;
use crate::datagram::packet::{BOGUS_DISTANCE, RETURNS_LENGTH};
use crate::model::{AZIMUTHS_PER_REVOLUTION, ModelSpec, RETURNS_PER_BLOCK};
use crate::revolution::echo::{Lanes, Slots};

const ZERO: Lanes = [0.0; RETURNS_PER_BLOCK];

/// Distance along the manual's x axis at which the near-range correction is measured, in m (HDL-64E S3 manual rev K,
/// appendix F).
const NEAR_X_M: f64 = 2.4;
/// Distance along the manual's y axis at which the near-range correction is measured, in m.
const NEAR_Y_M: f64 = 1.93;
/// Distance at which the far correction is measured, in m.
const FAR_M: f64 = 25.04;

/// Sine and cosine of every azimuth, by its count.
static AZIMUTHS: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let sin_cos =
        |count: u32| libm::sincos(f64::from(count) * std::f64::consts::TAU / f64::from(AZIMUTHS_PER_REVOLUTION));
    (0..AZIMUTHS_PER_REVOLUTION).map(sin_cos).map(|(sin, cos)| [sin as f32, cos as f32]).collect()
});

/// The corrections of one sensor, prepared for blocks of 32 lasers.
#[derive(Clone, Debug)]
pub(super) struct PointCorrection {
    spec: &'static ModelSpec,
    metres_per_count: f32,
    /// True if any laser has offsets or near-range corrections.
    corrected: bool,
    /// Lasers of blocks 0, 1, … of a firing.
    banks: Vec<Bank>,
    /// Rotations of the last steps, at index `step % ROTATIONS`.
    rotations: Vec<Rotation>,
}

/// The corrections of the 32 lasers of one block. 16 lasers are there twice.
#[derive(Clone, Debug)]
struct Bank {
    rotation_rad: [f64; RETURNS_PER_BLOCK],
    sin_elevation: Lanes,
    cos_elevation: Lanes,
    far_m: Lanes,
    vertical_m: Lanes,
    horizontal_m: Lanes,
    /// Correction at distance 0 along x, less the far correction.
    x_near_m: Lanes,
    /// Change of that difference per metre.
    x_slope: Lanes,
    /// Correction at distance 0 along y, less the far correction.
    y_near_m: Lanes,
    y_slope: Lanes,
}

/// Sine and cosine of the angle between the azimuth of a block and the direction of each laser: the rotation until the
/// laser fires, less the azimuth offset of the laser.
#[derive(Clone, Debug)]
struct Rotation {
    /// Counts by which the sensor turns from block to block.
    step: u32,
    sin: Vec<Lanes>,
    cos: Vec<Lanes>,
}

/// Number of rotations that are kept. Ours: the step of a sensor varies by a few counts, so that each is computed once.
const ROTATIONS: usize = 32;

impl PointCorrection {
    pub fn new(spec: &'static ModelSpec, calibration: &Calibration) -> Self {
        let banks: Vec<Bank> =
            (0..spec.lasers.div_ceil(RETURNS_PER_BLOCK)).map(|bank| Bank::new(calibration, bank)).collect();
        Self {
            spec,
            metres_per_count: calibration.distance_m_per_count as f32,
            corrected: banks.iter().any(Bank::has_offsets),
            rotations: vec![Rotation { step: u32::MAX, sin: Vec::new(), cos: Vec::new() }; ROTATIONS],
            banks,
        }
    }

    /// Converts the returns of one block of bank `bank`, at `azimuth`, of a sensor that turns by `step` counts per
    /// block.
    pub fn convert(
        &mut self,
        returns: &[u8; RETURNS_LENGTH],
        bank: usize,
        azimuth: u32,
        step: u32,
        out: &mut Slots<'_>,
    ) {
        let rotation = &mut self.rotations[step as usize % ROTATIONS];
        if rotation.step != step {
            *rotation = Rotation::new(self.spec, &self.banks, step);
        }
        let lasers = &self.banks[bank];
        let [sin, cos] = AZIMUTHS[azimuth as usize % AZIMUTHS_PER_REVOLUTION as usize];
        ranges(returns, self.metres_per_count, &lasers.far_m, out);
        let (mut sines, mut cosines) = (ZERO, ZERO);
        for i in 0..RETURNS_PER_BLOCK {
            sines[i] = sin * rotation.cos[bank][i] + cos * rotation.sin[bank][i];
            cosines[i] = cos * rotation.cos[bank][i] - sin * rotation.sin[bank][i];
        }
        if self.corrected {
            corrected_points(lasers, &sines, &cosines, out);
        } else {
            points(lasers, &sines, &cosines, out);
        }
    }
}

/// Writes ranges and intensities. The range is 0 without a return; the selection has no branch, so that it vectorises.
fn ranges(returns: &[u8; RETURNS_LENGTH], metres_per_count: f32, far_m: &Lanes, out: &mut Slots<'_>) {
    let mut counts = [0_i32; RETURNS_PER_BLOCK];
    for i in 0..RETURNS_PER_BLOCK {
        counts[i] = i32::from(u16::from_le_bytes([returns[3 * i], returns[3 * i + 1]]));
        out.intensity[i] = returns[3 * i + 2];
    }
    for i in 0..RETURNS_PER_BLOCK {
        let echo = (counts[i] != 0) & (counts[i] < i32::from(BOGUS_DISTANCE));
        let range = counts[i] as f32 * metres_per_count + far_m[i];
        out.range_m[i] = if echo { range.max(0.0) } else { 0.0 };
    }
}

fn points(lasers: &Bank, sines: &Lanes, cosines: &Lanes, out: &mut Slots<'_>) {
    for i in 0..RETURNS_PER_BLOCK {
        let range = out.range_m[i];
        let flat = range * lasers.cos_elevation[i];
        out.x[i] = flat * cosines[i];
        out.y[i] = -flat * sines[i];
        out.z[i] = range * lasers.sin_elevation[i];
    }
}

fn corrected_points(lasers: &Bank, sines: &Lanes, cosines: &Lanes, out: &mut Slots<'_>) {
    for i in 0..RETURNS_PER_BLOCK {
        let (sin, cos, range) = (sines[i], cosines[i], out.range_m[i]);
        let (h, cos_elevation) = (lasers.horizontal_m[i], lasers.cos_elevation[i]);
        let flat = range * cos_elevation;
        let across = (flat * sin - h * cos).abs().min(FAR_M as f32);
        let along = (flat * cos + h * sin).abs().min(FAR_M as f32);
        let range_x = range + (lasers.x_near_m[i] + lasers.x_slope[i] * across);
        let range_y = range + (lasers.y_near_m[i] + lasers.y_slope[i] * along);
        out.x[i] = range_y * cos_elevation * cos + h * sin;
        out.y[i] = h * cos - range_x * cos_elevation * sin;
        out.z[i] = range_y * lasers.sin_elevation[i] + lasers.vertical_m[i];
    }
}

impl Bank {
    fn new(calibration: &Calibration, bank: usize) -> Self {
        let laser = |i: usize| &calibration.lasers[(bank * RETURNS_PER_BLOCK + i) % calibration.lasers.len()];
        let near = |near: Option<f64>, i: usize, near_m: f64| {
            let used = laser(i).two_pt_correction_available;
            let excess = near.filter(|_| used).map_or(0.0, |c| c - laser(i).dist_correction);
            // The difference is linear, from `excess` at `near_m` to 0 at `FAR_M`.
            let slope = -excess / (FAR_M - near_m);
            ((-slope * FAR_M) as f32, slope as f32)
        };
        let x = |i: usize| near(laser(i).dist_correction_x, i, NEAR_X_M);
        let y = |i: usize| near(laser(i).dist_correction_y, i, NEAR_Y_M);
        Self {
            rotation_rad: std::array::from_fn(|i| laser(i).rot_correction),
            sin_elevation: std::array::from_fn(|i| libm::sin(laser(i).vert_correction) as f32),
            cos_elevation: std::array::from_fn(|i| libm::cos(laser(i).vert_correction) as f32),
            far_m: std::array::from_fn(|i| laser(i).dist_correction as f32),
            vertical_m: std::array::from_fn(|i| laser(i).vert_offset_correction as f32),
            horizontal_m: std::array::from_fn(|i| laser(i).horiz_offset_correction as f32),
            x_near_m: std::array::from_fn(|i| x(i).0),
            x_slope: std::array::from_fn(|i| x(i).1),
            y_near_m: std::array::from_fn(|i| y(i).0),
            y_slope: std::array::from_fn(|i| y(i).1),
        }
    }

    fn has_offsets(&self) -> bool {
        [&self.vertical_m, &self.horizontal_m, &self.x_slope, &self.y_slope].iter().any(|lanes| **lanes != ZERO)
    }
}

impl Rotation {
    fn new(spec: &ModelSpec, banks: &[Bank], step: u32) -> Self {
        let angle = |bank: usize, i: usize| {
            let offset = spec.azimuth_offset(bank * RETURNS_PER_BLOCK + i, step);
            f64::from(offset) * std::f64::consts::TAU / f64::from(AZIMUTHS_PER_REVOLUTION) - banks[bank].rotation_rad[i]
        };
        let all = |f: fn(f64) -> f64| {
            (0..banks.len()).map(|bank| std::array::from_fn(|i| f(angle(bank, i)) as f32)).collect::<Vec<Lanes>>()
        };
        Self { step, sin: all(libm::sin), cos: all(libm::cos) }
    }
}
