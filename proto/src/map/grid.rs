//! Where the cells of a layer lie: point in the ego frame (x forward, y left, metres) <-> cell index.
//!
//! In: `RadialGrid` or `CartesianGrid` from the wire, checked. Out: look-ups that never panic; a point outside the grid
//! has no cell.

use std::f64::consts::TAU;

use crate::map::error::MapError;
use crate::v1;

/// The geometry of one layer, checked.
#[derive(Clone, Debug, PartialEq)]
pub enum Grid {
    /// Rings and sectors around a centre. Cell index = row * columns + column. Row j spans (row_radius_m\[j-1\],
    /// row_radius_m\[j\]], row 0 starts at the centre; column c spans azimuths [c, c+1) * 2π / columns about the
    /// centre, counter-clockwise from the direction of the ego x axis.
    Radial {
        /// Position (x, y) of the centre in metres.
        centre_m: [f32; 2],
        /// Outer radius of each row in metres, ascending.
        row_radius_m: Vec<f32>,
        /// Number of columns (sectors), at least 1.
        columns: u32,
    },
    /// Squares. Cell index = iy * width + ix; cell (ix, iy) spans [origin + i * cell_m, origin + (i+1) * cell_m) along
    /// the grid's axes, which start at the origin of the ego frame.
    Cartesian {
        /// Corner of cell (0, 0) along the x axis, in metres.
        origin_x_m: f64,
        /// Corner of cell (0, 0) along the y axis, in metres.
        origin_y_m: f64,
        /// Number of cells along x, at least 1.
        width: u32,
        /// Number of cells along y, at least 1.
        height: u32,
        /// Edge of a cell in metres.
        cell_m: f32,
        /// Heading of the ego frame seen from the grid's axes; 0 if the axes are the vehicle's own.
        yaw_rad: f64,
        /// Number of cell (0, 0) along x in the endless grid that map.proto defines.
        first_ix: i64,
        /// Number of cell (0, 0) along y in the endless grid.
        first_iy: i64,
    },
}

impl Grid {
    /// Checks a layer's geometry.
    ///
    /// # Errors
    /// [`MapError::Geometry`] if the grid is absent, has no cell, has radii that are not finite and ascending, or has
    /// an edge, origin or heading that is impossible.
    pub fn from_wire(layer: &v1::Layer) -> Result<Self, MapError> {
        let wrong = |what: String| MapError::Geometry { layer: layer.name.clone(), what };
        match &layer.geometry {
            None => Err(wrong("none given; radial or cartesian is needed".into())),
            Some(v1::layer::Geometry::Radial(v1::RadialGrid { row_radius_m, columns, centre_x_m, centre_y_m })) => {
                if *columns == 0 || row_radius_m.is_empty() {
                    return Err(wrong(format!(
                        "{} rows and {columns} columns; at least 1 of each is needed",
                        row_radius_m.len()
                    )));
                }
                let mut inner = 0.0;
                for (row, &outer) in row_radius_m.iter().enumerate() {
                    if !outer.is_finite() || outer <= inner {
                        return Err(wrong(format!(
                            "row {row} has a radius of {outer} m; a finite value above {inner} m is needed"
                        )));
                    }
                    inner = outer;
                }
                let centre_m = [*centre_x_m, *centre_y_m];
                if !centre_m.iter().all(|place| place.is_finite()) {
                    return Err(wrong(format!("centre ({centre_x_m}, {centre_y_m}) m; finite values are needed")));
                }
                Ok(Self::Radial { centre_m, row_radius_m: row_radius_m.clone(), columns: *columns })
            }
            Some(v1::layer::Geometry::Cartesian(grid)) => {
                let v1::CartesianGrid { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix, first_iy } =
                    *grid;
                if width == 0 || height == 0 {
                    return Err(wrong(format!("{width} x {height} cells; at least 1 x 1 is needed")));
                }
                if !cell_m.is_finite() || cell_m <= 0.0 {
                    return Err(wrong(format!("cells of {cell_m} m; a finite edge above 0 is needed")));
                }
                if !origin_x_m.is_finite() || !origin_y_m.is_finite() {
                    return Err(wrong(format!("origin ({origin_x_m}, {origin_y_m}) m; finite values are needed")));
                }
                if !yaw_rad.is_finite() {
                    return Err(wrong(format!("yaw {yaw_rad} rad; a finite value is needed")));
                }
                Ok(Self::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix, first_iy })
            }
        }
    }

    /// Shape of the array of cells as (rows, columns); (height, width) for a Cartesian grid.
    pub fn shape(&self) -> (u32, u32) {
        match self {
            Self::Radial { row_radius_m, columns, .. } => (row_radius_m.len() as u32, *columns),
            Self::Cartesian { width, height, .. } => (*height, *width),
        }
    }

    /// Number of cells.
    pub fn cell_count(&self) -> u64 {
        let (rows, columns) = self.shape();
        u64::from(rows) * u64::from(columns)
    }

    /// Index of the cell that contains a point (ego frame, metres); `None` outside the grid and if a coordinate is not
    /// finite.
    pub fn cell_at(&self, x_m: f64, y_m: f64) -> Option<usize> {
        if !x_m.is_finite() || !y_m.is_finite() {
            return None;
        }
        match self {
            Self::Radial { centre_m, row_radius_m, columns } => {
                let [x_m, y_m] = [x_m - f64::from(centre_m[0]), y_m - f64::from(centre_m[1])];
                let range_m = x_m.hypot(y_m);
                let row = row_radius_m.partition_point(|&outer| f64::from(outer) < range_m);
                if row == row_radius_m.len() {
                    return None;
                }
                let share = (y_m.atan2(x_m) / TAU).rem_euclid(1.0);
                // A share just below 1 can round up to `columns`.
                let column = ((share * f64::from(*columns)) as usize).min(*columns as usize - 1);
                Some(row * *columns as usize + column)
            }
            Self::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
                let (x_m, y_m) = rotate(x_m, y_m, *yaw_rad);
                let ix = ((x_m - origin_x_m) / f64::from(*cell_m)).floor();
                let iy = ((y_m - origin_y_m) / f64::from(*cell_m)).floor();
                let inside = ix >= 0.0 && ix < f64::from(*width) && iy >= 0.0 && iy < f64::from(*height);
                inside.then(|| iy as usize * *width as usize + ix as usize)
            }
        }
    }

    /// Centre (x, y) of a cell in the ego frame, in metres; `None` past the last cell.
    pub fn centre_of(&self, index: usize) -> Option<(f64, f64)> {
        if index as u64 >= self.cell_count() {
            return None;
        }
        Some(match self {
            Self::Radial { centre_m, row_radius_m, columns } => {
                let (row, column) = (index / *columns as usize, index % *columns as usize);
                let inner = if row == 0 { 0.0 } else { f64::from(row_radius_m[row - 1]) };
                let range_m = 0.5 * (inner + f64::from(row_radius_m[row]));
                let (sin, cos) = ((column as f64 + 0.5) / f64::from(*columns) * TAU).sin_cos();
                (range_m * cos + f64::from(centre_m[0]), range_m * sin + f64::from(centre_m[1]))
            }
            Self::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } => {
                let (ix, iy) = (index % *width as usize, index / *width as usize);
                let edge = f64::from(*cell_m);
                rotate(origin_x_m + (ix as f64 + 0.5) * edge, origin_y_m + (iy as f64 + 0.5) * edge, -yaw_rad)
            }
        })
    }

    /// Greatest distance of the grid's edge from the vehicle along the grid's axes, in metres.
    pub fn range_m_max(&self) -> f64 {
        match self {
            Self::Radial { centre_m, row_radius_m, .. } => {
                let [x, y] = centre_m.map(|place| f64::from(place.abs()));
                row_radius_m.last().map_or(0.0, |&r| f64::from(r)) + x.max(y)
            }
            Self::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, .. } => {
                let end_x = origin_x_m + f64::from(*width) * f64::from(*cell_m);
                let end_y = origin_y_m + f64::from(*height) * f64::from(*cell_m);
                origin_x_m.abs().max(end_x.abs()).max(origin_y_m.abs()).max(end_y.abs())
            }
        }
    }
}

