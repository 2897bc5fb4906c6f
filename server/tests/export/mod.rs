//! `clearway export` and `clearway info` read a recording that the test writes.

mod pictures;
mod plans;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use clearway_lidar::model::Model;
use clearway_lidar::{Sensor, SensorConfig};
use clearway_proto::map::SafePoint;
use clearway_proto::{safe_points, v1};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::vehicle::SimulatedVehicle;
use prost::Message;
use serde_json::{Value, json};

use crate::common::{CAPTURE_END_NS, CLASSES, clearway, map, text, venv};

/// The map's layer with another name and three safe points: a line to the left of the vehicle, and a branch ahead.
fn safe_path(mut layer: v1::Layer) -> v1::Layer {
    let point = |x_m, y_m, radius_m, links: &[u32]| SafePoint { x_m, y_m, radius_m, links: links.to_vec() };
    let points = [point(0.0, 0.0, 2.0, &[]), point(0.0, 12.0, 4.0, &[0]), point(6.0, 12.0, 2.5, &[1])];
    layer.name = "safe_path".into();
    layer.safe_points = Some(safe_points::pack(&points, 0.125));
    layer
}

/// Writes three maps of the vehicle alpha, as the server records them. An unfinished file is as after a crash.
fn record(path: &Path, finished: bool) {
    let mut writer = mcap::WriteOptions::new().compression_threads(0).create(File::create(path).unwrap()).unwrap();
    let metadata = BTreeMap::from([("boot_id".to_string(), "7".to_string())]);
    writer.write_metadata(&mcap::records::Metadata { name: "clearway".into(), metadata }).unwrap();
    let schema = writer.add_schema("clearway.v1.Map", "protobuf", clearway_proto::DESCRIPTORS).unwrap();
    let mut channel =
        |layer| writer.add_channel(schema, &format!("/alpha/map/{layer}"), "protobuf", &BTreeMap::new()).unwrap();
    let channels = ["drivability", "safe_path"].map(&mut channel);
    for sequence in 0..3 {
        let end_ns = CAPTURE_END_NS + 100_000_000 * i64::from(sequence);
        let log_time = end_ns as u64;
        let whole = map(sequence.into(), end_ns);
        let mut other = v1::Map::decode(whole.clone()).unwrap();
        other.layers = other.layers.into_iter().map(safe_path).collect();
        for (channel_id, bytes) in channels.into_iter().zip([whole, other.encode_to_vec().into()]) {
            let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &bytes).unwrap();
        }
        writer.flush().unwrap();
    }
    if finished {
        writer.finish().unwrap();
    } else {
        let length = std::fs::metadata(path).unwrap().len();
        // A dropped writer would finish the file.
        std::mem::forget(writer);
        File::options().write(true).open(path).unwrap().set_len(length - 1).unwrap();
    }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

#[test]
fn several_layers_or_all_are_exported_with_their_names() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record_drive(&file);
    let export = |name: &str, more: &[&str]| {
        let out = folder.path().join(name);
        let paths = [file.to_str().unwrap(), out.to_str().unwrap()];
        let arguments = ["export", paths[0], "--format", "png", "--pixels", "64", "--out", paths[1]];
        let done = clearway(&[&arguments, more].concat());
        let entries = std::fs::read_dir(&out).into_iter().flatten();
        let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        (done, names)
    };
    let of_layers = |layers: &[&str]| -> Vec<String> {
        (0..3).flat_map(|sequence| layers.iter().map(move |layer| format!("{sequence:06}_{layer}.png"))).collect()
    };
    let both = of_layers(&["drivability", "second"]);
    let (done, names) = export("all", &[]);
    assert_eq!(names, of_layers(&["drivability", "safe_path", "second"]));
    assert!(text(&done.stdout).contains("3 maps of drivability in"), "{}", text(&done.stdout));
    assert_eq!(export("two", &["--layer", "second,drivability"]).1, both);
    assert_eq!(export("again", &["--layer", "second", "--layer", "drivability"]).1, both);
    assert_eq!(export("one", &["--layer", "second"]).1.len(), 3);
    let (refused, _) = export("channel", &["--channel", "nothing"]);
    assert!(text(&refused.stderr).contains("no layer has the channel \"nothing\""), "{}", text(&refused.stderr));
    assert!(!folder.path().join("channel").exists(), "no folder is left");
    let (refused, _) = export("none", &["--layer", "second,third"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        text(&refused.stderr).contains("no layer \"third\"; it has drivability, safe_path, second"),
        "{}",
        text(&refused.stderr)
    );
}

