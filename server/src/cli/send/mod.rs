//! `clearway send`: a capture -> its datagrams, sent again over UDP at the recorded pace.
//!
//! | file | in -> out |
//! |---|---|
//! | `udp` | datagrams -> UDP, at the pace of their stamps |
//! | `network` | datagrams -> what a bad network delivers of them (feature `sim`) |

use std::collections::BTreeMap;
use std::io::BufReader;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_lidar::capture::Capture;
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_ros::velodyne_scan::VelodyneScan;
use serde_json::{Value, json};

use crate::cli::shared::exit::Exit;
use crate::cli::shared::files;
use crate::cli::shared::output::{counted, print_line, progress_bar};
use clearway_daemon::ingest::files::{Kind as FileKind, kind};
use clearway_journal::mcap_reader::McapReader;
use udp::{Kind, Sender, Speed};

#[cfg(feature = "sim")]
mod network;
pub mod udp;

/// Send the datagrams of a capture over UDP, at the recorded pace.
///
/// Sends the data packets (1206 bytes) and telemetry datagrams (512 bytes) of a pcap, a pcapng, or the VelodyneScan
/// messages of an MCAP file.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway send drive.pcap --to udp://127.0.0.1:2368
  clearway send drive.pcap --to udp://127.0.0.1:2368 --bind 127.0.0.2 --speed max")]
pub struct Options {
    /// The capture: pcap, pcapng, or MCAP with VelodyneScan messages.
    file: PathBuf,
    /// Target of the data packets.
    #[arg(long, value_name = "udp://HOST:PORT")]
    to: String,
    /// Target of the telemetry; that of the data packets if absent.
    #[arg(long, value_name = "udp://HOST:PORT")]
    telemetry_to: Option<String>,
    /// Address to send from, with or without a port; a server tells sensors apart by it.
    #[arg(long, value_name = "ADDRESS", value_parser = udp::own_address)]
    bind: Option<SocketAddr>,
    /// Speed, as a multiple of the recorded one, such as 0.5; or max for as fast as possible.
    #[arg(long, default_value = "1", value_name = "X|max", value_parser = udp::speed)]
    speed: Speed,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
    #[cfg(feature = "sim")]
    #[command(flatten)]
    network: network::NetworkOptions,
}

/// Sends the datagrams of the capture.
///
/// # Errors
/// If the capture cannot be read or the datagrams cannot be sent. A capture that is cut off is not an error; the output
/// and the exit code say so.
pub fn run(options: &Options) -> Result<Exit> {
    let to = udp::target(&options.to)?;
    let telemetry_to = options.telemetry_to.as_deref().map_or(Ok(to), udp::target)?;
    let (_, length) = files::open(&options.file)?;
    let mut route = Route {
        #[cfg(feature = "sim")]
        network: options.network.network()?,
        sender: Sender::new(to, telemetry_to, options.bind, options.speed)?,
        skipped: BTreeMap::new(),
    };
    let cut = match kind(&options.file)? {
        FileKind::Mcap => send_mcap(options, &mut route, length)?,
        _ => send_capture(options, &mut route, length)?,
    };
    let sent = route.finish()?;
    report(options, (to, telemetry_to), &sent, cut.as_deref())?;
    if sent.sender.packets + sent.sender.telemetry == 0 {
        bail!("{} has no Velodyne datagram", options.file.display());
    }
    Ok(Exit::from_incomplete(cut.is_some()))
}

/// Sends the packets of the VelodyneScan messages of an MCAP file; returns why the file is not whole.
fn send_mcap(options: &Options, route: &mut Route, length: u64) -> Result<Option<String>> {
    let progress = progress_bar(length);
    let mut recording = McapReader::open(&options.file)?;
    while let Some(message) = recording.next() {
        let message = message?;
        progress.set_position(recording.bytes_read());
        if !message.is_velodyne_scan() {
            route.skip("not a VelodyneScan", 1);
            continue;
        }
        let scan = VelodyneScan::new(&message.data).with_context(|| message.channel.topic.clone())?;
        for packet in scan.packets() {
            let (stamp_ns, packet) = packet.with_context(|| message.channel.topic.clone())?;
            route.send(stamp_ns, packet)?;
        }
    }
    progress.finish_and_clear();
    Ok(recording.incomplete())
}

