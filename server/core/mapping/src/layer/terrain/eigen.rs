//! Principal components of a covariance matrix, in closed form.
//!
//! In: variances xx, yy, zz and covariances xy, xz, yz, m². Out: the eigenvalues, and which eigenvalue belongs to the
//! most vertical eigenvector (Neuhaus 2009, eq. 1). The matrix is scaled first; then the characteristic polynomial is
//! solved trigonometrically in f64. Newton's method finds the cosine of a third of the angle, because the last bits of
//! the system's `acos` and `cos` differ from machine to machine. The vertical component of an eigenvector follows from
//! the eigenvalues of the matrix and of its horizontal part, so that no eigenvector is computed.

/// Least difference between two distinct eigenvalues, relative to the largest entry. Ours: below it, rounding decides
/// which eigenvector belongs to which value.
const DOUBLE: f64 = 1e-6;

/// Result of the principal component analysis of a set of points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Principal {
    /// Variance along the principal axes, m², largest first.
    pub values: [f64; 3],
    /// Index of the value along the most vertical axis.
    pub vertical: usize,
}

impl Principal {
    /// The principal components of a covariance matrix: xx, yy, zz, xy, xz, yz.
    pub fn from_covariance(covariance: [f64; 6]) -> Self {
        // A value that is not a number is not flat.
        if covariance.iter().any(|value| !value.is_finite()) {
            return Self { values: [f64::INFINITY; 3], vertical: 0 };
        }
        let scale = covariance.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
        if scale == 0.0 {
            return Self::default();
        }
        let scaled = covariance.map(|value| value / scale);
        let values = eigenvalues(scaled);
        Self { values: values.map(|value| (value * scale).max(0.0)), vertical: most_vertical(scaled, values) }
    }

    /// The local height disturbance h (eq. 1), m².
    pub fn height_disturbance(&self) -> f64 {
        self.values[self.vertical]
    }
}

/// Eigenvalues, largest first. Exchanging x and y does not change a bit of the result.
fn eigenvalues([xx, yy, zz, xy, xz, yz]: [f64; 6]) -> [f64; 3] {
    let mean = ((xx + yy) + zz) / 3.0;
    let (x, y, z) = (xx - mean, yy - mean, zz - mean);
    let spread = ((x * x + y * y) + z * z) + 2.0 * (xy * xy + (xz * xz + yz * yz));
    let radius = (spread / 6.0).sqrt();
    if radius < 1e-15 {
        return [mean; 3];
    }
    let determinant = ((x * y) * z + 2.0 * (xy * (xz * yz))) - (x * (yz * yz) + y * (xz * xz)) - z * (xy * xy);
    let cosine = (determinant / (2.0 * radius * radius * radius)).clamp(-1.0, 1.0);
    // In units of twice the radius from the mean, one of the outer eigenvalues is the cosine of a third of the angle,
    // on the side of the cosine's sign. The two others solve the quadratic equation that remains.
    let single = cosine_of_third(cosine.abs());
    let (middle, spread) = (-single / 2.0, (3.0 * (1.0 - single * single)).max(0.0).sqrt() / 2.0);
    let own = [single, middle + spread, middle - spread].map(|value| 2.0 * radius * value);
    if cosine < 0.0 { [mean - own[2], mean - own[1], mean - own[0]] } else { own.map(|value| mean + value) }
}

/// cos(acos(cosine) / 3) for 0 <= cosine <= 1: the root of 4c³ - 3c = cosine between 0.86 and 1, where the slope is 6
/// to 9.
fn cosine_of_third(cosine: f64) -> f64 {
    // The chord is off by less than 0.006; the fourth step squares the error to less than rounding.
    let mut c = 0.866_025_403_784_438_6 + 0.133_974_596_215_561_4 * cosine;
    for _ in 0..4 {
        c -= ((4.0 * c * c - 3.0) * c - cosine) / (12.0 * c * c - 3.0);
    }
    c
}

