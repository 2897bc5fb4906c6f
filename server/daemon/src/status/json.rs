//! The JSON objects of a vehicle's state, of a sensor's state, of the recorder and of a ledger: the same for the page,
//! `clearway vehicles`, `recorder`, `get` and `export`.

use clearway_proto::v1;
use serde_json::{Value, json};

/// A run of a server in short: the first half of its boot id in hexadecimal, as in the keys of its announcements.
pub fn run_text(boot_id: u64) -> String {
    format!("run {:08x}", boot_id >> 32)
}

/// The state of one sensor as a JSON object: the fields of [`v1::SensorState`] under their own names, and a blocked
/// sector as `[from_deg, to_deg]`.
pub fn sensor_json(state: &v1::SensorState) -> Value {
    json!({
        "name": state.name, "model": state.model, "packets": state.packets, "packets_expected": state.packets_expected,
        "refused": state.refused, "returns": state.returns,
        "rpm": state.rpm, "completeness": state.completeness, "partial": state.partial,
        "blocked_deg": state.blocked_sectors.iter().map(|b| [b.from_deg, b.to_deg]).collect::<Vec<_>>(),
        "blocked_lasers": state.blocked_lasers,
        "clock": state.clock, "clock_offset_ms": state.clock_offset_ms, "epoch": state.epoch,
        "elevations": state.elevations,
        "state": state.state, "age_ms": state.age_ms,
    })
}

/// The state of a vehicle as a JSON object: the fields of [`v1::Vehicle`] under their own names, each sensor with its
/// ledger and its mount; null where a value is absent. Boot id, stamps and unknown senders are left out, because the
/// page and people need them in different forms.
pub fn vehicle_json(vehicle: &v1::Vehicle) -> Value {
    let sensors = vehicle.sensors.iter().map(|state| {
        let mut sensor = sensor_json(state);
        sensor["ledger"] = vehicle.sensor_ledgers.get(&state.name).map(ledger_json).into();
        sensor["mount"] = vehicle.mounts.get(&state.name).map(mount_json).into();
        sensor
    });
    json!({
        "name": vehicle.name,
        "layers": vehicle.layers,
        "maps": vehicle.maps,
        "reference_sensor": vehicle.reference_sensor,
        "sensors": sensors.collect::<Vec<_>>(),
        "ledger": ledger_json(&vehicle.ledger.clone().unwrap_or_default()),
        "observations_refused": vehicle.observations_refused,
        "recorder": recorder_json(&vehicle.recorder.clone().unwrap_or_default()),
        "readers": vehicle.readers,
        "fault": (!vehicle.fault.is_empty()).then_some(&vehicle.fault),
        "state": vehicle.state,
        "state_ms": vehicle.state_ms,
        "reasons": vehicle.reasons,
        "pose": vehicle.pose.map(|pose| {
            // As a string: a double of a browser cannot hold it.
            let stamp_ns = pose.stamp_ns.to_string();
            json!({"x_m": pose.x_m, "y_m": pose.y_m, "heading_deg": pose.heading_deg, "stamp_ns": stamp_ns})
        }),
        "speed_m_s": vehicle.speed_m_s,
        "map_age_ms": vehicle.map_age_ms,
        "map_valid_ms": vehicle.map_valid_ms,
        "map_rate_hz": vehicle.map_rate_hz,
        "loss": vehicle.loss,
        "latency_ms": vehicle.latency_ms,
        "drivable_share": vehicle.drivable_share,
        "map_bytes": vehicle.map_bytes,
        "skips": vehicle.skips,
        "server": vehicle.server,
        "run": run_text(vehicle.boot_id),
        "grpc": vehicle.grpc,
        "page": vehicle.page,
        "claimed_by": vehicle.claimed_by,
        "outline_m": vehicle.outline_m,
    })
}

/// The state and the counts of the recorder as a JSON object: the fields of [`v1::RecorderStatus`] under their own
/// names, the store's fields in an object of their own.
pub fn recorder_json(recorder: &v1::RecorderStatus) -> Value {
    json!({
        "file": recorder.file, "events": recorder.events, "maps": recorder.maps, "lost": recorder.lost,
        "state": recorder.state, "reason": recorder.reason, "part": recorder.part,
        "durable_events": recorder.durable_events,
        "store": {
            "confirmed": recorder.store_confirmed, "waiting": recorder.store_waiting,
            "failures": recorder.store_failures, "problem": recorder.store_problem,
            "problem_since_ns": recorder.store_problem_since_ns,
        },
        "topics": recorder.topics.iter().map(|of| {
            json!({"topic": of.topic, "offered": of.offered, "written": of.written, "dropped": of.dropped})
        }).collect::<Vec<_>>(),
    })
}

/// The counters of a vehicle or of one sensor as a JSON object: the fields of [`v1::Ledger`] under their own names.
fn ledger_json(ledger: &v1::Ledger) -> Value {
    json!({
        "received": ledger.received, "decoded": ledger.decoded, "telemetry": ledger.telemetry,
        "refused": ledger.refused, "lost": ledger.lost, "kernel_drops": ledger.kernel_drops,
        "points_dropped": ledger.points_dropped, "own_body": ledger.own_body, "through_body": ledger.through_body,
        "blind": ledger.blind, "missing": ledger.missing,
        "poses": ledger.poses, "poses_refused": ledger.poses_refused,
        "roads": ledger.roads, "roads_refused": ledger.roads_refused,
    })
}

/// How far the ground deviates from a sensor's mount, as a JSON object: the fields of [`v1::MountDeviation`] under
/// their own names.
fn mount_json(mount: &v1::MountDeviation) -> Value {
    json!({
        "height_m": mount.height_m, "pitch_deg": mount.pitch_deg, "roll_deg": mount.roll_deg,
        "height_std_m": mount.height_std_m, "pitch_std_deg": mount.pitch_std_deg, "roll_std_deg": mount.roll_std_deg,
        "scans": mount.scans, "contradicts": mount.contradicts,
    })
}
