//! What a map states about one of its sensors.

use std::sync::Arc;

use clearway_lidar::Blocked;
use clearway_lidar::revolution::{Partial, Revolution};

use crate::event_time::EventTime;
use crate::sensor::observation::Scan;

/// One sensor's state in a map. Values that describe its scan are 0 or empty if the scan is not in the map.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorState {
    /// Name of the sensor in the configuration.
    pub name: Arc<str>,
    /// Name of the model (`hdl32e`, and so on); `scan` if the sensor sends scans.
    pub model: &'static str,
    /// Number of data packets of the revolution; 0 for scans.
    pub packets: u32,
    /// Number of data packets of the revolution and of the missing packets before them, ±1 a gap; 0 for scans.
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

impl SensorState {
    /// What a map states about the sensor of a revolution.
    pub(crate) fn of_revolution(
        name: &Arc<str>,
        revolution: &Revolution,
        elevations: ElevationSource,
        returns: u32,
    ) -> Self {
        Self {
            name: name.clone(),
            model: revolution.model.as_str(),
            packets: revolution.packets,
            packets_expected: revolution.packets_expected,
            refused: 0,
            returns,
            rpm: revolution.rpm,
            completeness: completeness(revolution),
            partial: revolution.partial.map_or("", Partial::as_str),
            contribution: if revolution.partial.is_some() { Contribution::Partial } else { Contribution::Ok },
            age_ms: None,
            blocked: revolution.blocked.clone(),
            clock: revolution.clock.as_str(),
            clock_offset_ms: revolution.clock_offset_ms,
            epoch: revolution.epoch,
            elevations: Some(elevations),
        }
    }

    /// What a map states about the sensor of a scan event.
    pub(crate) fn of_scan(
        name: &Arc<str>,
        scan: &Scan,
        elevations: ElevationSource,
        returns: u32,
        now: EventTime,
    ) -> Self {
        Self {
            name: name.clone(),
            model: "scan",
            returns,
            // The sender alone can tell which part of its field of view is missing.
            completeness: 1.0,
            contribution: if scan.x.is_empty() && scan.no_returns.is_empty() {
                Contribution::Empty
            } else {
                Contribution::Ok
            },
            clock: "sender",
            clock_offset_ms: now.arrival_ns.saturating_sub(scan.stamp_ns) / 1_000_000,
            elevations: Some(elevations),
            ..Self::default()
        }
    }
}

/// Share of the degrees of the field of view in which a firing lies, 0 to 1.
fn completeness(revolution: &Revolution) -> f32 {
    let mut seen = [false; 360];
    for firing in &revolution.firings {
        let degree = firing.azimuth_rad.to_degrees();
        // `as` saturates, so an azimuth of exactly 2π (or beyond) falls into the last degree.
        seen[(degree as usize).min(359)] = true;
    }
    let is_in_gap = |degree: usize| {
        revolution.fov_gap_rad.is_some_and(|ends| {
            let [from_deg, to_deg] = ends.map(f32::to_degrees);
            (degree as f32 - from_deg).rem_euclid(360.0) + 1.0 <= (to_deg - from_deg).rem_euclid(360.0)
        })
    };
    let in_view = (0..360).filter(|&degree| seen[degree] || !is_in_gap(degree)).count();
    seen.iter().filter(|seen| **seen).count() as f32 / in_view.max(1) as f32
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

/// The scans of a sensor that have no pose because the clock of the poses or the clock of the scans has stepped and the
/// other has not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OtherClock {
    /// Number of these scans.
    pub scans: u64,
    /// Step of the clock of the poses since it agreed with the clock of the scans, for the newest of these scans, ns.
    pub ahead_ns: i64,
    /// True if the newest scan is one of them.
    pub lasts: bool,
}

impl OtherClock {
    /// Notes how far the poses are ahead of a scan; `None` if the clocks agree.
    pub(crate) fn note(&mut self, ahead_ns: Option<i64>) {
        self.lasts = ahead_ns.is_some();
        self.scans += u64::from(self.lasts);
        self.ahead_ns = ahead_ns.unwrap_or(self.ahead_ns);
    }

    /// The scans and the step in one line, for people; `None` without such scans.
    pub fn describe(&self) -> Option<String> {
        let (scans, apart_s) = (self.scans, self.ahead_ns.unsigned_abs() as f64 * 1e-9);
        let way = if self.ahead_ns > 0 { "ahead of" } else { "behind" };
        (scans > 0).then(|| {
            format!(
                "{scans} of its scans have no pose: one clock stepped, and the stamps of the poses are {apart_s:.2} s \
                 {way} its stamps since"
            )
        })
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

    /// What follows from the source, and what to do; `None` if the sensor has these elevations itself.
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
