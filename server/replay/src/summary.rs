//! The result of a replay, as text and as JSON.

use std::path::PathBuf;

use clearway_daemon::base::counted::counted;
use clearway_daemon::status::Snapshot;
use clearway_mapping::config::Extrinsics;
use clearway_mapping::map::ElevationSource;
use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::{MountError, MountEstimate};
use serde_json::{Map, Value, json};

use crate::files::Truncated;

/// Where the extrinsics of the first sensor come from.
#[derive(Clone, Debug, PartialEq)]
pub enum Mount {
    /// The options, the configuration or the recording.
    Given,
    /// The transforms of a ROS bag.
    Tf {
        /// Name of the vehicle's frame.
        ego_frame: String,
        /// Name of the sensor's frame.
        frame_id: String,
    },
    /// An estimate from the ground in the first revolutions.
    Estimated(MountEstimate),
    /// Nowhere: the transform that states them was refused, so no map was made.
    Refused {
        /// Name of the sensor's frame.
        frame_id: String,
        /// Why the transform was refused.
        fault: String,
    },
    /// Nowhere: no ground was found to estimate them from, so no map was made.
    Unknown(MountError),
    /// Nowhere: the files hold no revolution, so none are needed.
    Unneeded,
}

/// The result of a replay.
#[derive(Clone, Debug)]
pub struct ReplaySummary {
    /// Name of the first vehicle.
    pub vehicle: String,
    /// Counters, sensors, maps and latency of the first vehicle.
    pub snapshot: Snapshot,
    /// Name and state of every other vehicle.
    pub others: Vec<(String, Snapshot)>,
    /// Extrinsics of the first sensor.
    pub extrinsics: Extrinsics,
    /// Where the extrinsics come from.
    pub mount: Mount,
    /// Files that are cut off.
    pub truncated: Vec<Truncated>,
    /// Remarks about the files, one a line.
    pub notes: Vec<String>,
    /// Duration of the replay, in seconds.
    pub seconds: f64,
    /// The recording that was written.
    pub record: Option<PathBuf>,
    /// What is replayed, for people: the whole drive, or a range of it.
    pub what: &'static str,
    /// False if the replay was stopped before its end.
    pub reached_end: bool,
}

/// Why no map was made, or none that shows anything, as far as the mount and the counts say it.
pub fn why_no_map(mount: &Mount, snapshot: &Snapshot) -> String {
    if let Mount::Unknown(why) = mount {
        return format!("the mount of the sensor is not known: {why}");
    }
    if let Mount::Refused { frame_id, fault } = mount {
        return format!("the transform that places {frame_id} was refused: {fault}");
    }
    let ledger = &snapshot.ledger;
    if snapshot.maps > 0 {
        return format!("none of {} has a return", counted(snapshot.revolutions(), "revolution"));
    }
    if ledger.received == 0 {
        return "the files hold no packet, scan or message that is read".to_owned();
    }
    if ledger.received == ledger.telemetry {
        return format!(
            "the files hold {} of telemetry and no packet with points",
            counted(ledger.telemetry, "datagram")
        );
    }
    let refused = ledger.refused.iter().map(|(reason, n)| match snapshot.refusals.get(reason) {
        Some(first) => format!("{n} for {reason}: {first}"),
        None => format!("{n} for {reason}"),
    });
    let refused = refused.collect::<Vec<_>>();
    let refused = if refused.is_empty() { String::new() } else { format!(" ({})", refused.join("; ")) };
    format!(
        "of {} received {} were decoded and {}{refused} refused; they hold {}",
        ledger.received,
        ledger.decoded,
        snapshot.refused(),
        counted(snapshot.revolutions(), "revolution")
    )
}

