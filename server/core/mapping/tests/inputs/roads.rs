//! Roads in events and in files: what is accepted, what is refused, and lanes of real networks on the map.

use bytes::Bytes;
use clearway_mapping::config::{Extrinsics, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Road, RoadFrame, RoadPurpose};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::road::rddf::Rddf;
use clearway_mapping::road::rndf::Rndf;
use clearway_mapping::road::{self, LocalFrame};

use crate::common;

fn good() -> Road {
    Road {
        stamp_ns: 1,
        purpose: RoadPurpose::Paint,
        frame: RoadFrame::Ego,
        points: vec![[0.0, 0.0], [5.0, 0.0], [10.0, 1.0]],
        widths_m: vec![4.0; 3],
        orientations: vec![1.0, 2.0],
        speed_limits_mps: Vec::new(),
    }
}

fn pipeline() -> Pipeline {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let config = VehicleConfig::new("car", vec![SensorConfig::new("top", extrinsics)]);
    Pipeline::new(&config, vec![None]).unwrap()
}

fn step(pipeline: &mut Pipeline, body: Body) -> Result<(), (&'static str, String)> {
    let event = Event { sequence: 0, arrival_ns: 0, source: 0, body };
    pipeline.step(&event).map(|_| ()).map_err(|rejected| (rejected.reason(), rejected.to_string()))
}

#[test]
fn a_road_of_the_future_does_not_block_one_of_the_present() {
    let mut pipeline = pipeline();
    let road = |stamp_ns| Body::Road(Road { stamp_ns, ..good() });
    assert_eq!(step(&mut pipeline, road(i64::MAX / 4)), Ok(()));
    assert_eq!(step(&mut pipeline, road(2)), Ok(()));
    assert_eq!(step(&mut pipeline, road(1)).unwrap_err().0, "stamp");
}

#[test]
fn an_invalid_road_is_refused_and_counted_and_the_one_before_stays() {
    let mut pipeline = pipeline();
    assert_eq!(step(&mut pipeline, Body::Road(good())), Ok(()));

    type Change = fn(&mut Road);
    let changes: [(&str, Change); 20] = [
        ("road_points", |road| road.points.clear()),
        ("road_points", |road| road.points.truncate(1)),
        ("road_points", |road| road.points = vec![[0.0; 2]; 65_537]),
        ("road_widths", |road| road.widths_m.truncate(2)),
        ("road_coinciding", |road| road.points[2] = road.points[1]),
        ("road_coinciding", |road| road.points[1] = [0.001, 0.001]),
        ("road_point", |road| road.points[1][0] = f64::NAN),
        ("road_point", |road| road.points[1][1] = f64::INFINITY),
        ("road_point", |road| road.points[0][1] = 1e9),
        ("road_width", |road| road.widths_m[1] = -4.0),
        ("road_width", |road| road.widths_m[1] = f64::NAN),
        ("road_width", |road| road.widths_m[1] = 0.0),
        ("road_orientations", |road| road.orientations[0] = -1.0),
        ("road_orientations", |road| road.orientations[0] = f32::NAN),
        ("road_orientations", |road| road.orientations = vec![0.0; 9]),
        ("road_speed_limits", |road| road.speed_limits_mps = vec![5.0; 2]),
        ("road_speed_limit", |road| road.speed_limits_mps = vec![5.0, -1.0, 5.0]),
        ("road_speed_limit", |road| road.speed_limits_mps = vec![5.0, 5.0, f64::NAN]),
        ("road_speed_limit", |road| road.speed_limits_mps = vec![f64::INFINITY, 5.0, 5.0]),
        ("stamp", |road| road.stamp_ns = 0),
    ];
    for (reason, change) in changes {
        let mut road = Road { stamp_ns: 2, ..good() };
        change(&mut road);
        let (found, message) = step(&mut pipeline, Body::Road(road)).unwrap_err();
        assert_eq!(found, reason, "{message}");
        assert!(message.contains("allowed"), "{message}");
    }
    // A road of another purpose has its own stamps, and other events are accepted as before.
    assert_eq!(step(&mut pipeline, Body::Road(Road { purpose: RoadPurpose::Route, ..good() })), Ok(()));
    assert_eq!(step(&mut pipeline, Body::Road(Road { stamp_ns: 2, ..good() })), Ok(()));
    let pose = EgoPose { stamp_ns: 1, map_from_ego: nalgebra::Isometry3::identity(), speed_mps: 0.0 };
    assert_eq!(step(&mut pipeline, Body::EgoPose(pose)), Ok(()));
    assert_eq!(step(&mut pipeline, Body::Datagram(Bytes::from_static(b"short"))).unwrap_err().0, "length");
    let ledger = pipeline.ledger();
    let refused = [
        ("road_coinciding", 2),
        ("road_orientations", 3),
        ("road_point", 3),
        ("road_points", 3),
        ("road_speed_limit", 3),
        ("road_speed_limits", 1),
        ("road_width", 3),
        ("road_widths", 1),
        ("stamp", 1),
    ];
    assert_eq!((ledger.roads, &ledger.roads_refused), (3, &refused.into()));
    assert_eq!((ledger.received, ledger.poses), (1, 1), "roads are not counted as received datagrams");
}

