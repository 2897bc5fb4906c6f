//! Classes and channels of the layer `freespace`.

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
