//! A layer -> square cells, as occupancies and as a picture.
//!
//! In: a layer, Cartesian or radial. Out: row by row, x first, an occupancy (0 free to 100 occupied, -1 unknown) or
//! red, green, blue and alpha for each cell; and the position of the cells in the ego frame. A Cartesian layer keeps
//! its cells and its axes. A radial layer is resampled: a square cell gets the worst of the radial cell at its middle
//! and the radial cells whose middles lie in it, so that near the vehicle, where radial cells are smaller, no obstacle
//! is lost. Unknown is worse than free.
//!
//! | occupancy | meaning of the class |
//! |---|---|
//! | 0 | free |
//! | 100 | occupied, low, not reached |
//! | -1 | unknown, inferred, hidden |
//!
//! There is no value between, because planners with a threshold treat less than 100 as free.

use std::collections::BTreeMap;

use clearway_proto::codec::Cells;
use clearway_proto::grid::Grid;
use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;
use nalgebra::{Isometry3, Vector3};

use crate::viewer::colours::Colours;

/// Edge of the cells to which radial layers are resampled, in metres, equal to the cells of the other layers.
const CELL_M: f64 = 0.25;
/// Most square cells from the vehicle to the edge; larger grids get larger cells.
const CELLS_MAX: f64 = 1000.0;
/// Index of a square outside the layer.
const NOWHERE: u32 = u32::MAX;

/// Occupancy of an unknown cell.
pub const UNKNOWN: i8 = -1;
/// Occupancy of a free cell.
pub const FREE: i8 = 0;
/// Occupancy of a cell that a planner must not enter.
pub const OCCUPIED: i8 = 100;

/// The square cells of a grid, and the cells of the grid that they show.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    grid: Grid,
    /// Cells along the raster's x axis.
    pub width: u32,
    /// Number of cells along the raster's y axis.
    pub height: u32,
    /// Edge of a cell, in metres.
    pub cell_m: f32,
    /// Pose of the raster in the ego frame: the corner of cell (0, 0), and the axes.
    pub ego_from_raster: Isometry3<f64>,
    /// Resampled cells; `None` if the raster has the grid's own cells.
    samples: Option<Samples>,
}

/// Cells of a radial grid for each square cell.
#[derive(Clone, Debug, PartialEq)]
struct Samples {
    /// The cell at the middle of each square, or [`NOWHERE`].
    at_middle: Vec<u32>,
    /// Square cells, each with a radial cell whose middle lies in it.
    inside: Vec<(u32, u32)>,
}

impl Raster {
    /// The raster of a grid; [`Rasters`] keeps it while the grid stays the same.
    pub fn from_grid(grid: &Grid) -> Self {
        match *grid {
            Grid::Radial { .. } => Self::from_radial(grid),
            Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
                let ego_from_axes = Isometry3::rotation(Vector3::z() * -yaw_rad);
                let ego_from_raster = ego_from_axes * Isometry3::translation(origin_x_m, origin_y_m, 0.0);
                Self { grid: grid.clone(), width, height, cell_m, ego_from_raster, samples: None }
            }
        }
    }

    fn from_radial(grid: &Grid) -> Self {
        let range_m = grid.range_m_max();
        let cell_m = CELL_M.max(range_m / CELLS_MAX) as f32;
        let edge = f64::from(cell_m);
        let half = (range_m / edge).ceil();
        let (side, corner_m) = (2 * half as usize, -half * edge);
        let middle = |index: usize| corner_m + (index as f64 + 0.5) * edge;
        let at_middle = (0..side * side)
            .map(|index| grid.cell_at(middle(index % side), middle(index / side)).map_or(NOWHERE, |cell| cell as u32));
        let of_middle = |cell: u32| {
            let (x_m, y_m) = grid.centre_of(cell as usize)?;
            let [column, row] = [x_m, y_m].map(|m| (((m - corner_m) / edge) as usize).min(side - 1));
            Some(((row * side + column) as u32, cell))
        };
        let samples = Samples {
            at_middle: at_middle.collect(),
            inside: (0..grid.cell_count() as u32).filter_map(of_middle).collect(),
        };
        Self {
            grid: grid.clone(),
            width: side as u32,
            height: side as u32,
            cell_m,
            ego_from_raster: Isometry3::translation(corner_m, corner_m, 0.0),
            samples: Some(samples),
        }
    }

    /// Number of cells of the raster.
    pub fn cells(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The occupancy of each cell of a layer with this grid.
    pub fn occupancies(&self, layer: &Layer) -> Vec<i8> {
        let occupancies = occupancies(layer);
        match &self.samples {
            None => occupancies,
            Some(samples) => samples.worst(&occupancies).map(|cell| at(&occupancies, cell)).collect(),
        }
    }

    /// Red, green, blue and alpha of each cell of a layer with this grid, in the colours of [`Colours`].
    /// Squares outside a radial grid are transparent.
    pub fn rgba(&self, layer: &Layer) -> Vec<u8> {
        let colours = Colours::of_layer(layer);
        let colour = |cell: u32| match cell {
            NOWHERE => [0; 4],
            cell => {
                let [red, green, blue] = colours.of_cell(layer, cell as usize);
                [red, green, blue, u8::MAX]
            }
        };
        match &self.samples {
            None => (0..self.width * self.height).flat_map(colour).collect(),
            Some(samples) => samples.worst(&occupancies(layer)).flat_map(colour).collect(),
        }
    }
}

