//! The conductor of one vehicle: events in, maps out. The events alone decide what a map contains.
//!
//! In: [`Event`]s in the order of the event queue. Out: a [`Map`] for every scan that makes one. The hops of
//! [`Pipeline::step`]: event -> [`Inputs`] -> the newest scan of one sensor -> [`Fusion`] -> the map's [`Sweep`] -> its
//! [`MapGround`] -> one layer a map -> [`Map`].

use clearway_lidar::SensorStatus;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;

use crate::config::{ConfigValueError, MapsConfig, VehicleConfig};
use crate::error::EventError;
use crate::event::{Body, EgoPose, Event};
use crate::event_time::{EventClock, EventTime};
use crate::fusion::reference_sensor::ReferenceChoice;
use crate::fusion::{Fusion, MergedScans};
use crate::ground::Ground;
use crate::inputs::Inputs;
use crate::layer::Context;
use crate::layer::registry::Layers;
use crate::ledger::{Ledger, Ledgers};
use crate::map::{ElevationSource, Map, OtherClock};
use crate::map_ground::MapGround;
use crate::sensor::mount::check::MountDeviation;
use crate::sensor::pipeline::SensorPipeline;
use crate::sensor::sweep::Sweep;

/// The maps of one vehicle, made from its events. A clone goes on from the same state with other events.
#[derive(Clone)]
pub struct Pipeline {
    maps: MapsConfig,
    deadline_ns: i64,
    has_epochs: bool,
    clock: EventClock,
    inputs: Inputs,
    ledgers: Ledgers,
    reference: ReferenceChoice,
    fusion: Fusion,
    ground: MapGround,
    layers: Layers,
    /// Number of maps made so far.
    maps_made: u64,
    /// The newest map, whose memory the next one uses.
    map: Map,
    /// The scans of the newest map; `None` before the first.
    merged: Option<MergedScans>,
    /// Number of scans that were completed after the newest map was made.
    scans_since_map: u64,
}

/// A sensor with its status and its counts.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedStatus {
    /// Index of the sensor: the source of its events.
    pub source: u16,
    /// Name of the sensor in the configuration.
    pub name: String,
    /// True if it is the reference sensor: the configured sensor, else the chosen sensor.
    pub is_reference: bool,
    /// Status found from the sensor's data; a scan event counts as a revolution.
    pub status: SensorStatus,
    /// Source of the elevations of the newest scan; `None` before the first.
    pub elevations: Option<ElevationSource>,
    /// How far the ground deviates from the configured mount; `None` before the first scan with ground.
    pub mount: Option<MountDeviation>,
    /// The scans without a pose because the poses are of another clock.
    pub other_clock: OtherClock,
    /// Counts of what became of everything the sensor sent.
    pub ledger: Ledger,
}

/// What a pipeline takes over from the pipeline that it replaces: the numbers that go on.
#[derive(Clone, Debug)]
pub struct Handover {
    /// Sequence of the next map.
    pub next_map: u64,
    /// Epoch of the newest map, and the end of its capture in ns: the stamps after the handover go on from these.
    pub newest: (u32, i64),
    ledgers: Ledgers,
}

impl Handover {
    /// A handover as a recording states it: the sequence of the next map, epoch and end of the newest one, and
    /// [`Handover::refused`].
    pub fn from_recording(next_map: u64, newest: (u32, i64), refused: &[u64]) -> Self {
        Self { next_map, newest, ledgers: Ledgers::with_refused(refused) }
    }

    /// Number of refused datagrams and scans of each sensor, by source: the counts that are in maps.
    pub fn refused(&self) -> Vec<u64> {
        self.ledgers.sensors().iter().map(Ledger::refused_sum).collect()
    }
}

