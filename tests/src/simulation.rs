//! The whole house in one thread and on a clock of its own: simulated sensors, bad networks, the real door, engine,
//! recorder and readers' streams, and the recording verified in the end. Nothing sleeps; one seed decides everything.
//!
//! | file | in -> out |
//! |---|---|
//! | [`mod@fate`] | seed -> what goes wrong, and when |
//! | [`drive`] | a simulated car with several sensors -> what it sends, cast once |
//! | [`trouble`] | what it sends -> what troubled sensors send, and nonsense |
//! | [`mod@readers`] | the newest map -> readers of every kind, at the server's own streams |
//! | [`tape`] | the server's own recorder -> a disk that fails as told, verified |
//! | [`checks`] | what must be true |
//!
//! Faults end at [`fate::HEAL_NS`]; by [`fate::END_NS`] everything must be as if nothing had been.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::hash::{DefaultHasher, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use bytes::Bytes;
use clearway_mapping::event::{Body, Cause};
use clearway_mapping::map::{Cells, Map};
use clearway_mapping::pipeline::{Pipeline, layer_names};
use clearway_proto::v1;
use clearway_server::config::Config;
use clearway_server::engine::Engine;
use clearway_server::ingest::entrance::Entrance;
use clearway_server::ingest::ticket::{Account, Mark, Verdict, Verdicts};
use clearway_server::ingest::udp::DATAGRAM_BYTES_MAX;
use clearway_server::ingest::{Clock, Door, Queued, door_by};
use clearway_server::publish::{Served, Vehicles};
use clearway_server::record::{Preface, Scribe};
use clearway_server::status::VehicleStatus;
use clearway_server::wire::EncodedMap;
use clearway_sim::impair::Impairment;
use clearway_sim::vehicle::Datagram;
use prost::Message;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::watch;

use checks::{Breach, accounts, adds_up, breach, is_healthy, nothing_free};
use drive::{Drive, What, drives};
use fate::{Dice, DiskFate, END_NS, Fate, HEAL_NS, TURN_NS, Trouble};
use readers::{Reader, readers};
use tape::{MemoryDisk, Recorded};

pub mod checks;
pub mod drive;
pub mod fate;
pub mod readers;
pub mod tape;
pub mod trouble;

/// From one step of the run to the next.
const TICK_NS: i64 = 10_000_000;
/// How much the machine's death may cost of the recording.
const FLUSH_MS: u64 = 200;
/// After the faults have ended, every sensor is whole and in the map within so many turns.
pub const TURNS_TO_HEAL: i64 = 4;
/// Turns with a covered window until maps must show it: the one it happened in, another, and what a stopped sensor's
/// newest turn may still contribute.
const TURNS_TO_COVER: i64 = 4;

/// A fault of the house itself, planted to show that a check finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Plant {
    /// A datagram vanishes between socket and door.
    UncountedDatagram,
    /// A reader gets a map with a byte missing.
    SpoiltMap,
    /// A reader is told that it missed nothing.
    UntoldSkips,
    /// A reader never wakes again.
    AsleepReader,
    /// Everything is called free.
    FreedCells,
    /// An event is processed and not recorded.
    UnrecordedEvent,
    /// A byte of the recording changes on the disk.
    RottenRecording,
    /// Nobody hears what became of an observation.
    LostVerdict,
    /// A sensor stays silent.
    EndlessSilence,
    /// A map's stamp does not rise.
    StuckStamp,
}

/// A run that went as it must.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Simulated time, ns.
    pub simulated_ns: i64,
    /// Events the engine took.
    pub events: u64,
    /// Maps it made.
    pub maps: u64,
    /// Readings it refused.
    pub refused: u64,
    /// Readings its queue had no room for.
    pub lost: u64,
    /// Maps readers got, and were told they missed.
    pub read: (u64, u64),
    /// Turns after the faults until every sensor was whole again.
    pub healed_in: i64,
    /// Whether the recording holds everything.
    pub recorded: bool,
    /// Of every map and the recording.
    pub digest: u64,
}