#[test]
fn options_that_the_format_does_not_use_are_refused() {
    for (format, option) in
        [("json", "--range=9"), ("npy", "--channel=class"), ("ros2", "--pixels=80"), ("png", "--no-points")]
    {
        let done = clearway(&["export", "run.mcap", "--format", format, option, "--out", "x"]);
        let name = option.split('=').next().unwrap();
        assert!(done.status.code() == Some(3) && text(&done.stderr).contains(name), "{}", text(&done.stderr));
    }
    let done = clearway(&["get", "--out", "map.npy", "--range", "10"]);
    assert!(text(&done.stderr).contains("--range is for pictures: it needs --out FILE.png"), "{}", text(&done.stderr));
    assert_eq!(done.status.code(), Some(3));
}

#[test]
fn npy_writes_numpys_header_the_cells_and_a_json_document() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let out = folder.path().join("npy");
    let paths = [file.to_str().unwrap(), out.to_str().unwrap()];
    let done = clearway(&["export", paths[0], "--layer", "drivability", "--format", "npy", "--out", paths[1]]);
    assert!(done.status.success(), "{}", text(&done.stderr));
    let expected = [("class", "|u1", 12), ("unit_height", "|i1", 12), ("segment", "<u2", 24)];
    for (channel, dtype, length) in expected {
        let bytes = std::fs::read(out.join(format!("000002_drivability_{channel}.npy"))).unwrap();
        assert_eq!(bytes[..8], *b"\x93NUMPY\x01\x00");
        let header_end = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        assert_eq!(header_end % 64, 0);
        let header = text(&bytes[10..header_end]);
        let dictionary = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': (3, 4), }}");
        assert_eq!(header.trim_end(), dictionary);
        assert!(header.ends_with('\n'));
        assert_eq!(bytes.len() - header_end, length);
        if channel == "class" {
            assert_eq!(bytes[header_end..], CLASSES);
        }
    }
    let document: Value = serde_json::from_slice(&std::fs::read(out.join("000002_drivability.json")).unwrap()).unwrap();
    assert_eq!(document["sequence"], 2);
    assert_eq!(document["capture_end_ns"], CAPTURE_END_NS + 200_000_000);
    assert_eq!(document["geometry"]["row_radius_m"], serde_json::json!([10.0, 20.0, 30.0]));
    assert_eq!(document["legend"][3], "obstacle");
    assert_eq!(document["legend_meanings"][3], "CLASS_MEANING_OCCUPIED");
    assert_eq!(document["legend_rgb"][3], "#c42638");
    assert_eq!(document["channels"][1]["scale"], 0.5);
    assert_eq!(document["channels"][0].get("cells"), None);
}

#[test]
fn json_writes_the_cells_into_the_document() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let paths = [file.to_str().unwrap(), folder.path().to_str().unwrap()];
    let done = clearway(&["export", paths[0], "--layer", "drivability", "--format", "json", "--out", paths[1]]);
    assert!(done.status.success(), "{}", text(&done.stderr));
    let path = folder.path().join("000000_drivability.json");
    let document: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(document["channels"][0]["cells"], serde_json::json!(CLASSES));
    assert_eq!(document["shape"], serde_json::json!([3, 4]));
}

#[test]
fn a_recording_that_is_cut_off_is_exported_as_far_as_it_goes() {
    let folder = folder();
    let file = folder.path().join("cut.mcap");
    record(&file, false);
    let paths = [file.to_str().unwrap(), folder.path().to_str().unwrap()];
    let done = clearway(&["export", paths[0], "--layer", "drivability", "--format", "json", "--out", paths[1]]);
    assert_eq!(done.status.code(), Some(2), "{}", text(&done.stderr));
    assert!(text(&done.stderr).contains("cut after"), "{}", text(&done.stderr));
    assert!(folder.path().join("000001_drivability.json").exists());

    let info = clearway(&["info", paths[0], "--json"]);
    let document: Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!(document["complete"], false);
    assert_eq!(document["run"]["boot_id"], "7");
    assert!(document["maps"]["alpha"]["drivability"].as_u64().unwrap() >= 2);
}

