//! SemanticKITTI labels -> the truth about a scan's points.
//!
//! In: a `.label` file (one u32 a point, the class in the lower 16 bits), the points in the ego frame. Out:
//! [`JudgedPoint`]s. A point that is not ground is an obstacle if it is 0.3 to 2.5 m above the labelled ground around
//! it. Ground is drivable if it can be reached from the blind zone over cells without obstacles. The cells are 1 degree
//! wide and one sensor ring deep; up to two rows without points are bridged.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail};
use clearway_mapping::layer::radial_grid::RadialGrid;
use clearway_mapping::sensor::sweep::Sweep;

use super::super::judge::{JudgedPoint, OBSTACLE_M_MAX, OBSTACLE_M_MIN, Scored, Vote};

/// Name of each class by its number, from SemanticKITTI's list (semantic-kitti.yaml). A moving class has the name of
/// the same class at rest.
const CLASSES: [(u32, &str); 34] = [
    (0, "unlabeled"),
    (1, "outlier"),
    (10, "car"),
    (11, "bicycle"),
    (13, "bus"),
    (15, "motorcycle"),
    (16, "on-rails"),
    (18, "truck"),
    (20, "other-vehicle"),
    (30, "person"),
    (31, "bicyclist"),
    (32, "motorcyclist"),
    (40, "road"),
    (44, "parking"),
    (48, "sidewalk"),
    (49, "other-ground"),
    (50, "building"),
    (51, "fence"),
    (52, "other-structure"),
    (60, "lane-marking"),
    (VEGETATION, "vegetation"),
    (71, "trunk"),
    (72, "terrain"),
    (80, "pole"),
    (81, "traffic-sign"),
    (99, "other-object"),
    (252, "car"),
    (253, "bicyclist"),
    (254, "person"),
    (255, "motorcyclist"),
    (256, "on-rails"),
    (257, "bus"),
    (258, "truck"),
    (259, "other-vehicle"),
];
const VEGETATION: u32 = 70;

/// Greatest height of low vegetation above the vehicle's ground, as a share of the sensor's height. From Patchwork: its
/// low vegetation is 1.3 m or more below the sensor on KITTI's car, which is three quarters of the sensor's height.
const LOW_VEGETATION: f32 = 0.25;

/// Radius of the truth's grid, in metres.
const RANGE_M_MAX: f32 = 60.0;
/// Number of columns of the truth's grid.
const COLUMNS: u16 = 360;
/// Radius around the vehicle from which ground is reached, in metres.
const BLIND_ZONE_M: f32 = 7.0;
/// Number of rows without points over which ground is reached.
const BRIDGE_ROWS: usize = 2;

/// Reads the class of each of the `points` points of `scan`.
///
/// # Errors
/// If the file cannot be read, has another number of labels, or a label is no class.
pub fn read(file: &Path, scan: &Path, points: usize) -> Result<Vec<u32>> {
    let bytes = std::fs::read(file).with_context(|| file.display().to_string())?;
    if bytes.len() != 4 * points {
        let (file, scan, labels, over) = (file.display(), scan.display(), bytes.len() / 4, bytes.len() % 4);
        bail!("{file}: {labels} label(s) of 4 bytes and {over} byte(s) over for the {points} points of {scan}");
    }
    let class = |label: &[u8]| u32::from(u16::from_le_bytes([label[0], label[1]]));
    let classes: Vec<u32> = bytes.chunks_exact(4).map(class).collect();
    match classes.iter().position(|class| name(*class).is_none()) {
        Some(point) => {
            let (file, class) = (file.display(), classes[point]);
            bail!("{file}: point {point} has class {class}: SemanticKITTI has none of that number")
        }
        None => Ok(classes),
    }
}

fn name(class: u32) -> Option<&'static str> {
    let index = CLASSES.binary_search_by_key(&class, |(number, _)| *number).ok()?;
    Some(CLASSES[index].1)
}

fn is_ground(class: u32) -> bool {
    matches!(class, 40 | 44 | 48 | 49 | 60 | 72)
}

