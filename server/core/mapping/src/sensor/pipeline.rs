//! One sensor: from its events to its newest scan in the ego frame.
//!
//! In: the datagrams and scans of one sensor, and the motion of the vehicle. Out: [`SensorScan`], the newest revolution
//! or scan with its points, and, if a layer needs them, with the directions of the rays without a return. The hops:
//! datagram -> decoder -> revolution -> motion compensation and self filter -> [`SensorScan`].

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::{CalibrationSource, Model, Sensor, SensorStatus};

use nalgebra::Vector3;

use crate::error::{EventError, check_newer};
use crate::event_time::EventTime;
use crate::sensor::config::SensorConfig;
use crate::sensor::distance_series::DistanceSeries;
use crate::sensor::model_check;
use crate::sensor::motion::stamp_clock::ScanClock;
use crate::sensor::motion::{EgoTrajectory, Motion};
use crate::sensor::mount::check::{MountCheck, MountDeviation};
use crate::sensor::observation::Scan;
use crate::sensor::rays::ScanExtras;
use crate::sensor::rays::{find_no_returns, rotated};
use crate::sensor::ring_series::RingSeries;
use crate::sensor::rings;
use crate::sensor::scan::SensorScan;
use crate::sensor::self_filter::BodyConfig;
use crate::sensor::self_filter::{RemovedPoints, SelfFilter};
use crate::sensor::state::{ElevationSource, OtherClock, SensorState};
use crate::sensor::sweep::Mount;

/// Number of scans from whose points the elevations are estimated. Ours: if the first scans do not show them, the later
/// ones do not either, and each estimate takes as long as a layer.
const ESTIMATES_MAX: u64 = 20;

/// Standard deviation of the range noise of a sensor whose model is not known, metres. Ours: the noise of an HDL-64E or
/// HDL-32E, the least of the family, so that no roughness is lost.
const RANGE_NOISE_M: f32 = 0.02;

/// One sensor of the vehicle.
#[derive(Clone)]
pub(crate) struct SensorPipeline {
    name: Arc<str>,
    decoder: Sensor,
    mount: Mount,
    filter: Option<SelfFilter>,
    /// Elevations of the lasers behind scan events; `None` until they are known.
    scan_calibration: Option<Arc<Calibration>>,
    /// Source of these elevations.
    scan_elevations: ElevationSource,
    /// Source of the elevations of the newest scan; `None` before the first.
    elevations: Option<ElevationSource>,
    /// Stamp and event time of the newest accepted scan event, ns.
    newest_scan: Option<(i64, i64)>,
    /// How often the stamps of accepted scan events have gone back; `None` if that is not counted.
    scan_epoch: Option<u32>,
    clock: ScanClock,
    other_clock: OtherClock,
    mount_check: MountCheck,
    /// End of the newest scan, ns; `None` before the first.
    newest_end_ns: Option<i64>,
    /// Number of accepted scan events.
    scans: u64,
    /// Number of returns in all accepted scan events.
    scan_returns: u64,
    /// Configured standard deviation of the range noise, metres; `None` selects the noise of the model.
    range_noise_m: Option<f32>,
    /// Configured model.
    model: Option<Model>,
    /// `None` unless a layer needs the deviations.
    series: Option<Series>,
    finds_no_returns: bool,
    /// How the vehicle moved through the newest scan.
    trajectory: EgoTrajectory,
    /// Number of packets that [`SensorPipeline::drain_unfit`] has returned.
    unfit_drained: u64,
}

/// The distance series of a sensor's revolutions and scan events.
#[derive(Clone, Default)]
struct Series {
    of_lasers: DistanceSeries,
    of_rings: RingSeries,
}

