//! Files -> maps, through the same door, engine, recorder and publishers as live data, with the capture's own stamps:
//! the same files always make the same maps.
//!
//! A capture rarely says how its sensor was mounted. Without extrinsics a first pass over the first revolutions finds
//! height, pitch and roll from the ground around the vehicle; the figures are said, and recorded. Where there is no
//! ground to find, nothing is guessed: the files are decoded and no map is made, and that is said too.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clearway_lidar::model::Model;
use clearway_mapping::config::Extrinsics;

use crate::cli::replay::clouds::CloudError;
use crate::config::ConfigError;
use crate::ingest::files::{FilesError, Readings};
use crate::ingest::queue::EventQueue;
use crate::sync::locked;
use crate::record::reader::RecordingError;
use crate::server::{ShutdownError, Running, Server, StartError};

pub mod clouds;
mod plan;
mod summary;

use plan::{Plan, plan};
pub use summary::{Mount, Summary, describe};

/// How fast a capture's time passes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// So many times as fast as recorded.
    Times(f64),
    /// As fast as the machine can.
    Max,
}

impl std::str::FromStr for Speed {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "as-recorded" => Ok(Self::Times(1.0)),
            "max" => Ok(Self::Max),
            factor => match factor.parse() {
                Ok(times) if times > 0.0 && f64::is_finite(times) => Ok(Self::Times(times)),
                _ => Err("as-recorded, max, or a factor above 0 is allowed".into()),
            },
        }
    }
}

/// What to replay, and how.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Files and folders, in order.
    pub files: Vec<PathBuf>,
    /// Recording to write.
    pub record: Option<PathBuf>,
    /// Pace; as fast as possible where absent, as recorded while serving.
    pub speed: Option<Speed>,
    /// Folder for a PCD a revolution.
    pub clouds: Option<PathBuf>,
    /// The sensor's own table.
    pub calibration: Option<PathBuf>,
    /// How the sensor is mounted; estimated where neither this nor the configuration says it.
    pub extrinsics: Option<Extrinsics>,
    /// The sensor's model; found from the data where absent.
    pub model: Option<Model>,
    /// ROS topics of an MCAP file; chosen where none is named.
    pub topics: Vec<String>,
    /// Its turning rate; found from the data where absent.
    pub rpm: Option<f32>,
    /// Configuration whose vehicle and publishers are used.
    pub config: Option<PathBuf>,
    /// Overrides of the configuration.
    pub set: Vec<String>,
    /// Publish the maps, and go on serving the last one.
    pub serve: bool,
    /// Whose journal is replayed out of a recording of several vehicles; whose configuration is used.
    pub vehicle: Option<String>,
}

/// Why a replay did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// A file cannot be read.
    #[error(transparent)]
    Files(#[from] FilesError),
    /// A recording cannot be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// No vehicle of that name is configured.
    #[error("--vehicle {name}: the configuration has: {known}")]
    Vehicle {
        /// As it was given.
        name: String,
        /// What there is.
        known: String,
    },
    /// The point clouds cannot be written.
    #[error(transparent)]
    Clouds(#[from] CloudError),
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not end as it should have.
    #[error(transparent)]
    End(#[from] ShutdownError),
    /// The engine stopped in the middle.
    #[error("the vehicle's engine has stopped")]
    Engine,
}

/// How far a replay has come, for a progress bar.
#[derive(Debug, Default)]
pub struct Progress {
    /// Bytes of all files.
    pub bytes: AtomicU64,
    /// Bytes read.
    pub bytes_read: AtomicU64,
}

/// Replays the files to their end; `started` sees the running server, and with [`Options::serve`] the replay returns
/// only after `stop` has resolved. Needs a multi-thread tokio runtime.
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
    let door = running.inputs[0].queue.clone();
    let read = tokio::task::spawn_blocking(move || feed(readings, &door, speed, &progress)).await;
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
    }
    summary.seconds = began.elapsed().as_secs_f64();
    Ok(summary)
}

/// Puts every reading through the door at its time.
fn feed(mut readings: Readings, door: &EventQueue, speed: Speed, progress: &Progress) -> Result<Readings, ReplayError> {
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
        leave_refused(&mut readings, door);
        newest_ns = Some(reading.arrival_ns);
        door.push_captured(reading).map_err(|_| ReplayError::Engine)?;
    }
    leave_refused(&mut readings, door);
    door.report_drops(newest_ns).map_err(|_| ReplayError::Engine)?;
    Ok(readings)
}

/// Leaves the messages that were refused outside the door, which counts and tells them.
fn leave_refused(readings: &mut Readings, door: &EventQueue) {
    for ((source, reason), count) in readings.drain_refused() {
        door.drops().record_refused_messages(source, reason, count);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speed_is_a_word_or_a_factor_above_nothing() {
        assert_eq!("as-recorded".parse(), Ok(Speed::Times(1.0)));
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("2.5".parse(), Ok(Speed::Times(2.5)));
        for wrong in ["0", "-1", "inf", "NaN", "fast"] {
            assert!(wrong.parse::<Speed>().unwrap_err().contains("as-recorded, max"), "{wrong}");
        }
    }
}
