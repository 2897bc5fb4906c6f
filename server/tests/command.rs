//! The command `clearway`, run as a user runs it.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

use crate::common::{clearway, text};

/// Runs `clearway` in a folder.
fn clearway_in(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
    command.args(arguments).env_remove("CLEARWAY_CONFIG").current_dir(folder).output().expect("the binary starts")
}

#[test]
fn help_lists_the_subcommands_in_order_and_the_exit_codes() {
    let output = clearway(&["--help"]);
    assert_eq!(output.status.code(), Some(0));
    let help = text(&output.stdout);
    let position = |part: &str| help.find(part).unwrap_or_else(|| panic!("{part:?} is missing:\n{help}"));
    let order = ["Commands:", "  serve ", "  replay ", "  verify ", "  watch ", "Options:", "Exit codes:"];
    assert!(order.map(position).is_sorted(), "{help}");
    position("Exit codes: 0 good, 1 the result differs, 2 an input cannot be read");
    let pages: Vec<_> = help.split_whitespace().filter(|word| word.ends_with(".md")).collect();
    assert!(pages.len() >= 8, "{pages:?}");
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    assert!(pages.iter().all(|page| repository.join(page).is_file()), "{pages:?}");
}

#[test]
fn every_subcommand_has_help() {
    let help = text(&clearway(&["--help"]).stdout);
    let lines = help.lines().take_while(|line| *line != "Pages:");
    let names = lines.filter_map(|line| line.strip_prefix("  ")?.split_once(' ').map(|(name, _)| name));
    let names: Vec<&str> =
        names.filter(|name| !matches!(name.chars().next(), None | Some('-')) && *name != "help").collect();
    assert_eq!(names.len(), 24, "{names:?}");
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
    // The comments say where a value was given: first in one file, then in the other.
    let values = |shown: &[u8]| -> Vec<String> {
        text(shown).lines().map(|line| line.split("  # ").next().unwrap_or_default().to_owned()).collect()
    };
    assert_eq!(values(&again.stdout), values(&output.stdout));
}

#[test]
fn the_default_configuration_is_printed_with_its_comments_and_is_valid() {
    let printed = clearway(&["check", "--default"]);
    assert!(printed.status.success(), "{}", text(&printed.stderr));
    let shown = text(&printed.stdout);
    for optional in
        ["# [grpc.tls]", "[vehicle.udp]", "# [vehicle.ros]", "# [vehicle.body]", "[recorder]", "# Maps over"]
    {
        assert!(shown.contains(optional), "{optional}");
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("clearway.toml"), &printed.stdout).unwrap();
    let checked = clearway_in(folder.path(), &["check"]);
    assert!(checked.status.success(), "{}", text(&checked.stderr));
    assert_eq!(clearway(&["check", "--default", "--set", "grpc.enabled=false"]).status.code(), Some(3));
}

#[test]
fn the_variable_clearway_config_names_the_default_file_and_contradicts_no_option() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("other.toml"), "[grpc]\nenabled = 7\n").unwrap();
    let check = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
        command.arg("check").args(arguments).env("CLEARWAY_CONFIG", "other.toml").current_dir(folder.path());
        command.output().expect("the binary starts")
    };
    let refused = check(&[]);
    let error = text(&refused.stderr);
    assert!(refused.status.code() == Some(2) && error.contains("other.toml"), "{error}");
    let printed = check(&["--default"]);
    assert!(printed.status.success(), "{}", text(&printed.stderr));
}

#[test]
fn an_unknown_key_is_refused_with_its_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    std::fs::write(&file, "[grpc]\nlisten = \"127.0.0.1:0\"\nlissten = 1\n").unwrap();
    let output = clearway(&["serve", "--config", file.to_str().unwrap()]);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(error.contains("clearway.toml") && error.contains("line 3") && error.contains("lissten"), "{error}");
}

#[test]
fn serve_without_a_configuration_file_names_the_example() {
    let folder = tempfile::tempdir().unwrap();
    let output = clearway_in(folder.path(), &["serve"]);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(
        error.contains("clearway check --default") && error.contains("configuration clearway.toml: No such file"),
        "{error}"
    );
}

#[test]
fn wrong_usage_prints_the_usage_and_exits_with_3() {
    let output = clearway(&["replay"]);
    assert_eq!(output.status.code(), Some(3));
    assert!(text(&output.stderr).contains("Usage: clearway replay"));
}

