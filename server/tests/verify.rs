//! `clearway verify` as a tool for CI: many recordings, shards, reports, and what a change changes.

use std::fs;
use std::path::{Path, PathBuf};

use clearway_proto::codec::{Cells, CellsRef, Limits, decode, encode_grid};
use clearway_proto::v1;
use prost::Message;
use serde_json::Value;

use crate::common::copied::copy;
use crate::common::{clearway, text};

/// The golden recording: a VLP-16 in the simulated town, 10 maps.
fn town() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../client/golden/town.mcap")
}

/// Copies the golden recording with another class in cell (5, 7) of the layer safe_path of map 3; returns the class
/// before and after.
fn with_one_changed_cell(to: &Path) -> (i32, i32) {
    let mut classes = None;
    copy(&town(), to, |topic, sequence, data| {
        if topic != "/car/map/safe_path" || sequence != 3 {
            return Some(data);
        }
        let mut map = v1::Map::decode(&data[..]).unwrap();
        let (columns, channel) = (240, &mut map.layers[0].channels[0]);
        let Cells::U8(mut cells) = decode(channel, columns, &Limits::default()).unwrap() else {
            panic!("classes are u8")
        };
        let cell = &mut cells[5 * columns + 7];
        let was = *cell;
        *cell = (was + 1) % 5;
        classes = Some((was.into(), (*cell).into()));
        let v1::Channel { name, unit, scale, unknown, .. } = channel.clone();
        *channel = encode_grid(CellsRef::U8(&cells), columns).into_channel(&name, &unit, scale, unknown);
        Some(map.encode_to_vec())
    });
    classes.expect("map 3 has the layer")
}

/// Runs `clearway verify` with these arguments; returns its exit code and what it printed as JSON.
fn verified(arguments: &[&str]) -> (i32, Value) {
    let output = clearway(&[&["verify", "--json"], arguments].concat());
    let printed = serde_json::from_slice(&output.stdout);
    (output.status.code().unwrap(), printed.unwrap_or_else(|_| panic!("{}", text(&output.stderr))))
}

#[test]
fn the_golden_recording_holds_the_maps_of_its_events() {
    let (code, report) = verified(&[town().to_str().unwrap()]);
    assert_eq!(code, 0, "its README.md says how to make it again: {report:#}");
    let file = &report["files"][0];
    assert_eq!((&file["events"], &file["maps"], &file["equal"]), (&770.into(), &10.into(), &70.into()));
    // 21 rows of 360 columns twice, 400 x 400 twice, 240 x 240, 160 x 160, 512 x 512.
    assert_eq!(file["cells"], 10 * (2 * 21 * 360 + 2 * 400 * 400 + 240 * 240 + 160 * 160 + 512 * 512));
}

#[test]
fn many_files_have_a_line_each_the_first_difference_and_the_worst_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    fs::copy(town(), at("a.mcap")).unwrap();
    let (all, junit) = (at("*.mcap"), at("junit.xml"));
    assert_eq!(verified(&[&all]).0, 0);

    let (was, is) = with_one_changed_cell(Path::new(&at("b.mcap")));
    let output = clearway(&["verify", folder.path().to_str().unwrap()]);
    let table = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{table}");
    let cell = format!("cell row 5 column 7, channel class: recorded {is}, computed {was}");
    let line = table.lines().find(|line| line.contains("b.mcap")).expect("a line for each file");
    assert!(line.contains("sequence 3, layer safe_path") && line.contains(&cell), "{line}");
    assert!(table.contains("2 files: 1 equal, 1 different, 0 equal but not whole, 0 not checked"), "{table}");

    fs::write(at("c.mcap"), "not a recording").unwrap();
    let (code, report) = verified(&[&all, "--junit", &junit]);
    assert_eq!((code, &report["ok"]), (2, &false.into()));
    let good: Vec<_> = report["files"].as_array().unwrap().iter().map(|file| file["ok"] == true).collect();
    assert_eq!(good, [true, false, false], "in the order of their names");
    let xml = fs::read_to_string(junit).unwrap();
    let document = roxmltree::Document::parse(&xml).unwrap();
    let suite = document.root_element().first_element_child().unwrap();
    let of = |name| suite.attribute(name).unwrap();
    assert_eq!([of("tests"), of("failures"), of("errors")], ["3", "1", "1"]);
    assert!(xml.contains(&cell) && xml.contains("not an MCAP file"), "{xml}");

    let shards = [("1/2", 2), ("2/2", 1), ("3/3", 1)].map(|(shard, files)| {
        let (code, report) = verified(&[&all, "--shard", shard]);
        assert_eq!(report["files"].as_array().unwrap().len(), files, "{shard}");
        code
    });
    assert_eq!(shards, [2, 1, 2], "a, c; b; c");
    let (code, report) = verified(&[&all, "--shard", "4/4"]);
    assert_eq!((code, &report["files"]), (0, &Value::Array(Vec::new())), "a shard may be empty");
}

