//! `clearway replay`: recorded drives -> maps, a recording, readers.

use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;
use clearway_replay::player::faults::Fault;
use clearway_replay::summary::why_no_map;
use clearway_replay::{ReplayOptions, ReplayRun, ReplaySpeed, ServedReplay, describe};

use crate::arguments::model::ModelParser;
use crate::arguments::values::{extrinsics, offset, seconds};
use crate::process::stdin;
use crate::process::stop_signal;
use crate::terminal::{Exit, draw_progress, print, print_line, printable, usage_error};

/// Make maps from recorded drives: pcap, pcapng, MCAP, KITTI, nuScenes and PCD files or folders.
///
/// The sensor's model, return mode and rotation rate are found from the data. If nothing says how the sensor is
/// mounted, height, pitch and roll are estimated from the ground in the first revolutions; the estimate is printed and
/// recorded.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway replay drive.pcap --record drive.mcap
  clearway replay drive.pcap --extrinsics 0,0,1.9,0,0,0 --json
  clearway replay drive.mcap --serve --as-live
  clearway replay drive.mcap --serve --as-live --any-port --ready-file ready.json --wait-readers 1 --exit-at-end

Exit codes: 0 the end was reached, 2 failure, no reading, a file that is not whole, or a signal before the end, 3 wrong use.")]
pub struct ReplayArguments {
    /// pcap, pcapng, MCAP, KITTI .bin, nuScenes .pcd.bin and .pcd files, or folders of them, in the order
    /// given.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Record the events and the maps to this MCAP file, which must not exist.
    #[arg(long, value_name = "OUT.mcap")]
    record: Option<PathBuf>,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
    /// Speed of the replay: as-recorded, max, or a factor such as 0.5 [default: max; as-recorded with --serve].
    #[arg(long, value_name = "as-recorded|max|X")]
    speed: Option<ReplaySpeed>,
    /// Begin this many seconds after the first event; the maps from there are the maps of the whole drive.
    #[arg(long, value_name = "SECONDS", value_parser = offset)]
    from: Option<f64>,
    /// End this many seconds after the first event.
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    to: Option<f64>,
    /// The vehicle to replay; needed if the recording or the configuration has several.
    #[arg(long, value_name = "NAME")]
    vehicle: Option<String>,
    /// Position and orientation of the first sensor in the ego frame, in metres and degrees, such as 0,0,1.9,0,0,0;
    /// estimated from the ground if neither this nor the files nor the configuration has it.
    #[arg(long, value_name = "x,y,z,roll,pitch,yaw", value_parser = extrinsics, allow_hyphen_values = true)]
    extrinsics: Option<Extrinsics>,
    /// Model of every sensor, if the data names the wrong one or none; of scans, the model whose elevations they have.
    #[arg(long, value_parser = ModelParser)]
    model: Option<Model>,
    /// A ROS topic of a ROS 2 bag (MCAP) to read; may be given several times. Sensors and poses are chosen if absent.
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Use the vehicle, the maps and the publishers of this configuration.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of that configuration, or of the recorded one, such as vehicle.maps.valid_ms=500; may be given
    /// several times.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Replay with a fault: lost:SENSOR@FROM-TO, loss:PERCENT or loss:PERCENT@FROM-TO, clock:MS@AT, pose:X,Y,YAW@AT or
    /// stop@FROM-TO, in seconds after the first event, metres and degrees; may be given several times. clock steps the
    /// clock of this host, by which packets arrive: maps stamped by a sensor's own clock keep their stamps, and the
    /// status names the difference.
    #[arg(long = "fault", value_name = "FAULT", value_parser = |text: &str| text.parse::<Fault>())]
    faults: Vec<Fault>,
    /// Publish the maps, and the last one until SIGINT (Ctrl-C) or SIGTERM. Without --as-live the maps keep the stamps
    /// of the recording, so readers see the maps of an old recording as stale.
    #[arg(long)]
    serve: bool,
    #[command(flatten)]
    served: ServedArguments,
}

