//! A labelled scan -> the same scan as it would be of another world or of another sensor.
//!
//! In: a scan in the sensor frame, its mount. Out: a [`Varied`] scan with the index of each of its points in the
//! original, and the extrinsics that the maps get. A point has the truth of its original point, so the truth is
//! transformed with the scan.

use std::fmt;

use anyhow::{Result, bail};
use clearway_mapping::config::Extrinsics;
use clearway_mapping::event::Scan;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

/// Range from which a bent world leaves the plane under the vehicle, in metres.
const BEND_FROM_M: f64 = 8.0;
/// Number of lasers that a scan needs for a variation that keeps some of its lasers.
const LASERS: u16 = 64;

/// How a scan is varied.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Variation {
    /// The scan as it was recorded.
    #[default]
    Recorded,
    /// The world rises by this many percent from 8 m on in every direction, or falls if the number is negative.
    Bend(f64),
    /// The world is rolled about the vehicle's forward axis by this many degrees; its left side is higher if the
    /// number is positive.
    Roll(f64),
    /// This many lasers of a sensor with 64, evenly chosen. The scan states their rings, because the sensor is then
    /// another model.
    Lasers(u16),
    /// The ego frame's origin is this many metres behind the sensor.
    SensorOffset(f64),
}

/// A scan after a [`Variation`].
#[derive(Clone, Debug, PartialEq)]
pub struct Varied {
    /// The scan, sensor frame.
    pub scan: Scan,
    /// Index of each point in the original scan.
    pub original: Vec<u32>,
    /// Extrinsics of the sensor that the maps get.
    pub extrinsics: Extrinsics,
}

impl Variation {
    /// The scan as recorded; its world bent by ±3, 6 and 10 % and rolled by ±3 degrees; seen by 32 and by 16 of its
    /// lasers; with the ego frame's origin 1.5 m behind the sensor.
    pub const ALL: [Self; 12] = [
        Self::Recorded,
        Self::Bend(3.0),
        Self::Bend(-3.0),
        Self::Bend(6.0),
        Self::Bend(-6.0),
        Self::Bend(10.0),
        Self::Bend(-10.0),
        Self::Roll(3.0),
        Self::Roll(-3.0),
        Self::Lasers(32),
        Self::Lasers(16),
        Self::SensorOffset(1.5),
    ];

    /// True if the variation is for final tables only, so that no parameter is tuned on it: every other bend, and one
    /// roll.
    pub fn is_final_only(self) -> bool {
        matches!(self, Self::Bend(percent) if [-3.0, 6.0, -10.0].contains(&percent)) || self == Self::Roll(-3.0)
    }

    /// Varies a scan of a sensor at these extrinsics.
    ///
    /// # Errors
    /// If lasers are to be chosen and the file does not have the points of 64 in order.
    pub fn apply(self, scan: &Scan, extrinsics: Extrinsics) -> Result<Varied> {
        let all = (0..scan.x.len() as u32).collect();
        let mut varied = Varied { scan: scan.clone(), original: all, extrinsics };
        match self {
            Self::Recorded => {}
            Self::Bend(percent) => {
                let ego_from_sensor = extrinsics.ego_from_sensor();
                let up = ego_from_sensor.rotation.inverse() * Vector3::z();
                move_points(&mut varied.scan, |point| {
                    // The range is that in the ego frame's plane, about the sensor.
                    let range = (ego_from_sensor.rotation * point.coords).xy().norm();
                    point + up * (percent / 100.0 * (range - BEND_FROM_M).max(0.0))
                });
            }
            Self::Roll(degrees) => {
                let ego_from_sensor = extrinsics.ego_from_sensor();
                let roll = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), degrees.to_radians());
                let rolled: Isometry3<f64> = ego_from_sensor.inverse() * roll * ego_from_sensor;
                move_points(&mut varied.scan, |point| rolled * point);
            }
            Self::Lasers(number) => {
                let rings = rings(scan);
                let found = rings.last().map_or(0, |last| usize::from(*last) + 1);
                if found != usize::from(LASERS) {
                    bail!(
                        "lasers are chosen from the order of the points, as KITTI's files have it: {found} ring(s) found, \
                         not {LASERS}"
                    );
                }
                let step = LASERS / number.clamp(1, LASERS);
                varied.original.retain(|index| rings[*index as usize].is_multiple_of(step));
                varied.scan = chosen(scan, &varied.original);
                // KITTI's files begin with the highest laser; ring 0 is the lowest.
                let ring = |index: &u32| (LASERS - 1 - rings[*index as usize]) / step;
                varied.scan.ring = varied.original.iter().map(ring).collect();
            }
            Self::SensorOffset(metres) => varied.extrinsics.x_m += metres,
        }
        Ok(varied)
    }
}

/// The name of the variation on the command line, of its row in the report, and of the folder of its files.
impl fmt::Display for Variation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Recorded => write!(f, "recorded"),
            Self::Bend(percent) => write!(f, "bend{percent:+}"),
            Self::Roll(degrees) => write!(f, "roll{degrees:+}"),
            Self::Lasers(number) => write!(f, "lasers{number}"),
            Self::SensorOffset(metres) => write!(f, "offset{metres:+}"),
        }
    }
}