const RDDF: &str = "1,34.7607233,-117.0107599,90,10\n732,34.9313317,-116.7157473,13,15,13,30,0\n\
                    2557,35.6626488,-115.369351,800,60\n2586,35.6162012,-115.3821023,12,0\n";

#[test]
fn the_rows_of_a_route_file_give_its_centre_line() {
    let rddf = Rddf::read(RDDF);
    assert_eq!((rddf.rows.len(), rddf.refused.len()), (4, 0));
    let row = rddf.rows[1];
    assert_eq!((row.number, row.latitude_deg, row.longitude_deg), (732, 34.9313317, -116.7157473));
    assert!((row.lateral_offset_m - 13.0 * 0.3048).abs() < 1e-12 && (row.speed_mps - 15.0 * 0.44704).abs() < 1e-12);
    let road = rddf.road(&rddf.local_frame().unwrap(), RoadPurpose::Route, 7);
    assert_eq!(road::check(&road), Ok(()));
    assert_eq!((road.points[0], road.frame, road.purpose), ([0.0, 0.0], RoadFrame::Map, RoadPurpose::Route));
    assert!((road.widths_m[2] - 487.68).abs() < 1e-9);
    assert!((road.speed_limits_mps[2] - 60.0 * 0.44704).abs() < 1e-12 && road.speed_limits_mps[3] == 0.0);
}

#[test]
fn a_row_with_missing_or_invalid_fields_is_left_out_and_reported() {
    let text = "1,34.76,-117.01,90,10\n2,34.77,-117.02\n3,34.78\n4\n,34.7,-117.0,90,10\n5,94.0,-117.03,90,10\n\
                6,34.79,-217.0,90,10\n7,34.79,-117.0,-90,10\n8,34.79,-117.0,NaN,10\n9,34.79,-117.0,90\n\
                10,34.79,-117.0,90,fast\n# a comment\n\n11,34.80,-117.04,90,10\n12,34.80,-117.04,90,10\r\n";
    let rddf = Rddf::read(text);
    assert_eq!(rddf.rows.iter().map(|row| row.number).collect::<Vec<_>>(), [1, 11]);
    let refused: Vec<_> = rddf.refused.iter().map(|refused| (refused.line, refused.what)).collect();
    let expected = [
        (2, "lateral offset"),
        (3, "longitude"),
        (4, "latitude"),
        (5, "number"),
        (6, "latitude"),
        (7, "longitude"),
        (8, "lateral offset"),
        (9, "lateral offset"),
        (10, "speed"),
        (11, "speed"),
        (15, "place"),
    ];
    assert_eq!(refused, expected);
    assert_eq!(rddf.refused[0].to_string(), "line 2: lateral offset is \"\": allowed is more than 0, up to 1640 ft");
    assert_eq!(road::check(&rddf.road(&rddf.local_frame().unwrap(), RoadPurpose::Route, 0)), Ok(()));
    assert!(Rddf::read("").local_frame().is_none());
}

#[test]
fn invalid_lines_of_a_lane_are_left_out_and_reported() {
    let text = "lane 1.1 /* first */\nlane_width -12\n1.1.1 38.1 -77.1\n1.1.2 38.2\n1.2.3 38.2 -77.1\n1.1.4 38.2 -77.1\n\
                1.1.5 38.2 -77.1\nend_lane\nlane 1.2\nlane_width 12\n1.2.1 38.1 -77.2\nend_lane\nlane 1.3\n\
                lane_width 10\n1.3.1 38.1 -77.3\n1.3.2 38.2 -77.3\nend_lane\nzone 14\n14.0.1 38.0 -77.0\nend_zone\n";
    let rndf = Rndf::read(text);
    let refused: Vec<_> = rndf.refused.iter().map(|refused| (refused.line, refused.what)).collect();
    assert_eq!(refused, [(2, "lane_width"), (4, "longitude"), (5, "waypoint"), (7, "place"), (9, "lane")]);
    let names: Vec<_> = rndf.lanes.iter().map(|lane| (lane.name.as_str(), lane.width_m.is_some())).collect();
    assert_eq!(names, [("1.1", false), ("1.3", true)]);
    let frame = rndf.local_frame().unwrap();
    assert_eq!(rndf.lanes[0].road(&frame, None, 0), None);
    assert_eq!(rndf.lanes[0].road(&frame, Some(3.0), 0).unwrap().widths_m, [3.0, 3.0]);
}

