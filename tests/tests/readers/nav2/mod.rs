//! Maps as the costmap layers of Nav2 read them. Nav2 does not run here: its rules are done again, from
//! `nav2_costmap_2d/plugins/static_layer.cpp` and `obstacle_layer.cpp` of ros-navigation/navigation2.

mod files;

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};

use clearway_client::MapView;
use clearway_daemon::viewer::FrameNames;
use clearway_daemon::viewer::raster::Raster;
use clearway_daemon::viewer::ros::{ShownLayer, topics_of};
use clearway_proto::codec::{CellsRef, encode_grid};
use clearway_proto::legend::encode_legend;
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::v1;
use clearway_proto::v1::ClassMeaning;
use clearway_ros::cdr::Reader;
use clearway_ros::{PointCloud2, Points};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;
use serde_yaml_ng::Value;

use files::parameters;

/// Cells of the layer along each side, and their edge.
const SIDE: u32 = 128;
const CELL_M: f64 = 0.25;
/// Farthest that an obstacle may be placed from where it is.
const OFF_M_MAX: f64 = 0.3;
/// Half of the sides of the vehicle's outline.
const OUTLINE_M: [f64; 2] = [2.2, 1.0];
/// Half of the side of the local costmap.
const HALF_WINDOW_M: f64 = 20.0;
const STAMP_NS: i64 = 1_700_000_000_250_000_000;

/// Classes of the layer, by number.
const LEGEND: [(&str, ClassMeaning, u32); 6] = [
    ("unknown", ClassMeaning::Unknown, 0),
    ("free", ClassMeaning::Free, 0),
    ("occupied", ClassMeaning::Occupied, 0),
    ("low", ClassMeaning::Low, 0),
    ("hidden", ClassMeaning::Hidden, 0),
    ("not_reached", ClassMeaning::NotReached, 0),
];

/// A map of free ground with single cells of every other class, and the centre and the class of each cell.
struct World {
    map: MapView,
    cells: Vec<([f64; 2], usize)>,
    map_from_ego: Isometry3<f64>,
}

fn is_in_outline([x, y]: [f64; 2]) -> bool {
    x.abs() < OUTLINE_M[0] && y.abs() < OUTLINE_M[1]
}

fn world(map_from_ego: Option<Isometry3<f64>>) -> World {
    let mut random = Pcg64::seed_from_u64(37);
    let half_m = CELL_M * f64::from(SIDE) / 2.0;
    let centre = |cell: u32| [cell % SIDE, cell / SIDE].map(|index| (f64::from(index) + 0.5) * CELL_M - half_m);
    let mut class = |cell: u32| match random.random_range(0..60) {
        class @ (0 | 2..=5) if !is_in_outline(centre(cell)) => class,
        _ => 1,
    };
    let classes: Vec<u8> = (0..SIDE * SIDE).map(&mut class).collect();
    let pose = map_from_ego.map(|pose| {
        let (at, q) = (pose.translation, pose.rotation.coords);
        v1::Pose { x: at.x, y: at.y, z: at.z, qx: q.x, qy: q.y, qz: q.z, qw: q.w }
    });
    let header = v1::Header {
        vehicle: "car".into(),
        capture_end_ns: STAMP_NS,
        valid_until_ns: STAMP_NS + 300_000_000,
        map_from_ego: pose,
        ..Default::default()
    };
    let grid = v1::CartesianGrid {
        origin_x_m: -half_m,
        origin_y_m: -half_m,
        width: SIDE,
        height: SIDE,
        cell_m: CELL_M as f32,
        ..Default::default()
    };
    let mut layer = v1::Layer {
        name: "freespace".into(),
        geometry: Some(v1::layer::Geometry::Cartesian(grid)),
        channels: vec![encode_grid(CellsRef::U8(&classes), SIDE as usize).into_channel("class", "", 1.0, 0)],
        ..Default::default()
    };
    encode_legend(&mut layer, LEGEND);
    World {
        map: MapView::decode([encode_header(&header), encode_layer(&layer)].concat().into()).expect("a map"),
        cells: (0..SIDE * SIDE).map(centre).zip(classes.into_iter().map(usize::from)).collect(),
        map_from_ego: map_from_ego.unwrap_or_default(),
    }
}

