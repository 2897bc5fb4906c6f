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
        /// Joined to the ground under the vehicle cell by cell, but across an edge, a slope or a passage that the
        /// vehicle cannot drive over.
        NotDrivable: "not_drivable", NotReached, 0xf4b842;
        /// Not joined to the ground under the vehicle: too high, or behind something that is too high.
        Obstacle: "obstacle", Occupied, 0xc42638;
    }
}

/// Segment of a cell, counted from 0.
pub const SEGMENT: TypedChannel<u16> = TypedChannel { name: "segment", unit: "", scale: 1.0, unknown: u16::MAX };

/// Raw `unit_height` of a cell without points.
pub const UNIT_HEIGHT_UNKNOWN: i8 = i8::MIN;
