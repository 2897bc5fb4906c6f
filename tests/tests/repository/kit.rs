//! The tests of a planner that client/guide/testing.md shows, in Rust, Python and a shell, as they are written there.

use std::fs;
use std::path::Path;
use std::process::Command;

use clearway_client::test::{Replay, town};
use clearway_client::zenoh::ZenohClient;
use clearway_client::{ClientError, Footprint, StreamEvent, Subscription, now_ns, v1};
use clearway_tests::{binaries, run, workspace};

use crate::fixture::{pages, venv};

#[tokio::test]
async fn the_street_ahead_is_free() -> Result<(), Box<dyn std::error::Error>> {
    binaries();
    let drive = Replay::start(town())?;
    let mut maps = drive.client().await?.subscribe(Subscription::default()).await?;
    let map = loop {
        match maps.next().await?.map {
            map if map.sequence() >= 5 => break map,
            _ => continue,
        }
    };
    let car = Footprint { x_m: 8.0, y_m: 0.0, heading_rad: 0.0, length_m: 4.0, width_m: 2.0 };
    assert!(!map.is_stale(now_ns()) && map.is_free("freespace", &car)?);
    assert_eq!(map.layer("occupancy")?.class_at(8.0, 0.0).1, "clear");
    assert!(map.nearest_obstacle("occupancy", [0.0; 2], None)?.is_some_and(|obstacle| obstacle.distance_m > 1.0));
    while maps.next().await.is_ok() {} // to the end of the drive
    while !matches!(maps.next_or_stale().await?, StreamEvent::Stale(_)) {}
    Ok(())
}

#[tokio::test]
async fn a_replay_is_paused_and_stepped_and_its_exit_status_and_log_are_known() {
    binaries();
    let mut drive = Replay::with(town(), &["--paused", "--exit-at-end"]).unwrap();
    let client = drive.client().await.unwrap();
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    let control = |step, paused| v1::ReplayControl { step, paused, ..Default::default() };
    // It waits for its reader, and then still for the first command.
    let mut state = client.replay_control(control(None, None)).await.unwrap();
    while state.phase() == v1::ReplayPhase::Waiting {
        state = client.replay_control(control(None, None)).await.unwrap();
    }
    assert_eq!((state.phase(), &state.maps[..]), (v1::ReplayPhase::Paused, &[0][..]), "{state:?}");
    let state = client.replay_control(control(Some(2), None)).await.unwrap();
    assert_eq!((state.phase(), &state.maps[..]), (v1::ReplayPhase::Paused, &[2][..]), "{state:?}");
    client.replay_control(control(None, Some(false))).await.unwrap();
    let mut read = 0;
    while maps.next().await.is_ok() {
        read += 1;
    }
    let status = drive.wait().unwrap();
    assert!(read > 2 && status.success(), "{read} maps, {status}: {}", drive.log());
    assert!(drive.log().contains("INFO"), "{}", drive.log());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_over_zenoh_learns_that_a_replay_has_ended_and_why_one_in_lockstep_has_failed() {
    binaries();
    let drive = Replay::with(town(), &["--speed", "max"]).unwrap();
    let client = ZenohClient::connect(&drive.zenoh).await.unwrap();
    let mut maps = client.subscribe("car", "drivability").await.unwrap();
    let mut last = None;
    let ended = loop {
        match maps.next().await {
            Ok(update) => last = Some(update.map.sequence()),
            Err(ended) => break ended,
        }
    };
    assert!(matches!(ended, ClientError::ReplayEnded { .. }) && last == Some(9), "{ended} after {last:?}");
    // A subscriber that comes later gets the last map, and then the end.
    let mut late = client.subscribe("car", "drivability").await.unwrap();
    while let Ok(update) = late.next().await {
        assert_eq!(update.map.sequence(), 9);
    }
    assert!(matches!(late.next().await, Err(ClientError::ReplayEnded { .. })));

    let drive = Replay::with(town(), &["--lockstep=0.5"]).unwrap();
    let client = ZenohClient::connect(&drive.zenoh).await.unwrap();
    let mut maps = client.subscribe("car", "drivability").await.unwrap();
    let failed = loop {
        if let Err(failed) = maps.next().await {
            break failed.to_string();
        }
    };
    assert!(failed.contains("map 0 of vehicle car was not acknowledged within 0.5 s"), "{failed}");
}

/// The code blocks of a language.
fn blocks(language: &str) -> Vec<String> {
    pages::blocks_of("client/guide/testing.md", language)
}

#[test]
fn the_test_in_rust_is_the_one_of_the_page() {
    let shown = blocks("rust,ignore");
    assert_eq!(shown.len(), 1);
    let own = include_str!("kit.rs").replace("    binaries();\n", "");
    let body = shown[0].split_once("#[tokio::test]").expect("a test").1;
    assert!(own.contains(body), "the page shows another test:\n{body}");
}

#[test]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
fn the_test_in_python_passes_with_the_client_of_its_source_distribution_and_older_versions_of_protobuf() {
    // The client's own tests have the newest one.
    for (name, versions) in [
        ("python-protobuf-5", &["protobuf==5.26.0", "grpcio==1.67.1"][..]),
        ("python-protobuf-6", &["protobuf==6.33.6"][..]),
    ] {
        planner_passes(&venv::client_with(&workspace(), name, versions));
    }
}

fn planner_passes(interpreter: &Path) {
    let folder = tempfile::tempdir().unwrap();
    let shown = blocks("python");
    assert_eq!(shown.len(), 1);
    fs::write(folder.path().join("test_planner.py"), &shown[0]).unwrap();
    let mut pytest = Command::new(interpreter);
    pytest.args(["-B", "-m", "pytest", "-q", "-p", "no:cacheprovider"]).current_dir(folder.path());
    pytest.env("CLEARWAY", binaries().join("clearway"));
    let said = venv::run(&mut pytest, "pytest names what failed");
    assert!(said.contains("1 passed"), "{said}");
}

#[test]
fn the_shell_steps_end_with_success_and_fail_for_a_recording_that_is_not_there() {
    let shown = blocks("bash");
    assert_eq!(shown.len(), 1);
    let path = format!("{}:{}", binaries().display(), std::env::var("PATH").unwrap_or_default());
    let steps = |recording: &Path| {
        let folder = tempfile::tempdir().unwrap();
        fs::copy(recording, folder.path().join("drive.mcap")).unwrap();
        let mut shell = Command::new("bash");
        shell.args(["-euo", "pipefail", "-c", &shown[0]]).env("PATH", &path).current_dir(folder.path());
        let output = shell.output().expect("bash runs");
        (output.status.success(), format!("{}{}", text(&output.stdout), text(&output.stderr)))
    };
    let (passed, said) = steps(town());
    assert!(passed, "{said}");
    let (passed, said) = steps(&workspace().join("client/golden/README.md"));
    assert!(!passed && said.contains("drive.mcap"), "{said}");
}

#[test]
fn the_verify_commands_end_with_the_exit_codes_that_the_page_gives() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("drives")).unwrap();
    for copy in ["drives/town.mcap", "before.mcap", "after.mcap"] {
        fs::copy(town(), at(copy)).unwrap();
    }
    let config = fs::read_to_string(workspace().join("deploy/clearway.toml")).unwrap();
    fs::write(at("new.toml"), config.replace("vehicle_width_m = 2.0", "vehicle_width_m = 2.6")).unwrap();
    let shown = pages::commands_of("server/guide/replay.md", &["shell"]);
    let codes = shown.iter().map(|command| {
        let words: Vec<_> = command.split_whitespace().collect();
        run(folder.path(), words[0], &words[1..]).status.code()
    });
    assert_eq!(codes.collect::<Vec<_>>(), [Some(0), Some(1), Some(0)]);
    assert!(at("verify.xml").is_file());
}

