//! `clearway simulate`: a simulated scene -> the datagrams of a simulated vehicle, in a capture or over UDP.

use std::io::{BufWriter, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use clearway_client::now_ns;
use clearway_lidar::model::Model;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::traffic;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

use crate::cli::send::udp::{self, Sender, Speed};
use crate::cli::shared::files;
use crate::cli::shared::model::ModelParser;
use crate::cli::shared::output::{counted, print_line, progress_bar};

/// Speed of the vehicle in the scene `street`, in m/s; as in `demo --sensors many`.
const STREET_MPS: f64 = 8.0;

/// Builds a scene.
type SceneMaker = fn() -> Scene;

/// The scenes: name, description, maker.
const SCENES: [(&str, &str, SceneMaker); 7] = [
    ("town", "a street round a block of buildings, with traffic; the vehicle drives", scenes::town),
    ("street", "a straight street with traffic in both directions; the vehicle drives", || traffic::street(STREET_MPS)),
    ("flat", "flat ground with few obstacles; the vehicle stands", scenes::flat),
    ("slopes", "a road that falls and rises between banks and cars; the vehicle stands", scenes::slopes_with_obstacles),
    ("canopy", "a fenced road under branches; the vehicle stands", scenes::fenced_road_under_canopy),
    (
        "overhang",
        "the same road under a beam that is too low; the vehicle stands",
        scenes::fenced_road_with_low_overhang,
    ),
    ("track", "a dirt track between ploughed fields; the vehicle stands", scenes::dirt_track_between_fields),
];

/// The names of the scenes as the command line accepts them.
fn names() -> PossibleValuesParser {
    PossibleValuesParser::new(SCENES.map(|(name, description, _)| PossibleValue::new(name).help(description)))
}

/// Simulate a drive: write the datagrams of a simulated vehicle to a capture, or send them over UDP.
///
/// The vehicle has one LIDAR on its roof, 1.9 m above the ground, and sends data packets and telemetry (position and
/// speed). In a capture the drive begins on 2026-01-01 at 12:00 UTC, so that the same options make the same file.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway simulate town --seconds 10 --out drive.pcap
  clearway simulate street --sensor vlp16 --to udp://127.0.0.1:2368")]
pub struct Options {
    /// The scene.
    #[arg(value_parser = names())]
    scene: String,
    /// Model of the sensor; hdl64e is hdl64e_s2.
    #[arg(long, visible_alias = "model", value_name = "MODEL", default_value = "hdl64e_s2")]
    #[arg(value_parser = ModelParser::simulated())]
    sensor: Model,
    /// Duration of the drive, in seconds.
    #[arg(long, default_value = "10", value_parser = seconds)]
    seconds: Duration,
    /// Seed of the sensor's noise; the same seed makes the same datagrams.
    #[arg(long, default_value = "1")]
    seed: u64,
    /// Write a capture to this new file.
    #[arg(long, value_name = "FILE.pcap", required_unless_present = "to", conflicts_with = "to")]
    out: Option<PathBuf>,
    /// Send the datagrams to this address as they are made, in real time.
    #[arg(long, value_name = "udp://HOST:PORT")]
    to: Option<String>,
    /// With --to: the target of the telemetry; that of the data packets if absent.
    #[arg(long, value_name = "udp://HOST:PORT", requires = "to", conflicts_with = "out")]
    telemetry_to: Option<String>,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().filter(|seconds| (0.1..=3600.0).contains(seconds));
    duration.map(Duration::from_secs_f64).ok_or_else(|| "0.1 to 3600 seconds are allowed".into())
}

/// The scene of that name; `None` if there is none.
pub fn scene(name: &str) -> Option<Scene> {
    SCENES.iter().find(|(known, ..)| *known == name).map(|(.., scene)| scene())
}

/// Simulates the drive.
///
/// # Errors
/// If the file exists or cannot be written, or the datagrams cannot be sent.
pub fn run(options: &Options) -> Result<()> {
    let scene = scene(&options.scene).expect("clap accepts only names of scenes");
    let scanner = ScannerConfig { model: options.sensor, seed: options.seed, ..ScannerConfig::default() };
    let (packets, telemetry, target) = match (&options.out, &options.to) {
        (Some(file), _) => write_capture(SimulatedVehicle::new(scene, scanner), options.seconds, file)?,
        (None, Some(to)) => {
            let to = udp::target(to)?;
            let telemetry_to = options.telemetry_to.as_deref().map_or(Ok(to), udp::target)?;
            send(SimulatedVehicle::starting_at(scene, scanner, now_ns()), options.seconds, (to, telemetry_to))?
        }
        (None, None) => unreachable!("clap requires --out or --to"),
    };
    print_line(&format!(
        "{:.1} s of {} with the sensor {}: {} and {} {target}",
        options.seconds.as_secs_f64(),
        options.scene,
        options.sensor.as_str(),
        counted(packets, "data packet"),
        counted(telemetry, "telemetry datagram"),
    ))?;
    Ok(())
}

/// The datagrams of the first `duration` of the drive.
fn datagrams(vehicle: SimulatedVehicle, duration: Duration) -> impl Iterator<Item = Datagram> {
    let end_ns = vehicle.start_ns().saturating_add(i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX));
    vehicle.take_while(move |datagram| datagram.stamp_ns <= end_ns)
}

