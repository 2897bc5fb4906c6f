//! What the server knows of each vehicle: ledger, rates, latency, readers, recorder. One snapshot, written by the
//! engine, read by gRPC, zenoh, the page, `/metrics` and the command line.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write as _;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_lidar::sensor::SensorStatus;
use clearway_mapping::pipeline::{Ledger, NamedStatus};
use clearway_proto::v1;
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::demand::Demand;
use crate::engine::NewestSweep;
use crate::ingest::{Outside, Stranger, locked, now_ns};
use crate::record::RecorderCounts;
use crate::wire::EncodedMap;

/// Durations kept for the percentiles: seven minutes of a 10 Hz sensor.
const LATENCIES: usize = 4096;
/// Maps over which the rates are measured.
const RATE_MAPS: usize = 16;
/// Without a new map for this long, the rate is nothing.
const RATE_AGE_MAX: Duration = Duration::from_secs(2);

/// One vehicle's status, shared by everybody who shows it.
#[derive(Debug)]
pub struct VehicleStatus {
    /// The vehicle's name.
    pub name: Arc<str>,
    /// Names this run of the server.
    pub boot_id: u64,
    /// The layers of its maps, in order.
    pub layers: Vec<&'static str>,
    /// Which of the layers somebody takes.
    pub demand: Demand,
    /// Where the newest map's points go while somebody takes them.
    pub sweeps: watch::Sender<NewestSweep>,
    /// Readers over gRPC.
    pub grpc_readers: Arc<AtomicU32>,
    /// Open pages.
    pub page_readers: Arc<AtomicU32>,
    outside: Arc<Outside>,
    recorder: Option<Arc<RecorderCounts>>,
    engine_stopped: AtomicBool,
    inside: Mutex<Inside>,
}

#[derive(Debug, Default)]
struct Inside {
    ledger: Ledger,
    sensors: Vec<NamedStatus>,
    states: Vec<v1::SensorState>,
    maps: u64,
    newest_capture_end_ns: i64,
    drivable_share: Option<f64>,
    /// Step and encode of each map, ns.
    latencies_ns: VecDeque<u64>,
    /// When each of the newest maps was published, and the datagrams received until then.
    paces: VecDeque<(Instant, u64)>,
}

/// One reader of a vehicle's maps; counted while it lives.
#[derive(Debug)]
pub struct Reader(Arc<AtomicU32>);

impl Reader {
    /// Counts one more.
    pub fn new(readers: &Arc<AtomicU32>) -> Self {
        readers.fetch_add(1, Ordering::Relaxed);
        Self(readers.clone())
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// A vehicle's status at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// What came of everything that arrived: the core's ledger, with what the door turned away.
    pub ledger: Ledger,
    /// The sensors and what they have shown.
    pub sensors: Vec<NamedStatus>,
    /// What the ledger calls `observation`, by its own name, since the server's start.
    pub observations_refused: BTreeMap<&'static str, u64>,
    /// Maps made.
    pub maps: u64,
    /// Of the newest map; 0 before the first.
    pub newest_capture_end_ns: i64,
    /// Of the newest map, while somebody takes that layer.
    pub drivable_share: Option<f64>,
    /// Step and encode a map, median; `None` before the first map.
    pub latency_ms_p50: Option<f64>,
    /// Step and encode a map, 99th percentile.
    pub latency_ms_p99: Option<f64>,
    /// Maps a second over the newest ones.
    pub maps_hz: f64,
    /// Datagrams a second over the newest maps.
    pub packets_hz: f64,
}

impl Snapshot {
    /// Revolutions of all sensors.
    pub fn revolutions(&self) -> u64 {
        self.sensors.iter().map(|sensor| sensor.status.revolutions).sum()
    }

    /// What came of everything but telemetry: received = decoded + the sum of refused.
    pub fn packets_json(&self) -> Value {
        let Ledger { received, telemetry, decoded, refused, .. } = &self.ledger;
        json!({ "received": received - telemetry, "decoded": decoded, "refused": refused })
    }

    /// Datagrams refused, for any reason.
    pub fn refused(&self) -> u64 {
        self.ledger.refused.values().sum()
    }
}

impl VehicleStatus {
    /// The status of a vehicle that has seen nothing.
    pub fn new(
        name: Arc<str>,
        boot_id: u64,
        layers: Vec<&'static str>,
        outside: Arc<Outside>,
        recorder: Option<Arc<RecorderCounts>>,
    ) -> Self {
        Self {
            name,
            boot_id,
            demand: Demand::new(&layers),
            sweeps: watch::Sender::new(None),
            layers,
            grpc_readers: Arc::default(),
            page_readers: Arc::default(),
            outside,
            recorder,
            engine_stopped: AtomicBool::new(false),
            inside: Mutex::default(),
        }
    }

