//! One socket -> batches of datagrams, and the number of datagrams that the kernel dropped.
//!
//! One call (`recvmsg`) reads the first datagram of a batch with the socket's drop counter (`SO_RXQ_OVFL`); a second
//! call (`recvmmsg`) reads all datagrams that wait behind it. Both go through nix, so that no `unsafe` is needed here.
//! nix' `recvmmsg` cannot return the counter, because it does not restore the length of a control buffer. The datagrams
//! of a slab share one allocation, which lives as long as the last of them.

use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::os::fd::AsRawFd;

use bytes::{Bytes, BytesMut};
use nix::sys::socket::sockopt::RxqOvfl;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, MultiHeaders, RecvMsg, SockaddrStorage, recvmmsg, recvmsg, setsockopt,
};
use socket2::Socket;

/// Greatest length of a datagram in bytes. Ours: longer than an Ethernet frame and than the packets of all sensors, so
/// only fragmented datagrams are longer.
pub const DATAGRAM_BYTES_MAX: usize = 1536;
/// Greatest number of datagrams in a batch. Ours: an HDL-64E sends as many in 18 ms.
pub const BATCH: usize = 64;
/// Number of datagrams in a slab, of one batch or of several.
const SLOTS: usize = 2 * BATCH;

/// One datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// The sender's address; an IPv4 address also if an IPv6 socket received it. `None` if the kernel gives none.
    pub peer: Option<SocketAddr>,
    /// The datagram's length in bytes.
    pub length: usize,
    /// The first [`DATAGRAM_BYTES_MAX`] bytes of the datagram.
    pub payload: Bytes,
}

/// Receives from one non-blocking socket.
pub struct Receiver {
    socket: Socket,
    slab: BytesMut,
    headers: MultiHeaders<SockaddrStorage>,
    /// The kernel's drop counter at the last call; it wraps around.
    drops: u32,
}

impl Receiver {
    /// A receiver for `socket`; the kernel counts the socket's drops from now on.
    ///
    /// # Errors
    /// [`io::Error`] if the kernel does not allow the drop counter.
    pub fn new(socket: Socket) -> io::Result<Self> {
        setsockopt(&socket, RxqOvfl, &1)?;
        Ok(Self { socket, slab: BytesMut::new(), headers: MultiHeaders::preallocate(BATCH, None), drops: 0 })
    }

    /// The socket.
    pub fn socket(&self) -> &Socket {
        &self.socket
    }

    /// Appends the waiting datagrams, at most [`BATCH`], to `batch`. Returns the number of datagrams that the kernel
    /// dropped since the last call and before the first of them.
    ///
    /// # Errors
    /// [`io::Error`] of the kind `WouldBlock` if no datagram waits; of another kind if the kernel reports an error.
    pub fn receive(&mut self, batch: &mut Vec<Received>) -> io::Result<u64> {
        if self.slab.is_empty() {
            self.slab = BytesMut::zeroed(SLOTS * DATAGRAM_BYTES_MAX);
        }
        let fd = self.socket.as_raw_fd();
        // With MSG_TRUNC the kernel returns the true length of a datagram that is longer than its slot.
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_TRUNC;
        let (first, rest) = self.slab.split_at_mut(DATAGRAM_BYTES_MAX);
        let mut control = nix::cmsg_space!(u32);
        let mut slots = [IoSliceMut::new(first)];
        let message = recvmsg::<SockaddrStorage>(fd, &mut slots, Some(&mut control), flags)?;
        let drops = drops_of(&message).unwrap_or(self.drops);
        let mut found = Vec::with_capacity(BATCH);
        found.push((peer_of(&message), message.bytes));

        let mut slots: Vec<_> =
            rest.chunks_exact_mut(DATAGRAM_BYTES_MAX).take(BATCH - 1).map(|slot| [IoSliceMut::new(slot)]).collect();
        // An error here concerns a later datagram than the first; the next call returns it.
        if let Ok(messages) = recvmmsg(fd, &mut self.headers, &mut slots, flags, None) {
            found.extend(messages.map(|message| (peer_of(&message), message.bytes)));
        }
        for (peer, length) in found {
            let mut slot = self.slab.split_to(DATAGRAM_BYTES_MAX);
            slot.truncate(length);
            batch.push(Received { peer, length, payload: slot.freeze() });
        }
        Ok(u64::from(drops.wrapping_sub(std::mem::replace(&mut self.drops, drops))))
    }
}

fn drops_of(message: &RecvMsg<'_, '_, SockaddrStorage>) -> Option<u32> {
    message.cmsgs().ok()?.find_map(|control| match control {
        ControlMessageOwned::RxqOvfl(drops) => Some(drops),
        _ => None,
    })
}

fn peer_of(message: &RecvMsg<'_, '_, SockaddrStorage>) -> Option<SocketAddr> {
    let address = message.address.as_ref()?;
    let v4 = address.as_sockaddr_in().map(|a| (IpAddr::V4(a.ip()), a.port()));
    let (ip, port) = v4.or_else(|| address.as_sockaddr_in6().map(|a| (IpAddr::V6(a.ip()), a.port())))?;
    Some(SocketAddr::new(ip.to_canonical(), port))
}