/// A run that did not.
#[derive(Clone, Debug, PartialEq)]
pub struct Failure {
    /// Its seed.
    pub seed: u64,
    /// When, ns after its beginning.
    pub at_ns: i64,
    /// What was found.
    pub breach: Breach,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self { seed, breach: Breach { check, found }, .. }, seconds) = (self, self.at_ns as f64 * 1e-9);
        writeln!(f, "seed {seed}, {seconds:.2} s, {check}: {found}")?;
        write!(f, "    again: cargo run --release -p clearway-tests --bin campaign -- --seed {seed}")
    }
}

/// What a seed has in store.
pub fn fate(seed: u64) -> Fate {
    let rig = &drives()[0].rig;
    Fate::of(seed, drives().len(), rig.scanners.len(), rig.scanners.len() + rig.units.len())
}

/// One run.
///
/// # Errors
/// The first thing that was not as it must be.
pub fn run(seed: u64, plant: Option<Plant>) -> Result<Outcome, Failure> {
    let fate = fate(seed);
    let mut house = House::new(&fate, plant);
    let outcome = house.run();
    let at_ns = house.now_ns;
    outcome.and_then(|()| house.end()).map_err(|breach| Failure { seed, at_ns, breach })
}

/// The house, and the street outside.
struct House<'a> {
    fate: &'a Fate,
    plant: Option<Plant>,
    drive: &'static Drive,
    dice: Dice,
    now_ns: i64,

    clock: Arc<AtomicI64>,
    door: Door,
    events: Receiver<Queued>,
    engine: Engine,
    vehicles: Vehicles,
    maps: Vec<Arc<EncodedMap>>,
    taken: u64,
    /// When the newest map came that was not whole.
    unwhole_ns: i64,

    networks: Vec<Impairment>,
    /// Datagrams on their way, by when they arrive.
    arriving: BTreeMap<(i64, u64), (u16, Vec<u8>)>,
    datagrams: u64,
    next_sent: usize,
    offered: u64,

    entrance: Entrance,
    waiting: VecDeque<v1::Observation>,
    account: Account,
    observations: u64,
    verdicts: Verdicts,
    told: UnboundedReceiver<(Mark, Verdict)>,

    readers: Vec<Reader>,

    began: Instant,
    disk: MemoryDisk,
    scribe: Option<Scribe<MemoryDisk>>,
    /// Events given to the recorder by the end of each tick.
    given: Vec<u64>,
    /// What was on the disk when the machine died.
    left: Option<Vec<u8>>,
}

impl<'a> House<'a> {
    fn new(fate: &'a Fate, plant: Option<Plant>) -> Self {
        let drive = &drives()[fate.drive];
        let config = config(drive, fate);
        let vehicle = &config.vehicles[0];
        let layers = layer_names(&vehicle.maps);
        let clock = Arc::new(AtomicI64::new(0));
        let (door, events) = door_by(
            Clock::new({
                let clock = clock.clone();
                move || clock.load(Ordering::Relaxed)
            }),
            vehicle.queue,
        );
        let vehicles = vec![("car".into(), layers.clone())];
        let preface = Preface { boot_id: 1, config: config.to_toml(), vehicles, ..Preface::default() };
        let disk = MemoryDisk::new(fate.disk.clone());
        let (scribe, journal) = match Scribe::new(disk.clone(), &config.recorder, &preface, false) {
            Ok((scribe, mut journals)) => (Some(scribe), journals.pop()),
            // The disk is full before the first event; a server would not start, and one that does not record does.
            Err(_) => (None, None),
        };
        let counts = scribe.as_ref().map(Scribe::counts);
        let status = Arc::new(VehicleStatus::new("car".into(), 1, layers.clone(), door.outside(), counts));
        let (newest, receiver) = watch::channel(None);
        let pipeline = Pipeline::new(&vehicle.core(), vec![None; vehicle.sensors.len()]).expect("a car that can be");
        let valid_ms = vehicle.maps.valid_ms;
        let engine = Engine { pipeline, valid_ms, newest, journal, status: status.clone(), observer: None };
        let mut dice = Dice::new(!fate.seed);
        let (verdicts, told) = unbounded_channel();
        Self {
            fate,
            plant,
            drive,
            now_ns: 0,
            clock,
            entrance: Entrance::new(vehicle, &door),
            door,
            events,
            engine,
            vehicles: Vehicles(vec![Served { status, newest: receiver }].into()),
            maps: Vec::new(),
            taken: 0,
            unwhole_ns: 0,
            networks: fate.networks.iter().map(|faults| Impairment::new(*faults)).collect(),
            arriving: BTreeMap::new(),
            datagrams: 0,
            next_sent: drive.sent.partition_point(|sent| sent.offset_ns < fate.offset_ns),
            offered: 0,
            waiting: VecDeque::new(),
            account: Account::new(0),
            observations: 0,
            verdicts,
            told,
            readers: readers(&mut dice, &layers),
            dice,
            began: Instant::now(),
            disk,
            scribe,
            given: Vec::new(),
            left: None,
        }
    }