    /// Whether the vehicle's engine still takes events.
    pub fn is_alive(&self) -> bool {
        !self.engine_stopped.load(Ordering::Acquire)
    }

    pub(crate) fn engine_stopped(&self) {
        self.engine_stopped.store(true, Ordering::Release);
    }

    pub(crate) fn stepped(&self, ledger: &Ledger, sensors: Vec<NamedStatus>) {
        let mut inside = locked(&self.inside);
        inside.ledger.clone_from(ledger);
        inside.sensors = sensors;
    }

    pub(crate) fn mapped(&self, map: &EncodedMap, states: Vec<v1::SensorState>, latency: Duration) {
        let mut inside = locked(&self.inside);
        inside.states = states;
        inside.maps += 1;
        inside.newest_capture_end_ns = map.capture_end_ns;
        inside.drivable_share = map.drivable_share;
        if inside.latencies_ns.len() == LATENCIES {
            inside.latencies_ns.pop_front();
        }
        inside.latencies_ns.push_back(u64::try_from(latency.as_nanos()).unwrap_or(u64::MAX));
        if inside.paces.len() == RATE_MAPS {
            inside.paces.pop_front();
        }
        let received = inside.ledger.received;
        inside.paces.push_back((Instant::now(), received));
    }

    /// The status now.
    pub fn snapshot(&self) -> Snapshot {
        let inside = locked(&self.inside);
        let mut ledger = inside.ledger.clone();
        let mut sensors = inside.sensors.clone();
        self.outside.add_to(&mut ledger, sensors.iter_mut().map(|sensor| &mut sensor.ledger));
        let mut latencies: Vec<u64> = inside.latencies_ns.iter().copied().collect();
        latencies.sort_unstable();
        let (maps_hz, packets_hz) = rates(&inside.paces);
        Snapshot {
            ledger,
            sensors,
            observations_refused: self.outside.observations_refused(),
            maps: inside.maps,
            newest_capture_end_ns: inside.newest_capture_end_ns,
            drivable_share: inside.drivable_share,
            latency_ms_p50: percentile_ms(&latencies, 50),
            latency_ms_p99: percentile_ms(&latencies, 99),
            maps_hz,
            packets_hz,
        }
    }

    /// The status as the wire carries it.
    pub fn to_proto(&self) -> v1::Vehicle {
        let snapshot = self.snapshot();
        let readers = [("grpc", &self.grpc_readers), ("page", &self.page_readers)];
        v1::Vehicle {
            name: self.name.to_string(),
            boot_id: self.boot_id,
            layers: self.layers.iter().map(|&layer| layer.to_owned()).collect(),
            maps: snapshot.maps,
            newest_capture_end_ns: snapshot.newest_capture_end_ns,
            sensors: locked(&self.inside).states.clone(),
            ledger: Some(ledger(&snapshot.ledger)),
            sensor_ledgers: snapshot.sensors.iter().map(|s| (s.name.clone(), ledger(&s.ledger))).collect(),
            recorder: Some(self.recorder.as_ref().map(|counts| counts.to_proto()).unwrap_or_default()),
            readers: readers
                .map(|(name, count)| (name.to_owned(), count.load(Ordering::Relaxed)))
                .into_iter()
                .collect(),
            strangers: self.outside.strangers().iter().map(stranger).collect(),
            observations_refused: by_name(&snapshot.observations_refused),
        }
    }

