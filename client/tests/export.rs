//! A recording written here goes through `clearway export` and `clearway info`.

mod common;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use common::{CAPTURE_END_NS, CLASSES, clearway, map, text};
use serde_json::Value;

/// Three maps of alpha, as the server lays them out; unfinished: as a crash leaves it.
fn record(path: &Path, finished: bool) {
    let mut writer = mcap::WriteOptions::new().compression_threads(0).create(File::create(path).unwrap()).unwrap();
    let metadata = BTreeMap::from([("boot_id".to_string(), "7".to_string())]);
    writer.write_metadata(&mcap::records::Metadata { name: "clearway".into(), metadata }).unwrap();
    let schema = writer.add_schema("clearway.v1.Map", "protobuf", clearway_proto::DESCRIPTORS).unwrap();
    let channel = writer.add_channel(schema, "/alpha/map/drivability", "protobuf", &BTreeMap::new()).unwrap();
    for sequence in 0..3 {
        let end_ns = CAPTURE_END_NS + 100_000_000 * i64::from(sequence);
        let log_time = end_ns as u64;
        let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, &map(sequence.into(), end_ns)).unwrap();
        writer.flush().unwrap();
    }
    if finished {
        writer.finish().unwrap();
    } else {
        let length = std::fs::metadata(path).unwrap().len();
        // Dropping the writer would finish the file.
        std::mem::forget(writer);
        File::options().write(true).open(path).unwrap().set_len(length - 1).unwrap();
    }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

#[test]
fn a_picture_has_the_colour_of_each_class_where_it_lies() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let out = folder.path().join("png");
    let arguments = ["export", file.to_str().unwrap(), "--layer", "drivability", "--format", "png", "--out"];
    let done = clearway(&[&arguments[..], &[out.to_str().unwrap(), "--pixels", "120"]].concat());
    assert!(done.status.success(), "{}", text(&done.stderr));
    for sequence in 0..3 {
        assert!(out.join(format!("{sequence:06}_drivability.png")).exists());
    }
    let decoder = png::Decoder::new(BufReader::new(File::open(out.join("000001_drivability.png")).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.height, info.color_type), (120, 120, png::ColorType::Rgb));
    // Half a metre a pixel: forward is up, left is left.
    let at = |x_m: f64, y_m: f64| {
        let (row, column) = (((30.0 - x_m) * 2.0) as usize, ((30.0 - y_m) * 2.0) as usize);
        let start = (row * 120 + column) * 3;
        [pixels[start], pixels[start + 1], pixels[start + 2]]
    };
    let [unknown, drivable, not_drivable, obstacle] = [[38, 40, 44], [64, 176, 128], [232, 176, 64], [176, 40, 48]];
    assert_eq!(at(6.1, 6.1), drivable, "ahead and to the left");
    assert_eq!(at(-6.1, 6.1), not_drivable, "behind and to the left");
    assert_eq!(at(-6.1, -6.1), unknown, "behind and to the right");
    assert_eq!(at(10.1, -10.1), obstacle, "ahead and to the right, 14 m off");
    assert_eq!(at(18.1, -15.1), drivable, "behind the obstacle");
    assert_eq!(at(29.1, 29.1), unknown, "outside of the grid");
    assert_eq!(at(0.1, 0.1), [244, 244, 248], "the vehicle");
}

#[test]
fn arrays_have_numpys_header_and_the_cells_and_come_with_a_document() {
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
    assert_eq!(document["geometry"]["r_bench_m"], serde_json::json!([10.0, 20.0, 30.0]));
    assert_eq!(document["legend"][3], "obstacle");
    assert_eq!(document["channels"][1]["scale"], 0.5);
    assert_eq!(document["channels"][0].get("cells"), None);
}

#[test]
fn a_document_has_the_cells_inline() {
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
fn a_recording_cut_by_a_crash_is_exported_as_far_as_it_goes_and_says_so() {
    let folder = folder();
    let file = folder.path().join("cut.mcap");
    record(&file, false);
    let paths = [file.to_str().unwrap(), folder.path().to_str().unwrap()];
    let done = clearway(&["export", paths[0], "--layer", "drivability", "--format", "json", "--out", paths[1]]);
    assert!(done.status.success(), "{}", text(&done.stderr));
    assert!(text(&done.stderr).contains("cut after"), "{}", text(&done.stderr));
    assert!(folder.path().join("000001_drivability.json").exists());

    let told = clearway(&["info", paths[0], "--json"]);
    let document: Value = serde_json::from_slice(&told.stdout).unwrap();
    assert_eq!(document["complete"], false);
    assert_eq!(document["run"]["boot_id"], "7");
    assert!(document["maps"]["alpha"]["drivability"].as_u64().unwrap() >= 2);
}

#[test]
fn an_unknown_layer_is_refused_with_the_layers_there_are() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let paths = [file.to_str().unwrap(), folder.path().to_str().unwrap()];
    let done = clearway(&["export", paths[0], "--layer", "roughness", "--format", "png", "--out", paths[1]]);
    assert_eq!(done.status.code(), Some(1));
    assert!(text(&done.stderr).contains("no layer \"roughness\"; it has drivability"), "{}", text(&done.stderr));
}

#[test]
fn files_of_no_kind_known_are_refused_and_wrong_usage_is_another_exit_code() {
    let folder = folder();
    let file = folder.path().join("note.txt");
    std::fs::write(&file, "dear reader").unwrap();
    let path = file.to_str().unwrap();
    let told = clearway(&["info", path]);
    assert_eq!(told.status.code(), Some(1));
    assert!(text(&told.stderr).contains("not a capture"), "{}", text(&told.stderr));
    let exported = clearway(&["export", path, "--layer", "x", "--format", "png", "--out", path]);
    assert_eq!(exported.status.code(), Some(1));
    assert!(text(&exported.stderr).contains("not an MCAP file"), "{}", text(&exported.stderr));
    assert_eq!(clearway(&["export", path, "--format", "gif"]).status.code(), Some(2));
}
