//! Classes of the layer `safe_path`.

use crate::layer::class::classes;

classes! {
    /// Classes of the layer `safe_path`.
    pub enum SafePathClass {
        /// Nothing is known of the cell.
        Unknown,
        /// Drivable in the layer `drivability`.
        Free: "free", Free, 0x166e6a;
        /// Seen, and not drivable.
        Obstacle: "obstacle", Occupied, 0xc42638;
        /// Drivable, and a safe point that the vehicle can reach lies in the cell.
        Path: "path", Free, 0xfafaf0;
        /// Free ground, but no passage wide enough for the vehicle leads there.
        NotReached: "not_reached", NotReached, 0xaa803c;
    }
}
