//! `clearway replay` as a command: how it ends, what it refuses, and what it says of several vehicles.

mod common;

use std::path::Path;
use std::process::{Child, Command, Stdio};

use common::{clearway, text};

const TOWN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/golden/town.mcap");

/// A served replay that ends at its end, and the address of its gRPC.
fn served(folder: &Path, options: &[&str]) -> (Child, String) {
    let ready = folder.join("ready.json");
    let serve = ["--serve", "--as-live", "--any-port", "--wait-readers", "1", "--exit-at-end", "--ready-file"];
    let mut server = Command::new(env!("CARGO_BIN_EXE_clearway"))
        .args(["replay", TOWN])
        .args(serve)
        .arg(&ready)
        .args(options)
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    while !ready.exists() {
        assert_eq!(server.try_wait().unwrap(), None, "the server is there");
        std::thread::yield_now();
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
    assert!(error.contains("made no map: of 769 received 0 were decoded and 678 (678 for block_flag)"), "{error}");
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

#[test]
fn a_wrong_line_of_a_script_of_faults_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("faults.txt");
    std::fs::write(&script, "loss:5\n\nfoo:1 # none\n").unwrap();
    let output = clearway(&["replay", TOWN, "--fault-script", script.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("faults.txt, line 3: fault \"foo:1\""), "{}", text(&output.stderr));
}
