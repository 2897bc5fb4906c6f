//! Several sensors, one map: which sensor's scan makes the map, and what the others contribute.
//!
//! In: the newest scan of each sensor, ego frame at its own end, and the event that completed one of them. Out: whether
//! that scan makes a map, and the map's [`Sweep`]: the points of that scan and the newest points of every other sensor,
//! propagated rigidly by the vehicle's motion from their own end to the map's stamp. The events alone decide:
//!
//! - The source of a map is the first usable sensor in this order: the reference sensor, then the others as they are
//!   configured. A sensor is not usable while it completes no scan for `deadline_ms` of event time, or while its scans
//!   arrive that much later after their stamps (or that much earlier before them) than the scans of the timeliest
//!   sensor.
//! - A map waits for the scans of other sensors that are due with the same stamp: those whose stamp before, plus the
//!   time between their last two stamps, is the map's stamp. It waits until they are there, until an event shows that a
//!   quarter of `deadline_ms` has passed, or until the next scan makes a map. A vehicle with one sensor never waits.
//! - A scan without points and rays makes no map and is in no map while another sensor is usable.
//! - If no map was made for `deadline_ms` (for `period_ms` if that is more), the next timely scan of any sensor makes
//!   one: no silent sensor holds back the maps.
//! - Radial maps have the rows of the reference sensor once it has completed a scan, whichever sensor is the source. If
//!   a sensor has few lasers, a row may cover all the ground, and one return would make all of it drivable.
//! - A scan whose end is more than `deadline_ms` away from the map's stamp is not in the map. The map names its sensor
//!   with the age of the scan.
//!
//! The order in which the scans of different sensors arrive between two maps does not change the layers that are made
//! from the sweep.

pub(crate) mod config;
pub(crate) mod reference_sensor;

use std::sync::Arc;

use nalgebra::Isometry3;

use crate::event_time::EventTime;
use crate::fusion::config::FusionConfig;
use crate::sensor::motion::{Compensation, Motion};
use crate::sensor::scan::SensorScan;
use crate::sensor::state::{Contribution, SensorState};
use crate::sensor::sweep::Sweep;

const NS_PER_MS: i64 = 1_000_000;
/// A scan of the same source makes a map once `period_ms` less one part in this many has passed. Ours: sensors jitter
/// by some per cent of their own period, and a scan that comes a little early must not halve the rate of maps.
const PERIOD_TOLERANCE_PARTS: i64 = 10;

/// A map waits at most the deadline divided by this. Ours: scans that are taken together arrive within some
/// milliseconds of each other, and a map that waits is older for the planner.
const WAIT_PARTS: i64 = 4;
/// Stamps that differ by at most this part of a sensor's period are equal. Ours: sensors that are locked to each other
/// turn evenly to a per cent.
const EQUAL_STAMP_PARTS: i64 = 50;

/// The newest map, as far as the next one depends on it.
#[derive(Clone, Copy, Debug)]
struct NewestMap {
    /// `None` once its sensor was withdrawn.
    source: Option<usize>,
    stamp_ns: i64,
    event_ns: i64,
}

/// A map whose source has completed its scan, while scans with the same stamp are due.
#[derive(Clone)]
struct WaitingMap {
    /// What the map has of its source's scan alone. A later scan does not change it.
    own: MergedScans,
    /// Indices of the sensors whose scans are due.
    due: Vec<usize>,
    /// Event time from which the map waits, ns.
    since_ns: i64,
}

/// The fusion of one vehicle.
#[derive(Clone)]
pub(crate) struct Fusion {
    reference_sensor: usize,
    deadline_ns: i64,
    period_ns: i64,
    newest: Option<NewestMap>,
    waiting: Option<WaitingMap>,
    /// Memory for the points of the next map that needs its own.
    spare: Sweep,
}

/// The scans of one map: its points, and what the map states about them.
#[derive(Clone)]
pub(crate) struct MergedScans {
    /// Index of the sensor whose scan made the map.
    pub source: usize,
    /// Stamp of the earliest first firing of the contributing scans, ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the source's last firing, ns since the Unix epoch.
    pub end_ns: i64,
    /// Ego frame in the world frame at `end_ns`; `None` if no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed at `end_ns`; `None` if it is unknown.
    pub speed_mps: Option<f64>,
    /// Weakest motion compensation among the contributing sensors.
    pub compensation: Compensation,
    /// State of every sensor, by source; `refused` is 0.
    pub sensors: Vec<SensorState>,
    /// Points, ego frame at `end_ns`.
    pub sweep: Arc<Sweep>,
    /// Number of the source's scan if its points are all the points of the map; `None` for a map of several scans.
    pub sole_scan: Option<u64>,
}

