//! Files -> maps, through the same door, engine, recorder and publishers as live data, with the capture's own stamps: the
//! same files always make the same maps.
//!
//! A capture rarely says how its sensor was mounted. Without extrinsics a first pass over the first revolutions finds
//! height, pitch and roll from the ground around the vehicle; the figures are said, and recorded.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::sensor::{Sensor, SensorConfig as LidarConfig};
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_mapping::event::{Body, Scan};
use clearway_mapping::mount::{MountError, MountEstimate, estimate};
use serde_json::{Value, json};

use crate::clouds::{CloudError, Clouds};
use crate::config::{Config, ConfigError, Recorder};
use crate::ingest::files::{FilesError, Kind, Readings, Truncated};
use crate::ingest::{Door, locked};
use crate::recording::{Recording, RecordingError};
use crate::server::{EndError, Running, Server, Setup, StartError};
use crate::status::Snapshot;

/// Revolutions the mount is estimated from.
const MOUNT_REVOLUTIONS: usize = 10;

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
    /// The mount is not known, and cannot be found.
    #[error(
        "the files do not say how the sensor is mounted, and its mount cannot be estimated: {source}; give it with \
         --extrinsics x,y,z,roll,pitch,yaw (metres and degrees, such as 0,0,1.9,0,0,0), or with --config FILE"
    )]
    Mount {
        /// Why not.
        source: MountError,
    },
    /// The point clouds cannot be written.
    #[error(transparent)]
    Clouds(#[from] CloudError),
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not end as it should have.
    #[error(transparent)]
    End(#[from] EndError),
    /// The engine stopped in the middle.
    #[error("the vehicle's engine has stopped")]
    Engine,
}

/// Where the mount came from.
#[derive(Clone, Debug, PartialEq)]
pub enum Mount {
    /// Options, configuration or recording.
    Given,
    /// The ground in the first revolutions.
    Estimated(MountEstimate),
    /// Nowhere: the files hold no revolution.
    Unneeded,
}

/// What came of a replay.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Ledger, sensors, maps, latency.
    pub snapshot: Snapshot,
    /// The extrinsics used.
    pub extrinsics: Extrinsics,
    /// Where they came from.
    pub mount: Mount,
    /// Files that ended in the middle of something.
    pub truncated: Vec<Truncated>,
    /// What else is worth knowing.
    pub notes: Vec<String>,
    /// Point clouds written.
    pub clouds: u64,
    /// Wall time.
    pub seconds: f64,
    /// The recording written.
    pub record: Option<PathBuf>,
}

impl Summary {
    /// One object with all of it.
    pub fn to_json(&self) -> Value {
        let Snapshot { ledger, sensors, .. } = &self.snapshot;
        let sensors = sensors.iter().map(|sensor| {
            let model = sensor.status.model.map(clearway_mapping::pipeline::model_name);
            json!({
                "name": sensor.name, "model": model, "returns": sensor.status.returns, "rpm": sensor.status.rpm,
                "revolutions": sensor.status.revolutions,
            })
        });
        let e = &self.extrinsics;
        let mut mount = json!({
            "source": match self.mount {
                Mount::Given => "given",
                Mount::Estimated(_) => "estimated",
                Mount::Unneeded => "none",
            },
            "x_m": e.x_m, "y_m": e.y_m, "z_m": e.z_m,
            "roll_deg": e.roll_deg, "pitch_deg": e.pitch_deg, "yaw_deg": e.yaw_deg,
        });
        if let Mount::Estimated(estimate) = &self.mount {
            mount["revolutions"] = estimate.revolutions.into();
            mount["residual_m"] = estimate.residual_m.into();
            mount["inliers"] = estimate.inliers.into();
            mount["samples"] = estimate.samples.into();
        }
        let truncated = self.truncated.iter().map(|t| json!({ "file": t.file, "reason": t.reason }));
        json!({
            "packets": { "received": ledger.received, "decoded": ledger.decoded, "refused": ledger.refused },
            "telemetry": ledger.telemetry,
            "lost": ledger.lost,
            "revolutions": self.snapshot.revolutions(),
            "maps": self.snapshot.maps,
            "sensors": sensors.collect::<Vec<_>>(),
            "latency_ms": { "p50": self.snapshot.latency_ms_p50, "p99": self.snapshot.latency_ms_p99 },
            "drivable_share": self.snapshot.drivable_share,
            "mount": mount,
            "truncated": truncated.collect::<Vec<_>>(),
            "notes": self.notes,
            "clouds": self.clouds,
            "record": self.record,
            "seconds": self.seconds,
        })
    }
}

