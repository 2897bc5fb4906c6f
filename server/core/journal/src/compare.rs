//! Two sets of maps of one drive -> what changed: cells by layer and class, gained and lost free space, the maps that
//! changed most.
//!
//! The maps before come from a recording. The maps after are computed from its events with another configuration, or
//! come from another recording. Maps with the same stamp are compared; maps that only one side has are counted.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

use bytes::Bytes;
use clearway_mapping::config::ConfigValueError;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::codec::Limits;
use clearway_proto::grid::Grid;
use clearway_proto::map::{Layer, MapError, decode_map};

use change::{Change, class_name};
use computing::Computing;

use super::reader::{RecordedMessage, RecordingError, RecordingReader};
use crate::{RecordedMaps, RecordedVehicle};

pub mod change;
mod computing;

/// Where the maps after the change come from.
pub enum After<'a> {
    /// Maps computed from the recorded events with another configuration.
    Config {
        /// Configuration of each recorded vehicle, in any order; without tables, a vehicle uses the recorded tables.
        given: &'a [RecordedVehicle],
        /// The configuration of each vehicle as recorded, in the recording's order.
        recorded: &'a [RecordedVehicle],
    },
    /// The maps of this recording.
    Recording(&'a Path),
}

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

/// Compares the maps of the recording `before` with the maps of `after`; keeps the `worst` maps that changed most.
///
/// # Errors
/// [`CompareError::Recording`] if a file cannot be read, [`CompareError::Misfit`] if the configuration names other
/// vehicles or sensors than the recording, [`CompareError::NoMaps`] if two recordings are compared and one has no maps,
/// [`CompareError::Config`] if a configuration is invalid, [`CompareError::Map`] if a map cannot be decoded.
pub fn compare(before: &Path, after: &After<'_>, worst: usize) -> Result<Comparison, CompareError> {
    let mut pairs =
        Pairs { waiting: BTreeMap::new(), worst, changed_most: BTreeMap::new(), comparison: Comparison::default() };
    let mut recording = RecordingReader::open(before)?;
    match after {
        After::Config { given, recorded } => {
            let boot_id = recording.header().boot_id;
            let mut vehicles = pipelines(before, boot_id, given, recorded)?;
            // Without recorded maps, the maps of the recorded configuration are computed too.
            let mut recorded = match recording.maps() {
                RecordedMaps::Full => Vec::new(),
                RecordedMaps::Digest | RecordedMaps::None => pipelines(before, boot_id, recorded, recorded)?,
            };
            let losses = recording.loss_count();
            while let Some(message) = recording.next() {
                let message = message?;
                let is_after_gap = matches!(&message, RecordedMessage::Event { vehicle, event }
                    if vehicles.iter().any(|of| *of.name == **vehicle && of.lacks_events_before(event)));
                if recording.loss_count() > losses || is_after_gap {
                    pairs.comparison.is_ended_by_loss = true;
                    break;
                }
                match message {
                    RecordedMessage::Event { vehicle, event } => {
                        for (side, vehicles) in [(BEFORE, &mut recorded), (AFTER, &mut vehicles)] {
                            let Some(computing) = vehicles.iter_mut().find(|v| *v.name == *vehicle) else { continue };
                            for (layer, bytes) in computing.step(&event) {
                                pairs.push(side, before, vehicle.clone(), layer, bytes)?;
                            }
                        }
                    }
                    RecordedMessage::Map { vehicle, layer, bytes } => {
                        pairs.push(BEFORE, before, vehicle, layer, bytes)?;
                    }
                    RecordedMessage::Digest { .. }
                    | RecordedMessage::Keyframe { .. }
                    | RecordedMessage::Counts(_)
                    | RecordedMessage::Ros { .. } => {}
                }
            }
            // How the file ends is known at its end.
            recording.by_ref().try_for_each(|message| message.map(|_| ()))?;
            pairs.comparison.incomplete = incomplete(before, &recording);
        }
        After::Recording(after) => {
            let mut sides = [recording, RecordingReader::open(after)?];
            let files = [before, *after];
            for (file, side) in files.iter().zip(&sides) {
                if side.maps() != RecordedMaps::Full {
                    return Err(CompareError::NoMaps { file: file.to_path_buf(), maps: side.maps() });
                }
            }
            let mut newest_ns = [Some(i64::MIN); 2];
            // The side that is behind is read next, so that few maps wait for their counterpart.
            while let Some(side) = (0..2).filter(|&side| newest_ns[side].is_some()).min_by_key(|&s| newest_ns[s]) {
                newest_ns[side] = loop {
                    match sides[side].next().transpose()? {
                        None => break None,
                        Some(RecordedMessage::Map { vehicle, layer, bytes }) => {
                            break Some(pairs.push(side, files[side], vehicle, layer, bytes)?);
                        }
                        Some(_) => {}
                    }
                };
            }
            pairs.comparison.incomplete = files.into_iter().zip(&sides).find_map(|(file, side)| incomplete(file, side));
        }
    }
    Ok(pairs.finish())
}

