//! The engine's time for the observations that wait for it, by turns of their senders.
//!
//! Little waits in the queue of the engine, so that a packet that comes over UDP is not late behind it; the rest waits
//! with its sender. The sender that will have had the least time is next (self-clocked fair queuing: Golestani, INFOCOM
//! 1994), so that the scans of a sender that takes less than an equal part wait for one scan of the others, however
//! many send more, and no sender waits for ever.

use std::collections::BTreeMap;
use std::future::{pending, ready};
use std::net::IpAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use clearway_proto::v1;
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::oneshot;

use super::observation::PACKETS_MAX;
use crate::base::sync::locked;
use crate::status::map_time::MapTime;

/// Returns of a packet, at most: those of a Velodyne have 12 blocks of 32.
const PACKET_RETURNS: usize = 384;

/// The engine's time for the points of one observation; free again when this is dropped. Empty for an observation
/// without points.
#[derive(Debug, Default)]
pub struct EngineTime {
    us: u64,
    turns: Option<Arc<Mutex<Turns>>>,
}

/// The engine's time for the observations of one vehicle.
#[derive(Debug)]
pub struct EngineTimes {
    map_time: Arc<MapTime>,
    /// Time for the points in the engine's queue.
    most_us: u64,
    turns: Arc<Mutex<Turns>>,
    /// The hosts that have streams, and those that have had more time than a sender that always waits: a new stream of
    /// theirs has had it too.
    hosts: Mutex<BTreeMap<IpAddr, Sender>>,
}

/// One sender: the time in microseconds that it has had, its waiting observations included; used only while the turns
/// are locked.
#[derive(Clone, Debug)]
pub struct Sender(Arc<AtomicU64>);

/// An observation whose points wait until the engine has time for them.
pub struct Waiting {
    /// The observation.
    pub observation: v1::Observation,
    /// Its encoded length.
    pub bytes: usize,
    time: BoxFuture<'static, EngineTime>,
}

/// Who gets the engine's time next. All times are in microseconds.
#[derive(Debug)]
struct Turns {
    free: u64,
    /// The time that a sender that always waits has had: that of the sender of the newest turn, with it.
    now: u64,
    /// In the order in which they came.
    waiting: Vec<Turn>,
}

/// One observation that waits for its turn.
#[derive(Debug)]
struct Turn {
    /// The time that its sender has had with it.
    end: u64,
    takes: u64,
    granted: oneshot::Sender<EngineTime>,
}

impl EngineTimes {
    /// Points whose maps take `most` together, by `map_time`, are in the engine's queue at most; or one observation.
    pub fn new(map_time: Arc<MapTime>, most: Duration) -> Self {
        let most_us = micros(most);
        let turns = Turns { free: most_us, now: 0, waiting: Vec::new() };
        Self { map_time, most_us, turns: Arc::new(Mutex::new(turns)), hosts: Mutex::default() }
    }

    /// A sender that has had as much time as a sender that always waits.
    pub fn sender(&self) -> Sender {
        locked(&self.turns).sender()
    }

    /// The sender of all streams of this host.
    pub fn sender_at(&self, host: IpAddr) -> Sender {
        let mut hosts = locked(&self.hosts);
        let turns = locked(&self.turns);
        hosts.retain(|_, Sender(had)| Arc::strong_count(had) > 1 || had.load(Ordering::Relaxed) > turns.now);
        hosts.entry(host).or_insert_with(|| turns.sender()).clone()
    }

    /// An observation of `bytes` bytes that waits until the points before it leave the engine time for it, so that no
    /// map is late because points came faster than maps are made. Only a scan and packets wait.
    pub fn wait(&self, observation: v1::Observation, bytes: usize, sender: &Sender) -> Waiting {
        let takes = match &observation.body {
            Some(v1::observation::Body::Scan(scan)) => {
                let rays = scan.x.len() / size_of::<f32>() + scan.no_returns.len() / size_of::<[f32; 3]>();
                self.map_time.of(rays)
            }
            Some(v1::observation::Body::Packets(packets)) => {
                // More packets are refused.
                let count = (packets.lengths.len() / size_of::<u16>()).min(PACKETS_MAX);
                self.map_time.of_part(count * PACKET_RETURNS)
            }
            _ => return Waiting { observation, bytes, time: ready(EngineTime::default()).boxed() },
        };
        let (granted, turn) = oneshot::channel();
        let mut turns = locked(&self.turns);
        // A sender that was silent is before the others for as much as may be queued, and not for longer.
        let start = sender.0.load(Ordering::Relaxed).max(turns.now.saturating_sub(self.most_us));
        let takes = micros(takes);
        let end = start + takes;
        sender.0.store(end, Ordering::Relaxed);
        turns.waiting.push(Turn { end, takes: takes.min(self.most_us), granted });
        turns.grant(&self.turns);
        // No turn ends without a grant, because the observation waits for it.
        let time = async move { turn.await.unwrap_or_default() };
        Waiting { observation, bytes, time: time.boxed() }
    }
}

