//! The options and files of a replay -> everything that is known before its first event: the configuration, how the
//! sensors are mounted, the readings.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clearway_daemon::config::{Calibrations, Config, Origin, Recorder, Ros};
use clearway_daemon::ingest::ros::decoder::PoseSource;
use clearway_daemon::record::run_config;
use clearway_daemon::record::writer::{is_same_file, parent_of};
use clearway_daemon::run::Setup;
use clearway_journal::reader::RecordingReader;
use clearway_lidar::Sensor;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig, SENSORS_MAX, SensorConfig, TimeConfig};
use clearway_mapping::event::{Body, Scan};
use clearway_mapping::scan_file::ScanFormat;
use clearway_mapping::sensor::mount::estimate;
use nalgebra::{Isometry3, Point3, Vector3};

use super::bag::{choice, extrinsics_of, frames_of, keep_placed, sensors_of};
use super::error::ReplayError;
use super::options::ReplayOptions;
use super::overrides::overridden;
use super::recordings::{Recorded, check_sensors, files_of_vehicle, several_vehicles};
use super::summary::{Mount, describe};
use crate::files::Readings;
use crate::files::ground_revolutions::{GroundRevolutions, points_of};
use crate::files::mcap::McapOptions;
use crate::player::faults::Faults;
use crate::player::timeline::{Timeline, Track};
use crate::topics::choice::SensorTopic;

/// What is known before the first event.
pub(super) struct ReplayPlan {
    pub(super) setup: Setup,
    pub(super) mount: Mount,
    pub(super) extrinsics: Extrinsics,
    pub(super) timeline: Timeline,
    /// Bytes of all files.
    pub(super) bytes: u64,
}

/// Finds the configuration, the mounts and the readings of a replay.
///
/// # Errors
/// [`ReplayError`] if a file, a recording or the configuration cannot be used.
pub(super) fn plan(options: &ReplayOptions) -> Result<ReplayPlan, ReplayError> {
    let files = Readings::open(&options.files, McapOptions::default())?;
    let bag = files.bag();
    let recorded = bag.first().cloned();
    let journal = match &recorded {
        Some(file) => RecordingReader::open(file)?.header().config.is_some(),
        None => false,
    };
    check(options, recorded.as_deref(), journal)?;
    if options.vehicle.is_none()
        && options.config.is_none()
        && let Some(recordings) = several_vehicles(&files)?
    {
        return plan_several(options, recordings, files.bytes());
    }
    if let Some(files) = files_of_vehicle(options, &files)? {
        return plan(&ReplayOptions { files, ..options.clone() });
    }
    let mut known = configured(options, recorded.as_deref())?;
    let vehicle = &mut known.config.vehicles[0];
    (vehicle.udp, vehicle.ros) = (None, vehicle.ros.take().map(Ros::frames_alone));
    let mut wanted = McapOptions {
        vehicle: options.vehicle.clone(),
        topics: options.topics.clone(),
        sensors_max: if known.is_mounted { vehicle.sensors.len() } else { SENSORS_MAX },
        available: None,
    };
    let is_given = options.extrinsics.is_some();
    let mount_from_tf = if known.is_mounted { None } else { known.apply_bag(&bag, &mut wanted, is_given)? };
    if let Some(model) = options.model {
        known.apply_model(model);
    }
    let open = || Readings::open(&options.files, wanted.clone());
    let bytes = files.bytes();
    let mount = match options.extrinsics {
        Some(extrinsics) => {
            known.config.vehicles[0].sensors[0].extrinsics = extrinsics;
            Mount::Given
        }
        None if known.is_mounted => Mount::Given,
        None if let Some(mount) = mount_from_tf => mount,
        None => known.estimate_mount(open()?)?,
    };
    let extrinsics = known.config.vehicles[0].sensors[0].extrinsics;
    let setup = known.setup(options)?;
    let tracks = vec![Track { files: options.files.clone(), options: wanted }];
    let timeline = Timeline { tracks, bytes_read: Arc::default(), faults: Faults::default() };
    Ok(ReplayPlan { setup, mount, extrinsics, timeline, bytes })
}

