//! UDP sockets -> the event queues of the vehicles. One named OS thread a socket. Several sensors and several vehicles
//! can share a socket; the sender's address identifies the sensor.
//!
//! The threads do nothing else and never wait for an engine. If an engine does not keep up, readings are lost at its
//! event queue, which counts them, and not in the kernel's buffer.
//!
//! To wake a thread costs more than to read a datagram. So a thread that has read datagrams faster than one a pause
//! ([`PAUSE`]) reads again after a pause, and the kernel keeps and stamps what arrives meanwhile.

use std::collections::BTreeSet;
use std::io::{self, PipeReader, PipeWriter};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::AsFd;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_mapping::event::{Body, Cause, UNKNOWN_SOURCE};
use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, Socket, Type};

use crate::base::held_sockets::HeldSockets;
use crate::config::{Listener, Vehicle, listeners};
use crate::ingest::queue::{Arrival, EventQueue, LiveReading, QueueClosedError};
use crate::ingest::sensor_senders::SensorSender;

mod receive;

/// Time between two reads of a socket whose datagrams come faster. Ours: a map is that much later at most, and the
/// threads of one HDL-64E wake a third as often.
const PAUSE: Duration = Duration::from_millis(1);

pub use receive::{BATCH, DATAGRAM_BYTES_MAX, Received, Receiver};

/// The bound sockets of all vehicles, before anything is read.
#[derive(Debug, Default)]
pub struct Sockets(Vec<(Socket, SocketAddr, Listener)>);

/// A socket cannot be bound.
#[derive(Debug, thiserror::Error)]
#[error("{key} = {at}: {source}")]
pub struct BindError {
    /// Index of the first vehicle that is configured with the socket.
    pub vehicle: usize,
    /// The key of the address.
    pub key: &'static str,
    /// The address in the configuration.
    pub at: SocketAddr,
    /// Error of the operating system.
    pub source: io::Error,
}

impl Sockets {
    /// Takes the held sockets at the configured addresses of all vehicles, and binds the others. Logs a warning if the
    /// kernel allows a smaller receive buffer than configured.
    ///
    /// # Errors
    /// [`BindError`] for the first socket that cannot be bound.
    pub fn bind(vehicles: &[Vehicle], held: &mut HeldSockets) -> Result<Self, BindError> {
        let bound = listeners(vehicles).into_iter().map(|listener| match bind(&listener, held) {
            Ok((socket, at)) => Ok((socket, at, listener)),
            Err(source) => {
                let (vehicle, at) = (listener.routes[0].vehicle, listener.at);
                let key = vehicles[vehicle].udp.as_ref().map_or("vehicle.udp", |udp| udp.key_of(at));
                Err(BindError { vehicle, key, at, source })
            }
        });
        Ok(Self(bound.collect::<Result<_, _>>()?))
    }

    /// The bound addresses of a vehicle's first UDP sensor: for data packets, for telemetry.
    pub fn addresses(&self, vehicle: usize) -> Option<(SocketAddr, SocketAddr)> {
        let source = self.0.iter().flat_map(|(.., l)| &l.routes).find(|route| route.vehicle == vehicle)?.source;
        let has_route = |l: &Listener| l.routes.iter().any(|route| (route.vehicle, route.source) == (vehicle, source));
        let mut at = self.0.iter().filter(|(.., listener)| has_route(listener)).map(|(_, at, _)| *at);
        // Data comes before telemetry in `listeners`; both may arrive at one socket.
        let data = at.next()?;
        Some((data, at.next().unwrap_or(data)))
    }

    /// Starts one thread a socket, which reads until [`UdpThreads::stop`]. `queues` are in the order of the vehicles.
    ///
    /// # Errors
    /// [`io::Error`] if the system cannot create a thread or pipe.
    pub fn start(self, queues: &[EventQueue]) -> io::Result<UdpThreads> {
        let (stopped, stop) = io::pipe()?;
        let mut threads = Vec::new();
        for (socket, at, listener) in self.0 {
            let (queues, stopped) = (queues.to_vec(), stopped.try_clone()?);
            let run = move || {
                let mut watch =
                    ThreadWatch { at, listener: &listener, queues: &queues, fault: Some("it panicked".into()) };
                watch.fault = receive(socket, &listener, &queues, &stopped).err().map(|error| error.to_string());
            };
            threads.push(std::thread::Builder::new().name(format!("udp {}", at.port())).spawn(run)?);
        }
        Ok(UdpThreads { stop, threads })
    }
}

/// Tells the vehicles of a socket when its thread ends by a fault; dropped at the end of the thread, also if it panics.
struct ThreadWatch<'a> {
    at: SocketAddr,
    listener: &'a Listener,
    queues: &'a [EventQueue],
    fault: Option<String>,
}

