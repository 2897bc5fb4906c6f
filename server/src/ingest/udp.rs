//! UDP sockets -> the door. One task a socket; a datagram longer than any sensor's is taken whole, so that the decoder
//! can refuse it by its true length.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use bytes::Bytes;
use clearway_mapping::event::Body;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;

use super::Door;
use crate::config::{Sender, Udp};

/// Larger than any UDP payload: an oversized datagram must be seen as such, not cut to a plausible length.
const DATAGRAM_MAX: usize = 65_536;

/// A vehicle's bound sockets, before anything is read.
#[derive(Debug)]
pub struct Sockets {
    data: UdpSocket,
    telemetry: UdpSocket,
}

impl Sockets {
    /// Binds both sockets with the receive buffer asked for; says so when the kernel gives less.
    ///
    /// # Errors
    /// What the kernel says, with the address it says it of.
    pub fn bind(udp: &Udp) -> std::io::Result<Self> {
        let bind = |at: SocketAddr, what: &str| {
            bind(at, udp.receive_buffer_bytes)
                .map_err(|error| std::io::Error::new(error.kind(), format!("udp {what} {at}: {error}")))
        };
        Ok(Self { data: bind(udp.data, "data")?, telemetry: bind(udp.telemetry, "telemetry")? })
    }

    /// The addresses really bound: data, telemetry.
    ///
    /// # Errors
    /// What the kernel says.
    pub fn addresses(&self) -> std::io::Result<(SocketAddr, SocketAddr)> {
        Ok((self.data.local_addr()?, self.telemetry.local_addr()?))
    }

    /// Reads both sockets until the engine stops; `senders` gives each sensor's sender, in the order of the sensors.
    pub async fn run(self, senders: Vec<Option<Sender>>, door: Door) {
        tokio::join!(read(self.data, &senders, &door), read(self.telemetry, &senders, &door));
    }
}

/// The configured senders in the order of the sensors.
pub fn senders(from: &BTreeMap<String, Sender>, sensors: impl Iterator<Item = impl AsRef<str>>) -> Vec<Option<Sender>> {
    sensors.map(|name| from.get(name.as_ref()).copied()).collect()
}

fn bind(at: SocketAddr, receive_buffer_bytes: usize) -> std::io::Result<UdpSocket> {
    let socket = Socket::new(Domain::for_address(at), Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_recv_buffer_size(receive_buffer_bytes)?;
    // Linux reports twice what it was asked for: half of it is its own bookkeeping.
    let given = socket.recv_buffer_size()? / if cfg!(target_os = "linux") { 2 } else { 1 };
    if given < receive_buffer_bytes {
        tracing::warn!(%at, asked = receive_buffer_bytes, given, "receive buffer clamped: raise net.core.rmem_max");
    }
    socket.set_nonblocking(true)?;
    socket.bind(&at.into())?;
    UdpSocket::from_std(socket.into())
}

async fn read(socket: UdpSocket, senders: &[Option<Sender>], door: &Door) {
    let mut buffer = vec![0; DATAGRAM_MAX];
    loop {
        let (length, peer) = match socket.recv_from(&mut buffer).await {
            Ok(received) => received,
            // A receive error belongs to one datagram (an ICMP answer, say); the socket goes on.
            Err(error) => {
                tracing::warn!(%error, "udp receive");
                tokio::task::yield_now().await;
                continue;
            }
        };
        let Some(source) = source_of(senders, peer) else {
            door.refuse("source");
            continue;
        };
        if door.enter(source, Body::Datagram(Bytes::copy_from_slice(&buffer[..length]))).is_err() {
            return;
        }
    }
}

/// The sensor a peer speaks for: the one it is configured for, or the one that takes anybody.
fn source_of(senders: &[Option<Sender>], peer: SocketAddr) -> Option<u16> {
    let index = senders.iter().position(|sender| sender.is_none_or(|sender| sender.is(peer)))?;
    u16::try_from(index).ok()
}

/// Datagrams the kernel dropped at sockets bound to these ports, from `/proc/net/udp`; `None` where there is no such file.
pub fn kernel_drops(addresses: &[SocketAddr]) -> Option<u64> {
    let mut drops = 0;
    for table in ["/proc/net/udp", "/proc/net/udp6"] {
        let Ok(text) = std::fs::read_to_string(table) else { continue };
        drops += drops_in(&text, addresses)?;
    }
    Some(drops)
}

fn drops_in(table: &str, addresses: &[SocketAddr]) -> Option<u64> {
    let mut drops = 0;
    for line in table.lines().skip(1) {
        let mut columns = line.split_whitespace();
        let port = columns.nth(1)?.rsplit_once(':').and_then(|(_, port)| u16::from_str_radix(port, 16).ok())?;
        if addresses.iter().any(|address| address.port() == port) {
            drops += columns.last()?.parse::<u64>().ok()?;
        }
    }
    Some(drops)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_without_a_sender_takes_anybody_and_a_sensor_with_one_takes_nobody_else() {
        let peer: SocketAddr = "192.168.1.201:2368".parse().unwrap();
        let stranger: SocketAddr = "192.168.1.7:2368".parse().unwrap();
        assert_eq!(source_of(&[None], stranger), Some(0));
        let known = Some(Sender::Address(peer.ip()));
        let other = Some(Sender::Socket("192.168.1.202:2368".parse().unwrap()));
        assert_eq!(source_of(&[other, known], peer), Some(1));
        assert_eq!(source_of(&[other, known], stranger), None);
    }

    #[test]
    fn the_kernels_drops_are_read_from_its_table() {
        let table = "   sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref pointer drops\n  \
            412: 00000000:0940 00000000:0000 07 00000000:00000000 00:00000000 00000000  0 0 3811 2 0000000000000000 17\n  \
            413: 00000000:2074 00000000:0000 07 00000000:00000000 00:00000000 00000000  0 0 3812 2 0000000000000000 4\n";
        assert_eq!(drops_in(table, &["0.0.0.0:2368".parse().unwrap()]), Some(17));
        assert_eq!(drops_in(table, &["0.0.0.0:1".parse().unwrap()]), Some(0));
    }
}