impl Samples {
    /// The radial cell that each square cell shows.
    fn worst(&self, occupancies: &[i8]) -> impl Iterator<Item = u32> + use<> {
        let rank = |cell: u32| (cell != NOWHERE).then(|| rank(at(occupancies, cell)));
        let mut shown = self.at_middle.clone();
        for &(square, cell) in &self.inside {
            let shown = &mut shown[square as usize];
            if rank(cell) > rank(*shown) {
                *shown = cell;
            }
        }
        shown.into_iter()
    }
}

/// True for the occupancy of a free cell, graded or not.
pub(super) fn is_free(occupancy: i8) -> bool {
    (FREE..OCCUPIED).contains(&occupancy)
}

/// Order from the best to the worst occupancy: unknown is worse than free, and better than an obstacle.
pub(super) fn rank(occupancy: i8) -> i8 {
    if occupancy == UNKNOWN { OCCUPIED - 1 } else { occupancy }
}

fn at(occupancies: &[i8], cell: u32) -> i8 {
    occupancies.get(cell as usize).copied().unwrap_or(UNKNOWN)
}

/// The occupancy of each of the layer's own cells.
fn occupancies(layer: &Layer) -> Vec<i8> {
    meanings(layer).into_iter().map(occupancy).collect()
}

/// The meaning of each of the layer's own cells; unknown if it has no classes.
pub(super) fn meanings(layer: &Layer) -> Vec<ClassMeaning> {
    let class = |class: i32| layer.legend.get(usize::try_from(class).ok()?);
    let of = |number: i32| class(number).map_or(ClassMeaning::Unknown, |class| class.meaning);
    match layer.channel("class").map(|channel| &channel.cells) {
        None => vec![ClassMeaning::Unknown; layer.grid.cell_count() as usize],
        Some(Cells::U8(cells)) => cells.iter().map(|&class| of(class.into())).collect(),
        Some(Cells::I8(cells)) => cells.iter().map(|&class| of(class.into())).collect(),
        Some(Cells::U16(cells)) => cells.iter().map(|&class| of(class.into())).collect(),
    }
}

/// The occupancy of a class with this meaning.
pub fn occupancy(meaning: ClassMeaning) -> i8 {
    match meaning {
        ClassMeaning::Free => FREE,
        ClassMeaning::Occupied | ClassMeaning::Low | ClassMeaning::NotReached => OCCUPIED,
        ClassMeaning::Unknown | ClassMeaning::Inferred | ClassMeaning::Hidden => UNKNOWN,
    }
}

/// The raster of each layer, made again when its grid changes.
#[derive(Debug, Default)]
pub struct Rasters(BTreeMap<String, Raster>);

impl Rasters {
    /// The raster of a layer.
    pub fn of(&mut self, layer: &Layer) -> &Raster {
        let raster = self.0.entry(layer.name.clone()).or_insert_with(|| Raster::from_grid(&layer.grid));
        if raster.grid != layer.grid {
            *raster = Raster::from_grid(&layer.grid);
        }
        raster
    }
}

#[cfg(test)]
mod tests {
    use clearway_proto::codec::Cells;
    use clearway_proto::legend::Class;
    use clearway_proto::map::Channel;

    use super::*;

    const MEANINGS: [ClassMeaning; 4] =
        [ClassMeaning::Unknown, ClassMeaning::Free, ClassMeaning::NotReached, ClassMeaning::Occupied];

