//! Beyond the paper: which ground the vehicle gets to.
//!
//! In: by cell of the square grid whether it may be driven over and whether something stands in it. Out: by cell
//! whether the vehicle gets there, from the middle of the grid on, as a disc that nothing may stand in. Ground behind a
//! closed fence is as flat as the road, and joins it where the sensor looks between two slats; no vehicle fits through
//! there.
//!
//! A row of the grid is a row of bits: widening what stands by the disc, and the flood, take 64 cells at a time.

/// What a cell is to a vehicle that wants to drive over it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Passage {
    /// Nothing is known that speaks for it.
    #[default]
    None,
    /// Ground, or a gap in it.
    Open,
    /// Something stands there.
    Closed,
}

/// Flood from the middle of a square grid, reusing its buffers.
#[derive(Clone, Debug, Default)]
pub struct Reach {
    open: Bits,
    closed: Bits,
    widened: Bits,
    reached: Bits,
}

impl Reach {
    /// Floods a grid of `width` × `width` cells, `cell(ix, iy)` telling what each is, with a disc of `radius` cells
    /// about its middle one.
    pub fn find(&mut self, width: usize, radius: usize, cell: impl Fn(usize, usize) -> Passage) {
        for bits in [&mut self.open, &mut self.closed, &mut self.widened, &mut self.reached] {
            bits.clear(width);
        }
        let stride = self.open.stride;
        for (at, (open, closed)) in self.open.words.iter_mut().zip(&mut self.closed.words).enumerate() {
            let (first, iy) = (at % stride * 64, at / stride);
            for bit in 0..(width - first).min(64) {
                let passage = cell(first + bit, iy);
                *open |= u64::from(passage == Passage::Open) << bit;
                *closed |= u64::from(passage == Passage::Closed) << bit;
            }
        }
        self.widened.widen(&self.closed, radius);
        self.open.words.iter_mut().zip(&self.widened.words).for_each(|(open, closed)| *open &= !closed);
        // The vehicle stands between the four cells of the middle.
        for (ix, iy) in [width / 2 - 1, width / 2].into_iter().flat_map(|iy| [(width / 2 - 1, iy), (width / 2, iy)]) {
            self.reached.set(ix, iy);
        }
        self.reached.words.iter_mut().zip(&self.open.words).for_each(|(reached, open)| *reached &= open);
        self.reached.flood(&self.open);
        self.widened.clear(width);
        self.widened.widen(&self.reached, radius);
    }

    /// Whether the vehicle gets there: whether the cell lies under the disc somewhere on its ways.
    pub fn reached(&self, ix: usize, iy: usize) -> bool {
        self.widened.get(ix, iy)
    }
}

/// A square of bits.
#[derive(Clone, Debug, Default)]
struct Bits {
    /// Words a row.
    stride: usize,
    words: Vec<u64>,
}

impl Bits {
    fn clear(&mut self, width: usize) {
        self.stride = width.div_ceil(64);
        self.words.clear();
        self.words.resize(self.stride * width, 0);
    }

    fn set(&mut self, ix: usize, iy: usize) {
        self.words[iy * self.stride + ix / 64] |= 1 << (ix % 64);
    }

    fn get(&self, ix: usize, iy: usize) -> bool {
        self.words[iy * self.stride + ix / 64] >> (ix % 64) & 1 != 0
    }

    /// Adds every place within `radius` of one of `from`. Beyond the last column bits may be set; no cell lies there.
    fn widen(&mut self, from: &Self, radius: usize) {
        let rows = from.words.len() / from.stride;
        let half_width = |dy: usize| (radius * radius - dy * dy).isqrt();
        let mut wide = vec![0; from.stride];
        for (iy, row) in from.words.chunks_exact(from.stride).enumerate() {
            if row.iter().all(|word| *word == 0) {
                continue;
            }
            wide.copy_from_slice(row);
            for reach in 0..=radius {
                for dy in (0..=radius).filter(|dy| half_width(*dy) == reach) {
                    for there in [iy.checked_sub(dy), Some(iy + dy)].into_iter().flatten().filter(|there| *there < rows)
                    {
                        let row = &mut self.words[there * from.stride..][..from.stride];
                        row.iter_mut().zip(&wide).for_each(|(word, wide)| *word |= wide);
                    }
                }
                widen_by_one(&mut wide);
            }
        }
    }

    /// Spreads over sides of cells wherever `open` allows.
    fn flood(&mut self, open: &Self) {
        let rows = open.words.len() / open.stride;
        self.words.iter_mut().zip(&open.words).for_each(|(word, open)| *word = fill(*word, *open));
        loop {
            let mut grown = false;
            // Down and up; a flood that turns back takes another round.
            for (iy, from) in (1..rows).map(|iy| (iy, iy - 1)).chain((1..rows).rev().map(|iy| (iy - 1, iy))) {
                grown |= self.spread(open, iy, from);
            }
            if !grown {
                break;
            }
        }
    }

