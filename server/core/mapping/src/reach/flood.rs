//! Flood fill of a square grid with a disc.
//!
//! In: by cell whether it is open, and whether it is closed. Out: by cell whether the disc can get there, starting in
//! the middle of the grid, without a closed cell in it.

use super::bits::Bits;

/// Flood fill from the middle of a square grid. It reuses its buffers.
#[derive(Clone, Debug)]
pub struct Flood {
    width: usize,
    passable: Bits,
    /// Passable cells of one stage.
    near: Bits,
    reached: Bits,
    covered: Bits,
    /// One row, as wide as the disc makes it so far; a buffer.
    wide: Vec<u64>,
    /// Buffers of [`Bits::flood`].
    grown: [Vec<bool>; 2],
}

impl Flood {
    /// A flood fill of `width` × `width` cells.
    pub fn new(width: usize) -> Self {
        let bits = Bits::square(width);
        Self {
            width,
            passable: bits.clone(),
            near: bits.clone(),
            reached: bits.clone(),
            covered: bits,
            wide: Vec::new(),
            grown: Default::default(),
        }
    }

    /// Floods the grid with a disc whose radius is `radius` cells around its middle cell. The middle of the disc moves
    /// over open cells. `stages` are sets of cells, each within the next: a cell is reached only over cells of the
    /// first set that contains it.
    pub fn run(&mut self, open: &Bits, closed: &Bits, radius: usize, stages: &[Bits]) {
        let Self { width, passable, near, reached, covered, wide, grown } = self;
        passable.clear();
        passable.dilate(closed, radius, wide);
        passable.words.iter_mut().zip(&open.words).for_each(|(passable, open)| *passable = open & !*passable);
        reached.clear();
        // The vehicle stands between the four middle cells.
        for (ix, iy) in [*width / 2 - 1, *width / 2].into_iter().flat_map(|iy| [(*width / 2 - 1, iy), (*width / 2, iy)])
        {
            reached.set(ix, iy);
        }
        reached.words.iter_mut().zip(&passable.words).for_each(|(reached, passable)| *reached &= passable);
        for stage in stages {
            let words = near.words.iter_mut().zip(&passable.words).zip(&stage.words);
            words.for_each(|((near, passable), stage)| *near = passable & stage);
            reached.flood(near, grown);
            let words = passable.words.iter_mut().zip(&reached.words).zip(&stage.words);
            words.for_each(|((passable, reached), stage)| *passable &= reached | !stage);
        }
        reached.flood(passable, grown);
        covered.clear();
        covered.dilate(reached, radius, wide);
    }

    /// True if the disc covers the cell somewhere on its path.
    pub fn is_reached(&self, ix: usize, iy: usize) -> bool {
        self.covered.get(ix, iy)
    }

    /// The cells that the disc covers.
    pub fn covered(&self) -> &Bits {
        &self.covered
    }

    /// True if the middle of the disc gets to the cell.
    pub fn is_middle(&self, ix: usize, iy: usize) -> bool {
        self.reached.get(ix, iy)
    }

    /// Makes cells unreached: these bits of a word ([`Bits::place`]).
    pub fn remove(&mut self, word: u32, bits: u64) {
        self.covered.words[word as usize] &= !bits;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bits(width: usize, is_set: impl Fn(usize) -> bool) -> Bits {
        let mut bits = Bits::square(width);
        bits.fill(is_set);
        bits
    }

    /// Floods a picture: `.` is open, `#` closed, blank neither. Returns it with `o` for open cells that are reached.
    fn flooded(picture: &[&str], radius: usize) -> Vec<String> {
        let width = picture.len();
        let is = |c: u8| bits(width, |cell| picture[cell / width].as_bytes()[cell % width] == c);
        let mut flood = Flood::new(width);
        flood.run(&is(b'.'), &is(b'#'), radius, &[]);
        let drawn = |(iy, row): (usize, &&str)| {
            let cell = |(ix, c): (usize, char)| if c == '.' && flood.is_reached(ix, iy) { 'o' } else { c };
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
    fn a_flood_fills_a_maze_wider_than_a_word() {
        let width = 200;
        // Each fourth row is a wall with one gap, at alternating ends.
        let wall = |iy: usize| iy % 4 == 3;
        let gap = |iy: usize| if iy % 8 == 3 { width - 1 } else { 0 };
        let is_closed = |cell: usize| wall(cell / width) && cell % width != gap(cell / width);
        let mut flood = Flood::new(width);
        flood.run(&bits(width, |cell| !is_closed(cell)), &bits(width, is_closed), 0, &[]);
        assert!((0..width * width).all(|cell| flood.is_reached(cell % width, cell / width) != is_closed(cell)));
    }
}
