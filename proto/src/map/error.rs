//! Why a map is refused.

use crate::channel::by_class::ByClassError;
use crate::channel::error::DecodeError;
use crate::map::base_error::BaseError;
use crate::map::id::MapId;
use crate::map::legend::LegendError;

/// Why a map was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// The map has more bytes than the reader accepts.
    #[error("map of {length} bytes; at most {allowed} are allowed")]
    TooLong {
        /// Bytes of the encoded map.
        length: usize,
        /// Greatest length in bytes, [`crate::limits::Limits::map_bytes`].
        allowed: usize,
    },
    /// The map has more layers, channels, planes, sensors and names than the reader accepts.
    #[error("map of {parts} parts; at most {allowed} are allowed")]
    TooManyParts {
        /// Number that the map claims.
        parts: usize,
        /// Greatest number of parts, [`crate::limits::Limits::map_parts`].
        allowed: usize,
    },
    /// The bytes are not a protobuf `clearway.v1.Map`.
    #[error("not an encoded clearway.v1.Map: {0}")]
    Protobuf(#[from] prost::DecodeError),
    /// The header is absent, or one of its values is impossible.
    #[error("header: {what}")]
    Header {
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// The map has a later major version of the wire.
    #[error("wire of version {version}; this reader knows versions up to {known}")]
    Version {
        /// The version in `Header.wire_version`.
        version: u32,
        /// The newest version that this reader knows, [`crate::limits::WIRE_VERSION`].
        known: u32,
    },
    /// Two layers, or two channels of a layer, have one name.
    #[error("{what} {name:?} occurs twice; names are unique")]
    Twice {
        /// `layer` or `channel`.
        what: &'static str,
        /// The name that occurs twice.
        name: String,
    },
    /// A grid is absent or impossible.
    #[error("layer {layer:?}, geometry: {what}")]
    Geometry {
        /// Name of the layer.
        layer: String,
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// All channels together claim more cells than the reader accepts.
    #[error("the channels claim {cells} cells together; at most {allowed} are allowed")]
    TooManyCells {
        /// Number that the channels claim.
        cells: u64,
        /// Greatest number of cells, [`crate::limits::Limits::map_cells`].
        allowed: u64,
    },
    /// A channel has another number of cells than its grid.
    #[error("layer {layer:?}, channel {channel:?}: {cell_count} cells; the grid has {expected}")]
    CellCount {
        /// Name of the layer.
        layer: String,
        /// Name of the channel.
        channel: String,
        /// Number of cells in `Channel.cell_count`.
        cell_count: u32,
        /// Cells of the grid.
        expected: u64,
    },
    /// The cells of a channel were refused.
    #[error("layer {layer:?}, channel {channel:?}: {source}")]
    Cells {
        /// Name of the layer.
        layer: String,
        /// Name of the channel.
        channel: String,
        /// Fault of the cells.
        source: DecodeError,
    },
    /// A delta came without its base map, or the base map does not have the layer.
    #[error("layer {layer:?} is a delta to that of map {base_sequence}, which is needed and not there")]
    NoBase {
        /// Name of the layer.
        layer: String,
        /// Sequence number of the base map.
        base_sequence: u64,
    },
    /// A delta was applied to another map than its base.
    #[error("layer {layer:?} is a delta to {needed}; given was {given}")]
    OtherBase {
        /// Name of the layer.
        layer: String,
        /// The map that the delta needs as its base.
        needed: Box<MapId>,
        /// The map that was given.
        given: Box<MapId>,
    },
    /// The cells of a delta cannot be compared with the cells of its base layer.
    #[error("layer {layer:?} is a delta that does not fit its base: {source}")]
    BaseShape {
        /// Name of the layer.
        layer: String,
        /// How the grids differ.
        source: BaseError,
    },
    /// The class table of a channel was refused.
    #[error("layer {layer:?}, channel {channel:?}, class table: {source}")]
    ByClass {
        /// Name of the layer.
        layer: String,
        /// Name of the channel.
        channel: String,
        /// Fault of the class table.
        source: ByClassError,
    },
    /// A safe point is impossible.
    #[error("layer {layer:?}, safe point {point}: {what}")]
    SafePoint {
        /// Name of the layer.
        layer: String,
        /// Index of the point.
        point: usize,
        /// What is wrong, the value and what is needed.
        what: String,
    },
    /// The legend was refused.
    #[error("layer {layer:?}, legend: {source}")]
    Legend {
        /// Name of the layer.
        layer: String,
        /// Fault of the legend.
        source: LegendError,
    },
    /// A cell has a class that the legend does not name.
    #[error("layer {layer:?}: class {class} in cell {cell}; the legend has {legend} entries")]
    Class {
        /// Name of the layer.
        layer: String,
        /// Index of the cell.
        cell: usize,
        /// Value of the class.
        class: i32,
        /// Entries of the legend.
        legend: usize,
    },
}

impl MapError {
    /// Name of the variant in the golden vectors, the same in every client language. [`MapError::Cells`] has the name
    /// of its [`DecodeError`].
    pub fn name(&self) -> &'static str {
        match self {
            Self::TooLong { .. } => "too_long",
            Self::TooManyParts { .. } => "too_many_parts",
            Self::Protobuf(_) => "protobuf",
            Self::Header { .. } => "header",
            Self::Version { .. } => "version",
            Self::Twice { .. } => "twice",
            Self::Geometry { .. } => "geometry",
            Self::TooManyCells { .. } => "too_many_cells",
            Self::CellCount { .. } => "cell_count",
            Self::Cells { source, .. } => source.name(),
            Self::NoBase { .. } => "no_base",
            Self::OtherBase { .. } => "other_base",
            Self::BaseShape { .. } => "base_shape",
            Self::ByClass { .. } => "by_class",
            Self::SafePoint { .. } => "safe_point",
            Self::Legend { .. } => "legend",
            Self::Class { .. } => "class",
        }
    }
}