/// The plan of several vehicles in one recorded time. The files of one vehicle follow each other.
fn plan_several(options: &ReplayOptions, recordings: Vec<Recorded>, bytes: u64) -> Result<ReplayPlan, ReplayError> {
    let given = [("--extrinsics", options.extrinsics.is_some()), ("--model", options.model.is_some())];
    if let Some((option, _)) = given.iter().find(|(_, is_given)| *is_given) {
        let reason = "the recordings have several vehicles; name one with --vehicle".to_owned();
        return Err(ReplayError::Option { option: (*option).to_owned(), reason });
    }
    let boot_ids: BTreeSet<u64> = recordings.iter().map(|recording| recording.boot_id).collect();
    let boot_id = boot_ids.first().copied().filter(|_| boot_ids.len() == 1);
    let config = Config { vehicles: Vec::new(), ..Config::default() };
    let mut known = KnownVehicle { config, tables: Vec::new(), boot_id, is_mounted: true, remarks: Vec::new() };
    let mut tracks: Vec<Track> = Vec::new();
    for Recorded { file, config, tables, .. } in recordings {
        for (mut vehicle, tables) in config.vehicles.into_iter().zip(tables) {
            (vehicle.udp, vehicle.ros) = (None, vehicle.ros.take().map(Ros::frames_alone));
            match known.config.vehicles.iter().position(|before| before.name == vehicle.name) {
                Some(index) if known.config.vehicles[index] != vehicle => {
                    let name = &vehicle.name;
                    let reason = format!("its configuration of vehicle {name} differs from the files before it");
                    return Err(ReplayError::mismatch(&file, reason));
                }
                Some(index) => tracks[index].files.push(file.clone()),
                None => {
                    let options = McapOptions { vehicle: Some(vehicle.name.clone()), ..McapOptions::default() };
                    tracks.push(Track { files: vec![file.clone()], options });
                    known.config.vehicles.push(vehicle);
                    known.tables.push(tables);
                }
            }
        }
    }
    known.config = overridden(known.config, options, &options.files[0], &mut known.tables)?;
    let extrinsics = known.config.vehicles[0].sensors[0].extrinsics;
    let setup = known.setup(options)?;
    let timeline = Timeline { tracks, bytes_read: Arc::default(), faults: Faults::default() };
    Ok(ReplayPlan { setup, mount: Mount::Given, extrinsics, timeline, bytes })
}

/// Refuses options that have no meaning for the files. `mcap` is the first MCAP file, and `journal` is true if it is a
/// recording of clearway.
fn check(options: &ReplayOptions, mcap: Option<&Path>, journal: bool) -> Result<(), ReplayError> {
    let unused = |option: String, reason: String| Err(ReplayError::Option { option, reason });
    if let Some(topic) = options.topics.first() {
        let option = format!("--topic {topic}");
        match mcap {
            None => return unused(option, "the files have no topics; a ROS 2 bag in MCAP has".into()),
            Some(file) if journal => {
                let file = file.display();
                return unused(option, format!("{file} is a recording of clearway, of which the events are replayed"));
            }
            Some(_) => {}
        }
    }
    if let Some(name) = options.vehicle.as_ref().filter(|_| options.config.is_none() && !journal) {
        let reason = "the files name no vehicle; the option needs --config FILE or a recording of clearway";
        return unused(format!("--vehicle {name}"), reason.into());
    }
    let Some(record) = &options.record else { return Ok(()) };
    if let Some(from) = options.from_s {
        let reason = "a recording begins with the first event; --to may end it earlier";
        return unused(format!("--from {from}"), reason.into());
    }
    check_record(&options.files, record)
}

