//! A simulated scene -> the datagrams of a simulated vehicle, in a capture or over UDP.

use std::io::{BufWriter, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context, Result};
use clearway_client::now_ns;
use clearway_daemon::base::files;
use clearway_lidar::model::Model;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::Scene;
use clearway_sim::send::{Pace, Sent, Until, drive};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use etherparse::PacketBuilder;

/// A drive of a simulated vehicle with one LIDAR on its roof.
#[derive(Clone, Debug)]
pub struct SimulatedDrive {
    /// The scene in which the vehicle drives.
    pub scene: Scene,
    /// Model of the sensor.
    pub model: Model,
    /// Duration of the drive.
    pub duration: Duration,
    /// Seed of the sensor's noise.
    pub seed: u64,
}

/// Address of a Velodyne sensor by default, and the broadcast address to which it sends (VLP-16 User Manual, 63-9243,
/// section 7.1).
const ADDRESSES: [[u8; 4]; 2] = [[192, 168, 1, 201], [255, 255, 255, 255]];
/// Hardware addresses: a station of Velodyne, and every station.
const STATIONS: [[u8; 6]; 2] = [[0x60, 0x76, 0x88, 0, 0, 1], [0xff; 6]];
/// Number of routers that a datagram may pass.
const HOPS: u8 = 64;

impl SimulatedDrive {
    fn scanner(&self) -> ScannerConfig {
        ScannerConfig { model: self.model, seed: self.seed, ..ScannerConfig::default() }
    }

    /// Writes the drive to a new pcap file. `progress` is called with the time that is written.
    ///
    /// # Errors
    /// If the file exists or cannot be written.
    pub fn write_capture(&self, file: &Path, mut progress: impl FnMut(Duration)) -> Result<Sent> {
        let context = || format!("write {}", file.display());
        let mut pcap = Pcap::new(BufWriter::new(files::create_new(file)?)).with_context(context)?;
        let vehicle = SimulatedVehicle::new(self.scene.clone(), self.scanner());
        let start_ns = vehicle.start_ns();
        let mut sent = Sent::default();
        for datagram in vehicle {
            sent.device_time = Duration::from_nanos(u64::try_from(datagram.stamp_ns - start_ns).unwrap_or(0));
            if sent.device_time > self.duration {
                break;
            }
            progress(sent.device_time);
            pcap.write(&datagram).with_context(context)?;
            *if datagram.kind == Kind::Data { &mut sent.packets } else { &mut sent.telemetry } += 1;
        }
        pcap.0.flush().with_context(context)?;
        Ok(sent)
    }

    /// Sends the drive in real time to these addresses of data packets and telemetry, until another thread sets `stop`;
    /// if it is endless, beyond its duration.
    ///
    /// # Errors
    /// If a datagram cannot be sent.
    pub fn send(&self, to: SocketAddr, telemetry_to: SocketAddr, is_endless: bool, stop: &AtomicBool) -> Result<Sent> {
        let any: IpAddr = if to.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
        let vehicle = SimulatedVehicle::starting_at(self.scene.clone(), self.scanner(), now_ns());
        let until = Until { stop: Some(stop), device_time: (!is_endless).then_some(self.duration) };
        drive((any, 0).into(), vehicle, to, telemetry_to, Pace::RealTime, until)
            .with_context(|| format!("send to {to}"))
    }
}

/// A capture in the format pcap, with stamps in nanoseconds, of UDP datagrams over IPv4 and Ethernet.
struct Pcap<W: Write>(W);

impl<W: Write> Pcap<W> {
    /// Writes the file's header.
    fn new(mut file: W) -> std::io::Result<Self> {
        // Magic number of nanosecond stamps; version 2.4; zone and accuracy, unused; longest frame; Ethernet.
        for field in [0xa1b2_3c4d, 0x0004_0002, 0, 0, 0xffff, 1_u32] {
            file.write_all(&field.to_le_bytes())?;
        }
        Ok(Self(file))
    }

    /// Writes the Ethernet frame of a datagram, as a Velodyne sensor with its default settings sends it.
    fn write(&mut self, datagram: &Datagram) -> std::io::Result<()> {
        let port: u16 = if datagram.kind == Kind::Data { 2368 } else { 8308 };
        let [from, to] = STATIONS;
        let packet = PacketBuilder::ethernet2(from, to).ipv4(ADDRESSES[0], ADDRESSES[1], HOPS).udp(port, port);
        let mut frame = Vec::new();
        packet.write(&mut frame, &datagram.payload).map_err(std::io::Error::other)?;
        let (seconds, ns) = (datagram.stamp_ns.div_euclid(1_000_000_000), datagram.stamp_ns.rem_euclid(1_000_000_000));
        for field in [seconds as u32, ns as u32, frame.len() as u32, frame.len() as u32] {
            self.0.write_all(&field.to_le_bytes())?;
        }
        self.0.write_all(&frame)
    }
}