/// The layers of a comparison whose cells changed.
fn changed(file: &Value) -> Vec<&Value> {
    file["layers"].as_array().unwrap().iter().filter(|layer| layer["changed"] != 0).collect()
}

#[test]
fn a_changed_configuration_is_compared_by_layer_class_and_free_space() {
    let town = town().display().to_string();
    // A wider vehicle reaches less ground.
    let wider = ["--set", "vehicle.maps.reach.vehicle_width_m=2.6"];
    let (code, report) = verified(&[&[&*town], &wider[..]].concat());
    assert_eq!(code, 1);
    let file = &report["files"][0];
    let layers = changed(file);
    assert!(layers.iter().any(|layer| layer["layer"] == "speed"), "{file:#}");
    for layer in &layers {
        let classes = layer["classes"].as_array().unwrap();
        let sum: u64 = classes.iter().map(|pair| pair["cells"].as_u64().unwrap()).sum();
        assert_eq!(layer["changed"], sum, "{layer:#}");
        assert!(layer["first"]["before"] != layer["first"]["after"], "{layer:#}");
    }
    let lost = |layer: &Value| layer["free_lost_m2"].as_f64().unwrap() - layer["free_gained_m2"].as_f64().unwrap();
    assert!(layers.iter().map(|layer| lost(layer)).sum::<f64>() > 10.0, "{file:#}");
    assert_eq!(file["worst"].as_array().unwrap().len(), 5);

    // Another cell size: the maps are compared where the cells lie; no other layer changes.
    let (code, report) = verified(&[&town, "--set", "vehicle.maps.terrain.cell_m=0.5"]);
    let names: Vec<_> = changed(&report["files"][0]).iter().map(|layer| layer["layer"].clone()).collect();
    assert_eq!((code, names), (1, vec!["terrain".into()]));
    // The recorded configuration changes nothing.
    let (code, report) = verified(&[&town, "--set", "vehicle.maps.valid_ms=500"]);
    assert_eq!((code, changed(&report["files"][0]).len()), (0, 0));
    assert_eq!(report["files"][0]["layers"][0]["maps"], 10);
}

#[test]
fn two_recordings_of_one_drive_are_compared_map_by_map() {
    let folder = tempfile::tempdir().unwrap();
    let other = folder.path().join("other.mcap");
    with_one_changed_cell(&other);
    let town = town().display().to_string();
    let (code, report) = verified(&[&town, "--against", other.to_str().unwrap()]);
    let layers = changed(&report["files"][0]);
    assert_eq!((code, layers.len()), (1, 1));
    let layer = layers[0];
    assert_eq!((&layer["layer"], &layer["maps"], &layer["changed"]), (&"safe_path".into(), &10.into(), &1.into()));
    let first = &layer["first"];
    assert_eq!((&first["sequence"], &first["row"], &first["column"]), (&3.into(), &5.into(), &7.into()));
    assert_eq!(verified(&[&town, "--against", &town]).0, 0);
}

#[test]
fn recordings_without_a_map_in_common_are_not_compared() {
    let folder = tempfile::tempdir().unwrap();
    let (town, other) = (town().display().to_string(), folder.path().join("other.mcap"));
    copy(Path::new(&town), &other, |topic, _, data| {
        if !topic.starts_with("/car/map/") {
            return Some(data);
        }
        let mut map = v1::Map::decode(&data[..]).unwrap();
        map.header.as_mut().unwrap().capture_end_ns += 1;
        Some(map.encode_to_vec())
    });
    let other = other.display().to_string();
    let (code, report) = verified(&[&town, "--against", &other]);
    let reason = report["files"][0]["not_checked"].as_str().unwrap_or_default();
    let expected = format!("no map in common with {other}: no vehicle and layer has maps of one stamp on both sides");
    assert!(code == 2 && reason.contains(&expected), "{report:#}");
}

#[test]
fn maps_that_a_cut_recording_lacks_are_no_change() {
    let folder = tempfile::tempdir().unwrap();
    let shorter = folder.path().join("shorter.mcap");
    // Without the counts of the recorder, by which they would be lost.
    let is_map = |topic: &str| topic.starts_with("/car/map/");
    let is_early = |topic: &str, sequence| topic != "/recorder/counts" && (!is_map(topic) || sequence < 7);
    copy(&town(), &shorter, |topic, sequence, data| is_early(topic, sequence).then_some(data));
    let (town, file) = (town().display().to_string(), shorter.display().to_string());
    assert_eq!(verified(&[&town, "--against", &file]).0, 1, "a whole recording that lacks maps differs");
    let bytes = fs::read(&shorter).unwrap();
    fs::write(&shorter, &bytes[..bytes.len() - 20]).unwrap();
    let output = clearway(&["verify", &town, "--against", &file]);
    let table = text(&output.stdout);
    assert_eq!(output.status.code(), Some(2), "{table}");
    assert!(
        table.contains("equal; 21 maps of one side only; ") && table.contains("shorter.mcap is not whole: cut"),
        "{table}"
    );
}

