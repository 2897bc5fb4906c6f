//! Counts of the readings that did not become events: by cause, by unknown sender, by the reason of a refused message.
//! Beside them, what else is known of a vehicle's inputs.
//! The event queue reports the counts to the engine as [`Body::Lost`](clearway_mapping::event::Body::Lost); until then
//! the status adds them to the ledger.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Mutex;

use clearway_mapping::event::Cause;
use clearway_mapping::ledger::Ledger;

use super::sensor_senders::SensorSenders;
use crate::base::sync::locked;

/// Number of unknown senders that are remembered. Ours: enough to find a sensor with a wrong address.
const UNKNOWN_SENDERS_MAX: usize = 8;

/// The drop counters of one vehicle; they outlive its queue.
#[derive(Debug, Default)]
pub struct DropCounters {
    pub(super) unreported: Mutex<Unreported>,
    /// Unknown senders, the newest last.
    unknown_senders: Mutex<VecDeque<UnknownSender>>,
    /// Refused messages by reason; the ledger counts all of them as `observation`, and no part of a message.
    refused_messages: Mutex<BTreeMap<&'static str, u64>>,
    /// Who sends the data of each sensor.
    pub senders: SensorSenders,
    /// Threads that read for the vehicle and ended by a fault.
    ended_inputs: Mutex<Vec<String>>,
}

/// Number of dropped readings that are not reported to the engine yet, by cause and sensor. A full queue comes first.
pub(super) type Unreported = BTreeMap<(Cause, u16), u64>;

/// A sender of datagrams that is none of the vehicle's sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UnknownSender {
    /// Source address of the sender's datagrams.
    pub address: SocketAddr,
    /// Number of its datagrams since it is remembered.
    pub datagrams: u64,
    /// Arrival of its newest datagram, ns since the Unix epoch.
    pub newest_ns: i64,
}

impl DropCounters {
    /// Adds the drops that are not reported to the engine yet to the vehicle's ledger and to the ledgers of its
    /// sensors.
    pub fn add_unreported_to<'a>(&self, ledger: &mut Ledger, sensors: impl IntoIterator<Item = (u16, &'a mut Ledger)>) {
        let mut sensors: BTreeMap<_, _> = sensors.into_iter().collect();
        for (&(cause, source), &count) in &*locked(&self.unreported) {
            ledger.record_lost(cause, count);
            if let Some(sensor) = sensors.get_mut(&source).filter(|_| cause.has_source()) {
                sensor.record_lost(cause, count);
            }
        }
    }

    /// Counts `count` dropped readings of a sensor.
    pub(crate) fn record(&self, source: u16, cause: Cause, count: u64) {
        if count > 0 {
            *locked(&self.unreported).entry((cause, source)).or_default() += count;
        }
    }

    /// Counts `count` messages that were refused for `reason`. `source` is the index of a sensor, or
    /// [`clearway_mapping::event::UNKNOWN_SOURCE`].
    pub fn record_refused_messages(&self, source: u16, reason: &'static str, count: u64) {
        self.record(source, Cause::Observation, count);
        *locked(&self.refused_messages).entry(reason).or_default() += count;
    }

    /// Counts `count` parts of messages (points, fields, transforms, packets) that were refused while the rest of their
    /// messages is used.
    #[cfg(feature = "zenoh")]
    pub(crate) fn record_refused_parts(&self, count: u64) {
        *locked(&self.refused_messages).entry("ros_part").or_default() += count;
    }

    /// Counts a plan that was refused. No map depends on it, so the ledger and the journal do not have it.
    pub(crate) fn record_refused_plan(&self) {
        *locked(&self.refused_messages).entry("plan").or_default() += 1;
    }

    /// Remembers the sender of a datagram that arrived at `newest_ns`.
    pub(super) fn record_unknown_sender(&self, address: SocketAddr, newest_ns: i64) {
        let mut senders = locked(&self.unknown_senders);
        let known = senders.iter().position(|sender| sender.address == address);
        let known = known.and_then(|index| senders.remove(index));
        // One line: anybody can send from many addresses.
        if senders.is_empty() && known.is_none() {
            tracing::warn!(%address, "datagrams of a sender that vehicle.udp.from does not name are refused");
        }
        if known.is_none() && senders.len() == UNKNOWN_SENDERS_MAX {
            senders.pop_front();
        }
        let datagrams = known.map_or(0, |sender| sender.datagrams) + 1;
        senders.push_back(UnknownSender { address, datagrams, newest_ns });
    }

    /// Number of refused messages since the server's start, by reason.
    pub fn refused_messages(&self) -> BTreeMap<&'static str, u64> {
        locked(&self.refused_messages).clone()
    }

    /// Records that a thread that reads for the vehicle has ended by a fault.
    pub(crate) fn record_ended_input(&self, what: String) {
        locked(&self.ended_inputs).push(what);
    }

    /// The threads that read for the vehicle and have ended by a fault.
    pub fn ended_inputs(&self) -> Vec<String> {
        locked(&self.ended_inputs).clone()
    }

    /// The most recent unknown senders, the newest last.
    pub fn unknown_senders(&self) -> Vec<UnknownSender> {
        locked(&self.unknown_senders).iter().copied().collect()
    }
}

/// The cause and sensor to report next: drops by a full queue at once, all others only if the report `is_due`.
pub(super) fn next_unreported(unreported: &Unreported, is_due: bool) -> Option<(Cause, u16)> {
    unreported.keys().next().copied().filter(|(cause, _)| is_due || *cause == Cause::Queue)
}
