//! The status of one vehicle: counts, rates, latency, readers, recorder.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use clearway_mapping::ledger::Ledger;
use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::check::MountDeviation;
use clearway_proto::v1;
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::acknowledgements::Acknowledgements;
use crate::clock::now_ns;
use crate::encode::EncodedMap;
use crate::ingest::drops::{DropCounters, UnknownSender};
use crate::newest::NewestSweep;
use crate::record::writer::RecorderCounts;
use crate::subscriptions::LayerSubscriptions;
use crate::sync::locked;

use super::json::vehicle_json;
use super::notices::Notices;

/// Latencies kept for the percentiles: seven minutes of a 10 Hz sensor.
const LATENCIES: usize = 4096;
/// Maps over which the rates are measured.
const RATE_MAPS: usize = 16;
/// Longest time between two signs of life of an engine that does not hang. Ours: the largest allowed scan takes half a
/// second, and an engine without events polls fifty times a second.
const ENGINE_SILENT_MAX: Duration = Duration::from_secs(2);
/// Time without a new map after which the rates are 0.
const RATE_AGE_MAX: Duration = Duration::from_secs(2);

/// Status of one vehicle, written by its engine and read by every publisher.
#[derive(Debug)]
pub struct VehicleStatus {
    /// Name of the vehicle.
    pub name: Arc<str>,
    /// Identifier of this run of the server.
    pub boot_id: u64,
    /// Names of the layers of its maps, in order.
    pub layers: Vec<&'static str>,
    /// Subscriptions of readers to the layers.
    pub subscriptions: LayerSubscriptions,
    /// The newest map that each acknowledging reader has finished with.
    pub acknowledgements: Acknowledgements,
    /// The points of the newest map, while a reader subscribes to them.
    pub sweeps: watch::Sender<NewestSweep>,
    /// Number of readers over gRPC.
    pub grpc_readers: Arc<AtomicU32>,
    /// Number of open pages.
    pub page_readers: Arc<AtomicU32>,
    /// Number of keys of zenoh and topics of ROS 2 with a subscriber.
    pub zenoh_readers: Arc<AtomicU32>,
    /// Number of subscriptions of Foxglove's clients.
    pub foxglove_readers: Arc<AtomicU32>,
    /// True while a replay stands at its end.
    pub replay_ended: watch::Sender<bool>,
    drops: Arc<DropCounters>,
    pub(super) recorder: OnceLock<Arc<RecorderCounts>>,
    engine_stopped: AtomicBool,
    /// Time of the newest sign of life of the engine, in ms after `started`; 0 before the first.
    engine_beat_ms: AtomicU64,
    started: Instant,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    ledger: Ledger,
    sensors: Vec<NamedStatus>,
    notices: Notices,
    states: Vec<v1::SensorState>,
    maps: u64,
    newest_capture_end_ns: i64,
    drivable_share: Option<f64>,
    /// Time to step and encode each of the newest maps, in ns.
    latencies_ns: VecDeque<u64>,
    /// Publication of each of the newest maps, and the datagrams received until then.
    paces: VecDeque<(Instant, u64)>,
}

/// One reader of a vehicle's maps, counted until it is dropped.
#[derive(Debug)]
pub struct Reader(Arc<AtomicU32>);

impl Reader {
    /// Counts one more reader.
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

/// Status of a vehicle at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Counts of everything that arrived: the core's ledger, and readings dropped before the event queue.
    pub ledger: Ledger,
    /// The sensors with their status and counts.
    pub sensors: Vec<NamedStatus>,
    /// Invalid messages since the start of the server, by reason; the ledger counts them as `observation`.
    pub observations_refused: BTreeMap<&'static str, u64>,
    /// Number of maps made.
    pub maps: u64,
    /// End of the newest map's capture, in ns since the Unix epoch; 0 before the first map.
    pub newest_capture_end_ns: i64,
    /// Drivable share of the newest map, while a reader subscribes to that layer.
    pub drivable_share: Option<f64>,
    /// Median time to step and encode a map; `None` before the first map.
    pub latency_ms_p50: Option<f64>,
    /// 99th percentile of that time.
    pub latency_ms_p99: Option<f64>,
    /// Maps per second, over the newest maps.
    pub maps_hz: f64,
    /// Datagrams per second, over the newest maps.
    pub packets_hz: f64,
}

impl Snapshot {
    /// Number of revolutions of all sensors.
    pub fn revolutions(&self) -> u64 {
        self.sensors.iter().map(|sensor| sensor.status.revolutions).sum()
    }

    /// Name of the reference sensor; `None` before the first event.
    pub fn reference_sensor(&self) -> Option<&str> {
        self.sensors.iter().find(|sensor| sensor.is_reference).map(|sensor| sensor.name.as_str())
    }

