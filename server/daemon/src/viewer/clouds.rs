//! A layer of squares -> points for Nav2's ObstacleLayer and VoxelLayer, in the ego frame, on the ground.
//!
//! Marking: the middles of the cells where something stands. Clearing: the ends of rays from the vehicle that pass free
//! cells alone. Nav2 clears every cell between the vehicle and such an end, so that a ray never leads past a cell that
//! is not free: unknown ground behind an obstacle stays unknown.

use std::f64::consts::TAU;

use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;
use nalgebra::Point3;

use super::raster::{Raster, meanings};

/// Steps in which a ray passes a cell. Ours: it cuts at most a corner of the cells between two steps.
const STEPS_PER_CELL: f64 = 2.0;

/// The middles of the cells where something stands. The raster belongs to the layer, which has squares.
pub fn obstacles(layer: &Layer, raster: &Raster) -> Vec<[f32; 3]> {
    let stands = |meaning| matches!(meaning, ClassMeaning::Occupied | ClassMeaning::Low);
    let cells = (0..raster.width * raster.height).zip(meanings(layer)).filter(|(_, meaning)| stands(*meaning));
    let middle = |(cell, _)| {
        let [column, row] = [cell % raster.width, cell / raster.width].map(|index| f64::from(index) + 0.5);
        let edge_m = f64::from(raster.cell_m);
        (raster.ego_from_raster * Point3::new(column * edge_m, row * edge_m, 0.0)).coords.cast::<f32>().into()
    };
    cells.map(middle).collect()
}

/// The ends of the rays that pass free cells alone, one ray for each cell at the edge of the layer.
pub fn ray_ends(layer: &Layer, raster: &Raster) -> Vec<[f32; 3]> {
    let edge_m = f64::from(raster.cell_m);
    let meanings = meanings(layer);
    let is_free = |place: Point3<f64>| {
        let [x, y] = [place.x / edge_m, place.y / edge_m];
        let inside = x >= 0.0 && y >= 0.0 && x < f64::from(raster.width) && y < f64::from(raster.height);
        inside && meanings[y as usize * raster.width as usize + x as usize] == ClassMeaning::Free
    };
    let origin = raster.ego_from_raster.inverse() * Point3::origin();
    let rays = 2 * (raster.width + raster.height);
    let step_m = edge_m / STEPS_PER_CELL;
    let end = |ray: u32| {
        let (sin, cos) = (TAU * f64::from(ray) / f64::from(rays)).sin_cos();
        let at = |step: u32| origin + nalgebra::Vector3::new(cos, sin, 0.0) * (step_m * f64::from(step));
        let blocked = (0..).find(|step| !is_free(at(*step)))?;
        let last = raster.ego_from_raster * at(blocked.checked_sub(1)?);
        Some(last.coords.cast::<f32>().into())
    };
    (0..rays).filter_map(end).collect()
}
