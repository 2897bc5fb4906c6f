//! The gRPC server: `clearway.v1.MapService`, `PlanService` and `RecordingService`, standard health and reflection, and
//! the ingest service if it is configured ([`ingest`]).
//!
//! [`listen`](super::listen) accepts the connections and checks who calls. [`reader`] has the updates of one reader.

pub mod ingest;
mod plan;
pub mod reader;
mod recording;
mod replay;
pub mod selection;
mod status;

use std::pin::Pin;
use std::time::{Duration, Instant};

use clearway_proto::{DESCRIPTORS, SERVED_AT, v1};
use futures::Stream;
use tonic::service::Routes;
use tonic::{Request, Response, Status, Streaming};
use tonic_health::server::HealthReporter;

use super::listen::Listener;
use super::listen::access::{Caller, caller};
use super::served::{Served, Vehicles};
use reader::watch;
use recording::Recordings;
use replay::Replay;

use crate::base::clock::now_ns;
use crate::fleet::Fleet;
use crate::record::writer::RecorderControl;
use crate::replay_control::ReplayHandle;
use crate::status::state_changed;

use v1::ingest_service_server::{IngestService, IngestServiceServer};
use v1::map_service_server::{MapService, MapServiceServer};
use v1::recording_service_server::RecordingServiceServer;
use v1::replay_service_server::ReplayServiceServer;

/// Longest request, in bytes. Ours: requests hold names and numbers.
const REQUEST_BYTES_MAX: usize = 64 << 10;
/// Longest time from opening `Watch` to its first request. Ours: a reader sends its selection at once.
const SELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// Interval at which the health of the services is reported.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);

/// Serves maps, leads readers of the `fleet`'s vehicles to their servers, serves `ingest` if it is configured, and the
/// control of `recorder` and `replay` if there is one, until `stop` resolves and all streams have ended.
///
/// # Errors
/// [`tonic_reflection::server::Error`] if the descriptors are invalid.
pub async fn serve<I: IngestService>(
    listener: Listener,
    vehicles: Vehicles,
    fleet: Fleet,
    ingest: Option<IngestServiceServer<I>>,
    recorder: Option<RecorderControl>,
    replay: Option<ReplayHandle>,
    stop: impl Future<Output = ()>,
) -> Result<(), tonic_reflection::server::Error> {
    let of_health = vehicles.clone();
    let (health, health_service) = tonic_health::server::health_reporter();
    // Until the first report.
    health.set_not_serving::<MapServiceServer<Maps>>().await;
    if ingest.is_some() {
        health.set_serving::<IngestServiceServer<I>>().await;
    }
    let replay = replay.map(|replay| ReplayServiceServer::new(Replay(replay)));
    if replay.is_some() {
        health.set_serving::<ReplayServiceServer<Replay>>().await;
    }
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(DESCRIPTORS)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET);
    let mut routes = Routes::builder();
    routes.add_service(plan::service(vehicles.clone()));
    routes.add_service(MapServiceServer::new(Maps { vehicles, fleet }).max_decoding_message_size(REQUEST_BYTES_MAX));
    let recordings = RecordingServiceServer::new(Recordings { control: recorder.clone() });
    routes.add_service(recordings.max_decoding_message_size(REQUEST_BYTES_MAX));
    if let Some(ingest) = ingest {
        routes.add_service(ingest);
    }
    if let Some(replay) = replay {
        routes.add_service(replay);
    }
    routes.add_service(health_service).add_service(reflection.build_v1()?);
    let reports = report_health(health, of_health, recorder);
    tokio::select! {
        () = listener.serve(routes.routes().prepare().into_axum_router(), stop) => {}
        () = reports => {}
    }
    Ok(())
}

/// Reports the health of the services, once in [`HEALTH_PERIOD`] and at each change of a vehicle's state, for ever: the
/// maps are served unless every vehicle's state is an error, and the recordings if nothing is wrong with the recorder.
async fn report_health(health: HealthReporter, vehicles: Vehicles, recorder: Option<RecorderControl>) {
    let mut every = tokio::time::interval(HEALTH_PERIOD);
    let mut states: Vec<_> = vehicles.0.iter().map(|served| served.status.states()).collect();
    loop {
        tokio::select! {
            _ = every.tick() => {}
            () = state_changed(&mut states) => {}
        }
        if vehicles.are_ready() {
            health.set_serving::<MapServiceServer<Maps>>().await;
        } else {
            health.set_not_serving::<MapServiceServer<Maps>>().await;
        }
        match recorder.as_ref().map(|recorder| recorder.status().status.is_none_or(|of| of.reason.is_empty())) {
            Some(true) => health.set_serving::<RecordingServiceServer<Recordings>>().await,
            Some(false) => health.set_not_serving::<RecordingServiceServer<Recordings>>().await,
            None => {}
        }
    }
}

