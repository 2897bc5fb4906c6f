//! The factory tables: nominal angles of every model, in firing order.
//!
//! Sources: the tables of elevations (and azimuth offsets) in the manuals of HDL-32E, VLP-16, Puck Hi-Res, VLP-32C and
//! VLS-128. Each HDL-64E is measured individually; its table here is nominal: evenly spaced elevations between the
//! limits in the manual, the order of lasers of real units, and azimuth offsets that are rounded from published units.

use super::table::{Calibration, LaserCalibration};
use crate::model::Model;

/// The nominal table of a model.
pub(super) fn factory(model: Model) -> Calibration {
    let angles: Vec<(f64, f64)> = match model {
        Model::Hdl64eS1 | Model::Hdl64eS2 | Model::Hdl64eS3 => hdl64e(),
        Model::Hdl32e => (0..32).map(|laser| (hdl32e_elevation(laser), 0.0)).collect(),
        Model::Vlp16 => (0..16).map(|laser| (interleaved(laser, -15.0, 2.0), 0.0)).collect(),
        Model::PuckHiRes => PUCK_HI_RES.iter().map(|elevation| (*elevation, 0.0)).collect(),
        Model::Vlp32c => VLP32C.to_vec(),
        Model::Vls128 => vls128(),
    };
    let lasers = angles.iter().enumerate().map(|(id, (elevation, rotation))| LaserCalibration {
        laser_id: id as u16,
        vert_correction: elevation.to_radians(),
        rot_correction: rotation.to_radians(),
        ..LaserCalibration::default()
    });
    Calibration { distance_m_per_count: model.spec().distance_m_per_count, lasers: lasers.collect() }
}

/// Elevation of a laser, in degrees: even lasers rise from the lowest one, odd lasers from the middle (VLP-16: -15, 1,
/// -13, 3, …).
fn interleaved(laser: usize, lowest: f64, step: f64) -> f64 {
    lowest + step * (laser / 2 + laser % 2 * 8) as f64
}

/// Elevation of a laser, in degrees: -30.67, -9.33, -29.33, -8.00, … 10.67. The steps are thirds of four degrees,
/// rounded to two decimals as in the manual.
fn hdl32e_elevation(laser: usize) -> f64 {
    let rank = laser / 2 + laser % 2 * 16;
    let thirds = 4.0 * rank as f64 - 92.0;
    (thirds / 3.0 * 100.0).round() / 100.0
}

/// Elevations of a Puck Hi-Res, in degrees.
const PUCK_HI_RES: [f64; 16] =
    [-10.0, 0.667, -8.667, 2.0, -7.333, 3.333, -6.0, 4.667, -4.667, 6.0, -3.333, 7.333, -2.0, 8.667, -0.667, 10.0];

/// Elevation and azimuth offset of each laser of a VLP-32C, in degrees.
const VLP32C: [(f64, f64); 32] = [
    (-25.0, -1.4),
    (-1.0, 4.2),
    (-1.667, -1.4),
    (-15.639, 1.4),
    (-11.31, -1.4),
    (0.0, 1.4),
    (-0.667, -4.2),
    (-8.843, 1.4),
    (-7.254, -1.4),
    (0.333, 4.2),
    (-0.333, -1.4),
    (-6.148, 1.4),
    (-5.333, -4.2),
    (1.333, 1.4),
    (0.667, -4.2),
    (-4.0, 1.4),
    (-4.667, -1.4),
    (1.667, 4.2),
    (1.0, -1.4),
    (-3.667, 4.2),
    (-3.333, -4.2),
    (3.333, 1.4),
    (2.333, -1.4),
    (-2.667, 1.4),
    (-3.0, -1.4),
    (7.0, 1.4),
    (4.667, -1.4),
    (-2.333, 4.2),
    (-2.0, -4.2),
    (15.0, 1.4),
    (10.333, -1.4),
    (-1.333, 1.4),
];

/// Elevation of each laser of a VLS-128, in degrees.
#[expect(clippy::approx_constant, reason = "-6.28 is an elevation")]
const VLS128_ELEVATION: [f64; 128] = [
    -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19, -3.86, 1.53,
    -9.244, -1.77, 2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58, -0.34, 5.18, -3.64,
    1.75, -25.0, -2.43, 2.96, -5.73, 0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85, 3.18, -5.51, -0.12, 5.73, -4.3,
    1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15.0, -3.42, 1.97, -6.85, -1.33, -5.62, -0.23, 5.43, -3.53, 0.98, -19.582,
    -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44, 3.95, -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2,
    -13.565, -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65, 1.42, -10.346, -1.88, 3.51, -6.06, -0.67, 4.72, -3.97,
    2.3, -6.39, -1.0, 4.39, -5.18, 0.21, 6.98, -3.09, 4.98, -3.75, 1.64, -8.352, -2.54, 2.85, -5.84, -0.45, 8.43,
    -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43,
];
/// Azimuth offsets of a VLS-128, in degrees; they repeat every eight lasers.
const VLS128_ROTATION: [f64; 8] = [-6.354, -4.548, -2.732, -0.911, 0.911, 2.732, 4.548, 6.354];

fn vls128() -> Vec<(f64, f64)> {
    VLS128_ELEVATION.iter().enumerate().map(|(laser, elevation)| (*elevation, VLS128_ROTATION[laser % 8])).collect()
}

/// Lasers of one HDL-64E block from the lowest to the highest. The order is the same in both blocks.
const HDL64E_FROM_LOWEST: [usize; 32] = [
    6, 7, 10, 11, 0, 1, 4, 5, 8, 9, 14, 15, 18, 19, 22, 23, 12, 13, 16, 17, 20, 21, 26, 27, 30, 31, 2, 3, 24, 25, 28,
    29,
];
/// Azimuth offsets of the upper block of an HDL-64E, in degrees: the offset of the first laser of each pair, from the
/// lowest pair up, repeated after six pairs; and the difference from the first to the second laser of a pair.
const HDL64E_UPPER_ROTATION: ([f64; 6], f64) = ([-1.0, 3.25, -4.5, -0.25, 4.0, -5.25], 2.25);
/// Azimuth offsets of the lower block of an HDL-64E, in degrees, listed as in [`HDL64E_UPPER_ROTATION`].
const HDL64E_LOWER_ROTATION: ([f64; 6], f64) = ([-1.75, 5.25, -7.5, -0.5, 6.25, -8.5], 3.5);

fn hdl64e() -> Vec<(f64, f64)> {
    let mut angles = vec![(0.0, 0.0); 64];
    for (rank, laser) in HDL64E_FROM_LOWEST.iter().enumerate() {
        let rotation = |(pairs, second): ([f64; 6], f64)| pairs[rank / 2 % 6] + second * (rank % 2) as f64;
        let down = (31 - rank) as f64;
        angles[*laser] = (2.0 - down / 3.0, rotation(HDL64E_UPPER_ROTATION));
        angles[32 + laser] = (-8.83 - down / 2.0, rotation(HDL64E_LOWER_ROTATION));
    }
    angles
}