/// The options of a replay that readers see.
#[derive(Args)]
#[command(next_help_heading = "With --serve")]
struct ServedArguments {
    /// Move the stamps of the maps to the present, so that readers judge their age as on the vehicle.
    #[arg(long, requires = "serve")]
    as_live: bool,
    /// Begin again at the end of the drive or of --to, until a signal.
    #[arg(long = "loop", requires = "serve", conflicts_with_all = ["record", "exit_at_end"])]
    repeat: bool,
    /// Begin paused; `clearway transport` or the page starts it.
    #[arg(long, requires = "serve")]
    paused: bool,
    /// Make the next map when every reader that acknowledges has acknowledged the last one; the default speed is max.
    /// If an acknowledgement takes longer than this time (10 s if none is given), the server ends with exit code 2, and
    /// names the map and the readers.
    #[arg(long, value_name = "SECONDS", requires = "serve", num_args = 0..=1, require_equals = true,
        default_missing_value = "10", value_parser = seconds)]
    lockstep: Option<f64>,
    /// Wait for this many readers before the first event: gRPC streams, pages, zenoh keys and Foxglove subscriptions.
    #[arg(long, value_name = "N", requires = "serve", default_value_t = 0, hide_default_value = true)]
    wait_readers: u32,
    /// Write the process id and the addresses to this new file as JSON once readers can connect; it is removed at the
    /// end. If a program holds stdin open as a pipe, the command ends with that program.
    #[arg(long, value_name = "FILE.json", requires = "serve")]
    ready_file: Option<PathBuf>,
    /// Listen on free ports of this machine only; --ready-file and the log say which.
    #[arg(long, requires = "serve")]
    any_port: bool,
    /// End when the end of the drive or of --to is reached, instead of serving the last map.
    #[arg(long, requires = "serve")]
    exit_at_end: bool,
}

impl From<ServedArguments> for ServedReplay {
    fn from(given: ServedArguments) -> Self {
        let ServedArguments { as_live, repeat, paused, wait_readers, ready_file, any_port, .. } = given;
        let (lockstep, exits_at_end) = (given.lockstep.map(Duration::from_secs_f64), given.exit_at_end);
        Self { as_live, repeat, paused, seek_s: None, lockstep, wait_readers, ready_file, any_port, exits_at_end }
    }
}

/// Replays the files and prints the summary. A file that is not whole, or a signal before the end, is
/// [`Exit::Unreadable`].
pub async fn run(arguments: ReplayArguments) -> Result<Exit> {
    let ReplayArguments { files, record, json, speed, from: from_s, to: to_s, vehicle, extrinsics, .. } = arguments;
    if let (Some(from), Some(to)) = (from_s, to_s)
        && from >= to
    {
        return Err(usage_error(format!("--from {from} --to {to}: the range must end after it begins")));
    }
    let ReplayArguments { model, topics, config, set, faults, serve, served, .. } = arguments;
    let served: Option<ServedReplay> = serve.then(|| served.into());
    // Under cron stdin is a pipe that was closed from the start.
    let is_of_program = served.as_ref().is_some_and(|served| served.ready_file.is_some()) && !stdin::is_closed();
    let has_bar = !json && !serve && std::io::stderr().is_terminal();
    let options = ReplayOptions {
        files,
        vehicle,
        topics,
        config,
        set,
        extrinsics,
        model,
        record,
        from_s,
        to_s,
        speed,
        faults,
        served,
    };
    let signal = stop_signal()?;
    let closed = tokio::spawn(stdin::closed(is_of_program));
    let stop = async {
        tokio::select! {
            () = signal => {}
            _ = closed => {}
        }
    };
    let replay = ReplayRun::start(options).await?;
    if let Some(description) = describe(replay.mount()) {
        eprintln!("extrinsics {description}");
    }
    let bar = has_bar.then(|| draw_progress(replay.progress.bytes, replay.progress.bytes_read.clone()));
    let summary = replay.play(stop).await;
    drop(bar);
    let summary = summary?;
    summary.remarks().iter().for_each(|remark| eprintln!("{}", printable(remark)));
    if json {
        print_line(&format!("{:#}", summary.to_json()))?
    } else {
        print(&summary.to_text())?
    };
    let has_no_map = summary.reached_end && !summary.shows_anything();
    if has_no_map {
        let which = if summary.maps() == 0 { "no map" } else { "no map that shows anything" };
        eprintln!("clearway: the {} made {which}: {}", summary.what, why_no_map(&summary.mount, &summary.snapshot));
    }
    Ok(Exit::from_incomplete(!summary.truncated.is_empty() || !summary.reached_end || has_no_map))
}
