//! The vehicles of other servers in the same zenoh network.
//!
//! Each server announces its vehicles once a second; the others list them and lead readers to them. Announcements tell
//! what a vehicle's server says of it: a server takes its own vehicles from no announcement.
//!
//! A server that ends takes its announcements back; a server that is silent leaves its vehicles in error for a while.
//!
//! In: announcements, in the order in which they come. Out: the vehicles, who claims a name, and where it is served.
//! `publish::announcements` sends and receives them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use clearway_mapping::config::check_name;
use clearway_proto::v1;
use prost::Message;
use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};

use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::config;

/// Time after its last announcement at which the server of a vehicle is silent. Ours: two lost announcements and the
/// delay of a bad link.
const SILENT_MAX: Duration = Duration::from_secs(4);
/// Time after its last announcement for which a vehicle is listed, in error once its server is silent. Ours: a person
/// who looks once in a while sees it.
const LISTED_MAX: Duration = Duration::from_secs(30);
/// Most memory of the vehicles of other servers, in bytes, by [`decoded_bytes`]. Ours: a thousand vehicles with one
/// sensor, some hundred with eight.
const BYTES_MAX: usize = 8 << 20;
/// Longest list of the vehicles of other servers, in bytes of their announcements. A client of gRPC reads a message of
/// 4 MiB, and the vehicles of this server are in the list too.
const LIST_BYTES_MAX: usize = 3 << 20;
/// Most reasons of a vehicle of another server that are shown. Ours: a server gives fewer.
const REASONS_MAX: usize = 32;
/// Longest announcement, in bytes. Ours: a vehicle with eight sensors takes some 4 KiB.
const ANNOUNCEMENT_BYTES_MAX: usize = 64 << 10;
/// Most memory of one vehicle, in bytes, by [`decoded_bytes`]. Ours: ten vehicles with eight sensors.
const VEHICLE_BYTES_MAX: usize = 256 << 10;
/// Depth of messages in a vehicle: the counts of a sensor's ledger by reason.
const DEPTH_MAX: u32 = 3;
/// Longest name of a vehicle or server, in bytes. Ours: names of vehicles in the configuration are shorter.
const NAME_BYTES_MAX: usize = 256;
/// Time by which the newest map of another server may be ahead of this host's clock, in ns. Ours: two clocks of hosts.
const AHEAD_NS_MAX: i64 = 1_000_000_000;

/// The vehicles of other servers. Clones share them. Empty without zenoh.
#[derive(Clone, Debug, Default)]
pub struct Fleet(Arc<Mutex<Heard>>);

#[derive(Debug, Default)]
struct Heard {
    /// By name of the vehicle and run of its server.
    vehicles: BTreeMap<(String, u64), Announced>,
    /// Number of refused announcements, by [`AnnouncementRefused::reason`].
    refused: BTreeMap<&'static str, u64>,
}

#[derive(Debug)]
struct Announced {
    vehicle: v1::Vehicle,
    /// Memory of the vehicle, by [`decoded_bytes`].
    bytes: usize,
    /// Length of the announcement, in bytes.
    length: usize,
    heard: Instant,
}

impl Announced {
    fn is_silent(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.heard) > SILENT_MAX
    }

    /// The vehicle at the time `now`: its newest map grows older, and it is in error if its server is silent.
    fn at(&self, now: Instant) -> v1::Vehicle {
        let (mut vehicle, silent) = (self.vehicle.clone(), now.saturating_duration_since(self.heard));
        vehicle.map_age_ms.iter_mut().for_each(|age_ms| *age_ms += silent.as_secs_f64() * 1e3);
        if self.is_silent(now) {
            let reason = format!("its server {} has not announced it for {} s", vehicle.server, silent.as_secs());
            (vehicle.state, vehicle.map_rate_hz) = ("error".into(), 0.0);
            vehicle.reasons = vec![reason];
        }
        vehicle
    }
}

/// What an announcement that was taken claims: that the run of a server serves a vehicle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FleetClaim {
    /// Name of the vehicle.
    pub vehicle: String,
    /// The run of the server.
    pub boot_id: u64,
    /// Name of the server.
    pub server: String,
}

/// Why an announcement is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AnnouncementRefused {
    /// It is no [`v1::Vehicle`], is too long or takes too much memory, its name is no vehicle's, or another text is too
    /// long or has control characters, which would make lines of their own on a terminal.
    #[error("an announcement of another server is no vehicle, or too large a one")]
    Invalid,
    /// The vehicles that are listed take the memory.
    #[error(
        "the vehicles of other servers take {} MiB, or {} MiB in their list, which are allowed: further ones are not listed",
        BYTES_MAX >> 20,
        LIST_BYTES_MAX >> 20
    )]
    Full,
}

