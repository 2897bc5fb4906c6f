//! Raw returns to corrected points, a block of 32 at a time.
//!
//! In: the 96 bytes of a block's returns, its azimuth and how fast the sensor turns. Out: 32 slots of range, x, y, z
//! (m, sensor frame) and intensity. Loops run over separate arrays without branches, so that the compiler vectorises
//! them. Formula: HDL-64E S3 manual rev K, appendix F (the same with zero offsets for every other model), with the
//! sensor's y axis as our x and its x axis as our -y. VeloView computes the same.

use std::sync::LazyLock;

use crate::calibration::Calibration;
use crate::model::{AZIMUTHS_PER_TURN, ModelSpec, RETURNS_PER_BLOCK};
use crate::packet::{BOGUS_DISTANCE, RETURNS_LENGTH};

type Lanes = [f32; RETURNS_PER_BLOCK];
const ZERO: Lanes = [0.0; RETURNS_PER_BLOCK];

/// Where the near-range corrections of the sensor's x and y axis are measured, and the far one; m.
const NEAR_X_M: f64 = 2.4;
const NEAR_Y_M: f64 = 1.93;
const FAR_M: f64 = 25.04;

/// Sine and cosine of every azimuth the wire can carry.
static AZIMUTHS: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
    let of = |count: u32| (f64::from(count) * std::f64::consts::TAU / f64::from(AZIMUTHS_PER_TURN)).sin_cos();
    (0..AZIMUTHS_PER_TURN).map(of).map(|(sin, cos)| [sin as f32, cos as f32]).collect()
});

/// What turns one sensor's returns into points.
#[derive(Clone, Debug)]
pub(crate) struct Beams {
    spec: &'static ModelSpec,
    metres_per_count: f32,
    /// Whether any laser has offsets or near-range corrections.
    corrected: bool,
    /// Blocks 0, 1, … of a firing.
    banks: Vec<Bank>,
    /// Turned corrections for the rates of turn seen lately, at `step % TURNS`.
    turns: Vec<Turn>,
}

/// The 32 lasers of one block. With 16 lasers they come twice.
#[derive(Clone, Debug)]
struct Bank {
    rotation_rad: [f64; RETURNS_PER_BLOCK],
    sin_elevation: Lanes,
    cos_elevation: Lanes,
    far_m: Lanes,
    vertical_m: Lanes,
    horizontal_m: Lanes,
    /// What the correction at range 0 along x, y differs from the far one, and how it falls with every metre.
    x_near_m: Lanes,
    x_slope: Lanes,
    y_near_m: Lanes,
    y_slope: Lanes,
}

/// Sine and cosine of what is added to a block's azimuth at one rate of turn: the turn until the laser fires, less the
/// laser's own azimuth offset.
#[derive(Clone, Debug)]
struct Turn {
    step: u32,
    sin: Vec<Lanes>,
    cos: Vec<Lanes>,
}

const TURNS: usize = 32;

/// 32 slots of each array of an image.
pub(crate) struct Slots<'a> {
    pub range_m: &'a mut Lanes,
    pub x: &'a mut Lanes,
    pub y: &'a mut Lanes,
    pub z: &'a mut Lanes,
    pub intensity: &'a mut [u8; RETURNS_PER_BLOCK],
}

impl Beams {
    pub fn new(spec: &'static ModelSpec, calibration: &Calibration) -> Self {
        let banks: Vec<Bank> =
            (0..spec.lasers.div_ceil(RETURNS_PER_BLOCK)).map(|bank| Bank::new(calibration, bank)).collect();
        Self {
            spec,
            metres_per_count: calibration.distance_m_per_count as f32,
            corrected: banks.iter().any(Bank::has_offsets),
            turns: vec![Turn { step: u32::MAX, sin: Vec::new(), cos: Vec::new() }; TURNS],
            banks,
        }
    }

    /// Decodes one block of bank `bank`, sent at `azimuth`, by a sensor that turns `step` counts a block.
    pub fn decode(
        &mut self,
        returns: &[u8; RETURNS_LENGTH],
        bank: usize,
        azimuth: u32,
        step: u32,
        out: &mut Slots<'_>,
    ) {
        let turn = &mut self.turns[step as usize % TURNS];
        if turn.step != step {
            *turn = Turn::new(self.spec, &self.banks, step);
        }
        let lasers = &self.banks[bank];
        let [sin, cos] = AZIMUTHS[azimuth as usize % AZIMUTHS_PER_TURN as usize];
        ranges(returns, self.metres_per_count, &lasers.far_m, out);
        let (mut sines, mut cosines) = (ZERO, ZERO);
        for i in 0..RETURNS_PER_BLOCK {
            sines[i] = sin * turn.cos[bank][i] + cos * turn.sin[bank][i];
            cosines[i] = cos * turn.cos[bank][i] - sin * turn.sin[bank][i];
        }
        if self.corrected {
            corrected_points(lasers, &sines, &cosines, out);
        } else {
            points(lasers, &sines, &cosines, out);
        }
    }
}

/// Range 0 where there is no echo, as a select that vectorises.
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
            // Linear from `excess` at `near_m` to 0 at `FAR_M`.
            let slope = -excess / (FAR_M - near_m);
            ((-slope * FAR_M) as f32, slope as f32)
        };
        let x = |i: usize| near(laser(i).dist_correction_x, i, NEAR_X_M);
        let y = |i: usize| near(laser(i).dist_correction_y, i, NEAR_Y_M);
        Self {
            rotation_rad: std::array::from_fn(|i| laser(i).rot_correction),
            sin_elevation: std::array::from_fn(|i| laser(i).vert_correction.sin() as f32),
            cos_elevation: std::array::from_fn(|i| laser(i).vert_correction.cos() as f32),
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

impl Turn {
    fn new(spec: &ModelSpec, banks: &[Bank], step: u32) -> Self {
        let angle = |bank: usize, i: usize| {
            let offset = spec.azimuth_offset(bank * RETURNS_PER_BLOCK + i, step);
            f64::from(offset) * std::f64::consts::TAU / f64::from(AZIMUTHS_PER_TURN) - banks[bank].rotation_rad[i]
        };
        let all = |f: fn(f64) -> f64| {
            (0..banks.len()).map(|bank| std::array::from_fn(|i| f(angle(bank, i)) as f32)).collect::<Vec<Lanes>>()
        };
        Self { step, sin: all(f64::sin), cos: all(f64::cos) }
    }
}
