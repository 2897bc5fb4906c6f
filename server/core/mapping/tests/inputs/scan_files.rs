//! Scan files of every kind, and what their scans state about the lasers of their sensor.

use clearway_lidar::calibration::Calibration;
use clearway_mapping::config::{Extrinsics, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, Event, Scan};
use clearway_mapping::map::{ElevationSource, Map};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::scan_file::{POINTS_MAX, ScanFormat, read, read_bin, read_pcd};
use proptest::prelude::*;

use crate::common;

/// Greatest number of points for each byte of a file: LZF repeats 264 bytes for 3, and a point has at least 3 bytes.
const POINTS_A_BYTE: usize = 30;

fn pcd_bytes() -> impl Strategy<Value = Vec<u8>> {
    let number = prop_oneof![4 => 0usize..9, 1 => Just(usize::MAX), 1 => 0usize..5_000_000];
    let numbers = prop::collection::vec(number.clone(), 5);
    let types = prop::collection::vec(prop::sample::select(vec!["F", "I", "U", "X"]), 5);
    let data = prop::sample::select(vec!["ascii", "binary", "binary_compressed", "x"]);
    let body = prop::collection::vec(prop_oneof![any::<u8>(), Just(b' '), Just(b'1'), Just(b'\n'), Just(0)], 0..600);
    (numbers.clone(), types, prop::collection::vec(1usize..3, 5), number, data, body).prop_map(
        |(sizes, types, counts, points, data, body)| {
            let words = |values: Vec<usize>| values.iter().map(usize::to_string).collect::<Vec<_>>().join(" ");
            let (sizes, types, counts) = (words(sizes), types.join(" "), words(counts));
            let fields = "x y z intensity ring";
            let mut file =
                format!("FIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nPOINTS {points}\nDATA {data}\n")
                    .into_bytes();
            file.extend(body);
            file
        },
    )
}

/// Checks that a file is refused, or has lists of one length of no more points than its bytes can state.
fn check_read(bytes: &[u8]) -> Result<(), TestCaseError> {
    for scan in [read_bin(bytes), read_pcd(bytes), read("a.pcd.bin", bytes).map(|(_, scan)| scan)].into_iter().flatten()
    {
        let points = scan.x.len();
        prop_assert!(points <= POINTS_MAX && points <= bytes.len() * POINTS_A_BYTE);
        prop_assert_eq!([scan.y.len(), scan.z.len(), scan.intensity.len()], [points; 3]);
        prop_assert!(scan.ring.is_empty() || scan.ring.len() == points);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn no_bytes_make_a_reader_panic_or_return_more_than_they_hold(
        bytes in prop::collection::vec(any::<u8>(), 0..2000),
        pcd in pcd_bytes(),
        floats in prop::collection::vec(-9f32..9.0, 0..400),
    ) {
        check_read(&bytes)?;
        check_read(&pcd)?;
        check_read(&floats.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())?;
    }
}

/// Level ground 1.9 m under the sensor: 16 rings of 360 points, ring by ring from the highest down.
fn ground() -> Scan {
    let angle = |i: usize| (i % 360) as f32 * std::f32::consts::TAU / 360.0;
    let radius = |i: usize| 1.9 / (0.08 + 0.03 * (i / 360) as f32);
    let points = |value: &dyn Fn(usize) -> f32| (0..16 * 360).map(value).collect::<Vec<f32>>();
    Scan {
        stamp_ns: 1_000_000,
        x: points(&|i| radius(i) * angle(i).cos()),
        y: points(&|i| radius(i) * angle(i).sin()),
        z: points(&|_| -1.9),
        intensity: points(&|_| 0.5),
        ..Scan::default()
    }
}

/// The points of a scan in an order without any meaning, at elevations without clusters.
fn shuffled(scan: &Scan) -> Scan {
    let order = |i: usize| i * 1979 % scan.x.len();
    let pick = |axis: &[f32], by: f32| (0..axis.len()).map(|i| axis[order(i)] * (1.0 + by * (i % 89) as f32)).collect();
    Scan {
        x: pick(&scan.x, 0.005),
        y: pick(&scan.y, 0.005),
        z: pick(&scan.z, 0.0),
        intensity: scan.intensity.clone(),
        ..scan.clone()
    }
}

fn map(sensor: SensorConfig, calibration: Option<Calibration>, scan: Scan) -> (Map, Pipeline) {
    let mut pipeline = Pipeline::new(&VehicleConfig::new("car", vec![sensor]), vec![calibration]).unwrap();
    let event = Event { sequence: 0, arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) };
    (pipeline.step(&event).unwrap().unwrap().clone(), pipeline)
}

fn sensor() -> SensorConfig {
    let mount = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    SensorConfig::new("top", mount)
}

