//! Steps of the clock of one input, from the stamps and the event times of its messages.
//!
//! A stamp less its event time is the offset of the input's clock, less the delay of the message. Both change it. If a
//! message is late, its event time is uneven and the stamps go on evenly; if the clock steps, the stamp is uneven and
//! the event times go on evenly. While messages come much faster or slower than they are stamped (a drive that is sent
//! at another speed), neither is known, and no step is found.

use std::collections::VecDeque;

/// Least step that is found, ns. Ours: the delays of messages differ by less, and at 10 m/s the vehicle moves by half a
/// metre.
const STEP_NS_MIN: u64 = 50_000_000;
/// Number of messages by which the next one is judged. Ours: an outage is out of the window after a second at 10 Hz.
const WINDOW: usize = 8;
/// Least number of messages by which the next one is judged.
const WINDOW_MIN: usize = 3;
/// Number of poses in a row that go back which make a step of the stamps. Ours: one pose that was overtaken on its way
/// makes none.
const STEP_POSES: u32 = 2;
/// Share by which the greatest offset falls as time passes: faster than clocks drift, so that it stays near the newest
/// offsets.
const LEAK_PARTS: i64 = 1000;
/// Share of the time that passes by which the steady offset follows the offset. Ours: stamps that run ahead by a third
/// of a second in four seconds, and then go back, move it by less than a step.
const STEADY_PARTS: i64 = 100;

/// The stamp of a message, and the event time at which it arrived, ns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ClockReading {
    pub stamp_ns: i64,
    pub event_ns: i64,
}

impl ClockReading {
    /// How far another stamp of the same clock is from the stamp that this reading lets expect at its event time, ns.
    fn distance_ns(&self, other: &Self) -> u64 {
        let expected_ns = self.stamp_ns.saturating_add(other.event_ns.saturating_sub(self.event_ns));
        other.stamp_ns.abs_diff(expected_ns)
    }

    /// Stamp and event time since another reading, ns.
    fn since(&self, before: &Self) -> (i64, i64) {
        (self.stamp_ns.saturating_sub(before.stamp_ns), self.event_ns.saturating_sub(before.event_ns))
    }
}

/// The clock of one input.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct StampClock {
    /// The newest messages in the order of their arrival; stamps from before a step are moved by it.
    window: VecDeque<ClockReading>,
    /// Offset of the messages with the least delay, ns.
    offset_ns: i64,
    /// The offset as it stood for long; a step is measured from it.
    steady_ns: i64,
    /// The steady offset before the clock stepped; `None` if it has not stepped, or has stepped back to this offset.
    before_ns: Option<i64>,
}

impl StampClock {
    /// How far the clock has stepped since its first message, ns; 0 if it has stepped back.
    pub fn step_ns(&self) -> i64 {
        self.before_ns.map_or(0, |before_ns| self.offset_ns.saturating_sub(before_ns))
    }

    /// Notes a message, accepted or refused for its stamp.
    pub fn note(&mut self, now: ClockReading) {
        let offset_ns = now.stamp_ns.saturating_sub(now.event_ns);
        let step_ns = offset_ns.saturating_sub(self.offset_ns);
        match self.window.back() {
            None => (self.offset_ns, self.steady_ns) = (offset_ns, offset_ns),
            Some(newest) if self.is_step(now, newest, step_ns) => {
                self.before_ns.get_or_insert(self.steady_ns);
                (self.offset_ns, self.steady_ns) = (offset_ns, offset_ns);
                self.window.iter_mut().for_each(|reading| reading.stamp_ns = reading.stamp_ns.saturating_add(step_ns));
            }
            Some(newest) => {
                let (_, passed_ns) = now.since(newest);
                self.offset_ns = offset_ns.max(self.offset_ns.saturating_sub(passed_ns / LEAK_PARTS));
                // The first messages may have waited: the offset is the one without delay after some of them.
                let follows_ns = if self.window.len() < WINDOW { i64::MAX } else { passed_ns.max(0) / STEADY_PARTS };
                let behind_ns = self.offset_ns.saturating_sub(self.steady_ns);
                self.steady_ns = self.steady_ns.saturating_add(behind_ns.clamp(-follows_ns, follows_ns));
            }
        }
        // The clock has stepped back, or messages with less delay show that it had not stepped.
        self.before_ns = self.before_ns.filter(|before_ns| before_ns.abs_diff(self.offset_ns) > STEP_NS_MIN);
        if self.window.len() == WINDOW {
            self.window.pop_front();
        }
        self.window.push_back(now);
    }

