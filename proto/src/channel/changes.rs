//! Cells <-> bits, as differences from a base: `ENCODING_CHANGES` of map.proto.
//!
//! In: cells, and a base of as many cells: the cells of an earlier map ([`crate::delta`]) or the usual value of each
//! cell's class ([`crate::by_class`]). Out: bits.
//!
//! Changes occur along borders between patches and continue from cell to cell. So each cell has a context (which of its
//! neighbours have changed, and which have another value in the base), and each context has its own runs of unchanged
//! and changed cells. Far from any border all cells have context 0: one run covers most of the map. A changed cell
//! mostly takes the value of a neighbour, which therefore is predicted.

use crate::channel::bits::{BitReader, BitWriter, Mean};
use crate::channel::cells::Cell;
use crate::channel::error::DecodeError;

/// Bits of a context: the cell above or to the left has changed.
const CHANGED_ABOVE: u8 = 1;
const CHANGED_LEFT: u8 = 2;
/// Bits of a context: in the base, the neighbour has another value than the cell.
const BORDER_ABOVE: u8 = 4;
const BORDER_LEFT: u8 = 8;
const BORDER_BELOW: u8 = 16;
const BORDER_RIGHT: u8 = 32;
/// Context of the flags that state whether a changed cell has another value than the predicted one.
const MISPREDICTED: usize = 64;
const CONTEXTS: usize = 65;
/// Contexts of 32 cells far from any border or change: they are compared at once.
const CALM: [u8; 32] = [0; 32];

/// The border bits of each cell's context.
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
        let differs = base.iter().zip(&base[1..]).map(|(cell, right)| u8::from(cell != right));
        borders.iter_mut().zip(differs.clone()).for_each(|(borders, differs)| *borders |= differs * BORDER_RIGHT);
        borders[1..].iter_mut().zip(differs).for_each(|(borders, differs)| *borders |= differs * BORDER_LEFT);
    }
    borders
}

/// Predicted value of the changed cell `at`: the first value other than its own among the cells to the left, above, to
/// the right and below. Cells from `at` on still have their base values.
fn predict<T: Cell>(cells: &[T], columns: usize, at: usize) -> Option<T> {
    let (row, column) = (at / columns, at % columns);
    let left = (column > 0).then(|| cells[at - 1]);
    let above = (row > 0).then(|| cells[at - columns]);
    let right = cells.get(at + 1).filter(|_| column + 1 < columns).copied();
    let below = cells.get(at + columns).copied();
    [left, above, right, below].into_iter().flatten().find(|cell| *cell != cells[at])
}

/// Sets the change bits in the contexts of the cells below and to the right of a changed cell.
fn mark_changed(contexts: &mut [u8], columns: usize, changed: usize) {
    if let Some(below) = contexts.get_mut(changed + columns) {
        *below |= CHANGED_ABOVE;
    }
    if let Some(right) = contexts.get_mut(changed + 1).filter(|_| !(changed + 1).is_multiple_of(columns)) {
        *right |= CHANGED_LEFT;
    }
}

/// Number of unchanged cells of context 0 at the beginning, or fewer: the caller asks again for the rest, and joins the
/// runs.
fn calm_cells<T: Cell>(cells: &[T], now: &[T], contexts: &[u8]) -> usize {
    const BLOCK: usize = CALM.len();
    let of_eight = |((cells, now), contexts): ((&[T; 8], &[T; 8]), &[u8; 8])| {
        let contexts = u64::from_le_bytes(*contexts).trailing_zeros() as usize / 8;
        T::first_difference(cells, now).min(contexts)
    };
    let (eights, now_eights, of_eights) = (cells.as_chunks::<8>().0, now.as_chunks::<8>().0, contexts.as_chunks().0);
    // Most such pieces are short, and most cells lie in long ones.
    match eights.iter().zip(now_eights).zip(of_eights).next().map(of_eight) {
        Some(8) => {}
        first => return first.unwrap_or(0),
    }
    let blocks = cells.as_chunks::<BLOCK>().0.iter().zip(now.as_chunks::<BLOCK>().0).zip(contexts.as_chunks().0);
    let calm = blocks.take_while(|((cells, now), contexts)| **contexts == CALM && cells == now).count();
    (BLOCK * calm).max(8)
}