    fn layer(grid: Grid, classes: Vec<u8>) -> Layer {
        let class =
            Channel { name: "class".into(), unit: String::new(), scale: 1.0, unknown: 0, cells: Cells::U8(classes) };
        Layer {
            name: "drivability".into(),
            grid,
            legend: MEANINGS.map(|meaning| Class { name: "any".into(), meaning, rgb: 0x00ff_8000 }).to_vec(),
            channels: vec![class],
            planes: Vec::new(),
            metrics: BTreeMap::new(),
            points: Vec::new(),
        }
    }

    #[test]
    fn every_class_of_every_layer_has_its_occupancy() {
        use clearway_journal::encode::meaning;
        use clearway_mapping::layer::ClassInfo;
        use clearway_mapping::layer::drivability::class::DrivabilityClass;
        use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;
        use clearway_mapping::layer::occupancy::class::OccupancyClass;
        use clearway_mapping::layer::safe_path::class::SafePathClass;
        use clearway_mapping::layer::speed::class::SpeedClass;
        use clearway_mapping::layer::terrain::class::TerrainClass;
        let of =
            |legend: &[ClassInfo]| legend.iter().map(|class| occupancy(meaning(class.meaning))).collect::<Vec<_>>();
        assert_eq!(of(DrivabilityClass::LEGEND), [-1, 0, 100, 100]);
        assert_eq!(of(HeightDifferenceClass::LEGEND), [-1, 0, 100]);
        assert_eq!(of(TerrainClass::LEGEND), [-1, 0, -1, 100, 100, 100]);
        assert_eq!(of(OccupancyClass::LEGEND), [-1, 0, 100, -1, -1]);
        assert_eq!(of(SpeedClass::LEGEND), [-1, 0, 100, 0, 100]);
        assert_eq!(of(SafePathClass::LEGEND), [-1, 0, 100, 0, 100]);
    }

    #[test]
    fn every_radial_cell_that_is_not_free_is_in_a_square_that_is_not_free() {
        let row_radius_m: Vec<f32> = (1..=40).map(|row| 0.02 * (row * row) as f32).collect();
        let grid = Grid::Radial { centre_m: [0.0; 2], row_radius_m, columns: 360 };
        // Any mixture of classes.
        let class = |cell: u64| (cell.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 61).saturating_sub(4) as u8;
        let classes: Vec<u8> = (0..grid.cell_count()).map(class).collect();
        let layer = layer(grid.clone(), classes.clone());
        let raster = Raster::from_grid(&grid);
        let (occupancies, rgba) = (raster.occupancies(&layer), raster.rgba(&layer));
        let half_m = 0.5 * f64::from(raster.cell_m) * f64::from(raster.width);
        let square = |x_m: f64, y_m: f64| {
            let [column, row] = [x_m, y_m].map(|m| ((m + half_m) / f64::from(raster.cell_m)) as usize);
            row * raster.width as usize + column
        };
        for (cell, class) in classes.iter().enumerate() {
            let (x_m, y_m) = grid.centre_of(cell).unwrap();
            let shown = occupancies[square(x_m, y_m)];
            match class {
                0 => assert_ne!(shown, FREE, "unknown cell {cell}"),
                1 => {}
                _ => assert_eq!(shown, OCCUPIED, "obstacle cell {cell}"),
            }
        }
        let free = occupancies.iter().filter(|&&occupancy| occupancy == FREE).count();
        assert!(free > 1000, "{free} free cells of {}", occupancies.len());
        assert_eq!((occupancies[0], &rgba[..4]), (UNKNOWN, &[0; 4][..]), "the corner lies outside");
        assert_eq!(rgba.len(), 4 * occupancies.len());
    }

    #[test]
    fn a_rotated_grid_keeps_its_cells_and_its_pose() {
        let grid = Grid::Cartesian {
            origin_x_m: -1.5,
            origin_y_m: -0.5,
            width: 4,
            height: 3,
            cell_m: 0.5,
            yaw_rad: 0.7,
            first_ix: 0,
            first_iy: 0,
        };
        let layer = layer(grid.clone(), (0..12).map(|cell| cell % 4).collect());
        let raster = Raster::from_grid(&grid);
        assert_eq!(raster.occupancies(&layer), [-1, 0, 100, 100].repeat(3));
        for cell in 0..12_usize {
            let (column, row) = ((cell % 4) as f64, (cell / 4) as f64);
            let middle = raster.ego_from_raster * nalgebra::Point3::new(0.5 * column + 0.25, 0.5 * row + 0.25, 0.0);
            let (x_m, y_m) = grid.centre_of(cell).unwrap();
            assert!((middle.x - x_m).abs() < 1e-9 && (middle.y - y_m).abs() < 1e-9, "{middle} is not {x_m}, {y_m}");
        }
    }
}
