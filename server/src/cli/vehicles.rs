//! `clearway vehicles`: a server -> the state of its vehicles.

use anyhow::Result;
use clap::Args;
use clearway_client::{now_ns, v1};
use serde_json::{Value, json};

use crate::connect::{ServerOptions, explain};
use crate::terminal::{Exit, age_text, counted, one_line, print_line};
use crate::vehicles::servers::{is_of_several_servers, server_text};
use clearway_daemon::status::vehicle_json;

/// List the vehicles of a server and of those it knows: maps, sensors, losses, readers, recording.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway vehicles
  clearway vehicles --server vehicle.local:50051 --json")]
pub struct VehiclesArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// Print one JSON array.
    #[arg(long)]
    json: bool,
}

/// Prints the state of every vehicle.
pub async fn run(options: &VehiclesArguments) -> Result<Exit> {
    let vehicles = options.server.connect().await?.vehicles().await.map_err(explain)?;
    let now = now_ns();
    if options.json {
        let documents: Vec<_> = vehicles.iter().map(|vehicle| document(vehicle, now)).collect();
        print_line(&serde_json::to_string_pretty(&documents)?)?;
        return Ok(Exit::Good);
    }
    let is_fleet = is_of_several_servers(&vehicles);
    for line in vehicles.iter().flat_map(|vehicle| lines(vehicle, is_fleet, now)) {
        print_line(&one_line(&line))?;
    }
    if vehicles.is_empty() {
        print_line("the server has no vehicles")?;
    }
    Ok(Exit::Good)
}

fn age_ms(vehicle: &v1::Vehicle, now: i64) -> Option<f64> {
    (vehicle.newest_capture_end_ns != 0).then(|| (now - vehicle.newest_capture_end_ns) as f64 * 1e-6)
}

fn document(vehicle: &v1::Vehicle, now: i64) -> Value {
    let unknown_senders = vehicle.unknown_senders.iter().map(|sender| {
        let age_ms = (now - sender.newest_ns) as f64 * 1e-6;
        json!({"address": sender.address, "datagrams": sender.datagrams, "newest_age_ms": age_ms})
    });
    let mut document = vehicle_json(vehicle);
    document["boot_id"] = vehicle.boot_id.into();
    document["newest_age_ms"] = age_ms(vehicle, now).into();
    document["unknown_senders"] = unknown_senders.collect();
    document
}

/// The lines for one vehicle, with its server if there are several.
fn lines(vehicle: &v1::Vehicle, is_fleet: bool, now: i64) -> Vec<String> {
    let age = age_ms(vehicle, now).map_or("none yet".to_owned(), |age| format!("newest {}", age_text(age)));
    let server = if is_fleet { format!(" on {}", server_text(vehicle)) } else { String::new() };
    let mut lines = vec![format!(
        "{}{server}: {}, {age}; layers {}",
        vehicle.name,
        counted(vehicle.maps, "map"),
        vehicle.layers.join(", ")
    )];
    for state in &vehicle.sensors {
        lines.push(sensor_line(state));
        lines.extend(vehicle.mounts.get(&state.name).filter(|mount| mount.contradicts).map(mount_line));
        lines.extend(vehicle.sensor_ledgers.get(&state.name).map(|ledger| format!("    {}", ledger_line(ledger))));
    }
    if let Some(ledger) = &vehicle.ledger {
        let loss = vehicle.loss.map_or("unknown".to_owned(), |loss| format!("{:.1} %", 100.0 * loss));
        let kernel_drops = ledger.kernel_drops;
        lines.push(format!(
            "  {}, by the kernel {kernel_drops}; lost or refused in the last 10 s: {loss}",
            ledger_line(ledger)
        ));
        let roads_refused: u64 = ledger.roads_refused.values().sum();
        if ledger.poses + ledger.poses_refused + ledger.roads + roads_refused > 0 {
            lines.push(format!(
                "  poses: {} accepted, {} refused; roads: {} accepted, {roads_refused} refused",
                ledger.poses, ledger.poses_refused, ledger.roads
            ));
        }
    }
    for s in &vehicle.unknown_senders {
        let age = (now - s.newest_ns) as f64 * 1e-9;
        let datagrams = counted(s.datagrams, "datagram");
        lines.push(format!("  unknown sender {}: {datagrams}, the newest {age:.0} s ago", s.address));
    }
    match vehicle.recorder.as_ref().filter(|recorder| !recorder.file.is_empty()) {
        Some(r) => {
            let (events, maps) = (counted(r.events, "event"), counted(r.maps, "map"));
            let reason = if r.reason.is_empty() { String::new() } else { format!(": {}", r.reason) };
            lines.push(format!("  recording {}: {events}, {maps}, lost {}{reason}", r.file, r.lost));
        }
        None if let Some(r) = vehicle.recorder.as_ref().filter(|recorder| !recorder.state.is_empty()) => {
            lines.push(format!("  recorder {}: {}, lost {}", r.state, r.reason, r.lost));
        }
        None => lines.push("  not recording".into()),
    }
    if !vehicle.fault.is_empty() {
        lines.push(format!("  FAULT: {}", vehicle.fault));
    }
    let readers: Vec<_> = vehicle.readers.iter().map(|(transport, n)| format!("{transport} {n}")).collect();
    lines.push(format!("  readers: {}", if readers.is_empty() { "none".into() } else { readers.join(", ") }));
    lines
}

fn sensor_line(state: &v1::SensorState) -> String {
    let partial = if state.partial.is_empty() { String::new() } else { format!(", partial ({})", state.partial) };
    let sectors = state.blocked_sectors.iter().map(|sector| format!("{} to {} deg", sector.from_deg, sector.to_deg));
    let lasers = state.blocked_lasers.iter().map(|laser| format!("laser {laser}"));
    let blocked = sectors.chain(lasers).collect::<Vec<_>>().join(", ");
    let blocked = if blocked.is_empty() { blocked } else { format!(", BLOCKED: {blocked}") };
    let epoch = if state.epoch == 0 { String::new() } else { format!(", epoch {}", state.epoch) };
    let elevations =
        if state.elevations.is_empty() { String::new() } else { format!(", elevations {}", state.elevations) };
    format!(
        "  sensor {} ({}): {:.0} rpm, {} of {} packets and {} a revolution, {:.1} % of the revolution{partial}\
         {blocked}{elevations}, clock {} (host {:+} ms){epoch}",
        state.name,
        state.model,
        state.rpm,
        state.packets,
        state.packets_expected,
        counted(state.returns.into(), "return"),
        100.0 * state.completeness,
        state.clock,
        state.clock_offset_ms
    )
}

fn mount_line(mount: &v1::MountDeviation) -> String {
    format!(
        "    MOUNT: the ground contradicts it: the sensor is {:+.2} ± {:.2} m higher than configured, the ground is \
         tilted by {:+.1} ± {:.1} deg in pitch and {:+.1} ± {:.1} deg in roll",
        mount.height_m, mount.height_std_m, mount.pitch_deg, mount.pitch_std_deg, mount.roll_deg, mount.roll_std_deg
    )
}

fn ledger_line(ledger: &v1::Ledger) -> String {
    let refused: Vec<_> = ledger.refused.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    let refused = if refused.is_empty() { "0".into() } else { refused.join(", ") };
    format!(
        "datagrams: {} received, {} decoded, {} telemetry, refused {refused}; lost on the way {}, dropped at the \
         full queue {}",
        ledger.received, ledger.decoded, ledger.telemetry, ledger.missing, ledger.lost
    )
}
