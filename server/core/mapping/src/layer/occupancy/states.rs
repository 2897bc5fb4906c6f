//! State transitions of a cell (Seo 2014, figure 4): the next state follows from the last state and the evidence since
//! the last map.
//!
//! In: a [`Cell`] and its [`Evidence`]. Out: the cell as it is published.

use super::class::OccupancyClass::{self, Clear, Occluded, Occupied, OutOfRange, Unknown};
use super::config::Hits;

/// Evidence bit of a cell: rays of a sensor pass over it or through it.
pub const LOOKED_AT: u8 = 1;
/// Evidence bit of a cell: low rays of a sensor's newest scan pass through it.
pub const THROUGH: u8 = 2;
/// Evidence bit of a cell: something hides it from a sensor.
pub const HIDDEN: u8 = 4;

/// Evidence about one cell since the last map, weakest first; the strongest counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// No sensor sent a scan.
    Silence,
    /// Sensors sent scans, but no ray passes here.
    Nothing,
    /// Rays passed only overhead.
    Overhead,
    /// Something nearer to the sensor hides the cell.
    Hidden,
    /// Low rays passed through, and no return came from here.
    Through,
    /// The same, but earlier returns from here still count.
    ThroughDoubted,
    /// Some hits, but fewer than the threshold; occlusion takes precedence.
    FewHits,
    /// As many hits as the threshold, together with earlier ones.
    Hits,
}

/// The strongest evidence in a cell's bits; `any` is true if any sensor sent a scan.
pub fn evidence(bits: u8, any: bool) -> Evidence {
    match bits {
        bits if bits & THROUGH != 0 => Evidence::Through,
        bits if bits & HIDDEN != 0 => Evidence::Hidden,
        bits if bits & LOOKED_AT != 0 => Evidence::Overhead,
        _ if any => Evidence::Nothing,
        _ => Evidence::Silence,
    }
}

/// Next state of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// This state, immediately.
    Go(OccupancyClass),
    /// The last state, until no evidence has confirmed it for more than `hold_maps` maps; then this state.
    Hold(OccupancyClass),
}

use Next::{Go, Hold};

/// Next state by last state and evidence: `TRANSITIONS[last state is occupied][evidence]`.
///
/// Figure 4 of the paper shows that a cell is first unobserved, and then occupied or occluded; this table defines each
/// transition. A cell loses its state as soon as no evidence confirms it. Only an occupied cell keeps its state for a
/// few maps, because an occlusion or a pause of a sensor does not remove the object.
#[rustfmt::skip]
pub const TRANSITIONS: [[Next; 8]; 2] = [
    // not occupied
    [Go(Unknown), Go(OutOfRange), Go(Unknown), Go(Occluded), Go(Clear), Go(Unknown), Go(Unknown), Go(Occupied)],
    // occupied
    [Hold(Unknown), Hold(OutOfRange), Hold(Unknown), Hold(Occluded), Go(Clear), Go(Unknown), Go(Unknown), Go(Occupied)],
];

/// State of a cell from map to map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cell {
    /// The state as published.
    pub state: OccupancyClass,
    /// Number of returns, reduced by rays that pass through; 255 in an occupied cell without such rays.
    pub hits: u8,
    /// Number of maps since a ray returned from here or passed through.
    pub age: u8,
}

impl Cell {
    /// The hits as published. Reduced, because the difference between 20 and 23 returns is chance, and would be half of
    /// the layer's bytes; or counted (Seo 2014, section 2).
    pub fn level(self, published: Hits) -> u8 {
        match (published, self.state, self.hits) {
            (_, Occupied, hits) => hits,
            (Hits::Reduced, Unknown, hits) if hits > 0 => 1 << hits.ilog2(),
            (Hits::Reduced, ..) => 0,
            (Hits::Counted, _, hits) => hits.min(u8::MAX - 1),
        }
    }

    /// The cell one map later. `fresh` returns came from it, and `rays` is the strongest evidence of other rays
    /// ([`Evidence::Silence`] to [`Evidence::Through`]). `hits_needed` returns (at least 1) make a cell occupied.
    #[inline(always)]
    pub fn next(self, fresh: u8, rays: Evidence, hits_needed: u8, hold_maps: u8) -> Self {
        let (mut hits, mut evidence) = (self.hits, rays);
        if fresh > 0 {
            // Returns take precedence over rays that passed through since the same map: an object is there, or was
            // there a moment ago.
            hits = hits.saturating_add(fresh);
            evidence = match rays {
                _ if hits >= hits_needed => Evidence::Hits,
                Evidence::Hidden => Evidence::Hidden,
                _ => Evidence::FewHits,
            };
        } else if rays == Evidence::Through {
            // The cell is no longer occupied at once, so that no object leaves a trail. The hits fade step by step, so
            // that a thin object that rays sometimes miss does not become clear.
            // Without a hold nothing of earlier maps counts.
            hits = if hold_maps > 0 { (hits >> 2).min(hits_needed - 1) } else { 0 };
            evidence = if hits > 0 { Evidence::ThroughDoubted } else { Evidence::Through };
        }
        let age = if fresh > 0 || rays == Evidence::Through { 0 } else { self.age.saturating_add(1) };
        let expired = age > hold_maps;
        let state = match TRANSITIONS[usize::from(self.state == Occupied)][evidence as usize] {
            Go(state) => state,
            Hold(later) => {
                if expired {
                    later
                } else {
                    self.state
                }
            }
        };
        let hits = if evidence == Evidence::Hits {
            u8::MAX
        } else if expired {
            0
        } else {
            hits
        };
        Self { state, hits, age }
    }
}