    /// Counts without telemetry, as JSON: received = decoded + the sum of refused.
    pub fn packets_json(&self) -> Value {
        let Ledger { received, telemetry, decoded, refused, .. } = &self.ledger;
        json!({ "received": received - telemetry, "decoded": decoded, "refused": refused })
    }

    /// Number of datagrams refused, for any reason.
    pub fn refused(&self) -> u64 {
        self.ledger.refused.values().sum()
    }
}

impl VehicleStatus {
    /// The status of a vehicle before its first event.
    pub fn new(name: Arc<str>, boot_id: u64, layers: Vec<&'static str>, drops: Arc<DropCounters>) -> Self {
        Self {
            name,
            boot_id,
            subscriptions: LayerSubscriptions::new(&layers),
            acknowledgements: Acknowledgements::default(),
            sweeps: watch::Sender::new(None),
            layers,
            grpc_readers: Arc::default(),
            page_readers: Arc::default(),
            zenoh_readers: Arc::default(),
            foxglove_readers: Arc::default(),
            replay_ended: watch::Sender::new(false),
            drops,
            recorder: OnceLock::new(),
            engine_stopped: AtomicBool::new(false),
            engine_beat_ms: AtomicU64::new(0),
            started: Instant::now(),
            state: Mutex::default(),
        }
    }

    /// Adds the counts of the vehicle's recorder; a second call changes nothing.
    pub fn show_recorder(&self, counts: Arc<RecorderCounts>) {
        self.recorder.get_or_init(|| counts);
    }

    /// What is wrong with the recording now; `None` if nothing is, or nothing is recorded.
    pub fn recorder_problem(&self) -> Option<String> {
        self.recorder.get().and_then(|counts| counts.problem())
    }

    /// True if nothing of the vehicle has stopped or hangs.
    pub fn is_alive(&self) -> bool {
        self.fault().is_none()
    }

    /// What of the vehicle has stopped or hangs: its engine, or a thread that reads its sockets; `None` if nothing has.
    pub fn fault(&self) -> Option<String> {
        if self.engine_stopped.load(Ordering::Acquire) {
            return Some(format!("the engine of vehicle {} has stopped", self.name));
        }
        let beat = Duration::from_millis(self.engine_beat_ms.load(Ordering::Relaxed));
        let silent = self.started.elapsed().saturating_sub(beat);
        if !beat.is_zero() && silent > ENGINE_SILENT_MAX {
            return Some(format!("the engine of vehicle {} has hung for {} s", self.name, silent.as_secs()));
        }
        let ended = self.drops.ended_inputs();
        (!ended.is_empty()).then(|| format!("vehicle {}: {}", self.name, ended.join("; ")))
    }

    /// Records that the engine is at work, or waits for events.
    pub(crate) fn engine_beats(&self) {
        let ms = u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.engine_beat_ms.store(ms.max(1), Ordering::Relaxed);
    }

    /// Records that the engine has stopped.
    pub(crate) fn engine_stopped(&self) {
        self.engine_stopped.store(true, Ordering::Release);
    }

    /// Records the counts after a step of the engine.
    pub(crate) fn stepped(&self, ledger: &Ledger, sensors: Vec<NamedStatus>) {
        let mut state = locked(&self.state);
        state.ledger.clone_from(ledger);
        state.notices.update(&self.name, &sensors);
        state.sensors = sensors;
    }

    /// Records a new map and the time it took.
    pub(crate) fn mapped(&self, map: &EncodedMap, states: Vec<v1::SensorState>, latency: Duration) {
        let mut state = locked(&self.state);
        state.states = states;
        // A jump of a replay sets the number back.
        state.maps = map.sequence + 1;
        state.newest_capture_end_ns = map.capture_end_ns;
        state.drivable_share = map.drivable_share;
        if state.latencies_ns.len() == LATENCIES {
            state.latencies_ns.pop_front();
        }
        state.latencies_ns.push_back(u64::try_from(latency.as_nanos()).unwrap_or(u64::MAX));
        if state.paces.len() == RATE_MAPS {
            state.paces.pop_front();
        }
        let received = state.ledger.received;
        state.paces.push_back((Instant::now(), received));
    }

    /// The current status.
    pub fn snapshot(&self) -> Snapshot {
        let state = locked(&self.state);
        let mut latencies: Vec<u64> = state.latencies_ns.iter().copied().collect();
        let (maps_hz, packets_hz) = rates(&state.paces);
        let mut snapshot = Snapshot {
            ledger: state.ledger.clone(),
            sensors: state.sensors.clone(),
            maps: state.maps,
            newest_capture_end_ns: state.newest_capture_end_ns,
            drivable_share: state.drivable_share,
            maps_hz,
            packets_hz,
            ..Snapshot::default()
        };
        let sensors = snapshot.sensors.iter_mut().map(|sensor| &mut sensor.ledger);
        self.drops.add_unreported_to(&mut snapshot.ledger, sensors);
        // The engine waits for this lock, so slower work follows after it.
        drop(state);
        snapshot.observations_refused = self.drops.refused_messages();
        latencies.sort_unstable();
        snapshot.latency_ms_p50 = percentile_ms(&latencies, 50);
        snapshot.latency_ms_p99 = percentile_ms(&latencies, 99);
        snapshot
    }