struct Maps {
    vehicles: Vehicles,
    fleet: Fleet,
}

impl Maps {
    /// The vehicle with this name; the only one of this server if it is empty. The error for a vehicle of another
    /// server has its address in the metadata [`SERVED_AT`], for callers that may reach the vehicle.
    fn find(&self, name: &str, caller: &Caller) -> Result<&Served, Status> {
        let unknown = match self.vehicles.find(name) {
            Ok(served) => return Ok(served),
            Err(unknown) => unknown,
        };
        let elsewhere = self.fleet.find(name, Instant::now()).filter(|_| caller.may_reach(name));
        let Some(v1::Vehicle { server, grpc: address, .. }) = elsewhere else { return Err(unknown.into()) };
        let Some(value) = address.parse().ok().filter(|_| !address.is_empty()) else {
            return Err(Status::not_found(format!(
                "vehicle {name:?} is served by {server:?}, which announces no address: set grpc.advertise there"
            )));
        };
        let mut led = Status::not_found(format!("vehicle {name:?} is served at {address}"));
        led.metadata_mut().insert(SERVED_AT, value);
        Err(led)
    }
}

#[tonic::async_trait]
impl MapService for Maps {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;

    async fn watch(
        &self,
        request: Request<Streaming<v1::WatchRequest>>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let agent = request.metadata().get("user-agent").and_then(|agent| agent.to_str().ok()).map(str::to_owned);
        let caller = caller(&request);
        let mut requests = request.into_inner();
        let first = tokio::time::timeout(SELECTION_TIMEOUT, requests.message())
            .await
            .map_err(|_| Status::deadline_exceeded(format!("no selection within {SELECTION_TIMEOUT:?}")))??;
        let selection = first.and_then(|first| first.selection);
        let mut selection =
            selection.ok_or_else(|| Status::invalid_argument("the first request carries a selection"))?;
        let layers = if selection.layers.is_empty() { "all layers".to_owned() } else { selection.layers.join(", ") };
        let name = format!("gRPC reader of {layers} ({})", agent.as_deref().unwrap_or("no user-agent"));
        let served = self.find(&selection.vehicle, &caller)?;
        selection.layers = caller.layers(&served.status.name, selection.layers, &served.status.layers)?;
        Ok(Response::new(Box::pin(watch(&self.vehicles, selection, requests, name)?)))
    }

    async fn get_map(&self, request: Request<v1::GetMapRequest>) -> Result<Response<v1::MapUpdate>, Status> {
        let caller = caller(&request);
        let v1::GetMapRequest { vehicle, layers } = request.into_inner();
        let served = self.find(&vehicle, &caller)?;
        served.check_layers(&layers)?;
        let name = &served.status.name;
        let layers = caller.layers(name, layers, &served.status.layers)?;
        if served.newest.borrow().is_none() {
            return Err(Status::unavailable(format!("vehicle {name} has no map yet")));
        }
        let newest = served.wires.subscriptions.subscribe(&layers).newest_map(&served.newest).await;
        let map = newest.ok_or_else(|| {
            Status::unavailable(format!("vehicle {name} makes no map at present: no data arrived since the request"))
        })?;
        Ok(Response::new(v1::MapUpdate { map: map.select(&layers), sent_ns: now_ns(), ..Default::default() }))
    }

    type WatchStatusStream = Pin<Box<dyn Stream<Item = Result<v1::WatchStatusResponse, Status>> + Send>>;

    async fn watch_status(
        &self,
        request: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        let caller = caller(&request);
        let names = request.into_inner().vehicles;
        Ok(Response::new(Box::pin(status::watch(status::selected(&self.vehicles, &caller, &names)?))))
    }

    async fn list_vehicles(
        &self,
        request: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        let caller = caller(&request);
        let statuses = self.vehicles.statuses();
        let vehicles = statuses.iter().filter(|status| caller.may_reach(&status.name));
        let own = vehicles.map(|status| status.to_proto());
        let others = self.fleet.vehicles(Instant::now()).into_iter().filter(|vehicle| caller.may_reach(&vehicle.name));
        let vehicles = own.chain(others).collect();
        Ok(Response::new(v1::ListVehiclesResponse { vehicles }))
    }
}
