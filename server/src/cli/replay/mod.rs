//! `clearway replay`: recorded drives -> maps, through the same event queue, engine, recorder and publishers as live
//! data, with the stamps of the recording. The same files always make the same maps.
//!
//! | file | in -> out |
//! |---|---|
//! | [`options`] | the command line -> [`Options`] |
//! | `plan` | options, files -> configuration, mount, readings |
//! | `recordings` | files -> recordings of several vehicles; sensors that do not fit |
//! | `ready_file` | the running server -> the file that tells programs its addresses |
//! | `record_file` | --record, --force -> whether the file may be written; its name at the end |
//! | `keys` | lines of a terminal -> requests |
//! | [`state`] | the state of the replay -> text, JSON |
//! | [`clouds`] | revolutions -> PCD files |
//! | [`summary`] | the state at the end -> text, JSON |
//!
//! A capture rarely contains how its sensor was mounted. Without extrinsics, a first pass over the first revolutions
//! estimates height, pitch and roll from the ground around the vehicle; the estimate is printed and recorded. If there
//! is no ground to estimate from, the files are decoded and no map is made, and the summary says so.

use std::io::IsTerminal;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clearway_proto::v1;
use indicatif::{ProgressBar, ProgressStyle};

use crate::cli::serve::log_endpoints;
use crate::cli::shared::exit::Exit;
use crate::cli::shared::output::{block_on, print, print_line, stop_signal, usage_error};
use clearway_daemon::base::sync::locked;
use clearway_daemon::config::{Config, Vehicle};
use clearway_daemon::ingest::files::Truncated;
use clearway_daemon::replay::ReplayHandle;
use clearway_daemon::replay::control::{ControlError, check};
use clearway_daemon::replay::faults::Faults;
use clearway_daemon::replay::outcome::Played;
use clearway_daemon::replay::player::{BEHIND_MAX, Player, PlayerOptions};
use clearway_daemon::replay::timeline::{Remarks, Timeline};
use clearway_daemon::replay::vehicle::ReplayedVehicle;
use clearway_daemon::run::{Running, Server, Setup, random};
use clearway_daemon::status::VehicleStatus;

pub mod clouds;
mod keys;
pub mod options;
mod plan;
mod ready_file;
mod record_file;
mod recordings;
pub mod state;
pub mod summary;

pub use options::{Options, ReplayError, Speed};
use plan::{Plan, plan};
use ready_file::ReadyFile;
use record_file::Former;
use summary::why_no_map;
pub use summary::{Mount, Summary, describe};

/// Interval at which the progress bar is drawn again.
const DRAW_INTERVAL: Duration = Duration::from_millis(100);
/// Longest wait for an acknowledgement in lockstep, in seconds. Ours: a planner that stands in a debugger says so with
/// --lockstep-timeout.
const ACKNOWLEDGE_S_MAX: f64 = 10.0;

/// Replays the files and prints the summary. A file that is not whole, or a signal before the end, is
/// [`Exit::Unreadable`].
///
/// # Errors
/// [`ReplayError`].
pub fn run(options: Options) -> anyhow::Result<Exit> {
    if let (Some(from), Some(to)) = (options.from, options.to)
        && from >= to
    {
        return Err(usage_error(format!("--from {from} --to {to}: the range must end after it begins")));
    }
    block_on(replay_and_print(options, None))
}

/// As [`run`], for a person who looks at the page: prints its address, and opens it with the desktop's browser if
/// `opens` is true. A signal or the key q is the normal end.
///
/// # Errors
/// [`ReplayError`].
pub fn view(options: Options, opens: bool) -> anyhow::Result<Exit> {
    block_on(replay_and_print(options, Some(opens)))
}

/// Prints the address of the page, and opens it.
fn show_page(running: &Running, opens: bool) -> anyhow::Result<()> {
    let Some(page) = running.page.map(|at| format!("http://{at}/")) else { return Ok(()) };
    print_line(&page)?;
    if opens && let Err(error) = Command::new("xdg-open").arg(&page).spawn() {
        tracing::warn!(%error, "xdg-open");
    }
    Ok(())
}

