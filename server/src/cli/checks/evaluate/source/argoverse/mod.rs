//! Logs of Argoverse 2 -> scans, and the truth about their points from the map of the ground.
//!
//! In: the folder of a log, with `city_SE3_egovehicle.feather`, `map/` and `sensors/lidar/*.feather`. Out: the counts
//! of all sweeps, in a [`Source`]. A point is ground within [`GROUND_OFF_M`] of the published ground-height raster, and
//! an obstacle 0.3 to 2.5 m above it. Ground inside a drivable area is drivable if it can be reached; other ground may
//! be called drivable or not. The two VLP-32C stand on top of one another, so they are read as one sensor of 64 rings.
//!
//! | file | in -> out |
//! |---|---|
//! | [`map`] | the log's map -> height of the ground, drivable areas |
//! | [`feather`] | Arrow files -> columns |

pub mod feather;
pub mod map;

use std::path::{Path, PathBuf};
use std::time::Instant;

use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::pipeline::Pipeline;
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion};

use super::super::error::EvaluateError;
use super::super::judge::{OBSTACLE_M_MAX, OBSTACLE_M_MIN, Point, Scored, Vote};
use super::super::report::Source;
use super::labels::mark_reachable;
use super::setup::{SensorSetup, pipeline};
use super::written::{Frame, write_sweep};
use feather::{columns, f16, values};
use map::GroundMap;

/// Greatest distance of a ground point from the raster, in metres. Ours, because the raster has cells of 0.3 m and
/// three quarters of the points within 10 m are within 0.03 m of it.
const GROUND_OFF_M: f32 = 0.15;
/// Height of the rear axle, the origin of Argoverse's frame, over the ground, in metres: the median of the ground
/// points within 8 m in the sample log is 0.33 to 0.34 m below it.
const AXLE_M: f64 = 0.33;
/// Middle of the two sensors in Argoverse's frame, in metres, from the published calibration of its cars.
const SENSOR_M: [f64; 3] = [1.35, 0.0, 1.60];
/// File of a log that has the poses of the vehicle.
const POSES: &str = "city_SE3_egovehicle.feather";
/// Name of the only row.
const RECORDED: &str = "as recorded";
/// Number of lasers of both sensors.
const LASERS: usize = 64;

/// A log.
#[derive(Clone, Debug, PartialEq)]
pub struct Log {
    folder: PathBuf,
    sweeps: Vec<PathBuf>,
}

