//! Maps of both sides -> the changes of the pairs with the same stamp.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

use bytes::Bytes;
use clearway_proto::codec::Limits;
use clearway_proto::grid::Grid;
use clearway_proto::map::{Layer, decode_map};

use super::change::{Change, class_name};
use super::outcome::{CellChange, CompareError, Comparison, LayerChange, MapChange};

/// The sides of a comparison, as indices.
pub const BEFORE: usize = 0;
pub const AFTER: usize = 1;

/// A decoded map of one layer.
struct OneLayer {
    sequence: u64,
    stamp_ns: i64,
    layer: Layer,
}

/// The maps of both sides that wait for their counterpart.
pub struct Pairs {
    /// By vehicle and layer: the maps of each side in the order of their stamps.
    waiting: BTreeMap<(String, String), [VecDeque<OneLayer>; 2]>,
    /// Number of maps that changed most to list.
    worst: usize,
    /// By vehicle and layer: the maps that changed most, greatest share first.
    changed_most: BTreeMap<(String, String), Vec<MapChange>>,
    pub comparison: Comparison,
}

impl Pairs {
    pub fn new(worst: usize) -> Self {
        let (waiting, changed_most, comparison) = Default::default();
        Self { waiting, worst, changed_most, comparison }
    }

    /// Adds a map of one side, and compares it if the other side has its counterpart; returns its stamp.
    pub fn push(
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

    pub fn finish(mut self) -> Comparison {
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