    /// From one row to the next, and along it; whether it grew. A word holds all that its own bits spread to, before
    /// and after, so one that gains nothing is left alone.
    fn spread(&mut self, open: &Self, iy: usize, from: usize) -> bool {
        let mut grown = false;
        let (row, from) = (iy * self.stride, from * self.stride);
        let mut carry = 0;
        for word in 0..self.stride {
            grown |= self.gain(open, row + word, self.words[from + word] | carry);
            carry = self.words[row + word] >> 63;
        }
        carry = 0;
        for word in (0..self.stride).rev() {
            grown |= self.gain(open, row + word, carry);
            carry = self.words[row + word] << 63;
        }
        grown
    }

    /// Adds bits to a word, and what they spread to; whether it grew.
    fn gain(&mut self, open: &Self, at: usize, bits: u64) -> bool {
        let bits = self.words[at] | bits & open.words[at];
        let grown = bits != self.words[at];
        if grown {
            self.words[at] = fill(bits, open.words[at]);
        }
        grown
    }
}

/// Spreads set bits both ways as long as `open` has them.
fn fill(bits: u64, open: u64) -> u64 {
    match bits {
        0 => 0,
        _ => fill_up(bits, open) | fill_up(bits.reverse_bits(), open.reverse_bits()).reverse_bits(),
    }
}

/// Spreads set bits towards higher ones as long as `open` has them.
fn fill_up(mut bits: u64, mut open: u64) -> u64 {
    for step in [1, 2, 4, 8, 16, 32] {
        bits |= open & (bits << step);
        open &= open << step;
    }
    bits
}

fn widen_by_one(row: &mut [u64]) {
    let mut before = 0;
    for word in 0..row.len() {
        let here = row[word];
        let after = row.get(word + 1).map_or(0, |next| next << 63);
        row[word] = here | here << 1 | here >> 1 | before >> 63 | after;
        before = here;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By a picture: `.` open, `#` closed, blank nothing; gives it with `o` where the vehicle gets.
    fn flooded(picture: &[&str], radius: usize) -> Vec<String> {
        let passage = |c: char| match c {
            '.' => Passage::Open,
            '#' => Passage::Closed,
            _ => Passage::None,
        };
        let mut reach = Reach::default();
        reach.find(picture.len(), radius, |ix, iy| passage(picture[iy].as_bytes()[ix].into()));
        let drawn = |(iy, row): (usize, &&str)| {
            let cell = |(ix, c): (usize, char)| if c == '.' && reach.reached(ix, iy) { 'o' } else { c };
            row.chars().enumerate().map(cell).collect()
        };
        picture.iter().enumerate().map(drawn).collect()
    }

    #[test]
    fn a_disc_passes_a_gap_as_wide_as_itself_and_no_narrower_one() {
        let court = [
            "...........", //
            "...........",
            "...........",
            "....###....",
            "....# #....",
            "...........",
            "...........",
            "####...####",
            "...........",
            "...........",
            "...........",
        ];
        let everywhere: Vec<String> = court.iter().map(|row| row.replace('.', "o")).collect();
        assert_eq!(flooded(&court, 0), everywhere);
        assert_eq!(flooded(&court, 1)[8..], everywhere[8..]);
        let narrower: Vec<String> = court.iter().map(|row| row.replace("####...####", "####..#####")).collect();
        let narrower: Vec<&str> = narrower.iter().map(String::as_str).collect();
        assert_eq!(flooded(&narrower, 1)[8..], court[8..]);
        assert_eq!(flooded(&narrower, 0)[8..], everywhere[8..]);
    }

    #[test]
    fn a_flood_finds_its_way_through_a_maze_wider_than_a_word() {
        let width = 200;
        // Walls on every fourth row, each with one gap, at alternating ends.
        let wall = |iy: usize| iy % 4 == 3;
        let gap = |iy: usize| if iy % 8 == 3 { width - 1 } else { 0 };
        let passage = |cell: usize| {
            let (ix, iy) = (cell % width, cell / width);
            if wall(iy) && ix != gap(iy) { Passage::Closed } else { Passage::Open }
        };
        let mut reach = Reach::default();
        reach.find(width, 0, |ix, iy| passage(iy * width + ix));
        assert!(
            (0..width * width)
                .all(|cell| reach.reached(cell % width, cell / width) == (passage(cell) == Passage::Open))
        );
    }
}