impl SensorPipeline {
    /// A sensor without events; `body` is the vehicle's own box. `ahead_ns_max`:
    /// [`clearway_lidar::SensorConfig::ahead_ns_max`].
    pub fn new(
        config: &SensorConfig,
        ahead_ns_max: i64,
        calibration: Option<Calibration>,
        body: Option<&BodyConfig>,
        extras: ScanExtras,
    ) -> Self {
        let (scan_calibration, scan_elevations) = scan_calibration(config, calibration.as_ref());
        let mount = Mount { ego_from_sensor: config.extrinsics.ego_from_sensor(), range_m_min: config.range_m_min };
        Self {
            name: config.name.as_str().into(),
            scan_calibration: scan_calibration.map(Arc::new),
            scan_elevations,
            elevations: None,
            decoder: Sensor::new(config.lidar(calibration, ahead_ns_max)),
            filter: SelfFilter::new(body, mount.origin_m(), &config.blind_deg),
            mount,
            newest_scan: None,
            scan_epoch: (ahead_ns_max > 0).then_some(0),
            clock: ScanClock::default(),
            other_clock: OtherClock::default(),
            mount_check: MountCheck::default(),
            newest_end_ns: None,
            scans: 0,
            scan_returns: 0,
            range_noise_m: config.range_noise_m,
            model: config.model,
            series: extras.deviations.then(Series::default),
            finds_no_returns: extras.no_returns,
            trajectory: EgoTrajectory::default(),
            unfit_drained: 0,
        }
    }

    /// Position of the sensor, ego frame, metres.
    pub fn origin_m(&self) -> [f32; 3] {
        self.mount.origin_m()
    }

    /// Angle between the sensor's z axis and the vertical, radians.
    pub fn tilt_rad(&self) -> f32 {
        (self.mount.ego_from_sensor.rotation * Vector3::z()).angle(&Vector3::z()) as f32
    }

    /// Number of lasers whose elevations are configured; 0 if they are found from the data.
    pub fn lasers_configured(&self) -> usize {
        self.scan_calibration.as_ref().map_or(0, |table| table.lasers.len())
    }

    /// Sets what the layers need of the sensor's scans from now on; `scan` is its newest one.
    pub fn set_extras(&mut self, extras: ScanExtras, scan: &mut SensorScan) {
        if extras.deviations != self.series.is_some() {
            self.series = extras.deviations.then(Series::default);
        }
        self.finds_no_returns = extras.no_returns;
        if !extras.no_returns {
            scan.no_returns.clear();
        }
    }

    /// Status of the sensor, found from its data. A scan event counts as a revolution.
    pub fn status(&self) -> SensorStatus {
        let mut status = self.decoder.status();
        status.revolutions += self.scans;
        status.returns += self.scan_returns;
        status.epoch = status.epoch.saturating_add(self.scan_epoch.unwrap_or(0));
        status
    }

    /// Source of the elevations of the newest scan; `None` before the first.
    pub fn elevations(&self) -> Option<ElevationSource> {
        self.elevations
    }

    /// How far the ground deviates from the configured mount; `None` before the first scan with ground.
    pub fn mount_deviation(&self) -> Option<MountDeviation> {
        self.mount_check.deviation()
    }

    /// The scans without a pose because the poses are of another clock.
    pub fn other_clock(&self) -> OtherClock {
        self.other_clock
    }

    /// The newest revolution; `None` before the first.
    pub fn revolution(&self) -> Option<&Revolution> {
        self.decoder.newest()
    }

    /// Decodes a datagram. If it completes a revolution, writes the revolution to `scan` and returns what was removed
    /// from it.
    ///
    /// # Errors
    /// [`EventError::Datagram`] if the decoder refuses the datagram.
    pub fn apply_datagram(
        &mut self,
        payload: &[u8],
        scan: &mut SensorScan,
        motion: &mut Motion,
        now: EventTime,
    ) -> Result<Option<RemovedPoints>, EventError> {
        let is_complete = self.decoder.push(payload, now.arrival_ns)?.is_some();
        Ok(if is_complete { self.apply_revolution(scan, motion, now) } else { None })
    }

    /// Ends the source: writes what is left of its revolution to `scan`, if anything is left.
    pub fn finish(&mut self, scan: &mut SensorScan, motion: &mut Motion, now: EventTime) -> Option<RemovedPoints> {
        self.decoder.finish()?;
        self.apply_revolution(scan, motion, now)
    }

    /// Number of packets that do not fit the model the decoder has found, although they were accepted before it was
    /// found; since the last call.
    pub fn drain_unfit(&mut self) -> u64 {
        let unfit = self.decoder.packets_unfit() - self.unfit_drained;
        self.unfit_drained += unfit;
        unfit
    }

