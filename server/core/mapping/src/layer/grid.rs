//! Where the cells of a layer lie, in the ego frame: x forward, y left, origin at the vehicle's reference point.

/// Grid of a layer: how many cells it has, and which part of the ground each covers.
#[derive(Clone, Debug, PartialEq)]
pub enum Geometry {
    /// r-θ grid: cell index = row * columns + column; row 0 is innermost, row j spans ranges from the centre
    /// `(row_radius_m[j-1], row_radius_m[j]]`; column c spans azimuths [c, c+1) * 2π/columns about the centre,
    /// counter-clockwise from the direction of the ego x axis.
    Radial {
        /// Position (x, y) of the centre, metres: the sensor whose lasers define the rows.
        centre_m: [f32; 2],
        /// Outer radius of each row, metres, ascending. The drivability thesis calls it `r_bench`.
        row_radius_m: Vec<f32>,
        /// Number of columns.
        columns: u16,
    },
    /// Square cells: index = iy * width + ix; cell (ix, iy) spans `origin + i * cell_m` to `origin + (i + 1) * cell_m`
    /// along the grid's axes. The grid's axes have the same origin as the ego frame: a point (x, y) of the ego frame
    /// has the grid coordinates `(x cos yaw - y sin yaw, x sin yaw + y cos yaw)`.
    Cartesian {
        /// Position of the corner of cell (0, 0) along the grid's x axis, metres.
        origin_x_m: f64,
        /// Position of the corner of cell (0, 0) along the grid's y axis, metres.
        origin_y_m: f64,
        /// Number of cells along x.
        width: u32,
        /// Number of cells along y.
        height: u32,
        /// Side of a cell, metres.
        cell_m: f32,
        /// Heading of the ego frame in the grid's axes, radians; 0 if the grid has the vehicle's axes.
        yaw_rad: f64,
        /// Index (x, y) of cell (0, 0) in the world's grid; 0 if the grid has the vehicle's axes.
        first_cell: [i64; 2],
    },
}

impl Geometry {
    /// An r-θ grid of `columns` columns about the ego origin, without rows.
    pub fn radial(columns: u16) -> Self {
        Self::Radial { centre_m: [0.0; 2], row_radius_m: Vec::new(), columns }
    }

    /// A square of `side` x `side` cells (an even number) along the vehicle's axes, with the vehicle in the middle.
    pub fn about_vehicle(side: u32, cell_m: f32) -> Self {
        let corner_m = -f64::from(side / 2) * f64::from(cell_m);
        Self::Cartesian {
            origin_x_m: corner_m,
            origin_y_m: corner_m,
            width: side,
            height: side,
            cell_m,
            yaw_rad: 0.0,
            first_cell: [0, 0],
        }
    }
}
