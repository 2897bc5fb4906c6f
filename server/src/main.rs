//! The command `clearway-server`: serve, replay, verify, evaluate, check, demo.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context, Result};
use clap::{Parser, Subcommand, ValueEnum};
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_server::config::Config;
use clearway_server::demo::{self, Places, Second};
use clearway_server::evaluate;
use clearway_server::replay::{self, Progress, Speed, Summary};
use clearway_server::server::{Running, Server, Setup};
use clearway_server::verify::verify;
use indicatif::{ProgressBar, ProgressStyle};
use tracing_subscriber::EnvFilter;

/// Turns LIDAR packets into maps of where a vehicle may drive.
#[derive(Parser)]
#[command(name = "clearway-server", version)]
struct Arguments {
    /// How logs look on stderr; RUST_LOG selects them.
    #[arg(long, value_enum, default_value = "text", global = true)]
    log_format: LogFormat,
    #[command(subcommand)]
    command: Command,
}

#[derive(Clone, Copy, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

#[derive(Subcommand)]
enum Command {
    /// Listen for datagrams, make maps and publish them, until SIGINT or SIGTERM.
    Serve {
        #[command(flatten)]
        config: ConfigArguments,
    },
    /// Make maps of pcap, pcapng, MCAP and KITTI files or folders, in the order given.
    Replay(Box<ReplayArguments>),
    /// Recompute every map of a recording from its events; exit 1 and name the first difference if there is one.
    Verify {
        /// The recording.
        file: PathBuf,
        /// One object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Judge every map against labelled scans (SemanticKITTI's .bin and .label) or simulated scenes.
    Evaluate(EvaluateArguments),
    /// Check a configuration and print it with every default.
    Check {
        #[command(flatten)]
        config: ConfigArguments,
    },
    /// Drive a simulated vehicle at a server of its own, over real UDP.
    Demo {
        /// End after so many seconds; without, at Ctrl-C.
        #[arg(long, value_parser = seconds)]
        seconds: Option<Duration>,
        /// Where to record; a temporary file where absent.
        #[arg(long)]
        record: Option<PathBuf>,
        /// One turning LIDAR in a town; or two of them and six that scan, poses and roads over gRPC, in traffic.
        #[arg(long, value_enum, default_value = "one")]
        sensors: Sensors,
        /// One object a second on stdout, and a summary.
        #[arg(long)]
        json: bool,
    },
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Sensors {
    One,
    Many,
}

#[derive(clap::Args)]
struct ConfigArguments {
    /// The configuration file; deploy/clearway.toml shows every key.
    #[arg(short, long, env = "CLEARWAY_CONFIG", default_value = "clearway.toml")]
    config: PathBuf,
    /// Overrides a key: KEY=VALUE, such as grpc.listen=0.0.0.0:50051.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

#[derive(clap::Args)]
struct ReplayArguments {
    /// pcap, pcapng, MCAP, KITTI .bin, .pcd, or folders of them.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Record events and maps to this MCAP file.
    #[arg(long, value_name = "OUT.mcap")]
    record: Option<PathBuf>,
    /// as-recorded, max, or a factor [default: max; as-recorded with --serve].
    #[arg(long)]
    speed: Option<Speed>,
    /// One object on stdout.
    #[arg(long)]
    json: bool,
    /// Write each revolution's points, sensor frame, as binary PCD into this folder.
    #[arg(long, value_name = "DIR")]
    clouds: Option<PathBuf>,
    /// The sensor's own table: ROS YAML or Velodyne XML.
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// How the sensor is mounted: x,y,z in metres, roll,pitch,yaw in degrees; estimated from the ground where absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    extrinsics: Option<Extrinsics>,
    /// The sensor's model, where the data lies about it.
    #[arg(long, value_parser = model)]
    model: Option<Model>,
    /// The sensor's turning rate, where the data lies about it.
    #[arg(long)]
    rpm: Option<f32>,
    /// A ROS topic of an MCAP file, several times for several; sensors and poses are chosen where absent.
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Take vehicle, maps and publishers from this configuration.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Overrides a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    set: Vec<String>,
    /// Publish the maps, until SIGINT or SIGTERM. They keep the stamps of their capture, so readers call old ones
    /// stale.
    #[arg(long)]
    serve: bool,
    /// Whose journal (of a recording) or configuration is used, where there are several.
    #[arg(long)]
    vehicle: Option<String>,
}

#[derive(clap::Args)]
struct EvaluateArguments {
    /// Folders with .bin and .label files of the same names, or sim:flat, sim:slopes, sim:canopy, sim:overhang,
    /// sim:town.
    #[arg(required = true, value_name = "PATH")]
    paths: Vec<String>,
    /// One object on stdout.
    #[arg(long)]
    json: bool,
    /// Degrees a column of the radial maps spans.
    #[arg(long, value_name = "1|2|4", value_parser = columns)]
    columns: Option<u16>,
    /// How the scans' sensor is mounted, as for replay; as on KITTI's car where absent.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    extrinsics: Option<Extrinsics>,
    /// Judge the maps of this configuration's first vehicle.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Overrides a key of the configuration.
    #[arg(long, value_name = "KEY=VALUE", requires = "config")]
    set: Vec<String>,
}

fn columns(text: &str) -> Result<u16, String> {
    let degrees = text.parse().ok().filter(|degrees| evaluate::columns(*degrees).is_some());
    degrees.ok_or_else(|| "1, 2 or 4 degrees are allowed".into())
}

fn seconds(text: &str) -> Result<Duration, String> {
    let duration = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    duration.ok_or_else(|| "0 or more seconds are allowed".into())
}

fn extrinsics(text: &str) -> Result<Extrinsics, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match numbers[..] {
        [x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg] if text.split(',').count() == 6 => {
            Ok(Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg })
        }
        _ => Err("six numbers are needed: x,y,z in metres, roll,pitch,yaw in degrees".into()),
    }
}

fn model(text: &str) -> Result<Model, String> {
    let all: Vec<&str> = Model::ALL.into_iter().map(clearway_mapping::pipeline::model_name).collect();
    let found = all.iter().position(|name| *name == text);
    found.map(|index| Model::ALL[index]).ok_or_else(|| format!("known: {}", all.join(", ")))
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,zenoh=error"));
    let logs = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match arguments.log_format {
        LogFormat::Text => logs.with_ansi(std::io::stderr().is_terminal()).init(),
        LogFormat::Json => logs.json().init(),
    }
    match run(arguments.command) {
        Ok(code) => code,
        Err(error) => {
            // The errors of this house name their causes themselves.
            eprintln!("clearway-server: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: Command) -> Result<ExitCode> {
    match command {
        Command::Serve { config } => runtime()?.block_on(serve(&config)),
        Command::Replay(arguments) => runtime()?.block_on(replay_files(*arguments)),
        Command::Verify { file, json } => verify_file(&file, json),
        Command::Evaluate(arguments) => evaluate_maps(arguments),
        Command::Check { config } => {
            let checked = load(&config)?;
            checked.calibrations(&config.config)?;
            checked.certificates(&config.config)?;
            say(&checked.to_toml());
            Ok(ExitCode::SUCCESS)
        }
        Command::Demo { seconds, record, sensors, json } => {
            runtime()?.block_on(run_demo(seconds, record, sensors == Sensors::Many, json))
        }
    }
}

/// zenoh needs several threads, whatever the machine has.
fn runtime() -> Result<tokio::runtime::Runtime> {
    let threads = std::thread::available_parallelism().map_or(2, usize::from).max(2);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(threads).enable_all().build();
    runtime.context("starting the runtime")
}

fn load(arguments: &ConfigArguments) -> Result<Config> {
    Ok(Config::load(&arguments.config, &arguments.set)?)
}

async fn serve(arguments: &ConfigArguments) -> Result<ExitCode> {
    let mut config = load(arguments)?;
    let calibrations = config.calibrations(&arguments.config)?;
    let certificates = config.certificates(&arguments.config)?;
    if let Some(file) = clearway_server::record::wanted(&config.recorder) {
        config.recorder.file = clearway_server::record::unused(file);
    }
    // Asked for before anything starts, so that no signal can fall between.
    let stop = stop_signal()?;
    let running = Server::start(Setup { config, calibrations, certificates, ..Setup::default() }).await?;
    tell(&running);
    stop.await;
    tracing::info!("stopping");
    running.shutdown().await?;
    Ok(ExitCode::SUCCESS)
}

/// Logs where to look.
fn tell(running: &Running) {
    for vehicle in &running.doors {
        if let Some((data, telemetry)) = vehicle.udp {
            tracing::info!(vehicle = %vehicle.name, %data, %telemetry, "listening for datagrams");
        }
    }
    if let Some(at) = running.grpc {
        tracing::info!(%at, "gRPC");
    }
    if let Some(at) = running.page {
        tracing::info!("page http://{at}/");
    }
    for endpoint in &running.zenoh {
        tracing::info!(%endpoint, "zenoh");
    }
    if let Some(at) = running.foxglove {
        tracing::info!("foxglove ws://{at}");
    }
    if let Some(recording) = running.recording() {
        tracing::info!(%recording, "recording");
    }
}

/// Resolves at SIGINT or SIGTERM.
fn stop_signal() -> Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

async fn replay_files(arguments: ReplayArguments) -> Result<ExitCode> {
    let json = arguments.json;
    let options = replay::Options {
        files: arguments.files,
        record: arguments.record,
        speed: arguments.speed,
        clouds: arguments.clouds,
        calibration: arguments.calibration,
        extrinsics: arguments.extrinsics,
        model: arguments.model,
        rpm: arguments.rpm,
        topics: arguments.topics,
        config: arguments.config,
        set: arguments.set,
        serve: arguments.serve,
        vehicle: arguments.vehicle,
    };
    let progress = Arc::new(Progress::default());
    let bar = tokio::spawn(draw(progress.clone(), !json && std::io::stderr().is_terminal()));
    let stop = stop_signal()?;
    let started = |running: &Running, summary: &Summary| {
        if let Some(said) = replay::describe(&summary.mount) {
            eprintln!("extrinsics {said}");
        }
        tell(running);
    };
    let outcome = replay::replay(options, progress, started, stop).await;
    bar.abort();
    // A bar that was cleared away has nothing left to say.
    let _ = bar.await;
    let summary = outcome?;
    for truncated in &summary.truncated {
        eprintln!("warning: {}: {}; what came before was used", truncated.file.display(), truncated.reason);
    }
    for note in &summary.notes {
        eprintln!("note: {note}");
    }
    if json {
        say(&format!("{:#}\n", summary.to_json()));
    } else {
        say(&summary.to_text());
    }
    Ok(ExitCode::SUCCESS)
}

/// A progress bar on a terminal, nothing elsewhere.
async fn draw(progress: Arc<Progress>, shown: bool) {
    if !shown {
        return;
    }
    let style = ProgressStyle::with_template("{bar:40} {bytes}/{total_bytes} {bytes_per_sec} {eta}");
    let bar = ProgressBar::new(0).with_style(style.expect("the template is constant"));
    // Cleared when this task is dropped, so that it does not stand between the lines that follow.
    struct Cleared(ProgressBar);
    impl Drop for Cleared {
        fn drop(&mut self) {
            self.0.finish_and_clear();
        }
    }
    let bar = Cleared(bar);
    loop {
        bar.0.set_length(progress.bytes.load(Ordering::Relaxed));
        bar.0.set_position(progress.bytes_read.load(Ordering::Relaxed));
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

async fn run_demo(
    duration: Option<Duration>,
    record: Option<PathBuf>,
    many_sensors: bool,
    json: bool,
) -> Result<ExitCode> {
    let folder = if Path::new("target").is_dir() { PathBuf::from("target") } else { std::env::temp_dir() };
    let record = record.unwrap_or_else(|| folder.join("demo.mcap"));
    let picture = record.with_extension("png");
    let options = demo::Options { duration, record, picture, many_sensors, any_port: false };
    let begun = |places: &Places| {
        if json {
            return;
        }
        places.notes.iter().for_each(|note| say(&format!("{note}\n")));
        say(&format!(
            "A simulated car drives through a simulated town.\n  page       http://{}/\n  gRPC       {}   (clearway watch \
             --server http://{})\n  zenoh      {}   (clearway/car/map/drivability)\n  recording  {}\n  newest map {}   (drawn each second)\n",
            places.page,
            places.grpc,
            places.grpc,
            places.zenoh.join(", "),
            places.record.display(),
            places.picture.display(),
        ));
    };
    let second = |second: &Second| {
        say(&if json { format!("{}\n", second.to_json()) } else { format!("{}\n", second.line()) });
    };
    let stop = stop_signal()?;
    let summary = demo::demo(options, begun, second, stop).await?;
    if json {
        say(&format!("{}\n", summary.to_json()));
    } else {
        let (sent, last) = (summary.sent, &summary.last.snapshot);
        say(&format!(
            "The car sent {} data packets and {} telemetry datagrams; {} were received, {} maps made.\n",
            sent.packets, sent.telemetry, last.ledger.received, last.maps
        ));
    }
    Ok(ExitCode::SUCCESS)
}

fn verify_file(file: &Path, json: bool) -> Result<ExitCode> {
    let report = verify(file)?;
    if json {
        say(&format!("{:#}\n", report.to_json()));
    } else {
        let cut = if report.cut { "; the file was cut by a crash, this is what it holds" } else { "" };
        let of = format!("{} events, {} maps, {} layers equal{cut}", report.events, report.maps, report.equal);
        if report.is_good() {
            say(&format!("{}: every map is the map of its events: {of}\n", file.display()));
        } else {
            say(&format!("{}: {} differences: {of}\n", file.display(), report.different));
            report.differences.iter().for_each(|difference| say(&format!("{difference}\n")));
        }
    }
    Ok(if report.is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn evaluate_maps(arguments: EvaluateArguments) -> Result<ExitCode> {
    let EvaluateArguments { paths, json, columns, extrinsics, config, set } = arguments;
    let options = evaluate::Options { paths, columns_deg: columns, extrinsics, config, set };
    let shown = !json && std::io::stderr().is_terminal();
    let bar = if shown { ProgressBar::new(0) } else { ProgressBar::hidden() };
    let outcome = evaluate::evaluate(&options, |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    });
    bar.finish_and_clear();
    let report = outcome?;
    say(&if json { format!("{:#}\n", report.to_json()) } else { report.to_text() });
    Ok(ExitCode::SUCCESS)
}

/// Prints; a reader that has gone (`| head`) is no error.
fn say(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extrinsics_are_six_numbers_in_metres_and_degrees() {
        let given = extrinsics("1,-0.5,1.9,0,-2.5,90").unwrap();
        assert_eq!((given.x_m, given.y_m, given.z_m), (1.0, -0.5, 1.9));
        assert_eq!((given.roll_deg, given.pitch_deg, given.yaw_deg), (0.0, -2.5, 90.0));
        for wrong in ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,x,6"] {
            assert!(extrinsics(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_model_nobody_knows_is_answered_with_those_that_are() {
        assert_eq!(model("vls128"), Ok(Model::Vls128));
        assert!(model("ouster").unwrap_err().contains("hdl64e_s2"));
    }

    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory;
        Arguments::command().debug_assert();
    }
}
