//! Conducts one vehicle: events in, maps out, nothing but the events deciding.
//!
//! In: [`Event`]s in the order the door took them. Out: a [`Map`] for every revolution or scan an event completes.
//! The hops: datagram -> `lidar` -> [`Revolution`] -> [`Sweep`] -> one layer a map -> [`Map`]. A scan that was
//! assembled elsewhere enters at the sweep.

use std::collections::BTreeMap;
use std::sync::Arc;

use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_lidar::revolution::{Partial, Revolution};
use clearway_lidar::sensor::{Refusal, Sensor, SensorStatus};
use clearway_lidar::telemetry::TELEMETRY_LENGTH;

use crate::config::{ConfigError, MapsConfig, SensorConfig, VehicleConfig};
use crate::drivability::Drivability;
use crate::event::{Body, EgoPose, Event, Road, Scan};
use crate::height_difference::HeightDifference;
use crate::map::{Context, LayerMaker, Map, SensorState};
use crate::motion::{Compensation, Motion, Moved};
use crate::occupancy::Occupancy;
use crate::road::{self, RoadError, Roads};
use crate::safe_path::SafePath;
use crate::series::Series;
use crate::speed::Speed;
use crate::sweep::{Mount, Sweep};
use crate::terrain::Terrain;

/// One vehicle's way from events to maps.
pub struct Pipeline {
    config: VehicleConfig,
    sensor: Sensor,
    /// Table of the grid's rows where turns come as scans; `None` while neither file nor model is configured.
    scan_calibration: Option<Arc<Calibration>>,
    motion: Motion,
    roads: Roads,
    scan_stamp_ns: Option<i64>,
    /// Scans taken, and their points.
    scans: (u64, u64),
    ledger: Ledger,
    newest_is_revolution: bool,
    maker: Maker,
}

/// What came of everything that reached the core. `received = decoded + telemetry + the sum of refused`, exactly.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ledger {
    /// Datagrams and scans.
    pub received: u64,
    /// Data packets and scans taken.
    pub decoded: u64,
    /// Telemetry datagrams read.
    pub telemetry: u64,
    /// Datagrams and scans not taken, by [`Rejected::reason`].
    pub refused: BTreeMap<&'static str, u64>,
    /// Events that never entered, as [`Body::Lost`] says.
    pub lost: u64,
    /// Ego poses taken.
    pub poses: u64,
    /// Ego poses not taken.
    pub poses_refused: u64,
    /// Roads taken.
    pub roads: u64,
    /// Roads not taken, by [`Rejected::reason`].
    pub roads_refused: BTreeMap<&'static str, u64>,
    /// Points of scans that were no positions (not finite, or beyond any sensor's reach) and were left out.
    pub points_dropped: u64,
}

/// A sensor as configured, and what it has shown of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedStatus {
    /// From the configuration.
    pub name: String,
    /// From the data; a scan counts as a revolution.
    pub status: SensorStatus,
}

/// An event that was not taken. The pipeline's state is as if it had not come, but for the ledger.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Rejected {
    /// The decoder refused the datagram.
    #[error(transparent)]
    Datagram(#[from] Refusal),
    /// No such sensor.
    #[error("source {source_index}: the vehicle has {sensors} sensor(s), counted from 0")]
    Source {
        /// The event's.
        source_index: u16,
        /// How many are configured.
        sensors: usize,
    },
    /// A scan whose arrays do not belong together.
    #[error("scan with {x} x, {y} y, {z} z and {intensity} intensities: the four lengths must be equal")]
    ScanLengths {
        /// Length of `x`.
        x: usize,
        /// Length of `y`.
        y: usize,
        /// Length of `z`.
        z: usize,
        /// Length of `intensity`.
        intensity: usize,
    },
    /// A scan of a sensor whose rings are not known.
    #[error("scan of sensor {sensor}: set its model or calibration, the grid's rows come from its elevations")]
    ScanModel {
        /// The sensor's name.
        sensor: String,
    },
    /// A scan, ego pose or road not newer than the one before.
    #[error("stamp {stamp_ns} ns: later than {newest_ns} ns is allowed")]
    Stamp {
        /// The event's.
        stamp_ns: i64,
        /// The newest taken.
        newest_ns: i64,
    },
    /// A road that is no road.
    #[error(transparent)]
    Road(#[from] RoadError),
    /// An ego pose that is no pose.
    #[error(
        "ego pose of {stamp_ns} ns: position within 10^9 m, a unit quaternion and speed within 1000 m/s are allowed"
    )]
    Pose {
        /// The event's.
        stamp_ns: i64,
    },
}

