//! One vehicle as those who send observations see it: its sensors, its limits, and the way to its door. gRPC and zenoh
//! come in here alike.

use std::sync::{Arc, Mutex};

use clearway_mapping::config::{SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Cause, NOBODY};
use clearway_proto::v1;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::observation::{self, Limits, ObservationError};
use super::receipt::{Account, Mark, Ticket, Verdict, Verdicts};
use super::{Door, WeakDoor, locked};
use crate::config::Vehicle;
use crate::publish::Unknown;

/// Where one vehicle's observations enter.
#[derive(Debug)]
pub struct Entrance {
    /// The vehicle's name.
    pub vehicle: Arc<str>,
    /// What one observation may be.
    pub limits: Limits,
    /// Events of one client that may wait for their verdict: all streams together fill half the vehicle's queue, so
    /// that the other half is the UDP door's.
    pub in_flight_max: usize,
    /// With the sensors that were declared: what the engine will have made of the events sent so far.
    config: Mutex<VehicleConfig>,
    streams: Arc<Semaphore>,
    streams_max: usize,
    door: WeakDoor,
}

impl Entrance {
    /// To a vehicle's door.
    pub fn new(vehicle: &Vehicle, door: &Door) -> Self {
        let streams_max = vehicle.ingest.streams_max;
        Self {
            vehicle: vehicle.name.as_str().into(),
            limits: Limits::of_points(vehicle.ingest.points_max),
            in_flight_max: (vehicle.queue / (2 * streams_max)).max(1),
            config: Mutex::new(vehicle.core()),
            streams: Arc::new(Semaphore::new(streams_max)),
            streams_max,
            door: door.weak(),
        }
    }

    /// A place among the vehicle's streams; `Err` with how many there are.
    ///
    /// # Errors
    /// The number of streams allowed, all of which are taken.
    pub fn stream(&self) -> Result<OwnedSemaphorePermit, usize> {
        self.streams.clone().try_acquire_owned().map_err(|_| self.streams_max)
    }

    /// Takes one observation, as far as the door: `account` and, by and by, `verdicts` hear what becomes of it.
    ///
    /// # Errors
    /// [`Unknown::Sensor`], listing the known ones; the account has it already.
    pub fn take(
        &self,
        observation: v1::Observation,
        bytes: usize,
        account: &mut Account,
        verdicts: &Verdicts,
    ) -> Result<(), Unknown> {
        let (client, number) = (observation.client, observation.number);
        let of_vehicle = is_of_vehicle(&observation);
        if let Err(message) = account.count(number) {
            self.refuse(account, number, "number", message);
            return Ok(());
        }
        let source = match self.source(&observation) {
            Ok(source) => source,
            Err(unknown) => {
                account.enter(number, 0, 0);
                self.refuse(account, number, "source", unknown.to_string());
                return Err(unknown);
            }
        };
        match observation::bodies(observation, &self.limits) {
            Err(error) => {
                account.enter(number, 0, 0);
                self.leave(if of_vehicle { NOBODY } else { source }, error.reason());
                account.refuse(number, error.reason(), error.to_string(), 1);
            }
            Ok(bodies) => {
                account.enter(number, bodies.len(), bytes);
                for (captured_ns, body) in bodies {
                    let ticket = Ticket::new(Mark { client, number }, verdicts);
                    match body {
                        Body::Sensor(sensor) => self.declare(captured_ns, sensor, ticket),
                        body => _ = self.enter(captured_ns, source, body, ticket),
                    }
                }
            }
        }
        Ok(())
    }

    /// Counts and reports what did not become an event.
    pub fn refuse(&self, account: &mut Account, number: u64, reason: &'static str, message: String) {
        self.count(reason);
        account.refuse(number, reason, message, 1);
    }

    /// [`Entrance::refuse`] of an error.
    pub fn refuse_error(&self, account: &mut Account, number: u64, error: &ObservationError) {
        self.refuse(account, number, error.reason(), error.to_string());
    }

    /// Counts what did not become an event, where nobody can be told.
    pub fn count(&self, reason: &'static str) {
        self.leave(NOBODY, reason);
    }

    fn leave(&self, source: u16, reason: &'static str) {
        let outside = self.door.outside();
        match reason {
            "queue" => outside.leave(source, Cause::Queue, 1),
            "source" => outside.leave(source, Cause::Sender, 1),
            _ => outside.leave_observations(source, reason, 1),
        }
    }