/// Writes the drive to a new pcap file; returns the number of data packets and telemetry datagrams, and where they are.
fn write_capture(vehicle: SimulatedVehicle, duration: Duration, file: &Path) -> Result<(u64, u64, String)> {
    let context = || format!("write {}", file.display());
    let mut pcap = Pcap::new(BufWriter::new(files::create_new(file)?)).with_context(context)?;
    let start_ns = vehicle.start_ns();
    let progress = progress_bar(u64::try_from(duration.as_millis()).unwrap_or(u64::MAX));
    let (mut packets, mut telemetry) = (0, 0);
    for datagram in datagrams(vehicle, duration) {
        progress.set_position(u64::try_from((datagram.stamp_ns - start_ns) / 1_000_000).unwrap_or(0));
        pcap.write(&datagram).with_context(context)?;
        let count = if datagram.kind == Kind::Data { &mut packets } else { &mut telemetry };
        *count += 1;
    }
    progress.finish_and_clear();
    pcap.0.flush().with_context(context)?;
    Ok((packets, telemetry, format!("in {}", file.display())))
}

/// Sends the drive in real time; returns the number of data packets and telemetry datagrams, and where they went.
fn send(
    vehicle: SimulatedVehicle,
    duration: Duration,
    (to, telemetry_to): (SocketAddr, SocketAddr),
) -> Result<(u64, u64, String)> {
    let mut sender = Sender::new(to, telemetry_to, None, Speed::Times(1.0))?;
    for datagram in datagrams(vehicle, duration) {
        let kind = match datagram.kind {
            Kind::Data => udp::Kind::Data,
            Kind::Telemetry => udp::Kind::Telemetry,
        };
        sender.send(datagram.stamp_ns, kind, &datagram.payload)?;
    }
    Ok((sender.packets, sender.telemetry, format!("sent to {to}")))
}

/// Bytes of an Ethernet, an IPv4 and a UDP header.
const HEADERS: [usize; 3] = [14, 20, 8];
/// The address of a Velodyne sensor by default, and the broadcast address it sends to (VLP-16 User Manual, 63-9243,
/// section 7.1).
const ADDRESSES: [[u8; 4]; 2] = [[192, 168, 1, 201], [255, 255, 255, 255]];

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

    fn write(&mut self, datagram: &Datagram) -> std::io::Result<()> {
        let frame = frame(datagram);
        let (seconds, ns) = (datagram.stamp_ns.div_euclid(1_000_000_000), datagram.stamp_ns.rem_euclid(1_000_000_000));
        for field in [seconds as u32, ns as u32, frame.len() as u32, frame.len() as u32] {
            self.0.write_all(&field.to_le_bytes())?;
        }
        self.0.write_all(&frame)
    }
}

/// The Ethernet frame of a datagram, as a Velodyne sensor with its default settings sends it.
fn frame(datagram: &Datagram) -> Vec<u8> {
    let [_, ip_bytes, udp_bytes] = HEADERS;
    let port: u16 = match datagram.kind {
        Kind::Data => 2368,
        Kind::Telemetry => 8308,
    };
    let udp_length = (udp_bytes + datagram.payload.len()) as u16;
    let mut ip = vec![0x45, 0];
    ip.extend((ip_bytes as u16 + udp_length).to_be_bytes());
    // Identification 0, do not fragment, 64 hops, UDP, checksum.
    ip.extend([0, 0, 0x40, 0, 64, 17, 0, 0]);
    ip.extend(ADDRESSES.concat());
    let checksum = checksum(&ip);
    ip[10..12].copy_from_slice(&checksum.to_be_bytes());
    // To every station, from a station of Velodyne (60:76:88), IPv4.
    let mut frame = vec![0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x60, 0x76, 0x88, 0, 0, 1, 0x08, 0x00];
    frame.extend(ip);
    // A UDP checksum of 0 means none.
    frame.extend([port, port, udp_length, 0].iter().flat_map(|field| field.to_be_bytes()));
    frame.extend(&datagram.payload);
    frame
}

/// The checksum of an IPv4 header (RFC 791): the complement of the ones' complement sum of its 16-bit words.
fn checksum(header: &[u8]) -> u16 {
    let sum: u32 = header.chunks_exact(2).map(|word| u32::from(u16::from_be_bytes([word[0], word[1]]))).sum();
    let folded = (sum & 0xffff) + (sum >> 16);
    !(folded as u16 + (folded >> 16) as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_the_example_in_rfc_1071() {
        assert_eq!(checksum(&[0x00, 0x01, 0xf2, 0x03, 0xf4, 0xf5, 0xf6, 0xf7]), !0xddf2);
    }
}
