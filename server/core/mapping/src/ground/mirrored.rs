//! Mirror images: returns under ground that other rays met before.
//!
//! A wet or smooth road reflects a ray onto the foot of what stands there, and the return is measured as far under the
//! road as the foot is above it. No light comes from there: on its way to a place under the ground the ray would pass
//! under ground that was seen. Into a ditch it passes over the ditch's edge, and under nothing.

use super::polar::{COLUMNS, PolarCells, ROWS, Return, beside, row_start_m};
use super::surface::{Confidence, Surface};

/// Least depth of a mirror image under the ground, metres. Ours: shallower ones are noise.
pub const DEPTH_M_MIN: f32 = 0.3;
/// Greatest range of a mirror image, metres. Ours: farther away a column of the polar cells is as wide as a ditch.
const RANGE_M_MAX: f32 = 15.0;
/// Least height of seen ground over the ray, metres, and its largest height over the estimate. Ours; not tuned.
const OVER_RAY_M: f32 = 0.1;
const GROUND_M_MAX: f32 = 0.1;
/// Number of cells in which ground over the ray is seen, in the column of the return and in the column to each side.
/// Ours: the edge of a ditch that runs along the ray fills one side.
const SEEN_MIN: usize = 2;

/// True if the ray of a return of a column passes under ground that was seen. The return lies at this height over the
/// ground, and the sensor at this one, metres.
pub fn is_mirrored(
    (cells, surface): (&PolarCells, &Surface),
    column: usize,
    found: &Return,
    height_m: f32,
    sensor_m: f32,
) -> bool {
    let Return { range_m, z_m } = *found;
    let ray_m = |at_m: f32| sensor_m + (z_m - sensor_m) * at_m / range_m;
    let is_over = |cell: usize| {
        surface.confidences()[cell] == Confidence::Seen
            && cells.lowest(cell).next().is_some_and(|low| {
                low.range_m < range_m
                    && low.z_m > ray_m(low.range_m) + OVER_RAY_M
                    && low.z_m - surface.heights_m()[cell] < GROUND_M_MAX
            })
    };
    let rows = (0..ROWS).take_while(|row| row_start_m(*row + 1) < range_m);
    height_m < -DEPTH_M_MIN
        && range_m < RANGE_M_MAX
        && [-1, 0, 1].into_iter().all(|offset| {
            let column = beside(column, offset);
            rows.clone().filter(|row| is_over(row * COLUMNS + column)).take(SEEN_MIN).count() == SEEN_MIN
        })
}
