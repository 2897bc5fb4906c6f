//! The status of one vehicle: counts, rates, latency, readers, recorder.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use clearway_mapping::config::BodyConfig;
use clearway_mapping::error::EventError;
use clearway_mapping::ledger::Ledger;
use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::vehicle_outline::Outline;
use clearway_proto::v1;
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::ingest::drops::DropCounters;
use crate::ingest::queue::QueueSpace;
use crate::record::writer::RecorderCounts;
use crate::traces::{StageTimes, Traces};
use clearway_journal::encode::EncodedMap;

use super::health::{Health, State};
use super::histogram::Histogram;
use super::history::History;
use super::network::Network;
use super::notices::Notices;
use super::transports::{Readers, Transport};
use super::window::{PacketCounts, Window};

/// Latencies kept for the percentiles: seven minutes of a 10 Hz sensor.
const LATENCIES: usize = 4096;
/// Longest time between two signs of life of an engine that does not hang. Ours: the largest allowed scan takes half a
/// second, and an engine without events polls fifty times a second.
const ENGINE_SILENT_MAX: Duration = Duration::from_secs(2);
/// Most other servers that are remembered, and the longest name of one. Ours: people read them.
pub(super) const CLAIMS_MAX: usize = 8;
pub(super) const SERVER_NAME_MAX: usize = 64;

/// Status of one vehicle, written by its engine and read by every publisher.
#[derive(Debug)]
pub struct VehicleStatus {
    /// Name of the vehicle.
    pub name: Arc<str>,
    /// Identifier of this run of the server.
    pub boot_id: u64,
    /// Names of the layers of its maps, in order.
    pub layers: Vec<&'static str>,
    /// The readers of its maps, by transport.
    pub transports: Arc<Readers>,
    /// Collects the traces of the vehicle's maps.
    pub traces: Traces,
    /// Outline of the vehicle in the ego frame as x0, y0, x1, y1, ..., in metres; empty if none is configured.
    pub(super) outline_m: Vec<f64>,
    pub(super) drops: Arc<DropCounters>,
    pub(super) recorder: OnceLock<Arc<RecorderCounts>>,
    queue: OnceLock<QueueSpace>,
    /// True if the events come from files, so that maps have the stamps of a recording.
    pub(super) is_from_files: AtomicBool,
    /// Other servers that serve a vehicle of this name: their names and their newest signs of life, by boot id.
    pub(super) claims: Mutex<BTreeMap<u64, (String, Instant)>>,
    pub(super) health: Mutex<Health>,
    pub(super) history: Mutex<History>,
    pub(super) health_state: watch::Sender<State>,
    engine_stopped: AtomicBool,
    /// The listeners, the router and the certificates of its server.
    pub network: Network,
    /// Time of the newest sign of life of the engine, in ms after `started`; 0 before the first.
    engine_beat_ms: AtomicU64,
    pub(super) started: Instant,
    pub(super) changing: Mutex<Changing>,
}

/// What the engine changes.
#[derive(Debug, Default)]
pub(super) struct Changing {
    /// The counts, without the values that [`VehicleStatus::snapshot`] computes.
    pub(super) counts: Snapshot,
    /// When something of each sensor arrived and could be read, by name.
    pub(super) seen: BTreeMap<String, Seen>,
    pub(super) pose: Option<v1::VehiclePose>,
    notices: Notices,
    pub(super) states: Vec<v1::SensorState>,
    /// Publication of the newest map, after `started`.
    pub(super) mapped_at: Duration,
    /// Publication of the newest map that was fresh then, after `started`.
    pub(super) fresh_at: Duration,
    pub(super) validity: Duration,
    pub(super) speed_m_s: Option<f64>,
    pub(super) has_recorded_stamps: bool,
    /// Phase of the replay that makes the maps, and since when after `started`; `None` if they are made live.
    pub(super) replay: Option<(v1::ReplayPhase, Duration)>,
    /// What the replay waits for in lockstep; empty: nothing.
    pub(super) replay_awaited: String,
    pub(super) window: Window,
    /// Time to step and encode each of the newest maps, in ns.
    latencies_ns: VecDeque<u64>,
}

