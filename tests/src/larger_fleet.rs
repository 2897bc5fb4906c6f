//! What a fleet needs that no single machine can hold, by the constants of the growth model.
//!
//! A server on each vehicle, a client of one router; planners, each a client of one router, that read some layers of
//! one vehicle at the rate of its maps; each two routers joined, so that a map crosses to each other router with a
//! reader of it once. The routers are as many as one limit of [`Fleet`] asks for.

use crate::growth::{MAPS_HZ, Model, PROBES};

/// A fleet, and what one router may be given.
#[derive(Clone, Copy, Debug)]
pub struct Fleet {
    /// Number of vehicles, each with a server of its own.
    pub vehicles: f64,
    /// Number of planners.
    pub planners: f64,
    /// Layers that a planner reads.
    pub layers: f64,
    /// Servers that list the vehicles of all (`zenoh.fleet.list`).
    pub listing: f64,
    /// A map of one layer, in bytes.
    pub map_bytes: f64,
    /// An announcement of a vehicle, in bytes.
    pub announcement_bytes: f64,
    /// Sessions that a router may be given.
    pub sessions_max: f64,
    /// Cores that a router may be given.
    pub cores_max: f64,
    /// Bits that a router may send in a second.
    pub bits_max: f64,
}

/// Sessions of the router of `deploy/` (`max_sessions`).
const SESSIONS: f64 = 1024.0;
/// Share of a limit that is planned with.
const FILL: f64 = 0.8;
/// Headers of zenoh, TCP, IP and Ethernet of a message, in bytes.
const HEADER_BYTES: f64 = 150.0;
/// A recording of an hour with all packets and layers of an HDL-64E, in GB (BENCHMARKS.md, "Recordings").
const RECORDING_GB: f64 = 10.6;

impl Default for Fleet {
    /// 1,000 vehicles, 10,000 planners with two layers each, ten servers that list all; routers with four cores and
    /// links of 1 Gbit/s. A map has the mean size of `drivability` and `speed` on recorded drives of an HDL-64E
    /// (BENCHMARKS.md, "Agreement"): those of the simulated town are smaller.
    fn default() -> Self {
        Self {
            vehicles: 1000.0,
            planners: 10_000.0,
            layers: 2.0,
            listing: 10.0,
            map_bytes: 4800.0,
            announcement_bytes: 500.0,
            sessions_max: FILL * SESSIONS,
            cores_max: FILL * 4.0,
            bits_max: FILL * 1e9,
        }
    }
}

/// What each router of a fleet is given.
#[derive(Clone, Copy, Debug)]
pub struct PerRouter {
    /// Sessions with planners, servers and other routers.
    pub sessions: f64,
    /// Messages received and sent in a second.
    pub messages: [f64; 2],
    /// Processors that it keeps busy.
    pub cores: f64,
    /// Bits that it sends in a second.
    pub bits: f64,
    /// Maps that come from other routers in a second.
    pub crossing: f64,
}

impl Fleet {
    /// What each of so many routers is given. A vehicle's readers are at any router, or all at the vehicle's own.
    pub fn at(&self, routers: f64, is_anywhere: bool, model: &Model) -> PerRouter {
        // Routers, other than the vehicle's own, at which at least one of its readers is.
        let readers = self.planners / self.vehicles;
        let others = if is_anywhere { (routers - 1.0) * (1.0 - (1.0 - 1.0 / routers).powf(readers)) } else { 0.0 };
        let maps_hz = self.vehicles * self.layers * (MAPS_HZ + 1.0);
        let crossing = maps_hz * others;
        let delivered = self.planners * self.layers * (MAPS_HZ + 1.0);
        // Announcements cross to each router with a server that lists.
        let listing_routers = self.listing.min(routers);
        let announced = self.vehicles * self.listing;
        let announced_across = self.vehicles * (listing_routers - 1.0).max(0.0);
        // Probes of the link, and their answers.
        let probes = self.vehicles * PROBES * MAPS_HZ;
        let received = maps_hz + crossing + self.vehicles + announced_across + probes;
        let sent = delivered + crossing + announced + announced_across + probes;
        // Of eleven messages of a layer ten are maps.
        let maps_sent = (delivered + crossing) * MAPS_HZ / (MAPS_HZ + 1.0);
        let announcements_sent = announced + announced_across;
        let bytes = sent * HEADER_BYTES + maps_sent * self.map_bytes + announcements_sent * self.announcement_bytes;
        let sessions = (self.planners + self.vehicles) / routers + routers - 1.0;
        let cores =
            model.constant(1, 0) * sessions + (model.constant(1, 1) * received + model.constant(1, 2) * sent) / routers;
        let messages = [received / routers, sent / routers];
        PerRouter { sessions, messages, cores, bits: 8.0 * bytes / routers, crossing: crossing / routers }
    }

    /// The shares of what one router may be given: of sessions, cores and bits.
    fn loads(&self, of: &PerRouter) -> [f64; 3] {
        [of.sessions / self.sessions_max, of.cores / self.cores_max, of.bits / self.bits_max]
    }