    fn run(&mut self) -> Result<(), Breach> {
        while self.now_ns < END_NS {
            self.now_ns += TICK_NS;
            self.send();
            self.arrive();
            self.observe();
            if !during(&self.fate.engine_stall, self.now_ns) {
                self.step()?;
                self.engine.rest();
                let snapshot = self.vehicles.0[0].status.snapshot();
                accounts(self.offered, &snapshot.ledger, &snapshot.sensors)?;
            }
            for reader in &mut self.readers {
                reader.look(self.now_ns, &self.vehicles, &self.maps, self.plant)?;
            }
            let open = self.readers.iter().filter(|reader| reader.is_open()).count() as u32;
            let counted = self.vehicles.0[0].status.grpc_readers.load(Ordering::Relaxed);
            if counted != open {
                return Err(breach("reader", format!("{open} readers are there, {counted} are counted")));
            }
            self.record();
        }
        Ok(())
    }

    /// Everything that leaves a sensor in this tick goes into its network.
    fn send(&mut self) {
        let quiet = Trouble::default();
        while let Some(sent) =
            self.drive.sent.get(self.next_sent).filter(|s| s.offset_ns - self.fate.offset_ns <= self.now_ns)
        {
            self.next_sent += 1;
            let at_ns = sent.offset_ns - self.fate.offset_ns;
            let healthy = at_ns >= HEAL_NS && self.plant != Some(Plant::EndlessSilence);
            let covered =
                self.fate.covered.as_ref().filter(|(_, when)| when.contains(&at_ns)).map(|(sector, _)| sector);
            let trouble = |source: usize| if healthy { &quiet } else { &self.fate.troubles[source] };
            match &sent.what {
                What::Datagram(source, datagram) => {
                    let mut trouble = trouble(*source).clone();
                    if self.plant == Some(Plant::EndlessSilence) && *source == 1 {
                        trouble.silent = Some(HEAL_NS..END_NS + 1);
                    }
                    let Some(mut datagram) = trouble::troubled(datagram.clone(), at_ns, &trouble) else {
                        // Networks wait for no later packet, as the order in which packets are late has it.
                        let arrived = self.networks[*source].finish().collect();
                        self.under_way(*source, arrived);
                        continue;
                    };
                    if let Some(sector) = covered {
                        let mount = &self.drive.rig.scanners[*source].1.ego_from_sensor;
                        trouble::cover_datagram(&mut datagram, sector, mount);
                    }
                    datagram.stamp_ns = at_ns;
                    self.carry(*source, datagram);
                }
                What::Observation(observation) => {
                    let unit = self.drive.rig.units.iter().position(|(name, _)| *name == observation.sensor);
                    let mut observation = observation.clone();
                    if let Some(unit) = unit {
                        if during(&trouble(self.networks.len() + unit).silent, at_ns) {
                            continue;
                        }
                        if let Some(sector) = covered {
                            let mount = &self.drive.rig.units[unit].1.ego_from_sensor;
                            trouble::cover_scan(&mut observation, sector, mount);
                        }
                    }
                    self.waiting.push_back(*observation);
                }
            }
        }
        if self.now_ns < HEAL_NS {
            self.bother();
        }
    }

