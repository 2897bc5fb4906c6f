//! A varied scan and its truth -> files, so that other programs can be judged on the very same points.
//!
//! In: a folder, the names of the frame and of its rows, a scan in the sensor frame, the truth of its points. Out:
//! `NAME.bin` (float32 x y z intensity, little-endian), `NAME.label` (u32, SemanticKITTI's class), `NAME.truth` (two
//! bytes a point, one for each protocol in the order of the report: 0 not scored, 1 ground, 2 not ground), and
//! `NAME.json` with the path, the rows of the report in which the frame is counted, and the extrinsics.

use std::fs::File;
use std::io::Write as _;
use std::path::Path;

use anyhow::{Context, Result};
use clearway_mapping::config::Extrinsics;
use clearway_mapping::event::Scan;
use clearway_mapping::sensor::sweep::Sweep;
use serde_json::json;

use super::super::judge::{JudgedPoint, Scored};

/// The files of one frame of a report.
#[derive(Clone, Copy, Debug)]
pub struct WrittenFrame<'a> {
    /// Folder of the frame's files.
    pub folder: &'a Path,
    /// Name of the frame's files.
    pub name: &'a str,
    /// The path that was evaluated, as given.
    pub path: &'a str,
    /// Names of the rows of the report in which the frame is counted.
    pub rows: &'a [&'a str],
}

/// Writes the files of one frame.
///
/// # Errors
/// If a file or folder cannot be written, or a file exists.
pub fn write(
    frame: &WrittenFrame<'_>,
    (scan, extrinsics): (&Scan, &Extrinsics),
    truth: impl Iterator<Item = (u32, [Scored; 2])>,
) -> Result<()> {
    let (mut bin, mut label, mut scored) = (Vec::new(), Vec::new(), Vec::new());
    for (((x, y), z), intensity) in scan.x.iter().zip(&scan.y).zip(&scan.z).zip(&scan.intensity) {
        bin.extend([*x, *y, *z, *intensity].into_iter().flat_map(f32::to_le_bytes));
    }
    for (class, protocols) in truth {
        label.extend(class.to_le_bytes());
        scored.extend(protocols.map(|protocol| match protocol {
            Scored::Not => 0,
            Scored::Ground => 1,
            Scored::Other => 2,
        }));
    }
    let described = json!({ "path": frame.path, "rows": frame.rows, "extrinsics": extrinsics });
    let described = described.to_string().into_bytes();
    let WrittenFrame { folder, name, .. } = *frame;
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (extension, bytes) in [("bin", &bin), ("label", &label), ("truth", &scored), ("json", &described)] {
        let file = folder.join(format!("{name}.{extension}"));
        // Scans of the same name from two folders must not replace one another.
        let made = File::create_new(&file).and_then(|mut made| made.write_all(bytes));
        made.with_context(|| file.display().to_string())?;
    }
    Ok(())
}

/// Writes the points of a sweep as the scan of an upright sensor at `extrinsics`; `points[i]` is the truth of its
/// point i.
///
/// # Errors
/// As [`write()`].
pub fn write_sweep(
    frame: &WrittenFrame<'_>,
    (sweep, extrinsics): (&Sweep, &Extrinsics),
    points: &[JudgedPoint],
) -> Result<()> {
    let moved = |axis: &[f32], origin_m: f64| axis.iter().map(|place| place - origin_m as f32).collect();
    let scan = Scan {
        x: moved(&sweep.x, extrinsics.x_m),
        y: moved(&sweep.y, extrinsics.y_m),
        z: moved(&sweep.z, extrinsics.z_m),
        intensity: vec![0.5; sweep.x.len()],
        ..Scan::default()
    };
    // The classes of these points are none of SemanticKITTI's.
    write(frame, (&scan, extrinsics), points.iter().map(|point| (0, point.ground)))
}