impl Turns {
    fn sender(&self) -> Sender {
        Sender(Arc::new(self.now.into()))
    }

    /// Grants the turns for which there is time. One that needs more than is free is not passed by another.
    fn grant(&mut self, turns: &Arc<Mutex<Self>>) {
        self.waiting.retain(|turn| !turn.granted.is_closed());
        while let Some((at, next)) = self.waiting.iter().enumerate().min_by_key(|(_, turn)| turn.end)
            && next.takes <= self.free
        {
            let Turn { end, takes, granted } = self.waiting.remove(at);
            self.now = self.now.max(end);
            self.free -= takes;
            // The observation may have ended by now. Its time must not be dropped while the turns are locked.
            if let Err(mut unwanted) = granted.send(EngineTime { us: takes, turns: Some(turns.clone()) }) {
                unwanted.turns = None;
                self.free += takes;
            }
        }
    }
}

impl Drop for EngineTime {
    fn drop(&mut self) {
        if let Some(turns) = self.turns.take() {
            let mut all = locked(&turns);
            all.free += self.us;
            all.grant(&turns);
        }
    }
}

impl Waiting {
    /// Resolves when the engine has time for the observation; never without one.
    pub async fn time(waiting: &mut Option<Self>) -> EngineTime {
        match waiting {
            Some(waiting) => (&mut waiting.time).await,
            None => pending().await,
        }
    }
}

/// Whole microseconds, at least one.
fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX).max(1)
}

#[cfg(test)]
mod tests {
    use clearway_proto::packed::pack;

    use super::*;

    /// Before the first map a scan takes 0.1 ms for each thousand points and 2 ms beside them.
    fn scan(points: usize) -> v1::Observation {
        let scan = v1::Scan { x: pack(&vec![1.0_f32; points]), ..Default::default() };
        v1::Observation { body: Some(v1::observation::Body::Scan(scan)), ..Default::default() }
    }

    fn packets(count: usize) -> v1::Observation {
        let packets = v1::Packets { lengths: pack(&vec![1206_u16; count]), ..Default::default() };
        v1::Observation { body: Some(v1::observation::Body::Packets(packets)), ..Default::default() }
    }

    /// The time, if the engine has it at once.
    fn at_once(waiting: Waiting) -> Option<EngineTime> {
        Waiting::time(&mut Some(waiting)).now_or_never()
    }