impl ReplaySummary {
    /// The summary as one JSON object.
    pub fn to_json(&self) -> Value {
        let mut document = snapshot_json(&self.snapshot);
        let truncated = self.truncated.iter().map(|t| json!({ "file": t.file, "reason": t.reason }));
        let of_run = json!({
            "vehicle": self.vehicle,
            "mount": self.mount_json(),
            "truncated": truncated.collect::<Vec<_>>(),
            "notes": self.notes,
            "record": self.record,
            "reached_end": self.reached_end,
            "seconds": self.seconds,
        });
        document.extend(of_run.as_object().cloned().unwrap_or_default());
        let others = self.others.iter().map(|(name, snapshot)| {
            let mut other = snapshot_json(snapshot);
            other.insert("vehicle".to_owned(), name.as_str().into());
            Value::Object(other)
        });
        document.insert("others".to_owned(), others.collect());
        Value::Object(document)
    }

    /// Number of maps of all vehicles.
    pub fn maps(&self) -> u64 {
        self.snapshot.maps + self.others.iter().map(|(_, snapshot)| snapshot.maps).sum::<u64>()
    }

    /// True if a vehicle has a map and a return: only then a map shows what is around it.
    pub fn shows_anything(&self) -> bool {
        let all = std::iter::once(&self.snapshot).chain(self.others.iter().map(|(_, snapshot)| snapshot));
        all.into_iter().any(|of| of.maps > 0 && of.sensors.iter().any(|sensor| sensor.status.returns > 0))
    }

    /// Number of readings of all vehicles.
    pub fn received(&self) -> u64 {
        let others = self.others.iter().map(|(_, snapshot)| snapshot.ledger.received);
        self.snapshot.ledger.received + others.sum::<u64>()
    }

    fn mount_json(&self) -> Value {
        let e = &self.extrinsics;
        let mut known = json!({
            "source": "given",
            "x_m": e.x_m, "y_m": e.y_m, "z_m": e.z_m,
            "roll_deg": e.roll_deg, "pitch_deg": e.pitch_deg, "yaw_deg": e.yaw_deg,
        });
        match &self.mount {
            Mount::Given => known,
            Mount::Tf { ego_frame, frame_id } => {
                known["source"] = "tf".into();
                known["ego_frame"] = ego_frame.clone().into();
                known["frame_id"] = frame_id.clone().into();
                known
            }
            Mount::Estimated(estimate) => {
                known["source"] = "estimated".into();
                known["revolutions"] = estimate.revolutions.into();
                known["height_std_m"] = estimate.height_std_m.into();
                known["pitch_std_deg"] = estimate.pitch_std_rad.to_degrees().into();
                known["roll_std_deg"] = estimate.roll_std_rad.to_degrees().into();
                known["residual_m"] = estimate.residual_m.into();
                known["inliers"] = estimate.inliers.into();
                known["samples"] = estimate.samples.into();
                known["weak"] = estimate.is_weak().into();
                known
            }
            Mount::Unknown(why) => json!({ "source": "unknown", "reason": why.to_string() }),
            Mount::Refused { frame_id, fault } => {
                json!({ "source": "refused", "frame_id": frame_id, "reason": fault })
            }
            Mount::Unneeded => json!({ "source": "none" }),
        }
    }

    /// What is remarkable about the files, one remark a line, for people.
    pub fn remarks(&self) -> Vec<String> {
        let warning = |of: &Truncated| format!("warning: {}: {}; the rest was used", of.file.display(), of.reason);
        let notes = self.notes.iter().map(|note| format!("note: {note}"));
        self.truncated.iter().map(warning).chain(notes).collect()
    }

    /// The summary as a few lines of text.
    pub fn to_text(&self) -> String {
        let is_several = !self.others.is_empty();
        let first = (&self.vehicle, &self.snapshot);
        let all = std::iter::once(first).chain(self.others.iter().map(|(name, snapshot)| (name, snapshot)));
        let mut lines = Vec::new();
        for (name, snapshot) in all {
            if is_several {
                lines.push(format!("vehicle {name}"));
            }
            lines.extend(snapshot_lines(snapshot));
        }
        if let Some(record) = &self.record {
            lines.push(format!("recorded {}", record.display()));
        }
        if !self.reached_end {
            lines.push("stopped before the end".to_owned());
        }
        lines.join("\n") + "\n"
    }
}

