//! `clearway evaluate` on the labelled SemanticKITTI frame and its variations, on a sweep of Argoverse 2, and beside
//! Patchwork++: the targets, and the errors for files that do not match.

use std::path::Path;

use clearway_tests::{binaries, run};
use clearway_tools::evaluate::{EvaluateOptions, evaluate};
use serde_json::Value;

/// Least F1 of the ground points by the shared estimate on the labelled frame and its variations: the F1 of Patchwork++
/// on the frame with 32 lasers.
const GROUND_F1: f64 = 0.989;

fn kitti() -> String {
    Path::new(env!("CLEARWAY_DRIVES")).join("kitti").display().to_string()
}

fn evaluated(arguments: &[&str]) -> Value {
    let folder = tempfile::tempdir().expect("a folder");
    let output = run(folder.path(), "clearway", &[&["evaluate", "--json"], arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one object")
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn drivability_of_the_labelled_frame_meets_its_targets() {
    // The scan and its labels lie in folders side by side; two more scans there, and ten .pcd, have no labels.
    for (degrees, precision, road) in [(1, 0.9995, 0.99), (2, 0.997, 0.98), (4, 0.997, 0.97)] {
        let columns = format!("vehicle.maps.drivability.columns={}", 360 / degrees);
        let report = evaluated(&[&kitti(), "--set", &columns]);
        let source = &report["sources"][0];
        assert_eq!((source["frames"].as_u64(), source["scans_without_labels"].as_u64()), (Some(1), Some(12)));
        let maps = source["maps"].as_array().expect("maps");
        let map = maps.iter().find(|map| map["layer"] == "drivability").expect("drivability");
        let metric = |pointer: &str| map.pointer(pointer).and_then(Value::as_f64).expect(pointer);
        println!(
            "{degrees}°: cells {:.5} / {:.5}, road {:.5}, ground points {:.4} / {:.4}, leaks {}",
            metric("/cells/precision"),
            metric("/cells/recall"),
            metric("/road/recall"),
            metric("/ground_points/vegetation_excluded/precision"),
            metric("/ground_points/vegetation_excluded/recall"),
            map["leaks"]["by_class"]
        );
        assert!(metric("/cells/precision") >= precision && metric("/road/recall") >= road);
        assert!(metric("/cells/recall") >= 0.95);
        let classes = map["leaks"]["by_class"].as_object().expect("leaks by class");
        for grave in ["person", "car", "pole", "fence"] {
            assert!(degrees != 1 || !classes.contains_key(grave), "{grave}: {classes:?}");
        }
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn labels_without_their_scan_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::copy(Path::new(&kitti()).join("mmdet3d/000000.label"), folder.path().join("000000.label"))
        .expect("labels");
    let place = folder.path().display().to_string();
    let output = run(folder.path(), "clearway", &["evaluate", &place]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && said.contains("000000.label: no 000000.bin"), "{said}");
    // The scan of another frame.
    let scan = Path::new(&kitti()).join("patchwork-plusplus/000001.bin");
    std::fs::copy(scan, folder.path().join("000000.bin")).expect("a scan");
    let output = run(folder.path(), "clearway", &["evaluate", &place]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && said.contains("000000.label: ") && said.contains(" points of "), "{said}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn every_variation_of_the_labelled_frame_is_judged() {
    let [scan, labels] = ["patchwork-plusplus/000000.bin", "mmdet3d/000000.label"]
        .map(|file| Path::new(&kitti()).join(file).display().to_string());
    let report = evaluated(&[&scan, "--labels", &labels, "--variations", "all"]);
    let rows = report["sources"][0]["rows"].as_array().expect("rows");
    let names: Vec<&str> = rows.iter().filter_map(|row| row["name"].as_str()).collect();
    assert_eq!(names.len(), 12, "{names:?}");
    let layer = |row: &Value, name: &str| {
        let maps = row["maps"].as_array().expect("maps");
        maps.iter().find(|map| map["layer"] == name).cloned().unwrap_or_else(|| panic!("{name}"))
    };
    for row in rows {
        let name = row["name"].as_str().expect("a name");
        let ground = layer(row, "ground");
        let f1 = ground["ground_points"]["vegetation_excluded"]["f1"].as_f64().expect("points");
        let drivability = layer(row, "drivability");
        println!(
            "{name}: F1 of the ground estimate {f1:.4}, drivability {} / {} / road {}, false obstacles {}",
            drivability["cells"]["precision"],
            drivability["cells"]["recall"],
            drivability["road"]["recall"],
            drivability["false_obstacles"]["pure_ground"]["share"]
        );
        assert!(f1 >= GROUND_F1, "{name}: {f1}");
        // Each class of ground, by five bands of range, adds up to no more than the cells of all classes.
        let reach = &drivability["reach"];
        let cells = |bands: &Value| -> u64 {
            bands.as_array().expect("bands").iter().filter_map(|band| band["cells"].as_u64()).sum()
        };
        let road = cells(&reach["by_class"]["road"]);
        assert!(road > 0 && road <= cells(&reach["by_range"]), "{name}");
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_sweep_of_argoverse_is_judged_by_its_map_of_the_ground() {
    let folder = tempfile::tempdir().expect("a folder");
    let drive = Path::new(env!("CLEARWAY_DRIVES")).join("argoverse2/adcf7d18-0510-35b0-a2fa-b4cea13a6d76");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers/argoverse.py");
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python-argoverse");
    let mut command = std::process::Command::new("python3");
    command.arg("-B").arg(script).arg("--venv").arg(venv).arg(drive).arg(folder.path());
    let output = command.output().expect("Debian's python3 and python3-venv, and a package registry");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mount = String::from_utf8(output.stdout).expect("the mount of the sensor");
    let report = evaluated(&[&folder.path().display().to_string(), "--extrinsics", mount.trim()]);
    let row = &report["sources"][0]["rows"][0];
    assert_eq!(row["frames"], 1);
    let maps = row["maps"].as_array().expect("maps");
    let metric = |layer: &str, pointer: &str| {
        let map = maps.iter().find(|map| map["layer"] == layer).unwrap_or_else(|| panic!("{layer}"));
        map.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{layer} {pointer}"))
    };
    let f1 = metric("ground", "/ground_points/vegetation_excluded/f1");
    let [precision, recall] = ["precision", "recall"].map(|name| metric("drivability", &format!("/cells/{name}")));
    println!("ground points F1 {f1:.4}, drivability {precision:.4} / {recall:.4}");
    assert!(f1 >= 0.95 && precision >= 0.97 && recall >= 0.8, "{f1} {precision} {recall}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn patchwork_is_judged_on_the_same_points_as_the_maps() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers/patchwork.py");
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("python-patchwork");
    let mut command = std::process::Command::new("python3");
    command.arg("-B").arg(script).arg("--json").arg("--venv").arg(venv);
    let output = command
        .arg(binaries().join("clearway"))
        .args([&kitti(), "--variations", "bend+6"])
        .output()
        .expect("Debian's python3 and python3-venv, and a package registry");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let rows: Value = serde_json::from_slice(&output.stdout).expect("one object");
    let row = &rows["bend+6"];
    for protocol in ["vegetation_excluded", "low_vegetation_ground"] {
        let peer = row["patchwork++"]["ground_points"][protocol]["f1"].as_f64().expect("Patchwork++");
        let own = row["clearway"]["ground"]["ground_points"][protocol]["f1"].as_f64().expect("Clearway");
        println!("{protocol}: Patchwork++ {peer:.4}, Clearway {own:.4}");
        assert!(peer > 0.95 && own >= peer, "{protocol}: {peer} {own}");
    }
}

#[test]
fn a_gate_on_footprints_decides_the_exit_code() {
    let folder = tempfile::tempdir().expect("a folder");
    let gated = |gate: &str| {
        let output = run(folder.path(), "clearway", &["evaluate", "sim:flat", "--fail-under", gate]);
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    assert_eq!(gated("safe_path=99@8-20"), (Some(0), String::new()));
    let (code, said) = gated("terrain=99");
    assert!(code == Some(1) && said.contains("sim:flat : terrain=99@4-20: "), "{code:?} {said}");
    assert_eq!(gated("terrain=99@4-21").0, Some(3));
}

#[test]
fn a_variant_of_the_papers_is_selected_without_a_configuration() {
    let report = |set: &[&str]| {
        let set = set.iter().map(|text| (*text).to_owned()).collect();
        evaluate(&EvaluateOptions { paths: vec!["sim:flat".into()], set, ..EvaluateOptions::default() }, |_, _| {})
    };
    let cells = |set: &[&str]| {
        let report = report(set).expect("a report").to_json();
        let maps = report["sources"][0]["maps"].as_array().expect("maps").clone();
        maps.into_iter().find(|map| map["layer"] == "terrain").expect("terrain")["cells"].clone()
    };
    assert_ne!(cells(&[]), cells(&["vehicle.maps.terrain.variant=paper"]));
    let error = report(&["vehicle.maps.terrain.variant=none"]).unwrap_err().to_string();
    assert!(error.contains("vehicle.maps.terrain.variant"), "{error}");
}
