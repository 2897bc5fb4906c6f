//! A running server, and its shutdown.

use std::net::SocketAddr;
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;

use super::input::VehicleInput;
use super::setup::ShutdownError;
use crate::base::sync::locked;
use crate::config::{Certificates, Config};
use crate::engine::Engine;
use crate::engine::subscriptions::LayerSubscription;
use crate::fleet::Fleet;
use crate::ingest::queue::QueuedEvent;
use crate::ingest::udp;
use crate::publish::Vehicles;
use crate::publish::listen::ListenerHandle;
use crate::publish::listen::security::{Current, Security};
use crate::record::writer::Recorder;
use crate::replay_control::ReplayHandle;
use crate::traces::Traces;

/// Longest time of [`Running::shutdown_in_time`]. Ours: service managers wait 10 s or more before they kill a server.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_millis(4500);
/// Longest wait for each kind of publisher at shutdown. Ours: a stalled peer must not keep the server from ending.
const PUBLISHERS_STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// A running server. If it is dropped without [`Running::shutdown`], the recording stays unfinished.
#[derive(Default)]
pub struct Running {
    /// The newest maps and the status of all vehicles.
    pub vehicles: Vehicles,
    /// The vehicles of other servers.
    pub fleet: Fleet,
    /// The inputs of all vehicles.
    pub inputs: Vec<VehicleInput>,
    /// The address of gRPC.
    pub grpc: Option<SocketAddr>,
    /// The address of the page.
    pub page: Option<SocketAddr>,
    /// The address of `/healthz`, `/readyz` and `/metrics` alone.
    pub metrics: Option<SocketAddr>,
    /// The endpoints of zenoh.
    pub zenoh: Vec<String>,
    /// The address of the Foxglove WebSocket.
    pub foxglove: Option<SocketAddr>,
    /// The engines that the caller steps, with the events of their queues; in the order of the vehicles. They must be
    /// dropped before [`Running::shutdown`].
    pub stepped: Vec<(Engine, Receiver<QueuedEvent>)>,
    /// Controls the replay that the server serves.
    pub(super) replay: Option<ReplayHandle>,
    pub(super) engines: Vec<(Arc<str>, JoinHandle<()>)>,
    pub(super) recorder: Option<Recorder>,
    pub(super) udp: Option<udp::UdpThreads>,
    pub(super) publishers: JoinSet<()>,
    pub(super) stop: watch::Sender<bool>,
    /// What the shutdown waits for.
    shutdown_step: Arc<Mutex<&'static str>>,
    /// Layers that are computed with or without readers; held until the end.
    pub(super) subscriptions: Vec<LayerSubscription>,
    /// The security and the counts of the TCP listeners.
    pub(super) listeners: Option<(Security, Vec<(&'static str, ListenerHandle)>)>,
    pub(super) traces: Traces,
    #[cfg(feature = "zenoh")]
    pub(super) connected: super::router::Connected,
    /// Waits for the router and watches it, or watches the endpoints to which a peer connects.
    #[cfg(feature = "zenoh")]
    pub(super) connecting: JoinSet<()>,
}

impl Running {
    /// Logs every address at which the server listens, and the recording.
    pub fn log_endpoints(&self) {
        for vehicle in &self.inputs {
            if let Some((data, telemetry)) = vehicle.udp {
                tracing::info!(vehicle = %vehicle.name, %data, %telemetry, "listening for datagrams");
            }
        }
        if let Some(at) = self.grpc {
            tracing::info!(%at, "gRPC");
        }
        let tls = if self.is_encrypted() { "s" } else { "" };
        if let Some(at) = self.page {
            tracing::info!("page http{tls}://{at}/");
        }
        if let Some(at) = self.metrics {
            tracing::info!("metrics http{tls}://{at}/metrics");
        }
        for endpoint in &self.zenoh {
            tracing::info!(%endpoint, "zenoh");
        }
        if let Some(at) = self.foxglove {
            tracing::info!("foxglove ws{tls}://{at}");
        }
        if let Some(recording) = self.recording() {
            tracing::info!(%recording, "recording");
        }
    }

    /// The path of the recording, if the server records and the disk has answered.
    pub fn recording(&self) -> Option<String> {
        let file = self.recorder.as_ref().map(|recorder| recorder.counts().to_proto().file);
        file.filter(|file| !file.is_empty())
    }

    /// What of the vehicles has stopped or hangs, as `/healthz` says it; `None` if nothing has.
    pub fn fault(&self) -> Option<String> {
        self.vehicles.statuses().iter().find_map(|status| status.fault())
    }

    /// True if the TCP listeners have certificates.
    pub fn is_encrypted(&self) -> bool {
        self.listeners.as_ref().is_some_and(|(security, _)| security.current().tls.is_some())
    }

    /// Uses the certificates, tokens, roles and limits of another configuration from now on, for new connections and
    /// new calls. Open connections stay, unless their client has lost its role.
    ///
    /// # Errors
    /// A text that says which certificate is invalid, or that TLS cannot begin or end while the server runs; then
    /// everything stays as it was.
    pub fn reload(&self, config: &Config, certificates: Option<&Certificates>) -> Result<(), String> {
        let Some((security, handles)) = &self.listeners else { return Ok(()) };
        let next = Current::new(config, certificates)?;
        if next.tls.is_some() != security.current().tls.is_some() {
            return Err("TLS begins or ends only with a restart".into());
        }
        security.replace(next.clone());
        for (_, handle) in handles {
            handle.set_limits(config.connections.clone());
            handle.recheck(&next);
        }
        Ok(())
    }

    /// Notes in status and metrics why the configuration was not read again; `None`: it was.
    pub fn note_reload(&self, refused: Option<String>) {
        for status in self.vehicles.statuses() {
            status.network.set_refused_reload(refused.clone());
        }
    }

    /// Resolves when the server stops.
    pub(super) fn stopped(&self) -> impl Future<Output = ()> + Send + use<> {
        let mut stopped = self.stop.subscribe();
        async move {
            // An error means that the sender is gone, so the server stops as well.
            let _ = stopped.wait_for(|stop| *stop).await;
        }
    }

    /// As [`Running::shutdown`], but gives up after 4.5 s whatever a disk or an engine does. Threads may go on then, so
    /// the process should end.
    ///
    /// # Errors
    /// As [`Running::shutdown`], and [`ShutdownError::Deadline`] with the part that did not end.
    pub async fn shutdown_in_time(self) -> Result<(), ShutdownError> {
        let step = self.shutdown_step.clone();
        match tokio::time::timeout(SHUTDOWN_TIMEOUT, self.shutdown()).await {
            Ok(ended) => ended,
            Err(_) => Err(ShutdownError::Deadline { waiting_for: *locked(&step), limit: SHUTDOWN_TIMEOUT }),
        }
    }

    /// Ends the server in order: first the inputs, then the engines after their last event, the recorder after the last
    /// map, and the publishers at the end.
    ///
    /// # Errors
    /// [`ShutdownError`] if an engine panicked or the recording is incomplete; everything has ended then as well.
    pub async fn shutdown(mut self) -> Result<(), ShutdownError> {
        self.stepped.clear();
        let step = self.shutdown_step.clone();
        let begin = |what: &'static str| *locked(&step) = what;
        begin("the sockets' threads");
        if let Some(threads) = self.udp.take() {
            // Fails only if the runtime shuts down; then the threads end by themselves.
            let _ = tokio::task::spawn_blocking(move || threads.stop()).await;
        }
        #[cfg(feature = "zenoh")]
        {
            self.connecting.shutdown().await;
            if let Some(over_zenoh) = &mut self.connected.lock().await.over_zenoh {
                over_zenoh.stop_ros().await;
            }
        }
        begin("the event queues");
        let inputs = std::mem::take(&mut self.inputs);
        let close_queues = move || {
            for input in inputs {
                // Fails only if the engine has stopped already.
                let _ = input.queue.report_drops(None);
                input.queue.close();
            }
        };
        let _ = tokio::task::spawn_blocking(close_queues).await;
        let (engines, recorder) = (self.engines, self.recorder);
        let of_finish = step.clone();
        let finished = tokio::task::spawn_blocking(move || finish(engines, recorder, &of_finish)).await;
        let outcome = finished.unwrap_or_else(|error| Err(error.into()));
        begin("the publishers");
        self.stop.send_replace(true);
        let mut publishers = self.publishers;
        let all = async { while publishers.join_next().await.is_some() {} };
        if tokio::time::timeout(PUBLISHERS_STOP_TIMEOUT, all).await.is_err() {
            publishers.shutdown().await;
        }
        #[cfg(feature = "zenoh")]
        if let Some(over_zenoh) = self.connected.lock().await.over_zenoh.take()
            && tokio::time::timeout(PUBLISHERS_STOP_TIMEOUT, over_zenoh.stop()).await.is_err()
        {
            tracing::warn!("zenoh did not close in time");
        }
        begin("the traces");
        let traces = self.traces;
        // Fails only if the runtime shuts down.
        let _ = tokio::task::spawn_blocking(move || traces.end()).await;
        outcome
    }
}

/// Waits for the engines, and then for the recorder, whose error matters more than an engine's error.
fn finish(
    engines: Vec<(Arc<str>, JoinHandle<()>)>,
    recorder: Option<Recorder>,
    step: &Mutex<&'static str>,
) -> Result<(), ShutdownError> {
    let mut outcome = Ok(());
    *locked(step) = "the engines";
    for (name, engine) in engines {
        if engine.join().is_err() {
            outcome = Err(ShutdownError::Engine(name));
        }
    }
    *locked(step) = "the recorder";
    recorder.map_or(Ok(()), Recorder::finish)?;
    outcome
}
