//! The papers' own forms on every recorded drive.

use clearway_lidar::model::Model;
use clearway_mapping::config::{
    DrivabilityVariant, Extrinsics, MapsConfig, OccupancyVariant, SensorConfig, Variant, VehicleConfig,
};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::layer::occupancy::class::OccupancyClass;
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::scan_file;

use crate::common::{self, classes, data, figure, values};

/// Maps of a drive with the papers' forms of all layers.
fn maps(model: Option<Model>, extrinsics: Extrinsics, bodies: impl Iterator<Item = (i64, Body)>) -> Vec<Map> {
    let mut maps = MapsConfig::default();
    maps.drivability.variant = DrivabilityVariant::Paper;
    maps.terrain.variant = Variant::Paper;
    maps.occupancy.variant = OccupancyVariant::Paper;
    let sensor = SensorConfig { model, ..SensorConfig::new("top", extrinsics) };
    let config = VehicleConfig { maps, ..VehicleConfig::new("car", vec![sensor]) };
    let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
    let events =
        (0..).zip(bodies).map(|(sequence, (arrival_ns, body))| Event { sequence, arrival_ns, source: 0, body });
    events.filter_map(|event| pipeline.step(&event).unwrap().cloned()).collect()
}

fn mount([x_m, z_m, yaw_deg]: [f64; 3], tilt_deg: f64) -> Extrinsics {
    Extrinsics { x_m, y_m: 0.0, z_m, roll_deg: tilt_deg, pitch_deg: -tilt_deg, yaw_deg }
}

/// The scans of a folder, in the order of their names.
fn scans(folder: &str) -> Vec<(String, Scan)> {
    let mut paths: Vec<_> = std::fs::read_dir(data(folder)).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|of| of == "bin" || of == "pcd"));
    paths.sort();
    assert!(!paths.is_empty(), "{folder}");
    let scan = |path: std::path::PathBuf| {
        let name = path.display().to_string();
        let (_, scan) = scan_file::read(&name, &std::fs::read(&path).unwrap()).unwrap();
        (name, Scan { stamp_ns: 1_000_000, ..scan })
    };
    paths.into_iter().map(scan).collect()
}

/// Checks what each paper shows of a drive: drivable ground, a number of hits in each cell and a plane of each cell.
fn check(name: &str, map: &Map) {
    let [drivability, terrain, occupancy] =
        ["drivability", "terrain", "occupancy"].map(|name| map.layers.iter().find(|of| of.name == name).unwrap());
    let share = figure(drivability, "drivable_share");
    println!("{name} map {}: {:.1} % drivable", map.sequence, 100.0 * share);
    assert!(share > 0.2, "{name}: {share}");
    // Neuhaus 2009, figure 4: oriented quadrilaterals.
    let planes = ["height", "slope_x", "slope_y"].map(|channel| values(terrain, channel));
    let drawn = planes.iter().filter(|of| of.iter().filter(|value| **value != i32::from(i8::MIN)).count() > 100);
    assert_eq!(drawn.count(), 3, "{name}");
    // Seo 2014, figure 6: how many returns were observed in a cell.
    let hits = values(occupancy, "hits");
    let is_occupied = |cell: usize| classes(occupancy)[cell] == OccupancyClass::Occupied.value();
    let numbers: std::collections::BTreeSet<i32> =
        (0..hits.len()).filter(|cell| !is_occupied(*cell)).map(|cell| hits[cell]).collect();
    assert!((0..hits.len()).filter(|cell| is_occupied(*cell)).all(|cell| hits[cell] == 255), "{name}");
    assert!(numbers.contains(&1), "{name}: numbers of returns {numbers:?}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_papers_own_forms_find_ground_hits_and_planes_on_every_recorded_drive() {
    let (kitti, nuscenes) = (mount([0.0, 1.73, 0.0], 0.0), mount([0.94, 1.84, -90.0], 0.0));
    for (folder, model, extrinsics) in [
        ("kitti/patchwork-plusplus", Model::Hdl64eS2, kitti),
        ("kitti/udacity_data_2", Model::Hdl64eS2, kitti),
        ("labelled/hdl64e", Model::Hdl64eS2, kitti),
        ("labelled/hdl32e", Model::Hdl32e, nuscenes),
        ("nuscenes/mmdet3d", Model::Hdl32e, nuscenes),
    ] {
        for (name, scan) in scans(folder) {
            let made = maps(Some(model), extrinsics, std::iter::once((scan.stamp_ns, Body::Scan(scan))));
            assert_eq!(made.len(), 1, "{name}");
            check(&name, &made[0]);
        }
    }
    for (path, height_m) in
        [("pcap/rust-lidar-utils/hdl32_example.pcap", 2.165), ("pcap/opendlv/proxy-velodyne16/sampleShort.pcap", 1.59)]
    {
        let datagrams = common::datagrams(path).into_iter();
        let bodies = datagrams.map(|datagram| (datagram.stamp_ns, Body::Datagram(datagram.payload.into())));
        let made = maps(None, mount([0.0, height_m, 0.0], 1.4), bodies);
        let whole: Vec<&Map> = made.iter().filter(|map| map.sensors[0].partial.is_empty()).collect();
        assert!(whole.len() >= 2, "{path}: {}", whole.len());
        whole.iter().for_each(|map| check(path, map));
    }
}
