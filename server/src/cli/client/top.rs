//! `clearway top`: a server -> a live table of its vehicles, the worst first.

use anyhow::Result;
use clap::Args;
use clearway_client::v1;
use console::{Style, truncate_str};
use futures::StreamExt;

use crate::cli::client::connection::{ServerOptions, explain};
use crate::cli::client::screen::Screen;
use crate::cli::shared::output::{self, block_on, counted, stop_signal};

/// Show the vehicles of a server live: state, age, rate, loss, latency, readers, and what is wrong.
///
/// The table is renewed once a second and whenever a state changes, the worst vehicle first; Ctrl-C ends it. If stdout
/// is not a terminal, each table follows the one before.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway top
  clearway top car truck --server fleet.local:50051
  clearway top --count 1")]
pub struct Options {
    #[command(flatten)]
    server: ServerOptions,
    /// The vehicles; all if absent.
    #[arg(value_name = "VEHICLE")]
    vehicles: Vec<String>,
    /// End after this many tables; at Ctrl-C if absent.
    #[arg(long, value_name = "TABLES")]
    count: Option<u64>,
}

/// Shows tables until Ctrl-C, the count is reached, or the reader of stdout has closed it.
///
/// # Errors
/// [`ClientError`](clearway_client::ClientError) if the server refuses, does not answer or ends the stream.
pub fn run(options: &Options) -> Result<()> {
    let screen = Screen::new();
    screen.set_cursor(false)?;
    let ended = block_on(show(options, &screen));
    screen.set_cursor(true)?;
    ended
}

async fn show(options: &Options, screen: &Screen) -> Result<()> {
    let stop = stop_signal()?;
    let mut updates = options.server.connect().await?.watch_status(&options.vehicles).await.map_err(explain)?;
    let mut shown = 0;
    tokio::pin!(stop);
    while options.count.is_none_or(|count| shown < count) {
        let update = tokio::select! {
            () = &mut stop => break,
            update = updates.next() => update,
        };
        let Some(update) = update else { break };
        let vehicles = update.map_err(explain)?;
        if !screen.show(&table(vehicles, screen.size().1, screen.is_live()))? {
            break;
        }
        shown += 1;
    }
    Ok(())
}

/// The lines of the table, none longer than `columns`: a line for each vehicle and one for each reason, the worst
/// vehicles first. Text of the server is shown without control characters.
fn table(mut vehicles: Vec<v1::Vehicle>, columns: usize, is_coloured: bool) -> Vec<String> {
    let severity = |state: &str| ["error", "warn", "ok"].iter().position(|known| *known == state).unwrap_or(1);
    vehicles.sort_by(|a, b| (severity(&a.state), &a.name).cmp(&(severity(&b.state), &b.name)));
    let count = |state: &str| vehicles.iter().filter(|vehicle| vehicle.state == state).count();
    let cut = |line: String| truncate_str(&line, columns, "…").into_owned();
    let mut lines = vec![
        cut(format!(
            "{}: {} error, {} warn, {} ok",
            counted(vehicles.len() as u64, "vehicle"),
            count("error"),
            count("warn"),
            count("ok")
        )),
        cut(format!(
            "{:<16} {:<5} {:>8} {:>6} {:>6} {:>7} {:>8} {:>6} {:>7} {:>6} {:>7}",
            "VEHICLE", "STATE", "AGE", "MAPS/s", "LOSS", "LATENCY", "KB/MAP", "DRIVE", "READERS", "SKIPS", "SPEED"
        )),
    ];
    for vehicle in &vehicles {
        let style = match (is_coloured, severity(&vehicle.state)) {
            (false, _) => Style::new(),
            (true, 0) => Style::new().force_styling(true).red().bold(),
            (true, 1) => Style::new().force_styling(true).yellow(),
            (true, _) => Style::new().force_styling(true).green(),
        };
        lines.push(style.apply_to(cut(row(vehicle))).to_string());
        lines.extend(vehicle.reasons.iter().map(|reason| cut(format!("    {}", printable(reason)))));
    }
    lines
}

