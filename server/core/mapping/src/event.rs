//! What enters the core. Only the event queue (live) and the recording's reader create events; no module behind them
//! can tell a live event from a recorded one.

use bytes::Bytes;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;

use crate::sensor::config::SensorConfig;

pub use crate::road::{Road, RoadFrame, RoadPurpose};
pub use crate::sensor::observation::{EgoPose, Scan};

/// One reading or message of one vehicle, in the order in which the event queue accepted it.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Number of the event: the first of a vehicle is 0, the next ones count up without gaps.
    pub sequence: u64,
    /// Time at which the event queue accepted the event, ns since the Unix epoch, host clock.
    pub arrival_ns: i64,
    /// Index of the sensor: first the sensors of the configuration, then the declared sensors. 0 if the body concerns
    /// the whole vehicle.
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
    /// What a planner did with the maps, as bytes that the core does not read: no map depends on it.
    Plan(Bytes),
}

impl Body {
    /// Number of the kind of a body whose events arrive in order.
    pub(crate) fn lane(&self) -> u8 {
        match self {
            // A sensor's packets and its telemetry may come from two sockets.
            Self::Datagram(payload) if payload.len() == TELEMETRY_LENGTH => 0,
            Self::Datagram(_) => 1,
            Self::Scan(_) => 2,
            Self::EgoPose(_) => 3,
            Self::Road(_) => 4,
            Self::Sensor(_) | Self::Withdrawn | Self::Lost { .. } | Self::End | Self::Plan(_) => 5,
        }
    }
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
