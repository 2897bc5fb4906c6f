//! Classes and channels of the layer `terrain`.

use crate::layer::channel::TypedChannel;
use crate::layer::class::classes;

classes! {
    /// Classes of the layer `terrain`.
    pub enum TerrainClass {
        /// No point fell into the cell, or too few to judge it, and it lies in no flat region.
        Unknown,
        /// Points fell into the cell, and it is part of flat ground.
        Flat: "flat", Free, 0x1c9e96;
        /// No point fell into the cell; the flat region around it covers it.
        FlatInferred: "flat_inferred", Inferred, 0x166e6a;
        /// Flat, but higher than a step over the local ground: a car's roof, a wall's top.
        FlatElevated: "flat_elevated", Occupied, 0xf4b842;
        /// Not flat.
        Obstacle: "obstacle", Occupied, 0xc42638;
        /// Flat ground, but no passage wide enough for the vehicle leads there.
        FlatUnreachable: "flat_unreachable", NotReached, 0xaa803c;
    }
}

/// Shape of a cell's points, as [`Shape`].
pub const SHAPE: TypedChannel<u8> =
    TypedChannel { name: "shape", unit: "id", scale: 1.0, unknown: Shape::Unknown as u8 };

/// Square root of the paper's roughness: one raw unit is a fifth of a millimetre of range deviation per metre of
/// distance. Unknown in a cell that is not flat, or has too few points with a distance series.
pub const ROUGHNESS: TypedChannel<u8> = TypedChannel { name: "roughness", unit: "m/m", scale: 2e-4, unknown: u8::MAX };

/// Plane of a cell's flat region: height at the cell's centre, then rise over run along x and along y.
pub const PLANE: [TypedChannel<i8>; 3] = [
    TypedChannel { name: "height", unit: "m", scale: 0.05, unknown: i8::MIN },
    TypedChannel { name: "slope_x", unit: "", scale: 0.02, unknown: i8::MIN },
    TypedChannel { name: "slope_y", unit: "", scale: 0.02, unknown: i8::MIN },
];

/// Raw values of the channel `shape` (Neuhaus 2009, figure 1).
#[repr(u8)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shape {
    /// The cell was not judged.
    #[default]
    Unknown,
    /// The points have no main direction.
    Scatter,
    /// The points lie along a line.
    Line,
    /// The points lie in a plane.
    Plane,
}
