//! Throughput of the UDP ingest: a thread sends datagrams over loopback, and an engine that only counts them receives
//! the events.
//!
//!   cargo bench -p clearway --bench udp                       as fast as possible, 2,000,000 datagrams
//!   cargo bench -p clearway --bench udp -- 6254 60            6,254 a second for 60 seconds
//!
//! Every datagram is accounted for: sent = received + lost at the queue + dropped by the kernel.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use clearway_daemon::base::held_sockets::HeldSockets;
use clearway_daemon::config::{Config, Udp};
use clearway_daemon::ingest::{queue::event_queue, udp};
use clearway_mapping::event::Body;
use clearway_mapping::ledger::Ledger;
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::UdpGsoSegment;

/// Number of datagrams of one send call, between two reads of the clock. The kernel splits them (UDP GSO), so that
/// sending needs less time than receiving. At most 64 KiB.
const BURST: usize = 32;
/// Length of a data packet in bytes.
const DATAGRAM: usize = 1206;

fn main() {
    let numbers: Vec<u64> = std::env::args().skip(1).filter_map(|argument| argument.parse().ok()).collect();
    let (rate, count) = match numbers[..] {
        [rate, seconds] => (Some(rate), rate * seconds),
        [count] => (None, count),
        _ => (None, 2_000_000),
    };
    let mut config = Config::of_one_vehicle("car", "top");
    let any = "127.0.0.1:0".parse().expect("an address");
    config.vehicles[0].udp = Some(Udp { data: any, telemetry: any, ..Udp::default() });
    let sockets = udp::Sockets::bind(&config.vehicles, &mut HeldSockets::default()).expect("free ports");
    let (data, _) = sockets.addresses(0).expect("a socket");
    let (queue, events) = event_queue(config.vehicles[0].queue);
    let threads = sockets.start(std::slice::from_ref(&queue)).expect("threads");
    let drops = queue.drops();
    drop(queue);

    let sender = std::thread::spawn(move || {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        socket.connect(data).expect("loopback");
        let began = Instant::now();
        setsockopt(&socket, UdpGsoSegment, &(DATAGRAM as i32)).expect("a kernel since 4.18");
        let burst = [0x5a; BURST * DATAGRAM];
        for number in (0..count).step_by(BURST) {
            if let Some(rate) = rate {
                let due = Duration::from_secs_f64(number as f64 / rate as f64);
                std::thread::sleep(due.saturating_sub(began.elapsed()));
            }
            let datagrams = BURST.min((count - number) as usize);
            socket.send(&burst[..datagrams * DATAGRAM]).expect("loopback takes datagrams");
        }
        let took = began.elapsed();
        // The kernel returns its drop counter with the next datagram; after this pause there is space for one.
        std::thread::sleep(Duration::from_millis(500));
        socket.send(&[]).expect("loopback takes datagrams");
        took
    });
    let (mut received, mut ledger) = (0, Ledger::default());
    let mut receiving = Duration::ZERO;
    let began = Instant::now();
    for queued in &events {
        match queued.event.body {
            Body::Lost { cause, count } => ledger.record_lost(cause, count),
            Body::Datagram(payload) if payload.is_empty() => break,
            _ => {
                received += 1;
                receiving = began.elapsed();
            }
        }
    }
    let sending = sender.join().expect("no panic");
    drop(events);
    threads.stop();
    drops.add_unreported_to(&mut ledger, []);
    let per_second = |n: u64, duration: Duration| n as f64 / duration.as_secs_f64();
    println!("sent     {count:>9} in {:.2} s, {:.0} a second", sending.as_secs_f64(), per_second(count, sending));
    println!(
        "received {received:>9} in {:.2} s, {:.0} a second",
        receiving.as_secs_f64(),
        per_second(received, receiving)
    );
    println!("lost     {:>9} at the queue, {} in the kernel", ledger.lost, ledger.kernel_drops);
    assert_eq!(received + ledger.lost + ledger.kernel_drops, count, "every datagram is accounted for");
}
