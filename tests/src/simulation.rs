//! The whole house in one thread and on a clock of its own: simulated sensors, bad networks, the real door, engine,
//! recorder and readers' streams, and the recording verified in the end. Nothing sleeps; one seed decides everything.
//!
//! | file | in -> out |
//! |---|---|
//! | [`mod@fate`] | seed -> what goes wrong, and when |
//! | [`drive`] | a simulated car with several sensors -> what it sends, cast once |
//! | [`trouble`] | what it sends -> what troubled sensors send, and nonsense |
//! | [`mod@house`] | what arrives -> maps, tick after tick |
//! | [`mod@street`] | what sensors send -> what arrives at the door, through bad networks |
//! | [`mod@readers`] | the newest map -> readers of every kind, at the server's own streams |
//! | [`tape`] | the server's own recorder -> a disk that fails as told, verified |
//! | [`mod@ending`] | the run's end -> everything accounted for |
//! | [`checks`] | what must be true |
//!
//! Faults end at [`fate::HEAL_NS`]; by [`fate::END_NS`] everything must be as if nothing had been.

use std::fmt;

use checks::Breach;
use drive::drives;
use fate::Fate;
use house::House;

pub mod checks;
pub mod drive;
mod ending;
pub mod fate;
mod house;
pub mod readers;
mod street;
pub mod tape;
pub mod trouble;

/// From one step of the run to the next.
const TICK_NS: i64 = 10_000_000;
/// How much the machine's death may cost of the recording.
const FLUSH_MS: u64 = 200;
/// After the faults have ended, every sensor is whole and in the map within so many turns.
pub const TURNS_TO_HEAL: i64 = 4;

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
