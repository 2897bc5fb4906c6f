//! A seed -> everything that will go wrong in one run, and when. Times are ns after the run's beginning.

use std::fmt;
use std::ops::Range;

use clearway_sim::impair::Faults;
use clearway_sim::noise::{mixed, uniform};

/// From one turn of the turning sensors to the next, ns.
pub const TURN_NS: i64 = 100_000_000;
/// Faults end here.
pub const HEAL_NS: i64 = 18 * TURN_NS;
/// The run ends here.
pub const END_NS: i64 = HEAL_NS + 10 * TURN_NS;

/// Where a device's counter jumps between the same two packets as the host's clock is set, nobody tells how much time
/// has passed, and stamps that went ahead are held (`clearway_lidar::clock`). The longest burst of loss lasts less than
/// this.
const APART_NS: i64 = 3 * TURN_NS;

/// Chance, draw after draw.
#[derive(Clone, Debug)]
pub struct Dice(u64);

impl Dice {
    /// The same key draws the same.
    pub fn new(key: u64) -> Self {
        Self(mixed(key))
    }

    /// A well mixed number.
    pub fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(1);
        mixed(self.0)
    }

    /// 0 to 1.
    pub fn share(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(1);
        uniform(self.0)
    }

    /// One number of a range that is not empty.
    pub fn of(&mut self, range: Range<i64>) -> i64 {
        range.start + (self.share() * (range.end - range.start) as f64) as i64
    }

    /// Whether something of this chance happens.
    pub fn happens(&mut self, chance: f64) -> bool {
        self.share() < chance
    }
}

/// What happens to one sensor itself.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trouble {
    /// Nothing comes.
    pub silent: Option<Range<i64>>,
    /// From here on the device's clock is ahead by so many microseconds, and its receiver has lost the satellites.
    pub restart: Option<(i64, u32)>,
}

/// What becomes of the recording.
#[derive(Clone, Debug, PartialEq)]
pub enum DiskFate {
    /// It is written and closed.
    Sound,
    /// The machine dies at this time; with so many of the last bytes torn off.
    Crash(i64, usize),
    /// The disk is full after so many bytes.
    Full(usize),
    /// One write fails after so many bytes, and never another.
    Hiccup(usize),
}

/// Everything that goes wrong in one run.
#[derive(Clone, Debug, PartialEq)]
pub struct Fate {
    /// What it was all drawn from.
    pub seed: u64,
    /// Which of the drives.
    pub drive: usize,
    /// Where in the drive the run begins, ns.
    pub offset_ns: i64,
    /// Every map is made, and not only the cheap ones.
    pub all_maps: bool,
    /// Of each turning sensor's network.
    pub networks: Vec<Faults>,
    /// Of each sensor.
    pub troubles: Vec<Trouble>,
    /// A sector (ego frame, degrees counter-clockwise) that all sensors' windows are covered in, and when.
    pub covered: Option<(Range<i64>, Range<i64>)>,
    /// The host's clock is ahead by this, and when.
    pub host_clock: Option<(Range<i64>, i64)>,
    /// Datagrams that are none, a tick.
    pub garbage: f64,
    /// Events that may wait for the engine.
    pub queue: usize,
    /// The engine does nothing.
    pub engine_stall: Option<Range<i64>>,
    /// The recorder does nothing.
    pub recorder_stall: Option<Range<i64>>,
    /// Entries that may wait for the recorder.
    pub recorder_queue: usize,
    /// What becomes of the recording.
    pub disk: DiskFate,
}