impl AnnouncementRefused {
    /// The reason in metrics.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Invalid => "invalid",
            Self::Full => "full",
        }
    }
}

impl Fleet {
    /// Takes an announcement, an encoded [`v1::Vehicle`], at the time `now`, or counts it as refused. An address or URL
    /// that the configuration would refuse is left out of it, and so is a newest map that lies in the future.
    ///
    /// # Errors
    /// Why it is not taken.
    pub fn hear(&self, announcement: &[u8], now: Instant) -> Result<FleetClaim, AnnouncementRefused> {
        let taken = self.take(announcement, now);
        if let Err(refused) = &taken {
            *locked(&self.0).refused.entry(refused.reason()).or_default() += 1;
        }
        taken
    }

    /// Number of refused announcements, by [`AnnouncementRefused::reason`].
    pub fn refused(&self) -> BTreeMap<&'static str, u64> {
        locked(&self.0).refused.clone()
    }

    fn take(&self, announcement: &[u8], now: Instant) -> Result<FleetClaim, AnnouncementRefused> {
        let bytes = Some(announcement).filter(|of| of.len() <= ANNOUNCEMENT_BYTES_MAX);
        let bytes = bytes.and_then(|of| decoded_bytes(of, 0)).filter(|bytes| *bytes <= VEHICLE_BYTES_MAX);
        let bytes = bytes.ok_or(AnnouncementRefused::Invalid)?;
        let mut vehicle = v1::Vehicle::decode(announcement).map_err(|_| AnnouncementRefused::Invalid)?;
        let names = [&vehicle.name, &vehicle.server, &vehicle.grpc, &vehicle.page];
        let is_wrong = |text: &String| text.len() > NAME_BYTES_MAX || text.contains(char::is_control);
        if check_name("name", &vehicle.name).is_err() || names.into_iter().any(is_wrong) {
            return Err(AnnouncementRefused::Invalid);
        }
        if !config::Grpc::is_address(&vehicle.grpc) {
            vehicle.grpc.clear();
        }
        if !config::Page::is_url(&vehicle.page) {
            vehicle.page.clear();
        }
        if vehicle.newest_capture_end_ns > now_ns() + AHEAD_NS_MAX {
            vehicle.newest_capture_end_ns = 0;
        }
        vehicle.reasons.truncate(REASONS_MAX);
        let key = (vehicle.name.clone(), vehicle.boot_id);
        let vehicles = &mut self.heard(now).vehicles;
        // A server that starts again takes the place of its last run.
        let is_last_run = |of: &Announced, id: &(String, u64)| of.is_silent(now) && id.0 == key.0 && id.1 != key.1;
        vehicles.retain(|id, announced| !is_last_run(announced, id));
        let others = vehicles.iter().filter(|(other, _)| **other != key).map(|(_, of)| of);
        let (others, listed) = others.fold((0, 0), |(bytes, listed), of| (bytes + of.bytes, listed + of.length));
        let length = announcement.len();
        if others + bytes > BYTES_MAX || listed + length > LIST_BYTES_MAX {
            return Err(AnnouncementRefused::Full);
        }
        let claim = FleetClaim { vehicle: key.0.clone(), boot_id: key.1, server: vehicle.server.clone() };
        vehicles.insert(key, Announced { vehicle, bytes, length, heard: now });
        Ok(claim)
    }

    /// The vehicles of other servers at the time `now`, by name. A name that several servers claim is there several
    /// times.
    pub fn vehicles(&self, now: Instant) -> Vec<v1::Vehicle> {
        self.heard(now).vehicles.values().map(|announced| announced.at(now)).collect()
    }

    /// Forgets a vehicle whose server has ended, by the run of the server.
    pub fn forget(&self, vehicle: &str, boot_id: u64) {
        locked(&self.0).vehicles.remove(&(vehicle.to_owned(), boot_id));
    }

    /// A vehicle of another server by its name at the time `now`; `None` if its server is silent. If several servers
    /// claim it, the newest map of the servers that announce an address decides.
    pub fn find(&self, name: &str, now: Instant) -> Option<v1::Vehicle> {
        let heard = self.heard(now);
        let of_name = heard.vehicles.values().filter(|of| of.vehicle.name == name && !of.is_silent(now));
        of_name.map(|of| of.at(now)).max_by_key(|vehicle| (!vehicle.grpc.is_empty(), vehicle.newest_capture_end_ns))
    }

    /// Forgets the vehicles of servers that are silent for long again and again, so that their memory is free without a
    /// reader.
    pub async fn forget_silent(self) {
        let mut every = tokio::time::interval(LISTED_MAX);
        loop {
            every.tick().await;
            drop(self.heard(Instant::now()));
        }
    }

    /// The vehicles that are listed at the time `now`.
    fn heard(&self, now: Instant) -> MutexGuard<'_, Heard> {
        let mut heard = locked(&self.0);
        heard.vehicles.retain(|_, announced| now.saturating_duration_since(announced.heard) <= LISTED_MAX);
        heard
    }
}

