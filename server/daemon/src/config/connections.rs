//! The table `[connections]`: what the peers of every TCP listener may cost, and which addresses may be public.

use std::net::IpAddr;

use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// The table `[connections]`. It holds for gRPC, the page, the metrics and Foxglove.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Connections {
    /// Most connections at once, at each listener; further connections are refused with RESOURCE_EXHAUSTED or 503.
    pub max: usize,
    /// Most connections of one address at once, at each listener. IPv6: of one network with a prefix of 64 bits.
    pub per_address_max: usize,
    /// Connections and calls of each listener that only known peers may use. A constant but in tests.
    #[serde(skip)]
    pub kept: usize,
    /// Addresses that are known peers; so are the names in certificates and tokens that have a role.
    pub known: Vec<IpAddr>,
    /// A connection without a request for this time is closed, in s.
    #[serde(skip)]
    pub idle_s: u64,
    /// A connection that receives nothing of what waits for it for this time is closed, in s.
    #[serde(skip)]
    pub stalled_s: u64,
    /// Most gRPC calls at once, of all readers and senders. A constant but in tests. Ours: four times the readers that
    /// the default number of connections serves.
    #[serde(skip)]
    pub calls_max: usize,
    /// Most gRPC calls of one address at once. A constant but in tests. Ours: a quarter, so that one address never has
    /// all.
    #[serde(skip)]
    pub calls_per_address_max: usize,
    /// Names by which a browser may address the page, beside addresses, `localhost` and the names in the certificate.
    pub hosts: Vec<String>,
    /// Origins of other web pages that may connect, such as `https://fleet.example`.
    pub origins: Vec<String>,
    /// Listeners that may serve other hosts without protection.
    pub unprotected: Vec<Service>,
}

impl Default for Connections {
    fn default() -> Self {
        Self {
            max: 256,
            per_address_max: 64,
            kept: 16,
            known: Vec::new(),
            idle_s: 60,
            stalled_s: 10,
            calls_max: 1024,
            calls_per_address_max: 256,
            hosts: Vec::new(),
            origins: Vec::new(),
            unprotected: Vec::new(),
        }
    }
}

/// A kind of listener on an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Service {
    /// The gRPC server.
    Grpc,
    /// The page and its WebSocket.
    Page,
    /// The listener of `/healthz`, `/readyz` and `/metrics` alone.
    Metrics,
    /// The WebSocket server for Foxglove.
    Foxglove,
    /// The endpoint on which zenoh listens.
    Zenoh,
    /// The UDP socket for datagrams of sensors.
    Udp,
}

impl Service {
    /// The name in the configuration.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Page => "page",
            Self::Metrics => "metrics",
            Self::Foxglove => "foxglove",
            Self::Zenoh => "zenoh",
            Self::Udp => "udp",
        }
    }
}

impl Connections {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        for (key, value) in [("connections.max", self.max), ("connections.per_address_max", self.per_address_max)] {
            if !(1..=65_536).contains(&value) {
                return Err(ValueError::new(key, value, "1 to 65536"));
            }
        }
        // The pages of an Electron program, such as Foxglove's, have the origin `file://`.
        let is_wrong = |origin: &&String| !origin.contains("://") || (origin.ends_with('/') && *origin != "file://");
        if let Some(origin) = self.origins.iter().find(is_wrong) {
            let allowed = "origins such as \"https://fleet.example\" or \"file://\", without a path";
            return Err(ValueError::new("connections.origins", origin, allowed));
        }
        Ok(())
    }
}
