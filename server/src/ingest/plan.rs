//! Files, by the endings of their names -> what is sent, and the stamps at which it is sent.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::now_ns;
use clearway_daemon::base::files;

use super::items::{IngestItem, read_poses, read_road};
use crate::terminal::{counted, usage_error};

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
                    let (road, refused) = read_road(&text()?, ending(file), options.origin, options.lane.as_deref());
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

    /// True if there are scans or drives, which have a sensor.
    pub fn has_sensors(&self) -> bool {
        !self.drives.is_empty() || self.items.iter().any(|(_, item)| matches!(item, IngestItem::Scan(_)))
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
