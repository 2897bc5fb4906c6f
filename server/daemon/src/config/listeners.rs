//! The sockets of all vehicles: one [`Listener`] for each address, which several sensors and several vehicles can
//! share.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};

use super::error::ValueError;
use super::udp::{Sender, Udp};
use super::vehicle::Vehicle;

/// The sensor that a sender is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    /// The sender; `None`: every sender.
    pub from: Option<Sender>,
    /// Index of the vehicle in the configuration.
    pub vehicle: usize,
    /// Index of the sensor in the vehicle's configuration.
    pub source: u16,
}

/// One socket to open, and the sensors that send to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listener {
    /// Address and port to bind.
    pub at: SocketAddr,
    /// Receive buffer, in bytes: the largest buffer requested by its vehicles.
    pub receive_buffer_bytes: usize,
    /// Multicast groups to join, each with its interface.
    pub groups: BTreeSet<(IpAddr, String)>,
    /// The sensors by sender.
    pub routes: Vec<Route>,
    /// For port 0: the vehicle and the configured address for which the system chooses a port.
    chosen_for: Option<(usize, AddressKey)>,
}

/// Which address of a vehicle's table: a sensor's own port or the common one, for data or telemetry.
type AddressKey = (Option<u16>, &'static str);

impl Listener {
    /// The route of a datagram; `None` if its sender is unknown.
    pub fn route(&self, peer: SocketAddr) -> Option<Route> {
        self.routes.iter().find(|route| route.from.is_none_or(|sender| sender.matches(peer))).copied()
    }

    fn add(&mut self, route: Route, udp: &Udp) {
        self.receive_buffer_bytes = self.receive_buffer_bytes.max(udp.receive_buffer_bytes);
        self.groups.extend(udp.groups.iter().map(|group| (*group, udp.interface.clone())));
        // Data and telemetry of a sensor may share a socket.
        if !self.routes.contains(&route) {
            self.routes.push(route);
        }
    }

    /// Two sensors whose datagrams cannot be distinguished on this socket.
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
            // If any sensor is named, the unnamed sensors get their data from other sources.
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

/// Checks the UDP tables of all vehicles, and that senders on shared sockets can be distinguished.
pub(super) fn check(vehicles: &[Vehicle]) -> Result<(), ValueError> {
    for vehicle in vehicles {
        let Some(udp) = &vehicle.udp else { continue };
        let wrong = |key: &str, value: &dyn ToString, allowed: &str| {
            Err(ValueError::new(format!("vehicle.udp.{key} (of {})", vehicle.name), value.to_string(), allowed))
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
        let joins = |group: &IpAddr| group.is_multicast() && (group.is_ipv4() || udp.data.is_ipv6());
        if let Some(group) = udp.groups.iter().find(|group| !joins(group)) {
            return wrong("groups", group, "multicast addresses, IPv6 groups only if data is an IPv6 address");
        }
    }
    for listener in listeners(vehicles) {
        if let Some((a, b)) = listener.ambiguous() {
            let sensor = |route: Route| &vehicles[route.vehicle].sensors[usize::from(route.source)].name;
            let vehicle = |route: Route| &vehicles[route.vehicle].name;
            let mut allowed = format!(
                "a sender of its own, or ports of its own, for each sensor at {}: {} of {} and {} of {} cannot be distinguished",
                listener.at,
                sensor(a),
                vehicle(a),
                sensor(b),
                vehicle(b)
            );
            if a.vehicle != b.vehicle {
                allowed += "; `--vehicle NAME` uses one vehicle of the file alone";
            }
            let value = b.from.or(a.from).map_or("(nothing)".to_owned(), |from| from.to_string());
            return Err(ValueError::new(format!("vehicle.udp.from (of {})", vehicle(b)), value, allowed));
        }
    }
    Ok(())
}
