//! The tree of frames.

use clearway_ros::Frames;
use clearway_ros::cdr::Header;
use clearway_ros::pose::StampedTransform;
use nalgebra::{Isometry3, Point3, Vector3};

fn transform<'a>(parent: &'a str, child: &'a str, x: f64, yaw: f64) -> StampedTransform<'a> {
    let parent_from_child = Isometry3::new(Vector3::new(x, 0.0, 0.0), Vector3::new(0.0, 0.0, yaw));
    StampedTransform { header: Header { stamp_ns: 1, frame_id: parent }, child_frame_id: child, parent_from_child }
}

#[test]
fn a_frame_is_found_up_and_down_its_tree_only() {
    let mut frames = Frames::default();
    let quarter = std::f64::consts::FRAC_PI_2;
    for (parent, child, x, yaw) in [
        ("map", "odom", 100.0, 0.0),
        ("odom", "/base_link", 5.0, quarter),
        ("base_link", "top", 2.0, 0.0),
        ("rig", "left", 1.0, 0.0),
    ] {
        assert!(frames.insert(&transform(parent, child, x, yaw)));
    }
    let at = |a: &str, b: &str| frames.a_from_b(a, b).map(|a_from_b| a_from_b * Point3::origin());
    let near = |a: Option<Point3<f64>>, x: f64, y: f64| (a.unwrap() - Point3::new(x, y, 0.0)).norm() < 1e-12;
    assert!(near(at("base_link", "top"), 2.0, 0.0));
    assert!(near(at("map", "top"), 105.0, 2.0));
    assert!(near(at("top", "odom"), -2.0, 5.0));
    assert_eq!(at("top", "/top"), Some(Point3::origin()));
    assert_eq!(at("base_link", "left"), None);
    assert_eq!(at("base_link", "absent"), None);
    assert_eq!([frames.steps_up("top", "map"), frames.steps_up("left", "map")], [Some(3), None]);
    assert!(frames.names().contains("rig") && !frames.names().contains("absent"));
}

#[test]
fn a_cycle_of_frames_ends() {
    let mut frames = Frames::default();
    frames.insert(&transform("a", "b", 1.0, 0.0));
    frames.insert(&transform("b", "a", 1.0, 0.0));
    assert_eq!(frames.a_from_b("map", "a"), None);
}
