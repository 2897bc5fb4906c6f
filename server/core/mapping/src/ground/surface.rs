//! The surface of the ground: heights with their confidence, between and beyond the cells with ground.
//!
//! In: by cell the height of its ground, or none. Out: by cell a height and a [`Confidence`]. Isolated cells that stand
//! over their neighbours are removed, gaps are bridged, edges extrapolated, and the heights smoothed once.

use super::growth::Growth;
use super::neighbourhood::Neighbourhood;
use super::plane::NearPlane;
use super::polar::{CELLS, COLUMNS, ROWS, beside, column_directions, row_middles_m, row_start_m};

/// Where a height of the surface comes from; each source is more certain than the source before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Confidence {
    /// No ground was seen near; the height is the near plane's, and proves nothing free.
    #[default]
    None,
    /// Beyond the edge of seen ground, by up to [`EXTRAPOLATED_M_MAX`].
    Extrapolated,
    /// In a gap between seen ground, or between the vehicle and the nearest seen ground.
    Bridged,
    /// A return of the cell is ground.
    Seen,
}

/// Largest height of a cell over the mean of its neighbours, metres, and how much more a metre of the cell's length
/// allows. Ours; tuned on the scenes of BENCHMARKS.md.
const STANDING_M: [f32; 2] = [0.16, 0.04];
/// Longest gap that is bridged, metres, and as a share of its outer range. Ours: rings of a 16-laser sensor lie up to
/// that far apart.
const BRIDGED_M_MAX: f32 = 18.0;
const BRIDGED_SHARE: f32 = 0.44;
/// Widest gap across columns that is bridged, as a share of the range. Ours; not tuned.
const BRIDGED_ACROSS_SHARE: f32 = 0.2;
/// Steepest bridge.
const GRADE_MAX: f32 = 0.25;
/// Largest distance of extrapolated ground from seen ground, metres. Ours; not tuned.
const EXTRAPOLATED_M_MAX: f32 = 2.0;
/// Largest range of the nearest seen ground up to which the ground under and before the vehicle is bridged, metres.
/// Ours: the innermost ring of a VLP-16 at a height of 2.5 m.
const BLIND_ZONE_M: f32 = 10.0;
/// Number of cells that are not known in either direction.
const NONE: usize = usize::MAX;

/// Heights and confidences of all cells.
#[derive(Clone)]
pub struct Surface {
    heights_m: Vec<f32>,
    confidences: Vec<Confidence>,
    around: Neighbourhood,
    /// Columns of a row whose heights are known.
    known: [usize; COLUMNS],
}

impl Default for Surface {
    fn default() -> Self {
        let confidences = vec![Confidence::None; CELLS];
        Self { heights_m: vec![0.0; CELLS], confidences, around: Neighbourhood::default(), known: [0; COLUMNS] }
    }
}

impl Surface {
    /// By cell: height at the middle of the cell, metres.
    pub fn heights_m(&self) -> &[f32] {
        &self.heights_m
    }

    /// By cell.
    pub fn confidences(&self) -> &[Confidence] {
        &self.confidences
    }

    /// Replaces the surface by the surface of the ground found.
    pub fn cover(&mut self, growth: &Growth, plane: &NearPlane) {
        self.heights_m.copy_from_slice(growth.heights_m());
        self.remove_standing_cells();
        for (confidence, height) in self.confidences.iter_mut().zip(&self.heights_m) {
            *confidence = if height.is_nan() { Confidence::None } else { Confidence::Seen };
        }
        let middles_m = row_middles_m();
        self.bridge_rows(&middles_m);
        self.bridge_columns(&middles_m);
        self.bridge_blind_zone(&middles_m, plane);
        self.extrapolate(&middles_m);
        self.fill_with(plane, &middles_m);
        self.smooth();
    }

    /// Removes cells that stand over the weighted mean of the 5 x 5 cells around them.
    fn remove_standing_cells(&mut self) {
        let heights = &self.heights_m;
        self.around.fill(|cell| if heights[cell].is_nan() { (0.0, 0.0) } else { (heights[cell], 1.0) });
        for (row, heights) in self.heights_m.chunks_exact_mut(COLUMNS).enumerate() {
            let limit_m = STANDING_M[0] + STANDING_M[1] * (row_start_m(row + 1) - row_start_m(row));
            self.around.sum_around(row, [1.0, 2.0, 3.0, 2.0, 1.0]);
            let sums = self.around.value_sums.iter().zip(&self.around.weight_sums);
            for (height, (values, weights)) in heights.iter_mut().zip(sums) {
                // NaN fails the comparison.
                if *height - values / weights > limit_m {
                    *height = f32::NAN;
                }
            }
        }
    }

    /// Bridges gaps along each column.
    fn bridge_rows(&mut self, middles_m: &[f32; ROWS]) {
        for column in 0..COLUMNS {
            let mut last = NONE;
            for row in 0..ROWS {
                if self.confidences[row * COLUMNS + column] == Confidence::None {
                    continue;
                }
                if last != NONE && row - last > 1 {
                    let gap_m = middles_m[row] - middles_m[last];
                    let [from, to] = [last, row].map(|row| self.heights_m[row * COLUMNS + column]);
                    let longest_m = BRIDGED_M_MAX.min(BRIDGED_SHARE * middles_m[row]);
                    if gap_m <= longest_m && (to - from).abs() <= GRADE_MAX * gap_m {
                        for between in last + 1..row {
                            let share = (middles_m[between] - middles_m[last]) / gap_m;
                            self.bridge(between * COLUMNS + column, from + share * (to - from));
                        }
                    }
                }
                last = row;
            }
        }
    }

    fn bridge(&mut self, cell: usize, height_m: f32) {
        (self.heights_m[cell], self.confidences[cell]) = (height_m, Confidence::Bridged);
    }

