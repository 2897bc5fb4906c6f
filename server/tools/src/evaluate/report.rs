//! The result of an evaluation, and the result as JSON. `table.rs` writes it as text.

use std::collections::BTreeMap;

use anyhow::Result;
use clearway_client::MapView;
use clearway_journal::encode::EncodedMap;
use clearway_mapping::pipeline::Pipeline;
use serde_json::{Value, json};

use super::footprint::gate::FootprintGate;
use super::footprint::ground::KnownPlace;
use super::footprint::tally::{self as footprint_tally, Bands, FootprintTally, HELD_M};
use super::footprint::{judge_footprints, judged_footprints};
use super::judge::{JudgedPoint, judge, judge_ground};
use super::tally::{BANDS, BANDS_M, CellCount, Confusion, Tally};

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

/// Name of the class of simulated ground behind a closed fence, or behind an opening narrower than the vehicle.
pub const UNREACHABLE: &str = "unreachable";

/// Counts of one variation of the scans of a path, or of one type of world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluatedRow {
    /// Name of the variation or type; empty if there is only one.
    pub name: String,
    /// True if no parameter may be tuned on these frames.
    pub final_only: bool,
    /// Number of frames judged.
    pub frames: u64,
    /// Name and counts of each layer, in the order of the map.
    pub layers: Vec<(String, Tally)>,
    /// Name and counts of whole footprints of each layer, in the order of the map.
    pub footprints: Vec<(String, FootprintTally)>,
    /// Names of the layers without a free class.
    pub left_out: Vec<String>,
    /// Time that the maps of each frame took, in milliseconds.
    pub step_ms: Vec<f64>,
}

/// The truth of one frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameTruth<'a> {
    /// The points of the sweep.
    pub points: &'a [JudgedPoint],
    /// The points from which the truth of footprints is made: the same points, or the points of a scan with more
    /// lasers.
    pub whole: &'a [JudgedPoint],
    /// Places whose truth is known without a return.
    pub known: &'a [KnownPlace],
}

impl EvaluatedRow {
    /// Adds the counts of a pipeline's newest map, and of its estimate of the ground, against the truth of its frame.
    ///
    /// # Errors
    /// If the map cannot be read as a planner reads it.
    pub fn judge_map(&mut self, pipeline: &Pipeline, truth: FrameTruth<'_>) -> Result<()> {
        let FrameTruth { points, whole, known } = truth;
        self.frames += u64::from(pipeline.newest_map().is_some());
        for layer in pipeline.newest_map().iter().flat_map(|map| &map.layers) {
            let mut tally = Tally::default();
            if judge(&mut tally, layer, points) {
                self.tally(layer.name).merge(&tally);
            } else if !self.left_out.iter().any(|name| name == layer.name) {
                self.left_out.push(layer.name.to_owned());
            }
        }
        if let Some(ground) = pipeline.newest_ground() {
            let height_over_m = |[x, y, z]: [f32; 3]| Some(ground.height_over_m(x, y, z)).filter(|over| !over.is_nan());
            judge_ground(self.tally("ground"), points, height_over_m);
        }
        let Some(map) = pipeline.newest_map() else { return Ok(()) };
        let view = MapView::decode(EncodedMap::new(map, "judged".into(), 0, 0).select(&[]))?;
        let footprints = judged_footprints(whole, known, pipeline.newest_sweep().mount_m);
        for layer in map.layers.iter().filter(|layer| !self.left_out.iter().any(|name| name == layer.name)) {
            judge_footprints(of(&mut self.footprints, layer.name), &view, layer.name, &footprints)?;
        }
        Ok(())
    }

    /// Adds the counts of another row.
    pub fn merge(&mut self, other: &Self) {
        self.frames += other.frames;
        for (name, tally) in &other.layers {
            self.tally(name).merge(tally);
        }
        for (name, tally) in &other.footprints {
            of(&mut self.footprints, name).merge(tally);
        }
        for name in &other.left_out {
            if !self.left_out.contains(name) {
                self.left_out.push(name.clone());
            }
        }
        self.step_ms.extend(&other.step_ms);
    }

    /// The counts of a layer; `None` if it was not judged.
    pub fn layer(&self, name: &str) -> Option<&Tally> {
        self.layers.iter().find(|(layer, _)| layer == name).map(|(_, tally)| tally)
    }

