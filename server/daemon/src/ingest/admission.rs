//! Admission of observations: the streams that hosts may open to a vehicle, and the sources' turns at its event queue.
//!
//! A source is a host over gRPC or a session over zenoh. One observation of a source waits at a time, and the permits
//! of [`Admission`] are given in the order of the requests, so sources that always send are admitted in turn. No more
//! than [`QUEUED_MAX`] admitted observations are on the event queue, so that a packet that comes over UDP is not late
//! behind them. A scan that is too large for a turn is refused by its number of points (`vehicle.ingest.points_max`).

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use clearway_proto::v1;
use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::base::sync::locked;

/// Number of admitted observations that wait for the engine or that it works on. Ours: the engine always has one while
/// another is decoded.
const QUEUED_MAX: usize = 2;

/// The semaphore of one source, with one permit: one of its observations waits at a time. All streams of a host share
/// it.
pub type Source = Arc<Semaphore>;

/// Permit for one observation to be on the event queue, released on drop; `None` for an observation that needs none.
pub type AdmissionPermit = Option<OwnedSemaphorePermit>;

/// Resolves when the observation is admitted.
pub type Admitting = BoxFuture<'static, Admitted>;

/// An admitted observation.
#[derive(Debug)]
pub struct Admitted {
    /// The observation.
    pub observation: v1::Observation,
    /// Its permit.
    pub permit: AdmissionPermit,
}

/// The permits of one vehicle's event queue for observations.
#[derive(Debug)]
pub struct Admission(Arc<Semaphore>);

impl Default for Admission {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(QUEUED_MAX)))
    }
}

impl Admission {
    /// Admits an observation when the source and the event queue have a permit for it. A pose and an end of data are
    /// little work for the engine and need none.
    pub fn admit(&self, observation: v1::Observation, source: &Source) -> Admitting {
        use v1::observation::Body::{EgoPose, End};
        if let None | Some(EgoPose(_) | End(_)) = observation.body {
            return std::future::ready(Admitted { observation, permit: None }).boxed();
        }
        let (source, queue) = (source.clone(), self.0.clone());
        let admitted = async move {
            // Fail only for a closed semaphore, and none is closed.
            let _turn = source.acquire_owned().await.ok();
            let permit = queue.acquire_owned().await.ok();
            Admitted { observation, permit }
        };
        admitted.boxed()
    }
}

/// The hosts with open streams, of which a vehicle or a server has a limited number.
#[derive(Debug)]
pub struct StreamLimits {
    /// Greatest number of open streams of all hosts.
    pub streams_max: usize,
    /// Number of streams that one host may have; the others are kept for other hosts.
    host_max: usize,
    /// A source that no stream holds any more has one owner.
    hosts: Mutex<BTreeMap<IpAddr, Source>>,
}

/// A stream exceeds a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StreamLimitError {
    /// The limit of all hosts together.
    #[error("all {streams_max} streams are open")]
    All {
        /// Greatest number of streams.
        streams_max: usize,
    },
    /// The limit of one host.
    #[error("{host} has {streams} of {streams_max} streams open, and the others are kept for other senders")]
    Host {
        /// Address of the host.
        host: IpAddr,
        /// Number of its streams.
        streams: usize,
        /// Greatest number of streams of all hosts.
        streams_max: usize,
    },
}

impl StreamLimits {
    /// At most `streams_max` streams, of which a host never has `kept`; the only stream is for any host.
    pub fn new(streams_max: usize, kept: usize) -> Self {
        Self { streams_max, host_max: streams_max.saturating_sub(kept).max(1), hosts: Mutex::default() }
    }

    /// Opens a stream of this host; it is open until the returned source is dropped.
    ///
    /// # Errors
    /// [`StreamLimitError`] if the stream exceeds a limit.
    pub fn open(&self, host: IpAddr) -> Result<Source, StreamLimitError> {
        let (streams_max, mut hosts) = (self.streams_max, locked(&self.hosts));
        let open = |source: &Source| Arc::strong_count(source) - 1;
        hosts.retain(|_, source| open(source) > 0);
        if hosts.values().map(open).sum::<usize>() >= streams_max {
            return Err(StreamLimitError::All { streams_max });
        }
        let source = hosts.entry(host).or_insert_with(|| Arc::new(Semaphore::new(1)));
        let streams = open(source);
        if streams >= self.host_max {
            return Err(StreamLimitError::Host { host, streams, streams_max });
        }
        Ok(source.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan() -> v1::Observation {
        let body = Some(v1::observation::Body::Scan(v1::Scan::default()));
        v1::Observation { body, ..Default::default() }
    }

    fn source() -> Source {
        Arc::new(Semaphore::new(1))
    }

    #[test]
    fn sources_that_always_send_are_admitted_in_turn_and_a_pose_at_once() {
        let admission = Admission::default();
        let [flood, honest] = [source(), source()];
        let queued: Vec<_> = (0..QUEUED_MAX).map(|_| admission.admit(scan(), &flood).now_or_never()).collect();
        assert!(queued.iter().all(Option::is_some));
        let mut waiting = [&flood, &flood, &honest].map(|source| admission.admit(scan(), source));
        assert!(waiting.iter_mut().all(|waiting| waiting.now_or_never().is_none()));
        let pose = v1::observation::Body::EgoPose(v1::EgoPose::default());
        let pose = v1::Observation { body: Some(pose), ..Default::default() };
        assert!(admission.admit(pose, &flood).now_or_never().is_some(), "a pose waits for nothing");
        let [first, second, of_honest] = &mut waiting;
        let mut queued = queued.into_iter();
        drop(queued.next());
        assert!(second.now_or_never().is_none() && of_honest.now_or_never().is_none());
        let admitted = first.now_or_never().expect("the first in the queue");
        assert!(second.now_or_never().is_none(), "it asks for a permit only now");
        drop(queued.next());
        assert!(second.now_or_never().is_none() && of_honest.now_or_never().is_some(), "one of each source in turn");
        drop(admitted);
        assert!(second.now_or_never().is_some());
    }

    #[test]
    fn an_observation_that_ends_while_it_waits_takes_no_permit() {
        let admission = Admission::default();
        let queued: Vec<_> = (0..QUEUED_MAX).map(|_| admission.admit(scan(), &source()).now_or_never()).collect();
        let mut ended = admission.admit(scan(), &source());
        assert!((&mut ended).now_or_never().is_none());
        let mut next = admission.admit(scan(), &source());
        assert!((&mut next).now_or_never().is_none());
        drop((ended, queued));
        assert!(next.now_or_never().is_some());
    }

    #[test]
    fn one_host_never_has_all_streams() {
        let (a, b): (IpAddr, IpAddr) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
        let limits = StreamLimits::new(3, 1);
        let mut held: Vec<_> = (0..2).map(|_| limits.open(a).unwrap()).collect();
        assert!(Arc::ptr_eq(&held[0], &held[1]), "all streams of a host are one source");
        assert_eq!(limits.open(a).unwrap_err(), StreamLimitError::Host { host: a, streams: 2, streams_max: 3 });
        held.push(limits.open(b).unwrap());
        for host in [a, b] {
            assert_eq!(limits.open(host).unwrap_err(), StreamLimitError::All { streams_max: 3 });
        }
        held.remove(0);
        assert!(limits.open(b).is_ok(), "a dropped stream leaves its place");
        assert!(StreamLimits::new(1, 1).open(a).is_ok(), "the only stream is for any host");
    }
}
