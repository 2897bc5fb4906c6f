//! Cells beside a step that are even themselves.
//!
//! In: the cells that a step alone closes, and the free cells. Out: the closed cells whose own returns are as even as
//! free ground, and lie as high as the free cells around them. A step marks both of its sides, half a metre of road
//! too: the side on which the vehicle stands is free.

use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::SIDE;

/// Greatest span of a released cell's returns, millimetres, and the greatest distance of its lowest return from the
/// mean of the free cells around it. Ours: the noise of returns; a kerb is higher.
const SPAN_MM_MAX: i32 = 100;
const APART_MM_MAX: i32 = 80;
/// Half the side of the box of these free cells, in cells.
const HALF: usize = 2;

/// Calls `release` with each cell that a step alone closes (`stepped`) and that is free like the cells around it.
/// `covered` are the cells that the vehicle's disc covers, `free` the free cells among them.
pub fn find(reach: &Reach, stepped: &Bits, covered: &Bits, free: &Bits, mut release: impl FnMut(usize, usize)) {
    let spans = reach.ground_spans_mm();
    stepped.each(|ix, iy| {
        if !(HALF..SIDE - HALF).contains(&ix) || !(HALF..SIDE - HALF).contains(&iy) {
            return;
        }
        let [low, high] = spans[iy * SIDE + ix].map(i32::from);
        if low > high || high - low >= SPAN_MM_MAX {
            return;
        }
        let around =
            |half: usize| (iy - half..=iy + half).flat_map(move |iy| (ix - half..=ix + half).map(move |ix| (ix, iy)));
        if !covered.get(ix, iy) && !around(1).any(|(ix, iy)| free.get(ix, iy)) {
            return;
        }
        let (mut sum, mut count) = (0, 0);
        for (ix, iy) in around(HALF).filter(|(ix, iy)| free.get(*ix, *iy)) {
            let [low, high] = spans[iy * SIDE + ix].map(i32::from);
            if low <= high {
                (sum, count) = (sum + low, count + 1);
            }
        }
        if count > 0 && (low - sum / count).abs() < APART_MM_MAX {
            release(ix, iy);
        }
    });
}
