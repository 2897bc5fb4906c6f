//! The engine's time for the observations that wait for it: all of one vehicle together, and a share for each sender.
//!
//! The sender that has had the least time is next (start-time fair queuing: Goyal, Vin and Cheng, SIGCOMM 1996), so that
//! the scans of a sender that takes less than an equal part wait for one scan of the others, however many send more.

use std::collections::BTreeMap;
use std::future::{pending, ready};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use clearway_proto::v1;
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::oneshot;

use crate::base::sync::locked;
use crate::status::map_time::MapTime;

/// Number of senders whose waiting points together take the time that a map may take. Ours: beside one that sends more
/// than the engine can map, the scan of another waits an eighth of the time for which a map is valid, and its own.
const SHARES: u32 = 4;
/// Returns of a packet, at most: those of a Velodyne have 12 blocks of 32.
const PACKET_RETURNS: usize = 384;

/// The engine's time for the points of one observation; free again when this is dropped. Empty for an observation
/// without points.
#[derive(Debug, Default)]
pub struct EngineTime(Option<Taken>);

#[derive(Debug)]
struct Taken {
    time: Time,
    turns: Arc<Mutex<Turns>>,
}

/// The engine's time for the observations of one vehicle.
#[derive(Debug)]
pub struct EngineTimes {
    map_time: Arc<MapTime>,
    /// Longest time for all waiting points.
    most: Duration,
    turns: Arc<Mutex<Turns>>,
    /// The hosts that have streams.
    hosts: Mutex<BTreeMap<IpAddr, Weak<Mutex<Sender>>>>,
}

/// The part of the engine's time that the points of one sender may take.
#[derive(Clone, Debug)]
pub struct TimeShare(Arc<Mutex<Sender>>);

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
    /// The time that a sender has had who always waits: the start of the newest turn.
    now: u64,
    /// In the order in which they came.
    waiting: Vec<Turn>,
}

/// One observation that waits for its turn.
#[derive(Debug)]
struct Turn {
    /// The time that its sender has had before it.
    start: u64,
    time: Time,
    granted: oneshot::Sender<EngineTime>,
}

/// The time for one observation: of the vehicle's, and of its sender's share.
#[derive(Clone, Debug)]
struct Time {
    of_vehicle: u64,
    of_sender: u64,
    sender: Arc<Mutex<Sender>>,
}

/// One sender; used only while the turns are locked.
#[derive(Debug)]
struct Sender {
    /// What is left of its share.
    free: u64,
    /// The time that it has had, its waiting observations included; at most a share behind that of one who always
    /// waits, so that a sender that was silent does not hold up the others for long.
    had: u64,
}

impl EngineTimes {
    /// Time for points whose maps take `most` together, by `map_time`.
    pub fn new(map_time: Arc<MapTime>, most: Duration) -> Self {
        let turns = Turns { free: micros(most), now: 0, waiting: Vec::new() };
        Self { map_time, most, turns: Arc::new(Mutex::new(turns)), hosts: Mutex::default() }
    }

    /// A share for one sender.
    pub fn share(&self) -> TimeShare {
        let sender = Sender { free: micros(self.most / SHARES), had: locked(&self.turns).now };
        TimeShare(Arc::new(Mutex::new(sender)))
    }

    /// The share that all streams of this host have in common.
    pub fn share_of(&self, host: IpAddr) -> TimeShare {
        let mut hosts = locked(&self.hosts);
        hosts.retain(|_, share| share.strong_count() > 0);
        if let Some(share) = hosts.get(&host).and_then(Weak::upgrade) {
            return TimeShare(share);
        }
        let share = self.share();
        hosts.insert(host, Arc::downgrade(&share.0));
        share
    }

    /// An observation of `bytes` bytes that waits until the points before it leave the engine time for it, so that no
    /// map is late because points came faster than maps are made. Only a scan and packets wait.
    pub fn wait(&self, observation: v1::Observation, bytes: usize, share: &TimeShare) -> Waiting {
        let takes = match &observation.body {
            Some(v1::observation::Body::Scan(scan)) => {
                let rays = scan.x.len() / size_of::<f32>() + scan.no_returns.len() / size_of::<[f32; 3]>();
                self.map_time.of(rays)
            }
            Some(v1::observation::Body::Packets(packets)) => {
                self.map_time.of_part(packets.lengths.len() / size_of::<u16>() * PACKET_RETURNS)
            }
            _ => return Waiting { observation, bytes, time: ready(EngineTime::default()).boxed() },
        };
        let [of_sender, of_vehicle] = [self.most / SHARES, self.most].map(|most| micros(takes.min(most)));
        let time = Time { of_vehicle, of_sender, sender: share.0.clone() };
        let (granted, turn) = oneshot::channel();
        locked(&self.turns).add(time, micros(self.most / SHARES), granted, &self.turns);
        // The turns outlive the observation, and end no turn without a grant.
        let time = async move { turn.await.unwrap_or_default() };
        Waiting { observation, bytes, time: time.boxed() }
    }
}

