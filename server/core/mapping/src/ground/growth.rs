//! Which returns are ground: the ground grows outward from the near plane, row by row.
//!
//! In: the lowest returns of the cells, the near plane. Out: by cell the height of its ground, or none. Each column
//! keeps the range, height and slope of its outermost ground. A cell's height is predicted from its own and the
//! neighbouring columns; the lowest return near the prediction is its ground. A return too far above it is an object,
//! unless the next returns of its column show that the ground rises; one too far below it is a mirror image, and the
//! next lowest return is tried.

use super::plane::NearPlane;
use super::polar::{CELLS, COLUMNS, PolarCells, ROWS, Return, beside, column_directions, row_start_m};

/// Weight of the columns beside, from two clockwise to two counter-clockwise. Ours; tuned on the scenes of
/// BENCHMARKS.md, as are all constants of this file.
const WEIGHTS: [f32; 5] = [0.25, 0.7, 1.0, 0.7, 0.25];
/// How far a return may lie above the prediction, metres, and how much more a metre to the nearest ground allows.
const ABOVE_M: [f32; 2] = [0.17, 0.06];
/// The same below the prediction.
const BELOW_M: [f32; 2] = [0.22, 0.16];
/// The same above the prediction in a cell with an object: its lowest return may be part of the object.
const ABOVE_IN_OBJECT_M: [f32; 2] = [0.12, 0.03];
/// Largest distance to the nearest ground that counts, metres.
const DISTANCE_M_MAX: f32 = 4.0;
/// The same behind an obstacle: ground there must lie where it is expected.
const DISTANCE_BLOCKED_M_MAX: f32 = 0.3;
/// Span of an object's returns in a cell, metres, and how much more a metre of the cell's length allows.
const OBJECT_M: [f32; 2] = [0.2, 0.1];
/// Share of a new height and of a new slope in the height and slope of a column.
const HEIGHT_SHARE: f32 = 0.6;
const SLOPE_SHARE: f32 = 0.4;
/// Steepest slope of a column.
const SLOPE_MAX: f32 = 0.25;
/// Least gap before the first return of rising ground, metres: over a shorter one a step is not told from a slope.
/// Largest gap, as a share of its outer range, as in the surface. Number of next returns that continue the rise, and
/// least share of it that they keep. Ours; tuned on the even seeds of the random worlds.
const RISING_GAP_M_MIN: f32 = 1.0;
const RISING_GAP_SHARE: f32 = 0.44;
const RISING_RETURNS: usize = 2;
const RISE_KEPT: f32 = 0.8;
/// Largest height of ground over or under the plane z = 0 if no near ground was seen, metres. Ours; not tuned.
const LEVEL_M: f32 = 0.2;
/// Number of times each row is grown; all but the first also reach ground behind objects from the columns beside.
const ROUNDS: usize = 3;

/// The outermost ground of a column.
#[derive(Clone, Copy, Debug, Default)]
struct Front {
    range_m: f32,
    height_m: f32,
    slope: f32,
    /// True if an obstacle stands behind this ground.
    is_blocked: bool,
}

/// What is known of a cell of the row that grows.
#[derive(Clone, Copy, Debug, PartialEq)]
enum CellOutcome {
    /// No return, or only mirror images.
    Nothing,
    /// The lowest return is too high to be ground.
    Obstacle,
    /// Range and height of the ground, and whether an object stands in the cell too.
    Ground { range_m: f32, z_m: f32, with_object: bool, predicted_m: f32 },
}

/// The ground of each cell.
#[derive(Clone)]
pub struct Growth {
    fronts: Vec<Front>,
    outcomes: Vec<CellOutcome>,
    /// By cell: height of the ground at the middle of the cell, metres; NaN without ground.
    heights_m: Vec<f32>,
}

impl Default for Growth {
    fn default() -> Self {
        Self {
            fronts: vec![Front::default(); COLUMNS],
            outcomes: vec![CellOutcome::Nothing; COLUMNS],
            heights_m: vec![f32::NAN; CELLS],
        }
    }
}

impl Growth {
    /// By cell: height of the ground at the middle of the cell, metres; NaN without ground.
    pub fn heights_m(&self) -> &[f32] {
        &self.heights_m
    }

    /// Grows the ground from the near plane to the last row. If no near ground was seen, the ground does not grow: only
    /// returns at the height of the plane under the vehicle are ground.
    pub fn grow(&mut self, cells: &PolarCells, plane: &NearPlane) {
        if !plane.is_seen {
            return self.select_level(cells);
        }
        let start_m = row_start_m(0);
        for (front, [cos, sin]) in self.fronts.iter_mut().zip(column_directions()) {
            let [a, b, c] = plane.abc;
            let slope = a * cos + b * sin;
            *front = Front { range_m: start_m, height_m: c + slope * start_m, slope, is_blocked: false };
        }
        self.heights_m.fill(f32::NAN);
        for row in 0..ROWS {
            self.outcomes.fill(CellOutcome::Nothing);
            for round in 0..ROUNDS {
                if !self.judge_row(row, round, cells) {
                    break;
                }
                self.advance_fronts(row_start_m(row + 1) - row_start_m(row));
            }
            self.end_row(row);
        }
    }

