//! The state of vehicles -> a table, the worst first.

use clearway_client::v1;
use console::{Alignment, Style, measure_text_width, pad_str, truncate_str};

use super::servers::{is_of_several_servers, server_text};
use crate::terminal::{self, counted};

/// Widest column of servers, in characters.
const SERVER_COLUMNS_MAX: usize = 32;

/// The server's own vehicles and the vehicles of other servers in a list; only the vehicles with these names, or all.
pub fn with_others(own: Vec<v1::Vehicle>, list: Vec<v1::Vehicle>, names: &[String]) -> Vec<v1::Vehicle> {
    let is_own = |of: &v1::Vehicle| own.iter().any(|own| (&own.name, own.boot_id) == (&of.name, of.boot_id));
    let others: Vec<_> = list.into_iter().filter(|of| !is_own(of)).collect();
    let is_named = |of: &v1::Vehicle| names.is_empty() || names.contains(&of.name);
    own.into_iter().chain(others).filter(is_named).collect()
}

/// The lines of the table, none longer than `columns`: a line for each vehicle and one for each reason, the worst
/// vehicles first. Text of the server is shown without control characters.
pub fn table(mut vehicles: Vec<v1::Vehicle>, columns: usize, is_coloured: bool) -> Vec<String> {
    let is_fleet = is_of_several_servers(&vehicles);
    let severity = |state: &str| ["error", "warn", "ok"].iter().position(|known| *known == state).unwrap_or(1);
    vehicles.sort_by_cached_key(|of| (severity(&of.state), of.name.clone(), server_text(of)));
    let servers: Vec<_> = vehicles.iter().map(|of| one_line(&server_text(of))).collect();
    let wide = servers.iter().map(|text| measure_text_width(text)).max().unwrap_or(0).min(SERVER_COLUMNS_MAX);
    let column = |text: &str| match is_fleet {
        true => pad_str(&truncate_str(text, wide, "…"), wide, Alignment::Left, None).into_owned() + " ",
        false => String::new(),
    };
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
            "{:<16} {}{:<5} {:>8} {:>6} {:>6} {:>7} {:>8} {:>6} {:>7} {:>6} {:>7}",
            "VEHICLE",
            column("SERVER"),
            "STATE",
            "AGE",
            "MAPS/s",
            "LOSS",
            "LATENCY",
            "KB/MAP",
            "DRIVE",
            "READERS",
            "SKIPS",
            "SPEED"
        )),
    ];
    for (vehicle, server) in vehicles.iter().zip(&servers) {
        let style = match (is_coloured, severity(&vehicle.state)) {
            (false, _) => Style::new(),
            (true, 0) => Style::new().force_styling(true).red().bold(),
            (true, 1) => Style::new().force_styling(true).yellow(),
            (true, _) => Style::new().force_styling(true).green(),
        };
        lines.push(style.apply_to(cut(row(vehicle, &column(server)))).to_string());
        lines.extend(vehicle.reasons.iter().map(|reason| cut(format!("    {}", one_line(reason)))));
    }
    lines
}

/// The line of one vehicle, with the text of its server's column; a dash stands for what is not known.
fn row(vehicle: &v1::Vehicle, server: &str) -> String {
    let or_dash = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
    let age = or_dash(vehicle.map_age_ms.map(age));
    let latency = or_dash(vehicle.latency_ms.get("total").map(|ms| format!("{ms:.0} ms")));
    let share = or_dash(vehicle.drivable_share.map(|share| format!("{:.0} %", 100.0 * share)));
    let speed = or_dash(vehicle.speed_m_s.map(|speed| format!("{speed:.1}")));
    let (readers, skips): (u32, u64) = (vehicle.readers.values().sum(), vehicle.skips.values().sum());
    format!(
        "{:<16} {server}{:<5} {age:>8} {:>6.1} {:>6} {latency:>7} {:>8.1} {share:>6} {readers:>7} {skips:>6} {speed:>7}",
        truncate_str(&one_line(&vehicle.name), 16, "…"),
        one_line(&vehicle.state).to_uppercase(),
        vehicle.map_rate_hz,
        or_dash(vehicle.loss.map(|loss| format!("{:.1} %", 100.0 * loss))),
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
fn one_line(text: &str) -> String {
    terminal::one_line(text).replace(['\n', '\t'], "\u{fffd}")
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
            loss: Some(0.012),
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
    fn vehicles_of_other_servers_stand_in_the_table_each_with_a_server_of_its_own() {
        let of = |name: &str, boot_id: u64, grpc: &str| v1::Vehicle {
            boot_id,
            server: "b".into(),
            grpc: grpc.into(),
            ..vehicle(name, "ok")
        };
        let own = vec![of("car", 1 << 60, "")];
        let list = vec![of("car", 1 << 60, ""), of("van", 2, "b:1"), of("van", 3, "b:2"), of("bus", 3, "b:2")];
        let all = table(with_others(own.clone(), list.clone(), &[]), 120, false);
        assert_eq!(all[0], "4 vehicles: 0 error, 0 warn, 4 ok");
        let shown: Vec<_> = all[2..].iter().map(|line| line.split(" OK ").next().unwrap().trim_end()).collect();
        let column = |name: &str, server: &str| format!("{name:<16} {server}");
        let rows = [("bus", "b (b:2)"), ("car", "b (run 10000000)"), ("van", "b (b:1)"), ("van", "b (b:2)")];
        assert_eq!(shown, rows.map(|(name, server)| column(name, server)));
        assert!(all[1].contains("SERVER") && all.iter().skip(2).all(|line| line.len() == all[1].len()), "{all:?}");
        let one = with_others(own.clone(), list, &["van".into()]);
        assert_eq!(one.iter().map(|of| &*of.grpc).collect::<Vec<_>>(), ["b:1", "b:2"]);
        assert!(!table(own, 120, false)[1].contains("SERVER"), "one server needs no column");
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
