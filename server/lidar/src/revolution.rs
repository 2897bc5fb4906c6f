//! Firings to revolutions, cut at firings by azimuth.

use std::sync::Arc;

use crate::calibration::Calibration;
use crate::model::{Model, ReturnMode};

/// One turn of one sensor as a range image: `lasers` slots a firing, firings in time order.
///
/// Slot `firing * lasers + laser` of every [`Echo`] array belongs to the same beam. Frame: the sensor's (REP-103).
#[derive(Clone, Debug)]
pub struct Revolution {
    /// Counts from 0 for each sensor.
    pub sequence: u64,
    /// The model that made it.
    pub model: Model,
    /// The echoes asked of the sensor.
    pub return_mode: ReturnMode,
    /// Slots a firing; the index within a firing is the laser in firing order.
    pub lasers: usize,
    /// The firings, in time order.
    pub firings: Vec<Firing>,
    /// One image, or two in dual-return mode (strongest first, then last).
    pub echoes: Vec<Echo>,
    /// The per-laser corrections that were applied; `calibration.lasers[laser]` has elevation and ring.
    pub calibration: Arc<Calibration>,
    /// Stamp of the first firing, ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the last firing, ns since the Unix epoch.
    pub end_ns: i64,
    /// Measured turning rate.
    pub rpm: f32,
    /// Why the turn is not whole; `None` for a whole one.
    pub partial: Option<Partial>,
    /// Data packets that contributed.
    pub packets: u32,
}

/// Why a revolution does not cover its whole turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Partial {
    /// The stream began inside the turn.
    Start,
    /// The stream ended inside the turn.
    End,
    /// Azimuths are missing inside the turn (lost packets or a blocked sector).
    Gap,
    /// The azimuth ran backwards.
    Reversal,
}

/// One pass of all lasers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Firing {
    /// Encoder angle, rad, clockwise from the sensor's x axis seen from above (Velodyne's sense), in [0, 2π).
    pub azimuth_rad: f32,
    /// ns since the revolution's `start_ns`.
    pub offset_ns: u32,
}

/// One image of echoes. Arrays hold `firings * lasers` slots.
#[derive(Clone, Debug, Default)]
pub struct Echo {
    /// Corrected range; 0: fired, no return; NaN: this laser did not fire in this firing (HDL-64E S1).
    pub range_m: Vec<f32>,
    /// Metres, sensor frame; unspecified where there is no return.
    pub x: Vec<f32>,
    /// Metres, sensor frame.
    pub y: Vec<f32>,
    /// Metres, sensor frame.
    pub z: Vec<f32>,
    /// 0 to 255 as the sensor reports it.
    pub intensity: Vec<u8>,
}
