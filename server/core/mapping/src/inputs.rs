//! All that events change: the sensors with their newest scans, the motion of the vehicle, and the roads.
//!
//! In: one [`Event`] after the other. Out: an [`InputOutcome`] each, and the inputs of fusion and layers.

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;

use crate::config::VehicleConfig;
use crate::error::{EventError, check_newer, check_stamp_range};
use crate::event::{Body, EgoPose, Event, Road};
use crate::event_time::EventTime;
use crate::fusion::reference_sensor::ReferenceChoice;
use crate::road::{self, Roads};
use crate::sensor::config::SensorConfig;
use crate::sensor::motion::Motion;
use crate::sensor::pipeline::SensorPipeline;
use crate::sensor::rays::ScanExtras;
use crate::sensor::scan::SensorScan;
use crate::sensor::self_filter::RemovedPoints;

/// Greatest distance of an ego pose from the world's origin along one axis, metres. Ours: far beyond every local map
/// frame, and exact to 0.1 µm in double precision.
const POSITION_M_MAX: f64 = 1e9;
/// Greatest speed of an ego pose, m/s. Ours: no vehicle on wheels is faster, and the points of a scan move by no more
/// than 100 m in 0.1 s.
const SPEED_MPS_MAX: f64 = 1000.0;
/// Norm of the quaternion of an ego pose. Ours: single precision rounds a norm of 1 by less than 1e-6.
const QUATERNION_NORM: std::ops::RangeInclusive<f64> = 1.0 - 1e-6..=1.0 + 1e-6;

/// What an accepted event changed, as far as the ledgers count it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct InputOutcome {
    /// Points that were removed from the scan that the event completed; `None` if the event completed no scan.
    pub completed_scan: Option<RemovedPoints>,
    /// Packets of the sensor that were counted as decoded while the decoder held them back, and that do not fit the
    /// model it has found now.
    pub packets_unfit: u64,
}

/// The inputs of one vehicle.
#[derive(Clone)]
pub(crate) struct Inputs {
    config: VehicleConfig,
    deadline_ns: i64,
    extras: ScanExtras,
    reference_sensor: usize,
    /// Number of sensors of the configuration; those after them are declared.
    configured: usize,
    /// By source.
    sensors: Vec<SensorPipeline>,
    /// By source.
    scans: Vec<SensorScan>,
    motion: Motion,
    roads: Roads,
    /// Event time of the newest accepted ego pose; `None` before the first.
    pose_event_ns: Option<i64>,
}

impl Inputs {
    /// Inputs before the first event. `config` is valid; `calibrations[i]` belongs to `config.sensors[i]`.
    pub fn new(config: &VehicleConfig, calibrations: Vec<Option<Calibration>>, extras: ScanExtras) -> Self {
        let mut inputs = Self {
            deadline_ns: config.fusion.deadline_ns(),
            extras,
            reference_sensor: config.reference_sensor().unwrap_or(0),
            configured: config.sensors.len(),
            sensors: Vec::new(),
            scans: Vec::new(),
            motion: Motion::new(&config.maps.motion),
            roads: Roads::default(),
            pose_event_ns: None,
            config: config.clone(),
        };
        calibrations.into_iter().enumerate().for_each(|(index, calibration)| inputs.begin_sensor(index, calibration));
        inputs
    }

    /// Applies one event.
    ///
    /// # Errors
    /// [`EventError`] if the event is refused; then nothing has changed but what its stamp shows of its clock.
    pub fn apply(&mut self, event: &Event, now: EventTime) -> Result<InputOutcome, EventError> {
        let outcome = match &event.body {
            Body::Datagram(payload) => self.apply_datagram(event.source, payload, now)?,
            Body::Scan(scan) => {
                let (sensor, newest) = sensor_mut(&mut self.sensors, &mut self.scans, event.source)?;
                let removed = sensor.apply_scan(scan, newest, &mut self.motion, now, self.deadline_ns)?;
                InputOutcome { completed_scan: Some(removed), packets_unfit: 0 }
            }
            Body::End | Body::Withdrawn => {
                self.check_may_end(event)?;
                let (sensor, newest) = sensor_mut(&mut self.sensors, &mut self.scans, event.source)?;
                let completed_scan = sensor.finish(newest, &mut self.motion, now);
                InputOutcome { completed_scan, packets_unfit: sensor.drain_unfit() }
            }
            Body::EgoPose(pose) => self.apply_ego_pose(pose, now).map(|()| InputOutcome::default())?,
            Body::Road(road) => self.apply_road(road, now).map(|()| InputOutcome::default())?,
            Body::Sensor(sensor) => self.declare_sensor(event.source, sensor).map(|()| InputOutcome::default())?,
            Body::Lost { .. } | Body::Plan(_) => InputOutcome::default(),
        };
        if outcome.completed_scan.is_some() {
            self.motion.note_scan_end(self.scans[usize::from(event.source)].end_ns);
        }
        Ok(outcome)
    }

