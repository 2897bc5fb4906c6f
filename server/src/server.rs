//! Puts the house together: doors, engines, recorder and publishers of one configuration, started in an order in which
//! nothing is lost and stopped in the reverse one.

use std::collections::BTreeMap;
use std::hash::{BuildHasher, Hasher};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::thread::JoinHandle;
use std::time::Duration;

use clearway_lidar::calibration::Calibration;
use clearway_mapping::pipeline::{Pipeline, layer_names};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::config::{Calibrations, Certificates, Config, Foxglove, Grpc, Vehicle};
use crate::subscriptions::Taken;
use crate::engine::{Engine, Observer};
use crate::ingest::gateway::{Entrance, Entrances};
use crate::ingest::{Door, Queued, door, udp};
use crate::publish::{Served, Vehicles, grpc, page};
use crate::record::writer::{Preface, RecordError, Recorder};
use crate::status::VehicleStatus;

/// A stalled peer may not keep the server from ending.
const PUBLISHERS_STOP: Duration = Duration::from_secs(2);

/// What a server is started with.
#[derive(Default)]
pub struct Setup {
    /// Checked.
    pub config: Config,
    /// Of every sensor, as [`Config::calibrations`] gives them.
    pub calibrations: Calibrations,
    /// As [`Config::certificates`] gives them; gRPC is plain text where there are none.
    pub certificates: Option<Certificates>,
    /// Names this run in maps and recordings; drawn where absent.
    pub boot_id: Option<u64>,
    /// Events come from files: a full recorder queue holds them up, instead of losing anything.
    pub from_files: bool,
    /// Put before the recorded configuration as comments, a line each.
    pub remarks: Vec<String>,
    /// Put into the recording's metadata.
    pub notes: BTreeMap<String, String>,
    /// Looks at what the maps of the first vehicle were made from.
    pub observer: Option<Observer>,
}

