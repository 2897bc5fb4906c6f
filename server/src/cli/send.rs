//! A capture -> its datagrams, sent again over UDP at the recorded pace.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_lidar::capture::Capture;
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_sim::impair::{Counts, Impairment};
use clearway_sim::vehicle::{Datagram, Kind};
use serde_json::json;

use super::network;
use super::progress_bar;
use crate::record::mcap_reader::McapReader;

/// A capture with a hole of hours is not a reason to sit and wait.
const PAUSE_MAX: Duration = Duration::from_secs(60);

/// Send a capture's datagrams: data packets (1206 bytes) and telemetry (512 bytes) of a pcap, a pcapng, or the
/// VelodyneScan messages of an MCAP file.
#[derive(Args)]
pub struct Options {
    /// The capture.
    file: PathBuf,
    /// Where data packets go.
    #[arg(long, value_name = "udp://HOST:PORT")]
    to: String,
    /// Where telemetry goes; with the data packets unless given.
    #[arg(long, value_name = "udp://HOST:PORT")]
    telemetry_to: Option<String>,
    /// Address to send from, with a port or without: how a server tells several senders apart.
    #[arg(long, value_name = "ADDRESS", value_parser = own_address)]
    bind: Option<SocketAddr>,
    /// Multiple of the recorded pace, or max for as fast as it goes.
    #[arg(long, default_value = "1", value_name = "X|max", value_parser = speed)]
    speed: Speed,
    #[command(flatten)]
    network: network::Network,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy)]
enum Speed {
    Times(f64),
    Max,
}

fn speed(text: &str) -> Result<Speed, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(Speed::Max),
        Ok(times) if (0.001..=1000.0).contains(&times) => Ok(Speed::Times(times)),
        _ => Err("0.001 to 1000, or max, is allowed".into()),
    }
}

fn own_address(text: &str) -> Result<SocketAddr, String> {
    let without_port = || text.parse::<IpAddr>().map(|ip| SocketAddr::new(ip, 0));
    text.parse()
        .or_else(|_| without_port())
        .map_err(|_| "an address such as 127.0.0.2 or 127.0.0.2:2368 is allowed".into())
}

fn target(text: &str) -> Result<SocketAddr> {
    let rest = text.strip_prefix("udp://").with_context(|| format!("{text:?}: udp://HOST:PORT is allowed"))?;
    let mut found = rest.to_socket_addrs().with_context(|| format!("{text:?}: udp://HOST:PORT is allowed"))?;
    found.next().with_context(|| format!("{text:?}: the host has no address"))
}

/// Sends.
///
/// # Errors
/// What cannot be read or sent; a capture that is cut is no error, but is said.
pub fn run(options: &Options) -> Result<()> {
    let to = target(&options.to)?;
    let telemetry_to = options.telemetry_to.as_deref().map_or(Ok(to), target)?;
    let length = std::fs::metadata(&options.file).with_context(|| format!("open {}", options.file.display()))?.len();
    let sender = Sender::new(to, telemetry_to, options.bind, options.speed)?;
    let mut sender = Through { network: options.network.faults().map(Impairment::new), sender };
    let progress = progress_bar(length);
    let mut cut = None;
    if options.file.extension().is_some_and(|extension| extension == "mcap") {
        let mut recording = McapReader::salvage(&options.file)?;
        while let Some(message) = recording.next() {
            let message = message?;
            progress.set_position(recording.bytes_read());
            if !message.is_velodyne_scan() {
                sender.sender.skip("not a VelodyneScan", 1);
                continue;
            }
            let scan = VelodyneScan::new(&message.data).with_context(|| message.channel.topic.clone())?;
            for packet in scan.packets() {
                let (stamp_ns, packet) = packet.with_context(|| message.channel.topic.clone())?;
                sender.send(stamp_ns, packet)?;
            }
        }
        cut = recording.incomplete();
    } else {
        let file = File::open(&options.file).with_context(|| format!("open {}", options.file.display()))?;
        let mut capture = Capture::new(BufReader::new(file)).with_context(|| options.file.display().to_string())?;
        while let Some(datagram) = capture.next() {
            progress.set_position(capture.offset());
            match datagram {
                Ok(datagram) => sender.send(datagram.stamp_ns, &datagram.payload)?,
                Err(error) => cut = Some(error.to_string()),
            }
        }
        let skipped = capture.skipped();
        sender.sender.skip("not UDP", skipped.not_udp);
        sender.sender.skip("fragmented", skipped.fragmented);
        sender.sender.skip("unreadable", skipped.unreadable);
    }
    progress.finish_and_clear();
    let (sender, counts) = sender.finish()?;
    let Sender { packets, telemetry, skipped, .. } = &sender;
    let seconds = sender.started.map_or(0.0, |(at, _)| at.elapsed().as_secs_f64());
    if options.json {
        let document = json!({
            "packets": packets, "telemetry": telemetry, "skipped": skipped, "seconds": seconds, "cut": cut,
            "network": counts.as_ref().map(network::document),
        });
        println!("{document}");
    } else {
        println!(
            "sent {packets} data packets to {to} and {telemetry} telemetry datagrams to {telemetry_to} in {seconds:.1} s"
        );
        if let Some(counts) = &counts {
            println!("{}", network::line(counts));
        }
        for (reason, count) in skipped {
            println!("skipped {count}: {reason}");
        }
        if let Some(cut) = &cut {
            println!("the capture is not whole: {cut}");
        }
    }
    if *packets + *telemetry == 0 {
        bail!("{} has no Velodyne datagram", options.file.display());
    }
    Ok(())
}

