//! Starts a server: [`Setup`] -> [`Running`].

use std::collections::BTreeMap;
use std::hash::{BuildHasher, Hasher};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use clearway_lidar::calibration::Calibration;
use clearway_mapping::pipeline::{Pipeline, layer_names};
use tokio::net::TcpListener;
use tokio::sync::watch;

use super::input::VehicleInput;
use super::running::Running;
use super::setup::{Setup, StartError};
use crate::config::{Certificates, Config, Foxglove, Grpc, Vehicle};
use crate::engine::{Engine, Observer};
use crate::ingest::gateway::{Gateway, Gateways};
use crate::ingest::grpc::Ingest;
use crate::ingest::queue::{EventQueue, QueuedEvent, event_queue};
use crate::ingest::udp;
use crate::publish::{Served, Vehicles, foxglove, grpc, page};
use crate::record::mcap_file::Header;
use crate::record::writer::{Recorder, recording_path};
use crate::status::VehicleStatus;

/// The server.
pub struct Server;

impl Server {
    /// Starts everything that the configuration enables: first what another program may hold already (addresses and
    /// ports), then recorder and engines, and the sources of events last. Needs a multi-thread tokio runtime.
    ///
    /// # Errors
    /// [`StartError`] with the first part that did not start; then nothing is left running.
    pub async fn start(setup: Setup) -> Result<Running, StartError> {
        let Setup { config, mut calibrations, boot_id, .. } = setup;
        if config.zenoh.enabled && !cfg!(feature = "zenoh") {
            return Err(StartError::NoZenoh);
        }
        let boot_id = boot_id.unwrap_or_else(random);
        let mut observer = setup.observer;
        calibrations.resize_with(config.vehicles.len(), Vec::new);
        let mut running = Running { replay: setup.replay, ..Running::default() };
        let mut prepared = Vec::new();
        for (vehicle, tables) in config.vehicles.iter().zip(&mut calibrations) {
            tables.resize(vehicle.sensors.len(), None);
            let pipeline = Pipeline::new(&vehicle.core(), tables.clone())?;
            prepared.push(running.prepare(vehicle, boot_id, pipeline, observer.take()));
        }
        running.vehicles = Vehicles(prepared.iter().map(|prepared| prepared.served.clone()).collect());
        let header = || header(&config, &calibrations, boot_id, &setup.config_comments, setup.metadata);
        let driver = Driver { from_files: setup.from_files, is_stepped: setup.is_stepped };
        match running.start_all(&config, setup.certificates, prepared, driver, header).await {
            Ok(()) => Ok(running),
            Err(error) => {
                // The caller needs the error of the start, not one of the shutdown that follows from it.
                let _ = running.shutdown().await;
                Err(error)
            }
        }
    }
}

/// Where the events come from, and which thread steps the engines ([`Setup::from_files`], [`Setup::is_stepped`]).
#[derive(Clone, Copy)]
struct Driver {
    from_files: bool,
    is_stepped: bool,
}

/// One vehicle before its engine runs.
struct Prepared {
    served: Served,
    engine: Engine,
    events: Receiver<QueuedEvent>,
}

/// The steps of [`Server::start`], in order.
impl Running {
    /// Creates a vehicle's event queue, its engine, and what publishers see of it.
    fn prepare(&mut self, vehicle: &Vehicle, boot_id: u64, pipeline: Pipeline, observer: Option<Observer>) -> Prepared {
        let name: Arc<str> = vehicle.name.as_str().into();
        let (queue, events) = event_queue(vehicle.queue);
        let layers = layer_names(&vehicle.maps);
        let status = Arc::new(VehicleStatus::new(name.clone(), boot_id, layers, queue.drops()));
        let (newest, receiver) = watch::channel(None);
        let valid_ms = vehicle.maps.valid_ms;
        let engine =
            Engine { pipeline, valid_ms, newest, recording: None, status: status.clone(), observer, replayed: None };
        self.inputs.push(VehicleInput { name, queue, udp: None });
        Prepared { served: Served { status, newest: receiver }, engine, events }
    }

    async fn start_all(
        &mut self,
        config: &Config,
        certificates: Option<Certificates>,
        prepared: Vec<Prepared>,
        driver: Driver,
        header: impl FnOnce() -> Header,
    ) -> Result<(), StartError> {
        // Before the recorder: a port in use must not overwrite an earlier recording.
        let grpc = listen("grpc.listen", config.grpc.enabled.then_some(config.grpc.listen)).await?;
        let page = listen("page.listen", config.page.enabled.then_some(config.page.listen)).await?;
        let security = security(certificates, &config.grpc)?;
        let sockets = udp::Sockets::bind(&config.vehicles).map_err(|source| StartError::Udp {
            vehicle: config.vehicles[source.vehicle].name.as_str().into(),
            source,
        })?;
        let gateways = self.gateways(config);
        if config.foxglove.enabled {
            self.serve_foxglove(&config.foxglove).await?;
        }
        #[cfg(feature = "zenoh")]
        if config.zenoh.enabled {
            let started = super::over_zenoh::OverZenoh::start(config, &self.vehicles, &gateways, &self.inputs);
            let over_zenoh = started.await?;
            self.zenoh = over_zenoh.endpoints().await;
            self.over_zenoh = Some(over_zenoh);
        }
        self.start_engines(config, prepared, driver, header)?;
        if let Some(listener) = grpc {
            self.serve_grpc(listener, security, config.grpc.connections_max, gateways);
        }
        if let Some(listener) = page {
            self.serve_page(listener);
        }
        self.start_udp(sockets)
    }

