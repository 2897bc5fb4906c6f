//! What a file holds: a recording, a capture or a scan.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::MapView;
use clearway_lidar::capture::Capture;
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_lidar::{Sensor, SensorConfig};
use serde_json::{Map, Value, json};

use crate::record::mcap_reader::McapReader;
use super::say;

/// Tell what a file holds: an MCAP recording, a pcap or pcapng capture, a KITTI .bin or a .pcd scan.
#[derive(Args)]
pub struct Options {
    /// The file.
    file: PathBuf,
    /// One JSON object.
    #[arg(long)]
    json: bool,
}

/// Tells.
///
/// # Errors
/// What cannot be read, and files of no kind known here.
pub fn run(options: &Options) -> Result<()> {
    let file = &options.file;
    let mut start = Vec::new();
    File::open(file)
        .and_then(|f| f.take(8).read_to_end(&mut start))
        .with_context(|| format!("open {}", file.display()))?;
    let extension = file.extension().and_then(|extension| extension.to_str()).unwrap_or("");
    let document = match extension {
        "bin" => kitti(file),
        "pcd" => pcd(file),
        _ if start.starts_with(b"\x89MCAP") => recording(file),
        _ => capture(file),
    }
    .with_context(|| file.display().to_string())?;
    if options.json {
        say(&serde_json::to_string_pretty(&document)?)?;
        return Ok(());
    }
    for line in lines(&document) {
        if !say(&line)? {
            break;
        }
    }
    Ok(())
}

/// `key: value` lines, nested ones indented.
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
                lines.push(format!("{indent}{key}: {} lines; --json prints them", text.lines().count()));
            }
            Value::String(text) => lines.push(format!("{indent}{key}: {text}")),
            other => lines.push(format!("{indent}{key}: {other}")),
        }
    }
}