impl MergedScans {
    /// The source's scan alone.
    fn of_source(source: usize, scan: &SensorScan) -> Self {
        Self {
            source,
            start_ns: scan.start_ns,
            end_ns: scan.end_ns,
            map_from_ego: scan.map_from_ego,
            speed_mps: scan.speed_mps,
            compensation: scan.compensation,
            sensors: vec![SensorState { age_ms: Some(0.0), ..scan.state.clone() }],
            sweep: Arc::clone(&scan.sweep),
            sole_scan: Some(scan.completed),
        }
    }
}

impl Fusion {
    /// A fusion before the first map. `reference_sensor` is an index.
    pub fn new(config: &FusionConfig, reference_sensor: usize) -> Self {
        Self {
            reference_sensor,
            deadline_ns: config.deadline_ns(),
            period_ns: i64::from(config.period_ms) * NS_PER_MS,
            newest: None,
            waiting: None,
            spare: Sweep::default(),
        }
    }

    /// Sets the reference sensor from now on.
    pub fn set_reference_sensor(&mut self, reference_sensor: usize) {
        self.reference_sensor = reference_sensor;
    }

    /// Index of the reference sensor.
    pub fn reference_sensor(&self) -> usize {
        self.reference_sensor
    }

    /// Index of the sensor whose scan made the newest map; `None` before the first map, and if it was withdrawn since.
    pub fn source(&self) -> Option<usize> {
        self.newest?.source
    }

    /// Forgets a sensor that is withdrawn. A map of its last scan that still waits for scans of others is not made.
    pub fn remove_sensor(&mut self, source: usize) {
        self.newest.iter_mut().filter(|newest| newest.source == Some(source)).for_each(|newest| newest.source = None);
        self.waiting.take_if(|waiting| waiting.own.source == source);
        self.waiting.iter_mut().for_each(|waiting| waiting.due.retain(|due| *due != source));
    }

    /// True if a map waits for scans with the same stamp.
    pub fn is_waiting(&self) -> bool {
        self.waiting.is_some()
    }

    /// Takes back the memory of a map that is read no more.
    pub fn reuse(&mut self, map: MergedScans) {
        if let Some(sweep) = Arc::into_inner(map.sweep) {
            self.spare = sweep;
        }
    }

    /// Merges the newest scans if the scan that sensor `source` has just completed makes a map, or if it is the last
    /// for which a map waits; `None` if there is no map.
    pub fn merge(
        &mut self,
        source: usize,
        scans: &[SensorScan],
        motion: &Motion,
        now: EventTime,
    ) -> Option<MergedScans> {
        let makes_map = self.makes_map(source, scans, now);
        if let Some(waiting) = &mut self.waiting {
            waiting.due.retain(|due| *due != source);
        }
        let released = self.release(makes_map, scans, motion, now);
        if !makes_map {
            return released;
        }
        let own = MergedScans::of_source(source, &scans[source]);
        self.newest = Some(NewestMap { source: Some(source), stamp_ns: own.end_ns, event_ns: now.event_ns });
        let due = self.due(source, scans, now);
        if released.is_some() || !due.is_empty() {
            // Only one map is made at a time: behind a map that has waited, this one waits for the next event.
            self.waiting = Some(WaitingMap { own, due, since_ns: now.event_ns });
            return released;
        }
        Some(self.merge_scans(own, scans, motion, now))
    }

    /// Merges the map that waits if an event that completed no scan shows that it has waited long enough, or that its
    /// source or a sensor for which it waits has ended; `None` if no map waits or it goes on waiting.
    pub fn merge_waiting(
        &mut self,
        ended: Option<usize>,
        scans: &[SensorScan],
        motion: &Motion,
        now: EventTime,
    ) -> Option<MergedScans> {
        let waiting = self.waiting.as_mut()?;
        waiting.due.retain(|due| Some(*due) != ended);
        let has_ended = ended == Some(waiting.own.source);
        self.release(has_ended, scans, motion, now)
    }

