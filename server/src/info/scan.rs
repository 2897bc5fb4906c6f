//! A scan (.bin, .pcd.bin, .pcd) -> its size.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::Result;
use clearway_mapping::scan_file;
use serde_json::{Value, json};

use super::span::rounded;

/// The number of points and rings of a scan, and the box around the points that are finite.
pub fn describe(file: &Path) -> Result<Value> {
    let (format, scan) = scan_file::read(&file.to_string_lossy(), &std::fs::read(file)?)?;
    let points = || scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]);
    let finite = || points().filter(|point| point.iter().all(|value| value.is_finite()));
    let bounds = |axis: usize| {
        let values = finite().map(|point| f64::from(point[axis]));
        let least_and_greatest = values.fold(None, |bounds: Option<[f64; 2]>, value| {
            Some(bounds.map_or([value; 2], |[least, greatest]| [least.min(value), greatest.max(value)]))
        });
        least_and_greatest.map(|bounds| bounds.map(rounded))
    };
    let rings: BTreeSet<u16> = scan.ring.iter().copied().collect();
    Ok(json!({
        "kind": "scan", "format": format.as_str(), "rings": (!rings.is_empty()).then_some(rings.len()),
        "points": scan.x.len(), "not_finite": scan.x.len() - finite().count(),
        "bounds_m": {"x": bounds(0), "y": bounds(1), "z": bounds(2)},
    }))
}
