//! Poses, roads and scans of files -> observations.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clearway_client::Observation;
use clearway_client::observation::{RoadFrame, RoadPurpose};
use clearway_daemon::base::files;
use clearway_mapping::event::{Road, RoadPurpose as Purpose};
use clearway_mapping::road::rddf::Rddf;
use clearway_mapping::road::rndf::Rndf;
use clearway_mapping::road::{FOOT_M, LineError, LocalFrame};
use clearway_mapping::scan_file;

/// Width of an RNDF lane without a width, in metres: 12 feet, the width of most lanes.
const LANE_M: f64 = 12.0 * FOOT_M;

/// One observation to send.
pub enum IngestItem {
    /// Position in the map frame in metres, quaternion x y z w, forward speed in m/s.
    Pose([f64; 3], [f64; 4], f64),
    /// A road in the map frame.
    Road(Road),
    /// The file of a scan.
    Scan(PathBuf),
}

impl IngestItem {
    /// The kind of the item, and its observation.
    ///
    /// # Errors
    /// If the file of a scan cannot be read.
    pub fn read(&self, sensor: &str, stamp_ns: i64) -> Result<(&'static str, Observation)> {
        Ok(match self {
            Self::Pose(at, turned, speed_mps) => ("poses", Observation::pose(stamp_ns, *at, *turned, *speed_mps)),
            Self::Road(road) => {
                let points: Vec<[f64; 3]> =
                    road.points.iter().zip(&road.widths_m).map(|(&[x, y], &width)| [x, y, width]).collect();
                let purpose = match road.purpose {
                    Purpose::Paint => RoadPurpose::Paint,
                    Purpose::Route => RoadPurpose::Route,
                };
                ("roads", Observation::road(stamp_ns, purpose, RoadFrame::Map, &points))
            }
            Self::Scan(file) => {
                let bytes = files::read(file)?;
                let scan = scan_file::read(&file.to_string_lossy(), &bytes);
                let (_, scan) = scan.with_context(|| file.display().to_string())?;
                let observation = Observation::scan(sensor, stamp_ns, &scan.x, &scan.y, &scan.z);
                ("scans", observation.intensity(&scan.intensity).rings(&scan.ring))
            }
        })
    }
}

/// Reads lines of "seconds x y z qx qy qz qw". The speed of each pose is that from the pose before it.
pub fn read_poses(text: &str) -> Result<Vec<(i64, IngestItem)>> {
    let mut poses: Vec<(i64, [f64; 7])> = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|number| number.parse().ok()).collect();
        let Ok([seconds, pose @ ..]) = <[f64; 8]>::try_from(numbers) else {
            bail!("line {}: {line:?}: eight numbers are needed", index + 1)
        };
        poses.push(((seconds * 1e9).round() as i64, pose));
    }
    let speed_mps = |from: &(i64, [f64; 7]), to: &(i64, [f64; 7])| {
        let [dx, dy, dz] = [0, 1, 2].map(|axis| to.1[axis] - from.1[axis]);
        let seconds = to.0.saturating_sub(from.0) as f64 * 1e-9;
        let [qx, qy, qz, qw] = [3, 4, 5, 6].map(|axis| to.1[axis]);
        // The distance driven along the vehicle's x axis; backwards is negative.
        let forward = [1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy + qw * qz), 2.0 * (qx * qz - qw * qy)];
        let driven_m = dx * forward[0] + dy * forward[1] + dz * forward[2];
        if seconds > 0.0 { driven_m / seconds } else { 0.0 }
    };
    let item = |index: usize| {
        let (stamp_ns, [x, y, z, qx, qy, qz, qw]) = poses[index];
        let (from, to) = if index > 0 { (index - 1, index) } else { (0, 1.min(poses.len() - 1)) };
        (stamp_ns, IngestItem::Pose([x, y, z], [qx, qy, qz, qw], speed_mps(&poses[from], &poses[to])))
    };
    Ok((0..poses.len()).map(item).collect())
}

/// Reads the route of an RDDF, or one lane of an RNDF to paint; returns also the lines that are left out.
pub fn read_road(
    text: &str,
    ending: &str,
    origin: Option<[f64; 2]>,
    lane: Option<&str>,
) -> (Result<Road>, Vec<LineError>) {
    let frame = |frame_of_file: Option<LocalFrame>| match origin {
        Some([latitude, longitude]) => Some(LocalFrame::new(latitude, longitude)),
        None => frame_of_file,
    };
    if ending == "rddf" {
        let rddf = Rddf::read(text);
        let road = frame(rddf.local_frame()).map(|frame| rddf.road(&frame, Purpose::Route, 0));
        return (road.context("no row of a route"), rddf.refused);
    }
    let mut rndf = Rndf::read(text);
    let names: Vec<String> = rndf.lanes.iter().map(|lane| lane.name.clone()).collect();
    let frame = frame(rndf.local_frame());
    let lane = match lane {
        None => rndf.lanes.first(),
        Some(name) => rndf.lanes.iter().find(|lane| lane.name == name),
    };
    let road = lane.zip(frame).and_then(|(lane, frame)| lane.road(&frame, Some(LANE_M), 0));
    let road = road.with_context(|| format!("no such lane with two points; lanes: {}", names.join(", ")));
    (road, std::mem::take(&mut rndf.refused))
}