/// Refuses a file of `--record` that exists, is no file, or would become a file of a replayed folder. The recorder
/// refuses the name of an earlier recording's parts, and of a recording that is being written.
fn check_record(files: &[PathBuf], record: &Path) -> Result<(), ReplayError> {
    let refused = |reason: &str| Err(ReplayError::path("--record", record, reason));
    let name = record.as_os_str().as_encoded_bytes();
    if name.ends_with(b"/") || name.ends_with(b".unfinished.mcap") {
        return refused("this is the name of a folder, or of a recording that is being written; name a file");
    }
    if record.symlink_metadata().is_ok() {
        return refused("the file exists and is not overwritten; name another file, or delete it");
    }
    match files.iter().find(|file| is_same_file(file, parent_of(record))) {
        Some(folder) => refused(&format!("the folder {} is replayed; name a file in another folder", folder.display())),
        None => Ok(()),
    }
}

/// What is known about the vehicle so far.
struct KnownVehicle {
    /// The configuration, with one vehicle.
    config: Config,
    tables: Calibrations,
    /// Boot id of the recording whose maps are made again.
    boot_id: Option<u64>,
    /// True if the extrinsics of the sensors are known.
    is_mounted: bool,
    /// Lines about the mounts, for the recording.
    remarks: Vec<String>,
}

impl KnownVehicle {
    /// Configures the sensors of a ROS bag and puts their topics into `wanted`. Returns the mount of the first sensor
    /// if tf has it.
    fn apply_bag(
        &mut self,
        bag: &[PathBuf],
        wanted: &mut McapOptions,
        is_given: bool,
    ) -> Result<Option<Mount>, ReplayError> {
        let mut choice = choice(bag, wanted)?;
        keep_placed(&mut choice.sensors, is_given);
        // With names, the same topics are chosen again when the bag is read.
        wanted.topics = choice.sensors.iter().map(|sensor| sensor.topic.clone()).collect();
        if let Some(PoseSource::Topic(topic)) = &choice.pose {
            wanted.topics.push(topic.clone());
        }
        if choice.sensors.is_empty() {
            return Ok(None);
        }
        (wanted.sensors_max, self.tables) = (choice.sensors.len(), vec![vec![None; choice.sensors.len()]]);
        if let Some(SensorTopic { frame_id, refused_mount: Some(fault), .. }) =
            choice.sensors.first().filter(|_| !is_given)
        {
            self.config.vehicles[0].maps = MapsConfig::none();
            return Ok(Some(Mount::Refused { frame_id: frame_id.clone(), fault: fault.clone() }));
        }
        let (sensors, mounts) = sensors_of(&choice);
        sensors.iter().zip(&mounts).for_each(|(sensor, mount)| self.remark(&sensor.name, mount.as_ref()));
        (self.config.vehicles[0].sensors, self.config.vehicles[0].ros) = (sensors, Some(frames_of(&choice)));
        Ok(mounts.into_iter().next().flatten())
    }

    fn remark(&mut self, sensor: &str, mount: Option<&Mount>) {
        self.remarks.extend(mount.and_then(describe).map(|said| format!("extrinsics of {sensor}: {said}")));
    }

    /// Gives each sensor this model, which comes before the configured elevations.
    fn apply_model(&mut self, model: Model) {
        for sensor in &mut self.config.vehicles[0].sensors {
            sensor.model = Some(model);
            sensor.elevations_deg.clear();
        }
    }

