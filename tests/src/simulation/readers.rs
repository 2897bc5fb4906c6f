//! Readers of every kind on the server's own `Watch`, polled by hand: each at its own times, and every update is
//! compared with the map that the engine made. Readers over zenoh are not among them, because its sessions have threads
//! and clocks of their own.

use std::collections::VecDeque;
use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use clearway_daemon::publish::Vehicles;
use clearway_daemon::publish::grpc::reader::watch;
use clearway_journal::encode::EncodedMap;
use clearway_proto::v1;
use futures::Stream;
use futures::channel::mpsc::{UnboundedSender, unbounded};
use prost::Message;
use tonic::{Code, Status};

use super::checks::{Violation, violation};
use super::fault_plan::{END_NS, HEAL_NS, InjectedFault, REVOLUTION_NS, Rng};

type Updates = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>>>>;
type Requests = UnboundedSender<Result<v1::WatchRequest, Status>>;

/// Behaviour of a reader.
#[derive(Clone, Debug, PartialEq)]
pub enum Habit {
    /// Polls in every tick and acknowledges at once.
    Fast,
    /// Polls in every tick and never acknowledges.
    Silent,
    /// Polls now and then, and acknowledges the update before.
    Slow,
    /// Does not poll during this time.
    Stopped(Range<i64>),
    /// Acknowledges arbitrary sequences.
    Garbled,
    /// Disconnects and subscribes again.
    Fickle,
}

/// A simulated reader with its habit and its layers.
pub struct SimulatedReader {
    habit: Habit,
    layers: Vec<String>,
    max_in_flight: usize,
    rng: Rng,
    next_poll_ns: i64,
    open: Option<(Updates, Requests)>,
    last: Option<u64>,
    in_flight: VecDeque<u64>,
    /// Updates that the reader received.
    pub updates: u64,
    /// Maps reported to the reader as skipped.
    pub skipped: u64,
}

