//! UDP sockets -> the vehicles' doors. One named OS thread a socket; several sensors and several vehicles can share a
//! socket and are told apart by their senders.
//!
//! The threads do nothing else and wait for nobody: where an engine does not keep up, readings are lost in its door's
//! queue and counted there, not in the kernel's buffer.

use std::io::{self, PipeReader, PipeWriter};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::AsFd;
use std::thread::JoinHandle;

use clearway_mapping::event::{Body, Cause};
use nix::net::if_::if_nametoindex;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, Socket, Type};

use super::{Closed, Door};
use crate::config::{Listener, Vehicle, listeners};

mod receive;

pub use receive::{BATCH, DATAGRAM_BYTES_MAX, Received, Receiver};

/// The bound sockets of all vehicles, before anything is read.
#[derive(Debug, Default)]
pub struct Sockets(Vec<(Socket, SocketAddr, Listener)>);

/// A socket that cannot be had.
#[derive(Debug, thiserror::Error)]
#[error("udp {at}: {source}")]
pub struct BindError {
    /// Index of the first vehicle that asks for it.
    pub vehicle: usize,
    /// Where it was to be bound.
    pub at: SocketAddr,
    /// Why.
    pub source: io::Error,
}

impl Sockets {
    /// Binds what the vehicles ask for, with the receive buffers asked for; says so when the kernel gives less.
    ///
    /// # Errors
    /// [`BindError`] for the first socket that cannot be had.
    pub fn bind(vehicles: &[Vehicle]) -> Result<Self, BindError> {
        let bound = listeners(vehicles).into_iter().map(|listener| match bind(&listener) {
            Ok((socket, at)) => Ok((socket, at, listener)),
            Err(source) => Err(BindError { vehicle: listener.routes[0].vehicle, at: listener.at, source }),
        });
        Ok(Self(bound.collect::<Result<_, _>>()?))
    }

    /// Where a vehicle's first sensor that sends datagrams is heard: data, telemetry.
    pub fn addresses(&self, vehicle: usize) -> Option<(SocketAddr, SocketAddr)> {
        let source = self.0.iter().flat_map(|(.., l)| &l.routes).find(|route| route.vehicle == vehicle)?.source;
        let hears = |l: &Listener| l.routes.iter().any(|route| (route.vehicle, route.source) == (vehicle, source));
        let mut at = self.0.iter().filter(|(.., listener)| hears(listener)).map(|(_, at, _)| *at);
        // Data comes before telemetry in `listeners`; both may arrive at one socket.
        let data = at.next()?;
        Some((data, at.next().unwrap_or(data)))
    }

    /// Reads all sockets, each on a thread of its own, until the [`Readers`] are stopped; `doors` in the order of the
    /// vehicles.
    ///
    /// # Errors
    /// What the system says where it has no thread or pipe to give.
    pub fn read(self, doors: &[Door]) -> io::Result<Readers> {
        let (stopped, stop) = io::pipe()?;
        let mut threads = Vec::new();
        for (socket, at, listener) in self.0 {
            let (doors, stopped) = (doors.to_vec(), stopped.try_clone()?);
            let read = move || {
                if let Err(error) = read(socket, &listener, &doors, &stopped) {
                    tracing::error!(%at, %error, "udp ended");
                }
            };
            threads.push(std::thread::Builder::new().name(format!("udp {}", at.port())).spawn(read)?);
        }
        Ok(Readers { stop, threads })
    }
}

/// The running threads; they end when this is dropped.
#[derive(Debug)]
pub struct Readers {
    stop: PipeWriter,
    threads: Vec<JoinHandle<()>>,
}

impl Readers {
    /// Ends all threads, and has their doors tell what stayed outside. Blocks until that is done.
    pub fn stop(self) {
        drop(self.stop);
        for thread in self.threads {
            if thread.join().is_err() {
                tracing::error!("a udp thread panicked");
            }
        }
    }
}