/// Encodes `cells` as differences from `base`, which has as many cells, in rows of `columns`.
pub(crate) fn encode_changes<T: Cell>(cells: &[T], base: Vec<T>, columns: usize) -> Vec<u8> {
    let mut contexts = borders(&base, columns);
    let mut writer = RunWriter { tokens: Vec::with_capacity(cells.len() / 16), newest: [Run::default(); CONTEXTS] };
    let (mut now, mut at) = (base, 0);
    while at < cells.len() {
        let is_changed = cells[at] != now[at];
        if contexts[at] == 0 && !is_changed {
            let calm = calm_cells(&cells[at..], &now[at..], &contexts[at..]);
            writer.push_flags(0, false, calm.max(1) as u32);
            at += calm.max(1);
            continue;
        }
        writer.push_flags(contexts[at].into(), is_changed, 1);
        if is_changed {
            mark_changed(&mut contexts, columns, at);
            let predicted = predict(&now, columns, at);
            let is_mispredicted = predicted != Some(cells[at]);
            if predicted.is_some() {
                writer.push_flags(MISPREDICTED, is_mispredicted, 1);
            }
            if is_mispredicted {
                writer.tokens.push(Token::Value(cells[at].to_wire()));
            }
            now[at] = cells[at];
        }
        at += 1;
    }
    writer.finish()
}

/// A piece of the payload.
enum Token {
    /// A run of equal flags of one context; `is_first` if it is the context's first run.
    Run { context: u8, flag: bool, is_first: bool, length: u32 },
    /// A cell value as a number on the wire.
    Value(u16),
}

/// The newest run of a context.
#[derive(Clone, Copy, Default)]
struct Run {
    /// `None` before the context's first run.
    flag: Option<bool>,
    length: u32,
    /// Index of its piece in [`RunWriter::tokens`], which gets the length when the run has ended.
    token: usize,
}

/// Collects the pieces of a payload in the order in which a decoder needs them. A run grows after it was started.
struct RunWriter {
    tokens: Vec<Token>,
    /// The newest run of each context, by index of the context.
    newest: [Run; CONTEXTS],
}

impl RunWriter {
    /// Appends `count` equal flags of a context.
    #[inline]
    fn push_flags(&mut self, context: usize, value: bool, count: u32) {
        let newest = &mut self.newest[context];
        if newest.flag == Some(value) {
            newest.length += count;
        } else {
            self.begin_run(context, value, count);
        }
    }

    #[inline(never)]
    fn begin_run(&mut self, context: usize, value: bool, count: u32) {
        self.end_run(context);
        let is_first = self.newest[context].flag.is_none();
        self.newest[context] = Run { flag: Some(value), length: count, token: self.tokens.len() };
        self.tokens.push(Token::Run { context: context as u8, flag: value, is_first, length: count });
    }

    /// Writes the length of the newest run of a context into its piece.
    fn end_run(&mut self, context: usize) {
        let newest = self.newest[context];
        if newest.flag.is_some()
            && let Some(Token::Run { length, .. }) = self.tokens.get_mut(newest.token)
        {
            *length = newest.length;
        }
    }

    fn finish(mut self) -> Vec<u8> {
        (0..CONTEXTS).for_each(|context| self.end_run(context));
        let mut bits = BitWriter::with_capacity(2 * self.tokens.len());
        let (mut runs, mut values) = ([[Mean::default(); 2]; CONTEXTS], Mean::default());
        for token in self.tokens {
            match token {
                Token::Run { context, flag, is_first, length } => {
                    if is_first {
                        bits.write_bit(flag);
                    }
                    bits.write_adaptive(&mut runs[usize::from(context)][usize::from(flag)], u64::from(length) - 1);
                }
                Token::Value(value) => bits.write_adaptive(&mut values, value.into()),
            }
        }
        bits.finish()
    }
}

