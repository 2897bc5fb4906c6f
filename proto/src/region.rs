//! The part of a layer that holds a rectangle of the ego frame.
//!
//! In: a whole layer and a `Region`. Out: a layer like it with fewer cells, its channels encoded anew.
//!
//! A Cartesian grid keeps the smallest rectangle of its cells that holds the region; where it turns under the vehicle,
//! that of the turned region. A radial grid keeps the rows from the vehicle to the region's farthest corner, with all
//! columns. Planes, figures, legend and safe points stay whole: they tell of the layer, not of its cells.

use crate::by_class::encode_beside;
use crate::codec::{Cells, CellsRef, Limits, encode_grid};
use crate::grid::{Grid, turned};
use crate::map::{MapError, decode_layer};
use crate::v1;

/// Why a layer has no such part.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RegionError {
    /// A rectangle that is none.
    #[error("region {region:?}: finite metres are needed, each from below its to")]
    Bounds {
        /// As it was asked for.
        region: v1::Region,
    },
    /// No cell of the layer lies in it.
    #[error("layer {layer:?} has no cell in the region {region:?}; it reaches {range_m_max} m from the vehicle")]
    Outside {
        /// The layer's name.
        layer: String,
        /// As it was asked for.
        region: v1::Region,
        /// [`Grid::range_m_max`].
        range_m_max: f64,
    },
    /// The layer is not whole or cannot be read.
    #[error(transparent)]
    Layer(#[from] MapError),
}

/// Checks that a region is a rectangle.
///
/// # Errors
/// [`RegionError::Bounds`].
pub fn check(region: &v1::Region) -> Result<(), RegionError> {
    let v1::Region { x_from_m, x_to_m, y_from_m, y_to_m } = *region;
    let finite = [x_from_m, x_to_m, y_from_m, y_to_m].iter().all(|metres| metres.is_finite());
    if finite && x_from_m < x_to_m && y_from_m < y_to_m { Ok(()) } else { Err(RegionError::Bounds { region: *region }) }
}

/// The part of `layer` that holds `region`; the layer itself where that is all of it.
///
/// # Errors
/// [`RegionError`], with what was asked for and how far the layer reaches.
pub fn crop(layer: &v1::Layer, region: &v1::Region, limits: &Limits) -> Result<v1::Layer, RegionError> {
    check(region)?;
    let decoded = decode_layer(layer.clone(), None, limits)?;
    let [rows, columns] = part(&decoded.grid, region).ok_or_else(|| RegionError::Outside {
        layer: layer.name.clone(),
        region: *region,
        range_m_max: decoded.grid.range_m_max(),
    })?;
    let columns_before = decoded.grid.shape().1 as usize;
    if rows.len() * columns.len() == decoded.grid.cell_count() as usize {
        return Ok(layer.clone());
    }
    let mut cropped = layer.clone();
    match &mut cropped.geometry {
        Some(v1::layer::Geometry::Radial(grid)) => grid.r_bench_m.truncate(rows.len()),
        Some(v1::layer::Geometry::Cartesian(grid)) => {
            grid.origin_x_m += columns.start as f64 * f64::from(grid.cell_m);
            grid.origin_y_m += rows.start as f64 * f64::from(grid.cell_m);
            grid.first_ix = grid.first_ix.wrapping_add(columns.start as i64);
            grid.first_iy = grid.first_iy.wrapping_add(rows.start as i64);
            (grid.width, grid.height) = (columns.len() as u32, rows.len() as u32);
        }
        None => {}
    }
    let class = decoded.channel("class").map(|class| kept(&class.cells, columns_before, &rows, &columns));
    for (channel, whole) in cropped.channels.iter_mut().zip(&decoded.channels) {
        let cells = kept(&whole.cells, columns_before, &rows, &columns);
        let encoded = match &class {
            Some(Cells::U8(class)) if channel.name != "class" => {
                encode_beside(cells.as_ref(), class, layer.legend.len(), columns.len())
            }
            _ => encode_grid(cells.as_ref(), columns.len()),
        };
        (channel.encoding, channel.cell_count) = (encoded.encoding.into(), encoded.cell_count);
        (channel.crc32, channel.payload, channel.by_class) = (encoded.crc32, encoded.payload, encoded.by_class);
    }
    Ok(cropped)
}

type Span = std::ops::Range<usize>;

/// The rows and columns of a grid that hold a region; `None` where there are none.
fn part(grid: &Grid, region: &v1::Region) -> Option<[Span; 2]> {
    let corners = [region.x_from_m, region.x_to_m].map(|x| [region.y_from_m, region.y_to_m].map(|y| (x, y)));
    let corners = corners.as_flattened();
    match grid {
        Grid::Radial { r_bench_m, columns } => {
            let nearest =
                region.x_from_m.max(0.0).max(-region.x_to_m).hypot(region.y_from_m.max(0.0).max(-region.y_to_m));
            let farthest = corners.iter().map(|(x, y)| x.hypot(*y)).fold(0.0, f64::max);
            let row_at = |range_m: f64| r_bench_m.partition_point(|&outer| f64::from(outer) < range_m);
            let rows = r_bench_m.len();
            (row_at(nearest) < rows).then(|| [0..rows.min(row_at(farthest) + 1), 0..*columns as usize])
        }
        Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            let along = corners.iter().map(|&(x, y)| <[f64; 2]>::from(turned(x, y, *yaw_rad)));
            let span = |axis: usize, origin_m: f64, cells: u32| {
                let places = along.clone().map(|at| (at[axis] - origin_m) / f64::from(*cell_m));
                let (from, to) = places.fold((f64::MAX, f64::MIN), |(from, to), at| (from.min(at), to.max(at)));
                let [from, to] = [from.floor(), to.ceil()].map(|at| at.clamp(0.0, f64::from(cells)) as usize);
                (from < to).then_some(from..to)
            };
            Some([span(1, *origin_y_m, *height)?, span(0, *origin_x_m, *width)?])
        }
    }
}

fn kept(cells: &Cells, columns_before: usize, rows: &Span, columns: &Span) -> Cells {
    fn of<T: Copy>(cells: &[T], columns_before: usize, rows: &Span, columns: &Span) -> Vec<T> {
        rows.clone().flat_map(|row| &cells[row * columns_before..][columns.clone()]).copied().collect()
    }
    match cells.as_ref() {
        CellsRef::U8(cells) => Cells::U8(of(cells, columns_before, rows, columns)),
        CellsRef::I8(cells) => Cells::I8(of(cells, columns_before, rows, columns)),
        CellsRef::U16(cells) => Cells::U16(of(cells, columns_before, rows, columns)),
    }
}