impl World {
    /// The message of the topic of the layer with this ending.
    fn message(&self, ending: &str, is_fresh: bool) -> Vec<u8> {
        let layer = self.map.layer("freespace").expect("the layer");
        let frames = FrameNames { fixed: "odom".into(), ego: "base_link".into() };
        let raster = &Raster::from_grid(&layer.grid);
        let shown = ShownLayer { map: &self.map, layer, raster, frames: &frames, is_fresh };
        let topic = topics_of("freespace").iter().find(|topic| topic.ending == ending).expect("the topic");
        (topic.write)(&shown).expect("a message")
    }

    fn meaning(class: usize) -> ClassMeaning {
        LEGEND[class].1
    }

    /// A place of the ego frame in the fixed frame.
    fn fixed(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let at = self.map_from_ego * Point3::new(x, y, 0.0);
        [at.x, at.y]
    }
}

/// What StaticLayer takes from a grid: it never reads the orientation of the origin.
struct StaticLayer {
    frame_id: String,
    stamp_ns: i64,
    resolution_m: f64,
    size: [usize; 2],
    origin_m: [f64; 2],
    orientation: [f64; 4],
    costs: Vec<u8>,
}

const LETHAL: u8 = 254;
const NO_INFORMATION: u8 = 255;

impl StaticLayer {
    fn process(message: &[u8]) -> Self {
        let mut reader = Reader::new(message).expect("CDR");
        let header = reader.header().expect("a header");
        let (frame_id, stamp_ns) = (header.frame_id.to_owned(), header.stamp_ns);
        reader.stamp("map_load_time").expect("a stamp");
        let resolution_m = f64::from(f32::from_bits(reader.u32("resolution").expect("metres")));
        let size = ["width", "height"].map(|side| reader.u32(side).expect("cells") as usize);
        let [x_m, y_m, _] = reader.f64s("position").expect("a position");
        let orientation = reader.f64s("orientation").expect("an orientation");
        let count = reader.count("data", 1).expect("cells");
        let data = reader.read_bytes("data", count).expect("cells");
        assert_eq!(count, size[0] * size[1]);
        // interpretValue with track_unknown_space and trinary_costmap, and the default thresholds.
        let cost = |value: &u8| match value {
            255 => NO_INFORMATION,
            99.. => LETHAL,
            _ => 0,
        };
        let costs = data.iter().map(cost).collect();
        Self { frame_id, stamp_ns, resolution_m, size, origin_m: [x_m, y_m], orientation, costs }
    }

    /// The cost at a place of the grid's frame; no information outside.
    fn cost(&self, place: [f64; 2]) -> u8 {
        let [x, y] = [0, 1].map(|axis| ((place[axis] - self.origin_m[axis]) / self.resolution_m).floor());
        let inside = x >= 0.0 && y >= 0.0 && x < self.size[0] as f64 && y < self.size[1] as f64;
        if inside { self.costs[y as usize * self.size[0] + x as usize] } else { NO_INFORMATION }
    }

    fn centre(&self, cell: usize) -> [f64; 2] {
        let at = [cell % self.size[0], cell / self.size[0]];
        [0, 1].map(|axis| self.origin_m[axis] + (at[axis] as f64 + 0.5) * self.resolution_m)
    }

    fn lethal(&self) -> Vec<[f64; 2]> {
        (0..self.costs.len()).filter(|cell| self.costs[*cell] == LETHAL).map(|cell| self.centre(cell)).collect()
    }
}

/// Distance from a place to the nearest of others, which are at most a metre apart from it.
fn nearest_m(place: [f64; 2], others: &[[f64; 2]]) -> f64 {
    let distance = |other: &[f64; 2]| (other[0] - place[0]).hypot(other[1] - place[1]);
    others.iter().map(distance).fold(f64::INFINITY, f64::min)
}

/// Poses at five headings, of a vehicle that moves by no whole number of cells, on a slope.
fn poses() -> Vec<Isometry3<f64>> {
    let headings = [0.0, 0.3, FRAC_PI_4, FRAC_PI_2, -2.5];
    let moving = headings.into_iter().zip(0..).flat_map(|(heading, step)| {
        [0.0, 0.37].map(|further_m| {
            let step = f64::from(step) + further_m;
            let rotation = Vector3::z() * heading;
            Isometry3::new(Vector3::new(1000.0 + 1.7 * step, -70.0 - 0.9 * step, 12.0), rotation)
        })
    });
    moving.collect()
}

