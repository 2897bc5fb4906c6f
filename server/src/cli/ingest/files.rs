//! Files, by the endings of their names -> observations and the stamps at which they are sent.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::observation::{RoadFrame, RoadPurpose};
use clearway_client::{Observation, now_ns};
use clearway_lidar::capture::{Capture, CaptureError, Datagram};
use clearway_lidar::capture_sensor::CaptureSensor;
use clearway_mapping::event::{Road, RoadPurpose as Purpose};
use clearway_mapping::road::rddf::Rddf;
use clearway_mapping::road::rndf::Rndf;
use clearway_mapping::road::{FOOT_M, LineError, LocalFrame};
use clearway_mapping::scan_file;

use crate::cli::shared::files;
use crate::cli::shared::output::{counted, usage_error};

/// Most datagrams of a drive in one observation: 50 ms of an HDL-64E.
const PACKETS: usize = 175;
/// Longest time between the first and the last datagram of one observation, in nanoseconds; ours, because it delays
/// each packet by as much.
const PACKETS_NS: i64 = 20_000_000;
/// Width of an RNDF lane without a width, in metres: 12 feet, the width of most lanes.
const LANE_M: f64 = 12.0 * FOOT_M;

/// Scans a second if the options do not give them, as of most rotating sensors at 600 rpm.
const HZ: f64 = 10.0;

/// The options that name the files to send and how to read them.
#[derive(Args)]
pub struct FileOptions {
    /// The files. Each scan is sent with the stamp of a pose, or from now on at --hz if there are no poses.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Scans a second, if there are no poses; 10 if absent.
    #[arg(long, value_parser = hz)]
    hz: Option<f64>,
    /// Position on the Earth, in degrees, of the map frame's origin, for roads; their first point if absent.
    #[arg(long, value_name = "LATITUDE,LONGITUDE", allow_hyphen_values = true, value_parser = origin)]
    origin: Option<[f64; 2]>,
    /// The lane of an .rndf to paint; the first if absent.
    #[arg(long, value_name = "SEGMENT.LANE")]
    lane: Option<String>,
}

fn hz(text: &str) -> Result<f64, String> {
    let found = text.parse().ok().filter(|hz| (0.1..=100.0).contains(hz));
    found.ok_or_else(|| "0.1 to 100 is allowed".into())
}

fn origin(text: &str) -> Result<[f64; 2], String> {
    let parts = text.split_once(',').map(|(latitude, longitude)| (latitude.trim().parse(), longitude.trim().parse()));
    match parts {
        Some((Ok(latitude), Ok(longitude)))
            if (-90.0..=90.0).contains(&latitude) && (-180.0..=180.0).contains(&longitude) =>
        {
            Ok([latitude, longitude])
        }
        _ => Err("two numbers of degrees are needed, such as 30.39,-97.73".into()),
    }
}

/// What is sent, and when.
pub struct IngestPlan {
    /// Scans, poses and roads, ordered by stamp.
    pub items: Vec<(i64, IngestItem)>,
    /// Captures, whose datagrams have stamps of their own.
    pub drives: Vec<PathBuf>,
    /// Lines of road files that are left out, and why.
    pub notes: Vec<String>,
}

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

fn ending(file: &Path) -> &str {
    file.extension().and_then(|extension| extension.to_str()).unwrap_or("")
}

