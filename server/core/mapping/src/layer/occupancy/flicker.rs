//! Cells that rays reach in one map and not in the next, along the borders of shadows. Not in the paper.
//!
//! In: the states of a map's cells. Out: the same with two exceptions, in which a clear cell has the last of its other
//! states: a cell that was clear, and then was neither clear nor occupied, does not become clear again for some maps;
//! and a hidden cell becomes clear in the second map in a row that shows it clear. So such a cell changes once in place
//! of each map, which makes deltas shorter, and no cell is clear that would not be without this. While the vehicle is
//! fast, nearly every border moves from map to map, and nothing is replaced.
//!
//! What a cell is follows from the states of the last maps alone, so that the maps of a pipeline that begins later soon
//! equal the maps of an earlier pipeline.

use super::class::OccupancyClass;

/// Largest number of maps for which a cell is remembered.
pub const MAPS_MAX: u8 = 7;

/// Farthest way from one map to the next, in cells along an axis, after which cells are calmed. Ours: 1 m, which is
/// 10 m/s at 10 maps a second; at 25 m/s a twentieth of the clear cells would come late.
const MOVED_MAX: u64 = 4;

/// Bits of a cell: maps left in which it does not become clear.
const LEFT: u8 = 0b111;
/// Bit of a cell: it was clear in the last map, before it was calmed.
const WAS_CLEAR: u8 = 0b1000;
/// Place of the bits with the last state that was not clear.
const LAST: u32 = 4;

/// The cells around the vehicle that flicker, stored like the cells of the window: world cell (i, j) at (i mod n, j mod
/// n).
#[derive(Clone)]
pub struct Flicker {
    /// Number of maps in which a cell that was clear and no longer is does not become clear again.
    maps: u8,
    /// Number of cells along a side of the window.
    side: usize,
    /// Bits of a stored index along one axis.
    bits: u32,
    /// World index (x, y) of the first cell of the last map; `None` before the first.
    corner: Option<[i64; 2]>,
    cells: Vec<u8>,
}

impl Flicker {
    /// No cells yet, for a window of `side` x `side` cells. `maps` is at most [`MAPS_MAX`].
    pub fn new(side: usize, maps: u8) -> Self {
        let bits = side.next_power_of_two().trailing_zeros();
        Self { maps: maps.min(MAPS_MAX), side, bits, corner: None, cells: vec![0; 1 << (2 * bits)] }
    }

    /// Forgets all cells.
    pub fn clear(&mut self) {
        self.corner = None;
    }

    /// Replaces the states of cells that flicker. `class` are the states of the window's cells, whose first one is the
    /// world cell `corner`.
    pub fn calm(&mut self, corner: [i64; 2], class: &mut [u8]) {
        if self.maps == 0 {
            return;
        }
        let known = self.corner.replace(corner);
        let is_slow = known.is_some_and(|known| (0..2).all(|axis| known[axis].abs_diff(corner[axis]) <= MOVED_MAX));
        for (y, row) in (corner[1]..).zip(class.chunks_exact_mut(self.side)) {
            let mask = (1_i64 << self.bits) - 1;
            let stored = &mut self.cells[((y & mask) as usize) << self.bits..][..1 << self.bits];
            let is_row_known = known.is_some_and(|known| (known[1]..known[1] + self.side as i64).contains(&y));
            // The row is stored in one piece, or in two.
            let first = (corner[0] & mask) as usize;
            let (head, tail) = row.split_at_mut(self.side.min(stored.len() - first));
            let tail_x = corner[0] + head.len() as i64;
            for (x, at, states) in [(corner[0], first, head), (tail_x, 0, tail)] {
                let stored = &mut stored[at..at + states.len()];
                // Cells that were not in the last map's window have no history.
                let known_x = known.filter(|_| is_row_known).map_or(i64::MAX, |known| known[0]);
                let [from, to] = [known_x, known_x.saturating_add(self.side as i64)]
                    .map(|known_x| known_x.saturating_sub(x).clamp(0, stored.len() as i64) as usize);
                stored[..from].fill(0);
                stored[to..].fill(0);
                for (cell, state) in stored.iter_mut().zip(states) {
                    let (later, calmed) = next(*cell, *state, self.maps);
                    (*cell, *state) = (later, if is_slow { calmed } else { *state });
                }
            }
        }
    }
}

/// The cell one map later, and its state if it is calmed.
#[inline(always)]
fn next(cell: u8, state: u8, maps: u8) -> (u8, u8) {
    const CLEAR: u8 = OccupancyClass::Clear.value();
    const OCCUPIED: u8 = OccupancyClass::Occupied.value();
    const OCCLUDED: u8 = OccupancyClass::Occluded.value();
    let (is_clear, is_occupied) = (state == CLEAR, state == OCCUPIED);
    let is_lost = (cell & WAS_CLEAR != 0) & !is_clear;
    let left = (cell & LEFT).saturating_sub(1);
    let left = if is_lost { maps } else { left };
    // An object stood in the cell: what rays show after it is no flicker.
    let left = if is_occupied { 0 } else { left };
    let last = if is_clear { cell >> LAST } else { state };
    let was_hidden = (cell & WAS_CLEAR == 0) & (cell >> LAST == OCCLUDED);
    let published = if is_clear & ((left > 0) | was_hidden) { last } else { state };
    (left | if is_clear { WAS_CLEAR } else { 0 } | last << LAST, published)
}

