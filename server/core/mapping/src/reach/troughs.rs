//! Troughs of the ground: ditches that rings cross too far apart for a step.
//!
//! In: lowest returns from the ground by cell, millimetres. Out: the cells with a return that lies lower than ground on
//! two opposite sides of it. The near side of a ditch is hidden, and far from the vehicle the returns from its far side
//! lie metres from those before it, so that no two cells beside each other show a step. On a grade one side is higher
//! and the other lower. The foot of a step that is as high counts too. Cells are compared in a grid of half their
//! resolution.

use super::bits::Bits;
use super::cells::SIDE;

/// Number of cells along a side of a coarse cell.
const FOLD: usize = 2;
/// Number of coarse cells along a side.
const COARSE: usize = SIDE / FOLD;
/// Least height of the ground on both sides over the return, millimetres. Ours: one unit of the layer `drivability`;
/// tuned on the even seeds of the random worlds, where 200 and 250 are equal.
const DEPTH_MM_MIN: i16 = 250;
/// Largest height of a marked cell's return over the lowest one of its coarse cell, millimetres. Ours; not tuned.
const FLOOR_MM_MAX: i16 = 100;
/// Number of coarse cells to each side in which higher ground counts: 2 m. Ours; 1.5 to 2.5 m are nearly equal.
const REACH: usize = 4;
/// The same along both axes at once, for the corners: 2.1 m.
const CORNER: usize = 3;
/// Height of a coarse cell without a return, as a lowest and as a highest height.
const EMPTY: i16 = i16::MAX;
const NONE: i16 = i16::MIN;

/// Finds the troughs. It reuses its buffers.
#[derive(Clone)]
pub struct Troughs {
    /// Coarse cells with a return.
    seen: Vec<u32>,
    /// By coarse cell: height of its lowest return, or [`NONE`].
    low: Vec<i16>,
    /// By coarse cell: greatest of these heights in the cells from here on: along a row, and in a box along the row,
    /// along the column, and along both.
    along: Vec<i16>,
    row_box: Vec<i16>,
    column_box: Vec<i16>,
    corner_box: Vec<i16>,
}

impl Troughs {
    /// No troughs.
    pub fn new() -> Self {
        let heights = vec![NONE; COARSE * COARSE];
        Self {
            seen: Vec::new(),
            low: heights.clone(),
            along: heights.clone(),
            row_box: heights.clone(),
            column_box: heights.clone(),
            corner_box: heights,
        }
    }

    /// Calls `mark` with column and row of each cell in a trough. `seen` are the cells with a return from the ground,
    /// `lowest_mm` is the height of a cell's lowest one.
    pub fn find(&mut self, seen: &Bits, lowest_mm: impl Fn(usize) -> i16, mut mark: impl FnMut(usize, usize)) {
        for cell in self.seen.drain(..) {
            self.low[cell as usize] = NONE;
        }
        seen.each(|ix, iy| {
            let coarse = iy / FOLD * COARSE + ix / FOLD;
            let low = &mut self.low[coarse];
            if *low == NONE {
                self.seen.push(coarse as u32);
                *low = EMPTY;
            }
            *low = (*low).min(lowest_mm(iy * SIDE + ix));
        });
        self.find_boxes();
        for coarse in self.seen.iter().map(|coarse| *coarse as usize).filter(|coarse| self.is_trough(*coarse)) {
            let highest_mm = self.low[coarse].saturating_add(FLOOR_MM_MAX);
            let (ix, iy) = (coarse % COARSE * FOLD, coarse / COARSE * FOLD);
            for (ix, iy) in (iy..iy + FOLD).flat_map(|iy| (ix..ix + FOLD).map(move |ix| (ix, iy))) {
                if lowest_mm(iy * SIDE + ix) <= highest_mm {
                    mark(ix, iy);
                }
            }
        }
    }

    /// Finds the greatest heights of the boxes that begin in each coarse cell.
    fn find_boxes(&mut self) {
        greatest(&self.low, &mut self.along, 1, REACH);
        greatest(&self.along, &mut self.row_box, COARSE, 3);
        greatest(&self.low, &mut self.along, 1, 3);
        greatest(&self.along, &mut self.column_box, COARSE, REACH);
        greatest(&self.along, &mut self.corner_box, COARSE, CORNER);
    }

    /// True if the ground is higher on two opposite sides of a coarse cell.
    fn is_trough(&self, coarse: usize) -> bool {
        let (ix, iy) = (coarse % COARSE, coarse / COARSE);
        let inside = REACH..COARSE - REACH;
        if !inside.contains(&ix) || !inside.contains(&iy) {
            return false;
        }
        let least = self.low[coarse].saturating_add(DEPTH_MM_MIN);
        let [row, column, corner] = [&self.row_box, &self.column_box, &self.corner_box];
        let is_high = |of_box: &[i16], ix: usize, iy: usize| of_box[iy * COARSE + ix] >= least;
        is_high(row, ix + 1, iy - 1) && is_high(row, ix - REACH, iy - 1)
            || is_high(column, ix - 1, iy + 1) && is_high(column, ix - 1, iy - REACH)
            || is_high(corner, ix + 1, iy + 1) && is_high(corner, ix - CORNER, iy - CORNER)
            || is_high(corner, ix + 1, iy - CORNER) && is_high(corner, ix - CORNER, iy + 1)
    }
}

