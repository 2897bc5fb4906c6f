//! The types of a decoded map.

use std::collections::BTreeMap;

use crate::channel::cells::Cells;
use crate::map::grid::Grid;
use crate::map::legend::Class;
use crate::v1::{self, ClassMeaning};

/// A map, decoded and checked.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// The header as on the wire.
    pub header: v1::Header,
    /// The layers in the order on the wire; names are unique.
    pub layers: Vec<Layer>,
}

/// One grid of a map, with one or more values per cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Name, such as `drivability`.
    pub name: String,
    /// Where the cells lie.
    pub grid: Grid,
    /// The classes, by value of channel `class`; class 0 is `unknown`. Empty in a layer without classes.
    pub legend: Vec<Class>,
    /// The channels in the order on the wire; names are unique. Each has [`Grid::cell_count`] cells.
    pub channels: Vec<Channel>,
    /// Planes z = ax + by + c in the ego frame as [a, b, c], by segment id; empty in a layer without segments.
    pub planes: Vec<[f64; 3]>,
    /// Metrics of the whole layer by name, such as `drivable_share`.
    pub metrics: BTreeMap<String, f64>,
    /// Safe points, the vehicle's position first; empty in a layer without them.
    pub points: Vec<SafePoint>,
}

/// A point on the medial axis of the free space, in the ego frame: it is as far as possible from the obstacles on both
/// sides.
#[derive(Clone, Debug, PartialEq)]
pub struct SafePoint {
    /// Distance forward, in metres.
    pub x_m: f32,
    /// Distance to the left, in metres.
    pub y_m: f32,
    /// Distance to the nearest cell that is not free, in metres.
    pub radius_m: f32,
    /// Indices of earlier points that the vehicle can drive to straight from here, ascending.
    pub links: Vec<u32>,
}

/// One value per cell of a layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Name, such as `class` or `unit_height`.
    pub name: String,
    /// Unit of `raw * scale`: `id` for ids; empty for classes and plain numbers.
    pub unit: String,
    /// Factor from a raw value to a value in [`Channel::unit`].
    pub scale: f32,
    /// Raw value of an unknown cell.
    pub unknown: i32,
    /// Raw values in the order of the cell index.
    pub cells: Cells,
}

impl Map {
    /// The layer with this name.
    pub fn layer(&self, name: &str) -> Option<&Layer> {
        self.layers.iter().find(|layer| layer.name == name)
    }
}

impl Layer {
    /// The channel with this name.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// Value and name of the class at a point (ego frame, metres): (0, "unknown") outside the grid and in a layer
    /// without classes.
    pub fn class_at(&self, x_m: f64, y_m: f64) -> (u16, &str) {
        match self.grid.cell_at(x_m, y_m).and_then(|cell| self.class_of(cell)) {
            Some((value, class)) => (value, &class.name),
            None => (0, "unknown"),
        }
    }

    /// Meaning of the class at a point (ego frame, metres): unknown outside the grid and in a layer without classes.
    pub fn meaning_at(&self, x_m: f64, y_m: f64) -> ClassMeaning {
        self.grid.cell_at(x_m, y_m).map_or(ClassMeaning::Unknown, |cell| self.meaning_of(cell))
    }

    /// Meaning of the class of a cell, by cell index: unknown past the last cell and in a layer without classes.
    pub fn meaning_of(&self, cell: usize) -> ClassMeaning {
        self.class_of(cell).map_or(ClassMeaning::Unknown, |(_, class)| class.meaning)
    }

    fn class_of(&self, cell: usize) -> Option<(u16, &Class)> {
        let value = u16::try_from(self.channel("class")?.cells.get(cell)?).ok()?;
        Some((value, self.legend.get(usize::from(value))?))
    }

    /// Value of a channel at a point (ego frame, metres), in the channel's unit. `None` outside the grid, in an unknown
    /// cell, and if the layer has no such channel.
    pub fn value_at(&self, channel: &str, x_m: f64, y_m: f64) -> Option<f64> {
        self.channel(channel)?.value(self.grid.cell_at(x_m, y_m)?)
    }
}

impl Channel {
    /// Value of a cell in [`Channel::unit`]; `None` if nothing is known of the cell, and past the last cell.
    pub fn value(&self, index: usize) -> Option<f64> {
        let raw = self.cells.get(index)?;
        (raw != self.unknown).then(|| f64::from(raw) * f64::from(self.scale))
    }
}