#[cfg(test)]
mod tests {
    use super::*;
    use OccupancyClass::{Clear, Occluded, Occupied, Unknown};

    /// The published states of a cell in a standing window that has these states in one map after the other.
    fn published(states: &[OccupancyClass], maps: u8) -> Vec<u8> {
        let mut flicker = Flicker::new(5, maps);
        let calm = |state: &OccupancyClass| {
            let mut class = [Unknown.value(); 25];
            class[12] = state.value();
            flicker.calm([-2, 7], &mut class);
            class[12]
        };
        states.iter().map(calm).collect()
    }

    fn values(states: &[OccupancyClass]) -> Vec<u8> {
        states.iter().map(|state| state.value()).collect()
    }

    #[test]
    fn a_cell_that_flickers_stays_hidden_until_it_is_clear_for_some_maps() {
        let flickers = [Unknown, Clear, Occluded, Clear, Occluded, Clear, Clear, Clear, Clear];
        let calmed = [Unknown, Clear, Occluded, Occluded, Occluded, Occluded, Occluded, Clear, Clear];
        assert_eq!(published(&flickers, 3), values(&calmed));
        assert_eq!(published(&flickers, 0), values(&flickers));
    }

    #[test]
    fn a_new_cell_is_clear_at_once_and_so_is_one_that_an_object_has_left() {
        let states = [Unknown, Clear, Clear, Clear];
        assert_eq!(published(&states, MAPS_MAX), values(&states));
        let passes = [Clear, Occluded, Occupied, Clear, Clear];
        assert_eq!(published(&passes, MAPS_MAX), values(&passes));
    }

    #[test]
    fn a_hidden_cell_is_clear_in_the_second_map_in_a_row_that_shows_it_clear() {
        let appears = [Occluded, Clear, Clear, Clear];
        assert_eq!(published(&appears, 1), values(&[Occluded, Occluded, Clear, Clear]));
        let once = [Occluded, Occluded, Clear, Occluded, Occluded];
        assert_eq!(published(&once, 1), values(&[Occluded; 5]));
    }

    #[test]
    fn no_cell_is_clear_or_occupied_that_was_not() {
        let all = [Unknown, Clear, Occupied, Occluded, OccupancyClass::OutOfRange];
        for number in 0..5_usize.pow(7) {
            let states: Vec<_> = (0..7).map(|place| all[number / 5_usize.pow(place) % 5]).collect();
            for (state, published) in states.iter().zip(published(&states, 2)) {
                let is_same = published == state.value();
                assert!(is_same || *state == Clear && published != Occupied.value(), "{states:?}");
            }
        }
    }

    #[test]
    fn a_cell_keeps_its_history_while_the_window_scrolls_and_loses_it_outside() {
        // Corners of the window in the third and fourth map; the cell is (7, 7).
        for (corners, expected) in [
            ([[6, 5], [6, 5]], Occluded),
            ([[5, 3], [5, 3]], Occluded),
            ([[4, 7], [4, 7]], Occluded),
            ([[8, 5], [7, 5]], Clear),
            ([[5, 1], [5, 4]], Clear),
        ] {
            let mut flicker = Flicker::new(5, 3);
            let mut show = |corner: [i64; 2], state: OccupancyClass| {
                let mut class = [Unknown.value(); 25];
                let place = [0, 1].map(|axis| usize::try_from(7 - corner[axis]).ok().filter(|at| *at < 5));
                let cell = place[0].zip(place[1]).map(|(x, y)| y * 5 + x);
                cell.into_iter().for_each(|cell| class[cell] = state.value());
                flicker.calm(corner, &mut class);
                cell.map(|cell| class[cell])
            };
            show([5, 5], Clear);
            show([5, 5], Occluded);
            show(corners[0], Occluded);
            assert_eq!(show(corners[1], Clear), Some(expected.value()), "{corners:?}");
        }
    }
    #[test]
    fn the_cells_of_a_fast_vehicle_are_not_calmed() {
        for (moved, expected) in [([4, 0], Occluded), ([5, 0], Clear), ([0, -4], Occluded), ([0, -5], Clear)] {
            let mut flicker = Flicker::new(16, 3);
            let mut show = |corner: [i64; 2], state: OccupancyClass| {
                let mut class = [Unknown.value(); 256];
                let cell = ((7 - corner[1]) * 16 + 7 - corner[0]) as usize;
                class[cell] = state.value();
                flicker.calm(corner, &mut class);
                class[cell]
            };
            show([0, 0], Clear);
            show([0, 0], Occluded);
            assert_eq!(show(moved, Clear), expected.value(), "{moved:?}");
        }
    }
}
