//! Labelled scans and their variations -> counts.
//!
//! In: pairs of one folder. Out: the counts of each variation, in an [`EvaluatedSource`]. Each variation has a pipeline
//! of its own. The truth is made once a frame, from the scan as it was recorded.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::{Body, Scan};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::mount::estimate;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_replay::files::kitti;

use super::super::judge::{JudgedPoint, Scored, Vote};
use super::super::options::EvaluateOptions;
use super::super::report::{EvaluatedSource, FrameTruth};
use super::labels;
use super::objects::judge_objects;
use super::one_sensor::{pipeline, step};
use super::pairs::LabelledScan;
use super::variation::{Variation, Varied};
use super::written::{WrittenFrame, write};

/// How the sensor is mounted on KITTI's car, from KITTI's published sensor setup. The published metrics of other
/// methods use it, and an estimate from one scan tilts with the road under it.
const KITTI_EXTRINSICS: Extrinsics =
    Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.73, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
/// Largest difference between the estimated height of the sensor and KITTI's, in metres; beyond it the scans are from
/// another car. Ours.
const MOUNT_M_OFF_MAX: f64 = 0.3;
/// Number of scans from which the height of the sensor is estimated.
const MOUNT_SCANS: usize = 10;

/// Judges the labelled scans of one folder, in order.
///
/// # Errors
/// For the first scan that cannot be judged.
pub fn judge_folder(
    pairs: &[LabelledScan],
    options: &EvaluateOptions,
    maps: &MapsConfig,
    source: &mut EvaluatedSource,
    judged: &mut impl FnMut(),
) -> Result<()> {
    let folder = pairs[0].scan.parent().unwrap_or(Path::new("")).to_owned();
    let (extrinsics, origin) = match options.extrinsics {
        Some(extrinsics) => (extrinsics, "as given".to_owned()),
        None => (KITTI_EXTRINSICS, kitti_mount(&folder, pairs)?),
    };
    let Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg } = extrinsics;
    let numbers = format!("{x_m},{y_m},{z_m},{roll_deg},{pitch_deg},{yaw_deg}");
    source.mounts.push(format!("{numbers} in {}: {origin}", folder.display()));
    let model = options.model;
    let mut truth = TruthMaker::new(maps, model, extrinsics)?;
    let mut pipelines: Vec<Option<(Pipeline, Mount)>> = options.variations.iter().map(|_| None).collect();
    for (index, pair) in (0..).zip(pairs) {
        let scan = read_scan(&pair.scan, index)?;
        let classes = labels::read(&pair.labels, &pair.scan, scan.x.len())?;
        let truths = truth.points(&scan, &classes, index, &pair.scan)?;
        if options.objects {
            judge_objects(&scan, &truths, (maps, model, extrinsics), source)?;
        }
        let frame = LabelledFrame { index, pair, classes: &classes, truths: &truths };
        for (variation, made) in options.variations.iter().zip(&mut pipelines) {
            let varied = variation.apply(&scan, extrinsics).with_context(|| pair.scan.display().to_string())?;
            if let Some(folder) = &options.write_scans {
                frame.write(&varied, &variation.to_string(), folder, &source.path)?;
            }
            let made = match made {
                Some(made) => made,
                None => {
                    // Chosen lasers are a sensor of their own, whose elevations follow from its rings.
                    let model = model.filter(|_| !matches!(variation, Variation::Lasers(_)));
                    made.insert(pipeline(maps, model, varied.extrinsics)?)
                }
            };
            frame.judge(varied, *variation, made, source)?;
            judged();
        }
    }
    Ok(())
}

/// A scan as it was recorded, with its labels.
struct LabelledFrame<'a> {
    index: u64,
    pair: &'a LabelledScan,
    classes: &'a [u32],
    /// The truth of each point; `None` for points too near to be kept.
    truths: &'a [Option<JudgedPoint>],
}

