//! The results of all files as text: a line for each file, and what changed in its maps.

use std::fmt::Write as _;

use super::checked::{Check, CheckOutcome, Checked};
use super::report::reason;
use crate::terminal::{Exit, counted};
use clearway_journal::compare::{Comparison, LayerChange};

/// Greatest number of pairs of classes that are listed for a layer, the most frequent first.
const CLASSES_MAX: usize = 6;

/// The results as text.
pub fn text(results: &[Checked], check: &Check) -> String {
    let mut text = String::new();
    let width = results.iter().map(|result| result.file.display().to_string().len()).max().unwrap_or(0).max(4);
    if !results.is_empty() {
        write_line(&mut text, width, ["file", "events", "maps", "layers", "cells"].map(str::to_owned), "result");
    }
    for result in results {
        let name = result.file.display().to_string();
        let [events, maps, layers, cells] = match &result.outcome {
            CheckOutcome::Verified(report) => {
                [report.events, report.maps, report.equal, report.cells].map(|count| count.to_string())
            }
            CheckOutcome::Compared(comparison) => {
                let sum = |of: fn(&LayerChange) -> u64| comparison.layers.values().map(of).sum::<u64>().to_string();
                [String::new(), String::new(), sum(|layer| layer.maps), sum(|layer| layer.cells)]
            }
            CheckOutcome::Unreadable(_) => Default::default(),
        };
        write_line(&mut text, width, [name, events, maps, layers, cells], &reason(&result.outcome));
        match &result.outcome {
            CheckOutcome::Verified(report) => {
                report.differences.iter().skip(1).for_each(|other| _ = writeln!(text, "  {other}"));
            }
            CheckOutcome::Compared(comparison) => write_changes(&mut text, comparison),
            CheckOutcome::Unreadable(_) => {}
        }
    }
    let good = results.iter().filter(|result| result.is_good()).count();
    let different = results.iter().filter(|result| result.exit() == Exit::Differs).count();
    let cut = results.iter().filter(|result| result.is_equal_but_not_whole()).count();
    let is_compared = |result: &Checked| matches!(&result.outcome, CheckOutcome::Verified(report) if report.equal > 0);
    let is_unjudged =
        |result: &Checked| matches!(&result.outcome, CheckOutcome::Verified(report) if report.unjudged > 0);
    let what = match check {
        Check::Verify if !results.iter().any(is_compared) => "no map was compared",
        Check::Verify if results.iter().any(is_unjudged) => "every map that can be judged is the map of its events",
        Check::Verify => "every map is the map of its events",
        _ => "every map is equal",
    };
    let sum = counted(results.len() as u64, "file");
    let _ = match results.len() - good {
        0 if results.is_empty() => writeln!(text, "0 files in this shard: nothing to check"),
        0 => writeln!(text, "{sum}: {what}"),
        bad => writeln!(
            text,
            "{sum}: {good} equal, {different} different, {cut} equal but not whole, {} not checked",
            bad - different - cut
        ),
    };
    text
}

fn write_line(text: &mut String, width: usize, [name, events, maps, layers, cells]: [String; 5], result: &str) {
    let _ = writeln!(text, "{name:<width$}  {events:>9} {maps:>6} {layers:>7} {cells:>11}  {result}");
}

/// What changed: a line for each layer with its most frequent pairs of classes, then the maps that changed most.
fn write_changes(text: &mut String, comparison: &Comparison) {
    for ((vehicle, layer), change) in &comparison.layers {
        let LayerChange { maps, cells, changed, values, .. } = change;
        if change.is_equal() {
            let _ = writeln!(text, "  {vehicle} {layer}: {}, equal", counted(*maps, "map"));
            continue;
        }
        let per_map = |sum: f64| sum / (*maps as f64).max(1.0);
        let share = 100.0 * *changed as f64 / (*cells as f64).max(1.0);
        let _ = writeln!(
            text,
            "  {vehicle} {layer}: {}, {changed} of {cells} cells changed ({share:.2} %), {values} other values; free \
             space for each map: {:.1} m2 gained, {:.1} m2 lost",
            counted(*maps, "map"),
            per_map(change.gained_m2),
            per_map(change.lost_m2),
        );
        for (alone, side) in [(change.only_before, "before"), (change.only_after, "after")] {
            if alone > 0 {
                let _ = writeln!(text, "    {} only {side} the change", counted(alone, "map"));
            }
        }
        let mut classes: Vec<_> = change.classes.iter().collect();
        classes.sort_by_key(|(_, cells)| std::cmp::Reverse(**cells));
        for ((before, after), cells) in classes.into_iter().take(CLASSES_MAX) {
            let _ = writeln!(text, "    {cells:>9} {before} -> {after}");
        }
    }
    for map in &comparison.worst {
        let _ = writeln!(
            text,
            "  sequence {}, {} {}: {:.2} % of the cells changed, {:.1} m2 gained, {:.1} m2 lost",
            map.sequence,
            map.vehicle,
            map.layer,
            100.0 * map.share(),
            map.gained_m2,
            map.lost_m2
        );
    }
}