fn bind(listener: &Listener) -> io::Result<(Socket, SocketAddr)> {
    let Listener { at, receive_buffer_bytes, groups, .. } = listener;
    let socket = Socket::new(Domain::for_address(*at), Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_recv_buffer_size(*receive_buffer_bytes)?;
    // Linux reports twice what it was asked for: half of it is its own bookkeeping.
    let given = socket.recv_buffer_size()? / 2;
    if given < *receive_buffer_bytes {
        tracing::warn!(%at, asked = receive_buffer_bytes, given, "receive buffer clamped: raise net.core.rmem_max");
    }
    socket.set_nonblocking(true)?;
    if at.is_ipv6() {
        // [::] hears IPv4 too, whatever net.ipv6.bindv6only says.
        socket.set_only_v6(false)?;
    }
    socket.bind(&(*at).into())?;
    for (group, interface) in groups {
        join(&socket, *group, interface).map_err(|error| {
            io::Error::new(error.kind(), format!("join {group} on interface {interface:?}: {error}"))
        })?;
    }
    let at = socket.local_addr()?.as_socket().ok_or(io::ErrorKind::AddrNotAvailable)?;
    Ok((socket, at))
}

fn join(socket: &Socket, group: IpAddr, interface: &str) -> io::Result<()> {
    let index = if interface.is_empty() { None } else { Some(if_nametoindex(interface)?) };
    match group {
        IpAddr::V4(group) => {
            let any = InterfaceIndexOrAddress::Address(Ipv4Addr::UNSPECIFIED);
            let on = index.map_or(any, InterfaceIndexOrAddress::Index);
            socket.join_multicast_v4_n(&group, &on)?;
            // Otherwise every group that anybody on this host has joined is heard.
            socket.set_multicast_all_v4(false)
        }
        IpAddr::V6(group) => {
            socket.join_multicast_v6(&group, index.unwrap_or(0))?;
            socket.set_multicast_all_v6(false)
        }
    }
}

/// Reads one socket until `stopped` has no other end any more, or every engine behind it has stopped.
fn read(socket: Socket, listener: &Listener, doors: &[Door], stopped: &PipeReader) -> io::Result<()> {
    let mut receiver = Receiver::new(socket)?;
    let mut heard: Vec<Heard> = Vec::new();
    for route in &listener.routes {
        if !heard.iter().any(|heard| heard.vehicle == route.vehicle) {
            heard.push(Heard { vehicle: route.vehicle, door: &doors[route.vehicle], readings: Vec::new() });
        }
    }
    let mut batch = Vec::with_capacity(BATCH);
    while wait(receiver.socket(), stopped)? {
        match receiver.receive(&mut batch) {
            // Any of them may have been meant.
            Ok(drops) => heard.iter().for_each(|heard| heard.door.leave_outside(0, Cause::Kernel, drops)),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => continue,
            // It belongs to one datagram (an ICMP answer, say); the socket goes on.
            Err(error) => tracing::warn!(at = %listener.at, %error, "udp receive"),
        }
        for datagram in batch.drain(..) {
            sort(datagram, listener, &mut heard);
        }
        heard.retain_mut(|heard| heard.enter().is_ok());
        if heard.is_empty() {
            return Ok(());
        }
    }
    for heard in heard {
        // A closed door has nobody to tell.
        let _ = heard.door.close(None);
    }
    Ok(())
}

/// One vehicle that is heard at a socket.
struct Heard<'a> {
    vehicle: usize,
    door: &'a Door,
    /// What came for it in one batch.
    readings: Vec<(u16, Body)>,
}

impl Heard<'_> {
    fn enter(&mut self) -> Result<(), Closed> {
        if self.readings.is_empty() { Ok(()) } else { self.door.enter_all(self.readings.drain(..)) }
    }
}

/// Gives a datagram to its vehicle. One of a stranger, or of nobody, is counted by the first vehicle of the socket, so
/// that each datagram is in one ledger.
fn sort(datagram: Received, listener: &Listener, heard: &mut [Heard<'_>]) {
    let Some(route) = datagram.peer.and_then(|peer| listener.route(peer)) else {
        match (heard.first(), datagram.peer) {
            (Some(first), Some(peer)) => first.door.refuse_stranger(peer),
            (Some(first), None) => first.door.leave_outside(0, Cause::Sender, 1),
            (None, _) => {}
        }
        return;
    };
    let Some(heard) = heard.iter_mut().find(|heard| heard.vehicle == route.vehicle) else { return };
    if datagram.length > DATAGRAM_BYTES_MAX {
        heard.door.leave_outside(route.source, Cause::Length, 1);
    } else {
        heard.readings.push((route.source, Body::Datagram(datagram.payload)));
    }
}

/// Waits for a datagram; `false` when there is nothing more to wait for.
fn wait(socket: &Socket, stopped: &PipeReader) -> io::Result<bool> {
    let mut ends = [PollFd::new(socket.as_fd(), PollFlags::POLLIN), PollFd::new(stopped.as_fd(), PollFlags::POLLIN)];
    match poll(&mut ends, PollTimeout::NONE) {
        Ok(_) => Ok(ends[1].revents().is_none_or(|happened| happened.is_empty())),
        // A signal.
        Err(nix::Error::EINTR) => Ok(true),
        Err(error) => Err(error.into()),
    }
}

#[cfg(test)]
mod tests {
    use clearway_mapping::ledger::Ledger;

    use super::*;
    use crate::config::{Config, Udp};
    use crate::ingest::door;

    #[test]
    fn a_datagram_without_a_sender_is_refused_and_counted() {
        let mut config = Config::of_one_vehicle("car", "top");
        config.vehicles[0].udp = Some(Udp::default());
        let listener = &listeners(&config.vehicles)[0];
        let (door, _events) = door(4);
        let mut heard = [Heard { vehicle: 0, door: &door, readings: Vec::new() }];
        let of = |peer| Received { peer, length: 3, payload: "abc".into() };
        sort(of(None), listener, &mut heard);
        sort(of(Some(([10, 0, 0, 1], 2368).into())), listener, &mut heard);
        assert_eq!(heard[0].readings, [(0, Body::Datagram("abc".into()))]);
        let mut ledger = Ledger::default();
        door.outside().add_to(&mut ledger, []);
        assert_eq!((ledger.received, ledger.refused), (1, [("source", 1)].into()));
        assert!(door.outside().strangers().is_empty());
    }
}
