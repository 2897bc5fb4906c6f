//! A simulated HDL-64E in the town: its datagrams are made beforehand, then sent in real time.

use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_client::now_ns;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

/// Time before its due time within which a packet is sent without waiting.
const BURST: Duration = Duration::from_millis(1);

/// Datagrams of revolutions; each ends with the packet at which the server ends the revolution.
pub type Revolutions = Arc<Vec<Vec<Datagram>>>;

/// Stamps of the last packets of revolutions, by the device's clock and by the host's clock, in ns.
pub type Cuts = Arc<Mutex<Vec<(i64, i64)>>>;

/// A drive that continues until it is stopped.
pub struct Car {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<()>,
}

impl Car {
    /// Starts the drive; it ends with the last revolution at the latest.
    pub fn drive(revolutions: &Revolutions, to: SocketAddr, cuts: &Cuts) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let (revolutions, cuts, stop) = (revolutions.clone(), cuts.clone(), stop.clone());
            move || send(&revolutions, to, &cuts, &stop)
        });
        Self { stop, thread }
    }

    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the car drives");
    }
}

/// The datagrams of this many revolutions in the town; each ends with the packet at which the server ends it.
pub fn cast(count: usize) -> Revolutions {
    let mut vehicle = SimulatedVehicle::new(town(), ScannerConfig::default());
    let (mut revolutions, mut revolution, mut before) = (Vec::new(), Vec::new(), u16::MAX);
    while revolutions.len() < count {
        let datagram = vehicle.next().expect("datagrams do not end");
        if datagram.kind == Kind::Telemetry {
            continue;
        }
        // The azimuth of the last block; the server ends revolutions behind the vehicle.
        let azimuth = u16::from_le_bytes([datagram.payload[1102], datagram.payload[1103]]);
        revolution.push(datagram);
        if before < 18_000 && azimuth >= 18_000 {
            revolutions.push(std::mem::take(&mut revolution));
        }
        before = azimuth;
    }
    revolutions.into()
}

/// Sends the revolutions in real time, and records when the last packet of each was sent.
fn send(revolutions: &[Vec<Datagram>], to: SocketAddr, cuts: &Cuts, stop: &AtomicBool) {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
    let (began, first_ns) = (Instant::now(), revolutions[0][0].stamp_ns);
    for revolution in revolutions {
        for (index, datagram) in revolution.iter().enumerate() {
            let due = Duration::from_nanos((datagram.stamp_ns - first_ns).unsigned_abs());
            let early = due.saturating_sub(began.elapsed());
            if early > BURST {
                std::thread::sleep(early);
            }
            if stop.load(Ordering::Relaxed) {
                return;
            }
            if index + 1 == revolution.len() {
                cuts.lock().expect("no thread panics").push((datagram.stamp_ns, now_ns()));
            }
            socket.send_to(&datagram.payload, to).expect("loopback takes datagrams");
        }
    }
}
