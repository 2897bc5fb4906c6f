//! Recorded drives -> maps, through the same event queue, engine, recorder and publishers as live data, with the stamps
//! of the recording. The same files always make the same maps.
//!
//! | file | in -> out |
//! |---|---|
//! | [`options`] | what a replay does |
//! | `plan` | options, files -> configuration, mount, readings |
//! | `overrides` | configuration, keys of the command line -> configuration, calibration tables |
//! | [`files`] | captures, MCAP files, scans -> readings |
//! | [`topics`] | topics of a ROS 2 bag -> the topics to decode |
//! | `bag` | these topics -> sensors and their mounts |
//! | [`player`] | readings -> engines that are stepped in recorded time, and set back |
//! | `recordings` | files -> recordings of several vehicles; sensors that do not fit |
//! | `ready_file` | the running server -> the file that tells programs its addresses |
//! | [`summary`] | the state at the end -> text, JSON |
//! | [`error`] | why a replay fails |
//!
//! A capture rarely contains how its sensor was mounted. Without extrinsics, a first pass over the first revolutions
//! estimates height, pitch and roll from the ground around the vehicle; the estimate is printed and recorded. If there
//! is no ground to estimate from, the files are decoded and no map is made, and the summary says so.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

use clearway_daemon::config::{Config, Vehicle};
use clearway_daemon::replay_control::{ControlError, ReplayHandle, ReplayInput, check};
use clearway_daemon::run::{Running, Server, Setup, random};
use clearway_daemon::status::VehicleStatus;
use clearway_proto::v1;

use crate::files::Truncated;
use crate::player::faults::Faults;
use crate::player::outcome::Played;
use crate::player::play::{BEHIND_MAX, Player, PlayerOptions};
use crate::player::timeline::{Remarks, Timeline};
use crate::player::vehicle::ReplayedVehicle;

mod bag;
pub mod error;
pub mod files;
pub mod options;
mod overrides;
mod plan;
pub mod player;
mod ready_file;
mod recordings;
pub mod summary;
pub mod topics;

pub use error::ReplayError;
pub use options::{ReplayOptions, ReplaySpeed, ServedReplay};
use plan::{ReplayPlan, plan};
use ready_file::ReadyFile;
use summary::why_no_map;
pub use summary::{Mount, ReplaySummary, describe};

/// Bytes of the files of a replay, for a progress bar.
#[derive(Clone, Debug, Default)]
pub struct ReplayProgress {
    /// Bytes of all files.
    pub bytes: u64,
    /// Bytes read so far.
    pub bytes_read: Arc<AtomicU64>,
}

/// A replay whose server runs, before its first event.
pub struct ReplayRun {
    /// The server that publishes the replayed maps.
    pub running: Running,
    /// How far the files are read.
    pub progress: ReplayProgress,
    began: Instant,
    summary: ReplaySummary,
    status: Arc<VehicleStatus>,
    timeline: Timeline,
    handle: ReplayHandle,
    input: ReplayInput,
    options: PlayerOptions,
    ready_file: Option<ReadyFile>,
}

/// Replays the files to their end. Needs a multi-thread tokio runtime.
///
/// # Errors
/// [`ReplayError`]; nothing is left running.
pub async fn replay(options: ReplayOptions) -> Result<ReplaySummary, ReplayError> {
    ReplayRun::start(options).await?.play(std::future::pending()).await
}