/// Decodes cells from their base, in rows of `columns`. Refuses a payload that [`encode_changes`] would not write.
pub(crate) fn decode_changes<T: Cell>(payload: &[u8], base: Vec<T>, columns: usize) -> Result<Vec<T>, DecodeError> {
    let mut contexts = borders(&base, columns);
    let (mut bits, mut values) = (BitReader::new(payload), Mean::default());
    let mut runs = RunReader { means: [[Mean::default(); 2]; CONTEXTS], flag: [None; CONTEXTS], left: [0; CONTEXTS] };
    let (mut cells, mut at) = (base, 0);
    while at < cells.len() {
        if contexts[at..].starts_with(&CALM) && runs.skip_unchanged(CALM.len() as u64) {
            at += CALM.len();
            continue;
        }
        if runs.read_flag(contexts[at].into(), &mut bits)? {
            mark_changed(&mut contexts, columns, at);
            let predicted = predict(&cells, columns, at);
            cells[at] = match predicted {
                Some(predicted) if !runs.read_flag(MISPREDICTED, &mut bits)? => predicted,
                _ => {
                    let offset = bits.offset();
                    let value = bits.read_cell(Some(&mut values))?;
                    if value == cells[at] || predicted == Some(value) {
                        return Err(DecodeError::Repeated { offset, value: value.to_wire().into() });
                    }
                    value
                }
            };
        }
        at += 1;
    }
    // Canonical: the last runs end with the last cell.
    if let Some(&left) = runs.left.iter().find(|left| **left > 0) {
        return Err(DecodeError::RunTooLong { offset: bits.offset(), length: left, left: 0 });
    }
    bits.finish()?;
    Ok(cells)
}

/// Reads the flags of each context from its runs.
struct RunReader {
    means: [[Mean; 2]; CONTEXTS],
    /// Flag of each context's present run; `None` before its first.
    flag: [Option<bool>; CONTEXTS],
    /// Flags left in each context's present run.
    left: [u64; CONTEXTS],
}

impl RunReader {
    /// Consumes so many flags of context 0 if all of them are 0; returns whether they are.
    fn skip_unchanged(&mut self, cells: u64) -> bool {
        let is_unchanged = self.flag[0] == Some(false) && self.left[0] >= cells;
        if is_unchanged {
            self.left[0] -= cells;
        }
        is_unchanged
    }

    fn read_flag(&mut self, context: usize, bits: &mut BitReader<'_>) -> Result<bool, DecodeError> {
        let flag = match self.flag[context] {
            Some(flag) if self.left[context] > 0 => flag,
            before => {
                let flag = before.map_or_else(|| bits.read_bit(), |flag| Ok(!flag))?;
                self.left[context] = bits.read_adaptive(&mut self.means[context][usize::from(flag)])? + 1;
                self.flag[context] = Some(flag);
                flag
            }
        };
        self.left[context] -= 1;
        Ok(flag)
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn changed_cells_decode_to_themselves(
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
        fn only_canonical_changes_decode(
            columns in 1..5_usize,
            base in vec(0..3_u8, 1..24),
            payload in vec(prop_oneof![any::<u8>(), Just(0xff)], 0..12),
        ) {
            if let Ok(cells) = decode_changes(&payload, base.clone(), columns) {
                prop_assert_eq!(encode_changes(&cells, base, columns), payload);
            }
        }
    }

    #[test]
    fn a_border_that_moves_by_one_cell_costs_less_than_a_bit_per_cell() {
        let patch = |end_row: usize| -> Vec<u8> {
            let inside = |cell: usize| (20..end_row).contains(&(cell / 100)) && (10..90).contains(&(cell % 100));
            (0..10_000).map(|cell| u8::from(inside(cell))).collect()
        };
        let changes = encode_changes(&patch(51), patch(50), 100);
        assert!(changes.len() <= 20, "{} bytes for 80 cells", changes.len());
    }
}
