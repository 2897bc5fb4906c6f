//! `clearway info`: a recording, a capture, a scan or a folder of them -> a description of its contents, and what is
//! wrong with it.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::io::BufReader;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use anyhow::{Context, Result};
use clap::Args;
use clearway_client::MapView;
use clearway_lidar::capture::Capture;
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_lidar::{Sensor, SensorConfig};
use clearway_mapping::event::Scan;
use clearway_mapping::scan_file;
use serde_json::{Map, Value, json};

use crate::cli::shared::exit::Exit;
use crate::cli::shared::files;
use crate::cli::shared::output::{counted, print_line, printable};
use clearway_daemon::base::file_advice::open_to_read;
use clearway_journal::channel::Channel;
use clearway_journal::encode::event_from_bytes;
use clearway_journal::mcap_reader::{McapReader, Message};
use clearway_replay::files::{Kind, Truncated, files_of_folder, kind, missing_parts};

/// Describe a file: a recording, a ROS 2 bag, a capture (pcap, pcapng) or a scan (.bin, .pcd.bin, .pcd); or a folder.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway info drive.mcap
  clearway info drive.pcap --json")]
pub struct InfoArguments {
    /// The file; its first bytes, or else its name, give its kind. Of a folder, each file but one of its scans alone.
    file: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Prints the description of the file. A file that is not whole is [`Exit::Unreadable`].
///
/// # Errors
/// If the file cannot be read or its kind is not known.
pub fn run(options: &InfoArguments) -> Result<Exit> {
    let file = &options.file;
    let document = if file.is_dir() { of_folder(file)? } else { of_file(file)? };
    if options.json {
        print_line(&serde_json::to_string_pretty(&document)?)?;
    } else {
        for line in lines(&document) {
            if !print_line(&line)? {
                break;
            }
        }
    }
    let described: Vec<(PathBuf, &Value)> = match document["files"].as_object() {
        Some(files) => files.iter().map(|(name, document)| (file.join(name), document)).collect(),
        None => vec![(file.clone(), &document)],
    };
    let mut is_incomplete = false;
    for (file, document) in described.iter().filter(|(_, document)| document["complete"] == false) {
        is_incomplete = true;
        let state = printable(document["state"].as_str().unwrap_or_default());
        eprintln!("clearway: {} is not whole: {state}", file.display());
    }
    Ok(Exit::from_incomplete(is_incomplete))
}

/// Describes the files of a folder in the order of a replay. Of scans, which are many, the first stands for all. A file
/// that cannot be read is not whole, and costs the others nothing.
fn of_folder(folder: &Path) -> Result<Value> {
    let found = files_of_folder(folder)?;
    let scans = found.iter().filter(|(_, kind)| *kind == Kind::Scan).count();
    let mut is_first_scan = true;
    let mut files = Map::new();
    for (file, kind) in &found {
        if *kind != Kind::Scan || std::mem::take(&mut is_first_scan) {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let unread = |error: anyhow::Error| json!({"complete": false, "state": format!("{error:#}")});
            files.insert(printable(&name), of_file(file).unwrap_or_else(unread));
        }
    }
    for Truncated { file, reason } in missing_parts(folder) {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        files.insert(printable(&name), json!({"complete": false, "state": reason}));
    }
    Ok(json!({"kind": "folder", "scans": scans, "files": files}))
}

fn of_file(file: &Path) -> Result<Value> {
    files::open(file)?;
    let mut document = match kind(file)? {
        // Its errors name the file.
        Kind::Mcap => recording(file)?,
        Kind::Scan => scan_file(file).with_context(|| file.display().to_string())?,
        Kind::Capture => capture(file).with_context(|| file.display().to_string())?,
    };
    document["size_bytes"] = std::fs::metadata(file)?.len().into();
    Ok(document)
}

/// The document as `key: value` lines; nested objects are indented.
fn lines(document: &Value) -> Vec<String> {
    let mut lines = Vec::new();
    describe(document.as_object().unwrap_or(&Map::new()), "", &mut lines);
    lines
}

fn describe(object: &Map<String, Value>, indent: &str, lines: &mut Vec<String>) {
    for (key, value) in object {
        match value {
            Value::Object(inner) if inner.is_empty() => lines.push(format!("{indent}{key}: none")),
            Value::Object(inner) => {
                lines.push(format!("{indent}{key}:"));
                describe(inner, &format!("{indent}  "), lines);
            }
            Value::Null => lines.push(format!("{indent}{key}: not known")),
            Value::String(text) if text.contains('\n') => {
                lines
                    .push(format!("{indent}{key}: {}; --json prints it", counted(text.lines().count() as u64, "line")));
            }
            Value::String(text) => lines.push(format!("{indent}{key}: {text}")),
            other => lines.push(format!("{indent}{key}: {other}")),
        }
    }
}

/// The value to a thousandth, as seconds, metres and revolutions per minute are printed.
fn rounded(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

fn recording(file: &Path) -> Result<Value> {
    let mut recording = McapReader::open(file)?;
    let mut messages: BTreeMap<String, u64> = BTreeMap::new();
    let (mut events, mut maps, mut scans) = (0_u64, BTreeMap::<(String, String), u64>::new(), 0_u64);
    let mut grids: BTreeMap<String, Value> = BTreeMap::new();
    // By topic: the number of messages that cannot be decoded, and the fault of the first.
    let mut unreadable: BTreeMap<String, (u64, String)> = BTreeMap::new();
    let mut span = Span::default();
    let mut spans: BTreeMap<String, Span> = BTreeMap::new();
    for message in recording.by_ref() {
        let message = message?;
        *messages.entry(message.channel.topic.clone()).or_default() += 1;
        let at = i64::try_from(message.log_ns).unwrap_or(i64::MAX);
        span.extend(at);
        spans.entry(message.channel.topic.clone()).or_default().extend(at);
        let mut add_unreadable = |message: &Message, reason: &dyn Display| {
            let of_topic = unreadable.entry(message.channel.topic.clone());
            of_topic.or_insert_with(|| (0, reason.to_string())).0 += 1;
        };
        if message.journal_of().is_some() {
            events += 1;
            if let Err(error) = event_from_bytes(message.data.clone()) {
                add_unreadable(&message, &error);
            }
        }
        scans += u64::from(message.is_velodyne_scan());
        if let Some((vehicle, layer)) = message.map_of() {
            *maps.entry((vehicle.to_owned(), layer.to_owned())).or_default() += 1;
            match grid(&message, layer) {
                Ok(grid) if !grids.contains_key(layer) => {
                    grids.insert(layer.to_owned(), grid);
                }
                Ok(_) => {}
                Err(error) => add_unreadable(&message, &error),
            }
        }
    }
    let mut vehicles: BTreeMap<String, BTreeMap<String, u64>> = BTreeMap::new();
    for ((vehicle, layer), count) in maps {
        vehicles.entry(vehicle).or_default().insert(layer, count);
    }
    let header = recording.header();
    let topic = |(channel, count): (&Channel, u64)| {
        let span = spans.get(&channel.topic).copied().unwrap_or_default();
        let rate_hz = span.seconds().filter(|seconds| *seconds > 0.0).map(|seconds| (count - 1) as f64 / seconds);
        let described = json!({
            "type": channel.schema, "encoding": channel.encoding, "messages": count, "rate_hz": rate_hz.map(rounded),
        });
        (channel.topic.clone(), described)
    };
    let topics: Map<String, Value> = recording.channels().into_iter().map(topic).collect();
    let undecoded = unreadable.iter().map(|(topic, (count, first))| {
        format!("{} of {topic} cannot be decoded, the first: {first}", counted(*count, "message"))
    });
    let faults: Vec<String> = recording.incomplete().into_iter().chain(undecoded).collect();
    let damage: Map<String, Value> =
        recording.damages().iter().map(|damage| (format!("byte {}", damage.bytes.0), damage.to_json())).collect();
    Ok(json!({
        "kind": "recording",
        "complete": faults.is_empty(),
        "state": if faults.is_empty() { "complete".to_owned() } else { faults.join("; ") },
        "damage": damage,
        "repaired": recording.repaired(),
        "begins": span.begins(),
        "ends": span.ends(),
        "duration_s": span.seconds().map(rounded),
        "topics": topics,
        "run": header.metadata,
        "maps": vehicles,
        "layers": grids,
        "events": events,
        "velodyne_scans": scans,
        "messages": messages,
        "calibrations": header.calibrations.keys().collect::<Vec<_>>(),
        "config": header.config,
    }))
}

/// The first and the last time of what a file holds, ns since the Unix epoch.
#[derive(Clone, Copy, Default)]
struct Span(Option<(i64, i64)>);

impl Span {
    fn extend(&mut self, at: i64) {
        self.0 = Some(self.0.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
    }

    fn seconds(self) -> Option<f64> {
        self.0.map(|(first, last)| last.saturating_sub(first) as f64 * 1e-9)
    }

    fn begins(self) -> Option<String> {
        self.0.map(|(first, _)| date(first))
    }

    fn ends(self) -> Option<String> {
        self.0.map(|(_, last)| date(last))
    }
}

/// A time as date and time in UTC.
fn date(ns: i64) -> String {
    let since = Duration::from_nanos(u64::try_from(ns).unwrap_or(0));
    humantime::format_rfc3339_millis(UNIX_EPOCH + since).to_string()
}

/// The shape, classes and channels of a recorded layer.
fn grid(message: &Message, layer: &str) -> Result<Value> {
    let map = MapView::decode(message.data.clone())?;
    let found = map.layer(layer)?;
    let (rows, columns) = found.grid.shape();
    let channels: Vec<_> = found.channels.iter().map(|channel| &channel.name).collect();
    let legend: Vec<_> = found.legend.iter().map(|class| &class.name).collect();
    Ok(json!({"rows": rows, "columns": columns, "legend": legend, "channels": channels}))
}

/// One sender of a capture.
struct CaptureSender {
    sensor: Sensor,
    /// Number of refused datagrams, by reason.
    refused: BTreeMap<&'static str, u64>,
}

fn capture(file: &Path) -> Result<Value> {
    let mut capture = Capture::new(BufReader::new(open_to_read(file)?))?;
    let mut sources: BTreeMap<SocketAddr, CaptureSender> = BTreeMap::new();
    let (mut packets, mut telemetry, mut other) = (0_u64, 0_u64, 0_u64);
    let mut ports: BTreeMap<String, u64> = BTreeMap::new();
    let mut span = Span::default();
    let mut cut = None;
    for datagram in capture.by_ref() {
        let datagram = match datagram {
            Ok(datagram) => datagram,
            Err(error) => {
                cut = Some(error.to_string());
                continue;
            }
        };
        let at = datagram.stamp_ns;
        span.extend(at);
        *ports.entry(datagram.destination_port.to_string()).or_default() += 1;
        match datagram.payload.len() {
            PACKET_LENGTH => packets += 1,
            TELEMETRY_LENGTH => telemetry += 1,
            _ => other += 1,
        }
        // Sensors with the factory address differ by the port that they send to; telemetry has a port of its own.
        let ip = datagram.source.ip();
        let (unknown, of_data) = (SocketAddr::new(ip, 0), SocketAddr::new(ip, datagram.destination_port));
        let sender = match datagram.payload.len() {
            TELEMETRY_LENGTH => sources.keys().find(|known| known.ip() == ip).copied().unwrap_or(unknown),
            _ => of_data,
        };
        // Telemetry came first.
        if sender == of_data
            && let Some(telemetry) = sources.remove(&unknown)
        {
            sources.insert(of_data, telemetry);
        }
        let source = sources.entry(sender).or_insert_with(|| CaptureSender {
            sensor: Sensor::new(SensorConfig::default()),
            refused: BTreeMap::new(),
        });
        if let Err(refusal) = source.sensor.push(&datagram.payload, at) {
            *source.refused.entry(refusal.reason()).or_default() += 1;
        }
    }
    let addresses: Vec<IpAddr> = sources.keys().map(SocketAddr::ip).collect();
    let sensors: BTreeMap<_, _> = sources
        .into_iter()
        .map(|(sender, mut source)| {
            source.sensor.finish();
            let is_alone = addresses.iter().filter(|address| **address == sender.ip()).count() == 1;
            (if is_alone { sender.ip().to_string() } else { sender.to_string() }, sensor(&source))
        })
        .collect();
    let skipped = capture.skipped();
    Ok(json!({
        "kind": "capture",
        "complete": cut.is_none(),
        "state": cut.clone().unwrap_or_else(|| "complete".into()),
        "begins": span.begins(),
        "ends": span.ends(),
        "duration_s": span.seconds().map(rounded),
        "packets": packets,
        "telemetry": telemetry,
        "other_datagrams": other,
        "passed_over": {"not_udp": skipped.not_udp, "fragmented": skipped.fragmented, "unreadable": skipped.unreadable, "link_type": skipped.link_type},
        "ports": ports,
        "sensors": sensors,
    }))
}

fn sensor(source: &CaptureSender) -> Value {
    let status = source.sensor.status();
    json!({
        "model": status.model.map(|model| model.spec().name),
        "return_mode": status.return_mode.map(|mode| format!("{mode:?}").to_lowercase()),
        "rpm": status.rpm.map(|rpm| rounded(rpm.into())),
        "clock": status.clock.map(|clock| clock.as_str()),
        "clock_offset_ms": status.clock_offset_ms,
        "packets": status.packets,
        "packets_lost": status.packets_lost,
        "telemetry": status.telemetry,
        "returns": status.returns,
        "revolutions": status.revolutions,
        "refused": source.refused,
    })
}

fn scan_file(file: &Path) -> Result<Value> {
    let (format, found) = scan_file::read(&file.to_string_lossy(), &std::fs::read(file)?)?;
    Ok(scan(format.as_str(), &found))
}

/// The number of points and rings of a scan and the box around the points that are finite.
fn scan(format: &str, scan: &Scan) -> Value {
    let points = || scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]);
    let finite = || points().filter(|point| point.iter().all(|value| value.is_finite()));
    let bounds = |axis: usize| {
        let values = finite().map(|point| f64::from(point[axis]));
        let least_and_greatest = values.fold(None, |bounds: Option<[f64; 2]>, value| {
            Some(bounds.map_or([value; 2], |[least, greatest]| [least.min(value), greatest.max(value)]))
        });
        least_and_greatest.map(|bounds| bounds.map(rounded))
    };
    let rings: std::collections::BTreeSet<u16> = scan.ring.iter().copied().collect();
    json!({
        "kind": "scan", "format": format, "rings": (!rings.is_empty()).then_some(rings.len()),
        "points": scan.x.len(), "not_finite": scan.x.len() - finite().count(),
        "bounds_m": {"x": bounds(0), "y": bounds(1), "z": bounds(2)},
    })
}
