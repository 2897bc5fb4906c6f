//! The edge of the ground beside the vehicle, in the zone that is too near for the lasers.
//!
//! In: the cells beside a step of the ground, the obstacles, and which polar cells have ground that was seen. Out: on
//! each side of the vehicle the cells on the straight line between the nearest cell beside a step ahead and that
//! behind. A kerb or a ditch along the road is seen ahead and behind, but no return shows the piece between. The line
//! counts only if no ground was seen on the vehicle's side of it: what was seen there decides by itself. If the nearest
//! ground in a direction is a step higher than the plane under the vehicle, its kerb lies in the zone too, and it is
//! closed there.

use std::f32::consts::TAU;

use crate::ground::polar::{COLUMNS, ROWS, column_directions, row_middles_m};
use crate::ground::surface::Confidence;

use super::bits::Bits;
use super::cells::{SIDE, cell, centre_m};
use super::joins::draw;

/// Greatest distance of a step from the vehicle, metres. Ours: as far as the plane under the vehicle is fitted.
const RANGE_M_MAX: f32 = 12.0;
/// How far ground may be seen on the vehicle's side of the line, metres. Ours: the returns from the side of a ditch or
/// kerb lie on both sides of the line; tuned on the even seeds of the random worlds, where 1 and 1.5 are equal.
const MARGIN_M: f32 = 1.0;
/// Least height of an obstacle whose returns are no edge of the ground, metres. Ours: higher than any kerb, lower than
/// the sills of cars, between which there is a way.
const TALL_M: f32 = 0.5;
/// Distance, in cells, up to which a step belongs to such an obstacle. Ours; with 1, maps of a drive past parked cars
/// change more from map to map.
const APART: usize = 2;

/// Least height over the plane under the vehicle of ground behind a hidden kerb, metres. Ours: lower than a step,
/// because the plane leans to the higher ground; tuned on the even seeds of the random worlds, where 0.17 is equal.
const RISE_M_MIN: f32 = 0.2;

/// Half the width of the strip ahead and behind in which a step is no edge, metres. Ours: a car stands on it. It is not
/// the vehicle's own width, so that a wider vehicle has no fewer edges.
pub const VEHICLE_M: f32 = 1.0;

/// Finds the lines.
#[derive(Clone)]
pub struct BlindZone {
    middles_m: [f32; ROWS],
}

impl BlindZone {
    /// No lines.
    pub fn new() -> Self {
        Self { middles_m: row_middles_m() }
    }

    /// Calls `mark` with column and row of each cell on a line. `obstacle_m` is the height of the obstacle in a cell,
    /// negative without one; `confidences` is by polar cell.
    pub fn find(
        &self,
        beside_step: &Bits,
        obstacle_m: impl Fn(usize) -> f32,
        confidences: &[Confidence],
        mut mark: impl FnMut(usize, usize),
    ) {
        for ends in self.nearest(beside_step, obstacle_m) {
            let [Some(behind), Some(ahead)] = ends else { continue };
            let mut is_blind = true;
            draw(behind, ahead, &mut |ix, iy| is_blind &= self.is_blind(centre_m(iy * SIDE + ix), confidences));
            if is_blind {
                draw(behind, ahead, &mut mark);
            }
        }
    }

    /// Calls `mark` with column and row of each cell beside the vehicle that is the nearest one with ground in its
    /// direction, if that ground is high over the plane under the vehicle: the face of the kerb before it is hidden.
    /// `over_plane_m` is the height of the ground at a position over that plane; `confidences` is by polar cell.
    pub fn find_rises(
        &self,
        over_plane_m: impl Fn([f32; 2]) -> f32,
        confidences: &[Confidence],
        mut mark: impl FnMut(usize, usize),
    ) {
        for (column, [cos, sin]) in column_directions().into_iter().enumerate() {
            let Some(range_m) = self.nearest_ground_m(column, confidences).filter(|range_m| *range_m < RANGE_M_MAX)
            else {
                continue;
            };
            let place @ [x, y] = [range_m * cos, range_m * sin];
            if y.abs() > VEHICLE_M && over_plane_m(place) >= RISE_M_MIN {
                let cell = cell(x, y) as usize;
                mark(cell % SIDE, cell / SIDE);
            }
        }
    }

    /// Left and right, behind and ahead: the cell beside a step that is least far behind or ahead.
    fn nearest(&self, beside_step: &Bits, obstacle_m: impl Fn(usize) -> f32) -> [[Option<usize>; 2]; 2] {
        let mut nearest = [[None; 2]; 2];
        beside_step.each(|ix, iy| {
            let [x, y] = centre_m(iy * SIDE + ix);
            if y.abs() > VEHICLE_M && x * x + y * y < RANGE_M_MAX * RANGE_M_MAX {
                let nearest = &mut nearest[usize::from(y < 0.0)][usize::from(x > 0.0)];
                let is_nearer = nearest.is_none_or(|cell| x.abs() < centre_m(cell)[0].abs());
                if is_nearer && is_of_ground(ix, iy, &obstacle_m) {
                    *nearest = Some(iy * SIDE + ix);
                }
            }
        });
        nearest
    }

    /// True if no ground was seen before a position.
    fn is_blind(&self, [x, y]: [f32; 2], confidences: &[Confidence]) -> bool {
        let column = ((libm::atan2f(y, x) / TAU).rem_euclid(1.0) * COLUMNS as f32) as usize % COLUMNS;
        let nearest_m = self.nearest_ground_m(column, confidences);
        nearest_m.is_none_or(|nearest_m| nearest_m >= libm::hypotf(x, y) - MARGIN_M)
    }