    /// Passes the speed of the newest telemetry to the vehicle's motion.
    pub fn apply_speed(&self, motion: &mut Motion) {
        if let Some(gprmc) = self.decoder.gprmc() {
            motion.apply_gprmc(gprmc, self.decoder.newest().map(|revolution| revolution.end_ns));
        }
    }

    fn apply_revolution(
        &mut self,
        scan: &mut SensorScan,
        motion: &mut Motion,
        now: EventTime,
    ) -> Option<RemovedPoints> {
        let revolution = self.decoder.newest()?;
        if scan.completed > 0 && scan.is_revolution && revolution.epoch > scan.state.epoch {
            motion.begin_epoch(scan.completed_at.event_ns);
        }
        self.clock.note([revolution.start_ns, revolution.end_ns], now.event_ns);
        motion.note_scan(revolution.end_ns, now.event_ns, &mut self.clock);
        let (mount, filter) = (&self.mount, self.filter.as_ref());
        motion.follow_revolution(revolution, &mut self.trajectory);
        let sweep = scan.next_sweep();
        let removed = sweep.set_moving_revolution(revolution, mount, &self.trajectory.end_from_ego, filter);
        if let Some(series) = &mut self.series {
            let noise_m = self.range_noise_m.unwrap_or(revolution.model.spec().range_noise_m);
            sweep.set_deviations(revolution, &mut series.of_lasers, noise_m);
        }
        if self.finds_no_returns {
            find_no_returns(revolution, mount, &self.trajectory, filter, &mut scan.no_returns);
        }
        let elevations = revolution_elevations(self.decoder.status().calibration, revolution.model);
        self.elevations = Some(elevations);
        scan.state = SensorState::of_revolution(&self.name, revolution, elevations, scan.sweep.returns);
        (scan.start_ns, scan.end_ns, scan.is_revolution) = (revolution.start_ns, revolution.end_ns, true);
        self.complete(scan, motion, now);
        Some(removed)
    }

    /// Writes a scan event to `newest` and returns what was removed from it. A scan that is not newer than the newest
    /// one is refused, unless no scan was accepted for `deadline_ns` of event time: then the sender has restarted, or
    /// its clock was set back. A repeated scan is always refused.
    ///
    /// # Errors
    /// [`EventError::ScanLengths`], [`EventError::ScanList`], [`EventError::ScanOffset`], [`EventError::NoReturn`] or
    /// [`EventError::StampRange`] if a value of the scan is not allowed; [`EventError::ScanRing`] or
    /// [`EventError::ScanElevation`] if it is no scan of the configured model, from which the elevations come;
    /// [`EventError::Stamp`] if it is not newer.
    pub fn apply_scan(
        &mut self,
        scan: &Scan,
        newest: &mut SensorScan,
        motion: &mut Motion,
        now: EventTime,
        deadline_ns: i64,
    ) -> Result<RemovedPoints, EventError> {
        scan.check()?;
        if let (Some(model), ElevationSource::Model) = (self.model, self.scan_elevations) {
            model_check::check(scan, model)?;
        }
        // A scan without points has the stamp of another part of the revolution.
        if !scan.x.is_empty() {
            self.clock.note([scan.start_ns(), scan.stamp_ns], now.event_ns);
        }
        if let Some((newest_ns, accepted_ns)) = self.newest_scan
            && (scan.stamp_ns == newest_ns || now.event_ns.saturating_sub(accepted_ns) <= deadline_ns)
        {
            check_newer(scan.stamp_ns, Some(newest_ns))?;
        }
        if let (Some(epoch), Some((newest_ns, accepted_ns))) = (&mut self.scan_epoch, self.newest_scan)
            && scan.stamp_ns < newest_ns
        {
            *epoch = epoch.saturating_add(1);
            motion.begin_epoch(accepted_ns);
        }
        motion.note_scan(scan.stamp_ns, now.event_ns, &mut self.clock);
        self.newest_scan = Some((scan.stamp_ns, now.event_ns));
        self.find_elevations(scan);
        motion.follow_scan(scan, &mut self.trajectory);
        let (calibration, end_from_ego) = (self.scan_calibration.as_ref(), &self.trajectory.end_from_ego);
        let sweep = newest.next_sweep();
        let removed = sweep.set_moving_scan(scan, calibration, &self.mount, end_from_ego, self.filter.as_ref());
        if let Some(series) = &mut self.series {
            let of_model = || self.model.map_or(RANGE_NOISE_M, |model| model.spec().range_noise_m);
            let noise_m = self.range_noise_m.unwrap_or_else(of_model);
            let deviations_m = series.of_rings.deviations(scan);
            sweep.set_scan_deviations(scan, deviations_m, noise_m);
        }
        newest.no_returns.clear();
        if self.finds_no_returns {
            let to_ego = |ray: &[f32; 3]| rotated(&self.mount.ego_from_sensor, *ray);
            let is_blind = |ray: &[f32; 3]| self.filter.as_ref().is_some_and(|filter| filter.is_blind(*ray));
            newest.no_returns.extend(scan.no_returns.iter().filter(|ray| !is_blind(ray)).map(to_ego));
        }
        newest.state = SensorState::of_scan(&self.name, scan, self.scan_elevations, newest.sweep.returns, now);
        newest.state.epoch = self.scan_epoch.unwrap_or(0);
        (newest.start_ns, newest.end_ns, newest.is_revolution) = (scan.start_ns(), scan.stamp_ns, false);
        (self.scans, self.scan_returns) = (self.scans + 1, self.scan_returns + u64::from(newest.sweep.returns));
        self.complete(newest, motion, now);
        Ok(removed)
    }

