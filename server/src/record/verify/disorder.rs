//! An event or a map of a recording that does not stand where its recorder has written it.

use std::fmt;

use serde_json::{Value, json};

/// An event or a map that does not stand in its place. A recorder writes both in the order of their sequences, so the
/// file was changed after it was written, or the recorder has dropped what is missing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Disorder {
    /// An event stands in the place of another one: the events between them are missing, or the file has them
    /// elsewhere.
    Event {
        /// The vehicle's name.
        vehicle: String,
        /// Sequence of the event that should stand here.
        expected: u64,
        /// Sequence of the event that stands here.
        found: u64,
    },
    /// A map stands in the file again.
    Map {
        /// The vehicle's name.
        vehicle: String,
        /// The layer's name.
        layer: String,
        /// Sequence of the map.
        sequence: u64,
    },
}

impl Disorder {
    /// The place as one JSON object.
    pub(super) fn to_json(&self) -> Value {
        match self {
            Self::Event { vehicle, expected, found } => {
                json!({ "vehicle": vehicle, "event": { "expected": expected, "found": found } })
            }
            Self::Map { vehicle, layer, sequence } => {
                json!({ "vehicle": vehicle, "map": { "layer": layer, "sequence": sequence } })
            }
        }
    }
}

impl fmt::Display for Disorder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Event { vehicle, expected, found } => {
                write!(f, "vehicle {vehicle}: event {found} stands in the place of event {expected}")
            }
            Self::Map { vehicle, layer, sequence } => {
                write!(f, "vehicle {vehicle}: the map {sequence} of the layer {layer} is in the file again")
            }
        }
    }
}
