//! Obstacles without gaps, and ground without patches, that are too small for any vehicle.
//!
//! In: closed and open cells, and the cells that are free, low or of drops. Out: the cells to call occupied, not
//! reached and hidden. A gap of one or two cells between closed cells is occupied too. Ground of less than three cells
//! by three, seen between obstacles by single returns, is hidden like all around it: a map is a quarter smaller by
//! it, and quieter to the eye. No free, low or dropping cell changes, nor does ground beside a free cell.

use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::SIDE;

/// Finds the cells of the three classes. It reuses its buffers.
#[derive(Clone)]
pub struct Patches {
    occupied: Bits,
    not_reached: Bits,
    hidden: Bits,
    wide: Bits,
    narrow: Bits,
    words: Vec<u64>,
}

impl Patches {
    /// No cell yet.
    pub fn new() -> Self {
        let bits = Bits::square(SIDE);
        Self {
            occupied: bits.clone(),
            not_reached: bits.clone(),
            hidden: bits.clone(),
            wide: bits.clone(),
            narrow: bits,
            words: Vec::new(),
        }
    }

    /// Occupied, not reached and hidden cells, in this order; an occupied one may be free or in a trough. `judged` are
    /// free, low and dropping cells.
    pub fn find(&mut self, reach: &Reach, unproved: &Bits, judged: [&Bits; 3]) -> [&Bits; 3] {
        let Self { occupied, not_reached, hidden, wide, narrow, words } = self;
        let ([free, ..], bits) = (judged, reach.bits());
        wide.grow(bits.closed, words);
        shrink(wide, occupied, narrow, words);
        not_reached.copy_from(bits.open);
        not_reached.remove(unproved);
        judged.into_iter().for_each(|cells| occupied.remove(cells));
        occupied.add(bits.closed);
        for cells in judged.into_iter().chain([&*occupied]) {
            not_reached.remove(cells);
        }
        hidden.copy_from(bits.hidden);
        hidden.add(not_reached);
        // Ground that a square of three by three cells covers, and ground beside a free cell.
        shrink(not_reached, wide, narrow, words);
        narrow.grow(wide, words);
        wide.grow(free, words);
        narrow.add(wide);
        not_reached.keep(narrow);
        hidden.remove(not_reached);
        [occupied, not_reached, hidden]
    }
}

/// Writes the cells of `from` around which all eight cells are in it; `outside` is a buffer.
fn shrink(from: &Bits, to: &mut Bits, outside: &mut Bits, words: &mut Vec<u64>) {
    outside.copy_from(from);
    outside.invert();
    to.grow(outside, words);
    to.invert();
}