#[test]
fn a_scan_that_contradicts_the_configured_model_is_refused_by_name() {
    let refused = |sensor: &SensorConfig, scan: Scan| {
        let mut pipeline = Pipeline::new(&VehicleConfig::new("car", vec![sensor.clone()]), vec![None]).unwrap();
        let event = Event { sequence: 0, arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) };
        pipeline.step(&event).map(|map| map.is_some()).map_err(|error| (error.reason(), error.to_string()))
    };
    let vlp16 = SensorConfig { model: Some(clearway_lidar::model::Model::Vlp16), ..sensor() };
    let with_rings = |lift: u16| Scan { ring: (0..16 * 360u16).map(|i| 15 - i / 360 + lift).collect(), ..ground() };
    // The upper rings alone lie within the elevations of a VLP-16.
    let upper = |scan: Scan| {
        let cut = |of: &Vec<f32>| of[..6 * 360].to_vec();
        let ring = scan.ring.iter().copied().take(6 * 360).collect();
        Scan { x: cut(&scan.x), y: cut(&scan.y), z: cut(&scan.z), intensity: cut(&scan.intensity), ring, ..scan }
    };
    let (reason, said) = refused(&vlp16, upper(with_rings(48))).unwrap_err();
    assert_eq!(reason, "scan_model");
    assert!(said.contains("scan with ring 63: the configured model vlp16 has 16 lasers, so 0 to 15 is"), "{said}");
    let (reason, said) = refused(&vlp16, with_rings(0)).unwrap_err();
    assert_eq!(reason, "scan_model");
    assert!(said.contains("of its points outside of the elevations -15 to 15 degrees of the configured"), "{said}");
    assert_eq!(refused(&vlp16, upper(with_rings(0))), Ok(true));
    // The configured elevations are used in place of the model's.
    assert_eq!(refused(&SensorConfig { elevations_deg: vec![-20.0, -5.0], ..vlp16 }, ground()), Ok(true));
}

#[test]
fn a_map_names_the_source_of_the_elevations() {
    use ElevationSource::*;
    let elevations_deg = vec![-20.0, -10.0, -5.0];
    let ringed = Scan { ring: (0..16 * 360u16).map(|i| 15 - i / 360).collect(), ..ground() };
    let with_model = SensorConfig { model: Some(clearway_lidar::model::Model::Hdl32e), ..sensor() };
    let both = SensorConfig { elevations_deg: elevations_deg.clone(), ..with_model.clone() };
    let table = Some(Calibration::factory(clearway_lidar::model::Model::Hdl32e));
    let cases = [
        ("rings", sensor(), None, ringed, Rings, 16),
        ("order", sensor(), None, ground(), Estimated, 16),
        ("no order", sensor(), None, shuffled(&ground()), Unknown, 60),
        ("elevations", SensorConfig { elevations_deg, ..sensor() }, None, ground(), Configured, 3),
        ("model", with_model.clone(), None, ground(), Model, 22),
        ("both", both.clone(), None, ground(), Configured, 3),
        ("table", both, table, ground(), Table, 22),
    ];
    for (name, sensor, calibration, scan, expected, rows) in cases {
        let (map, pipeline) = map(sensor, calibration, scan);
        assert_eq!(map.sensors[0].elevations, Some(expected), "{name}");
        assert_eq!(pipeline.sensors()[0].elevations, Some(expected), "{name}");
        let layer = &map.layers[0];
        let found = if expected == Unknown { common::benches(layer) } else { common::ring_benches(layer) }.len();
        assert!(found.abs_diff(rows) <= rows / 5, "{name}: {found} rows");
        assert!(common::classes(&map.layers[0]).iter().any(|class| *class != 0), "{name}");
        assert_eq!(expected.advice().is_some(), matches!(expected, Estimated | Unknown), "{name}");
    }
}

#[cfg(clearway_data)]
mod recorded {
    use super::*;

    const NUSCENES: &str = "nuscenes/mmdet3d/n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin";

    fn bytes(path: &str) -> Vec<u8> {
        std::fs::read(common::data(path)).unwrap()
    }

    #[test]
    fn a_nuscenes_scan_is_read_with_its_rings_whatever_its_name() {
        let file = bytes(NUSCENES);
        for name in [NUSCENES, "000000.bin", "scan"] {
            let (format, scan) = read(name, &file).unwrap();
            assert_eq!((format, scan.x.len()), (ScanFormat::NuScenes, 34_688), "{name}");
            assert_eq!((scan.x[1], scan.z[1], scan.ring[1]), (-3.290_636_3, -1.863_189_2, 1));
            assert!((scan.intensity[0] - 4.0 / 255.0).abs() < 1e-6);
            assert_eq!(scan.ring.iter().max(), Some(&31));
        }
        let (map, _) = map(sensor(), None, read_bin(&file).unwrap());
        assert_eq!(map.sensors[0].elevations, Some(ElevationSource::Rings));
        // The rings of an HDL-32E whose rays meet the ground within 60 m.
        let rows = common::ring_benches(&map.layers[0]).len();
        assert!((20..=24).contains(&rows), "{rows} rows");
    }

