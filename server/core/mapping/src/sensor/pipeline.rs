//! One sensor: from its events to its newest turn in the ego frame.
//!
//! In: datagrams and scans of one sensor, what is known of the vehicle's motion. Out: [`Turn`], the newest revolution
//! or scan as a [`Sweep`] at its own end, with the rays that came back with nothing where a map asks for them.

use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::{Partial, Revolution};
use clearway_lidar::sensor::{Sensor, SensorStatus};
use nalgebra::{Isometry3, Vector3};

use crate::sensor::self_filter::Screen;
use crate::config::{BodyConfig, SensorConfig};
use crate::event::Scan;
use crate::ledger::{Dropped, Ledger, Rejected};
use crate::layer::{Rays, ScanExtras};
use crate::map::{Part, SensorState};
use crate::sensor::motion::{Compensation, KNOT_FIRINGS, Motion, Moved};
use crate::sensor::rings;
use crate::sensor::distance_series::Series;
use crate::sensor::sweep::{Mount, Sweep};

/// When an event arrived.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Moment {
    /// As the door read it.
    pub arrival_ns: i64,
    /// Event time of the vehicle: the sum of all steps forward from arrival to arrival. A host clock that is set back
    /// does not turn it back.
    pub event_ns: i64,
}

impl Moment {
    /// The moment of the next event.
    pub fn next(self, arrival_ns: i64) -> Self {
        let step_ns = arrival_ns.saturating_sub(self.arrival_ns).max(0);
        Self { arrival_ns, event_ns: self.event_ns.saturating_add(step_ns) }
    }
}

/// A sensor's newest revolution or scan.
#[derive(Default)]
pub(crate) struct Turn {
    pub start_ns: i64,
    pub end_ns: i64,
    /// When its last event came.
    pub completed: Moment,
    pub is_revolution: bool,
    /// Ego frame at `end_ns`.
    pub sweep: Sweep,
    /// Directions, ego frame at `end_ns`.
    pub no_returns: Vec<[f32; 3]>,
    pub compensation: Compensation,
    pub map_from_ego: Option<Isometry3<f64>>,
    pub speed_mps: Option<f64>,
    /// Its part in a map it contributes to.
    pub state: SensorState,
}

/// One sensor of the vehicle.
pub(crate) struct Intake {
    name: String,
    sensor: Sensor,
    mount: Mount,
    screen: Option<Screen>,
    /// Of the lasers behind scans; `None` while nobody tells.
    scan_calibration: Option<Arc<Calibration>>,
    newest_scan: Option<(i64, i64)>,
    scans: u64,
    scan_returns: u64,
    /// Where a map asks for it.
    series: Option<Series>,
    wants_no_returns: bool,
    moved: Moved,
    unfit: u64,
    pub ledger: Ledger,
    /// Turns completed so far.
    pub turns: u64,
    pub turn: Turn,
}

impl Intake {
    pub fn new(
        config: &SensorConfig,
        calibration: Option<Calibration>,
        body: Option<&BodyConfig>,
        wanted: ScanExtras,
    ) -> Self {
        let ego_from_sensor = config.extrinsics.ego_from_sensor();
        let place = ego_from_sensor.translation;
        let configured = (!config.elevations_deg.is_empty())
            .then(|| rings::table(config.elevations_deg.iter().map(|degrees| f64::from(*degrees).to_radians())));
        let factory = || config.model.map(Calibration::factory);
        Self {
            name: config.name.clone(),
            scan_calibration: calibration.clone().or_else(factory).or(configured).map(Arc::new),
            sensor: Sensor::new(config.lidar(calibration)),
            screen: Screen::new(body, [place.x, place.y, place.z].map(|metres| metres as f32), &config.blind_deg),
            mount: Mount { ego_from_sensor, range_m_min: config.range_m_min },
            newest_scan: None,
            scans: 0,
            scan_returns: 0,
            series: wanted.deviations.then(Series::default),
            wants_no_returns: wanted.no_returns,
            moved: Moved::default(),
            unfit: 0,
            ledger: Ledger::default(),
            turns: 0,
            turn: Turn::default(),
        }
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// What the maps want of the turns from now on.
    pub fn want(&mut self, wanted: ScanExtras) {
        match (&self.series, wanted.deviations) {
            (None, true) => self.series = Some(Series::default()),
            (Some(_), false) => self.series = None,
            (None, false) | (Some(_), true) => {}
        }
        self.wants_no_returns = wanted.no_returns;
        if !wanted.no_returns {
            self.turn.no_returns.clear();
        }
    }

    /// What the sensor has shown of itself; a scan counts as a revolution.
    pub fn status(&self) -> SensorStatus {
        let mut status = self.sensor.status();
        status.revolutions += self.scans;
        status.returns += self.scan_returns;
        status
    }

    /// The revolution behind the newest turn; `None` where that was a scan.
    pub fn revolution(&self) -> Option<&Revolution> {
        if self.turn.is_revolution { self.sensor.newest() } else { None }
    }

    /// The newest turn as maps that gather evidence see it.
    pub fn rays(&self, sensor: u16) -> Rays<'_> {
        let place = self.mount.ego_from_sensor.translation;
        Rays {
            sensor,
            stamp_ns: self.turn.end_ns,
            returns: &self.turn.sweep,
            origin_m: [place.x, place.y, place.z].map(|metres| metres as f32),
            no_returns: &self.turn.no_returns,
            map_from_ego: self.turn.map_from_ego,
            speed_mps: self.turn.speed_mps,
        }
    }