#[test]
fn static_layer_has_every_obstacle_where_it_is_at_every_heading_and_nothing_unknown_is_free() {
    for pose in poses() {
        let world = world(Some(pose));
        let layer = StaticLayer::process(&world.message("", true));
        assert_eq!((layer.frame_id.as_str(), layer.stamp_ns), ("odom", STAMP_NS));
        assert_eq!(layer.orientation, [0.0, 0.0, 0.0, 1.0]);
        for at_m in layer.origin_m {
            assert_eq!(at_m % layer.resolution_m, 0.0, "the cells of all grids coincide: {at_m}");
        }
        let lethal = layer.lethal();
        let (mut free, mut occupied) = (0, Vec::new());
        for (place, class) in &world.cells {
            let at = world.fixed(*place);
            match World::meaning(*class) {
                ClassMeaning::Free => free += usize::from(layer.cost(at) == 0),
                ClassMeaning::Unknown | ClassMeaning::Hidden => assert_ne!(layer.cost(at), 0, "{place:?}"),
                _ => {
                    let off_m = nearest_m(at, &lethal);
                    assert!(off_m <= OFF_M_MAX, "{place:?} is {off_m} m off at {pose}");
                    occupied.push(at);
                }
            }
        }
        assert!(free * 10 > world.cells.len() * 7, "{free} cells are free");
        let astray = lethal.iter().map(|at| nearest_m(*at, &occupied)).fold(0.0, f64::max);
        assert!(astray <= OFF_M_MAX, "an obstacle {astray} m from the nearest one at {pose}");
        // A cell is in the outline if all its corners are.
        for cell in 0..layer.costs.len() {
            let [x, y] = layer.centre(cell);
            let half_m = layer.resolution_m / 2.0;
            let corners = [[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]];
            let inside = corners.into_iter().all(|[to_x, to_y]| {
                let corner = Point3::new(x + half_m * to_x, y + half_m * to_y, 12.0);
                let at = world.map_from_ego.inverse_transform_point(&corner);
                is_in_outline([at.x, at.y])
            });
            assert!(!inside || layer.costs[cell] == 0, "the vehicle stands on ({x}, {y})");
        }
    }
}

#[test]
fn a_map_without_a_pose_lies_in_the_frame_of_the_vehicle_and_a_stale_one_is_unknown() {
    let world = world(None);
    let layer = StaticLayer::process(&world.message("", true));
    assert_eq!((layer.frame_id.as_str(), layer.size), ("base_link", [SIDE as usize; 2]));
    for (place, class) in &world.cells {
        let expected = match World::meaning(*class) {
            ClassMeaning::Free => 0,
            ClassMeaning::Unknown | ClassMeaning::Hidden => NO_INFORMATION,
            _ => LETHAL,
        };
        assert_eq!(layer.cost(*place), expected, "{place:?}");
    }
    let stale = StaticLayer::process(&world.message("", false));
    assert_eq!((stale.size, stale.origin_m), (layer.size, layer.origin_m));
    assert_eq!(stale.stamp_ns, STAMP_NS + 300_000_000, "the time at which the map became stale");
    assert!(stale.costs.iter().all(|cost| *cost == NO_INFORMATION));
}

/// Points of a cloud in the fixed frame, as Nav2's observation buffer keeps them for a source with these parameters.
fn observed(world: &World, ending: &str, source: &Value) -> Vec<[f64; 2]> {
    let message = world.message(ending, true);
    let cloud = PointCloud2::new(&message).expect("a cloud");
    assert_eq!((cloud.header.frame_id, cloud.header.stamp_ns), ("base_link", STAMP_NS));
    let points = Points::from_cloud(&cloud).expect("points");
    let heights = ["min_obstacle_height", "max_obstacle_height"].map(|key| source[key].as_f64().expect("metres"));
    let fixed = (0..points.x.len())
        .map(|index| world.map_from_ego * Point3::new(points.x[index], points.y[index], points.z[index]).cast::<f64>());
    fixed.filter(|at| (heights[0]..=heights[1]).contains(&at.z)).map(|at| [at.x, at.y]).collect()
}

