//! Readers of every kind at the server's own `Watch`, driven by hand: each looks when it pleases, and what it gets is
//! held against the map the engine made. Readers over zenoh are not among them: its sessions have threads and clocks of
//! their own, which nobody can step by hand.

use std::collections::VecDeque;
use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use clearway_proto::v1;
use clearway::publish::Vehicles;
use clearway::publish::grpc::reader::watch;
use clearway::encode::EncodedMap;
use futures::Stream;
use futures::channel::mpsc::{UnboundedSender, unbounded};
use prost::Message;
use tonic::{Code, Status};

use super::Plant;
use super::checks::{Breach, breach};
use super::fate::{Dice, END_NS, HEAL_NS, TURN_NS};

type Updates = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>>>>;
type Requests = UnboundedSender<Result<v1::WatchRequest, Status>>;

/// What a reader does.
#[derive(Clone, Debug, PartialEq)]
pub enum Habit {
    /// Looks all the time and acknowledges at once.
    Fast,
    /// Looks all the time and never says a word.
    Silent,
    /// Looks now and then, and acknowledges what it had before.
    Slow,
    /// Does nothing for a while.
    Stopped(Range<i64>),
    /// Acknowledges anything.
    Garbled,
    /// Goes and comes again.
    Fickle,
}

/// One reader.
pub struct Reader {
    habit: Habit,
    layers: Vec<String>,
    max_in_flight: usize,
    dice: Dice,
    looks_ns: i64,
    open: Option<(Updates, Requests)>,
    last: Option<u64>,
    in_flight: VecDeque<u64>,
    /// Updates it got.
    pub updates: u64,
    /// Maps it was told it missed.
    pub skipped: u64,
}