    /// A datagram through its network, which is whole again when the faults have ended.
    fn carry(&mut self, source: usize, datagram: Datagram) {
        let network = &mut self.networks[source];
        let mut arrived: Vec<Datagram> = Vec::new();
        if datagram.stamp_ns < HEAL_NS {
            arrived.extend(network.push(datagram));
        } else {
            arrived.extend(network.finish());
            arrived.push(datagram);
        }
        self.under_way(source, arrived);
    }

    /// Nothing arrives before the tick in which it is known.
    fn under_way(&mut self, source: usize, arrived: Vec<Datagram>) {
        for datagram in arrived {
            self.datagrams += 1;
            let when = (datagram.stamp_ns.max(self.now_ns - TICK_NS), self.datagrams);
            self.arriving.insert(when, (source as u16, datagram.payload));
        }
    }

    /// Nonsense from senders known and unknown.
    fn bother(&mut self) {
        if !self.dice.happens(self.fate.garbage) {
            return;
        }
        let source = self.dice.of(0..self.networks.len() as i64) as u16;
        self.offered += 1;
        match self.dice.of(0..4) {
            0 => self.door.leave_outside(source, Cause::Length, 1),
            1 => self.door.refuse_stranger(([10, 0, 0, self.dice.of(1..99) as u8], 2368).into()),
            2 => {
                self.offered -= 1;
                let stamp_ns = self.drive.rig.start_ns + self.fate.offset_ns + self.now_ns;
                self.waiting.push_back(trouble::nonsense(stamp_ns, &mut self.dice));
            }
            _ => {
                self.offered -= 1;
                self.datagrams += 1;
                let payload = trouble::garbage(&mut self.dice);
                self.arriving.insert((self.now_ns, self.datagrams), (source, payload));
            }
        }
    }

    fn set_clock(&self, at_ns: i64) {
        let ahead_ns =
            self.fate.host_clock.as_ref().filter(|(when, _)| when.contains(&at_ns)).map_or(0, |(_, step)| *step);
        self.clock.store(self.drive.rig.start_ns + self.fate.offset_ns + at_ns + ahead_ns, Ordering::Relaxed);
    }

    /// Datagrams that have arrived go through the door, as a socket's thread has it.
    fn arrive(&mut self) {
        let later = self.arriving.split_off(&(self.now_ns + 1, 0));
        for ((at_ns, number), (source, payload)) in std::mem::replace(&mut self.arriving, later) {
            self.set_clock(at_ns);
            self.offered += 1;
            if self.plant == Some(Plant::UncountedDatagram) && number == 500 {
                continue;
            }
            assert!(payload.len() <= DATAGRAM_BYTES_MAX, "the network makes nothing longer");
            self.door.enter(source, Body::Datagram(Bytes::from(payload))).expect("the engine is there");
        }
        self.set_clock(self.now_ns);
    }

    /// The car tells as much as the vehicle's entrance has room for, and hears what became of it.
    fn observe(&mut self) {
        while let Ok((mark, verdict)) = self.told.try_recv() {
            if self.plant != Some(Plant::LostVerdict) || mark.number != 100 {
                self.account.tell(mark.number, verdict);
            }
        }
        let limits = &self.entrance.limits;
        while self.account.has_room(self.entrance.in_flight_max, limits.message_bytes_max) {
            let Some(mut observation) = self.waiting.pop_front() else { break };
            self.observations += 1;
            observation.number = self.observations;
            self.offered += 1;
            let bytes = observation.encoded_len();
            // An unknown sensor ends a real stream, and its car comes again.
            let _ = self.entrance.take(observation, bytes, &mut self.account, &self.verdicts);
        }
    }

