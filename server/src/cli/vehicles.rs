//! What a server knows of its vehicles.

use anyhow::Result;
use clap::Args;
use clearway_client::{now_ns, v1};
use serde_json::{Value, json};

use super::{Server, say};

/// List a server's vehicles: maps, sensors, what was refused or lost, readers, recorder.
#[derive(Args)]
pub struct Options {
    #[command(flatten)]
    server: Server,
    /// One JSON array.
    #[arg(long)]
    json: bool,
}

/// Lists.
///
/// # Errors
/// What the server says.
pub async fn run(options: Options) -> Result<()> {
    let vehicles = options.server.connect().await?.vehicles().await?;
    let now = now_ns();
    if options.json {
        let documents: Vec<_> = vehicles.iter().map(|vehicle| document(vehicle, now)).collect();
        say(&serde_json::to_string_pretty(&documents)?)?;
        return Ok(());
    }
    for vehicle in &vehicles {
        for line in lines(vehicle, now) {
            say(&line)?;
        }
    }
    if vehicles.is_empty() {
        say("the server has no vehicles")?;
    }
    Ok(())
}

fn age_ms(vehicle: &v1::Vehicle, now: i64) -> Option<f64> {
    (vehicle.newest_capture_end_ns != 0).then(|| (now - vehicle.newest_capture_end_ns) as f64 * 1e-6)
}

fn document(vehicle: &v1::Vehicle, now: i64) -> Value {
    let ledger = vehicle.ledger.clone().unwrap_or_default();
    let recorder = vehicle.recorder.clone().unwrap_or_default();
    let sensors = vehicle.sensors.iter().map(|s| {
        let mut sensor = super::document::sensor(s);
        sensor["ledger"] = vehicle.sensor_ledgers.get(&s.name).map(ledger_document).into();
        sensor
    });
    json!({
        "name": vehicle.name,
        "boot_id": vehicle.boot_id,
        "layers": vehicle.layers,
        "maps": vehicle.maps,
        "newest_age_ms": age_ms(vehicle, now),
        "sensors": sensors.collect::<Vec<_>>(),
        "ledger": ledger_document(&ledger),
        "observations_refused": vehicle.observations_refused,
        "recorder": {"file": recorder.file, "events": recorder.events, "maps": recorder.maps, "lost": recorder.lost},
        "readers": vehicle.readers,
        "unknown_senders": vehicle.unknown_senders.iter().map(|s| {
            json!({"address": s.address, "datagrams": s.datagrams, "newest_age_ms": (now - s.newest_ns) as f64 * 1e-6})
        }).collect::<Vec<_>>(),
    })
}

fn ledger_document(ledger: &v1::Ledger) -> Value {
    json!({
        "received": ledger.received, "decoded": ledger.decoded, "telemetry": ledger.telemetry,
        "refused": ledger.refused, "lost": ledger.lost, "kernel_drops": ledger.kernel_drops,
        "points_dropped": ledger.points_dropped, "own_body": ledger.own_body, "through_body": ledger.through_body,
        "blind": ledger.blind,
        "poses": ledger.poses, "poses_refused": ledger.poses_refused,
        "roads": ledger.roads, "roads_refused": ledger.roads_refused,
    })
}

fn ledger_line(ledger: &v1::Ledger) -> String {
    let refused: Vec<_> = ledger.refused.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    let refused = if refused.is_empty() { "0".into() } else { refused.join(", ") };
    format!(
        "datagrams: {} received, {} decoded, {} telemetry, refused {refused}; lost {}",
        ledger.received, ledger.decoded, ledger.telemetry, ledger.lost
    )
}

fn lines(vehicle: &v1::Vehicle, now: i64) -> Vec<String> {
    let age = age_ms(vehicle, now).map_or("none yet".to_owned(), |age| format!("newest {age:.0} ms old"));
    let mut lines =
        vec![format!("{}: {} maps, {age}; layers {}", vehicle.name, vehicle.maps, vehicle.layers.join(", "))];
    for s in &vehicle.sensors {
        let partial = if s.partial.is_empty() { String::new() } else { format!(", partial ({})", s.partial) };
        let sectors: Vec<_> = s.blocked_sectors.iter().map(|b| format!("{} to {} deg", b.from_deg, b.to_deg)).collect();
        let lasers: Vec<_> = s.blocked_lasers.iter().map(|laser| format!("laser {laser}")).collect();
        let blocked = [sectors, lasers].concat().join(", ");
        let blocked = if blocked.is_empty() { blocked } else { format!(", BLOCKED: {blocked}") };
        lines.push(format!(
            "  sensor {} ({}): {:.0} rpm, {} of {} packets and {} returns a turn, {:.1} % of the turn{partial}{blocked}, clock {} \
             (host {:+} ms)",
            s.name,
            s.model,
            s.rpm,
            s.packets,
            s.packets_expected,
            s.returns,
            100.0 * s.completeness,
            s.clock,
            s.clock_offset_ms
        ));
        lines.extend(vehicle.sensor_ledgers.get(&s.name).map(|ledger| format!("    {}", ledger_line(ledger))));
    }
    if let Some(ledger) = &vehicle.ledger {
        lines.push(format!("  {}, dropped by the kernel {}", ledger_line(ledger), ledger.kernel_drops));
        let roads_refused: u64 = ledger.roads_refused.values().sum();
        if ledger.poses + ledger.poses_refused + ledger.roads + roads_refused > 0 {
            lines.push(format!(
                "  poses: {} taken, {} refused; roads: {} taken, {roads_refused} refused",
                ledger.poses, ledger.poses_refused, ledger.roads
            ));
        }
    }
    for s in &vehicle.unknown_senders {
        let age = (now - s.newest_ns) as f64 * 1e-9;
        lines.push(format!("  unknown sender {}: {} datagrams, the newest {age:.0} s ago", s.address, s.datagrams));
    }
    match vehicle.recorder.as_ref().filter(|recorder| !recorder.file.is_empty()) {
        Some(r) => lines.push(format!("  recording {}: {} events, {} maps, lost {}", r.file, r.events, r.maps, r.lost)),
        None => lines.push("  not recording".into()),
    }
    let readers: Vec<_> = vehicle.readers.iter().map(|(way, n)| format!("{way} {n}")).collect();
    lines.push(format!("  readers: {}", if readers.is_empty() { "none".into() } else { readers.join(", ") }));
    lines
}
