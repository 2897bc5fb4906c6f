//! Questions of a planner to one layer: whether an area or a path is free, what blocks it, what is nearest, and how far
//! the next cell is that is not free.
//!
//! In: a layer with classes, and an area, a path or a point in the ego frame (x forward, y left, metres). Out: answers
//! from the meanings in the layer's legend. They consider every cell that an area touches, its border included. Only
//! the meaning free is free; ground outside the grid is not free. A low thing, which some vehicles clear, has an answer
//! of its own. The Python client gives the same answers (`client/golden/questions.json`).
//!
//! | file | in -> out |
//! |---|---|
//! | [`shape`] | values -> checked areas, outlines and paths |
//! | `touched` | a polygon -> the cells that it touches |
//! | `kinds` | a layer -> what its classes are to a vehicle |
//! | [`clearance`] | a layer -> the distance of every cell to the nearest cell that is not free |

use std::f64::consts::TAU;

use clearway_proto::grid::Grid;
use clearway_proto::legend::Class;
use clearway_proto::map::Layer;
use clearway_proto::v1::ClassMeaning;

use crate::error::ClientError;
use crate::view::MapView;

pub mod clearance;
mod kinds;
pub mod shape;
mod touched;

use kinds::{ClassKind, class_name, class_of, kind, kinds};
use shape::{Area, Outline, Path};
use touched::{Touched, from_centre, nearest_on, touched};

/// What a vehicle may do on an area.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// Drive there: every cell that the area touches is free.
    Free,
    /// Drive there if it clears low things: the area touches the named one, and no cell that blocks.
    Low(Blocker),
    /// Not drive there: the area touches the named cell, or leaves the grid.
    Blocked(Blocker),
}

/// A cell that is not free.
#[derive(Clone, Debug, PartialEq)]
pub struct Blocker {
    /// Centre of the cell: distance forward, in metres; of a place outside the grid, that place.
    pub x_m: f64,
    /// Centre of the cell: distance to the left, in metres.
    pub y_m: f64,
    /// Name of its class; `unknown` outside the grid.
    pub class: String,
    /// Why the cell has its class: the name in the channel `why` if the map has it, `outside of the map` outside the
    /// grid.
    pub why: Option<String>,
}

/// What a vehicle meets on a path.
#[derive(Clone, Debug, PartialEq)]
pub struct Along {
    /// Length of the path, in metres.
    pub length_m: f64,
    /// The first low thing, and the distance along the path at which the vehicle touches it, in metres; none behind the
    /// first cell that blocks.
    pub low: Option<(f64, Blocker)>,
    /// The first cell that blocks, and the distance along the path at which the vehicle touches it, in metres.
    pub blocked: Option<(f64, Blocker)>,
}

/// The nearest point of a cell that contains an obstacle.
#[derive(Clone, Debug, PartialEq)]
pub struct Obstacle {
    /// Distance forward, in metres.
    pub x_m: f64,
    /// Distance to the left, in metres.
    pub y_m: f64,
    /// Distance from the given point, in metres; 0 if the point lies in such a cell. No obstacle of the layer is
    /// nearer. The obstacle itself can be farther away by up to the size of the cell, because a map does not state
    /// where in a cell it stands.
    pub distance_m: f64,
    /// Direction from the given point in radians, counter-clockwise from the ego x axis, -π to π.
    pub bearing_rad: f64,
    /// Name of the cell's class.
    pub class: String,
}

impl MapView {
    /// True if every cell that the area touches has a class that means free.
    ///
    /// # Errors
    /// As [`MapView::answer`].
    pub fn is_free(&self, layer: &str, area: &(impl Area + ?Sized)) -> Result<bool, ClientError> {
        Ok(self.answer(layer, area)? == Answer::Free)
    }

    /// Whether a vehicle may drive on an area, and else the cell nearest to the ego origin that forbids it.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer, [`ClientError::Shape`] if the area is none.
    pub fn answer(&self, layer: &str, area: &(impl Area + ?Sized)) -> Result<Answer, ClientError> {
        let layer = self.layer(layer)?;
        Ok(answer(layer, &kinds(layer), &area.checked_corners()?, [0.0; 2]))
    }