    /// Whether it is on the queue; the ticket knows where it is not.
    fn enter(&self, captured_ns: Option<i64>, source: u16, body: Body, ticket: Ticket) -> bool {
        match self.door.door() {
            Some(door) => door.enter_observed(captured_ns, source, body, ticket).unwrap_or(false),
            None => false,
        }
    }

    /// Declares a sensor as the next one, or one that is there already. The engine will judge it as it is judged here,
    /// so that its name can be used at once.
    fn declare(&self, captured_ns: Option<i64>, sensor: Box<SensorConfig>, ticket: Ticket) {
        let mut config = locked(&self.config);
        let before = config.sensors.len();
        let index = config.sensors.iter().position(|known| *known == *sensor).unwrap_or(before);
        let declared = config.declare(index, &sensor).map_err(|error| error.to_string());
        match declared.and_then(|_| u16::try_from(index).map_err(|error| error.to_string())) {
            Ok(source) => {
                if !self.enter(captured_ns, source, Body::Sensor(sensor), ticket) {
                    config.sensors.truncate(before);
                }
            }
            Err(message) => {
                self.count("sensor");
                ticket.tell(Verdict::Refused { reason: "sensor", message });
            }
        }
    }

    /// The sensor an observation is of; 0 where it concerns the whole vehicle.
    fn source(&self, observation: &v1::Observation) -> Result<u16, Unknown> {
        let name = &observation.sensor;
        let sensors = &locked(&self.config).sensors;
        if is_of_vehicle(observation) || (name.is_empty() && sensors.len() == 1) {
            return Ok(0);
        }
        let index = sensors.iter().position(|sensor| sensor.name == *name);
        index.and_then(|index| u16::try_from(index).ok()).ok_or_else(|| Unknown::Sensor {
            name: name.clone(),
            vehicle: self.vehicle.to_string(),
            known: sensors.iter().map(|sensor| sensor.name.as_str()).collect::<Vec<_>>().join(", "),
        })
    }
}

/// Whether an observation is of no sensor but of the whole vehicle.
fn is_of_vehicle(observation: &v1::Observation) -> bool {
    use v1::observation::Body::{Declaration, EgoPose, Road};
    matches!(observation.body, Some(EgoPose(_) | Road(_) | Declaration(_)) | None)
}

/// The entrances of all vehicles that have one, in the order of the configuration.
#[derive(Clone, Debug)]
pub struct Entrances {
    all: Arc<[Arc<Entrance>]>,
    /// Places for the streams of all vehicles: one that has not said yet whose it is takes one too.
    streams: Arc<Semaphore>,
    stop: watch::Receiver<bool>,
}

impl Entrances {
    /// Of these vehicles; streams end once `stop` is true.
    pub fn new(all: impl IntoIterator<Item = Entrance>, stop: watch::Receiver<bool>) -> Self {
        let all: Arc<[Arc<Entrance>]> = all.into_iter().map(Arc::new).collect();
        let streams = Arc::new(Semaphore::new(all.iter().map(|entrance| entrance.streams_max).sum()));
        Self { all, streams, stop }
    }

    /// One a vehicle.
    pub fn all(&self) -> &[Arc<Entrance>] {
        &self.all
    }

    /// The vehicle of this name; the only one where `name` is empty.
    ///
    /// # Errors
    /// [`Unknown::Vehicle`], listing the known ones.
    pub fn find(&self, name: &str) -> Result<&Arc<Entrance>, Unknown> {
        if let ("", [only]) = (name, &self.all[..]) {
            return Ok(only);
        }
        self.all.iter().find(|entrance| &*entrance.vehicle == name).ok_or_else(|| {
            let known: Vec<&str> = self.all.iter().map(|entrance| &*entrance.vehicle).collect();
            Unknown::Vehicle { name: name.to_owned(), known: known.join(", ") }
        })
    }

    /// A place for one more stream, where there is one.
    pub fn stream(&self) -> Option<OwnedSemaphorePermit> {
        self.streams.clone().try_acquire_owned().ok()
    }

    /// The longest message any vehicle takes.
    pub fn message_bytes_max(&self) -> usize {
        self.all.iter().map(|entrance| entrance.limits.message_bytes_max).max().unwrap_or_default()
    }

    /// Resolves when the server stops.
    pub async fn stopped(&mut self) {
        // An error means that the sender is gone, which is a stop too.
        let _ = self.stop.wait_for(|stop| *stop).await;
    }
}
