//! The occupancies of a raster -> cells along the axes of a frame.
//!
//! In: the square cells of a layer, and the pose of their axes in the frame. Out: cells of the same edge along the axes
//! of the frame. Their borders lie at whole multiples of the edge, so that the cells of all maps coincide, and no grid
//! is rotated: Nav2's StaticLayer ignores the orientation of a grid. A cell gets the worst of the source cell at its
//! middle and the source cells whose middles lie in it, so that no obstacle is lost and unknown never becomes free. An
//! obstacle moves by half the diagonal of a cell at most.

use nalgebra::{Isometry3, Point2, Vector3};

use super::raster::{Raster, UNKNOWN, is_free, rank};

/// Occupancies of square cells along the axes of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct AlignedGrid {
    /// Corner of cell (0, 0), in metres.
    pub origin_m: [f64; 2],
    /// Cells along the frame's x axis.
    pub width: u32,
    /// Number of cells along the grid's y axis.
    pub height: u32,
    /// Row by row, x first: 0 free to 100 occupied, -1 unknown.
    pub occupancies: Vec<i8>,
}

impl AlignedGrid {
    /// The smallest grid that holds the whole raster. `occupancies` belong to the raster's cells. The position and
    /// the heading of the ego frame's pose count alone.
    pub fn new(raster: &Raster, occupancies: &[i8], frame_from_ego: &Isometry3<f64>) -> Self {
        let forward = frame_from_ego * Vector3::x();
        let heading = Isometry3::new(frame_from_ego.translation.vector, Vector3::z() * forward.y.atan2(forward.x));
        let Isometry3 { translation, rotation } = heading * raster.ego_from_raster;
        let edge_m = f64::from(raster.cell_m);
        let (sin, cos) = rotation.euler_angles().2.sin_cos();
        let corner = [translation.x / edge_m, translation.y / edge_m];
        // In edges: from the raster's axes to the frame's, and back.
        let placed = |x: f64, y: f64| Point2::new(corner[0] + cos * x - sin * y, corner[1] + sin * x + cos * y);
        let source = |x: f64, y: f64| {
            let (x, y) = (x - corner[0], y - corner[1]);
            Point2::new(cos * x + sin * y, cos * y - sin * x)
        };
        let (columns, rows) = (raster.width, raster.height);
        let corners = [(0, 0), (columns, 0), (0, rows), (columns, rows)];
        let corners = corners.map(|(x, y)| placed(f64::from(x), f64::from(y)));
        let first = corners.iter().fold(corners[0], |least, corner| least.inf(corner)).map(f64::floor);
        let end = corners.iter().fold(corners[0], |greatest, corner| greatest.sup(corner)).map(f64::ceil);
        let [width, height] = [(end - first).x, (end - first).y].map(|cells| cells as u32);
        let index = |at: Point2<f64>, width: u32, height: u32| {
            let inside = at.x >= 0.0 && at.x < f64::from(width) && at.y >= 0.0 && at.y < f64::from(height);
            inside.then(|| at.y as usize * width as usize + at.x as usize)
        };
        let mut cells = Vec::with_capacity(width as usize * height as usize);
        for row in 0..height {
            let start = source(first.x + 0.5, first.y + f64::from(row) + 0.5);
            let at_middle = |column: u32| {
                let by = f64::from(column);
                let middle = Point2::new(start.x + by * cos, start.y - by * sin);
                index(middle, columns, rows).map_or(UNKNOWN, |cell| occupancies[cell])
            };
            cells.extend((0..width).map(at_middle));
        }
        for (row, of_row) in (0..rows).zip(occupancies.chunks_exact(columns as usize)) {
            let start = placed(0.5, f64::from(row) + 0.5) - first.coords;
            for (column, &occupancy) in (0..columns).zip(of_row).filter(|(_, occupancy)| !is_free(**occupancy)) {
                let by = f64::from(column);
                let middle = Point2::new(start.x + by * cos, start.y + by * sin);
                if let Some(cell) = index(middle, width, height) {
                    cells[cell] = std::cmp::max_by_key(cells[cell], occupancy, |occupancy| rank(*occupancy));
                }
            }
        }
        Self { origin_m: [first.x * edge_m, first.y * edge_m], width, height, occupancies: cells }
    }
}
