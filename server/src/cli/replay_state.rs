//! The state of a replay as a line of text and as JSON.

use clearway_proto::v1::{ReplayPhase, ReplayState};
use serde_json::json as document;

fn phase(state: &ReplayState) -> &'static str {
    match state.phase() {
        ReplayPhase::Unspecified => "unknown",
        ReplayPhase::Waiting => "waiting for readers",
        ReplayPhase::Playing => "playing",
        ReplayPhase::Paused => "paused",
        ReplayPhase::Ended => "ended",
    }
}

fn seconds(state: &ReplayState, ns: i64) -> f64 {
    ns.saturating_sub(state.begin_ns) as f64 * 1e-9
}

/// The state as a line of text.
pub fn line(state: &ReplayState) -> String {
    let at = |ns| seconds(state, ns);
    let rate = if state.rate.is_finite() { format!("{}x", state.rate) } else { "max".to_owned() };
    let flags = [(state.as_live, ", as live"), (state.repeat, ", loop"), (state.lockstep, ", lockstep")];
    let flags: String = flags.iter().filter(|(is_set, _)| *is_set).map(|(_, text)| *text).collect();
    let (from, to) = (at(state.from_ns), at(state.to_ns));
    let newest: Vec<String> = state
        .vehicles
        .iter()
        .zip(&state.maps)
        .filter(|(_, maps)| **maps > 0)
        .map(|(vehicle, maps)| format!(", {vehicle} at map {}", maps - 1))
        .collect();
    let awaited = if state.awaited.is_empty() { String::new() } else { format!(", waits for {}", state.awaited) };
    let (newest, position) = (newest.concat(), at(state.position_ns));
    format!("{} at {position:.3} s of {from:.3} to {to:.3} s{newest}, {rate}{flags}{awaited}", phase(state))
}

/// The state as a JSON object; times are seconds after the first event.
pub fn json(state: &ReplayState) -> String {
    let at = |ns| seconds(state, ns);
    document!({
        "phase": phase(state), "position_s": at(state.position_ns), "from_s": at(state.from_ns),
        "to_s": at(state.to_ns), "end_s": at(state.end_ns), "begin_ns": state.begin_ns,
        "rate": if state.rate.is_finite() { document!(state.rate) } else { "max".into() },
        "loop": state.repeat, "lockstep": state.lockstep, "as_live": state.as_live, "jumps": state.jumps,
        "readers_awaited": state.readers_awaited, "awaited": state.awaited,
        "vehicles": state.vehicles, "maps": state.maps,
    })
    .to_string()
}