impl ReplayRun {
    /// Reads what is known before the first event, and starts the server. Needs a multi-thread tokio runtime.
    ///
    /// # Errors
    /// [`ReplayError`]; nothing is left running.
    pub async fn start(options: ReplayOptions) -> Result<Self, ReplayError> {
        let began = Instant::now();
        let served = options.served.as_ref();
        let ready_file = served.and_then(|served| served.ready_file.as_deref());
        ready_file.map_or(Ok(()), ReadyFile::prepare)?;
        let ReplayPlan { setup, mount, extrinsics, mut timeline, bytes } =
            tokio::task::block_in_place(|| plan(&options))?;
        let extent = tokio::task::block_in_place(|| extent(&options, &timeline))?;
        let mut state = initial_state(&options, extent)?;
        state.vehicles = setup.config.vehicles.iter().map(|vehicle| vehicle.name.clone()).collect();
        timeline.faults = faults(&options, extent, &setup.config)?;
        // Maps that are as recorded keep their boot id until the first jump.
        let recorded_boot_id = setup.boot_id.filter(|_| served.is_none_or(|served| !served.as_live));
        let player_options = PlayerOptions {
            is_served: served.is_some(),
            is_recorded: options.record.is_some(),
            exits_at_end: served.is_some_and(|served| served.exits_at_end),
            begins_paused: served.is_some_and(|served| served.paused),
            acknowledge_timeout: served.and_then(|served| served.lockstep).unwrap_or(ACKNOWLEDGE_TIMEOUT),
            boot_id: recorded_boot_id.unwrap_or_else(random),
        };
        let (handle, input) = ReplayHandle::new(state);
        let running = Server::start(Setup { replay: served.map(|_| handle.clone()), ..setup }).await?;
        running.log_endpoints();
        // After the log, so that a program that waits for the file finds the addresses there too.
        let ready_file = match ready_file.map(|file| ReadyFile::write(file, &running)).transpose() {
            Ok(ready_file) => ready_file,
            Err(error) => {
                running.shutdown().await?;
                return Err(error);
            }
        };
        let status = running.vehicles.0[0].status.clone();
        let is_range = options.from_s.is_some() || options.to_s.is_some();
        let summary = ReplaySummary {
            vehicle: status.name.to_string(),
            snapshot: status.snapshot(),
            others: Vec::new(),
            extrinsics,
            mount,
            truncated: Vec::new(),
            notes: Vec::new(),
            seconds: 0.0,
            record: options.record,
            what: if is_range { "range of --from and --to" } else { "whole drive" },
            reached_end: false,
        };
        let progress = ReplayProgress { bytes, bytes_read: timeline.bytes_read.clone() };
        let options = player_options;
        Ok(Self { running, progress, began, summary, status, timeline, handle, input, options, ready_file })
    }

    /// Mount of the first sensor.
    pub fn mount(&self) -> &Mount {
        &self.summary.mount
    }

    /// Returns a handle that pauses, seeks and stops the replay.
    pub fn handle(&self) -> ReplayHandle {
        self.handle.clone()
    }

    /// Replays the files to their end. A served replay returns only after `stop` has resolved, unless it exits at its
    /// end. Every replay ends early if `stop` resolves.
    ///
    /// # Errors
    /// [`ReplayError`]; nothing is left running.
    pub async fn play(self, stop: impl Future<Output = ()>) -> Result<ReplaySummary, ReplayError> {
        let Self { mut running, began, mut summary, status, timeline, handle, input, options, ready_file, .. } = self;
        let stepped = std::mem::take(&mut running.stepped).into_iter().zip(&running.inputs);
        let vehicles: Vec<_> = stepped
            .map(|((engine, events), input)| ReplayedVehicle { engine, events, queue: input.queue.clone() })
            .collect();
        let runtime = tokio::runtime::Handle::current();
        let play = move || Player::new(timeline, vehicles, input, options, runtime)?.run();
        let mut player = tokio::task::spawn_blocking(play);
        let outcome = tokio::select! {
            played = &mut player => played,
            () = warn_without_map(&handle, &summary, &status) => unreachable!("it does not end"),
            () = stop => {
                handle.stop();
                player.await
            }
        };
        drop(ready_file);
        let served = running.vehicles.clone();
        let ended = running.shutdown().await;
        let Played { reached_end, behind_max, remarks } = outcome.map_err(|_| ReplayError::Player)??;
        ended?;
        summary.reached_end = reached_end;
        summary.snapshot = status.snapshot();
        summary.truncated = remarks.truncated;
        summary.notes = remarks.notes;
        if behind_max > BEHIND_MAX {
            let seconds = behind_max.as_secs_f64();
            let note = format!("this machine was too slow for this speed: maps were up to {seconds:.1} s late");
            summary.notes.push(note);
        }
        let others = served.0.iter().skip(1);
        summary.others = others.map(|served| (served.status.name.to_string(), served.status.snapshot())).collect();
        summary.seconds = began.elapsed().as_secs_f64();
        Ok(summary)
    }
}

