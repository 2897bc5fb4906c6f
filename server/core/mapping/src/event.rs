//! What enters the core. Only the event queue (live) and the recording's reader create events; no module behind them
//! can tell a live event from a recorded one.

use bytes::Bytes;
use clearway_lidar::revolution::Revolution;
use nalgebra::Isometry3;

use crate::config::sensor::SensorConfig;

/// One reading or message of one vehicle, in the order in which the event queue accepted it.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Number of the event: the first of a vehicle is 0, the next ones count up without gaps.
    pub sequence: u64,
    /// Time at which the event queue accepted the event, ns since the Unix epoch, host clock.
    pub arrival_ns: i64,
    /// Index of the sensor: first those of the configuration, then the declared ones. 0 if the body concerns the whole
    /// vehicle.
    pub source: u16,
    /// The reading or message.
    pub body: Body,
}

/// The kinds of events.
#[derive(Clone, Debug, PartialEq)]
pub enum Body {
    /// The payload of one UDP datagram: a data packet, telemetry, or something that the decoder refuses.
    Datagram(Bytes),
    /// One scan that the sender has assembled.
    Scan(Scan),
    /// Pose and speed of the vehicle.
    EgoPose(EgoPose),
    /// Shape of a road.
    Road(Road),
    /// Declaration of a sensor that the configuration does not contain. The event's source is its index, which no
    /// sensor has. A repeated declaration changes nothing.
    Sensor(Box<SensorConfig>),
    /// The declaration of the source is withdrawn: its unfinished revolution becomes a partial one, and then its name
    /// and its index are free.
    Withdrawn,
    /// Readings that were dropped before they became events.
    Lost {
        /// Why they were dropped.
        cause: Cause,
        /// Number of readings.
        count: u64,
    },
    /// The source has ended: its unfinished revolution becomes a partial one.
    End,
}

/// Source of readings that belong to no known sensor.
pub const UNKNOWN_SOURCE: u16 = u16::MAX;

/// Why a reading never became an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The event queue was full.
    Queue,
    /// The kernel's receive buffer was full. The source of these readings is known if the socket has only one.
    Kernel,
    /// The sender is not a sensor of the vehicle.
    Sender,
    /// The datagram was longer than any that is accepted.
    Length,
    /// The message was not a valid observation, or not one of the ROS 2 messages that are read.
    Observation,
}

impl Cause {
    /// True if the source of the readings may be known; if it is not, the source is [`UNKNOWN_SOURCE`].
    pub fn has_source(self) -> bool {
        self != Self::Sender
    }
}

/// Points of one revolution, or of one pass over a field of view, in the sensor frame (REP-103). The arrays have one
/// entry a point, except `no_returns`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scan {
    /// Stamp of the scan's end, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Distance forward of the sensor, metres.
    pub x: Vec<f32>,
    /// Distance to the left of the sensor, metres.
    pub y: Vec<f32>,
    /// Distance above the sensor, metres.
    pub z: Vec<f32>,
    /// Intensity, 0 to 1.
    pub intensity: Vec<f32>,
    /// Rank of each point's laser by elevation, 0 the lowest; empty if the sensor does not state it.
    pub ring: Vec<u16>,
    /// Time of each point, ns after `stamp_ns` and so at most 0; empty if all points have the time of the stamp.
    pub offset_ns: Vec<i32>,
    /// Directions (unit vectors, sensor frame) of rays without a return; empty if the sensor does not state them.
    pub no_returns: Vec<[f32; 3]>,
}

/// The points of a revolution in the order of `Revolution::points`, as a client would send them.
impl From<&Revolution> for Scan {
    fn from(revolution: &Revolution) -> Self {
        let mut scan = Scan { stamp_ns: revolution.end_ns, ..Scan::default() };
        for point in revolution.points() {
            scan.x.push(point.x);
            scan.y.push(point.y);
            scan.z.push(point.z);
            scan.intensity.push(f32::from(point.intensity) / 255.0);
            scan.ring.push(point.ring);
        }
        scan
    }
}

/// Pose and speed of the vehicle at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct EgoPose {
    /// Time of the pose, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Ego frame in the locally fixed world frame.
    pub map_from_ego: Isometry3<f64>,
    /// Forward speed, m/s; negative when the vehicle drives backwards.
    pub speed_mps: f64,
}

/// A road: points along its middle, and its width at each. [`crate::road::check`] states what is allowed.
#[derive(Clone, Debug, PartialEq)]
pub struct Road {
    /// Time at which the road was seen or read, ns since the Unix epoch. The ego frame of the points is the one of this
    /// stamp.
    pub stamp_ns: i64,
    /// What the road is used for.
    pub purpose: RoadPurpose,
    /// Frame of the points.
    pub frame: RoadFrame,
    /// Points x, y, metres, in driving order.
    pub points: Vec<[f64; 2]>,
    /// Whole width at each point, metres.
    pub widths_m: Vec<f64>,
    /// Votes for each dominant orientation in the detector's image; empty if the road was not found in an image.
    pub orientations: Vec<f32>,
    /// Speed limit from each point to the next one, m/s; 0: no limit. Empty if the road has no limits.
    pub speed_limits_mps: Vec<f64>,
}

/// What a road is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadPurpose {
    /// A detected road or a lane: it is painted into the speed map, and replaces the one before.
    Paint,
    /// The centre line of the route (RDDF): it is never painted. Its curvature shows where a detector fails; its width
    /// is the corridor in which roads are painted; its limits cap the speed.
    Route,
}

/// Frame of a road's points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadFrame {
    /// The ego frame at the road's stamp.
    Ego,
    /// The locally fixed world frame. The road is not used until an ego pose is known.
    Map,
}
