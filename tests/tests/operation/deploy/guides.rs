//! The pages of deploy/guide, followed in a network of their own.

use std::fmt::Write as _;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use clearway_tests::serial::PACKAGES;
use clearway_tests::{binaries, workspace};

use super::said;
use crate::fixture::pages::{self, Block};
use crate::fixture::venv;

/// Starts the test: a network with a loopback interface and nothing else, and programs that end with the script.
const HEAD: &str = "set -eu
ip link set lo up
trap 'kill $(jobs -p) 2>/dev/null' EXIT
wait_until() { # pid, command
    pid=$1
    shift
    until \"$@\" >/dev/null 2>&1; do kill -0 \"$pid\"; done
}
";
/// Sends what a VLP-16 sends that stands on flat ground, 1.9 m over it.
const SENSOR: &str = "clearway simulate flat --sensor vlp16 --seconds 600 --to udp://127.0.0.1:2368 \
    --telemetry-to udp://127.0.0.1:8308 2>simulate.log &
";

/// The certificates of a reader.
const TLS: &str = "env CLEARWAY_CA=certificates/ca.pem CLEARWAY_CERT=certificates/reader.pem \
    CLEARWAY_KEY=certificates/reader.key";

/// Runs a script in a network namespace and in this folder. If it fails, its programs' logs say why.
fn follow(folder: &Path, script: &str) -> String {
    symlink(workspace().join("deploy"), folder.join("deploy")).expect("a link of ours");
    fs::write(folder.join("guide.sh"), format!("{HEAD}{script}")).expect("a file of ours");
    let path = format!("{}:{}", binaries().display(), std::env::var("PATH").unwrap_or_default());
    let mut command = Command::new("timeout");
    command.args(["300", "unshare", "--net", "bash", "guide.sh"]).current_dir(folder).env("PATH", path);
    let output = command.output().expect("timeout");
    let logs = || Command::new("bash").args(["-c", "tail -n 5 *.log"]).current_dir(folder).output().expect("tail");
    assert!(output.status.success(), "{}\n{script}\n{}\n{}", output.status, said(&output), said(&logs()));
    said(&output)
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_guide_of_the_first_sensor_leads_to_a_map() {
    let _packages = PACKAGES.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let mut script = SENSOR.to_owned();
    let commands = pages::commands_of("deploy/guide/first-sensor.md", &["sh"]);
    assert_eq!(commands.len(), 5, "{commands:?}");
    for command in &commands {
        // A running server keeps its terminal.
        match command.starts_with("clearway serve") {
            true => _ = writeln!(script, "{command} 2>serve.log &\nwait_until $! clearway get --layer drivability"),
            false => _ = writeln!(script, "{command}"),
        }
    }
    // `init` does not replace the file that it has written.
    script += "if clearway init --seconds 1; then exit 1; fi\n";
    let printed = follow(folder.path(), &script);
    let config = fs::read_to_string(folder.path().join("clearway.toml")).expect("init wrote it");
    assert!(config.contains("model = \"vlp16\"\n") && config.contains("top = \"127.0.0.1\"\n"), "{config}");
    let height = config.lines().find_map(|line| line.strip_prefix("z_m = ")).expect("the height is estimated");
    let height: f64 = height.parse().expect("a number");
    assert!((height - 1.9).abs() < 0.05, "the sensor is 1.9 m over the ground, not {height} m");
    assert!(printed.contains("exists, and is not overwritten"), "{printed}");
    assert!(fs::metadata(folder.path().join("newest.png")).expect("a picture").len() > 1000);
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_guide_of_a_fleet_with_tls_leads_through_the_router_to_a_map() {
    let _packages = PACKAGES.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let blocks = pages::blocks("deploy/guide/fleet.md");
    let mut script = SENSOR.to_owned();
    // zenoh's router from its Python package, instead of the program.
    let router = venv::script("router.py");
    let words: Vec<_> =
        [router.get_program()].into_iter().chain(router.get_args()).map(|word| word.to_string_lossy()).collect();
    _ = writeln!(script, "zenohd() {{ exec {} \"$2\"; }}", words.join(" "));
    let python = venv::client(&workspace());
    for Block { language, text: block } in &blocks {
        match (language.as_str(), block.split_whitespace().next()) {
            ("toml", _) => fs::write(folder.path().join("fleet.toml"), block).expect("a file of ours"),
            ("python", _) => {
                fs::write(folder.path().join("planner.py"), block).expect("a file of ours");
                _ = writeln!(script, "{} planner.py", python.display());
            }
            (_, Some("zenohd")) => {
                let port = "bash -c '</dev/tcp/localhost/7447'";
                _ = writeln!(script, "{} 2>router.log &\nwait_until $! {port}", block.trim());
            }
            _ if block.contains("--vehicle van") => {
                // The second vehicle is on this host too, so it has ports of its own, and no sensor.
                let ports =
                    ["grpc.listen=127.0.0.1:50052", "page.listen=127.0.0.1:8081", "vehicle.udp.data=127.0.0.1:0"];
                let ports =
                    ports.iter().chain(&["vehicle.udp.telemetry=127.0.0.1:0"]).map(|set| format!(" --set {set}"));
                _ = writeln!(script, "{}{} 2>van.log &", block.trim(), ports.collect::<String>());
                let listed = format!("bash -c '{TLS} clearway vehicles --json | grep \\\"van\\\"'");
                _ = writeln!(script, "wait_until $! {listed}");
            }
            _ if block.starts_with("clearway serve") => {
                _ = writeln!(script, "{} 2>serve.log &\nwait_until $! {TLS} clearway vehicles", block.trim());
                // The vehicle listens nowhere that others could reach; the router does.
                script += "ss --no-header --listening --tcp --udp --numeric --processes | grep \"pid=$pid,\" | tee listening\n";
                script += "if grep -v ' 127.0.0.1:' listening; then exit 1; fi\n";
                script += "if CLEARWAY_CA=certificates/ca.pem clearway vehicles; then exit 1; fi\n";
            }
            _ => script += block,
        }
    }
    let printed = follow(folder.path(), &script);
    assert!(printed.lines().any(|line| line.ends_with(" False")), "a fresh map: {printed}");
    let listed = |name: &str| printed.lines().any(|line| line.starts_with(&format!("{name} on ")));
    assert!(listed("car") && listed("van"), "any server lists all vehicles: {printed}");
}

#[test]
fn the_example_of_the_configuration_is_valid_and_says_where_each_value_was_given() {
    let folder = tempfile::tempdir().expect("a folder");
    let example = pages::blocks_of("deploy/guide/configuration.md", "toml").remove(0);
    fs::write(folder.path().join("clearway.toml"), &example).expect("a file of ours");
    let mut check = Command::new(binaries().join("clearway"));
    check.args(["check", "--set", "vehicle[car2].queue=4096"]).current_dir(folder.path());
    let output = check.env("CLEARWAY__PAGE__LISTEN", "127.0.0.1:8081").output().expect("clearway starts");
    let text = said(&output);
    assert!(output.status.success(), "{text}");
    let line_of = |wanted: &str| 1 + example.lines().position(|line| line.starts_with(wanted)).expect("in the example");
    let (first, second) = text.split_once("name = \"car2\"").expect("two vehicles");
    for (part, line) in [
        (first, "listen = \"127.0.0.1:8081\"  # $CLEARWAY__PAGE__LISTEN".to_owned()),
        (first, "queue = 8192\n".to_owned()),
        (first, format!("valid_ms = 250  # clearway.toml:{}, vehicle_defaults", line_of("valid_ms"))),
        (first, format!("z_m = 1.9  # clearway.toml:{}, vehicle_defaults", line_of("z_m = 1.9"))),
        (second, "queue = 4096  # --set vehicle[car2].queue".to_owned()),
        (second, format!("model = \"vlp16\"  # clearway.toml:{}, vehicle_defaults", line_of("model"))),
        (second, format!("z_m = 2.05  # clearway.toml:{}\n", line_of("z_m = 2.05"))),
    ] {
        assert!(part.contains(&line), "{line:?} in:\n{part}");
    }
}
