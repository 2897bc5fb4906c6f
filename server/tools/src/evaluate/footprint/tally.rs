//! Counts of the answers of one layer for whole footprints, which can be summed over frames.

use std::collections::BTreeMap;

use super::super::tally::CellCount;

/// Bounds of the bands of range of a footprint's middle, in metres.
pub const BANDS_M: [f64; 6] = [4.0, 8.0, 12.0, 15.0, 20.0, 30.0];
/// Number of bands.
pub const BANDS: usize = BANDS_M.len() - 1;
/// Least heights of the things that a footprint holds, by kind, in metres.
pub const HELD_M: [f32; 3] = [0.2, 0.3, 0.5];
/// Range up to which a thing of the second kind must be seen, in metres; one of the third kind must be seen everywhere.
const SEEN_M: f64 = 20.0;
/// Number of wrong footprints that are listed.
const LISTED: usize = 20;

/// Counts by band of range.
pub type Bands = [CellCount; BANDS];

/// A footprint called free in which something stands.
#[derive(Clone, Debug, PartialEq)]
pub struct WrongFootprint {
    /// Middle: distance forward, in metres.
    pub x_m: f64,
    /// Middle: distance to the left, in metres.
    pub y_m: f64,
    /// Heading in degrees, counter-clockwise from forward.
    pub heading_deg: f64,
    /// Class of the highest thing in it.
    pub class: &'static str,
    /// Height of that thing, in metres.
    pub height_m: f32,
}

/// Counts of whole footprints of one layer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FootprintTally {
    /// Free footprints on one level, and how many are answered free, by band.
    pub level: Bands,
    /// The same of free footprints across a kerb or another step.
    pub stepped: Bands,
    /// Footprints whose highest thing is of a kind of [`HELD_M`], and how many are answered free, by kind and band.
    pub holding: [Bands; HELD_M.len()],
    /// Footprints over ground that cannot be reached, with nothing in them, and how many are answered free, by band.
    pub unreachable: Bands,
    /// Free footprints that are not answered free, by the class of the cell that forbids it.
    pub refused: BTreeMap<String, u64>,
    /// The first wrong footprints.
    pub wrong: Vec<WrongFootprint>,
}

impl FootprintTally {
    /// Lists a wrong footprint, if the list is not full.
    pub fn add_wrong(&mut self, wrong: WrongFootprint) {
        if self.wrong.len() < LISTED {
            self.wrong.push(wrong);
        }
    }

    /// Free footprints on one level, and how many are answered free, in a range whose ends are bounds of bands.
    pub fn level_within(&self, from_m: f64, to_m: f64) -> CellCount {
        within(&self.level, from_m, to_m)
    }

    /// Footprints answered free though they hold something that must be seen: 0.5 m anywhere, 0.3 m up to 20 m.
    pub fn grave(&self) -> u64 {
        let [_, low, high] = &self.holding;
        within(low, BANDS_M[0], SEEN_M).of_them + within(high, BANDS_M[0], BANDS_M[BANDS]).of_them
    }

    /// Adds the counts of other frames.
    pub fn merge(&mut self, other: &Self) {
        let own = self.holding.iter_mut().chain([&mut self.level, &mut self.stepped, &mut self.unreachable]);
        let others = other.holding.iter().chain([&other.level, &other.stepped, &other.unreachable]);
        for (own, other) in own.zip(others) {
            own.iter_mut().zip(other).for_each(|(own, other)| own.merge(other));
        }
        for (class, footprints) in &other.refused {
            *self.refused.entry(class.clone()).or_default() += footprints;
        }
        other.wrong.iter().for_each(|wrong| self.add_wrong(wrong.clone()));
    }
}

/// Sum of the bands of a range.
pub fn within(bands: &Bands, from_m: f64, to_m: f64) -> CellCount {
    let mut sum = CellCount::default();
    for (band, count) in bands.iter().enumerate() {
        if BANDS_M[band] >= from_m && BANDS_M[band + 1] <= to_m {
            sum.merge(count);
        }
    }
    sum
}

/// The band of a range in metres; `None` outside all.
pub fn band(range_m: f64) -> Option<usize> {
    let above = BANDS_M.partition_point(|bound| *bound <= range_m);
    above.checked_sub(1).filter(|band| *band < BANDS)
}