    /// Range of the nearest ground that was seen in a column.
    fn nearest_ground_m(&self, column: usize, confidences: &[Confidence]) -> Option<f32> {
        let mut rows = self.middles_m.iter().zip(confidences.iter().skip(column).step_by(COLUMNS));
        rows.find(|(_, confidence)| **confidence == Confidence::Seen).map(|(range_m, _)| *range_m)
    }
}

/// True if a cell beside a step, which is not at the border of the grid, is one of the ground itself: if no tall
/// obstacle stands beside it. `obstacle_m` is the height of the obstacle in a cell, negative without one.
pub fn is_of_ground(ix: usize, iy: usize, obstacle_m: impl Fn(usize) -> f32) -> bool {
    let mut around = (iy - APART..=iy + APART).flat_map(|iy| (ix - APART..=ix + APART).map(move |ix| iy * SIDE + ix));
    around.all(|cell| obstacle_m(cell) < TALL_M)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::polar::{CELLS, PolarIndex};

    /// The number of cells on lines, for steps at these places, an obstacle of this height at a place, and ground that
    /// was seen at a place.
    fn marked(steps: &[[f32; 2]], (obstacle, height_m): ([f32; 2], f32), seen: [f32; 2]) -> usize {
        let mut beside_step = Bits::square(SIDE);
        for [x, y] in steps {
            let cell = cell(*x, *y) as usize;
            beside_step.set(cell % SIDE, cell / SIDE);
        }
        let obstacle = cell(obstacle[0], obstacle[1]) as usize;
        let obstacle_m = |cell: usize| if cell == obstacle { height_m } else { f32::NEG_INFINITY };
        let mut confidences = vec![Confidence::Bridged; CELLS];
        confidences[PolarIndex::at(seen[0], seen[1]).index().unwrap()] = Confidence::Seen;
        let mut marked = 0;
        BlindZone::new().find(&beside_step, obstacle_m, &confidences, |_, _| marked += 1);
        marked
    }

    #[test]
    fn steps_ahead_and_behind_are_joined_beside_the_vehicle() {
        let (far, none) = ([30.0, 30.0], ([30.0, -30.0], 0.0));
        // Cells of 0.25 m from 5.1 m behind to 5.1 m ahead.
        for y in [4.1, -4.1] {
            assert_eq!(marked(&[[5.1, y], [-5.1, y]], none, far), 40, "{y}");
            assert_eq!(marked(&[[5.1, y], [8.1, y], [-5.1, y], [-7.1, y]], none, far), 40, "the nearest count: {y}");
        }
        assert_eq!(marked(&[[5.1, 4.1], [-5.1, -4.1]], none, far), 0, "one on each side");
        assert_eq!(marked(&[[5.1, 4.1], [9.1, 4.1]], none, far), 0, "both ahead");
        assert_eq!(marked(&[[5.1, 0.6], [-5.1, 0.6]], none, far), 0, "under the vehicle");
        assert_eq!(marked(&[[12.1, 4.1], [-5.1, 4.1]], none, far), 0, "too far away");
    }

    #[test]
    fn a_line_counts_only_without_ground_before_it() {
        let steps = [[5.1, 4.1], [-5.1, 4.1]];
        let none = ([30.0, -30.0], 0.0);
        // Places in the direction of a cell of the line, which is 4.13 m away.
        let at = |range_m: f32| [0.03 * range_m, range_m];
        assert_eq!(marked(&steps, none, at(2.5)), 0, "before it");
        assert_eq!(marked(&steps, none, at(3.6)), 40, "before it, as near as the returns from the step");
        assert_eq!(marked(&steps, none, at(6.0)), 40, "beyond it");
        assert_eq!(marked(&steps, none, at(-2.5)), 40, "on the other side of the vehicle");
    }

    #[test]
    fn the_returns_of_a_car_are_no_edge_of_the_ground() {
        let (steps, far) = ([[5.1, 4.1], [-5.1, 4.1]], [30.0, 30.0]);
        assert_eq!(marked(&steps, ([5.1, 4.6], 1.0), far), 0, "beside the step");
        assert_eq!(marked(&steps, ([5.1, 4.6], 0.4), far), 40, "a kerb");
        assert_eq!(marked(&steps, ([5.1, 5.1], 1.0), far), 40, "apart from the step");
    }

    #[test]
    fn ground_high_over_the_plane_is_closed_where_it_is_the_nearest_that_was_seen() {
        // Cells with ground: all beyond this range.
        let marked = |from_m: f32, over_plane_m: f32| {
            let middles_m = row_middles_m();
            let seen = |polar: usize| middles_m[polar / COLUMNS] > from_m;
            let confidence = |polar| if seen(polar) { Confidence::Seen } else { Confidence::Bridged };
            let confidences: Vec<Confidence> = (0..CELLS).map(confidence).collect();
            let mut found = Vec::new();
            let over_m = |[_, y]: [f32; 2]| if y > 4.0 { over_plane_m } else { 0.0 };
            BlindZone::new().find_rises(over_m, &confidences, |ix, iy| found.push(centre_m(iy * SIDE + ix)));
            found
        };
        let bed = marked(5.0, 0.4);
        assert!(bed.len() >= 40 && bed.iter().all(|[x, y]| *y > 3.8 && libm::hypotf(*x, *y) < 6.0), "{bed:?}");
        assert_eq!(marked(5.0, 0.1), [[0.0; 2]; 0], "a rise that the vehicle climbs");
        assert_eq!(marked(5.0, -0.4), [[0.0; 2]; 0], "lower ground");
        assert_eq!(marked(13.0, 0.4), [[0.0; 2]; 0], "too far away");
    }
}