#[test]
fn the_ci_examples_verify_and_compare_and_a_recording_that_is_not_whole_fails_them_after_the_comparison() {
    let path = format!("{}:{}", binaries().display(), std::env::var("PATH").unwrap_or_default());
    let config = fs::read_to_string(workspace().join("deploy/clearway.toml")).unwrap();
    let whole = fs::read(town()).unwrap();
    for (file, recording, passes) in [
        ("github.yml", &whole[..], true),
        ("github.yml", &whole[..whole.len() / 20 * 19], false),
        ("gitlab.yml", &whole[..], true),
        ("gitlab.yml", &whole[..whole.len() / 20 * 19], false),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir_all(at("client/golden")).unwrap();
        fs::write(at("client/golden/drive.mcap"), recording).unwrap();
        fs::write(at("new.toml"), config.replace("vehicle_width_m = 2.0", "vehicle_width_m = 2.6")).unwrap();
        let run = |script: &String| {
            let mut shell = Command::new("bash");
            shell.args(["-e", "-c", script]).env("PATH", &path).env("SHARD", "1/1").current_dir(folder.path());
            shell.output().expect("bash runs").status.success()
        };
        let results: Vec<bool> = scripts(file).iter().map(run).collect();
        assert_eq!(results.iter().all(|passed| *passed), passes, "{file}: {results:?}");
        let report = fs::read_to_string(at("verify.xml")).unwrap();
        assert_eq!(report.contains("failures=\"0\" errors=\"0\""), passes, "{file}: {report}");
    }
}

/// The scripts of a CI example that call `verify`; its CI runs each of them also if a script before it failed.
fn scripts(file: &str) -> Vec<String> {
    let text = fs::read_to_string(workspace().join("deploy/ci").join(file)).unwrap();
    if file == "gitlab.yml" {
        let script = text.split_once("  script:\n").unwrap().1.split_once("  artifacts:").unwrap().0;
        let lines: Vec<_> = script.lines().filter_map(|line| line.trim().strip_prefix("- ")).collect();
        return vec![lines.join("\n")];
    }
    let (_, steps) = text.split_once("    steps:\n").unwrap();
    let steps: Vec<_> = steps.split("      - ").filter(|step| step.contains("run: clearway verify")).collect();
    assert!(steps[1].contains("if: ${{ !cancelled() }}"), "{file}: the comparison depends on the result of verify");
    steps.iter().map(|step| step.split_once("run: ").unwrap().1.trim_end().to_owned()).collect()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
