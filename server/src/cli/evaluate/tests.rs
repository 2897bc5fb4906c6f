//! Whole evaluations of hand-made scans and of a simulated scene.

use super::*;

const LEVEL: Extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.73, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };

/// Writes the points of a scan (sensor frame) and their labels to a new folder.
fn written(points: &[([f32; 3], u32)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let bytes = |[x, y, z]: [f32; 3]| [x, y, z, 0.5].map(f32::to_le_bytes).concat();
    let scan: Vec<u8> = points.iter().flat_map(|(place, _)| bytes(*place)).collect();
    let labels: Vec<u8> = points.iter().flat_map(|(_, class)| class.to_le_bytes()).collect();
    std::fs::write(folder.path().join("7.bin"), scan).unwrap();
    std::fs::write(folder.path().join("7.label"), labels).unwrap();
    folder
}

/// Level road from 3 to 24 m in every direction, with terrain at every third point, and a wall 1.5 m high across it at
/// azimuth 0.
fn street() -> Vec<([f32; 3], u32)> {
    let mut points = Vec::new();
    for step in 0..720 {
        let (sin, cos) = ((step as f32 + 0.5) * std::f32::consts::TAU / 720.0).sin_cos();
        let blocked = !(30..690).contains(&step);
        for tenth in 15..120 {
            let range = tenth as f32 * 0.2;
            if blocked && range > 12.0 {
                continue;
            }
            points.push(([range * cos, range * sin, -1.73], if tenth % 3 == 0 { 72 } else { 40 }));
        }
        if blocked {
            points.extend((1..6).map(|up| ([12.2 * cos, 12.2 * sin, -1.73 + up as f32 * 0.3], 50)));
        }
    }
    points
}

fn options(path: &Path) -> Options {
    Options { paths: vec![path.display().to_string()], extrinsics: Some(LEVEL), ..Options::default() }
}

#[test]
fn a_hand_made_street_gets_the_metrics_counted_by_hand() {
    let points = street();
    let folder = written(&points);
    let mut steps = Vec::new();
    let report = evaluate(&options(folder.path()), |done, total| steps.push((done, total))).unwrap();
    assert_eq!(steps, [(1, 1)]);
    let source = &report.sources[0];
    assert_eq!((source.frames, source.unlabelled), (1, 0));
    let (name, tally) = &source.layers[0];
    assert_eq!(name, "drivability");
    assert_eq!((tally.precision(), tally.recall(), tally.road_recall()), (Some(1.0), Some(1.0), Some(1.0)));
    assert!(tally.leaks.is_empty(), "{:?}", tally.leaks);
    // Every ground point, road or terrain, except those in the cells of the wall; no point of the wall.
    let ground = points.iter().filter(|(_, class)| *class != 50).count() as u64;
    for protocol in tally.points {
        assert_eq!((protocol.right + protocol.missed, protocol.wrong), (ground, 0));
        assert!(protocol.missed <= 60 * 5, "{protocol:?}");
    }
    let text = report.to_text();
    for part in ["drivability", "height_difference", "100.00", "leaks of drivability: 0 of", "vegetation_excluded: "] {
        assert!(text.contains(part), "{part}\n{text}");
    }
    let json = report.to_json();
    let map = &json["sources"][0]["maps"][0];
    assert_eq!((map["layer"].as_str(), map["cells"]["precision"].as_f64()), (Some("drivability"), Some(1.0)));
    assert_eq!(map["ground_points"]["low_vegetation_ground"]["wrong"], 0);
}

#[test]
fn options_set_the_column_width_and_disable_maps() {
    assert_eq!([1, 2, 4].map(columns), [Some(360), Some(180), Some(90)]);
    assert_eq!(columns(3), None);
    let folder = written(&street());
    let config = folder.path().join("clearway.toml");
    let all = include_str!("../../../../deploy/clearway.toml");
    let judged = |columns_deg, text: &str| {
        std::fs::write(&config, text).unwrap();
        let options = Options { columns_deg, config: Some(config.clone()), ..options(folder.path()) };
        evaluate(&options, |_, _| {}).unwrap().sources.remove(0).layers
    };
    let (fine, coarse) = (judged(None, all), judged(Some(4), all));
    assert!(fine[0].1.called > 3 * coarse[0].1.called, "{} {}", fine[0].1.called, coarse[0].1.called);
    let switch = "[vehicle.maps.drivability]\nenabled = ";
    assert!(all.contains(&format!("{switch}true")));
    let without = all.replace(&format!("{switch}true"), &format!("{switch}false"));
    let names: Vec<String> = judged(None, &without).into_iter().map(|(name, _)| name).collect();
    assert!(!names.is_empty() && !names.contains(&"drivability".to_owned()), "{names:?}");
}

#[test]
fn a_wrong_path_is_named_before_any_path_is_judged() {
    let folder = written(&street());
    let error = |path: &str| {
        let paths = vec![folder.path().display().to_string(), path.to_owned()];
        let options = Options { paths, extrinsics: Some(LEVEL), ..Options::default() };
        evaluate(&options, |_, _| panic!("a path was judged")).unwrap_err().to_string()
    };
    #[cfg(feature = "sim")]
    assert_eq!(error("sim:moon"), "sim:moon: the scenes are flat, slopes, canopy, overhang, town");
    #[cfg(not(feature = "sim"))]
    assert!(error("sim:town").contains("without the feature sim"));
    assert!(error("/no/such/folder").starts_with("/no/such/folder: "));
    std::fs::write(folder.path().join("7.label"), [0; 12]).unwrap();
    let mismatched = evaluate(&options(folder.path()), |_, _| {}).unwrap_err().to_string();
    assert!(mismatched.contains("7.label: 3 label(s)") && mismatched.contains("7.bin"), "{mismatched}");
}

#[test]
fn scans_of_another_car_are_refused_without_extrinsics() {
    let mut points = street();
    points.iter_mut().for_each(|(place, _)| place[2] -= 0.6);
    let folder = written(&points);
    let options = Options { extrinsics: None, ..options(folder.path()) };
    let error = evaluate(&options, |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("is 2.33 m above") && error.contains("--extrinsics"), "{error}");
}

#[test]
#[cfg(feature = "sim")]
fn a_simulated_scene_is_judged_by_its_own_truth() {
    let options = Options { paths: vec!["sim:overhang".into()], ..Options::default() };
    let report = evaluate(&options, |_, _| {}).unwrap();
    let layer = |name: &str| &report.sources[0].layers.iter().find(|(layer, _)| layer == name).unwrap().1;
    let (ours, baseline) = (layer("drivability"), layer("height_difference"));
    assert_eq!(ours.precision(), Some(1.0));
    assert!(ours.recall() > Some(0.98) && ours.leaks.is_empty(), "{ours:?}");
    assert!(baseline.leaks["unreachable"] > 1000, "the baseline does not search what can be reached");
    assert_eq!(ours.road_recall(), None, "the scenes mark no road");
}
