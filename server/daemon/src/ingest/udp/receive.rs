//! One socket -> batches of datagrams with their times of arrival, and the number of datagrams that the kernel dropped.
//!
//! One call (`recvmmsg`) reads the datagrams that wait, at most a batch of them; a second one (`SO_MEMINFO`) then reads
//! the socket's drop counter. The kernel drops a datagram only while others wait, and a call that reads them follows,
//! so no drop stays uncounted, also if no datagram comes after it. Both calls go through nix, so that no `unsafe` is
//! needed here.
//! The kernel stamps each datagram when it arrives (`SO_TIMESTAMPNS`), so that a server that stood still knows how old
//! the datagrams are that it reads. nix' `recvmmsg` does not restore the lengths of its control buffers, so each call
//! gets new ones. The datagrams of a slab share one allocation, which lives as long as the last of them.

use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::os::fd::AsRawFd;
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use nix::sys::socket::sockopt::ReceiveTimestampns;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, MultiHeaders, RecvMsg, SockaddrStorage, getsockopt, recvmmsg, setsockopt,
};
use nix::sys::time::TimeSpec;
use nix::{getsockopt_impl, libc, sockopt_impl};
use socket2::Socket;

/// Greatest length of a datagram in bytes. Ours: longer than an Ethernet frame and than the packets of all sensors, so
/// only fragmented datagrams are longer.
pub const DATAGRAM_BYTES_MAX: usize = 1536;
/// Greatest number of datagrams in a batch. Ours: an HDL-64E sends as many in 18 ms.
pub const BATCH: usize = 64;
/// Number of datagrams in a slab, of one batch or of several.
const SLOTS: usize = 2 * BATCH;

sockopt_impl!(
    /// The memory of a socket: `SK_MEMINFO_*` of the kernel's `sock_diag.h`.
    MemoryInfo,
    GetOnly,
    libc::SOL_SOCKET,
    libc::SO_MEMINFO,
    [u32; 9]
);
/// Index of the socket's drop counter in [`MemoryInfo`].
const SK_MEMINFO_DROPS: usize = 8;

/// A datagram with its sender and the kernel's stamp.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// The sender's address; an IPv4 address also if an IPv6 socket received it. `None` if the kernel gives none.
    pub peer: Option<SocketAddr>,
    /// Time at which the kernel received the datagram, ns since the Unix epoch; `None` if the kernel does not tell.
    pub received_ns: Option<i64>,
    /// The datagram's length in bytes.
    pub length: usize,
    /// The first [`DATAGRAM_BYTES_MAX`] bytes of the datagram.
    pub payload: Bytes,
}

/// Receives from one non-blocking socket.
pub struct Receiver {
    socket: Socket,
    slab: BytesMut,
    /// The kernel's drop counter at the last call; it wraps around.
    drops: u32,
}

impl Receiver {
    /// A receiver for `socket`; the kernel stamps the socket's datagrams from now on.
    ///
    /// # Errors
    /// [`io::Error`] if the kernel does not tell the drop counter.
    pub fn new(socket: Socket) -> io::Result<Self> {
        getsockopt(&socket, MemoryInfo)?;
        if let Err(error) = setsockopt(&socket, ReceiveTimestampns, &true) {
            tracing::warn!(%error, "the kernel does not stamp datagrams: they are stamped when they are read");
        }
        Ok(Self { socket, slab: BytesMut::new(), drops: 0 })
    }

    /// The socket from which datagrams are read.
    pub fn socket(&self) -> &Socket {
        &self.socket
    }

    /// Appends the waiting datagrams, at most [`BATCH`], to `batch`. Returns the number of datagrams that the kernel
    /// dropped since the last call.
    ///
    /// # Errors
    /// [`io::Error`] of the kind `WouldBlock` if no datagram waits; of another kind if the kernel reports an error.
    pub fn receive(&mut self, batch: &mut Vec<Received>) -> io::Result<u64> {
        if self.slab.is_empty() {
            self.slab = BytesMut::zeroed(SLOTS * DATAGRAM_BYTES_MAX);
        }
        // With MSG_TRUNC the kernel returns the true length of a datagram that is longer than its slot.
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_TRUNC;
        let slots = self.slab.chunks_exact_mut(DATAGRAM_BYTES_MAX).take(BATCH);
        let mut slots: Vec<_> = slots.map(|slot| [IoSliceMut::new(slot)]).collect();
        let mut headers = MultiHeaders::preallocate(BATCH, Some(nix::cmsg_space!(TimeSpec)));
        let messages = recvmmsg(self.socket.as_raw_fd(), &mut headers, &mut slots, flags, None)?;
        let found = messages.map(|message| (peer_of(&message), received_ns_of(&message), message.bytes));
        let found: Vec<_> = found.collect();
        for (peer, received_ns, length) in found {
            let mut slot = self.slab.split_to(DATAGRAM_BYTES_MAX);
            slot.truncate(length);
            batch.push(Received { peer, received_ns, length, payload: slot.freeze() });
        }
        let drops = getsockopt(&self.socket, MemoryInfo)?[SK_MEMINFO_DROPS];
        Ok(u64::from(drops.wrapping_sub(std::mem::replace(&mut self.drops, drops))))
    }
}