    /// Takes a datagram; the points left out of the turn it completed, if it completed one.
    pub fn take_datagram(&mut self, payload: &[u8], motion: &Motion, now: Moment) -> Result<Option<Dropped>, Rejected> {
        let completed = self.sensor.push(payload, now.arrival_ns)?.is_some();
        Ok(if completed { self.take_revolution(motion, now) } else { None })
    }

    /// Packets that counted as decoded while they were held, and then were not of the model found.
    pub fn count_unfit(&mut self) -> u64 {
        let unfit = self.sensor.packets_unfit() - self.unfit;
        self.unfit += unfit;
        unfit
    }

    /// The newest telemetry's GPRMC.
    pub fn tell_speed(&self, motion: &mut Motion) {
        if let Some(gprmc) = self.sensor.gprmc() {
            motion.take_gprmc(gprmc, self.sensor.newest().map(|revolution| revolution.end_ns));
        }
    }

    /// The source has ended: what is left of its turn.
    pub fn finish(&mut self, motion: &Motion, now: Moment) -> Option<Dropped> {
        self.sensor.finish()?;
        self.take_revolution(motion, now)
    }

    fn take_revolution(&mut self, motion: &Motion, now: Moment) -> Option<Dropped> {
        let revolution = self.sensor.newest()?;
        let (turn, mount, screen) = (&mut self.turn, &self.mount, self.screen.as_ref());
        motion.through(revolution, &mut self.moved);
        let dropped = turn.sweep.take_revolution_around(revolution, mount, &self.moved.end_from_ego, screen);
        if let Some(series) = &mut self.series {
            turn.sweep.take_deviations(revolution, mount, series, screen);
        }
        if self.wants_no_returns {
            look_for_no_returns(revolution, mount, &self.moved, screen, &mut turn.no_returns);
        }
        turn.state = SensorState {
            name: self.name.clone(),
            model: crate::pipeline::model_name(revolution.model).to_owned(),
            packets: revolution.packets,
            packets_expected: revolution.packets_expected,
            refused: 0,
            returns: turn.sweep.returns,
            rpm: revolution.rpm,
            completeness: completeness(revolution),
            partial: revolution.partial.map_or("", Partial::as_str),
            state: if revolution.partial.is_some() { Part::Partial } else { Part::Ok },
            age_ms: None,
            blocked: revolution.blocked.clone(),
            clock: revolution.clock.as_str(),
            clock_offset_ms: revolution.clock_offset_ms,
        };
        (turn.start_ns, turn.end_ns, turn.is_revolution) = (revolution.start_ns, revolution.end_ns, true);
        self.end_turn(motion, now);
        Some(dropped)
    }

