//! `clearway status`: a server -> the state of each vehicle with its reasons, and an exit code.

use anyhow::{Result, bail};
use clap::Args;
use clearway_client::v1;

use crate::connect::{ServerOptions, explain};
use crate::terminal::{Exit, age_text, one_line, print_line};
use clearway_daemon::status::{State, vehicle_json};

/// Print the state of each vehicle: ok, or what is wrong with it.
///
/// The exit code is 0 if every vehicle is ok, 5 if the worst of them warns, 4 if one is an error (no fresh map is
/// made), and 2 if the server does not answer.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway status
  clearway status car --json
  clearway status --server vehicle.local:50051 || echo \"look at the vehicle\"")]
pub struct StatusArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// The vehicles; all if absent.
    #[arg(value_name = "VEHICLE")]
    vehicles: Vec<String>,
    /// Print one JSON array.
    #[arg(long)]
    json: bool,
}

/// Prints the states.
pub async fn run(options: &StatusArguments) -> Result<Exit> {
    let all = options.server.connect().await?.vehicles().await.map_err(explain)?;
    if let Some(unknown) = options.vehicles.iter().find(|name| !all.iter().any(|vehicle| vehicle.name == **name)) {
        let known = all.iter().map(|vehicle| vehicle.name.as_str()).collect::<Vec<_>>().join(", ");
        bail!("no vehicle {unknown:?}; there is {known}");
    }
    let is_selected = |vehicle: &&v1::Vehicle| options.vehicles.is_empty() || options.vehicles.contains(&vehicle.name);
    let selected: Vec<_> = all.iter().filter(is_selected).collect();
    if options.json {
        let documents: Vec<_> = selected.iter().map(|vehicle| vehicle_json(vehicle)).collect();
        print_line(&serde_json::to_string_pretty(&documents)?)?;
    } else {
        for line in selected.iter().flat_map(|vehicle| lines(vehicle)) {
            print_line(&one_line(&line))?;
        }
    }
    Ok(exit(selected.iter().map(|vehicle| vehicle.state.as_str())))
}

/// The exit code of the worst state. A state of a newer server that is not known here warns.
fn exit<'a>(states: impl Iterator<Item = &'a str>) -> Exit {
    let severity = |state: &str| match state {
        state if state == State::Ok.as_str() => (0, Exit::Good),
        state if state == State::Error.as_str() => (2, Exit::Stale),
        _ => (1, Exit::Warn),
    };
    states.map(severity).max_by_key(|(severity, _)| *severity).map_or(Exit::Good, |(_, exit)| exit)
}

/// A line for the vehicle, and one for each reason.
fn lines(vehicle: &v1::Vehicle) -> Vec<String> {
    let age = vehicle.map_age_ms.map_or("no map".to_owned(), |age| format!("newest map {}", age_text(age)));
    let total = vehicle.latency_ms.get("total").map_or(String::new(), |ms| format!(", latency {ms:.0} ms"));
    let share = vehicle.drivable_share.map_or(String::new(), |share| format!(", {:.0} % drivable", 100.0 * share));
    let pose = vehicle.pose.as_ref().map_or(String::new(), |pose| {
        format!(", at {:.1} m, {:.1} m, heading {:.0} deg", pose.x_m, pose.y_m, pose.heading_deg)
    });
    let speed = vehicle.speed_m_s.map_or(String::new(), |speed| format!(", {speed:.1} m/s"));
    let loss = vehicle.loss.map_or(String::new(), |loss| format!(", loss {:.1} %", 100.0 * loss));
    let readers: u32 = vehicle.readers.values().sum();
    let mut lines = vec![format!(
        "{}: {}: {age}, {:.1} maps/s{total}{loss}{share}, readers {readers}{pose}{speed}",
        vehicle.name,
        vehicle.state.to_uppercase(),
        vehicle.map_rate_hz,
    )];
    lines.extend(vehicle.reasons.iter().map(|reason| format!("  {reason}")));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_state_decides_the_exit_code() {
        let exit = |states: &[&'static str]| exit(states.iter().copied());
        assert_eq!([exit(&[]), exit(&["ok"]), exit(&["warn", "ok"])], [Exit::Good, Exit::Good, Exit::Warn]);
        assert_eq!([exit(&["ok", "error", "warn"]), exit(&["limp"])], [Exit::Stale, Exit::Warn]);
    }

    #[test]
    fn what_is_not_known_is_not_printed() {
        let vehicle = v1::Vehicle { name: "car".into(), state: "error".into(), ..Default::default() };
        assert_eq!(lines(&vehicle), ["car: ERROR: no map, 0.0 maps/s, readers 0"]);
        let reasons = vec!["no packets from top for 76 s".into()];
        let vehicle =
            v1::Vehicle { map_age_ms: Some(76_090.0), speed_m_s: Some(8.0), loss: Some(0.0), reasons, ..vehicle };
        let printed = lines(&vehicle).join("\n");
        let expected = "car: ERROR: newest map 76090 ms old, 0.0 maps/s, loss 0.0 %, readers 0, 8.0 m/s\n  no packets \
                        from top for 76 s";
        assert_eq!(printed, expected);
    }
}