#[test]
fn an_unknown_layer_is_refused_with_the_names_of_the_layers_before_anything_is_written() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let (path, out) = (file.to_str().unwrap(), folder.path().join("maps"));
    for layers in ["roughness", "drivability,roughness"] {
        for format in ["png", "npy", "foxglove"] {
            let arguments = ["export", path, "--layer", layers, "--format", format, "--out", out.to_str().unwrap()];
            let done = clearway(&arguments);
            let error = text(&done.stderr);
            assert_eq!(done.status.code(), Some(2));
            assert!(error.contains("no layer \"roughness\"; it has drivability, safe_path"), "{error}");
            assert!(!out.exists(), "{layers} as {format}");
        }
    }
}

#[test]
fn a_file_of_an_unknown_kind_is_refused() {
    let folder = folder();
    let file = folder.path().join("note.txt");
    std::fs::write(&file, "dear reader").unwrap();
    let path = file.to_str().unwrap();
    let info = clearway(&["info", path]);
    assert_eq!(info.status.code(), Some(2));
    assert!(text(&info.stderr).contains("not pcap, pcapng, MCAP"), "{}", text(&info.stderr));
    let exported = clearway(&["export", path, "--layer", "x", "--format", "png", "--out", path]);
    assert_eq!(exported.status.code(), Some(2));
    assert!(text(&exported.stderr).contains("not an MCAP file"), "{}", text(&exported.stderr));
    assert_eq!(clearway(&["export", path, "--format", "jpg"]).status.code(), Some(3));
}

const CONFIG: &str = "[[vehicle]]\nname = 'alpha'\nqueue = 16\n[[vehicle.sensor]]\nname = 'top'\nmodel = 'hdl64e_s2'\n\
    [vehicle.sensor.extrinsics]\nx_m = 0.5\ny_m = 0.0\nz_m = 1.9\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n";

/// Writes a journal of some revolutions of a simulated vehicle, and three maps of a vehicle at rest that faces left, as
/// the server records them. Returns the number of bytes of each revolution's points.
fn record_drive(path: &Path) -> Vec<usize> {
    let mut writer = mcap::WriteOptions::new().compression_threads(0).create(File::create(path).unwrap()).unwrap();
    let metadata = BTreeMap::from([("boot_id".to_string(), "7".to_string())]);
    writer.write_metadata(&mcap::records::Metadata { name: "clearway".into(), metadata }).unwrap();
    let (name, data) = ("config.toml".to_owned(), CONFIG.as_bytes().into());
    let media_type = "application/toml".to_owned();
    writer.attach(&mcap::Attachment { log_time: 0, create_time: 0, name, media_type, data }).unwrap();
    let mut channel = |schema: &str, topic: &str| {
        let schema = writer.add_schema(schema, "protobuf", clearway_proto::DESCRIPTORS).unwrap();
        writer.add_channel(schema, topic, "protobuf", &BTreeMap::new()).unwrap()
    };
    let journal = channel("clearway.v1.Event", "/alpha/journal");
    let layers = ["drivability", "second", "safe_path"];
    let layers = layers.map(|layer| channel("clearway.v1.Map", &format!("/alpha/map/{layer}")));
    let mut put = |channel_id: u16, log_ns: i64, bytes: &[u8]| {
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence: 0,
            log_time: log_ns as u64,
            publish_time: log_ns as u64,
        };
        writer.write_to_known_channel(&header, bytes).unwrap();
    };
    let mut next = 0;
    let mut event = |arrival_ns: i64, body: v1::event::Body| {
        let event = v1::Event { sequence: next, arrival_ns, body: Some(body), ..Default::default() };
        next += 1;
        put(journal, arrival_ns, &event.encode_to_vec());
    };
    let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::default() });
    let (mut revolutions, mut last_ns) = (Vec::new(), 0);
    for datagram in SimulatedVehicle::new(flat(), ScannerConfig::default()).take(1200) {
        if let Ok(Some(revolution)) = sensor.push(&datagram.payload, datagram.stamp_ns) {
            revolutions.push(12 * revolution.returns());
        }
        last_ns = datagram.stamp_ns;
        event(last_ns, v1::event::Body::Datagram(datagram.payload.into()));
    }
    revolutions.extend(sensor.finish().map(|revolution| 12 * revolution.returns()));
    event(last_ns, v1::event::Body::End(v1::End {}));
    // An event of a sensor that the configuration does not have.
    let stray =
        v1::Event { sequence: next, source: 3, body: Some(v1::event::Body::End(v1::End {})), ..Default::default() };
    put(journal, last_ns, &stray.encode_to_vec());
    for sequence in 0..3 {
        let end_ns = CAPTURE_END_NS + 100_000_000 * sequence;
        let mut map = v1::Map::decode(map(sequence as u64, end_ns)).unwrap();
        let header = map.header.as_mut().unwrap();
        let half = std::f64::consts::FRAC_1_SQRT_2;
        header.map_from_ego = Some(v1::Pose { x: 4.0, y: 2.0, qz: half, qw: half, ..Default::default() });
        header.speed_mps = Some(3.5);
        put(layers[0], end_ns + 1_000_000, &map.encode_to_vec());
        map.layers[0].name = "second".into();
        put(layers[1], end_ns + 1_000_000, &map.encode_to_vec());
        map.layers = map.layers.into_iter().map(safe_path).collect();
        put(layers[2], end_ns + 1_000_000, &map.encode_to_vec());
    }
    writer.finish().unwrap();
    revolutions
}