impl IngestPlan {
    /// Reads poses and roads, and orders what is sent.
    ///
    /// # Errors
    /// If a file cannot be read, its kind is not known, or there are more scans than poses.
    pub fn new(options: &FileOptions) -> Result<Self> {
        let (mut scans, mut poses, mut roads) = (Vec::new(), Vec::new(), Vec::new());
        let (mut drives, mut notes) = (Vec::new(), Vec::new());
        for file in &options.files {
            let text = || files::read_text(file);
            match ending(file) {
                "bin" | "pcd" => scans.push(file.clone()),
                "pcap" | "pcapng" => drives.push(file.clone()),
                "tum" => poses.extend(read_poses(&text()?).with_context(|| file.display().to_string())?),
                "rddf" | "rndf" => {
                    let (road, refused) = read_road(&text()?, ending(file), options);
                    notes.extend(refused.iter().map(|line| format!("{}: {line}", file.display())));
                    roads.push(road.with_context(|| file.display().to_string())?);
                }
                _ if file.is_dir() => bail!("{0}: this is a folder; name its files, such as {0}/*.bin", file.display()),
                other => bail!("{}: .{other}: bin, pcd, pcap, pcapng, tum, rddf and rndf are allowed", file.display()),
            }
        }
        if !poses.is_empty() && scans.len() > poses.len() {
            bail!(
                "{} and {}: each scan needs a pose for its stamp, or there must be no poses",
                counted(scans.len() as u64, "scan"),
                counted(poses.len() as u64, "pose")
            );
        }
        let unused = |option: &str, needs: &str| Err(usage_error(format!("{option} needs {needs} among the files")));
        let has = |wanted: &[&str]| options.files.iter().any(|file| wanted.contains(&ending(file)));
        if options.lane.is_some() && !has(&["rndf"]) {
            return unused("--lane", "an .rndf");
        }
        if options.origin.is_some() && roads.is_empty() {
            return unused("--origin", "an .rndf or .rddf");
        }
        if options.hz.is_some() && (scans.is_empty() || !poses.is_empty()) {
            return unused("--hz", "scans (.bin, .pcd) and no poses (.tum)");
        }
        let hz = options.hz.unwrap_or(HZ);
        let first_ns = poses.first().map_or_else(now_ns, |(stamp_ns, _)| *stamp_ns);
        let stamp_ns = |index: usize| match poses.get(index) {
            Some((stamp_ns, _)) => *stamp_ns,
            None => first_ns.saturating_add((index as f64 * 1e9 / hz) as i64),
        };
        let scans = scans.into_iter().enumerate().map(|(index, file)| (stamp_ns(index), IngestItem::Scan(file)));
        // Each road has a stamp of its own, because the server uses the newest.
        let roads = (0..).zip(roads).map(|(index, road)| (first_ns.saturating_add(index), IngestItem::Road(road)));
        let mut items: Vec<_> = roads.chain(scans).collect();
        items.extend(poses);
        // Poses and roads come before the scan of the same stamp, whose map uses them.
        items.sort_by_key(|(stamp_ns, item)| (*stamp_ns, matches!(item, IngestItem::Scan(_))));
        Ok(Self { items, drives, notes })
    }
}