/// ObstacleLayer after one observation of each source: free along the clearing rays, then lethal at the marks.
fn obstacle_layer(world: &World, parameters: &Value) -> StaticLayer {
    let layer = &parameters["obstacle_layer"];
    let resolution_m = parameters["resolution"].as_f64().expect("metres");
    let side = (parameters["width"].as_f64().expect("metres") / resolution_m) as usize;
    let at = world.map_from_ego.translation.vector;
    // updateOrigin moves a rolling window by whole cells.
    let origin_m = [at.x, at.y].map(|at| ((at - HALF_WINDOW_M) / resolution_m).floor() * resolution_m);
    let costs = vec![NO_INFORMATION; side * side];
    let (frame_id, orientation) = ("odom".to_owned(), [0.0, 0.0, 0.0, 1.0]);
    let mut found =
        StaticLayer { frame_id, stamp_ns: STAMP_NS, resolution_m, size: [side; 2], origin_m, orientation, costs };
    let cell = |[x, y]: [f64; 2]| {
        let at = [(x - origin_m[0]) / resolution_m, (y - origin_m[1]) / resolution_m].map(f64::floor);
        at.iter().all(|index| (0.0..side as f64).contains(index)).then(|| at.map(|index| index as i64))
    };
    let index = |[x, y]: [i64; 2]| y as usize * side + x as usize;
    let origin = cell([at.x, at.y]).expect("the vehicle is in its window");
    for end in observed(world, "/ground", &layer["ground"]).into_iter().filter_map(cell) {
        // bresenham2D: a step along the longer axis each, with the error of the other.
        let [dx, dy] = [end[0] - origin[0], end[1] - origin[1]];
        let longer = dx.abs().max(dy.abs());
        let (mut error, mut place) = (longer / 2, origin);
        let along = usize::from(dy.abs() > dx.abs());
        let (steps, shorter) = ([dx.signum(), dy.signum()], dx.abs().min(dy.abs()));
        for _ in 0..longer {
            found.costs[index(place)] = 0;
            place[along] += steps[along];
            error += shorter;
            if error >= longer {
                place[1 - along] += steps[1 - along];
                error -= longer;
            }
        }
        found.costs[index(place)] = 0;
    }
    let range = ["obstacle_min_range", "obstacle_max_range"].map(|key| layer["obstacles"][key].as_f64().expect("m"));
    for mark in observed(world, "/obstacles", &layer["obstacles"]) {
        let range_m = (mark[0] - at.x).hypot(mark[1] - at.y);
        if let Some(place) = cell(mark).filter(|_| (range[0]..range[1]).contains(&range_m)) {
            found.costs[index(place)] = LETHAL;
        }
    }
    found
}

#[test]
fn obstacle_layer_marks_every_obstacle_and_clears_nothing_that_is_not_free() {
    let parameters = parameters("local_costmap");
    for pose in poses() {
        let world = world(Some(pose));
        let layer = obstacle_layer(&world, &parameters);
        let lethal = layer.lethal();
        for (place, class) in &world.cells {
            let at = world.fixed(*place);
            let is_in_window =
                (0..2).all(|axis| (at[axis] - pose.translation.vector[axis]).abs() < HALF_WINDOW_M - 0.5);
            match World::meaning(*class) {
                ClassMeaning::Occupied | ClassMeaning::Low if is_in_window => {
                    let off_m = nearest_m(at, &lethal);
                    assert!(off_m <= OFF_M_MAX, "{place:?} is {off_m} m off at {pose}");
                }
                ClassMeaning::Free => {}
                // Outside the window there is no information.
                _ => assert_ne!(layer.cost(at), 0, "{place:?} at {pose}"),
            }
        }
        let free = layer.costs.iter().filter(|cost| **cost == 0).count();
        assert!(free > 1000, "{free} cells are cleared around the vehicle at {pose}");
    }
    let stale = world(None);
    let layer = stale.map.layer("freespace").unwrap();
    let raster = &Raster::from_grid(&layer.grid);
    let frames = &FrameNames::new("car", None);
    let shown = ShownLayer { map: &stale.map, layer, raster, frames, is_fresh: false };
    let of_stale = topics_of("freespace").iter().filter(|topic| !topic.is_latched).map(|topic| (topic.write)(&shown));
    assert!(of_stale.eq([None, None]), "expected_update_rate shows that clouds are missing");
}