impl Fate {
    /// What this seed has in store for a car with so many turning sensors and so many sensors in all.
    pub fn of(seed: u64, drives: usize, turning: usize, sensors: usize) -> Self {
        let mut dice = Dice::new(seed);
        let covered = dice.happens(0.3).then(|| {
            let from_deg = dice.of(0..360);
            (from_deg..from_deg + dice.of(60..120), 9 * TURN_NS..HEAL_NS)
        });
        // A flipped bit makes a return where the window is covered, and a clock that jumps moves the turns.
        let plain = covered.is_some();
        let networks: Vec<Faults> = (0..turning).map(|_| network(&mut dice, plain)).collect();
        let during = |dice: &mut Dice, longest_ns| {
            let from_ns = dice.of(2 * TURN_NS..HEAL_NS - TURN_NS);
            from_ns..(from_ns + dice.of(1..longest_ns)).min(HEAL_NS)
        };
        let trouble = |dice: &mut Dice| {
            let silent = dice.happens(0.25).then(|| during(dice, HEAL_NS));
            let restarts = !plain && silent.is_none() && dice.happens(0.15);
            let restart = || (dice.of(2 * TURN_NS..HEAL_NS), dice.of(0..3_600_000_000) as u32);
            Trouble { silent, restart: restarts.then(restart) }
        };
        let troubles: Vec<Trouble> = (0..sensors).map(|_| trouble(&mut dice)).collect();
        let host_clock = (!plain && dice.happens(0.35)).then(|| {
            let step_ns = if dice.happens(0.5) { 3_600_000_000_000 } else { 2_000_000_000 };
            let step_ns = if dice.happens(0.5) { step_ns } else { -step_ns };
            let when = during(&mut dice, HEAL_NS);
            (when.start..when.end.min(HEAL_NS - 2 * APART_NS), step_ns)
        });
        // A device's counter jumps when it is restarted, and when its receiver is back after the faults.
        let jumps = || troubles.iter().filter_map(|trouble| trouble.restart.map(|(at_ns, _)| at_ns)).chain([HEAL_NS]);
        let is_apart = |at_ns: i64| jumps().all(|jump_ns| (at_ns - jump_ns).abs() > APART_NS);
        let host_clock = host_clock.filter(|(when, _)| !when.is_empty() && is_apart(when.start) && is_apart(when.end));
        let disk = match dice.of(0..10) {
            0..5 => DiskFate::Sound,
            5..7 => {
                DiskFate::Crash(dice.of(TURN_NS..END_NS), if dice.happens(0.5) { dice.of(0..5000) as usize } else { 0 })
            }
            7..9 => DiskFate::Full(dice.of(20_000..3_000_000) as usize),
            _ => DiskFate::Hiccup(dice.of(20_000..3_000_000) as usize),
        };
        Self {
            seed,
            drive: dice.of(0..drives as i64) as usize,
            offset_ns: dice.of(0..TURN_NS),
            all_maps: dice.happens(0.05),
            networks,
            troubles,
            covered,
            host_clock,
            garbage: if dice.happens(0.4) { dice.share() } else { 0.0 },
            queue: if dice.happens(0.3) { dice.of(64..512) as usize } else { 8192 },
            engine_stall: dice.happens(0.3).then(|| during(&mut dice, 3 * TURN_NS)),
            recorder_stall: dice.happens(0.15).then(|| during(&mut dice, HEAL_NS)),
            recorder_queue: if dice.happens(0.5) { 16_384 } else { dice.of(400..1500) as usize },
            disk,
        }
    }
}

fn network(dice: &mut Dice, plain: bool) -> Faults {
    let mut rarely = |chance: f64, most: f64| if dice.happens(chance) { dice.share() * most } else { 0.0 };
    Faults {
        loss: rarely(0.4, 0.3),
        burst: rarely(0.2, 0.01),
        duplicate: rarely(0.3, 0.5),
        truncate: rarely(0.2, 0.1),
        flip: if plain { 0.0 } else { rarely(0.15, 0.05) },
        burst_packets: dice.of(1..200) as u32,
        reorder: if dice.happens(0.3) { dice.of(1..33) as u32 } else { 0 },
        delay_ns: if dice.happens(0.3) { dice.of(0..5_000_000) } else { 0 },
        seed: dice.draw(),
    }
}

impl fmt::Display for Fate {
    /// As it would be wanted beside a failure.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}
