//! A simulated car and its sensors: their part of the vehicle's configuration, and what they send.
//!
//! Out: datagrams of each rotating sensor ([`Rig::vehicle`]), and observations ([`Rig::observations`]): ego poses, and
//! of a car with units of a few planes their scans and the road ahead.

use std::time::Duration;

use clearway_client::Observation;
use clearway_client::observation::{RoadFrame, RoadPurpose};
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_sim::planes::{PlaneScan, PlaneUnit};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::Scene;
use clearway_sim::traffic::six_units;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};

/// From one ego pose to the next.
const POSE_PERIOD_NS: i64 = 20_000_000;
/// From one observation of the road to the next.
const ROAD_PERIOD_NS: i64 = 100_000_000;
/// Least range of every sensor, in metres. The simulated world does not contain the car itself, so only rain on the
/// sensor's window would return from nearer.
const RANGE_M_MIN: f32 = 0.5;

/// A car in a scene, and its sensors by name. The rotating sensors come first in the configuration, and the first of
/// them is the reference sensor.
#[derive(Clone, Debug)]
pub struct Rig {
    /// The world, and the car's course through it.
    pub scene: Scene,
    /// The scene's time 0, ns since the Unix epoch.
    pub start_ns: i64,
    /// Rotating sensors, which send datagrams.
    pub scanners: Vec<(String, ScannerConfig)>,
    /// Units of a few planes, whose scans are observations.
    pub units: Vec<(String, PlaneUnit)>,
}

/// An observation of the car, and its time.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedObservation {
    /// When it is sent, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// The observation that is sent at this time.
    pub observation: Observation,
}

/// The observations of a car, from the scene's beginning on, in the order of their stamps and without end.
#[derive(Clone, Debug)]
pub struct Observations<'a> {
    rig: &'a Rig,
    /// Offset from the scene's beginning of the next observation of each kind, ns, and the kind.
    due: Vec<(i64, ObservationKind)>,
}

/// A kind of observation. Observations with one stamp are sent in this order: poses before the scans that end with
/// them, so that the scans are compensated by them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum ObservationKind {
    Pose,
    Road,
    /// A scan of the unit with this index.
    Scan(usize),
}

impl Rig {
    /// A car with one sensor, `model`, on the roof.
    pub fn one(model: Model, scene: Scene, start_ns: i64) -> Self {
        let scanner = ScannerConfig { model, ..ScannerConfig::default() };
        Self { scene, start_ns, scanners: vec![("top".into(), scanner)], units: Vec::new() }
    }

    /// A car with two VLP-16, one on the roof and one on the tail that looks backwards, and the six units of the car of
    /// Seo 2014.
    pub fn many(scene: Scene, start_ns: i64) -> Self {
        let scanner = |name: &str, [x, y, z, yaw]: [f64; 4], seed| {
            let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
            let ego_from_sensor = Isometry3::from_parts(Translation3::new(x, y, z), turned);
            (name.to_owned(), ScannerConfig { model: Model::Vlp16, ego_from_sensor, seed, ..ScannerConfig::default() })
        };
        let names = ["ahead", "front-left", "rear-left", "behind", "rear-right", "front-right"];
        Self {
            scene,
            start_ns,
            scanners: vec![
                scanner("top", [0.0, 0.0, 1.9, 0.0], 1),
                scanner("tail", [-1.8, 0.0, 1.4, std::f64::consts::PI], 2),
            ],
            units: names.map(str::to_owned).into_iter().zip(six_units()).collect(),
        }
    }

    /// The sensors' part of the vehicle's configuration.
    pub fn sensors(&self) -> Vec<SensorConfig> {
        let sensor = |name: &str, ego_from_sensor: &Isometry3<f64>| {
            let range_m_min = RANGE_M_MIN;
            SensorConfig { range_m_min, ..SensorConfig::new(name, extrinsics(ego_from_sensor)) }
        };
        let scanners = self.scanners.iter().map(|(name, config)| sensor(name, &config.ego_from_sensor));
        let units = self.units.iter().map(|(name, unit)| SensorConfig {
            elevations_deg: unit.elevations.iter().map(|elevation| elevation.to_degrees() as f32).collect(),
            ..sensor(name, &unit.ego_from_sensor)
        });
        scanners.chain(units).collect()
    }

