//! Cells as what differs from a base: `ENCODING_CHANGES` of map.proto.
//!
//! In: cells, and for each what it is unless something changed: the cell of an earlier map ([`crate::delta`]) or what
//! cells of its class mostly are ([`crate::by_class`]). Out: bits. Change lies along borders and goes on from cell to
//! cell, so whether a cell has changed is told among the cells in the same context only: which of its neighbours in the
//! base are other than it, and whether the cells above and before it have changed. In each context cells take turns:
//! a run of unchanged ones, a run of changed ones, and so on. Where nothing is near, that is one run of most of the map.
//!
//! What a changed cell has become is mostly what one of its neighbours is.

use crate::bits::{BitReader, BitWriter, Mean};
use crate::codec::Cell;
use crate::decode::DecodeError;

/// Bits of a context: the cell above, the one before has changed.
const CHANGED_ABOVE: u8 = 1;
const CHANGED_BEFORE: u8 = 2;
/// Bits of a context: the neighbour in the base is other than the cell.
const BORDER_ABOVE: u8 = 4;
const BORDER_BEFORE: u8 = 8;
const BORDER_BELOW: u8 = 16;
const BORDER_BEHIND: u8 = 32;
/// The context in which turns tell whether a changed cell has become something other than its neighbour.
const OTHER: usize = 64;
const CONTEXTS: usize = 65;
/// Contexts of cells that are passed over together where none has changed.
const CALM: [u8; 32] = [0; 32];

/// For each cell, which of its neighbours are other than it.
fn borders<T: Cell>(base: &[T], columns: usize) -> Vec<u8> {
    let mut borders = vec![0; base.len()];
    for from in (columns..base.len()).step_by(columns) {
        let ((above, here), rows) = (borders[from - columns..].split_at_mut(columns), &base[from - columns..]);
        for (((above, here), up), cell) in above.iter_mut().zip(here).zip(rows).zip(&rows[columns..]) {
            let differs = u8::from(up != cell);
            *above |= differs * BORDER_BELOW;
            *here |= differs * BORDER_ABOVE;
        }
    }
    for (borders, base) in borders.chunks_mut(columns).zip(base.chunks(columns)) {
        let differs = base.iter().zip(&base[1..]).map(|(cell, behind)| u8::from(cell != behind));
        borders.iter_mut().zip(differs.clone()).for_each(|(borders, differs)| *borders |= differs * BORDER_BEHIND);
        borders[1..].iter_mut().zip(differs).for_each(|(borders, differs)| *borders |= differs * BORDER_BEFORE);
    }
    borders
}

/// What a cell that has changed is likely to be: the first that is other than it was of the cell before it, the one
/// above it, and in the base the one behind it and the one below. Cells from `at` on are the base's.
fn neighbour<T: Cell>(cells: &[T], columns: usize, at: usize) -> Option<T> {
    let (row, column) = (at / columns, at % columns);
    let before = (column > 0).then(|| cells[at - 1]);
    let above = (row > 0).then(|| cells[at - columns]);
    let behind = cells.get(at + 1).filter(|_| column + 1 < columns).copied();
    let below = cells.get(at + columns).copied();
    [before, above, behind, below].into_iter().flatten().find(|cell| *cell != cells[at])
}

/// Tells the cells beside one that it has changed.
fn mark(contexts: &mut [u8], columns: usize, changed: usize) {
    if let Some(below) = contexts.get_mut(changed + columns) {
        *below |= CHANGED_ABOVE;
    }
    if let Some(behind) = contexts.get_mut(changed + 1).filter(|_| !(changed + 1).is_multiple_of(columns)) {
        *behind |= CHANGED_BEFORE;
    }
}

/// `cells` as what differs from `base`, as many cells, in rows of `columns`.
pub(crate) fn encode_changes<T: Cell>(cells: &[T], base: Vec<T>, columns: usize) -> Vec<u8> {
    let mut contexts = borders(&base, columns);
    let mut told = Told { tokens: Vec::new(), newest: [None; CONTEXTS] };
    let (mut now, mut at) = (base, 0);
    while at < cells.len() {
        if contexts[at..].starts_with(&CALM) && cells[at..at + CALM.len()] == now[at..at + CALM.len()] {
            told.turn(0, false, CALM.len() as u64);
            at += CALM.len();
            continue;
        }
        let is_changed = cells[at] != now[at];
        told.turn(contexts[at].into(), is_changed, 1);
        if is_changed {
            mark(&mut contexts, columns, at);
            let likely = neighbour(&now, columns, at);
            let is_other = likely != Some(cells[at]);
            if likely.is_some() {
                told.turn(OTHER, is_other, 1);
            }
            if is_other {
                told.tokens.push(Token::Value(cells[at].to_wire().into()));
            }
            now[at] = cells[at];
        }
        at += 1;
    }
    told.finish()
}

enum Token {
    /// The first run of a context, or the next.
    Run { context: u8, is_changed: bool, is_first: bool, length: u64 },
    /// Of a cell, as on the wire.
    Value(u64),
}

/// What is told, in the order in which it is asked for.
struct Told {
    tokens: Vec<Token>,
    /// Context -> its newest run.
    newest: [Option<usize>; CONTEXTS],
}

