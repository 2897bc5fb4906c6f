//! Cells as differences from a prediction: the map before ([`crate::delta`]), or what cells of their class mostly are
//! (`Channel.by_class` of map.proto).
//!
//! In: cells and what is predicted of them. Out: the differences, which go through the same encodings as cells do:
//! mostly 0, they make long runs. Differences wrap, and those of unsigned cells zigzag. A channel beside the classes
//! changes where they do: told by class, these borders are not told again.

use bytes::Bytes;

use crate::codec::{Cells, CellsRef, Encoded, encode_grid, unzigzag, zigzag};
use crate::decode::{DecodeError, Limits, check_crc, decode_differences};
use crate::v1;

/// What is added to the prediction to make `cells`; `None` for cells of two types.
pub(crate) fn differences(predicted: Cells, cells: &Cells) -> Option<Cells> {
    Some(match (predicted, cells) {
        (Cells::U8(before), Cells::U8(cells)) => {
            Cells::U8(zip(before, cells, |before, now| zigzag(now.wrapping_sub(before) as i8)))
        }
        (Cells::I8(before), Cells::I8(cells)) => Cells::I8(zip(before, cells, |before, now| now.wrapping_sub(before))),
        (Cells::U16(before), Cells::U16(cells)) => {
            Cells::U16(zip(before, cells, |before, now| zigzag_wide(now.wrapping_sub(before) as i16)))
        }
        _ => return None,
    })
}

/// The way back from [`differences`].
pub(crate) fn sums(predicted: Cells, differences: &Cells) -> Option<Cells> {
    Some(match (predicted, differences) {
        (Cells::U8(before), Cells::U8(more)) => {
            Cells::U8(zip(before, more, |before, more| before.wrapping_add_signed(unzigzag(more))))
        }
        (Cells::I8(before), Cells::I8(more)) => Cells::I8(zip(before, more, i8::wrapping_add)),
        (Cells::U16(before), Cells::U16(more)) => {
            Cells::U16(zip(before, more, |before, more| before.wrapping_add_signed(unzigzag_wide(more))))
        }
        _ => return None,
    })
}

/// Cell by cell, in place of the first.
fn zip<T: Copy>(mut cells: Vec<T>, others: &[T], of: impl Fn(T, T) -> T) -> Vec<T> {
    cells.iter_mut().zip(others).for_each(|(cell, other)| *cell = of(*cell, *other));
    cells
}

fn zigzag_wide(value: i16) -> u16 {
    ((value << 1) ^ (value >> 15)) as u16
}

fn unzigzag_wide(value: u16) -> i16 {
    ((value >> 1) as i16) ^ -((value & 1) as i16)
}

/// Encodes the cells of a grid with rows of `columns` cells whose classes are known, `class` of `classes`: by class
/// where that is shorter than [`encode_grid`].
///
/// # Panics
/// As [`encode_grid`]; with another number of classes than cells, or a class that is none of `classes`.
pub fn encode_beside(cells: CellsRef<'_>, class: &[u8], classes: usize, columns: usize) -> Encoded {
    assert_eq!(cells.len(), class.len(), "a class a cell");
    let plain = encode_grid(cells, columns);
    let owned = match cells {
        CellsRef::U8(cells) => Cells::U8(cells.to_vec()),
        CellsRef::I8(cells) => Cells::I8(cells.to_vec()),
        CellsRef::U16(cells) => Cells::U16(cells.to_vec()),
    };
    let (table, predicted) = match cells {
        CellsRef::U8(cells) => of_classes(cells, class, classes, Cells::U8),
        CellsRef::I8(cells) => of_classes(cells, class, classes, Cells::I8),
        CellsRef::U16(cells) => of_classes(cells, class, classes, Cells::U16),
    };
    let Some(differences) = differences(predicted, &owned) else { return plain };
    let told = encode_grid(differences.as_ref(), columns);
    let by_class = Bytes::from(table.as_ref().to_le_bytes().into_owned());
    if told.payload.len() + by_class.len() < plain.payload.len() {
        Encoded { encoding: told.encoding, payload: told.payload, by_class, ..plain }
    } else {
        plain
    }
}

/// What cells of each class mostly are, and so what is predicted of each cell.
fn of_classes<T: Copy + PartialEq + Default>(
    cells: &[T],
    class: &[u8],
    classes: usize,
    wrap: impl Fn(Vec<T>) -> Cells,
) -> (Cells, Cells) {
    // A value that more than half of the cells have outlasts all others' votes (Boyer and Moore 1991); where there is
    // none any will do.
    let mut most = vec![(T::default(), 0_u32); classes];
    for (&cell, &class) in cells.iter().zip(class) {
        let (value, votes) = &mut most[usize::from(class)];
        match *votes {
            0 => (*value, *votes) = (cell, 1),
            _ if *value == cell => *votes += 1,
            _ => *votes -= 1,
        }
    }
    let table: Vec<T> = most.iter().map(|(value, _)| *value).collect();
    let predicted = class.iter().map(|&class| table[usize::from(class)]).collect();
    (wrap(table), wrap(predicted))
}

/// The cells of a channel told by class. `Err` without a source: what does not fit the classes.
pub(crate) fn decode_beside(
    channel: &v1::Channel,
    class: Option<&Cells>,
    classes: usize,
    limits: &Limits,
) -> Result<Cells, Misfit> {
    let Some(Cells::U8(class)) = class else {
        return Err(Misfit::Classes("no channel \"class\" of u8 before it".into()));
    };
    let (table, width) = (&channel.by_class[..], if channel.cell_type() == v1::CellType::U16 { 2 } else { 1 });
    if table.len() != classes * width {
        let text = format!("{} bytes by class; {classes} classes of {width} bytes are needed", table.len());
        return Err(Misfit::Classes(text));
    }
    if let Some(class) = class.iter().find(|class| usize::from(**class) >= classes) {
        return Err(Misfit::Classes(format!("class {class} in the layer; the legend has {classes} entries")));
    }
    let differences = decode_differences(channel, limits).map_err(Misfit::Cells)?;
    let of = |class: &u8| usize::from(*class) * width;
    let predicted = match differences {
        Cells::U8(_) => Cells::U8(class.iter().map(|class| table[of(class)]).collect()),
        Cells::I8(_) => Cells::I8(class.iter().map(|class| table[of(class)] as i8).collect()),
        Cells::U16(_) => {
            Cells::U16(class.iter().map(|class| u16::from_le_bytes([table[of(class)], table[of(class) + 1]])).collect())
        }
    };
    let cells = sums(predicted, &differences).ok_or_else(|| Misfit::Classes("cells of another type".into()))?;
    check_crc(channel, &cells).map_err(Misfit::Cells)?;
    Ok(cells)
}

/// Why a channel told by class was refused.
pub(crate) enum Misfit {
    /// It does not fit the classes.
    Classes(String),
    /// Its payload.
    Cells(DecodeError),
}