impl Rejected {
    /// The ledger's key: the decoder's own (`length`, `block_flag`, …), or `source`, `scan_lengths`, `model`, `stamp`,
    /// `pose`, or a road's own ([`RoadError::reason`]).
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Datagram(refusal) => refusal.reason(),
            Self::Source { .. } => "source",
            Self::ScanLengths { .. } => "scan_lengths",
            Self::ScanModel { .. } => "model",
            Self::Stamp { .. } => "stamp",
            Self::Pose { .. } => "pose",
            Self::Road(refused) => refused.reason(),
        }
    }
}

impl Pipeline {
    /// A pipeline that has seen nothing. `calibrations[i]` is the table read from `config.sensors[i].calibration`;
    /// `None` where the factory's (or the one in the sensor's status bytes) is meant.
    ///
    /// # Errors
    /// [`ConfigError`] for the first value that cannot be used.
    pub fn new(config: &VehicleConfig, calibrations: Vec<Option<Calibration>>) -> Result<Self, ConfigError> {
        config.validate()?;
        let [sensor] = &config.sensors[..] else { unreachable!("validate() takes one sensor") };
        let Ok([calibration]) = <[Option<Calibration>; 1]>::try_from(calibrations) else {
            return Err(ConfigError::new("vehicle.sensor", "calibrations", "one calibration, or none, a sensor"));
        };
        let factory = || sensor.model.map(Calibration::factory);
        let scan_calibration = calibration.clone().or_else(factory).map(Arc::new);
        Ok(Self {
            sensor: Sensor::new(clearway_lidar::sensor::SensorConfig {
                model: sensor.model,
                rpm: sensor.rpm,
                calibration,
                cut_azimuth_deg: sensor.cut_azimuth_deg,
            }),
            scan_calibration,
            motion: Motion::new(&config.maps.motion),
            roads: Roads::default(),
            scan_stamp_ns: None,
            scans: (0, 0),
            ledger: Ledger::default(),
            newest_is_revolution: false,
            maker: Maker::new(config),
            config: config.clone(),
        })
    }

    /// Takes one event; gives the map it completed, if any. The same events give the same maps, byte for byte.
    ///
    /// # Errors
    /// [`Rejected`] with the values that were wrong, once counted in the ledger.
    pub fn step(&mut self, event: &Event) -> Result<Option<&Map>, Rejected> {
        match &event.body {
            Body::Datagram(_) | Body::Scan(_) => self.ledger.received += 1,
            Body::Lost(events) => self.ledger.lost += events,
            Body::EgoPose(_) | Body::Road(_) | Body::End => {}
        }
        let outcome = match &event.body {
            Body::EgoPose(pose) => self.step_ego_pose(pose).map(|()| false),
            Body::Road(road) => self.step_road(road).map(|()| false),
            Body::Lost(_) => Ok(false),
            _ if usize::from(event.source) >= self.config.sensors.len() => {
                Err(Rejected::Source { source_index: event.source, sensors: self.config.sensors.len() })
            }
            Body::Datagram(payload) => self.step_datagram(payload, event.arrival_ns),
            Body::Scan(scan) => self.step_scan(scan, event.arrival_ns),
            Body::End => Ok(self.step_end(event.arrival_ns)),
        };
        match outcome {
            Ok(made) => Ok(made.then_some(&self.maker.map)),
            Err(rejected) => {
                match event.body {
                    Body::Datagram(_) | Body::Scan(_) => {
                        *self.ledger.refused.entry(rejected.reason()).or_default() += 1
                    }
                    Body::EgoPose(_) => self.ledger.poses_refused += 1,
                    Body::Road(_) => *self.ledger.roads_refused.entry(rejected.reason()).or_default() += 1,
                    Body::Lost(_) | Body::End => {}
                }
                Err(rejected)
            }
        }
    }

    /// What came of everything so far.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The sensors in the order of the configuration.
    pub fn sensors(&self) -> Vec<NamedStatus> {
        let mut status = self.sensor.status();
        status.revolutions += self.scans.0;
        status.returns += self.scans.1;
        let named = |sensor: &SensorConfig| NamedStatus { name: sensor.name.clone(), status: status.clone() };
        self.config.sensors.iter().map(named).collect()
    }

    /// The newest map, until the next one is made; `None` before the first.
    pub fn newest_map(&self) -> Option<&Map> {
        (self.maker.maps_made > 0).then_some(&self.maker.map)
    }

    /// The points the newest map was made from, ego frame at its capture's end; empty before the first.
    pub fn newest_sweep(&self) -> &Sweep {
        &self.maker.sweep
    }

    /// The revolution that made the newest map; `None` before the first, and where a scan made it.
    pub fn newest_revolution(&self) -> Option<&Revolution> {
        if self.newest_is_revolution { self.sensor.newest() } else { None }
    }

