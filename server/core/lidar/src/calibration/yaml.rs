//! ROS `velodyne_pointcloud` YAML, in all variants in use.
//!
//! In: text. Out: [`Calibration`]. Keys may be missing, unknown keys are ignored, and `num_lasers` is checked. A key
//! that occurs twice (as in `angles-calibrated.yaml` of the driver) is an error only if the values differ.

use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};

use super::bounds::{ANGLE_RAD, FOCAL, LENGTH_M, RESOLUTION_M, bounded};
use super::error::CalibrationError;
use super::table::{Calibration, LaserCalibration};

pub(super) fn read(text: &str) -> Result<Calibration, CalibrationError> {
    let root: YamlNode = serde_yaml_ng::from_str(text).map_err(|e| CalibrationError::Yaml(e.to_string()))?;
    let root = YamlMap::new(String::new(), &root)?;
    let list = match root.get("lasers")? {
        Some(YamlNode::List(list)) => list,
        Some(other) => return Err(root.wrong("lasers", other, LASERS)),
        None => return Err(CalibrationError::Missing { key: "lasers".into(), allowed: LASERS }),
    };
    let lasers = list.iter().enumerate().map(|(i, node)| laser(i, node)).collect::<Result<Vec<_>, _>>()?;
    if let Some(node) = root.get("num_lasers")?
        && node.number() != Some(lasers.len() as f64)
    {
        return Err(root.wrong("num_lasers", node, "the number of lasers listed"));
    }
    Calibration::from_lasers(root.number("distance_resolution", RESOLUTION_M)?, lasers)
}

pub(super) fn write(calibration: &Calibration) -> String {
    serde_yaml_ng::to_string(calibration).expect("numbers and flags alone serialise")
}

const LASERS: &str = "a list with one map a laser";

fn laser(index: usize, node: &YamlNode) -> Result<LaserCalibration, CalibrationError> {
    let map = YamlMap::new(format!("lasers[{index}]"), node)?;
    let required = |key, bounds| {
        map.number(key, bounds)?.ok_or(CalibrationError::Missing { key: map.path(key), allowed: bounds.1 })
    };
    let optional = |key| map.number(key, LENGTH_M);
    Ok(LaserCalibration {
        laser_id: required("laser_id", ((0.0, 127.0), "a whole number, 0 to 127"))? as u16,
        vert_correction: required("vert_correction", ANGLE_RAD)?,
        rot_correction: map.number("rot_correction", ANGLE_RAD)?.unwrap_or(0.0),
        dist_correction: optional("dist_correction")?.unwrap_or(0.0),
        vert_offset_correction: optional("vert_offset_correction")?.unwrap_or(0.0),
        horiz_offset_correction: optional("horiz_offset_correction")?.unwrap_or(0.0),
        two_pt_correction_available: map.flag("two_pt_correction_available")?,
        dist_correction_x: optional("dist_correction_x")?,
        dist_correction_y: optional("dist_correction_y")?,
        focal_distance: map.number("focal_distance", FOCAL)?,
        focal_slope: map.number("focal_slope", FOCAL)?,
        min_intensity: map.number("min_intensity", BYTE)?.map(|v| v as u8),
        max_intensity: map.number("max_intensity", BYTE)?.map(|v| v as u8),
    })
}

const BYTE: ((f64, f64), &str) = ((0.0, 255.0), "a whole number, 0 to 255");

/// A map and its path in the document.
struct YamlMap<'a> {
    path: String,
    entries: &'a [(String, YamlNode)],
}

impl<'a> YamlMap<'a> {
    fn new(path: String, node: &'a YamlNode) -> Result<Self, CalibrationError> {
        match node {
            YamlNode::Map(entries) => Ok(Self { path, entries }),
            other if path.is_empty() => {
                Err(CalibrationError::Format(format!("{} instead of a map of keys", other.shown())))
            }
            other => Err(CalibrationError::Value { key: path, value: other.shown(), allowed: "a map of corrections" }),
        }
    }

    fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.into() } else { format!("{}.{key}", self.path) }
    }

    fn get(&self, key: &str) -> Result<Option<&'a YamlNode>, CalibrationError> {
        let mut found = self.entries.iter().filter(|(k, _)| k == key).map(|(_, node)| node);
        let first = found.next();
        match (first, found.find(|node| Some(*node) != first)) {
            (Some(first), Some(second)) => {
                Err(CalibrationError::Duplicate { key: self.path(key), first: first.shown(), second: second.shown() })
            }
            _ => Ok(first),
        }
    }

    fn wrong(&self, key: &str, node: &YamlNode, allowed: &'static str) -> CalibrationError {
        CalibrationError::Value { key: self.path(key), value: node.shown(), allowed }
    }

    fn number(
        &self,
        key: &str,
        (bounds, allowed): ((f64, f64), &'static str),
    ) -> Result<Option<f64>, CalibrationError> {
        let Some(node) = self.get(key)? else { return Ok(None) };
        let value = node.number().ok_or_else(|| self.wrong(key, node, allowed))?;
        if allowed.starts_with("a whole") && value.fract() != 0.0 {
            return Err(self.wrong(key, node, allowed));
        }
        bounded(|| self.path(key), value, bounds, allowed).map(Some)
    }

    fn flag(&self, key: &str) -> Result<bool, CalibrationError> {
        match self.get(key)? {
            None => Ok(false),
            Some(YamlNode::Flag(flag)) => Ok(*flag),
            Some(other) => Err(self.wrong(key, other, "true or false")),
        }
    }
}

/// A node of a YAML document. A map keeps keys that occur twice.
#[derive(Debug, PartialEq)]
enum YamlNode {
    Nothing,
    Flag(bool),
    Number(f64),
    Text(String),
    List(Vec<YamlNode>),
    Map(Vec<(String, YamlNode)>),
}

impl YamlNode {
    fn number(&self) -> Option<f64> {
        match self {
            YamlNode::Number(number) => Some(*number),
            _ => None,
        }
    }

    fn shown(&self) -> String {
        match self {
            YamlNode::Nothing => "nothing".into(),
            YamlNode::Flag(flag) => flag.to_string(),
            YamlNode::Number(number) => number.to_string(),
            YamlNode::Text(text) => format!("`{}`", text.chars().take(40).collect::<String>()),
            YamlNode::List(list) => format!("a list of {}", list.len()),
            YamlNode::Map(map) => format!("a map of {}", map.len()),
        }
    }
}

impl<'de> Deserialize<'de> for YamlNode {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NodeVisitor)
    }
}

struct NodeVisitor;

impl<'de> Visitor<'de> for NodeVisitor {
    type Value = YamlNode;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a number, a flag, a text, a list or a map")
    }
    fn visit_unit<E>(self) -> Result<YamlNode, E> {
        Ok(YamlNode::Nothing)
    }
    fn visit_bool<E>(self, value: bool) -> Result<YamlNode, E> {
        Ok(YamlNode::Flag(value))
    }
    fn visit_i64<E>(self, value: i64) -> Result<YamlNode, E> {
        Ok(YamlNode::Number(value as f64))
    }
    fn visit_u64<E>(self, value: u64) -> Result<YamlNode, E> {
        Ok(YamlNode::Number(value as f64))
    }
    fn visit_f64<E>(self, value: f64) -> Result<YamlNode, E> {
        Ok(YamlNode::Number(value))
    }
    fn visit_str<E>(self, value: &str) -> Result<YamlNode, E> {
        Ok(YamlNode::Text(value.into()))
    }
    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<YamlNode, A::Error> {
        let mut list = Vec::new();
        while let Some(node) = access.next_element()? {
            list.push(node);
        }
        Ok(YamlNode::List(list))
    }
    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<YamlNode, A::Error> {
        let mut map = Vec::new();
        while let Some(key) = access.next_key::<YamlNode>()? {
            let key = match key {
                YamlNode::Text(text) => text,
                other => other.shown(),
            };
            map.push((key, access.next_value()?));
        }
        Ok(YamlNode::Map(map))
    }
}