    /// Estimates the mount of the first sensor from the ground in the first revolutions. If that fails, no map is made.
    fn estimate_mount(&mut self, mut readings: Readings) -> Result<Mount, ReplayError> {
        let vehicle = &mut self.config.vehicles[0];
        let sensor = &mut vehicle.sensors[0];
        let mut revolutions = first_revolutions(&mut readings, sensor, self.tables[0][0].clone())?;
        if revolutions.is_empty() {
            return Ok(Mount::Unneeded);
        }
        // The ground does not show which way is forward; the format of a scan file does.
        let yaw_rad = readings.scan_format().map_or(0.0, ScanFormat::yaw_deg).to_radians();
        let forward_from_sensor = Isometry3::rotation(Vector3::z() * yaw_rad);
        if yaw_rad != 0.0 {
            let turned = |point: &mut [f32; 3]| {
                *point = (forward_from_sensor * Point3::from(point.map(f64::from))).cast::<f32>().into();
            };
            revolutions.iter_mut().flatten().for_each(turned);
        }
        let mount = estimate(&revolutions).map_or_else(Mount::Unknown, Mount::Estimated);
        match &mount {
            Mount::Estimated(estimate) => {
                let ego_from_forward = estimate.extrinsics().ego_from_sensor();
                sensor.extrinsics = match yaw_rad {
                    0.0 => estimate.extrinsics(),
                    _ => extrinsics_of(&(ego_from_forward * forward_from_sensor)),
                };
            }
            _ => vehicle.maps = MapsConfig::none(),
        }
        let name = sensor.name.clone();
        self.remark(&name, Some(&mount));
        Ok(mount)
    }

    /// The setup with which the server starts.
    fn setup(self, options: &ReplayOptions) -> Result<Setup, ReplayError> {
        let Self { config, tables: calibrations, boot_id, remarks, .. } = self;
        let file = options.config.as_deref().unwrap_or(Path::new("of the replayed files"));
        // A run that serves nothing opens none of these paths, and its boot id must not depend on the folder.
        let served = options.served.as_ref();
        let mut config = if served.is_some() { config.located(file) } else { config };
        config.recorder.file = options.record.clone().unwrap_or_default();
        if served.is_none() {
            (config.grpc.enabled, config.page.enabled, config.foxglove.enabled) = (false, false, false);
            (config.zenoh.enabled, config.zenoh.ros2.enabled) = (false, false);
        }
        if served.is_some_and(|served| served.any_port) {
            let any = SocketAddr::from(([127, 0, 0, 1], 0));
            (config.grpc.listen, config.page.listen, config.foxglove.listen) = (any, any, any);
            config.zenoh.listen = vec!["tcp/127.0.0.1:0".into()];
        }
        config.check(&origin(options, file))?;
        let certificates = if served.is_some() { config.certificates(file)? } else { None };
        // The same files and settings get the same boot id. Served maps need a new one, because a reader that has seen
        // these maps before would drop them as old.
        let is_altered = options.extrinsics.is_some() || options.model.is_some() || !options.set.is_empty();
        let of_settings = || served.is_none().then(|| fingerprint(&config, &options.files));
        let boot_id = boot_id.filter(|_| !is_altered).or_else(of_settings);
        let mut notes = BTreeMap::new();
        if !remarks.is_empty() {
            notes.insert("mount".to_owned(), remarks.join("\n"));
        }
        Ok(Setup {
            config,
            calibrations,
            certificates,
            boot_id,
            from_files: true,
            config_comments: remarks,
            metadata: notes,
            is_stepped: true,
            ..Setup::default()
        })
    }
}

/// Where a wrong value of the configuration was given. The configuration was checked when it was read, so a value is
/// wrong because of the options, or of the mounts in a bag.
fn origin(options: &ReplayOptions, file: &Path) -> Origin {
    match options.extrinsics {
        None => Origin::file(file),
        Some(Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg }) => {
            Origin::Options(vec![format!("--extrinsics {x_m},{y_m},{z_m},{roll_deg},{pitch_deg},{yaw_deg}")])
        }
    }
}

