//! Classes of cells: the name, the meaning and the colour of each value of a layer's channel `class`.
//!
//! Each layer declares its classes once, with the macro `classes!`. Clients, pictures and the page read names, meanings
//! and colours from the legend that this gives; they keep no table of their own. Class 0 is `unknown` in every layer,
//! and is never free.

/// What a class says about driving through a cell, the same for all layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Meaning {
    /// The layer makes no statement about the cell.
    Unknown,
    /// The sensor saw the cell, and the vehicle can drive there.
    Free,
    /// No point fell into the cell; it is assumed free because of the cells around it.
    Inferred,
    /// Something stands in the cell.
    Occupied,
    /// Something nearer to the sensor hides the cell.
    Hidden,
    /// The cell itself is free ground, but the layer found no way there for the vehicle.
    NotReached,
    /// Something stands in the cell that is higher than the vehicle's ground clearance, and lower than an obstacle.
    Low,
}

/// One entry of a legend: a class of a layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClassInfo {
    /// Name on the wire, unique within the layer.
    pub name: &'static str,
    /// What the class says about driving through the cell.
    pub meaning: Meaning,
    /// Colour in pictures, `0xRRGGBB`. Classes of one layer differ in lightness as well as in hue, so that
    /// colour-blind readers tell them apart, also in grey.
    pub rgb: u32,
}

impl ClassInfo {
    /// Class 0 of every layer.
    pub const UNKNOWN: Self = Self { name: "unknown", meaning: Meaning::Unknown, rgb: 0x3a3f46 };
}

/// Declares the classes of one layer: an enum whose discriminants are the raw values of the channel `class`, and its
/// legend. The first class is `Unknown`; each further one has a name, a [`Meaning`] and a colour.
macro_rules! classes {
    (
        $(#[$enum_doc:meta])*
        pub enum $Class:ident {
            $(#[$unknown_doc:meta])*
            Unknown,
            $( $(#[$doc:meta])* $Variant:ident: $name:literal, $meaning:ident, $rgb:literal; )+
        }
    ) => {
        $(#[$enum_doc])*
        #[repr(u8)]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub enum $Class {
            $(#[$unknown_doc])*
            #[default]
            Unknown,
            $( $(#[$doc])* $Variant, )+
        }

        impl $Class {
            /// The classes by value.
            pub const LEGEND: &'static [$crate::layer::class::ClassInfo] = &[
                $crate::layer::class::ClassInfo::UNKNOWN,
                $( $crate::layer::class::ClassInfo {
                    name: $name,
                    meaning: $crate::layer::class::Meaning::$meaning,
                    rgb: $rgb,
                }, )+
            ];

            /// Raw value of the class in the channel `class`.
            pub const fn value(self) -> u8 {
                self as u8
            }
        }
    };
}
pub(crate) use classes;

/// Number of cells of a class. `class` holds the raw values of a layer.
pub(crate) fn count_cells(class: &[u8], value: u8) -> usize {
    // A chunk's count fits into a byte, so that the compiler vectorises it.
    let of_chunk = |cells: &[u8]| usize::from(cells.iter().map(|cell| u8::from(*cell == value)).sum::<u8>());
    class.chunks(u8::MAX as usize).map(of_chunk).sum()
}

/// Number of free cells over the number of judged cells (free, not reached or occupied), 0 to 1; 0 without judged
/// cells. `class` holds the raw values of a layer with this legend.
pub(crate) fn drivable_share(legend: &[ClassInfo], class: &[u8]) -> f64 {
    let (mut free, mut judged) = (0, 0);
    for (value, info) in (0..).zip(legend) {
        let cells = || count_cells(class, value);
        match info.meaning {
            Meaning::Free => (free, judged) = (free + cells(), judged + cells()),
            Meaning::NotReached | Meaning::Occupied | Meaning::Low => judged += cells(),
            Meaning::Unknown | Meaning::Inferred | Meaning::Hidden => {}
        }
    }
    if judged == 0 { 0.0 } else { free as f64 / judged as f64 }
}
