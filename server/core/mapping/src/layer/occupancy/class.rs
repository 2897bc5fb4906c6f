//! Classes and channels of the layer `occupancy`.

use crate::layer::channel::TypedChannel;
use crate::layer::class::classes;

classes! {
    /// Classes of the layer `occupancy`: the states of a cell (Seo 2014, figure 4).
    pub enum OccupancyClass {
        /// No sensor looked at the cell, or the rays prove nothing about it (the paper's "unobserved").
        Unknown,
        /// Rays passed through the cell low over the ground, and none returned from it.
        Clear: "clear", Free, 0x1c9e96;
        /// As many returns came from the cell as the vehicle's speed requires.
        Occupied: "occupied", Occupied, 0xc42638;
        /// Something nearer to the sensor hides the cell.
        Occluded: "occluded", Hidden, 0x5c5c80;
        /// Beyond the reliable range, or outside every field of view since the last map.
        OutOfRange: "out_of_range", Unknown, 0x181a1e;
    }
}

/// Hits of a cell: 255 in an occupied cell, in others as [`super::config::Hits`] states.
pub const HITS: TypedChannel<u8> = TypedChannel { name: "hits", unit: "hits", scale: 1.0, unknown: 0 };
