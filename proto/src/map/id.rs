//! Identity of a map.

use crate::v1;

/// Identifies one map among all maps of all vehicles and runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MapId {
    /// Name of the vehicle, `Header.vehicle`.
    pub vehicle: String,
    /// Run of the server that made the map, `Header.boot_id`.
    pub boot_id: u64,
    /// Number of the map in this run, `Header.sequence`.
    pub sequence: u64,
}

impl MapId {
    /// Identity of the map with this header.
    pub fn of(header: &v1::Header) -> Self {
        Self { vehicle: header.vehicle.clone(), boot_id: header.boot_id, sequence: header.sequence }
    }
}

impl std::fmt::Display for MapId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "map {} of {:?}, boot id {:016x}", self.sequence, self.vehicle, self.boot_id)
    }
}