#[test]
fn a_negative_number_is_a_wrong_value_and_not_an_unknown_option() {
    for (arguments, allowed) in [
        (&["replay", "a.pcap", "--speed", "-1"][..], "or a factor from 0.1 to 1000 is allowed"),
        (&["replay", "a.pcap", "--from", "NaN"], "0 to 1000000000 seconds are allowed"),
        (&["replay", "a.pcap", "--to", "1e300"], "a number of seconds above 0, up to 1000000000, is allowed"),
        (&["replay", "a.pcap", "--from", "2", "--to", "1"], "--from 2 --to 1: the range must end after it begins"),
        (&["view", "a.pcap", "--from", "-1"], "0 to 1000000000 seconds are allowed"),
        (&["simulate", "flat", "--out", "a.pcap", "--seconds", "-1"], "0.1 to 3600 seconds are allowed"),
        (&["demo", "--seconds", "-1"], "0 or more seconds are allowed"),
        (&["ingest", "a.bin", "--hz", "-1"], "0.1 to 100 is allowed"),
        (&["transport", "seek", "inf"], "0 to 1000000000 seconds are allowed"),
        (&["transport", "step", "0"], "0 is not in 1..=1000000"),
        (&["transport", "range", "5", "2"], "range 5 2: the range must end after it begins"),
        (&["get", "--range", "-1"], "0.1 to 10000 m is allowed"),
    ] {
        let output = clearway(arguments);
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(3) && error.contains(allowed), "{arguments:?}: {error}");
    }
    let extrinsics = clearway(&["replay", "absent.pcap", "--extrinsics", "-1,0,1.9,0,-2,0"]);
    assert_eq!(extrinsics.status.code(), Some(2), "{}", text(&extrinsics.stderr));
}

#[test]
fn a_sensor_model_is_listed_in_the_help_and_read_in_each_way_to_write_it() {
    let names = ["hdl64e_s1", "hdl64e_s2", "hdl64e_s3", "hdl32e", "vlp16", "puck_hi_res", "vlp32c", "vls128"];
    for command in ["replay", "simulate"] {
        let help = text(&clearway(&[command, "--help"]).stdout);
        assert!(names.iter().all(|name| help.contains(name)), "{help}");
    }
    let folder = tempfile::tempdir().unwrap();
    let simulated = |sensor: &str| {
        let file = folder.path().join(format!("{sensor}.pcap"));
        let arguments = ["simulate", "flat", "--seconds", "0.1", "--out", file.to_str().unwrap(), "--sensor", sensor];
        text(&clearway(&arguments).stdout)
    };
    assert!(simulated("HDL-64E S2").contains("with the sensor hdl64e_s2"));
    assert!(simulated("VLP-16").contains("with the sensor vlp16"));
    let refused = clearway(&["replay", "a.pcap", "--model", "hdl64e"]);
    let error = text(&refused.stderr);
    assert!(refused.status.code() == Some(3) && error.contains("hdl64e_s1, hdl64e_s2, hdl64e_s3"), "{error}");
}

#[test]
fn a_file_that_cannot_be_used_is_named_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    for name in ["empty.pcap", "empty.mcap", "empty.bag"] {
        std::fs::write(at(name), "").unwrap();
    }
    let (no_file, is_folder, is_empty) = (": No such file", ": this is a folder; name a file", "empty");
    let (poses, none) = (at("absent.tum"), at("none"));
    std::fs::create_dir(&none).unwrap();
    let (absent, here) = (at("absent.pcap"), folder.path().display().to_string());
    let (capture, recording, unknown) = (at("empty.pcap"), at("empty.mcap"), at("empty.bag"));
    let (to, png) = ("udp://127.0.0.1:9", at("out"));
    let wrong_files: [(&[&str], &str, &str); 20] = [
        (&["info", &absent], &absent, no_file),
        (&["info", &here], &here, is_empty),
        (&["info", &none], &none, "in this folder"),
        (&["info", &capture], &capture, is_empty),
        (&["replay", &absent], &absent, no_file),
        (&["replay", &capture], &capture, is_empty),
        (&["replay", &recording], &recording, is_empty),
        (&["replay", &unknown], &unknown, is_empty),
        (&["verify", &absent], &absent, no_file),
        (&["verify", &none], &none, "no file *.mcap in this folder"),
        (&["verify", &recording], &recording, is_empty),
        (&["export", &here, "--format", "png", "--out", &png], &here, is_folder),
        (&["export", &recording, "--format", "png", "--out", &png], &recording, is_empty),
        (&["send", &absent, "--to", to], &absent, no_file),
        (&["send", &here, "--to", to], &here, is_folder),
        (&["ingest", &here], &here, "name its files, such as"),
        (&["ingest", &poses], &poses, no_file),
        (&["check", "--config", &absent], &absent, ": No such file; `clearway check --default > clearway.toml`"),
        (&["check", "--config", &here], &here, is_folder),
        (&["simulate", "flat", "--out", &capture], &capture, "exists and is not overwritten; delete it"),
    ];
    for (arguments, file, advice) in wrong_files {
        let output = clearway(arguments);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(file) && error.contains(advice), "{arguments:?}: {error}");
        assert!(!error.contains("os error"), "{arguments:?}: {error}");
    }
}