/// How far a replay has come, for a progress bar.
#[derive(Debug, Default)]
pub struct Progress {
    /// Bytes of all files.
    pub bytes: AtomicU64,
    /// Bytes read.
    pub bytes_read: AtomicU64,
}

/// Replays the files to their end; `started` sees the running server, and with [`Options::serve`] the replay returns only
/// after `stop` has resolved. Needs a multi-thread tokio runtime.
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
    let door = running.doors[0].door.clone();
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

/// Everything known before the first event.
struct Plan {
    setup: Setup,
    mount: Mount,
    extrinsics: Extrinsics,
    readings: Readings,
    /// How many clouds were written, or why no more.
    clouds: Option<Arc<Mutex<Result<u64, CloudError>>>>,
}

fn plan(options: &Options) -> Result<Plan, ReplayError> {
    let open = || Readings::open(&options.files, options.vehicle.as_deref());
    let readings = open()?;
    let recorded = readings.files().find(|(_, kind)| *kind == Kind::Mcap).map(|(file, _)| file.to_owned());
    let scans = readings.files().all(|(_, kind)| kind == Kind::Scan);
    let (mut config, mut tables, boot_id, given) = configured(options, recorded.as_deref())?;
    let vehicle = &mut config.vehicles[0];
    vehicle.udp = None;
    let sensor = &mut vehicle.sensors[0];
    sensor.model = options.model.or(sensor.model);
    // Scans do not tell who made them, and KITTI's were made by this one.
    if scans && sensor.model.is_none() && tables[0][0].is_none() {
        sensor.model = Some(Model::Hdl64eS2);
    }
    sensor.rpm = options.rpm.or(sensor.rpm);
    if let Some(file) = &options.calibration {
        sensor.calibration = Some(file.display().to_string());
        tables = config.calibrations(Path::new(""))?;
    }
    let sensor = &mut config.vehicles[0].sensors[0];
    let mut remarks = Vec::new();
    let mount = match options.extrinsics {
        Some(extrinsics) => {
            sensor.extrinsics = extrinsics;
            Mount::Given
        }
        None if given => Mount::Given,
        None => {
            let revolutions = first_revolutions(open()?, sensor, tables[0][0].clone())?;
            if revolutions.is_empty() {
                Mount::Unneeded
            } else {
                let estimate = estimate(&revolutions).map_err(|source| ReplayError::Mount { source })?;
                sensor.extrinsics = estimate.extrinsics();
                remarks.push(format!("extrinsics of {}: {}", sensor.name, describe(&estimate)));
                Mount::Estimated(estimate)
            }
        }
    };
    let extrinsics = sensor.extrinsics;
    config.recorder.file = options.record.clone().unwrap_or_default();
    if !options.serve {
        (config.grpc.enabled, config.page.enabled, config.zenoh.enabled) = (false, false, false);
    }
    config.check(options.config.as_deref().unwrap_or(Path::new("(replay)")))?;
    // The same files and settings name the same run; served maps need a name of their own, or a reader that saw them
    // before would take them for old ones.
    let boot_id = boot_id.or_else(|| (!options.serve).then(|| fingerprint(&config, &options.files)));
    let mut notes = std::collections::BTreeMap::new();
    if let Some(remark) = remarks.first() {
        notes.insert("mount".to_owned(), remark.clone());
    }
    let clouds = options.clouds.as_deref().map(Clouds::create).transpose()?;
    let (observer, clouds) = clouds.map(Clouds::observer).unzip();
    let setup = Setup { config, calibrations: tables, boot_id, from_files: true, remarks, notes, observer };
    Ok(Plan { setup, mount, extrinsics, readings, clouds })
}

type Configured = (Config, Vec<Vec<Option<Calibration>>>, Option<u64>, bool);