impl Turns {
    /// Adds a turn, whose sender starts at most `behind` behind one who always waits.
    fn add(&mut self, time: Time, behind: u64, granted: oneshot::Sender<EngineTime>, turns: &Arc<Mutex<Self>>) {
        let mut sender = locked(&time.sender);
        let start = sender.had.max(self.now.saturating_sub(behind));
        sender.had = start + time.of_vehicle;
        drop(sender);
        self.waiting.push(Turn { start, time, granted });
        self.grant(turns);
    }

    /// Grants the turns for which there is time. One that needs more than is free is not passed by another.
    fn grant(&mut self, turns: &Arc<Mutex<Self>>) {
        self.waiting.retain(|turn| !turn.granted.is_closed());
        let has_share = |turn: &Turn| locked(&turn.time.sender).free >= turn.time.of_sender;
        loop {
            let ready = self.waiting.iter().enumerate().filter(|(_, turn)| has_share(turn));
            let next = ready.min_by_key(|(_, turn)| turn.start);
            let Some((at, _)) = next.filter(|(_, turn)| turn.time.of_vehicle <= self.free) else { return };
            let Turn { start, time, granted } = self.waiting.remove(at);
            self.now = self.now.max(start);
            self.free -= time.of_vehicle;
            locked(&time.sender).free -= time.of_sender;
            let taken = EngineTime(Some(Taken { time, turns: turns.clone() }));
            // The observation may have ended by now.
            if let Some(Taken { time, .. }) = granted.send(taken).err().and_then(|mut unwanted| unwanted.0.take()) {
                self.give_back(&time);
            }
        }
    }

    fn give_back(&mut self, time: &Time) {
        self.free += time.of_vehicle;
        locked(&time.sender).free += time.of_sender;
    }
}

impl Drop for EngineTime {
    fn drop(&mut self) {
        if let Some(Taken { time, turns }) = self.0.take() {
            let mut all = locked(&turns);
            all.give_back(&time);
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
        let wait = |observation| at_once(times.wait(observation, 0, &times.share()));
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
    fn the_scans_of_one_sender_wait_for_its_share_and_not_those_of_another() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [flood, other] = [(); 2].map(|()| times.share());
        let first = at_once(times.wait(scan(30_000), 0, &flood)).expect("5 of 5 ms");
        let mut second = Some(times.wait(scan(30_000), 0, &flood));
        assert!(Waiting::time(&mut second).now_or_never().is_none(), "its share is taken");
        let _other = at_once(times.wait(scan(30_000), 0, &other)).expect("a share of its own");
        drop(first);
        assert!(Waiting::time(&mut second).now_or_never().is_some(), "the observation that has waited goes on");
    }

    #[test]
    fn a_sender_of_small_scans_is_next_beside_many_that_send_more_than_the_engine_maps() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [honest, floods] = [1, 16].map(|count| (0..count).map(|_| times.share()).collect::<Vec<_>>());
        // Scans of 5 ms: four are granted, one of each flood waits, so that each gets a 17th of the time.
        let wait = |points, share| Some(times.wait(scan(points), 0, share));
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
    fn a_sender_that_was_silent_is_not_long_before_the_others() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [silent, busy] = [(); 2].map(|()| times.share());
        (0..1000).for_each(|_| drop(at_once(times.wait(scan(30_000), 0, &busy)).expect("all time is free")));
        let _all = [(); 3].map(|()| at_once(times.wait(scan(30_000), 0, &times.share())).expect("5 of 20 ms"));
        let first = at_once(times.wait(scan(30_000), 0, &silent)).expect("the last 5 of 20 ms");
        let mut next_of_silent = Some(times.wait(scan(30_000), 0, &silent));
        let mut next_of_busy = Some(times.wait(scan(30_000), 0, &busy));
        drop(first);
        assert!(Waiting::time(&mut next_of_busy).now_or_never().is_none());
        drop(Waiting::time(&mut next_of_silent).now_or_never().expect("it had as much time less"));
        assert!(Waiting::time(&mut next_of_busy).now_or_never().is_some());
    }

    #[test]
    fn an_observation_that_ends_while_it_waits_takes_no_time() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [first, second] = [(); 2].map(|()| times.share());
        let whole = at_once(times.wait(scan(180_000), 0, &first)).expect("20 of 20 ms");
        let ended = times.wait(scan(180_000), 0, &second);
        let mut next = Some(times.wait(scan(180_000), 0, &times.share()));
        drop(ended);
        drop(whole);
        assert!(Waiting::time(&mut next).now_or_never().is_some());
    }

    #[test]
    fn all_streams_of_a_host_have_one_share() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [first, second] = [[127, 0, 0, 1], [127, 0, 0, 1]].map(|host| times.share_of(host.into()));
        let _first = at_once(times.wait(scan(30_000), 0, &first)).expect("5 of 5 ms");
        assert!(at_once(times.wait(scan(30_000), 0, &second)).is_none());
        let other = times.share_of([127, 0, 0, 2].into());
        assert!(at_once(times.wait(scan(30_000), 0, &other)).is_some());
    }
}