    /// The datagrams of rotating sensor `index`.
    pub fn vehicle(&self, index: usize) -> SimulatedVehicle {
        SimulatedVehicle::starting_at(self.scene.clone(), self.scanners[index].1.clone(), self.start_ns)
    }

    /// The car's poses, roads and scans, each with its period.
    pub fn observations(&self) -> Observations<'_> {
        let mut due = vec![(POSE_PERIOD_NS, ObservationKind::Pose)];
        due.extend(self.units.first().map(|_| (ROAD_PERIOD_NS, ObservationKind::Road)));
        due.extend(
            self.units.iter().enumerate().map(|(index, (_, unit))| (unit.period_ns, ObservationKind::Scan(index))),
        );
        Observations { rig: self, due }
    }

    fn pose(&self, offset_ns: i64) -> Observation {
        let time = offset_ns as f64 * 1e-9;
        let pose = self.scene.pose_at(time);
        let (at, turned) = (pose.translation.vector, pose.rotation.coords);
        let turned = [turned.x, turned.y, turned.z, turned.w];
        Observation::pose(self.start_ns + offset_ns, at.into(), turned, self.scene.drive.speed_at(time))
    }
}

impl Observations<'_> {
    /// The stamp of the next observation, ns since the Unix epoch.
    pub fn next_stamp_ns(&self) -> i64 {
        self.rig.start_ns + self.due.iter().map(|(offset_ns, _)| *offset_ns).min().unwrap_or(0)
    }

    /// Skips the scans before `stamp_ns`, without simulating them; returns the longest time that a unit skips. Poses
    /// and roads stay, because they cost next to nothing.
    pub fn skip_scans_to(&mut self, stamp_ns: i64) -> Duration {
        let mut longest_ns = 0;
        for (offset_ns, kind) in &mut self.due {
            let ObservationKind::Scan(unit) = *kind else { continue };
            let period_ns = self.rig.units[unit].1.period_ns;
            let skipped_ns = (stamp_ns - self.rig.start_ns - *offset_ns).max(0) / period_ns * period_ns;
            *offset_ns += skipped_ns;
            longest_ns = longest_ns.max(skipped_ns);
        }
        Duration::from_nanos(longest_ns.unsigned_abs())
    }
}

impl Iterator for Observations<'_> {
    type Item = TimedObservation;

    fn next(&mut self) -> Option<TimedObservation> {
        let rig = self.rig;
        let next = self.due.iter_mut().min()?;
        let (offset_ns, kind) = *next;
        let stamp_ns = rig.start_ns + offset_ns;
        let (period_ns, observation) = match kind {
            ObservationKind::Pose => (POSE_PERIOD_NS, rig.pose(offset_ns)),
            ObservationKind::Road => (ROAD_PERIOD_NS, road(stamp_ns)),
            ObservationKind::Scan(unit) => {
                let (name, unit) = &rig.units[unit];
                let scan = unit.scan(&rig.scene, offset_ns / unit.period_ns);
                (unit.period_ns, scan_observation(name, rig.start_ns, &scan))
            }
        };
        next.0 += period_ns;
        Some(TimedObservation { stamp_ns, observation })
    }
}

/// The lane ahead, as a camera would find it.
fn road(stamp_ns: i64) -> Observation {
    let points: Vec<[f64; 3]> = (0..12).map(|i| [3.0 + 3.0 * f64::from(i), 0.0, 3.5]).collect();
    Observation::road(stamp_ns, RoadPurpose::Paint, RoadFrame::Ego, &points)
}

fn scan_observation(sensor: &str, start_ns: i64, scan: &PlaneScan) -> Observation {
    Observation::scan(sensor, start_ns + scan.end_ns, &scan.x, &scan.y, &scan.z)
        .intensity(&scan.intensity)
        .rings(&scan.ring)
        .offsets_ns(&scan.offset_ns)
        .no_returns(&scan.no_returns)
}

/// A sensor's pose on the vehicle in the terms of the configuration.
pub fn extrinsics(ego_from_sensor: &Isometry3<f64>) -> Extrinsics {
    let (at, (roll, pitch, yaw)) = (ego_from_sensor.translation, ego_from_sensor.rotation.euler_angles());
    Extrinsics {
        x_m: at.x,
        y_m: at.y,
        z_m: at.z,
        roll_deg: roll.to_degrees(),
        pitch_deg: pitch.to_degrees(),
        yaw_deg: yaw.to_degrees(),
    }
}
