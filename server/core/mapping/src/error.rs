//! Why the core refuses an event.

use clearway_lidar::DatagramError;

use crate::road::RoadError;
use crate::value_check::ConfigValueError;

/// Latest stamp that is accepted: the year 2116, in ns since the Unix epoch. Ours: half of what an `i64` holds, so that
/// differences and sums of two stamps do not overflow. The earliest is 0.
pub const STAMP_NS_MAX: i64 = 1 << 62;

/// An event that was refused. It changes nothing but the ledgers.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EventError {
    /// The decoder refused the datagram.
    #[error(transparent)]
    Datagram(#[from] DatagramError),
    /// The vehicle has no sensor of this index.
    #[error("source {source_index}: the vehicle has {sensors} sensor(s), counted from 0")]
    Source {
        /// Source of the event.
        source_index: u16,
        /// Number of sensors of the vehicle.
        sensors: usize,
    },
    /// The sensor is one of the configuration, so that its declaration cannot be withdrawn.
    #[error("source {source_index} withdrawn: a declared sensor is allowed, from {first_declared} on")]
    Withdrawn {
        /// Source of the event.
        source_index: u16,
        /// Number of sensors of the configuration, which is the first index of a declared one.
        first_declared: usize,
    },
    /// A declared sensor has a value that is not allowed.
    #[error("declared sensor: {0}")]
    Sensor(#[from] ConfigValueError),
    /// The coordinate and intensity arrays of a scan differ in length.
    #[error("scan with {x} x, {y} y, {z} z and {intensity} intensities: the four lengths must be equal")]
    ScanLengths {
        /// Length of `x`.
        x: usize,
        /// Length of `y`.
        y: usize,
        /// Length of `z`.
        z: usize,
        /// Length of `intensity`.
        intensity: usize,
    },
    /// An optional array of a scan is neither empty nor as long as the scan has points.
    #[error("scan of {points} points with {length} {list}: none or one a point is allowed")]
    ScanList {
        /// Name of the array: `ring` or `offset_ns`.
        list: &'static str,
        /// Length of the array.
        length: usize,
        /// Number of points of the scan.
        points: usize,
    },
    /// A scan has a ring that the configured model does not have.
    #[error(
        "scan with ring {ring}: the configured model {model} has {lasers} lasers, so 0 to {} is allowed; set the \
         sensor's `model` to the one that sends the scans, or remove it",
        lasers - 1
    )]
    ScanRing {
        /// Greatest ring of the scan.
        ring: u16,
        /// The configured model.
        model: &'static str,
        /// Number of lasers of the model.
        lasers: usize,
    },
    /// Many points of a scan lie where no laser of the configured model points.
    #[error(
        "scan with {outside_percent} % of its points outside of the elevations {} to {} degrees of the configured \
         model {model}: at most {allowed_percent} % is allowed; set the sensor's `model` to the one that sends the \
         scans, or remove it",
        elevation_deg.0, elevation_deg.1
    )]
    ScanElevation {
        /// Share of the points outside, percent.
        outside_percent: usize,
        /// Greatest share that is allowed, percent.
        allowed_percent: usize,
        /// The configured model.
        model: &'static str,
        /// Lowest and highest nominal elevation of the model, degrees.
        elevation_deg: (f32, f32),
    },
    /// A point of a scan is later than the scan's stamp.
    #[error("scan with a point {offset_ns} ns after its stamp: at most 0 is allowed")]
    ScanOffset {
        /// Greatest offset of the scan.
        offset_ns: i32,
    },
    /// All points of a scan are farther from the sensor than any sensor measures.
    #[error("{}", too_far(*nearest_m))]
    ScanFar {
        /// Distance of the nearest point, metres.
        nearest_m: f64,
    },
    /// A no-return direction of a scan is not a unit vector.
    #[error("scan with the no-return direction {direction:?}: a unit vector is allowed")]
    NoReturn {
        /// The direction: x, y, z.
        direction: [f32; 3],
    },
    /// A scan, ego pose or road is not newer than the newest one.
    #[error("stamp {stamp_ns} ns: later than {newest_ns} ns is allowed")]
    Stamp {
        /// Stamp of the refused one.
        stamp_ns: i64,
        /// Stamp of the newest one.
        newest_ns: i64,
    },
    /// The stamp of a scan, ego pose or road is out of range.
    #[error("stamp {stamp_ns} ns: 0 to {STAMP_NS_MAX} ns since the epoch is allowed")]
    StampRange {
        /// The stamp.
        stamp_ns: i64,
    },
    /// A road has a value that is not allowed.
    #[error(transparent)]
    Road(#[from] RoadError),
    /// An ego pose has a value that is not allowed.
    #[error(
        "ego pose of {stamp_ns} ns: position within 10^9 m, a unit quaternion and speed within 1000 m/s are allowed"
    )]
    Pose {
        /// Stamp of the pose.
        stamp_ns: i64,
    },
}

impl EventError {
    /// The key under which a ledger counts the error: the decoder's own key (`length`, `block_flag`, and so on), or
    /// `source`, `sensor`, `scan_lengths`, `scan_model`, `scan_offset`, `scan_far`, `no_returns`, `stamp`,
    /// `stamp_range`, `pose`, or the key of a road error ([`RoadError::reason`]).
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Datagram(refusal) => refusal.reason(),
            Self::Source { .. } => "source",
            Self::Sensor(_) | Self::Withdrawn { .. } => "sensor",
            Self::ScanLengths { .. } | Self::ScanList { .. } => "scan_lengths",
            Self::ScanRing { .. } | Self::ScanElevation { .. } => "scan_model",
            Self::ScanOffset { .. } => "scan_offset",
            Self::ScanFar { .. } => "scan_far",
            Self::NoReturn { .. } => "no_returns",
            Self::Stamp { .. } => "stamp",
            Self::StampRange { .. } => "stamp_range",
            Self::Pose { .. } => "pose",
            Self::Road(error) => error.reason(),
        }
    }
}

/// Text of the refusal of points that are all too far from the sensor.
pub(crate) fn too_far(nearest_m: f64) -> String {
    format!(
        "the nearest point is {:.1} km from the origin of its frame: 1 km is allowed; the points are in a frame of a \
         map or of the Earth: give the scan in the frame of its sensor, before a localisation moved it",
        nearest_m * 1e-3
    )
}

/// Checks that a stamp is in range.
///
/// # Errors
/// [`EventError::StampRange`] if the stamp is negative or later than [`STAMP_NS_MAX`].
pub(crate) fn check_stamp_range(stamp_ns: i64) -> Result<(), EventError> {
    if (0..=STAMP_NS_MAX).contains(&stamp_ns) { Ok(()) } else { Err(EventError::StampRange { stamp_ns }) }
}

/// Checks that a stamp is newer than the newest one before it; `newest_ns` is `None` if there is none.
///
/// # Errors
/// [`EventError::Stamp`] if the stamp is not newer.
pub(crate) fn check_newer(stamp_ns: i64, newest_ns: Option<i64>) -> Result<(), EventError> {
    match newest_ns {
        Some(newest_ns) if stamp_ns <= newest_ns => Err(EventError::Stamp { stamp_ns, newest_ns }),
        _ => Ok(()),
    }
}
