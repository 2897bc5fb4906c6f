//! How far the stamps of a drive's scans are from the stamps of its poses.

use std::collections::BTreeMap;

use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;

use crate::topics::available::NEAR_NS;

/// TAI is ahead of UTC by this much from 2017 on.
const TAI_S: f64 = 37.0;

/// The stamps of the readings so far.
#[derive(Clone, Debug, Default)]
pub(super) struct PoseGap {
    pose_ns: Option<i64>,
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

impl PoseGap {
    /// Notes the stamp of a reading. The stamp of a packet is about its arrival.
    pub(super) fn note(&mut self, reading: &Reading) {
        let source = match &reading.body {
            Body::EgoPose(pose) => {
                self.pose_ns = Some(pose.stamp_ns);
                None
            }
            Body::Scan(scan) => Some(scan.stamp_ns),
            Body::Datagram(_) => Some(reading.arrival_ns),
            _ => return,
        };
        let pose_ns = self.pose_ns;
        if let Some(stamp_ns) = source {
            let scan = self.scans.entry(reading.source).or_default();
            scan.newest_ns = stamp_ns;
            let ahead_ns = pose_ns.map(|pose_ns| stamp_ns.saturating_sub(pose_ns));
            scan.apart_ns = scan.apart_ns.into_iter().chain(ahead_ns).min_by_key(|ns| ns.unsigned_abs());
        }
        let Some(pose_ns) = pose_ns else { return };
        for (_, scan) in self.scans.iter_mut().filter(|(of, _)| source.is_none() || **of == reading.source) {
            let distance_ns = scan.newest_ns.abs_diff(pose_ns);
            scan.least_ns = Some(scan.least_ns.map_or(distance_ns, |least_ns| least_ns.min(distance_ns)));
        }
    }

    /// A line for people for each source without a scan near a pose; `name` names the source.
    pub(super) fn notes(&self, name: impl Fn(u16) -> String) -> Vec<String> {
        let far = self.scans.iter().filter_map(|(source, scan)| {
            scan.least_ns.filter(|least_ns| *least_ns > NEAR_NS)?;
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
