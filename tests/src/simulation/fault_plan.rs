//! A seed -> the faults of one run, and when each occurs. Times are ns after the beginning of the run.

use std::fmt;
use std::ops::Range;

use clearway_sim::impair::Faults;
use clearway_sim::noise::{mixed, uniform};

/// Period of the rotating sensors, in ns.
pub const REVOLUTION_NS: i64 = 100_000_000;
/// Time at which all faults end.
pub const HEAL_NS: i64 = 18 * REVOLUTION_NS;
/// Time at which the run ends.
pub const END_NS: i64 = HEAL_NS + 10 * REVOLUTION_NS;

/// Least time between a jump of a device's counter and a step of the host's clock, in ns. If both fell between the same
/// two packets, no clock would measure the time that passed. The longest burst of loss is shorter than this.
const JUMP_GAP_NS: i64 = 3 * REVOLUTION_NS;

/// Simulated time between two steps of the run, in ns.
pub(super) const TICK_NS: i64 = 10_000_000;
/// Flush interval of the recorder, in ms: what a crash of the machine may cost of the recording.
pub(super) const FLUSH_MS: u64 = 200;

/// Warm-up of a new pipeline before a keyframe, in ms: six revolutions.
pub(super) const WARM_UP_MS: u64 = 600;

/// A fault of the system itself, injected to show that a check finds it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InjectedFault {
    /// A datagram disappears between socket and event queue, uncounted.
    UncountedDatagram,
    /// A reader gets a map without its last byte.
    CorruptMap,
    /// A reader gets 0 as its count of skipped maps.
    UnreportedSkips,
    /// A reader is never polled again.
    StalledReader,
    /// Every cell gets the class that means free.
    FreedCells,
    /// An event is processed and not recorded.
    UnrecordedEvent,
    /// A bit of the recording changes on the disk.
    CorruptRecording,
    /// The outcome of an observation is not delivered.
    LostOutcome,
    /// A sensor sends nothing more, and does not recover.
    SilentSensor,
    /// The stamp of a map equals the stamp of the map before.
    StuckStamp,
}

/// A deterministic random number generator.
#[derive(Clone, Debug)]
pub struct Rng(u64);

impl Rng {
    /// Equal keys give equal sequences.
    pub fn new(key: u64) -> Self {
        Self(mixed(key))
    }

    /// A number from the whole range of 64 bits.
    pub fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(1);
        mixed(self.0)
    }

    /// A number from 0 to 1.
    pub fn share(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(1);
        uniform(self.0)
    }

    /// A number from a range, which must not be empty.
    pub fn within(&mut self, range: Range<i64>) -> i64 {
        range.start + (self.share() * (range.end - range.start) as f64) as i64
    }

    /// True with this probability.
    pub fn happens(&mut self, chance: f64) -> bool {
        self.share() < chance
    }
}

/// Faults of one sensor itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorFault {
    /// While it sends nothing.
    pub silent: Option<Range<i64>>,
    /// Time of a restart, and microseconds by which the device's clock is ahead from then on. The GPS receiver has no
    /// fix.
    pub restart: Option<(i64, u32)>,
}

/// Fault of the disk that holds the recording.
#[derive(Clone, Debug, PartialEq)]
pub enum DiskFault {
    /// The recording is written and closed.
    Sound,
    /// The machine crashes at this time, and of what was not synced the disk has at most this many bytes of each file.
    Crash(i64, usize),
    /// The disk is full after so many bytes.
    Full(usize),
    /// One write fails after so many bytes, and no other.
    Hiccup(usize),
}

/// All faults of one run.
#[derive(Clone, Debug, PartialEq)]
pub struct FaultPlan {
    /// Seed of the plan.
    pub seed: u64,
    /// Index of the drive.
    pub drive: usize,
    /// Offset in the drive at which the run begins, in ns.
    pub offset_ns: i64,
    /// True if every layer is made, not only the cheap layers.
    pub all_maps: bool,
    /// Faults of the network of each rotating sensor.
    pub networks: Vec<Faults>,
    /// Faults of each sensor.
    pub sensor_faults: Vec<SensorFault>,
    /// A sector (ego frame, degrees counter-clockwise) in which the windows of all sensors are covered, and when.
    pub covered: Option<(Range<i64>, Range<i64>)>,
    /// When the host's clock is ahead, and by how many ns.
    pub host_clock: Option<(Range<i64>, i64)>,
    /// Invalid datagrams and observations sent in one tick, on average.
    pub garbage: f64,
    /// Length of the event queue.
    pub queue: usize,
    /// While the engine processes nothing.
    pub engine_stall: Option<Range<i64>>,
    /// While the recorder writes nothing.
    pub recorder_stall: Option<Range<i64>>,
    /// Length of the recorder's queue.
    pub recorder_queue: usize,
    /// Fault of the disk.
    pub disk: DiskFault,
    /// True if the recording has parts of one second.
    pub parts: bool,
}

