//! Classes and channels of the layer `height_difference`.

use crate::layer::channel::TypedChannel;
use crate::layer::class::classes;

classes! {
    /// Classes of the layer `height_difference`.
    pub enum HeightDifferenceClass {
        /// No point fell into the cell.
        Unknown,
        /// The heights of the highest and the lowest point differ by at most the threshold. The class does not say that
        /// the vehicle can get there.
        Drivable: "drivable", Free, 0x1c9e96;
        /// The heights differ by more than the threshold.
        Obstacle: "obstacle", Occupied, 0xc42638;
    }
}

/// Height of the highest point of a cell over the lowest one.
pub const DIFFERENCE: TypedChannel<u16> =
    TypedChannel { name: "difference", unit: "m", scale: 0.01, unknown: u16::MAX };
