//! A layer and one of its channels -> the colour of each cell.

use clearway_proto::legend::Class;
use clearway_proto::map::{Channel, Layer};

use super::palette::{Rgb, id_colour, scale_colour};

/// Colour of the ground outside the grid, and of cells without a value: the colour of class `unknown` in every legend.
pub const UNKNOWN: Rgb = [58, 63, 70];

/// The colours of a layer's cells.
#[derive(Clone, Debug, PartialEq)]
pub enum Colours {
    /// Index of the channel `class`, and the colours of the classes.
    Classes(usize, Vec<Rgb>),
    /// Index of a channel of ids.
    Ids(usize),
    /// A channel of numbers, coloured from the least to the greatest value.
    Values {
        /// Index of the channel.
        index: usize,
        /// Value of the first colour; greater than `greatest` if no cell has a value.
        least: f64,
        /// Value of the last colour.
        greatest: f64,
    },
    /// The layer has no channel to colour.
    None,
}

/// True if the values of a channel are ids: only their equality means something.
fn is_id(channel: &Channel) -> bool {
    channel.unit == "id"
}

impl Colours {
    /// The colours of the classes, or of the first channel of a layer without classes.
    pub fn of_layer(layer: &Layer) -> Self {
        Self::of_channel(layer, "class").unwrap_or_else(|| Self::of_index(layer, 0))
    }

    /// The colours of a channel; `None` if the layer does not have it.
    pub fn of_channel(layer: &Layer, name: &str) -> Option<Self> {
        let index = layer.channels.iter().position(|channel| channel.name == name)?;
        Some(Self::of_index(layer, index))
    }

    fn of_index(layer: &Layer, index: usize) -> Self {
        let Some(channel) = layer.channels.get(index) else { return Self::None };
        if channel.name == "class" {
            return Self::Classes(index, layer.legend.iter().map(Class::colour).collect());
        }
        if is_id(channel) {
            return Self::Ids(index);
        }
        let values = (0..channel.cells.len()).filter_map(|cell| channel.value(cell));
        let (least, greatest) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(least, greatest), v| (least.min(v), greatest.max(v)));
        Self::Values { index, least, greatest }
    }

    /// The colour of a cell.
    pub fn of_cell(&self, layer: &Layer, cell: usize) -> Rgb {
        let colour = match self {
            Self::Classes(channel, colours) => {
                let class = layer.channels[*channel].cells.get(cell).and_then(|class| usize::try_from(class).ok());
                class.and_then(|class| colours.get(class)).copied()
            }
            Self::Ids(channel) => {
                let channel = &layer.channels[*channel];
                channel.cells.get(cell).filter(|raw| *raw != channel.unknown).map(id_colour)
            }
            Self::Values { index, least, greatest } => layer.channels[*index].value(cell).map(|value| {
                let span = greatest - least;
                scale_colour(if span > 0.0 { (value - least) / span } else { 0.5 })
            }),
            Self::None => None,
        };
        colour.unwrap_or(UNKNOWN)
    }
}
