//! Objects cut into labelled scans by ray geometry -> how many of their cells each layer calls free.
//!
//! In: a recorded scan and the truth of its points. Out: counts by object and distance, in an [`EvaluatedSource`]. A
//! ray that meets the object before its recorded return ends on the object, without noise; a return inside a trench
//! moves on to its floor or far wall. Each object stands alone, on the first open level ground at its distance, and is
//! judged by one scan.

use std::collections::BTreeSet;

use anyhow::Result;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::Scan;
use clearway_mapping::layer::{Layer, Meaning};
use nalgebra::Point3;

use super::super::footprint::ground::{FreeGround, Surface, squares_within};
use super::super::judge::{JudgedPoint, Scored, locate, meanings};
use super::super::report::EvaluatedSource;
use super::super::tally::CellCount;
use super::one_sensor::{pipeline, step};

/// Distances of the objects from the sensor, in metres.
pub const DISTANCES_M: [f32; 4] = [7.0, 10.0, 15.0, 20.0];

/// An upright box on the ground, or a trench.
#[derive(Clone, Copy, Debug)]
pub struct CutObject {
    /// Name in the report.
    pub name: &'static str,
    /// Extents along and across the view, in metres.
    size_m: [f32; 2],
    /// Height in metres; the depth of a trench is negative.
    height_m: f32,
}

/// The objects that are put into scans.
pub const OBJECTS: [CutObject; 6] = [
    CutObject { name: "box of 0.5 m", size_m: [0.5, 0.5], height_m: 0.5 },
    CutObject { name: "log of 0.2 m", size_m: [0.3, 2.0], height_m: 0.2 },
    CutObject { name: "kerb of 0.2 m", size_m: [2.0, 4.0], height_m: 0.2 },
    CutObject { name: "person who lies", size_m: [0.5, 1.8], height_m: 0.25 },
    CutObject { name: "pole of 0.1 m", size_m: [0.1, 0.1], height_m: 2.0 },
    CutObject { name: "trench of 2 m", size_m: [2.0, 4.0], height_m: -1.0 },
];

/// Azimuths at which open ground is searched, in degrees, the nearest to straight ahead first.
const AZIMUTH_STEP_DEG: f32 = 3.0;
/// Open ground around an object, in metres.
const OPEN_M: f32 = 0.6;
/// Distance of the places of a trench that are looked up, in metres.
const PLACES_M: f32 = 0.1;

/// Where an object stands: the middle (x, y), the direction of the view, and the height of the ground.
struct Stand {
    middle: [f32; 2],
    heading_rad: f32,
    ground_m: f32,
}

/// Judges every object at every distance in one scan.
///
/// # Errors
/// If a value of the configuration is not allowed, or the pipeline refuses a scan.
pub fn judge_objects(
    scan: &Scan,
    truths: &[Option<JudgedPoint>],
    (maps, model, extrinsics): (&MapsConfig, Option<Model>, Extrinsics),
    source: &mut EvaluatedSource,
) -> Result<()> {
    let points: Vec<JudgedPoint> = truths.iter().flatten().copied().collect();
    let sensor_m = [extrinsics.x_m as f32, extrinsics.y_m as f32];
    let ground = FreeGround::new(&points, &[], sensor_m);
    for (object, distance_m) in OBJECTS.iter().flat_map(|object| DISTANCES_M.map(|distance_m| (object, distance_m))) {
        let Some(stand) = stand(object, distance_m, &ground, &points, sensor_m) else { continue };
        let (cut, held) = cut(object, &stand, scan, truths, extrinsics);
        let (mut pipeline, _) = pipeline(maps, model, extrinsics)?;
        step(&mut pipeline, cut, 0, std::path::Path::new(object.name))?;
        let places = if object.height_m < 0.0 { places_within(object, &stand) } else { held };
        let counts = source.objects.entry((object.name, distance_m as u32)).or_default();
        for layer in pipeline.newest_map().iter().flat_map(|map| &map.layers) {
            if let Some(found) = count(layer, &places) {
                match counts.iter_mut().find(|(name, _)| name == layer.name) {
                    Some((_, count)) => count.merge(&found),
                    None => counts.push((layer.name.to_owned(), found)),
                }
            }
        }
    }
    Ok(())
}

/// The cells of a layer at these places, and the cells among them called free; `None` if the layer has no free class.
fn count(layer: &Layer, places: &[[f32; 3]]) -> Option<CellCount> {
    let (meanings, cell_of) = (meanings(layer)?, locate(&layer.geometry));
    let cells: BTreeSet<usize> = places.iter().filter_map(|place| cell_of(*place)).collect();
    let mut count = CellCount::default();
    cells.into_iter().for_each(|cell| count.add(meanings[cell] == Meaning::Free));
    Some(count)
}

