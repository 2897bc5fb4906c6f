//! A simulated vehicle with six sensors. Its scans are transformed to the ego frame of their ends, as the pipeline
//! does.

use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::{Context, Geometry, Layer, LayerMaker, Rays};
use clearway_mapping::sensor::sweep::Sweep;
use clearway_sim::planes::PlaneUnit;
use clearway_sim::scenes::Scene;
use nalgebra::{Isometry3, Point3, Vector3};

/// Number of scans of each sensor in a map: 100 ms at 50 Hz.
pub const SCANS: i64 = 5;

/// A scene, the sensors of its vehicle, and the layer they make.
pub struct Street {
    pub scene: Scene,
    pub units: Vec<PlaneUnit>,
    pub occupancy: Occupancy,
}

/// One sensor's scan, ego frame at its end.
pub struct ScanInEgo {
    pub sweep: Sweep,
    pub no_returns: Vec<[f32; 3]>,
    pub origin_m: [f32; 3],
    pub map_from_ego: Isometry3<f64>,
}

/// Scan `number` of a sensor.
pub fn scan(scene: &Scene, unit: &PlaneUnit, number: i64) -> ScanInEgo {
    let scan = unit.scan(scene, number);
    let seconds = |ns: i64| ns as f64 * 1e-9;
    let map_from_ego = scene.pose_at(seconds(scan.end_ns));
    let end_from_map = map_from_ego.inverse();
    let mut sweep = Sweep::default();
    for i in 0..scan.x.len() {
        let seen_at = scene.pose_at(seconds(scan.end_ns + i64::from(scan.offset_ns[i])));
        let point = Point3::new(f64::from(scan.x[i]), f64::from(scan.y[i]), f64::from(scan.z[i]));
        let point = end_from_map * seen_at * unit.ego_from_sensor * point;
        super::add(&mut sweep, [point.x as f32, point.y as f32, point.z as f32]);
    }
    let rotated =
        |d: &[f32; 3]| (unit.ego_from_sensor.rotation * Vector3::from(d.map(f64::from))).map(|v| v as f32).into();
    ScanInEgo {
        sweep,
        no_returns: scan.no_returns.iter().map(rotated).collect(),
        origin_m: unit.ego_from_sensor.translation.vector.map(|v| v as f32).into(),
        map_from_ego,
    }
}

/// Corners of a cell of a layer, world frame, metres.
pub fn cell_corners(layer: &Layer, cell: usize, map_from_ego: &Isometry3<f64>) -> [[f64; 2]; 4] {
    let Geometry::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } = layer.geometry else {
        panic!("{} has no square cells", layer.name)
    };
    let (sin, cos) = yaw_rad.sin_cos();
    [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(i, j)| {
        let x = origin_x_m + ((cell % width as usize) as f64 + i) * f64::from(cell_m);
        let y = origin_y_m + ((cell / width as usize) as f64 + j) * f64::from(cell_m);
        let place = map_from_ego * Point3::new(x * cos + y * sin, y * cos - x * sin, 0.0);
        [place.x, place.y]
    })
}

impl Street {
    /// Layer `number`, which ends 100 ms after the layer before, with the pose of the vehicle and the time (s) at its
    /// end.
    pub fn map(&mut self, number: i64) -> (Layer, Isometry3<f64>, f64) {
        let speed_mps = Some(self.scene.drive.speed);
        for number in number * SCANS + 1..=(number + 1) * SCANS {
            for (sensor, unit) in self.units.iter().enumerate() {
                let rays = scan(&self.scene, unit, number);
                self.occupancy.integrate(&Rays {
                    sensor: sensor as u16,
                    stamp_ns: number * unit.period_ns,
                    returns: &rays.sweep,
                    heights_m: &rays.sweep.z,
                    origin_m: rays.origin_m,
                    origin_height_m: rays.origin_m[2],
                    no_returns: &rays.no_returns,
                    map_from_ego: Some(rays.map_from_ego),
                    speed_mps,
                });
            }
        }
        let time = ((number + 1) * SCANS) as f64 * 0.02;
        let map_from_ego = self.scene.pose_at(time);
        let mut layer = self.occupancy.layer();
        let context = Context { map_from_ego: Some(map_from_ego), ..Context::default() };
        self.occupancy.make(&Sweep::default(), &context, &mut layer);
        (layer, map_from_ego, time)
    }
}
