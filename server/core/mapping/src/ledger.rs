//! What came of everything that reached the core, and why an event was not taken.

use std::collections::BTreeMap;

use clearway_lidar::sensor::Refusal;

use crate::sensor::self_filter::Hidden;
use crate::config::ConfigError;
use crate::event::Cause;
use crate::road::RoadError;

/// What came of everything that reached a vehicle, or one of its sensors: `received = decoded + telemetry + the sum of
/// refused`, exactly, for each. What no sensor sent (of an unknown source, poses, roads) is the vehicle's alone.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ledger {
    /// Datagrams and scans, and ends of sensors that are not there.
    pub received: u64,
    /// Data packets and scans taken.
    pub decoded: u64,
    /// Telemetry datagrams read.
    pub telemetry: u64,
    /// Datagrams, scans and ends not taken, by [`Rejected::reason`].
    pub refused: BTreeMap<&'static str, u64>,
    /// Readings that found the door's queue full.
    pub lost: u64,
    /// Datagrams the kernel dropped before anybody read them; the vehicle's alone.
    pub kernel_drops: u64,
    /// Ego poses taken.
    pub poses: u64,
    /// Ego poses not taken.
    pub poses_refused: u64,
    /// Roads taken.
    pub roads: u64,
    /// Roads not taken, by [`Rejected::reason`].
    pub roads_refused: BTreeMap<&'static str, u64>,
    /// Sensors declared by an event.
    pub sensors: u64,
    /// Declarations not taken.
    pub sensors_refused: u64,
    /// Points of scans that were no positions (not finite, or beyond any sensor's reach) and were left out.
    pub points_dropped: u64,
    /// Returns left out because they lie on or in the vehicle.
    pub own_body: u64,
    /// Returns left out because their ray crosses the vehicle.
    pub through_body: u64,
    /// Returns left out because they lie in a sector that the configuration calls blind.
    pub blind: u64,
}

/// The count of what stayed outside is a recording's to claim; each cause ends here, so that no sum of them overflows.
const OUTSIDE_MAX: u64 = 1 << 60;

impl Ledger {
    /// Datagrams and scans refused, but for copies of packets: those leave no trace in a map.
    pub fn refused_sum(&self) -> u64 {
        self.refused.iter().filter(|(reason, _)| **reason != "duplicate").map(|(_, count)| count).sum()
    }

    /// Counts readings that never became events: lost, or refused at the door.
    pub fn stayed_outside(&mut self, cause: Cause, count: u64) {
        let (sum, is_received) = match cause {
            Cause::Queue => (&mut self.lost, false),
            Cause::Kernel => (&mut self.kernel_drops, false),
            Cause::Sender => (self.refused.entry("source").or_default(), true),
            Cause::Length => (self.refused.entry("length").or_default(), true),
            Cause::Observation => (self.refused.entry("observation").or_default(), true),
        };
        let count = count.min(OUTSIDE_MAX.saturating_sub(*sum));
        *sum += count;
        self.received += if is_received { count } else { 0 };
    }

    pub(crate) fn add_dropped(&mut self, dropped: Dropped) {
        self.points_dropped += dropped.no_position;
        self.own_body += dropped.own_body;
        self.through_body += dropped.through_body;
        self.blind += dropped.blind;
    }
}

/// Returns of one turn that were left out, beside those nearer than the sensor's least range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropped {
    /// A coordinate is not finite, or lies beyond any sensor's reach.
    pub no_position: u64,
    /// On or in the vehicle.
    pub own_body: u64,
    /// Behind the vehicle.
    pub through_body: u64,
    /// In a blind sector.
    pub blind: u64,
}

impl Dropped {
    #[inline(always)]
    pub(crate) fn count(&mut self, hidden: Option<Hidden>) {
        self.own_body += u64::from(hidden == Some(Hidden::OwnBody));
        self.through_body += u64::from(hidden == Some(Hidden::ThroughBody));
        self.blind += u64::from(hidden == Some(Hidden::Blind));
    }
}