impl Pipeline {
    /// A pipeline before the first event, with all enabled layers active. `calibrations[i]` is the table of
    /// `config.sensors[i].calibration`; `None` selects the factory's table, or the table in the sensor's status bytes.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed, or if there are not as many calibrations as
    /// sensors.
    pub fn new(config: &VehicleConfig, calibrations: Vec<Option<Calibration>>) -> Result<Self, ConfigValueError> {
        config.validate()?;
        if calibrations.len() != config.sensors.len() {
            return Err(ConfigValueError::new("vehicle.sensor", "calibrations", "one calibration, or none, a sensor"));
        }
        let layers = Layers::new(&config.maps);
        let mut inputs = Inputs::new(config, calibrations, layers.uses());
        let is_named = !config.fusion.reference_sensor.is_empty();
        let configured = config.reference_sensor().expect("validate() checks the reference sensor");
        let reference_sensor = if is_named { configured } else { inputs.reference_by_configuration() };
        inputs.set_reference_sensor(reference_sensor);
        Ok(Self {
            reference: ReferenceChoice::new(
                is_named || config.sensors.len() == 1,
                config.sensors.len(),
                config.fusion.deadline_ns(),
            ),
            maps: config.maps.with_one_overhang(),
            deadline_ns: config.fusion.deadline_ns(),
            has_epochs: config.time.ahead_ms_max > 0,
            clock: EventClock::default(),
            inputs,
            ledgers: Ledgers::new(config.sensors.len()),
            fusion: Fusion::new(&config.fusion, reference_sensor),
            ground: MapGround::new(&config.maps),
            layers,
            maps_made: 0,
            map: Map::default(),
            merged: None,
            scans_since_map: 0,
        })
    }

    /// Applies one event and returns the map that it completed, if it completed one. The same events give the same
    /// maps, byte for byte.
    ///
    /// # Errors
    /// [`EventError`] if the event is refused; then it changes nothing but the ledgers.
    pub fn step(&mut self, event: &Event) -> Result<Option<&Map>, EventError> {
        let is_map = self.apply(event)?;
        if matches!(event.body, Body::Withdrawn) {
            self.remove_sensor(event.source);
        }
        Ok(is_map.then_some(&self.map))
    }

    /// True if the event completed a map.
    fn apply(&mut self, event: &Event) -> Result<bool, EventError> {
        if matches!(event.body, Body::Plan(_)) {
            return Ok(false);
        }
        let now = self.clock.advance(event.arrival_ns, (event.source, event.body.lane()));
        let outcome = self.inputs.apply(event, now);
        self.ledgers.record(event, &outcome);
        let completed = outcome?.completed_scan.map(|_| event.source);
        self.scans_since_map += u64::from(completed.is_some());
        self.choose_reference(completed, now);
        let merged = self.merge_scans(event, completed, now);
        self.estimate_ground(merged.as_ref());
        self.integrate(completed, now);
        let Some(merged) = merged else { return Ok(false) };
        self.begin_map(merged, now);
        self.make_layers();
        Ok(true)
    }

    /// Removes a sensor that is withdrawn, once what it has completed is in a map.
    fn remove_sensor(&mut self, source: u16) {
        let index = usize::from(source);
        let was_reference = self.fusion.reference_sensor() == index;
        self.fusion.remove_sensor(index);
        self.inputs.remove_sensor(source);
        self.ledgers.remove_sensor(source, self.inputs.sources());
        self.ground.forget_scan();
        self.reference.remove_sensor(index, was_reference);
        if was_reference {
            self.set_reference_sensor(self.inputs.reference_by_configuration());
        }
    }

    /// Activates the layers for which `is_active` returns true and the layers they are made from. The others take no
    /// time and are in no map. All are active before the first call. A layer that gathers evidence begins with unknown
    /// cells when it is activated again: the same events give the same bytes of such a layer only if it is always
    /// active.
    pub fn set_active_layers(&mut self, is_active: impl Fn(&str) -> bool) {
        if self.layers.set_active(&self.maps, is_active) {
            self.inputs.set_extras(self.layers.uses());
        }
    }

