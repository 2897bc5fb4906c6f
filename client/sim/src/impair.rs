//! A bad network between sensor and server.
//!
//! In: datagrams in the order in which the sensor sent them. Out: the datagrams that arrive, in the order and with the
//! stamps of their arrival, and [`Counts`] of the faults. The same seed gives the same faults.

use std::collections::BTreeMap;

use crate::noise::{mixed, uniform};
use crate::vehicle::{Datagram, Kind};

/// The faults of a network. Shares are of all datagrams, from 0 to 1. `Default`: no faults.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Faults {
    /// Share of the datagrams lost, each independently.
    pub loss: f64,
    /// Share of the data packets at which a burst begins, in which consecutive data packets are lost.
    pub burst: f64,
    /// Greatest number of data packets lost in one burst, at least 1.
    pub burst_packets: u32,
    /// Share of the datagrams that arrive twice, the copy up to `reorder` data packets later.
    pub duplicate: f64,
    /// One data packet in four arrives later, by 1 to this many data packets.
    pub reorder: u32,
    /// Share of the datagrams that are cut short.
    pub truncate: f64,
    /// Share of the datagrams in which one bit is flipped.
    pub flip: f64,
    /// Greatest delay of a datagram, in ns; the order is kept.
    pub delay_ns: i64,
    /// Seed of all random draws.
    pub seed: u64,
}

/// Number of datagrams that each fault befell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Datagrams that were sent.
    pub sent: u64,
    /// Number of datagrams that arrived, with copies.
    pub arrived: u64,
    /// Data packets lost, in bursts or alone.
    pub packets_lost: u64,
    /// Telemetry datagrams lost.
    pub telemetry_lost: u64,
    /// Runs of lost data packets.
    pub gaps: u64,
    /// Copies that were made.
    pub duplicated: u64,
    /// Data packets that arrived after a later one; copies are not counted.
    pub reordered: u64,
    /// Datagrams that were cut short.
    pub truncated: u64,
    /// Datagrams in which a bit was flipped.
    pub flipped: u64,
}

/// A network with faults, and the datagrams under way in it.
#[derive(Clone, Debug)]
pub struct Impairment {
    faults: Faults,
    counts: Counts,
    /// Data packets seen.
    packets: u64,
    burst_left: u64,
    in_gap: bool,
    /// Datagrams under way, by the data packet after which they arrive and the order in which they were sent.
    under_way: BTreeMap<(u64, u64), Datagram>,
    arrived: Vec<Datagram>,
    newest_ns: i64,
}

impl Impairment {
    /// A network without datagrams.
    pub fn new(faults: Faults) -> Self {
        let (under_way, arrived) = (BTreeMap::new(), Vec::new());
        let counts = Counts::default();
        Self { faults, counts, packets: 0, burst_left: 0, in_gap: false, under_way, arrived, newest_ns: i64::MIN }
    }

