//! The table `[vehicle.udp]`: where a vehicle's datagrams arrive, and which sensor each sender is.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use serde::{Deserialize, Serialize};

/// The table `[vehicle.udp]`: the sockets that receive datagrams of the sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Udp {
    /// Address and port of data packets. Vehicles with the same address share a socket; port 0 selects a free port for
    /// each.
    pub data: SocketAddr,
    /// Address and port of telemetry.
    pub telemetry: SocketAddr,
    /// Receive buffer requested from the kernel for each socket, in bytes: 1 s of an HDL-64E. A constant but in tests.
    #[serde(skip)]
    pub receive_buffer_bytes: usize,
    /// Multicast groups that the sockets join.
    pub groups: Vec<IpAddr>,
    /// Name of the network interface on which the groups are joined; empty: the system chooses.
    pub interface: String,
    /// Sender of each sensor, by sensor name: `"192.168.1.201"`, or with its port. Datagrams of other senders are
    /// refused. Empty: every datagram belongs to the only sensor.
    pub from: BTreeMap<String, Sender>,
    /// Ports of sensors that have ports of their own, by sensor name.
    pub ports: BTreeMap<String, Ports>,
}

impl Udp {
    /// The key that names the address of a socket.
    pub fn key_of(&self, at: SocketAddr) -> &'static str {
        match at {
            _ if at == self.data => "vehicle.udp.data",
            _ if at == self.telemetry => "vehicle.udp.telemetry",
            _ => "vehicle.udp.ports",
        }
    }
}

impl Default for Udp {
    fn default() -> Self {
        let at = |port| SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port);
        Self {
            data: at(2368),
            telemetry: at(8308),
            receive_buffer_bytes: 4 << 20,
            groups: Vec::new(),
            interface: String::new(),
            from: BTreeMap::new(),
            ports: BTreeMap::new(),
        }
    }
}

/// A sensor's own ports, at the addresses of [`Udp::data`] and [`Udp::telemetry`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ports {
    /// Port that receives the sensor's data packets.
    pub data: u16,
    /// Port that receives the sensor's telemetry.
    pub telemetry: u16,
}

/// Address of a sender, with or without its port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "an address such as \"192.168.1.201\" or \"192.168.1.201:2368\"")]
pub enum Sender {
    /// Any port of this address.
    Address(IpAddr),
    /// This port alone.
    Socket(SocketAddr),
}

impl std::fmt::Display for Sender {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Address(address) => address.fmt(f),
            Self::Socket(socket) => socket.fmt(f),
        }
    }
}

impl Sender {
    /// True if `peer` is this sender; an IPv4 peer must not be given as a mapped IPv6 address.
    pub fn matches(&self, peer: SocketAddr) -> bool {
        match self {
            Self::Address(address) => *address == peer.ip(),
            Self::Socket(socket) => *socket == peer,
        }
    }

    /// True if a datagram could come from both senders.
    pub(super) fn overlaps(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Address(a), Self::Address(b)) => a == b,
            (Self::Socket(a), Self::Socket(b)) => a == b,
            (Self::Address(a), Self::Socket(b)) | (Self::Socket(b), Self::Address(a)) => *a == b.ip(),
        }
    }
}
