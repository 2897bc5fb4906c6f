//! Who sends the data of each sensor of a vehicle, to tell when several senders do so at once: the data of one sender
//! would replace the data of the others.

use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clearway_mapping::event::Body;

use crate::base::sync::locked;

/// Time after its newest datagram or observation for which a sender counts. Ours: as long as a sensor is not silent.
const RECENT: Duration = Duration::from_secs(2);
/// Number of senders of one sensor that are remembered. Ours: people read them.
const SENDERS_MAX: usize = 4;

/// A sender of a sensor's data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SensorSender {
    /// Source address of the sender's datagrams.
    Address(SocketAddr),
    /// What names it alone.
    Named(Arc<str>),
}

impl fmt::Display for SensorSender {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Address(address) => write!(f, "UDP from {address}"),
            Self::Named(name) => f.write_str(name),
        }
    }
}

/// The newest senders of the sensors of one vehicle, by the sensors' indices.
#[derive(Debug, Default)]
pub struct SensorSenders(Mutex<BTreeMap<u16, Vec<Heard>>>);

#[derive(Debug)]
struct Heard {
    sender: SensorSender,
    first: Instant,
    newest: Instant,
}

impl SensorSenders {
    /// Notes that a sender has sent data of a sensor now. Poses, roads and declarations are no data of a sensor.
    pub fn note(&self, source: u16, body: &Body, sender: &SensorSender, now: Instant) {
        if !matches!(body, Body::Datagram(_) | Body::Scan(_)) {
            return;
        }
        let mut senders = locked(&self.0);
        let heard = senders.entry(source).or_default();
        match heard.iter_mut().find(|heard| heard.sender == *sender) {
            Some(heard) if now.saturating_duration_since(heard.newest) <= RECENT => heard.newest = now,
            // It has begun again.
            Some(heard) => (heard.first, heard.newest) = (now, now),
            None => {
                if heard.len() == SENDERS_MAX {
                    let oldest = heard.iter().enumerate().min_by_key(|(_, heard)| heard.newest);
                    oldest.map(|(at, _)| at).map(|at| heard.swap_remove(at));
                }
                heard.push(Heard { sender: sender.clone(), first: now, newest: now });
            }
        }
    }

    /// The senders of a sensor that send at once, in the order in which they began; none if there is one alone, or if
    /// one went on where another ended.
    pub fn at_once(&self, source: u16, now: Instant) -> Vec<String> {
        let senders = locked(&self.0);
        let Some(heard) = senders.get(&source) else { return Vec::new() };
        let is_recent = |heard: &&Heard| now.saturating_duration_since(heard.newest) <= RECENT;
        let recent = || heard.iter().filter(is_recent);
        let has_begun_before = |one: &Heard, other: &Heard| one.first < other.newest;
        let overlaps = |one: &&Heard| {
            let others = recent().filter(|other| other.sender != one.sender);
            others.into_iter().any(|other| has_begun_before(one, other) && has_begun_before(other, one))
        };
        let mut at_once: Vec<_> = recent().filter(overlaps).collect();
        at_once.sort_by_key(|heard| heard.first);
        at_once.into_iter().map(|heard| heard.sender.to_string()).collect()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    #[test]
    fn two_senders_of_one_sensor_are_told_from_one_that_takes_over() {
        let (senders, began) = (SensorSenders::default(), Instant::now());
        let at = |ms| began + Duration::from_millis(ms);
        let udp = |port| SensorSender::Address(([10, 0, 0, 1], port).into());
        let stream = SensorSender::Named("stream 7 of 10.0.0.2".into());
        let note = |sender: &SensorSender, ms| senders.note(0, &Body::Datagram(Bytes::new()), sender, at(ms));
        note(&udp(1), 0);
        note(&udp(1), 100);
        note(&stream, 200);
        note(&stream, 300);
        assert_eq!(senders.at_once(0, at(300)), [""; 0], "the stream goes on where the datagrams ended");
        note(&udp(1), 400);
        let both = ["UDP from 10.0.0.1:1", "stream 7 of 10.0.0.2"];
        assert_eq!(senders.at_once(0, at(400)), both);
        assert_eq!(senders.at_once(1, at(400)), [""; 0], "another sensor");
        assert_eq!(senders.at_once(0, at(2350)), [""; 0], "the stream has ended");
        senders.note(0, &Body::End, &udp(9), at(2350));
        (10..100).for_each(|port| note(&udp(port), 2400));
        note(&udp(1), 2401);
        assert!(locked(&senders.0)[&0].len() <= SENDERS_MAX, "a flood of addresses is bounded");
    }
}
