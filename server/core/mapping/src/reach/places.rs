//! Where the cells of the grid lie: tables that are made once and are the same for every vehicle.
//!
//! Runs of cells have their centres in one polar cell: what is known of the polar cell is copied to 64 bits of the grid
//! at a time.

use std::sync::{Arc, LazyLock};

use crate::ground::polar::{PolarIndex, ROWS, row_middles_m};

use super::cells::{self, SIDE};
use super::directions::Directions;
use super::shadow::Place;

/// The tables.
pub struct CellPlaces {
    /// By cell: the polar cell of its centre.
    pub polar_of_cell: Vec<PolarIndex>,
    pub polar_runs: PolarRuns,
    /// Range of the middle of each polar row, metres.
    pub row_middles_m: [f32; ROWS],
    /// By cell.
    pub of_shadows: Arc<[Place]>,
    pub directions: Directions,
}

/// The places of the reach stage's cells.
pub static PLACES: LazyLock<CellPlaces> = LazyLock::new(|| {
    let centres_m = || (0..SIDE * SIDE).map(cells::centre_m);
    let polar_of_cell: Vec<_> = centres_m().map(|[x, y]| PolarIndex::at(x, y)).collect();
    CellPlaces {
        polar_runs: PolarRuns::new(&polar_of_cell),
        polar_of_cell,
        row_middles_m: row_middles_m(),
        of_shadows: centres_m().map(Place::at).collect(),
        directions: Directions::new(),
    }
});

/// Number of cells of a word of bits.
pub const WORD: usize = 64;

/// Some cells of a word, one after the other, in one polar cell.
#[derive(Clone, Copy, Debug)]
struct Run {
    polar: PolarIndex,
    /// Bit of the first cell.
    first: u8,
    /// Number of cells.
    cells: u8,
}

impl Run {
    #[inline(always)]
    fn bits(self) -> u64 {
        u64::MAX >> (WORD as u8 - self.cells) << self.first
    }
}

/// The runs of each word of a grid. Cells beyond the polar grid are in none.
#[derive(Clone, Debug)]
pub struct PolarRuns {
    runs: Vec<Run>,
    /// Index of the first run of each word, and of the word after the last.
    first_of_word: Vec<u32>,
}

impl PolarRuns {
    /// The runs of a grid whose cells have their centres in these polar cells. A row is a whole number of words.
    pub fn new(polar_of_cell: &[PolarIndex]) -> Self {
        let (mut runs, mut first_of_word) = (Vec::new(), vec![0]);
        for word in polar_of_cell.chunks(WORD) {
            let mut first = 0;
            for of_run in word.chunk_by(|one, next| one == next) {
                let (polar, cells) = (of_run[0], of_run.len() as u8);
                runs.extend(polar.index().map(|_| Run { polar, first, cells }));
                first += cells;
            }
            first_of_word.push(runs.len() as u32);
        }
        Self { runs, first_of_word }
    }

    /// The bits of a word's cells whose polar cell has each of the values below `N`.
    #[inline(always)]
    pub fn bits<const N: usize>(&self, word: usize, of_polar: impl Fn(PolarIndex) -> u8) -> [u64; N] {
        let mut bits = [0; N];
        let runs = self.first_of_word[word] as usize..self.first_of_word[word + 1] as usize;
        for run in &self.runs[runs] {
            bits[usize::from(of_polar(run.polar))] |= run.bits();
        }
        bits
    }
}

#[cfg(test)]
mod tests {
    use super::super::cells::centre_m;
    use super::*;
    use crate::ground::polar::CELLS;

    #[test]
    fn each_cell_has_the_bit_of_the_value_of_its_polar_cell() {
        let polar: Vec<_> = (0..SIDE * SIDE).map(centre_m).map(|[x, y]| PolarIndex::at(x, y)).collect();
        let values: Vec<u8> = (0..CELLS as u32).map(|cell| (cell.wrapping_mul(2_654_435_761) >> 30) as u8).collect();
        let runs = PolarRuns::new(&polar);
        for (word, cells) in polar.chunks(WORD).enumerate() {
            let bits: [u64; 4] = runs.bits(word, |polar| *polar.of(&values).unwrap());
            for (bit, polar) in cells.iter().enumerate() {
                let value = polar.of(&values).map(|value| usize::from(*value));
                let with_bit: Vec<usize> = (0..4).filter(|value| bits[*value] >> bit & 1 != 0).collect();
                assert_eq!(with_bit, Vec::from_iter(value));
            }
        }
    }
}
