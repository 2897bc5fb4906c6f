//! Measures the age of a map of `clearway replay DRIVE --serve --as-live` when its readers have it: over gRPC, over
//! zenoh, as a ROS 2 topic, and on the page in Chromium, all at once.
//!
//!   cargo build --release -p clearway && cargo bench -p clearway-tests --bench replay
//!   cargo bench -p clearway-tests --bench replay -- --seconds 60             a longer drive
//!   cargo bench -p clearway-tests --bench replay -- --drive drive.mcap       a recording of one vehicle
//!
//! Age: from the shifted stamp of the map (its `capture_end_ns`, or the stamp of the ROS message) to the reader's
//! hands, with decoding for gRPC and zenoh; of the page, the age that it shows in each display frame. The drive is a
//! simulated HDL-64E in the town unless one is given. The command is the file that the environment variable CLEARWAY
//! names, else the file beside this bench in the target folder.

#[path = "../tests/page/webdriver.rs"]
#[allow(dead_code, reason = "the tests of the page use the rest")]
mod webdriver;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use clap::Parser;
use clearway_client::test::Replay;
use clearway_client::{MapStream, Subscription, ZenohClient, now_ns};
use clearway_daemon::record::run_config;
use clearway_journal::reader::RecordingReader;
use tokio::runtime::Runtime;
use webdriver::Browser;

/// Age that no map may have, in ms: the default validity of a map.
const AGE_MS_MAX: f64 = 300.0;
/// Time for which the page stays open before the drive begins, so that its start is not measured.
const SETTLE: Duration = Duration::from_secs(3);