impl Log {
    /// The folders of the logs directly in a folder, by name.
    pub fn folders_in(folder: &Path) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(folder).into_iter().flatten();
        let mut folders: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
        folders.retain(|folder| folder.join(POSES).is_file());
        folders.sort();
        folders
    }

    /// The log in a folder; `None` if the folder is not one.
    pub fn find(folder: &Path) -> Option<Self> {
        folder.join(POSES).is_file().then_some(())?;
        let entries = std::fs::read_dir(folder.join("sensors/lidar")).ok()?;
        let mut sweeps: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
        sweeps.retain(|path| path.extension().is_some_and(|extension| extension == "feather"));
        sweeps.sort();
        Some(Self { folder: folder.to_owned(), sweeps })
    }

    /// Number of sweeps.
    pub fn frames(&self) -> u64 {
        self.sweeps.len() as u64
    }

    /// Judges all sweeps in order, with one pipeline.
    ///
    /// # Errors
    /// [`EvaluateError::Argoverse`] for a file that cannot be read, [`EvaluateError::Rejected`] for a sweep that the
    /// pipeline refuses, [`EvaluateError::Maps`] if a value of the configuration is not allowed.
    pub fn judge(
        &self,
        maps: &MapsConfig,
        write_to: Option<&Path>,
        source: &mut Source,
        judged: &mut impl FnMut(),
    ) -> Result<(), EvaluateError> {
        let [x_m, y_m, z_m] = SENSOR_M;
        let extrinsics = Extrinsics { x_m, y_m, z_m: z_m + AXLE_M, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
        source.mounts.push(format!("{x_m},{y_m},{:.2},0,0,0: both sensors of Argoverse 2", extrinsics.z_m));
        let (mut pipeline, _) = pipeline(maps, &SensorSetup::default(), extrinsics)?;
        let poses = Poses::read(&self.folder.join(POSES))?;
        let map = GroundMap::read(&self.folder.join("map"))?;
        for (sequence, file) in (0..).step_by(2).zip(&self.sweeps) {
            let scan = read_sweep(file)?;
            let city_from_ego = poses.at(scan.stamp_ns).ok_or_else(|| fault(file, "no pose at its time"))?;
            let map_from_ego = city_from_ego * Translation3::new(0.0, 0.0, -AXLE_M);
            let pose = EgoPose { stamp_ns: scan.stamp_ns, map_from_ego, speed_mps: 0.0 };
            step(&mut pipeline, sequence, scan.stamp_ns, Body::EgoPose(pose), file)?;
            let begun = Instant::now();
            step(&mut pipeline, sequence + 1, scan.stamp_ns, Body::Scan(scan), file)?;
            let step_ms = begun.elapsed().as_secs_f64() * 1e3;
            let sweep = pipeline.newest_sweep();
            let places = sweep.x.iter().zip(&sweep.y).zip(&sweep.z);
            let mut points: Vec<Point> = places.map(|((&x, &y), &z)| truth([x, y, z], &map_from_ego, &map)).collect();
            mark_reachable(sweep, &mut points);
            // The map does not state what is drivable outside the drivable areas.
            let outside = |point: &&mut Point| point.vote == Vote::Drivable && !point.road;
            points.iter_mut().filter(outside).for_each(|point| point.vote = Vote::Either);
            if let Some(folder) = write_to {
                let name = file.file_stem().unwrap_or_default().to_string_lossy();
                let frame =
                    Frame { folder: &folder.join("argoverse"), name: &name, path: &source.path, rows: &[RECORDED] };
                write_sweep(&frame, (sweep, &extrinsics), &points)?;
            }
            let row = source.row(RECORDED, false);
            row.judge_map(&pipeline, &points);
            row.step_ms.push(step_ms);
            judged();
        }
        Ok(())
    }
}

/// An error about a file.
fn fault(file: &Path, what: &str) -> EvaluateError {
    EvaluateError::Argoverse { file: file.to_owned(), what: what.to_owned() }
}

fn step(pipeline: &mut Pipeline, sequence: u64, arrival_ns: i64, body: Body, file: &Path) -> Result<(), EvaluateError> {
    let rejected = |source| EvaluateError::Rejected { scan: file.to_owned(), source };
    pipeline.step(&Event { sequence, arrival_ns, source: 0, body }).map(|_| ()).map_err(rejected)
}

/// The truth about a point at a place in the ego frame.
fn truth(place: [f32; 3], map_from_ego: &Isometry3<f64>, map: &GroundMap) -> Point {
    let at = map_from_ego * Point3::from(place.map(f64::from));
    let Some(ground) = map.height_m(at.x, at.y) else {
        return Point { place, class: "unmapped", vote: Vote::Nothing, road: false, ground: [Scored::Not; 2] };
    };
    let over = (at.z - ground) as f32;
    let is_ground = over.abs() <= GROUND_OFF_M;
    let road = is_ground && map.is_drivable(at.x, at.y);
    let (class, vote) = match () {
        () if over > OBSTACLE_M_MAX => ("object", Vote::Nothing),
        () if over > OBSTACLE_M_MIN => ("object", Vote::Obstacle),
        () if !is_ground => ("low", Vote::Seen),
        () if road => ("drivable-area", Vote::Either),
        () => ("other-ground", Vote::Either),
    };
    let scored = match () {
        () if is_ground => Scored::Ground,
        () if over > OBSTACLE_M_MIN => Scored::Other,
        () => Scored::Not,
    };
    Point { place, class, vote, road, ground: [scored; 2] }
}

