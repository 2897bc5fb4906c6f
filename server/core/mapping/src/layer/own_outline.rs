//! The cells in the vehicle's own outline are not occupied.
//!
//! In: a layer, and the outline, ego frame, metres. Out: the layer in which no square whose centre lies in the outline,
//! and no radial cell that touches it, is occupied: the vehicle itself, its load and its passengers return light there,
//! and a layer does not state where in a cell an obstacle stands. Such a cell is unknown.

use std::f32::consts::TAU;

use crate::layer::channel::TypedChannel;
use crate::layer::class::Meaning;
use crate::layer::grid::Geometry;
use crate::layer::maker::Layer;
use crate::vehicle_outline::Outline;

/// Shares of a radial cell's depth and width at which it is compared with the outline. Ours: a cell near the vehicle is
/// at most half a metre deep and a quarter of a metre wide.
const SHARES: [f32; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];

/// Makes the occupied cells in the outline unknown.
pub fn clear(layer: &mut Layer, outline: &Outline) {
    let mut class = TypedChannel::CLASS.reuse_values(&mut layer.channels);
    let legend = layer.legend;
    let is_occupied = |value: u8| legend.get(usize::from(value)).is_some_and(|of| of.meaning == Meaning::Occupied);
    let mut clear = |cell: usize, is_own: &dyn Fn() -> bool| {
        if let Some(value) = class.get_mut(cell).filter(|value| is_occupied(**value) && is_own()) {
            *value = 0;
        }
    };
    match &layer.geometry {
        Geometry::Radial { centre_m, row_radius_m, columns } => {
            let columns = usize::from(*columns);
            let reach_m =
                outline.front_m.max(outline.rear_m) + outline.width_m + libm::hypotf(centre_m[0], centre_m[1]);
            let inner = std::iter::once(&0.0).chain(row_radius_m);
            for (row, (inner_m, outer_m)) in inner.zip(row_radius_m).enumerate().take_while(|(_, (m, _))| **m < reach_m)
            {
                for column in 0..columns {
                    let is_own = |across: f32, along: f32| {
                        let (sin, cos) = libm::sincosf((column as f32 + across) / columns as f32 * TAU);
                        let range_m = inner_m + along * (outer_m - inner_m);
                        outline.contains(centre_m[0] + range_m * cos, centre_m[1] + range_m * sin)
                    };
                    clear(row * columns + column, &|| {
                        SHARES.iter().any(|across| SHARES.iter().any(|along| is_own(*across, *along)))
                    });
                }
            }
        }
        Geometry::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            let (sin, cos) = libm::sincos(*yaw_rad);
            let (cell_m, width, height) = (f64::from(*cell_m), *width as usize, *height as usize);
            let reach_m = f64::from(outline.front_m.max(outline.rear_m) + outline.width_m);
            let near = |origin_m: f64, most: usize| {
                let at = |metres: f64| ((metres - origin_m) / cell_m).clamp(0.0, most as f64) as usize;
                at(-reach_m)..at(reach_m)
            };
            for iy in near(*origin_y_m, height) {
                for ix in near(*origin_x_m, width) {
                    let centre = |origin_m: f64, index: usize| origin_m + (index as f64 + 0.5) * cell_m;
                    let [x, y] = [centre(*origin_x_m, ix), centre(*origin_y_m, iy)];
                    // From the grid's axes to the vehicle's axes.
                    let is_own = || outline.contains((cos * x + sin * y) as f32, (cos * y - sin * x) as f32);
                    clear(iy * width + ix, &is_own);
                }
            }
        }
    }
    TypedChannel::CLASS.store(&mut layer.channels, class);
}