/// How a recording that was read to its end is incomplete, with its name.
fn incomplete(file: &Path, recording: &RecordingReader) -> Option<String> {
    recording.incomplete().map(|how| format!("{} is not whole: {how}", file.display()))
}

/// The sides of a comparison, as indices.
const BEFORE: usize = 0;
const AFTER: usize = 1;

/// The pipelines of a configuration, for the vehicles of a recording.
fn pipelines(
    file: &Path,
    boot_id: u64,
    given: &[RecordedVehicle],
    recorded: &[RecordedVehicle],
) -> Result<Vec<Computing>, CompareError> {
    let names = |vehicles: &[RecordedVehicle]| vehicles.iter().map(|vehicle| vehicle.config.name.clone()).collect();
    let misfit = |what: String, given: Vec<String>, recorded: Vec<String>| {
        let [given, recorded] = [given, recorded].map(|names| names.join(", "));
        CompareError::Misfit { file: file.to_owned(), what, given, recorded }
    };
    let mut vehicles = Vec::new();
    for was in recorded {
        let is = given.iter().find(|vehicle| vehicle.config.name == was.config.name);
        let is = is.ok_or_else(|| misfit("its vehicles are".into(), names(given), names(recorded)))?;
        let [given, known] = [is, was]
            .map(|vehicle| vehicle.config.sensors.iter().map(|sensor| sensor.name.clone()).collect::<Vec<_>>());
        if given != known {
            return Err(misfit(format!("the sensors of vehicle {} are", is.config.name), given, known));
        }
        let tables = if is.tables.is_empty() { &was.tables } else { &is.tables };
        vehicles.push(Computing {
            name: is.config.name.as_str().into(),
            boot_id,
            valid_ms: is.config.maps.valid_ms,
            next_event: 0,
            pipeline: Pipeline::new(&is.config, tables.clone())?,
        });
    }
    Ok(vehicles)
}

/// A decoded map of one layer.
struct OneLayer {
    sequence: u64,
    stamp_ns: i64,
    layer: Layer,
}

/// The maps of both sides that wait for their counterpart.
struct Pairs {
    /// By vehicle and layer: the maps of each side in the order of their stamps.
    waiting: BTreeMap<(String, String), [VecDeque<OneLayer>; 2]>,
    /// Number of maps that changed most to list.
    worst: usize,
    /// By vehicle and layer: the maps that changed most, greatest share first.
    changed_most: BTreeMap<(String, String), Vec<MapChange>>,
    comparison: Comparison,
}

impl Pairs {
    /// Adds a map of one side, and compares it if the other side has its counterpart; returns its stamp.
    fn push(
        &mut self,
        side: usize,
        file: &Path,
        vehicle: String,
        layer: String,
        bytes: Bytes,
    ) -> Result<i64, CompareError> {
        let wrong = |source| CompareError::Map {
            file: file.to_owned(),
            vehicle: vehicle.clone(),
            layer: layer.clone(),
            source: Box::new(source),
        };
        let mut map = decode_map(bytes, &Limits::default()).map_err(wrong)?;
        let (sequence, stamp_ns) = (map.header.sequence, map.header.capture_end_ns);
        *[&mut self.comparison.before, &mut self.comparison.after][side] += 1;
        let Some(decoded) = map.layers.pop() else { return Ok(stamp_ns) };
        let other = 1 - side;
        // Stamps rise on each side, so an older map of the other side has no counterpart.
        for (key, waiting) in self.waiting.iter_mut().filter(|((of, _), _)| *of == vehicle) {
            while waiting[other].pop_front_if(|map| map.stamp_ns < stamp_ns).is_some() {
                self.comparison.layers.entry(key.clone()).or_default().count_alone(other, 1);
            }
        }
        let map = OneLayer { sequence, stamp_ns, layer: decoded };
        let key = (vehicle, layer);
        let waiting = self.waiting.entry(key.clone()).or_default();
        // The other side's maps that wait here are at least as new as this map.
        match waiting[other].pop_front_if(|counterpart| counterpart.stamp_ns == stamp_ns) {
            None => waiting[side].push_back(map),
            Some(counterpart) => {
                let (was, is) = if side == AFTER { (counterpart, map) } else { (map, counterpart) };
                let one = self.comparison.layers.entry(key.clone()).or_default().add(&key.0, was, is);
                keep_worst(self.changed_most.entry(key).or_default(), one, self.worst);
            }
        }
        Ok(stamp_ns)
    }

