//! What the server knows of each vehicle: ledger, rates, latency, readers, recorder. One snapshot, written by the
//! engine, read by gRPC, zenoh, the page, `/metrics` and the command line.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use clearway_mapping::ledger::Ledger;
use clearway_mapping::pipeline::NamedStatus;
use clearway_proto::v1;
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::subscriptions::LayerSubscriptions;
use crate::newest::NewestSweep;
use crate::clock::now_ns;
use crate::ingest::drops::{DropCounters, UnknownSender};
use crate::sync::locked;
use crate::record::writer::RecorderCounts;
use crate::encode::EncodedMap;

mod prometheus;
mod sensor_json;

pub use prometheus::prometheus;
pub use sensor_json::{ledger_json, sensor_json};

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
    pub subscriptions: LayerSubscriptions,
    /// Where the newest map's points go while somebody takes them.
    pub sweeps: watch::Sender<NewestSweep>,
    /// Readers over gRPC.
    pub grpc_readers: Arc<AtomicU32>,
    /// Open pages.
    pub page_readers: Arc<AtomicU32>,
    drops: Arc<DropCounters>,
    recorder: OnceLock<Arc<RecorderCounts>>,
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
    pub fn new(name: Arc<str>, boot_id: u64, layers: Vec<&'static str>, drops: Arc<DropCounters>) -> Self {
        Self {
            name,
            boot_id,
            subscriptions: LayerSubscriptions::new(&layers),
            sweeps: watch::Sender::new(None),
            layers,
            grpc_readers: Arc::default(),
            page_readers: Arc::default(),
            drops,
            recorder: OnceLock::new(),
            engine_stopped: AtomicBool::new(false),
            inside: Mutex::default(),
        }
    }

    /// From now on shows what the recording holds; the first one's, where there are two.
    pub fn show_recorder(&self, counts: Arc<RecorderCounts>) {
        self.recorder.get_or_init(|| counts);
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
        let mut latencies: Vec<u64> = inside.latencies_ns.iter().copied().collect();
        let (maps_hz, packets_hz) = rates(&inside.paces);
        let mut snapshot = Snapshot {
            ledger: inside.ledger.clone(),
            sensors: inside.sensors.clone(),
            maps: inside.maps,
            newest_capture_end_ns: inside.newest_capture_end_ns,
            drivable_share: inside.drivable_share,
            maps_hz,
            packets_hz,
            ..Snapshot::default()
        };
        let sensors = snapshot.sensors.iter_mut().map(|sensor| &mut sensor.ledger);
        self.drops.add_unreported_to(&mut snapshot.ledger, sensors);
        // The engine waits for this lock: what takes longer comes after it.
        drop(inside);
        snapshot.observations_refused = self.drops.refused_messages();
        latencies.sort_unstable();
        snapshot.latency_ms_p50 = percentile_ms(&latencies, 50);
        snapshot.latency_ms_p99 = percentile_ms(&latencies, 99);
        snapshot
    }

    /// Readers of its maps, by the way they come.
    fn readers(&self) -> [(&'static str, u32); 2] {
        [("grpc", &self.grpc_readers), ("page", &self.page_readers)]
            .map(|(transport, readers)| (transport, readers.load(Ordering::Relaxed)))
    }

    /// The status as the wire carries it.
    pub fn to_proto(&self) -> v1::Vehicle {
        self.proto_of(&self.snapshot())
    }

    fn proto_of(&self, snapshot: &Snapshot) -> v1::Vehicle {
        v1::Vehicle {
            name: self.name.to_string(),
            boot_id: self.boot_id,
            layers: self.layers.iter().map(|&layer| layer.to_owned()).collect(),
            maps: snapshot.maps,
            newest_capture_end_ns: snapshot.newest_capture_end_ns,
            sensors: locked(&self.inside).states.clone(),
            ledger: Some(ledger(&snapshot.ledger)),
            sensor_ledgers: snapshot.sensors.iter().map(|s| (s.name.clone(), ledger(&s.ledger))).collect(),
            recorder: Some(self.recorder.get().map(|counts| counts.to_proto()).unwrap_or_default()),
            readers: self.readers().map(|(transport, readers)| (transport.to_owned(), readers)).into(),
            unknown_senders: self.drops.unknown_senders().iter().map(unknown_sender).collect(),
            observations_refused: by_name(&snapshot.observations_refused),
        }
    }

    /// The status as JSON: what [`VehicleStatus::to_proto`] has, and rates, latency and age. 64-bit numbers that a
    /// browser's doubles cannot hold (boot id, stamps) are strings.
    pub fn to_json(&self) -> Value {
        let snapshot = self.snapshot();
        let proto = self.proto_of(&snapshot);
        let (ledger, recorder) = (proto.ledger.unwrap_or_default(), proto.recorder.unwrap_or_default());
        let sensors = proto.sensors.iter().map(|state| {
            let mut sensor = sensor_json(state);
            sensor["ledger"] = proto.sensor_ledgers.get(&state.name).map(ledger_json).into();
            sensor
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
            "ledger": ledger_json(&ledger),
            "observations_refused": proto.observations_refused,
            "recorder": {
                "file": recorder.file, "events": recorder.events, "maps": recorder.maps, "lost": recorder.lost,
                "stopped": self.recorder.get().and_then(|counts| counts.stop_reason()),
            },
            "readers": proto.readers,
            "unknown_senders": proto.unknown_senders.iter().map(|s| {
                json!({ "address": s.address, "datagrams": s.datagrams, "newest_ns": s.newest_ns.to_string() })
            }).collect::<Vec<_>>(),
            "rates": { "maps_hz": snapshot.maps_hz, "packets_hz": snapshot.packets_hz },
            "latency_ms": { "p50": snapshot.latency_ms_p50, "p99": snapshot.latency_ms_p99 },
            "alive": self.is_alive(),
        })
    }
}

fn unknown_sender(sender: &UnknownSender) -> v1::UnknownSender {
    let UnknownSender { address, datagrams, newest_ns } = *sender;
    v1::UnknownSender { address: address.to_string(), datagrams, newest_ns }
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
        let (door, _events) = crate::ingest::queue::event_queue(4);
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.drops());
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