    /// What a vehicle of this outline meets on a path. The path is judged at poses at most 0.1 m apart, between which
    /// no corner of the vehicle moves farther than that by turning.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer, [`ClientError::Shape`] if a value of the path or
    /// outline is not allowed.
    pub fn along(&self, layer: &str, path: &Path, outline: &Outline) -> Result<Along, ClientError> {
        let layer = self.layer(layer)?;
        let kinds = kinds(layer);
        outline.check()?;
        let poses = path.poses(outline)?;
        let mut met = Along { length_m: poses.last().map_or(0.0, |pose| pose.along_m), low: None, blocked: None };
        for pose in poses {
            match answer(layer, &kinds, &outline.at(pose.place, pose.heading_rad), pose.place) {
                Answer::Free => {}
                Answer::Low(blocker) if met.low.is_none() => met.low = Some((pose.along_m, blocker)),
                Answer::Low(_) => {}
                Answer::Blocked(blocker) => {
                    met.blocked = Some((pose.along_m, blocker));
                    break;
                }
            }
        }
        Ok(met)
    }

    /// The obstacle of a layer that is nearest to a point; `None` if the layer has none. An obstacle can also stand in
    /// an unknown cell. Cells whose centre lies within `own`, the outline of the vehicle itself, do not count, nor do
    /// low things.
    ///
    /// # Errors
    /// [`ClientError::NoLayer`] if the map does not have the layer, [`ClientError::Shape`] if a value is not allowed.
    pub fn nearest_obstacle(
        &self,
        layer: &str,
        point_m: [f64; 2],
        own: Option<&Outline>,
    ) -> Result<Option<Obstacle>, ClientError> {
        self.nearest(layer, point_m, own, |class| {
            class.meaning == ClassMeaning::Occupied && kind(class) != ClassKind::Low
        })
    }

    /// The low thing that is nearest to a point, as [`MapView::nearest_obstacle`].
    ///
    /// # Errors
    /// As [`MapView::nearest_obstacle`].
    pub fn nearest_low(
        &self,
        layer: &str,
        point_m: [f64; 2],
        own: Option<&Outline>,
    ) -> Result<Option<Obstacle>, ClientError> {
        self.nearest(layer, point_m, own, |class| kind(class) == ClassKind::Low)
    }

    fn nearest(
        &self,
        layer: &str,
        [x_m, y_m]: [f64; 2],
        own: Option<&Outline>,
        is_wanted: impl Fn(&Class) -> bool,
    ) -> Result<Option<Obstacle>, ClientError> {
        let layer = self.layer(layer)?;
        shape::finite_point([x_m, y_m])?;
        own.map_or(Ok(()), Outline::check)?;
        let wanted: Vec<bool> = layer.legend.iter().map(is_wanted).collect();
        let is_own = |cell: usize| {
            own.zip(layer.grid.centre_of(cell))
                .is_some_and(|(own, (x, y))| (-own.rear_m..=own.front_m).contains(&x) && y.abs() <= own.width_m / 2.0)
        };
        let cells = (0..layer.grid.cell_count() as usize)
            .filter(|cell| class_of(layer, *cell).is_some_and(|class| wanted[class]) && !is_own(*cell));
        let found = cells.map(|cell| {
            let [x, y] = nearest_in(&layer.grid, cell, [x_m, y_m]);
            let (dx, dy) = (x - x_m, y - y_m);
            (
                Obstacle { x_m: x, y_m: y, distance_m: dx.hypot(dy), bearing_rad: dy.atan2(dx), class: String::new() },
                cell,
            )
        });
        let nearest = found.min_by(|(a, _), (b, _)| a.distance_m.total_cmp(&b.distance_m));
        Ok(nearest.map(|(obstacle, cell)| Obstacle { class: class_name(layer, cell), ..obstacle }))
    }
}