impl LabelledFrame<'_> {
    /// Writes a variation of the scan, and its truth, to a folder of its name.
    fn write(&self, varied: &Varied, row_name: &str, folder: &Path, path: &str) -> Result<()> {
        let name = self.pair.scan.file_stem().unwrap_or_default().to_string_lossy();
        let truth = varied.original.iter().map(|index| {
            let index = *index as usize;
            (self.classes[index], self.truths[index].map_or([Scored::Not; 2], |point| point.ground))
        });
        let frame = WrittenFrame { folder: &folder.join(row_name), name: &name, path, rows: &[row_name] };
        write(&frame, (&varied.scan, &varied.extrinsics), truth)
    }

    /// Judges the map of a variation of the scan.
    fn judge(
        &self,
        varied: Varied,
        variation: Variation,
        (pipeline, mount): &mut (Pipeline, Mount),
        source: &mut EvaluatedSource,
    ) -> Result<()> {
        let place = |i: usize| [varied.scan.x[i], varied.scan.y[i], varied.scan.z[i]];
        let kept = (0..varied.original.len()).filter(|i| Sweep::keeps(mount, place(*i)));
        let kept: Vec<usize> = kept.map(|i| varied.original[i] as usize).collect();
        let begun = Instant::now();
        step(pipeline, varied.scan, self.index, &self.pair.scan)?;
        let step_ms = begun.elapsed().as_secs_f64() * 1e3;
        let sweep = pipeline.newest_sweep();
        let point = |(original, i): (&usize, usize)| {
            let place = [sweep.x[i], sweep.y[i], sweep.z[i]];
            JudgedPoint { place, ..self.truths[*original].unwrap_or(UNKNOWN) }
        };
        let points: Vec<JudgedPoint> = kept.iter().zip(0..).map(point).collect();
        // Fewer lasers are judged by the truth of all of them, which lie in the same frame.
        let all: Vec<JudgedPoint> = match variation {
            Variation::Lasers(_) => self.truths.iter().flatten().copied().collect(),
            _ => Vec::new(),
        };
        let whole = if all.is_empty() { &points } else { &all };
        let row = source.row(&variation.to_string(), variation.is_final_only());
        row.judge_map(pipeline, FrameTruth { points: &points, whole, known: &[] })?;
        row.step_ms.push(step_ms);
        Ok(())
    }
}

/// The truth about a point that the recorded scan's truth does not cover.
const UNKNOWN: JudgedPoint = JudgedPoint {
    place: [0.0; 3],
    over_m: f32::NAN,
    class: "unlabeled",
    vote: Vote::Nothing,
    road: false,
    ground: [Scored::Not; 2],
};

/// Makes the truth of scans as they were recorded, with a pipeline that makes no map.
struct TruthMaker {
    pipeline: Pipeline,
    mount: Mount,
}

impl TruthMaker {
    fn new(maps: &MapsConfig, model: Option<Model>, extrinsics: Extrinsics) -> Result<Self> {
        let (mut pipeline, mount) = pipeline(maps, model, extrinsics)?;
        pipeline.set_active_layers(|_| false);
        Ok(Self { pipeline, mount })
    }

    /// The truth of each point of the scan; `None` for points too near to be kept.
    fn points(&mut self, scan: &Scan, classes: &[u32], index: u64, file: &Path) -> Result<Vec<Option<JudgedPoint>>> {
        step(&mut self.pipeline, scan.clone(), index, file)?;
        let keeps = |i: &usize| Sweep::keeps(&self.mount, [scan.x[*i], scan.y[*i], scan.z[*i]]);
        let kept: Vec<usize> = (0..classes.len()).filter(keeps).collect();
        let kept_classes: Vec<u32> = kept.iter().map(|i| classes[*i]).collect();
        let mut points = vec![None; classes.len()];
        for (i, point) in kept.into_iter().zip(labels::truth(self.pipeline.newest_sweep(), &kept_classes)) {
            points[i] = Some(point);
        }
        Ok(points)
    }
}

/// Checks KITTI's mount against the ground in the scans; returns the reason for using it, for the report.
fn kitti_mount(folder: &Path, pairs: &[LabelledScan]) -> Result<String> {
    let points = |scan: Scan| scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]).collect();
    let first = pairs.iter().zip(0..).take(MOUNT_SCANS).map(|(pair, index)| read_scan(&pair.scan, index).map(points));
    let scans: Vec<Vec<[f32; 3]>> = first.collect::<Result<_>>()?;
    let estimated = estimate(&scans).map_err(|error| anyhow!("{}: {error}; give --extrinsics", folder.display()))?;
    let Extrinsics { z_m, pitch_deg, roll_deg, .. } = estimated.extrinsics();
    if (z_m - KITTI_EXTRINSICS.z_m).abs() > MOUNT_M_OFF_MAX {
        bail!(
            "{}: the sensor is {z_m:.2} m above the ground, on KITTI's car {} m; give --extrinsics",
            folder.display(),
            KITTI_EXTRINSICS.z_m
        );
    }
    Ok(format!(
        "KITTI's car as published; estimated from the ground in {} scan(s): {z_m:.2} m, pitch {pitch_deg:.1}°, roll \
         {roll_deg:.1}°",
        scans.len()
    ))
}

fn read_scan(file: &Path, index: u64) -> Result<Scan> {
    match kitti::read(file, index)?.body {
        Body::Scan(scan) => Ok(scan),
        _ => unreachable!("the reading of a scan file is a scan"),
    }
}
