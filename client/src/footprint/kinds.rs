//! What the classes of a layer are to a vehicle.

use clearway_proto::legend::Class;
use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;

/// What a class is to a vehicle that drives onto it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ClassKind {
    Free,
    Low,
    Blocks,
}

pub(super) fn kind(class: &Class) -> ClassKind {
    match class.meaning {
        ClassMeaning::Free => ClassKind::Free,
        ClassMeaning::Low => ClassKind::Low,
        _ => ClassKind::Blocks,
    }
}

/// The kinds of a layer's classes, by value.
pub(super) fn kinds(layer: &Layer) -> Vec<ClassKind> {
    layer.legend.iter().map(kind).collect()
}

/// Class of a cell; `None` without classes.
pub(super) fn class_of(layer: &Layer, cell: usize) -> Option<usize> {
    let raw = layer.channel("class")?.cells.get(cell)?;
    usize::try_from(raw).ok().filter(|class| *class < layer.legend.len())
}

pub(super) fn class_name(layer: &Layer, cell: usize) -> String {
    class_of(layer, cell).map_or("unknown".into(), |class| layer.legend[class].name.clone())
}
