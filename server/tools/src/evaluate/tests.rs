//! Whole evaluations of hand-made scans and of a simulated scene.

use std::ops::Range;

use clearway_mapping::config::Extrinsics;

use super::source::variation::Variation;
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

fn options(path: &Path) -> EvaluateOptions {
    let paths = vec![path.display().to_string()];
    EvaluateOptions { paths, extrinsics: Some(LEVEL), ..EvaluateOptions::default() }
}

#[test]
fn a_hand_made_street_gets_the_metrics_counted_by_hand() {
    let points = street();
    let folder = written(&points);
    let mut steps = Vec::new();
    let report = evaluate(&options(folder.path()), |done, total| steps.push((done, total))).unwrap();
    assert_eq!(steps, [(1, 1)]);
    let source = &report.sources[0];
    assert_eq!((source.rows.len(), source.rows[0].frames, source.unlabelled), (1, 1, 0));
    let (name, tally) = &source.rows[0].layers[0];
    assert_eq!(name, "drivability");
    assert_eq!(tally.precision(), Some(1.0));
    // All ground is found, but for a few cells beside the ends of the wall, where the vehicle is too wide.
    assert_eq!(tally.drivable.of_them + tally.not_reached.of_them, tally.drivable.all);
    assert!(tally.not_reached.of_them <= 4 && tally.road_recall() > Some(0.999), "{tally:?}");
    assert!(tally.leaks.is_empty(), "{:?}", tally.leaks);
    // Every ground point, road or terrain, except points in the cells of the wall; no point of the wall.
    let ground = points.iter().filter(|(_, class)| *class != 50).count() as u64;
    for protocol in tally.points {
        assert_eq!((protocol.right + protocol.missed, protocol.wrong), (ground, 0));
        assert!(protocol.missed <= 60 * 5, "{protocol:?}");
    }
    let (name, footprints) = &source.rows[0].footprints[0];
    let near = footprints.level_within(4.0, 20.0);
    assert!(name == "drivability" && near.all > 500 && near.share() > Some(0.9), "{near:?}");
    let held: u64 = footprints.holding[2].iter().map(|count| count.all).sum();
    assert!(held > 20 && footprints.grave() == 0 && footprints.wrong.is_empty(), "{footprints:?}");
    let failures = |gate: &str| report.failures(&[gate.parse().unwrap()]);
    assert!(failures("drivability=90").is_empty(), "{:?}", failures("drivability=90"));
    assert!(failures("terrain=100@4-30")[0].contains("terrain=100@4-30: "), "{:?}", failures("terrain=100@4-30"));
    assert!(failures("none=0")[0].contains("no such layer"), "{:?}", failures("none=0"));
    let text = report.to_text();
    let parts = ["drivability, %", "height_difference, %", "100.00", "0 of ", "reach of road"];
    for part in parts {
        assert!(text.contains(part), "{part}\n{text}");
    }
    let json = report.to_json();
    let map = &json["sources"][0]["maps"][0];
    assert_eq!((map["layer"].as_str(), map["cells"]["precision"].as_f64()), (Some("drivability"), Some(1.0)));
    assert_eq!(map["ground_points"]["low_vegetation_ground"]["wrong"], 0);
    let counts = &json["sources"][0]["rows"][0]["footprints"][0];
    assert_eq!(
        (counts["one_level"][0]["footprints"].as_u64(), &counts["wrong"]),
        (Some(footprints.level[0].all), &serde_json::json!([]))
    );
    assert_eq!(map["false_obstacles"]["pure_ground"]["called_occupied"], 0);
    // Road in every cell from 3 m on; the last band ends beyond the road.
    let road = &map["reach"]["by_class"]["road"];
    assert_eq!((road[0]["recall"].as_f64(), road[4]["recall"].as_f64()), (Some(1.0), None));
}

#[test]
fn a_configuration_sets_the_column_width_and_disables_maps() {
    let folder = written(&street());
    let config = folder.path().join("clearway.toml");
    let all = include_str!("../../../../deploy/clearway.toml");
    let judged = |set: &[&str], text: &str| {
        std::fs::write(&config, text).unwrap();
        let set = set.iter().map(|key| (*key).to_owned()).collect();
        let options = EvaluateOptions { set, config: Some(config.clone()), ..options(folder.path()) };
        evaluate(&options, |_, _| {}).unwrap().sources.remove(0).rows.remove(0).layers
    };
    let (fine, coarse) = (judged(&[], all), judged(&["vehicle.maps.drivability.columns=90"], all));
    assert!(fine[0].1.called > 3 * coarse[0].1.called, "{} {}", fine[0].1.called, coarse[0].1.called);
    let switch = "[vehicle.maps.drivability]\nenabled = ";
    assert!(all.contains(&format!("{switch}true")));
    let without = all.replace(&format!("{switch}true"), &format!("{switch}false"));
    let names: Vec<String> = judged(&[], &without).into_iter().map(|(name, _)| name).collect();
    assert!(!names.is_empty() && !names.contains(&"drivability".to_owned()), "{names:?}");
}