#[test]
fn degrees_become_metres_on_the_ellipsoid() {
    // Lengths of a minute of latitude and longitude at 45° (Bowditch, table 7): 1852.2 m and 1314.2 m, to a decimetre.
    let frame = LocalFrame::new(45.0, 7.0);
    let [east, north] = frame.position_m(45.0 + 0.5 / 60.0, 7.0);
    assert!(east == 0.0 && (2.0 * north - 1852.2).abs() < 0.2, "{north}");
    let [east, north] = frame.position_m(45.0, 7.0 + 1.0 / 60.0);
    assert!(north == 0.0 && (east - 1314.2).abs() < 0.2, "{east}");
    assert_eq!(LocalFrame::new(-33.0, 151.0).position_m(-33.0, 151.0), [0.0, 0.0]);
}

fn network(path: &str) -> Rndf {
    // One of the files contains Latin-1.
    Rndf::read(&String::from_utf8_lossy(&std::fs::read(common::data(path)).unwrap()))
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_lanes_of_real_networks_are_read_whole() {
    // Number of lanes, of lanes with a width, and of waypoints.
    let whole = |path: &str| {
        let rndf = network(path);
        assert_eq!(rndf.refused, [], "{path}");
        let frame = rndf.local_frame().unwrap();
        for lane in &rndf.lanes {
            let road = lane.road(&frame, Some(3.6), 0).unwrap();
            assert_eq!(road::check(&road), Ok(()), "{path} lane {}", lane.name);
        }
        let widths = rndf.lanes.iter().filter(|lane| lane.width_m.is_some()).count();
        (rndf.lanes.len(), widths, rndf.lanes.iter().map(|lane| lane.waypoints_deg.len()).sum::<usize>())
    };
    assert_eq!(whole("road/utexas/swri_site_visit.rndf"), (6, 6, 60));
    let found = ["urban_challenge/sample1", "utexas/swri_site_visit_with_zones", "utexas/outside_prc_gen"]
        .map(|name| whole(&format!("road/{name}.rndf")));
    insta::assert_debug_snapshot!(found);
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_real_lane_is_painted_with_the_width_of_its_file() {
    use clearway_mapping::config::{Bonus, SpeedConfig};
    use clearway_mapping::layer::speed::Speed;
    use clearway_mapping::layer::speed::class::SpeedClass;
    use clearway_mapping::layer::{Context, LayerMaker};
    use clearway_mapping::road::StoredRoad;

    let mut sweep = common::empty(clearway_lidar::model::Model::Hdl64eS2);
    for ix in -240..240 {
        for iy in -240..240 {
            common::add(&mut sweep, [0.125 * ix as f32 + 0.06, 0.125 * iy as f32 + 0.06, 0.0]);
        }
    }
    let rndf = network("road/utexas/swri_site_visit.rndf");
    let frame = rndf.local_frame().unwrap();
    let config = SpeedConfig { extent_m: 30.0, cell_m: 0.25, bonus: Bonus::Relative, ..SpeedConfig::default() };
    let mut map = Speed::new(&config);
    let mut layer = map.layer();
    for lane in &rndf.lanes {
        let road = lane.road(&frame, None, 0).unwrap();
        // The vehicle is half-way between the first two waypoints of the lane and heads along it.
        let ([ax, ay], [bx, by]) = (road.points[0], road.points[1]);
        let pose = nalgebra::Isometry3::new(
            nalgebra::vector![(ax + bx) / 2.0, (ay + by) / 2.0, 200.0],
            nalgebra::vector![0.0, 0.0, (by - ay).atan2(bx - ax)],
        );
        let stored = StoredRoad { road, map_from_ego: None };
        let context = Context { road: Some(&stored), map_from_ego: Some(pose), ..Context::default() };
        map.make(&sweep, &context, &mut layer);
        let (rows, columns) = common::size(&layer);
        let across: Vec<usize> = (0..rows)
            .filter(|iy| common::classes(&layer)[iy * columns + columns / 2] == SpeedClass::Road.value())
            .collect();
        let painted_m = across.len() as f64 * 0.25;
        let width_m = lane.width_m.unwrap();
        // The tolerance is a cell on each side, and more inwards: a bend at the next waypoint narrows the painted lane.
        assert!(
            (0.85 * width_m - 0.25..=width_m + 0.25).contains(&painted_m),
            "lane {}: {painted_m} m of {width_m} m",
            lane.name
        );
        let middle = (across[0] + across[across.len() - 1] + 1) as f64 / 2.0;
        assert!((middle - rows as f64 / 2.0).abs() <= 1.0, "lane {}: middle at row {middle}", lane.name);
        let speeds = common::values(&layer, "speed");
        let fastest = (0..rows).max_by_key(|iy| speeds[iy * columns + columns / 2]).unwrap();
        assert!(fastest.abs_diff(rows / 2) <= 2, "lane {}: fastest in row {fastest}", lane.name);
    }
}
