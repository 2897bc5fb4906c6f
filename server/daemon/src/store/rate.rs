//! How fast recordings are uploaded, so that the maps on the same link stay fresh.
//!
//! In: what share of their validity the link takes for the newest maps. Out: when the next bytes of an upload may be
//! sent. Without a link that is measured, uploads are limited by `store.upload_kbit_s_max` alone; while no reader has
//! maps over it, they get faster until they have all of it.
//!
//! An upload that is faster than what the maps leave of the link fills its queue, and the maps wait there. So the rate
//! is halved when a map takes more than half its validity, and grows while maps are in time, as TCP does by losses.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::base::sync::locked;

/// Share of a map's validity that the link may take for it before uploads give way. Ours: the other half is left for
/// making the map, and for what is on the way when the rate falls.
const SHARE_MAX: f64 = 0.5;
/// Share below which uploads may get faster soon. Ours: a map that waits for nothing on a link of 1 Mbit/s takes less.
const SHARE_CALM: f64 = 0.25;
/// Lowest rate, in bytes a second, of an upload that gives way. Ours: stores close a request of which nothing arrives
/// for 20 s.
const RATE_MIN: f64 = 2e3;
/// Rate, in bytes a second, when a reader's first map is on the link. Ours: a quarter of a thin link of 500 kbit/s.
const RATE_BEGIN: f64 = 16e3;
/// Growth of a rate that is used, in a second; and while none is on the link, or none was late for [`CALM`]. Ours: with
/// the first, the link is full for less than a second before maps are late; with the second, 10 Mbit/s are reached in
/// 2 s.
const GROWTH: [f64; 2] = [1.2, 8.0];
/// Time without late maps after which the rate grows faster. Ours: longer than from a halving to the next.
const CALM: Duration = Duration::from_secs(5);
/// Time for which the rate is not halved again. Ours: until then the queue is that of the rate before.
const HALVED: Duration = Duration::from_millis(400);
/// Time over which what is sent is measured. Ours: as long as a halving shows.
const MEASURED: Duration = Duration::from_millis(400);
/// A rate grows if so many times what is sent is more: one that is not used is not known to fit.
const USED: f64 = 2.0;
/// Longest time between two looks that counts as growth.
const LOOK_MAX: Duration = Duration::from_millis(200);
/// Time for which bytes may be sent that were not sent before.
const BURST: Duration = Duration::from_millis(20);
/// Longest wait until the rate is looked at again.
const WAIT_MAX: Duration = Duration::from_millis(50);
/// Bytes of the smallest and the largest piece of a request's body, and of an answer.
const PIECE_BYTES: [f64; 2] = [2e3, 65_536.0];
const ANSWER_BYTES: [f64; 2] = [8e3, (8 << 20) as f64];
/// Time in which an answer of the store is to arrive.
const ANSWER: Duration = Duration::from_millis(150);

/// What share of their validity the link takes for the newest maps; `None` while no map is on it, or if it is not
/// measured.
pub type LinkShare = dyn Fn() -> Option<f64> + Send + Sync;

/// The rate at one time, and what was sent of it.
#[derive(Debug)]
struct Rate {
    /// Bytes a second; infinite until a map was on the link.
    bytes_s: f64,
    /// Limit of the configuration.
    bytes_s_max: f64,
    /// Bytes that may be sent now; below 0 after a piece that was sent ahead.
    bytes: f64,
    /// What was sent in a second, of late.
    sent_s: f64,
    seen: Instant,
    halved: Option<Instant>,
}

impl Rate {
    fn new(bytes_s_max: f64, now: Instant) -> Self {
        Self { bytes_s: f64::INFINITY, bytes_s_max, bytes: 0.0, sent_s: 0.0, seen: now, halved: None }
    }

    fn limit(&self) -> f64 {
        self.bytes_s.min(self.bytes_s_max)
    }