    /// Merges the map that waits if nothing is due any more, if it has waited long enough, or if `is_over`.
    fn release(&mut self, is_over: bool, scans: &[SensorScan], motion: &Motion, now: EventTime) -> Option<MergedScans> {
        let wait_ns = self.deadline_ns / WAIT_PARTS;
        let is_over = |waiting: &mut WaitingMap| {
            is_over || waiting.due.is_empty() || now.event_ns.saturating_sub(waiting.since_ns) > wait_ns
        };
        let waiting = self.waiting.take_if(is_over)?;
        Some(self.merge_scans(waiting.own, scans, motion, now))
    }

    /// Indices of the sensors whose next scans have the stamp of the newest scan of `source` and arrive in time.
    fn due(&self, source: usize, scans: &[SensorScan], now: EventTime) -> Vec<usize> {
        let (stamp_ns, wait_ns) = (scans[source].end_ns, self.deadline_ns / WAIT_PARTS);
        let delay_ns = |scan: &SensorScan| scan.completed_at.arrival_ns.saturating_sub(scan.end_ns);
        let is_due = |index: &usize| {
            let scan = &scans[*index];
            let period_ns = scan.period_ns.filter(|period_ns| (1..=self.deadline_ns).contains(period_ns));
            let equal_ns = period_ns.map_or(0, |period_ns| period_ns / EQUAL_STAMP_PARTS);
            let next_ns = period_ns.map(|period_ns| scan.end_ns.saturating_add(period_ns));
            next_ns.is_some_and(|next_ns| next_ns.saturating_sub(stamp_ns).saturating_abs() <= equal_ns)
                && stamp_ns.saturating_sub(scan.end_ns) > equal_ns
                && delay_ns(scan).saturating_sub(delay_ns(&scans[source])) <= wait_ns
                && self.is_fresh(scan, now)
                && self.is_timely(*index, scans, now)
        };
        (0..scans.len()).filter(|index| *index != source).filter(is_due).collect()
    }

    /// True if the sensor's scans arrive no later after their stamps, nor earlier before them, than the scans of the
    /// timeliest fresh sensor, with the deadline as tolerance. A scan that is not timely no longer describes the scene.
    pub fn is_timely(&self, source: usize, scans: &[SensorScan], now: EventTime) -> bool {
        let delay_ns = |scan: &SensorScan| scan.completed_at.arrival_ns.saturating_sub(scan.end_ns).saturating_abs();
        let fresh = scans.iter().filter(|other| other.completed > 0 && self.is_fresh(other, now));
        let least_ns = fresh.map(delay_ns).min();
        let scan = &scans[source];
        scan.completed == 0
            || least_ns.is_none_or(|least_ns| delay_ns(scan).saturating_sub(least_ns) <= self.deadline_ns)
    }

    /// True if the scan that sensor `source` has just completed makes a map.
    fn makes_map(&self, source: usize, scans: &[SensorScan], now: EventTime) -> bool {
        let since_ns = now.event_ns.saturating_sub(self.newest.map_or(0, |newest| newest.event_ns));
        let is_overdue = since_ns > self.deadline_ns.max(self.period_ns);
        let is_usable = |&index: &usize| {
            index == source || (self.is_fresh(&scans[index], now) && self.is_timely(index, scans, now))
        };
        let seeing = self.order(scans.len()).find(|index| is_usable(index) && !scans[*index].is_empty());
        let first_usable = seeing.or_else(|| self.order(scans.len()).find(is_usable));
        self.is_timely(source, scans, now)
            && (is_overdue || first_usable == Some(source))
            && self.is_newer(source, &scans[source], is_overdue)
            && (is_overdue || self.is_due(source, &scans[source]))
    }

    /// Indices of the sensors, the reference sensor first.
    fn order(&self, sensors: usize) -> impl Iterator<Item = usize> {
        let reference = self.reference_sensor;
        std::iter::once(reference).chain((0..sensors).filter(move |index| *index != reference))
    }

    /// True if the sensor has completed a scan within the deadline. A sensor without a scan counts as fresh until the
    /// deadline after the vehicle's first event.
    fn is_fresh(&self, scan: &SensorScan, now: EventTime) -> bool {
        now.event_ns.saturating_sub(scan.completed_at.event_ns) <= self.deadline_ns
    }

    /// True if `period_ms` has passed since the same sensor made the newest map, if another sensor made it, or if the
    /// sensor's clock was set back.
    fn is_due(&self, source: usize, scan: &SensorScan) -> bool {
        self.newest.is_none_or(|newest| {
            let since_ns = scan.end_ns.saturating_sub(newest.stamp_ns);
            let tolerance_ns = self.period_ns / PERIOD_TOLERANCE_PARTS;
            newest.source != Some(source) || since_ns < 0 || since_ns >= self.period_ns - tolerance_ns
        })
    }