/// Exports, and reads the file with a decoder of another project.
fn exported(format: &str, more: &[&str]) -> (Value, Vec<usize>) {
    let folder = folder();
    let [file, out] = ["run.mcap", "out.mcap"].map(|name| folder.path().join(name));
    let revolutions = record_drive(&file);
    let paths = [file.to_str().unwrap(), out.to_str().unwrap()];
    let arguments = [&["export", paths[0], "--format", format, "--out", paths[1]], more].concat();
    let done = clearway(&arguments);
    assert!(done.status.success(), "{}", text(&done.stderr));
    let again = clearway(&arguments);
    assert!(!again.status.success() && text(&again.stderr).contains("exists"), "{}", text(&again.stderr));
    (serde_json::from_str(&venv::run(venv::script("viewer_file.py").arg(&out), "mcap")).unwrap(), revolutions)
}

/// The places of the lines of the links of [`safe_path`].
fn links() -> Vec<Value> {
    let places = [[0.0, 12.0], [0.0, 0.0], [6.0, 12.0], [0.0, 12.0]];
    places.map(|[x, y]| json!({"x": x, "y": y, "z": 0.05})).to_vec()
}

/// The topics of an exported file in alphabetical order, each with its schema and its number of messages.
fn schemas(file: &Value) -> Vec<(&str, &str, u64)> {
    let topics = file.as_object().unwrap().iter();
    let topics = topics.map(|(topic, of)| (&**topic, of["schema"].as_str().unwrap(), of["count"].as_u64().unwrap()));
    let mut topics: Vec<_> = topics.collect();
    topics.sort_unstable();
    topics
}

