//! `clearway replay` as a command: how it ends, what it refuses, and what it says of several vehicles.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::common::{clearway, text};

const TOWN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/golden/town.mcap");

/// A served replay of the town that waits for a reader and ends at its end, and the address of its gRPC.
fn served(folder: &Path, options: &[&str]) -> (Child, String) {
    started(folder, &[&[TOWN, "--wait-readers", "1", "--exit-at-end"], options].concat())
}

/// A served replay, and the address of its gRPC.
fn started(folder: &Path, options: &[&str]) -> (Child, String) {
    let ready = folder.join("ready.json");
    let mut server = Command::new(env!("CARGO_BIN_EXE_clearway"))
        .args(["replay", "--serve", "--as-live", "--any-port", "--ready-file"])
        .arg(&ready)
        .args(options)
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    while !ready.exists() {
        assert_eq!(server.try_wait().unwrap(), None, "the server is there");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let addresses: serde_json::Value = serde_json::from_slice(&std::fs::read(ready).unwrap()).unwrap();
    (server, addresses["grpc"].as_str().unwrap().to_owned())
}

#[test]
fn a_drive_without_a_map_fails_the_replay_and_its_reader() {
    let folder = tempfile::tempdir().unwrap();
    let (server, address) = served(folder.path(), &["--model", "hdl64e_s3"]);
    let watched = clearway(&["watch", "--server", &address, "--count", "5"]);
    let error = text(&watched.stderr);
    assert_eq!(watched.status.code(), Some(2), "{error}");
    assert!(error.contains("0 of 5 maps came before the replay ended"), "{error}");
    let ended = server.wait_with_output().unwrap();
    let error = text(&ended.stderr);
    assert_eq!(ended.status.code(), Some(2), "{error}");
    assert!(error.contains("made no map: of 769 received 0 were decoded and 678 (678 for block_flag: "), "{error}");
}

#[test]
fn a_drive_without_a_map_says_so_at_its_end_although_it_is_served_on() {
    let folder = tempfile::tempdir().unwrap();
    let (mut server, _) = started(folder.path(), &[TOWN, "--model", "hdl64e_s3", "--speed", "max"]);
    let log = BufReader::new(server.stderr.take().unwrap());
    let why = "the whole drive made no map: of 769 received";
    let found = log.lines().any(|line| line.unwrap().contains(why));
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(found, "the log ends without the reason");
}

#[test]
fn a_drive_of_one_scan_is_controlled_and_begins_once() {
    let folder = tempfile::tempdir().unwrap();
    let scan = folder.path().join("0000000000.bin");
    let point = |i: u16| [f32::from(i % 100) * 0.2, f32::from(i / 100) * 0.2, -1.7, 0.5];
    let bytes: Vec<u8> = (0..10_000).flat_map(point).flat_map(f32::to_le_bytes).collect();
    std::fs::write(&scan, bytes).unwrap();
    let options = [scan.to_str().unwrap(), "--extrinsics", "0,0,1.7,0,0,0", "--loop"];
    let (mut server, address) = started(folder.path(), &options);
    loop {
        let output = clearway(&["transport", "--server", &address, "--json"]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        let state: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        if state["phase"] == "ended" {
            assert_eq!(state["jumps"], 0, "{state}");
            break;
        }
    }
    server.kill().unwrap();
    server.wait().unwrap();
}

#[test]
fn of_recordings_of_several_vehicles_those_of_the_named_one_are_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let truck = include_str!("../../deploy/clearway.toml").replace("name = \"car\"", "name = \"truck\"");
    std::fs::write(at("truck.toml"), truck).unwrap();
    for arguments in [
        &["simulate", "flat", "--sensor", "vlp16", "--seconds", "0.3", "--out", &at("truck.pcap")][..],
        &["replay", &at("truck.pcap"), "--config", &at("truck.toml"), "--record", &at("truck.mcap")],
    ] {
        let output = clearway(arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
    }
    let output = clearway(&["replay", TOWN, &at("truck.mcap"), "--vehicle", "truck", "--json"]);
    let said = text(&output.stderr);
    assert!(output.status.success() && said.contains("town.mcap") && said.contains("left out"), "{said}");
    let output = clearway(&["replay", TOWN, &at("truck.mcap"), "--vehicle", "van"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("--vehicle van"), "{}", text(&output.stderr));
}

#[test]
fn a_view_from_beyond_the_end_is_refused_by_the_name_of_its_option() {
    let output = clearway(&["view", TOWN, "--from", "99"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("--from 99.000 s: the replay plays 0.000 s to"), "{}", text(&output.stderr));
}

#[test]
fn a_reader_of_more_maps_than_there_are_fails_and_the_replay_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let (server, address) = served(folder.path(), &[]);
    let watched = clearway(&["watch", "--server", &address, "--count", "99"]);
    assert_eq!(watched.status.code(), Some(2));
    assert!(text(&watched.stderr).contains("of 99 maps came before the replay ended"));
    assert_eq!(server.wait_with_output().unwrap().status.code(), Some(0));
}

#[test]
fn a_key_overrides_the_recorded_configuration_and_another_vehicle_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let output = clearway(&["replay", TOWN, "--set", "vehicle.maps.valid_ms=555", "--record", &at("set.mcap")]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(text(&clearway(&["info", "--json", &at("set.mcap")]).stdout).contains("valid_ms = 555"));
    let output = clearway(&["replay", TOWN, "--set", "vehicle.maps.nosuch=1"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("vehicle.maps.nosuch (of car) is not a key"));

    let truck = include_str!("../../deploy/clearway.toml").replace("name = \"car\"", "name = \"truck\"");
    std::fs::write(at("truck.toml"), truck).unwrap();
    let output = clearway(&["replay", TOWN, "--config", &at("truck.toml")]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("its vehicle is truck, but the recording has car"));
}