    /// Bridges gaps along each row.
    fn bridge_columns(&mut self, middles_m: &[f32; ROWS]) {
        for (row, middle_m) in middles_m.iter().enumerate() {
            let column_m = middle_m * std::f32::consts::TAU / COLUMNS as f32;
            let of_row = |column: usize| row * COLUMNS + column % COLUMNS;
            let (known, mut columns) = (&mut self.known, 0);
            for column in 0..COLUMNS {
                known[columns] = column;
                columns += usize::from(self.confidences[of_row(column)] != Confidence::None);
            }
            for at in 0..columns {
                let from = self.known[at];
                let to = if at + 1 < columns { self.known[at + 1] } else { self.known[0] + COLUMNS };
                let gap_m = (to - from) as f32 * column_m;
                let [a, b] = [from, to].map(|column| self.heights_m[of_row(column)]);
                let longest_m = BRIDGED_M_MAX.min(BRIDGED_ACROSS_SHARE * middle_m);
                if to - from > 1 && gap_m <= longest_m && (b - a).abs() <= GRADE_MAX * gap_m {
                    for between in from + 1..to {
                        let share = (between - from) as f32 / (to - from) as f32;
                        self.bridge(of_row(between), a + share * (b - a));
                    }
                }
            }
        }
    }

    /// Bridges each column from the vehicle to its nearest ground, which no laser reaches.
    fn bridge_blind_zone(&mut self, middles_m: &[f32; ROWS], plane: &NearPlane) {
        if !plane.is_seen {
            return;
        }
        let directions = column_directions();
        for (column, [cos, sin]) in directions.into_iter().enumerate() {
            let nearest = (0..ROWS).find(|row| self.confidences[row * COLUMNS + column] != Confidence::None);
            let Some(nearest) = nearest.filter(|row| middles_m[*row] <= BLIND_ZONE_M) else { continue };
            for (row, range_m) in middles_m.iter().enumerate().take(nearest) {
                self.bridge(row * COLUMNS + column, plane.height_m(range_m * cos, range_m * sin));
            }
        }
    }

    /// Extends the ground beyond its edges, along the columns and then along the rows.
    fn extrapolate(&mut self, middles_m: &[f32; ROWS]) {
        for column in 0..COLUMNS {
            for outward in [true, false] {
                let mut edge: Option<(usize, f32)> = None;
                let mut before: Option<(f32, f32)> = None;
                for step in 0..ROWS {
                    let row = if outward { step } else { ROWS - 1 - step };
                    let cell = row * COLUMNS + column;
                    if self.confidences[cell] >= Confidence::Bridged {
                        let (range_m, height_m) = (middles_m[row], self.heights_m[cell]);
                        let slope = before.map_or(0.0, |(r, h): (f32, f32)| (height_m - h) / (range_m - r));
                        edge = Some((row, slope.clamp(-GRADE_MAX, GRADE_MAX) / 2.0));
                        before = Some((range_m, height_m));
                    } else if let Some((from, slope)) = edge
                        && self.confidences[cell] == Confidence::None
                        && (middles_m[row] - middles_m[from]).abs() <= EXTRAPOLATED_M_MAX
                    {
                        let height_m =
                            self.heights_m[from * COLUMNS + column] + slope * (middles_m[row] - middles_m[from]);
                        (self.heights_m[cell], self.confidences[cell]) = (height_m, Confidence::Extrapolated);
                    }
                }
            }
        }
        for (row, middle_m) in middles_m.iter().enumerate() {
            let reach = (EXTRAPOLATED_M_MAX / (middle_m * std::f32::consts::TAU / COLUMNS as f32)) as isize;
            for column in 0..COLUMNS {
                if self.confidences[row * COLUMNS + column] != Confidence::None {
                    continue;
                }
                let near =
                    (1..=reach).flat_map(|step| [step, -step]).map(|offset| row * COLUMNS + beside(column, offset));
                if let Some(from) = near.into_iter().find(|cell| self.confidences[*cell] >= Confidence::Bridged) {
                    let cell = row * COLUMNS + column;
                    (self.heights_m[cell], self.confidences[cell]) = (self.heights_m[from], Confidence::Extrapolated);
                }
            }
        }
    }

    /// Gives the cells without ground the height of the near plane.
    fn fill_with(&mut self, plane: &NearPlane, middles_m: &[f32; ROWS]) {
        let directions = column_directions();
        for cell in 0..CELLS {
            if self.confidences[cell] == Confidence::None {
                let (range_m, [cos, sin]) = (middles_m[cell / COLUMNS], directions[cell % COLUMNS]);
                self.heights_m[cell] = plane.height_m(range_m * cos, range_m * sin);
            }
        }
    }

    /// Smooths the heights once with a binomial of 3 x 3 cells, weighted by confidence.
    fn smooth(&mut self) {
        let weight = |confidence| match confidence {
            Confidence::Seen => 4.0,
            Confidence::Bridged => 1.0,
            Confidence::Extrapolated => 0.25,
            Confidence::None => 0.0,
        };
        let (heights, confidences) = (&self.heights_m, &self.confidences);
        self.around.fill(|cell| (heights[cell], weight(confidences[cell])));
        let rows = self.heights_m.chunks_exact_mut(COLUMNS).zip(self.confidences.chunks_exact(COLUMNS));
        for (row, (heights, confidences)) in rows.enumerate() {
            self.around.sum_around(row, [1.0, 2.0, 1.0]);
            let sums = self.around.value_sums.iter().zip(&self.around.weight_sums);
            for ((height, confidence), (values, weights)) in heights.iter_mut().zip(confidences).zip(sums) {
                if *confidence != Confidence::None {
                    *height = values / weights;
                }
            }
        }
    }
}
