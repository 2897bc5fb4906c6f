//! What changed between two sets of maps, or why it cannot be said.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clearway_mapping::config::ConfigValueError;
use clearway_proto::map::MapError;

use crate::RecordedMaps;
use crate::reader::RecordingError;

/// What changed between two sets of maps.
#[derive(Debug, Default)]
pub struct Comparison {
    /// Number of maps before, of one layer each.
    pub before: u64,
    /// Number of maps after, of one layer each.
    pub after: u64,
    /// How a file is incomplete, with its name; `None` if both are whole.
    pub incomplete: Option<String>,
    /// True if events are missing. The maps after them are not compared with maps of a configuration: the missing
    /// events alone may make them differ.
    pub is_ended_by_loss: bool,
    /// Changes by vehicle and layer.
    pub layers: BTreeMap<(String, String), LayerChange>,
    /// The maps with the greatest share of changed cells: the first map of each layer, greatest share first, then the
    /// second map of each layer, and so on.
    pub worst: Vec<MapChange>,
}

/// What changed in the maps of one layer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LayerChange {
    /// Number of maps that are compared.
    pub maps: u64,
    /// Number of maps that only the side before has.
    pub only_before: u64,
    /// Number of maps that only the side after has.
    pub only_after: u64,
    /// Number of cells of the compared maps.
    pub cells: u64,
    /// Number of cells whose class changed.
    pub changed: u64,
    /// Number of cells with the same class and another value in another channel.
    pub values: u64,
    /// Area that became free, in square metres, in all maps.
    pub gained_m2: f64,
    /// Area that was free and is no more, in square metres, in all maps.
    pub lost_m2: f64,
    /// Number of changed cells, by class before and class after.
    pub classes: BTreeMap<(String, String), u64>,
    /// The first cell whose class changed.
    pub first: Option<CellChange>,
}

/// A cell whose class changed.
#[derive(Clone, Debug, PartialEq)]
pub struct CellChange {
    /// Sequence of the map, after the change.
    pub sequence: u64,
    /// Row of the grid.
    pub row: u32,
    /// Column of the grid.
    pub column: u32,
    /// Name of the class before.
    pub before: String,
    /// Name of the class after.
    pub after: String,
}

/// One map of one layer, before and after.
#[derive(Clone, Debug)]
pub struct MapChange {
    /// Name of the vehicle.
    pub vehicle: String,
    /// Sequence of the map, after the change.
    pub sequence: u64,
    /// End of the capture, in nanoseconds since the Unix epoch.
    pub stamp_ns: i64,
    /// Number of cells whose class changed.
    pub changed: u64,
    /// Number of cells.
    pub cells: u64,
    /// Area that became free, in square metres.
    pub gained_m2: f64,
    /// Area that was free and is no more, in square metres.
    pub lost_m2: f64,
    /// Name of the layer.
    pub layer: String,
}

/// Two sets of maps cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareError {
    /// A file cannot be read or is damaged.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The configuration of a vehicle is invalid.
    #[error(transparent)]
    Config(#[from] ConfigValueError),
    /// A recorded map cannot be decoded.
    #[error("{}: a map of layer {layer} of vehicle {vehicle}: {source}", file.display())]
    Map {
        /// Path of the recording with the map.
        file: PathBuf,
        /// Name of the vehicle.
        vehicle: String,
        /// Name of the map's layer.
        layer: String,
        /// Why the map cannot be decoded.
        source: Box<MapError>,
    },
    /// A recording has no maps to compare with another recording's maps.
    #[error(
        "{} has no maps (recorder.maps = {:?}): `clearway replay` makes them with --record", file.display(), maps.as_str()
    )]
    NoMaps {
        /// Path of the recording without maps.
        file: PathBuf,
        /// What the recording holds of the maps.
        maps: RecordedMaps,
    },
    /// The configuration does not fit the sensors of the recording: events name sensors by their place in the list.
    #[error(
        "the configuration does not fit {}: {what} {given}; recorded, in this order: {recorded}", file.display()
    )]
    Misfit {
        /// Path of the recording that the configuration does not fit.
        file: PathBuf,
        /// The kind of names that do not fit, in words.
        what: String,
        /// The names in the configuration.
        given: String,
        /// The names in the recording.
        recorded: String,
    },
}

impl Comparison {
    /// True if no cell changed and every map has its counterpart; a file that is not whole may lack some.
    pub fn is_equal(&self) -> bool {
        let is_complete = |change: &LayerChange| change.only_before + change.only_after == 0;
        let may_lack = self.incomplete.is_some() || self.is_ended_by_loss;
        let is_unchanged = |change: &LayerChange| change.changed + change.values == 0;
        self.layers.values().all(|change| is_unchanged(change) && (may_lack || is_complete(change)))
    }

    /// Number of maps of one side only.
    pub fn unpaired(&self) -> u64 {
        self.layers.values().map(|change| change.only_before + change.only_after).sum()
    }
}

impl LayerChange {
    /// True if every map has its counterpart and no cell changed.
    pub fn is_equal(&self) -> bool {
        self.changed + self.values + self.only_before + self.only_after == 0
    }
}

impl MapChange {
    /// Share of the cells whose class changed, 0 to 1.
    pub fn share(&self) -> f64 {
        self.changed as f64 / (self.cells as f64).max(1.0)
    }
}
