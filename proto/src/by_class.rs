//! A channel as what differs from what cells of their class mostly are: `Channel.by_class` of map.proto.
//!
//! In: cells and their classes. Out: one cell a class, and the changes from it. A channel beside the classes changes
//! where they do: told by class, these borders are not told again.

use bytes::Bytes;

use crate::changes::encode_changes;
use crate::codec::{Cell, Cells, CellsRef, Encoded, encode_grid};
use crate::v1;

/// Encodes the cells of a grid with rows of `columns` cells whose classes are known, `class` of `classes`: by class
/// where that is shorter than [`encode_grid`].
///
/// # Panics
/// As [`encode_grid`]; with another number of classes than cells, or a class that is none of `classes`.
pub fn encode_beside(cells: CellsRef<'_>, class: &[u8], classes: usize, columns: usize) -> Encoded {
    assert_eq!(cells.len(), class.len(), "a class a cell");
    let plain = encode_grid(cells, columns);
    let (by_class, changes) = match cells {
        CellsRef::U8(cells) => told(cells, class, classes, columns.max(1)),
        CellsRef::I8(cells) => told(cells, class, classes, columns.max(1)),
        CellsRef::U16(cells) => told(cells, class, classes, columns.max(1)),
    };
    if by_class.len() + changes.len() < plain.payload.len() {
        Encoded { encoding: v1::Encoding::Changes, payload: changes.into(), by_class, ..plain }
    } else {
        plain
    }
}

/// One cell a class, and the changes from it.
fn told<T: Cell>(cells: &[T], class: &[u8], classes: usize, columns: usize) -> (Bytes, Vec<u8>) {
    let table = most(cells, class, classes);
    let base = class.iter().map(|&class| table[usize::from(class)]).collect();
    let changes = encode_changes(cells, base, columns);
    (T::cells(table).as_ref().to_le_bytes().into_owned().into(), changes)
}

/// What cells of each class mostly are: a value that more than half of them have outlasts all others' votes (Boyer and
/// Moore 1991); where there is none any will do.
fn most<T: Cell>(cells: &[T], class: &[u8], classes: usize) -> Vec<T> {
    let mut most = vec![(T::default(), 0_u32); classes];
    for (&cell, &class) in cells.iter().zip(class) {
        let (value, votes) = &mut most[usize::from(class)];
        match *votes {
            0 => (*value, *votes) = (cell, 1),
            _ if *value == cell => *votes += 1,
            _ => *votes -= 1,
        }
    }
    most.into_iter().map(|(value, _)| value).collect()
}

/// What the changes of a channel told by class change. `Err` says what does not fit the classes, those of the cells and
/// how many there are.
pub(crate) fn base(channel: &v1::Channel, class: Option<&Cells>, classes: usize) -> Result<Cells, String> {
    let Some(Cells::U8(class)) = class else {
        return Err("no channel \"class\" of u8 before it".into());
    };
    if let Some(class) = class.iter().find(|class| usize::from(**class) >= classes) {
        return Err(format!("class {class} in the layer; the legend has {classes} entries"));
    }
    match channel.cell_type() {
        _ if channel.encoding() != v1::Encoding::Changes => Err(format!("encoding {}, not changes", channel.encoding)),
        v1::CellType::U16 => of_classes::<u16>(&channel.by_class, class, classes),
        v1::CellType::I8 => of_classes::<i8>(&channel.by_class, class, classes),
        v1::CellType::U8 | v1::CellType::Unspecified => of_classes::<u8>(&channel.by_class, class, classes),
    }
}

fn of_classes<T: Cell>(table: &[u8], class: &[u8], classes: usize) -> Result<Cells, String> {
    let (length, width) = (table.len(), T::BYTES);
    if length != classes * width {
        return Err(format!("{length} bytes by class; {classes} classes of {width} bytes are needed"));
    }
    let table: Vec<T> = table.chunks_exact(width).map(T::of_le_bytes).collect();
    Ok(T::cells(class.iter().map(|&class| table[usize::from(class)]).collect()))
}
