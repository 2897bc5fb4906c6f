//! How readings enter: from sockets, streams and topics to the event queue of their vehicle.
//!
//! | file | in -> out |
//! |---|---|
//! | [`udp`] | UDP sockets -> batches of datagrams, by vehicle and sensor |
//! | [`publish::grpc::ingest`](crate::publish::grpc::ingest) | observations over gRPC -> gateway; reports back |
//! | `zenoh` | observations over zenoh -> a queue for each source |
//! | `zenoh_source` | the queue of one source -> gateway; reports back |
//! | [`gateway`] | one observation of a client -> events on the queue of its vehicle |
//! | [`observation`] | `clearway.v1.Observation` -> event bodies, or the reason of the refusal |
//! | [`admission`] | streams and observations -> the observations that are admitted now, by turns of their sources |
//! | [`receipt`] | outcome of an event -> report to its client |
//! | [`ros`] | ROS 2 messages -> readings |
//! | [`queue`] | readings -> numbered events on one bounded queue a vehicle |
//! | [`sensor_senders`] | who sends the data of each sensor, to tell when several do at once |
//! | [`drops`] | counts of readings that did not become events |

pub mod admission;
pub mod drops;
pub mod gateway;
pub mod observation;
pub mod queue;
pub mod receipt;
pub mod ros;
pub mod sensor_senders;
pub mod udp;
#[cfg(feature = "zenoh")]
pub mod zenoh;
#[cfg(feature = "zenoh")]
mod zenoh_source;
