//! One rotating sensor: firings at their own times, each ray along its laser's true line, raw returns as the sensor
//! reports them.
//!
//! In: a world, the sensor's pose at a firing, the model's constants. Out: [`RawFiring`]s. The corrections of each
//! laser are applied inversely, so that the decoder's point is the point where the ray met the world.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::{Model, ModelSpec, ReturnMode, S1_FLAGS};
use clearway_lidar::packet::BOGUS_DISTANCE;
use nalgebra::{Isometry3, Point3, Vector3};
use std::f64::consts::TAU;
use std::ops::Deref;

use super::encode::{RawFiring, RawReturn};
use super::raycast::{Caster, Hit};
use crate::noise::{gaussian, mixed, uniform};
use crate::scene::world::World;

/// The model, mounting and accuracy of a simulated sensor.
#[derive(Clone, Debug)]
pub struct ScannerConfig {
    /// Model of the sensor.
    pub model: Model,
    /// Echoes that the sensor reports.
    pub return_mode: ReturnMode,
    /// Rotation rate, revolutions per minute.
    pub rpm: f64,
    /// The sensor's own calibration; `None`: the factory calibration of the model.
    pub calibration: Option<Calibration>,
    /// Pose of the sensor on the vehicle.
    pub ego_from_sensor: Isometry3<f64>,
    /// Standard deviation of the range, metres.
    pub noise_m: f64,
    /// Share of the returns that are missing, 0 to 1.
    pub dropout: f64,
    /// Greatest range that returns, metres.
    pub range_m_max: f64,
    /// Seed of noise and missing returns: the same seed gives the same datagrams.
    pub seed: u64,
}

impl Default for ScannerConfig {
    /// An HDL-64E S2 at 600 rpm, 1.9 m over the ground on the roof, with 1.5 cm of noise and one return in 200 missing.
    fn default() -> Self {
        Self {
            model: Model::Hdl64eS2,
            return_mode: ReturnMode::Strongest,
            rpm: 600.0,
            calibration: None,
            ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9),
            noise_m: 0.015,
            dropout: 0.005,
            range_m_max: 120.0,
            seed: 1,
        }
    }
}

impl ScannerConfig {
    /// The same without noise and missing returns.
    pub fn noiseless(self) -> Self {
        Self { noise_m: 0.0, dropout: 0.0, ..self }
    }
}

/// Least range that returns, metres. Ours, because the manuals state none below 0.5 m.
const RANGE_M_MIN: f64 = 0.5;

/// One laser's line in the rotating head, at encoder angle 0 (x forward, y left, z up).
#[derive(Clone, Copy, Debug)]
struct Beam {
    /// The line's point at range 0.
    origin: [f64; 3],
    /// The line's direction, length 1.
    direction: [f64; 3],
    /// The distance that the decoder adds to the range.
    range_added_m: f64,
    /// The head's rotation until the laser fires, as a share of that from block to block.
    rotation: [f64; 2],
}

/// A simulated sensor that can fire.
#[derive(Clone, Debug)]
pub struct Scanner {
    config: ScannerConfig,
    spec: &'static ModelSpec,
    calibration: Calibration,
    beams: Vec<Beam>,
}

impl Scanner {
    /// A sensor with this configuration. Its lines of sight are straight: near-range corrections of a calibration are
    /// left out.
    pub fn new(config: ScannerConfig) -> Self {
        let spec = config.model.spec();
        let mut calibration = config.calibration.clone().unwrap_or_else(|| Calibration::factory(config.model));
        for laser in &mut calibration.lasers {
            (laser.dist_correction_x, laser.dist_correction_y) = (None, None);
            laser.two_pt_correction_available = false;
        }
        let beams = (0..spec.lasers).map(|laser| beam(spec, &calibration, laser)).collect();
        Self { config, spec, calibration, beams }
    }

    /// Configuration with which the sensor was made.
    pub fn config(&self) -> &ScannerConfig {
        &self.config
    }