#[test]
fn another_drive_with_the_same_stamps_is_not_compared_as_if_it_were_a_change() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let made = |arguments: &[&str]| {
        let output = clearway(arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
    };
    for (scene, name) in [("street", "a"), ("slopes", "b")] {
        let (capture, drive) = (at(&format!("{name}.pcap")), at(&format!("{name}.mcap")));
        made(&["simulate", scene, "--sensor", "vlp16", "--seconds", "0.5", "--out", &capture]);
        made(&["replay", &capture, "--record", &drive]);
    }
    let (code, report) = verified(&[&at("a.mcap"), "--against", &at("b.mcap")]);
    let reason = report["files"][0]["not_checked"].as_str().unwrap_or_default();
    assert!(code == 2 && reason.contains("b.mcap are different drives: of "), "{report:#}");
    // The same drive with other maps still compares.
    made(&["replay", &at("a.mcap"), "--set", "vehicle.maps.reach.vehicle_width_m=2.6", "--record", &at("wide.mcap")]);
    let (code, report) = verified(&[&at("a.mcap"), "--against", &at("wide.mcap")]);
    assert_eq!(code, 1, "{report:#}");
}

#[test]
fn a_report_is_written_when_no_file_matches() {
    let folder = tempfile::tempdir().unwrap();
    let report = folder.path().join("verify.xml").display().to_string();
    let pattern = format!("{}/*.mcap", folder.path().display());
    let (code, json) = verified(&[&pattern, "--junit", &report]);
    let junit = fs::read_to_string(report).unwrap();
    assert_eq!((code, &json["ok"]), (2, &false.into()));
    assert!(junit.contains("errors=\"1\"") && junit.contains("no file matches this pattern"), "{junit}");
}

#[test]
fn the_sum_counts_a_file_that_is_cut_apart_from_those_that_are_not_checked() {
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.mcap").display().to_string();
    let bytes = fs::read(town()).unwrap();
    for (part, arguments, sum) in [
        (bytes.len() / 20 * 19, &["verify", &cut][..], "1 equal but not whole, 0 not checked"),
        // Its first chunk is cut, so that it has no event.
        (bytes.len() / 8, &["verify", &cut], "0 equal but not whole, 1 not checked"),
        (
            bytes.len() / 8,
            &["verify", &cut, "--set", "vehicle.maps.valid_ms=500"],
            "0 equal but not whole, 1 not checked",
        ),
    ] {
        fs::write(&cut, &bytes[..part]).unwrap();
        let output = clearway(arguments);
        let table = text(&output.stdout);
        assert_eq!(output.status.code(), Some(2), "{table}");
        assert!(table.contains(&format!("1 file: 0 equal, 0 different, {sum}")), "{table}");
    }
}

#[test]
fn one_mistake_of_the_command_line_is_printed_once() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.mcap", "b.mcap"] {
        fs::copy(town(), folder.path().join(name)).unwrap();
    }
    let drives = folder.path().to_str().unwrap();
    let absent = format!("{drives}/absent.mcap");
    let wrong: [(&[&str], &str); 2] =
        [(&["--against", &absent], "No such file"), (&["--set", "vehicle.maps.nosuch=1"], "nosuch")];
    for (options, reason) in wrong {
        let output = clearway(&[&["verify", drives], options].concat());
        let (table, error) = (text(&output.stdout), text(&output.stderr));
        assert_eq!((output.status.code(), &*table), (Some(2), ""), "{error}");
        assert_eq!(error.matches("clearway: ").count(), 1, "{error}");
        assert!(error.contains(reason), "{error}");
    }
}

#[test]
fn a_configuration_that_does_not_fit_the_recording_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let town = town().display().to_string();
    let config = folder.path().join("new.toml");
    let new = |from: &str, to: &str| {
        let default = include_str!("../../deploy/clearway.toml");
        assert!(default.contains(from), "{from}");
        fs::write(&config, default.replace(from, to)).unwrap();
        let output = clearway(&["verify", &town, "--config", config.to_str().unwrap()]);
        (output.status.code().unwrap(), text(&output.stderr))
    };
    assert_eq!(new("name = \"car\"", "name = \"car\"").0, 0, "the default configuration fits");
    let (code, error) = new("name = \"top\"", "name = \"left\"");
    assert!(code == 2 && error.contains("left; recorded, in this order: top"), "{error}");
    let (code, error) = new("name = \"car\"", "name = \"bus\"");
    assert!(code == 2 && error.contains("its vehicles are bus; recorded, in this order: car"), "{error}");
    let output = clearway(&["verify", &town, "--shard", "3/2"]);
    assert!(!output.status.success() && text(&output.stderr).contains("I/N is needed"));
}