/// `view`: whether to open the page, for [`view`].
async fn replay_and_print(options: Options, view: Option<bool>) -> anyhow::Result<Exit> {
    let (json, serve) = (options.json, options.serve);
    let what = what_is_replayed(&options);
    let mut shown = Ok(());
    let progress = Arc::new(Progress::default());
    let mut bar = None;
    let started = |running: &Running, summary: &Summary| {
        if let Some(description) = describe(&summary.mount) {
            eprintln!("extrinsics {description}");
        }
        log_endpoints(running);
        if let Some(opens) = view {
            shown = show_page(running, opens);
        }
        // Only now: a bar drawn before these lines would stay above them.
        if let Some(replay) = running.replay() {
            keys::follow(replay, tokio::runtime::Handle::current());
        }
        bar = (!json && !serve && std::io::stderr().is_terminal()).then(|| tokio::spawn(draw(progress.clone())));
    };
    let outcome = replay(options, progress.clone(), started, stop_signal()?).await;
    if let Some(bar) = bar {
        bar.abort();
        // The task ends with a cancellation, which is its normal end.
        let _ = bar.await;
    }
    let summary = outcome?;
    shown?;
    for truncated in &summary.truncated {
        eprintln!("warning: {}: {}; the rest was used", truncated.file.display(), truncated.reason);
    }
    for note in &summary.notes {
        eprintln!("note: {note}");
    }
    let is_whole = summary.truncated.is_empty();
    if view.is_some() {
        return Ok(Exit::from_incomplete(!is_whole));
    }
    if json {
        print_line(&format!("{:#}", summary.to_json()))?
    } else {
        print(&summary.to_text())?
    };
    let is_expected = serve || summary.received() == 0 || summary.is_all_refused();
    let has_no_map = summary.reached_end && summary.maps() == 0 && is_expected;
    if has_no_map {
        eprintln!("clearway: the {what} made no map: {}", why_no_map(&summary.mount, &summary.snapshot));
    }
    Ok(Exit::from_incomplete(!is_whole || !summary.reached_end || has_no_map))
}

/// How many bytes of the files a replay has read, for a progress bar.
#[derive(Debug, Default)]
pub struct Progress {
    /// Bytes of all files.
    pub bytes: AtomicU64,
    /// Bytes read so far.
    pub bytes_read: Arc<AtomicU64>,
}

/// Draws the progress bar until the task is aborted, and then clears it.
async fn draw(progress: Arc<Progress>) {
    struct Cleared(ProgressBar);
    impl Drop for Cleared {
        fn drop(&mut self) {
            self.0.finish_and_clear();
        }
    }
    let template = "{bar:40} {bytes}/{total_bytes} {bytes_per_sec} {eta}";
    let style = ProgressStyle::with_template(template).expect("the template is a constant");
    let bar = Cleared(ProgressBar::new(progress.bytes.load(Ordering::Relaxed)).with_style(style));
    loop {
        bar.0.set_position(progress.bytes_read.load(Ordering::Relaxed));
        tokio::time::sleep(DRAW_INTERVAL).await;
    }
}