impl FaultPlan {
    /// Draws the faults of a car with `rotating` sensors among `sensors` in all.
    pub fn from_seed(seed: u64, drives: usize, rotating: usize, sensors: usize) -> Self {
        let mut rng = Rng::new(seed);
        let covered = rng.happens(0.3).then(|| {
            let from_deg = rng.within(0..360);
            (from_deg..from_deg + rng.within(60..120), 9 * REVOLUTION_NS..HEAL_NS)
        });
        // A flipped bit would make a return where the window is covered, and a clock step would move the revolutions.
        let plain = covered.is_some();
        let networks: Vec<Faults> = (0..rotating).map(|_| network(&mut rng, plain)).collect();
        let during = |rng: &mut Rng, longest_ns| {
            let from_ns = rng.within(2 * REVOLUTION_NS..HEAL_NS - REVOLUTION_NS);
            from_ns..(from_ns + rng.within(1..longest_ns)).min(HEAL_NS)
        };
        let fault = |rng: &mut Rng| {
            let silent = rng.happens(0.25).then(|| during(rng, HEAL_NS));
            let restarts = !plain && silent.is_none() && rng.happens(0.15);
            let restart = || (rng.within(2 * REVOLUTION_NS..HEAL_NS), rng.within(0..3_600_000_000) as u32);
            SensorFault { silent, restart: restarts.then(restart) }
        };
        let sensor_faults: Vec<SensorFault> = (0..sensors).map(|_| fault(&mut rng)).collect();
        let host_clock = (!plain && rng.happens(0.35)).then(|| {
            let step_ns = if rng.happens(0.5) { 3_600_000_000_000 } else { 2_000_000_000 };
            let step_ns = if rng.happens(0.5) { step_ns } else { -step_ns };
            let when = during(&mut rng, HEAL_NS);
            (when.start..when.end.min(HEAL_NS - 2 * JUMP_GAP_NS), step_ns)
        });
        // A device's counter jumps at its restart, and when its GPS receiver has a fix again after the faults.
        let jumps = || sensor_faults.iter().filter_map(|fault| fault.restart.map(|(at_ns, _)| at_ns)).chain([HEAL_NS]);
        let is_apart = |at_ns: i64| jumps().all(|jump_ns| (at_ns - jump_ns).abs() > JUMP_GAP_NS);
        let host_clock = host_clock.filter(|(when, _)| !when.is_empty() && is_apart(when.start) && is_apart(when.end));
        let disk = match rng.within(0..10) {
            0..5 => DiskFault::Sound,
            5..7 => DiskFault::Crash(
                rng.within(REVOLUTION_NS..END_NS),
                if rng.happens(0.5) { rng.within(0..5000) as usize } else { 0 },
            ),
            7..9 => DiskFault::Full(rng.within(20_000..3_000_000) as usize),
            _ => DiskFault::Hiccup(rng.within(20_000..3_000_000) as usize),
        };
        Self {
            seed,
            drive: rng.within(0..drives as i64) as usize,
            offset_ns: rng.within(0..REVOLUTION_NS),
            all_maps: rng.happens(0.05),
            networks,
            sensor_faults,
            covered,
            host_clock,
            garbage: if rng.happens(0.4) { rng.share() } else { 0.0 },
            queue: if rng.happens(0.3) { rng.within(64..512) as usize } else { 8192 },
            engine_stall: rng.happens(0.3).then(|| during(&mut rng, 3 * REVOLUTION_NS)),
            recorder_stall: rng.happens(0.15).then(|| during(&mut rng, HEAL_NS)),
            recorder_queue: if rng.happens(0.5) { 16_384 } else { rng.within(400..1500) as usize },
            disk,
            parts: rng.happens(0.3),
        }
    }
}

fn network(rng: &mut Rng, plain: bool) -> Faults {
    let mut rarely = |chance: f64, most: f64| if rng.happens(chance) { rng.share() * most } else { 0.0 };
    Faults {
        loss: rarely(0.4, 0.3),
        burst: rarely(0.2, 0.01),
        duplicate: rarely(0.3, 0.5),
        truncate: rarely(0.2, 0.1),
        flip: if plain { 0.0 } else { rarely(0.15, 0.05) },
        burst_packets: rng.within(1..200) as u32,
        reorder: if rng.happens(0.3) { rng.within(1..33) as u32 } else { 0 },
        delay_ns: if rng.happens(0.3) { rng.within(0..5_000_000) } else { 0 },
        seed: rng.draw(),
    }
}

impl fmt::Display for FaultPlan {
    /// All faults in one line, to stand beside a failure.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}