/// The truth about the points of a sweep; `classes[i]` is the class of point i.
pub fn truth(sweep: &Sweep, classes: &[u32]) -> Vec<JudgedPoint> {
    let places: Vec<[f32; 3]> = (0..sweep.x.len()).map(|i| [sweep.x[i], sweep.y[i], sweep.z[i]]).collect();
    let height = LabelledGround::new(places.iter().zip(classes));
    let mut points: Vec<JudgedPoint> = places
        .iter()
        .zip(classes)
        .map(|(place, class)| {
            let over = place[2] - height.about(place);
            let vote = match class {
                0 | 1 => Vote::Nothing,
                class if is_ground(*class) => Vote::Either,
                _ if over > OBSTACLE_M_MAX => Vote::Nothing,
                _ if over > OBSTACLE_M_MIN => Vote::Obstacle,
                _ => Vote::Seen,
            };
            let ground = scored(*class, place[2] < LOW_VEGETATION * sweep.mount_height_m);
            let road = matches!(class, 40 | 60);
            let class = name(*class).unwrap_or("unlabeled");
            JudgedPoint { place: *place, over_m: over, class, vote, road, ground }
        })
        .collect();
    mark_reachable(sweep, &mut points);
    points
}

/// How the protocols of [`super::super::report::PROTOCOLS`] score a class; `low` is true if the point is low enough for
/// Patchwork's low vegetation.
fn scored(class: u32, low: bool) -> [Scored; 2] {
    match class {
        0 | 1 => [Scored::Not, Scored::Not],
        VEGETATION => [Scored::Not, if low { Scored::Ground } else { Scored::Other }],
        class if is_ground(class) => [Scored::Ground; 2],
        _ => [Scored::Other; 2],
    }
}

/// Height of the labelled ground around a position: the median of its square of 2 m, or of the nearest squares that
/// have ground, in metres.
struct LabelledGround(BTreeMap<(i32, i32), f32>);

impl LabelledGround {
    fn new<'a>(points: impl Iterator<Item = (&'a [f32; 3], &'a u32)>) -> Self {
        let mut squares: BTreeMap<_, Vec<f32>> = BTreeMap::new();
        for (place, _) in points.filter(|(_, class)| is_ground(**class)) {
            squares.entry(Self::square(place)).or_default().push(place[2]);
        }
        Self(squares.into_iter().map(|(square, heights)| (square, median(heights))).collect())
    }

    fn square(place: &[f32; 3]) -> (i32, i32) {
        ((place[0] / 2.0).floor() as i32, (place[1] / 2.0).floor() as i32)
    }

    fn about(&self, place: &[f32; 3]) -> f32 {
        let (i, j) = Self::square(place);
        for reach in 0..4 {
            let around = (-reach..=reach).flat_map(|di| (-reach..=reach).map(move |dj| (i + di, j + dj)));
            let medians: Vec<f32> = around.filter_map(|square| self.0.get(&square).copied()).collect();
            if !medians.is_empty() {
                return median(medians);
            }
        }
        // No ground is labelled within 8 m: the ground under the vehicle is at 0.
        0.0
    }
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

