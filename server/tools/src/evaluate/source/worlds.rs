//! Simulated scenes -> maps of the pipeline, with the simulator's truth about every point.
//!
//! In: a scene. Out: for each frame a map and its [`JudgedPoint`]s. The vehicle's datagrams, and its pose every 10 ms,
//! are the events; the truth describes the end of the map's capture.

use anyhow::Result;
use bytes::Bytes;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig};
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::sensor::sweep::Sweep;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::Scene;
use clearway_sim::truth::{Limits, Truth, TruthGrid};
use clearway_sim::vehicle::SimulatedVehicle;

use super::super::footprint::ground::KnownPlace;
use super::super::judge::{JudgedPoint, OBSTACLE_M_MAX, OBSTACLE_M_MIN, Scored, Vote};
use super::super::report::{EvaluatedSource, FrameTruth, UNREACHABLE};
use super::one_sensor::pipeline;
use crate::scenes::NamedScene;

/// Half the edge of the truth's grid and the edge of its cells, in metres.
const RASTER_M: (f64, f64) = (60.0, 0.2);
/// Greatest height of a ground point above the true ground, in metres: ten times the sensor's noise, which also covers
/// the rise of the ground within a cell of the truth.
const GROUND_M_MAX: f32 = 0.15;
/// Time between two poses, in nanoseconds.
const POSE_PERIOD_NS: i64 = 10_000_000;

/// Judges the maps of a scene.
///
/// # Errors
/// If a value of the configuration is not allowed.
pub fn judge_scene(
    named: &NamedScene,
    model: Option<Model>,
    maps: &MapsConfig,
    source: &mut EvaluatedSource,
    judged: &mut impl FnMut(),
) -> Result<()> {
    let default = ScannerConfig::default();
    let scanner = ScannerConfig { model: model.unwrap_or(default.model), ..default };
    drive((named.make)(), scanner, maps, named.revolutions, |pipeline, _, truth| {
        source.row("", false).judge_map(pipeline, truth)?;
        judged();
        Ok(())
    })
}

/// Drives through the scene until `revolutions` whole revolutions have become maps, and calls `judge` after each with
/// the pipeline, the extrinsics of the upright sensor and the truth of the map.
///
/// # Errors
/// If a value of the configuration is not allowed, or `judge` fails.
pub fn drive(
    scene: Scene,
    scanner: ScannerConfig,
    maps: &MapsConfig,
    revolutions: u64,
    mut judge: impl FnMut(&Pipeline, &Extrinsics, FrameTruth<'_>) -> Result<()>,
) -> Result<()> {
    let at = scanner.ego_from_sensor.translation;
    let extrinsics = Extrinsics { x_m: at.x, y_m: at.y, z_m: at.z, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let (mut pipeline, _) = pipeline(maps, Some(scanner.model), extrinsics)?;
    let vehicle = SimulatedVehicle::new(scene, scanner);
    let mut next_pose_ns = vehicle.start_ns();
    let mut judged = 0;
    for datagram in vehicle.clone() {
        while next_pose_ns <= datagram.stamp_ns {
            let (map_from_ego, speed_mps) = (vehicle.pose_at(next_pose_ns), vehicle.speed_at(next_pose_ns));
            let pose = Body::EgoPose(EgoPose { stamp_ns: next_pose_ns, map_from_ego, speed_mps });
            step(&mut pipeline, next_pose_ns, pose);
            next_pose_ns += POSE_PERIOD_NS;
        }
        let Some([start_ns, end_ns]) =
            step(&mut pipeline, datagram.stamp_ns, Body::Datagram(Bytes::from(datagram.payload)))
        else {
            continue;
        };
        let limits = Limits::default();
        let truth = vehicle.truth_at(end_ns, RASTER_M.0, RASTER_M.1, &limits);
        let before = vehicle.truth_before(end_ns, end_ns - start_ns, RASTER_M.0, RASTER_M.1, &limits);
        let (points, known) = (points(pipeline.newest_sweep(), &truth), known_places(&truth, &before));
        judge(&pipeline, &extrinsics, FrameTruth { points: &points, whole: &points, known: &known })?;
        judged += 1;
        if judged == revolutions {
            break;
        }
    }
    Ok(())
}

/// The stamps at which the capture of the map that the event completed began and ended; `None` without a map or if a
/// sensor's revolution in it is partial.
fn step(pipeline: &mut Pipeline, arrival_ns: i64, body: Body) -> Option<[i64; 2]> {
    let made = pipeline.step(&Event { sequence: 0, arrival_ns, source: 0, body });
    let map = made.expect("the pipeline accepts the simulator's datagrams and poses")?;
    let stamps_ns = [map.capture_start_ns, map.capture_end_ns];
    map.sensors.iter().all(|sensor| sensor.partial.is_empty()).then_some(stamps_ns)
}

/// The places of the truth's raster on which no vehicle may stand, or perhaps none. `before` is the truth when the
/// capture of the map began.
fn known_places(truth: &TruthGrid, before: &TruthGrid) -> Vec<KnownPlace> {
    let vote = |(class, before): (&Truth, &Truth)| match class {
        Truth::Drivable | Truth::Outside => None,
        // What hangs higher than the uppermost laser looks cannot be known; what was seen of it are points.
        Truth::Tight | Truth::Overhang => Some(Vote::Either),
        Truth::Unreachable => Some(Vote::Forbidden),
        Truth::Steep => Some(Vote::Steep),
        // A thing that came while the scan was made may have been seen elsewhere.
        Truth::Obstacle if *before != Truth::Obstacle => Some(Vote::Either),
        Truth::Obstacle => Some(Vote::Obstacle),
    };
    let place = |index: usize| <[f64; 2]>::from(truth.middle(index)).map(|place| place as f32);
    (0..)
        .zip(truth.classes.iter().zip(&before.classes))
        .filter_map(|(index, classes)| Some(KnownPlace { place: place(index), vote: vote(classes)? }))
        .collect()
}

/// The truth about the points of a sweep.
fn points(sweep: &Sweep, truth: &TruthGrid) -> Vec<JudgedPoint> {
    let place = |i: usize| [sweep.x[i], sweep.y[i], sweep.z[i]];
    (0..sweep.x.len()).map(|i| point(place(i), truth)).collect()
}

fn point(place: [f32; 3], truth: &TruthGrid) -> JudgedPoint {
    let [x, y] = [place[0], place[1]].map(f64::from);
    let Some(ground) = truth.height_at(x, y) else {
        let ground = [Scored::Not; 2];
        return JudgedPoint { place, over_m: f32::NAN, class: "outside", vote: Vote::Nothing, road: false, ground };
    };
    let over = place[2] - ground;
    let here = truth.class_at(x, y);
    let (class, vote) = match here {
        _ if over > OBSTACLE_M_MAX => ("object", Vote::Nothing),
        _ if over > OBSTACLE_M_MIN => ("object", Vote::Obstacle),
        Truth::Steep => ("steep", Vote::Steep),
        Truth::Unreachable => (UNREACHABLE, Vote::Forbidden),
        Truth::Drivable => ("ground", Vote::Drivable),
        // Ground in a cell of the truth that also has an object: both answers are correct.
        Truth::Obstacle | Truth::Overhang | Truth::Tight | Truth::Outside => ("ground", Vote::Either),
    };
    let scored = match here {
        _ if over > GROUND_M_MAX => Scored::Other,
        Truth::Obstacle | Truth::Overhang | Truth::Outside => Scored::Not,
        _ => Scored::Ground,
    };
    JudgedPoint { place, over_m: over, class, vote, road: false, ground: [scored; 2] }
}
