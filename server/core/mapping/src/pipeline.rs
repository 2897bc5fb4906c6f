//! Conducts one vehicle: events in, maps out, nothing but the events deciding.
//!
//! In: [`Event`]s in the order the door took them. Out: a [`Map`] for every turn that makes one. The hops: datagram or
//! scan -> its sensor's [`Intake`] -> that sensor's newest turn -> [`Fusion`] -> the map's [`Sweep`] -> one layer a map
//! -> [`Map`].

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::sensor::SensorStatus;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;

use crate::config::{ConfigError, MapsConfig, SensorConfig, VehicleConfig};
use crate::event::{Body, Cause, EgoPose, Event, Road, Scan};
use crate::fusion::Fusion;
use crate::sensor::pipeline::{Intake, Moment};
use crate::layer::registry::Layers;
use crate::layer::{Context, ScanExtras};
use crate::ledger::Dropped;
pub use crate::ledger::{Ledger, Rejected};
use crate::map::Map;
use crate::sensor::motion::{Compensation, Motion};
use crate::road::{self, Roads};
use crate::sensor::sweep::Sweep;

/// One vehicle's way from events to maps.
pub struct Pipeline {
    config: VehicleConfig,
    /// By source.
    intakes: Vec<Intake>,
    motion: Motion,
    roads: Roads,
    fusion: Fusion,
    ledger: Ledger,
    now: Option<Moment>,
    /// When the newest pose was taken, event time.
    pose_event_ns: Option<i64>,
    maps_made: u64,
    /// Whether a turn has ended that is in no map.
    turn_since_map: bool,
    layers: Layers,
    map: Map,
}

/// A sensor as configured, and what it has shown of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedStatus {
    /// From the configuration.
    pub name: String,
    /// From the data; a scan counts as a revolution.
    pub status: SensorStatus,
    /// What came of everything this sensor sent.
    pub ledger: Ledger,
}

impl Pipeline {
    /// A pipeline that has seen nothing. `calibrations[i]` is the table read from `config.sensors[i].calibration`;
    /// `None` where the factory's (or the one in the sensor's status bytes) is meant.
    ///
    /// # Errors
    /// [`ConfigError`] for the first value that cannot be used.
    pub fn new(config: &VehicleConfig, calibrations: Vec<Option<Calibration>>) -> Result<Self, ConfigError> {
        config.validate()?;
        if calibrations.len() != config.sensors.len() {
            return Err(ConfigError::new("vehicle.sensor", "calibrations", "one calibration, or none, a sensor"));
        }
        let layers = Layers::new(&config.maps);
        let lead = config.lead().expect("validate() finds the lead");
        let wanted = layers.uses();
        let intake = |(index, (sensor, calibration)): (usize, (&SensorConfig, _))| {
            let wanted = ScanExtras { deviations: wanted.deviations && index == lead, ..wanted };
            Intake::new(sensor, calibration, config.body.as_ref(), wanted)
        };
        Ok(Self {
            intakes: config.sensors.iter().zip(calibrations).enumerate().map(intake).collect(),
            motion: Motion::new(&config.maps.motion),
            roads: Roads::default(),
            fusion: Fusion::new(&config.fusion, lead),
            ledger: Ledger::default(),
            now: None,
            pose_event_ns: None,
            maps_made: 0,
            turn_since_map: false,
            map: Map {
                sequence: 0,
                capture_start_ns: 0,
                capture_end_ns: 0,
                completed_ns: 0,
                map_from_ego: None,
                speed_mps: None,
                compensation: Compensation::None,
                made_by: 0,
                sensors: Vec::new(),
                layers: Vec::new(),
            },
            layers,
            config: config.clone(),
        })
    }

