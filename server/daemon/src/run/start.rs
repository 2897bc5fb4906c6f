//! Starts a server: [`Setup`] -> [`Running`].

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, Hasher};
#[cfg(feature = "zenoh")]
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::VehicleConfig;
use clearway_mapping::pipeline::{Pipeline, layer_names};
use tokio::sync::watch;

use super::input::VehicleInput;
use super::listeners::Listeners;
#[cfg(feature = "zenoh")]
use super::over_zenoh::{OverZenoh, Users};
#[cfg(feature = "zenoh")]
use super::router;
use super::running::Running;
use super::save_rules;
use super::setup::{Setup, StartError, comment_lines};
#[cfg(feature = "store")]
use super::uploads;
use crate::base::clock::now_ns;
use crate::base::held_sockets::HeldSockets;
#[cfg(feature = "zenoh")]
use crate::config::ZenohMode;
use crate::config::{self, Certificates, Config, Vehicle, listeners};
use crate::engine::compute_permits::ComputePermits;
use crate::engine::wires::Wires;
use crate::engine::{Engine, Observer};
use crate::ingest::gateway::{Gateway, Gateways};
use crate::ingest::queue::{EventQueue, QueuedEvent, event_queue};
use crate::ingest::udp;
use crate::publish::listen::security::{Current, Security};
use crate::publish::listen::{Listener, ListenerHandle};
#[cfg(feature = "zenoh")]
use crate::publish::zenoh::signing_key;
use crate::publish::{Served, Vehicles, foxglove, grpc, page};
use crate::record::writer::{Recorder, recording_path};
use crate::status::network::end_text;
use crate::status::{VehicleStatus, watch_states};
use crate::traces::Traces;
#[cfg(feature = "zenoh")]
use crate::zenoh_session;
use clearway_journal::mcap_file::RecordingHeader;

/// Longest time between two signs of life of a listener that does not hang: it gives one twice a second.
const LISTENER_SILENT_MAX: Duration = Duration::from_secs(3);
/// Interval at which the listeners are looked at.
const LISTENER_POLL_INTERVAL: Duration = Duration::from_millis(500);

/// A server with its vehicles, listeners and recorder; [`Server::start`] starts it.
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
        if !config.store.url.is_empty() && !cfg!(feature = "store") {
            return Err(StartError::NoStore);
        }
        let boot_id = boot_id.unwrap_or_else(random);
        let mut observer = setup.observer;
        calibrations.resize_with(config.vehicles.len(), Vec::new);
        let mut running = Running::default();
        running.replay = setup.replay;
        running.traces = Traces::start(&config.traces, boot_id)?;
        let mut prepared = Vec::new();
        for (vehicle, tables) in config.vehicles.iter().zip(&mut calibrations) {
            tables.resize(vehicle.sensors.len(), None);
            let core = (vehicle.core(), tables.clone());
            let pipeline = Pipeline::new(&core.0, core.1.clone())?;
            prepared.push(running.prepare(vehicle, boot_id, pipeline, core, observer.take(), setup.is_stepped));
        }
        running.vehicles = Vehicles(prepared.iter().map(|prepared| prepared.served.clone()).collect());
        let header = || header(&config, &calibrations, boot_id, &setup.config_comments, setup.metadata);
        let driver = Driver { from_files: setup.from_files, is_stepped: setup.is_stepped };
        let given = (setup.certificates, setup.held_sockets);
        match running.start_all(&config, given, prepared, driver, header).await {
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
    /// The configuration and the tables of the vehicle's pipelines.
    core: (VehicleConfig, Vec<Option<Calibration>>),
}

/// The steps of [`Server::start`], in order.
impl Running {
    /// Creates a vehicle's event queue, its engine, and what publishers see of it.
    fn prepare(
        &mut self,
        vehicle: &Vehicle,
        boot_id: u64,
        pipeline: Pipeline,
        core: (VehicleConfig, Vec<Option<Calibration>>),
        observer: Option<Observer>,
        is_stepped: bool,
    ) -> Prepared {
        let name: Arc<str> = vehicle.name.as_str().into();
        let (queue, events) = event_queue(vehicle.queue);
        let queue = queue.with_shares(vehicle.queue - vehicle.ingest.events_max(vehicle.queue), udp_sensors(vehicle));
        let layers = layer_names(&vehicle.maps);
        let wires = Wires::new(&layers).with_plans((!is_stepped).then(|| queue.clone()), queue.drops());
        let status = VehicleStatus::new(name.clone(), boot_id, layers, queue.drops()).with_traces(self.traces.clone());
        status.show_queue(queue.space());
        let status = Arc::new(status.with_outline(vehicle.body.as_ref(), vehicle.maps.reach.outline()));
        let (newest, receiver) = watch::channel(None);
        let engine = Engine {
            pipeline,
            valid_ms: vehicle.maps.valid_ms,
            newest,
            wires: wires.clone(),
            recording: None,
            status: status.clone(),
            observer,
            plan: None,
            replayed: None,
        };
        self.inputs.push(VehicleInput { name, queue, udp: None });
        Prepared { served: Served::new(status, receiver, wires, vehicle.ros.as_ref()), engine, events, core }
    }

