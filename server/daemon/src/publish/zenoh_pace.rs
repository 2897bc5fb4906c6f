//! What a thin link bears: when a vehicle's next map may follow the last to the router.
//!
//! In: probes before and after each map, and their answers. Out: the time from which the next map may be sent. A probe
//! is a query on a key without a queryable, so that the router ends it at once; it has the maps' priority and travels
//! behind them. The time between the two answers is what the link takes for the map.
//!
//! A map that waits in the queue of a link is old when it arrives, so maps wait here, where a newer one replaces them:
//! the next is sent when the link has transmitted the last, and two are on the way at most, as over gRPC.

use std::time::{Duration, Instant};

use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Reply;
use zenoh::sample::Locality;

use crate::zenoh_session::ZenohError;

/// Maps on the way to the router at the same time. Ours: as a gRPC client asks for (`max_in_flight`).
const ON_THE_WAY_MAX: u64 = 2;
/// Time without an answer after which another probe is sent, because the last may be lost: a full queue drops it, as it
/// does maps. Ours: a lost one delays maps by less than their validity, and probes stay a few percent of a thin link.
pub(super) const REPEAT: Duration = Duration::from_millis(100);
/// Time without any answer after which maps are sent without waiting for one, until one comes. Ours: longer than a link
/// takes for a map that a planner can use. A router whose access control denies the probes delays maps once.
const SILENCE: Duration = Duration::from_secs(2);
/// Longest life of a probe. The end of the session with a router, after its lease, ends its probes before.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);

/// The maps of a vehicle that are on the way to the router.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// Numbers of maps since the start.
    sent: u64,
    arrived: u64,
    /// Time that the link took for the last map that arrived.
    transmission: Duration,
    /// When the link has transmitted the maps on the way; `None` before the first map.
    free: Option<Instant>,
    /// Time of the last answer, or of the first map after it; `None` while no map is on the way.
    unanswered_since: Option<Instant>,
}

impl Pace {
    /// Records a map that is sent now.
    pub fn sent(&mut self, now: Instant) {
        self.sent += 1;
        self.free = Some(now + self.transmission);
        self.unanswered_since.get_or_insert(now);
    }

    /// Number of maps that were sent.
    pub fn count(&self) -> u64 {
        self.sent
    }

    /// Records that the first `count` maps have arrived, and how long the link took for the last of them, if that is
    /// known. If another is on the way, it may have waited in the queue of the link until now.
    pub fn arrived(&mut self, now: Instant, count: u64, transmission: Option<Duration>) {
        if count > self.arrived {
            self.arrived = count;
            self.transmission = transmission.unwrap_or(self.transmission);
            self.free = Some(now + self.transmission);
            self.unanswered_since = Some(now).filter(|_| self.sent > count);
        }
    }

    /// Time for which no probe has been answered, although maps were sent.
    pub fn unanswered(&self, now: Instant) -> Option<Duration> {
        self.unanswered_since.map(|since| now.saturating_duration_since(since))
    }

    /// True if no probe has been answered for long, although maps were sent.
    pub fn is_silent(&self, now: Instant) -> bool {
        self.unanswered(now).is_some_and(|unanswered| unanswered >= SILENCE)
    }

    /// Time from now until the next map may be sent; `None` if one must arrive before.
    pub fn wait(&self, now: Instant) -> Option<Duration> {
        match self.sent - self.arrived {
            _ if self.is_silent(now) => Some(Duration::ZERO),
            0 => Some(Duration::ZERO),
            1..ON_THE_WAY_MAX => self.free.map(|free| free.saturating_duration_since(now)),
            _ => None,
        }
    }
}

/// Sends probes of a vehicle's link to the router.
pub(super) struct Probes {
    session: Session,
    key: String,
    priority: Priority,
}

/// A probe on its way.
pub(super) struct Probe(FifoChannelHandler<Reply>);

impl Probes {
    /// Probes with the priority of the vehicle's maps.
    pub fn new(session: &Session, vehicle: &str, priority: Priority) -> Self {
        Self { session: session.clone(), key: format!("clearway/{vehicle}/link"), priority }
    }

    /// Sends a probe behind everything that was sent with its priority.
    ///
    /// # Errors
    /// [`ZenohError`] if the session is closed.
    pub async fn send(&self) -> Result<Probe, ZenohError> {
        let query = self.session.get(&self.key).allowed_destination(Locality::Remote).timeout(ANSWER_TIMEOUT);
        let query = query.priority(self.priority).congestion_control(CongestionControl::Drop);
        // Express: in a batch with the map, which is received as one, it would arrive with the map.
        let query = query.express(true);
        query.await.map(Probe).map_err(ZenohError::of(format!("probe {}", self.key)))
    }
}