    /// True if the offset has changed by `step_ns` because the clock has stepped.
    fn is_step(&self, now: ClockReading, newest: &ClockReading, step_ns: i64) -> bool {
        let Some(spacing_ns) = self.spacing_ns() else { return false };
        let (stamped_ns, passed_ns) = now.since(newest);
        let uneven_ns = stamped_ns.saturating_sub(passed_ns);
        step_ns.unsigned_abs() > STEP_NS_MIN
            && uneven_ns.abs_diff(step_ns) <= step_ns.unsigned_abs() / 2
            && passed_ns.abs_diff(spacing_ns) <= stamped_ns.abs_diff(spacing_ns) / 2
    }

    /// Median time from one stamp to the next, ns; `None` if it is not known, or if time passes otherwise.
    fn spacing_ns(&self) -> Option<i64> {
        let (first, newest) = (self.window.front()?, self.window.back()?);
        let (stamped_ns, passed_ns) = newest.since(first);
        if self.window.len() < WINDOW_MIN || !(stamped_ns / 2..=stamped_ns.saturating_mul(2)).contains(&passed_ns) {
            return None;
        }
        let mut spacings = [0; WINDOW - 1];
        let pairs = self.window.iter().zip(self.window.iter().skip(1));
        spacings.iter_mut().zip(pairs).for_each(|(spacing, (before, after))| *spacing = after.since(before).0);
        let spacings = &mut spacings[..self.window.len() - 1];
        spacings.sort_unstable();
        Some(spacings[spacings.len() / 2])
    }
}

/// Poses in a row whose stamps are older than the newest pose.
#[derive(Clone, Copy, Debug, PartialEq)]
struct StepBack {
    poses: u32,
    /// The newest of them.
    at: ClockReading,
}

/// The clock of the poses.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct PoseClock {
    clock: StampClock,
    /// How far the clock had stepped at the newest pose that is kept, ns.
    step_ns: i64,
    /// The newest pose that is kept.
    newest: Option<ClockReading>,
    /// The poses since then that were refused because their stamps are older.
    step_back: Option<StepBack>,
}

impl PoseClock {
    /// How far the clock of the poses that are kept has stepped since its first pose, ns; 0 if it has stepped back.
    pub fn step_ns(&self) -> i64 {
        self.step_ns
    }

    /// Forgets the poses, and not the clock.
    pub fn forget_poses(&mut self) {
        (self.newest, self.step_back) = (None, None);
    }

    /// Notes a pose that is kept.
    pub fn note(&mut self, pose: ClockReading) {
        self.clock.note(pose);
        (self.step_ns, self.newest, self.step_back) = (self.clock.step_ns(), Some(pose), None);
    }

    /// Notes a pose that was refused because its stamp is older than the newest one.
    pub fn note_refused(&mut self, pose: ClockReading) {
        self.clock.note(pose);
        let before = self.step_back.filter(|before| before.at.stamp_ns < pose.stamp_ns);
        self.step_back = Some(StepBack { poses: before.map_or(0, |before| before.poses) + 1, at: pose });
    }

    /// The newest refused pose, if the stamps of the poses have stepped back: several poses in a row are older than the
    /// newest one and newer than each other. A pose that was overtaken comes alone.
    pub fn stepped_back(&self) -> Option<ClockReading> {
        self.step_back.filter(|step| step.poses >= STEP_POSES).map(|step| step.at)
    }

    /// True if the stamps of the poses have stepped back, and the stamp of this scan is nearer to the refused poses
    /// than to the poses before them.
    pub fn has_stepped_back_with(&self, scan: ClockReading) -> bool {
        let (after, before) = (self.stepped_back(), self.newest);
        after.zip(before).is_some_and(|(after, before)| after.distance_ns(&scan) < before.distance_ns(&scan))
    }
}

/// The clock of a sensor's scans.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ScanClock {
    /// Of the first points, and of the last points.
    ends: [StampClock; 2],
    /// How far the clock of the poses had stepped when a scan first had a pose, ns; `None` before.
    agreed_ns: Option<i64>,
}

impl ScanClock {
    /// Notes a scan by the stamps of its first and its last point. A step is what both ends show, because where a scan
    /// begins and ends depends on its surroundings too.
    pub fn note(&mut self, stamps_ns: [i64; 2], event_ns: i64) {
        for (end, stamp_ns) in self.ends.iter_mut().zip(stamps_ns) {
            end.note(ClockReading { stamp_ns, event_ns });
        }
    }