impl Drop for ThreadWatch<'_> {
    fn drop(&mut self) {
        let Some(fault) = self.fault.take() else { return };
        tracing::error!(at = %self.at, %fault, "the thread of a udp socket has ended");
        let vehicles: BTreeSet<usize> = self.listener.routes.iter().map(|route| route.vehicle).collect();
        for vehicle in vehicles {
            let what = format!("the thread of udp socket {} has ended: {fault}", self.at);
            self.queues[vehicle].drops().record_ended_input(what);
        }
    }
}

/// The threads that read the sockets; they end when this is dropped.
#[derive(Debug)]
pub struct UdpThreads {
    stop: PipeWriter,
    threads: Vec<JoinHandle<()>>,
}

impl UdpThreads {
    /// Ends all threads; each reports its queues' drops to the engines first. Blocks until all have ended.
    pub fn stop(self) {
        drop(self.stop);
        for thread in self.threads {
            if thread.join().is_err() {
                tracing::error!("a udp thread panicked");
            }
        }
    }
}

fn bind(listener: &Listener, held: &mut HeldSockets) -> io::Result<(Socket, SocketAddr)> {
    let Listener { at, receive_buffer_bytes, groups, .. } = listener;
    let held = held.take_udp(*at).map(Socket::from);
    let is_held = held.is_some();
    let socket = match held {
        Some(socket) => socket,
        None => Socket::new(Domain::for_address(*at), Type::DGRAM, Some(Protocol::UDP))?,
    };
    socket.set_recv_buffer_size(*receive_buffer_bytes)?;
    // Linux reports twice the requested size, because it adds as much for its own bookkeeping.
    let granted = socket.recv_buffer_size()? / 2;
    if granted < *receive_buffer_bytes {
        let requested = receive_buffer_bytes;
        tracing::warn!(%at, requested, granted, "receive buffer clamped: raise net.core.rmem_max");
    }
    socket.set_nonblocking(true)?;
    if at.is_ipv6() && !is_held {
        // An IPv6 socket at [::] receives IPv4 too, with any setting of net.ipv6.bindv6only.
        socket.set_only_v6(false)?;
    }
    if !is_held {
        socket.bind(&(*at).into())?;
    }
    for (group, interface) in groups {
        joined(join_group(&socket, *group, interface)).map_err(|error| {
            io::Error::new(error.kind(), format!("join {group} on interface {interface:?}: {error}"))
        })?;
    }
    let at = socket.local_addr()?.as_socket().ok_or(io::ErrorKind::AddrNotAvailable)?;
    Ok((socket, at))
}

/// A held socket has joined its groups before.
fn joined(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::AddrInUse => Ok(()),
        other => other,
    }
}

fn join_group(socket: &Socket, group: IpAddr, interface: &str) -> io::Result<()> {
    let index = if interface.is_empty() { None } else { Some(if_nametoindex(interface)?) };
    match group {
        IpAddr::V4(group) => {
            let any = InterfaceIndexOrAddress::Address(Ipv4Addr::UNSPECIFIED);
            let on = index.map_or(any, InterfaceIndexOrAddress::Index);
            socket.join_multicast_v4_n(&group, &on)?;
            // Otherwise the socket receives every group that any program of this host has joined.
            socket.set_multicast_all_v4(false)
        }
        IpAddr::V6(group) => {
            socket.join_multicast_v6(&group, index.unwrap_or(0))?;
            socket.set_multicast_all_v6(false)
        }
    }
}

/// Reads one socket until the other end of `stopped` is closed, or until all engines behind the socket have stopped.
fn receive(socket: Socket, listener: &Listener, queues: &[EventQueue], stopped: &PipeReader) -> io::Result<()> {
    let mut receiver = Receiver::new(socket)?;
    let mut batches: Vec<VehicleBatch> = Vec::new();
    for route in &listener.routes {
        if !batches.iter().any(|batch| batch.vehicle == route.vehicle) {
            let queue = &queues[route.vehicle];
            batches.push(VehicleBatch { vehicle: route.vehicle, queue, readings: Vec::new() });
        }
    }
    let of_drops = if let [only] = &listener.routes[..] { only.source } else { UNKNOWN_SOURCE };
    let mut datagrams = Vec::with_capacity(BATCH);
    let mut last_read: Option<Instant> = None;
    while wait_readable(receiver.socket(), stopped)? {
        match receiver.receive(&mut datagrams) {
            // The destination of a datagram that the kernel dropped is unknown, so every vehicle counts it.
            Ok(drops) => batches.iter().for_each(|batch| batch.queue.record_drop(of_drops, Cause::Kernel, drops)),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
            // The error concerns one datagram (an ICMP reply, for example), not the socket.
            Err(error) => tracing::warn!(at = %listener.at, %error, "udp receive"),
        }
        let (read, now) = (datagrams.len(), Instant::now());
        for datagram in datagrams.drain(..) {
            route(datagram, listener, &mut batches, now);
        }
        batches.retain_mut(|batch| batch.push().is_ok());
        if batches.is_empty() {
            return Ok(());
        }
        let is_fast = read > 1 || last_read.is_some_and(|last| last.elapsed() < PAUSE);
        last_read = Some(Instant::now());
        // After a whole batch more datagrams may wait.
        if is_fast && read < BATCH {
            std::thread::sleep(PAUSE);
        }
    }
    for batch in batches {
        // A closed queue has no engine that could count the drops.
        let _ = batch.queue.report_drops(None);
    }
    Ok(())
}

