//! The legend of a layer: name, meaning and colour of each class.
//!
//! In: the three parallel lists of `clearway.v1.Layer`. Out: one [`Class`] per value of channel `class`, checked.

use crate::limits::RGB_MAX;
use crate::v1::{self, ClassMeaning};

/// One class of a layer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Class {
    /// Name, such as `drivable`; `unknown` for class 0.
    pub name: String,
    /// What a planner may conclude about a cell of this class.
    pub meaning: ClassMeaning,
    /// Colour in which viewers draw the class: 0xRRGGBB.
    pub rgb: u32,
}

impl Class {
    /// Red, green and blue of the class's colour.
    pub fn colour(&self) -> [u8; 3] {
        let [_, red, green, blue] = self.rgb.to_be_bytes();
        [red, green, blue]
    }
}

/// Why a legend was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LegendError {
    /// The three lists of the legend differ in length.
    #[error("{names} names, {meanings} meanings and {colours} colours; one of each per class is needed")]
    Lengths {
        /// Entries of `Layer.legend`.
        names: usize,
        /// Entries of `Layer.legend_meanings`.
        meanings: usize,
        /// Entries of `Layer.legend_rgb`.
        colours: usize,
    },
    /// A layer has classes, but its class 0 is not named `unknown`.
    #[error("class 0 is named {name:?}; class 0 is \"unknown\" in every legend")]
    FirstName {
        /// Name of class 0; empty if the legend is empty.
        name: String,
    },
    /// Class 0 has another meaning than `CLASS_MEANING_UNKNOWN`.
    #[error("class 0 has the meaning {meaning}; class 0 means 0 (unknown) in every legend")]
    FirstMeaning {
        /// The number on the wire.
        meaning: i32,
    },
    /// A colour has more than 24 bits.
    #[error("class {class} has the colour {rgb:#x}; at most {RGB_MAX:#x} is allowed")]
    Colour {
        /// Value of the class.
        class: usize,
        /// The number on the wire.
        rgb: u32,
    },
}

/// Reads the legend of a layer. A meaning that this version does not know becomes `ClassMeaning::Unknown`, so that a
/// planner does not enter cells of that class.
///
/// # Errors
/// [`LegendError::Lengths`] if the lists differ in length, [`LegendError::FirstMeaning`] if class 0 does not mean
/// unknown, [`LegendError::Colour`] if a colour has more than 24 bits.
pub(crate) fn decode_legend(layer: &v1::Layer) -> Result<Vec<Class>, LegendError> {
    let v1::Layer { legend, legend_meanings, legend_rgb, .. } = layer;
    let (names, meanings, colours) = (legend.len(), legend_meanings.len(), legend_rgb.len());
    if (meanings, colours) != (names, names) {
        return Err(LegendError::Lengths { names, meanings, colours });
    }
    if let Some(&meaning) = legend_meanings.first().filter(|meaning| **meaning != ClassMeaning::Unknown as i32) {
        return Err(LegendError::FirstMeaning { meaning });
    }
    if let Some((class, &rgb)) = legend_rgb.iter().enumerate().find(|(_, rgb)| **rgb > RGB_MAX) {
        return Err(LegendError::Colour { class, rgb });
    }
    let entries = legend.iter().zip(legend_meanings).zip(legend_rgb);
    Ok(entries
        .map(|((name, &meaning), &rgb)| Class {
            name: name.clone(),
            meaning: ClassMeaning::try_from(meaning).unwrap_or(ClassMeaning::Unknown),
            rgb,
        })
        .collect())
}

/// Writes a legend into a layer's message.
pub fn encode_legend<'a>(layer: &mut v1::Layer, classes: impl IntoIterator<Item = (&'a str, ClassMeaning, u32)>) {
    (layer.legend, layer.legend_meanings, layer.legend_rgb) = Default::default();
    for (name, meaning, rgb) in classes {
        layer.legend.push(name.to_owned());
        layer.legend_meanings.push(meaning.into());
        layer.legend_rgb.push(rgb);
    }
}

/// True if a layer's message has no legend at all.
pub(crate) fn is_empty(layer: &v1::Layer) -> bool {
    layer.legend.is_empty() && layer.legend_meanings.is_empty() && layer.legend_rgb.is_empty()
}

/// True if two layers have the same legend.
pub(crate) fn is_same_legend(one: &v1::Layer, other: &v1::Layer) -> bool {
    one.legend == other.legend && one.legend_meanings == other.legend_meanings && one.legend_rgb == other.legend_rgb
}