    /// The engine takes everything that waits.
    fn step(&mut self) -> Result<(), Breach> {
        while let Ok(queued) = self.events.try_recv() {
            self.taken += 1;
            let journal =
                (self.plant == Some(Plant::UnrecordedEvent) && self.taken == 300).then(|| self.engine.journal.take());
            self.engine.take(queued);
            if let Some(journal) = journal {
                self.engine.journal = journal;
            }
            adds_up("the vehicle", self.engine.pipeline.ledger())?;
            let newest = self.engine.newest.borrow().clone();
            if let Some(map) = newest.filter(|map| self.maps.len() as u64 <= map.sequence) {
                self.check_map(map)?;
            }
        }
        Ok(())
    }

    fn check_map(&mut self, encoded: Arc<EncodedMap>) -> Result<(), Breach> {
        let Some(map) = self.engine.pipeline.newest_map() else { return Err(breach("map", "encoded, and never made")) };
        if encoded.sequence != self.maps.len() as u64 || encoded.sequence != map.sequence {
            return Err(breach("map", format!("number {} after {} maps", encoded.sequence, self.maps.len())));
        }
        let stuck = self.plant == Some(Plant::StuckStamp);
        if let Some(before) = self.maps.last().filter(|before| stuck || before.capture_end_ns >= encoded.capture_end_ns)
        {
            let back_ms = before.capture_end_ns.saturating_sub(encoded.capture_end_ns) / 1_000_000;
            let found = format!("{back_ms} ms before map {}: {}", before.sequence, describe(map));
            return Err(breach("stamps", found));
        }
        if let Some((sector, when)) = &self.fate.covered {
            let at_ns = map.completed_ns - self.drive.rig.start_ns - self.fate.offset_ns;
            if (when.start + TURNS_TO_COVER * TURN_NS..when.end).contains(&at_ns) {
                match self.plant {
                    Some(Plant::FreedCells) => nothing_free(self.drive, sector, &freed(map))?,
                    _ => nothing_free(self.drive, sector, map)?,
                }
            }
        }
        if !is_healthy(map) {
            self.unwhole_ns = self.now_ns;
        }
        self.maps.push(encoded);
        Ok(())
    }

    fn instant(&self) -> Instant {
        self.began + Duration::from_nanos(self.now_ns.unsigned_abs())
    }

    /// The recorder writes everything that waits.
    fn record(&mut self) {
        let now = self.instant();
        if !during(&self.fate.recorder_stall, self.now_ns)
            && let Some(scribe) = &mut self.scribe
        {
            while scribe.take(now) {}
        }
        self.given.push(self.taken);
        if let DiskFate::Crash(at_ns, torn) = self.fate.disk
            && self.left.is_none()
            && self.now_ns >= at_ns
        {
            let mut bytes = self.disk.bytes();
            bytes.truncate(bytes.len() - torn.min(bytes.len()));
            self.left = Some(bytes);
        }
    }

    /// Everything ends in order, and must be as if nothing had been.
    fn end(mut self) -> Result<Outcome, Breach> {
        let turn = |at_ns: i64| ((at_ns - HEAL_NS).max(0) + TURN_NS - 1) / TURN_NS;
        let healed_in = turn(self.unwhole_ns);
        let last = self.engine.pipeline.newest_map().map(describe).unwrap_or_default();
        if healed_in > TURNS_TO_HEAL {
            return Err(breach("converge", format!("not whole {healed_in} turns after the faults have ended: {last}")));
        }
        let newest_ns = self.engine.pipeline.newest_map().map_or(0, |map| map.completed_ns);
        if self.clock.load(Ordering::Relaxed) - newest_ns > 2 * TURN_NS {
            return Err(breach("converge", format!("no map for two turns: {last}")));
        }
        self.door.close().map_err(|closed| breach("ledger", closed.to_string()))?;
        self.step()?;
        self.engine.rest();
        let snapshot = self.vehicles.0[0].status.snapshot();
        accounts(self.offered, &snapshot.ledger, &snapshot.sensors)?;
        adds_up("in the end, the core", self.engine.pipeline.ledger())?;
        self.observe();
        if !self.account.is_settled() || !self.waiting.is_empty() {
            let (events, _) = self.account.in_flight();
            let found = format!("{events} events without a verdict, {} observations still wait", self.waiting.len());
            return Err(breach("verdicts", found));
        }
        let mut hasher = DefaultHasher::new();
        for map in &self.maps {
            hasher.write(&map.select(&[]));
        }
        let sum = |of: &dyn Fn(&Reader) -> u64| self.readers.iter().map(of).sum();
        let outcome = Outcome {
            simulated_ns: self.now_ns,
            events: self.taken,
            maps: self.maps.len() as u64,
            refused: snapshot.refused(),
            lost: snapshot.ledger.lost,
            read: (sum(&|reader| reader.updates), sum(&|reader| reader.skipped)),
            healed_in,
            ..Outcome::default()
        };
        self.played(outcome, hasher)
    }