fn received_ns_of(message: &RecvMsg<'_, '_, SockaddrStorage>) -> Option<i64> {
    message.cmsgs().ok()?.find_map(|control| match control {
        ControlMessageOwned::ScmTimestampns(at) => i64::try_from(Duration::from(at).as_nanos()).ok(),
        _ => None,
    })
}

fn peer_of(message: &RecvMsg<'_, '_, SockaddrStorage>) -> Option<SocketAddr> {
    let address = message.address.as_ref()?;
    let v4 = address.as_sockaddr_in().map(|a| (IpAddr::V4(a.ip()), a.port()));
    let (ip, port) = v4.or_else(|| address.as_sockaddr_in6().map(|a| (IpAddr::V6(a.ip()), a.port())))?;
    Some(SocketAddr::new(ip.to_canonical(), port))
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::time::Instant;

    use super::*;
    use crate::base::clock::now_ns;

    #[test]
    fn datagrams_that_are_read_late_have_the_time_at_which_the_kernel_received_them() {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_nonblocking(true).unwrap();
        let at = socket.local_addr().unwrap();
        let (sender, mut receiver) = (UdpSocket::bind("127.0.0.1:0").unwrap(), Receiver::new(socket.into()).unwrap());
        let began = Instant::now();
        // The kernel begins to stamp shortly after it was told to: until then, it stamps when the datagram is read.
        loop {
            assert!(began.elapsed() < Duration::from_secs(60), "the kernel does not stamp");
            let from_ns = now_ns();
            (0..3).for_each(|_| _ = sender.send_to(&[7; 1206], at).unwrap());
            let to_ns = now_ns();
            while now_ns() <= to_ns + 1_000_000 {
                std::thread::yield_now();
            }
            let mut batch = Vec::new();
            while batch.len() < 3 {
                assert!(began.elapsed() < Duration::from_secs(60), "{} of 3 datagrams", batch.len());
                let _ = receiver.receive(&mut batch);
            }
            let stamps: Vec<i64> = batch.iter().map(|datagram| datagram.received_ns.expect("a stamp")).collect();
            if stamps.iter().all(|ns| (from_ns..=to_ns).contains(ns)) {
                assert!(stamps.is_sorted() && batch.iter().all(|datagram| datagram.payload[..] == [7; 1206]));
                return;
            }
        }
    }

    #[test]
    fn the_kernels_drops_are_counted_beside_its_stamps() {
        let socket = Socket::new(socket2::Domain::IPV4, socket2::Type::DGRAM, None).unwrap();
        socket.set_recv_buffer_size(8192).unwrap();
        socket.set_nonblocking(true).unwrap();
        socket.bind(&"127.0.0.1:0".parse::<SocketAddr>().unwrap().into()).unwrap();
        let at = socket.local_addr().unwrap().as_socket().unwrap();
        let (sender, mut receiver) = (UdpSocket::bind("127.0.0.1:0").unwrap(), Receiver::new(socket).unwrap());
        let (mut sent, mut received, mut drops, mut batch) = (0, 0, 0, Vec::new());
        for _ in 0..1_000 {
            (0..20).for_each(|_| _ = sender.send_to(&[7; 1206], at).unwrap());
            sent += 20;
            while let Ok(dropped) = receiver.receive(&mut batch) {
                drops += dropped;
                received += batch.drain(..).filter(|datagram| datagram.received_ns.is_some()).count() as u64;
            }
            assert_eq!(received + drops, sent, "also those that no datagram follows");
        }
        assert!(drops > 1_000, "{drops}");
    }
}