    /// The status as JSON: what [`VehicleStatus::to_proto`] has, and rates, latency and age. 64-bit numbers that a
    /// browser's doubles cannot hold (boot id, stamps) are strings.
    pub fn to_json(&self) -> Value {
        let proto = self.to_proto();
        let snapshot = self.snapshot();
        let (ledger, recorder) = (proto.ledger.unwrap_or_default(), proto.recorder.unwrap_or_default());
        let ledger_json = self::ledger_json(&ledger);
        let sensors = proto.sensors.iter().map(|s| {
            json!({
                "name": s.name, "model": s.model, "packets": s.packets, "packets_expected": s.packets_expected,
                "refused": s.refused, "returns": s.returns,
                "rpm": s.rpm, "completeness": s.completeness, "partial": s.partial,
                "blocked_deg": s.blocked_sectors.iter().map(|b| [b.from_deg, b.to_deg]).collect::<Vec<_>>(),
                "blocked_lasers": s.blocked_lasers,
                "clock": s.clock, "clock_offset_ms": s.clock_offset_ms,
                "state": s.state, "age_ms": s.age_ms,
                "ledger": proto.sensor_ledgers.get(&s.name).map(self::ledger_json),
            })
        });
        json!({
            "name": proto.name,
            "boot_id": proto.boot_id.to_string(),
            "layers": proto.layers,
            "maps": proto.maps,
            "newest_capture_end_ns": proto.newest_capture_end_ns.to_string(),
            "now_ns": now_ns().to_string(),
            "drivable_share": snapshot.drivable_share,
            "sensors": sensors.collect::<Vec<_>>(),
            "ledger": ledger_json,
            "observations_refused": proto.observations_refused,
            "recorder": {
                "file": recorder.file, "events": recorder.events, "maps": recorder.maps, "lost": recorder.lost,
                "stopped": self.recorder.as_ref().and_then(|counts| counts.stopped()),
            },
            "readers": proto.readers,
            "strangers": proto.strangers.iter().map(|s| {
                json!({ "address": s.address, "datagrams": s.datagrams, "newest_ns": s.newest_ns.to_string() })
            }).collect::<Vec<_>>(),
            "rates": { "maps_hz": snapshot.maps_hz, "packets_hz": snapshot.packets_hz },
            "latency_ms": { "p50": snapshot.latency_ms_p50, "p99": snapshot.latency_ms_p99 },
            "alive": self.is_alive(),
        })
    }
}

fn stranger(stranger: &Stranger) -> v1::Stranger {
    let Stranger { address, datagrams, newest_ns } = *stranger;
    v1::Stranger { address: address.to_string(), datagrams, newest_ns }
}

fn ledger_json(ledger: &v1::Ledger) -> Value {
    json!({
        "received": ledger.received, "decoded": ledger.decoded, "telemetry": ledger.telemetry,
        "refused": ledger.refused, "lost": ledger.lost, "kernel_drops": ledger.kernel_drops, "points_dropped": ledger.points_dropped,
        "own_body": ledger.own_body, "through_body": ledger.through_body, "blind": ledger.blind,
        "poses": ledger.poses, "poses_refused": ledger.poses_refused,
        "roads": ledger.roads, "roads_refused": ledger.roads_refused,
    })
}

fn ledger(ledger: &Ledger) -> v1::Ledger {
    v1::Ledger {
        received: ledger.received,
        decoded: ledger.decoded,
        telemetry: ledger.telemetry,
        refused: by_name(&ledger.refused),
        lost: ledger.lost,
        kernel_drops: ledger.kernel_drops,
        points_dropped: ledger.points_dropped,
        own_body: ledger.own_body,
        through_body: ledger.through_body,
        blind: ledger.blind,
        poses: ledger.poses,
        poses_refused: ledger.poses_refused,
        roads: ledger.roads,
        roads_refused: by_name(&ledger.roads_refused),
    }
}

fn by_name(counts: &BTreeMap<&'static str, u64>) -> BTreeMap<String, u64> {
    counts.iter().map(|(&reason, &n)| (reason.to_owned(), n)).collect()
}

/// Maps and datagrams a second.
fn rates(paces: &VecDeque<(Instant, u64)>) -> (f64, f64) {
    let (Some((first, before)), Some((last, after))) = (paces.front(), paces.back()) else { return (0.0, 0.0) };
    let seconds = (*last - *first).as_secs_f64();
    if paces.len() < 2 || seconds <= 0.0 || last.elapsed() > RATE_AGE_MAX {
        return (0.0, 0.0);
    }
    ((paces.len() - 1) as f64 / seconds, (after - before) as f64 / seconds)
}

/// Nearest-rank percentile of ascending durations.
fn percentile_ms(ascending_ns: &[u64], percent: usize) -> Option<f64> {
    let rank = (ascending_ns.len() * percent).div_ceil(100).max(1);
    ascending_ns.get(rank - 1).map(|&ns| ns as f64 / 1e6)
}

fn labels(vehicle: &str, sensor: &str) -> String {
    format!("vehicle=\"{vehicle}\",sensor=\"{sensor}\"")
}

/// The status of all vehicles in Prometheus' text format.
pub fn prometheus(vehicles: &[Arc<VehicleStatus>]) -> String {
    let mut text = String::new();
    let all: Vec<_> = vehicles.iter().map(|v| (v, v.snapshot(), v.to_proto())).collect();
    let mut family = |name: &str, kind: &str, help: &str, samples: &[(String, f64)]| {
        if samples.is_empty() {
            return;
        }
        // Writing to a string cannot fail.
        let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(text, "{name}{{{labels}}} {value}");
        }
    };
    let each = |value: &dyn Fn(&Snapshot, &v1::Vehicle) -> f64| -> Vec<(String, f64)> {
        all.iter().map(|(v, s, p)| (format!("vehicle=\"{}\"", v.name), value(s, p))).collect()
    };
    let received = each(&|s, _| s.ledger.received as f64);
    family("clearway_packets_received_total", "counter", "Datagrams and scans received.", &received);
    let decoded = each(&|s, _| s.ledger.decoded as f64);
    family("clearway_packets_decoded_total", "counter", "Data packets and scans decoded.", &decoded);
    let telemetry = each(&|s, _| s.ledger.telemetry as f64);
    family("clearway_telemetry_total", "counter", "Telemetry datagrams read.", &telemetry);
    let refused: Vec<_> = all
        .iter()
        .flat_map(|(v, s, _)| s.ledger.refused.iter().map(move |(r, n)| (v.name.clone(), r, *n as f64)))
        .map(|(vehicle, reason, n)| (format!("vehicle=\"{vehicle}\",reason=\"{reason}\""), n))
        .collect();
    family("clearway_packets_refused_total", "counter", "Datagrams and scans refused, by reason.", &refused);
    let refused: Vec<_> = all
        .iter()
        .flat_map(|(v, s, _)| s.observations_refused.iter().map(move |(r, n)| (v.name.clone(), r, *n as f64)))
        .map(|(vehicle, reason, n)| (format!("vehicle=\"{vehicle}\",reason=\"{reason}\""), n))
        .collect();
    let help = "Messages that are no observations, which the ledger calls observation, by their own reason.";
    family("clearway_observations_refused_total", "counter", help, &refused);
    let lost = each(&|s, _| s.ledger.lost as f64);
    family("clearway_events_lost_total", "counter", "Readings that found the door's queue full.", &lost);
    let of_sensors = |value: &dyn Fn(&SensorStatus) -> f64| -> Vec<(String, f64)> {
        let labels = |vehicle: &str, sensor: &str| format!("vehicle=\"{vehicle}\",sensor=\"{sensor}\"");
        let of = |(v, s, _): &(&Arc<VehicleStatus>, Snapshot, v1::Vehicle)| -> Vec<(String, f64)> {
            s.sensors.iter().map(|sensor| (labels(&v.name, &sensor.name), value(&sensor.status))).collect()
        };
        all.iter().flat_map(of).collect()
    };
    let missing = of_sensors(&|status| status.packets_lost as f64);
    let help = "Data packets that never came, by device time and azimuth, +-1 a gap.";
    family("clearway_packets_missing_total", "counter", help, &missing);
    let blocked = of_sensors(&|status| {
        status.blocked.sectors.iter().map(|sector| f64::from(sector.to_deg - sector.from_deg)).sum()
    });
    family("clearway_blocked_degrees", "gauge", "Degrees in which a sensor used to see and does no more.", &blocked);
    let drops = each(&|s, _| s.ledger.kernel_drops as f64);
    family("clearway_kernel_drops_total", "counter", "Datagrams the kernel dropped at the vehicle's sockets.", &drops);
    let of_sensors = |value: &dyn Fn(&Ledger) -> u64| -> Vec<(String, f64)> {
        let sensors = all.iter().flat_map(|(v, s, _)| s.sensors.iter().map(move |sensor| (v, sensor)));
        sensors.map(|(v, s)| (labels(&v.name, &s.name), value(&s.ledger) as f64)).collect()
    };
    let received = of_sensors(&|ledger| ledger.received);
    family("clearway_sensor_received_total", "counter", "Datagrams and scans received from a sensor.", &received);
    let decoded = of_sensors(&|ledger| ledger.decoded);
    family("clearway_sensor_decoded_total", "counter", "A sensor's data packets and scans decoded.", &decoded);
    let telemetry = of_sensors(&|ledger| ledger.telemetry);
    family("clearway_sensor_telemetry_total", "counter", "A sensor's telemetry datagrams read.", &telemetry);
    let lost = of_sensors(&|ledger| ledger.lost);
    family("clearway_sensor_lost_total", "counter", "A sensor's readings that found the queue full.", &lost);
    let refused: Vec<_> = all
        .iter()
        .flat_map(|(v, s, _)| s.sensors.iter().map(move |sensor| (v, sensor)))
        .flat_map(|(v, s)| {
            s.ledger.refused.iter().map(move |(reason, n)| (labels(&v.name, &s.name), reason, *n as f64))
        })
        .map(|(labels, reason, n)| (format!("{labels},reason=\"{reason}\""), n))
        .collect();
    family("clearway_sensor_refused_total", "counter", "A sensor's datagrams and scans refused, by reason.", &refused);
    let poses = each(&|s, _| s.ledger.poses as f64);
    family("clearway_poses_total", "counter", "Ego poses taken.", &poses);
    let poses = each(&|s, _| s.ledger.poses_refused as f64);
    family("clearway_poses_refused_total", "counter", "Ego poses refused.", &poses);
    let roads = each(&|s, _| s.ledger.roads as f64);
    family("clearway_roads_total", "counter", "Roads taken.", &roads);
    let roads = each(&|s, _| s.ledger.roads_refused.values().sum::<u64>() as f64);
    family("clearway_roads_refused_total", "counter", "Roads refused.", &roads);
    let maps = each(&|_, p| p.maps as f64);
    family("clearway_maps_total", "counter", "Maps made.", &maps);
    let revolutions = each(&|s, _| s.revolutions() as f64);
    family("clearway_revolutions_total", "counter", "Revolutions completed.", &revolutions);
    let now = now_ns();
    let ages: Vec<_> = all
        .iter()
        .filter(|(_, _, p)| p.maps > 0)
        .map(|(v, s, _)| (format!("vehicle=\"{}\"", v.name), (now - s.newest_capture_end_ns) as f64 / 1e9))
        .collect();
    family("clearway_map_age_seconds", "gauge", "Age of the newest map, from its capture's end.", &ages);
    let latencies: Vec<_> = all
        .iter()
        .flat_map(|(v, s, _)| [(v, "0.5", s.latency_ms_p50), (v, "0.99", s.latency_ms_p99)])
        .filter_map(|(v, q, ms)| ms.map(|ms| (format!("vehicle=\"{}\",quantile=\"{q}\"", v.name), ms / 1e3)))
        .collect();
    family("clearway_map_latency_seconds", "gauge", "Step and encode of a map.", &latencies);
    let readers: Vec<_> = all
        .iter()
        .flat_map(|(v, _, p)| p.readers.iter().map(move |(t, n)| (v.name.clone(), t, f64::from(*n))))
        .map(|(vehicle, transport, n)| (format!("vehicle=\"{vehicle}\",transport=\"{transport}\""), n))
        .collect();
    family("clearway_readers", "gauge", "Readers of the vehicle's maps.", &readers);
    let recorder_lost = each(&|_, p| p.recorder.as_ref().map_or(0, |r| r.lost) as f64);
    family("clearway_recorder_lost_total", "counter", "Events and maps the recording does not hold.", &recorder_lost);
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_ranks() {
        let ns: Vec<u64> = (1..=100).map(|ms| ms * 1_000_000).collect();
        assert_eq!(percentile_ms(&ns, 50), Some(50.0));
        assert_eq!(percentile_ms(&ns, 99), Some(99.0));
        assert_eq!(percentile_ms(&ns[..1], 50), Some(1.0));
        assert_eq!(percentile_ms(&[], 50), None);
    }