/// One reader of each kind.
pub fn readers(rng: &mut Rng, layers: &[&'static str]) -> Vec<SimulatedReader> {
    let from_ns = rng.within(REVOLUTION_NS..HEAL_NS);
    let habits = [
        (Habit::Fast, 2),
        (Habit::Silent, 0),
        (Habit::Slow, 1),
        (Habit::Stopped(from_ns..rng.within(from_ns..HEAL_NS + 1)), 2),
        (Habit::Garbled, 1 + rng.within(0..4) as usize),
        (Habit::Fickle, 3),
    ];
    let reader = |(habit, max_in_flight)| {
        let chosen = layers.iter().filter(|_| rng.happens(0.5)).map(|&layer| layer.to_owned()).collect();
        let rng = Rng::new(rng.draw());
        let (open, last, in_flight) = (None, None, VecDeque::new());
        let (next_poll_ns, updates, skipped) = (0, 0, 0);
        SimulatedReader {
            habit,
            layers: chosen,
            max_in_flight,
            rng,
            next_poll_ns,
            open,
            last,
            in_flight,
            updates,
            skipped,
        }
    };
    habits.into_iter().map(reader).collect()
}

impl SimulatedReader {
    /// True if the reader has an open stream.
    pub fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Polls for updates at `now_ns`, if the reader polls now; `maps` are all maps made so far.
    pub fn poll_at(
        &mut self,
        now_ns: i64,
        vehicles: &Vehicles,
        maps: &[Arc<EncodedMap>],
        injected: Option<InjectedFault>,
    ) -> Result<(), Violation> {
        let healthy = now_ns >= HEAL_NS;
        let rests = match &self.habit {
            Habit::Slow => now_ns < self.next_poll_ns,
            Habit::Stopped(while_ns) => {
                while_ns.contains(&now_ns) || (injected == Some(InjectedFault::StalledReader) && now_ns > HEAL_NS)
            }
            _ => false,
        };
        if rests && now_ns < END_NS {
            return Ok(());
        }
        if rests && injected == Some(InjectedFault::StalledReader) {
            return self.has_newest(maps);
        }
        self.next_poll_ns = now_ns + self.rng.within(1..4 * REVOLUTION_NS);
        if self.habit == Habit::Fickle && !healthy && self.rng.happens(0.05) {
            self.open = None;
        }
        if self.open.is_none() {
            self.subscribe(vehicles)?;
        }
        self.acknowledge();
        while let Some(update) = self.poll()? {
            self.check(update, maps, injected)?;
            if self.habit == Habit::Slow {
                break;
            }
            self.acknowledge();
        }
        if now_ns >= END_NS { self.has_newest(maps) } else { Ok(()) }
    }

    fn subscribe(&mut self, vehicles: &Vehicles) -> Result<(), Violation> {
        let (requests, received) = unbounded();
        let max_in_flight = self.max_in_flight as u32;
        let layers = self.layers.clone();
        let selection = v1::Selection { vehicle: "car".into(), layers, max_in_flight, ..Default::default() };
        let updates = watch(vehicles, selection, received, "a simulated reader".into());
        let updates =
            updates.map_err(|status| violation("reader", format!("{:?} is refused: {status}", self.habit)))?;
        self.open = Some((Box::pin(updates), requests));
        (self.last, self.in_flight) = (None, VecDeque::new());
        Ok(())
    }

    /// Sends an acknowledgement, according to the kind of reader.
    fn acknowledge(&mut self) {
        let acknowledged = match self.habit {
            Habit::Silent => return,
            Habit::Garbled => match self.rng.within(0..5) {
                0 => Some(0),
                1 => Some(u64::MAX),
                2 => None,
                3 => Some(self.rng.draw()),
                _ => self.last,
            },
            _ => self.last,
        };
        let Some((_, requests)) = &self.open else { return };
        // The other end lives as long as this end.
        let _ = requests.unbounded_send(Ok(v1::WatchRequest { acknowledged, ..Default::default() }));
        if let Some(acknowledged) = acknowledged {
            self.in_flight.retain(|sent| *sent > acknowledged);
        }
    }

    fn poll(&mut self) -> Result<Option<v1::MapUpdate>, Violation> {
        let Some((updates, _)) = &mut self.open else { return Ok(None) };
        match updates.as_mut().poll_next(&mut Context::from_waker(Waker::noop())) {
            Poll::Pending => Ok(None),
            Poll::Ready(Some(Ok(update))) => Ok(Some(update)),
            // The reader acknowledged a map that it was never sent, and subscribes again.
            Poll::Ready(Some(Err(status)))
                if self.habit == Habit::Garbled && status.code() == Code::InvalidArgument =>
            {
                self.open = None;
                Ok(None)
            }
            Poll::Ready(other) => Err(violation("reader", format!("{:?}: the stream ended: {other:?}", self.habit))),
        }
    }

    /// Checks that an update is the newest map, whole, and that the skipped maps before it are counted.
    fn check(
        &mut self,
        update: v1::MapUpdate,
        maps: &[Arc<EncodedMap>],
        injected: Option<InjectedFault>,
    ) -> Result<(), Violation> {
        let v1::MapUpdate { mut map, mut skipped, .. } = update;
        match injected {
            Some(InjectedFault::CorruptMap) if self.updates == 3 => map = map.slice(..map.len() - 1),
            Some(InjectedFault::UnreportedSkips) => skipped = 0,
            _ => {}
        }
        let wrong = |what: String| Err(violation("reader", format!("{:?}: {what}", self.habit)));
        let newest = maps.last().map(|map| map.sequence);
        let header = v1::Map::decode(map.clone()).ok().and_then(|map| map.header);
        let Some(sequence) = header.map(|header| header.sequence) else { return wrong("an invalid map".into()) };
        if Some(sequence) != newest {
            return wrong(format!("map {sequence}, but the newest is {newest:?}"));
        }
        if map != maps[sequence as usize].select(&self.layers) {
            return wrong(format!("map {sequence} differs from the map that was made"));
        }
        let before = self.last.map_or(sequence, |last| last + 1);
        if skipped != sequence.wrapping_sub(before) {
            return wrong(format!("map {sequence} after {:?}, {skipped} reported as skipped", self.last));
        }
        self.in_flight.push_back(sequence);
        if self.max_in_flight > 0 && self.in_flight.len() > self.max_in_flight {
            return wrong(format!("{:?} are in flight, {} are allowed", self.in_flight, self.max_in_flight));
        }
        self.last = Some(sequence);
        self.updates += 1;
        self.skipped += skipped;
        Ok(())
    }

    fn has_newest(&self, maps: &[Arc<EncodedMap>]) -> Result<(), Violation> {
        let newest = maps.last().map(|map| map.sequence);
        if self.last == newest || self.habit == Habit::Garbled {
            return Ok(());
        }
        Err(violation(
            "converge",
            format!("{:?} has map {:?} at the end, the newest is {newest:?}", self.habit, self.last),
        ))
    }
}