#[test]
fn a_ros_2_file_has_occupancy_grids_tf_and_odometry() {
    let (topics, _) = exported("ros2", &["--no-points"]);
    let expected = [
        ("/clearway/alpha/drivability", "nav_msgs/msg/OccupancyGrid", 3),
        ("/clearway/alpha/odometry", "nav_msgs/msg/Odometry", 3),
        ("/clearway/alpha/safe_path", "nav_msgs/msg/OccupancyGrid", 3),
        ("/clearway/alpha/safe_path/markers", "visualization_msgs/msg/MarkerArray", 3),
        ("/clearway/alpha/safe_path/poses", "geometry_msgs/msg/PoseArray", 3),
        ("/clearway/alpha/second", "nav_msgs/msg/OccupancyGrid", 3),
        ("/tf", "tf2_msgs/msg/TFMessage", 3),
    ];
    assert_eq!(schemas(&topics), expected);
    // As rosbag2 offers the topics: 1 keeps the newest message for later subscribers, 2 does not.
    for (topic, durability) in [("/clearway/alpha/drivability", 1), ("/clearway/alpha/safe_path/poses", 1), ("/tf", 2)]
    {
        let qos = topics[topic]["metadata"]["offered_qos_profiles"].as_str().expect("a profile");
        assert!(qos.contains(&format!("reliability: 1, durability: {durability}")), "{topic}: {qos}");
    }
    let markers = topics["/clearway/alpha/safe_path/markers"]["last"]["markers"].as_array().unwrap();
    let of = |marker: &Value| json!([marker["ns"], marker["type"], marker["action"], marker["lifetime"]]);
    let lifetime = json!({"sec": 0, "nanosec": 300_000_000});
    assert_eq!([of(&markers[0]), of(&markers[1])], ["links", "radii"].map(|name| json!([name, 5, 0, lifetime])));
    assert_eq!(markers[0]["points"], json!(links()), "each link leads to an earlier point");
    // Only the last point is an end; its radius is 2.5 m.
    let circle = markers[1]["points"].as_array().unwrap();
    let off = |point: &Value| (point["x"].as_f64().unwrap() - 6.0).hypot(point["y"].as_f64().unwrap() - 12.0);
    assert!(circle.len() == 64 && circle.iter().all(|point| (off(point) - 2.5).abs() < 1e-6), "{circle:?}");
    let poses = topics["/clearway/alpha/safe_path/poses"]["last"]["poses"].as_array().unwrap();
    let place = |pose: &Value| [&pose["position"]["x"], &pose["position"]["y"]].map(|m| m.as_f64().unwrap());
    assert_eq!(poses.iter().map(place).collect::<Vec<_>>(), [[0.0, 0.0], [0.0, 12.0], [6.0, 12.0]]);
    let turned = poses[1]["orientation"]["z"].as_f64().unwrap();
    assert!((turned - std::f64::consts::FRAC_1_SQRT_2).abs() < 1e-9, "the second point lies to the left: {turned}");
    let grid = &topics["/clearway/alpha/drivability"]["last"];
    assert_eq!(grid["header"], json!({"stamp": {"sec": 1_700_000_000, "nanosec": 300_000_000}, "frame_id": "map"}));
    let (info, corner) = (&grid["info"], &grid["info"]["origin"]["position"]);
    assert_eq!((&info["resolution"], &info["origin"]["orientation"]["w"]), (&json!(0.25), &json!(1.0)));
    // The vehicle stands at (4, 2) in `map` and heads along its y axis.
    let index = |at_m: f64, axis: &str| ((at_m - corner[axis].as_f64().unwrap()) * 4.0) as u64;
    let cell = |x_m: f64, y_m: f64| index(2.0 + x_m, "y") * info["width"].as_u64().unwrap() + index(4.0 - y_m, "x");
    let at = |x_m: f64, y_m: f64| grid["data"][cell(x_m, y_m) as usize].as_i64();
    assert_eq!(at(6.1, 6.1), Some(0), "ahead and to the left: drivable");
    assert_eq!(at(-6.1, 6.1), Some(100), "behind and to the left: not drivable");
    assert_eq!(at(-6.1, -6.1), Some(-1), "behind and to the right: unknown");
    assert_eq!(at(10.1, -10.1), Some(100), "ahead and to the right, 14 m off: an obstacle");
    assert_eq!(at(29.1, 29.1), Some(-1), "outside the grid");
    let transform = &topics["/tf"]["last"]["transforms"][0];
    assert_eq!(
        (&transform["header"]["frame_id"], &transform["child_frame_id"]),
        (&json!("map"), &json!("alpha/base_link"))
    );
    assert_eq!(transform["transform"]["translation"], json!({"x": 4.0, "y": 2.0, "z": 0.0}));
    let odometry = &topics["/clearway/alpha/odometry"]["last"];
    assert_eq!(odometry["twist"]["twist"]["linear"]["x"], 3.5);
    assert_eq!(odometry["pose"]["pose"]["orientation"]["z"], json!(std::f64::consts::FRAC_1_SQRT_2));
}