    /// How far the clock has stepped since it agreed with the clock of the poses, or since the first scan, ns; 0 if it
    /// has stepped back.
    pub fn step_ns(&self) -> i64 {
        let [first_ns, last_ns] = [self.ends[0].step_ns(), self.ends[1].step_ns()];
        let step_ns = if first_ns.unsigned_abs() < last_ns.unsigned_abs() { first_ns } else { last_ns };
        step_ns.saturating_add(self.agreed_ns.unwrap_or(0))
    }

    /// Notes that there is a pose at the stamp of a scan, and how far the clock of the poses has stepped, ns. If it is
    /// the first such scan, the clocks agree since a step: a clock that was wrong at first has been set right.
    pub fn note_pose(&mut self, pose_step_ns: i64) {
        if self.agreed_ns.is_none() {
            self.agreed_ns = Some(pose_step_ns);
            self.ends.iter_mut().for_each(|end| end.before_ns = None);
        }
    }
}

/// True if two clocks that agreed agree after these steps, ns.
pub(super) fn agree(a_step_ns: i64, b_step_ns: i64) -> bool {
    a_step_ns.abs_diff(b_step_ns) <= STEP_NS_MIN
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_of_the_clock_is_found_and_a_delay_is_none() {
        // Message i of 60, ten a second: its stamp and its event time in ms; `None` if it is lost.
        type Make = fn(i64) -> Option<(i64, i64)>;
        let cases: [(&str, i64, Make); 17] = [
            ("none", 0, |i| Some((100 * i, 100 * i + 30))),
            ("jitter", 0, |i| Some((100 * i, 100 * i + 37 * i % 45))),
            ("an outage", 0, |i| Some((100 * i, if (20..25).contains(&i) { 2500 + i } else { 100 * i }))),
            ("a delay that lasts", 0, |i| Some((100 * i, 100 * i + if i < 20 { 30 } else { 230 }))),
            ("bursts", 0, |i| Some((100 * i, 100 * (i / 4 * 4 + 3) + i % 4))),
            ("a loss", 0, |i| (!(20..24).contains(&i)).then_some((100 * i, 100 * i))),
            ("a loss in an outage", 0, |i| {
                (!(20..24).contains(&i)).then_some((100 * i, if (16..20).contains(&i) { 2500 + i } else { 100 * i }))
            }),
            ("ten times the speed, with losses", 0, |i| (i % 9 != 8 && i % 9 != 7).then_some((100 * i, 10 * i))),
            ("drift", 0, |i| Some((100 * i, 99 * i))),
            ("one wrong stamp", 0, |i| Some((100 * i + if i == 20 { 300 } else { 0 }, 100 * i))),
            ("ahead and back", 0, |i| Some((100 * i + if (20..40).contains(&i) { 300 } else { 0 }, 100 * i))),
            ("runs ahead and steps back", 0, |i| {
                Some((100 * i + if (20..30).contains(&i) { 34 * (i - 20) } else { 0 }, 100 * i))
            }),
            ("runs ahead with gaps and steps back", 0, |i| {
                let ahead = if (20..30).contains(&i) { 34 * (i - 20) } else { 0 };
                (!(24..26).contains(&i)).then_some((100 * i + ahead, 100 * i))
            }),
            ("back by a spacing", -100, |i| Some((100 * i - if i < 20 { 0 } else { 100 }, 100 * i))),
            ("ahead, with jitter", 100, |i| Some((100 * i + if i < 20 { 0 } else { 100 }, 100 * i + 37 * i % 45))),
            ("back by 20 s", -20_000, |i| Some((100 * i - if i < 3 { 0 } else { 20_000 }, 100 * i))),
            ("twice", 250, |i| Some((100 * i + i / 20 * 125, 100 * i + 30))),
        ];
        for (what, step_ms, make) in cases {
            let mut clock = StampClock::default();
            for (stamp_ms, event_ms) in (0..60).filter_map(make) {
                clock.note(ClockReading { stamp_ns: stamp_ms * 1_000_000, event_ns: event_ms * 1_000_000 });
            }
            let found_ms = clock.step_ns() / 1_000_000;
            assert!((found_ms - step_ms).abs() <= 20, "{what}: {found_ms} ms, not {step_ms} ms");
        }
    }
}