    /// Starts the recorder, if the configuration names a file, and the engines.
    fn start_engines(
        &mut self,
        config: &Config,
        prepared: Vec<Prepared>,
        driver: Driver,
        header: impl FnOnce() -> Header,
    ) -> Result<(), StartError> {
        let mut handles = Vec::new().into_iter();
        if recording_path(&config.recorder).is_some() {
            let (recorder, of_vehicles) = Recorder::start(&config.recorder, &header(), driver.from_files)?;
            (self.recorder, handles) = (Some(recorder), of_vehicles.into_iter());
        }
        for Prepared { served: Served { status, .. }, mut engine, events } in prepared {
            self.recorder.iter().for_each(|recorder| status.show_recorder(recorder.counts()));
            // A replay computes all layers: a reader that comes late gets the last map, and the summary has all
            // metrics.
            self.subscriptions.extend(driver.from_files.then(|| status.subscriptions.subscribe(&[])));
            engine.recording = handles.next();
            if driver.is_stepped {
                self.stepped.push((engine, events));
                continue;
            }
            let name = status.name.clone();
            let thread = engine.start(events).map_err(|source| StartError::Thread { vehicle: name.clone(), source })?;
            self.engines.push((name, thread));
        }
        Ok(())
    }

    /// The gateways of the vehicles that allow observations.
    fn gateways(&self, config: &Config) -> Gateways {
        let enabled = config.vehicles.iter().zip(&self.inputs).filter(|(vehicle, _)| vehicle.ingest.enabled);
        Gateways::new(enabled.map(|(vehicle, input)| Gateway::new(vehicle, &input.queue)), self.stop.subscribe())
    }

    fn serve_grpc(
        &mut self,
        listener: TcpListener,
        security: grpc::Security,
        connections_max: usize,
        gateways: Gateways,
    ) {
        self.grpc = listener.local_addr().ok();
        let (vehicles, stopped) = (self.vehicles.clone(), self.stopped());
        let ingest = (!gateways.all().is_empty()).then(|| Ingest::new(gateways).into_service());
        let replay = self.replay.clone();
        self.publishers.spawn(async move {
            let served = grpc::serve(listener, security, connections_max, vehicles, ingest, replay, stopped);
            if let Err(error) = served.await {
                tracing::error!(%error, "grpc ended");
            }
        });
    }

    fn serve_page(&mut self, listener: TcpListener) {
        self.page = listener.local_addr().ok();
        let (vehicles, stopped, replay) = (self.vehicles.clone(), self.stopped(), self.replay.clone());
        self.publishers.spawn(async move {
            if let Err(error) = page::serve(listener, vehicles, replay, stopped).await {
                tracing::error!(%error, "page ended");
            }
        });
    }

    async fn serve_foxglove(&mut self, options: &Foxglove) -> Result<(), StartError> {
        let started = foxglove::Publisher::start(options, &self.vehicles).await;
        let viewers = started.map_err(|source| StartError::Foxglove { at: options.listen, source })?;
        self.foxglove = Some(SocketAddr::new(options.listen.ip(), viewers.port()));
        self.viewers = Some(viewers);
        Ok(())
    }

    /// Starts the threads that read the sockets. They start last, when everything behind them runs.
    fn start_udp(&mut self, sockets: udp::Sockets) -> Result<(), StartError> {
        for (index, input) in self.inputs.iter_mut().enumerate() {
            input.udp = sockets.addresses(index);
        }
        let queues: Vec<EventQueue> = self.inputs.iter().map(|input| input.queue.clone()).collect();
        self.udp = Some(sockets.start(&queues).map_err(StartError::UdpThread)?);
        Ok(())
    }
}

/// The transport security of gRPC. It is never plain text if the configuration names certificates.
fn security(certificates: Option<Certificates>, grpc: &Grpc) -> Result<grpc::Security, StartError> {
    if grpc.enabled && grpc.tls.is_some() && certificates.is_none() {
        return Err(StartError::Certificates("its files were not read".into()));
    }
    let security = grpc::Security::new(certificates, &grpc.access);
    security.map_err(|error| StartError::Certificates(with_causes(&error)))
}

/// An error with all its causes, because "transport error" alone says little.
fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

async fn listen(what: &'static str, at: Option<SocketAddr>) -> Result<Option<TcpListener>, StartError> {
    let Some(at) = at else { return Ok(None) };
    TcpListener::bind(at).await.map(Some).map_err(|source| StartError::Listen { what, at, source })
}

/// The header of the recording.
fn header(
    config: &Config,
    calibrations: &[Vec<Option<Calibration>>],
    boot_id: u64,
    config_comments: &[String],
    mut metadata: BTreeMap<String, String>,
) -> Header {
    let mut tables = Vec::new();
    for (vehicle, of_vehicle) in config.vehicles.iter().zip(calibrations) {
        for (sensor, table) in vehicle.sensors.iter().zip(of_vehicle) {
            let key = format!("calibration/{}/{}", vehicle.name, sensor.name);
            let source = match &sensor.calibration {
                Some(file) => file.clone(),
                None => "the factory's table of the model, or the one in the sensor's status bytes".into(),
            };
            metadata.insert(key, source);
            if let Some(table) = table {
                tables.push((vehicle.name.clone(), sensor.name.clone(), table.to_yaml()));
            }
        }
    }
    let comments: String = config_comments.iter().map(|comment| format!("# {comment}\n")).collect();
    let vehicles = config.vehicles.iter().map(|v| (v.name.as_str().into(), layer_names(&v.maps))).collect();
    Header { boot_id, config: comments + &config.to_toml(), vehicles, calibrations: tables, metadata }
}

/// A random 64-bit number: the system seeds each `RandomState` with its randomness.
pub fn random() -> u64 {
    std::hash::RandomState::new().build_hasher().finish()
}