/// Sends the datagrams of a pcap or pcapng file; returns why the file is not whole.
fn send_capture(options: &Options, route: &mut Route, length: u64) -> Result<Option<String>> {
    let progress = progress_bar(length);
    let (file, _) = files::open(&options.file)?;
    let mut capture = Capture::new(BufReader::new(file)).with_context(|| options.file.display().to_string())?;
    let mut cut = None;
    while let Some(datagram) = capture.next() {
        progress.set_position(capture.offset());
        match datagram {
            Ok(datagram) => route.send(datagram.stamp_ns, &datagram.payload)?,
            Err(error) => cut = Some(error.to_string()),
        }
    }
    progress.finish_and_clear();
    let skipped = capture.skipped();
    route.skip("not UDP", skipped.not_udp);
    route.skip("fragmented", skipped.fragmented);
    route.skip("unreadable", skipped.unreadable);
    Ok(cut)
}

fn report(options: &Options, to: (SocketAddr, SocketAddr), sent: &Sent, cut: Option<&str>) -> Result<()> {
    let Sent { sender, skipped, .. } = sent;
    let (packets, telemetry, seconds) = (sender.packets, sender.telemetry, sender.seconds());
    if options.json {
        let document = json!({
            "packets": packets, "telemetry": telemetry, "skipped": skipped, "seconds": seconds, "cut": cut,
            "network": sent.network_document(),
        });
        print_line(&document.to_string())?;
        return Ok(());
    }
    let (to, telemetry_to) = to;
    print_line(&format!(
        "sent {} to {to} and {} to {telemetry_to} in {seconds:.1} s",
        counted(packets, "data packet"),
        counted(telemetry, "telemetry datagram")
    ))?;
    if let Some(line) = sent.network_line() {
        print_line(&line)?;
    }
    for (reason, count) in skipped {
        print_line(&format!("skipped {count}: {reason}"))?;
    }
    if let Some(cut) = cut {
        print_line(&format!("the capture is not whole: {cut}"))?;
    }
    Ok(())
}

/// The way of the datagrams: the bad network if there is one, then the socket.
struct Route {
    #[cfg(feature = "sim")]
    network: Option<network::Network>,
    sender: Sender,
    /// Number of datagrams and packets that are not sent, by reason.
    skipped: BTreeMap<String, u64>,
}

/// What was sent.
struct Sent {
    sender: Sender,
    skipped: BTreeMap<String, u64>,
    #[cfg(feature = "sim")]
    counts: Option<clearway_sim::impair::Counts>,
}

impl Route {
    fn send(&mut self, stamp_ns: i64, payload: &[u8]) -> Result<()> {
        let Some(kind) = Kind::from_length(payload.len()) else {
            let length = payload.len();
            self.skip(&format!("{length} bytes; {PACKET_LENGTH} and {TELEMETRY_LENGTH} are sent"), 1);
            return Ok(());
        };
        #[cfg(feature = "sim")]
        if let Some(network) = &mut self.network {
            return network.send(&mut self.sender, stamp_ns, kind, payload);
        }
        self.sender.send(stamp_ns, kind, payload)
    }

    fn skip(&mut self, reason: &str, count: u64) {
        if count > 0 {
            *self.skipped.entry(reason.to_owned()).or_default() += count;
        }
    }

    /// Sends the datagrams that are still under way in the bad network.
    #[cfg(feature = "sim")]
    fn finish(mut self) -> Result<Sent> {
        let counts = self.network.map(|network| network.finish(&mut self.sender)).transpose()?;
        Ok(Sent { sender: self.sender, skipped: self.skipped, counts })
    }

    #[cfg(not(feature = "sim"))]
    fn finish(self) -> Result<Sent> {
        Ok(Sent { sender: self.sender, skipped: self.skipped })
    }
}

#[cfg(feature = "sim")]
impl Sent {
    fn network_document(&self) -> Option<Value> {
        self.counts.as_ref().map(network::document)
    }

    fn network_line(&self) -> Option<String> {
        self.counts.as_ref().map(network::line)
    }
}

#[cfg(not(feature = "sim"))]
impl Sent {
    fn network_document(&self) -> Option<Value> {
        None
    }

    fn network_line(&self) -> Option<String> {
        None
    }
}