    fn step_datagram(&mut self, payload: &[u8], arrival_ns: i64) -> Result<bool, Rejected> {
        let completed = self.sensor.push(payload, arrival_ns)?;
        let made = match completed {
            None => false,
            Some(revolution) => {
                let refused = self.ledger.refused.values().sum();
                let known = (&self.motion, &self.roads);
                self.maker.revolution(revolution, &self.config, known, refused, arrival_ns);
                true
            }
        };
        self.newest_is_revolution |= made;
        if payload.len() == TELEMETRY_LENGTH {
            self.ledger.telemetry += 1;
            if let Some(gprmc) = self.sensor.gprmc() {
                self.motion.take_gprmc(gprmc, arrival_ns);
            }
        } else {
            self.ledger.decoded += 1;
        }
        Ok(made)
    }

    fn step_scan(&mut self, scan: &Scan, arrival_ns: i64) -> Result<bool, Rejected> {
        let (x, y, z, intensity) = (scan.x.len(), scan.y.len(), scan.z.len(), scan.intensity.len());
        if x != y || x != z || x != intensity {
            return Err(Rejected::ScanLengths { x, y, z, intensity });
        }
        check_newer(scan.stamp_ns, self.scan_stamp_ns)?;
        let Some(calibration) = &self.scan_calibration else {
            return Err(Rejected::ScanModel { sensor: self.config.sensors[0].name.clone() });
        };
        self.scan_stamp_ns = Some(scan.stamp_ns);
        let refused = self.ledger.refused.values().sum();
        let known = (&self.motion, &self.roads);
        let dropped = self.maker.scan(scan, calibration, &self.config, known, refused, arrival_ns);
        self.ledger.points_dropped += dropped;
        self.scans = (self.scans.0 + 1, self.scans.1 + u64::from(self.maker.sweep.returns));
        self.ledger.decoded += 1;
        self.newest_is_revolution = false;
        Ok(true)
    }

    fn step_ego_pose(&mut self, pose: &EgoPose) -> Result<(), Rejected> {
        let rotation = pose.map_from_ego.rotation.coords;
        let position = pose.map_from_ego.translation.vector;
        // NaN fails every comparison, and a NaN in the quaternion makes the norm NaN, which is in no range.
        let possible = position.iter().all(|v| v.abs() <= 1e9) && pose.speed_mps.abs() <= 1000.0;
        if !possible || !(1.0 - 1e-6..=1.0 + 1e-6).contains(&rotation.norm()) {
            return Err(Rejected::Pose { stamp_ns: pose.stamp_ns });
        }
        check_newer(pose.stamp_ns, self.motion.newest_pose().map(|p| p.stamp_ns))?;
        self.motion.take_pose(pose);
        self.ledger.poses += 1;
        Ok(())
    }

    fn step_road(&mut self, road: &Road) -> Result<(), Rejected> {
        road::check(road)?;
        check_newer(road.stamp_ns, self.roads.newest_stamp_ns(road.purpose))?;
        self.roads.take(road, self.motion.map_from_ego(road.stamp_ns));
        self.ledger.roads += 1;
        Ok(())
    }

    fn step_end(&mut self, arrival_ns: i64) -> bool {
        let refused = self.ledger.refused.values().sum();
        match self.sensor.finish() {
            None => false,
            Some(revolution) => {
                let known = (&self.motion, &self.roads);
                self.maker.revolution(revolution, &self.config, known, refused, arrival_ns);
                self.newest_is_revolution = true;
                true
            }
        }
    }
}

fn check_newer(stamp_ns: i64, newest_ns: Option<i64>) -> Result<(), Rejected> {
    match newest_ns {
        Some(newest_ns) if stamp_ns <= newest_ns => Err(Rejected::Stamp { stamp_ns, newest_ns }),
        _ => Ok(()),
    }
}

/// What other events told: the newest ego pose, the newest roads.
type Known<'a> = (&'a Motion, &'a Roads);

/// The hops behind the sensor, with the buffers they reuse from map to map.
struct Maker {
    maps_made: u64,
    mount: Mount,
    moved: Moved,
    sweep: Sweep,
    /// Where a map asks for it.
    series: Option<Series>,
    layer_makers: Vec<Box<dyn LayerMaker>>,
    map: Map,
}

impl Maker {
    fn new(config: &VehicleConfig) -> Self {
        let layer_makers = layer_makers(&config.maps);
        let layers = layer_makers.iter().map(|maker| maker.layer()).collect();
        let sensor = &config.sensors[0];
        Self {
            maps_made: 0,
            mount: Mount { ego_from_sensor: sensor.extrinsics.ego_from_sensor(), range_m_min: sensor.range_m_min },
            moved: Moved::default(),
            sweep: Sweep::default(),
            series: config.maps.terrain.enabled.then(Series::default),
            layer_makers,
            map: Map {
                sequence: 0,
                capture_start_ns: 0,
                capture_end_ns: 0,
                completed_ns: 0,
                map_from_ego: None,
                speed_mps: None,
                compensation: Compensation::None,
                sensors: Vec::new(),
                layers,
            },
        }
    }