impl Told {
    fn turn(&mut self, context: usize, changed: bool, times: u64) {
        let newest = self.newest[context];
        if let Some(Token::Run { is_changed, length, .. }) = newest.and_then(|newest| self.tokens.get_mut(newest))
            && *is_changed == changed
        {
            *length += times;
            return;
        }
        self.newest[context] = Some(self.tokens.len());
        let is_first = newest.is_none();
        self.tokens.push(Token::Run { context: context as u8, is_changed: changed, is_first, length: times });
    }

    fn finish(self) -> Vec<u8> {
        let mut bits = BitWriter::with_capacity(2 * self.tokens.len());
        let (mut runs, mut values) = ([[Mean::default(); 2]; CONTEXTS], Mean::default());
        for token in self.tokens {
            match token {
                Token::Run { context, is_changed, is_first, length } => {
                    if is_first {
                        bits.bit(is_changed);
                    }
                    bits.number_about(&mut runs[usize::from(context)][usize::from(is_changed)], length - 1);
                }
                Token::Value(value) => bits.number_about(&mut values, value),
            }
        }
        bits.finish()
    }
}

/// The way back: `base` becomes the cells. Refuses what [`encode_changes`] would not have written.
pub(crate) fn decode_changes<T: Cell>(payload: &[u8], base: Vec<T>, columns: usize) -> Result<Vec<T>, DecodeError> {
    let mut contexts = borders(&base, columns);
    let (mut bits, mut values) = (BitReader::new(payload), Mean::default());
    let mut turns =
        Turns { means: [[Mean::default(); 2]; CONTEXTS], is_changed: [None; CONTEXTS], left: [0; CONTEXTS] };
    let (mut cells, mut at) = (base, 0);
    while at < cells.len() {
        if contexts[at..].starts_with(&CALM) && turns.pass(CALM.len() as u64) {
            at += CALM.len();
            continue;
        }
        if turns.next(contexts[at].into(), &mut bits)? {
            mark(&mut contexts, columns, at);
            let likely = neighbour(&cells, columns, at);
            cells[at] = match likely {
                Some(likely) if !turns.next(OTHER, &mut bits)? => likely,
                _ => {
                    let offset = bits.offset();
                    let value = bits.cell(Some(&mut values))?;
                    if value == cells[at] || likely == Some(value) {
                        return Err(DecodeError::Repeated { offset, value: value.to_wire().into() });
                    }
                    value
                }
            };
        }
        at += 1;
    }
    // A last run is as long as it was asked for.
    if let Some(&left) = turns.left.iter().find(|left| **left > 0) {
        return Err(DecodeError::RunTooLong { offset: bits.offset(), length: left, left: 0 });
    }
    bits.finish()?;
    Ok(cells)
}

struct Turns {
    means: [[Mean; 2]; CONTEXTS],
    /// Whose turn it is, once it is somebody's.
    is_changed: [Option<bool>; CONTEXTS],
    /// Cells left of the turn.
    left: [u64; CONTEXTS],
}

impl Turns {
    /// Whether so many cells in context 0 are unchanged; then they have had their turn.
    fn pass(&mut self, cells: u64) -> bool {
        let passes = self.is_changed[0] == Some(false) && self.left[0] >= cells;
        if passes {
            self.left[0] -= cells;
        }
        passes
    }

    fn next(&mut self, context: usize, bits: &mut BitReader<'_>) -> Result<bool, DecodeError> {
        let is_changed = match self.is_changed[context] {
            Some(is_changed) if self.left[context] > 0 => is_changed,
            turn => {
                let is_changed = turn.map_or_else(|| bits.bit(), |is_changed| Ok(!is_changed))?;
                self.left[context] = bits.number_about(&mut self.means[context][usize::from(is_changed)])? + 1;
                self.is_changed[context] = Some(is_changed);
                is_changed
            }
        };
        self.left[context] -= 1;
        Ok(is_changed)
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn changed_cells_come_back_whatever_they_were(
            columns in 1..40_usize,
            cells in vec((0..6_u8, 1..30_usize, any::<u8>()), 0..60),
        ) {
            let spread = |of: fn(&(u8, usize, u8)) -> i8| -> Vec<i8> {
                cells.iter().flat_map(|span| std::iter::repeat_n(of(span), span.1)).collect()
            };
            let base = spread(|(class, ..)| *class as i8);
            let now = spread(|(class, _, chance)| if *chance < 80 { *chance as i8 } else { *class as i8 });
            let changes = encode_changes(&now, base.clone(), columns);
            prop_assert_eq!(decode_changes(&changes, base.clone(), columns), Ok(now));
        }

        #[test]
        fn changes_that_decode_are_the_ones_that_are_written(
            columns in 1..5_usize, base in vec(0..3_u8, 1..24), payload in vec(prop_oneof![any::<u8>(), Just(0xff)], 0..12),
        ) {
            if let Ok(cells) = decode_changes(&payload, base.clone(), columns) {
                prop_assert_eq!(encode_changes(&cells, base, columns), payload);
            }
        }
    }

    #[test]
    fn what_goes_on_along_a_border_costs_less_than_a_bit_a_cell() {
        // A patch whose lower border has moved down by a cell.
        let patch = |below: usize| -> Vec<u8> {
            let inside = |cell: usize| (20..below).contains(&(cell / 100)) && (10..90).contains(&(cell % 100));
            (0..10_000).map(|cell| u8::from(inside(cell))).collect()
        };
        let changes = encode_changes(&patch(51), patch(50), 100);
        assert!(changes.len() <= 20, "{} bytes for 80 cells", changes.len());
    }
}
