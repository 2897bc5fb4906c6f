//! Position -> column of equal azimuth; and the rounding that vectorises.

use std::f32::consts::{FRAC_PI_2, TAU};

/// 2²³: floats from here on are whole numbers, one apart.
const WHOLE_FROM: f32 = 8_388_608.0;

/// Columns of equal azimuth: position -> column, counter-clockwise from the x axis.
///
/// The position is first rotated into the first quadrant by a multiple of 90 degrees, which is exact. So if 90 degrees
/// are a whole number of columns, a world rotated by 90 degrees gives the same columns, shifted by a quarter. Within
/// the quadrant the error of the angle is less than 2 µrad, a tenth of a millimetre at 60 m.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct AzimuthColumns {
    /// Number of columns in a full circle.
    pub(crate) columns: u16,
    columns_a_rad: f32,
    /// Column in which each quadrant begins.
    first: [u32; 4],
    /// Position of the beginning of each quadrant in that column, 0 to 1.
    offset: [f32; 4],
    /// Largest position within a quadrant, in columns: slightly less than its width, so that rounding does not reach
    /// the next quadrant.
    most: f32,
}

impl AzimuthColumns {
    /// Number of columns of two degrees, in which the local ground is estimated.
    pub(crate) const TWO_DEGREES: u16 = 180;

    /// This many columns in a full circle.
    pub(crate) fn new(columns: u16) -> Self {
        let quarters = [0, 1, 2, 3].map(|quadrant| quadrant * u32::from(columns));
        Self {
            columns,
            columns_a_rad: f32::from(columns) / TAU,
            first: quarters.map(|quarters| quarters / 4),
            offset: quarters.map(|quarters| (quarters % 4) as f32 / 4.0),
            most: f32::from(columns) / 4.0 * (1.0 - 2.0 * f32::EPSILON),
        }
    }

    /// The column that contains a position; 0 for the origin.
    #[inline(always)]
    pub(crate) fn column(&self, x: f32, y: f32) -> u32 {
        let (first, within) = self.quadrant(x, y);
        first + floor_to_whole(within)
    }

    /// The azimuth of a position in columns, with a fraction; 0 for the origin. It is less than the number of columns.
    #[inline(always)]
    pub(crate) fn position(&self, x: f32, y: f32) -> f32 {
        let (first, within) = self.quadrant(x, y);
        // The cast of a signed number is one instruction.
        first as i32 as f32 + within
    }

    /// The column in which a position's quadrant begins, and the columns from there to the position.
    #[inline(always)]
    fn quadrant(&self, x: f32, y: f32) -> (u32, f32) {
        // AzimuthColumns are half-open: [0, 90°) has x > 0, y >= 0, and so on around.
        let second = x <= 0.0 && y > 0.0;
        let third = x < 0.0 && y <= 0.0;
        let fourth = x >= 0.0 && y < 0.0;
        let (mut first, mut offset) = (self.first[0], self.offset[0]);
        (first, offset) = if second { (self.first[1], self.offset[1]) } else { (first, offset) };
        (first, offset) = if third { (self.first[2], self.offset[2]) } else { (first, offset) };
        (first, offset) = if fourth { (self.first[3], self.offset[3]) } else { (first, offset) };
        let (ax, ay) = (x.abs(), y.abs());
        let (along, across) = if second | fourth { (ay, ax) } else { (ax, ay) };
        let within = quarter_angle(across, along) * self.columns_a_rad;
        // NaN fails the comparison.
        let within = if within < self.most { within } else { self.most };
        (first, within + offset)
    }
}

/// The whole number nearest to a value from 0 to 2²². A cast has range checks, which would prevent vectorisation.
#[inline(always)]
pub(crate) fn round_to_whole(value: f32) -> u32 {
    (value + WHOLE_FROM).to_bits() - WHOLE_FROM.to_bits()
}

/// The whole number at or below a value from 0 to 2²².
#[inline(always)]
pub(crate) fn floor_to_whole(value: f32) -> u32 {
    round_to_whole(value) - u32::from(value + WHOLE_FROM - WHOLE_FROM > value)
}

/// atan2 of two numbers that are not negative, 0 for (0, 0): an odd polynomial of degree 11 on [0, 1], mirrored at 45°.
/// Ours: minimax coefficients by reweighted least squares, error below 1.7e-6.
#[inline(always)]
fn quarter_angle(y: f32, x: f32) -> f32 {
    const ATAN: [f32; 6] = [0.999_977_2, -0.332_622_83, 0.193_540_36, -0.116_426_45, 0.052_647_31, -0.011_719_12];
    let steep = y > x;
    let (small, large) = if steep { (x, y) } else { (y, x) };
    // The lower bound makes 0/0 0.
    let t = small / if large > f32::MIN_POSITIVE { large } else { f32::MIN_POSITIVE };
    let s = t * t;
    let p = ATAN.iter().rev().fold(0.0, |p, c| p * s + c) * t;
    if steep { FRAC_PI_2 - p } else { p }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The exact column, and the distance from the position to the nearest column border, in columns.
    fn exact(x: f32, y: f32, columns: u16) -> (usize, f64) {
        let turns = libm::atan2(f64::from(y), f64::from(x)) / std::f64::consts::TAU;
        let column = turns.rem_euclid(1.0) * f64::from(columns);
        (column as usize % usize::from(columns), (column - column.round()).abs())
    }

    #[test]
    fn a_position_falls_into_the_column_of_its_azimuth() {
        for columns in [8, 90, 180, 360, 1440] {
            let azimuths = AzimuthColumns::new(columns);
            for step in 0..200_000 {
                let (angle, range) = (f64::from(step) * 3.141_59e-5, 1.0 + f64::from(step % 97) * 0.7);
                let (x, y) = ((range * libm::cos(angle)) as f32, (range * libm::sin(angle)) as f32);
                let (column, from_border) = exact(x, y, columns);
                // A thousandth of a column at 1440 columns is 4 µrad, a quarter of a millimetre at 60 m.
                if from_border > 1e-3 {
                    assert_eq!(azimuths.column(x, y) as usize, column, "{columns} columns, ({x}, {y})");
                }
            }
        }
    }

    #[test]
    fn each_axis_lies_in_the_first_column_of_its_quadrant() {
        let azimuths = AzimuthColumns::new(360);
        let axes = [([1.0, 0.0], 0), ([0.0, 1.0], 90), ([-1.0, 0.0], 180), ([0.0, -1.0], 270), ([1.0, -1e-7], 359)];
        for ([x, y], column) in axes {
            assert_eq!(azimuths.column(x, y) as usize, column, "({x}, {y})");
        }
        assert_eq!(azimuths.column(0.0, 0.0), 0);
        assert_eq!(azimuths.column(-0.0, -0.0), 0);
    }
}