    #[test]
    fn a_kitti_scan_has_64_rings_by_the_order_of_its_points() {
        for (name, path) in [
            ("0.bin", "kitti/patchwork-plusplus/000000.bin"),
            ("0.pcd.bin", "kitti/patchwork-plusplus/000001.bin"),
            ("0.pcd", "kitti/udacity_data_2/0000000004.pcd"),
        ] {
            let (format, scan) = read(name, &bytes(path)).unwrap();
            let expected = if name == "0.pcd" { ScanFormat::Pcd } else { ScanFormat::Kitti };
            assert_eq!((format, scan.ring[0], scan.ring.iter().max()), (expected, 63, Some(&63)), "{path}");
            let elevation_deg = |ring: u16| {
                let of_ring = (0..scan.x.len()).filter(|i| scan.ring[*i] == ring && scan.x[*i] != 0.0);
                let mut found: Vec<f32> =
                    of_ring.map(|i| scan.z[i].atan2(scan.x[i].hypot(scan.y[i])).to_degrees()).collect();
                {
                    let middle = found.len() / 2;
                    *found.select_nth_unstable_by(middle, f32::total_cmp).1
                }
            };
            assert!((elevation_deg(0) + 24.0).abs() < 1.0 && elevation_deg(63) > 1.0, "{path}");
        }
    }

    #[test]
    fn points_without_rings_show_the_lasers_of_a_vls_128() {
        let path = "ros2bag/nebula/decoder_ground_truth/vls128/1585897255376374245.pcd";
        let scan = Scan { stamp_ns: 1, ..read_pcd(&bytes(path)).unwrap() };
        assert!(scan.ring.is_empty(), "its points are in the order of their firings");
        let (map, _) = map(sensor(), None, scan);
        assert_eq!(map.sensors[0].elevations, Some(ElevationSource::Estimated));
        let channels = read_pcd(&bytes("ros2bag/nebula/decoder_ground_truth/vlp16/1673400472138016708.pcd")).unwrap();
        assert_eq!(channels.ring.iter().max(), Some(&14), "the field `channel`; one laser of 16 returned nothing");
    }

    #[test]
    fn compressed_pcd_files_are_read_with_their_rings() {
        for (file, points, rings) in [("top", 92_677, 64), ("left", 0, 0), ("right", 0, 0)] {
            let path = format!("multilidar/opencalib/real_world/0001/{file}.pcd");
            let scan = read_pcd(&bytes(&path)).unwrap();
            let distinct: std::collections::BTreeSet<u16> = scan.ring.iter().copied().collect();
            println!("{file}: {} points, {} rings", scan.x.len(), distinct.len());
            assert!(points == 0 || (scan.x.len(), distinct.len()) == (points, rings), "{file}");
            let near = (0..scan.x.len()).filter(|i| scan.x[*i].hypot(scan.y[*i]) < 250.0).count();
            assert!(near * 100 > scan.x.len() * 99 && scan.x.len() > 3000, "{file}");
        }
    }

    #[test]
    fn an_hdl_64e_without_its_table_is_named() {
        let path = "pcap/opendlv/proxy-velodyne64/cut_for_developers/atwall_first174packets.pcap";
        let named = |calibration: Option<Calibration>| {
            let mut pipeline = Pipeline::new(&VehicleConfig::new("car", vec![sensor()]), vec![calibration]).unwrap();
            for (sequence, datagram) in (0..).zip(common::datagrams(path)) {
                let body = Body::Datagram(datagram.payload.into());
                let _ = pipeline.step(&Event { sequence, arrival_ns: datagram.stamp_ns, source: 0, body });
            }
            let end = Event { sequence: 999, arrival_ns: i64::MAX / 2, source: 0, body: Body::End };
            let map = pipeline.step(&end).unwrap().expect("a partial revolution").clone();
            assert_eq!(pipeline.sensors()[0].elevations, map.sensors[0].elevations);
            map.sensors[0].elevations.unwrap()
        };
        assert_eq!(named(None), ElevationSource::Nominal);
        assert!(ElevationSource::Nominal.advice().unwrap().contains("0.33 m"));
        let table = bytes("pcap/opendlv/proxy-velodyne64/db.xml");
        let table = Calibration::load_str(&String::from_utf8(table).unwrap()).unwrap();
        assert_eq!(named(Some(table)), ElevationSource::Table);
    }
}
