//! `clearway send`: a capture -> its datagrams, sent again over UDP at the recorded pace.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use clearway_tools::network::{self, Faults};
use clearway_tools::send::{Pace, SendOptions, SendSummary, send, target};
use serde_json::json;

use crate::process::stop_flag;
use crate::terminal::{Exit, counted, print_line, progress_bar};
use clearway_daemon::base::files;

/// Send the datagrams of a capture over UDP, at the recorded pace.
///
/// Sends the data packets (1206 bytes) and telemetry datagrams (512 bytes) of a pcap, a pcapng, or the VelodyneScan
/// messages of an MCAP file.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway send drive.pcap --to udp://127.0.0.1:2368
  clearway send drive.pcap --to udp://127.0.0.1:2368 --loop
  clearway send drive.pcap --to udp://127.0.0.1:2368 --bind 127.0.0.2 --speed max
  clearway send drive.pcap --to udp://127.0.0.1:2368 --network loss=5,reorder=8,seed=7")]
pub struct SendArguments {
    /// The capture: pcap, pcapng, or MCAP with VelodyneScan messages.
    file: PathBuf,
    /// Target of the data packets.
    #[arg(long, value_name = "udp://HOST:PORT")]
    to: String,
    /// Target of the telemetry; the target of the data packets if absent.
    #[arg(long, value_name = "udp://HOST:PORT")]
    telemetry_to: Option<String>,
    /// Address to send from, with or without a port; a server tells sensors apart by it.
    #[arg(long, value_name = "ADDRESS", value_parser = own_address)]
    bind: Option<SocketAddr>,
    /// Speed, as a multiple of the recorded one, such as 0.5; or max for as fast as possible.
    #[arg(long, default_value = "1", value_name = "X|max", value_parser = pace)]
    speed: Pace,
    /// Send the capture again and again, until Ctrl-C.
    #[arg(long = "loop")]
    repeats: bool,
    /// Simulate a bad network. In percent of the datagrams: loss, duplicate, truncate (cut short), flip (a bit). In
    /// data packets: burst (most that are lost in a row; about one packet in 200 begins a burst), reorder (most that
    /// overtake a late one; one in four is late). Also delay_ms (longest delay) and seed (the same seed makes the same
    /// network).
    #[arg(long, value_name = "FAULT=N,...", value_parser = network::faults)]
    network: Option<Faults>,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
}

fn pace(text: &str) -> Result<Pace, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(Pace::AsFastAsPossible),
        Ok(times) if (0.001..=1000.0).contains(&times) => Ok(Pace::Times(times)),
        _ => Err("0.001 to 1000, or max, is allowed".into()),
    }
}

fn own_address(text: &str) -> Result<SocketAddr, String> {
    let without_port = || text.parse::<IpAddr>().map(|ip| SocketAddr::new(ip, 0));
    text.parse()
        .or_else(|_| without_port())
        .map_err(|_| "an address such as 127.0.0.2 or 127.0.0.2:2368 is allowed".into())
}

/// Sends the datagrams of the capture.
pub fn run(arguments: SendArguments) -> Result<Exit> {
    let SendArguments { file, to, telemetry_to, bind, speed: pace, repeats, network: faults, json } = arguments;
    let to = target(&to)?;
    let telemetry_to = telemetry_to.as_deref().map_or(Ok(to), target)?;
    let any: IpAddr = if to.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    let bar = progress_bar(files::open(&file)?.1);
    let options = SendOptions { file, to, telemetry_to, own: bind.unwrap_or((any, 0).into()), pace, repeats, faults };
    let summary = send(&options, &*stop_flag()?, |bytes| bar.set_position(bytes))?;
    bar.finish_and_clear();
    print_line(&if json { document(&summary) } else { text(&summary, &options) })?;
    if summary.sent.refused > 0 {
        eprintln!("clearway: no socket is open at {to}: its machine refused datagrams {} times", summary.sent.refused);
    }
    Ok(Exit::from_incomplete(summary.cut.is_some() || summary.sent.refused > 0))
}

fn document(summary: &SendSummary) -> String {
    let SendSummary { sent, elapsed, skipped, notes, cut, network } = summary;
    json!({
        "packets": sent.packets, "telemetry": sent.telemetry, "refused": sent.refused, "skipped": skipped,
        "notes": notes, "seconds": elapsed.as_secs_f64(), "cut": cut, "network": network.as_ref().map(network::document),
    })
    .to_string()
}

fn text(summary: &SendSummary, options: &SendOptions) -> String {
    let SendSummary { sent, elapsed, skipped, notes, cut, network } = summary;
    let (packets, telemetry) = (counted(sent.packets, "data packet"), counted(sent.telemetry, "telemetry datagram"));
    let (to, telemetry_to, seconds) = (options.to, options.telemetry_to, elapsed.as_secs_f64());
    let mut lines = vec![format!("sent {packets} to {to} and {telemetry} to {telemetry_to} in {seconds:.1} s")];
    lines.extend(network.as_ref().map(network::line));
    lines.extend(skipped.iter().map(|(reason, count)| format!("skipped {count}: {reason}")));
    lines.extend(notes.iter().cloned());
    lines.extend(cut.as_ref().map(|cut| format!("the capture is not whole: {cut}")));
    lines.join("\n")
}