/// Reads lines of "seconds x y z qx qy qz qw". The speed of each pose is that from the pose before it.
fn read_poses(text: &str) -> Result<Vec<(i64, IngestItem)>> {
    let mut poses: Vec<(i64, [f64; 7])> = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or("").trim();
        if line.is_empty() {
            continue;
        }
        let numbers: Vec<f64> = line.split_whitespace().filter_map(|number| number.parse().ok()).collect();
        let [seconds, rest @ ..] = &numbers[..] else {
            bail!("line {}: {line:?}: eight numbers are needed", index + 1)
        };
        let Ok(pose) = <[f64; 7]>::try_from(rest) else {
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
fn read_road(text: &str, ending: &str, options: &FileOptions) -> (Result<Road>, Vec<LineError>) {
    let frame = |frame_of_file: Option<LocalFrame>| match options.origin {
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
    let lane = match &options.lane {
        None => rndf.lanes.first(),
        Some(name) => rndf.lanes.iter().find(|lane| lane.name == *name),
    };
    let road = lane.zip(frame).and_then(|(lane, frame)| lane.road(&frame, Some(LANE_M), 0));
    let road = road.with_context(|| format!("no such lane with two points; lanes: {}", names.join(", ")));
    (road, std::mem::take(&mut rndf.refused))
}

/// Datagrams with their stamps, in nanoseconds since the Unix epoch.
type StampedPackets = Vec<(i64, Vec<u8>)>;

/// The datagrams of one sensor of a capture, in groups that make one observation each: an iterator. A capture that is
/// cut off gives the groups before the cut.
pub struct PacketGroups {
    capture: Capture<'static>,
    /// The datagram that begins the next group.
    pending: Option<Result<Datagram, CaptureError>>,
    sensor: CaptureSensor,
}

impl PacketGroups {
    /// Opens a capture.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn open(file: &Path) -> Result<Self> {
        let (opened, _) = files::open(file)?;
        let capture = Capture::new(BufReader::new(opened)).with_context(|| file.display().to_string())?;
        Ok(Self { capture, pending: None, sensor: CaptureSensor::default() })
    }

    /// The datagrams of other sensors, and the packets that are no UDP datagrams, so far; for people.
    pub fn notes(&self) -> Vec<String> {
        self.sensor.notes().into_iter().chain(self.capture.skipped().notes()).collect()
    }
}

impl Iterator for PacketGroups {
    type Item = Result<StampedPackets, CaptureError>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut packets = StampedPackets::new();
        while packets.len() < PACKETS {
            let first_ns = packets.first().map(|(stamp_ns, _)| *stamp_ns);
            let near =
                |stamp_ns: i64| first_ns.is_none_or(|first| (0..=PACKETS_NS).contains(&stamp_ns.saturating_sub(first)));
            let is_next = |next: &Result<Datagram, CaptureError>| {
                packets.is_empty() || next.as_ref().is_ok_and(|d| near(d.stamp_ns))
            };
            match self.pending.take().or_else(|| self.capture.next()) {
                Some(next) if !is_next(&next) => {
                    self.pending = Some(next);
                    break;
                }
                Some(Ok(datagram)) if self.sensor.has_sent(&datagram) => {
                    packets.push((datagram.stamp_ns, datagram.payload));
                }
                Some(Ok(_)) => {}
                Some(Err(CaptureError::Truncated { .. })) | None => break,
                Some(Err(error)) => return Some(Err(error)),
            }
        }
        (!packets.is_empty()).then_some(Ok(packets))
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct TestArguments {
        #[command(flatten)]
        options: FileOptions,
    }

    fn plan(folder: &Path, files: &[(&str, &[u8])]) -> Result<IngestPlan> {
        plan_with(folder, files, &[])
    }

    fn plan_with(folder: &Path, files: &[(&str, &[u8])], options: &[&str]) -> Result<IngestPlan> {
        let mut arguments = vec!["ingest".to_owned()];
        arguments.extend(options.iter().map(|&option| option.to_owned()));
        for (name, bytes) in files {
            std::fs::write(folder.join(name), bytes).unwrap();
            arguments.push(folder.join(name).display().to_string());
        }
        IngestPlan::new(&TestArguments::parse_from(arguments).options)
    }

    #[test]
    fn scans_get_the_stamps_of_poses_and_are_sent_after_them() {
        let folder = tempfile::tempdir().unwrap();
        let poses = b"# seconds x y z qx qy qz qw\n1.5 0 0 0 0 0 1 0\n2.0 -4 0 0 0 0 1 0\n2.5 -3 0 0 0 0 1 0\n";
        let rddf = b"1,30.0,-97.0,10,20\n2,30.001,-97.0,10,20\nthree,1,2\n";
        let files: [(&str, &[u8]); 4] = [("a.bin", &[0; 16]), ("b.bin", &[0; 16]), ("p.tum", poses), ("r.rddf", rddf)];
        let plan = plan(folder.path(), &files).unwrap();
        let kind = |item: &IngestItem| match item {
            IngestItem::Pose(..) => "pose",
            IngestItem::Road(_) => "road",
            IngestItem::Scan(_) => "scan",
        };
        let kinds: Vec<_> = plan.items.iter().map(|(stamp_ns, item)| (*stamp_ns, kind(item))).collect();
        let half = 500_000_000;
        let expected = [(3 * half, "road"), (3 * half, "pose"), (3 * half, "scan"), (4 * half, "pose")];
        assert_eq!(kinds[..4], expected);
        assert_eq!(kinds[4..], [(4 * half, "scan"), (5 * half, "pose")]);
        let speeds = plan.items.iter().filter_map(|(_, item)| match item {
            IngestItem::Pose(_, _, speed_mps) => Some(*speed_mps),
            _ => None,
        });
        // The vehicle faces -x: it drives forward to -4 m, and then backward to -3 m.
        assert_eq!(speeds.collect::<Vec<_>>(), [8.0, 8.0, -2.0]);
        assert!(plan.notes.len() == 1 && plan.notes[0].contains("line 3"), "{:?}", plan.notes);
    }

    #[test]
    fn options_that_no_file_uses_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let pose: &[u8] = b"1 0 0 0 0 0 0 1\n";
        for (files, option, value) in [
            (&[("a.bin", pose)][..], "--lane", "1.1"),
            (&[("a.bin", pose)], "--origin", "30,-97"),
            (&[("a.bin", pose), ("a.tum", pose)], "--hz", "5"),
            (&[("a.tum", pose)], "--hz", "5"),
        ] {
            let error = plan_with(folder.path(), files, &[option, value]).err().unwrap();
            assert!(error.is::<clap::Error>() && error.to_string().contains(&format!("{option} needs")), "{error}");
        }
        assert!(plan_with(folder.path(), &[("a.bin", pose)], &["--hz", "5"]).is_ok());
    }

    #[test]
    fn files_that_cannot_be_sent_are_refused_with_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let error = |files: &[(&str, &[u8])]| format!("{:#}", plan(folder.path(), files).err().unwrap());
        assert!(error(&[("a.txt", b"")]).contains(".txt"));
        assert!(error(&[("a.tum", b"1 2 3\n")]).contains("eight numbers"));
        assert!(error(&[("a.rddf", b"")]).contains("no row"));
        assert!(error(&[("a.rndf", b"RNDF_name x\n")]).contains("no such lane"));
        assert!(
            error(&[("a.bin", b""), ("b.bin", b""), ("a.tum", b"1 0 0 0 0 0 0 1\n")]).contains("2 scans and 1 pose:")
        );
    }
}