/// The configuration of `--config`, else of the recording, else the default one.
fn configured(options: &ReplayOptions, recorded: Option<&Path>) -> Result<KnownVehicle, ReplayError> {
    let known =
        |config, tables, boot_id, is_mounted| KnownVehicle { config, tables, boot_id, is_mounted, remarks: Vec::new() };
    let pick = |file: &Path, config: &mut Config, tables: &mut Calibrations| {
        let known = || config.vehicles.iter().map(|v| v.name.as_str()).collect::<Vec<_>>().join(", ");
        let index = match &options.vehicle {
            None if config.vehicles.len() > 1 => {
                let reason = format!("it has the vehicles {}; name one with --vehicle", known());
                return Err(ReplayError::mismatch(file, reason));
            }
            None => 0,
            Some(name) => {
                let found = config.vehicles.iter().position(|vehicle| vehicle.name == *name);
                found.ok_or_else(|| ReplayError::Option {
                    option: format!("--vehicle {name}"),
                    reason: format!("the configuration has: {}", known()),
                })?
            }
        };
        config.vehicles = vec![config.vehicles.swap_remove(index)];
        *tables = vec![tables.swap_remove(index)];
        Ok::<_, ReplayError>(())
    };
    if let Some(file) = &options.config {
        let mut config = Config::load(file, &options.set)?;
        let mut tables = config.calibrations(file)?;
        pick(file, &mut config, &mut tables)?;
        recorded.map_or(Ok(()), |recording| check_sensors(file, &config, recording))?;
        return Ok(known(config, tables, None, true));
    }
    if let Some(file) = recorded {
        let recording = RecordingReader::open(file)?;
        if recording.header().config.is_some() {
            let (mut config, mut tables) = run_config(&recording)?;
            pick(file, &mut config, &mut tables)?;
            // This run does not use the publishers, the files and the recorder of the recorded run.
            let config = Config { vehicles: config.vehicles, ..Config::default() };
            let config = overridden(config, options, file, &mut tables)?;
            return Ok(known(config, tables, Some(recording.header().boot_id), true));
        }
    }
    let mut tables = vec![vec![None]];
    let config = overridden(Config::of_one_vehicle("car", "top"), options, &options.files[0], &mut tables)?;
    // A key of the extrinsics says that they are known.
    let is_mounted = options.set.iter().any(|key| key.contains(".extrinsics."));
    Ok(known(config, tables, None, is_mounted))
}

/// The points of the first revolutions or scans, in the sensor frame, in metres.
fn first_revolutions(
    readings: &mut Readings,
    config: &SensorConfig,
    calibration: Option<Calibration>,
) -> Result<Vec<Vec<[f32; 3]>>, ReplayError> {
    let mut sensor = Sensor::new(config.lidar(calibration, TimeConfig::default().ahead_ns_max()));
    let mut revolutions = GroundRevolutions::default();
    for reading in readings.filter(|reading| !matches!(reading, Ok(other) if other.source != 0)) {
        let reading = reading?;
        let needs_more = match &reading.body {
            // Refused datagrams are counted in the second pass, which makes the maps.
            Body::Datagram(payload) => match sensor.push(payload, reading.arrival_ns) {
                Ok(Some(revolution)) => revolutions.push(|| points_of(revolution)),
                Ok(None) | Err(_) => true,
            },
            Body::Scan(scan) => revolutions.push(|| points_of_scan(scan)),
            Body::End => sensor.finish().is_none_or(|revolution| revolutions.push(|| points_of(revolution))),
            _ => true,
        };
        if !needs_more {
            break;
        }
    }
    Ok(revolutions.into_clouds())
}

fn points_of_scan(scan: &Scan) -> Vec<[f32; 3]> {
    scan.x.iter().zip(&scan.y).zip(&scan.z).map(|((&x, &y), &z)| [x, y, z]).collect()
}

/// FNV-1a hash of the settings and the file names.
fn fingerprint(config: &Config, files: &[PathBuf]) -> u64 {
    let settings = Config { recorder: Recorder::default(), ..config.clone() }.to_toml();
    let names = files.iter().filter_map(|file| file.file_name()).flat_map(|name| name.as_encoded_bytes());
    let bytes = settings.as_bytes().iter().chain(names);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}
