//! The part of a layer that contains a rectangle of the ego frame.
//!
//! In: a whole layer and a `Region`. Out: an equal layer with fewer cells; its channels are encoded again.
//!
//! A Cartesian grid keeps the smallest rectangle of cells that contains the region, or the rotated region if the grid
//! is rotated. A radial grid keeps the rows from the vehicle to the region's farthest corner, with all columns; cells
//! in rings and sectors that do not touch the region become unknown. Planes, metrics, legend and safe points stay
//! whole, because they describe the layer and not single cells.

use std::f64::consts::{PI, TAU};

use crate::channel::by_class::encode_beside;
use crate::channel::cells::{Cells, CellsRef};
use crate::channel::codec::encode_grid;
use crate::limits::Limits;
use crate::map::decode::decode_layer;
use crate::map::error::MapError;
use crate::map::grid::{Grid, rotate};
use crate::map::layer::Channel;
use crate::v1;

/// Why a layer has no part for a region.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RegionError {
    /// The region is not a rectangle.
    #[error("region {region:?}: finite metres are needed, and each `from` below its `to`")]
    Bounds {
        /// The region as requested.
        region: v1::Region,
    },
    /// No cell of the layer lies in the region.
    #[error("layer {layer:?} has no cell in the region {region:?}; it reaches {range_m_max} m from the vehicle")]
    Outside {
        /// Name of the layer.
        layer: String,
        /// The region as requested.
        region: v1::Region,
        /// Distance to the layer's farthest cell, [`Grid::range_m_max`].
        range_m_max: f64,
    },
    /// The layer is not whole or is invalid.
    #[error(transparent)]
    Layer(#[from] MapError),
}

/// Checks that a region is a rectangle.
///
/// # Errors
/// [`RegionError::Bounds`] if a coordinate is not finite, or a `from` is not less than its `to`.
pub fn check(region: &v1::Region) -> Result<(), RegionError> {
    let v1::Region { x_from_m, x_to_m, y_from_m, y_to_m } = *region;
    let finite = [x_from_m, x_to_m, y_from_m, y_to_m].iter().all(|metres| metres.is_finite());
    if finite && x_from_m < x_to_m && y_from_m < y_to_m { Ok(()) } else { Err(RegionError::Bounds { region: *region }) }
}