/// Replays the files to their end. `started` is called with the running server before the first event; with
/// [`Options::serve`] the replay returns only after `stop` has resolved, or with [`Options::exit_at_end`]. It ends
/// early if `stop` resolves. Needs a multi-thread tokio runtime.
///
/// # Errors
/// [`ReplayError`]; nothing is left running.
pub async fn replay(
    options: Options,
    progress: Arc<Progress>,
    started: impl FnOnce(&Running, &Summary),
    stop: impl Future<Output = ()>,
) -> Result<Summary, ReplayError> {
    let (began, what) = (Instant::now(), what_is_replayed(&options));
    options.ready_file.as_deref().map_or(Ok(()), ReadyFile::remove_earlier)?;
    let plan = tokio::task::block_in_place(|| plan(&options))?;
    let Plan { setup, mount, extrinsics, mut timeline, bytes, boot_id, clouds } = plan;
    progress.bytes.store(bytes, Ordering::Relaxed);
    timeline.bytes_read = progress.bytes_read.clone();
    let extent = tokio::task::block_in_place(|| extent(&options, &timeline))?;
    let mut state = initial_state(&options, extent)?;
    state.vehicles = setup.config.vehicles.iter().map(|vehicle| vehicle.name.clone()).collect();
    timeline.faults = faults(&options, extent, &setup.config)?;
    let (handle, input) = ReplayHandle::new(state);
    let setup = Setup { replay: options.serve.then(|| handle.clone()), ..setup };
    let former = Former::keep(&options)?;
    let mut running = match Server::start(setup).await {
        Ok(running) => running,
        Err(error) => {
            former.map_or(Ok(None), |former| former.end(false))?;
            return Err(error.into());
        }
    };
    let running_vehicles = running.vehicles.clone();
    let status = running_vehicles.0[0].status.clone();
    let mut summary = Summary {
        vehicle: status.name.to_string(),
        snapshot: status.snapshot(),
        others: Vec::new(),
        extrinsics,
        mount,
        truncated: Vec::new(),
        notes: Vec::new(),
        clouds: 0,
        seconds: 0.0,
        record: options.record.clone(),
        reached_end: false,
    };
    started(&running, &summary);
    // After that, so that a program that waits for the file finds the addresses in the log too.
    let ready_file = options.ready_file.as_deref().map(|file| ReadyFile::write(file, &running)).transpose();

    // Maps that are as recorded keep their boot id until the first jump.
    let first_boot_id = boot_id.filter(|_| !options.as_live).unwrap_or_else(random);
    let player_options = PlayerOptions {
        is_served: options.serve,
        is_recorded: options.record.is_some(),
        exits_at_end: options.exit_at_end,
        begins_paused: options.paused,
        acknowledge_timeout: Duration::from_secs_f64(options.lockstep_timeout.unwrap_or(ACKNOWLEDGE_S_MAX)),
        boot_id: first_boot_id,
    };
    let stepped = std::mem::take(&mut running.stepped).into_iter().zip(&running.inputs);
    let vehicles: Vec<_> = stepped
        .map(|((engine, events), input)| ReplayedVehicle { engine, events, queue: input.queue.clone() })
        .collect();
    let runtime = tokio::runtime::Handle::current();
    let play = move || Player::new(timeline, vehicles, input, player_options, runtime)?.run();
    let outcome = match &ready_file {
        Err(_) => {
            // With its engines, for which the recorder waits.
            drop(play);
            Ok(Ok(Played::default()))
        }
        Ok(_) => {
            let mut player = tokio::task::spawn_blocking(play);
            tokio::select! {
                played = &mut player => played,
                () = warn_without_map(&handle, what, &summary.mount, &status) => unreachable!("it does not end"),
                () = stop => {
                    handle.stop();
                    player.await
                }
            }
        }
    };
    let ended = running.shutdown().await;
    let outcome = outcome.map_err(|_| ReplayError::Engine).and_then(|played| Ok(played?));
    let received: u64 = running_vehicles.0.iter().map(|served| served.status.snapshot().ledger.received).sum();
    let is_read = |played: &Played| played.reached_end && played.remarks.truncated.is_empty() && received > 0;
    let is_whole = ready_file.is_ok() && ended.is_ok() && outcome.as_ref().is_ok_and(is_read);
    let new = former.map_or(Ok(None), |former| former.end(is_whole));
    ready_file?;
    let played = outcome?;
    ended?;
    if let Some(new) = new? {
        summary.notes.push(format!(
            "the replay is not whole: the file of --record is still the former recording, the new one is {}",
            new.display()
        ));
        summary.record = Some(new);
    }
    summary.reached_end = played.reached_end;
    summary.snapshot = status.snapshot();
    summary.truncated = played.remarks.truncated;
    summary.notes.extend(played.remarks.notes);
    if played.behind_max > BEHIND_MAX {
        let seconds = played.behind_max.as_secs_f64();
        summary.notes.push(format!("this machine was too slow for this speed: maps were up to {seconds:.1} s late"));
    }
    let others = running_vehicles.0.iter().skip(1);
    summary.others = others.map(|served| (served.status.name.to_string(), served.status.snapshot())).collect();
    if let Some(clouds) = clouds {
        summary.clouds = std::mem::replace(&mut *locked(&clouds), Ok(0))?;
        if summary.clouds == 0 {
            summary.notes.push("--clouds wrote no file: it writes revolutions, and the files have none".into());
        }
    }
    summary.seconds = began.elapsed().as_secs_f64();
    Ok(summary)
}

/// What is replayed, for people.
fn what_is_replayed(options: &Options) -> &'static str {
    if options.from.is_some() || options.to.is_some() { "range of --from and --to" } else { "whole drive" }
}

/// Logs why a served drive has made no map, when it has ended: it may be killed there, before its summary. Does not
/// return.
async fn warn_without_map(replay: &ReplayHandle, what: &str, mount: &Mount, status: &VehicleStatus) {
    let has_none =
        |state: &v1::ReplayState| state.phase() == v1::ReplayPhase::Ended && state.maps.iter().all(|maps| *maps == 0);
    if replay.state().wait_for(has_none).await.is_ok() {
        tracing::warn!("the {what} made no map: {}", why_no_map(mount, &status.snapshot()));
    }
    std::future::pending().await
}

