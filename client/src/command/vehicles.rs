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
        json!({
            "name": s.name, "model": s.model, "packets": s.packets, "refused": s.refused, "returns": s.returns,
            "rpm": s.rpm, "completeness": s.completeness, "partial": s.partial,
        })
    });
    json!({
        "name": vehicle.name,
        "boot_id": vehicle.boot_id,
        "layers": vehicle.layers,
        "maps": vehicle.maps,
        "newest_age_ms": age_ms(vehicle, now),
        "sensors": sensors.collect::<Vec<_>>(),
        "ledger": {
            "received": ledger.received, "decoded": ledger.decoded, "telemetry": ledger.telemetry,
            "refused": ledger.refused, "lost": ledger.lost,
        },
        "recorder": {"file": recorder.file, "events": recorder.events, "maps": recorder.maps, "lost": recorder.lost},
        "readers": vehicle.readers,
    })
}

fn lines(vehicle: &v1::Vehicle, now: i64) -> Vec<String> {
    let age = age_ms(vehicle, now).map_or("none yet".to_owned(), |age| format!("newest {age:.0} ms old"));
    let mut lines =
        vec![format!("{}: {} maps, {age}; layers {}", vehicle.name, vehicle.maps, vehicle.layers.join(", "))];
    for s in &vehicle.sensors {
        let partial = if s.partial.is_empty() { String::new() } else { format!(", partial ({})", s.partial) };
        lines.push(format!(
            "  sensor {} ({}): {:.0} rpm, {} packets and {} returns a turn, {:.1} % of the turn{partial}",
            s.name,
            s.model,
            s.rpm,
            s.packets,
            s.returns,
            100.0 * s.completeness
        ));
    }
    if let Some(ledger) = &vehicle.ledger {
        let refused: Vec<_> = ledger.refused.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
        let refused = if refused.is_empty() { "0".into() } else { refused.join(", ") };
        lines.push(format!(
            "  datagrams: {} received, {} decoded, {} telemetry, refused {refused}, lost {}",
            ledger.received, ledger.decoded, ledger.telemetry, ledger.lost
        ));
    }
    match vehicle.recorder.as_ref().filter(|recorder| !recorder.file.is_empty()) {
        Some(r) => lines.push(format!("  recording {}: {} events, {} maps, lost {}", r.file, r.events, r.maps, r.lost)),
        None => lines.push("  not recording".into()),
    }
    let readers: Vec<_> = vehicle.readers.iter().map(|(way, n)| format!("{way} {n}")).collect();
    lines.push(format!("  readers: {}", if readers.is_empty() { "none".into() } else { readers.join(", ") }));
    lines
}