/// Writes by cell the greatest height of `length` cells, 3 or 4, from it on, `stride` apart. The last cells, from which
/// they do not fit in, get no height.
fn greatest(of: &[i16], into: &mut [i16], stride: usize, length: usize) {
    let whole = of.len() - (length - 1) * stride;
    let from = |cells: usize| &of[cells * stride..][..whole];
    let (into, rest) = into.split_at_mut(whole);
    let heights = from(0).iter().zip(from(1)).zip(from(2)).zip(from(length - 1));
    into.iter_mut().zip(heights).for_each(|(into, (((a, b), c), d))| *into = (*a).max(*b).max((*c).max(*d)));
    rest.fill(NONE);
}

#[cfg(test)]
mod tests {
    use super::super::cells::{cell, centre_m};
    use super::*;

    /// Cells in troughs of ground with this height, seen at places that `is_seen` is true for.
    fn troughs(height_m: impl Fn([f32; 2]) -> f32, is_seen: impl Fn([f32; 2]) -> bool) -> Vec<[f32; 2]> {
        let (mut found, mut seen) = (Vec::new(), Bits::square(SIDE));
        seen.fill(|cell| is_seen(centre_m(cell)));
        let lowest_mm = |cell: usize| {
            let place = centre_m(cell);
            if is_seen(place) { (height_m(place) * 1000.0) as i16 } else { EMPTY }
        };
        Troughs::new().find(&seen, lowest_mm, |ix, iy| found.push(centre_m(iy * SIDE + ix)));
        found
    }

    /// A ditch along a line through the vehicle's left side at this angle to x, 0.5 m deep and 1 m wide.
    fn ditch([x, y]: [f32; 2], angle: f32) -> f32 {
        let (sin, cos) = libm::sincosf(angle);
        if (-0.5..0.5).contains(&(cos * y - sin * x - 8.0)) { -0.5 } else { 0.0 }
    }

    #[test]
    fn a_ditch_is_a_trough_in_every_direction_though_its_near_side_is_hidden() {
        for step in 0..24 {
            let angle = step as f32 * std::f32::consts::PI / 12.0;
            let (sin, cos) = libm::sincosf(angle);
            let across = |[x, y]: [f32; 2]| cos * y - sin * x - 8.0;
            let near = |[x, y]: [f32; 2]| libm::hypotf(x, y) < 30.0;
            let found =
                troughs(|place| ditch(place, angle), |place| near(place) && !(-0.5..0.0).contains(&across(place)));
            assert!(found.iter().all(|place| (-0.5..0.5).contains(&across(*place))), "{angle}: only in the ditch");
            for along in -20..20 {
                let [x, y] = [along as f32 * cos - 8.25 * sin, along as f32 * sin + 8.25 * cos];
                let is_near = |[fx, fy]: &[f32; 2]| libm::hypotf(fx - x, fy - y) < 0.8;
                assert!(found.iter().any(is_near), "{angle}: {along} m along");
            }
        }
    }

    #[test]
    fn grades_kerbs_and_shallow_dips_are_no_troughs() {
        for step in 0..16 {
            let (sin, cos) = libm::sincosf(step as f32 * std::f32::consts::PI / 8.0);
            let along = |[x, y]: [f32; 2]| cos * x + sin * y;
            let everywhere = |[x, y]: [f32; 2]| libm::hypotf(x, y) < 40.0;
            assert_eq!(troughs(|place| 0.3 * along(place), everywhere).len(), 0, "a grade of 30 %");
            let kerb = |rise_m: f32| troughs(|place| if along(place) > 9.0 { rise_m } else { 0.0 }, everywhere);
            assert_eq!(kerb(0.24).len(), 0, "a kerb that the vehicle climbs");
            let is_at_foot = |place: &[f32; 2]| (7.8..9.0).contains(&along(*place));
            assert!(kerb(0.5).iter().all(is_at_foot), "a kerb that it does not climb is closed at its foot alone");
            assert_eq!(troughs(|place| 0.1 * along(place).abs(), everywhere).len(), 0, "a dip of 10 %");
            assert_eq!(troughs(|place| 0.4 * ditch(place, 0.0), everywhere).len(), 0, "0.2 m deep");
        }
        let cell = cell(5.1, 5.1) as usize;
        assert_eq!(troughs(|place| if place == centre_m(cell) { -0.5 } else { 0.0 }, |_| true), [centre_m(cell)]);
    }
}
