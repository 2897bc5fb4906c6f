//! `clearway evaluate` on the labelled SemanticKITTI frame: the targets, and the errors for files that do not match.

use std::path::Path;

use clearway_tests::run;
use serde_json::Value;

fn kitti() -> String {
    Path::new(env!("CLEARWAY_DATA")).join("kitti").display().to_string()
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
    // The scan and its labels lie in folders side by side; two more scans there have no labels.
    for (columns, precision, road) in [("1", 0.9995, 0.99), ("2", 0.997, 0.98), ("4", 0.997, 0.97)] {
        let report = evaluated(&[&kitti(), "--columns", columns]);
        let source = &report["sources"][0];
        assert_eq!((source["frames"].as_u64(), source["scans_without_labels"].as_u64()), (Some(1), Some(2)));
        let maps = source["maps"].as_array().expect("maps");
        let map = maps.iter().find(|map| map["layer"] == "drivability").expect("drivability");
        let metric = |pointer: &str| map.pointer(pointer).and_then(Value::as_f64).expect(pointer);
        println!(
            "{columns}°: cells {:.5} / {:.5}, road {:.5}, ground points {:.4} / {:.4}, leaks {}",
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
            assert!(columns != "1" || !classes.contains_key(grave), "{grave}: {classes:?}");
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