    fn tally(&mut self, name: &str) -> &mut Tally {
        of(&mut self.layers, name)
    }

    /// Median time that the maps of a frame took, in milliseconds; `None` if it was not measured.
    pub fn step_ms_p50(&self) -> Option<f64> {
        let mut times = self.step_ms.clone();
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied()
    }
}

/// Counts by object, distance in metres and layer: the cells with the object in them, and how many are called free.
pub type ObjectCounts = BTreeMap<(&'static str, u32), Vec<(String, CellCount)>>;

/// The counts of a layer, which are made if there are none.
fn of<'a, T: Default>(layers: &'a mut Vec<(String, T)>, name: &str) -> &'a mut T {
    let at = layers.iter().position(|(layer, _)| layer == name).unwrap_or_else(|| {
        layers.push((name.to_owned(), T::default()));
        layers.len() - 1
    });
    &mut layers[at].1
}

/// One random world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluatedWorld {
    /// Seed of the world.
    pub seed: u64,
    /// Theme and form.
    pub name: String,
    /// The drawn ground and objects in words.
    pub description: String,
    /// Counts of the world's cells and points.
    pub row: EvaluatedRow,
}

/// The result for one path.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluatedSource {
    /// The path, as given.
    pub path: String,
    /// Number of scans without labels, which are left out.
    pub unlabelled: usize,
    /// For each folder the extrinsics of the sensor, and where they come from.
    pub mounts: Vec<String>,
    /// The counts of each variation, first of the scans as they were recorded; or the sum of all worlds, then each type
    /// of world.
    pub rows: Vec<EvaluatedRow>,
    /// The cells of objects that were cut into the scans.
    pub objects: ObjectCounts,
    /// The random worlds, by seed.
    pub worlds: Vec<EvaluatedWorld>,
}

impl EvaluatedSource {
    /// The row of this name, which is made if there is none.
    pub fn row(&mut self, name: &str, final_only: bool) -> &mut EvaluatedRow {
        let at = self.rows.iter().position(|row| row.name == name).unwrap_or_else(|| {
            self.rows.push(EvaluatedRow { name: name.to_owned(), final_only, ..EvaluatedRow::default() });
            self.rows.len() - 1
        });
        &mut self.rows[at]
    }
}

/// The result for all paths.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Evaluation {
    /// The result for each path, in the order given.
    pub sources: Vec<EvaluatedSource>,
}

impl Evaluation {
    /// Why the footprints do not pass the gates, a line for each path, row and gate. Of random worlds, all worlds
    /// together count.
    pub fn failures(&self, gates: &[FootprintGate]) -> Vec<String> {
        let mut failures = Vec::new();
        for source in &self.sources {
            let rows = if source.worlds.is_empty() { source.rows.len() } else { 1 };
            for (row, gate) in source.rows.iter().take(rows).flat_map(|row| gates.iter().map(move |gate| (row, gate))) {
                let tally = row.footprints.iter().find(|(layer, _)| *layer == gate.layer);
                let failure = match tally {
                    None => Some("the maps have no such layer that answers".to_owned()),
                    Some((_, tally)) => gate.failure(tally),
                };
                failures.extend(failure.map(|why| format!("{} {}: {gate}: {why}", source.path, row.name)));
            }
        }
        failures
    }

    /// The report as a JSON object; a share of zero cells or points is null. `maps` of a source describes its first
    /// row.
    pub fn to_json(&self) -> Value {
        let source = |source: &EvaluatedSource| {
            let first = source.rows.first();
            json!({
                "path": source.path,
                "frames": first.map_or(0, |row| row.frames),
                "scans_without_labels": source.unlabelled,
                "extrinsics": source.mounts,
                "maps": first.map(maps),
                "left_out": first.map(|row| &row.left_out),
                "rows": source.rows.iter().map(row).collect::<Vec<_>>(),
                "objects": source.objects.iter().map(object).collect::<Vec<_>>(),
                "worlds": source.worlds.iter().map(world).collect::<Vec<_>>(),
            })
        };
        json!({
            "protocols": PROTOCOLS.map(|(name, words)| json!({ "name": name, "counts": words })),
            "range_bands_m": BANDS_M,
            "footprint_range_bands_m": footprint_tally::BANDS_M,
            "footprint_things_m": HELD_M,
            "sources": self.sources.iter().map(source).collect::<Vec<_>>(),
        })
    }
}

