//! The engine's time for the observations that wait for it: all of one vehicle together, and a share for each sender.

use std::collections::BTreeMap;
use std::future::{pending, ready};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use clearway_proto::v1;
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::base::sync::locked;
use crate::status::map_time::MapTime;

/// Number of senders whose waiting points together take the time that a map may take. Ours: beside one that sends more
/// than the engine can map, the scan of another waits an eighth of the time for which a map is valid, and its own.
const SHARES: u32 = 4;
/// Returns of a packet, at most: those of a Velodyne have 12 blocks of 32.
const PACKET_RETURNS: usize = 384;

/// The engine's time for the points of one observation, of the sender's share and of the vehicle; free again when this
/// is dropped. Empty for an observation without points.
#[derive(Debug, Default)]
pub struct EngineTime {
    _of_sender: Option<OwnedSemaphorePermit>,
    _of_vehicle: Option<OwnedSemaphorePermit>,
}

/// The engine's time for the observations of one vehicle.
#[derive(Debug)]
pub struct EngineTimes {
    map_time: Arc<MapTime>,
    /// Longest time for all waiting points.
    most: Duration,
    /// The time that is free, in microseconds.
    free_us: Arc<Semaphore>,
    /// The shares of the hosts that have streams.
    hosts: Mutex<BTreeMap<IpAddr, Weak<Semaphore>>>,
}

/// The part of the engine's time that the points of one sender may take, in microseconds.
#[derive(Clone, Debug)]
pub struct TimeShare(Arc<Semaphore>);

/// An observation whose points wait until the engine has time for them.
pub struct Waiting {
    /// The observation.
    pub observation: v1::Observation,
    /// Its encoded length.
    pub bytes: usize,
    time: BoxFuture<'static, EngineTime>,
}

impl EngineTimes {
    /// Time for points whose maps take `most` together, by `map_time`.
    pub fn new(map_time: Arc<MapTime>, most: Duration) -> Self {
        Self { map_time, most, free_us: semaphore(most), hosts: Mutex::default() }
    }

    /// A share for one sender.
    pub fn share(&self) -> TimeShare {
        TimeShare(semaphore(self.most / SHARES))
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
    /// map is late because points came faster than maps are made. It waits for those of its sender first, so that only
    /// one observation of a sender at a time waits among those of the others. Only a scan and packets wait.
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
        let (share, free) = (share.0.clone(), self.free_us.clone());
        let time = async move {
            // The semaphores are never closed.
            let _of_sender = share.acquire_many_owned(of_sender).await.ok();
            EngineTime { _of_sender, _of_vehicle: free.acquire_many_owned(of_vehicle).await.ok() }
        };
        Waiting { observation, bytes, time: time.boxed() }
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

fn semaphore(time: Duration) -> Arc<Semaphore> {
    Arc::new(Semaphore::new(micros(time) as usize))
}

/// Whole microseconds, at least one.
fn micros(time: Duration) -> u32 {
    u32::try_from(time.as_micros()).unwrap_or(u32::MAX).max(1)
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
    fn all_streams_of_a_host_have_one_share() {
        let times = EngineTimes::new(Arc::default(), Duration::from_millis(20));
        let [first, second] = [[127, 0, 0, 1], [127, 0, 0, 1]].map(|host| times.share_of(host.into()));
        let _first = at_once(times.wait(scan(30_000), 0, &first)).expect("5 of 5 ms");
        assert!(at_once(times.wait(scan(30_000), 0, &second)).is_none());
        let other = times.share_of([127, 0, 0, 2].into());
        assert!(at_once(times.wait(scan(30_000), 0, &other)).is_some());
    }
}
