//! A vehicle's datagrams over UDP, paced by the clock. The only file of this crate that does I/O or reads a clock.
//!
//! In: datagrams in device-time order. Out: UDP to a data port and a telemetry port, and a count of what was sent.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::ops::AddAssign;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::vehicle::{Datagram, Kind};

/// Speed at which device time passes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// As fast as the clock.
    RealTime,
    /// This many times as fast as the clock; above 0.
    Times(f64),
    /// As fast as datagrams can be sent, without waiting for their stamps.
    AsFastAsPossible,
}

/// When to stop: at the first of these.
#[derive(Clone, Copy, Debug, Default)]
pub struct Until<'a> {
    /// Another thread sets this.
    pub stop: Option<&'a AtomicBool>,
    /// This much device time has passed.
    pub device_time: Option<Duration>,
}

/// Counts of what was sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sent {
    /// Number of data packets.
    pub packets: u64,
    /// Number of telemetry datagrams.
    pub telemetry: u64,
    /// Answers of the data target's machine that no socket is open there.
    pub refused: u64,
    /// Device time from the first datagram to the last.
    pub device_time: Duration,
}

impl AddAssign for Sent {
    fn add_assign(&mut self, other: Self) {
        self.packets += other.packets;
        self.telemetry += other.telemetry;
        self.refused += other.refused;
        self.device_time = self.device_time.max(other.device_time);
    }
}

/// Datagrams that are due within this time are sent at once, so that the thread sleeps at most once a millisecond. The
/// due times count from the beginning, so the long-run rate is exact.
const BURST: Duration = Duration::from_millis(1);
/// Longest time until a stop is seen.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Sends datagrams from the address `own` until there are no more or `until` is reached; blocks.
///
/// # Errors
/// The operating system's error if the socket cannot be opened or a datagram cannot be sent.
pub fn drive(
    own: SocketAddr,
    datagrams: impl IntoIterator<Item = Datagram>,
    data: SocketAddr,
    telemetry: SocketAddr,
    pace: Pace,
    until: Until<'_>,
) -> io::Result<Sent> {
    let socket = UdpSocket::bind(own)?;
    // The system gives a connected socket alone the answers to earlier datagrams.
    socket.connect(data)?;
    let is_stopped = || until.stop.is_some_and(|stop| stop.load(Ordering::Relaxed));
    let began = Instant::now();
    let mut first_ns = None;
    let mut sent = Sent::default();
    for datagram in datagrams {
        let first_ns = *first_ns.get_or_insert(datagram.stamp_ns);
        let device_time = Duration::from_nanos(u64::try_from(datagram.stamp_ns - first_ns).unwrap_or(0));
        if until.device_time.is_some_and(|end| device_time > end) || is_stopped() {
            break;
        }
        let due = match pace {
            Pace::RealTime => device_time,
            Pace::Times(times) => device_time.div_f64(times),
            Pace::AsFastAsPossible => Duration::ZERO,
        };
        let early = || Some(due.saturating_sub(began.elapsed())).filter(|early| *early > BURST);
        while let Some(early) = early().filter(|_| !is_stopped()) {
            std::thread::sleep(early.min(LOOK_EVERY));
        }
        let (to, count) = match datagram.kind {
            Kind::Data => (data, &mut sent.packets),
            Kind::Telemetry => (telemetry, &mut sent.telemetry),
        };
        let send = || socket.send_to(&datagram.payload, to);
        // The answer to an earlier datagram: this one was not sent.
        let is_refused = |sent: &io::Result<usize>| {
            sent.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused)
        };
        let mut result = send();
        if is_refused(&result) {
            sent.refused += 1;
            result = send();
        }
        if !is_refused(&result) {
            result?;
        }
        *count += 1;
        sent.device_time = device_time;
    }
    Ok(sent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_datagram_arrives_at_its_own_port_in_order() {
        let (data, telemetry) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        let datagrams = (0..40_u8).map(|number| Datagram {
            stamp_ns: i64::from(number) * 1_000_000,
            kind: if number % 4 == 0 { Kind::Telemetry } else { Kind::Data },
            payload: vec![number; 10],
        });
        let ends = (data.local_addr().unwrap(), telemetry.local_addr().unwrap());
        let until = Until { device_time: Some(Duration::from_millis(31)), ..Until::default() };
        let sent =
            drive("127.0.0.1:0".parse().unwrap(), datagrams, ends.0, ends.1, Pace::AsFastAsPossible, until).unwrap();
        assert_eq!(sent, Sent { packets: 24, telemetry: 8, refused: 0, device_time: Duration::from_millis(31) });
        let mut buffer = [0; 64];
        for number in 0..32 {
            let socket = if number % 4 == 0 { &telemetry } else { &data };
            assert_eq!((socket.recv(&mut buffer).unwrap(), buffer[0]), (10, number));
        }
    }

    #[test]
    fn datagrams_to_a_closed_port_are_refused_and_counted() {
        let closed = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let datagrams = (0..9).map(|_| Datagram { stamp_ns: 0, kind: Kind::Data, payload: vec![0; 10] });
        let own = "127.0.0.1:0".parse().unwrap();
        let sent = drive(own, datagrams, closed, closed, Pace::AsFastAsPossible, Until::default()).unwrap();
        assert_eq!((sent.packets, sent.refused), (9, 8));
    }
}
