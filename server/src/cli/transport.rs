//! `clearway transport`: controls the replay that a server serves.

use anyhow::{Result, bail};
use clap::{ArgAction, Args, Subcommand};
use clearway_client::ClientError;
use clearway_client::v1::{ReplayControl, ReplayPhase, ReplayState};
use serde_json::json;

use crate::arguments::values::offset;
use crate::connect::{ServerOptions, explain};
use crate::terminal::{Exit, print_line, usage_error};
use clearway_daemon::replay_control::STEP_MAX;
use clearway_replay::ReplaySpeed;

/// Control the replay of a server: pause, play, step, seek, range, rate, loop, lockstep.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway transport
  clearway transport pause
  clearway transport seek 12.5
  clearway transport step 3
  clearway transport range 2 5
  clearway transport range --all
  clearway transport rate max")]
pub struct TransportArguments {
    #[command(subcommand)]
    request: Option<TransportRequest>,
    #[command(flatten)]
    server: ServerOptions,
    /// Print the state as one JSON object.
    #[arg(long, global = true)]
    json: bool,
}

/// What to change. Times are seconds after the first event.
#[derive(Clone, Copy, Subcommand)]
enum TransportRequest {
    /// Go on.
    Play,
    /// Stop until `play`.
    Pause,
    /// Make this many maps, and pause; the answer comes when they are made. A seek meanwhile ends the step.
    Step {
        /// Number of maps.
        #[arg(default_value = "1", value_parser = clap::value_parser!(u32).range(1..=i64::from(STEP_MAX)))]
        maps: u32,
    },
    /// Jump to this time. A paused replay stays paused there; a replay that has ended plays on.
    Seek {
        /// Seconds after the first event, from 0 on.
        #[arg(allow_negative_numbers = true, value_parser = offset)]
        seconds: f64,
    },
    /// Play only this part; --all plays the whole drive again.
    Range {
        /// Begin, in seconds after the first event.
        #[arg(required_unless_present = "all", allow_negative_numbers = true, value_parser = offset)]
        from: Option<f64>,
        /// End, in seconds after the first event.
        #[arg(required_unless_present = "all", allow_negative_numbers = true, value_parser = offset)]
        to: Option<f64>,
        /// The whole drive.
        #[arg(long, conflicts_with_all = ["from", "to"])]
        all: bool,
    },
    /// Set the speed: 0.1 to 1000 times the recorded one, or max; `speed` does the same.
    #[command(alias = "speed")]
    Rate {
        /// A factor, or max.
        rate: ReplaySpeed,
    },
    /// Begin again at the end, or do not.
    Loop {
        /// on or off.
        #[arg(value_parser = on_or_off, action = ArgAction::Set)]
        on: bool,
    },
    /// Wait for the acknowledgement of each map, or do not; if none comes in the time of --lockstep, the server
    /// ends.
    Lockstep {
        /// on or off.
        #[arg(value_parser = on_or_off, action = ArgAction::Set)]
        on: bool,
    },
}

fn on_or_off(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("on or off is allowed".into()),
    }
}

/// Changes how the replay goes on, and prints its state after the change.
pub async fn run(options: &TransportArguments) -> Result<Exit> {
    if let Some(TransportRequest::Range { from: Some(from), to: Some(to), .. }) = options.request
        && from >= to
    {
        return Err(usage_error(format!("range {from} {to}: the range must end after it begins")));
    }
    let client = options.server.connect().await?;
    let replay = match client.replay_control(ReplayControl::default()).await {
        Err(ClientError::Refused { address, code, .. }) if code == "Unimplemented" => {
            bail!("{address} replays nothing; start it with `clearway replay FILE --serve`")
        }
        replay => replay.map_err(explain)?,
    };
    let replay = match options.request {
        None => replay,
        Some(request) => client.replay_control(request.to_control(&replay)).await.map_err(explain)?,
    };
    print_line(&if options.json { document(&replay) } else { line(&replay) })?;
    Ok(Exit::Good)
}

impl TransportRequest {
    fn to_control(self, state: &ReplayState) -> ReplayControl {
        // Saturates: what lies outside the drive is refused by the server.
        let at = |seconds: f64| Some(state.begin_ns.saturating_add((seconds * 1e9) as i64));
        let nothing = ReplayControl::default();
        match self {
            Self::Play => ReplayControl { paused: Some(false), ..nothing },
            Self::Pause => ReplayControl { paused: Some(true), ..nothing },
            Self::Step { maps } => ReplayControl { step: Some(maps), ..nothing },
            Self::Seek { seconds } => ReplayControl { seek_ns: at(seconds), ..nothing },
            Self::Range { from: Some(from), to: Some(to), .. } => {
                ReplayControl { from_ns: at(from), to_ns: at(to), ..nothing }
            }
            Self::Range { .. } => ReplayControl { from_ns: Some(state.begin_ns), to_ns: Some(state.end_ns), ..nothing },
            Self::Rate { rate } => ReplayControl { rate: Some(rate.rate()), ..nothing },
            Self::Loop { on } => ReplayControl { repeat: Some(on), ..nothing },
            Self::Lockstep { on } => ReplayControl { lockstep: Some(on), ..nothing },
        }
    }
}

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
fn line(state: &ReplayState) -> String {
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
fn document(state: &ReplayState) -> String {
    let at = |ns| seconds(state, ns);
    json!({
        "phase": phase(state), "position_s": at(state.position_ns), "from_s": at(state.from_ns),
        "to_s": at(state.to_ns), "end_s": at(state.end_ns), "begin_ns": state.begin_ns,
        "rate": if state.rate.is_finite() { json!(state.rate) } else { "max".into() },
        "loop": state.repeat, "lockstep": state.lockstep, "as_live": state.as_live, "jumps": state.jumps,
        "readers_awaited": state.readers_awaited, "awaited": state.awaited,
        "vehicles": state.vehicles, "maps": state.maps,
    })
    .to_string()
}
