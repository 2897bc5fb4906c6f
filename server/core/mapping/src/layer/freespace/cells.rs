//! What was found of each cell -> the values of its channels.
//!
//! In: the cells of each class, a bit each. Out: class, height and reason of every cell, in the
//! order of the grid.

use crate::layer::maker::Context;
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::{SIDE, centre_m};

use super::class::{FreespaceClass, HEIGHT, Reason};

/// Number of cells of a word of bits.
const WORD: usize = 64;
/// Least height over the ground of the lowest return of an overhang, metres. Ours: higher than a vehicle's clearance.
const OVERHANG_M_MIN: f32 = 1.0;

/// What was found of the cells of one map.
pub struct Findings<'a> {
    /// What the vehicle can reach.
    pub reach: &'a Reach,
    /// The cells to call occupied, not reached and hidden, in this order.
    pub blocked: [&'a Bits; 3],
    /// The cells with something low.
    pub low: &'a Bits,
    /// The cells of drops.
    pub drop: &'a Bits,
    /// The cells in which the vehicle can stand.
    pub free: &'a Bits,
}

impl Findings<'_> {
    /// Writes the class of each cell but the cells of the vehicle.
    pub fn write_classes(&self, class: &mut Vec<u8>) {
        let bits = self.reach.bits();
        let [occupied, not_reached, hidden] = self.blocked;
        let planes = [self.free, bits.in_trough, occupied, self.drop, self.low, not_reached, hidden];
        // The first plane with the cell's bit decides.
        const CLASSES: [FreespaceClass; 7] = [
            FreespaceClass::Free,
            FreespaceClass::Drop,
            FreespaceClass::Occupied,
            FreespaceClass::Drop,
            FreespaceClass::Low,
            FreespaceClass::NotReached,
            FreespaceClass::Hidden,
        ];
        class.resize(SIDE * SIDE, 0);
        for (at, cells) in class.chunks_exact_mut(WORD).enumerate() {
            let (mut rest, mut eights) = (u64::MAX, [0; WORD / 8]);
            for (plane, class) in planes.iter().zip(CLASSES) {
                let word = plane.words()[at] & rest;
                rest &= !word;
                add_class(&mut eights, word, class);
            }
            add_class(&mut eights, rest, FreespaceClass::Unknown);
            for (cells, eight) in cells.chunks_exact_mut(8).zip(eights) {
                cells.copy_from_slice(&eight.to_le_bytes());
            }
        }
    }

    /// Writes the height of each cell's highest return over the ground.
    pub fn write_heights(&self, context: &Context<'_>, height: &mut Vec<i8>) {
        let spans = self.reach.ground_spans_mm();
        height.extend((0..SIDE * SIDE).map(|cell| {
            let [x, y] = centre_m(cell);
            let of_obstacle = self.reach.obstacles().span_m(cell).map(|[_, high]| high);
            let of_ground =
                |[low, high]: [i16; 2]| (low <= high).then(|| f32::from(high) / 1000.0 - context.ground_m(x, y));
            let height_m = of_obstacle.or_else(|| of_ground(spans[cell]));
            let raw =
                |metres: f32| (metres / HEIGHT.scale).round().clamp(f32::from(i8::MIN + 1), f32::from(i8::MAX)) as i8;
            height_m.map_or(HEIGHT.unknown, raw)
        }));
    }

    /// Writes why each cell has its class.
    pub fn write_reasons(&self, class: &[u8], why: &mut Vec<u8>) {
        let bits = self.reach.bits();
        why.extend(class.iter().enumerate().map(|(cell, class)| {
            let is = |plane: &Bits| plane.get(cell % SIDE, cell / SIDE);
            let obstacle = || match self.reach.obstacles().span_m(cell) {
                Some([low, _]) if low >= OVERHANG_M_MIN => Reason::Overhang,
                Some(_) => Reason::Obstacle,
                None if is(bits.closed) => Reason::Step,
                None => Reason::Obstacle,
            };
            let reason = match *class {
                class if class == FreespaceClass::Free.value() => match () {
                    () if is(self.reach.seen_now()) => Reason::Seen,
                    () if is(bits.seen) => Reason::Remembered,
                    () => Reason::Bridged,
                },
                class if class == FreespaceClass::Occupied.value() => obstacle(),
                class if class == FreespaceClass::Low.value() => Reason::Obstacle,
                class if class == FreespaceClass::Drop.value() => Reason::Ditch,
                class if class == FreespaceClass::NotReached.value() => Reason::TooNarrow,
                _ => Reason::NotSeen,
            };
            reason as u8
        }));
    }
}

/// Adds a class to the cells whose bits are set; a byte each, eight in a number, in the order of the cells.
fn add_class(eights: &mut [u64; WORD / 8], word: u64, class: FreespaceClass) {
    if word == 0 {
        return;
    }
    for (eight, byte) in eights.iter_mut().zip(word.to_le_bytes()) {
        // Each byte keeps its own bit, which is then moved to the lowest place.
        let own = (u64::from(byte) * 0x0101_0101_0101_0101) & 0x8040_2010_0804_0201;
        let bits = (own + 0x7f7f_7f7f_7f7f_7f7f) >> 7 & 0x0101_0101_0101_0101;
        *eight |= bits * u64::from(class.value());
    }
}
