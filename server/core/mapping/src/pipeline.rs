//! The conductor of one vehicle: events in, maps out. The events alone decide what a map contains.
//!
//! In: [`Event`]s in the order of the event queue. Out: a [`Map`] for every scan that makes one. The hops of
//! [`Pipeline::step`]: event -> [`Inputs`] -> the newest scan of one sensor -> [`Fusion`] -> the map's [`Sweep`] -> one
//! layer a map -> [`Map`].

use clearway_lidar::SensorStatus;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;

use crate::config::{ConfigValueError, MapsConfig, VehicleConfig};
use crate::error::EventError;
use crate::event::Event;
use crate::event_time::{EventClock, EventTime};
use crate::fusion::{Fusion, MergedScans};
use crate::inputs::Inputs;
use crate::layer::Context;
use crate::layer::registry::Layers;
use crate::ledger::{Ledger, Ledgers};
use crate::map::Map;
use crate::sensor::sweep::Sweep;

/// The maps of one vehicle, made from its events.
pub struct Pipeline {
    maps: MapsConfig,
    deadline_ns: i64,
    clock: EventClock,
    inputs: Inputs,
    ledgers: Ledgers,
    fusion: Fusion,
    layers: Layers,
    /// Number of maps made so far.
    maps_made: u64,
    /// The newest map, whose memory the next one uses.
    map: Map,
}

/// A sensor with its status and its counts.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedStatus {
    /// Name of the sensor in the configuration.
    pub name: String,
    /// Status found from the sensor's data; a scan event counts as a revolution.
    pub status: SensorStatus,
    /// Counts of what became of everything the sensor sent.
    pub ledger: Ledger,
}

impl Pipeline {
    /// A pipeline before the first event, with all enabled layers active. `calibrations[i]` is the table of
    /// `config.sensors[i].calibration`; `None` selects the factory's table, or the one in the sensor's status bytes.
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
        let reference_sensor = config.reference_sensor().expect("validate() checks the reference sensor");
        Ok(Self {
            maps: config.maps.clone(),
            deadline_ns: config.fusion.deadline_ns(),
            clock: EventClock::default(),
            inputs: Inputs::new(config, calibrations, layers.uses()),
            ledgers: Ledgers::new(config.sensors.len()),
            fusion: Fusion::new(&config.fusion, reference_sensor),
            layers,
            maps_made: 0,
            map: Map::default(),
        })
    }

    /// Applies one event and returns the map that it completed, if it completed one. The same events give the same
    /// maps, byte for byte.
    ///
    /// # Errors
    /// [`EventError`] if the event is refused; then it changes nothing but the ledgers.
    pub fn step(&mut self, event: &Event) -> Result<Option<&Map>, EventError> {
        let now = self.clock.advance(event.arrival_ns);
        let outcome = self.inputs.apply(event, now);
        self.ledgers.record(event, &outcome);
        if outcome?.completed_scan.is_none() {
            return Ok(None);
        }
        let (source, scans) = (usize::from(event.source), self.inputs.scans());
        if self.fusion.is_timely(source, scans, now) {
            self.layers.integrate(&scans[source].rays(event.source));
        }
        let Some(merged) = self.fusion.merge(source, scans, self.inputs.motion(), now) else { return Ok(None) };
        self.begin_map(merged, now);
        self.make_layers();
        Ok(Some(&self.map))
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
        let is_empty = self.maps_made > 0 && self.map.layers.is_empty();
        if !is_empty || !self.layers.any_active() || !self.fusion.is_current() {
            return None;
        }
        let source = self.map.source;
        self.layers.integrate(&self.inputs.scans()[usize::from(source)].rays(source));
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

    /// The sensors in the order of the configuration, then the declared ones.
    pub fn sensors(&self) -> Vec<NamedStatus> {
        let ledgers = self.ledgers.sensors();
        let with_ledger = |((name, status), ledger): ((&str, SensorStatus), &Ledger)| NamedStatus {
            name: name.to_owned(),
            status,
            ledger: ledger.clone(),
        };
        self.inputs.statuses().zip(ledgers).map(with_ledger).collect()
    }

    /// The newest map; `None` before the first.
    pub fn newest_map(&self) -> Option<&Map> {
        (self.maps_made > 0).then_some(&self.map)
    }

    /// Points from which the newest map was made, ego frame at its stamp; empty before the first scan.
    pub fn newest_sweep(&self) -> &Sweep {
        self.fusion.sweep(self.inputs.scans())
    }

    /// The revolution that made the newest map; `None` before the first map, and if a scan event made it.
    pub fn newest_revolution(&self) -> Option<&Revolution> {
        self.inputs.revolution(self.fusion.source()?)
    }

    /// Begins the next map in place of the newest one: all but its sequence and its layers.
    fn begin_map(&mut self, merged: MergedScans, now: EventTime) {
        let (map, scan) = (&mut self.map, &self.inputs.scans()[merged.source]);
        (map.capture_start_ns, map.capture_end_ns) = (merged.start_ns, scan.end_ns);
        map.completed_ns = now.arrival_ns;
        (map.map_from_ego, map.speed_mps) = (scan.map_from_ego, scan.speed_mps);
        (map.compensation, map.source) = (merged.compensation, merged.source as u16);
        map.sensors = merged.sensors;
        for (sensor, ledger) in map.sensors.iter_mut().zip(self.ledgers.sensors()) {
            sensor.refused = ledger.refused_sum();
        }
    }

    /// Makes the active layers of the map that has begun, and numbers it.
    fn make_layers(&mut self) {
        let (stamp_ns, roads) = (self.map.capture_end_ns, self.inputs.roads());
        let context = Context {
            earlier: &[],
            stamp_ns,
            earliest_ns: stamp_ns.saturating_sub(self.deadline_ns),
            map_from_ego: self.map.map_from_ego,
            road: roads.to_paint(),
            route: roads.route(),
        };
        self.layers.make(self.fusion.sweep(self.inputs.scans()), &context, &mut self.map.layers);
        self.map.sequence = self.maps_made;
        self.maps_made += 1;
    }
}

/// Names of the enabled layers of a vehicle, in the order of its maps.
pub fn layer_names(maps: &MapsConfig) -> Vec<&'static str> {
    Layers::new(maps).made().into_iter().map(|(name, _)| name).collect()
}