impl Probe {
    /// Waits for the answer, which is the end of the query without a reply; returns when it came. `None` without an
    /// answer: a reply says that the time is over.
    pub async fn answered(self) -> Option<Instant> {
        self.0.recv_async().await.is_err().then(Instant::now)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use super::*;

    const PERIOD_MS: u64 = 100;

    /// A link that takes `transmission_ms` for a map, one after the other, and delays it and its answer by `trip_ms`
    /// together, from a number of maps on.
    struct Link {
        transmission_ms: fn(u64) -> u64,
        trip_ms: u64,
    }

    /// Sends the newest of `made` maps, one each [`PERIOD_MS`], as soon as the pace allows. Returns of each map that
    /// was sent its number and its age in ms when the link has transmitted it.
    fn drive(made: u64, link: &Link) -> Vec<(u64, u64)> {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let (mut pace, mut answers, mut free_ms, mut arrived) = (Pace::default(), VecDeque::new(), 0, Vec::new());
        let mut unsent = None;
        for now_ms in 0..made * PERIOD_MS {
            let is_due = |answer: &mut (u64, u64, u64)| answer.0 <= now_ms;
            while let Some((_, count, transmission)) = answers.pop_front_if(is_due) {
                pace.arrived(at(now_ms), count, Some(Duration::from_millis(transmission)));
            }
            if now_ms % PERIOD_MS == 0 {
                unsent = Some(now_ms / PERIOD_MS);
            }
            if pace.wait(at(now_ms)) == Some(Duration::ZERO)
                && let Some(map) = unsent.take()
            {
                pace.sent(at(now_ms));
                let transmission_ms = (link.transmission_ms)(map);
                free_ms = free_ms.max(now_ms) + transmission_ms;
                answers.push_back((free_ms + link.trip_ms, pace.count(), transmission_ms));
                arrived.push((map, free_ms - map * PERIOD_MS));
            }
        }
        arrived
    }

    #[test]
    fn a_link_that_bears_every_map_gets_every_map_also_if_it_is_long() {
        for trip_ms in [0, 20, 150, 180] {
            let arrived = drive(100, &Link { transmission_ms: |_| 8, trip_ms });
            assert_eq!(arrived.len(), 100, "{trip_ms} ms");
            assert!(arrived.iter().all(|(_, age_ms)| *age_ms == 8), "{trip_ms} ms: {arrived:?}");
        }
    }

    #[test]
    fn a_thin_link_gets_as_many_maps_as_it_bears_and_none_waits_in_its_queue() {
        let arrived = drive(100, &Link { transmission_ms: |_| 250, trip_ms: 20 });
        assert!((36..=40).contains(&arrived.len()), "10 s of 250 ms each: {}", arrived.len());
        // A map waits here until a newer one replaces it, and in the link for none.
        let worst = arrived.iter().skip(2).map(|(_, age_ms)| *age_ms).max();
        assert!(worst <= Some(250 + PERIOD_MS), "{arrived:?}");
    }

    #[test]
    fn a_link_that_becomes_thin_has_two_maps_in_its_queue_at_most() {
        let arrived = drive(200, &Link { transmission_ms: |map| if map < 50 { 8 } else { 400 }, trip_ms: 20 });
        let worst = arrived.iter().map(|(_, age_ms)| *age_ms).max();
        assert!(worst <= Some(2 * 400), "{arrived:?}");
        let later = arrived.iter().filter(|(map, _)| *map >= 60).map(|(_, age_ms)| *age_ms).max();
        assert!(later <= Some(400 + PERIOD_MS), "{arrived:?}");
    }

    #[test]
    fn a_router_that_answers_no_probe_delays_maps_once() {
        let (start, mut pace) = (Instant::now(), Pace::default());
        let at = |ms: u64| start + Duration::from_millis(ms);
        let sent: Vec<u64> = (0..1000)
            .map(|map| map * PERIOD_MS)
            .filter(|now_ms| {
                let is_sent = pace.wait(at(*now_ms)) == Some(Duration::ZERO);
                if is_sent {
                    pace.sent(at(*now_ms));
                }
                is_sent
            })
            .collect();
        assert_eq!((sent[..3].to_vec(), sent.len()), (vec![0, 100, 2000], 2 + 980));
        pace.arrived(at(100_000), pace.count(), None);
        pace.sent(at(100_000));
        pace.sent(at(100_000));
        assert_eq!(pace.wait(at(100_100)), None, "after an answer maps are paced again");
    }

    #[test]
    fn an_answer_counts_for_the_maps_before_it_whose_answers_are_lost() {
        let (mut pace, start) = (Pace::default(), Instant::now());
        pace.sent(start);
        pace.sent(start);
        assert_eq!(pace.wait(start), None, "two are on the way");
        pace.arrived(start, pace.count(), None);
        assert_eq!(pace.wait(start), Some(Duration::ZERO));
        pace.arrived(start, 1, None);
        assert_eq!(pace.wait(start), Some(Duration::ZERO), "a late answer changes nothing");
    }
}
