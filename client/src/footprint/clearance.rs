//! The clearance of every cell: how far it is to the nearest cell that is not free.
//!
//! In: a layer of squares. Out: for each cell the distance in metres from its centre to the nearest point of a cell
//! that is not free, exact up to a bound; 0 in such a cell. What lies outside the grid is not free. Distances are sums
//! of squares of half cells, which are integers, so that all clients get the same bits.

use clearway_proto::grid::Grid;

use super::kinds::{ClassKind, class_of, kinds};
use crate::error::ClientError;
use crate::view::MapView;

/// Distance of every cell of a layer to the nearest cell that is not free.
#[derive(Clone, Debug, PartialEq)]
pub struct Clearance {
    /// Where the cells lie.
    pub grid: Grid,
    /// Distance of each cell in metres, in the order of the grid's cells.
    pub cells_m: Vec<f64>,
}

impl Clearance {
    /// The clearance of the cell at a point, in metres; 0 outside the grid.
    pub fn at(&self, x_m: f64, y_m: f64) -> f64 {
        self.grid.cell_at(x_m, y_m).map_or(0.0, |cell| self.cells_m[cell])
    }
}

impl MapView {
    /// The clearance of every cell of a layer, in metres, at most `most_m`. Low things do not count as free, unless
    /// `passes_low` is true: for a vehicle that clears them.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer, [`ClientError::NoSquares`] if its grid is radial,
    /// [`ClientError::Shape`] if `most_m` is not finite or negative.
    pub fn clearance(&self, layer: &str, most_m: f64, passes_low: bool) -> Result<Clearance, ClientError> {
        super::shape::length("most_m", most_m)?;
        let layer = self.layer(layer)?;
        let Grid::Cartesian { width, height, cell_m, .. } = layer.grid else {
            return Err(ClientError::NoSquares { layer: layer.name.clone() });
        };
        let (width, height) = (width as usize, height as usize);
        let kinds = kinds(layer);
        let is_free = |cell: usize| match class_of(layer, cell).map(|class| kinds[class]) {
            Some(ClassKind::Free) => true,
            Some(ClassKind::Low) => passes_low,
            Some(ClassKind::Blocks) | None => false,
        };
        let reach = (most_m / f64::from(cell_m) + 0.5).ceil().min((width + height) as f64) as u32;
        let down = steps_down(width, height, reach, is_free);
        let half_m = f64::from(cell_m) / 2.0;
        let mut cells_m = Vec::with_capacity(width * height);
        for row in down.chunks_exact(width) {
            for column in 0..width {
                let around = (0..=reach.min(width as u32)).flat_map(|by| {
                    let left = column.checked_sub(by as usize).map_or(0, |column| row[column]);
                    let right = row.get(column + by as usize).copied().unwrap_or(0);
                    [(by, left), (by, right)]
                });
                let squared = around.map(|(by, down)| halves(by) + halves(down)).min().unwrap_or(0);
                cells_m.push(((squared as f64).sqrt() * half_m).min(most_m));
            }
        }
        Ok(Clearance { grid: layer.grid.clone(), cells_m })
    }
}

/// Square of the half cells between a cell's centre and the nearest edge of the cell `steps` further on.
fn halves(steps: u32) -> u64 {
    let halves = u64::from((2 * steps).saturating_sub(1));
    halves * halves
}

/// For each cell the number of cells up or down its column to the nearest cell that is not free, at most `reach`.
fn steps_down(width: usize, height: usize, reach: u32, is_free: impl Fn(usize) -> bool) -> Vec<u32> {
    let mut steps: Vec<u32> = (0..width * height).map(|cell| if is_free(cell) { reach } else { 0 }).collect();
    for column in 0..width {
        // Outside the grid nothing is free.
        let mut pass = |rows: &mut dyn Iterator<Item = usize>| {
            let mut before = 0;
            for row in rows {
                let cell = &mut steps[row * width + column];
                *cell = (*cell).min(before + 1);
                before = *cell;
            }
        };
        pass(&mut (0..height));
        pass(&mut (0..height).rev());
    }
    steps
}