/// Some of each kind.
pub fn readers(dice: &mut Dice, layers: &[&'static str]) -> Vec<Reader> {
    let from_ns = dice.of(TURN_NS..HEAL_NS);
    let habits = [
        (Habit::Fast, 2),
        (Habit::Silent, 0),
        (Habit::Slow, 1),
        (Habit::Stopped(from_ns..dice.of(from_ns..HEAL_NS + 1)), 2),
        (Habit::Garbled, 1 + dice.of(0..4) as usize),
        (Habit::Fickle, 3),
    ];
    let reader = |(habit, max_in_flight)| {
        let wanted = layers.iter().filter(|_| dice.happens(0.5)).map(|&layer| layer.to_owned()).collect();
        let dice = Dice::new(dice.draw());
        let (open, last, in_flight) = (None, None, VecDeque::new());
        let (looks_ns, updates, skipped) = (0, 0, 0);
        Reader { habit, layers: wanted, max_in_flight, dice, looks_ns, open, last, in_flight, updates, skipped }
    };
    habits.into_iter().map(reader).collect()
}

impl Reader {
    /// Whether it has an open stream.
    pub fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Looks for maps at `now_ns`, if it is in the mood; `maps` are all made so far.
    pub fn look(
        &mut self,
        now_ns: i64,
        vehicles: &Vehicles,
        maps: &[Arc<EncodedMap>],
        plant: Option<Plant>,
    ) -> Result<(), Breach> {
        let healthy = now_ns >= HEAL_NS;
        let rests = match &self.habit {
            Habit::Slow => now_ns < self.looks_ns,
            Habit::Stopped(while_ns) => {
                while_ns.contains(&now_ns) || (plant == Some(Plant::AsleepReader) && now_ns > HEAL_NS)
            }
            _ => false,
        };
        if rests && now_ns < END_NS {
            return Ok(());
        }
        if rests && plant == Some(Plant::AsleepReader) {
            return self.has_newest(maps);
        }
        self.looks_ns = now_ns + self.dice.of(1..4 * TURN_NS);
        if self.habit == Habit::Fickle && !healthy && self.dice.happens(0.05) {
            self.open = None;
        }
        if self.open.is_none() {
            self.subscribe(vehicles)?;
        }
        self.speak();
        while let Some(update) = self.poll()? {
            self.check(update, maps, plant)?;
            if self.habit == Habit::Slow {
                break;
            }
            self.speak();
        }
        if now_ns >= END_NS { self.has_newest(maps) } else { Ok(()) }
    }

    fn subscribe(&mut self, vehicles: &Vehicles) -> Result<(), Breach> {
        let (requests, heard) = unbounded();
        let max_in_flight = self.max_in_flight as u32;
        let layers = self.layers.clone();
        let selection = v1::Selection { vehicle: "car".into(), layers, max_in_flight, ..Default::default() };
        let updates = watch(vehicles, selection, heard);
        let updates = updates.map_err(|status| breach("reader", format!("{:?} is refused: {status}", self.habit)))?;
        self.open = Some((Box::pin(updates), requests));
        (self.last, self.in_flight) = (None, VecDeque::new());
        Ok(())
    }

    /// Acknowledges, each in its own way.
    fn speak(&mut self) {
        let acknowledged = match self.habit {
            Habit::Silent => return,
            Habit::Garbled => match self.dice.of(0..5) {
                0 => Some(0),
                1 => Some(u64::MAX),
                2 => None,
                3 => Some(self.dice.draw()),
                _ => self.last,
            },
            _ => self.last,
        };
        let Some((_, requests)) = &self.open else { return };
        // Nobody drops the other end but with this one.
        let _ = requests.unbounded_send(Ok(v1::WatchRequest { acknowledged, ..Default::default() }));
        if let Some(acknowledged) = acknowledged {
            self.in_flight.retain(|sent| *sent > acknowledged);
        }
    }

    fn poll(&mut self) -> Result<Option<v1::MapUpdate>, Breach> {
        let Some((updates, _)) = &mut self.open else { return Ok(None) };
        match updates.as_mut().poll_next(&mut Context::from_waker(Waker::noop())) {
            Poll::Pending => Ok(None),
            Poll::Ready(Some(Ok(update))) => Ok(Some(update)),
            // It has acknowledged what it was never sent, and comes again.
            Poll::Ready(Some(Err(status)))
                if self.habit == Habit::Garbled && status.code() == Code::InvalidArgument =>
            {
                self.open = None;
                Ok(None)
            }
            Poll::Ready(other) => Err(breach("reader", format!("{:?} is sent away: {other:?}", self.habit))),
        }
    }

    /// An update is the newest map, whole, and all between it and the last one are accounted for.
    fn check(&mut self, update: v1::MapUpdate, maps: &[Arc<EncodedMap>], plant: Option<Plant>) -> Result<(), Breach> {
        let v1::MapUpdate { mut map, mut skipped, .. } = update;
        match plant {
            Some(Plant::SpoiltMap) if self.updates == 3 => map = map.slice(..map.len() - 1),
            Some(Plant::UntoldSkips) => skipped = 0,
            _ => {}
        }
        let wrong = |what: String| Err(breach("reader", format!("{:?}: {what}", self.habit)));
        let newest = maps.last().map(|map| map.sequence);
        let header = v1::Map::decode(map.clone()).ok().and_then(|map| map.header);
        let Some(sequence) = header.map(|header| header.sequence) else { return wrong("a map that is none".into()) };
        if Some(sequence) != newest {
            return wrong(format!("map {sequence}, and the newest is {newest:?}"));
        }
        if map != maps[sequence as usize].select(&self.layers) {
            return wrong(format!("map {sequence} is not as it was made"));
        }
        let before = self.last.map_or(sequence, |last| last + 1);
        if skipped != sequence.wrapping_sub(before) {
            return wrong(format!("map {sequence} after {:?}, and {skipped} are said to be skipped", self.last));
        }
        self.in_flight.push_back(sequence);
        if self.max_in_flight > 0 && self.in_flight.len() > self.max_in_flight {
            return wrong(format!("{:?} are on their way, {} were allowed", self.in_flight, self.max_in_flight));
        }
        self.last = Some(sequence);
        self.updates += 1;
        self.skipped += skipped;
        Ok(())
    }

    fn has_newest(&self, maps: &[Arc<EncodedMap>]) -> Result<(), Breach> {
        let newest = maps.last().map(|map| map.sequence);
        if self.last == newest || self.habit == Habit::Garbled {
            return Ok(());
        }
        Err(breach(
            "converge",
            format!("{:?} has map {:?} in the end, and the newest is {newest:?}", self.habit, self.last),
        ))
    }
}
