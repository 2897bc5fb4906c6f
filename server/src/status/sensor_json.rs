//! The JSON objects of a sensor's state and of a ledger: the same for the page, `clearway vehicles`, `get` and
//! `export`.

use clearway_proto::v1;
use serde_json::{Value, json};

/// The state of one sensor as a JSON object: the fields of [`v1::SensorState`] under their own names, and a blocked
/// sector as `[from_deg, to_deg]`.
pub fn sensor_json(state: &v1::SensorState) -> Value {
    json!({
        "name": state.name, "model": state.model, "packets": state.packets, "packets_expected": state.packets_expected,
        "refused": state.refused, "returns": state.returns,
        "rpm": state.rpm, "completeness": state.completeness, "partial": state.partial,
        "blocked_deg": state.blocked_sectors.iter().map(|b| [b.from_deg, b.to_deg]).collect::<Vec<_>>(),
        "blocked_lasers": state.blocked_lasers,
        "clock": state.clock, "clock_offset_ms": state.clock_offset_ms,
        "state": state.state, "age_ms": state.age_ms,
    })
}

/// The counters of a vehicle or of one sensor as a JSON object: the fields of [`v1::Ledger`] under their own names.
pub fn ledger_json(ledger: &v1::Ledger) -> Value {
    json!({
        "received": ledger.received, "decoded": ledger.decoded, "telemetry": ledger.telemetry,
        "refused": ledger.refused, "lost": ledger.lost, "kernel_drops": ledger.kernel_drops,
        "points_dropped": ledger.points_dropped, "own_body": ledger.own_body, "through_body": ledger.through_body,
        "blind": ledger.blind,
        "poses": ledger.poses, "poses_refused": ledger.poses_refused,
        "roads": ledger.roads, "roads_refused": ledger.roads_refused,
    })
}
