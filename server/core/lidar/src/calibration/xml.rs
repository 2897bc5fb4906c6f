//! Velodyne `db.xml`: a Boost serialisation archive in degrees and centimetres.
//!
//! In: text. Out: [`Calibration`] of the enabled lasers, in radians and metres.

use roxmltree::{Document, Node, ParsingOptions};

use super::bounds::{ANGLE_RAD, FOCAL, LENGTH_M, RESOLUTION_M, bounded};
use super::error::CalibrationError;
use super::table::{Calibration, LaserCalibration};

/// Metres per centimetre. `distLSB_` is in centimetres per count; all other lengths are in centimetres, all angles in
/// degrees.
const M_PER_CM: f64 = 0.01;
/// Greatest number in the list of enabled lasers, and a description of the allowed numbers.
const ENABLED: (u8, &str) = (1, "1 or 0, for each laser of points_");
/// Greatest number in a list of intensities, and a description of the allowed numbers.
const BYTE: (u8, &str) = (255, "a whole number, 0 to 255");

pub(super) fn read(text: &str) -> Result<Calibration, CalibrationError> {
    // The archives begin with a document type without content, which roxmltree refuses by default.
    let options = ParsingOptions { allow_dtd: true, nodes_limit: 100_000, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options).map_err(|e| CalibrationError::Xml(e.to_string()))?;
    let db = child(document.root_element(), "DB", "the calibration database")?;
    let points = child(db, "points_", "a list of lasers")?;
    let enabled = list(db, "enabled_", ENABLED)?;
    let min_intensity = list(db, "minIntensity_", BYTE)?;
    let max_intensity = list(db, "maxIntensity_", BYTE)?;
    let resolution = number(db, "DB", "distLSB_", M_PER_CM, RESOLUTION_M)?;

    let mut lasers = Vec::new();
    for (index, item) in items(points).enumerate() {
        match enabled.as_ref().map(|flags| flags.get(index)) {
            None | Some(Some(1)) => {}
            Some(Some(_)) => continue,
            Some(None) => {
                let key = format!("enabled_.item[{index}]");
                return Err(CalibrationError::Missing { key, allowed: ENABLED.1 });
            }
        }
        let mut laser = laser(&format!("points_.item[{index}].px"), child(item, "px", "one laser")?)?;
        let of_laser = |list: &Option<Vec<u8>>| list.as_ref()?.get(usize::from(laser.laser_id)).copied();
        (laser.min_intensity, laser.max_intensity) = (of_laser(&min_intensity), of_laser(&max_intensity));
        lasers.push(laser);
    }
    Calibration::from_lasers(resolution, lasers)
}

fn laser(path: &str, px: Node<'_, '_>) -> Result<LaserCalibration, CalibrationError> {
    const RAD_PER_DEG: f64 = std::f64::consts::PI / 180.0;
    let angle = |key| number(px, path, key, RAD_PER_DEG, ANGLE_RAD);
    let length = |key| number(px, path, key, M_PER_CM, LENGTH_M);
    const ID: ((f64, f64), &str) = ((0.0, 127.0), "a whole number, 0 to 127");
    let missing = |key: &str, allowed| CalibrationError::Missing { key: format!("{path}.{key}"), allowed };
    Ok(LaserCalibration {
        laser_id: number(px, path, "id_", 1.0, ID)?.ok_or_else(|| missing("id_", ID.1))? as u16,
        vert_correction: angle("vertCorrection_")?.ok_or_else(|| missing("vertCorrection_", ANGLE_RAD.1))?,
        rot_correction: angle("rotCorrection_")?.unwrap_or(0.0),
        dist_correction: length("distCorrection_")?.unwrap_or(0.0),
        vert_offset_correction: length("vertOffsetCorrection_")?.unwrap_or(0.0),
        horiz_offset_correction: length("horizOffsetCorrection_")?.unwrap_or(0.0),
        two_pt_correction_available: false,
        dist_correction_x: length("distCorrectionX_")?,
        dist_correction_y: length("distCorrectionY_")?,
        focal_distance: number(px, path, "focalDistance_", M_PER_CM, FOCAL)?,
        focal_slope: number(px, path, "focalSlope_", 1.0, FOCAL)?,
        min_intensity: None,
        max_intensity: None,
    })
}

fn child<'a, 'i>(node: Node<'a, 'i>, name: &str, allowed: &'static str) -> Result<Node<'a, 'i>, CalibrationError> {
    node.children()
        .find(|n| n.has_tag_name(name))
        .ok_or_else(|| CalibrationError::Missing { key: format!("{}.{name}", node.tag_name().name()), allowed })
}

fn items<'a, 'i>(list: Node<'a, 'i>) -> impl Iterator<Item = Node<'a, 'i>> {
    list.children().filter(|node| node.has_tag_name("item"))
}

/// The numbers of a list such as `enabled_`; `None` if the list is missing, as in older files.
fn list(
    db: Node<'_, '_>,
    name: &str,
    (most, allowed): (u8, &'static str),
) -> Result<Option<Vec<u8>>, CalibrationError> {
    let Some(list) = db.children().find(|node| node.has_tag_name(name)) else { return Ok(None) };
    let byte = |(index, item)| {
        let written = text(item);
        written.parse().ok().filter(|value| *value <= most).ok_or_else(|| CalibrationError::Value {
            key: format!("{name}.item[{index}]"),
            value: format!("`{written}`"),
            allowed,
        })
    };
    items(list).enumerate().map(byte).collect::<Result<_, _>>().map(Some)
}

fn number(
    node: Node<'_, '_>,
    path: &str,
    key: &str,
    factor: f64,
    (bounds, allowed): ((f64, f64), &'static str),
) -> Result<Option<f64>, CalibrationError> {
    let Some(found) = node.children().find(|n| n.has_tag_name(key)) else { return Ok(None) };
    let written = text(found);
    let path = || format!("{path}.{key}");
    let value: f64 =
        written.parse().map_err(|_| CalibrationError::Value { key: path(), value: format!("`{written}`"), allowed })?;
    bounded(path, value * factor, bounds, allowed).map(Some)
}

fn text<'a>(node: Node<'a, '_>) -> &'a str {
    node.text().unwrap_or("").trim()
}