/// A sender behind a network, good or bad.
struct Through {
    network: Option<Impairment>,
    sender: Sender,
}

impl Through {
    fn send(&mut self, stamp_ns: i64, payload: &[u8]) -> Result<()> {
        let kind = match payload.len() {
            PACKET_LENGTH => Kind::Data,
            TELEMETRY_LENGTH => Kind::Telemetry,
            length => {
                self.sender.skip(&format!("{length} bytes; {PACKET_LENGTH} and {TELEMETRY_LENGTH} are sent"), 1);
                return Ok(());
            }
        };
        let Some(network) = &mut self.network else { return self.sender.send(stamp_ns, kind, payload) };
        let mut arriving = network.push(Datagram { stamp_ns, kind, payload: payload.to_vec() });
        arriving.try_for_each(|datagram| self.sender.send(datagram.stamp_ns, datagram.kind, &datagram.payload))
    }

    /// Sends what is still under way; gives what the network did.
    fn finish(mut self) -> Result<(Sender, Option<Counts>)> {
        if let Some(network) = &mut self.network {
            let mut arriving = network.finish();
            arriving.try_for_each(|datagram| self.sender.send(datagram.stamp_ns, datagram.kind, &datagram.payload))?;
        }
        Ok((self.sender, self.network.map(|network| network.counts())))
    }
}

struct Sender {
    socket: UdpSocket,
    to: SocketAddr,
    telemetry_to: SocketAddr,
    speed: Speed,
    /// When the first datagram went, and its stamp.
    started: Option<(Instant, i64)>,
    packets: u64,
    telemetry: u64,
    skipped: BTreeMap<String, u64>,
}

impl Sender {
    fn new(to: SocketAddr, telemetry_to: SocketAddr, bind: Option<SocketAddr>, speed: Speed) -> Result<Self> {
        let any =
            SocketAddr::new(if to.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() }, 0);
        let own = bind.unwrap_or(any);
        let socket = UdpSocket::bind(own).with_context(|| format!("open a UDP socket at {own}"))?;
        let skipped = BTreeMap::new();
        Ok(Self { socket, to, telemetry_to, speed, started: None, packets: 0, telemetry: 0, skipped })
    }

    fn skip(&mut self, reason: &str, count: u64) {
        if count > 0 {
            *self.skipped.entry(reason.to_owned()).or_default() += count;
        }
    }

    fn send(&mut self, stamp_ns: i64, kind: Kind, payload: &[u8]) -> Result<()> {
        let (to, count) = match kind {
            Kind::Data => (self.to, &mut self.packets),
            Kind::Telemetry => (self.telemetry_to, &mut self.telemetry),
        };
        let (started, first_ns) = *self.started.get_or_insert_with(|| (Instant::now(), stamp_ns));
        if let Speed::Times(times) = self.speed {
            let due = Duration::from_secs_f64((stamp_ns.saturating_sub(first_ns)).max(0) as f64 * 1e-9 / times);
            let pause = due.saturating_sub(started.elapsed());
            if pause > PAUSE_MAX {
                // Time goes on from here.
                self.started = Some((Instant::now(), stamp_ns));
            } else {
                std::thread::sleep(pause);
            }
        }
        match self.socket.send_to(payload, to) {
            Ok(_) => *count += 1,
            // An answer to an earlier datagram, on loopback: nobody listens yet, and UDP does not care.
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused => *count += 1,
            Err(error) => return Err(error).with_context(|| format!("send to {to}")),
        }
        Ok(())
    }
}