/// Turns the vote of each ground point that can be reached from [`Vote::Either`] to [`Vote::Drivable`].
pub fn mark_reachable(sweep: &Sweep, points: &mut [JudgedPoint]) {
    let mut grid = RadialGrid::default();
    grid.update_rows(sweep, RANGE_M_MAX, COLUMNS);
    let (rows, columns) = (grid.rows(), grid.columns());
    let (mut seen, mut ground, mut obstacle) =
        (vec![false; grid.cells()], vec![false; grid.cells()], vec![false; grid.cells()]);
    let cells: Vec<Option<usize>> = points.iter().map(|point| grid.cell(point.place[0], point.place[1])).collect();
    for (point, cell) in points.iter().zip(&cells).filter_map(|(point, cell)| Some((point, (*cell)?))) {
        seen[cell] |= point.vote != Vote::Nothing;
        ground[cell] |= point.vote == Vote::Either;
        obstacle[cell] |= point.vote == Vote::Obstacle;
    }
    let free = |cell: usize| ground[cell] && !obstacle[cell];
    let known = |cell: &usize| seen[*cell];
    let mut reached = vec![false; grid.cells()];
    let mut waiting = Vec::new();
    for column in 0..columns {
        let near = (0..rows).take_while(|row| grid.row_span_m(*row).0 < BLIND_ZONE_M);
        waiting.extend(near.map(|row| row * columns + column).find(known).filter(|cell| free(*cell)));
    }
    while let Some(cell) = waiting.pop() {
        if std::mem::replace(&mut reached[cell], true) {
            continue;
        }
        let (row, column) = (cell / columns, cell % columns);
        let steps = 1..=BRIDGE_ROWS + 1;
        let outward = steps.clone().map(|step| cell + step * columns).take_while(|c| *c < rows * columns).find(known);
        let inward = steps.take_while(|step| *step <= row).map(|step| cell - step * columns).find(known);
        let sideways = [1, columns - 1].map(|step| Some(row * columns + (column + step) % columns));
        let next = [outward, inward].into_iter().chain(sideways).flatten();
        waiting.extend(next.filter(|next| free(*next) && !reached[*next]));
    }
    for (point, cell) in points.iter_mut().zip(cells) {
        if point.vote == Vote::Either && cell.is_some_and(|cell| reached[cell]) {
            point.vote = Vote::Drivable;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clearway_lidar::calibration::Calibration;
    use clearway_lidar::model::Model;

    /// Road in every direction out to 24 m, with a fence in a circle at 12 m.
    fn fenced() -> (Sweep, Vec<u32>) {
        let calibration = Some(std::sync::Arc::new(Calibration::factory(Model::Hdl64eS2)));
        let mut sweep = Sweep { calibration, mount_height_m: 1.73, ..Sweep::default() };
        let mut classes = Vec::new();
        for step in 0..1440 {
            let (sin, cos) = (step as f32 * std::f32::consts::TAU / 1440.0).sin_cos();
            let mut put = |range: f32, z: f32, class: u32| {
                sweep.x.push(range * cos);
                sweep.y.push(range * sin);
                sweep.z.push(z);
                classes.push(class);
            };
            (20..120).for_each(|tenth| put(tenth as f32 * 0.2, 0.0, 40));
            put(12.0, 1.0, 51);
            put(5.0, 4.0, VEGETATION);
        }
        (sweep, classes)
    }

    #[test]
    fn a_closed_fence_is_an_obstacle_and_the_ground_behind_it_is_not_drivable() {
        let (sweep, classes) = fenced();
        for point in truth(&sweep, &classes) {
            let range = point.place[0].hypot(point.place[1]);
            match point.class {
                "fence" => assert_eq!(point.vote, Vote::Obstacle),
                "vegetation" => assert_eq!(point.vote, Vote::Nothing, "4 m above the road"),
                _ if range < 11.0 => assert_eq!(point.vote, Vote::Drivable, "{range}"),
                _ if range > 13.0 => assert_eq!(point.vote, Vote::Either, "{range}"),
                _ => {}
            }
        }
    }

    #[test]
    fn the_protocols_differ_only_in_vegetation() {
        assert_eq!(scored(72, false), [Scored::Ground; 2]);
        assert_eq!(scored(10, true), [Scored::Other; 2]);
        assert_eq!(scored(1, true), [Scored::Not; 2]);
        assert_eq!(scored(VEGETATION, true), [Scored::Not, Scored::Ground]);
        assert_eq!(scored(VEGETATION, false), [Scored::Not, Scored::Other]);
    }

    #[test]
    fn labels_that_do_not_match_their_scan_are_refused_with_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("0.label");
        let read = |labels: &[u32], bytes_over: usize| {
            let mut bytes: Vec<u8> = labels.iter().flat_map(|label| label.to_le_bytes()).collect();
            bytes.extend(vec![0; bytes_over]);
            std::fs::write(&file, bytes).unwrap();
            super::read(&file, Path::new("0.bin"), 2)
        };
        // The upper 16 bits number instances.
        assert_eq!(read(&[40, 0x0007_000a], 0).unwrap(), [40, 10]);
        assert!(read(&[40], 0).unwrap_err().to_string().contains("1 label(s) of 4 bytes and 0 byte(s) over for the 2"));
        assert!(read(&[40, 40], 3).unwrap_err().to_string().contains("and 3 byte(s) over"));
        assert!(read(&[40, 77], 0).unwrap_err().to_string().contains("point 1 has class 77"));
        assert!(super::read(Path::new("/no.label"), Path::new("0.bin"), 2).is_err());
    }

    #[test]
    fn the_list_of_classes_is_sorted_for_the_binary_search() {
        assert!(CLASSES.is_sorted_by(|a, b| a.0 < b.0));
    }
}