fn object(((name, distance_m), layers): (&(&'static str, u32), &Vec<(String, CellCount)>)) -> Value {
    let of_layer = |(layer, count): &(String, CellCount)| json!({ "layer": layer, "cells": count.all, "called_free": count.of_them });
    json!({
        "object": name,
        "distance_m": distance_m,
        "layers": layers.iter().map(of_layer).collect::<Vec<_>>(),
    })
}

fn row(row: &EvaluatedRow) -> Value {
    json!({
        "name": row.name,
        "final_only": row.final_only,
        "frames": row.frames,
        "step_ms_p50": row.step_ms_p50(),
        "maps": maps(row),
        "footprints": footprints(row),
        "left_out": row.left_out,
    })
}

fn world(world: &EvaluatedWorld) -> Value {
    json!({
        "seed": world.seed,
        "name": world.name,
        "description": world.description,
        "maps": maps(&world.row),
        "footprints": footprints(&world.row),
    })
}

fn maps(row: &EvaluatedRow) -> Vec<Value> {
    row.layers.iter().map(|(name, tally)| layer(name, tally)).collect()
}

fn footprints(row: &EvaluatedRow) -> Vec<Value> {
    let bands = |counts: &Bands| {
        let band = |count: &CellCount| json!({ "footprints": count.all, "answered_free": count.of_them });
        counts.iter().map(band).collect::<Vec<_>>()
    };
    let wrong = |wrong: &footprint_tally::WrongFootprint| {
        json!({
            "x_m": wrong.x_m, "y_m": wrong.y_m, "heading_deg": wrong.heading_deg,
            "class": wrong.class, "height_m": wrong.height_m,
        })
    };
    let of_layer = |(name, tally): &(String, FootprintTally)| {
        json!({
            "layer": name,
            "one_level": bands(&tally.level),
            "stepped": bands(&tally.stepped),
            "holding": tally.holding.iter().map(bands).collect::<Vec<_>>(),
            "unreachable": bands(&tally.unreachable),
            "grave": tally.grave(),
            "refused_by_class": tally.refused,
            "wrong": tally.wrong.iter().map(wrong).collect::<Vec<_>>(),
        })
    };
    row.footprints.iter().map(of_layer).collect()
}

fn layer(name: &str, tally: &Tally) -> Value {
    let points = |points: &Confusion| {
        json!({
            "precision": points.precision(), "recall": points.recall(), "f1": points.f1(),
            "right": points.right, "wrong": points.wrong, "missed": points.missed,
        })
    };
    let occupied =
        |count: &CellCount| json!({ "cells": count.all, "called_occupied": count.of_them, "share": count.share() });
    let by_class: serde_json::Map<String, Value> =
        tally.by_class.iter().map(|(class, counts)| ((*class).to_owned(), bands(counts))).collect();
    json!({
        "layer": name,
        "cells": {
            "precision": tally.precision(), "recall": tally.recall(), "f1": tally.f1(),
            "free_of_obstacles": tally.free_of_obstacles(),
            "called_drivable": tally.called, "called_wrongly": tally.called_wrongly,
            "drivable": tally.drivable.all, "found": tally.drivable.of_them,
        },
        "road": { "recall": tally.road_recall(), "cells": tally.road.all, "found": tally.road.of_them },
        "reach": {
            "recall": tally.recall(),
            "not_reached": tally.not_reached.share(),
            "by_range": bands(&tally.by_range),
            "by_class": by_class,
        },
        "false_obstacles": { "ground": occupied(&tally.ground), "pure_ground": occupied(&tally.pure_ground) },
        "ground_points": { PROTOCOLS[0].0: points(&tally.points[0]), PROTOCOLS[1].0: points(&tally.points[1]) },
        "leaks": {
            "obstacle_cells": tally.leaking,
            "behind_barriers": tally.leaks.get(UNREACHABLE).copied().unwrap_or(0),
            "by_class": tally.leaks,
            "cells_by_range": tally.wrong_by_range.map(|count| count.of_them),
        },
    })
}

fn bands(counts: &[CellCount; BANDS]) -> Value {
    let band = |count: &CellCount| json!({ "cells": count.all, "found": count.of_them, "recall": count.share() });
    counts.iter().map(band).collect()
}