/// The line of one vehicle; a dash stands for what is not known.
fn row(vehicle: &v1::Vehicle) -> String {
    let or_dash = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
    let age = or_dash(vehicle.map_age_ms.map(age));
    let latency = or_dash(vehicle.latency_ms.get("total").map(|ms| format!("{ms:.0} ms")));
    let share = or_dash(vehicle.drivable_share.map(|share| format!("{:.0} %", 100.0 * share)));
    let speed = or_dash(vehicle.speed_m_s.map(|speed| format!("{speed:.1}")));
    let (readers, skips): (u32, u64) = (vehicle.readers.values().sum(), vehicle.skips.values().sum());
    format!(
        "{:<16} {:<5} {age:>8} {:>6.1} {:>6} {latency:>7} {:>8.1} {share:>6} {readers:>7} {skips:>6} {speed:>7}",
        truncate_str(&printable(&vehicle.name), 16, "…"),
        printable(&vehicle.state).to_uppercase(),
        vehicle.map_rate_hz,
        format!("{:.1} %", 100.0 * vehicle.loss),
        vehicle.map_bytes / 1e3,
    )
}

/// An age for people: milliseconds below ten seconds, then seconds, then hours.
fn age(ms: f64) -> String {
    match ms {
        ms if ms < 10_000.0 => format!("{ms:.0} ms"),
        ms if ms < 36e6 => format!("{:.0} s", ms / 1e3),
        ms => format!("{:.0} h", ms / 36e5),
    }
}

/// The text on one line.
fn printable(text: &str) -> String {
    output::printable(text).replace(['\n', '\t'], "\u{fffd}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vehicle(name: &str, state: &str) -> v1::Vehicle {
        v1::Vehicle { name: name.into(), state: state.into(), ..Default::default() }
    }

    #[test]
    fn the_worst_vehicle_stands_first_with_its_reasons() {
        let truck = v1::Vehicle { reasons: vec!["no packets from top for 76 s".into()], ..vehicle("truck", "error") };
        let car = v1::Vehicle {
            map_age_ms: Some(93.4),
            map_rate_hz: 10.0,
            loss: 0.012,
            latency_ms: [("total".to_owned(), 41.6)].into(),
            map_bytes: 12_340.0,
            drivable_share: Some(0.625),
            readers: [("grpc".to_owned(), 2), ("page".to_owned(), 1)].into(),
            skips: [("page".to_owned(), 4)].into(),
            speed_m_s: Some(8.0),
            ..vehicle("car", "ok")
        };
        let lines = table(vec![car, vehicle("bus", "warn"), truck], 120, false);
        assert_eq!(lines[0], "3 vehicles: 1 error, 1 warn, 1 ok");
        let names: Vec<_> = lines[2..].iter().map(|line| line.split_whitespace().next().unwrap()).collect();
        assert_eq!(names, ["truck", "no", "bus", "car"]);
        assert_eq!(lines[3], "    no packets from top for 76 s");
        let words: Vec<_> = lines[5].split_whitespace().collect();
        let expected = "car OK 93 ms 10.0 1.2 % 42 ms 12.3 62 % 3 4 8.0";
        assert_eq!(words.join(" "), expected);
        // Each value stands under its name.
        assert_eq!(lines[1].chars().count(), lines[5].chars().count());
    }

    #[test]
    fn no_line_is_longer_than_the_terminal_and_no_text_of_a_server_moves_the_cursor() {
        let evil = v1::Vehicle { reasons: vec!["\x1b[2J\r\n<b>x</b>".repeat(30)], ..vehicle("a\x1b[31m\n", "error") };
        for is_coloured in [false, true] {
            for line in table(vec![evil.clone()], 40, is_coloured) {
                assert!(console::measure_text_width(&line) <= 40, "{line:?}");
                assert!(!line.contains("[2J\r") && !line.contains('\n') && !line.contains("\x1b[2J"), "{line:?}");
            }
        }
    }

    #[test]
    fn an_age_has_the_unit_that_a_person_reads() {
        assert_eq!([age(93.4), age(76_090.0), age(9e9)], ["93 ms", "76 s", "2500 h"]);
    }
}
