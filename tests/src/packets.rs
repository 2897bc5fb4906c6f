//! The data packets of a simulated drive, made beforehand, and sent in real time to several vehicles.

use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

/// Time of a revolution.
pub const REVOLUTION: Duration = Duration::from_millis(100);
/// Time before its due time within which a packet is sent without waiting.
const BURST: Duration = Duration::from_millis(1);

/// The data packets of the first `length` of this vehicle's drive, without telemetry.
///
/// # Panics
/// If the vehicle sends no data packets.
pub fn packets(vehicle: SimulatedVehicle, length: Duration) -> Vec<Datagram> {
    let mut data = vehicle.filter(|datagram| datagram.kind != Kind::Telemetry).peekable();
    let first_ns = data.peek().expect("datagrams do not end").stamp_ns;
    data.take_while(|datagram| datagram.stamp_ns - first_ns < length.as_nanos() as i64).collect()
}

/// How much later than the first vehicle the vehicle with this number begins: the revolutions end evenly spread.
pub fn later(number: usize, vehicles: usize) -> Duration {
    REVOLUTION.mul_f64(number as f64 / vehicles as f64)
}

/// Sends the drive in real time from `start` on to each of these vehicles, which are some of `vehicles`, by their
/// numbers; adds to `sent`. Returns at the end of the drive.
///
/// # Panics
/// If no UDP port is free.
pub fn send(drive: &[Datagram], to: &[(usize, SocketAddr)], vehicles: usize, start: Instant, sent: &AtomicU64) {
    let sockets: Vec<_> = to
        .iter()
        .map(|(number, address)| {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
            socket.connect(address).expect("loopback");
            (socket, later(*number, vehicles))
        })
        .collect();
    let first_ns = drive[0].stamp_ns;
    let due = |at: usize| Duration::from_nanos(drive[at].stamp_ns.abs_diff(first_ns));
    let mut next = vec![0; sockets.len()];
    while next.iter().any(|at| *at < drive.len()) {
        let mut wait = REVOLUTION;
        for ((socket, later), at) in sockets.iter().zip(&mut next) {
            while *at < drive.len() && due(*at) + *later <= start.elapsed() + BURST && Instant::now() >= start {
                // A full socket buffer drops the packet, as a network would; the server's counts tell.
                let _ = socket.send(&drive[*at].payload);
                sent.fetch_add(1, Ordering::Relaxed);
                *at += 1;
            }
            if *at < drive.len() {
                wait = wait.min((due(*at) + *later).saturating_sub(start.elapsed() + BURST));
            }
        }
        std::thread::sleep(wait);
    }
}
