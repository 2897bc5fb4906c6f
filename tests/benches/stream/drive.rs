//! A simulated HDL-64E in the town: its datagrams are cast beforehand, then sent in real time.

use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_client::now_ns;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

/// Packets that are due this soon leave at once.
const BURST: Duration = Duration::from_millis(1);

/// Datagrams of turns, each of which ends with the packet at which the server cuts it.
pub type Turns = Arc<Vec<Vec<Datagram>>>;

/// Stamps of the last packets of turns, device and host clock, ns.
pub type Cuts = Arc<Mutex<Vec<(i64, i64)>>>;

/// A drive that goes on until it is stopped.
pub struct Car {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<()>,
}

impl Car {
    /// Drives, as long as there are turns.
    pub fn drive(turns: &Turns, to: SocketAddr, cuts: &Cuts) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let (turns, cuts, stop) = (turns.clone(), cuts.clone(), stop.clone());
            move || send(&turns, to, &cuts, &stop)
        });
        Self { stop, thread }
    }

    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the car drives");
    }
}

/// What the sensor sends in so many turns of the town; each ends with the packet at which the server cuts it.
pub fn cast(count: usize) -> Turns {
    let mut vehicle = SimulatedVehicle::new(town(), ScannerConfig::default());
    let (mut turns, mut turn, mut before) = (Vec::new(), Vec::new(), u16::MAX);
    while turns.len() < count {
        let datagram = vehicle.next().expect("datagrams do not end");
        if datagram.kind == Kind::Telemetry {
            continue;
        }
        // Of the last block; behind the vehicle turns are cut.
        let azimuth = u16::from_le_bytes([datagram.payload[1102], datagram.payload[1103]]);
        turn.push(datagram);
        if before < 18_000 && azimuth >= 18_000 {
            turns.push(std::mem::take(&mut turn));
        }
        before = azimuth;
    }
    turns.into()
}

/// Sends the turns in real time, and notes when the last packet of each left.
fn send(turns: &[Vec<Datagram>], to: SocketAddr, cuts: &Cuts, stop: &AtomicBool) {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let (began, first_ns) = (Instant::now(), turns[0][0].stamp_ns);
    for turn in turns {
        for (index, datagram) in turn.iter().enumerate() {
            let due = Duration::from_nanos((datagram.stamp_ns - first_ns).unsigned_abs());
            let early = due.saturating_sub(began.elapsed());
            if early > BURST {
                std::thread::sleep(early);
            }
            if stop.load(Ordering::Relaxed) {
                return;
            }
            if index + 1 == turn.len() {
                cuts.lock().expect("no thread panics").push((datagram.stamp_ns, now_ns()));
            }
            socket.send_to(&datagram.payload, to).expect("loopback takes datagrams");
        }
    }
}
