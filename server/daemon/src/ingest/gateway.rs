//! The gateway of one vehicle: one observation of a client -> events on the vehicle's queue. gRPC and zenoh both use
//! it.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_mapping::config::{SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Cause, UNKNOWN_SOURCE};
use clearway_proto::v1;
use tokio::sync::watch;

use super::engine_time::{EngineTime, EngineTimes};
use super::observation::{self, Bodies, Limits, ObservationError};
use super::queue::EventQueue;
use super::receipt::{ClientSession, ObservationId, Outcome, OutcomeSender, Receipt};
use super::stream_places::{StreamLimitError, StreamPlace, StreamPlaces};
use crate::base::directory::{UnknownNameError, find_vehicle, shortened};
use crate::base::sync::locked;
use crate::config::Vehicle;
use crate::status::map_time::MapTime;

/// Part of the longest time for a map that the points in the engine's queue may take, beside UDP's. Ours: three scans
/// of an HDL-64E, so that the engine always has one while another is decoded, and a packet of UDP does not wait long.
const QUEUED_PART: u32 = 4;

/// The gateway of one vehicle.
#[derive(Debug)]
pub struct Gateway {
    /// The vehicle's name.
    pub vehicle: Arc<str>,
    /// Limits of one observation.
    pub limits: Limits,
    /// Greatest number of events in flight of one client. All streams together fill half the vehicle's queue; the other
    /// half is for UDP.
    pub in_flight_max: usize,
    sensors: Mutex<Sensors>,
    streams: StreamPlaces,
    /// Number of streams that have been named.
    named_streams: AtomicU64,
    /// The engine's time for the observations.
    pub time: EngineTimes,
    map_time: Arc<MapTime>,
    /// Longest time that a map of scans may take.
    map_time_max: Duration,
    queue: EventQueue,
}

/// The sensors of a vehicle, as the engine will have them after the events pushed so far.
#[derive(Debug)]
struct Sensors {
    /// With the declared sensors.
    config: VehicleConfig,
    /// Number of clients that have declared each declared sensor, by its index. One without a client is withdrawn as
    /// soon as the queue has space.
    clients: BTreeMap<u16, usize>,
    /// Number of points and of rays without a return of each sensor's newest scan, and when it came, ns since the Unix
    /// epoch.
    newest_scans: BTreeMap<u16, (usize, i64)>,
}

/// A scan that is older has no part in the next map. Ours: two revolutions of the slowest sensor.
const SCAN_AGE_NS_MAX: i64 = 400_000_000;

impl Sensors {
    /// Index of the sensor of this name; of the only sensor if the name is empty.
    fn source(&self, name: &str, vehicle: &str) -> Result<u16, UnknownNameError> {
        let sensors = &self.config.sensors;
        if name.is_empty() && sensors.len() == 1 {
            return Ok(0);
        }
        let present = sensors.iter().filter(|sensor| !sensor.is_withdrawn());
        let index = sensors.iter().position(|sensor| sensor.name == name && !sensor.is_withdrawn());
        index.and_then(|index| u16::try_from(index).ok()).ok_or_else(|| UnknownNameError::Sensor {
            name: shortened(name),
            vehicle: vehicle.to_owned(),
            known: present.map(|sensor| sensor.name.as_str()).collect::<Vec<_>>().join(", "),
        })
    }
}

impl Gateway {
    /// The gateway to a vehicle's queue. A map of scans may take half the time for which it is valid, by `map_time`.
    pub fn new(vehicle: &Vehicle, queue: &EventQueue, map_time: Arc<MapTime>) -> Self {
        let streams_max = vehicle.ingest.streams_max;
        let map_time_max = Duration::from_millis(vehicle.maps.valid_ms.into()) / 2;
        Self {
            vehicle: vehicle.name.as_str().into(),
            limits: Limits {
                ahead_ns_max: i64::from(vehicle.ingest.ahead_ms_max) * 1_000_000,
                ..Limits::from_points_max(vehicle.ingest.points_max)
            },
            in_flight_max: (vehicle.ingest.events_max(vehicle.queue) / streams_max).max(1),
            sensors: Mutex::new(Sensors {
                config: vehicle.core(),
                clients: BTreeMap::new(),
                newest_scans: BTreeMap::new(),
            }),
            streams: StreamPlaces::new(streams_max, (streams_max / 4).max(1)),
            named_streams: AtomicU64::new(0),
            time: EngineTimes::new(map_time.clone(), map_time_max / QUEUED_PART),
            map_time,
            map_time_max,
            queue: queue.clone(),
        }
    }

