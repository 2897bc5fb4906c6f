//! The map of a log of Argoverse 2: heights of the ground and drivable areas, in the city's frame, metres.
//!
//! In: the folder `map/`, with `*_ground_height_surface____*.npy`, `*___img_Sim2_city.json` and
//! `log_map_archive_*.json`. Out: the height of the ground at a place, and whether it is drivable.

use std::path::Path;

use serde_json::Value;

use super::super::super::error::EvaluateError;
use super::feather::{f16, values};

/// Greatest number of cells of a raster. Ours: 10 km² of cells of 0.3 m.
const CELLS_MAX: usize = 120_000_000;

/// Heights of the ground, and drivable areas.
pub struct GroundMap {
    /// By row and column, in metres; NaN without a height.
    heights_m: Vec<f32>,
    columns: usize,
    /// Column and row of a place: (place + shift) * scale.
    shift_m: [f64; 2],
    scale: f64,
    /// Outlines of the drivable areas.
    areas: Vec<Vec<[f64; 2]>>,
}

impl GroundMap {
    /// Reads the files of a log's folder `map/`.
    ///
    /// # Errors
    /// [`EvaluateError::Argoverse`] for a file that is missing or not of its kind.
    pub fn read(folder: &Path) -> Result<Self, EvaluateError> {
        let file = |part: &'static str, extension: &'static str| {
            let fault = |what: String| EvaluateError::Argoverse { file: folder.to_owned(), what };
            let entries = std::fs::read_dir(folder).map_err(|error| fault(error.to_string()))?;
            let named = |name: &str| name.contains(part) && name.ends_with(extension);
            let mut paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
            let found = paths.find(|path| path.file_name().and_then(|name| name.to_str()).is_some_and(named));
            found.ok_or_else(|| fault(format!("no file *{part}*{extension}")))
        };
        let raster = file("_ground_height_surface_", ".npy")?;
        let placed = file("_img_Sim2_city", ".json")?;
        let archive = file("log_map_archive_", ".json")?;
        let kind = |file: &Path, what: &str| EvaluateError::Argoverse { file: file.to_owned(), what: what.to_owned() };
        let bytes = |file: &Path| std::fs::read(file).map_err(|error| kind(file, &error.to_string()));
        let json = |file: &Path| -> Result<Value, EvaluateError> {
            serde_json::from_slice(&bytes(file)?).map_err(|error| kind(file, &error.to_string()))
        };
        let (heights_m, columns) =
            heights(&bytes(&raster)?).ok_or_else(|| kind(&raster, "a NumPy array <f2 of two dimensions is needed"))?;
        let (shift_m, scale) =
            placement(&json(&placed)?).ok_or_else(|| kind(&placed, "R, t and s without a rotation are needed"))?;
        let areas = areas(&json(&archive)?).ok_or_else(|| kind(&archive, "drivable_areas are needed"))?;
        Ok(Self { heights_m, columns, shift_m, scale, areas })
    }

    /// Height of the ground at a place; `None` where the raster has none.
    pub fn height_m(&self, x: f64, y: f64) -> Option<f64> {
        let index = |place: f64, shift: f64| ((place + shift) * self.scale).round();
        let (column, row) = (index(x, self.shift_m[0]), index(y, self.shift_m[1]));
        if column < 0.0 || row < 0.0 || column >= self.columns as f64 {
            return None;
        }
        let height = *self.heights_m.get(row as usize * self.columns + column as usize)?;
        (!height.is_nan()).then(|| f64::from(height))
    }

    /// True if a place is inside a drivable area.
    pub fn is_drivable(&self, x: f64, y: f64) -> bool {
        self.areas.iter().any(|area| is_inside(area, x, y))
    }
}

