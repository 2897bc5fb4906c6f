//! What the UDP door takes: datagrams over loopback, from a thread that sends them, to an engine that only counts them.
//!
//!   cargo bench -p clearway --bench udp                       flat out, 2,000,000 datagrams
//!   cargo bench -p clearway --bench udp -- 6254 60            6,254 a second for 60 seconds, nothing may be lost
//!
//! Every datagram is accounted for: sent = taken + lost in the queue + dropped by the kernel.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use clearway_mapping::event::Body;
use clearway_mapping::ledger::Ledger;
use clearway::config::{Config, Udp};
use clearway::ingest::{queue::event_queue, udp};
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::UdpGsoSegment;

/// Datagrams between two looks at the clock, and in one call of the sender's: the kernel cuts them apart (UDP GSO), so that
/// sending takes less of the two cores than receiving. At most 64 KiB.
const BURST: usize = 32;
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
    let sockets = udp::Sockets::bind(&config.vehicles).expect("free ports");
    let (data, _) = sockets.addresses(0).expect("a socket");
    let (door, events) = event_queue(config.vehicles[0].queue);
    let readers = sockets.start(std::slice::from_ref(&door)).expect("threads");
    let outside = door.drops();
    drop(door);

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
        // The kernel tells its drops with the next datagram it takes; by now there is space for one.
        std::thread::sleep(Duration::from_millis(500));
        socket.send(&[]).expect("loopback takes datagrams");
        took
    });
    let (mut taken, mut ledger) = (0, Ledger::default());
    let mut took = Duration::ZERO;
    let began = Instant::now();
    for queued in &events {
        match queued.event.body {
            Body::Lost { cause, count } => ledger.record_lost(cause, count),
            Body::Datagram(payload) if payload.is_empty() => break,
            _ => {
                taken += 1;
                took = began.elapsed();
            }
        }
    }
    let sending = sender.join().expect("no panic");
    drop(events);
    readers.stop();
    outside.add_unreported_to(&mut ledger, []);
    let per_second = |n: u64, took: Duration| n as f64 / took.as_secs_f64();
    println!("sent    {count:>9} in {:.2} s, {:.0} a second", sending.as_secs_f64(), per_second(count, sending));
    println!("taken   {taken:>9} in {:.2} s, {:.0} a second", took.as_secs_f64(), per_second(taken, took));
    println!("lost    {:>9} in the queue, {} in the kernel", ledger.lost, ledger.kernel_drops);
    assert_eq!(taken + ledger.lost + ledger.kernel_drops, count, "every datagram is accounted for");
}
