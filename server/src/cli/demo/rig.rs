//! A simulated car with several sensors: what its vehicle's configuration says of them, and what they send.
//!
//! Out: datagrams of each turning sensor ([`Rig::vehicle`]), and as observations what comes over the network instead:
//! scans of the units with a few planes, ego poses and the road ahead ([`Rig::told`]).

use clearway_client::Observation;
use clearway_client::observation::{RoadFrame, RoadPurpose};
use clearway_mapping::config::{Extrinsics, SensorConfig};
use clearway_sim::planes::{PlaneScan, PlaneUnit};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::Scene;
use clearway_sim::traffic::six_units;
use clearway_sim::vehicle::SimulatedVehicle;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};

use clearway_lidar::model::Model;

/// From one ego pose to the next.
const POSE_PERIOD_NS: i64 = 20_000_000;
/// From one sight of the road to the next.
const ROAD_PERIOD_NS: i64 = 100_000_000;
/// Nothing of the car itself is in the simulated world; nearer returns would be rain on the window.
const RANGE_M_MIN: f32 = 0.5;

/// A car in a scene, and its sensors by name. The turning ones come first in the configuration, and the first of them
/// leads.
#[derive(Clone, Debug)]
pub struct Rig {
    /// Where it drives, and how.
    pub scene: Scene,
    /// The scene's time 0, ns since the Unix epoch.
    pub start_ns: i64,
    /// Send datagrams.
    pub scanners: Vec<(String, ScannerConfig)>,
    /// Their scans are observations.
    pub units: Vec<(String, PlaneUnit)>,
}

/// Something the car tells over the network.
#[derive(Clone, Debug, PartialEq)]
pub struct Told {
    /// When, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// What.
    pub observation: Observation,
}

impl Rig {
    /// Two VLP-16, one on the roof and one on the tail looking backwards, and the six units of Seo's car.
    pub fn many(scene: Scene, start_ns: i64) -> Self {
        let turning = |name: &str, [x, y, z, yaw]: [f64; 4], seed| {
            let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
            let ego_from_sensor = Isometry3::from_parts(Translation3::new(x, y, z), turned);
            (name.to_owned(), ScannerConfig { model: Model::Vlp16, ego_from_sensor, seed, ..ScannerConfig::default() })
        };
        let names = ["ahead", "front-left", "rear-left", "behind", "rear-right", "front-right"];
        Self {
            scene,
            start_ns,
            scanners: vec![
                turning("top", [0.0, 0.0, 1.9, 0.0], 1),
                turning("tail", [-1.8, 0.0, 1.4, std::f64::consts::PI], 2),
            ],
            units: names.map(str::to_owned).into_iter().zip(six_units()).collect(),
        }
    }

    /// The sensors as a configuration has them.
    pub fn sensors(&self) -> Vec<SensorConfig> {
        let sensor = |name: &str, ego_from_sensor: &Isometry3<f64>| {
            let range_m_min = RANGE_M_MIN;
            SensorConfig { range_m_min, ..SensorConfig::new(name, extrinsics(ego_from_sensor)) }
        };
        let turning = self.scanners.iter().map(|(name, config)| sensor(name, &config.ego_from_sensor));
        let units = self.units.iter().map(|(name, unit)| SensorConfig {
            elevations_deg: unit.elevations.iter().map(|elevation| elevation.to_degrees() as f32).collect(),
            ..sensor(name, &unit.ego_from_sensor)
        });
        turning.chain(units).collect()
    }

    /// The car as scanner `index` sees the world: an iterator over its datagrams.
    pub fn vehicle(&self, index: usize) -> SimulatedVehicle {
        SimulatedVehicle::starting_at(self.scene.clone(), self.scanners[index].1.clone(), self.start_ns)
    }

    /// All the car tells, from the scene's beginning on, in the order of the stamps and without end.
    pub fn told(&self) -> impl Iterator<Item = Told> + '_ {
        // Poses before the scans that end with them, so that these are moved by them.
        let mut due: Vec<(i64, usize)> = vec![(POSE_PERIOD_NS, 0), (ROAD_PERIOD_NS, 1)];
        due.extend(self.units.iter().enumerate().map(|(index, (_, unit))| (unit.period_ns, index + 2)));
        std::iter::from_fn(move || {
            let next = due.iter_mut().min()?;
            let (offset_ns, what) = *next;
            let stamp_ns = self.start_ns + offset_ns;
            let (period_ns, observation) = match what {
                0 => (POSE_PERIOD_NS, self.pose(offset_ns)),
                1 => (ROAD_PERIOD_NS, road(stamp_ns)),
                unit => {
                    let (name, unit) = &self.units[unit - 2];
                    let scan = unit.scan(&self.scene, offset_ns / unit.period_ns);
                    (unit.period_ns, observed(name, self.start_ns, &scan))
                }
            };
            next.0 += period_ns;
            Some(Told { stamp_ns, observation })
        })
    }

    fn pose(&self, offset_ns: i64) -> Observation {
        let time = offset_ns as f64 * 1e-9;
        let pose = self.scene.pose_at(time);
        let (at, turned) = (pose.translation.vector, pose.rotation.coords);
        let turned = [turned.x, turned.y, turned.z, turned.w];
        Observation::pose(self.start_ns + offset_ns, at.into(), turned, self.scene.drive.speed_at(time))
    }
}

/// A lane ahead as a camera would find it.
fn road(stamp_ns: i64) -> Observation {
    let points: Vec<[f64; 3]> = (0..12).map(|i| [3.0 + 3.0 * f64::from(i), 0.0, 3.5]).collect();
    Observation::road(stamp_ns, RoadPurpose::Paint, RoadFrame::Ego, &points)
}

fn observed(sensor: &str, start_ns: i64, scan: &PlaneScan) -> Observation {
    Observation::scan(sensor, start_ns + scan.end_ns, &scan.x, &scan.y, &scan.z)
        .intensity(&scan.intensity)
        .rings(&scan.ring)
        .offsets_ns(&scan.offset_ns)
        .no_returns(&scan.no_returns)
}

/// As the configuration spells a mount.
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