    /// Takes one event; gives the map it completed, if any. The same events give the same maps, byte for byte.
    ///
    /// # Errors
    /// [`Rejected`] with the values that were wrong, once counted in the ledger.
    pub fn step(&mut self, event: &Event) -> Result<Option<&Map>, Rejected> {
        let first = Moment { arrival_ns: event.arrival_ns, event_ns: 0 };
        let now = self.now.map_or(first, |before| before.next(event.arrival_ns));
        self.now = Some(now);
        match &event.body {
            Body::Datagram(_) | Body::Scan(_) => self.count(event.source, |ledger| ledger.received += 1),
            Body::Lost { cause, count } if cause.has_source() => {
                self.count(event.source, |ledger| ledger.stayed_outside(*cause, *count));
            }
            Body::Lost { cause, count } => self.ledger.stayed_outside(*cause, *count),
            Body::EgoPose(_) | Body::Road(_) | Body::Sensor(_) | Body::End => {}
        }
        match self.take(event, now) {
            Ok(None) => Ok(None),
            Ok(Some(dropped)) => {
                self.count(event.source, |ledger| ledger.add_dropped(dropped));
                Ok(self.end_turn(event.source, now).then_some(&self.map))
            }
            Err(rejected) => {
                let reason = rejected.reason();
                match event.body {
                    Body::Datagram(_) | Body::Scan(_) => {
                        self.count(event.source, |ledger| *ledger.refused.entry(reason).or_default() += 1);
                    }
                    Body::EgoPose(_) => self.ledger.poses_refused += 1,
                    Body::Road(_) => *self.ledger.roads_refused.entry(reason).or_default() += 1,
                    Body::Sensor(_) => self.ledger.sensors_refused += 1,
                    // One that is taken is no reading; one of a sensor that is not there stands for one.
                    Body::End => self.ledger.stayed_outside(Cause::Sender, 1),
                    Body::Lost { .. } => {}
                }
                Err(rejected)
            }
        }
    }

    /// From now on makes the layers that are named and those they are made from; the others cost nothing and are in no
    /// map. All are wanted before the first call. Layers that gather evidence begin from unknown when they are wanted
    /// again, so only where all are wanted throughout do the same events give the same bytes of every layer.
    pub fn want(&mut self, is_wanted: impl Fn(&str) -> bool) {
        if !self.layers.set_active(&self.config.maps, is_wanted) {
            return;
        }
        let wanted = self.layers.uses();
        let lead = self.config.lead();
        for (index, intake) in self.intakes.iter_mut().enumerate() {
            intake.want(ScanExtras { deviations: wanted.deviations && lead == Some(index), ..wanted });
        }
    }

    /// How often each layer was made, in the order of the layers.
    pub fn layers_made(&self) -> Vec<(&'static str, u64)> {
        self.layers.made()
    }

    /// What came of everything so far, of all sensors.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The sensors in the order of the configuration, then those declared.
    pub fn sensors(&self) -> Vec<NamedStatus> {
        let named = |intake: &Intake| NamedStatus {
            name: intake.name().to_owned(),
            status: intake.status(),
            ledger: intake.ledger.clone(),
        };
        self.intakes.iter().map(named).collect()
    }

    /// The newest map, until the next one is made; `None` before the first.
    pub fn newest_map(&self) -> Option<&Map> {
        (self.maps_made > 0).then_some(&self.map)
    }

    /// The points the newest map was made from, ego frame at its capture's end; empty before the first turn.
    pub fn newest_sweep(&self) -> &Sweep {
        self.fusion.sweep(&self.intakes)
    }

    /// The revolution that made the newest map; `None` before the first, and where a scan made it.
    pub fn newest_revolution(&self) -> Option<&Revolution> {
        self.intakes[self.fusion.maker()?].revolution()
    }

    /// The vehicle's ledger, and its sensor's where there is one.
    fn count(&mut self, source: u16, add: impl Fn(&mut Ledger)) {
        add(&mut self.ledger);
        if let Some(intake) = self.intakes.get_mut(usize::from(source)) {
            add(&mut intake.ledger);
        }
    }

    /// What was left out of the turn that the event completed, if it completed one.
    fn take(&mut self, event: &Event, now: Moment) -> Result<Option<Dropped>, Rejected> {
        match &event.body {
            Body::EgoPose(pose) => self.take_ego_pose(pose, now).map(|()| None),
            Body::Road(road) => self.take_road(road, now).map(|()| None),
            Body::Sensor(sensor) => self.take_sensor(event.source, sensor).map(|()| None),
            Body::Lost { .. } => Ok(None),
            Body::Datagram(payload) => self.take_datagram(event.source, payload, now),
            Body::Scan(scan) => self.take_scan(event.source, scan, now).map(Some),
            Body::End => {
                let left_out = intake_of(&mut self.intakes, event.source)?.finish(&self.motion, now);
                self.count_unfit(event.source);
                Ok(left_out)
            }
        }
    }