    /// Brings the rate up to date.
    fn see(&mut self, now: Instant, link_share: Option<f64>) {
        let passed = now.saturating_duration_since(self.seen);
        self.seen = now;
        self.sent_s *= (-passed.div_duration_f64(MEASURED)).exp();
        let is_used = self.bytes_s < USED * self.sent_s.max(RATE_MIN) && self.bytes_s < self.bytes_s_max;
        match link_share {
            Some(_) if self.bytes_s.is_infinite() => self.bytes_s = RATE_BEGIN,
            None if self.bytes_s.is_infinite() => {}
            Some(share) if share > SHARE_MAX => {
                if self.halved.is_none_or(|at| now.saturating_duration_since(at) >= HALVED) {
                    let sent = self.bytes_s.min(self.sent_s.max(RATE_BEGIN));
                    (self.bytes_s, self.halved) = ((sent / 2.0).max(RATE_MIN), Some(now));
                }
            }
            // Without maps it grows too, and not to any rate at once: a link that is cut carries no map either, and
            // what were written to it then would wait in front of the next ones.
            Some(_) | None if is_used => {
                let was_late = self.halved.is_some_and(|at| now.saturating_duration_since(at) < CALM);
                let is_calm = link_share.is_none_or(|share| share < SHARE_CALM && !was_late);
                self.bytes_s *= GROWTH[usize::from(is_calm)].powf(passed.min(LOOK_MAX).as_secs_f64());
            }
            Some(_) | None => {}
        }
        let limit = self.limit();
        if limit.is_finite() {
            self.bytes = (self.bytes + limit * passed.as_secs_f64()).min(limit * BURST.as_secs_f64());
        }
    }

    /// Time until a piece may be sent; zero: it is counted as sent.
    fn take(&mut self, bytes: usize) -> Duration {
        let limit = self.limit();
        if limit.is_finite() && self.bytes < 0.0 {
            return Duration::from_secs_f64(-self.bytes / limit).clamp(Duration::from_millis(1), WAIT_MAX);
        }
        self.sent_s += bytes as f64 / MEASURED.as_secs_f64();
        self.bytes = if limit.is_finite() { self.bytes - bytes as f64 } else { 0.0 };
        Duration::ZERO
    }

    fn piece(&self, of: Duration, [least, most]: [f64; 2]) -> usize {
        (self.limit() * of.as_secs_f64()).clamp(least, most) as usize
    }
}

/// The rate of all uploads of a process, which its requests share.
#[derive(Clone)]
pub struct UploadRate {
    rate: Arc<Mutex<Rate>>,
    link_share: Arc<LinkShare>,
}

impl std::fmt::Debug for UploadRate {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        locked(&self.rate).fmt(formatter)
    }
}

impl UploadRate {
    /// A rate that gives way to maps, and is at most `kbit_s_max`; 0: without this limit.
    pub fn new(kbit_s_max: u32, link_share: Arc<LinkShare>) -> Self {
        let bytes_s_max = if kbit_s_max == 0 { f64::INFINITY } else { f64::from(kbit_s_max) * 125.0 };
        Self { rate: Arc::new(Mutex::new(Rate::new(bytes_s_max, Instant::now()))), link_share }
    }

    /// A rate without a limit, of a process that has no maps.
    pub fn unlimited() -> Self {
        Self::new(0, Arc::new(|| None))
    }

    /// Waits until these bytes may be sent or requested.
    pub async fn take(&self, bytes: usize) {
        loop {
            let share = (self.link_share)();
            let wait = {
                let mut rate = locked(&self.rate);
                rate.see(Instant::now(), share);
                rate.take(bytes)
            };
            if wait.is_zero() {
                return;
            }
            tokio::time::sleep(wait).await;
        }
    }

    /// Bytes of a request's body that are sent at once.
    pub fn piece_bytes(&self) -> usize {
        locked(&self.rate).piece(BURST, PIECE_BYTES)
    }