#[test]
fn a_wrong_path_is_named_before_any_path_is_judged() {
    let folder = written(&street());
    let error = |path: &str| {
        let paths = vec![folder.path().display().to_string(), path.to_owned()];
        let options = EvaluateOptions { paths, extrinsics: Some(LEVEL), ..EvaluateOptions::default() };
        evaluate(&options, |_, _| panic!("a path was judged"))
            .map(|_| ())
            .map_err(|error| format!("{error:#}"))
            .unwrap_err()
    };
    assert_eq!(
        error("sim:moon"),
        "sim:moon: the scenes are town, street, flat, slopes, canopy, overhang, track, random"
    );
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
    let options = EvaluateOptions { extrinsics: None, ..options(folder.path()) };
    let error = evaluate(&options, |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("is 2.33 m above") && error.contains("--extrinsics"), "{error}");
}

#[test]
fn a_simulated_scene_is_judged_by_its_own_truth() {
    let options = EvaluateOptions { paths: vec!["sim:overhang".into()], ..EvaluateOptions::default() };
    let report = evaluate(&options, |_, _| {}).unwrap();
    let layer = |name: &str| report.sources[0].rows[0].layer(name).unwrap();
    let (ours, baseline) = (layer("drivability"), layer("height_difference"));
    assert_eq!(ours.precision(), Some(1.0));
    assert!(ours.recall() > Some(0.98) && ours.leaks.is_empty(), "{ours:?}");
    assert!(baseline.leaks["unreachable"] > 1000, "the baseline does not search what can be reached");
    assert_eq!(ours.road_recall(), None, "the scenes mark no road");
}

#[test]
fn each_variation_has_a_row_and_its_points_are_written() {
    let points = street();
    let folder = written(&points);
    let to = folder.path().join("written");
    let options = EvaluateOptions {
        variations: vec![Variation::Bend(-6.0), Variation::Roll(3.0), Variation::SensorOffset(1.5)],
        write_scans: Some(to.clone()),
        ..options(folder.path())
    };
    let report = evaluate(&options, |_, _| {}).unwrap();
    let rows = &report.sources[0].rows;
    let names: Vec<(&str, bool)> = rows.iter().map(|row| (row.name.as_str(), row.final_only)).collect();
    assert_eq!(names, [("bend-6", false), ("roll+3", false), ("offset+1.5", false)]);
    // The truth comes from the scan as recorded, so as many points of it are road and wall.
    let scored = |row: &report::EvaluatedRow| row.layer("drivability").unwrap().points[0];
    for row in rows {
        let ground = scored(row).right + scored(row).missed;
        assert_eq!(ground, points.iter().filter(|(_, class)| *class != 50).count() as u64, "{}", row.name);
    }
    let read = |file: &str| std::fs::read(to.join(file)).unwrap();
    let (bin, truth) = (read("bend-6/7.bin"), read("bend-6/7.truth"));
    assert_eq!((bin.len(), truth.len()), (16 * points.len(), 2 * points.len()));
    let z = |point: usize| f32::from_le_bytes(bin[16 * point + 8..16 * point + 12].try_into().unwrap());
    let far = points.iter().position(|([x, y, _], _)| x.hypot(*y) > 17.9).unwrap();
    let range = points[far].0[0].hypot(points[far].0[1]);
    assert!((z(far) - (-1.73 - 0.06 * (range - 8.0))).abs() < 1e-4, "{}", z(far));
    assert_eq!(truth[2 * far..2 * far + 2], [1, 1]);
    let json: serde_json::Value = serde_json::from_slice(&read("offset+1.5/7.json")).unwrap();
    assert_eq!((json["extrinsics"]["x_m"].as_f64(), &json["rows"][0]), (Some(1.5), &"offset+1.5".into()));
    assert!(report.to_text().contains("offset+1.5"));
}

#[test]
fn random_worlds_give_the_same_report_in_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let judged = |seeds: Range<u64>| {
        let write_scans = Some(folder.path().join(format!("{}-{}", seeds.start, seeds.end)));
        let paths = vec!["sim:random".into()];
        let options = EvaluateOptions { paths, seeds, write_scans, ..EvaluateOptions::default() };
        evaluate(&options, |_, _| {}).unwrap().sources.remove(0)
    };
    let both = judged(10..12);
    let names: Vec<&str> = both.rows.iter().map(|row| row.name.as_str()).collect();
    assert_eq!(names, ["all worlds", "even seeds", "odd seeds", "closed fence", "ground: rolling"]);
    assert!(both.rows[2].final_only && !both.rows[1].final_only);
    let (even, odd) = (judged(10..11), judged(11..12));
    assert_eq!((&both.rows[1].layers, &both.rows[2].layers), (&even.rows[0].layers, &odd.rows[0].layers));
    assert_eq!(both.worlds.len(), 2);
    let bin = |run: &str| std::fs::read(folder.path().join(run).join("random/10.bin")).unwrap();
    assert!(bin("10-12").len() > 1_000_000 && bin("10-12") == bin("10-11"));
    let drivability = both.rows[0].layer("drivability").unwrap();
    assert!(drivability.called > 1000 && drivability.drivable.all > 1000, "{drivability:?}");
}
