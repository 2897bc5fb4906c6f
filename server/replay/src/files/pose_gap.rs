//! How far the stamps of a drive's scans are from the stamps of its poses.

use std::collections::{BTreeMap, VecDeque};

use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;

use crate::topics::available::NEAR_NS;

/// TAI is ahead of UTC by this much from 2017 on.
const TAI_S: f64 = 37.0;
/// Number of poses that are kept: as in the core.
const POSES_MAX: usize = 1024;

/// The stamps of the readings so far.
#[derive(Clone, Debug, Default)]
pub(super) struct PoseGap {
    /// Stamps of the newest poses.
    poses_ns: VecDeque<i64>,
    scans: BTreeMap<u16, ScanGap>,
}

/// The stamps of one source.
#[derive(Clone, Debug, Default)]
struct ScanGap {
    newest_ns: i64,
    /// Least distance of a scan from a pose.
    least_ns: Option<u64>,
    /// Least distance of a scan ahead of the newest pose that came before it: how far the clocks are apart.
    apart_ns: Option<i64>,
}

impl ScanGap {
    fn note_distance(&mut self, distance_ns: u64) {
        self.least_ns = Some(self.least_ns.map_or(distance_ns, |least_ns| least_ns.min(distance_ns)));
    }
}

impl PoseGap {
    /// Notes the stamp of a reading. The stamp of a packet is about its arrival.
    pub(super) fn note(&mut self, reading: &Reading) {
        let stamp_ns = match &reading.body {
            Body::EgoPose(pose) => {
                for scan in self.scans.values_mut() {
                    scan.note_distance(scan.newest_ns.abs_diff(pose.stamp_ns));
                }
                if self.poses_ns.len() == POSES_MAX {
                    self.poses_ns.pop_front();
                }
                return self.poses_ns.push_back(pose.stamp_ns);
            }
            Body::Scan(scan) => scan.stamp_ns,
            Body::Datagram(_) => reading.arrival_ns,
            _ => return,
        };
        let scan = self.scans.entry(reading.source).or_default();
        scan.newest_ns = stamp_ns;
        let ahead_ns = self.poses_ns.back().map(|pose_ns| stamp_ns.saturating_sub(*pose_ns));
        scan.apart_ns = scan.apart_ns.into_iter().chain(ahead_ns).min_by_key(|ns| ns.unsigned_abs());
        let nearest_ns = self.poses_ns.iter().map(|pose_ns| stamp_ns.abs_diff(*pose_ns)).min();
        nearest_ns.into_iter().for_each(|distance_ns| scan.note_distance(distance_ns));
    }

    /// A line for people for each source without a scan near a pose; `name` names the source.
    pub(super) fn notes(&self, name: impl Fn(u16) -> String) -> Vec<String> {
        let far = self.scans.iter().filter_map(|(source, scan)| {
            scan.least_ns.filter(|least_ns| *least_ns > NEAR_NS as u64)?;
            let ahead_s = scan.apart_ns? as f64 * 1e-9;
            let way = if ahead_s > 0.0 { "ahead of" } else { "behind" };
            let hint = match ahead_s.abs() {
                s if (s - TAI_S).abs() < 0.5 => ": one clock is TAI, the other UTC",
                s if s > 1e8 => ": one clock counts from the start of its device",
                _ => "",
            };
            Some(format!(
                "no scan of {} has a pose within 0.2 s: its stamps are {:.1} s {way} the stamps of the poses{hint}",
                name(*source),
                ahead_s.abs()
            ))
        });
        far.collect()
    }
}

#[cfg(test)]
mod tests {
    use clearway_mapping::event::{EgoPose, Scan};
    use nalgebra::Isometry3;

    use super::*;

    #[test]
    fn a_scan_that_is_logged_late_is_near_the_pose_of_its_time_and_one_of_another_clock_is_not() {
        let reading = |body| Reading { arrival_ns: 0, source: 0, body };
        for (stamp_ms, notes) in [(1_500, 0), (39_000, 1)] {
            let mut gap = PoseGap::default();
            for stamp_ns in (0..=100).map(|pose| pose * 20_000_000) {
                let pose = EgoPose { stamp_ns, map_from_ego: Isometry3::identity(), speed_mps: 0.0 };
                gap.note(&reading(Body::EgoPose(pose)));
            }
            gap.note(&reading(Body::Scan(Scan { stamp_ns: stamp_ms * 1_000_000, ..Scan::default() })));
            let said = gap.notes(|_| "/points".to_owned());
            assert_eq!(said.len(), notes, "{said:?}");
            assert!(said.iter().all(|line| line.contains("37.0 s ahead of")), "{said:?}");
        }
    }
}