    /// Bytes that are requested at once.
    pub fn answer_bytes(&self) -> usize {
        locked(&self.rate).piece(ANSWER, ANSWER_BYTES)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VALID_MS: f64 = 300.0;
    const MAP_BYTES: f64 = 6500.0;

    /// What a link has carried.
    struct Carried {
        /// Bytes of the upload a second, in each second.
        upload: Vec<f64>,
        /// Time that the link took for each map, in ms, beside its number.
        maps_ms: Vec<(u64, f64)>,
    }

    /// A link of `bytes_s(second)` with one queue, ten maps a second if `has_maps(second)`, at most two of them on the
    /// way, and an upload that always has something to send. In steps of a millisecond.
    fn drive(seconds: u64, bytes_s: fn(u64) -> f64, has_maps: fn(u64) -> bool) -> Carried {
        let start = Instant::now();
        let mut rate = Rate::new(f64::INFINITY, start);
        // The queue: number of a map and when it was sent, or none for the upload, and the bytes that are left.
        let mut queue = std::collections::VecDeque::<(Option<(u64, u64)>, f64)>::new();
        let mut carried = Carried { upload: vec![0.0; seconds as usize], maps_ms: Vec::new() };
        let mut newest = None::<(u64, f64)>;
        for ms in 0..seconds * 1000 {
            let (now, second) = (start + Duration::from_millis(ms), ms / 1000);
            let mut left = bytes_s(second) / 1e3;
            while let Some((map, bytes)) = queue.front_mut() {
                let sent = bytes.min(left);
                (*bytes, left) = (*bytes - sent, left - sent);
                if map.is_none() {
                    carried.upload[second as usize] += sent;
                }
                if *bytes > 0.0 {
                    break;
                }
                if let Some((number, at)) = *map {
                    newest = Some((ms, (ms - at) as f64 / VALID_MS));
                    carried.maps_ms.push((number, (ms - at) as f64));
                }
                queue.pop_front();
            }
            let on_the_way: Vec<_> = queue.iter().filter_map(|(map, _)| *map).collect();
            if has_maps(second) && ms % 100 == 0 && on_the_way.len() < 2 {
                queue.push_back((Some((ms / 100, ms)), MAP_BYTES));
            }
            if let Some((_, at)) = on_the_way.first().filter(|(_, at)| ms > at + 100) {
                newest = Some((ms, (ms - at) as f64 / VALID_MS));
            }
            let share = newest.filter(|(at, _)| ms - at < 1000).map(|(_, share)| share);
            rate.see(now, share);
            // The kernel holds what the link's queue of 64 KiB does not take.
            let waits: f64 = queue.iter().map(|(_, bytes)| bytes).sum();
            let bytes = rate.piece(BURST, PIECE_BYTES);
            if waits < 65_536.0 && rate.take(bytes).is_zero() {
                queue.push_back((None, bytes as f64));
            }
        }
        carried
    }

    #[test]
    fn an_upload_leaves_maps_in_time_and_takes_most_of_what_they_leave() {
        let carried = drive(60, |_| 125e3, |_| true);
        let late = carried.maps_ms.iter().filter(|(_, ms)| *ms > 250.0).count();
        assert!(late * 50 < carried.maps_ms.len(), "{late} of {} maps are late", carried.maps_ms.len());
        assert!(carried.maps_ms.len() >= 570, "nearly all maps pass: {}", carried.maps_ms.len());
        let mean = carried.upload[20..].iter().sum::<f64>() / 40.0;
        println!("{late} of {} late, upload {mean:.0} bytes/s of 60000", carried.maps_ms.len());
        assert!(mean > 0.6 * 60e3, "{mean} bytes/s of the 60,000 that the maps leave");
    }

    #[test]
    fn a_link_that_bears_no_more_than_the_maps_is_left_to_them_but_for_the_lowest_rate() {
        let carried = drive(60, |_| 25e3, |_| true);
        let mean = carried.upload[20..].iter().sum::<f64>() / 40.0;
        assert!((0.9 * RATE_MIN..1.5 * RATE_MIN).contains(&mean), "{mean}");
    }

    #[test]
    fn an_upload_has_the_whole_link_without_readers_and_gives_way_to_a_reader_that_comes() {
        let carried = drive(60, |_| 125e3, |second| !(10..20).contains(&second));
        assert!(carried.upload[13..20].iter().all(|bytes| *bytes > 0.99 * 125e3), "{:?}", carried.upload);
        let late = carried.maps_ms.iter().filter(|(number, ms)| *number >= 210 && *ms > 250.0).count();
        assert!(late < 10, "{late} maps are late after the first second of the reader");
    }

    #[test]
    fn a_link_that_becomes_good_is_used_within_ten_seconds() {
        let carried = drive(60, |second| if second < 30 { 125e3 } else { 1.25e6 }, |_| true);
        assert!(carried.upload[40..].iter().all(|bytes| *bytes > 0.5 * 1.25e6), "{:?}", carried.upload);
    }

    #[test]
    fn the_limit_of_the_configuration_holds_with_and_without_maps() {
        let start = Instant::now();
        for share in [None, Some(0.1)] {
            let mut rate = Rate::new(50e3, start);
            let mut sent = 0;
            for ms in 0..10_000 {
                rate.see(start + Duration::from_millis(ms), share);
                if rate.take(2000).is_zero() {
                    sent += 2000;
                }
            }
            assert!((350_000..505_000).contains(&sent), "{share:?}: {sent} bytes in 10 s");
        }
    }
}
