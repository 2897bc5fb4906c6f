//! What stayed outside a door: readings by cause, strangers, refused messages by their own names. The door tells the
//! engine of it as [`Body::Lost`](clearway_mapping::event::Body::Lost); until then the status adds it to the ledger.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Mutex;

use clearway_mapping::event::Cause;
use clearway_mapping::ledger::Ledger;

use super::locked;

/// Strangers remembered, newest last.
const STRANGERS: usize = 8;

/// What stayed outside a door; outlives its queue.
#[derive(Debug, Default)]
pub struct Outside {
    pub(super) untold: Mutex<Untold>,
    strangers: Mutex<VecDeque<Stranger>>,
    /// What the ledger calls `observation`, by its own name.
    observations: Mutex<BTreeMap<&'static str, u64>>,
}

/// Readings that stayed outside and that the engine has not been told of yet; a full queue comes first.
pub(super) type Untold = BTreeMap<(Cause, u16), u64>;

/// A sender that is none of the vehicle's sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stranger {
    /// Whence its datagrams came.
    pub address: SocketAddr,
    /// How many, since it is remembered.
    pub datagrams: u64,
    /// When the newest came, ns since the Unix epoch.
    pub newest_ns: i64,
}

impl Outside {
    /// Adds what the engine has not been told of yet to its ledger, and to those of its sensors.
    pub fn add_to<'a>(&self, ledger: &mut Ledger, sensors: impl IntoIterator<Item = &'a mut Ledger>) {
        let mut sensors: Vec<_> = sensors.into_iter().collect();
        for (&(cause, source), &count) in &*locked(&self.untold) {
            ledger.record_lost(cause, count);
            if let Some(sensor) = sensors.get_mut(usize::from(source)).filter(|_| cause.has_source()) {
                sensor.record_lost(cause, count);
            }
        }
    }

    /// Counts readings that stay outside.
    pub(crate) fn leave(&self, source: u16, cause: Cause, count: u64) {
        if count > 0 {
            *locked(&self.untold).entry((cause, source)).or_default() += count;
        }
    }

    /// Counts messages that are no observations of a sensor, or of [`clearway_mapping::event::NOBODY`]: the ledger has
    /// one word for them, here each keeps its `reason`.
    pub(crate) fn leave_observations(&self, source: u16, reason: &'static str, count: u64) {
        self.leave(source, Cause::Observation, count);
        *locked(&self.observations).entry(reason).or_default() += count;
    }

    /// Remembers a stranger's datagram.
    pub(super) fn meet(&self, address: SocketAddr, newest_ns: i64) {
        let mut strangers = locked(&self.strangers);
        let known = strangers.iter().position(|stranger| stranger.address == address);
        let known = known.and_then(|index| strangers.remove(index));
        if known.is_none() && strangers.len() == STRANGERS {
            strangers.pop_front();
        }
        let datagrams = known.map_or(0, |stranger| stranger.datagrams) + 1;
        strangers.push_back(Stranger { address, datagrams, newest_ns });
    }

    /// The observations refused since the server's start, by reason.
    pub fn observations_refused(&self) -> BTreeMap<&'static str, u64> {
        locked(&self.observations).clone()
    }

    /// The last few strangers, newest last.
    pub fn strangers(&self) -> Vec<Stranger> {
        locked(&self.strangers).iter().copied().collect()
    }
}

/// What is told next: a full queue at once, all else when it `is_due`.
pub(super) fn next_told(untold: &Untold, is_due: bool) -> Option<(Cause, u16)> {
    untold.keys().next().copied().filter(|(cause, _)| is_due || *cause == Cause::Queue)
}
