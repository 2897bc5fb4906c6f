//! The results of all files for programs: one JSON object, or JUnit XML.

use std::fmt::Write as _;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use anyhow::{Context as _, Result, bail};
use serde_json::{Value, json};

use super::checked::{CheckOutcome, Checked};
use crate::terminal::{Exit, counted};
use clearway_journal::RecordedMaps;
use clearway_journal::compare::{Comparison, LayerChange, MapChange};

/// The beginning of every report.
const XML: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites name=\"clearway verify\"";

/// The result of one file in one line: `equal`, the first difference, or why it cannot be read.
pub fn reason(outcome: &CheckOutcome) -> String {
    match outcome {
        CheckOutcome::Verified(report) => {
            let is_whole = report.incomplete.is_none() && report.repaired.is_empty() && report.dropped == 0;
            let events = if is_whole { "the events are whole" } else { "the events that are left are in order" };
            let result = match report.differences.first() {
                Some(first) => {
                    let count = counted(report.different, "difference");
                    format!("{count}: {first}; {}", versions(&report.made_by, env!("CARGO_PKG_VERSION")))
                }
                None if report.events == 0 => "no event, so nothing is verified".to_owned(),
                None if report.recorded == RecordedMaps::None => format!("{events}; no map is recorded"),
                None if report.equal == 0 && report.unjudged > 0 => "no map can be judged".to_owned(),
                None if report.maps + report.equal == 0 => format!("{events}; no map follows from them"),
                None => "equal".to_owned(),
            };
            let unjudged = match report.unjudged {
                0 => String::new(),
                layers => format!("; {} after missing events cannot be judged", counted(layers, "layer")),
            };
            let dropped = match report.dropped {
                0 => String::new(),
                messages => {
                    let lost = counted(messages, "message");
                    format!("; the recorder has dropped {lost}, the first of {}", report.dropped_because)
                }
            };
            let repaired = match &report.repaired[..] {
                [] => String::new(),
                [first, ..] => {
                    let places = counted(report.repaired.len() as u64, "place");
                    format!("; repaired: what was lost in {places} is no difference, the first: {first}")
                }
            };
            let incomplete = report.incomplete.iter().map(|how| format!("; the file is not whole: {how}"));
            result + &unjudged + &dropped + &repaired + &incomplete.collect::<String>()
        }
        CheckOutcome::Compared(comparison) => {
            let result = match comparison {
                Comparison { before: 0, after: 0, .. } => "no map on either side, so nothing is compared".to_owned(),
                equal if equal.is_equal() && equal.unpaired() > 0 => {
                    format!("equal; {} of one side only", counted(equal.unpaired(), "map"))
                }
                equal if equal.is_equal() => "equal".to_owned(),
                changed => first_change(changed),
            };
            let after_loss =
                if comparison.is_ended_by_loss { "; maps after missing events cannot be compared" } else { "" };
            let incomplete = comparison.incomplete.iter().map(|how| format!("; {how}"));
            result + after_loss + &incomplete.collect::<String>()
        }
        CheckOutcome::Unreadable(reason) => format!("not checked: {reason}"),
    }
}

/// Which version recorded the maps that differ, and which one has made them again.
fn versions(made_by: &str, this: &str) -> String {
    match made_by {
        "" => format!("the file does not state which version recorded it, and this is clearway {this}"),
        same if same == this => format!("clearway {this} recorded the file, as this is"),
        other => format!(
            "clearway {other} recorded the file, and this is clearway {this}, whose maps may differ: CHANGELOG.md \
             names the changes, and `clearway replay FILE --record NEW` records the maps of this version"
        ),
    }
}

/// The first change of a comparison, of the earliest map.
fn first_change(comparison: &Comparison) -> String {
    let cells = comparison.layers.iter().filter_map(|(key, change)| Some((key, change.first.as_ref()?)));
    match cells.min_by_key(|(_, cell)| cell.sequence) {
        Some(((vehicle, layer), cell)) => format!(
            "first change: vehicle {vehicle}, sequence {}, layer {layer}, cell row {} column {}: {} before, {} after",
            cell.sequence, cell.row, cell.column, cell.before, cell.after
        ),
        None => "no class changed; other values, or maps of one side only".into(),
    }
}

/// All results as one JSON object.
pub fn json(results: &[Checked]) -> Value {
    let file = |result: &Checked| {
        let mut object = json!({ "file": result.file, "seconds": result.seconds, "ok": result.is_good() });
        let details = match &result.outcome {
            CheckOutcome::Verified(report) => report.to_json(),
            CheckOutcome::Compared(comparison) => comparison_json(comparison),
            CheckOutcome::Unreadable(reason) => json!({ "not_checked": reason }),
        };
        if let (Value::Object(object), Value::Object(details)) = (&mut object, details) {
            object.extend(details);
        }
        object
    };
    json!({ "ok": results.iter().all(Checked::is_good), "files": results.iter().map(file).collect::<Vec<_>>() })
}