    /// Removes a declared sensor with all that is known of it.
    pub fn remove_sensor(&mut self, source: u16) {
        let index = usize::from(source);
        self.config.withdraw(index);
        let sensors = self.config.sensors.len();
        self.sensors.truncate(sensors);
        self.scans.truncate(sensors);
        if index < sensors {
            self.begin_sensor(index, None);
        }
    }

    /// Sets what the active layers need of every scan from now on.
    pub fn set_extras(&mut self, extras: ScanExtras) {
        self.extras = extras;
        for (sensor, scan) in self.sensors.iter_mut().zip(&mut self.scans) {
            sensor.set_extras(extras, scan);
        }
    }

    /// Sets the reference sensor from now on.
    pub fn set_reference_sensor(&mut self, reference_sensor: usize) {
        self.reference_sensor = reference_sensor;
        self.set_extras(self.extras);
    }

    /// Index of the reference sensor by the configuration alone, if it names none.
    pub fn reference_by_configuration(&self) -> usize {
        // Without a configured sensor the first declared one is it.
        let candidates = if self.configured > 0 { self.configured } else { self.sensors.len() };
        let lasers: Vec<usize> = self.sensors[..candidates].iter().map(SensorPipeline::lasers_configured).collect();
        ReferenceChoice::by_configuration(&self.scans, &lasers)
    }

    /// The newest scan of each sensor, by source.
    pub fn scans(&self) -> &[SensorScan] {
        &self.scans
    }

    /// The motion of the vehicle.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// The newest roads.
    pub fn roads(&self) -> &Roads {
        &self.roads
    }

    /// Number of indices of sensors, with the indices of withdrawn sensors.
    pub fn sources(&self) -> usize {
        self.sensors.len()
    }

    /// Index, name and pipeline of each sensor.
    pub fn sensors(&self) -> impl Iterator<Item = (usize, &str, &SensorPipeline)> {
        let all = self.config.sensors.iter().zip(&self.sensors).enumerate();
        all.filter(|(_, (config, _))| !config.is_withdrawn())
            .map(|(index, (config, sensor))| (index, config.name.as_str(), sensor))
    }

    /// The revolution from which the newest scan of a sensor was made; `None` if the scan came as an event.
    pub fn revolution(&self, source: usize) -> Option<&Revolution> {
        if self.scans[source].is_revolution { self.sensors[source].revolution() } else { None }
    }

    fn apply_datagram(&mut self, source: u16, payload: &[u8], now: EventTime) -> Result<InputOutcome, EventError> {
        let (sensor, newest) = sensor_mut(&mut self.sensors, &mut self.scans, source)?;
        let completed_scan = sensor.apply_datagram(payload, newest, &mut self.motion, now)?;
        if payload.len() == TELEMETRY_LENGTH {
            sensor.apply_speed(&mut self.motion);
        }
        Ok(InputOutcome { completed_scan, packets_unfit: sensor.drain_unfit() })
    }

    /// Refuses a pose that is not newer than the newest one, unless no pose was accepted for the deadline: then the
    /// sender has restarted, or its clock was set back.
    fn apply_ego_pose(&mut self, pose: &EgoPose, now: EventTime) -> Result<(), EventError> {
        check_stamp_range(pose.stamp_ns)?;
        check_pose(pose)?;
        let newest_ns = self.motion.newest_pose().map(|newest| newest.stamp_ns);
        let is_silent = self.pose_event_ns.is_some_and(|ns| now.event_ns.saturating_sub(ns) > self.deadline_ns);
        if is_silent && newest_ns.is_some_and(|newest_ns| pose.stamp_ns <= newest_ns) {
            self.motion.forget_poses();
        } else if let Err(refusal) = check_newer(pose.stamp_ns, newest_ns) {
            if newest_ns.is_some_and(|newest_ns| pose.stamp_ns < newest_ns) {
                self.motion.note_refused_pose(pose.stamp_ns, now.event_ns);
            }
            return Err(refusal);
        }
        self.motion.push_pose(pose, now.event_ns);
        self.pose_event_ns = Some(now.event_ns);
        Ok(())
    }