    /// The least number of routers, and which limit asks for it.
    pub fn routers(&self, is_anywhere: bool, model: &Model) -> Option<(f64, &'static str)> {
        let loads = |routers: usize| self.loads(&self.at(routers as f64, is_anywhere, model));
        let routers = (1..2_000).find(|routers| loads(*routers).iter().all(|load| *load <= 1.0))?;
        // With one router less this was over its limit the most.
        let before = loads(routers.max(2) - 1);
        let most = (0..3).max_by(|first, second| before[*first].total_cmp(&before[*second]))?;
        Some((routers as f64, ["sessions", "cores", "bits"][most]))
    }

    /// The table of what this fleet needs.
    pub fn rows(&self, model: &Model) -> Vec<(String, String)> {
        let mut rows = Vec::new();
        let mut row = |name: &str, value: String| rows.push((name.to_owned(), value));
        for (where_, is_anywhere) in [("at any router", true), ("at their vehicle's router", false)] {
            let Some((routers, limit)) = self.routers(is_anywhere, model) else { continue };
            let of = self.at(routers, is_anywhere, model);
            row(&format!("planners {where_}: routers, and what asks for them"), format!("{routers}, {limit}"));
            row("links between them", format!("{}", routers * (routers - 1.0) / 2.0));
            row("sessions of a router", format!("{:.0}", of.sessions));
            row("messages into and out of a router, 1/s", format!("{:.0}, {:.0}", of.messages[0], of.messages[1]));
            row("maps from other routers into a router, 1/s", format!("{:.0}", of.crossing));
            row("cores of a router, of all", format!("{:.2}, {:.1}", of.cores, routers * of.cores));
            row("out of a router, Mbit/s", format!("{:.0}", 1e-6 * of.bits));
            row("memory of a router, MiB", format!("{:.0}", model.constant(4, 0) * of.sessions + model.constant(4, 1)));
        }
        let server = model.constant(0, 0) * MAPS_HZ + model.constant(0, 1);
        row("cores of a vehicle's server, of all", format!("{server:.2}, {:.0}", self.vehicles * server));
        row("memory of a vehicle's server, MiB", format!("{:.0}", model.constant(3, 0) + model.constant(3, 1)));
        let uplink = 8e-6 * self.layers * MAPS_HZ * (self.map_bytes + HEADER_BYTES);
        row("from a vehicle to its router, Mbit/s, however many read", format!("{uplink:.2}"));
        let planner = model.constant(2, 0) + model.constant(2, 1) * MAPS_HZ * self.layers;
        row("cores of a planner's reading, of all", format!("{planner:.4}, {:.0}", self.planners * planner));
        let every_server_lists = Self { listing: self.vehicles, ..*self };
        if let Some((routers, limit)) = every_server_lists.routers(true, model) {
            let announced = self.vehicles * (self.vehicles - 1.0);
            row("if every server lists all: announcements, 1/s", format!("{announced:.0}"));
            row("routers then, planners at any, and what asks for them", format!("{routers}, {limit}"));
            // A received announcement is decoded and kept, as a map is.
            row("cores of a server's list, at most", format!("{:.2}", self.vehicles * model.constant(2, 1)));
        }
        row("recordings of all, TB/h; GB/s", {
            let gb = self.vehicles * RECORDING_GB;
            format!("{:.1}; {:.1}", 1e-3 * gb, gb / 3600.0)
        });
        rows
    }

    /// The number of vehicles, with as many planners each as here, at which each limit is met.
    pub fn limits(&self, model: &Model) -> Vec<(String, String)> {
        let readers = self.planners / self.vehicles;
        let with = |vehicles: f64| Self { vehicles, planners: readers * vehicles, ..*self };
        let one_router = |vehicles: f64| with(vehicles).at(1.0, true, model);
        let routers = |fleet: Self| fleet.routers(true, model).map_or(f64::INFINITY, |(routers, _)| routers);
        let is_twice =
            |vehicles: f64| routers(Self { listing: vehicles, ..with(vehicles) }) >= 2.0 * routers(with(vehicles));
        let limits: [(&str, &dyn Fn(f64) -> bool); 5] = [
            ("one router: its 1,024 sessions", &|vehicles| one_router(vehicles).sessions > SESSIONS),
            ("one router: its four cores", &|vehicles| one_router(vehicles).cores > self.cores_max / FILL),
            ("one router: its link of 1 Gbit/s", &|vehicles| one_router(vehicles).bits > self.bits_max / FILL),
            ("every server lists all: announcements ask for as many routers as all else", &is_twice),
            ("joined routers: no number of them suffices", &|vehicles| routers(with(vehicles)).is_infinite()),
        ];
        let shown =
            |(name, is_met): &(&str, &dyn Fn(f64) -> bool)| ((*name).to_owned(), format!("{:.0}", first(is_met)));
        let mut limits: Vec<_> = limits.iter().map(shown).collect();
        limits.push(("a server's list of the vehicles of others".into(), "4096".into()));
        limits
    }
}

/// The least number of vehicles at which a limit is met, which it is then at every larger one; to one in a thousand.
fn first(is_met: impl Fn(f64) -> bool) -> f64 {
    let mut over = 1.0;
    while !is_met(over) && over < 1e7 {
        over *= 2.0;
    }
    let mut under = over / 2.0;
    while over - under > (over * 1e-3).max(1.0) {
        let middle = f64::floor((over + under) / 2.0);
        *(if is_met(middle) { &mut over } else { &mut under }) = middle;
    }
    over
}