fn recording(file: &Path) -> Result<Value> {
    let mut recording = McapReader::salvage(file)?;
    let mut messages: BTreeMap<String, u64> = BTreeMap::new();
    let (mut events, mut maps, mut scans) = (0_u64, BTreeMap::<(String, String), u64>::new(), 0_u64);
    let mut grids: BTreeMap<String, Value> = BTreeMap::new();
    let mut span: Option<(u64, u64)> = None;
    for message in recording.by_ref() {
        let message = message?;
        *messages.entry(message.channel.topic.clone()).or_default() += 1;
        let at = message.log_ns;
        span = Some(span.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
        events += u64::from(message.channel.schema == "clearway.v1.Event");
        scans += u64::from(message.is_velodyne_scan());
        if let Some((vehicle, layer)) = message.map_of() {
            *maps.entry((vehicle.to_owned(), layer.to_owned())).or_default() += 1;
            if !grids.contains_key(layer) {
                let map = MapView::decode(message.data.clone()).with_context(|| message.channel.topic.clone())?;
                let found = map.layer(layer)?;
                let (rows, columns) = found.grid.shape();
                let channels: Vec<_> = found.channels.iter().map(|channel| &channel.name).collect();
                let legend: Vec<_> = found.legend.iter().map(|class| &class.name).collect();
                grids.insert(
                    layer.into(),
                    json!({"rows": rows, "columns": columns, "legend": legend, "channels": channels}),
                );
            }
        }
    }
    let mut vehicles: BTreeMap<String, BTreeMap<String, u64>> = BTreeMap::new();
    for ((vehicle, layer), count) in maps {
        vehicles.entry(vehicle).or_default().insert(layer, count);
    }
    let header = recording.header();
    Ok(json!({
        "kind": "recording",
        "state": recording.incomplete().unwrap_or_else(|| "complete".into()),
        "complete": recording.incomplete().is_none(),
        "duration_s": span.map(|(first, last)| (last - first) as f64 * 1e-9),
        "run": header.metadata,
        "events": events,
        "maps": vehicles,
        "layers": grids,
        "velodyne_scans": scans,
        "messages": messages,
        "calibrations": header.calibrations.keys().collect::<Vec<_>>(),
        "config": header.config,
    }))
}

/// One sender of a capture.
struct Source {
    sensor: Sensor,
    refused: BTreeMap<&'static str, u64>,
}

fn capture(file: &Path) -> Result<Value> {
    let mut capture =
        Capture::new(BufReader::new(File::open(file)?)).context("MCAP, pcap, pcapng, .bin and .pcd are known")?;
    let mut sources: BTreeMap<SocketAddr, Source> = BTreeMap::new();
    let (mut packets, mut telemetry, mut other) = (0_u64, 0_u64, 0_u64);
    let mut ports: BTreeMap<String, u64> = BTreeMap::new();
    let mut span: Option<(i64, i64)> = None;
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
        span = Some(span.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
        *ports.entry(datagram.destination_port.to_string()).or_default() += 1;
        match datagram.payload.len() {
            PACKET_LENGTH => packets += 1,
            TELEMETRY_LENGTH => telemetry += 1,
            _ => other += 1,
        }
        // One sensor sends both kinds, each from its own port.
        let sender = SocketAddr::new(datagram.source.ip(), 0);
        let source = sources
            .entry(sender)
            .or_insert_with(|| Source { sensor: Sensor::new(SensorConfig::default()), refused: BTreeMap::new() });
        if let Err(refusal) = source.sensor.push(&datagram.payload, at) {
            *source.refused.entry(refusal.reason()).or_default() += 1;
        }
    }
    let sensors: BTreeMap<_, _> = sources
        .into_iter()
        .map(|(sender, mut source)| {
            source.sensor.finish();
            let status = source.sensor.status();
            let sensor = json!({
                "model": status.model.map(|model| model.spec().name),
                "return_mode": status.return_mode.map(|mode| format!("{mode:?}").to_lowercase()),
                "rpm": status.rpm,
                "clock": status.clock.map(|clock| clock.as_str()),
                "clock_offset_ms": status.clock_offset_ms,
                "packets": status.packets,
                "packets_lost": status.packets_lost,
                "telemetry": status.telemetry,
                "returns": status.returns,
                "revolutions": status.revolutions,
                "refused": source.refused,
            });
            (sender.ip().to_string(), sensor)
        })
        .collect();
    let skipped = capture.skipped();
    Ok(json!({
        "kind": "capture",
        "state": cut.clone().unwrap_or_else(|| "complete".into()),
        "complete": cut.is_none(),
        "packets": packets,
        "telemetry": telemetry,
        "other_datagrams": other,
        "passed_over": {"not_udp": skipped.not_udp, "fragmented": skipped.fragmented, "unreadable": skipped.unreadable},
        "duration_s": span.map(|(first, last)| (last - first) as f64 * 1e-9),
        "ports": ports,
        "sensors": sensors,
    }))
}

/// float32 x y z intensity, one after the other.
fn kitti(file: &Path) -> Result<Value> {
    let bytes = std::fs::read(file)?;
    if bytes.is_empty() || !bytes.len().is_multiple_of(16) {
        bail!("{} bytes; a scan has 16 (float32 x y z intensity) a point", bytes.len());
    }
    let coordinate = |at: &[u8; 4]| f64::from(f32::from_le_bytes(*at));
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
    let mut not_finite = 0_u64;
    for point in bytes.as_chunks::<16>().0 {
        let xyz: Vec<_> = point.as_chunks::<4>().0.iter().take(3).map(coordinate).collect();
        if xyz.iter().any(|v| !v.is_finite()) {
            not_finite += 1;
            continue;
        }
        for (bound, value) in bounds.iter_mut().zip(xyz) {
            *bound = [bound[0].min(value), bound[1].max(value)];
        }
    }
    let [x, y, z] = bounds;
    Ok(json!({
        "kind": "scan", "format": "KITTI .bin", "points": bytes.len() / 16, "not_finite": not_finite,
        "bounds_m": {"x": x, "y": y, "z": z},
    }))
}

/// The header of a PCD file.
fn pcd(file: &Path) -> Result<Value> {
    let mut header = BTreeMap::new();
    let mut reader = BufReader::new(File::open(file)?).take(64 << 10);
    loop {
        let mut line = Vec::new();
        if reader.read_until(b'\n', &mut line)? == 0 {
            bail!("no PCD header: a line DATA is needed within the first 64 KiB");
        }
        let line = String::from_utf8_lossy(&line).trim().to_owned();
        if let Some((key, value)) = line.split_once(' ').filter(|_| !line.starts_with('#')) {
            header.insert(key.to_lowercase(), value.to_owned());
        }
        if line.starts_with("DATA") {
            break;
        }
    }
    let points: Option<u64> = header.get("points").and_then(|points| points.parse().ok());
    Ok(
        json!({"kind": "scan", "format": "PCD", "points": points, "fields": header.get("fields"), "data": header.get("data"), "viewpoint": header.get("viewpoint")}),
    )
}
