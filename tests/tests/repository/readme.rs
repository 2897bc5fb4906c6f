//! The commands of the README and of server/README.md, run as they are written there.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use clearway_tests::serial::DEFAULT_PORTS;
use clearway_tests::{binaries, run, workspace};

use crate::fixture::venv;

/// Every command line of the `sh` blocks of the README and of server/README.md, in order.
fn commands() -> Vec<String> {
    let pages = ["README.md", "server/README.md"];
    let read = |page: &str| fs::read_to_string(workspace().join(page)).expect("a page");
    let readme = pages.map(read).join("\n");
    let mut inside = false;
    let mut lines = Vec::new();
    for line in readme.lines() {
        match line {
            "```sh" => inside = true,
            "```" => inside = false,
            command if inside => lines.push(command.to_owned()),
            _ => {}
        }
    }
    lines
}

/// A server that stops when this is dropped.
struct Stopped(Child);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn succeeds(folder: &Path, command: &str) {
    let words: Vec<_> = command.split_whitespace().collect();
    let output = run(folder, words[0], &words[1..]);
    assert!(output.status.success(), "{command}: {}\n{}", output.status, String::from_utf8_lossy(&output.stderr));
}

/// The capture has ended, so the newest map may be stale: then the exit code is 4.
fn shows_a_map(folder: &Path, command: &str) -> String {
    let words: Vec<_> = command.split_whitespace().collect();
    let output = run(folder, words[0], &words[1..]);
    assert!(matches!(output.status.code(), Some(0 | 4)), "{command}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn the_first_command_is_the_demo_and_the_second_runs_all_tests() {
    let commands = commands();
    assert_eq!(commands[0], "cargo run --release -- demo");
    assert_eq!(commands[1], "cargo test --workspace");
    let ci = fs::read_to_string(workspace().join(".ci/run")).expect(".ci/run");
    let is_run = ci.lines().any(|line| line.split(" | ").next() == Some(&commands[1]));
    assert!(is_run, ".ci/run runs the README's test command");
}

#[test]
fn the_demo_runs_and_ends_cleanly() {
    let _ports = DEFAULT_PORTS.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let output = run(folder.path(), "clearway", &["demo", "--seconds", "3"]);
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}\n{said}\n{}", output.status, String::from_utf8_lossy(&output.stderr));
    for place in ["http://", "gRPC", "zenoh", ".mcap", ".png"] {
        assert!(said.contains(place), "the demo prints {place}:\n{said}");
    }
}

#[test]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_offline_commands_of_the_readme_succeed_on_a_capture() {
    let folder = tempfile::tempdir().expect("a folder");
    let capture = Path::new(env!("CLEARWAY_DRIVES")).join("pcap/rust-lidar-utils/hdl32_example.pcap");
    fs::copy(&capture, folder.path().join("drive.pcap")).expect("the HDL-32E capture");
    let offline: Vec<_> = commands()
        .into_iter()
        .filter(|c| {
            let verbs = ["replay", "verify", "export", "info", "simulate"];
            verbs.iter().any(|verb| c.split(' ').nth(1) == Some(verb))
        })
        .collect();
    assert_eq!(offline.len(), 10, "{offline:?}");
    for command in &offline {
        succeeds(folder.path(), command);
    }
    let pictures = fs::read_dir(folder.path().join("maps")).expect("maps/").count();
    assert!(pictures >= 6, "{pictures} pictures of 5.7 revolutions");
    for (name, schema) in [("drive.foxglove.mcap", "foxglove.Grid"), ("drive.ros2.mcap", "nav_msgs/msg/OccupancyGrid")]
    {
        let topics =
            venv::run(venv::script("viewer_file.py").arg(folder.path().join(name)), "the README names its readers");
        let topics: serde_json::Value = serde_json::from_str(&topics).expect("one object");
        let topics = topics.as_object().expect("topics by name").values();
        let grids = topics.filter(|topic| topic["schema"] == schema && topic["count"].as_u64() >= Some(6)).count();
        assert_eq!(grids, 7, "every layer of 5.7 revolutions in {name}");
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_evaluate_commands_of_the_readme_succeed() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = Path::new(option_env!("CLEARWAY_DRIVES").unwrap_or_default()).join("kitti");
    for (file, place) in [("patchwork-plusplus/000000.bin", "velodyne"), ("mmdet3d/000000.label", "labels")] {
        let to = folder.path().join("sequences/00").join(place);
        fs::create_dir_all(&to).expect("the layout of SemanticKITTI");
        let from = data.join(file);
        fs::copy(&from, to.join(from.file_name().expect("a name"))).expect("the labelled frame");
    }
    let evaluations: Vec<_> = commands().into_iter().filter(|c| c.starts_with("clearway evaluate")).collect();
    assert_eq!(evaluations.len(), 3, "{evaluations:?}");
    for command in &evaluations {
        succeeds(folder.path(), command);
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_default_configuration_serves_what_send_sends_to_the_readers() {
    let _ports = DEFAULT_PORTS.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let capture = Path::new(env!("CLEARWAY_DRIVES")).join("pcap/rust-lidar-utils/hdl32_example.pcap");
    fs::copy(&capture, folder.path().join("drive.pcap")).expect("the HDL-32E capture");
    let config = workspace().join("deploy/clearway.toml");
    let server = Command::new(binaries().join("clearway"))
        .args(["serve", "--config"])
        .arg(config)
        .current_dir(folder.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("clearway starts");
    let mut server = Stopped(server);
    while !run(folder.path(), "clearway", &["vehicles"]).status.success() {
        let ended = server.0.try_wait().expect("the server's state");
        assert!(ended.is_none(), "clearway serve ended: {ended:?}");
    }
    for command in commands().iter().filter(|c| c.starts_with("clearway send") || c.starts_with("clearway vehicles")) {
        succeeds(folder.path(), command);
    }
    shows_a_map(folder.path(), "clearway watch --count 1");
    let get = commands().into_iter().find(|c| c.starts_with("clearway get")).expect("the README shows `clearway get`");
    shows_a_map(folder.path(), &get);
    assert!(folder.path().join("newest.png").is_file());
}