/// The counts, sensors, maps and times of one vehicle, as lines.
fn snapshot_lines(snapshot: &Snapshot) -> Vec<String> {
    let ledger = &snapshot.ledger;
    let mut lines = vec![format!(
        "{} received, {} decoded, {} telemetry, {} refused, {} lost",
        ledger.received,
        ledger.decoded,
        ledger.telemetry,
        snapshot.refused(),
        ledger.lost
    )];
    lines.extend(ledger.refused.iter().map(|(reason, n)| {
        let first = snapshot.refusals.get(reason).map_or(String::new(), |first| format!("; the first: {first}"));
        format!("  refused for {reason}: {n}{first}")
    }));
    if ledger.poses_refused > 0 {
        let first = snapshot.refusals.get("pose").map_or(String::new(), |first| format!("; the first: {first}"));
        lines.push(format!("{} refused{first}", counted(ledger.poses_refused, "pose")));
    }
    if ledger.points_dropped > 0 {
        let points = counted(ledger.points_dropped, "point");
        lines.push(format!("{points} dropped: not finite, or beyond the reach of any sensor"));
    }
    let several = snapshot.sensors.len() > 1;
    for sensor in &snapshot.sensors {
        let model = sensor.status.model.map_or("unknown model", clearway_lidar::model::Model::as_str);
        let rpm = sensor.status.rpm.map_or(String::new(), |rpm| format!(", {rpm:.0} rpm"));
        let (revolutions, returns) = (sensor.status.revolutions, sensor.status.returns);
        let (revolutions, returns) = (counted(revolutions, "revolution"), counted(returns, "return"));
        let missing = match sensor.status.packets_lost {
            0 => String::new(),
            missing => format!(", {} missing", counted(missing, "packet")),
        };
        lines.push(format!("{}: {model}{rpm}, {revolutions}, {returns}{missing}", sensor.name));
        if several && sensor.is_reference {
            lines.push("  reference sensor: its scans make the maps".to_owned());
        }
        lines.extend(remarks(sensor).iter().map(|remark| format!("  {remark}")));
        if let Some((source, advice)) = sensor.elevations.and_then(|of| Some((of.as_str(), of.advice()?))) {
            lines.push(format!("  elevations {source}: {advice}"));
        }
    }
    let share =
        snapshot.drivable_share.map_or(String::new(), |share| format!(", newest {:.1} % drivable", 100.0 * share));
    let posed = match (snapshot.maps_with_pose, snapshot.maps) {
        (_, 0) => String::new(),
        (with_pose, maps) => format!(", {with_pose} of {maps} with a pose"),
    };
    lines.push(format!("{}{posed}{share}", counted(snapshot.maps, "map")));
    if let (Some(p50), Some(p99)) = (snapshot.latency_ms_p50, snapshot.latency_ms_p99) {
        lines.push(format!("time to make a map: median {p50:.2} ms, 99th percentile {p99:.2} ms"));
    }
    lines
}

/// What is remarkable about a sensor, for people: one line each.
fn remarks(NamedStatus { status, other_clock, .. }: &NamedStatus) -> Vec<String> {
    let is_blind = status.revolutions > 0 && status.returns == 0;
    let blind = is_blind.then(|| "its scans have no returns, so no map shows what is around it".to_owned());
    status.remarks().into_iter().chain(blind).chain(other_clock.describe()).collect()
}

fn snapshot_json(snapshot: &Snapshot) -> Map<String, Value> {
    let Snapshot { ledger, sensors, .. } = snapshot;
    let sensors = sensors.iter().map(|sensor| {
        let model = sensor.status.model.map(clearway_lidar::model::Model::as_str);
        json!({
            "name": sensor.name, "model": model, "returns": sensor.status.returns, "rpm": sensor.status.rpm,
            "revolutions": sensor.status.revolutions,
            "packets_missing": sensor.status.packets_lost,
            "elevations": sensor.elevations.map(ElevationSource::as_str),
            "remarks": remarks(sensor),
        })
    });
    let document = json!({
        "packets": snapshot.packets_json(),
        "refusals": snapshot.refusals,
        "telemetry": ledger.telemetry,
        "lost": ledger.lost, "kernel_drops": ledger.kernel_drops,
        "poses_refused": ledger.poses_refused,
        "points_dropped": ledger.points_dropped,
        "revolutions": snapshot.revolutions(),
        "maps": snapshot.maps,
        "maps_with_pose": snapshot.maps_with_pose,
        "sensors": sensors.collect::<Vec<_>>(),
        "reference_sensor": snapshot.reference_sensor(),
        "latency_ms": { "p50": snapshot.latency_ms_p50, "p99": snapshot.latency_ms_p99 },
        "drivable_share": snapshot.drivable_share,
    });
    document.as_object().cloned().unwrap_or_default()
}