    /// The recording is closed and verified.
    fn played(self, outcome: Outcome, mut hasher: DefaultHasher) -> Result<Outcome, Breach> {
        let now = self.instant();
        let layers = self.maps.first().map_or(0, |map| map.layers.len() as u64);
        let Some(mut scribe) = self.scribe else { return Ok(Outcome { digest: hasher.finish(), ..outcome }) };
        drop(self.engine);
        while scribe.take(now) {}
        let counts = scribe.counts();
        scribe.finish();
        let died = self.left.is_some();
        let mut bytes = self.left.unwrap_or_else(|| self.disk.bytes());
        if self.plant == Some(Plant::RottenRecording) {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
        }
        let mut confirmed = 0;
        if let DiskFate::Crash(at_ns, 0) = self.fate.disk
            && self.fate.recorder_stall.is_none()
            && counts.lost() == 0
        {
            // A flush is due so long after what it flushes, and done in the tick after that.
            let ticks = (at_ns - FLUSH_MS as i64 * 1_000_000).div_euclid(TICK_NS) - 2;
            confirmed = usize::try_from(ticks).ok().and_then(|tick| self.given.get(tick)).copied().unwrap_or(0);
        }
        hasher.write(&bytes);
        let given = (self.taken, outcome.maps * layers);
        let recorded = Recorded { bytes, counts, given, confirmed, died }.check()?;
        Ok(Outcome { recorded, digest: hasher.finish(), ..outcome })
    }
}

fn during(when: &Option<std::ops::Range<i64>>, now_ns: i64) -> bool {
    now_ns < HEAL_NS && when.as_ref().is_some_and(|when| when.contains(&now_ns))
}

/// The drive's car, as this run has it.
fn config(drive: &Drive, fate: &Fate) -> Config {
    let mut config = drive.config.clone();
    config.recorder.flush_ms = FLUSH_MS;
    config.recorder.queue = fate.recorder_queue;
    let vehicle = &mut config.vehicles[0];
    vehicle.queue = fate.queue;
    let maps = &mut vehicle.maps;
    if fate.all_maps {
        maps.speed.enabled = true;
    } else {
        for enabled in [&mut maps.height_difference.enabled, &mut maps.terrain.enabled, &mut maps.safe_path.enabled] {
            *enabled = false;
        }
        (maps.occupancy.extent_m, maps.occupancy.cell_m) = (30.0, 0.5);
    }
    config
}

/// The map with every cell called by the second class of its layer, the one that is free.
fn freed(map: &Map) -> Map {
    let mut map = map.clone();
    for layer in &mut map.layers {
        if let Cells::U8(classes) = &mut layer.channels[0].cells {
            classes.fill(1);
        }
    }
    map
}

/// A map's sensors in a line.
fn describe(map: &Map) -> String {
    let sensor = |sensor: &clearway_mapping::map::SensorState| {
        let (name, state, age) = (&sensor.name, sensor.state.as_str(), sensor.age_ms.unwrap_or(f32::NAN));
        format!(
            "{name} {state} {age:.0} ms, clock {} {} ms, partial {:?}, blocked {:?}",
            sensor.clock, sensor.clock_offset_ms, sensor.partial, sensor.blocked
        )
    };
    let sensors: Vec<String> = map.sensors.iter().map(sensor).collect();
    format!("map {} by {}: {}", map.sequence, map.made_by, sensors.join("; "))
}