/// The first open level ground at a distance.
fn stand(
    object: &CutObject,
    distance_m: f32,
    ground: &FreeGround,
    points: &[JudgedPoint],
    sensor_m: [f32; 2],
) -> Option<Stand> {
    let steps = (0..=(180.0 / AZIMUTH_STEP_DEG) as i32).flat_map(|step| [step, -step]);
    let mut headings = steps.map(|step| (step as f32 * AZIMUTH_STEP_DEG).to_radians());
    headings.find_map(|heading_rad| {
        let middle = [sensor_m[0] + distance_m * heading_rad.cos(), sensor_m[1] + distance_m * heading_rad.sin()];
        let half = object.size_m.map(|side| side / 2.0 + OPEN_M);
        let is_open = ground.surface(&squares_within(middle, heading_rad, half)) == Some(Surface::Level);
        let near = |point: &&JudgedPoint| {
            point.ground[0] == Scored::Ground && (point.place[0] - middle[0]).hypot(point.place[1] - middle[1]) < 1.5
        };
        let mut heights: Vec<f32> = points.iter().filter(near).map(|point| point.place[2]).collect();
        heights.sort_by(f32::total_cmp);
        let ground_m = heights.get(heights.len() / 2).filter(|_| is_open)?;
        Some(Stand { middle, heading_rad, ground_m: *ground_m })
    })
}

/// The scan with the object, and the places of the returns that moved, ego frame.
fn cut(
    object: &CutObject,
    stand: &Stand,
    scan: &Scan,
    truths: &[Option<JudgedPoint>],
    extrinsics: Extrinsics,
) -> (Scan, Vec<[f32; 3]>) {
    let (mut cut, mut held) = (scan.clone(), Vec::new());
    let ego_from_sensor = extrinsics.ego_from_sensor();
    let origin = ego_from_sensor * Point3::origin();
    let (sin, cos) = f64::from(stand.heading_rad).sin_cos();
    // Along and across the view and up, from the object's middle on the ground.
    let local = |point: Point3<f64>| {
        let (x, y) = (point.x - f64::from(stand.middle[0]), point.y - f64::from(stand.middle[1]));
        [x * cos + y * sin, y * cos - x * sin, point.z - f64::from(stand.ground_m)]
    };
    for (index, truth) in truths.iter().enumerate() {
        let sensed = Point3::new(scan.x[index], scan.y[index], scan.z[index]).cast::<f64>();
        let ends = [local(origin), local(ego_from_sensor * sensed)];
        let is_ground = truth.is_some_and(|truth| truth.ground[0] == Scored::Ground);
        let Some(share) = object.meets(ends, is_ground) else { continue };
        let moved = sensed * share;
        (cut.x[index], cut.y[index], cut.z[index]) = (moved.x as f32, moved.y as f32, moved.z as f32);
        held.push((ego_from_sensor * moved).coords.cast::<f32>().into());
    }
    (cut, held)
}

impl CutObject {
    /// The share of the way to a return at which its ray ends because of the object; `None` if the return stays.
    fn meets(&self, [from, to]: [[f64; 3]; 2], is_ground: bool) -> Option<f64> {
        let [half_x, half_y] = self.size_m.map(|side| f64::from(side) / 2.0);
        let height = f64::from(self.height_m);
        let borders = [(-half_x, half_x), (-half_y, half_y), (height.min(-0.3), height.max(0.0))];
        let (mut enters, mut leaves) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..3 {
            let way = to[axis] - from[axis];
            let at = |border: f64| (border - from[axis]) / way;
            let (a, b) = (at(borders[axis].0), at(borders[axis].1));
            enters = enters.max(a.min(b));
            leaves = leaves.min(a.max(b));
        }
        if enters >= leaves {
            return None;
        }
        if height > 0.0 {
            return (enters > 0.0 && enters < 1.0).then_some(enters);
        }
        // A return on the ground over the trench goes on to where the ray leaves its space.
        let is_over = to[0].abs() < half_x && to[1].abs() < half_y;
        (is_ground && is_over && leaves > 1.0).then_some(leaves)
    }
}

/// Places all over an object's ground, ego frame.
fn places_within(object: &CutObject, stand: &Stand) -> Vec<[f32; 3]> {
    let [half_x, half_y] = object.size_m.map(|side| (side / 2.0 / PLACES_M) as i32);
    let (sin, cos) = stand.heading_rad.sin_cos();
    let place = |ix: i32, iy: i32| {
        let (x, y) = (ix as f32 * PLACES_M, iy as f32 * PLACES_M);
        [stand.middle[0] + x * cos - y * sin, stand.middle[1] + x * sin + y * cos, stand.ground_m]
    };
    (1 - half_x..half_x)
        .flat_map(|ix| (1 - half_y..half_y).map(move |iy| (ix, iy)))
        .map(|(ix, iy)| place(ix, iy))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_ends_on_a_box_and_goes_on_into_a_trench() {
        let [log, trench] = [OBJECTS[1], OBJECTS[5]];
        let eye = [-10.0, 0.0, 2.0];
        // Down to the ground 2 m behind the log: it passes over the front edge 0.37 m high, and 0.3 m further 0.31 m.
        assert_eq!(log.meets([eye, [2.0, 0.0, 0.0]], true), None);
        let share = log.meets([eye, [0.5, 0.0, 0.0]], true).unwrap();
        assert!((share - 9.85 / 10.5).abs() < 1e-9, "the near side: {share}");
        assert_eq!(log.meets([eye, [-1.0, 0.0, 0.0]], true), None, "before it");
        assert_eq!(log.meets([eye, [0.5, 3.0, 0.0]], true), None, "beside it");
        let share = trench.meets([eye, [0.0, 0.0, 0.0]], true).unwrap();
        assert!((share - 1.1).abs() < 1e-9, "the far wall, 0.2 m deep: {share}");
        assert_eq!(trench.meets([eye, [0.0, 0.0, 0.0]], false), None);
        assert_eq!(trench.meets([eye, [1.5, 0.0, 0.0]], true), None);
    }
}
