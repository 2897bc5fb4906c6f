//! Squares of bits, one for each cell of a grid.
//!
//! A row of the grid is a row of words: dilating cells by a disc, and spreading them over open cells, take 64 cells at
//! a time.

use std::ops::Range;

/// A square of bits, one for each cell.
#[derive(Clone, Debug)]
pub struct Bits {
    width: usize,
    /// Number of words in a row.
    stride: usize,
    pub(super) words: Vec<u64>,
}

impl Bits {
    /// `width` × `width` bits that are not set.
    pub fn square(width: usize) -> Self {
        let stride = width.div_ceil(64);
        Self { width, stride, words: vec![0; stride * width] }
    }

    /// Clears all bits.
    pub fn clear(&mut self) {
        self.words.fill(0);
    }

    /// Sets the bits of the cells for which `is_set` is true, and clears the others.
    #[cfg(test)]
    pub fn fill(&mut self, is_set: impl Fn(usize) -> bool) {
        self.fill_words(|cells| (0..).zip(cells).fold(0, |word, (bit, cell)| word | u64::from(is_set(cell)) << bit));
    }

    /// Replaces each word by the word of `word_of`, which gets the cells of its bits, the lowest first.
    pub fn fill_words(&mut self, mut word_of: impl FnMut(Range<usize>) -> u64) {
        for (at, word) in self.words.iter_mut().enumerate() {
            let (first, iy) = (at % self.stride * 64, at / self.stride);
            let from = iy * self.width + first;
            *word = word_of(from..from + (self.width - first).min(64));
        }
    }

    /// Index of the word with the bit of a cell, and the bit.
    pub fn place(&self, ix: usize, iy: usize) -> (u32, u64) {
        ((iy * self.stride + ix / 64) as u32, 1 << (ix % 64))
    }

    /// Sets the bit of a cell.
    #[inline(always)]
    pub fn set(&mut self, ix: usize, iy: usize) {
        self.words[iy * self.stride + ix / 64] |= 1 << (ix % 64);
    }

    /// The bit of a cell.
    #[inline(always)]
    pub fn get(&self, ix: usize, iy: usize) -> bool {
        self.words[iy * self.stride + ix / 64] >> (ix % 64) & 1 != 0
    }

    /// Replaces the bits by the bits of an equally large square.
    pub fn copy_from(&mut self, other: &Self) {
        self.words.copy_from_slice(&other.words);
    }

    /// Sets the bits that are set in an equally large square.
    pub fn add(&mut self, other: &Self) {
        self.words.iter_mut().zip(&other.words).for_each(|(word, other)| *word |= other);
    }

    /// Clears the bit of a cell.
    pub fn clear_cell(&mut self, ix: usize, iy: usize) {
        self.words[iy * self.stride + ix / 64] &= !(1 << (ix % 64));
    }

    /// Replaces each bit by its complement.
    pub fn invert(&mut self) {
        self.words.iter_mut().for_each(|word| *word = !*word);
    }

    /// Clears the bits that are set in an equally large square.
    pub fn remove(&mut self, other: &Self) {
        self.words.iter_mut().zip(&other.words).for_each(|(word, other)| *word &= !other);
    }

    /// Clears the bits that are not set in an equally large square.
    pub fn keep(&mut self, other: &Self) {
        self.words.iter_mut().zip(&other.words).for_each(|(word, other)| *word &= other);
    }

    /// The words, row by row.
    pub fn words(&self) -> &[u64] {
        &self.words
    }

    /// Replaces a word.
    pub fn set_word(&mut self, at: usize, word: u64) {
        self.words[at] = word;
    }

    /// Calls `each` with each cell whose bit is set, row by row.
    pub fn each(&self, each: impl FnMut(usize, usize)) {
        self.each_in(0..self.words.len() / self.stride, each);
    }

    /// The same for the cells of some rows.
    pub fn each_in(&self, rows: Range<usize>, mut each: impl FnMut(usize, usize)) {
        let words = rows.start * self.stride..rows.end * self.stride;
        for (at, word) in words.clone().zip(&self.words[words]) {
            let mut rest = *word;
            while rest != 0 {
                each(at % self.stride * 64 + rest.trailing_zeros() as usize, at / self.stride);
                rest &= rest - 1;
            }
        }
    }