    /// Makes the newest map again with the layers that became active after it was made without any, so that the first
    /// reader need not wait for a sensor that may be silent. The map gets the next sequence; layers that gather
    /// evidence have seen one scan. `None` if no layer is active, if the newest map has layers, or if a sensor has
    /// completed a scan since.
    pub fn remake_newest_map(&mut self) -> Option<&Map> {
        let merged = self.merged.as_ref().filter(|_| self.map.layers.is_empty() && self.layers.any_active())?;
        let scan = &self.inputs.scans()[self.fusion.source()?];
        if self.scans_since_map > 0 || self.fusion.is_waiting() || scan.end_ns != merged.end_ns {
            return None;
        }
        self.ground.estimate(merged, scan, self.layers.uses());
        self.layers.integrate(&self.ground.rays(scan, self.map.source));
        self.make_layers();
        Some(&self.map)
    }

    /// Number of times each layer was made, in the order of the layers.
    pub fn layers_made(&self) -> Vec<(&'static str, u64)> {
        self.layers.made()
    }

    /// Counts of what became of all events so far.
    pub fn ledger(&self) -> &Ledger {
        self.ledgers.vehicle()
    }

    /// What a pipeline that replaces this one takes over.
    pub fn handover(&self) -> Handover {
        let newest = (self.map.epoch, self.map.capture_end_ns);
        Handover { next_map: self.maps_made, newest, ledgers: self.ledgers.clone() }
    }

    /// Replaces another pipeline: the next map gets its number, and stamps and counts go on from the other's. All else
    /// follows from the events that this pipeline has processed itself.
    pub fn take_over(&mut self, handover: Handover) {
        let sensors = self.inputs.sources();
        self.maps_made = handover.next_map;
        self.map.sequence = handover.next_map.saturating_sub(1);
        (self.map.epoch, self.map.capture_end_ns) = handover.newest;
        self.ledgers = handover.ledgers;
        self.ledgers.set_sensors(sensors);
    }

    /// The sensors in the order of the configuration, then the declared ones.
    pub fn sensors(&self) -> Vec<NamedStatus> {
        let ledgers = self.ledgers.sensors();
        let with_ledger = |(index, name, sensor): (usize, &str, &SensorPipeline)| NamedStatus {
            source: index as u16,
            name: name.to_owned(),
            is_reference: index == self.fusion.reference_sensor(),
            status: sensor.status(),
            elevations: sensor.elevations(),
            mount: sensor.mount_deviation(),
            other_clock: sensor.other_clock(),
            ledger: ledgers.get(index).cloned().unwrap_or_default(),
        };
        self.inputs.sensors().map(with_ledger).collect()
    }

    /// The newest ego pose; `None` before the first.
    pub fn newest_pose(&self) -> Option<&EgoPose> {
        self.inputs.motion().newest_pose()
    }

    /// The newest map; `None` before the first.
    pub fn newest_map(&self) -> Option<&Map> {
        (self.maps_made > 0).then_some(&self.map)
    }

    /// Points from which the newest map was made, ego frame at its stamp; empty before the first scan.
    pub fn newest_sweep(&self) -> &Sweep {
        let of_reference = || &*self.inputs.scans()[self.fusion.reference_sensor()].sweep;
        self.merged.as_ref().map_or_else(of_reference, |merged| &merged.sweep)
    }

    /// Local ground of the newest map; `None` before the first, and if heights are taken over the plane under the
    /// vehicle or no layer needs the ground.
    pub fn newest_ground(&self) -> Option<&Ground> {
        self.ground.ground()
    }

    /// The revolution that made the newest map; `None` before the first map, and if a scan event made it.
    pub fn newest_revolution(&self) -> Option<&Revolution> {
        self.inputs.revolution(self.fusion.source()?)
    }

    /// Changes the reference sensor if the scans so far decide for another one. `completed` is the sensor that has
    /// completed a scan.
    fn choose_reference(&mut self, completed: Option<u16>, now: EventTime) {
        if completed.is_some()
            && let Some(chosen) = self.reference.by_scans(self.inputs.scans(), now)
            && chosen != self.fusion.reference_sensor()
        {
            self.set_reference_sensor(chosen);
        }
    }

