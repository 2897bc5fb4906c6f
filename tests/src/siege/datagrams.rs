//! Floods of datagrams on the sensor's port.

use std::net::{Ipv4Addr, SocketAddr};

use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::vehicle::SimulatedVehicle;
use futures::FutureExt;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use tokio::net::UdpSocket;

use super::target::Attack;

/// Bytes of a data packet of a Velodyne sensor.
const PACKET: usize = 1206;
/// Datagrams between two looks at other tasks.
const BURST: usize = 64;

/// The attacks of this file.
pub const ATTACKS: &[Attack] = &[
    Attack { name: "UDP: junk of every size", run: |target| flood(target.udp, junk).boxed() },
    Attack { name: "UDP: 1,206 random bytes", run: |target| flood(target.udp, random_packet).boxed() },
    Attack { name: "UDP: true packets of another address", run: |target| repeat_packets(target.udp).boxed() },
];

async fn socket(at: SocketAddr, own: Ipv4Addr) -> UdpSocket {
    let socket = UdpSocket::bind((own, 0)).await.expect("a port");
    socket.connect(at).await.expect("an address of ours");
    socket
}

async fn flood(at: SocketAddr, datagram: fn(&mut Pcg64Mcg, &mut [u8; 1472]) -> usize) {
    let (socket, mut random) = (socket(at, Ipv4Addr::LOCALHOST).await, Pcg64Mcg::seed_from_u64(12));
    let mut bytes = [0; 1472];
    loop {
        for _ in 0..BURST {
            let length = datagram(&mut random, &mut bytes);
            let _full = socket.try_send(&bytes[..length]);
        }
        tokio::task::yield_now().await;
    }
}

fn junk(random: &mut Pcg64Mcg, bytes: &mut [u8; 1472]) -> usize {
    let length = random.random_range(0..=bytes.len());
    random.fill(&mut bytes[..length]);
    length
}

fn random_packet(random: &mut Pcg64Mcg, bytes: &mut [u8; 1472]) -> usize {
    random.fill(&mut bytes[..PACKET]);
    PACKET
}

/// Sends the packets of a simulated vehicle again and again from 127.0.0.2, as fast as it can.
async fn repeat_packets(at: SocketAddr) {
    let socket = socket(at, Ipv4Addr::new(127, 0, 0, 2)).await;
    let vehicle = SimulatedVehicle::new(flat(), ScannerConfig::default());
    let packets: Vec<_> = vehicle.map(|datagram| datagram.payload).filter(|p| p.len() == PACKET).take(2000).collect();
    loop {
        for burst in packets.chunks(BURST) {
            for packet in burst {
                let _full = socket.try_send(packet);
            }
            tokio::task::yield_now().await;
        }
    }
}
