//! Classes and channels of the layer `freespace`.

use crate::layer::channel::TypedChannel;
use crate::layer::class::classes;

classes! {
    /// Classes of the layer `freespace`.
    pub enum FreespaceClass {
        /// No return says what is there.
        Unknown,
        /// Ground that the vehicle gets to: seen, or in a gap of seen ground which no obstacle hides.
        Free: "free", Free, 0x1c9e96;
        /// The vehicle itself stands there.
        Vehicle: "vehicle", Free, 0xfafaf0;
        /// An obstacle stands there, or the ground rises by a step.
        Occupied: "occupied", Occupied, 0xc42638;
        /// Something stands there that is higher than the vehicle's ground clearance and lower than an obstacle.
        Low: "low", Low, 0xf4b842;
        /// The ground drops: a ditch, a trench, an edge.
        Drop: "drop", Occupied, 0xd070d8;
        /// Something nearer to the sensor hides the ground.
        Hidden: "hidden", Hidden, 0x5c5c80;
        /// Ground, but the vehicle does not fit through to it.
        NotReached: "not_reached", NotReached, 0xaa803c;
    }
}

/// Height of the cell's highest return over the ground, overhangs aside.
pub const HEIGHT: TypedChannel<i8> = TypedChannel { name: "height", unit: "m", scale: 0.05, unknown: i8::MIN };

/// Why the cell has its class: a [`Reason`].
pub const WHY: TypedChannel<u8> = TypedChannel { name: "why", unit: "id", scale: 1.0, unknown: 0 };

/// Values of the channel `why`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reason {
    /// No return was seen there, nor ground around it.
    NotSeen = 0,
    /// A return of this map shows the ground.
    Seen = 1,
    /// No return fell into it; it lies in a gap of seen ground.
    Bridged = 2,
    /// A return of an earlier map shows the ground.
    Remembered = 3,
    /// The ground rises or falls by a step.
    Step = 4,
    /// Something stands there.
    Obstacle = 5,
    /// Something hangs there, too low to pass under.
    Overhang = 6,
    /// A ditch, a trench or an edge down.
    Ditch = 7,
    /// The vehicle does not fit through to it.
    TooNarrow = 8,
}
