//! Faults between machines and a thin uplink, in the short form of the program `machines`: six vehicles, five faults; a
//! vehicle whose uplink has 1 Mbit/s and 200 kbit/s. Validity and faults are longer than there, so that a machine with
//! other work to do delays no map into staleness.

use clearway_tests::serial::NAMESPACES;

use crate::fixture::venv;

/// What `machines` prints.
fn machines(arguments: &[&str]) -> String {
    let _namespaces = NAMESPACES.enter();
    let output = clearway_tests::run(&clearway_tests::workspace(), "machines", arguments);
    let shown = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{shown}");
    shown
}

/// A row of the table: the fault and the numbers of streams.
#[derive(Debug)]
struct Row {
    fault: String,
    /// Streams that the fault concerns: number that went STALE, number of all.
    concerned: [usize; 2],
    /// Streams that the fault does not concern: number that went STALE, number of all.
    others: [usize; 2],
    is_whole: bool,
    /// Why the concerned streams said they were stale, each with their number.
    said: String,
}

fn row(line: &str) -> Option<Row> {
    let cells: Vec<_> = line.trim_matches('|').split('|').map(str::trim).collect();
    let numbers = |cell: &str| {
        let (stale, all) = cell.split_once(" of ")?;
        Some([stale.parse().ok()?, all.parse().ok()?])
    };
    let [fault, concerned, others, _longest, whole, _runs, said] = cells[..] else { return None };
    Some(Row {
        fault: fault.into(),
        concerned: numbers(concerned)?,
        others: numbers(others)?,
        is_whole: !whole.starts_with("not in"),
        said: said.into(),
    })
}

#[test]
#[cfg_attr(not(clearway_namespaces), ignore = "needs root and /dev/net/tun: apt-get install iproute2 python3 faketime")]
fn only_streams_that_a_fault_concerns_go_stale_they_say_why_and_all_are_whole_afterwards() {
    // In the order of the program's table. The link between the routers concerns no stream: planners read through the
    // other router.
    let faults = [
        ("cut", "no-newer"),
        ("cut-routers", ""),
        ("server-behind", "old-on-arrival"),
        ("server-ahead", "in-the-future"),
        ("planner-ahead", "old-on-arrival"),
    ];
    let names: Vec<_> = faults.iter().map(|(name, _)| *name).collect();
    let names = names.join(",");
    let arguments = ["--vehicles", "6", "--seconds", "4", "--valid-ms", "1500", "--faults", &names];
    let shown = machines(&arguments);
    let rows: Vec<_> = shown.lines().filter_map(row).collect();
    assert_eq!(rows.len(), faults.len(), "{shown}");
    for (row, (name, why)) in rows.iter().zip(&faults) {
        let is_of_none = why.is_empty();
        assert!(row.concerned[0] == row.concerned[1] && (row.concerned[1] == 0) == is_of_none, "{name}: {row:?}");
        assert_eq!(row.others[0], 0, "{}: streams that it does not concern went STALE: {shown}", row.fault);
        assert!(row.is_whole, "{name}: {shown}");
        let is_said = row.said.contains(&format!("{why} {}", row.concerned[1]));
        assert!(is_of_none || is_said, "{name}: {row:?}");
    }
}

/// A row of the table of the uplink: its rate, what happens, and the stream of a reader.
struct Stream<'a> {
    kbit_s: &'a str,
    what: &'a str,
    of: &'a str,
    maps_hz: f64,
    deltas: f64,
    /// What the uplink carried.
    carried: f64,
    /// Why maps were stale.
    said: &'a str,
}

fn stream(line: &str) -> Option<Stream<'_>> {
    let cells: Vec<_> = line.strip_prefix('|')?.strip_suffix('|')?.split('|').map(str::trim).collect();
    let [kbit_s, what, of, _fresh_after, maps_hz, _kb, deltas, _ages, _fresh, carried, said] = cells[..] else {
        return None;
    };
    let number = |cell: &str| cell.parse().unwrap_or(0.0);
    let (maps_hz, deltas, carried) = (number(maps_hz), number(deltas), carried.parse().ok()?);
    Some(Stream { kbit_s, what, of, maps_hz, deltas, carried, said })
}

#[test]
#[cfg_attr(
    not(all(clearway_namespaces, clearway_python)),
    ignore = "needs root and /dev/net/tun: apt-get install iproute2 python3 python3-venv faketime"
)]
fn a_thin_uplink_carries_the_layers_with_readers_as_often_as_it_bears_and_no_part_of_a_recording_is_lost() {
    let python = venv::s3();
    let arguments = ["--uplink", "--seconds", "2", "--valid-ms", "1000", "--python", python.to_str().unwrap()];
    let shown = machines(&arguments);
    let streams: Vec<_> = shown.lines().filter_map(stream).collect();
    let find = |kbit_s: &str, what: &str, of: &str| {
        let found = streams.iter().find(|stream| (stream.kbit_s, stream.what, stream.of) == (kbit_s, what, of));
        found.unwrap_or_else(|| panic!("no row {kbit_s} {what} {of}: {shown}"))
    };
    let (idle, one) = (find("1000", "no reader", ""), find("1000", "one reader", "p1, v00"));
    let (two, thin) = (find("1000", "one at each router", "p2, v00"), find("200", "one at each router", "p2, v00"));
    assert!(10.0 * idle.carried < one.carried, "no reader, and maps travel: {shown}");
    assert!(two.carried < 1.5 * one.carried, "two readers of a layer cost the uplink once: {shown}");
    assert!(thin.maps_hz > 0.0 && 1.5 * thin.maps_hz < two.maps_hz, "fewer maps fit a thinner link: {shown}");
    assert!(find("200", "gRPC, deltas", "deltas, v00").deltas > 0.0, "{shown}");
    for Stream { kbit_s, what, of, said, .. } in streams.iter().filter(|stream| stream.what != "with the recording") {
        assert_eq!(*said, "", "{kbit_s} kbit/s, {what}, {of}: a map waited in a queue: {shown}");
    }
    let row = shown.lines().rfind(|line| line.contains("| exit ")).unwrap_or_default();
    let row = row.trim_matches('|').split('|').map(str::trim);
    let [_, waiting, deleted, _, stored, verified] = row.collect::<Vec<_>>()[..] else { panic!("{shown}") };
    assert!(waiting != "0" && deleted == "0", "parts wait for the store and stay: {shown}");
    assert!(stored == format!("{waiting} of {waiting}") && verified == "exit 0", "{shown}");
}
