//! The result of an evaluation, as a table and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::judge::{Confusion, Tally};

/// The protocols by which ground points are scored: name and description. Both leave out points without a class
/// (unlabeled, outlier) and the vehicle itself, and count road, parking, sidewalk, other-ground, lane-marking and
/// terrain as ground.
pub const PROTOCOLS: [(&str, &str); 2] = [
    (
        "vegetation_excluded",
        "as in Patchwork++ (Lee 2022, section IV.A) and GroundGrid's published script: ground is road, parking, \
         sidewalk, other-ground, lane-marking and terrain; vegetation is not scored; everything else is not ground",
    ),
    (
        "low_vegetation_ground",
        "as in Patchwork (Lim 2021): the same, except that vegetation lower than a quarter of the sensor's height \
         above the vehicle's ground (z < -1.3 m from KITTI's sensor) is ground, and higher vegetation is not",
    ),
];

/// The result for one path.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Source {
    /// The path, as given.
    pub path: String,
    /// Number of frames judged.
    pub frames: u64,
    /// Number of scans without labels, which are left out.
    pub unlabelled: usize,
    /// For each folder the extrinsics of the sensor, and where they come from.
    pub mounts: Vec<String>,
    /// Name and counts of each layer, in the order of the map.
    pub layers: Vec<(String, Tally)>,
    /// Names of the layers without a free class.
    pub left_out: Vec<String>,
}

/// The result for all paths.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// The result for each path, in the order given.
    pub sources: Vec<Source>,
}

impl Report {
    /// The report as a table.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        for source in &self.sources {
            let unlabelled = match source.unlabelled {
                0 => String::new(),
                scans => format!("; {scans} scan(s) without labels left out"),
            };
            let _ = writeln!(text, "{}: {} frame(s){unlabelled}", source.path, source.frames);
            source.mounts.iter().for_each(|mount| _ = writeln!(text, "  extrinsics {mount}"));
            let _ = writeln!(
                text,
                "  {:<18} {:>29}  {:>7}  {:>29}  {:>29}",
                "", "drivable cells", "road", "ground points, vegetation", "ground points, low vegetation"
            );
            let _ = writeln!(
                text,
                "  {:<18} {:>9} {:>9} {:>9}  {:>7}  {:>29}  {:>29}",
                "map, %", "precision", "recall", "F1", "recall", "excluded: P / R / F1", "is ground: P / R / F1"
            );
            for (layer, tally) in &source.layers {
                let [cells_p, cells_r, cells_f1] = [tally.precision(), tally.recall(), tally.f1()].map(percent);
                let [excluded, low] = tally.points.map(|points| {
                    let [p, r, f1] = [points.precision(), points.recall(), points.f1()].map(percent);
                    format!("{p} / {r} / {f1}")
                });
                let road = percent(tally.road_recall());
                let _ = writeln!(
                    text,
                    "  {layer:<18} {cells_p:>9} {cells_r:>9} {cells_f1:>9}  {road:>7}  {excluded:>29}  {low:>29}"
                );
            }
            for (layer, tally) in &source.layers {
                let by_class: Vec<String> =
                    tally.leaks.iter().map(|(class, cells)| format!("{class} {cells}")).collect();
                let by_class = if by_class.is_empty() { "none".to_owned() } else { by_class.join(", ") };
                let of = format!("{} of {} drivable cells", tally.called_wrongly, tally.called);
                let _ = writeln!(text, "  leaks of {layer}: {of}: {by_class}");
            }
            for layer in &source.left_out {
                let _ = writeln!(text, "  {layer}: left out, because none of its classes is free");
            }
        }
        let _ = writeln!(
            text,
            "A leak is a cell called drivable that has a point 0.3 to 2.5 m above the ground, or (simulated) ground \
             that is too steep or cannot be reached."
        );
        PROTOCOLS.iter().for_each(|(name, words)| _ = writeln!(text, "{name}: {words}."));
        text
    }

    /// The report as a JSON object; a share of zero cells or points is null.
    pub fn to_json(&self) -> Value {
        let points = |points: &Confusion| {
            json!({
                "precision": points.precision(), "recall": points.recall(), "f1": points.f1(),
                "right": points.right, "wrong": points.wrong, "missed": points.missed,
            })
        };
        let layer = |(layer, tally): &(String, Tally)| {
            json!({
                "layer": layer,
                "cells": {
                    "precision": tally.precision(), "recall": tally.recall(), "f1": tally.f1(),
                    "called_drivable": tally.called, "called_wrongly": tally.called_wrongly,
                    "drivable": tally.drivable.0, "found": tally.drivable.1,
                },
                "road": { "recall": tally.road_recall(), "cells": tally.road.0, "found": tally.road.1 },
                "ground_points": {
                    PROTOCOLS[0].0: points(&tally.points[0]),
                    PROTOCOLS[1].0: points(&tally.points[1]),
                },
                "leaks": { "obstacle_cells": tally.leaking, "by_class": tally.leaks },
            })
        };
        let source = |source: &Source| {
            json!({
                "path": source.path,
                "frames": source.frames,
                "scans_without_labels": source.unlabelled,
                "extrinsics": source.mounts,
                "maps": source.layers.iter().map(layer).collect::<Vec<_>>(),
                "left_out": source.left_out,
            })
        };
        json!({
            "protocols": PROTOCOLS.map(|(name, words)| json!({ "name": name, "counts": words })),
            "sources": self.sources.iter().map(source).collect::<Vec<_>>(),
        })
    }
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |share| format!("{:.2}", 100.0 * share))
}