    fn take_datagram(&mut self, source: u16, payload: &[u8], now: Moment) -> Result<Option<Dropped>, Rejected> {
        let intake = intake_of(&mut self.intakes, source)?;
        let completed = intake.take_datagram(payload, &self.motion, now)?;
        if payload.len() == TELEMETRY_LENGTH {
            intake.tell_speed(&mut self.motion);
            self.count(source, |ledger| ledger.telemetry += 1);
        } else {
            self.count(source, |ledger| ledger.decoded += 1);
        }
        self.count_unfit(source);
        Ok(completed)
    }

    /// What was held until the model was known, and then did not fit it, was not decoded after all.
    fn count_unfit(&mut self, source: u16) {
        let unfit = self.intakes.get_mut(usize::from(source)).map_or(0, Intake::count_unfit);
        if unfit > 0 {
            self.count(source, |ledger| {
                ledger.decoded -= unfit;
                *ledger.refused.entry("model").or_default() += unfit;
            });
        }
    }

    fn take_scan(&mut self, source: u16, scan: &Scan, now: Moment) -> Result<Dropped, Rejected> {
        let (motion, deadline_ns) = (&self.motion, self.fusion.deadline_ns);
        let dropped = intake_of(&mut self.intakes, source)?.take_scan(scan, motion, now, deadline_ns)?;
        self.count(source, |ledger| ledger.decoded += 1);
        Ok(dropped)
    }

    /// One not newer than the newest is refused, unless none was taken for the deadline: then its sender has begun anew, or its
    /// clock was set back.
    fn take_ego_pose(&mut self, pose: &EgoPose, now: Moment) -> Result<(), Rejected> {
        Rejected::unless_in_range(pose.stamp_ns)?;
        let rotation = pose.map_from_ego.rotation.coords;
        let position = pose.map_from_ego.translation.vector;
        // NaN fails every comparison, and a NaN in the quaternion makes the norm NaN, which is in no range.
        let possible = position.iter().all(|v| v.abs() <= 1e9) && pose.speed_mps.abs() <= 1000.0;
        if !possible || !(1.0 - 1e-6..=1.0 + 1e-6).contains(&rotation.norm()) {
            return Err(Rejected::Pose { stamp_ns: pose.stamp_ns });
        }
        if self.pose_event_ns.is_some_and(|taken_ns| now.event_ns.saturating_sub(taken_ns) > self.fusion.deadline_ns)
            && self.motion.newest_pose().is_some_and(|newest| pose.stamp_ns <= newest.stamp_ns)
        {
            self.motion.forget_poses();
        }
        Rejected::unless_newer(pose.stamp_ns, self.motion.newest_pose().map(|p| p.stamp_ns))?;
        self.motion.take_pose(pose);
        self.pose_event_ns = Some(now.event_ns);
        self.ledger.poses += 1;
        Ok(())
    }

    fn take_road(&mut self, road: &Road, now: Moment) -> Result<(), Rejected> {
        Rejected::unless_in_range(road.stamp_ns)?;
        road::check(road)?;
        // One stamped later than now, by the host's clock, was stamped by a clock that was set back since, or is wrong.
        let latest_ns = now.arrival_ns.saturating_add(self.fusion.deadline_ns);
        let newest_ns = self.roads.newest_stamp_ns(road.purpose).filter(|newest_ns| *newest_ns <= latest_ns);
        Rejected::unless_newer(road.stamp_ns, newest_ns)?;
        self.roads.take(road, self.motion.map_from_ego(road.stamp_ns));
        self.ledger.roads += 1;
        Ok(())
    }

    fn take_sensor(&mut self, source: u16, sensor: &SensorConfig) -> Result<(), Rejected> {
        let calibration = self.config.declare(usize::from(source), sensor)?;
        if self.intakes.len() < self.config.sensors.len() {
            let wanted = ScanExtras { deviations: false, ..self.layers.uses() };
            self.intakes.push(Intake::new(sensor, calibration, self.config.body.as_ref(), wanted));
        }
        self.ledger.sensors += 1;
        Ok(())
    }

