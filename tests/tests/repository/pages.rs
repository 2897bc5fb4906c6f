//! The Markdown pages: each begins with what it gives to whom, each link leads somewhere, and each command is run by a
//! test or stands here with the reason why it is not.

use std::collections::BTreeSet;
use std::fs;

use clearway_tests::workspace;

use super::{files, shown};
use crate::fixture::pages;

/// What becomes of a command.
enum Run {
    /// The test of this name runs it.
    By(&'static str),
    /// No test runs it, because of this.
    Not(&'static str),
}
use Run::{By, Not};

const CLUSTER: Run = Not("needs a cluster; the tests of deploy/ lint the manifests");
const HOST: Run = Not("changes the host; the tests of deploy/ unpack the package and start its service");
const LONG: Run = Not("a campaign of minutes to hours");
const OFFLINE: Run = By("the_offline_commands_of_the_readme_succeed_on_a_capture");
const SERVED: Run =
    By("the_default_configuration_with_a_black_box_serves_what_send_sends_and_its_file_is_repaired_and_archived");
const FIRST_SENSOR: Run = By("the_guide_of_the_first_sensor_leads_to_a_map");
const FLEET: Run = By("the_guide_of_a_fleet_with_tls_leads_through_the_router_to_a_map");

const VERIFY: Run = By("the_verify_commands_end_with_the_exit_codes_that_the_page_gives");
const EVALUATE: Run = By("the_evaluate_commands_of_the_page_succeed");
const LIVE: Run = By("the_replay_commands_of_the_page_serve_a_drive_as_live");
const FOXGLOVE: Run = By("the_extension_for_foxglove_is_packed_and_shows_the_grids_of_the_servers_own_output");
const GOLDEN: Run = By("the_commands_of_the_golden_recordings_make_the_same_maps_again");
const ROS: Run = Not("needs ROS 2; a test reads the keys that the commands set");

/// What becomes of the commands of a page that begin so; the first line that fits counts.
const COMMANDS: &[(&str, &str, Run)] = &[
    ("ARCHITECTURE.md", "RUSTC_BOOTSTRAP=1 cargo fuzz", Not("needs cargo-fuzz; `cargo test` replays the corpora")),
    ("README.md", "cargo run --release -- demo", By("the_demo_runs_and_ends_cleanly")),
    ("README.md", "cargo test", By("the_first_command_is_the_demo_and_the_second_runs_all_tests")),
    ("README.md", "clearway init", FIRST_SENSOR),
    ("README.md", "clearway serve", FIRST_SENSOR),
    ("README.md", "clearway status", SERVED),
    ("README.md", "clearway send", SERVED),
    ("README.md", "clearway vehicles", SERVED),
    ("README.md", "clearway watch", SERVED),
    ("README.md", "clearway get", SERVED),
    ("README.md", "clearway ", OFFLINE),
    ("client/README.md", "cargo run", By("a_planner_on_maps_of_grpc_and_zenoh_drives_a_lap_without_contact")),
    ("client/cpp/README.md", "cmake", By("the_cpp_example_follows_a_drive_to_its_end")),
    ("client/golden/README.md", "", GOLDEN),
    ("client/guide/testing.md", "", By("the_shell_steps_end_with_success_and_fail_for_a_recording_that_is_not_there")),
    ("client/python/README.md", "pip install", Not("the tests install the package in environments of their own")),
    ("client/ros2/README.md", "clearway demo", Not("takes 30 s; the tests run the demo with other options")),
    ("client/ros2/README.md", "clearway export", OFFLINE),
    ("client/ros2/README.md", "", ROS),
    ("client/web/foxglove/README.md", "", FOXGLOVE),
    ("deploy/README.md", "cargo build", Not("compiles everything once more; deploy/release.sh has the same command")),
    ("deploy/guide/containers.md", "docker", Not("needs docker; a test builds the image with buildah")),
    ("deploy/guide/containers.md", "", CLUSTER),
    ("deploy/guide/first-sensor.md", "ip address", HOST),
    ("deploy/guide/first-sensor.md", "", FIRST_SENSOR),
    ("deploy/guide/fleet.md", "", FLEET),
    ("deploy/guide/service.md", "deploy/debian/make-deb.sh", By("systemd_finds_nothing_in_the_units_of_the_release")),
    ("deploy/guide/service.md", "", HOST),
    ("server/guide/evaluation.md", "python3", Not("needs Patchwork++")),
    ("server/guide/evaluation.md", "", EVALUATE),
    ("server/guide/pictures.md", "pip install", Not("the weekly run installs it from a copy")),
    ("server/guide/pictures.md", "python3 client", Not("opens a window; a test runs it with --save")),
    ("server/guide/pictures.md", "", OFFLINE),
    ("server/guide/recordings.md", "clearway info", OFFLINE),
    ("server/guide/recordings.md", "clearway verify", OFFLINE),
    ("server/guide/recordings.md", "", SERVED),
    ("server/guide/replay.md", "clearway verify", VERIFY),
    ("server/guide/replay.md", "", LIVE),
    ("tests/README.md", "", LONG),
    ("tests/golden/README.md", "", GOLDEN),
];

/// Pages that are read from their own first sentence on: the rules, figures and lists of the repository.
const WITHOUT_INTRODUCTION: [&str; 6] =
    ["README.md", "ARCHITECTURE.md", "BENCHMARKS.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"];

/// All pages, named from the repository on.
fn all_pages() -> Vec<String> {
    files(&workspace(), &["md"]).iter().map(|file| shown(file)).collect()
}

/// The lines of a page outside of its blocks of code.
fn prose(page: &str) -> Vec<String> {
    let mut is_code = false;
    let text = pages::text(page);
    let lines = text.lines().filter(|line| {
        is_code ^= line.starts_with("```");
        !is_code
    });
    lines.map(str::to_owned).collect()
}

/// The targets of the links and pictures of a page.
fn links(page: &str) -> Vec<String> {
    let text = prose(page).join("\n");
    let targets = text.split("](").skip(1).filter_map(|rest| rest.split_once(')'));
    targets.map(|(target, _)| target.to_owned()).filter(|target| !target.starts_with("http")).collect()
}

/// The anchors of the headings of a page, as GitHub makes them.
fn anchors(page: &str) -> Vec<String> {
    let headings = prose(page).into_iter().filter(|line| line.starts_with('#'));
    let anchor = |heading: String| -> String {
        let heading = heading.trim_start_matches('#').trim().to_lowercase().replace(' ', "-");
        heading.chars().filter(|c| c.is_alphanumeric() || "-_".contains(*c)).collect()
    };
    headings.map(anchor).collect()
}

#[test]
fn every_link_of_every_page_leads_to_a_file_and_its_heading() {
    let mut wrong = Vec::new();
    for page in all_pages() {
        let folder = workspace().join(&page).parent().expect("a folder").to_owned();
        for link in links(&page) {
            let (path, anchor) = link.split_once('#').map_or((&*link, None), |(path, anchor)| (path, Some(anchor)));
            let file = if path.is_empty() { Ok(workspace().join(&page)) } else { folder.join(path).canonicalize() };
            let leads = file.is_ok_and(|file| {
                let is_heading = |anchor: &str| anchors(&shown(&file)).iter().any(|heading| heading == anchor);
                anchor.is_none_or(is_heading)
            });
            if !leads {
                wrong.push(format!("{page}: {link}"));
            }
        }
    }
    assert!(wrong.is_empty(), "links that lead nowhere:\n{}", wrong.join("\n"));
}

#[test]
fn the_keys_of_the_web_page_name_pages_that_are_there() {
    let html = fs::read_to_string(workspace().join("server/web/index.html")).expect("the web page");
    let named: Vec<_> = html.split("<code>").skip(1).filter_map(|rest| rest.split_once("</code>")).collect();
    let named: Vec<_> = named.into_iter().map(|(name, _)| name).filter(|name| name.ends_with(".md")).collect();
    let lost: Vec<_> = named.iter().filter(|page| !workspace().join(page).is_file()).collect();
    assert!(named.len() >= 5 && lost.is_empty(), "{named:?}, not there: {lost:?}");
}

#[test]
fn every_page_is_reached_from_the_readme() {
    let (mut reached, mut open) = (BTreeSet::new(), vec!["README.md".to_owned()]);
    while let Some(page) = open.pop() {
        let folder = workspace().join(&page).parent().expect("a folder").to_owned();
        let linked = links(&page).into_iter().filter_map(|link| {
            let file = folder.join(link.split('#').next()?).canonicalize().ok()?;
            (file.extension()? == "md").then(|| shown(&file))
        });
        if reached.insert(page) {
            open.extend(linked);
        }
    }
    let lost: Vec<_> = all_pages().into_iter().filter(|page| !reached.contains(page)).collect();
    assert!(lost.is_empty(), "no link leads to {lost:?}");
}

#[test]
fn every_page_begins_with_what_it_gives_to_whom() {
    let begins = |page: &String| {
        let first = prose(page).into_iter().skip(1).find(|line| !line.is_empty()).unwrap_or_default();
        ["This page ", "This package ", "This folder ", "Where to read "].iter().any(|words| first.starts_with(words))
    };
    let pages = all_pages().into_iter().filter(|page| !WITHOUT_INTRODUCTION.contains(&&**page));
    let wrong: Vec<_> = pages.filter(|page| !begins(page)).collect();
    assert!(wrong.is_empty(), "begin with \"This page gives WHOM WHAT\": {wrong:?}");
}

#[test]
fn every_command_of_every_page_is_run_by_a_test_or_named_with_the_reason() {
    let sources: String = ["rs", "py"]
        .iter()
        .flat_map(|ending| files(&workspace(), &[ending]))
        .fold(String::new(), |all, file| all + &fs::read_to_string(file).expect("UTF-8"));
    let (mut wrong, mut used) = (Vec::new(), BTreeSet::new());
    for page in all_pages() {
        for command in pages::commands(&page) {
            match COMMANDS.iter().position(|(of, begin, _)| *of == page && command.starts_with(begin)) {
                Some(line) => _ = used.insert(line),
                None => wrong.push(format!("{page}: {command}")),
            }
        }
    }
    for (line, (page, begin, run)) in COMMANDS.iter().enumerate() {
        let is_there = match run {
            By(test) => sources.contains(&format!("fn {test}(")),
            Not(reason) => !reason.is_empty(),
        };
        if !used.contains(&line) || !is_there {
            wrong.push(format!("{page}: no such command or test: {begin:?}"));
        }
    }
    assert!(wrong.is_empty(), "commands that no test runs, and lines of `COMMANDS` without one:\n{}", wrong.join("\n"));
}
