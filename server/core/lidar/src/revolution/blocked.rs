//! The blocked part of a sensor's view: sectors and lasers without returns.

/// The part of a sensor's view that is blocked, for example by dirt on its window.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Blocked {
    /// Sectors from which no laser receives returns.
    pub sectors: Vec<BlockedSector>,
    /// Lasers without any returns, as indices in firing order.
    pub lasers: Vec<u16>,
}

/// A sector of directions, in whole degrees clockwise from the sensor's x axis seen from above. A direction is the
/// encoder angle less the azimuth offset of the laser. A sector may extend over 360 degrees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockedSector {
    /// First degree of the sector, in `0..360`.
    pub from_deg: u16,
    /// Degree behind the last one of the sector, in `from_deg + 1..=from_deg + 360`.
    pub to_deg: u16,
}

impl Blocked {
    /// True if nothing is blocked.
    pub fn is_empty(&self) -> bool {
        self.sectors.is_empty() && self.lasers.is_empty()
    }

    /// True if an object may be invisible to `laser` at `azimuth_rad` (its encoder angle less its azimuth offset). Each
    /// sector is one degree wider on both sides.
    pub fn hides(&self, laser: usize, azimuth_rad: f32) -> bool {
        let azimuth_deg = azimuth_rad.to_degrees();
        let inside = |sector: &BlockedSector| {
            (azimuth_deg - f32::from(sector.from_deg) + 1.0).rem_euclid(360.0)
                <= f32::from(sector.to_deg - sector.from_deg) + 2.0
        };
        self.lasers.iter().any(|hidden| usize::from(*hidden) == laser) || self.sectors.iter().any(inside)
    }
}