    /// A place for one stream of this vehicle; the stream holds it while it is open.
    ///
    /// # Errors
    /// [`StreamLimitError`] if there is none for this sender.
    pub fn take_stream(&self, sender: IpAddr) -> Result<StreamPlace, StreamLimitError> {
        self.streams.take(sender)
    }

    /// A name for a new stream of a host, which no other stream has.
    pub fn name_stream(&self, host: IpAddr) -> String {
        format!("stream {} of {host}", self.named_streams.fetch_add(1, Ordering::Relaxed) + 1)
    }

    /// Checks one observation of `bytes` bytes and pushes its events; the last one holds `time` until it is processed.
    /// An immediate refusal goes to `session`; the outcome of each event goes to `outcomes`.
    ///
    /// # Errors
    /// [`UnknownNameError::Sensor`] if the vehicle has no such sensor; `session` has the refusal already.
    pub fn push(
        &self,
        observation: v1::Observation,
        bytes: usize,
        mut time: EngineTime,
        session: &mut ClientSession,
        outcomes: &OutcomeSender,
    ) -> Result<(), UnknownNameError> {
        let (client, number) = (observation.client, observation.number);
        let concerns_vehicle = concerns_vehicle(&observation);
        let sensor = if concerns_vehicle { None } else { Some(observation.sensor.clone()) };
        if let Err(error) = session.check_number(number) {
            self.refuse(session, number, "number", error.to_string());
            return Ok(());
        }
        let source = |sensors: &Sensors| sensor.as_ref().map_or(Ok(0), |name| sensors.source(name, &self.vehicle));
        let refuse = |unknown: UnknownNameError, session: &mut ClientSession| {
            session.begin(number, 0, 0);
            self.refuse(session, number, "source", unknown.to_string());
            Err(unknown)
        };
        let known = match source(&locked(&self.sensors)) {
            Ok(known) => known,
            Err(unknown) => return refuse(unknown, session),
        };
        let now_ns = self.queue.now_ns();
        let decoded = observation::decode(observation, &self.limits)
            .and_then(|bodies| observation::check_stamps(bodies, now_ns, &self.limits))
            .and_then(|bodies| self.check_time(bodies, known, now_ns));
        match decoded {
            Err(error) => {
                session.begin(number, 0, 0);
                self.record_drop(if concerns_vehicle { UNKNOWN_SOURCE } else { known }, error.reason());
                session.refuse(number, error.reason(), error.to_string(), 1);
            }
            Ok(bodies) => {
                // While it was decoded, the sensor may have been withdrawn, and another declared at its index.
                let mut sensors = locked(&self.sensors);
                let source = match source(&sensors) {
                    Ok(source) => source,
                    Err(unknown) => return refuse(unknown, session),
                };
                session.begin(number, bodies.len(), bytes);
                let (last, now) = (bodies.len().saturating_sub(1), Instant::now());
                for (at, (captured_ns, body)) in bodies.into_iter().enumerate() {
                    let id = ObservationId { client, number };
                    let time = if at == last { std::mem::take(&mut time) } else { EngineTime::default() };
                    let receipt = Receipt::new(id, time, outcomes);
                    if let Some(sender) = session.sender() {
                        self.queue.drops().senders.note(source, &body, sender, now);
                    }
                    match body {
                        Body::Sensor(sensor) => {
                            self.push_declaration(captured_ns, sensor, receipt, &mut sensors, session);
                        }
                        body => _ = self.push_event(captured_ns, source, body, receipt),
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns `bodies` if a map of their scan, together with the newest scans of the other sensors, does not take too
    /// long, or if it would not with as many points of each of them: the scans of others do not make one too large.
    fn check_time(&self, bodies: Bodies, source: u16, now_ns: i64) -> Result<Bodies, ObservationError> {
        let Some(scan) =
            bodies.iter().find_map(|(_, body)| if let Body::Scan(scan) = body { Some(scan) } else { None })
        else {
            return Ok(bodies);
        };
        let points = scan.x.len() + scan.no_returns.len();
        let newest = &mut locked(&self.sensors).newest_scans;
        newest.retain(|of, (_, came_ns)| *of != source && now_ns.saturating_sub(*came_ns) < SCAN_AGE_NS_MAX);
        let others = newest.values().map(|(points, _)| points).sum();
        let (all, equal) = (points.saturating_add(others), points.saturating_mul(newest.len() + 1));
        let is_small = self.map_time.of(equal) <= self.map_time_max;
        if !is_small && !self.map_time.allows(all, self.map_time_max, now_ns) {
            let takes = self.map_time.of(all);
            return Err(ObservationError::Time { points, others, takes, takes_max: self.map_time_max });
        }
        newest.insert(source, (points, now_ns));
        Ok(bodies)
    }

    /// Counts a refused observation and adds the refusal to the client's next report.
    pub fn refuse(&self, session: &mut ClientSession, number: u64, reason: &'static str, message: String) {
        self.record_refusal(reason);
        session.refuse(number, reason, message, 1);
    }

    /// Counts a message that is not an observation and adds the refusal to the client's next report.
    pub fn refuse_message(&self, session: &mut ClientSession, number: u64, error: &ObservationError) {
        self.refuse(session, number, error.reason(), error.to_string());
    }

    /// Counts a refused message of a client that cannot get a report.
    pub fn record_refusal(&self, reason: &'static str) {
        self.record_drop(UNKNOWN_SOURCE, reason);
    }

    fn record_drop(&self, source: u16, reason: &'static str) {
        let drops = self.queue.drops();
        match reason {
            "queue" => drops.record(source, Cause::Queue, 1),
            "source" => drops.record(source, Cause::Sender, 1),
            _ => drops.record_refused_messages(source, reason, 1),
        }
    }

    /// Returns true if the event is on the queue; otherwise the receipt delivers the refusal.
    fn push_event(&self, captured_ns: Option<i64>, source: u16, body: Body, receipt: Receipt) -> bool {
        self.queue.push_observation(captured_ns, source, body, receipt).unwrap_or(false)
    }

    /// Ends a client: the sensors that it alone has declared are withdrawn.
    pub fn end(&self, session: &mut ClientSession) {
        let mut sensors = locked(&self.sensors);
        for source in session.take_declared() {
            sensors.clients.entry(source).and_modify(|clients| *clients = clients.saturating_sub(1));
        }
        self.withdraw_without_client(&mut sensors);
    }

    /// Withdraws the sensors whose clients have ended, as far as the queue has space.
    fn withdraw_without_client(&self, sensors: &mut Sensors) {
        let Sensors { config, clients, .. } = sensors;
        clients.retain(|source, clients| {
            let is_withdrawn = *clients == 0 && self.queue.push_if_space(*source, Body::Withdrawn);
            if is_withdrawn {
                config.withdraw(usize::from(*source));
            }
            !is_withdrawn
        });
    }

    /// Pushes the declaration of a new sensor, or of one that exists already. The configuration here changes as the
    /// engine's will, so that the next observation can name the sensor.
    fn push_declaration(
        &self,
        captured_ns: Option<i64>,
        sensor: Box<SensorConfig>,
        receipt: Receipt,
        sensors: &mut Sensors,
        session: &mut ClientSession,
    ) {
        self.withdraw_without_client(sensors);
        let Sensors { config, clients, .. } = sensors;
        let at = |is_it: &dyn Fn(&SensorConfig) -> bool| config.sensors.iter().position(is_it);
        let known = at(&|known| *known == *sensor);
        let index = known.or_else(|| at(&SensorConfig::is_withdrawn)).unwrap_or(config.sensors.len());
        let declared = config.declare(index, &sensor).map_err(|error| error.to_string());
        match declared.and_then(|_| u16::try_from(index).map_err(|error| error.to_string())) {
            Ok(source) => {
                let is_pushed = self.push_event(captured_ns, source, Body::Sensor(sensor), receipt);
                let is_declared = known.is_none() || clients.contains_key(&source);
                if is_pushed && is_declared && session.declare(source) {
                    *clients.entry(source).or_default() += 1;
                } else if !is_pushed && known.is_none() {
                    config.withdraw(index);
                }
            }
            Err(message) => {
                self.record_refusal("sensor");
                receipt.deliver(Outcome::Refused { reason: "sensor", message });
            }
        }
    }
}

/// True if an observation concerns no sensor but the whole vehicle.
fn concerns_vehicle(observation: &v1::Observation) -> bool {
    use v1::observation::Body::{Declaration, EgoPose, Road};
    matches!(observation.body, Some(EgoPose(_) | Road(_) | Declaration(_)) | None)
}

/// The gateways of all vehicles that allow observations, in the order of the configuration.
#[derive(Clone, Debug)]
pub struct Gateways {
    all: Arc<[Arc<Gateway>]>,
    /// A place for each stream that has not named its vehicle yet.
    unnamed: StreamPlaces,
    stop: watch::Receiver<bool>,
}

impl Gateways {
    /// The gateways `all`; their streams end once `stop` is true.
    pub fn new(all: impl IntoIterator<Item = Gateway>, stop: watch::Receiver<bool>) -> Self {
        let all: Arc<[Arc<Gateway>]> = all.into_iter().map(Arc::new).collect();
        let places: usize = all.iter().map(|gateway| gateway.streams.places()).sum();
        Self { all, unnamed: StreamPlaces::new(places, places / 2), stop }
    }

    /// One gateway a vehicle.
    pub fn all(&self) -> &[Arc<Gateway>] {
        &self.all
    }

    /// The gateway of the vehicle `name`; of the only vehicle if `name` is empty.
    ///
    /// # Errors
    /// [`UnknownNameError::Vehicle`] if no vehicle has the name, or if it is empty and there is not exactly one
    /// vehicle.
    pub fn find(&self, name: &str) -> Result<&Arc<Gateway>, UnknownNameError> {
        find_vehicle(&self.all, name, |gateway| &gateway.vehicle)
    }

    /// A place for a stream until it has one of its vehicle.
    ///
    /// # Errors
    /// [`StreamLimitError`] if there is none for this sender.
    pub fn take_unnamed_stream(&self, sender: IpAddr) -> Result<StreamPlace, StreamLimitError> {
        self.unnamed.take(sender)
    }

    /// Length of the longest message that any vehicle allows, in bytes.
    pub fn message_bytes_max(&self) -> usize {
        self.all.iter().map(|gateway| gateway.limits.message_bytes_max).max().unwrap_or_default()
    }

    /// Resolves when the server stops.
    pub async fn stopped(&mut self) {
        // An error means that the sender is gone, so the server stops as well.
        let _ = self.stop.wait_for(|stop| *stop).await;
    }
}

#[cfg(test)]
mod tests {
    use clearway_proto::packed::pack;
    use futures::FutureExt;
    use tokio::sync::mpsc::unbounded_channel;

    use super::*;
    use crate::base::clock::Clock;
    use crate::config::Config;
    use crate::ingest::engine_time::Waiting;
    use crate::ingest::queue::{event_queue, event_queue_with_clock};

    fn scan(number: u64, points: usize) -> v1::Observation {
        let floats = pack(&vec![1.0_f32; points]);
        let scan = v1::Scan { x: floats.clone(), y: floats.clone(), z: floats, ..Default::default() };
        v1::Observation { number, body: Some(v1::observation::Body::Scan(scan)), ..Default::default() }
    }

    /// The first maps count as 0.1 ms for each thousand points and 2 ms beside them.
    fn vehicle(valid_ms: u32) -> Vehicle {
        let mut vehicle = Config::of_one_vehicle("car", "top").vehicles.remove(0);
        vehicle.maps.valid_ms = valid_ms;
        vehicle
    }

    #[test]
    fn the_engine_time_of_a_scan_is_free_when_its_event_is_dropped() {
        let (queue, events) = event_queue(16);
        let gateway = Gateway::new(&vehicle(40), &queue, Arc::default());
        let (outcomes, _reports) = unbounded_channel();
        let mut session = ClientSession::new(0);
        let sender = gateway.time.sender();
        let time =
            |number| Waiting::time(&mut Some(gateway.time.wait(scan(number, 80_000), 0, &sender))).now_or_never();
        gateway.push(scan(1, 80_000), 0, time(1).expect("nothing waits"), &mut session, &outcomes).unwrap();
        assert!(time(2).is_none(), "the first scan waits for the engine");
        drop(events.recv().unwrap());
        assert!(time(2).is_some());
    }

    #[test]
    fn after_slow_maps_one_scan_a_second_is_judged_as_before_the_first_map() {
        let clock = Arc::new(std::sync::atomic::AtomicI64::new(0));
        let now_ns = clock.clone();
        let clock_of_queue = Clock::new(move || now_ns.load(Ordering::Relaxed));
        let (queue, _events) = event_queue_with_clock(clock_of_queue, 16);
        let map_time = Arc::<MapTime>::default();
        let gateway = Gateway::new(&vehicle(40), &queue, map_time.clone());
        let (outcomes, _reports) = unbounded_channel();
        let mut session = ClientSession::new(0);
        map_time.record(1_000, Duration::from_secs(1));
        let mut is_pushed = |number, after_ms: i64| {
            clock.store(after_ms * 1_000_000, Ordering::Relaxed);
            gateway.push(scan(number, 100_000), 0, EngineTime::default(), &mut session, &outcomes).unwrap();
            session.next_report().is_none_or(|report| report.refused.is_empty())
        };
        let pushed = [is_pushed(1, 0), is_pushed(2, 100), is_pushed(3, 999), is_pushed(4, 1000), is_pushed(5, 1100)];
        assert_eq!(pushed, [true, false, false, true, false]);
        map_time.record(100_000, Duration::from_millis(10));
        assert!(is_pushed(6, 1200) && is_pushed(7, 1300), "it was fast");
    }

    #[test]
    fn a_scan_is_refused_if_its_map_would_take_half_the_validity_also_together_with_other_sensors() {
        let (queue, events) = event_queue(16);
        let mut vehicle = vehicle(40);
        vehicle.sensors.push(SensorConfig { name: "rear".into(), ..vehicle.sensors[0].clone() });
        let gateway = Gateway::new(&vehicle, &queue, Arc::default());
        let (outcomes, _reports) = unbounded_channel();
        let mut session = ClientSession::new(0);
        let mut push = |number, sensor: &str, points| {
            let observation = v1::Observation { sensor: sensor.into(), ..scan(number, points) };
            gateway.push(observation, 0, EngineTime::default(), &mut session, &outcomes).unwrap();
            session.next_report().map(|report| report.refused).unwrap_or_default()
        };
        let refused = push(1, "top", 180_001).remove(0);
        let message = "scan with 180001 points, beside 0 of other sensors: a map of them takes 20 ms; up to 20 ms are \
                       allowed, half of maps.valid_ms";
        assert_eq!((&*refused.reason, &*refused.message), ("scan_time", message));
        assert!(push(2, "top", 100_000).is_empty());
        let refused = push(3, "rear", 100_000).remove(0);
        assert!(refused.message.contains("100000 points, beside 100000 of other sensors"), "{}", refused.message);
        assert!(push(4, "rear", 70_000).is_empty() && push(5, "top", 110_000).is_empty());
        assert!(push(6, "rear", 90_000).is_empty(), "an equal part of the time is never too much");
        let scans = events.try_iter().filter(|queued| matches!(queued.event.body, Body::Scan(_)));
        assert_eq!(scans.count(), 4, "beside the reports of what was refused");
    }
}
