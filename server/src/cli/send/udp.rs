//! Datagrams -> UDP, at the pace of their stamps.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs, UdpSocket};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;

/// Longest wait between two datagrams. A longer gap in a capture is shortened to none.
const PAUSE_MAX: Duration = Duration::from_secs(60);

/// Kind of a Velodyne datagram.
#[derive(Clone, Copy)]
pub enum Kind {
    /// A data packet of 1206 bytes.
    Data,
    /// A telemetry datagram of 512 bytes.
    Telemetry,
}

impl Kind {
    /// The kind of a datagram of `length` bytes; `None` if no kind has that length.
    pub fn from_length(length: usize) -> Option<Self> {
        match length {
            PACKET_LENGTH => Some(Self::Data),
            TELEMETRY_LENGTH => Some(Self::Telemetry),
            _ => None,
        }
    }
}

/// Speed of sending, relative to the stamps.
#[derive(Clone, Copy)]
pub enum Speed {
    /// This many times the speed of the stamps.
    Times(f64),
    /// As fast as the machine can.
    Max,
}

/// Reads a speed from the command line.
///
/// # Errors
/// If it is neither `max` nor a number from 0.001 to 1000.
pub fn speed(text: &str) -> Result<Speed, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(Speed::Max),
        Ok(times) if (0.001..=1000.0).contains(&times) => Ok(Speed::Times(times)),
        _ => Err("0.001 to 1000, or max, is allowed".into()),
    }
}

/// Reads an own address, with or without port, from the command line.
///
/// # Errors
/// If it is not an address.
pub fn own_address(text: &str) -> Result<SocketAddr, String> {
    let without_port = || text.parse::<IpAddr>().map(|ip| SocketAddr::new(ip, 0));
    text.parse()
        .or_else(|_| without_port())
        .map_err(|_| "an address such as 127.0.0.2 or 127.0.0.2:2368 is allowed".into())
}

/// Finds the address of a target such as `udp://127.0.0.1:2368`.
///
/// # Errors
/// If the text is not `udp://HOST:PORT` or the host has no address.
pub fn target(text: &str) -> Result<SocketAddr> {
    let rest = text.strip_prefix("udp://").with_context(|| format!("{text:?}: udp://HOST:PORT is allowed"))?;
    let mut found = rest.to_socket_addrs().with_context(|| format!("{text:?}: udp://HOST:PORT is allowed"))?;
    found.next().with_context(|| format!("{text:?}: the host has no address"))
}

/// A socket that sends datagrams at their time, and counts them.
pub struct Sender {
    socket: UdpSocket,
    to: SocketAddr,
    telemetry_to: SocketAddr,
    speed: Speed,
    /// When the first datagram was sent, and its stamp.
    started: Option<(Instant, i64)>,
    /// When the first datagram was sent; not moved by long gaps.
    began: Option<Instant>,
    /// Number of data packets sent.
    pub packets: u64,
    /// Number of telemetry datagrams sent.
    pub telemetry: u64,
}

impl Sender {
    /// Opens a socket at the address `bind`, or at an address of the system's choice.
    ///
    /// # Errors
    /// If the system refuses the socket.
    pub fn new(to: SocketAddr, telemetry_to: SocketAddr, bind: Option<SocketAddr>, speed: Speed) -> Result<Self> {
        let any: IpAddr = if to.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
        let own = bind.unwrap_or(SocketAddr::new(any, 0));
        let socket = UdpSocket::bind(own).with_context(|| format!("open a UDP socket at {own}"))?;
        Ok(Self { socket, to, telemetry_to, speed, started: None, began: None, packets: 0, telemetry: 0 })
    }

    /// Waits until the datagram is due, and sends it.
    ///
    /// # Errors
    /// If the system cannot send it.
    pub fn send(&mut self, stamp_ns: i64, kind: Kind, payload: &[u8]) -> Result<()> {
        let (to, count) = match kind {
            Kind::Data => (self.to, &mut self.packets),
            Kind::Telemetry => (self.telemetry_to, &mut self.telemetry),
        };
        let (started, first_ns) = *self.started.get_or_insert_with(|| (Instant::now(), stamp_ns));
        self.began.get_or_insert(started);
        if let Speed::Times(times) = self.speed {
            let due = Duration::from_secs_f64((stamp_ns.saturating_sub(first_ns)).max(0) as f64 * 1e-9 / times);
            let pause = due.saturating_sub(started.elapsed());
            if pause > PAUSE_MAX {
                // The pace continues from this datagram.
                self.started = Some((Instant::now(), stamp_ns));
            } else {
                std::thread::sleep(pause);
            }
        }
        match self.socket.send_to(payload, to) {
            Ok(_) => *count += 1,
            // The answer to an earlier datagram on loopback: no socket is open at the target, which UDP does not need.
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused => *count += 1,
            Err(error) => return Err(error).with_context(|| format!("send to {to}")),
        }
        Ok(())
    }

    /// Seconds since the first datagram was sent; 0 before it.
    pub fn seconds(&self) -> f64 {
        self.began.map_or(0.0, |began| began.elapsed().as_secs_f64())
    }
}