/// A sweep as a scan of one sensor, in a level frame at the middle of the two sensors. Its stamp is in the file's name;
/// the points are already moved to that time.
fn read_sweep(file: &Path) -> Result<Scan, EvaluateError> {
    let bytes = std::fs::read(file).map_err(|error| fault(file, &error.to_string()))?;
    let stamp_ns = file.file_stem().and_then(|stem| stem.to_str()?.parse().ok());
    let stamp_ns = stamp_ns.ok_or_else(|| fault(file, "its name is not a stamp in nanoseconds"))?;
    scan(&bytes, stamp_ns).ok_or_else(|| fault(file, "columns x y z intensity laser_number offset_ns are needed"))
}

fn scan(file: &[u8], stamp_ns: i64) -> Option<Scan> {
    let columns: [Vec<u8>; 6] = columns(file)?.try_into().ok()?;
    let [x, y, z] = [0, 1, 2].map(|axis: usize| {
        let moved = move |bytes| f16(bytes) - SENSOR_M[axis] as f32;
        values(&columns[axis], moved)
    });
    let (x, y, z) = (x?, y?, z?);
    let (intensity, lasers) = (&columns[3], &columns[4]);
    let same = [y.len(), z.len(), intensity.len(), lasers.len()].iter().all(|length| *length == x.len());
    if !same || lasers.iter().any(|laser| usize::from(*laser) >= LASERS) {
        return None;
    }
    let rank = ranks(&x, &y, &z, lasers);
    Some(Scan {
        stamp_ns,
        intensity: intensity.iter().map(|intensity| f32::from(*intensity) / 255.0).collect(),
        ring: lasers.iter().map(|laser| rank[usize::from(*laser)]).collect(),
        x,
        y,
        z,
        ..Scan::default()
    })
}

/// Rank of each laser by the median elevation of its points, 0 the lowest.
fn ranks(x: &[f32], y: &[f32], z: &[f32], lasers: &[u8]) -> [u16; LASERS] {
    let mut elevations: Vec<Vec<f32>> = vec![Vec::new(); LASERS];
    for (((x, y), z), laser) in x.iter().zip(y).zip(z).zip(lasers) {
        elevations[usize::from(*laser)].push(z.atan2(x.hypot(*y)));
    }
    let median = |values: &mut Vec<f32>| {
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(f32::INFINITY)
    };
    let mut order: Vec<(f32, usize)> = elevations.iter_mut().map(median).zip(0..).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut ranks = [0; LASERS];
    for (rank, (_, laser)) in (0..).zip(order) {
        ranks[laser] = rank;
    }
    ranks
}

/// Poses of the vehicle, by stamp.
struct Poses {
    stamps_ns: Vec<i64>,
    /// By stamp: qw qx qy qz tx ty tz.
    parts: [Vec<f64>; 7],
}

impl Poses {
    fn read(file: &Path) -> Result<Self, EvaluateError> {
        let bytes = std::fs::read(file).map_err(|error| fault(file, &error.to_string()))?;
        let parse = || {
            let columns: [Vec<u8>; 8] = columns(&bytes)?.try_into().ok()?;
            let stamps_ns = values(&columns[0], i64::from_le_bytes)?;
            let mut parts: [Vec<f64>; 7] = Default::default();
            for (part, column) in parts.iter_mut().zip(&columns[1..]) {
                *part = values(column, f64::from_le_bytes).filter(|part| part.len() == stamps_ns.len())?;
            }
            Some(Self { stamps_ns, parts })
        };
        parse().ok_or_else(|| fault(file, "columns timestamp_ns qw qx qy qz tx_m ty_m tz_m are needed"))
    }

    /// The pose with exactly this stamp: every sweep has one.
    fn at(&self, stamp_ns: i64) -> Option<Isometry3<f64>> {
        let index = self.stamps_ns.iter().position(|stamp| *stamp == stamp_ns)?;
        let [w, i, j, k, x, y, z] = self.parts.each_ref().map(|part| part[index]);
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k));
        Some(Isometry3::from_parts(Translation3::new(x, y, z), rotation))
    }
}
