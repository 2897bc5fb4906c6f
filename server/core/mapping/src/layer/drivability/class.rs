//! Classes and channels of the layer `drivability`.

use crate::layer::channel::TypedChannel;
use crate::layer::class::classes;

classes! {
    /// Classes of the layer `drivability`.
    pub enum DrivabilityClass {
        /// No point fell into the cell.
        Unknown,
        /// The vehicle can drive there from where it stands.
        Drivable: "drivable", Free, 0x1c9e96;
        /// Free ground that the vehicle does not reach: behind an edge or a slope that it cannot drive over, or behind
        /// a passage that is narrower than the vehicle.
        NotDrivable: "not_drivable", NotReached, 0xf4b842;
        /// Something stands in the cell, higher than a unit over the local ground.
        Obstacle: "obstacle", Occupied, 0xc42638;
    }
}

/// Segment of a cell, counted from 0.
pub const SEGMENT: TypedChannel<u16> = TypedChannel { name: "segment", unit: "id", scale: 1.0, unknown: u16::MAX };

/// Raw `unit_height` of a cell without points.
pub const UNIT_HEIGHT_UNKNOWN: i8 = i8::MIN;