/// True if a place is inside an outline: a line from it to the right crosses the outline an odd number of times.
fn is_inside(outline: &[[f64; 2]], x: f64, y: f64) -> bool {
    let ends = outline.iter().zip(outline.iter().cycle().skip(1));
    let crossed =
        ends.filter(|([ax, ay], [bx, by])| (*ay > y) != (*by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax);
    crossed.count() % 2 == 1
}

/// The values of a NumPy array of 16-bit floats, and its number of columns.
fn heights(file: &[u8]) -> Option<(Vec<f32>, usize)> {
    let header_length = usize::from(u16::from_le_bytes(*file.get(8..)?.first_chunk()?));
    let header = std::str::from_utf8(file.get(10..10 + header_length)?).ok()?;
    let is_known = file.starts_with(b"\x93NUMPY\x01\0")
        && header.contains("'descr': '<f2'")
        && header.contains("'fortran_order': False");
    let shape = header.split_once("'shape': (")?.1.split_once(')')?.0;
    let shape: Vec<usize> = shape.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    let heights = values(file.get(10 + header_length..)?, f16)?;
    match shape[..] {
        [rows, columns] if is_known && rows.checked_mul(columns)? == heights.len() && heights.len() <= CELLS_MAX => {
            Some((heights, columns))
        }
        _ => None,
    }
}

/// Shift and scale of the raster.
fn placement(json: &Value) -> Option<([f64; 2], f64)> {
    let numbers = |key: &str| -> Option<Vec<f64>> { json[key].as_array()?.iter().map(Value::as_f64).collect() };
    let shift: [f64; 2] = numbers("t")?.try_into().ok()?;
    (numbers("R")? == [1.0, 0.0, 0.0, 1.0]).then_some((shift, json["s"].as_f64()?))
}

fn areas(json: &Value) -> Option<Vec<Vec<[f64; 2]>>> {
    let place = |point: &Value| Some([point["x"].as_f64()?, point["y"].as_f64()?]);
    let outline = |area: &Value| area["area_boundary"].as_array()?.iter().map(place).collect();
    json["drivable_areas"].as_object()?.values().map(outline).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Two rows of three cells of 0.5 m, from x = 10 and y = 20 on, and a triangle as the drivable area.
    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let header = "{'descr': '<f2', 'fortran_order': False, 'shape': (2, 3), }\n";
        let mut npy = b"\x93NUMPY\x01\0".to_vec();
        npy.extend((header.len() as u16).to_le_bytes());
        npy.extend(header.bytes());
        npy.extend([0x3c00_u16, 0x4000, 0x7e00, 0x3c00, 0x4000, 0x4200].into_iter().flat_map(u16::to_le_bytes));
        std::fs::write(folder.path().join("a_ground_height_surface____PIT.npy"), npy).unwrap();
        let placed = json!({ "R": [1.0, 0.0, 0.0, 1.0], "t": [-10.0, -20.0], "s": 2.0 });
        std::fs::write(folder.path().join("a___img_Sim2_city.json"), placed.to_string()).unwrap();
        let corner = |x: f64, y: f64| json!({ "x": x, "y": y, "z": 0.0 });
        let outline = [corner(10.0, 20.0), corner(11.0, 20.0), corner(10.0, 21.0)];
        let archive = json!({ "drivable_areas": { "7": { "area_boundary": outline } } });
        std::fs::write(folder.path().join("log_map_archive_a.json"), archive.to_string()).unwrap();
        folder
    }

    #[test]
    fn heights_and_areas_are_found_by_place() {
        let map = GroundMap::read(folder().path()).unwrap();
        assert_eq!([map.height_m(10.0, 20.0), map.height_m(10.6, 20.4)], [Some(1.0), Some(2.0)]);
        assert_eq!(map.height_m(11.0, 20.5), Some(3.0));
        assert_eq!([map.height_m(11.0, 20.0), map.height_m(9.0, 20.0), map.height_m(12.0, 20.0)], [None; 3]);
        assert!(map.is_drivable(10.2, 20.2) && !map.is_drivable(10.8, 20.8));
    }

    #[test]
    fn a_missing_or_wrong_file_is_named() {
        let folder = folder();
        let error = || GroundMap::read(folder.path()).err().unwrap().to_string();
        std::fs::write(folder.path().join("a___img_Sim2_city.json"), "{\"R\": [0, 1, 1, 0]}").unwrap();
        assert!(error().contains("a___img_Sim2_city.json: R, t and s"), "{}", error());
        std::fs::remove_file(folder.path().join("log_map_archive_a.json")).unwrap();
        assert!(error().contains("no file *log_map_archive_*.json"), "{}", error());
    }
}
