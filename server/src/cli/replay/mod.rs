//! `clearway replay`: recorded drives -> maps, through the same event queue, engine, recorder and publishers as live
//! data, with the stamps of the recording. The same files always make the same maps.
//!
//! | file | in -> out |
//! |---|---|
//! | [`options`] | the command line -> [`Options`] |
//! | `plan` | options, files -> configuration, mount, readings |
//! | [`clouds`] | revolutions -> PCD files |
//! | [`summary`] | the state at the end -> text, JSON |
//!
//! A capture rarely contains how its sensor was mounted. Without extrinsics, a first pass over the first revolutions
//! estimates height, pitch and roll from the ground around the vehicle; the estimate is printed and recorded. If there
//! is no ground to estimate from, the files are decoded and no map is made, and the summary says so.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::exit::Exit;
use super::output::{block_on, print, print_line, stop_signal};
use super::serve::log_endpoints;
use crate::ingest::files::Readings;
use crate::ingest::queue::EventQueue;
use crate::server::{Running, Server};
use crate::sync::locked;

pub mod clouds;
pub mod options;
mod plan;
pub mod summary;

pub use options::{Options, ReplayError, Speed};
use plan::{Plan, plan};
pub use summary::{Mount, Summary, describe};

/// Interval at which the progress bar is drawn again.
const DRAW_INTERVAL: Duration = Duration::from_millis(100);

/// Replays the files and prints the summary. A file that is not whole is [`Exit::Unreadable`].
///
/// # Errors
/// [`ReplayError`].
pub fn run(options: Options) -> anyhow::Result<Exit> {
    block_on(replay_and_print(options))
}

async fn replay_and_print(options: Options) -> anyhow::Result<Exit> {
    let json = options.json;
    let progress = Arc::new(Progress::default());
    let mut bar = None;
    let started = |running: &Running, summary: &Summary| {
        if let Some(description) = describe(&summary.mount) {
            eprintln!("extrinsics {description}");
        }
        log_endpoints(running);
        // Only now: a bar drawn before these lines would stay above them.
        bar = (!json && std::io::stderr().is_terminal()).then(|| tokio::spawn(draw(progress.clone())));
    };
    let outcome = replay(options, progress.clone(), started, stop_signal()?).await;
    if let Some(bar) = bar {
        bar.abort();
        // The task ends with a cancellation, which is its normal end.
        let _ = bar.await;
    }
    let summary = outcome?;
    for truncated in &summary.truncated {
        eprintln!("warning: {}: {}; the rest was used", truncated.file.display(), truncated.reason);
    }
    for note in &summary.notes {
        eprintln!("note: {note}");
    }
    if json {
        print_line(&format!("{:#}", summary.to_json()))?
    } else {
        print(&summary.to_text())?
    };
    Ok(Exit::from_incomplete(!summary.truncated.is_empty()))
}

/// How many bytes of the files a replay has read, for a progress bar.
#[derive(Debug, Default)]
pub struct Progress {
    /// Bytes of all files.
    pub bytes: AtomicU64,
    /// Bytes read so far.
    pub bytes_read: AtomicU64,
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
/// [`Options::serve`] the replay returns only after `stop` has resolved. Needs a multi-thread tokio runtime.
///
/// # Errors
/// [`ReplayError`]; nothing is left running.
pub async fn replay(
    options: Options,
    progress: Arc<Progress>,
    started: impl FnOnce(&Running, &Summary),
    stop: impl Future<Output = ()>,
) -> Result<Summary, ReplayError> {
    let began = Instant::now();
    let plan = tokio::task::block_in_place(|| plan(&options))?;
    let Plan { setup, mount, extrinsics, readings, clouds } = plan;
    progress.bytes.store(readings.bytes(), Ordering::Relaxed);
    let running = Server::start(setup).await?;
    let mut summary = Summary {
        snapshot: running.vehicles.0[0].status.snapshot(),
        extrinsics,
        mount,
        truncated: Vec::new(),
        notes: Vec::new(),
        clouds: 0,
        seconds: 0.0,
        record: options.record.clone(),
    };
    started(&running, &summary);

    let speed = options.speed.unwrap_or(if options.serve { Speed::Times(1.0) } else { Speed::Max });
    let queue = running.inputs[0].queue.clone();
    let read = tokio::task::spawn_blocking(move || feed(readings, &queue, speed, &progress)).await;
    let status = running.vehicles.0[0].status.clone();
    let outcome = match read {
        Ok(outcome) => outcome,
        Err(_) => Err(ReplayError::Engine),
    };
    if options.serve && outcome.is_ok() {
        stop.await;
    }
    let ended = running.shutdown().await;
    let readings = outcome?;
    ended?;
    summary.snapshot = status.snapshot();
    summary.truncated = readings.truncated().to_vec();
    summary.notes = readings.notes().to_vec();
    if let Some(clouds) = clouds {
        summary.clouds = std::mem::replace(&mut *locked(&clouds), Ok(0))?;
        if summary.clouds == 0 {
            summary.notes.push("--clouds wrote no file: it writes revolutions, and the files have none".into());
        }
    }
    summary.seconds = began.elapsed().as_secs_f64();
    Ok(summary)
}

/// Pushes every reading to the event queue, at its time if the speed is not [`Speed::Max`].
fn feed(
    mut readings: Readings,
    queue: &EventQueue,
    speed: Speed,
    progress: &Progress,
) -> Result<Readings, ReplayError> {
    let began = Instant::now();
    let (mut first_ns, mut newest_ns) = (None, None);
    while let Some(reading) = readings.next() {
        let reading = reading?;
        if let Speed::Times(times) = speed {
            let passed_ns = reading.arrival_ns.saturating_sub(*first_ns.get_or_insert(reading.arrival_ns));
            let due = Duration::try_from_secs_f64(passed_ns.max(0) as f64 * 1e-9 / times).unwrap_or(Duration::MAX);
            std::thread::sleep(due.saturating_sub(began.elapsed()));
        }
        progress.bytes_read.store(readings.bytes_read(), Ordering::Relaxed);
        leave_refused(&mut readings, queue);
        newest_ns = Some(reading.arrival_ns);
        queue.push_captured(reading).map_err(|_| ReplayError::Engine)?;
    }
    leave_refused(&mut readings, queue);
    queue.report_drops(newest_ns).map_err(|_| ReplayError::Engine)?;
    Ok(readings)
}

/// Reports the messages that the files' readers have refused to the drop counters.
fn leave_refused(readings: &mut Readings, queue: &EventQueue) {
    for ((source, reason), count) in readings.drain_refused() {
        queue.drops().record_refused_messages(source, reason, count);
    }
}
