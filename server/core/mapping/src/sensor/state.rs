//! What a map states about one of its sensors.

use std::sync::Arc;

use clearway_lidar::Blocked;

/// One sensor's state in a map. Values that describe its scan are 0 or empty if the scan is not in the map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorState {
    /// Name of the sensor in the configuration.
    pub name: Arc<str>,
    /// Name of the model (`hdl32e`, and so on); `scan` if the sensor sends scans.
    pub model: &'static str,
    /// Number of data packets of the revolution; 0 for scans.
    pub packets: u32,
    /// Number of data packets of the revolution and of those that are missing before them, ±1 a gap; 0 for scans.
    pub packets_expected: u32,
    /// Number of datagrams and scans that were refused since the start, without copies of packets.
    pub refused: u64,
    /// Number of returns in the scan.
    pub returns: u32,
    /// Measured rotation rate, revolutions a minute; 0 if it is unknown.
    pub rpm: f32,
    /// Share of the field of view's azimuths that have firings, 0 to 1.
    pub completeness: f32,
    /// Why the revolution is not whole: `start`, `end`, `gap`, `reversal`, `overlong`; empty if it is whole.
    pub partial: &'static str,
    /// Where the sensor returned points before and returned none in this revolution.
    pub blocked: Blocked,
    /// Name of the clock the stamps follow ([`clearway_lidar::Clock::as_str`]); `sender` if a scan brings its stamp.
    pub clock: &'static str,
    /// Offset of the host's clock from the stamps, ms; positive if the host's clock is ahead.
    pub clock_offset_ms: i64,
    /// Number of the epoch of the sensor's stamps: how often they have gone back.
    pub epoch: u32,
    /// Source of the elevations of the lasers; `None` before the first scan.
    pub elevations: Option<ElevationSource>,
    /// Whether the newest scan is in the map.
    pub contribution: Contribution,
    /// Time from the end of the newest scan to the map's stamp, ms; `None` before the first scan.
    pub age_ms: Option<f32>,
}

/// What the newest scan of a sensor contributes to a map, and why it contributes nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Contribution {
    /// The scan is in the map, and it is whole.
    Ok,
    /// The scan is in the map, and it is not whole.
    Partial,
    /// The scan is not in the map: it is too old, or the sensor's clock is behind.
    Late,
    /// The scan is not in the map: the sensor's clock is ahead.
    Ahead,
    /// The scan is not in the map: it has no point and no ray. The sensor sends, and sees nothing.
    Empty,
    /// The sensor has completed no scan within the deadline.
    #[default]
    Silent,
}

impl Contribution {
    /// Name of the value on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Partial => "partial",
            Self::Late => "late",
            Self::Ahead => "ahead",
            Self::Empty => "empty",
            Self::Silent => "silent",
        }
    }

    /// True if the map contains points of the scan.
    pub fn is_in_map(self) -> bool {
        matches!(self, Self::Ok | Self::Partial)
    }
}

/// The source of the elevations of a sensor's lasers. They define the rows of radial maps, and for a sensor that sends
/// packets also the heights of all points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ElevationSource {
    /// The configured calibration table of the sensor.
    Table,
    /// The table in the status bytes of an HDL-64E S2 or S3.
    StatusBytes,
    /// The table of the sensor's model, which holds for every unit.
    Model,
    /// The nominal table of an HDL-64E. Each unit differs from it.
    Nominal,
    /// The configured `elevations_deg`.
    Configured,
    /// The rings that a scan states.
    Rings,
    /// The points of a scan that states no rings.
    Estimated,
    /// None: a scan states no rings and does not show them. The rows of radial maps that the sensor defines have the
    /// same depth.
    Unknown,
}

impl ElevationSource {
    /// Name of the value on the wire.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Table => "table",
            Self::StatusBytes => "status_bytes",
            Self::Model => "model",
            Self::Nominal => "nominal",
            Self::Configured => "configured",
            Self::Rings => "rings",
            Self::Estimated => "estimated",
            Self::Unknown => "unknown",
        }
    }

    /// What follows from the source, and what to do; `None` if the elevations are those of the sensor.
    pub fn advice(self) -> Option<&'static str> {
        match self {
            Self::Table | Self::StatusBytes | Self::Model | Self::Configured | Self::Rings => None,
            // Measured: 0.33 m is the median distance between the points of the S1 of a recorded drive decoded by its
            // own table and by the nominal one.
            Self::Nominal => Some(
                "the corrections of each HDL-64E differ, and without its own table its points are off by 0.33 m in \
                 the median: set `calibration` to the unit's db.xml or YAML table",
            ),
            Self::Estimated => Some(
                "the scans state no rings, and the elevations were estimated from their points: send rings, or set \
                 `model` or `elevations_deg`",
            ),
            Self::Unknown => Some(
                "the scans state no rings and do not show them, so the rows of radial maps are 1 m deep: send \
                 rings, or set `model` or `elevations_deg`",
            ),
        }
    }
}
