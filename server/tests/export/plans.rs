//! `clearway export` draws the plans of a recording: the golden drive, in which an event is replaced by a plan.

use std::path::Path;

use clearway_proto::v1;
use prost::Message;
use serde_json::json;

use super::folder;
use super::pictures::decoded;
use crate::common::copied::copy;
use crate::common::{clearway, text, venv};

const PLAN_COLOUR: [u8; 3] = [255, 79, 216];

/// Writes the golden drive with a plan behind its fifth map: 10 m ahead, then 3 m to the left. Returns its stamp.
fn with_plan(to: &Path) -> i64 {
    let town = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/golden/town.mcap");
    let (mut stamp_ns, mut is_planned) = (None, false);
    copy(Path::new(town), to, |topic, _, data| {
        if topic.contains("/map/") {
            let header = v1::Map::decode(&*data).unwrap().header.unwrap();
            stamp_ns = stamp_ns.or((header.sequence == 4).then_some(header.capture_end_ns));
            return Some(data);
        }
        let Some(stamp_ns) = stamp_ns.filter(|_| topic.ends_with("/journal") && !is_planned) else { return Some(data) };
        is_planned = true;
        let plan = v1::Plan {
            planner: "tester".into(),
            stamp_ns,
            frame: v1::PlanFrame::Ego.into(),
            x: vec![0.0, 10.0, 10.0],
            y: vec![0.0, 0.0, 3.0],
            footprint_m: vec![2.0, 1.0, -2.0, 1.0, -2.0, -1.0, 2.0, -1.0],
            goal: Some(v1::PlanGoal { x: 16.0, y: 3.0 }),
            text: "blocked by a wall".into(),
            ..v1::Plan::default()
        };
        let body = Some(v1::event::Body::Plan(Box::new(plan)));
        Some(v1::Event { body, ..v1::Event::decode(&*data).unwrap() }.encode_to_vec())
    });
    assert!(is_planned, "an event follows the map");
    stamp_ns.expect("a map")
}

fn export(file: &Path, out: &Path, more: &[&str]) {
    let paths = [file.to_str().unwrap(), out.to_str().unwrap()];
    let done = clearway(&[&["export", paths[0], "--out", paths[1]], more].concat());
    assert!(done.status.success(), "{}", text(&done.stderr));
}

#[test]
fn the_plan_of_a_recording_is_drawn_over_the_maps_after_it() {
    let folder = folder();
    let [file, out] = ["run.mcap", "png"].map(|name| folder.path().join(name));
    with_plan(&file);
    export(&file, &out, &["--format", "png", "--layer", "freespace", "--pixels", "400", "--range", "25"]);
    if let Some(kept) = std::env::var_os("CLEARWAY_PICTURE") {
        std::fs::copy(out.join("000006_freespace.png"), kept).unwrap();
    }
    // 16 pixels are a metre; 5 m ahead.
    let at_path = |sequence: u32| {
        let (width, _, pixels, _) = decoded(&out.join(format!("{sequence:06}_freespace.png")));
        pixels[(200 - 40) * width + 200]
    };
    assert_ne!(at_path(4), PLAN_COLOUR, "it was planned with this map");
    assert_eq!(at_path(5), PLAN_COLOUR);
}

#[test]
fn the_plan_of_a_recording_is_a_scene_for_foxglove_and_a_path_for_ros_2() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    let stamp_ns = with_plan(&file);
    let plan_in = |format: &str| {
        let out = folder.path().join(format);
        export(&file, &out, &["--format", format, "--no-points"]);
        let topics = venv::run(venv::script("viewer_file.py").arg(&out), "mcap");
        let topics: serde_json::Value = serde_json::from_str(&topics).unwrap();
        let found = topics.as_object().unwrap().iter().find(|(topic, _)| topic.ends_with("/plan"));
        found.expect("a topic of the plan").1.clone()
    };
    let scene = plan_in("foxglove");
    assert_eq!((&scene["schema"], &scene["count"]), (&json!("foxglove.SceneUpdate"), &json!(1)));
    let entity = &scene["last"]["entities"][0];
    assert_eq!((&entity["id"], &entity["lifetime"]), (&json!("plan"), &json!("2s")));
    assert_eq!(entity["texts"][0]["text"], "blocked by a wall");
    assert_eq!(entity["lines"][0]["points"].as_array().unwrap().len(), 2 * (2 + 4 + 2), "path, footprint, cross");
    let path = plan_in("ros2");
    assert_eq!((&path["schema"], &path["count"]), (&json!("nav_msgs/msg/Path"), &json!(1)));
    let (header, poses) = (&path["last"]["header"], path["last"]["poses"].as_array().unwrap());
    assert_eq!(header["stamp"]["nanosec"], json!(stamp_ns.rem_euclid(1_000_000_000)));
    assert_eq!((poses.len(), &poses[1]["pose"]["position"]["x"]), (3, &json!(10.0)));
    let turned = poses[2]["pose"]["orientation"]["z"].as_f64().unwrap();
    assert!((turned - std::f64::consts::FRAC_1_SQRT_2).abs() < 1e-9, "it ends to the left: {turned}");
}