fn move_points(scan: &mut Scan, moved: impl Fn(Point3<f64>) -> Point3<f64>) {
    for ((x, y), z) in scan.x.iter_mut().zip(&mut scan.y).zip(&mut scan.z) {
        let point = moved(Point3::new(f64::from(*x), f64::from(*y), f64::from(*z)));
        (*x, *y, *z) = (point.x as f32, point.y as f32, point.z as f32);
    }
}

/// Number of the ring of each point of a scan that has the points ring by ring, each from azimuth 0 counter-clockwise:
/// a ring begins where the azimuth falls by more than half a turn.
fn rings(scan: &Scan) -> Vec<u16> {
    let azimuths = scan.x.iter().zip(&scan.y).map(|(x, y)| y.atan2(*x).rem_euclid(std::f32::consts::TAU));
    let (mut ring, mut before) = (0_u16, 0.0);
    azimuths
        .map(|azimuth| {
            ring = ring.saturating_add(u16::from(before - azimuth > std::f32::consts::PI));
            before = azimuth;
            ring
        })
        .collect()
}

/// The points of these indices. Directions without a return are left out, because their lasers are not known.
fn chosen(scan: &Scan, indices: &[u32]) -> Scan {
    fn of<T: Copy>(values: &[T], indices: &[u32]) -> Vec<T> {
        indices.iter().filter_map(|index| values.get(*index as usize).copied()).collect()
    }
    Scan {
        stamp_ns: scan.stamp_ns,
        x: of(&scan.x, indices),
        y: of(&scan.y, indices),
        z: of(&scan.z, indices),
        intensity: of(&scan.intensity, indices),
        ring: of(&scan.ring, indices),
        offset_ns: of(&scan.offset_ns, indices),
        no_returns: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEVEL: Extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 2.0, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };

    fn scan(points: &[[f32; 3]]) -> Scan {
        let axis = |axis: usize| points.iter().map(|point| point[axis]).collect();
        Scan { x: axis(0), y: axis(1), z: axis(2), intensity: vec![0.5; points.len()], ..Scan::default() }
    }

    #[test]
    fn a_bend_begins_at_eight_metres_and_rises_in_every_direction() {
        let scan = scan(&[[7.0, 0.0, -2.0], [18.0, 0.0, -2.0], [0.0, -28.0, -2.0]]);
        let bent = Variation::Bend(10.0).apply(&scan, LEVEL).unwrap().scan;
        assert_eq!((&bent.x, &bent.y), (&scan.x, &scan.y));
        assert_eq!(bent.z, [-2.0, -1.0, 0.0]);
        assert_eq!(Variation::Bend(-3.0).apply(&scan, LEVEL).unwrap().scan.z[1], -2.3);
    }

    #[test]
    fn a_roll_lifts_the_left_side_and_keeps_the_ground_under_the_vehicle() {
        let scan = scan(&[[0.0, 0.0, -2.0], [0.0, 10.0, -2.0]]);
        let rolled = Variation::Roll(3.0).apply(&scan, LEVEL).unwrap().scan;
        assert!(rolled.z[0] == -2.0 && rolled.y[0].abs() < 1e-6);
        assert!((rolled.z[1] - (-2.0 + 10.0 * 3f32.to_radians().sin())).abs() < 1e-5, "{}", rolled.z[1]);
    }

    #[test]
    fn lasers_are_chosen_by_the_order_of_the_file() {
        let points: Vec<[f32; 3]> = (0..64 * 8)
            .map(|index| {
                let (sin, cos) = ((index % 8) as f32 * 0.78 + 0.01).sin_cos();
                [cos, sin, (index / 8) as f32]
            })
            .collect();
        let all = scan(&points);
        let varied = Variation::Lasers(16).apply(&all, LEVEL).unwrap();
        assert_eq!((varied.scan.x.len(), varied.original.len()), (16 * 8, 16 * 8));
        assert!(varied.scan.z.iter().all(|z| z % 4.0 == 0.0));
        assert!(varied.original.iter().all(|index| index / 8 % 4 == 0));
        assert_eq!((varied.scan.ring[0], varied.scan.ring[16 * 8 - 1]), (15, 0));
        let error = Variation::Lasers(32).apply(&scan(&points[..80]), LEVEL).unwrap_err();
        assert!(error.to_string().contains("10 ring(s) found, not 64"), "{error}");
    }

    #[test]
    fn an_offset_moves_the_sensor_ahead_of_the_origin() {
        let scan = scan(&[[5.0, 0.0, -2.0]]);
        let varied = Variation::SensorOffset(1.5).apply(&scan, LEVEL).unwrap();
        assert_eq!((varied.scan, varied.extrinsics.x_m), (scan, 1.5));
    }

    #[test]
    fn half_of_the_bends_are_for_final_tables() {
        let bends = Variation::ALL.into_iter().filter(|variation| matches!(variation, Variation::Bend(_)));
        assert_eq!(bends.filter(|bend| bend.is_final_only()).count(), 3);
    }
}