#[test]
fn options_that_would_have_no_effect_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    simulated(&file, "1");
    let path = file.to_str().unwrap();
    let to = "udp://127.0.0.1:9";
    let town = Path::new(env!("CARGO_MANIFEST_DIR")).join("../client/golden/town.mcap").display().to_string();
    let refused: [(&[&str], i32, &str); 11] = [
        // Wrong for these files, not for all: an input that does not fit.
        (&["replay", &town, "--vehicle", "nope"], 2, "--vehicle nope: the configuration has: car"),
        (&["replay", &town, "--fault", "lost:nosuch@0-1"], 2, "sensor \"nosuch\" is not known; known: top"),
        (&["replay", &town, "--fault", "stop@50-60"], 2, "fault \"stop@50-60\": it begins after the drive"),
        (&["replay", &town, "--from", "100"], 2, "the replay plays 0.000 s to 0."),
        (&["replay", path, "--vehicle", "car"], 2, "--vehicle car: the files name no vehicle"),
        (&["replay", path, "--topic", "/points"], 2, "--topic /points: the files have no topics"),
        (&["replay", path, "--record", path], 2, "exists and is not overwritten; name another file"),
        (&["simulate", "flat", "--out", "x.pcap", "--telemetry-to", to], 3, "--telemetry-to"),
        (&["send", path, "--to", to, "--network", "seed=7"], 3, "a fault of the network is needed"),
        (&["watch", "--zenoh", "tcp/localhost:1", "--server", "localhost:1"], 3, "--server"),
        (&["check", "--default", "--config", "a.toml"], 3, "--config"),
    ];
    for (arguments, code, message) in refused {
        let output = clearway(arguments);
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(code) && error.contains(message), "{arguments:?}: {error}");
    }
    // The capture was not overwritten by its own recording.
    assert_eq!(&std::fs::read(&file).unwrap()[..4], [0x4d, 0x3c, 0xb2, 0xa1]);

    let recording = folder.path().join("drive.mcap");
    let recording = recording.to_str().unwrap();
    let extrinsics = ["--extrinsics", "0,0,1.9,0,0,0"];
    assert!(clearway(&[&["replay", path, "--record", recording], &extrinsics[..]].concat()).status.success());
    let output = clearway(&["replay", recording, "--topic", "/points"]);
    let error = text(&output.stderr);
    assert!(error.contains("is a recording of clearway, of which the events are replayed"), "{error}");
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
    assert_eq!(clearway(&["completions", "dos"]).status.code(), Some(3));
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
    let here = folder.path().to_str().unwrap();
    let of_folder: Value = serde_json::from_slice(&clearway(&["info", here, "--json"]).stdout).unwrap();
    assert_eq!((&of_folder["kind"], &of_folder["files"]), (&"folder".into(), &serde_json::json!({"drive.pcap": info})));
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
    assert!(output.status.code() == Some(2) && text(&output.stderr).contains("exists"), "{}", text(&output.stderr));
    assert_eq!(std::fs::read(&file).unwrap(), b"keep");
    assert_eq!(clearway(&["simulate", "flat"]).status.code(), Some(3), "--out or --to is needed");
}

#[test]
fn an_unknown_word_or_option_is_refused_with_what_the_subcommand_has() {
    for (arguments, tip) in [
        (
            &["serve", "a.toml"][..],
            "tip: a value needs its option: --config <FILE>, --set <KEY=VALUE>, --vehicle <NAME>",
        ),
        (&["watch", "car"], "--vehicle <NAME>"),
        (&["status", "--vehicle", "car"], "tip: 'VEHICLE' is a word without '--vehicle'"),
    ] {
        let output = clearway(arguments);
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(3) && error.contains(tip) && !error.contains("'-- "), "{error}");
    }
    assert!(text(&clearway(&["help", "watch"]).stdout).contains("Usage: clearway watch"));
    assert!(text(&clearway(&["transport", "--help"]).stdout).contains("`speed` does the same"));
}

#[test]
fn every_port_in_use_is_named_at_once_with_what_to_do() {
    let [first, second] = [(); 2].map(|()| std::net::TcpListener::bind("127.0.0.1:0").unwrap());
    let [first_at, second_at] = [&first, &second].map(|socket| socket.local_addr().unwrap());
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("clearway.toml"), clearway(&["check", "--default"]).stdout).unwrap();
    let set = [format!("--set=grpc.listen={first_at}"), format!("--set=page.listen={second_at}")];
    let output = clearway_in(folder.path(), &["serve", &set[0], &set[1]]);
    let error = text(&output.stderr);
    let named = [format!("grpc.listen {first_at}: "), format!("page.listen {second_at}: ")];
    assert!(named.iter().all(|part| error.contains(part)) && error.contains("perhaps another clearway"), "{error}");
}