    async fn start_all(
        &mut self,
        config: &Config,
        (certificates, mut held): (Option<Certificates>, HeldSockets),
        prepared: Vec<Prepared>,
        driver: Driver,
        header: impl FnOnce() -> RecordingHeader,
    ) -> Result<(), StartError> {
        // Before the recorder: a port in use must not overwrite an earlier recording.
        let current = Current::new(config, certificates.as_ref()).map_err(StartError::Certificates)?;
        let listeners = Listeners::bind(config, &Security::new(current), &mut held).await?;
        let sockets = udp::Sockets::bind(&config.vehicles, &mut held).map_err(|source| StartError::Udp {
            vehicle: config.vehicles[source.vehicle].name.as_str().into(),
            source,
        })?;
        held.unused()
            .for_each(|socket| tracing::warn!(%socket, "the service manager holds a socket that no service uses"));
        drop(held);
        let gateways = self.gateways(config);
        #[cfg(feature = "zenoh")]
        let session = open_zenoh(config, &gateways).await?;
        self.start_engines(config, prepared, driver, header)?;
        #[cfg(feature = "zenoh")]
        if let Some((settings, session)) = session {
            self.start_zenoh(config, &gateways, listeners.grpc_address(), settings, session).await?;
        }
        if let Some(recorder) = self.recorder.as_ref().filter(|_| !config.recorder.save_on.is_empty()) {
            self.spawn_until_stopped(save_rules::watch(config.clone(), self.vehicles.clone(), recorder.control()));
        }
        self.spawn_until_stopped(watch_states(self.vehicles.statuses()));
        self.spawn_until_stopped(self.fleet.clone().forget_silent());
        self.serve(listeners, gateways);
        self.start_udp(sockets)
    }

    /// Starts what uses the zenoh session: now, or without a session once a router answers.
    #[cfg(feature = "zenoh")]
    async fn start_zenoh(
        &mut self,
        config: &Config,
        gateways: &Gateways,
        grpc: Option<SocketAddr>,
        settings: zenoh::Config,
        session: Option<zenoh::Session>,
    ) -> Result<(), StartError> {
        let queues = self.inputs.iter().map(|input| input.queue.clone()).collect();
        let (vehicles, fleet) = (self.vehicles.clone(), self.fleet.clone());
        let recorder = self.recorder.as_ref().map(Recorder::control);
        let users =
            Users { config: config.clone(), vehicles, gateways: gateways.clone(), queues, fleet, grpc, recorder };
        let Some(session) = session else {
            let (endpoints, connected) = (config.zenoh.connect.clone(), self.connected.clone());
            self.connecting.spawn(router::watch(connected.clone(), endpoints, self.vehicles.clone()));
            self.connecting.spawn(router::connect(settings, users, connected));
            return Ok(());
        };
        let over_zenoh = OverZenoh::start(session.clone(), &users).await?;
        self.connecting.spawn(router::watch_each(session, config.zenoh.connect.clone(), self.vehicles.clone()));
        self.zenoh = over_zenoh.endpoints().await;
        self.connected.lock().await.over_zenoh = Some(over_zenoh);
        Ok(())
    }