    fn apply_road(&mut self, road: &Road, now: EventTime) -> Result<(), EventError> {
        check_stamp_range(road.stamp_ns)?;
        road::check(road)?;
        // A road whose stamp lies in the future of the host's clock was stamped by a clock that is wrong or was set
        // back since: it does not lock out newer roads.
        let latest_ns = now.arrival_ns.saturating_add(self.deadline_ns);
        let newest_ns = self.roads.newest_stamp_ns(road.purpose).filter(|newest_ns| *newest_ns <= latest_ns);
        check_newer(road.stamp_ns, newest_ns)?;
        self.roads.insert(road, self.motion.map_from_ego(road.stamp_ns));
        Ok(())
    }

    fn declare_sensor(&mut self, source: u16, sensor: &SensorConfig) -> Result<(), EventError> {
        let index = usize::from(source);
        if self.config.sensors.get(index) == Some(sensor) {
            return Ok(());
        }
        let calibration = self.config.declare(index, sensor)?;
        (self.sensors.len()..index).for_each(|withdrawn| self.begin_sensor(withdrawn, None));
        self.begin_sensor(index, calibration);
        Ok(())
    }

    /// Refuses the withdrawal of a sensor that was not declared.
    fn check_may_end(&self, event: &Event) -> Result<(), EventError> {
        let (source_index, first_declared) = (event.source, self.configured);
        match event.body {
            Body::Withdrawn if usize::from(source_index) < first_declared => {
                Err(EventError::Withdrawn { source_index, first_declared })
            }
            _ => Ok(()),
        }
    }

    /// Begins the pipeline of the sensor `index`, in place of the pipeline before.
    fn begin_sensor(&mut self, index: usize, calibration: Option<Calibration>) {
        let sensor = &self.config.sensors[index];
        let pipeline = SensorPipeline::new(
            sensor,
            self.config.time.ahead_ns_max(),
            calibration,
            self.config.body.as_ref(),
            self.extras,
        );
        let scan = SensorScan::new(&sensor.name, pipeline.origin_m(), pipeline.tilt_rad());
        match (self.scans.get_mut(index), self.sensors.get_mut(index)) {
            (Some(before), Some(pipeline_before)) => (*before, *pipeline_before) = (scan, pipeline),
            _ => {
                self.scans.push(scan);
                self.sensors.push(pipeline);
            }
        }
    }
}

/// The sensor of this index and its newest scan.
fn sensor_mut<'a>(
    sensors: &'a mut [SensorPipeline],
    scans: &'a mut [SensorScan],
    source_index: u16,
) -> Result<(&'a mut SensorPipeline, &'a mut SensorScan), EventError> {
    let (source, count) = (usize::from(source_index), scans.iter().filter(|scan| !scan.is_withdrawn()).count());
    let unknown = EventError::Source { source_index, sensors: count };
    match (sensors.get_mut(source), scans.get_mut(source)) {
        (Some(sensor), Some(scan)) if !scan.is_withdrawn() => Ok((sensor, scan)),
        _ => Err(unknown),
    }
}

fn check_pose(pose: &EgoPose) -> Result<(), EventError> {
    let position = pose.map_from_ego.translation.vector;
    let quaternion_norm = pose.map_from_ego.rotation.coords.norm();
    // NaN fails every comparison and is in no range; a NaN in the quaternion makes its norm NaN.
    let is_possible = position.iter().all(|v| v.abs() <= POSITION_M_MAX)
        && pose.speed_mps.abs() <= SPEED_MPS_MAX
        && QUATERNION_NORM.contains(&quaternion_norm);
    if is_possible { Ok(()) } else { Err(EventError::Pose { stamp_ns: pose.stamp_ns }) }
}