/// Later stamps, of 2116 and on, near the end of what 64 bits of nanoseconds hold; the earliest is 1970's first.
pub const STAMP_NS_MAX: i64 = 1 << 62;

/// An event that was not taken. The pipeline's state is as if it had not come, but for the ledger.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Rejected {
    /// The decoder refused the datagram.
    #[error(transparent)]
    Datagram(#[from] Refusal),
    /// No such sensor.
    #[error("source {source_index}: the vehicle has {sensors} sensor(s), counted from 0")]
    Source {
        /// The event's.
        source_index: u16,
        /// How many there are.
        sensors: usize,
    },
    /// A declared sensor that cannot be one.
    #[error("declared sensor: {0}")]
    Sensor(#[from] ConfigError),
    /// A scan whose arrays do not belong together.
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
    /// A scan that tells something of some points only.
    #[error("scan of {points} points with {length} {list}: none or one a point is allowed")]
    ScanList {
        /// `ring` or `offset_ns`.
        list: &'static str,
        /// Its length.
        length: usize,
        /// Length of `x`.
        points: usize,
    },
    /// A scan with a point later than its own end.
    #[error("scan with a point {offset_ns} ns after its stamp: at most 0 is allowed")]
    ScanOffset {
        /// The latest.
        offset_ns: i32,
    },
    /// A scan with a direction that is none.
    #[error("scan with the no-return direction {direction:?}: a unit vector is allowed")]
    NoReturn {
        /// x, y, z.
        direction: [f32; 3],
    },
    /// A scan, ego pose or road not newer than the one before.
    #[error("stamp {stamp_ns} ns: later than {newest_ns} ns is allowed")]
    Stamp {
        /// The event's.
        stamp_ns: i64,
        /// The newest taken.
        newest_ns: i64,
    },
    /// A scan, ego pose or road of a time that cannot be.
    #[error("stamp {stamp_ns} ns: 0 to {STAMP_NS_MAX} ns since the epoch is allowed")]
    StampRange {
        /// The event's.
        stamp_ns: i64,
    },
    /// A road that is no road.
    #[error(transparent)]
    Road(#[from] RoadError),
    /// An ego pose that is no pose.
    #[error(
        "ego pose of {stamp_ns} ns: position within 10^9 m, a unit quaternion and speed within 1000 m/s are allowed"
    )]
    Pose {
        /// The event's.
        stamp_ns: i64,
    },
}

impl Rejected {
    /// The ledger's key: the decoder's own (`length`, `block_flag`, …), or `source`, `sensor`, `scan_lengths`,
    /// `scan_offset`, `no_returns`, `stamp`, `stamp_range`, `pose`, or a road's own ([`RoadError::reason`]).
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Datagram(refusal) => refusal.reason(),
            Self::Source { .. } => "source",
            Self::Sensor(_) => "sensor",
            Self::ScanLengths { .. } | Self::ScanList { .. } => "scan_lengths",
            Self::ScanOffset { .. } => "scan_offset",
            Self::NoReturn { .. } => "no_returns",
            Self::Stamp { .. } => "stamp",
            Self::StampRange { .. } => "stamp_range",
            Self::Pose { .. } => "pose",
            Self::Road(refused) => refused.reason(),
        }
    }

    pub(crate) fn unless_in_range(stamp_ns: i64) -> Result<(), Self> {
        if (0..=STAMP_NS_MAX).contains(&stamp_ns) { Ok(()) } else { Err(Self::StampRange { stamp_ns }) }
    }

    pub(crate) fn unless_newer(stamp_ns: i64, newest_ns: Option<i64>) -> Result<(), Self> {
        match newest_ns {
            Some(newest_ns) if stamp_ns <= newest_ns => Err(Self::Stamp { stamp_ns, newest_ns }),
            _ => Ok(()),
        }
    }
}
