//! Classes and channels of the layer `speed`.

use crate::layer::class::classes;

classes! {
    /// Classes of the layer `speed`.
    pub enum SpeedClass {
        /// No point fell into the cell.
        Unknown,
        /// Seen, and even enough to drive over at the cell's speed.
        Passable: "passable", Free, 0x1c9e96;
        /// A step or an object: the speed is 0.
        Obstacle: "obstacle", Occupied, 0xc42638;
        /// Passable, and on the painted road.
        Road: "road", Free, 0x78bef0;
        /// Even enough to drive over, but no passage wide enough for the vehicle leads there.
        NotReached: "not_reached", NotReached, 0xaa803c;
    }
}

/// Speed of one raw unit of the channel `speed`, metres per second. Ours: a planner chooses no finer, and neighbouring
/// cells stay equal, so that the codec writes few runs.
pub const SPEED_SCALE_MPS: f32 = 0.25;
