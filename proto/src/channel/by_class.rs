//! A channel as differences from the usual value of each cell's class: `Channel.by_class` of map.proto.
//!
//! In: cells and their classes. Out: the class table (one value per class), and the changes from it. A channel beside
//! the classes has its borders mostly where the classes have theirs; with a class table these borders are not encoded
//! again.

use bytes::Bytes;

use crate::channel::cells::{Cell, Cells, CellsRef};
use crate::channel::changes::encode_changes;
use crate::channel::codec::{Encoded, encode_smallest};
use crate::v1;

/// Number of cells that are compared at once. Ours: most of a map are patches of one class.
const BLOCK: usize = 32;

/// Why the class table of a channel was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ByClassError {
    /// No channel `class` of type u8 precedes the channel.
    #[error("no channel \"class\" of u8 precedes it")]
    NoClasses,
    /// A cell has a class that the legend does not name.
    #[error("class {class} in the layer; the legend has {classes} entries")]
    Class {
        /// Value of the class.
        class: u8,
        /// Entries of the legend.
        classes: usize,
    },
    /// A channel with a class table has another encoding than changes.
    #[error("encoding {encoding}; 3 (changes) is needed")]
    Encoding {
        /// The value of `Channel.encoding`.
        encoding: i32,
    },
    /// The class table does not have one cell per class.
    #[error("{length} bytes by class; {classes} classes of {width} bytes are needed")]
    Length {
        /// Bytes of the class table.
        length: usize,
        /// Entries of the legend.
        classes: usize,
        /// Bytes of one cell.
        width: usize,
    },
}

/// Encodes the cells of a grid with rows of `columns` cells whose classes are known; `class` holds one value per cell,
/// less than `classes`. The result has a class table if that is shorter than
/// [`encode_grid`](crate::channel::codec::encode_grid).
///
/// # Panics
/// As [`encode_grid`](crate::channel::codec::encode_grid); also if `class` has another length than `cells`, or holds a
/// value of `classes` or more.
pub fn encode_beside(cells: CellsRef<'_>, class: &[u8], classes: usize, columns: usize) -> Encoded {
    assert_eq!(cells.len(), class.len(), "one class per cell");
    let changes = match cells {
        CellsRef::U8(cells) => table_and_changes(cells, class, classes, columns.max(1)),
        CellsRef::I8(cells) => table_and_changes(cells, class, classes, columns.max(1)),
        CellsRef::U16(cells) => table_and_changes(cells, class, classes, columns.max(1)),
    };
    encode_smallest(cells, columns, Some(changes))
}

/// The class table, and the changes from it.
fn table_and_changes<T: Cell>(cells: &[T], class: &[u8], classes: usize, columns: usize) -> (Bytes, Vec<u8>) {
    let table = majorities(cells, class, classes);
    let mut base = Vec::with_capacity(class.len());
    let (blocks, rest) = class.as_chunks::<BLOCK>();
    for block in blocks {
        match equal_value(block) {
            Some(class) => base.extend([table[usize::from(class)]; BLOCK]),
            None => base.extend(block.map(|class| table[usize::from(class)])),
        }
    }
    base.extend(rest.iter().map(|class| table[usize::from(*class)]));
    let changes = encode_changes(cells, base, columns);
    (T::into_cells(table).as_ref().to_le_bytes().into_owned().into(), changes)
}

/// The value that more than half of the cells of each class have (majority vote of Boyer and Moore 1991); any value if
/// there is no majority.
fn majorities<T: Cell>(cells: &[T], class: &[u8], classes: usize) -> Vec<T> {
    let mut majorities = vec![(T::default(), 0_u32); classes];
    // Cells of one value and one class vote together.
    let mut vote = |cell: T, class: u8, votes: u32| {
        let (value, lead) = &mut majorities[usize::from(class)];
        if *value == cell {
            *lead += votes;
        } else if *lead >= votes {
            *lead -= votes;
        } else {
            (*value, *lead) = (cell, votes - *lead);
        }
    };
    let ((cell_blocks, last_cells), (class_blocks, last_classes)) =
        (cells.as_chunks::<BLOCK>(), class.as_chunks::<BLOCK>());
    for (cells, classes) in cell_blocks.iter().zip(class_blocks) {
        match (equal_value(cells), equal_value(classes)) {
            (Some(cell), Some(class)) => vote(cell, class, BLOCK as u32),
            _ => cells.iter().zip(classes).for_each(|(cell, class)| vote(*cell, *class, 1)),
        }
    }
    last_cells.iter().zip(last_classes).for_each(|(cell, class)| vote(*cell, *class, 1));
    majorities.into_iter().map(|(value, _)| value).collect()
}

/// The value of a block of equal values; `None` if they differ.
#[inline(always)]
fn equal_value<T: Copy + PartialEq>(block: &[T; BLOCK]) -> Option<T> {
    let first = block[0];
    // Arrays are compared as vectors.
    (*block == [first; BLOCK]).then_some(first)
}

/// The base of a channel with a class table: the table's value for each cell's class. `class`: the cells of channel
/// `class` if it precedes; `classes`: entries of the legend.
pub(crate) fn base(channel: &v1::Channel, class: Option<&Cells>, classes: usize) -> Result<Cells, ByClassError> {
    let Some(Cells::U8(class)) = class else { return Err(ByClassError::NoClasses) };
    if let Some(&class) = class.iter().find(|class| usize::from(**class) >= classes) {
        return Err(ByClassError::Class { class, classes });
    }
    if channel.encoding() != v1::Encoding::Changes {
        return Err(ByClassError::Encoding { encoding: channel.encoding });
    }
    match channel.cell_type() {
        v1::CellType::U16 => look_up::<u16>(&channel.by_class, class, classes),
        v1::CellType::I8 => look_up::<i8>(&channel.by_class, class, classes),
        v1::CellType::U8 | v1::CellType::Unspecified => look_up::<u8>(&channel.by_class, class, classes),
    }
}

fn look_up<T: Cell>(table: &[u8], class: &[u8], classes: usize) -> Result<Cells, ByClassError> {
    let (length, width) = (table.len(), T::BYTES);
    if length != classes * width {
        return Err(ByClassError::Length { length, classes, width });
    }
    let table: Vec<T> = table.chunks_exact(width).map(T::from_le_bytes).collect();
    Ok(T::into_cells(class.iter().map(|&class| table[usize::from(class)]).collect()))
}
