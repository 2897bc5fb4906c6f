//! Why a delta does not fit its base layer.

/// Why the cells of a delta cannot be compared with the cells of its base layer.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BaseError {
    /// One grid is radial and the other is Cartesian.
    #[error("one grid is radial, the other Cartesian")]
    Kind,
    /// Two radial grids differ in their rows or columns.
    #[error("other rows or columns than the base has")]
    Rings,
    /// Two Cartesian grids have cells of different size.
    #[error("cells of {cell_m} m; those of the base have {base_cell_m} m")]
    CellEdge {
        /// Edge of a cell of the delta, in metres.
        cell_m: f32,
        /// Edge of a cell of the base, in metres.
        base_cell_m: f32,
    },
    /// The base layer does not have a channel of this name.
    #[error("channel {channel:?} is not in the base")]
    NoChannel {
        /// Name of the channel.
        channel: String,
    },
    /// The base layer's channel of this name has another cell type.
    #[error("channel {channel:?} has cell type {cell_type}; in the base {base_cell_type}")]
    CellType {
        /// Name of the channel.
        channel: String,
        /// `Channel.cell_type` of the delta.
        cell_type: i32,
        /// `Channel.cell_type` of the base.
        base_cell_type: i32,
    },
}