    #[test]
    fn what_the_door_turned_away_is_in_the_ledger_and_the_ledger_adds_up() {
        let (door, _events) = crate::ingest::door(4);
        door.refuse_stranger(([10, 0, 0, 9], 2368).into());
        door.refuse_stranger(([10, 0, 0, 9], 2368).into());
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.outside(), None);
        let ledger = Ledger { received: 3, decoded: 2, telemetry: 1, ..Ledger::default() };
        status.stepped(&ledger, Vec::new());
        let shown = status.snapshot().ledger;
        assert_eq!(shown.refused["source"], 2);
        assert_eq!(shown.received, shown.decoded + shown.telemetry + shown.refused.values().sum::<u64>());
        let text = prometheus(&[Arc::new(status)]);
        assert!(text.contains("clearway_packets_received_total{vehicle=\"car\"} 5\n"), "{text}");
        assert!(text.contains("clearway_packets_refused_total{vehicle=\"car\",reason=\"source\"} 2\n"), "{text}");
    }

    #[test]
    fn a_reader_counts_while_it_lives() {
        let readers = Arc::new(AtomicU32::new(0));
        let reader = Reader::new(&readers);
        assert_eq!(readers.load(Ordering::Relaxed), 1);
        drop(reader);
        assert_eq!(readers.load(Ordering::Relaxed), 0);
    }
}