    /// True if the scan ended after the newest map's stamp, so that the stamps of maps rise. Three cases:
    ///
    /// - The same sensor made the newest map: true. Its stamps rise unless its clock was set back.
    /// - Another sensor made it: the scan must have a later stamp.
    /// - A map is overdue and the scan is older by more than the deadline: true if all clocks were set back, which is
    ///   assumed unless the scan arrived long after its end. A scan that arrives long after its end means a silent
    ///   sensor, not a clock that was set back.
    fn is_newer(&self, source: usize, scan: &SensorScan, is_overdue: bool) -> bool {
        self.newest.is_none_or(|newest| {
            let newer_ns = scan.end_ns.saturating_sub(newest.stamp_ns);
            let is_set_back = is_overdue && newer_ns < -self.deadline_ns && !self.came_late(scan);
            newest.source == Some(source) || newer_ns > 0 || is_set_back
        })
    }

    /// True if the scan was completed later than the deadline after its end, both on the host's clock of that time.
    fn came_late(&self, scan: &SensorScan) -> bool {
        let offset_ns = scan.state.clock_offset_ms.saturating_mul(NS_PER_MS);
        let since_ns = scan.completed_at.arrival_ns.saturating_sub(scan.end_ns).saturating_sub(offset_ns);
        since_ns.saturating_abs() > self.deadline_ns
    }

    /// Adds the scans of all other sensors to the scan of the source.
    fn merge_scans(&mut self, own: MergedScans, scans: &[SensorScan], motion: &Motion, now: EventTime) -> MergedScans {
        let (source, stamp_ns, mut merged) = (own.source, own.end_ns, own);
        let mut own_state = merged.sensors.pop();
        for (index, scan) in scans.iter().enumerate() {
            if index == source {
                merged.sensors.extend(own_state.take());
                continue;
            }
            let contribution = self.contribution(scan, stamp_ns, now);
            if contribution.is_in_map() {
                let (stamp_from_end, compensation) = motion.propagate(scan.end_ns, stamp_ns);
                self.points_mut(&mut merged).append(&scan.sweep, &stamp_from_end);
                merged.start_ns = merged.start_ns.min(scan.start_ns);
                merged.compensation = merged.compensation.min(compensation).min(scan.compensation);
            }
            merged.sensors.push(sensor_state(scan, contribution, stamp_ns));
        }
        let reference = &scans[self.reference_sensor].sweep;
        if source != self.reference_sensor && reference.calibration.is_some() {
            self.points_mut(&mut merged).copy_rows(reference);
        }
        merged
    }

    /// The map's own points, which begin as a copy of its source's.
    fn points_mut<'a>(&mut self, merged: &'a mut MergedScans) -> &'a mut Sweep {
        if merged.sole_scan.take().is_some() {
            let mut points = std::mem::take(&mut self.spare);
            points.copy_from(&merged.sweep);
            merged.sweep = Arc::new(points);
        }
        Arc::make_mut(&mut merged.sweep)
    }

    /// What the newest scan of a sensor that is not the source contributes to a map.
    fn contribution(&self, scan: &SensorScan, stamp_ns: i64, now: EventTime) -> Contribution {
        let age_ns = stamp_ns.saturating_sub(scan.end_ns);
        if scan.completed == 0 {
            Contribution::Silent
        } else if age_ns.saturating_abs() <= self.deadline_ns {
            scan.state.contribution
        } else if !self.is_fresh(scan, now) {
            Contribution::Silent
        } else if age_ns > 0 {
            Contribution::Late
        } else {
            Contribution::Ahead
        }
    }
}

fn sensor_state(scan: &SensorScan, contribution: Contribution, stamp_ns: i64) -> SensorState {
    let age_ns = stamp_ns.saturating_sub(scan.end_ns);
    let counts = if contribution.is_in_map() { scan.state.clone() } else { SensorState::default() };
    SensorState {
        name: scan.state.name.clone(),
        model: scan.state.model,
        contribution,
        clock: scan.state.clock,
        clock_offset_ms: scan.state.clock_offset_ms,
        epoch: scan.state.epoch,
        elevations: scan.state.elevations,
        age_ms: (scan.completed > 0).then(|| (age_ns as f64 / NS_PER_MS as f64) as f32),
        ..counts
    }
}