/// Cuts `layer` to the part that contains `region`; returns the layer itself if that is all of it.
///
/// # Errors
/// [`RegionError::Bounds`] if the region is not a rectangle, [`RegionError::Outside`] if no cell of the layer lies in
/// it, [`RegionError::Layer`] if the layer is a delta or invalid.
pub fn crop(layer: &v1::Layer, region: &v1::Region, limits: &Limits) -> Result<v1::Layer, RegionError> {
    check(region)?;
    let decoded = decode_layer(layer.clone(), None, limits)?;
    let part = GridPart::of(&decoded.grid, region).ok_or_else(|| RegionError::Outside {
        layer: layer.name.clone(),
        region: *region,
        range_m_max: decoded.grid.range_m_max(),
    })?;
    let shape = <[u32; 2]>::from(decoded.grid.shape()).map(|cells| cells as usize);
    if part.is_all_of(shape) {
        return Ok(layer.clone());
    }
    let GridPart { rows, columns, .. } = &part;
    let mut cropped = layer.clone();
    match &mut cropped.geometry {
        Some(v1::layer::Geometry::Radial(grid)) => grid.row_radius_m.truncate(rows.len()),
        Some(v1::layer::Geometry::Cartesian(grid)) => {
            grid.origin_x_m += columns.start as f64 * f64::from(grid.cell_m);
            grid.origin_y_m += rows.start as f64 * f64::from(grid.cell_m);
            grid.first_ix = grid.first_ix.wrapping_add(columns.start as i64);
            grid.first_iy = grid.first_iy.wrapping_add(rows.start as i64);
            (grid.width, grid.height) = (columns.len() as u32, rows.len() as u32);
        }
        None => {}
    }
    let class = decoded.channel("class").map(|class| part.cells(class, shape[1]));
    for (channel, whole) in cropped.channels.iter_mut().zip(&decoded.channels) {
        let cells = part.cells(whole, shape[1]);
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

/// Where a region lies in a grid.
struct GridPart {
    /// Rows and columns that are kept.
    rows: Span,
    columns: Span,
    /// Rows and columns that keep their cells; the others become unknown. Columns continue past the last one with the
    /// first: column `columns + 1` is column 1.
    known_rows: Span,
    known_columns: Span,
}

impl GridPart {
    /// The smallest part that contains the region; `None` if the region lies outside the grid.
    fn of(grid: &Grid, region: &v1::Region) -> Option<Self> {
        let corners = [region.x_from_m, region.x_to_m].map(|x| [region.y_from_m, region.y_to_m].map(|y| (x, y)));
        let corners = corners.as_flattened();
        match grid {
            Grid::Radial { centre_m, row_radius_m, columns } => {
                let [x, y] = centre_m.map(f64::from);
                let region = &v1::Region {
                    x_from_m: region.x_from_m - x,
                    x_to_m: region.x_to_m - x,
                    y_from_m: region.y_from_m - y,
                    y_to_m: region.y_to_m - y,
                };
                let corners: Vec<(f64, f64)> = corners.iter().map(|(to_x, to_y)| (to_x - x, to_y - y)).collect();
                let nearest =
                    region.x_from_m.max(0.0).max(-region.x_to_m).hypot(region.y_from_m.max(0.0).max(-region.y_to_m));
                let farthest = corners.iter().map(|(x, y)| x.hypot(*y)).fold(0.0, f64::max);
                let row_at = |range_m: f64| row_radius_m.partition_point(|&outer| f64::from(outer) < range_m);
                let rows = row_radius_m.len().min(row_at(farthest) + 1);
                let known_rows = row_at(nearest)..rows;
                let known_columns = sectors(region, &corners, *columns);
                let all = Self { rows: 0..rows, columns: 0..*columns as usize, known_rows, known_columns };
                (!all.known_rows.is_empty()).then_some(all)
            }
            Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
                let along = corners.iter().map(|&(x, y)| <[f64; 2]>::from(rotate(x, y, *yaw_rad)));
                let span = |axis: usize, origin_m: f64, cells: u32| {
                    let places = along.clone().map(|at| (at[axis] - origin_m) / f64::from(*cell_m));
                    let (from, to) = places.fold((f64::MAX, f64::MIN), |(from, to), at| (from.min(at), to.max(at)));
                    let [from, to] = [from.floor(), to.ceil()].map(|at| at.clamp(0.0, f64::from(cells)) as usize);
                    (from < to).then_some(from..to)
                };
                let (rows, columns) = (span(1, *origin_y_m, *height)?, span(0, *origin_x_m, *width)?);
                Some(Self { known_rows: rows.clone(), known_columns: columns.clone(), rows, columns })
            }
        }
    }

    fn is_all_of(&self, [rows, columns]: [usize; 2]) -> bool {
        self.known_rows.len() == rows && self.known_columns.len() == columns
    }

    /// The cells of a channel in the part; `columns_before`: columns of the whole grid.
    fn cells(&self, channel: &Channel, columns_before: usize) -> Cells {
        match channel.cells.as_ref() {
            CellsRef::U8(cells) => Cells::U8(self.cut(cells, columns_before, channel.unknown as u8)),
            CellsRef::I8(cells) => Cells::I8(self.cut(cells, columns_before, channel.unknown as i8)),
            CellsRef::U16(cells) => Cells::U16(self.cut(cells, columns_before, channel.unknown as u16)),
        }
    }

    fn cut<T: Copy>(&self, cells: &[T], columns_before: usize, unknown: T) -> Vec<T> {
        let is_known = |row: usize, column: usize| {
            let columns = &self.known_columns;
            self.known_rows.contains(&row)
                && (columns.contains(&column) || columns.contains(&(column + columns_before)))
        };
        let all = self.rows.clone().flat_map(|row| self.columns.clone().map(move |column| (row, column)));
        all.map(|(row, column)| if is_known(row, column) { cells[row * columns_before + column] } else { unknown })
            .collect()
    }
}

/// The columns of a radial grid that touch a region. Columns continue past the last one with the first.
fn sectors(region: &v1::Region, corners: &[(f64, f64)], columns: u32) -> Span {
    let v1::Region { x_from_m, x_to_m, y_from_m, y_to_m } = *region;
    let count = columns as usize;
    if x_from_m < 0.0 && x_to_m > 0.0 && y_from_m < 0.0 && y_to_m > 0.0 {
        return 0..count;
    }
    // The vehicle is not inside the region, so the region spans less than 180 degrees: measure to both sides of its
    // centre.
    let middle = (0.5 * (y_from_m + y_to_m)).atan2(0.5 * (x_from_m + x_to_m));
    let aside = corners.iter().map(|(x, y)| (y.atan2(*x) - middle + PI).rem_euclid(TAU) - PI);
    let (right, left) = aside.fold((0.0_f64, 0.0_f64), |(right, left), at| (right.min(at), left.max(at)));
    // A corner on the edge of a sector may round to either side: half a nanoradian includes both.
    let at = |azimuth: f64| (azimuth / TAU * f64::from(columns)).floor() as i64;
    let [first, last] = [at(middle + right - 5e-10), at(middle + left + 5e-10)];
    let from = first.rem_euclid(i64::from(columns)) as usize;
    from..from + count.min((last - first) as usize + 1)
}
