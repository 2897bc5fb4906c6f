//! The vehicles of other servers in the same zenoh network.
//!
//! Each server announces its vehicles once a second; the others list them and lead readers to them. Announcements tell
//! what a vehicle's server says of it: a server takes its own vehicles from no announcement.
//!
//! In: announcements, in the order in which they come. Out: the vehicles, who claims a name, and where it is served.
//! `publish::announcements` sends and receives them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use clearway_proto::v1;
use prost::Message;

use crate::base::sync::locked;

/// Time after its last announcement at which a vehicle is no longer listed. Ours: two lost announcements and the delay
/// of a bad link.
const SILENT_MAX: Duration = Duration::from_secs(4);
/// Most vehicles of other servers. Ours: some megabytes; further ones are passed over.
const VEHICLES_MAX: usize = 4096;
/// Longest announcement, in bytes. Ours: a vehicle with eight sensors takes some 4 KiB.
const ANNOUNCEMENT_BYTES_MAX: usize = 64 << 10;
/// Longest name of a vehicle or server, in bytes. Ours: names of vehicles in the configuration are shorter.
const NAME_BYTES_MAX: usize = 256;

/// The vehicles of other servers, by name of the vehicle and run of its server. Clones share them. Empty without zenoh.
#[derive(Clone, Debug, Default)]
pub struct Fleet(Arc<Mutex<BTreeMap<(String, u64), Announced>>>);

#[derive(Debug)]
struct Announced {
    vehicle: v1::Vehicle,
    heard: Instant,
}

impl Fleet {
    /// Takes an announcement, an encoded [`v1::Vehicle`], at the time `now`. A message that cannot be one is passed
    /// over.
    pub fn hear(&self, announcement: &[u8], now: Instant) {
        if announcement.len() > ANNOUNCEMENT_BYTES_MAX {
            return;
        }
        let Ok(vehicle) = v1::Vehicle::decode(announcement) else { return };
        let names = [&vehicle.name, &vehicle.server, &vehicle.grpc, &vehicle.page];
        if vehicle.name.is_empty() || names.iter().any(|name| name.len() > NAME_BYTES_MAX) {
            return;
        }
        let key = (vehicle.name.clone(), vehicle.boot_id);
        let mut vehicles = self.heard(now);
        if vehicles.len() < VEHICLES_MAX || vehicles.contains_key(&key) {
            vehicles.insert(key, Announced { vehicle, heard: now });
        }
    }

    /// The vehicles of other servers at the time `now`, by name. A name that several servers claim is there several
    /// times.
    pub fn vehicles(&self, now: Instant) -> Vec<v1::Vehicle> {
        self.heard(now).values().map(|announced| announced.vehicle.clone()).collect()
    }

    /// A vehicle of another server by its name at the time `now`. If several servers claim it, the newest map of the
    /// servers that announce an address decides.
    pub fn find(&self, name: &str, now: Instant) -> Option<v1::Vehicle> {
        let of_name = self.vehicles(now).into_iter().filter(|vehicle| vehicle.name == name);
        of_name.max_by_key(|vehicle| (!vehicle.grpc.is_empty(), vehicle.newest_capture_end_ns))
    }

    /// The vehicles whose servers are not silent at the time `now`.
    fn heard(&self, now: Instant) -> MutexGuard<'_, BTreeMap<(String, u64), Announced>> {
        let mut vehicles = locked(&self.0);
        vehicles.retain(|_, announced| now.saturating_duration_since(announced.heard) <= SILENT_MAX);
        vehicles
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

    fn address(fleet: &Fleet, vehicle: &str, now: Instant) -> Option<String> {
        fleet.find(vehicle, now).map(|vehicle| vehicle.grpc)
    }

    #[test]
    fn a_vehicle_is_listed_until_its_server_is_silent() {
        let (fleet, start) = (Fleet::default(), Instant::now());
        fleet.hear(&announcement("van", 1, "a:1", 0), start);
        assert_eq!(fleet.vehicles(start + SILENT_MAX).len(), 1);
        assert_eq!(address(&fleet, "van", start + SILENT_MAX).as_deref(), Some("a:1"));
        let late = start + SILENT_MAX + Duration::from_millis(1);
        assert_eq!(fleet.vehicles(late), []);
        assert_eq!(address(&fleet, "van", late), None);
    }

    #[test]
    fn two_servers_with_one_vehicle_are_both_listed_and_the_newest_map_leads() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        fleet.hear(&announcement("van", 7, "old:1", 100), now);
        fleet.hear(&announcement("van", 3, "new:1", 200), now);
        fleet.hear(&announcement("vans", 4, "other:1", 900), now);
        assert_eq!(fleet.vehicles(now).len(), 3);
        assert_eq!(address(&fleet, "van", now).as_deref(), Some("new:1"));
        fleet.hear(&announcement("van", 9, "", 300), now);
        assert_eq!(address(&fleet, "van", now).as_deref(), Some("new:1"), "the newest announces no address");
        assert_eq!(address(&fleet, "bus", now), None);
    }

    #[test]
    fn what_is_no_announcement_is_passed_over() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        fleet.hear(&[0xff; 9], now);
        fleet.hear(&vec![0; ANNOUNCEMENT_BYTES_MAX + 1], now);
        fleet.hear(&announcement("", 1, "a:1", 0), now);
        fleet.hear(&announcement(&"v".repeat(NAME_BYTES_MAX + 1), 1, "a:1", 0), now);
        assert_eq!(fleet.vehicles(now), []);
    }

    #[test]
    fn a_flood_of_names_keeps_the_vehicles_that_are_known() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        for n in 0..VEHICLES_MAX + 10 {
            fleet.hear(&announcement(&format!("car {n}"), 1, "", 0), now);
        }
        fleet.hear(&announcement("car 0", 1, "a:1", 0), now);
        assert_eq!(fleet.vehicles(now).len(), VEHICLES_MAX);
        assert_eq!(address(&fleet, "car 0", now).as_deref(), Some("a:1"));
    }
}
