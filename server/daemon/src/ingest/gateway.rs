//! The gateway of one vehicle: one observation of a client -> events on the vehicle's queue. gRPC and zenoh both use
//! it.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use clearway_mapping::config::{SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Cause, UNKNOWN_SOURCE};
use clearway_proto::v1;
use tokio::sync::watch;

use super::admission::{Admission, AdmissionPermit, OpenStream, StreamLimitError, StreamLimits};
use super::observation::{self, Limits, ObservationError};
use super::queue::{Arrival, EventQueue, LiveReading};
use super::receipt::{ClientSession, ObservationId, Outcome, OutcomeSender, Receipt};
use crate::base::directory::{UnknownNameError, find_vehicle, shortened};
use crate::base::sync::locked;
use crate::config::Vehicle;

/// Greatest time by which the stamp of an observation may be ahead of the server's clock, in ns. Ours: a sender whose
/// clock is wrong by more needs a clock, and not maps.
const AHEAD_NS_MAX: i64 = 10_000_000_000;

/// The gateway of one vehicle.
#[derive(Debug)]
pub struct Gateway {
    /// Name of the vehicle.
    pub vehicle: Arc<str>,
    /// Limits of one observation.
    pub limits: Limits,
    /// Greatest number of events in flight of one client. All streams together fill half the vehicle's queue; the other
    /// half is for UDP.
    pub in_flight_max: usize,
    sensors: Mutex<Sensors>,
    /// The open streams of the vehicle.
    streams: StreamLimits,
    /// Number of streams that have been named.
    named_streams: AtomicU64,
    /// The permits of the sources for the event queue.
    pub admission: Admission,
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
}

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
    /// The gateway to a vehicle's queue.
    pub fn new(vehicle: &Vehicle, queue: &EventQueue) -> Self {
        let streams_max = vehicle.ingest.streams_max;
        Self {
            vehicle: vehicle.name.as_str().into(),
            limits: Limits { ahead_ns_max: AHEAD_NS_MAX, ..Limits::from_points_max(vehicle.ingest.points_max) },
            in_flight_max: (vehicle.ingest.events_max(vehicle.queue) / streams_max).max(1),
            sensors: Mutex::new(Sensors { config: vehicle.core(), clients: BTreeMap::new() }),
            streams: StreamLimits::new(streams_max, (streams_max / 4).max(1)),
            named_streams: AtomicU64::new(0),
            admission: Admission::default(),
            queue: queue.clone(),
        }
    }

    /// Opens a stream of this host to the vehicle; it counts until the return value is dropped.
    ///
    /// # Errors
    /// [`StreamLimitError`] if the stream exceeds a limit.
    pub fn open_stream(&self, host: IpAddr) -> Result<OpenStream, StreamLimitError> {
        self.streams.open(host)
    }

    /// A name for a new stream of a host, which no other stream has.
    pub fn name_stream(&self, host: IpAddr) -> String {
        format!("stream {} of {host}", self.named_streams.fetch_add(1, Ordering::Relaxed) + 1)
    }

    /// Checks one observation and pushes its events; the last one holds `permit` until it is processed. An immediate
    /// refusal goes to `session`; the outcome of each event goes to `outcomes`.
    ///
    /// # Errors
    /// [`UnknownNameError::Sensor`] if the vehicle has no such sensor; `session` has the refusal already.
    pub fn push(
        &self,
        observation: v1::Observation,
        mut permit: AdmissionPermit,
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
        let now_ns = self.queue.now_ns();
        let decoded = observation::decode(observation, &self.limits)
            .and_then(|bodies| observation::check_stamps(bodies, now_ns, &self.limits));
        let mut sensors = locked(&self.sensors);
        let source = match sensor.map_or(Ok(0), |name| sensors.source(&name, &self.vehicle)) {
            Ok(source) => source,
            Err(unknown) => {
                session.begin(number, 0);
                self.refuse(session, number, "source", unknown.to_string());
                return Err(unknown);
            }
        };
        match decoded {
            Err(error) => {
                session.begin(number, 0);
                self.record_drop(if concerns_vehicle { UNKNOWN_SOURCE } else { source }, error.reason());
                session.refuse(number, error.reason(), error.to_string(), 1);
            }
            Ok(bodies) => {
                session.begin(number, bodies.len());
                let (last, now) = (bodies.len().saturating_sub(1), Instant::now());
                for (at, (captured_ns, body)) in bodies.into_iter().enumerate() {
                    let id = ObservationId { client, number };
                    let receipt = Receipt::new(id, permit.take_if(|_| at == last), outcomes);
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
        let arrival = captured_ns.map_or(Arrival::Now, Arrival::Captured);
        self.queue.push([LiveReading { arrival, source, body, receipt: Some(receipt) }]).unwrap_or(false)
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

    /// Pushes the declaration of a new or an existing sensor. The configuration here changes as the engine's will, so
    /// that the next observation can name the sensor.
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
    /// The streams that have not named their vehicle yet.
    unnamed: Arc<StreamLimits>,
    stop: watch::Receiver<bool>,
}

impl Gateways {
    /// The gateways `all`; their streams end once `stop` is true.
    pub fn new(all: impl IntoIterator<Item = Gateway>, stop: watch::Receiver<bool>) -> Self {
        let all: Arc<[Arc<Gateway>]> = all.into_iter().map(Arc::new).collect();
        let streams_max: usize = all.iter().map(|gateway| gateway.streams.streams_max).sum();
        Self { all, unnamed: Arc::new(StreamLimits::new(streams_max, streams_max / 2)), stop }
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

    /// Opens a stream of this host that has not named its vehicle; it counts until the return value is dropped.
    ///
    /// # Errors
    /// [`StreamLimitError`] if the stream exceeds a limit.
    pub fn open_unnamed_stream(&self, host: IpAddr) -> Result<OpenStream, StreamLimitError> {
        self.unnamed.open(host)
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
