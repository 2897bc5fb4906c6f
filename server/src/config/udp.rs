//! `[vehicle.udp]`: where a vehicle's datagrams arrive, and which sensor each sender is. Out: the [`Listener`]s of all
//! vehicles, one a socket; several sensors, and several vehicles, can share one.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use serde::{Deserialize, Serialize};

use super::{Vehicle, Wrong};

/// `[vehicle.udp]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Udp {
    /// Where data packets arrive. Vehicles that name the same address share a socket; port 0 takes a free one each.
    pub data: SocketAddr,
    /// Where telemetry arrives.
    pub telemetry: SocketAddr,
    /// Asked of the kernel for each socket.
    pub receive_buffer_bytes: usize,
    /// Multicast groups the sockets join.
    pub groups: Vec<IpAddr>,
    /// Name of the network interface the groups are joined on; empty: the system's choice.
    pub interface: String,
    /// Sender of each sensor, by sensor name: `"192.168.1.201"`, or with its port. Datagrams of anyone else are
    /// refused. Empty: whatever arrives is the one sensor's.
    pub from: BTreeMap<String, Sender>,
    /// Ports of sensors that have their own, by sensor name.
    pub ports: BTreeMap<String, Ports>,
}

impl Default for Udp {
    fn default() -> Self {
        let any = |port| SocketAddr::new(Ipv4Addr::UNSPECIFIED.into(), port);
        Self {
            data: any(2368),
            telemetry: any(8308),
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
    /// Where its data packets arrive.
    pub data: u16,
    /// Where its telemetry arrives.
    pub telemetry: u16,
}

/// A sender's address, with its port or without.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "an address such as \"192.168.1.201\" or \"192.168.1.201:2368\"")]
pub enum Sender {
    /// Any port of this address.
    Address(IpAddr),
    /// This port alone.
    Socket(SocketAddr),
}

impl Sender {
    /// Whether `peer` (an IPv4 address as such) is this sender.
    pub fn is(&self, peer: SocketAddr) -> bool {
        match self {
            Self::Address(address) => *address == peer.ip(),
            Self::Socket(socket) => *socket == peer,
        }
    }

    /// Whether a datagram could be of both.
    fn overlaps(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Address(a), Self::Address(b)) => a == b,
            (Self::Socket(a), Self::Socket(b)) => a == b,
            (Self::Address(a), Self::Socket(b)) | (Self::Socket(b), Self::Address(a)) => *a == b.ip(),
        }
    }
}

/// Whose datagrams these are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    /// Whom they come from; `None`: from anybody.
    pub from: Option<Sender>,
    /// Index of the vehicle in the configuration.
    pub vehicle: usize,
    /// Index of the sensor in the vehicle's configuration.
    pub source: u16,
}

/// One socket to open, and whose datagrams come through it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listener {
    /// Where to bind it.
    pub at: SocketAddr,
    /// The greatest that any of its vehicles asks for.
    pub receive_buffer_bytes: usize,
    /// Multicast groups to join, each with the interface to join it on.
    pub groups: BTreeSet<(IpAddr, String)>,
    /// By sender.
    pub routes: Vec<Route>,
    /// Of a port of the system's choice: the vehicle and the configured place it is chosen for.
    chosen_for: Option<(usize, Place)>,
}