/// How the sensor is mounted and how that is known, in one line; `None` if it was given or is not needed.
pub fn describe(mount: &Mount) -> Option<String> {
    match mount {
        Mount::Estimated(estimate) => Some(format!(
            "estimated from the ground in {}: height {:.3} ± {:.3} m, pitch {:.2} ± {:.2} deg, roll {:.2} ± {:.2} deg \
             ({} of {} lowest points on one plane, residual {:.3} m{})",
            counted(estimate.revolutions as u64, "revolution"),
            estimate.height_m,
            estimate.height_std_m,
            estimate.pitch_rad.to_degrees(),
            estimate.pitch_std_rad.to_degrees(),
            estimate.roll_rad.to_degrees(),
            estimate.roll_std_rad.to_degrees(),
            estimate.inliers,
            estimate.samples,
            estimate.residual_m,
            if estimate.is_weak() { ", which is weak: give --extrinsics x,y,z,roll,pitch,yaw" } else { "" },
        )),
        Mount::Tf { ego_frame, frame_id } => Some(format!(
            "from tf, from {frame_id} to {ego_frame}; this assumes that the origin of {ego_frame} is on the ground; \
             if it is not, give --extrinsics"
        )),
        Mount::Refused { frame_id, fault } => Some(format!(
            "unknown, so no map is made: the files state how {frame_id} is mounted, but the transform was refused: \
             {fault}; give it with --extrinsics x,y,z,roll,pitch,yaw (metres and degrees)"
        )),
        Mount::Unknown(why) => Some(format!(
            "unknown, so no map is made: the files do not contain how the sensor is mounted, and it cannot be \
             estimated: {why}; give it with --extrinsics x,y,z,roll,pitch,yaw (metres and degrees, such as \
             0,0,1.9,0,0,0), or with --config FILE"
        )),
        Mount::Given | Mount::Unneeded => None,
    }
}

#[cfg(test)]
mod tests {
    use clearway_lidar::SensorStatus;
    use clearway_mapping::ledger::Ledger;

    use super::*;

    #[test]
    fn what_was_refused_dropped_or_never_arrived_is_in_the_lines() {
        let mut snapshot = Snapshot::default();
        (snapshot.ledger.poses_refused, snapshot.ledger.points_dropped) = (2, 840);
        snapshot.refusals.insert("pose", "pose at x = 1e9 m".into());
        snapshot.sensors.push(NamedStatus {
            source: 0,
            name: "top".into(),
            is_reference: false,
            status: SensorStatus { packets_lost: 60, ..SensorStatus::default() },
            elevations: None,
            mount: None,
            other_clock: Default::default(),
            ledger: Ledger::default(),
        });
        let lines = snapshot_lines(&snapshot).join("\n");
        for said in ["2 poses refused; the first: pose at x = 1e9 m", "840 points dropped", "top: unknown model, "] {
            assert!(lines.contains(said), "{lines}");
        }
        assert!(lines.contains(", 60 packets missing"), "{lines}");
    }

    #[test]
    fn files_of_telemetry_alone_are_called_so() {
        let mut snapshot = Snapshot::default();
        (snapshot.ledger.received, snapshot.ledger.telemetry) = (1, 1);
        let why = why_no_map(&Mount::Unneeded, &snapshot);
        assert_eq!(why, "the files hold 1 datagram of telemetry and no packet with points");
    }
}