    #[test]
    fn a_scan_waits_until_those_before_it_leave_the_engine_time() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let wait = |observation| at_once(times.wait(observation, 0, &times.sender()));
        let [first, second] = [(); 2].map(|()| wait(scan(80_000)).expect("10 of 20 ms"));
        assert!(wait(scan(80_000)).is_none(), "two scans of 10 ms wait for the engine");
        assert!(wait(packets(100)).is_none(), "38,400 returns, 3.8 ms");
        let pose = v1::observation::Body::EgoPose(v1::EgoPose::default());
        let pose = v1::Observation { body: Some(pose), ..Default::default() };
        assert!(wait(pose).is_some(), "a pose takes no time");
        drop(first);
        assert!(wait(scan(80_000)).is_some());
        drop(second);
    }

    #[test]
    fn a_sender_of_small_scans_is_next_beside_many_that_send_more_than_the_engine_maps() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [honest, floods] = [1, 16].map(|count| (0..count).map(|_| times.sender()).collect::<Vec<_>>());
        // Scans of 5 ms: four are granted, one of each flood waits, so that each gets a 17th of the time.
        let wait = |points, sender| Some(times.wait(scan(points), 0, sender));
        let mut waiting: Vec<_> = floods.iter().map(|flood| (flood, wait(30_000, flood))).collect();
        let mut granted = std::collections::VecDeque::new();
        let (mut own, mut waited, mut maps) = (None, 0, Vec::new());
        for map in 0..400 {
            for (flood, scan) in &mut waiting {
                if let Some(time) = Waiting::time(scan).now_or_never() {
                    granted.push_back(time);
                    *scan = wait(30_000, flood);
                }
            }
            // One scan of 3 ms in twenty of 5 ms: half of an equal part.
            if map % 20 == 0 && own.is_none() {
                (own, waited) = (wait(10_000, &honest[0]), 0);
            }
            if let Some(time) = Waiting::time(&mut own).now_or_never() {
                own = None;
                maps.push(waited);
                granted.push_back(time);
            }
            waited += 1;
            drop(granted.pop_front().expect("the engine has work"));
        }
        assert_eq!(maps.len(), 20, "{maps:?}");
        assert!(maps[1..].iter().all(|waited| *waited <= 1), "maps that each waits for: {maps:?}");
    }

    #[test]
    fn a_sender_that_was_silent_is_before_the_others_for_as_much_as_may_be_queued() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [silent, busy] = [(); 2].map(|()| times.sender());
        (0..1000).for_each(|_| drop(at_once(times.wait(scan(30_000), 0, &busy)).expect("all time is free")));
        let whole = at_once(times.wait(scan(180_000), 0, &busy)).expect("20 of 20 ms");
        let mut of_busy = Some(times.wait(scan(180_000), 0, &busy));
        let mut of_silent: Vec<_> = (0..10).map(|_| Some(times.wait(scan(30_000), 0, &silent))).collect();
        drop(whole);
        let granted = |waiting: &mut Option<Waiting>| Waiting::time(waiting).now_or_never();
        let before = (0..10).take_while(|at| granted(&mut of_silent[*at]).is_some()).count();
        assert_eq!(
            before, 7,
            "scans of 5 ms, from 20 ms before the newest turn to the end of the other's scan of 20 ms"
        );
        assert!(granted(&mut of_busy).is_some());
    }

    #[test]
    fn an_observation_that_ends_while_it_waits_takes_no_time() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [first, second] = [(); 2].map(|()| times.sender());
        let whole = at_once(times.wait(scan(180_000), 0, &first)).expect("20 of 20 ms");
        let ended = times.wait(scan(180_000), 0, &second);
        let mut next = Some(times.wait(scan(180_000), 0, &times.sender()));
        drop(ended);
        drop(whole);
        assert!(Waiting::time(&mut next).now_or_never().is_some());
    }

    #[test]
    fn all_streams_of_a_host_are_one_sender() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [first, second] = [[127, 0, 0, 1], [127, 0, 0, 1]].map(|host| times.sender_at(host.into()));
        let whole = at_once(times.wait(scan(180_000), 0, &first)).expect("20 of 20 ms");
        let mut of_second = Some(times.wait(scan(180_000), 0, &second));
        let mut of_other = Some(times.wait(scan(170_000), 0, &times.sender_at([127, 0, 0, 2].into())));
        drop(whole);
        assert!(Waiting::time(&mut of_second).now_or_never().is_none(), "its host has had 20 ms");
        assert!(Waiting::time(&mut of_other).now_or_never().is_some());
    }

    #[test]
    fn a_host_whose_streams_have_ended_keeps_the_time_that_it_has_had() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let whole = at_once(times.wait(scan(180_000), 0, &times.sender())).expect("20 of 20 ms");
        let gone = times.sender_at([127, 0, 0, 1].into());
        drop(times.wait(scan(180_000), 0, &gone));
        drop(gone);
        let mut again = Some(times.wait(scan(180_000), 0, &times.sender_at([127, 0, 0, 1].into())));
        let mut other = Some(times.wait(scan(180_000), 0, &times.sender_at([127, 0, 0, 2].into())));
        drop(whole);
        assert!(Waiting::time(&mut again).now_or_never().is_none());
        assert!(Waiting::time(&mut other).now_or_never().is_some());
    }

    #[test]
    fn a_sender_is_granted_its_turn_beside_new_ones_that_never_end() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let old = times.sender();
        let whole = at_once(times.wait(scan(180_000), 0, &old)).expect("20 of 20 ms");
        let mut of_old = Some(times.wait(scan(180_000), 0, &old));
        let mut of_new = Some(times.wait(scan(80_000), 0, &times.sender()));
        drop(whole);
        let granted = (1..=10).find(|_| {
            let next = Some(times.wait(scan(80_000), 0, &times.sender()));
            drop(Waiting::time(&mut of_new).now_or_never());
            of_new = next;
            Waiting::time(&mut of_old).now_or_never().is_some()
        });
        assert!(granted.is_some(), "each new one has scans of 10 ms");
    }
}
