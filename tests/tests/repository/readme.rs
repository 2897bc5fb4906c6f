//! The commands of the README and of the pages of server/guide, run as they are written there.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use clearway_mapping::config::MapsConfig;
use clearway_mapping::pipeline::layer_names;
use clearway_tests::serial::DEFAULT_PORTS;
use clearway_tests::{binaries, run, workspace};

use crate::fixture::{pages, venv};

/// The pages whose commands run in one folder, one after the other.
const PAGES: [&str; 3] = ["README.md", "server/guide/recordings.md", "server/guide/pictures.md"];

/// The commands of [`PAGES`] that begin with `clearway` and one of these subcommands, in order.
fn commands(subcommands: &[&str]) -> Vec<String> {
    let all = PAGES.iter().flat_map(|page| pages::commands(page));
    all.filter(|command| is_one_of(command, subcommands)).collect()
}

fn is_one_of(command: &str, subcommands: &[&str]) -> bool {
    let mut words = command.split(' ');
    words.next() == Some("clearway") && words.next().is_some_and(|word| subcommands.contains(&word))
}

/// A server that stops when this is dropped.
struct Stopped(Child);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Stopped {
    /// Starts a command of a page.
    fn start(folder: &Path, command: &str, stdout: Stdio) -> Self {
        let mut words = command.split_whitespace();
        let mut start = Command::new(binaries().join(words.next().expect("a program")));
        start.args(words).current_dir(folder).stdout(stdout).stderr(Stdio::null());
        Self(start.spawn().expect("the command starts"))
    }
}

fn succeeds(folder: &Path, command: &str) {
    ends_with(folder, command, &[0]);
}

