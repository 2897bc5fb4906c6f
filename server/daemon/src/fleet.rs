//! The vehicles of other servers in the same zenoh network.
//!
//! Each server announces its vehicles once a second; the others list them and lead readers to them. Announcements tell
//! what a vehicle's server says of it: a server takes its own vehicles from no announcement.
//!
//! In: announcements, in the order in which they come. Out: the vehicles, who claims a name, and where it is served.
//! `publish::announcements` sends and receives them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_proto::v1;
use prost::Message;

use crate::base::sync::locked;

/// Time after its last announcement at which a vehicle is no longer listed. Ours: two lost announcements and the delay
/// of a bad link.
const SILENT_MAX: Duration = Duration::from_secs(4);
/// Most vehicles of other servers. Ours: some megabytes; further ones are refused and counted.
const VEHICLES_MAX: usize = 4096;
/// Longest announcement, in bytes. Ours: a vehicle with eight sensors takes some 4 KiB.
const ANNOUNCEMENT_BYTES_MAX: usize = 64 << 10;
/// Longest name of a vehicle or server, in bytes. Ours: names of vehicles in the configuration are shorter.
const NAME_BYTES_MAX: usize = 256;

/// The vehicles of other servers. Clones share them. Empty without zenoh.
#[derive(Clone, Debug, Default)]
pub struct Fleet(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    /// By name of the vehicle and run of its server.
    vehicles: BTreeMap<(String, u64), Announced>,
    refused: BTreeMap<&'static str, u64>,
}

#[derive(Debug)]
struct Announced {
    vehicle: v1::Vehicle,
    heard: Instant,
}

impl Fleet {
    /// Takes an announcement, an encoded [`v1::Vehicle`], at the time `now`. What cannot be one is counted
    /// ([`Fleet::refused`]).
    pub fn hear(&self, announcement: &[u8], now: Instant) {
        let mut state = locked(&self.0);
        if let Err(reason) = state.hear(announcement, now) {
            *state.refused.entry(reason).or_default() += 1;
        }
    }

    /// The vehicles of other servers at the time `now`, by name. A name that several servers claim is there several
    /// times.
    pub fn vehicles(&self, now: Instant) -> Vec<v1::Vehicle> {
        let mut state = locked(&self.0);
        state.forget(now);
        state.vehicles.values().map(|announced| announced.vehicle.clone()).collect()
    }

    /// The other servers that announce a vehicle with this name at the time `now`.
    pub fn servers_of(&self, vehicle: &str, now: Instant) -> Vec<String> {
        let mut state = locked(&self.0);
        state.forget(now);
        state.of(vehicle).map(|of| of.server.clone()).collect()
    }

    /// The address, `HOST:PORT`, at which another server serves the maps of this vehicle at the time `now`. If several
    /// claim it, that of the one with the newest map.
    pub fn address_of(&self, vehicle: &str, now: Instant) -> Option<String> {
        let mut state = locked(&self.0);
        state.forget(now);
        let with_address = state.of(vehicle).filter(|of| !of.grpc.is_empty());
        with_address.max_by_key(|of| of.newest_capture_end_ns).map(|of| of.grpc.clone())
    }

    /// Number of announcements that were refused, by reason: "length", "message", "name", "full".
    pub fn refused(&self) -> BTreeMap<&'static str, u64> {
        locked(&self.0).refused.clone()
    }
}

impl State {
    fn hear(&mut self, announcement: &[u8], now: Instant) -> Result<(), &'static str> {
        if announcement.len() > ANNOUNCEMENT_BYTES_MAX {
            return Err("length");
        }
        let vehicle = v1::Vehicle::decode(announcement).map_err(|_| "message")?;
        let names = [&vehicle.name, &vehicle.server, &vehicle.grpc, &vehicle.page];
        if vehicle.name.is_empty() || names.iter().any(|name| name.len() > NAME_BYTES_MAX) {
            return Err("name");
        }
        let key = (vehicle.name.clone(), vehicle.boot_id);
        if self.vehicles.len() >= VEHICLES_MAX {
            self.forget(now);
        }
        if self.vehicles.len() >= VEHICLES_MAX && !self.vehicles.contains_key(&key) {
            return Err("full");
        }
        self.vehicles.insert(key, Announced { vehicle, heard: now });
        Ok(())
    }

    fn of(&self, vehicle: &str) -> impl Iterator<Item = &v1::Vehicle> {
        let from = (vehicle.to_owned(), 0);
        self.vehicles.range(from..).take_while(move |((name, _), _)| name == vehicle).map(|(_, of)| &of.vehicle)
    }

    fn forget(&mut self, now: Instant) {
        self.vehicles.retain(|_, announced| now.saturating_duration_since(announced.heard) <= SILENT_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn announcement(name: &str, boot_id: u64, grpc: &str, newest_capture_end_ns: i64) -> Vec<u8> {
        let server = format!("server {boot_id}");
        let vehicle = v1::Vehicle {
            name: name.into(),
            boot_id,
            server,
            grpc: grpc.into(),
            newest_capture_end_ns,
            ..Default::default()
        };
        vehicle.encode_to_vec()
    }

    #[test]
    fn a_vehicle_is_listed_until_its_server_is_silent() {
        let (fleet, start) = (Fleet::default(), Instant::now());
        fleet.hear(&announcement("van", 1, "a:1", 0), start);
        assert_eq!(fleet.vehicles(start + SILENT_MAX).len(), 1);
        assert_eq!(fleet.address_of("van", start + SILENT_MAX).as_deref(), Some("a:1"));
        let late = start + SILENT_MAX + Duration::from_millis(1);
        assert_eq!(fleet.vehicles(late), []);
        assert_eq!(fleet.address_of("van", late), None);
    }

    #[test]
    fn two_servers_with_one_vehicle_are_both_listed_and_the_newest_map_leads() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        fleet.hear(&announcement("van", 7, "old:1", 100), now);
        fleet.hear(&announcement("van", 3, "new:1", 200), now);
        fleet.hear(&announcement("vans", 4, "other:1", 900), now);
        assert_eq!(fleet.vehicles(now).len(), 3);
        assert_eq!(fleet.servers_of("van", now), ["server 3", "server 7"]);
        assert_eq!(fleet.address_of("van", now).as_deref(), Some("new:1"));
        assert_eq!(fleet.address_of("bus", now), None);
    }

    #[test]
    fn what_is_no_announcement_is_refused_and_counted() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        fleet.hear(&[0xff; 9], now);
        fleet.hear(&vec![0; ANNOUNCEMENT_BYTES_MAX + 1], now);
        fleet.hear(&announcement("", 1, "a:1", 0), now);
        fleet.hear(&announcement(&"v".repeat(NAME_BYTES_MAX + 1), 1, "a:1", 0), now);
        assert_eq!(fleet.vehicles(now), []);
        assert_eq!(fleet.refused(), BTreeMap::from([("length", 1), ("message", 1), ("name", 2)]));
    }

    #[test]
    fn a_flood_of_names_keeps_the_vehicles_that_are_known() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        for n in 0..VEHICLES_MAX + 10 {
            fleet.hear(&announcement(&format!("car {n}"), 1, "", 0), now);
        }
        fleet.hear(&announcement("car 0", 1, "a:1", 0), now);
        assert_eq!(fleet.vehicles(now).len(), VEHICLES_MAX);
        assert_eq!(fleet.address_of("car 0", now).as_deref(), Some("a:1"));
        assert_eq!(fleet.refused(), BTreeMap::from([("full", 10)]));
    }
}