/// The newest signs of life of a sensor, after the start of the server.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Seen {
    received: u64,
    read: u64,
    /// Time of the newest packet or scan that arrived.
    pub received_at: Option<Duration>,
    /// Time of the newest packet or scan that could be read.
    pub read_at: Option<Duration>,
}

/// A map that the engine has just made, and what of it the status shows.
pub(crate) struct MadeMap<'a> {
    /// The map, encoded.
    pub encoded: &'a EncodedMap,
    /// State of each sensor when the map was made.
    pub states: Vec<v1::SensorState>,
    /// Time that it took in each stage.
    pub stages: StageTimes,
    /// Age at which the map is stale.
    pub validity: Duration,
    /// Speed of the vehicle.
    pub speed_m_s: Option<f64>,
    /// True if its header has the vehicle's pose.
    pub has_pose: bool,
    /// True if its stamps were moved to the present.
    pub is_shifted: bool,
}

/// Status of a vehicle at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Counts of everything that arrived: the core's ledger, and readings dropped before the event queue.
    pub ledger: Ledger,
    /// The first refusal of an event for each reason, in words.
    pub refusals: BTreeMap<&'static str, String>,
    /// The sensors with their status and counts.
    pub sensors: Vec<NamedStatus>,
    /// Invalid messages since the start of the server, by reason; the ledger counts them as `observation`.
    pub observations_refused: BTreeMap<&'static str, u64>,
    /// Number of maps made.
    pub maps: u64,
    /// Number of them that have the vehicle's pose.
    pub maps_with_pose: u64,
    /// End of the newest map's capture, in ns since the Unix epoch; 0 before the first map.
    pub newest_capture_end_ns: i64,
    /// Drivable share of the newest map, while a reader subscribes to that layer.
    pub drivable_share: Option<f64>,
    /// Median time to step and encode a map; `None` before the first map.
    pub latency_ms_p50: Option<f64>,
    /// 99th percentile of that time.
    pub latency_ms_p99: Option<f64>,
    /// Median time by stage over the maps of the last 10 s.
    pub latency_ms: BTreeMap<&'static str, f64>,
    /// Maps per second over the last 10 s.
    pub map_rate_hz: f64,
    /// Mean size of an encoded map of the last 10 s, in bytes.
    pub map_bytes: f64,
    /// Time of all maps by stage, in the order of [`StageTimes::NAMES`].
    pub stages: [Histogram; StageTimes::NAMES.len()],
    /// Age of the newest map, sampled since the server started.
    pub ages: Histogram,
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
            layers,
            transports: Arc::default(),
            traces: Traces::default(),
            outline_m: Vec::new(),
            drops,
            recorder: OnceLock::new(),
            queue: OnceLock::new(),
            is_from_files: AtomicBool::new(false),
            claims: Mutex::default(),
            health: Mutex::default(),
            history: Mutex::default(),
            health_state: watch::Sender::new(State::default()),
            engine_stopped: AtomicBool::new(false),
            network: Network::default(),
            engine_beat_ms: AtomicU64::new(0),
            started: Instant::now(),
            changing: Mutex::default(),
        }
    }

    /// Adds the outline of the vehicle: the body's, else the reach's.
    pub fn with_outline(self, body: Option<&BodyConfig>, reach: Outline) -> Self {
        let of_body = |body: &BodyConfig| [body.x_m_max, body.y_m_min, body.x_m_min, body.y_m_max];
        let side_m = reach.width_m / 2.0;
        let [front, right, rear, left] = body.map_or([reach.front_m, -side_m, -reach.rear_m, side_m], of_body);
        // The shortest decimal: 0.1 stays 0.1.
        let exact = |m: f32| m.to_string().parse().unwrap_or(f64::from(m));
        Self { outline_m: [front, right, front, left, rear, left, rear, right].map(exact).into(), ..self }
    }

    /// Sends traces of the vehicle's maps to `traces`.
    pub fn with_traces(self, traces: Traces) -> Self {
        Self { traces, ..self }
    }

    /// True if the events come from files.
    pub(crate) fn is_from_files(&self) -> bool {
        self.is_from_files.load(Ordering::Relaxed)
    }

    /// Notes that the events come from files.
    pub(crate) fn set_from_files(&self) {
        self.is_from_files.store(true, Ordering::Relaxed);
    }

    /// Notes a sign of life of another server that serves a vehicle of this name, by the boot id of its run. Anyone may
    /// have sent it: of a few runs, a short printable name is kept.
    pub fn note_claim(&self, id: u64, server: &str) {
        let mut claims = locked(&self.claims);
        if id != self.boot_id && (claims.len() < CLAIMS_MAX || claims.contains_key(&id)) {
            let name = server.chars().filter(|c| !c.is_control()).take(SERVER_NAME_MAX).collect();
            claims.insert(id, (name, Instant::now()));
        }
    }

    /// Adds the space of the vehicle's event queue; a second call changes nothing.
    pub(crate) fn show_queue(&self, space: QueueSpace) {
        self.queue.get_or_init(|| space);
    }

    /// The space of the vehicle's event queue, if it has one.
    pub(super) fn queue(&self) -> Option<&QueueSpace> {
        self.queue.get()
    }

    /// Time since the newest packet or scan of each sensor that could be read, by the sensor's name.
    pub(super) fn packet_ages(&self) -> Vec<(String, Duration)> {
        let (changing, now) = (locked(&self.changing), self.started.elapsed());
        let age = |seen: &Seen| Some(now.saturating_sub(seen.read_at?));
        changing.seen.iter().filter_map(|(name, seen)| Some((name.clone(), age(seen)?))).collect()
    }

    /// Covered share of the revolution of each sensor in the newest map.
    pub(super) fn completeness(&self) -> Vec<(String, f32)> {
        locked(&self.changing).states.iter().map(|state| (state.name.clone(), state.completeness)).collect()
    }

    /// Adds the counts of the vehicle's recorder; a second call changes nothing.
    pub fn show_recorder(&self, counts: Arc<RecorderCounts>) {
        self.recorder.get_or_init(|| counts);
    }

    /// What is wrong with the recording of the vehicle now; `None` if nothing is, or nothing is recorded.
    pub fn recorder_problem(&self) -> Option<String> {
        self.recorder.get().and_then(|counts| counts.problem_of(&self.name))
    }

    /// True if nothing of the vehicle has stopped or hangs.
    pub fn is_alive(&self) -> bool {
        self.fault().is_none()
    }

    /// What has stopped or hangs: the vehicle's engine, a listener, or a thread that reads its sockets; `None` if
    /// nothing has.
    pub fn fault(&self) -> Option<String> {
        if self.engine_stopped.load(Ordering::Acquire) {
            return Some(format!("the engine of vehicle {} has stopped", self.name));
        }
        let beat = Duration::from_millis(self.engine_beat_ms.load(Ordering::Relaxed));
        let silent = self.started.elapsed().saturating_sub(beat);
        if !beat.is_zero() && silent > ENGINE_SILENT_MAX {
            return Some(format!("the engine of vehicle {} has hung for {} s", self.name, silent.as_secs()));
        }
        if let Some(fault) = self.network.listener_fault() {
            return Some(fault);
        }
        let ended = self.drops.ended_inputs();
        (!ended.is_empty()).then(|| format!("vehicle {}: {}", self.name, ended.join("; ")))
    }

    /// Records that the engine is at work, or waits for events.
    pub(crate) fn engine_beats(&self) {
        let ms = u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX);
        self.engine_beat_ms.store(ms.max(1), Ordering::Relaxed);
    }

    /// Records the phase of the replay that makes the maps.
    pub(crate) fn set_replay_phase(&self, phase: v1::ReplayPhase) {
        locked(&self.changing).replay = Some((phase, self.started.elapsed()));
    }

    /// Records what the replay waits for in lockstep; empty: nothing. Its data are expected from then on.
    pub fn set_replay_awaited(&self, awaited: &str) {
        let mut changing = locked(&self.changing);
        awaited.clone_into(&mut changing.replay_awaited);
        changing.replay = changing.replay.map(|(phase, _)| (phase, self.started.elapsed()));
    }

    /// Records that the engine has stopped.
    pub(crate) fn engine_stopped(&self) {
        self.engine_stopped.store(true, Ordering::Release);
    }

    /// Records the counts after a step of the engine, and the newest pose.
    pub(crate) fn stepped(&self, ledger: &Ledger, sensors: Vec<NamedStatus>, pose: Option<v1::VehiclePose>) {
        let mut state = locked(&self.changing);
        let now = self.started.elapsed();
        state.counts.ledger.clone_from(ledger);
        state.notices.update(&self.name, &sensors);
        for NamedStatus { name, ledger, .. } in &sensors {
            let (received, read) = (ledger.received, ledger.decoded + ledger.telemetry);
            let seen = state.seen.entry(name.clone()).or_default();
            if seen.received != received {
                seen.received_at = Some(now);
            }
            if seen.read != read {
                seen.read_at = Some(now);
            }
            (seen.received, seen.read) = (received, read);
        }
        (state.counts.sensors, state.pose) = (sensors, pose);
    }

    /// Keeps the words of a refusal, if it is the first for its reason.
    pub(crate) fn note_refusal(&self, error: &EventError) {
        locked(&self.changing).counts.refusals.entry(error.reason()).or_insert_with(|| error.to_string());
    }

    /// Records a new map and the time it took.
    pub(crate) fn mapped(&self, made: MadeMap<'_>) {
        let MadeMap { encoded: map, states, stages, validity, speed_m_s, has_pose, is_shifted } = made;
        self.traces.published(map, stages);
        let mut state = locked(&self.changing);
        state.states = states;
        // A jump of a replay sets the number back.
        state.counts.maps = map.sequence + 1;
        let with_pose = state.counts.maps_with_pose + u64::from(has_pose);
        state.counts.maps_with_pose = with_pose.min(state.counts.maps);
        state.counts.newest_capture_end_ns = map.capture_end_ns;
        state.counts.drivable_share = map.drivable_share;
        let at = self.started.elapsed();
        (state.mapped_at, state.validity, state.speed_m_s) = (at, validity, speed_m_s);
        state.has_recorded_stamps = !is_shifted && self.is_from_files.load(Ordering::Relaxed);
        let age = Duration::from_nanos(now_ns().abs_diff(map.capture_end_ns));
        state.fresh_at = if state.has_recorded_stamps || age <= validity { at } else { state.fresh_at };
        state.window.push_map(at, stages, map.bytes());
        for (histogram, time) in state.counts.stages.iter_mut().zip(stages.in_order()) {
            time.into_iter().for_each(|time| histogram.observe(time));
        }
        let latency = stages.map.unwrap_or_default() + stages.encode.unwrap_or_default();
        if state.latencies_ns.len() == LATENCIES {
            state.latencies_ns.pop_front();
        }
        state.latencies_ns.push_back(u64::try_from(latency.as_nanos()).unwrap_or(u64::MAX));
    }

    /// A copy of the current status, with the rates and latencies of the newest maps.
    pub fn snapshot(&self) -> Snapshot {
        let state = locked(&self.changing);
        let mut latencies: Vec<u64> = state.latencies_ns.iter().copied().collect();
        let now = self.started.elapsed();
        let mut snapshot = Snapshot {
            latency_ms: state.window.latency_ms(now),
            map_rate_hz: state.window.map_rate_hz(now),
            map_bytes: state.window.map_bytes(now),
            ..state.counts.clone()
        };
        let sensors = snapshot.sensors.iter_mut().map(|sensor| (sensor.source, &mut sensor.ledger));
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
    pub fn readers(&self) -> [(&'static str, u32); Transport::ALL.len()] {
        Transport::ALL.map(|transport| (transport.as_str(), self.transports.count(transport)))
    }

    /// Number of readers of its maps over all transports.
    pub fn readers_sum(&self) -> u32 {
        self.readers().iter().map(|(_, readers)| readers).sum()
    }
}

/// The counts of packets from which the loss is computed, with the ledgers of the sensors: packets of unknown senders
/// and copies of packets are not expected.
pub(super) fn packet_counts(sensors: &[NamedStatus]) -> PacketCounts {
    let sum = |count: fn(&NamedStatus) -> u64| sensors.iter().map(count).sum();
    PacketCounts {
        read: sum(|sensor| sensor.ledger.decoded),
        missing: sum(|sensor| sensor.status.packets_lost),
        dropped: sum(|sensor| sensor.ledger.refused_sum() + sensor.ledger.lost + sensor.ledger.kernel_drops),
    }
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
}