    /// Number of readers of its maps, by transport.
    pub fn readers(&self) -> [(&'static str, u32); 4] {
        let (grpc, page) = (&self.grpc_readers, &self.page_readers);
        [("grpc", grpc), ("page", page), ("zenoh", &self.zenoh_readers), ("foxglove", &self.foxglove_readers)]
            .map(|(transport, readers)| (transport, readers.load(Ordering::Relaxed)))
    }

    /// Number of readers of its maps over all transports.
    pub fn readers_sum(&self) -> u32 {
        self.readers().iter().map(|(_, readers)| readers).sum()
    }

    /// The status as a message of the wire.
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
            sensors: locked(&self.state).states.clone(),
            ledger: Some(ledger(&snapshot.ledger)),
            sensor_ledgers: snapshot.sensors.iter().map(|s| (s.name.clone(), ledger(&s.ledger))).collect(),
            recorder: Some(self.recorder.get().map(|counts| counts.to_proto()).unwrap_or_default()),
            readers: self.readers().map(|(transport, readers)| (transport.to_owned(), readers)).into(),
            unknown_senders: self.drops.unknown_senders().iter().map(unknown_sender).collect(),
            observations_refused: by_name(&snapshot.observations_refused),
            reference_sensor: snapshot.reference_sensor().unwrap_or_default().to_owned(),
            fault: self.fault().unwrap_or_default(),
            server: String::new(),
            grpc: String::new(),
            mounts: snapshot.sensors.iter().filter_map(|s| Some((s.name.clone(), mount(&s.mount?)))).collect(),
        }
    }

    /// The status as JSON: the content of [`VehicleStatus::to_proto`], rates, latency and age. 64-bit numbers that a
    /// browser's doubles cannot hold (boot id, stamps) are strings.
    pub fn to_json(&self) -> Value {
        let snapshot = self.snapshot();
        let proto = self.proto_of(&snapshot);
        let unknown_senders = proto.unknown_senders.iter();
        let unknown_senders = unknown_senders.map(|sender| {
            json!({
                "address": sender.address, "datagrams": sender.datagrams, "newest_ns": sender.newest_ns.to_string()
            })
        });
        let mut document = vehicle_json(&proto);
        document["boot_id"] = proto.boot_id.to_string().into();
        document["newest_capture_end_ns"] = proto.newest_capture_end_ns.to_string().into();
        document["now_ns"] = now_ns().to_string().into();
        document["drivable_share"] = snapshot.drivable_share.into();
        document["recorder"]["stopped"] = self.recorder.get().and_then(|counts| counts.stop_reason()).into();
        document["unknown_senders"] = unknown_senders.collect();
        document["rates"] = json!({ "maps_hz": snapshot.maps_hz, "packets_hz": snapshot.packets_hz });
        document["latency_ms"] = json!({ "p50": snapshot.latency_ms_p50, "p99": snapshot.latency_ms_p99 });
        document["alive"] = self.is_alive().into();
        document["fault"] = self.fault().into();
        document
    }
}

fn mount(deviation: &MountDeviation) -> v1::MountDeviation {
    let [height_std_m, pitch_std_rad, roll_std_rad] = deviation.std;
    v1::MountDeviation {
        height_m: deviation.height_m,
        pitch_deg: deviation.pitch_rad.to_degrees(),
        roll_deg: deviation.roll_rad.to_degrees(),
        height_std_m,
        pitch_std_deg: pitch_std_rad.to_degrees(),
        roll_std_deg: roll_std_rad.to_degrees(),
        scans: deviation.scans as u32,
        contradicts: deviation.contradicts,
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

/// Maps and datagrams per second.
fn rates(paces: &VecDeque<(Instant, u64)>) -> (f64, f64) {
    let (Some((first, before)), Some((last, after))) = (paces.front(), paces.back()) else { return (0.0, 0.0) };
    let seconds = (*last - *first).as_secs_f64();
    if paces.len() < 2 || seconds <= 0.0 || last.elapsed() > RATE_AGE_MAX {
        return (0.0, 0.0);
    }
    ((paces.len() - 1) as f64 / seconds, after.saturating_sub(*before) as f64 / seconds)
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
    fn a_reader_is_counted_until_it_is_dropped() {
        let readers = Arc::new(AtomicU32::new(0));
        let reader = Reader::new(&readers);
        assert_eq!(readers.load(Ordering::Relaxed), 1);
        drop(reader);
        assert_eq!(readers.load(Ordering::Relaxed), 0);
    }
}