    fn revolution(
        &mut self,
        revolution: &Revolution,
        config: &VehicleConfig,
        (motion, roads): Known<'_>,
        refused: u64,
        arrival_ns: i64,
    ) {
        motion.through(revolution, arrival_ns, &mut self.moved);
        self.sweep.take_moving_revolution(revolution, &self.mount, &self.moved.end_from_ego);
        (self.map.compensation, self.map.speed_mps) = (self.moved.compensation, self.moved.speed_mps);
        self.map.map_from_ego = motion.map_from_ego(revolution.end_ns);
        if let Some(series) = &mut self.series {
            self.sweep.take_deviations(revolution, &self.mount, series);
        }
        let state = SensorState {
            name: config.sensors[0].name.clone(),
            model: model_name(revolution.model).to_owned(),
            packets: revolution.packets,
            refused,
            returns: self.sweep.returns,
            rpm: revolution.rpm,
            completeness: completeness(revolution),
            partial: revolution.partial.map_or("", Partial::as_str),
        };
        self.map(state, (revolution.start_ns, revolution.end_ns), roads, arrival_ns);
    }

    /// Gives the number of points left out because they are no positions.
    fn scan(
        &mut self,
        scan: &Scan,
        calibration: &Arc<Calibration>,
        config: &VehicleConfig,
        (motion, roads): Known<'_>,
        refused: u64,
        arrival_ns: i64,
    ) -> u64 {
        let dropped = self.sweep.take_scan(scan, calibration, &self.mount);
        self.map.compensation = Compensation::None;
        (self.map.map_from_ego, self.map.speed_mps) = motion.at(scan.stamp_ns, arrival_ns);
        let state = SensorState {
            name: config.sensors[0].name.clone(),
            model: "scan".to_owned(),
            packets: 0,
            refused,
            returns: self.sweep.returns,
            rpm: 0.0,
            completeness: 1.0,
            partial: "",
        };
        self.map(state, (scan.stamp_ns, scan.stamp_ns), roads, arrival_ns);
        dropped
    }

    /// The newest sweep's map, in place of the one before.
    fn map(&mut self, sensor: SensorState, capture_ns: (i64, i64), roads: &Roads, arrival_ns: i64) {
        let map = &mut self.map;
        map.sequence = self.maps_made;
        self.maps_made += 1;
        (map.capture_start_ns, map.capture_end_ns) = capture_ns;
        map.completed_ns = arrival_ns;
        map.sensors.clear();
        map.sensors.push(sensor);
        let (road, route) = (roads.to_paint(), roads.route());
        for (index, maker) in self.layer_makers.iter_mut().enumerate() {
            let (earlier, rest) = map.layers.split_at_mut(index);
            let context = Context { earlier, stamp_ns: capture_ns.1, map_from_ego: map.map_from_ego, road, route };
            maker.make_with(&self.sweep, &context, &mut rest[0]);
        }
    }
}

/// The maps that are switched on, in the order of their layers.
fn layer_makers(maps: &MapsConfig) -> Vec<Box<dyn LayerMaker>> {
    let mut makers: Vec<Box<dyn LayerMaker>> = Vec::new();
    if maps.drivability.enabled {
        makers.push(Box::new(Drivability::new(&maps.drivability)));
    }
    if maps.height_difference.enabled {
        makers.push(Box::new(HeightDifference::new(&maps.height_difference)));
    }
    if maps.terrain.enabled {
        makers.push(Box::new(Terrain::new(&maps.terrain)));
    }
    if maps.occupancy.enabled {
        makers.push(Box::new(Occupancy::new(&maps.occupancy)));
    }
    if maps.speed.enabled {
        makers.push(Box::new(Speed::new(&maps.speed)));
    }
    // Behind the layers whose obstacles it keeps away from.
    if maps.safe_path.enabled {
        makers.push(Box::new(SafePath::new(&maps.safe_path)));
    }
    makers
}

/// Names of the layers of a vehicle's maps, in order.
pub fn layer_names(maps: &MapsConfig) -> Vec<&'static str> {
    layer_makers(maps).iter().map(|maker| maker.layer().name).collect()
}

/// Share of the turn's degrees in which a firing lies.
fn completeness(revolution: &Revolution) -> f32 {
    let mut seen = [false; 360];
    for firing in &revolution.firings {
        let degree = firing.azimuth_rad.to_degrees();
        // `as` saturates, so an azimuth of exactly 2π (or a wild one) falls into the last degree.
        seen[(degree as usize).min(359)] = true;
    }
    seen.iter().filter(|s| **s).count() as f32 / 360.0
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