    /// Finds the elevations behind scan events, unless they are known: from the scan's rings, else from its points.
    fn find_elevations(&mut self, scan: &Scan) {
        if scan.x.is_empty() {
            return;
        }
        let is_tried = self.scans < ESTIMATES_MAX;
        if self.scan_calibration.is_none() {
            let by_rings = rings::measured(scan).map(|found| (found, ElevationSource::Rings));
            let by_points = || rings::estimated(scan).map(|found| (found, ElevationSource::Estimated));
            if let Some((found, source)) = by_rings.or_else(|| if is_tried { by_points() } else { None }) {
                (self.scan_calibration, self.scan_elevations) = (Some(Arc::new(found)), source);
            }
        }
        self.elevations = Some(self.scan_elevations);
    }

    fn complete(&mut self, scan: &mut SensorScan, motion: &Motion, now: EventTime) {
        self.mount_check.push(&scan.sweep, self.mount.origin_m());
        scan.period_ns = self.newest_end_ns.replace(scan.end_ns).map(|before_ns| scan.end_ns.saturating_sub(before_ns));
        scan.completed_at = now;
        scan.compensation = self.trajectory.compensation;
        scan.speed_mps = self.trajectory.speed_mps;
        scan.map_from_ego = motion.at(scan.end_ns).0;
        self.other_clock.note(motion.ahead_of_scan_ns());
        scan.completed += 1;
    }
}

/// The configured elevations behind scan events, and their source: the table, else `elevations_deg`, else the model.
fn scan_calibration(
    config: &SensorConfig,
    calibration: Option<&Calibration>,
) -> (Option<Calibration>, ElevationSource) {
    if let Some(table) = calibration {
        (Some(table.clone()), ElevationSource::Table)
    } else if !config.elevations_deg.is_empty() {
        let elevations_rad = config.elevations_deg.iter().map(|degrees| f64::from(*degrees).to_radians());
        (Some(rings::table(elevations_rad)), ElevationSource::Configured)
    } else if let Some(model) = config.model {
        (Some(Calibration::factory(model)), ElevationSource::Model)
    } else {
        (None, ElevationSource::Unknown)
    }
}

/// Source of the elevations of a revolution.
fn revolution_elevations(source: CalibrationSource, model: Model) -> ElevationSource {
    match (source, model) {
        (CalibrationSource::Configured, _) => ElevationSource::Table,
        (CalibrationSource::StatusBytes, _) => ElevationSource::StatusBytes,
        (CalibrationSource::Factory, Model::Hdl64eS1 | Model::Hdl64eS2 | Model::Hdl64eS3) => ElevationSource::Nominal,
        (CalibrationSource::Factory, _) => ElevationSource::Model,
    }
}