/// Measures the age of the maps of a replay as live when its readers have them.
#[derive(Parser)]
struct ReplayBenchArguments {
    /// A recording of one vehicle.
    #[arg(long)]
    drive: Option<PathBuf>,
    /// Seconds of the simulated drive.
    #[arg(long, default_value_t = 30)]
    seconds: u32,
    /// Leaves the page out.
    #[arg(long)]
    no_page: bool,
    /// Set by cargo bench.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Ages in ms, as they come.
type Ages = Arc<Mutex<Vec<f64>>>;

fn main() {
    let arguments = ReplayBenchArguments::parse();
    let folder = tempfile::tempdir().expect("a folder");
    let drive = arguments.drive.unwrap_or_else(|| simulated(arguments.seconds, folder.path()));
    let (config, vehicle) = with_ros_2(&drive, folder.path());
    let runtime = Runtime::new().expect("threads");
    let replay = Replay::with(&drive, &["--config", &config, "--paused"]).expect("the replay starts");
    let browser = (!arguments.no_page).then(|| {
        let browser = Browser::start(1440, 900);
        browser.open(&format!("{}?vehicle={vehicle}", replay.page));
        browser.until("the time bar", "return !document.getElementById('replay').hidden");
        browser
    });
    let [over_grpc, over_zenoh, over_ros] = [(); 3].map(|()| Ages::default());
    runtime.block_on(async {
        let client = replay.client().await.expect("gRPC answers");
        let selection = Subscription { layers: vec!["drivability".into()], ..Subscription::default() };
        let maps = client.subscribe(selection).await.expect("a stream");
        let zenoh = ZenohClient::connect(&replay.zenoh).await.expect("zenoh answers");
        let of_zenoh = zenoh.subscribe(&vehicle, "drivability").await.expect("a stream");
        let reads_grpc = tokio::spawn(read(maps, over_grpc.clone()));
        tokio::spawn(read(of_zenoh, over_zenoh.clone()));
        tokio::spawn(read_ros_2(replay.zenoh.clone(), vehicle.clone(), over_ros.clone()));
        tokio::time::sleep(SETTLE).await;
        let play = clearway_client::v1::ReplayControl { paused: Some(false), ..Default::default() };
        client.replay_control(play).await.expect("it plays");
        // The page shows a map of the paused drive until the first one comes.
        tokio::time::sleep(SETTLE).await;
        browser.iter().for_each(Browser::collect_ages);
        reads_grpc.await.expect("no panic");
    });
    println!("| reader | maps or frames | p50 ms | p99 ms | worst ms | over {AGE_MS_MAX} ms |");
    println!("|---|---|---|---|---|---|");
    for (name, ages) in [("gRPC", over_grpc), ("zenoh", over_zenoh), ("ROS 2 topic", over_ros)] {
        print_row(name, std::mem::take(&mut ages.lock().expect("no thread panics")));
    }
    if let Some(browser) = browser {
        let shown = browser.run("return window.ages");
        let ages = shown.as_array().expect("a list").iter().filter_map(|age| age.as_f64()).collect();
        print_row("page, every display frame", ages);
    }
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    println!("load {}", load.split_whitespace().take(3).collect::<Vec<_>>().join(" "));
}

/// A recording of a simulated drive.
fn simulated(seconds: u32, folder: &Path) -> PathBuf {
    let [capture, recording] = ["drive.pcap", "drive.mcap"].map(|name| folder.join(name));
    let beside = || Some(std::env::current_exe().ok()?.parent()?.parent()?.join("clearway"));
    let command = std::env::var_os("CLEARWAY").map(PathBuf::from).or_else(beside).expect("the target folder");
    let run = |arguments: &[&str], files: [&Path; 2]| {
        let [input, output] = files;
        let mut command = Command::new(&command);
        command.args(arguments).arg(input).args([if arguments[0] == "replay" { "--record" } else { "--out" }]);
        let done = command.arg(output).output().expect("the command starts");
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    };
    run(&["simulate", "--seconds", &seconds.to_string()], [Path::new("town"), &capture]);
    run(&["replay", "--extrinsics", "0,0,1.9,0,0,0"], [&capture, &recording]);
    recording
}

/// Writes the recording's configuration with ROS 2 topics to a file; returns its path, and the vehicle's name.
fn with_ros_2(drive: &Path, folder: &Path) -> (String, String) {
    let (recorded, _) = RecordingReader::open(drive).and_then(|recording| run_config(&recording)).expect("a recording");
    let mut config = clearway_daemon::config::Config { vehicles: recorded.vehicles, ..Default::default() };
    (config.zenoh.enabled, config.zenoh.ros2.enabled) = (true, true);
    for vehicle in &mut config.vehicles {
        (vehicle.udp, vehicle.ros) = (None, None);
    }
    let file = folder.join("ros2.toml");
    std::fs::write(&file, config.to_toml()).expect("the folder can be written to");
    (file.to_str().expect("UTF-8").to_owned(), config.vehicles[0].name.clone())
}

/// Reads maps until the replay ends.
async fn read(mut maps: MapStream, ages: Ages) {
    while let Ok(update) = maps.next().await {
        let age_ns = now_ns() - update.map.header().capture_end_ns;
        ages.lock().expect("no thread panics").push(age_ns as f64 / 1e6);
    }
}

/// Reads `nav_msgs/OccupancyGrid` messages as rmw_zenoh publishes them; their first field is the stamp.
async fn read_ros_2(endpoints: String, vehicle: String, ages: Ages) {
    let mut config = zenoh::Config::default();
    let endpoints = format!("{:?}", endpoints.split(',').collect::<Vec<_>>());
    for (key, value) in [("mode", "\"client\""), ("connect/endpoints", &endpoints)] {
        config.insert_json5(key, value).expect("a setting");
    }
    let session = zenoh::open(config).await.expect("zenoh answers");
    let key = format!("0/clearway/{vehicle}/drivability/**");
    let subscriber = session.declare_subscriber(key).await.expect("a subscriber");
    while let Ok(sample) = subscriber.recv_async().await {
        let now_ns = now_ns();
        let bytes = sample.payload().to_bytes();
        // Four bytes say how CDR is encoded; ours is little-endian.
        let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        let stamp_ns = i64::from(number(4)) * 1_000_000_000 + i64::from(number(8));
        ages.lock().expect("no thread panics").push((now_ns - stamp_ns) as f64 / 1e6);
    }
}

fn print_row(name: &str, mut ages: Vec<f64>) {
    assert!(!ages.is_empty(), "{name}: no map came");
    ages.sort_by(f64::total_cmp);
    let at = |share: f64| ages[((ages.len() - 1) as f64 * share).round() as usize];
    let late = ages.iter().filter(|age| **age > AGE_MS_MAX).count();
    println!("| {name} | {} | {:.1} | {:.1} | {:.1} | {late} |", ages.len(), at(0.5), at(0.99), at(1.0));
}