    /// Sends a datagram; returns the datagrams that arrive before the next is sent.
    pub fn push(&mut self, datagram: Datagram) -> std::vec::Drain<'_, Datagram> {
        self.counts.sent += 1;
        let stamp_ns = datagram.stamp_ns;
        let is_packet = datagram.kind == Kind::Data;
        let draws = Draws { key: mixed(self.faults.seed ^ mixed(self.counts.sent)) };
        if is_packet {
            self.packets += 1;
        }
        if self.loses(is_packet, &draws) {
            let lost = if is_packet { &mut self.counts.packets_lost } else { &mut self.counts.telemetry_lost };
            *lost += 1;
        } else {
            let copy = draws.happens(1, self.faults.duplicate).then(|| datagram.clone());
            let late = is_packet && draws.happens(2, if self.faults.reorder > 0 { 0.25 } else { 0.0 });
            self.counts.reordered += u64::from(late);
            self.send(datagram, if late { 1 + draws.below(3, self.faults.reorder.into()) } else { 0 }, &draws);
            if let Some(copy) = copy {
                self.counts.duplicated += 1;
                let later = if is_packet { draws.below(4, u64::from(self.faults.reorder) + 1) } else { 0 };
                self.send(copy, later, &draws);
            }
        }
        self.deliver(self.packets, stamp_ns, &draws);
        self.arrived.drain(..)
    }

    /// Returns the datagrams that are still under way.
    pub fn finish(&mut self) -> std::vec::Drain<'_, Datagram> {
        self.deliver(u64::MAX, self.newest_ns, &Draws { key: 0 });
        self.arrived.drain(..)
    }

    /// The counts so far.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    fn loses(&mut self, is_packet: bool, draws: &Draws) -> bool {
        if !is_packet {
            return draws.happens(0, self.faults.loss);
        }
        if self.burst_left == 0 && draws.happens(5, self.faults.burst) {
            self.burst_left = 1 + draws.below(6, self.faults.burst_packets.into());
        }
        let lost = self.burst_left > 0 || draws.happens(0, self.faults.loss);
        self.burst_left = self.burst_left.saturating_sub(1);
        self.counts.gaps += u64::from(lost && !self.in_gap);
        self.in_gap = lost;
        lost
    }

    fn send(&mut self, mut datagram: Datagram, packets_later: u64, draws: &Draws) {
        if draws.happens(7, self.faults.truncate) {
            datagram.payload.truncate(draws.below(8, datagram.payload.len() as u64) as usize);
            self.counts.truncated += 1;
        } else if draws.happens(9, self.faults.flip) {
            let bit = draws.below(10, 8 * datagram.payload.len() as u64);
            datagram.payload[bit as usize / 8] ^= 1 << (bit % 8);
            self.counts.flipped += 1;
        }
        self.under_way.insert((self.packets + packets_later, self.counts.sent + self.counts.duplicated), datagram);
    }

    /// Moves the datagrams that arrive until data packet `packets` is sent, at `now_ns`, to `arrived`.
    fn deliver(&mut self, packets: u64, now_ns: i64, draws: &Draws) {
        let later = self.under_way.split_off(&(packets.saturating_add(1), 0));
        for (_, mut datagram) in std::mem::replace(&mut self.under_way, later) {
            let delay_ns = draws.below(11, self.faults.delay_ns.max(0) as u64 + 1) as i64;
            self.newest_ns = self.newest_ns.max(datagram.stamp_ns.max(now_ns) + delay_ns);
            datagram.stamp_ns = self.newest_ns;
            self.counts.arrived += 1;
            self.arrived.push(datagram);
        }
    }
}

/// The random draws of one datagram, by their purpose.
struct Draws {
    key: u64,
}

impl Draws {
    fn happens(&self, question: u64, share: f64) -> bool {
        share > 0.0 && uniform(self.key.wrapping_add(question)) < share
    }

    /// 0 to `end - 1`; 0 where `end` is 0.
    fn below(&self, question: u64, end: u64) -> u64 {
        (uniform(self.key.wrapping_add(question)) * end as f64) as u64
    }
}

/// The datagrams of a stream that arrive.
#[derive(Clone, Debug)]
pub struct Impaired<I> {
    sent: I,
    network: Impairment,
    ready: std::collections::VecDeque<Datagram>,
}

impl<I: Iterator<Item = Datagram>> Impaired<I> {
    /// A stream through a network with these faults.
    pub fn new(sent: I, faults: Faults) -> Self {
        Self { sent, network: Impairment::new(faults), ready: Default::default() }
    }

    /// The counts so far.
    pub fn counts(&self) -> Counts {
        self.network.counts()
    }
}

impl<I: Iterator<Item = Datagram>> Iterator for Impaired<I> {
    type Item = Datagram;

    fn next(&mut self) -> Option<Datagram> {
        while self.ready.is_empty() {
            match self.sent.next() {
                Some(datagram) => self.ready.extend(self.network.push(datagram)),
                None => {
                    self.ready.extend(self.network.finish());
                    break;
                }
            }
        }
        self.ready.pop_front()
    }
}