/// Where in a vehicle's table an address stands: a sensor's own port or everybody's, for data or telemetry.
type Place = (Option<u16>, &'static str);

impl Listener {
    /// The route of a datagram; `None` where its sender is nobody's.
    pub fn route(&self, peer: SocketAddr) -> Option<Route> {
        self.routes.iter().find(|route| route.from.is_none_or(|sender| sender.is(peer))).copied()
    }

    fn add(&mut self, route: Route, udp: &Udp) {
        self.receive_buffer_bytes = self.receive_buffer_bytes.max(udp.receive_buffer_bytes);
        self.groups.extend(udp.groups.iter().map(|group| (*group, udp.interface.clone())));
        // Data and telemetry of a sensor may share a socket.
        if !self.routes.contains(&route) {
            self.routes.push(route);
        }
    }

    /// Two sensors that cannot be told apart here.
    fn ambiguous(&self) -> Option<(Route, Route)> {
        let overlap = |a: &Route, b: &Route| match (a.from, b.from) {
            (Some(a), Some(b)) => a.overlaps(&b),
            _ => true,
        };
        self.routes.iter().enumerate().find_map(|(index, a)| {
            let b = self.routes[index + 1..].iter().find(|b| overlap(a, b))?;
            Some((*a, *b))
        })
    }
}

/// The sockets of all vehicles, in the order of the configuration.
pub fn listeners(vehicles: &[Vehicle]) -> Vec<Listener> {
    let mut listeners: Vec<Listener> = Vec::new();
    for (index, vehicle) in vehicles.iter().enumerate() {
        let Some(udp) = &vehicle.udp else { continue };
        for (source, sensor) in (0_u16..).zip(&vehicle.sensors) {
            let own = udp.ports.get(&sensor.name);
            let named = own.is_some() || udp.from.contains_key(&sensor.name);
            // Where any sensor is named, the others are fed by other doors.
            let any_named = !udp.from.is_empty() || !udp.ports.is_empty();
            if any_named && !named {
                continue;
            }
            let route = Route { from: udp.from.get(&sensor.name).copied(), vehicle: index, source };
            for (what, common) in [("data", udp.data), ("telemetry", udp.telemetry)] {
                let port = own.map(|own| if what == "data" { own.data } else { own.telemetry });
                let at = SocketAddr::new(common.ip(), port.unwrap_or(common.port()));
                let chosen_for = (at.port() == 0).then(|| (index, (own.map(|_| source), what)));
                let shared = listeners.iter_mut().find(|l| l.at == at && l.chosen_for == chosen_for);
                match shared {
                    Some(listener) => listener.add(route, udp),
                    None => {
                        let (receive_buffer_bytes, groups, routes) = Default::default();
                        let mut listener = Listener { at, receive_buffer_bytes, groups, routes, chosen_for };
                        listener.add(route, udp);
                        listeners.push(listener);
                    }
                }
            }
        }
    }
    listeners
}

/// What is wrong with the vehicles' UDP tables, and where they share addresses.
pub(super) fn check(vehicles: &[Vehicle]) -> Result<(), Wrong> {
    for vehicle in vehicles {
        let Some(udp) = &vehicle.udp else { continue };
        let wrong = |key: &str, value: &dyn ToString, allowed: &str| {
            Err(Wrong::new(format!("vehicle.udp.{key} (of {})", vehicle.name), value.to_string(), allowed))
        };
        let known: Vec<_> = vehicle.sensors.iter().map(|sensor| sensor.name.as_str()).collect();
        let unknown = |names: Vec<&String>| names.into_iter().find(|n| !known.contains(&n.as_str())).cloned();
        for (key, unknown) in
            [("from", unknown(udp.from.keys().collect())), ("ports", unknown(udp.ports.keys().collect()))]
        {
            if let Some(name) = unknown {
                return wrong(key, &name, &format!("the vehicle's sensors: {}", known.join(", ")));
            }
        }
        if !(65_536..=1 << 30).contains(&udp.receive_buffer_bytes) {
            return wrong("receive_buffer_bytes", &udp.receive_buffer_bytes, "65536 to 1073741824 bytes");
        }
        let joins = |group: &IpAddr| group.is_multicast() && (group.is_ipv4() || udp.data.is_ipv6());
        if let Some(group) = udp.groups.iter().find(|group| !joins(group)) {
            return wrong("groups", group, "multicast addresses, of IPv6 only where data is an IPv6 address");
        }
    }
    for listener in listeners(vehicles) {
        if let Some((a, b)) = listener.ambiguous() {
            let sensor = |route: Route| &vehicles[route.vehicle].sensors[usize::from(route.source)].name;
            let vehicle = |route: Route| &vehicles[route.vehicle].name;
            let allowed = format!(
                "a sender of its own, or ports of its own, for each sensor at {}: {} of {} and {} of {} cannot be told apart",
                listener.at,
                sensor(a),
                vehicle(a),
                sensor(b),
                vehicle(b)
            );
            let value = b.from.or(a.from).map_or("(nothing)".to_owned(), |from| format!("{from:?}"));
            return Err(Wrong::new(format!("vehicle.udp.from (of {})", vehicle(b)), value, allowed));
        }
    }
    Ok(())
}