    /// Constants of the sensor's model, from its manual.
    pub fn spec(&self) -> &'static ModelSpec {
        self.spec
    }

    /// Calibration of the lasers, by which the sensor casts its rays.
    pub fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    /// Time of firing `index`, ns after firing 0.
    pub fn firing_ns(&self, index: i64) -> i64 {
        index * i64::from(self.spec.period_ns(self.config.return_mode))
    }

    /// Encoder angle at firing `index`, as a share of a revolution in [0, 1); firing 0 is at 0.
    pub fn encoder_share(&self, index: i64) -> f64 {
        (self.firing_ns(index) as f64 * 1e-9 * self.config.rpm / 60.0).rem_euclid(1.0)
    }

    /// The first firing of revolution `number`.
    pub fn first_firing_of(&self, number: i64) -> i64 {
        let revolution_ns = 60e9 / self.config.rpm;
        (number as f64 * revolution_ns / f64::from(self.spec.period_ns(self.config.return_mode))).ceil() as i64
    }

    /// The lasers that fire in firing `index`: all, but a bank of 32 on the HDL-64E S1.
    fn firing_lasers(&self, index: i64) -> std::ops::Range<usize> {
        if self.config.model == Model::Hdl64eS1 {
            let flag = S1_FLAGS[index.rem_euclid(S1_FLAGS.len() as i64) as usize];
            let first = self.spec.first_laser(flag).expect("a flag of the model's own");
            return first..first + self.spec.returns_per_firing();
        }
        0..self.spec.lasers
    }

    /// The ray of `laser` in firing `index`, in the sensor's frame: its origin and its direction.
    ///
    /// A point to which the decoder gives range `r` lies `r` metres along it.
    pub fn ray(&self, index: i64, laser: usize) -> ([f64; 3], [f64; 3]) {
        let per_block = self.spec.firings_per_block as i64;
        let beam = &self.beams[laser];
        // The block reports the angle of its first firing; the head rotates on while the rest is fired.
        let first = index - index.rem_euclid(per_block);
        let block_share = self.firing_ns(per_block) as f64 * 1e-9 * self.config.rpm / 60.0;
        let share = self.encoder_share(first) + block_share * beam.rotation[(index - first) as usize];
        // Velodyne's azimuth is clockwise from above.
        let (sin, cos) = (-share * TAU).sin_cos();
        let rotated = |[x, y, z]: [f64; 3]| [x * cos - y * sin, x * sin + y * cos, z];
        (rotated(beam.origin), rotated(beam.direction))
    }

    /// The random draw of one ray, which decides where leaves stop it and how it is measured.
    pub fn draw(&self, index: i64, laser: usize) -> u64 {
        mixed(self.config.seed ^ ((index as u64) << 8)) ^ laser as u64
    }

    /// True if a packet can hold a return of `laser` from this range.
    pub fn reports(&self, laser: usize, range_m: f64) -> bool {
        range_m >= RANGE_M_MIN && (1.0..f64::from(BOGUS_DISTANCE)).contains(&self.counts(laser, range_m))
    }

    fn counts(&self, laser: usize, range_m: f64) -> f64 {
        ((range_m - self.beams[laser].range_added_m) / self.calibration.distance_m_per_count).round()
    }

    /// Fires once from a sensor at `map_from_sensor`.
    pub fn fire<W: Deref<Target = World>>(
        &self,
        caster: &Caster<W>,
        map_from_sensor: &Isometry3<f64>,
        index: i64,
        stamp_ns: i64,
    ) -> RawFiring {
        let azimuth = (self.encoder_share(index) * 36_000.0).round() as u32 % 36_000;
        let dual = self.config.return_mode == ReturnMode::Dual;
        let mut firing = RawFiring {
            stamp_ns,
            azimuth: azimuth as u16,
            strongest: vec![RawReturn::default(); self.spec.lasers],
            last: vec![RawReturn::default(); if dual { self.spec.lasers } else { 0 }],
        };
        let rotation = map_from_sensor.rotation.to_rotation_matrix();
        for laser in self.firing_lasers(index) {
            let (origin, direction) = self.ray(index, laser);
            let origin: [f64; 3] = (map_from_sensor * Point3::from(origin)).coords.into();
            let direction: [f64; 3] = (rotation * Vector3::from(direction)).into();
            let key = self.draw(index, laser);
            let last = || caster.cast_behind_leaves(origin, direction);
            let nearest = || caster.cast(origin, direction, key);
            firing.strongest[laser] = match self.config.return_mode {
                ReturnMode::Last => self.measured(last(), laser, key),
                _ => self.measured(nearest(), laser, key),
            };
            if dual {
                firing.last[laser] = self.measured(last(), laser, key);
            }
        }
        firing
    }

    /// A hit as the sensor reports it.
    fn measured(&self, hit: Option<Hit>, laser: usize, key: u64) -> RawReturn {
        let Some(hit) = hit else { return RawReturn::default() };
        if self.config.dropout > 0.0 && uniform(key ^ 0x0d) < self.config.dropout {
            return RawReturn::default();
        }
        let noise_m = if self.config.noise_m > 0.0 { self.config.noise_m * gaussian(key ^ 0x65) } else { 0.0 };
        let range_m = hit.range_m + noise_m;
        if !self.reports(laser, range_m) {
            return RawReturn::default();
        }
        let counts = self.counts(laser, range_m);
        RawReturn { distance: counts as u16, intensity: hit.reflectivity }
    }
}

/// A laser's line, from the corrections of its calibration.
fn beam(spec: &ModelSpec, calibration: &Calibration, laser: usize) -> Beam {
    let own = &calibration.lasers[laser];
    let (sin_v, cos_v) = own.vert_correction.sin_cos();
    // The correction is counter-clockwise, against the encoder.
    let (sin_r, cos_r) = own.rot_correction.sin_cos();
    let left = own.horiz_offset_correction;
    let index = |firing: usize| spec.azimuth_offset(laser + firing * spec.lasers, FINE) as f64 / f64::from(FINE);
    Beam {
        origin: [-left * sin_r, left * cos_r, own.vert_offset_correction],
        direction: [cos_v * cos_r, cos_v * sin_r, sin_v],
        range_added_m: own.dist_correction,
        rotation: [index(0), if spec.firings_per_block > 1 { index(1) } else { 0.0 }],
    }
}

/// A step from block to block, in counts, so long that rounding to counts does not matter.
const FINE: u32 = 1_000_000;
