//! Faults between machines, in the short form of the program `machines`: six vehicles, four faults. Validity and faults
//! are longer than there, so that a machine with other work to do delays no map into staleness.

/// A row of the table: the fault and the numbers of streams.
#[derive(Debug)]
struct Row {
    fault: String,
    /// Streams that the fault concerns: those that went STALE, all.
    concerned: [usize; 2],
    /// The others.
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
    let faults = [("cut", "no-newer"), ("server-behind", "old-on-arrival"), ("server-ahead", "in-the-future")];
    let faults = [&faults[..], &[("planner-ahead", "old-on-arrival")]].concat();
    let names: Vec<_> = faults.iter().map(|(name, _)| *name).collect();
    let names = names.join(",");
    let arguments = ["--vehicles", "6", "--seconds", "4", "--valid-ms", "1500", "--faults", &names];
    let output = clearway_tests::run(&clearway_tests::workspace(), "machines", &arguments);
    let shown = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{shown}");
    let rows: Vec<_> = shown.lines().filter_map(row).collect();
    assert_eq!(rows.len(), faults.len(), "{shown}");
    for (row, (name, why)) in rows.iter().zip(&faults) {
        assert!(row.concerned[0] == row.concerned[1] && row.concerned[1] > 0, "{name}: {row:?}");
        assert_eq!(row.others[0], 0, "{}: streams that it does not concern went STALE: {shown}", row.fault);
        assert!(row.is_whole, "{name}: {shown}");
        assert!(row.said.contains(&format!("{why} {}", row.concerned[1])), "{name}: {row:?}");
    }
}