/// Why a server did not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A vehicle cannot be as configured.
    #[error(transparent)]
    Vehicle(#[from] clearway_mapping::config::ConfigValueError),
    /// The recording cannot be created.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// An address cannot be listened on.
    #[error("{what} {at}: {source}")]
    Listen {
        /// The configuration key.
        what: &'static str,
        /// The address.
        at: SocketAddr,
        /// Why.
        source: std::io::Error,
    },
    /// The certificates are of no use.
    #[error("grpc.tls: {0}; a PEM certificate (chain), its PEM private key and PEM CA certificates are allowed")]
    Certificates(String),
    /// A vehicle's sockets cannot be bound.
    #[error("vehicle {vehicle}: {source}")]
    Udp {
        /// The vehicle's name.
        vehicle: Arc<str>,
        /// Which address, and why.
        source: udp::BindError,
    },
    /// The sockets cannot be read.
    #[error("no thread for a udp socket: {0}")]
    UdpThread(std::io::Error),
    /// An engine's thread cannot be started.
    #[error("vehicle {vehicle}: no thread for its engine: {source}")]
    Thread {
        /// The vehicle's name.
        vehicle: Arc<str>,
        /// Why.
        source: std::io::Error,
    },
    /// The Foxglove WebSocket cannot be served.
    #[error("foxglove.listen {at}: {source}")]
    Foxglove {
        /// The address.
        at: SocketAddr,
        /// Why.
        source: foxglove::FoxgloveError,
    },
    /// zenoh cannot be published.
    #[cfg(feature = "zenoh")]
    #[error(transparent)]
    Zenoh(#[from] crate::publish::zenoh::ZenohError),
    /// zenoh is asked for, but not built in.
    #[error("zenoh.enabled = true: this clearway was built without the feature zenoh; allowed: false")]
    NoZenoh,
}

/// One vehicle of a running server.
pub struct RunningVehicle {
    /// The vehicle's name.
    pub name: Arc<str>,
    /// Where its events enter.
    pub door: Door,
    /// Where its first sensor that sends datagrams is heard, if any: data, telemetry.
    pub udp: Option<(SocketAddr, SocketAddr)>,
}

/// A running server. Dropping it without [`Running::shutdown`] leaves an unfinished recording.
#[derive(Default)]
pub struct Running {
    /// The newest maps and the status of all vehicles.
    pub vehicles: Vehicles,
    /// The vehicles' doors.
    pub doors: Vec<RunningVehicle>,
    /// Where gRPC is served.
    pub grpc: Option<SocketAddr>,
    /// Where the page is served.
    pub page: Option<SocketAddr>,
    /// Where zenoh listens.
    pub zenoh: Vec<String>,
    /// Where Foxglove connects.
    pub foxglove: Option<SocketAddr>,
    engines: Vec<(Arc<str>, JoinHandle<()>)>,
    recorder: Option<Recorder>,
    udp: Option<udp::Readers>,
    publishers: JoinSet<()>,
    stop: watch::Sender<bool>,
    /// What is made whether or not somebody else takes it; only held.
    taken: Vec<Taken>,
    viewers: Option<crate::publish::foxglove::Publisher>,
    #[cfg(feature = "zenoh")]
    publisher: Option<crate::publish::zenoh::Publisher>,
    #[cfg(feature = "zenoh")]
    ros: Vec<crate::ingest::ros::live::Listener>,
}

/// What did not end as it should have.
#[derive(Debug, thiserror::Error)]
pub enum EndError {
    /// An engine died.
    #[error("the engine of vehicle {0} panicked")]
    Engine(Arc<str>),
    /// The recording is not whole.
    #[error("the recording is not whole: {0}")]
    Recording(String),
}

/// The server.
pub struct Server;

impl Server {
    /// Starts everything the configuration asks for: first all that another may hold already (addresses and ports), then
    /// recorder and engines, and what fills their queues last. Needs a multi-thread tokio runtime.
    ///
    /// # Errors
    /// [`StartError`], after which nothing is left running.
    pub async fn start(setup: Setup) -> Result<Running, StartError> {
        let Setup { config, mut calibrations, certificates, boot_id, from_files, remarks, notes, mut observer } = setup;
        if config.zenoh.enabled && !cfg!(feature = "zenoh") {
            return Err(StartError::NoZenoh);
        }
        let boot_id = boot_id.unwrap_or_else(random);
        calibrations.resize_with(config.vehicles.len(), Vec::new);
        let mut running = Running::default();
        let mut ready = Vec::new();
        for (vehicle, tables) in config.vehicles.iter().zip(&mut calibrations) {
            tables.resize(vehicle.sensors.len(), None);
            let pipeline = Pipeline::new(&vehicle.core(), tables.clone())?;
            ready.push(running.prepare(vehicle, boot_id, pipeline, observer.take()));
        }
        running.vehicles = Vehicles(ready.iter().map(|ready| ready.served.clone()).collect());
        let preface = || preface(&config, &calibrations, boot_id, &remarks, notes);
        match running.begin(&config, certificates, ready, from_files, preface).await {
            Ok(()) => Ok(running),
            Err(error) => {
                // What did not end well is nothing beside what did not begin.
                let _ = running.shutdown().await;
                Err(error)
            }
        }
    }
}

/// One vehicle, before its engine runs.
struct Ready {
    served: Served,
    engine: Engine,
    events: Receiver<Queued>,
}

/// What [`Server::start`] does, in order.
impl Running {
    /// Makes what publishers see of a vehicle, its door, and the engine behind it.
    fn prepare(&mut self, vehicle: &Vehicle, boot_id: u64, pipeline: Pipeline, observer: Option<Observer>) -> Ready {
        let name: Arc<str> = vehicle.name.as_str().into();
        let (door, events) = door(vehicle.queue);
        let layers = layer_names(&vehicle.maps);
        let status = Arc::new(VehicleStatus::new(name.clone(), boot_id, layers, door.outside()));
        let (newest, receiver) = watch::channel(None);
        let valid_ms = vehicle.maps.valid_ms;
        let engine = Engine { pipeline, valid_ms, newest, journal: None, status: status.clone(), observer };
        self.doors.push(RunningVehicle { name, door, udp: None });
        Ready { served: Served { status, newest: receiver }, engine, events }
    }

    async fn begin(
        &mut self,
        config: &Config,
        certificates: Option<Certificates>,
        ready: Vec<Ready>,
        from_files: bool,
        preface: impl FnOnce() -> Preface,
    ) -> Result<(), StartError> {
        // Before the recorder: a port in use must not cost an earlier recording its file.
        let grpc = listen("grpc.listen", config.grpc.enabled.then_some(config.grpc.listen)).await?;
        let page = listen("page.listen", config.page.enabled.then_some(config.page.listen)).await?;
        let security = security(certificates, &config.grpc)?;
        let sockets = udp::Sockets::bind(&config.vehicles).map_err(|source| StartError::Udp {
            vehicle: config.vehicles[source.vehicle].name.as_str().into(),
            source,
        })?;
        let entrances = self.entrances(config);
        if config.foxglove.enabled {
            self.serve_foxglove(&config.foxglove).await?;
        }
        #[cfg(feature = "zenoh")]
        if config.zenoh.enabled {
            self.open_zenoh(config, &entrances).await?;
        }
        self.run_engines(config, ready, from_files, preface)?;
        if let Some(listener) = grpc {
            self.serve_grpc(listener, security, config.grpc.connections_max, entrances);
        }
        if let Some(listener) = page {
            self.serve_page(listener);
        }
        self.hear(sockets)
    }

    /// Begins the recording, if one is wanted, and starts the engines.
    fn run_engines(
        &mut self,
        config: &Config,
        ready: Vec<Ready>,
        from_files: bool,
        preface: impl FnOnce() -> Preface,
    ) -> Result<(), StartError> {
        let mut journals = Vec::new().into_iter();
        if crate::record::writer::wanted(&config.recorder).is_some() {
            let (recorder, ways) = Recorder::start(&config.recorder, &preface(), from_files)?;
            (self.recorder, journals) = (Some(recorder), ways.into_iter());
        }
        for Ready { served: Served { status, .. }, mut engine, events } in ready {
            self.recorder.iter().for_each(|recorder| status.show_recorder(recorder.counts()));
            // Files are read for their maps: who comes late finds the last one, and the summary knows its figures.
            self.taken.extend(from_files.then(|| status.demand.take(&[])));
            engine.journal = journals.next();
            let name = status.name.clone();
            let thread = engine.start(events).map_err(|source| StartError::Thread { vehicle: name.clone(), source })?;
            self.engines.push((name, thread));
        }
        Ok(())
    }

    /// The ways in for observations, of the vehicles that take them.
    fn entrances(&self, config: &Config) -> Entrances {
        let open = config.vehicles.iter().zip(&self.doors).filter(|(vehicle, _)| vehicle.ingest.enabled);
        Entrances::new(open.map(|(vehicle, running)| Entrance::new(vehicle, &running.door)), self.stop.subscribe())
    }

    /// Resolves when the server stops.
    fn stopped(&self) -> impl Future<Output = ()> + Send + use<> {
        let mut stopped = self.stop.subscribe();
        async move {
            // An error means that the sender is gone, which is a stop too.
            let _ = stopped.wait_for(|stop| *stop).await;
        }
    }

    fn serve_grpc(
        &mut self,
        listener: TcpListener,
        security: grpc::Security,
        connections_max: usize,
        entrances: Entrances,
    ) {
        self.grpc = listener.local_addr().ok();
        let (vehicles, stopped) = (self.vehicles.clone(), self.stopped());
        self.publishers.spawn(async move {
            if let Err(error) = grpc::serve(listener, security, connections_max, vehicles, entrances, stopped).await {
                tracing::error!(%error, "grpc ended");
            }
        });
    }

    fn serve_page(&mut self, listener: TcpListener) {
        self.page = listener.local_addr().ok();
        let (vehicles, stopped) = (self.vehicles.clone(), self.stopped());
        self.publishers.spawn(async move {
            if let Err(error) = page::serve(listener, vehicles, stopped).await {
                tracing::error!(%error, "page ended");
            }
        });
    }

    async fn serve_foxglove(&mut self, options: &Foxglove) -> Result<(), StartError> {
        let started = crate::publish::foxglove::Publisher::start(options, &self.vehicles).await;
        let viewers = started.map_err(|source| StartError::Foxglove { at: options.listen, source })?;
        self.foxglove = Some(SocketAddr::new(options.listen.ip(), viewers.port()));
        self.viewers = Some(viewers);
        Ok(())
    }

    /// Publishes over zenoh, and hears what comes over it.
    #[cfg(feature = "zenoh")]
    async fn open_zenoh(&mut self, config: &Config, entrances: &Entrances) -> Result<(), StartError> {
        let publisher = crate::publish::zenoh::Publisher::start(&config.zenoh, &self.vehicles, entrances).await?;
        self.zenoh = publisher.endpoints().await;
        for (vehicle, running) in config.vehicles.iter().zip(&self.doors) {
            let Some(ros) = &vehicle.ros else { continue };
            let sensors = vehicle.sensors.iter().map(|sensor| &sensor.name);
            let door = running.door.clone();
            self.ros.push(crate::ingest::ros::live::listen(publisher.session(), ros, sensors, door).await?);
        }
        self.publisher = Some(publisher);
        Ok(())
    }

    /// Reads the sockets: last, when everything behind them is there.
    fn hear(&mut self, sockets: udp::Sockets) -> Result<(), StartError> {
        for (index, vehicle) in self.doors.iter_mut().enumerate() {
            vehicle.udp = sockets.addresses(index);
        }
        let doors: Vec<Door> = self.doors.iter().map(|vehicle| vehicle.door.clone()).collect();
        self.udp = Some(sockets.read(&doors).map_err(StartError::UdpThread)?);
        Ok(())
    }
}

impl Running {
    /// The file being recorded to.
    pub fn recording(&self) -> Option<String> {
        self.recorder.as_ref().map(|recorder| recorder.counts().to_proto().file)
    }

    /// Ends it all: no more readings, every event taken processed and recorded, the recording finished, the readers
    /// told.
    ///
    /// # Errors
    /// [`EndError`] where an engine had died or the recording is not whole; everything has ended all the same.
    pub async fn shutdown(mut self) -> Result<(), EndError> {
        if let Some(readers) = self.udp.take() {
            // Fails only where the runtime is going down, and the threads end without it.
            let _ = tokio::task::spawn_blocking(move || readers.stop()).await;
        }
        #[cfg(feature = "zenoh")]
        for listener in self.ros {
            listener.stop().await;
        }
        let doors = std::mem::take(&mut self.doors);
        // With the last door the engines end, once their queues are empty. Fails only where an engine is gone already.
        let closed = move || doors.into_iter().for_each(|vehicle| _ = vehicle.door.close(None));
        let _ = tokio::task::spawn_blocking(closed).await;
        let (engines, recorder) = (self.engines, self.recorder);
        let ended = tokio::task::spawn_blocking(move || {
            let mut outcome = Ok(());
            for (name, engine) in engines {
                if engine.join().is_err() {
                    outcome = Err(EndError::Engine(name));
                }
            }
            match recorder.map(Recorder::finish) {
                Some(Err(reason)) => Err(EndError::Recording(reason)),
                _ => outcome,
            }
        });
        let outcome = ended.await.unwrap_or_else(|error| Err(EndError::Recording(error.to_string())));
        self.stop.send_replace(true);
        let mut publishers = self.publishers;
        let all = async { while publishers.join_next().await.is_some() {} };
        if tokio::time::timeout(PUBLISHERS_STOP, all).await.is_err() {
            publishers.shutdown().await;
        }
        if let Some(viewers) = self.viewers
            && tokio::time::timeout(PUBLISHERS_STOP, viewers.stop()).await.is_err()
        {
            tracing::warn!("the Foxglove WebSocket did not close in time");
        }
        #[cfg(feature = "zenoh")]
        if let Some(publisher) = self.publisher
            && tokio::time::timeout(PUBLISHERS_STOP, publisher.stop()).await.is_err()
        {
            tracing::warn!("zenoh did not close in time");
        }
        outcome
    }
}

/// How gRPC's peers are met. Where the configuration names certificates, never without them.
fn security(certificates: Option<Certificates>, grpc: &Grpc) -> Result<grpc::Security, StartError> {
    if grpc.enabled && grpc.tls.is_some() && certificates.is_none() {
        return Err(StartError::Certificates("its files were not read".into()));
    }
    let security = grpc::Security::new(certificates, &grpc.access);
    security.map_err(|error| StartError::Certificates(sources(&error)))
}

/// An error and all that caused it: "transport error" says little.
fn sources(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

async fn listen(what: &'static str, at: Option<SocketAddr>) -> Result<Option<TcpListener>, StartError> {
    let Some(at) = at else { return Ok(None) };
    TcpListener::bind(at).await.map(Some).map_err(|source| StartError::Listen { what, at, source })
}

/// What the recording says before its first event.
fn preface(
    config: &Config,
    calibrations: &[Vec<Option<Calibration>>],
    boot_id: u64,
    remarks: &[String],
    mut notes: BTreeMap<String, String>,
) -> Preface {
    let mut tables = Vec::new();
    for (vehicle, of_vehicle) in config.vehicles.iter().zip(calibrations) {
        for (sensor, table) in vehicle.sensors.iter().zip(of_vehicle) {
            let key = format!("calibration/{}/{}", vehicle.name, sensor.name);
            let source = match &sensor.calibration {
                Some(file) => file.clone(),
                None => "the factory's table of the model, or the one in the sensor's status bytes".into(),
            };
            notes.insert(key, source);
            if let Some(table) = table {
                tables.push((vehicle.name.clone(), sensor.name.clone(), table.to_yaml()));
            }
        }
    }
    let remarks: String = remarks.iter().map(|remark| format!("# {remark}\n")).collect();
    let vehicles = config.vehicles.iter().map(|v| (v.name.as_str().into(), layer_names(&v.maps))).collect();
    Preface { boot_id, config: remarks + &config.to_toml(), vehicles, calibrations: tables, notes }
}

/// Sixty-four bits nobody else has: each `RandomState` is keyed by the system's randomness.
fn random() -> u64 {
    std::hash::RandomState::new().build_hasher().finish()
}