    /// Takes a scan. One not newer than the newest is refused, unless none came for `deadline_ns` of event time: then
    /// the sensor has begun anew, or its clock was set back.
    pub fn take_scan(
        &mut self,
        scan: &Scan,
        motion: &Motion,
        now: Moment,
        deadline_ns: i64,
    ) -> Result<Dropped, Rejected> {
        check(scan)?;
        if let Some((newest_ns, taken_ns)) = self.newest_scan
            && (scan.stamp_ns == newest_ns || now.event_ns.saturating_sub(taken_ns) <= deadline_ns)
        {
            Rejected::unless_newer(scan.stamp_ns, Some(newest_ns))?;
        }
        self.newest_scan = Some((scan.stamp_ns, now.event_ns));
        if self.scan_calibration.is_none() {
            self.scan_calibration = rings::measured(scan).map(Arc::new);
        }
        let turn = &mut self.turn;
        motion.through_scan(scan, &mut self.moved);
        let (calibration, moved) = (self.scan_calibration.as_ref(), &self.moved.end_from_ego);
        let dropped = turn.sweep.take_scan_around(scan, calibration, &self.mount, moved, self.screen.as_ref());
        turn.no_returns.clear();
        if self.wants_no_returns {
            let into_ego = |ray: &[f32; 3]| turned(&self.mount.ego_from_sensor, *ray);
            let blind = |ray: &[f32; 3]| self.screen.as_ref().is_some_and(|screen| screen.blinds(*ray));
            turn.no_returns.extend(scan.no_returns.iter().filter(|ray| !blind(ray)).map(into_ego));
        }
        turn.state = SensorState {
            name: self.name.clone(),
            model: "scan".to_owned(),
            returns: turn.sweep.returns,
            // Whoever assembled it knows its field of view.
            completeness: 1.0,
            state: Part::Ok,
            clock: "sender",
            clock_offset_ms: now.arrival_ns.saturating_sub(scan.stamp_ns) / 1_000_000,
            ..SensorState::default()
        };
        let first = scan.offset_ns.iter().min().copied().unwrap_or(0);
        (turn.start_ns, turn.end_ns) = (scan.stamp_ns.saturating_add(i64::from(first)), scan.stamp_ns);
        turn.is_revolution = false;
        (self.scans, self.scan_returns) = (self.scans + 1, self.scan_returns + u64::from(turn.sweep.returns));
        self.end_turn(motion, now);
        Ok(dropped)
    }

    fn end_turn(&mut self, motion: &Motion, now: Moment) {
        self.turn.completed = now;
        self.turn.compensation = self.moved.compensation;
        self.turn.speed_mps = self.moved.speed_mps;
        self.turn.map_from_ego = motion.map_from_ego(self.turn.end_ns);
        self.turns += 1;
    }
}

fn check(scan: &Scan) -> Result<(), Rejected> {
    let (x, y, z, intensity) = (scan.x.len(), scan.y.len(), scan.z.len(), scan.intensity.len());
    if x != y || x != z || x != intensity {
        return Err(Rejected::ScanLengths { x, y, z, intensity });
    }
    for (list, length) in [("ring", scan.ring.len()), ("offset_ns", scan.offset_ns.len())] {
        if length != 0 && length != x {
            return Err(Rejected::ScanList { list, length, points: x });
        }
    }
    if let Some(&offset_ns) = scan.offset_ns.iter().max().filter(|offset_ns| **offset_ns > 0) {
        return Err(Rejected::ScanOffset { offset_ns });
    }
    // Single precision, and whoever rounds it: a thousandth is 0.06 degrees of a direction's length alone. NaN is in no
    // range.
    let unit = |ray: &[f32; 3]| (0.998..=1.002).contains(&ray.iter().map(|v| v * v).sum::<f32>());
    match scan.no_returns.iter().find(|ray| !unit(ray)) {
        Some(&direction) => Err(Rejected::NoReturn { direction }),
        None => Rejected::unless_in_range(scan.stamp_ns),
    }
}

/// Directions of the firings' lasers that came back with nothing, but for those that are hidden, in place of what
/// `no_returns` held. A laser is taken to fire with the first of its firing, 0.2 degrees off at most.
fn look_for_no_returns(
    revolution: &Revolution,
    mount: &Mount,
    moved: &Moved,
    screen: Option<&Screen>,
    no_returns: &mut Vec<[f32; 3]>,
) {
    no_returns.clear();
    let Some(echo) = revolution.echoes.first() else { return };
    let lasers: Vec<(f32, [f32; 2])> = (revolution.calibration.lasers.iter())
        .map(|laser| {
            (laser.rot_correction as f32, [laser.vert_correction.sin() as f32, laser.vert_correction.cos() as f32])
        })
        .collect();
    for (number, (firing, range_m)) in revolution.firings.iter().zip(echo.range_m.chunks(revolution.lasers)).enumerate()
    {
        if !range_m.contains(&0.0) {
            continue;
        }
        // The knot before: a turn of 1 rad/s errs by a milliradian.
        let ego_from_sensor = moved
            .end_from_ego
            .get(number / KNOT_FIRINGS)
            .map_or(mount.ego_from_sensor, |end_from_ego| end_from_ego * mount.ego_from_sensor);
        let nothing = range_m.iter().zip(&lasers).enumerate().filter(|(_, (range, _))| **range == 0.0);
        for (laser, (_, &(rotation, [up, flat]))) in nothing {
            let azimuth_rad = firing.azimuth_rad - rotation;
            let ray = direction(azimuth_rad, [up, flat]);
            let blind = screen.is_some_and(|screen| screen.blinds(ray));
            if !blind && !revolution.blocked.hides(laser, azimuth_rad) {
                no_returns.push(turned(&ego_from_sensor, ray));
            }
        }
    }
}