    /// A sensor's turn has ended: the maps that gather see it, and perhaps it makes a map.
    fn end_turn(&mut self, source: u16, now: Moment) -> bool {
        let index = usize::from(source);
        self.motion.take_turn(self.intakes[index].turn.end_ns);
        // What comes that much too late is evidence of a world that has moved on.
        if self.fusion.is_timely(&self.intakes[index], &self.intakes, now) {
            let rays = self.intakes[index].rays(source);
            self.layers.integrate(&rays);
        }
        let makes_map = self.fusion.makes_map(index, &self.intakes, now);
        if makes_map {
            self.make_map(source, now);
        }
        self.turn_since_map = !makes_map;
        makes_map
    }

    /// Makes the newest map once more, under the next sequence, where it was made for nobody and somebody has come
    /// since: a late reader need not wait for a sensor that may be silent. `None` where there is nothing to make, and
    /// where another sensor's turn has ended since. Layers that gather evidence have seen one turn.
    pub fn make_late(&mut self) -> Option<&Map> {
        let was_for_nobody = self.maps_made > 0 && self.map.layers.is_empty();
        if !was_for_nobody || !self.layers.any_active() || self.turn_since_map {
            return None;
        }
        let source = self.map.made_by;
        self.layers.integrate(&self.intakes[usize::from(source)].rays(source));
        self.map.sequence = self.maps_made;
        self.maps_made += 1;
        self.make_layers();
        Some(&self.map)
    }

    /// The map of a sensor's newest turn, in place of the one before.
    fn make_map(&mut self, source: u16, now: Moment) {
        let gathered = self.fusion.gather(usize::from(source), &self.intakes, &self.motion, now);
        let (map, turn) = (&mut self.map, &self.intakes[usize::from(source)].turn);
        map.sequence = self.maps_made;
        self.maps_made += 1;
        (map.capture_start_ns, map.capture_end_ns, map.completed_ns) = (gathered.start_ns, turn.end_ns, now.arrival_ns);
        (map.map_from_ego, map.speed_mps) = (turn.map_from_ego, turn.speed_mps);
        (map.compensation, map.sensors, map.made_by) = (gathered.compensation, gathered.sensors, source);
        self.make_layers();
    }

    fn make_layers(&mut self) {
        let (map, sweep) = (&mut self.map, self.fusion.sweep(&self.intakes));
        let (road, route) = (self.roads.to_paint(), self.roads.route());
        let stamp_ns = map.capture_end_ns;
        let earliest_ns = stamp_ns.saturating_sub(self.fusion.deadline_ns);
        let context = Context { earlier: &[], stamp_ns, earliest_ns, map_from_ego: map.map_from_ego, road, route };
        self.layers.make(sweep, &context, &mut map.layers);
    }
}

fn intake_of(intakes: &mut [Intake], source_index: u16) -> Result<&mut Intake, Rejected> {
    let sensors = intakes.len();
    intakes.get_mut(usize::from(source_index)).ok_or(Rejected::Source { source_index, sensors })
}

/// Names of the layers of a vehicle's maps, in order.
pub fn layer_names(maps: &MapsConfig) -> Vec<&'static str> {
    Layers::new(maps).made().into_iter().map(|(name, _)| name).collect()
}

/// The model that [`model_name`] spells so.
pub fn model_of_name(name: &str) -> Option<Model> {
    Model::ALL.into_iter().find(|model| model_name(*model) == name)
}

/// The model as the configuration and the wire spell it.
pub fn model_name(model: Model) -> &'static str {
    match model {
        Model::Hdl64eS1 => "hdl64e_s1",
        Model::Hdl64eS2 => "hdl64e_s2",
        Model::Hdl64eS3 => "hdl64e_s3",
        Model::Hdl32e => "hdl32e",
        Model::Vlp16 => "vlp16",
        Model::PuckHiRes => "puck_hi_res",
        Model::Vlp32c => "vlp32c",
        Model::Vls128 => "vls128",
    }
}
