//! What happened in the last 10 s: maps with their times and sizes, and packets expected and lost. Pure: every time
//! is given, as the time since the server started, and never goes back.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use crate::traces::StageTimes;

/// Length of the window.
pub const WINDOW: Duration = Duration::from_secs(10);
/// Least time between two samples of the counts. Ours: a twentieth of the window.
const SAMPLE_PERIOD: Duration = Duration::from_millis(500);

/// Counts of the packets of a vehicle since the server started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PacketCounts {
    /// Packets and scans that could be read.
    pub read: u64,
    /// Packets that the sensors have sent and that did not arrive, as the stamps in the others show it.
    pub missing: u64,
    /// Packets that were dropped by the kernel or a full queue, or refused. Most of them are `missing` too.
    pub dropped: u64,
}

/// The last 10 s of one vehicle.
#[derive(Clone, Debug, Default)]
pub struct Window {
    maps: VecDeque<MapSample>,
    counts: VecDeque<(Duration, PacketCounts)>,
}

#[derive(Clone, Copy, Debug)]
struct MapSample {
    at: Duration,
    stages: StageTimes,
    bytes: usize,
}

impl Window {
    /// Adds a map that was published at `at`.
    pub fn push_map(&mut self, at: Duration, stages: StageTimes, bytes: usize) {
        self.maps.push_back(MapSample { at, stages, bytes });
        while self.maps.front().is_some_and(|oldest| at.saturating_sub(oldest.at) > WINDOW) {
            self.maps.pop_front();
        }
    }

    /// Adds the counts at `at`; counts that follow another sample too soon are left out.
    pub fn push_counts(&mut self, at: Duration, counts: PacketCounts) {
        if self.counts.back().is_some_and(|(last, _)| at.saturating_sub(*last) < SAMPLE_PERIOD) {
            return;
        }
        self.counts.push_back((at, counts));
        // The newest sample that is older than the window stays: the window begins with it.
        while self.counts.get(1).is_some_and(|(second, _)| at.saturating_sub(*second) >= WINDOW) {
            self.counts.pop_front();
        }
    }

    /// Maps per second. Before the window is full, over the time since the server started.
    pub fn map_rate_hz(&self, now: Duration) -> f64 {
        let over = now.min(WINDOW).as_secs_f64();
        if over > 0.0 { self.recent_maps(now).count() as f64 / over } else { 0.0 }
    }

    /// Mean size of an encoded map, in bytes; 0 without a map.
    pub fn map_bytes(&self, now: Duration) -> f64 {
        let (sum, maps) = self.recent_maps(now).fold((0, 0), |(sum, maps), map| (sum + map.bytes, maps + 1));
        if maps == 0 { 0.0 } else { sum as f64 / f64::from(maps) }
    }

    /// Median time of each stage in milliseconds; stages without a known time are absent.
    pub fn latency_ms(&self, now: Duration) -> BTreeMap<&'static str, f64> {
        let median = |(index, stage)| {
            let mut times: Vec<Duration> =
                self.recent_maps(now).filter_map(|map| map.stages.in_order()[index]).collect();
            times.sort_unstable();
            let median = times.get(times.len().saturating_sub(1) / 2)?;
            Some((stage, median.as_secs_f64() * 1e3))
        };
        StageTimes::NAMES.into_iter().enumerate().filter_map(median).collect()
    }

    /// Share of the expected packets that were lost on the way, dropped or refused, 0 to 1, with the counts of now;
    /// `None` if none was expected.
    pub fn loss(&self, now: PacketCounts) -> Option<f64> {
        let (_, first) = self.counts.front()?;
        // A dropped packet is missing as well, so the greater number counts each once.
        let missing = now.missing.saturating_sub(first.missing).max(now.dropped.saturating_sub(first.dropped));
        let expected = now.read.saturating_sub(first.read) + missing;
        (expected > 0).then(|| missing as f64 / expected as f64)
    }

    fn recent_maps(&self, now: Duration) -> impl Iterator<Item = &MapSample> {
        self.maps.iter().filter(move |map| now.saturating_sub(map.at) <= WINDOW)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn rate_size_and_latency_are_those_of_the_last_ten_seconds() {
        let mut window = Window::default();
        for map in 0..300 {
            let computed = ms(if map < 150 { 90 } else { map % 9 });
            let stages = StageTimes { map: Some(computed), encode: Some(ms(2)), ..StageTimes::default() };
            window.push_map(ms(100 * map), stages, if map < 150 { 9 } else { 1000 });
        }
        let now = ms(29_950);
        assert_eq!(window.map_rate_hz(now), 10.0);
        assert_eq!(window.map_bytes(now), 1000.0);
        assert_eq!(window.latency_ms(now), BTreeMap::from([("map", 4.0), ("encode", 2.0)]));
        assert_eq!(window.map_rate_hz(ms(35_000)), 5.0, "the maps of 25.0 s and later");
        assert_eq!((window.map_rate_hz(ms(60_000)), window.map_bytes(ms(60_000))), (0.0, 0.0));
        assert!(window.latency_ms(ms(60_000)).is_empty());
    }

    #[test]
    fn a_young_server_has_a_rate_over_its_own_age() {
        let mut window = Window::default();
        (0..20).for_each(|map| window.push_map(ms(100 * map), StageTimes::default(), 0));
        assert_eq!(window.map_rate_hz(ms(2000)), 10.0);
        assert_eq!(window.map_rate_hz(ms(0)), 0.0);
    }

    #[test]
    fn loss_counts_each_packet_once_and_forgets_after_ten_seconds() {
        let mut window = Window::default();
        let counts = |read, missing, dropped| PacketCounts { read, missing, dropped };
        assert_eq!(window.loss(counts(5, 5, 5)), None, "nothing to compare with");
        window.push_counts(ms(0), counts(0, 0, 0));
        assert_eq!(window.loss(counts(90, 10, 4)), Some(0.1));
        assert_eq!(window.loss(counts(90, 4, 10)), Some(0.1));
        assert_eq!(window.loss(counts(0, 0, 7)), Some(1.0), "all are refused");
        for second in 1..=20 {
            window.push_counts(ms(1000 * second), counts(90 + 100 * second, 10, 4));
        }
        assert_eq!(window.loss(counts(2090, 10, 4)), Some(0.0));
        for second in 21..=40 {
            window.push_counts(ms(1000 * second), counts(2090, 10, 4));
        }
        assert_eq!(window.loss(counts(2090, 10, 4)), None, "nothing is sent any more");
        assert!(window.counts.len() <= 12, "{}", window.counts.len());
    }
}