/// Upper bound of the memory of a decoded vehicle, in bytes, from its encoding: for each text, element of a list and
/// entry of a map its length and its type, so that a list of empty elements is not cheap. `None` if it is no encoding.
fn decoded_bytes(mut encoded: &[u8], depth: u32) -> Option<usize> {
    let (mut bytes, element_bytes) = match depth {
        0 => (size_of::<v1::Vehicle>(), size_of::<v1::SensorState>().max(size_of::<(String, v1::Ledger)>())),
        // Elements of a sensor, a ledger or the recorder hold two texts at most.
        _ => (0, 2 * size_of::<String>() + 32),
    };
    while !encoded.is_empty() {
        let (tag, wire) = decode_key(&mut encoded).ok()?;
        if wire != WireType::LengthDelimited {
            skip_field(wire, tag, &mut encoded, DecodeContext::default()).ok()?;
            continue;
        }
        let length = usize::try_from(decode_varint(&mut encoded).ok()?).ok()?;
        let (element, rest) = encoded.split_at_checked(length)?;
        let of_element = if depth < DEPTH_MAX { decoded_bytes(element, depth + 1) } else { None };
        bytes += element_bytes + length + of_element.unwrap_or(0);
        encoded = rest;
    }
    Some(bytes)
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
    fn a_vehicle_whose_server_is_silent_is_in_error_and_leads_no_reader_until_it_is_forgotten() {
        let (fleet, start) = (Fleet::default(), Instant::now());
        let vehicle = v1::Vehicle { name: "van".into(), boot_id: 1, grpc: "a:1".into(), ..Default::default() };
        let vehicle = v1::Vehicle { map_age_ms: Some(50.0), state: "ok".into(), server: "hq".into(), ..vehicle };
        fleet.hear(&vehicle.encode_to_vec(), start).unwrap();
        let shown = &fleet.vehicles(start + SILENT_MAX)[0];
        assert_eq!((&*shown.state, shown.map_age_ms), ("ok", Some(4050.0)), "its newest map grows older");
        assert_eq!(address(&fleet, "van", start + SILENT_MAX).as_deref(), Some("a:1"));
        let late = start + SILENT_MAX + Duration::from_secs(1);
        let shown = &fleet.vehicles(late)[0];
        assert_eq!((&*shown.state, &*shown.reasons[0]), ("error", "its server hq has not announced it for 5 s"));
        assert_eq!(address(&fleet, "van", late), None);
        assert_eq!(fleet.vehicles(start + LISTED_MAX + Duration::from_secs(1)), []);
    }

    #[test]
    fn a_server_that_ends_or_starts_again_leaves_no_vehicle_of_its_last_run() {
        let (fleet, start) = (Fleet::default(), Instant::now());
        let hear = |boot_id, at| _ = fleet.hear(&announcement("van", boot_id, "a:1", 0), at).unwrap();
        let runs = |at| fleet.vehicles(at).iter().map(|vehicle| vehicle.boot_id).collect::<Vec<_>>();
        hear(1, start);
        hear(2, start + SILENT_MAX);
        assert_eq!(runs(start + SILENT_MAX), [1, 2], "two servers that are both heard");
        hear(2, start + 2 * SILENT_MAX);
        assert_eq!(runs(start + 2 * SILENT_MAX), [2]);
        fleet.forget("van", 2);
        assert_eq!(runs(start + 2 * SILENT_MAX), [0_u64; 0]);
    }

    #[test]
    fn two_servers_with_one_vehicle_are_both_listed_and_the_newest_map_leads() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        let hear = |name, boot_id, grpc, newest| {
            _ = fleet.hear(&announcement(name, boot_id, grpc, newest), now).unwrap();
        };
        hear("van", 7, "old:1", 100);
        hear("van", 3, "new:1", 200);
        hear("vans", 4, "other:1", 900);
        assert_eq!(fleet.vehicles(now).len(), 3);
        assert_eq!(address(&fleet, "van", now).as_deref(), Some("new:1"));
        hear("van", 9, "", 300);
        assert_eq!(address(&fleet, "van", now).as_deref(), Some("new:1"), "the newest announces no address");
        hear("van", 5, "forged:1", i64::MAX);
        hear("van", 6, "javascript:alert(1)", 400);
        assert_eq!(address(&fleet, "van", now).as_deref(), Some("new:1"), "a map of the future, and no address");
        assert_eq!(address(&fleet, "bus", now), None);
    }

    #[test]
    fn a_url_that_is_no_page_is_not_passed_on() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        for (page, passed) in [("https://van:8080/", "https://van:8080/"), ("javascript:alert(1)", "")] {
            let vehicle = v1::Vehicle { name: "van".into(), page: page.into(), ..Default::default() };
            fleet.hear(&vehicle.encode_to_vec(), now).unwrap();
            assert_eq!(fleet.vehicles(now)[0].page, passed);
        }
    }

    #[test]
    fn what_is_no_announcement_is_refused() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        let of_empty_sensors = v1::Vehicle { sensors: vec![Default::default(); 32_000], ..Default::default() };
        for announcement in [
            vec![0xff; 9],
            vec![0; ANNOUNCEMENT_BYTES_MAX + 1],
            announcement("", 1, "a:1", 0),
            announcement(&"v".repeat(NAME_BYTES_MAX + 1), 1, "a:1", 0),
            announcement("van\ncar: OK", 1, "a:1", 0),
            announcement("van", 1, "a:1\n", 0),
            v1::Vehicle { name: "van".into(), ..of_empty_sensors }.encode_to_vec(),
        ] {
            assert_eq!(fleet.hear(&announcement, now), Err(AnnouncementRefused::Invalid));
        }
        assert_eq!(fleet.refused(), BTreeMap::from([("invalid", 7)]));
        assert_eq!(fleet.vehicles(now), []);
    }

    #[test]
    fn a_flood_of_vehicles_takes_its_memory_and_keeps_the_vehicles_that_are_known() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        let vehicle = |n: usize| {
            let sensors = vec![v1::SensorState { name: "top".into(), ..Default::default() }; 200];
            v1::Vehicle { name: format!("car-{n}"), sensors, ..Default::default() }.encode_to_vec()
        };
        let taken = (0..4096).take_while(|n| fleet.hear(&vehicle(*n), now).is_ok()).count();
        assert_eq!(fleet.hear(&vehicle(taken), now), Err(AnnouncementRefused::Full));
        let sensors = fleet.vehicles(now).iter().map(|vehicle| vehicle.sensors.len()).sum::<usize>();
        let bytes = sensors * (size_of::<v1::SensorState>() + "top".len());
        assert!((BYTES_MAX / 2..BYTES_MAX).contains(&bytes), "{taken} vehicles of {bytes} bytes");
        assert!(fleet.hear(&vehicle(0), now).is_ok());
    }

    #[test]
    fn a_list_of_all_vehicles_is_a_message_that_a_client_reads() {
        let (fleet, now) = (Fleet::default(), Instant::now());
        let long = |n: usize| v1::Vehicle {
            name: format!("car-{n}"),
            reasons: vec!["r".repeat(60_000)],
            ..Default::default()
        };
        let taken = (0..200).filter(|n| fleet.hear(&long(*n).encode_to_vec(), now).is_ok()).count();
        let listed = v1::ListVehiclesResponse { vehicles: fleet.vehicles(now) };
        assert_eq!((taken, fleet.refused()), (52, BTreeMap::from([("full", 148)])));
        assert!(listed.encoded_len() < 4 << 20, "{} bytes", listed.encoded_len());
    }

    #[tokio::test]
    async fn a_silent_vehicle_is_forgotten_without_a_reader() {
        let fleet = Fleet::default();
        let heard = Instant::now().checked_sub(2 * LISTED_MAX).expect("a host that runs for a minute");
        fleet.hear(&announcement("van", 1, "a:1", 0), heard).unwrap();
        // It begins at once.
        tokio::time::timeout(Duration::ZERO, fleet.clone().forget_silent()).await.unwrap_err();
        assert!(locked(&fleet.0).vehicles.is_empty());
    }
}