/// Index of the eigenvalue with the most vertical eigenvector.
fn most_vertical([xx, yy, _, xy, ..]: [f64; 6], values: [f64; 3]) -> usize {
    let [a, b, c] = values;
    // Squared vertical component of the eigenvector of the value `of`; `others` are the two other values.
    let vertical =
        |of: f64, others: [f64; 2]| ((xx - of) * (yy - of) - xy * xy) / ((of - others[0]) * (of - others[1]));
    let (upper, lower) = (a - b < DOUBLE, b - c < DOUBLE);
    match (upper, lower) {
        // Each direction is an eigenvector.
        (true, true) => 0,
        // One eigenvector in the plane of a double value is as vertical as the plane.
        (true, false) => {
            let single = vertical(c, [a, b]);
            if single > 1.0 - single { 2 } else { 0 }
        }
        (false, true) => {
            let single = vertical(a, [b, c]);
            if single > 1.0 - single { 0 } else { 1 }
        }
        (false, false) => {
            let shares = [vertical(a, [b, c]), vertical(b, [a, c]), vertical(c, [a, b])];
            let above = |i: usize, j: usize| shares[i] > shares[j];
            if above(0, 1) && above(0, 2) {
                0
            } else if above(1, 2) {
                1
            } else {
                2
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Rotation3, Vector3};
    use proptest::prelude::*;

    fn entries(m: &Matrix3<f64>) -> [f64; 6] {
        [m[(0, 0)], m[(1, 1)], m[(2, 2)], m[(0, 1)], m[(0, 2)], m[(1, 2)]]
    }

    proptest! {
        #[test]
        fn a_matrix_made_from_eigenvalues_gives_them_back(
            values in prop::array::uniform3(0f64..30.0), roll in -3f64..3.0, pitch in -1.5f64..1.5, yaw in -3f64..3.0,
            thin in 0f64..1.0,
        ) {
            let mut values = values;
            values[2] *= libm::pow(thin, 6.0);
            let axes = Rotation3::from_euler_angles(roll, pitch, yaw);
            let matrix = axes.matrix() * Matrix3::from_diagonal(&Vector3::from(values)) * axes.matrix().transpose();
            let found = Principal::from_covariance(entries(&matrix));
            let mut sorted = values;
            sorted.sort_by(|a, b| b.total_cmp(a));
            for (found, made) in found.values.iter().zip(sorted) {
                prop_assert!((found - made).abs() < 1e-9 * sorted[0], "{found} {made}");
            }
            let shares: Vec<f64> = (0..3).map(|i| axes.matrix()[(2, i)] * axes.matrix()[(2, i)]).collect();
            let most = (0..3).max_by(|i, j| shares[*i].total_cmp(&shares[*j])).unwrap();
            let clear = (0..3).all(|i| i == most || shares[most] - shares[i] > 1e-3);
            let apart = (0..3).all(|i| i == most || (values[most] - values[i]).abs() > 1e-4 * sorted[0]);
            if clear && apart {
                prop_assert!((found.height_disturbance() - values[most]).abs() < 1e-9 * sorted[0]);
            }
        }
    }

    #[test]
    fn the_cosine_of_a_third_agrees_with_acos_and_cos() {
        for step in 0..=1000 {
            let cosine = f64::from(step) / 1000.0;
            assert!((cosine_of_third(cosine) - libm::cos(libm::acos(cosine) / 3.0)).abs() < 4e-16, "{cosine}");
        }
    }

    #[test]
    fn exact_shapes_have_their_height_disturbance() {
        let h = |covariance| Principal::from_covariance(covariance).height_disturbance();
        // Level plane, pole, wall, ball, line along x, nothing.
        assert_eq!(h([1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), 0.0);
        assert!((h([1e-4, 1e-4, 1.0, 0.0, 0.0, 0.0]) - 1.0).abs() < 1e-12);
        assert!((h([0.0, 1.0, 0.5, 0.0, 0.0, 0.0]) - 0.5).abs() < 1e-12);
        assert!((h([2.0, 2.0, 2.0, 0.0, 0.0, 0.0]) - 2.0).abs() < 1e-12);
        // With a double value half the digits are lost.
        assert!(h([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]).abs() < 1e-7);
        assert_eq!(h([0.0; 6]), 0.0);
        assert_eq!(h([f64::NAN; 6]), f64::INFINITY);
        assert_eq!(h([1.0, 1.0, f64::NAN, 0.0, 0.0, 0.0]), f64::INFINITY);
        // A plane rising by 30 %.
        assert!(h([1.0, 1.0, 0.09, 0.0, 0.3, 0.0]).abs() < 1e-12);
    }
}
