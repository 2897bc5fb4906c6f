//! Where the events of one vehicle enter a running server.

use std::net::SocketAddr;
use std::sync::Arc;

use crate::ingest::queue::EventQueue;

/// Where the events of one vehicle enter a running server.
pub struct VehicleInput {
    /// Name of the vehicle.
    pub name: Arc<str>,
    /// The vehicle's event queue.
    pub queue: EventQueue,
    /// The addresses that receive data packets and telemetry of the vehicle's first UDP sensor, if there is one.
    pub udp: Option<(SocketAddr, SocketAddr)>,
}