fn comparison_json(comparison: &Comparison) -> Value {
    let layer = |((vehicle, layer), change): (&(String, String), &LayerChange)| {
        let classes = change
            .classes
            .iter()
            .map(|((before, after), cells)| json!({ "before": before, "after": after, "cells": cells }));
        json!({
            "vehicle": vehicle, "layer": layer, "maps": change.maps,
            "only_before": change.only_before, "only_after": change.only_after,
            "cells": change.cells, "changed": change.changed, "other_values": change.values,
            "free_gained_m2": change.gained_m2, "free_lost_m2": change.lost_m2,
            "classes": classes.collect::<Vec<_>>(),
            "first": change.first.as_ref().map(|cell| json!({
                "sequence": cell.sequence, "row": cell.row, "column": cell.column,
                "before": cell.before, "after": cell.after,
            })),
        })
    };
    let worst = |map: &MapChange| {
        json!({
            "vehicle": map.vehicle, "layer": map.layer, "sequence": map.sequence, "stamp_ns": map.stamp_ns,
            "changed": map.changed, "cells": map.cells,
            "free_gained_m2": map.gained_m2, "free_lost_m2": map.lost_m2,
        })
    };
    json!({
        "maps_before": comparison.before, "maps_after": comparison.after, "incomplete": comparison.incomplete,
        "layers": comparison.layers.iter().map(layer).collect::<Vec<_>>(),
        "worst": comparison.worst.iter().map(worst).collect::<Vec<_>>(),
    })
}

/// Refuses to replace a file that is no report.
///
/// # Errors
/// If it exists and is neither empty nor an earlier report.
pub fn check_junit(file: &Path) -> Result<()> {
    if !file.is_file() {
        return Ok(());
    }
    let mut start = Vec::new();
    File::open(file)
        .and_then(|open| open.take(XML.len() as u64).read_to_end(&mut start))
        .with_context(|| file.display().to_string())?;
    if !start.is_empty() && start != XML.as_bytes() {
        let file = file.display();
        bail!("--junit {file}: the file exists and is not an earlier report, so it is not replaced; name another file");
    }
    Ok(())
}

/// All results as JUnit XML: one test case for each file; a difference is a failure, a file that is not whole
/// or cannot be read an error.
pub fn junit(results: &[Checked]) -> String {
    let count = |is: fn(&Checked) -> bool| results.iter().filter(|result| is(result)).count();
    let errors = count(|result| result.exit() == Exit::Unreadable);
    let failures = count(|result| result.exit() == Exit::Differs);
    // `sum` of nothing is -0.
    let seconds = results.iter().fold(0.0, |seconds, result| seconds + result.seconds);
    let sums = format!("tests=\"{}\" failures=\"{failures}\" errors=\"{errors}\" time=\"{seconds:.3}\"", results.len());
    let mut xml = XML.to_owned();
    // Writing to a string cannot fail.
    let _ = writeln!(xml, " {sums}>\n  <testsuite name=\"clearway verify\" {sums}>");
    for result in results {
        let name = escaped(&result.file.display().to_string());
        let _ =
            write!(xml, "    <testcase classname=\"clearway.verify\" name=\"{name}\" time=\"{:.3}\"", result.seconds);
        let message = escaped(&reason(&result.outcome));
        let _ = match &result.outcome {
            _ if result.is_good() => writeln!(xml, "/>"),
            _ if result.exit() == Exit::Unreadable => writeln!(xml, "><error message=\"{message}\"/></testcase>"),
            CheckOutcome::Compared(_) | CheckOutcome::Unreadable(_) => {
                writeln!(xml, "><failure message=\"{message}\"/></testcase>")
            }
            CheckOutcome::Verified(report) => {
                let all: Vec<_> = report.differences.iter().map(|one| escaped(&one.to_string())).collect();
                writeln!(xml, "><failure message=\"{message}\">{}</failure></testcase>", all.join("\n"))
            }
        };
    }
    xml + "  </testsuite>\n</testsuites>\n"
}

/// A text in an XML attribute or element. Control characters, which XML does not allow, become `?`.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\n' | '\t' => escaped.push(' '),
            '\u{fffe}' | '\u{ffff}' => escaped.push('?'),
            letter if letter.is_control() => escaped.push('?'),
            letter => escaped.push(letter),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;
    use clearway_journal::verify::{Difference, DifferenceKind, Report};

    #[test]
    fn junit_is_xml_with_a_case_for_each_file_whatever_its_name() {
        let checked = |file: &str, outcome| Checked { file: file.into(), seconds: 0.25, outcome };
        let kind = DifferenceKind::Cell { row: 3, column: 17, channel: "class".into(), recorded: 1, computed: 3 };
        let difference = Difference { vehicle: "car".into(), sequence: 2, layer: "terrain".into(), kind };
        let report = Report { differences: vec![difference], different: 1, ..Report::default() };
        let results = [
            checked("a&b <\"c\">.mcap", CheckOutcome::Verified(Report { events: 9, ..Report::default() })),
            checked("d.mcap", CheckOutcome::Verified(report)),
            checked("e.mcap", CheckOutcome::Unreadable("line 1\nbyte \u{1}".into())),
        ];
        let xml = junit(&results);
        let document = roxmltree::Document::parse(&xml).expect("XML");
        let suite = document.root_element().first_element_child().expect("a suite");
        let of = |name| suite.attribute(name);
        assert_eq!((of("tests"), of("failures"), of("errors")), (Some("3"), Some("1"), Some("1")));
        let cases: Vec<_> = suite.children().filter(|node| node.has_tag_name("testcase")).collect();
        assert_eq!(cases[0].attribute("name"), Some("a&b <\"c\">.mcap"));
        let failure = cases[1].first_element_child().expect("a failure");
        assert!(failure.has_tag_name("failure"));
        assert!(failure.text().is_some_and(|text| text.contains("row 3 column 17, channel class: recorded 1")));
        let error = cases[2].first_element_child().and_then(|error| error.attribute("message"));
        assert_eq!(error, Some("not checked: line 1 byte ?"));
    }
}
