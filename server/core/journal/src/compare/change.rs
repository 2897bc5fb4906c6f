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
    /// The change from a cell of the layer `before` to a cell of the layer `after`.
    pub fn of(before: &Layer, cell_before: usize, after: &Layer, cell_after: usize) -> Self {
        let (old, new) = (before.meaning_of(cell_before), after.meaning_of(cell_after));
        match (old == ClassMeaning::Free, new == ClassMeaning::Free) {
            _ if class_name(before, cell_before) == class_name(after, cell_after) => match new {
                ClassMeaning::Unknown => Self::Unknown,
                ClassMeaning::Free => Self::Free,
                _ => Self::Closed,
            },
            (false, true) => Self::FreeGained,
            (true, false) => Self::FreeLost,
            _ => Self::Other,
        }
    }
}

/// Name of a cell's class: `unknown` without one.
pub fn class_name(layer: &Layer, cell: usize) -> &str {
    let value = layer.channel("class").and_then(|channel| channel.cells.get(cell));
    let class = value.and_then(|value| usize::try_from(value).ok()).and_then(|value| layer.legend.get(value));
    class.map_or("unknown", |class| &class.name)
}
