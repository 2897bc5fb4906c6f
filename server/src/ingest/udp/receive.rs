//! One socket -> batches of datagrams, and what the kernel dropped.
//!
//! The first datagram of a batch is read alone (`recvmsg`) with the socket's drop counter (`SO_RXQ_OVFL`), whatever
//! waits behind it in one call (`recvmmsg`); both through nix, so that no `unsafe` is needed here. nix' `recvmmsg`
//! cannot carry the counter: it never gives a control buffer back its length. Datagrams lie in slots of one slab, which
//! lives as long as the last of them; each costs no allocation of its own.

use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::os::fd::AsRawFd;

use bytes::{Bytes, BytesMut};
use nix::sys::socket::sockopt::RxqOvfl;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, MultiHeaders, RecvMsg, SockaddrStorage, recvmmsg, recvmsg, setsockopt,
};
use socket2::Socket;

/// More than an Ethernet frame carries, and than any sensor sends: only fragmented datagrams are longer.
pub const DATAGRAM_BYTES_MAX: usize = 1536;
/// At most so many datagrams a batch: what an HDL-64E sends in 18 ms.
pub const BATCH: usize = 64;
/// A slab is used by so many datagrams, of one batch or of many.
const SLOTS: usize = 2 * BATCH;

/// One datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// Whence it came; an IPv4 address as such, whatever kind of socket heard it. `None` where the kernel does not say.
    pub peer: Option<SocketAddr>,
    /// How long it was.
    pub length: usize,
    /// Its bytes, the first [`DATAGRAM_BYTES_MAX`] of them.
    pub payload: Bytes,
}

/// Reads one non-blocking socket.
pub struct Receiver {
    socket: Socket,
    slab: BytesMut,
    headers: MultiHeaders<SockaddrStorage>,
    /// The kernel's counter, as it was last; it wraps.
    drops: u32,
}

impl Receiver {
    /// Has the socket's drops counted from now on.
    ///
    /// # Errors
    /// What the kernel says.
    pub fn new(socket: Socket) -> io::Result<Self> {
        setsockopt(&socket, RxqOvfl, &1)?;
        Ok(Self { socket, slab: BytesMut::new(), headers: MultiHeaders::preallocate(BATCH, None), drops: 0 })
    }

    /// The socket.
    pub fn socket(&self) -> &Socket {
        &self.socket
    }

    /// Appends what waits, at most [`BATCH`] datagrams; gives the number the kernel has dropped before the first of
    /// them and was not asked for yet.
    ///
    /// # Errors
    /// What the kernel says; `WouldBlock` where nothing waits.
    pub fn receive(&mut self, batch: &mut Vec<Received>) -> io::Result<u64> {
        if self.slab.is_empty() {
            self.slab = BytesMut::zeroed(SLOTS * DATAGRAM_BYTES_MAX);
        }
        let fd = self.socket.as_raw_fd();
        // With MSG_TRUNC a datagram's true length is told, whatever the slot holds of it.
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
        // An error belongs to a later datagram than the first: the next call meets it again, or what comes after it.
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