    /// Starts the recorder, if the configuration names a file, and the engines.
    fn start_engines(
        &mut self,
        config: &Config,
        prepared: Vec<Prepared>,
        driver: Driver,
        header: impl FnOnce() -> RecordingHeader,
    ) -> Result<(), StartError> {
        let mut handles = Vec::new().into_iter();
        if recording_path(&config.recorder).is_some() {
            let options = config::Recorder { awaits_store: !config.store.url.is_empty(), ..config.recorder.clone() };
            let (recorder, of_vehicles) = Recorder::start(&options, &header(), driver.from_files)?;
            #[cfg(feature = "store")]
            if options.awaits_store {
                let saved = Duration::from_secs(config.recorder.save_s);
                let (control, counts) = (recorder.control(), recorder.counts());
                let uploads = uploads::upload_finished(config.store.clone(), saved, control.clone(), counts);
                let (stopped, runtime) = (self.stopped(), tokio::runtime::Handle::current());
                // What the store has not confirmed at the end stays, and the next start sends it. On a thread of its
                // own, because it reads whole files.
                let work = async move {
                    tokio::select! {
                        () = uploads => {}
                        () = stopped => {}
                    }
                    uploads::log_unconfirmed(&control);
                };
                self.publishers.spawn(async move {
                    // Fails only if the runtime shuts down.
                    let _ = tokio::task::spawn_blocking(move || runtime.block_on(work)).await;
                });
            }
            (self.recorder, handles) = (Some(recorder), of_vehicles.into_iter());
        }
        let permits = Arc::new(ComputePermits::of_processors());
        for Prepared { served: Served { status, wires, .. }, mut engine, events, core: (core, tables) } in prepared {
            self.recorder.iter().for_each(|recorder| status.show_recorder(recorder.counts()));
            if driver.from_files {
                status.set_from_files();
            }
            // A replay computes all layers: a reader that comes late gets the last map, and the summary has all
            // metrics.
            self.subscriptions.extend(driver.from_files.then(|| wires.subscriptions.subscribe(&[])));
            engine.recording = handles.next();
            engine.recording.iter_mut().for_each(|recording| recording.set_config(core.clone(), tables.clone()));
            if driver.is_stepped {
                self.stepped.push((engine, events));
                continue;
            }
            let name = status.name.clone();
            let thread = engine.start(events, permits.clone());
            let thread = thread.map_err(|source| StartError::Thread { vehicle: name.clone(), source })?;
            self.engines.push((name, thread));
        }
        Ok(())
    }

    /// Works beside the publishers until the server stops.
    fn spawn_until_stopped(&mut self, work: impl Future<Output = ()> + Send + 'static) {
        let stopped = self.stopped();
        self.publishers.spawn(async move {
            tokio::select! {
                () = work => {}
                () = stopped => {}
            }
        });
    }

    /// The gateways of the vehicles that allow observations.
    fn gateways(&self, config: &Config) -> Gateways {
        let enabled = config.vehicles.iter().zip(&self.inputs).filter(|(vehicle, _)| vehicle.ingest.enabled);
        let gateways = enabled.map(|(vehicle, input)| Gateway::new(vehicle, &input.queue));
        Gateways::new(gateways, self.stop.subscribe())
    }

