//! A capture (pcap, pcapng) -> its datagrams and its sensors.

use std::collections::BTreeMap;
use std::io::BufReader;
use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use anyhow::Result;
use clearway_daemon::base::file_advice::open_to_read;
use clearway_lidar::capture::{Capture, Datagram};
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_lidar::{Sensor, SensorConfig};
use serde_json::{Value, json};

use super::span::{Span, rounded};

/// One sender of a capture.
struct CaptureSender {
    sensor: Sensor,
    /// Number of refused datagrams, by reason.
    refused: BTreeMap<&'static str, u64>,
}

/// What the datagrams of a capture hold.
#[derive(Default)]
struct CapturedContents {
    span: Span,
    packets: u64,
    telemetry: u64,
    other: u64,
    /// Number of datagrams by the port that they were sent to.
    ports: BTreeMap<String, u64>,
    senders: BTreeMap<SocketAddr, CaptureSender>,
}

impl CapturedContents {
    fn add(&mut self, datagram: &Datagram) {
        self.span.extend(datagram.stamp_ns);
        *self.ports.entry(datagram.destination_port.to_string()).or_default() += 1;
        match datagram.payload.len() {
            PACKET_LENGTH => self.packets += 1,
            TELEMETRY_LENGTH => self.telemetry += 1,
            _ => self.other += 1,
        }
        let sender = self.sender(datagram);
        if let Err(refusal) = sender.sensor.push(&datagram.payload, datagram.stamp_ns) {
            *sender.refused.entry(refusal.reason()).or_default() += 1;
        }
    }

    /// The sender of a datagram. Sensors with the factory address differ by the port that they send to; telemetry has a
    /// port of its own.
    fn sender(&mut self, datagram: &Datagram) -> &mut CaptureSender {
        let ip = datagram.source.ip();
        let (unknown, of_data) = (SocketAddr::new(ip, 0), SocketAddr::new(ip, datagram.destination_port));
        let sender = match datagram.payload.len() {
            TELEMETRY_LENGTH => self.senders.keys().find(|known| known.ip() == ip).copied().unwrap_or(unknown),
            _ => of_data,
        };
        // Telemetry came first.
        if sender == of_data
            && let Some(telemetry) = self.senders.remove(&unknown)
        {
            self.senders.insert(of_data, telemetry);
        }
        let new = || CaptureSender { sensor: Sensor::new(SensorConfig::default()), refused: BTreeMap::new() };
        self.senders.entry(sender).or_insert_with(new)
    }

    /// The sensors by address, with the port if an address has several.
    fn sensors(self) -> BTreeMap<String, Value> {
        let addresses: Vec<IpAddr> = self.senders.keys().map(SocketAddr::ip).collect();
        let named = |(at, sender): (SocketAddr, CaptureSender)| {
            let is_alone = addresses.iter().filter(|address| **address == at.ip()).count() == 1;
            (if is_alone { at.ip().to_string() } else { at.to_string() }, sensor(sender))
        };
        self.senders.into_iter().map(named).collect()
    }
}

/// The description of a capture.
pub fn describe(file: &Path) -> Result<Value> {
    let mut capture = Capture::new(BufReader::new(open_to_read(file)?))?;
    let mut contents = CapturedContents::default();
    let mut cut = None;
    for datagram in capture.by_ref() {
        match datagram {
            Ok(datagram) => contents.add(&datagram),
            Err(error) => cut = Some(error.to_string()),
        }
    }
    let (skipped, span) = (capture.skipped(), contents.span);
    Ok(json!({
        "kind": "capture",
        "complete": cut.is_none(),
        "state": cut.unwrap_or_else(|| "complete".into()),
        "begins": span.begins(),
        "ends": span.ends(),
        "duration_s": span.seconds().map(rounded),
        "packets": contents.packets,
        "telemetry": contents.telemetry,
        "other_datagrams": contents.other,
        "passed_over": {"not_udp": skipped.not_udp, "fragmented": skipped.fragmented, "unreadable": skipped.unreadable, "link_type": skipped.link_type},
        "ports": contents.ports,
        "sensors": contents.sensors(),
    }))
}

fn sensor(CaptureSender { mut sensor, refused }: CaptureSender) -> Value {
    sensor.finish();
    let status = sensor.status();
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
        "refused": refused,
    })
}