    /// Calls the returns near the plane z = 0 ground.
    fn select_level(&mut self, cells: &PolarCells) {
        for (cell, height) in self.heights_m.iter_mut().enumerate() {
            let level = cells.lowest(cell).find(|point| point.z_m >= -LEVEL_M);
            *height = level.filter(|point| point.z_m <= LEVEL_M).map_or(f32::NAN, |point| point.z_m);
        }
    }

    /// Judges the cells of a row that are not ground yet; returns true if any was not.
    fn judge_row(&mut self, row: usize, round: usize, cells: &PolarCells) -> bool {
        let (start_m, end_m) = (row_start_m(row), row_start_m(row + 1));
        let column_m = (start_m + end_m) / 2.0 * std::f32::consts::TAU / COLUMNS as f32;
        let mut any = false;
        for column in 0..COLUMNS {
            let cell = row * COLUMNS + column;
            let is_open = match self.outcomes[column] {
                CellOutcome::Nothing => round == 0 && cells.is_seen(cell),
                CellOutcome::Obstacle => true,
                CellOutcome::Ground { .. } => false,
            };
            if is_open {
                self.outcomes[column] = self.judge(cell, end_m - start_m, column_m, cells);
                any = true;
            }
        }
        any
    }

    /// Judges one cell.
    fn judge(&self, cell: usize, row_m: f32, column_m: f32, cells: &PolarCells) -> CellOutcome {
        let column = cell % COLUMNS;
        let with_object = cells.span_m(cell) > OBJECT_M[0] + OBJECT_M[1] * row_m;
        let above = if with_object { ABOVE_IN_OBJECT_M } else { ABOVE_M };
        let most = if self.fronts[column].is_blocked { DISTANCE_BLOCKED_M_MAX } else { DISTANCE_M_MAX };
        for point in cells.lowest(cell) {
            let (predicted_m, distance_m) = self.predict(column, point.range_m, column_m);
            let distance_m = distance_m.min(most);
            let over_m = point.z_m - predicted_m;
            if over_m > above[0] + above[1] * distance_m {
                if with_object || !self.rises(cell, point, cells) {
                    return CellOutcome::Obstacle;
                }
                // The rise is confirmed, so that the height needs no filter.
                let Return { range_m, z_m } = point;
                return CellOutcome::Ground { range_m, z_m, with_object, predicted_m: z_m };
            }
            if over_m >= -(BELOW_M[0] + BELOW_M[1] * distance_m) {
                return CellOutcome::Ground { range_m: point.range_m, z_m: point.z_m, with_object, predicted_m };
            }
        }
        CellOutcome::Nothing
    }

    /// True if a return above the prediction is the first one of rising ground: if the next returns of its column
    /// continue the rise from the ground before it. The next return of a wall lies over it, that behind a kerb on a
    /// level with it, and that behind a hedge or a car lower. Two returns count, because one behind a fence may lie on
    /// the line through one of its slats by chance.
    fn rises(&self, cell: usize, point: Return, cells: &PolarCells) -> bool {
        let front = &self.fronts[cell % COLUMNS];
        let gap_m = point.range_m - front.range_m;
        let rise = (point.z_m - front.height_m) / gap_m;
        let is_gap = gap_m >= RISING_GAP_M_MIN && gap_m <= RISING_GAP_SHARE * point.range_m;
        if front.is_blocked || !is_gap || rise > SLOPE_MAX {
            return false;
        }
        let mut outward = (cell + COLUMNS..CELLS).step_by(COLUMNS).filter_map(|outer| cells.lowest(outer).next());
        let mut last = point;
        (0..RISING_RETURNS).all(|_| {
            let Some(next) = outward.next() else { return false };
            let run_m = next.range_m - last.range_m;
            let slope = (next.z_m - last.z_m) / run_m;
            last = next;
            run_m <= RISING_GAP_SHARE * next.range_m && (RISE_KEPT * rise..=SLOPE_MAX).contains(&slope)
        })
    }

    /// Height expected at a range of a column, and the distance to the nearest ground, metres.
    fn predict(&self, column: usize, range_m: f32, column_m: f32) -> (f32, f32) {
        let (mut weights, mut heights, mut nearest) = (0.0, 0.0, f32::INFINITY);
        for (weight, offset) in WEIGHTS.into_iter().zip(-2..=2_isize) {
            let front = &self.fronts[beside(column, offset)];
            let (along, across) = (range_m - front.range_m, column_m * offset as f32);
            let squared = along * along + across * across;
            let weight = weight / squared.max(0.01);
            weights += weight;
            heights += weight * (front.height_m + front.slope * along);
            nearest = nearest.min(squared);
        }
        (heights / weights, nearest.sqrt())
    }