    fn serve(&mut self, listeners: Listeners, gateways: Gateways) {
        let Listeners { grpc, page, metrics, foxglove, security, handles, .. } = listeners;
        let listeners = handles.clone().into();
        let (vehicles, replay) = (self.vehicles.clone(), self.replay.clone());
        let watched = (security.clone(), handles.clone());
        self.publishers.spawn(watch_listeners(watched, vehicles.clone(), self.stopped()));
        let (fleet, summaries) = (self.fleet.clone(), page::Summaries::default());
        let recorder = self.recorder.as_ref().map(Recorder::control);
        let shown = page::Shown { vehicles, fleet, listeners, replay, recorder: recorder.clone(), summaries };
        self.listeners = Some((security, handles));
        let address = |listener: &Option<Listener>| listener.as_ref().and_then(Listener::address);
        (self.grpc, self.page, self.metrics) = (address(&grpc), address(&page), address(&metrics));
        self.foxglove = address(&foxglove);
        if let Some(listener) = grpc {
            let (vehicles, stopped, replay) = (self.vehicles.clone(), self.stopped(), self.replay.clone());
            let fleet = self.fleet.clone();
            let ingest = (!gateways.all().is_empty()).then(|| grpc::ingest::GrpcIngest::new(gateways).into_service());
            self.publishers.spawn(async move {
                let served = grpc::serve(listener, vehicles, fleet, ingest, recorder, replay, stopped);
                if let Err(error) = served.await {
                    tracing::error!(%error, "grpc ended");
                }
            });
        }
        if let Some(listener) = page {
            self.publishers.spawn(page::serve(listener, shown.clone(), self.stopped()));
        }
        if let Some(listener) = metrics {
            self.publishers.spawn(page::serve_metrics(listener, shown, self.stopped()));
        }
        if let Some(listener) = foxglove {
            self.publishers.spawn(foxglove::serve(listener, self.vehicles.clone(), self.stopped()));
        }
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

/// The settings of the zenoh session, and the open session unless it needs a router; `None` without zenoh.
#[cfg(feature = "zenoh")]
async fn open_zenoh(
    config: &Config,
    gateways: &Gateways,
) -> Result<Option<(zenoh::Config, Option<zenoh::Session>)>, StartError> {
    if !config.zenoh.enabled {
        return Ok(None);
    }
    let names = config.vehicles.iter().map(|vehicle| &*vehicle.name);
    let settings = zenoh_session::settings(&config.zenoh, gateways.message_bytes_max(), names)?;
    // A key that cannot be read ends the start, also if the session is opened later.
    signing_key(&config.zenoh.signing_key)?;
    let session = match config.zenoh.mode {
        ZenohMode::Client => None,
        ZenohMode::Peer | ZenohMode::Router => Some(zenoh_session::open(settings.clone(), &config.zenoh).await?),
    };
    Ok(Some((settings, session)))
}

/// Names a listener that hangs or has stopped, and the ends of certificates, in the status of every vehicle, until
/// `stop` resolves.
async fn watch_listeners(
    (security, handles): (Security, Vec<(&'static str, ListenerHandle)>),
    vehicles: Vehicles,
    stop: impl Future<Output = ()>,
) {
    let watch = async {
        let mut every = tokio::time::interval(LISTENER_POLL_INTERVAL);
        // The certificates whose ends are in the log, each with whether it had ended.
        let mut told = Vec::new();
        loop {
            every.tick().await;
            let silent = |handle: &ListenerHandle| handle.silent().filter(|silent| *silent > LISTENER_SILENT_MAX);
            let silent = handles.iter().filter_map(|(name, handle)| Some((name, silent(handle)?)));
            let fault = silent.map(|(name, silent)| format!("the listener {name} has hung for {} s", silent.as_secs()));
            let fault = fault.collect::<Vec<_>>().join("; ");
            let current = security.current();
            let ends = current.tls.as_ref().map_or(&[][..], |tls| &tls.ends_s);
            let now_s = now_ns() / 1_000_000_000;
            for (name, end_s) in ends {
                let (Some(text), end) = (end_text(name, *end_s, now_s), (*name, *end_s, *end_s <= now_s)) else {
                    continue;
                };
                if !told.contains(&end) {
                    tracing::warn!("{text}");
                    told.push(end);
                }
            }
            for served in vehicles.0.iter() {
                served.status.network.set_listener_fault(&fault);
                served.status.network.set_certificates(ends);
            }
        }
    };
    tokio::select! {
        () = watch => {}
        () = stop => {}
    }
}

/// Number of a vehicle's sensors that send datagrams.
fn udp_sensors(vehicle: &Vehicle) -> usize {
    let routes = listeners(std::slice::from_ref(vehicle)).into_iter().flat_map(|listener| listener.routes);
    routes.map(|route| route.source).collect::<BTreeSet<_>>().len()
}

/// The header of the recording.
fn header(
    config: &Config,
    calibrations: &[Vec<Option<Calibration>>],
    boot_id: u64,
    config_comments: &[String],
    mut metadata: BTreeMap<String, String>,
) -> RecordingHeader {
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
    let vehicles = config.vehicles.iter().map(|v| (v.name.as_str().into(), layer_names(&v.maps))).collect();
    let config = comment_lines(config_comments) + &config.to_toml();
    RecordingHeader { boot_id, config, vehicles, calibrations: tables, metadata }
}

/// A random 64-bit number: the system seeds each `RandomState` with its randomness.
pub fn random() -> u64 {
    std::hash::RandomState::new().build_hasher().finish()
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use super::*;

    async fn until(condition: impl Fn() -> bool) {
        while !condition() {
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_listener_that_hangs_is_a_fault_of_every_vehicle_until_it_goes_on() {
        let mut config = Config::of_one_vehicle("car", "top");
        (config.page.enabled, config.grpc.listen) = (false, "127.0.0.1:0".parse().expect("an address"));
        let security = Security::new(Current::new(&config, None).expect("no certificates"));
        let bound = Listeners::bind(&config, &security, &mut HeldSockets::default()).await;
        let Listeners { grpc, handles, .. } = bound.expect("a free port");
        let status = VehicleStatus::new("car".into(), 1, Vec::new(), event_queue(1).0.drops());
        let (status, (_, newest)) = (Arc::new(status), watch::channel(None));
        let vehicles = Vehicles([Served::new(status.clone(), newest, Wires::new(&[]), None)].into());
        let watching = tokio::spawn(watch_listeners((security, handles.clone()), vehicles, pending()));

        let of_listener = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let of_listener = of_listener.expect("a thread");
        of_listener.spawn(grpc.expect("gRPC is served").serve(axum::Router::new(), pending()));
        until(|| handles[0].1.silent().is_some()).await;
        assert_eq!(status.fault(), None);
        let (hang, hung) = std::sync::mpsc::channel::<()>();
        of_listener.spawn(async move { hung.recv() });
        until(|| status.fault().is_some()).await;
        assert!(status.fault().is_some_and(|fault| fault.starts_with("the listener grpc has hung for")));
        drop(hang);
        until(|| status.fault().is_none()).await;
        watching.abort();
        of_listener.shutdown_background();
    }
}