/// The answer for a polygon; of several cells that forbid it, the cell nearest to `from` is named.
fn answer(layer: &Layer, kinds: &[ClassKind], corners: &[[f64; 2]], from: [f64; 2]) -> Answer {
    let Touched { cells, outside } = touched(&layer.grid, corners);
    let nearest = |wanted: ClassKind| {
        let of_kind = cells
            .iter()
            .filter(|cell| class_of(layer, **cell).map_or(ClassKind::Blocks, |class| kinds[class]) == wanted);
        let with_distance = of_kind.filter_map(|cell| {
            let (x, y) = layer.grid.centre_of(*cell)?;
            // To a micrometre, so that equal distances are equal in every client.
            let distance_um = ((x - from[0]).hypot(y - from[1]) * 1e6).round() as u64;
            Some((distance_um, *cell, [x, y]))
        });
        let (_, cell, [x_m, y_m]) = with_distance.min_by_key(|(distance_um, cell, _)| (*distance_um, *cell))?;
        Some(Blocker { x_m, y_m, class: class_name(layer, cell), why: why_of(layer, cell) })
    };
    if let Some(blocker) = nearest(ClassKind::Blocks) {
        return Answer::Blocked(blocker);
    }
    if let Some([x_m, y_m]) = outside {
        return Answer::Blocked(Blocker { x_m, y_m, class: "unknown".into(), why: Some("outside of the map".into()) });
    }
    nearest(ClassKind::Low).map_or(Answer::Free, Answer::Low)
}

/// Names of the values of the channel `why` of the layer `freespace`.
const REASONS: [&str; 9] =
    ["not seen", "seen", "bridged", "remembered", "step", "obstacle", "overhang", "ditch", "too narrow"];

/// The name of a cell's reason in the channel `why`; `None` if the layer has no such channel.
fn why_of(layer: &Layer, cell: usize) -> Option<String> {
    let raw = layer.channel("why")?.cells.get(cell)?;
    let name = usize::try_from(raw).ok().and_then(|raw| REASONS.get(raw));
    Some(name.map_or_else(|| format!("reason {raw}"), |name| (*name).to_owned()))
}
/// The place in a cell that is nearest to a point, ego frame.
fn nearest_in(grid: &Grid, cell: usize, [x, y]: [f64; 2]) -> [f64; 2] {
    match grid {
        // To the bit.
        _ if grid.cell_at(x, y) == Some(cell) => [x, y],
        Grid::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } => {
            let (sin, cos) = yaw_rad.sin_cos();
            let edge = f64::from(*cell_m);
            let (ix, iy) = ((cell % *width as usize) as f64, (cell / *width as usize) as f64);
            let near_x = (x * cos - y * sin).clamp(origin_x_m + ix * edge, origin_x_m + (ix + 1.0) * edge);
            let near_y = (x * sin + y * cos).clamp(origin_y_m + iy * edge, origin_y_m + (iy + 1.0) * edge);
            [near_x * cos + near_y * sin, near_y * cos - near_x * sin]
        }
        Grid::Radial { centre_m, row_radius_m, columns } => {
            let [centre_x, centre_y] = centre_m.map(f64::from);
            let in_ego_frame = |[x, y]: [f64; 2]| [x + centre_x, y + centre_y];
            let [x, y] = from_centre(*centre_m, [x, y]);
            let (row, column) = (cell / *columns as usize, (cell % *columns as usize) as f64);
            let (inner, outer) =
                (if row == 0 { 0.0 } else { f64::from(row_radius_m[row - 1]) }, f64::from(row_radius_m[row]));
            let position = (y.atan2(x) / TAU).rem_euclid(1.0) * f64::from(*columns);
            if (column..=column + 1.0).contains(&position) {
                let range_m = x.hypot(y).clamp(inner, outer);
                let (sin, cos) = y.atan2(x).sin_cos();
                return in_ego_frame([range_m * cos, range_m * sin]);
            }
            // Beside the column, one of its two sides is nearest: an arc comes nearer towards its ends.
            let side = |column: f64| {
                let (sin, cos) = (column / f64::from(*columns) * TAU).sin_cos();
                nearest_on([[inner * cos, inner * sin], [outer * cos, outer * sin]], [x, y])
            };
            let distance = |[a, b]: [f64; 2]| (a - x).hypot(b - y);
            let (first, last) = (side(column), side(column + 1.0));
            in_ego_frame(if distance(first) <= distance(last) { first } else { last })
        }
    }
}
