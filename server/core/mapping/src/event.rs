//! What enters the core. Only the door (live) and the recording's reader make these; nothing behind can tell them
//! apart.

use bytes::Bytes;
use nalgebra::Isometry3;

use crate::config::SensorConfig;

/// One thing that happened to one vehicle, in the order the door took it.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Counts from 0 without a hole.
    pub sequence: u64,
    /// When the door read it, ns since the Unix epoch.
    pub arrival_ns: i64,
    /// Index of the sensor: those of the configuration first, then those declared; 0 where the body concerns the whole
    /// vehicle.
    pub source: u16,
    /// What happened.
    pub body: Body,
}

/// The kinds of events.
#[derive(Clone, Debug, PartialEq)]
pub enum Body {
    /// One UDP payload as it came: data packet, telemetry, or something to refuse.
    Datagram(Bytes),
    /// A turn assembled elsewhere.
    Scan(Scan),
    /// Where the vehicle was.
    EgoPose(EgoPose),
    /// Where a road lies.
    Road(Road),
    /// A sensor that the configuration does not name; the event's source is its index, the next one. The same again
    /// changes nothing.
    Sensor(Box<SensorConfig>),
    /// So many readings never became events.
    Lost {
        /// Why.
        cause: Cause,
        /// How many.
        count: u64,
    },
    /// The source has ended: an unfinished revolution becomes a partial one.
    End,
}

/// The source of a reading that is no sensor's, or of which nobody knows whose it was.
pub const NOBODY: u16 = u16::MAX;

/// Why a reading never became an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The door's queue was full.
    Queue,
    /// The kernel's receive buffer was full: nobody knows whose these were.
    Kernel,
    /// The sender is none of the vehicle's sensors.
    Sender,
    /// A datagram longer than any the door takes.
    Length,
    /// A message that is no observation, or none of the ROS 2 messages that are read.
    Observation,
}

impl Cause {
    /// Whether it may be known which sensor's the reading was; [`NOBODY`] where it is not.
    pub fn has_source(self) -> bool {
        !matches!(self, Self::Kernel | Self::Sender)
    }
}

/// Points of one turn, or of one pass over a field of view, in the sensor's frame (REP-103), metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scan {
    /// Stamp of the scan's end, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Metres.
    pub x: Vec<f32>,
    /// Metres.
    pub y: Vec<f32>,
    /// Metres.
    pub z: Vec<f32>,
    /// 0 to 1.
    pub intensity: Vec<f32>,
    /// Rank of each point's laser by elevation, 0 lowest; empty where the sensor does not tell.
    pub ring: Vec<u16>,
    /// When each point was seen, ns after `stamp_ns` (so at most 0); empty where all were seen at once.
    pub offset_ns: Vec<i32>,
    /// Directions (unit vectors, sensor's frame) of rays that came back with nothing; empty where the sensor does not
    /// tell.
    pub no_returns: Vec<[f32; 3]>,
}

/// Where the vehicle was and how fast.
#[derive(Clone, Debug, PartialEq)]
pub struct EgoPose {
    /// ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Ego frame in the locally fixed world frame.
    pub map_from_ego: Isometry3<f64>,
    /// Forward speed.
    pub speed_mps: f64,
}

/// A road as points along its middle and its width there. Checked by [`crate::road::check`] when it is taken.
#[derive(Clone, Debug, PartialEq)]
pub struct Road {
    /// When it was seen or read, ns since the Unix epoch; in the ego frame, the frame of that stamp.
    pub stamp_ns: i64,
    /// What it is for.
    pub purpose: RoadPurpose,
    /// What the points are relative to.
    pub frame: RoadFrame,
    /// x, y in metres, in the order they are driven.
    pub points: Vec<[f64; 2]>,
    /// Whole width at each point.
    pub widths_m: Vec<f64>,
    /// Votes for each dominant orientation in the detector's image; empty where no image told of the road.
    pub orientations: Vec<f32>,
}

/// What a road is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadPurpose {
    /// A road that was detected, or a lane: painted into the speed map, in place of the one before.
    Paint,
    /// The centre line of the route (RDDF): never painted; its curvature says where a detector cannot follow.
    Route,
}

/// What a road's points are relative to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadFrame {
    /// The vehicle when the road was seen.
    Ego,
    /// The locally fixed world frame; needs an ego pose to be used.
    Map,
}