/// Of a laser with this sine and cosine of its elevation, sensor's frame; azimuths run clockwise.
fn direction(azimuth_rad: f32, [up, flat]: [f32; 2]) -> [f32; 3] {
    let (sin, cos) = azimuth_rad.sin_cos();
    [flat * cos, -flat * sin, up]
}

fn turned(by: &Isometry3<f64>, direction: [f32; 3]) -> [f32; 3] {
    let turned = by.rotation * Vector3::from(direction.map(f64::from));
    [turned.x, turned.y, turned.z].map(|metres| metres as f32)
}

/// Share of the field of view's degrees in which a firing lies.
fn completeness(revolution: &Revolution) -> f32 {
    let mut seen = [false; 360];
    for firing in &revolution.firings {
        let degree = firing.azimuth_rad.to_degrees();
        // `as` saturates, so an azimuth of exactly 2π (or a wild one) falls into the last degree.
        seen[(degree as usize).min(359)] = true;
    }
    let dark = |degree: usize| {
        revolution.dark_rad.is_some_and(|ends| {
            let [from_deg, to_deg] = ends.map(f32::to_degrees);
            (degree as f32 - from_deg).rem_euclid(360.0) + 1.0 <= (to_deg - from_deg).rem_euclid(360.0)
        })
    };
    let lit = (0..360).filter(|&degree| seen[degree] || !dark(degree)).count();
    seen.iter().filter(|s| **s).count() as f32 / lit.max(1) as f32
}

#[cfg(test)]
mod tests {
    use clearway_lidar::model::Model;
    use clearway_sim::scanner::ScannerConfig;
    use clearway_sim::scenes;
    use clearway_sim::vehicle::SimulatedVehicle;

    use super::*;

    #[test]
    fn a_ray_without_a_return_points_where_its_laser_did() {
        let config = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
        let revolution = SimulatedVehicle::new(scenes::flat(), config).revolution(1);
        let echo = &revolution.echoes[0];
        let at = |slot: usize| (slot / revolution.lasers, slot % revolution.lasers);
        let mut checked = 0;
        for slot in (0..echo.range_m.len()).filter(|slot| echo.range_m[*slot] > 5.0) {
            let (firing, laser) = at(slot);
            let laser = &revolution.calibration.lasers[laser];
            let elevation = [laser.vert_correction.sin() as f32, laser.vert_correction.cos() as f32];
            let ray = direction(revolution.firings[firing].azimuth_rad - laser.rot_correction as f32, elevation);
            let along = [echo.x[slot], echo.y[slot], echo.z[slot]].iter().zip(ray).map(|(p, r)| p * r).sum::<f32>();
            // Half a degree.
            assert!(along / echo.range_m[slot] > 0.99996, "slot {slot}");
            checked += 1;
        }
        assert!(checked > 5000);
        let turned = Isometry3::new(Vector3::new(0.0, 0.0, 1.9), Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
        let (mut level, mut left) = (Vec::new(), Vec::new());
        let mut mount = Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, 1.9), range_m_min: 2.0 };
        look_for_no_returns(&revolution, &mount, &Moved::default(), None, &mut level);
        mount.ego_from_sensor = turned;
        look_for_no_returns(&revolution, &mount, &Moved::default(), None, &mut left);
        assert_eq!(level.len(), echo.range_m.iter().filter(|range| **range == 0.0).count());
        assert!(level.len() > 10_000 && level.iter().any(|ray| ray[2] > 0.2), "the sky gives nothing back");
        for (level, left) in level.iter().zip(&left) {
            assert!((level[0] - left[1]).abs() < 1e-5 && (level[1] + left[0]).abs() < 1e-5 && level[2] == left[2]);
        }
    }
}