/// Longest wait for an acknowledgement if lockstep begins on request. Ours: a planner that stands in a debugger needs
/// more, and `--lockstep=SECONDS` gives it.
pub const ACKNOWLEDGE_TIMEOUT: Duration = Duration::from_secs(10);

/// Logs why a served drive has made no map, when it has ended: it may be killed there, before its summary. Does not
/// return.
async fn warn_without_map(replay: &ReplayHandle, summary: &ReplaySummary, status: &VehicleStatus) {
    let has_none =
        |state: &v1::ReplayState| state.phase() == v1::ReplayPhase::Ended && state.maps.iter().all(|maps| *maps == 0);
    if replay.state().wait_for(has_none).await.is_ok() {
        tracing::warn!("the {} made no map: {}", summary.what, why_no_map(&summary.mount, &status.snapshot()));
    }
    std::future::pending().await
}

/// Recorded time of the first and the last event. Reads the files once if that time matters, and logs then which of
/// them are not whole: a served replay may never come to its summary.
fn extent(options: &ReplayOptions, timeline: &Timeline) -> Result<Option<(i64, i64)>, ReplayError> {
    let has_range = options.from_s.is_some() || options.to_s.is_some();
    if options.served.is_none() && !has_range && options.faults.is_empty() {
        return Ok(None);
    }
    let (extent, Remarks { truncated, .. }) = timeline.extent()?;
    for Truncated { file, reason } in &truncated {
        tracing::warn!(file = %file.display(), "not whole: {reason}; the rest is used");
    }
    let why = || truncated.iter().map(|of| format!("; {}: {}", of.file.display(), of.reason)).collect();
    Ok(Some(extent.ok_or_else(|| ReplayError::Empty { truncated: why() })?))
}

/// The faults of the options, for the sensors of the configuration.
fn faults(options: &ReplayOptions, extent: Option<(i64, i64)>, config: &Config) -> Result<Faults, ReplayError> {
    let names = |vehicle: &Vehicle| vehicle.sensors.iter().map(|sensor| sensor.name.clone()).collect();
    let sensors: Vec<Vec<String>> = config.vehicles.iter().map(names).collect();
    // Known if there is a fault.
    let length_s = extent.map_or(0.0, |(begin, end)| end.saturating_sub(begin) as f64 * 1e-9);
    Ok(Faults::new(options.faults.clone(), length_s, sensors)?)
}

/// How the replay begins; `extent` is the recorded time of its events, if it is known.
fn initial_state(options: &ReplayOptions, extent: Option<(i64, i64)>) -> Result<v1::ReplayState, ReplayError> {
    let (begin_ns, end_ns) = extent.unwrap_or((i64::MIN, i64::MAX));
    let served = options.served.clone().unwrap_or_default();
    let lockstep = served.lockstep.is_some();
    let is_watched = options.served.is_some() && !lockstep;
    let default_speed = if is_watched { ReplaySpeed::Times(1.0) } else { ReplaySpeed::Max };
    let phase = match (served.wait_readers, served.paused) {
        (1.., _) => v1::ReplayPhase::Waiting,
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
        repeat: served.repeat,
        lockstep,
        as_live: served.as_live,
        readers_awaited: served.wait_readers,
        ..Default::default()
    };
    // Saturates: what lies outside the files is refused.
    let at = |seconds: f64| begin_ns.saturating_add((seconds * 1e9) as i64);
    let (from_ns, to_ns) = (options.from_s.map(at), options.to_s.map(at));
    if from_ns.is_some() || to_ns.is_some() {
        let range = v1::ReplayControl { from_ns, to_ns, ..Default::default() };
        (state.from_ns, state.to_ns) = check(&range, &state, false)?;
    }
    if let Some(seconds) = served.seek_s {
        let seek = v1::ReplayControl { seek_ns: Some(at(seconds)), ..Default::default() };
        // `view --from`, which is the only option that seeks at the start.
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