    /// Adds each cell within `radius` of a cell of `from`. Bits beyond the last column may be set; they are no cells.
    /// `wide` is a buffer.
    pub fn dilate(&mut self, from: &Self, radius: usize, wide: &mut Vec<u64>) {
        let rows = from.words.len() / from.stride;
        let half_width = |dy: usize| (radius * radius - dy * dy).isqrt();
        wide.resize(from.stride, 0);
        for (iy, row) in from.words.chunks_exact(from.stride).enumerate() {
            if row.iter().all(|word| *word == 0) {
                continue;
            }
            wide.copy_from_slice(row);
            for reach in 0..=radius {
                for dy in (0..=radius).filter(|dy| half_width(*dy) == reach) {
                    for other in [iy.checked_sub(dy), Some(iy + dy)].into_iter().flatten().filter(|other| *other < rows)
                    {
                        let row = &mut self.words[other * from.stride..][..from.stride];
                        row.iter_mut().zip(&*wide).for_each(|(word, wide)| *word |= wide);
                    }
                }
                dilate_by_one(wide);
            }
        }
    }

    /// Replaces the bits by the cells of `from` and the eight around each. `wide` is a buffer.
    pub fn grow(&mut self, from: &Self, wide: &mut Vec<u64>) {
        self.clear();
        wide.resize(from.stride, 0);
        for (iy, row) in from.words.chunks_exact(from.stride).enumerate() {
            wide.copy_from_slice(row);
            dilate_by_one(wide);
            let to = iy.saturating_sub(1) * from.stride..((iy + 2) * from.stride).min(from.words.len());
            for row in self.words[to].chunks_exact_mut(from.stride) {
                row.iter_mut().zip(&*wide).for_each(|(word, wide)| *word |= wide);
            }
        }
    }

    /// Spreads set bits to neighbours along sides of cells as long as they are set in `open`. `down` and `up` are
    /// buffers.
    pub fn flood(&mut self, open: &Self, [down, up]: &mut [Vec<bool>; 2]) {
        let rows = open.words.len() / open.stride;
        self.words.iter_mut().zip(&open.words).for_each(|(word, open)| *word = fill(*word, *open));
        // Rows that have grown since they were last spread down, and up.
        for grown in [&mut *down, &mut *up] {
            grown.clear();
            grown.resize(rows, true);
        }
        loop {
            let mut grown = false;
            // Down and up; a path that turns back needs another round.
            for iy in 1..rows {
                if std::mem::take(&mut down[iy - 1]) && self.spread(open, iy, iy - 1) {
                    (grown, down[iy], up[iy]) = (true, true, true);
                }
            }
            for iy in (0..rows - 1).rev() {
                if std::mem::take(&mut up[iy + 1]) && self.spread(open, iy, iy + 1) {
                    (grown, down[iy], up[iy]) = (true, true, true);
                }
            }
            if !grown {
                break;
            }
        }
    }

    /// Spreads bits from one row to the next, and along it; returns true if a bit was added. All bits that a word's own
    /// bits spread to are always set, so that a word without new bits stays unchanged.
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

    /// Adds bits to a word, and the bits they spread to; returns true if a bit was added.
    fn gain(&mut self, open: &Self, at: usize, bits: u64) -> bool {
        let bits = self.words[at] | bits & open.words[at];
        let grown = bits != self.words[at];
        if grown {
            self.words[at] = fill(bits, open.words[at]);
        }
        grown
    }
}

/// Spreads set bits in both directions as long as they are set in `open`.
fn fill(bits: u64, open: u64) -> u64 {
    match bits {
        0 => 0,
        _ => fill_up(bits, open) | fill_up(bits.reverse_bits(), open.reverse_bits()).reverse_bits(),
    }
}

/// Spreads set bits towards higher bits as long as they are set in `open`.
fn fill_up(mut bits: u64, mut open: u64) -> u64 {
    for step in [1, 2, 4, 8, 16, 32] {
        bits |= open & (bits << step);
        open &= open << step;
    }
    bits
}

/// Adds the neighbours of each set bit of a row.
fn dilate_by_one(row: &mut [u64]) {
    let mut before = 0;
    for word in 0..row.len() {
        let here = row[word];
        let after = row.get(word + 1).map_or(0, |next| next << 63);
        row[word] = here | here << 1 | here >> 1 | before >> 63 | after;
        before = here;
    }
}