/// Runs a command of a page; returns what it printed.
fn ends_with(folder: &Path, command: &str, codes: &[i32]) -> String {
    let words: Vec<_> = command.split_whitespace().collect();
    let output = run(folder, words[0], &words[1..]);
    let is_expected = output.status.code().is_some_and(|code| codes.contains(&code));
    assert!(is_expected, "{command}: {}\n{}", output.status, String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn the_first_command_is_the_demo_and_the_second_runs_all_tests() {
    let commands = pages::commands("README.md");
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
    let offline = commands(&["replay", "verify", "export", "info", "simulate"]);
    assert_eq!(offline.len(), 11, "{offline:?}");
    for command in &offline {
        succeeds(folder.path(), command);
    }
    for command in commands(&["view"]) {
        let mut view = Stopped::start(folder.path(), &command, Stdio::piped());
        let mut page = String::new();
        BufReader::new(view.0.stdout.take().expect("a pipe")).read_line(&mut page).expect("an address");
        assert!(page.starts_with("http://"), "{command}: {page}");
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
fn the_evaluate_commands_of_the_page_succeed() {
    let folder = tempfile::tempdir().expect("a folder");
    let data = Path::new(option_env!("CLEARWAY_DRIVES").unwrap_or_default()).join("kitti");
    for (file, place) in [("patchwork-plusplus/000000.bin", "velodyne"), ("mmdet3d/000000.label", "labels")] {
        let to = folder.path().join("sequences/00").join(place);
        fs::create_dir_all(&to).expect("the layout of SemanticKITTI");
        let from = data.join(file);
        fs::copy(&from, to.join(from.file_name().expect("a name"))).expect("the labelled frame");
    }
    let evaluations = pages::commands_of("server/guide/evaluation.md", &["sh", "shell"]);
    assert_eq!(evaluations.len(), 4, "{evaluations:?}");
    for command in &evaluations {
        succeeds(folder.path(), command);
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_default_configuration_with_a_black_box_serves_what_send_sends_and_its_file_is_repaired_and_archived() {
    let _ports = DEFAULT_PORTS.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let capture = Path::new(env!("CLEARWAY_DRIVES")).join("pcap/rust-lidar-utils/hdl32_example.pcap");
    fs::copy(&capture, folder.path().join("drive.pcap")).expect("the HDL-32E capture");
    fs::copy(workspace().join("deploy/clearway.toml"), folder.path().join("clearway.toml")).expect("the configuration");
    let serve = commands(&["serve"]).pop().expect("the page shows `clearway serve`");
    let mut server = Stopped::start(folder.path(), &serve, Stdio::null());
    await_vehicles(folder.path(), &mut server, &serve);
    for command in commands(&["send", "vehicles"]) {
        succeeds(folder.path(), &command);
    }
    // The capture has ended, so no further map comes, the newest one may be stale, and the vehicle silent.
    ends_with(folder.path(), "clearway watch --count 1", &[0, 4]);
    for command in commands(&["get", "status"]) {
        ends_with(folder.path(), &command, &[0, 4, 5]);
    }
    assert!(folder.path().join("newest.png").is_file());
    for command in commands(&["recorder"]) {
        succeeds(folder.path(), &command);
    }
    drop(server);
    for command in commands(&["repair"]) {
        // What the server had not written yet is missing.
        ends_with(folder.path(), &command, &[0, 1]);
    }
    fs::create_dir(folder.path().join("recordings")).expect("a folder");
    fs::copy(folder.path().join("repaired.mcap"), folder.path().join("recordings/drive.mcap")).expect("repaired");
    for command in commands(&["upload", "recordings"]) {
        succeeds(folder.path(), &command);
    }
}

/// Waits until the server on the default ports answers.
fn await_vehicles(folder: &Path, server: &mut Stopped, command: &str) {
    while !run(folder, "clearway", &["vehicles"]).status.success() {
        let ended = server.0.try_wait().expect("the server's state");
        assert!(ended.is_none(), "{command} ended: {ended:?}");
    }
}

#[test]
fn the_replay_commands_of_the_page_serve_a_drive_as_live() {
    let _ports = DEFAULT_PORTS.enter();
    let folder = tempfile::tempdir().expect("a folder");
    succeeds(folder.path(), "clearway simulate flat --sensor vlp16 --seconds 5 --out drive.pcap");
    succeeds(folder.path(), "clearway replay drive.pcap --extrinsics 0,0,1.9,0,0,0 --record drive.mcap");
    let (servers, controls): (Vec<_>, Vec<_>) =
        pages::commands_of("server/guide/replay.md", &["sh"]).into_iter().partition(|c| is_one_of(c, &["replay"]));
    assert_eq!((servers.len(), controls.len()), (3, 1), "{servers:?} {controls:?}");
    for command in &servers {
        let mut server = Stopped::start(folder.path(), command, Stdio::null());
        if command.contains("--any-port") {
            read_to_the_end(folder.path(), &mut server, command);
            continue;
        }
        await_vehicles(folder.path(), &mut server, command);
        controls.iter().for_each(|control| succeeds(folder.path(), control));
    }
}

/// Follows a replay on ports of the system's choice until it ends by itself.
fn read_to_the_end(folder: &Path, server: &mut Stopped, command: &str) {
    let ready = loop {
        let ready = fs::read(folder.join("ready.json")).unwrap_or_default();
        if let Ok(ready) = serde_json::from_slice::<serde_json::Value>(&ready) {
            break ready;
        }
        assert!(server.0.try_wait().expect("the server's state").is_none(), "{command} ended");
        std::thread::sleep(std::time::Duration::from_millis(2));
    };
    // A slow reader receives the newest maps alone: of a short drive, perhaps one.
    let grpc = ready["grpc"].as_str().expect("an address");
    let watched = run(folder, "clearway", &["watch", "--server", grpc, "--count", "1"]);
    assert!(watched.status.success(), "{}", String::from_utf8_lossy(&watched.stderr));
    assert!(server.0.wait().expect("the server ends").success(), "{command}");
}

#[test]
fn the_commands_of_the_golden_recordings_make_the_same_maps_again() {
    for (page, golden) in [("client/golden/README.md", "town.mcap"), ("tests/golden/README.md", "drive.mcap")] {
        let folder = tempfile::tempdir().expect("a folder");
        for command in pages::commands(page) {
            succeeds(folder.path(), &command);
        }
        let kept = workspace().join(page).with_file_name(golden);
        succeeds(folder.path(), &format!("clearway verify {golden} --against {}", kept.display()));
    }
}

#[test]
fn the_pictures_of_the_layers_are_those_that_the_page_makes() {
    let folder = tempfile::tempdir().expect("a folder");
    for command in pages::commands_of("server/guide/pictures.md", &["sh"]).iter().filter(|c| !c.contains("drive.mcap"))
    {
        succeeds(folder.path(), command);
    }
    let mut wrong = Vec::new();
    for layer in layer_names(&MapsConfig::default()) {
        let kept = workspace().join(format!("server/core/mapping/src/layer/{layer}/picture.png"));
        let made = folder.path().join(format!("pictures/000029_{layer}.png"));
        if std::env::var_os("CLEARWAY_BLESS").is_some() {
            fs::copy(&made, &kept).expect("the repository can be written");
        }
        if fs::read(&made).expect("a picture") != fs::read(&kept).expect("the page's picture") {
            wrong.push(layer);
        }
    }
    assert!(wrong.is_empty(), "CLEARWAY_BLESS=1 makes the pictures of {wrong:?} again");
}
