//! The command `clearway`, run as a user runs it.

mod common;

use std::path::Path;
use std::process::{Command, Output};

use common::{clearway, text};
use serde_json::Value;

/// Runs `clearway` in a folder.
fn clearway_in(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
    command.args(arguments).env_remove("CLEARWAY_CONFIG").current_dir(folder).output().expect("the binary starts")
}

#[test]
fn help_lists_the_subcommands_by_purpose_and_the_exit_codes() {
    let output = clearway(&["--help"]);
    assert_eq!(output.status.code(), Some(0));
    let help = text(&output.stdout);
    let position = |part: &str| help.find(part).unwrap_or_else(|| panic!("{part:?} is missing:\n{help}"));
    let order =
        ["Make maps:", "  demo ", "  serve ", "  replay ", "Check maps", "  verify ", "Send sensor data:", "Shell:"];
    assert!(order.map(position).is_sorted(), "{help}");
    position("Exit codes: 0 success, 1 failure, 2 wrong usage.");
}

#[test]
fn every_subcommand_has_help() {
    let help = text(&clearway(&["--help"]).stdout);
    let names = help.lines().filter_map(|line| line.strip_prefix("  ")?.split_once(' ').map(|(name, _)| name));
    let names: Vec<&str> = names.filter(|name| !name.is_empty() && !name.starts_with('-')).collect();
    assert_eq!(names.len(), 15, "{names:?}");
    for name in names {
        let output = clearway(&[name, "--help"]);
        assert!(output.status.success() && text(&output.stdout).contains(&format!("Usage: clearway {name}")), "{name}");
    }
}

#[test]
fn check_prints_the_default_configuration_in_a_form_that_check_accepts() {
    let output = clearway(&["check", "--config", concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/clearway.toml")]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let folder = tempfile::tempdir().unwrap();
    let printed = folder.path().join("effective.toml");
    std::fs::write(&printed, &output.stdout).unwrap();
    let again = clearway(&["check", "--config", printed.to_str().unwrap()]);
    assert_eq!(text(&again.stdout), text(&output.stdout));
}

#[test]
fn an_unknown_key_is_refused_with_its_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    std::fs::write(&file, "[grpc]\nlisten = \"127.0.0.1:0\"\nlissten = 1\n").unwrap();
    let output = clearway(&["serve", "--config", file.to_str().unwrap()]);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("clearway.toml") && error.contains("line 3") && error.contains("lissten"), "{error}");
}

#[test]
fn serve_without_a_configuration_file_names_the_example() {
    let folder = tempfile::tempdir().unwrap();
    let output = clearway_in(folder.path(), &["serve"]);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(
        error.contains("deploy/clearway.toml") && error.contains("configuration clearway.toml: No such"),
        "{error}"
    );
}

#[test]
fn wrong_usage_prints_the_usage_and_exits_with_2() {
    let output = clearway(&["replay"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("Usage: clearway replay"));
}

#[test]
fn completions_know_every_subcommand() {
    for shell in ["bash", "zsh", "fish"] {
        let output = clearway(&["completions", shell]);
        let script = text(&output.stdout);
        assert!(
            output.status.success() && ["replay", "simulate", "completions"].iter().all(|name| script.contains(name))
        );
    }
    assert_eq!(clearway(&["completions", "dos"]).status.code(), Some(2));
}

/// Simulates 0.3 s of a town with a VLP-16 to a new file; returns the bytes of the file.
fn simulated(file: &Path, seed: &str) -> Vec<u8> {
    let arguments = ["simulate", "town", "--sensor", "vlp16", "--seconds", "0.3", "--seed", seed, "--out"];
    let output = clearway(&[&arguments[..], &[file.to_str().unwrap()]].concat());
    assert!(output.status.success(), "{}", text(&output.stderr));
    std::fs::read(file).unwrap()
}

#[test]
fn a_simulated_drive_is_a_capture_that_info_and_replay_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    simulated(&file, "1");
    let path = file.to_str().unwrap();
    let info: Value = serde_json::from_slice(&clearway(&["info", path, "--json"]).stdout).unwrap();
    assert_eq!((&info["kind"], &info["complete"]), (&"capture".into(), &true.into()));
    // A VLP-16 sends 754 data packets a second, and the simulation 100 telemetry datagrams.
    let (packets, telemetry) = (info["packets"].as_u64().unwrap(), info["telemetry"].as_u64().unwrap());
    assert!((224..=228).contains(&packets) && (29..=31).contains(&telemetry), "{info}");
    assert_eq!(info["sensors"]["192.168.1.201"]["model"], "VLP-16");
    assert_eq!(info["sensors"]["192.168.1.201"]["refused"], serde_json::json!({}));
    let replayed = clearway(&["replay", path, "--extrinsics", "0,0,1.9,0,0,0", "--json"]);
    let summary: Value = serde_json::from_slice(&replayed.stdout).unwrap();
    assert!(summary["maps"].as_u64() >= Some(2), "{summary}");
}

#[test]
fn the_same_seed_makes_the_same_drive() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let first = simulated(&file("a.pcap"), "1");
    assert!(first == simulated(&file("b.pcap"), "1"), "the same seed");
    assert!(first != simulated(&file("c.pcap"), "2"), "another seed");
}

#[test]
fn simulate_refuses_to_overwrite_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("keep.pcap");
    std::fs::write(&file, "keep").unwrap();
    let output = clearway(&["simulate", "flat", "--seconds", "0.1", "--out", file.to_str().unwrap()]);
    assert!(output.status.code() == Some(1) && text(&output.stderr).contains("exists"), "{}", text(&output.stderr));
    assert_eq!(std::fs::read(&file).unwrap(), b"keep");
    assert_eq!(clearway(&["simulate", "flat"]).status.code(), Some(2), "--out or --to is needed");
}