#[test]
fn a_ros_2_file_has_the_points_of_every_revolution_and_the_mount() {
    let (topics, revolutions) = exported("ros2", &["--layer", "second"]);
    let clouds = revolutions.len() as u64;
    let expected = [
        ("/clearway/alpha/odometry", "nav_msgs/msg/Odometry", 3),
        ("/clearway/alpha/points/top", "sensor_msgs/msg/PointCloud2", clouds),
        ("/clearway/alpha/second", "nav_msgs/msg/OccupancyGrid", 3),
        ("/tf", "tf2_msgs/msg/TFMessage", 3 + clouds),
    ];
    assert_eq!(schemas(&topics), expected);
    let cloud = &topics["/clearway/alpha/points/top"]["last"];
    let bytes = revolutions[revolutions.len() - 1];
    assert_eq!(
        (&cloud["header"]["frame_id"], &cloud["width"], &cloud["data"]["length"]),
        (&json!("alpha/top"), &json!(bytes / 12), &json!(bytes / 12 * 18))
    );
    let names: Vec<&Value> = cloud["fields"].as_array().unwrap().iter().map(|field| &field["name"]).collect();
    assert_eq!(names, ["x", "y", "z", "time", "ring"]);
    // The events are newer than the maps, so the last transform is the sensor's mount.
    let transform = &topics["/tf"]["last"]["transforms"][0];
    assert_eq!(
        (&transform["header"]["frame_id"], &transform["child_frame_id"]),
        (&json!("alpha/base_link"), &json!("alpha/top"))
    );
    assert_eq!(transform["transform"]["translation"], json!({"x": 0.5, "y": 0.0, "z": 1.9}));
}

#[test]
fn a_foxglove_file_has_grids_transforms_and_points_of_every_revolution() {
    let (topics, revolutions) = exported("foxglove", &[]);
    let clouds = revolutions.len() as u64;
    assert!(clouds >= 3, "{revolutions:?}");
    let expected = [
        ("/alpha/map/drivability", "foxglove.Grid", 3),
        ("/alpha/map/safe_path", "foxglove.Grid", 3),
        ("/alpha/map/second", "foxglove.Grid", 3),
        ("/alpha/points/top", "foxglove.PointCloud", clouds),
        ("/alpha/safe_points", "foxglove.SceneUpdate", 3),
        ("/tf", "foxglove.FrameTransforms", 3 + clouds),
    ];
    assert_eq!(schemas(&topics), expected);
    let grid = &topics["/alpha/map/drivability"]["last"];
    assert_eq!(grid["timestamp"], "2023-11-14T22:13:20.300Z");
    assert_eq!((&grid["frame_id"], &grid["column_count"]), (&json!("alpha/base_link"), &json!(240)));
    assert_eq!(grid["data"]["length"], 240 * 240 * 4);
    let scene = &topics["/alpha/safe_points"]["last"]["entities"][0];
    assert_eq!(
        (&scene["id"], &scene["frame_id"], &scene["lifetime"]),
        (&json!("safe_path"), &json!("alpha/base_link"), &json!("0.300s"))
    );
    // Protobuf's JSON leaves out zeros.
    let place = |point: &Value| {
        let [x, y, z] = ["x", "y", "z"].map(|axis| point[axis].as_f64().unwrap_or(0.0));
        json!({"x": x, "y": y, "z": z})
    };
    let lines = scene["lines"][0]["points"].as_array().unwrap();
    assert_eq!(lines.iter().map(place).collect::<Vec<_>>(), links());
    assert_eq!((&scene["lines"][0]["type"], scene["lines"].as_array().unwrap().len()), (&json!("LINE_LIST"), 2));
    let cloud = &topics["/alpha/points/top"]["last"];
    assert_eq!(
        (&cloud["frame_id"], &cloud["data"]["length"]),
        (&json!("alpha/top"), &json!(revolutions[revolutions.len() - 1]))
    );
    // The events are newer than the maps, so the last transform is the sensor's mount.
    let transform = &topics["/tf"]["last"]["transforms"][0];
    assert_eq!(
        (&transform["parent_frame_id"], &transform["child_frame_id"]),
        (&json!("alpha/base_link"), &json!("alpha/top"))
    );
    assert_eq!(transform["translation"], json!({"x": 0.5, "z": 1.9}));
}

#[test]
fn a_foxglove_file_has_one_layer_and_no_points_if_the_options_say_so() {
    let (topics, _) = exported("foxglove", &["--layer", "second", "--no-points"]);
    assert_eq!(schemas(&topics), [("/alpha/map/second", "foxglove.Grid", 3), ("/tf", "foxglove.FrameTransforms", 3)]);
}
