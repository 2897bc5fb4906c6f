//! Two maps of one layer -> what changed in the class of each cell.

use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;

/// What changed in the class of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The cell lies outside one of the grids, or is unknown in both maps.
    Unknown,
    /// The class is the same, and free.
    Free,
    /// The class is the same, and neither free nor unknown.
    Closed,
    /// The cell is free now.
    FreeGained,
    /// The cell was free.
    FreeLost,
    /// Another class, and free in neither or in both maps.
    Other,
}

impl Change {
    /// The change at a point of the ego frame, in metres.
    pub fn at(before: &Layer, after: &Layer, x_m: f64, y_m: f64) -> Self {
        let (Some(was), Some(is)) = (before.grid.cell_at(x_m, y_m), after.grid.cell_at(x_m, y_m)) else {
            return Self::Unknown;
        };
        Self::of(before, was, after, is)
    }

    /// The change from cell `was` of the layer `before` to cell `is` of the layer `after`.
    pub fn of(before: &Layer, was: usize, after: &Layer, is: usize) -> Self {
        let meanings = (before.meaning_of(was), after.meaning_of(is));
        match meanings {
            _ if class_name(before, was) == class_name(after, is) => match meanings.1 {
                ClassMeaning::Unknown => Self::Unknown,
                ClassMeaning::Free => Self::Free,
                _ => Self::Closed,
            },
            (was, is) if (was == ClassMeaning::Free) == (is == ClassMeaning::Free) => Self::Other,
            (_, ClassMeaning::Free) => Self::FreeGained,
            _ => Self::FreeLost,
        }
    }
}

/// Name of a cell's class: `unknown` without one.
pub fn class_name(layer: &Layer, cell: usize) -> &str {
    let value = layer.channel("class").and_then(|channel| channel.cells.get(cell));
    let class = value.and_then(|value| usize::try_from(value).ok()).and_then(|value| layer.legend.get(value));
    class.map_or("unknown", |class| &class.name)
}