/// Rotates a point counter-clockwise about the origin. An angle of 0 leaves every bit of it as it is.
pub(crate) fn rotate(x: f64, y: f64, angle: f64) -> (f64, f64) {
    let (sin, cos) = angle.sin_cos();
    (x * cos - y * sin, x * sin + y * cos)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_radial_grid_is_looked_up_about_its_own_centre() {
        let grid = |centre_m| Grid::Radial { centre_m, row_radius_m: vec![1.0, 2.5], columns: 12 };
        let off = grid([1.5, -0.5]);
        assert_eq!(off.cell_at(1.6, -0.4), Some(1));
        assert_eq!([off.cell_at(4.1, -0.5), off.cell_at(-0.9, -0.4)], [None, Some(17)]);
        assert_eq!(off.range_m_max(), 4.0);
        for cell in 0..24 {
            let (x, y) = off.centre_of(cell).unwrap();
            assert_eq!(off.cell_at(x, y), Some(cell));
            let (about_x, about_y) = grid([0.0; 2]).centre_of(cell).unwrap();
            assert!((about_x + 1.5 - x).hypot(about_y - 0.5 - y) < 1e-12);
        }
    }

    #[test]
    fn a_rotated_grid_is_looked_up_along_its_own_axes() {
        let grid = |yaw_rad| Grid::Cartesian {
            origin_x_m: -2.0,
            origin_y_m: -2.0,
            width: 4,
            height: 4,
            cell_m: 1.0,
            yaw_rad,
            first_ix: 0,
            first_iy: 0,
        };
        // The vehicle heads along the grid's y axis: ahead is up the rows, to the left is down the columns.
        let quarter = grid(TAU / 4.0);
        assert_eq!(
            [(1.5, 0.5), (-0.5, 1.5), (2.5, 0.0)].map(|(x, y)| quarter.cell_at(x, y)),
            [Some(13), Some(4), None]
        );
        for yaw_rad in [0.0, 0.3, -2.0, 4.0] {
            let grid = grid(yaw_rad);
            for cell in 0..16 {
                let (x, y) = grid.centre_of(cell).unwrap();
                assert_eq!(grid.cell_at(x, y), Some(cell), "yaw {yaw_rad}");
            }
        }
    }

    #[test]
    fn the_farthest_edge_along_the_axes_is_the_range() {
        let grid = |origin_x_m, origin_y_m| Grid::Cartesian {
            origin_x_m,
            origin_y_m,
            width: 4,
            height: 4,
            cell_m: 1.0,
            yaw_rad: 0.3,
            first_ix: 0,
            first_iy: 0,
        };
        let ranges = [[-3.0, -2.0], [-1.0, -2.0], [-2.0, -3.5], [-2.0, 0.5]].map(|[x, y]| grid(x, y).range_m_max());
        assert_eq!(ranges, [3.0, 3.0, 3.5, 4.5]);
    }
}