/// Recorded time of the first and the last event. Reads the files once if that time matters, and logs then which of
/// them are not whole: a served replay may never come to its summary.
fn extent(options: &Options, timeline: &Timeline) -> Result<Option<(i64, i64)>, ReplayError> {
    let has_range = options.from.is_some() || options.to.is_some();
    let has_fault = !options.faults.is_empty() || options.fault_script.is_some() || options.fault_seed.is_some();
    if options.serve || has_range || has_fault {
        let (extent, Remarks { truncated, .. }) = timeline.extent()?;
        for Truncated { file, reason } in &truncated {
            tracing::warn!(file = %file.display(), "not whole: {reason}; the rest is used");
        }
        let why = || truncated.iter().map(|of| format!("; {}: {}", of.file.display(), of.reason)).collect();
        return Ok(Some(extent.ok_or_else(|| ReplayError::Empty { truncated: why() })?));
    }
    Ok(None)
}

/// The faults of the options, of the script, or of the seed alone.
fn faults(options: &Options, extent: Option<(i64, i64)>, config: &Config) -> Result<Faults, ReplayError> {
    let mut all = options.faults.clone();
    if let Some(file) = &options.fault_script {
        let text = std::fs::read_to_string(file);
        let text = text.map_err(|source| ReplayError::FaultScript { file: file.clone(), source })?;
        let lines = text.lines().map(|line| line.split('#').next().unwrap_or_default().trim());
        for (number, line) in lines.enumerate().filter(|(_, line)| !line.is_empty()) {
            let wrong = |source| ReplayError::FaultLine { file: file.clone(), line: number + 1, source };
            all.push(line.parse().map_err(wrong)?);
        }
    }
    let names = |vehicle: &Vehicle| vehicle.sensors.iter().map(|sensor| sensor.name.clone()).collect();
    let sensors: Vec<Vec<String>> = config.vehicles.iter().map(names).collect();
    // Known if there is a fault.
    let length_s = extent.map_or(0.0, |(begin, end)| end.saturating_sub(begin) as f64 * 1e-9);
    if let (Some(seed), true) = (options.fault_seed, all.is_empty()) {
        all = Faults::random(seed, length_s, &sensors);
    }
    Ok(Faults::new(all, options.fault_seed.unwrap_or(0), length_s, sensors)?)
}

/// How the replay begins; `extent` is the recorded time of its events, if it is known.
fn initial_state(options: &Options, extent: Option<(i64, i64)>) -> Result<v1::ReplayState, ReplayError> {
    let (begin_ns, end_ns) = extent.unwrap_or((i64::MIN, i64::MAX));
    let default_speed = if options.serve && !options.lockstep { Speed::Times(1.0) } else { Speed::Max };
    let phase = match (options.wait_readers, options.paused) {
        (Some(1..), _) => v1::ReplayPhase::Waiting,
        (_, true) => v1::ReplayPhase::Paused,
        (_, false) => v1::ReplayPhase::Playing,
    };
    let mut state = v1::ReplayState {
        phase: phase.into(),
        begin_ns,
        end_ns,
        from_ns: begin_ns,
        to_ns: end_ns,
        position_ns: begin_ns,
        rate: options.speed.unwrap_or(default_speed).rate(),
        repeat: options.r#loop,
        lockstep: options.lockstep,
        as_live: options.as_live,
        jumps: 0,
        vehicles: Vec::new(),
        readers_awaited: options.wait_readers.unwrap_or(0),
        awaited: String::new(),
        maps: Vec::new(),
    };
    // Saturates: what lies outside the files is refused.
    let at = |seconds: f64| begin_ns.saturating_add((seconds * 1e9) as i64);
    let range = v1::ReplayControl { from_ns: options.from.map(at), to_ns: options.to.map(at), ..Default::default() };
    if range.from_ns.is_some() || range.to_ns.is_some() {
        (state.from_ns, state.to_ns) = check(&range, &state, false)?;
    }
    if let Some(seconds) = options.seek {
        let seek = v1::ReplayControl { seek_ns: Some(at(seconds)), ..Default::default() };
        // `view --from`, which is the only one that seeks at the start.
        check(&seek, &state, false).map_err(|error| match error {
            ControlError::Outside { at_s, from_s, to_s, .. } => {
                ControlError::Outside { what: "from", at_s, from_s, to_s }
            }
            other => other,
        })?;
        state.position_ns = at(seconds);
    }
    Ok(state)
}