    fn set_reference_sensor(&mut self, chosen: usize) {
        self.fusion.set_reference_sensor(chosen);
        self.inputs.set_reference_sensor(chosen);
    }

    /// Merges the newest scans to a map if the completed scan, or the time of the event, completes one.
    fn merge_scans(&mut self, event: &Event, completed: Option<u16>, now: EventTime) -> Option<MergedScans> {
        let (scans, motion) = (self.inputs.scans(), self.inputs.motion());
        match completed {
            Some(source) => self.fusion.merge(usize::from(source), scans, motion, now),
            None => {
                let ended = matches!(event.body, Body::End | Body::Withdrawn).then_some(usize::from(event.source));
                self.fusion.merge_waiting(ended, scans, motion, now)
            }
        }
    }

    /// Estimates the ground of a map, and what the vehicle can reach on it, if a layer uses them.
    fn estimate_ground(&mut self, merged: Option<&MergedScans>) {
        let scans = self.inputs.scans();
        if let Some(merged) = merged {
            self.ground.estimate(merged, &scans[merged.source], self.layers.uses());
        }
    }

    /// Adds the evidence of the completed scan to the layers, if it is timely.
    fn integrate(&mut self, completed: Option<u16>, now: EventTime) {
        let scans = self.inputs.scans();
        if let Some(source) = completed.filter(|source| self.fusion.is_timely(usize::from(*source), scans, now)) {
            self.layers.integrate(&self.ground.rays(&scans[usize::from(source)], source));
        }
    }

    /// Index of the reference sensor: the configured sensor, else the sensor that is chosen from the sensors and their
    /// scans.
    pub fn reference_sensor(&self) -> usize {
        self.fusion.reference_sensor()
    }

    /// Begins the next map in place of the newest one: all but its sequence and its layers.
    fn begin_map(&mut self, mut merged: MergedScans, now: EventTime) {
        let map = &mut self.map;
        let goes_back = self.maps_made > 0 && merged.end_ns <= map.capture_end_ns;
        map.epoch = map.epoch.saturating_add(u32::from(goes_back && self.has_epochs));
        (map.capture_start_ns, map.capture_end_ns) = (merged.start_ns, merged.end_ns);
        map.completed_ns = now.arrival_ns;
        (map.map_from_ego, map.speed_mps) = (merged.map_from_ego, merged.speed_mps);
        (map.compensation, map.source) = (merged.compensation, merged.source as u16);
        map.reference_sensor = self.fusion.reference_sensor() as u16;
        map.sensors = std::mem::take(&mut merged.sensors);
        for (sensor, ledger) in map.sensors.iter_mut().zip(self.ledgers.sensors()) {
            sensor.refused = ledger.refused_sum();
        }
        if let Some(former) = self.merged.replace(merged) {
            self.fusion.reuse(former);
        }
        self.scans_since_map = 0;
    }

    /// Makes the active layers of the map that has begun, and numbers it.
    fn make_layers(&mut self) {
        let Some(merged) = &self.merged else { return };
        let (stamp_ns, roads) = (self.map.capture_end_ns, self.inputs.roads());
        let context = Context {
            earlier: &[],
            stamp_ns,
            earliest_ns: stamp_ns.saturating_sub(self.deadline_ns),
            map_from_ego: self.map.map_from_ego,
            ground: self.ground.ground(),
            radial: &[],
            reach: self.ground.reach(),
            memory: self.ground.memory(),
            road: roads.to_paint(),
            route: roads.route(),
        };
        let sweep = if context.ground.is_some() { self.ground.sweep(&merged.sweep) } else { &*merged.sweep };
        self.layers.make(sweep, &context, &mut self.map.layers);
        self.map.sequence = self.maps_made;
        self.maps_made += 1;
    }
}

/// Names of the enabled layers of a vehicle, in the order of its maps.
pub fn layer_names(maps: &MapsConfig) -> Vec<&'static str> {
    Layers::new(maps).made().into_iter().map(|(name, _)| name).collect()
}