/// The datagrams of one receive call for one vehicle.
#[derive(Debug)]
struct VehicleBatch<'a> {
    vehicle: usize,
    queue: &'a EventQueue,
    readings: Vec<LiveReading>,
}

impl VehicleBatch<'_> {
    fn push(&mut self) -> Result<(), QueueClosedError> {
        if self.readings.is_empty() { Ok(()) } else { self.queue.push(self.readings.drain(..)).map(drop) }
    }
}

/// Adds a datagram to the batch of its vehicle. The first vehicle of the socket counts a datagram of an unknown sender
/// or without sender, so that exactly one ledger has each datagram.
fn route(datagram: Received, listener: &Listener, batches: &mut [VehicleBatch<'_>], now: Instant) {
    let known = datagram.peer.and_then(|peer| Some((peer, listener.route(peer)?)));
    let Some((peer, route)) = known else {
        match (batches.first(), datagram.peer) {
            (Some(first), Some(peer)) => first.queue.refuse_unknown_sender(peer),
            (Some(first), None) => first.queue.record_drop(0, Cause::Sender, 1),
            (None, _) => {}
        }
        return;
    };
    let Some(batch) = batches.iter_mut().find(|batch| batch.vehicle == route.vehicle) else { return };
    if datagram.length > DATAGRAM_BYTES_MAX {
        batch.queue.record_drop(route.source, Cause::Length, 1);
    } else {
        let body = Body::Datagram(datagram.payload);
        // A sensor sends its telemetry from another port.
        if datagram.length != TELEMETRY_LENGTH {
            batch.queue.drops().senders.note(route.source, &body, &SensorSender::Address(peer), now);
        }
        batch.readings.push(LiveReading::new(Arrival::Received(datagram.received_ns), route.source, body));
    }
}

/// Waits for a datagram. Returns false once the other end of `stopped` is closed.
fn wait_readable(socket: &Socket, stopped: &PipeReader) -> io::Result<bool> {
    let mut ends = [PollFd::new(socket.as_fd(), PollFlags::POLLIN), PollFd::new(stopped.as_fd(), PollFlags::POLLIN)];
    match poll(&mut ends, PollTimeout::NONE) {
        Ok(_) => Ok(ends[1].revents().is_none_or(|events| events.is_empty())),
        // A signal interrupted the wait.
        Err(nix::Error::EINTR) => Ok(true),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use clearway_mapping::ledger::Ledger;

    use super::*;
    use crate::config::{Config, Udp};
    use crate::ingest::queue::event_queue;

    #[test]
    fn a_thread_that_ends_by_a_fault_is_known_to_its_vehicles() {
        let mut config = Config::of_one_vehicle("car", "top");
        config.vehicles[0].udp = Some(Udp::default());
        let listener = &listeners(&config.vehicles)[0];
        let (queue, _events) = event_queue(4);
        let watch = |fault| ThreadWatch { at: listener.at, listener, queues: std::slice::from_ref(&queue), fault };
        drop(watch(None));
        assert!(queue.drops().ended_inputs().is_empty());
        drop(watch(Some("no memory".into())));
        assert!(queue.drops().ended_inputs()[0].ends_with("has ended: no memory"));
    }

    #[test]
    fn a_datagram_without_a_sender_is_refused_and_counted() {
        let mut config = Config::of_one_vehicle("car", "top");
        config.vehicles[0].udp = Some(Udp::default());
        let listener = &listeners(&config.vehicles)[0];
        let (queue, _events) = event_queue(4);
        let mut batches = [VehicleBatch { vehicle: 0, queue: &queue, readings: Vec::new() }];
        let datagram = |peer| Received { peer, received_ns: Some(7), length: 3, payload: "abc".into() };
        route(datagram(None), listener, &mut batches, Instant::now());
        route(datagram(Some(([10, 0, 0, 1], 2368).into())), listener, &mut batches, Instant::now());
        let [LiveReading { arrival: Arrival::Received(Some(7)), source: 0, body, .. }] = &batches[0].readings[..]
        else {
            panic!("{batches:?}")
        };
        assert_eq!(*body, Body::Datagram("abc".into()));
        let mut ledger = Ledger::default();
        queue.drops().add_unreported_to(&mut ledger, []);
        assert_eq!((ledger.received, ledger.refused), (1, [("source", 1)].into()));
        assert!(queue.drops().unknown_senders().is_empty());
    }
}