    fn finish(mut self) -> Comparison {
        for (key, [before, after]) in self.waiting {
            let change = self.comparison.layers.entry(key).or_default();
            change.count_alone(BEFORE, before.len() as u64);
            change.count_alone(AFTER, after.len() as u64);
        }
        // Layers have cells of other sizes, and of a changed one there is something to see.
        let ranked = self.changed_most.into_values().flat_map(|maps| maps.into_iter().enumerate());
        let mut ranked: Vec<_> = ranked.collect();
        ranked.sort_by(|(a, one), (b, other)| a.cmp(b).then(other.share().total_cmp(&one.share())));
        self.comparison.worst = ranked.into_iter().map(|(_, map)| map).take(self.worst).collect();
        self.comparison
    }
}

/// Inserts a changed map into the list of the most changed maps, at most `length` maps.
fn keep_worst(worst: &mut Vec<MapChange>, one: MapChange, length: usize) {
    if one.changed == 0 {
        return;
    }
    let at = worst.partition_point(|other| other.share() >= one.share());
    worst.insert(at, one);
    worst.truncate(length);
}

impl LayerChange {
    /// Counts maps that only one side has.
    fn count_alone(&mut self, side: usize, maps: u64) {
        *[&mut self.only_before, &mut self.only_after][side] += maps;
    }

    /// Compares one map of the layer and adds its changes.
    fn add(&mut self, vehicle: &str, was: OneLayer, is: OneLayer) -> MapChange {
        let mut one = MapChange {
            vehicle: vehicle.to_owned(),
            sequence: is.sequence,
            stamp_ns: is.stamp_ns,
            changed: 0,
            cells: is.layer.grid.cell_count(),
            gained_m2: 0.0,
            lost_m2: 0.0,
            layer: is.layer.name.clone(),
        };
        let (before, after) = (&was.layer, &is.layer);
        let same_grid = before.grid == after.grid;
        let is_same = same_grid && before.channels == after.channels && before.legend == after.legend;
        let columns = after.grid.shape().1.max(1);
        for cell in (0..one.cells as usize).filter(|_| !is_same) {
            // On another grid, the class before is that at the middle of the cell.
            let was_at = match after.grid.centre_of(cell) {
                Some((x_m, y_m)) if !same_grid => before.grid.cell_at(x_m, y_m).unwrap_or(usize::MAX),
                _ => cell,
            };
            let (from, to) = (class_name(before, was_at), class_name(after, cell));
            if from == to {
                self.values += u64::from(same_grid && has_other_value(before, after, cell));
                continue;
            }
            one.changed += 1;
            *self.classes.entry((from.to_owned(), to.to_owned())).or_default() += 1;
            match Change::of(before, was_at, after, cell) {
                Change::FreeGained => one.gained_m2 += cell_m2(&after.grid, cell),
                Change::FreeLost => one.lost_m2 += cell_m2(&after.grid, cell),
                _ => {}
            }
            self.first.get_or_insert_with(|| CellChange {
                sequence: is.sequence,
                row: cell as u32 / columns,
                column: cell as u32 % columns,
                before: from.to_owned(),
                after: to.to_owned(),
            });
        }
        self.maps += 1;
        self.cells += one.cells;
        self.changed += one.changed;
        self.gained_m2 += one.gained_m2;
        self.lost_m2 += one.lost_m2;
        one
    }
}

/// True if a channel other than the class has another value in this cell of the same grid, or only one layer has it.
fn has_other_value(before: &Layer, after: &Layer, cell: usize) -> bool {
    before.channels.len() != after.channels.len()
        || after.channels.iter().any(|channel| {
            let was = before.channel(&channel.name).map(|was| was.value(cell));
            was != Some(channel.value(cell))
        })
}

/// Area of a cell, in square metres.
fn cell_m2(grid: &Grid, cell: usize) -> f64 {
    match grid {
        Grid::Cartesian { cell_m, .. } => f64::from(cell_m * cell_m),
        Grid::Radial { row_radius_m, columns, .. } => {
            let row = cell / *columns as usize;
            let radius_m = |row: usize| row_radius_m.get(row).map_or(0.0, |&radius| f64::from(radius));
            let (outer_m, inner_m) = (radius_m(row), row.checked_sub(1).map_or(0.0, radius_m));
            std::f64::consts::PI * (outer_m * outer_m - inner_m * inner_m) / f64::from(*columns)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cells_of_a_radial_grid_have_the_area_of_its_disc() {
        let grid = Grid::Radial { centre_m: [1.5, 0.0], row_radius_m: vec![2.0, 5.0, 10.0], columns: 8 };
        let sum: f64 = (0..24).map(|cell| cell_m2(&grid, cell)).sum();
        assert!((sum - std::f64::consts::PI * 100.0).abs() < 1e-9, "{sum}");
    }
}
