//! The command `clearway`: serve, replay, verify, evaluate, check, demo.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context, Result};

use clap::Parser;
use crate::config::Config;
use crate::cli::demo::{self, Places, Second};
use crate::cli::evaluate;
use crate::cli::replay::{self, Progress, Summary};
use crate::server::{Running, Server, Setup};
use crate::record::verify::verify;
use indicatif::{ProgressBar, ProgressStyle};
use tracing_subscriber::EnvFilter;

use super::arguments::{Arguments, Command, ConfigArguments, EvaluateArguments, LogFormat, ReplayArguments, Sensors};

/// Runs the command line.
pub fn main() -> ExitCode {
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
            eprintln!("clearway: {error:#}");
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
        Command::Watch(options) => done(super::block_on(super::watch::run(options))),
        Command::Get(options) => done(super::block_on(super::get::run(options))),
        Command::Vehicles(options) => done(super::block_on(super::vehicles::run(options))),
        Command::Info(options) => done(super::info::run(&options)),
        Command::Export(options) => done(super::export::run(&options)),
        Command::Send(options) => done(super::send::run(&options)),
        Command::Ingest(options) => done(super::block_on(super::ingest::run(options))),
        Command::Demo { seconds, record, sensors, json } => {
            runtime()?.block_on(run_demo(seconds, record, sensors == Sensors::Many, json))
        }
    }
}

fn done(outcome: Result<()>) -> Result<ExitCode> {
    outcome.map(|()| ExitCode::SUCCESS)
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
    let config = load(arguments)?;
    let calibrations = config.calibrations(&arguments.config)?;
    let certificates = config.certificates(&arguments.config)?;
    let mut config = config.located(&arguments.config);
    if let Some(file) = crate::record::writer::recording_path(&config.recorder) {
        config.recorder.file = crate::record::writer::next_free_name(file);
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
    for vehicle in &running.inputs {
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