    /// Moves the fronts to the ground that was found, in a row of this length.
    fn advance_fronts(&mut self, row_m: f32) {
        for (front, outcome) in self.fronts.iter_mut().zip(&self.outcomes) {
            if let CellOutcome::Ground { range_m, z_m, with_object, predicted_m } = *outcome
                && range_m > front.range_m
            {
                let height_m = predicted_m + HEIGHT_SHARE * (z_m - predicted_m);
                if !with_object {
                    let step_m = range_m - front.range_m;
                    let rise = (height_m - front.height_m) / step_m;
                    // Two returns a centimetre apart show noise and no slope.
                    let slope = front.slope + SLOPE_SHARE * (step_m / row_m).min(1.0) * (rise - front.slope);
                    front.slope = slope.clamp(-SLOPE_MAX, SLOPE_MAX);
                }
                (front.range_m, front.height_m, front.is_blocked) = (range_m, height_m, with_object);
            }
        }
    }

    /// Keeps the heights of a row, and marks the columns that it blocks.
    fn end_row(&mut self, row: usize) {
        let middle_m = (row_start_m(row) + row_start_m(row + 1)) / 2.0;
        for (column, (front, outcome)) in self.fronts.iter_mut().zip(&self.outcomes).enumerate() {
            let cell = row * COLUMNS + column;
            match *outcome {
                CellOutcome::Nothing => {}
                CellOutcome::Obstacle => front.is_blocked = true,
                CellOutcome::Ground { range_m, z_m, .. } => {
                    self.heights_m[cell] = z_m + front.slope * (middle_m - range_m);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::polar::PolarIndex;
    use super::*;
    use crate::sensor::sweep::Sweep;
    use crate::vehicle_outline::Outline;

    /// The heights of the ground at these ranges ahead, for level ground up to 12 m and rings of these ranges and
    /// heights beyond.
    fn ground_m<const RINGS: usize>(beyond: [[f32; 2]; RINGS]) -> [f32; RINGS] {
        let mut sweep = Sweep::default();
        for [range_m, z_m] in (3..=12).map(|range_m| [range_m as f32, 0.0]).chain(beyond) {
            for degree in 0..360 {
                let (sin, cos) = libm::sincosf((degree as f32 + 0.5).to_radians());
                sweep.x.push(range_m * cos);
                sweep.y.push(range_m * sin);
                sweep.z.push(z_m);
            }
        }
        let (mut cells, mut growth) =
            (PolarCells::new(Outline { width_m: 2.0, front_m: 3.0, rear_m: 2.0 }), Growth::default());
        cells.sort_points(&sweep);
        growth.grow(&cells, &NearPlane { abc: [0.0; 3], is_seen: true });
        beyond.map(|[range_m, _]| growth.heights_m()[PolarIndex::at(range_m, 0.1).index().unwrap()])
    }

    #[test]
    fn the_first_ring_on_rising_ground_is_ground_if_the_next_two_continue_the_rise() {
        for slope in [0.08, 0.12, 0.2] {
            let rings = [18.0, 21.0, 24.0, 28.0].map(|range_m| [range_m, slope * (range_m - 12.0)]);
            for (found, [range_m, z_m]) in ground_m(rings).into_iter().zip(rings) {
                assert!((found - z_m).abs() < 0.15, "{slope}: {found} at {range_m} m");
            }
        }
    }

    #[test]
    fn a_ring_above_level_ground_is_an_object_unless_the_next_two_continue_the_rise() {
        let is_ground = |next: [[f32; 2]; 2]| !ground_m([[18.0, 0.8], next[0], next[1]])[0].is_nan();
        let (hill, later) = ([21.0, 1.2], [24.0, 1.6]);
        assert!(is_ground([hill, later]), "a hill");
        assert!(!is_ground([[21.0, 0.8], [24.0, 0.8]]), "a bed");
        assert!(!is_ground([[25.0, 0.0], [32.0, 0.0]]), "a hedge, and the ground behind it");
        assert!(!is_ground([[19.5, 1.6], [21.0, 2.4]]), "a face");
        assert!(!is_ground([hill, [24.0, 1.2]]), "a slat, and level ground behind it");
        assert!(!is_ground([hill, [50.0, 4.5]]), "a ring too far away");
        assert!(ground_m([[18.0, 0.8], hill])[0].is_nan(), "one next ring");
        assert!(ground_m([[18.0, 2.0], [21.0, 2.7], [24.0, 3.4]])[0].is_nan(), "steeper than any road");
    }
}
