//! What a map is: a header, and layers of channels over one grid each. Class 0 is unknown everywhere, and is never
//! free.

use clearway_lidar::blocked::Blocked;
use nalgebra::Isometry3;

use crate::layer::Layer;
use crate::sensor::motion::Compensation;

/// Everything made from one revolution (or scan) of one vehicle's lead, and the newest ones of its other sensors.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Counts from 0 without a hole for each vehicle.
    pub sequence: u64,
    /// First firing, ns since the Unix epoch.
    pub capture_start_ns: i64,
    /// Last firing; the stamp all points are expressed at, and the one age is measured from.
    pub capture_end_ns: i64,
    /// Arrival of the event that completed the map.
    pub completed_ns: i64,
    /// Ego frame in the world frame at `capture_end_ns`, interpolated; `None` where no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed, where known.
    pub speed_mps: Option<f64>,
    /// What moved the points to `capture_end_ns`.
    pub compensation: Compensation,
    /// Index of the sensor whose turn made the map: the lead, or one that stands in for it.
    pub made_by: u16,
    /// Every sensor of the vehicle, in the order of the configuration, whether it contributed or not.
    pub sensors: Vec<SensorState>,
    /// Those that are wanted, and those they are made from, in the order of the configuration.
    pub layers: Vec<Layer>,
}

/// One sensor's part in a map; what counts one turn is 0 where it has none in it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorState {
    /// From the configuration.
    pub name: String,
    /// `hdl32e`, …; `scan` where the turn was assembled elsewhere.
    pub model: String,
    /// Data packets of this revolution.
    pub packets: u32,
    /// The same and those that were missing before them, ±1 a gap; 0 for scans.
    pub packets_expected: u32,
    /// Datagrams and scans refused since the start, but for copies of packets.
    pub refused: u64,
    /// Returns in this revolution.
    pub returns: u32,
    /// Measured turning rate; 0 where unknown.
    pub rpm: f32,
    /// Share of the turn's azimuths that have firings, 0 to 1.
    pub completeness: f32,
    /// `start`, `end`, `gap`, `reversal`, `overlong`, or empty for a whole turn.
    pub partial: &'static str,
    /// Where the sensor used to see and did not in this revolution.
    pub blocked: Blocked,
    /// The clock the stamps follow, as [`clearway_lidar::Clock::as_str`] spells it; `sender` where a scan brings its
    /// stamp.
    pub clock: &'static str,
    /// By how much the host's clock is ahead of the stamps, ms.
    pub clock_offset_ms: i64,
    /// Whether its newest turn is in the map.
    pub state: Part,
    /// From its newest turn's end to the map's stamp; `None` before its first turn.
    pub age_ms: Option<f32>,
}

/// Whether a sensor's newest turn is in a map, and why not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Part {
    /// Whole.
    Ok,
    /// A turn that is not whole.
    Partial,
    /// No: it is too old, or its clock is behind.
    Late,
    /// No: its clock is ahead.
    Ahead,
    /// No: the sensor gives none.
    #[default]
    Silent,
}

impl Part {
    /// As the wire spells it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Partial => "partial",
            Self::Late => "late",
            Self::Ahead => "ahead",
            Self::Silent => "silent",
        }
    }

    /// Whether the map holds points of the turn.
    pub fn contributes(self) -> bool {
        matches!(self, Self::Ok | Self::Partial)
    }
}