/// The configuration, the calibration tables, the boot id to keep, and whether the extrinsics are known: from `--config`,
/// else from the recording itself, else plain.
fn configured(options: &Options, recorded: Option<&Path>) -> Result<Configured, ReplayError> {
    let pick = |config: &mut Config, tables: &mut Vec<Vec<Option<Calibration>>>| {
        let index = match &options.vehicle {
            None => 0,
            Some(name) => config.vehicles.iter().position(|v| v.name == *name).ok_or_else(|| ReplayError::Vehicle {
                name: name.clone(),
                known: config.vehicles.iter().map(|v| v.name.as_str()).collect::<Vec<_>>().join(", "),
            })?,
        };
        config.vehicles = vec![config.vehicles.swap_remove(index)];
        *tables = vec![tables.swap_remove(index)];
        Ok::<_, ReplayError>(())
    };
    if let Some(file) = &options.config {
        let mut config = Config::load(file, &options.set)?;
        let mut tables = config.calibrations(file)?;
        pick(&mut config, &mut tables)?;
        return Ok((config, tables, None, true));
    }
    if let Some(file) = recorded {
        let recording = Recording::open(file)?;
        if recording.preface().config.is_some() {
            let (mut config, mut tables) = recording.config()?;
            pick(&mut config, &mut tables)?;
            // What the recording says of its own publishers and files is not for this run.
            let config = Config { vehicles: config.vehicles, ..Config::default() };
            return Ok((config, tables, Some(recording.preface().boot_id), true));
        }
    }
    Ok((Config::of_one_vehicle("car", "top"), vec![vec![None]], None, false))
}

/// The points of the first revolutions (or scans), sensor frame, metres.
fn first_revolutions(
    readings: Readings,
    config: &SensorConfig,
    calibration: Option<Calibration>,
) -> Result<Vec<Vec<[f32; 3]>>, ReplayError> {
    let mut sensor = Sensor::new(LidarConfig {
        model: config.model,
        rpm: config.rpm,
        calibration,
        cut_azimuth_deg: config.cut_azimuth_deg,
    });
    let mut clouds = Vec::new();
    for reading in readings {
        let reading = reading?;
        match &reading.body {
            // What is refused is counted and named on the real pass.
            Body::Datagram(payload) => {
                if let Ok(Some(revolution)) = sensor.push(payload, reading.arrival_ns) {
                    clouds.push(points_of(revolution));
                }
            }
            Body::Scan(scan) => clouds.push(points_of_scan(scan)),
            Body::End => clouds.extend(sensor.finish().map(points_of)),
            Body::EgoPose(_) | Body::Lost(_) => {}
        }
        if clouds.len() >= MOUNT_REVOLUTIONS {
            break;
        }
    }
    Ok(clouds)
}

fn points_of(revolution: &Revolution) -> Vec<[f32; 3]> {
    let echo = revolution.echoes.first();
    let returned = |echo: &clearway_lidar::revolution::Echo| {
        let slots = (0..echo.range_m.len()).filter(|&slot| echo.range_m[slot] > 0.0);
        slots.map(|slot| [echo.x[slot], echo.y[slot], echo.z[slot]]).collect()
    };
    echo.map(returned).unwrap_or_default()
}

fn points_of_scan(scan: &Scan) -> Vec<[f32; 3]> {
    scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]).collect()
}

/// An estimate in one line.
pub fn describe(estimate: &MountEstimate) -> String {
    format!(
        "estimated from the ground in {} revolutions: height {:.3} m, pitch {:.2} deg, roll {:.2} deg ({} of {} places on \
         one plane, residual {:.3} m)",
        estimate.revolutions,
        estimate.height_m,
        estimate.pitch_rad.to_degrees(),
        estimate.roll_rad.to_degrees(),
        estimate.inliers,
        estimate.samples,
        estimate.residual_m,
    )
}

/// FNV-1a over settings and file names.
fn fingerprint(config: &Config, files: &[PathBuf]) -> u64 {
    let settings = Config { recorder: Recorder::default(), ..config.clone() }.to_toml();
    let names = files.iter().filter_map(|file| file.file_name()).flat_map(|name| name.as_encoded_bytes());
    let bytes = settings.as_bytes().iter().chain(names);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

/// Puts every reading through the door at its time.
fn feed(mut readings: Readings, door: &Door, speed: Speed, progress: &Progress) -> Result<Readings, ReplayError> {
    let began = Instant::now();
    let mut first_ns = None;
    while let Some(reading) = readings.next() {
        let reading = reading?;
        if let Speed::Times(times) = speed {
            let passed = reading.arrival_ns - *first_ns.get_or_insert(reading.arrival_ns);
            let due = Duration::from_nanos(u64::try_from(passed).unwrap_or(0)).div_f64(times);
            std::thread::sleep(due.saturating_sub(began.elapsed()));
        }
        progress.bytes_read.store(readings.bytes_read(), Ordering::Relaxed);
        door.enter_captured(reading).map_err(|_| ReplayError::Engine)?;
    }
    Ok(readings)
}
