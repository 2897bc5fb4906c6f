//! The life of a cell (Seo 2014, figure 4): which state follows from the state it had and what one map's rays tell of
//! it.
//!
//! In: a [`Cell`] and its [`Evidence`] since the last map. Out: the cell as it is published.

use super::class::OccupancyClass::{self, Clear, Occluded, Occupied, OutOfRange, Unknown};

/// Told of a cell: a sensor looks there, over it or through it.
pub const LOOKED_AT: u8 = 1;
/// Told of a cell: low rays of a sensor's newest scan go through it.
pub const THROUGH: u8 = 2;
/// Told of a cell: something hides it from a sensor.
pub const HIDDEN: u8 = 4;

/// What the rays since the last map tell of one cell; the stronger comes later and wins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Evidence {
    /// No sensor has sent anything.
    Silence,
    /// Sensors have, but none looks here.
    Nothing,
    /// Rays went by overhead only.
    Overhead,
    /// Behind something.
    Hidden,
    /// Low rays went through, and none came back from here.
    Through,
    /// The same, but earlier returns from here are not yet outweighed.
    ThroughDoubted,
    /// Returns, with those before fewer than it takes; where the cell is hidden as well, that says more.
    FewHits,
    /// Returns, with those before as many as it takes.
    Hits,
}

/// The strongest of what was told of a cell; `any`: whether any sensor sent anything.
pub fn evidence(told: u8, any: bool) -> Evidence {
    match told {
        told if told & THROUGH != 0 => Evidence::Through,
        told if told & HIDDEN != 0 => Evidence::Hidden,
        told if told & LOOKED_AT != 0 => Evidence::Overhead,
        _ if any => Evidence::Nothing,
        _ => Evidence::Silence,
    }
}

/// What follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// This state, now.
    Go(OccupancyClass),
    /// The state it has, until it has not been confirmed for longer than `hold_maps`; then this one.
    Hold(OccupancyClass),
}

use Next::{Go, Hold};

/// `TRANSITIONS[whether the cell is occupied][evidence]`.
///
/// Figure 4 says that a cell is first unobserved, and then occupied or occluded as sensors look; here every arrow is
/// named. A cell loses its name the moment nobody confirms it; only an occupied one keeps its name for a few maps,
/// because what hides it, or a sensor's pause, does not make it go away.
#[rustfmt::skip]
pub const TRANSITIONS: [[Next; 8]; 2] = [
    // Silence       Nothing             Overhead       Hidden          Through    ThroughDoubted FewHits      Hits
    [Go(Unknown),   Go(OutOfRange),   Go(Unknown),   Go(Occluded),   Go(Clear), Go(Unknown),   Go(Unknown), Go(Occupied)], // any other
    [Hold(Unknown), Hold(OutOfRange), Hold(Unknown), Hold(Occluded), Go(Clear), Go(Unknown),   Go(Unknown), Go(Occupied)], // occupied
];

/// What is kept of a cell from map to map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cell {
    /// The state as published.
    pub state: OccupancyClass,
    /// Returns counted, faded by rays that went through; 255 in an occupied cell that nothing has gone through.
    pub hits: u8,
    /// Maps since a ray came back from here or went through.
    pub age: u8,
}

impl Cell {
    /// The hits as published: 255 in an occupied cell, in an unknown one the power of two they reach (what tells 20
    /// returns from 23 is chance, and would be half of the layer's bytes), 0 in any other.
    pub fn level(self) -> u8 {
        match (self.state, self.hits) {
            (Occupied, hits) => hits,
            (Unknown, hits) if hits > 0 => 1 << hits.ilog2(),
            _ => 0,
        }
    }

    /// The cell one map later: `fresh` returns came from it, and `told` is the strongest of what other rays tell
    /// ([`Evidence::Silence`] to [`Evidence::Through`]). It takes `hits_needed` returns (at least 1) to be occupied.
    #[inline(always)]
    pub fn judged(self, fresh: u8, told: Evidence, hits_needed: u8, hold_maps: u8) -> Self {
        let (mut hits, mut evidence) = (self.hits, told);
        if fresh > 0 {
            // Returns win over rays that went through in the same cycle: something is there, or was a moment ago.
            hits = hits.saturating_add(fresh);
            evidence = match told {
                _ if hits >= hits_needed => Evidence::Hits,
                Evidence::Hidden => Evidence::Hidden,
                _ => Evidence::FewHits,
            };
        } else if told == Evidence::Through {
            // No longer enough at once, so that nothing leaves a trail; not forgotten at once, so that a thin thing
            // that rays miss now and then is never clear.
            hits = (hits >> 2).min(hits_needed - 1);
            evidence = if hits > 0 { Evidence::ThroughDoubted } else { Evidence::Through };
        }
        let age = if fresh > 0 || told == Evidence::Through { 0 } else { self.age.saturating_add(1) };
        let over = age > hold_maps;
        let state = match TRANSITIONS[usize::from(self.state == Occupied)][evidence as usize] {
            Go(state) => state,
            Hold(later) => {
                if over {
                    later
                } else {
                    self.state
                }
            }
        };
        let hits = if evidence == Evidence::Hits {
            u8::MAX
        } else if over {
            0
        } else {
            hits
        };
        Self { state, hits, age }
    }
}
