//! A layer and one of its channels -> the colour of each cell.

use clearway_proto::legend::Class;
use clearway_proto::map::{Channel, Layer};

use super::error::PictureError;
use crate::encode::legend::Legend;
use crate::encode::palette::{Rgb, id_colour, scale_colour};

/// Colour of the ground outside the grid, and of cells without a value: the colour of class `unknown` in every legend.
pub const UNKNOWN: Rgb = [58, 63, 70];

/// The colours of a layer's cells.
pub(crate) enum Colours {
    /// Index of the channel `class`, and the colours of the classes.
    Classes(usize, Vec<Rgb>),
    /// Index of a channel of ids.
    Ids(usize),
    /// Index of another channel, and the values of its first and last colour.
    Values(usize, f64, f64),
    /// No channel.
    None,
}

/// True if the values of a channel are ids, of which only equality means something.
fn is_id(channel: &Channel) -> bool {
    channel.unit == "id"
}

impl Colours {
    /// The colours of a channel from the first to the second of these values, or over those of the layer if none are
    /// given; of the classes, or of the first channel of a layer without classes, if no channel is named.
    pub(crate) fn of(layer: &Layer, channel: Option<&str>, values: Option<[f64; 2]>) -> Result<Self, PictureError> {
        let find = |name: &str| layer.channels.iter().position(|channel| channel.name == name);
        let Some(name) = channel else { return Ok(Self::of_layer(layer)) };
        match (find(name).map(|index| Self::of_channel(layer, index)), values) {
            (Some(Self::Values(index, ..)), Some([least, greatest])) => Ok(Self::Values(index, least, greatest)),
            (Some(colours), _) => Ok(colours),
            (None, _) => Err(PictureError::NoChannel {
                layer: layer.name.clone(),
                channel: name.to_owned(),
                present: layer.channels.iter().map(|channel| &*channel.name).collect::<Vec<_>>().join(", "),
            }),
        }
    }

    /// The colours of the classes, or of the first channel of a layer without classes.
    pub(crate) fn of_layer(layer: &Layer) -> Self {
        let class = layer.channels.iter().position(|channel| channel.name == "class");
        Self::of_channel(layer, class.unwrap_or(0))
    }

    fn of_channel(layer: &Layer, index: usize) -> Self {
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
        Self::Values(index, least, greatest)
    }

    /// The colour of a cell.
    pub(crate) fn of_cell(&self, layer: &Layer, cell: usize) -> Rgb {
        let colour = match self {
            Self::Classes(channel, colours) => {
                let class = layer.channels[*channel].cells.get(cell).and_then(|class| usize::try_from(class).ok());
                class.and_then(|class| colours.get(class)).copied()
            }
            Self::Ids(channel) => {
                let channel = &layer.channels[*channel];
                channel.cells.get(cell).filter(|raw| *raw != channel.unknown).map(id_colour)
            }
            Self::Values(channel, least, greatest) => layer.channels[*channel].value(cell).map(|value| {
                let span = greatest - least;
                scale_colour(if span > 0.0 { (value - least) / span } else { 0.5 })
            }),
            Self::None => None,
        };
        colour.unwrap_or(UNKNOWN)
    }

    /// The texts of the values of the first and the last colour, and the unit; `None` for classes and ids, and if no
    /// cell is known.
    pub(crate) fn scale<'a>(&self, layer: &'a Layer) -> Option<([String; 2], &'a str)> {
        let (channel, &Self::Values(_, least, greatest)) = (self.channel(layer)?, self) else { return None };
        // 0.01 in single precision is a little less than 0.01.
        let digits = (-f64::from(channel.scale).log10() - 1e-6).ceil().clamp(0.0, 6.0) as usize;
        (least <= greatest).then(|| ([least, greatest].map(|value| format!("{value:.digits$}")), &*channel.unit))
    }

    /// The channel, if it is one of values.
    fn channel<'a>(&self, layer: &'a Layer) -> Option<&'a Channel> {
        if let &Self::Values(channel, ..) = self { layer.channels.get(channel) } else { None }
    }

    /// What the colours mean, for the strip under the picture.
    pub(crate) fn legend(&self, layer: &Layer) -> Legend {
        match (self, self.scale(layer)) {
            (Self::Classes(_, colours), _) => Legend::Classes(
                layer.legend.iter().map(|class| class.name.clone()).zip(colours.iter().copied()).collect(),
            ),
            (_, Some(([least, greatest], unit))) => {
                let name = self.channel(layer).map_or("", |channel| &*channel.name);
                Legend::Scale([format!("{name} {least}"), format!("{greatest} {unit}").trim_end().to_owned()])
            }
            (_, None) => Legend::Classes(Vec::new()),
        }
    }

    /// What the picture shows: the channel with its scale; `None` for classes.
    pub(crate) fn text(&self, layer: &Layer) -> Option<String> {
        let (Self::Ids(channel) | Self::Values(channel, ..)) = self else { return None };
        let name = &layer.channels[*channel].name;
        Some(match self.scale(layer) {
            Some(([least, greatest], unit)) => format!("{name}: dark {least} {unit} to light {greatest} {unit}")
                .replace("  ", " ")
                .trim_end()
                .to_owned(),
            None if matches!(self, Self::Ids(_)) => format!("{name}: one colour for each id"),
            None => format!("{name}: unknown in all cells"),
        })
    }
}
