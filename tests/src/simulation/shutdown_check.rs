//! The end of a run: every reading is accounted for, every observation has its outcome, and the recording is verified.

use std::hash::{DefaultHasher, Hasher};
use std::sync::atomic::Ordering;

use super::checks::{Violation, accounts, adds_up, describe, violation};
use super::fault_plan::{HEAL_NS, InjectedFault, REVOLUTION_NS};
use super::readers::SimulatedReader;
use super::recording_check::Recorded;
use super::test_bed::TestBed;

/// After the faults have ended, every sensor must be whole and in the map within this many revolutions.
pub const REVOLUTIONS_TO_HEAL: i64 = 4;

/// After the faults have ended, the newest map must be fresh within this many revolutions: a planner's clock and the
/// stamps agree again.
pub const REVOLUTIONS_TO_FRESH: i64 = 8;

/// A run without a violation.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Simulated time, in ns.
    pub simulated_ns: i64,
    /// Events that the engine processed.
    pub events: u64,
    /// Maps that the engine made.
    pub maps: u64,
    /// Readings that the engine refused.
    pub refused: u64,
    /// Readings lost because the event queue was full.
    pub lost: u64,
    /// Maps that readers received, and maps reported to them as skipped.
    pub read: (u64, u64),
    /// Revolutions from the end of the faults until every sensor was whole again.
    pub healed_in: i64,
    /// Revolutions from the end of the faults until the newest map was fresh.
    pub fresh_in: i64,
    /// True if the recording holds every event and map.
    pub recorded: bool,
    /// Hash of every map and of the recording.
    pub digest: u64,
}

impl TestBed<'_> {
    /// Shuts the system down in order, and checks that it has recovered.
    pub fn end(mut self) -> Result<Outcome, Violation> {
        let revolutions = |at_ns: i64| ((at_ns - HEAL_NS).max(0) + REVOLUTION_NS - 1) / REVOLUTION_NS;
        let healed_in = revolutions(self.unhealthy_ns);
        let last = self.engine.pipeline.newest_map().map(describe).unwrap_or_default();
        if healed_in > REVOLUTIONS_TO_HEAL {
            return Err(violation(
                "converge",
                format!("not whole {healed_in} revolutions after the end of the faults: {last}"),
            ));
        }
        let fresh_in = revolutions(self.stale_ns);
        if fresh_in > REVOLUTIONS_TO_FRESH {
            let found = format!("not fresh {fresh_in} revolutions after the end of the faults: {last}");
            return Err(violation("fresh", found));
        }
        let newest_ns = self.engine.pipeline.newest_map().map_or(0, |map| map.completed_ns);
        if self.clock.load(Ordering::Relaxed) - newest_ns > 2 * REVOLUTION_NS {
            return Err(violation("converge", format!("no map for two revolutions: {last}")));
        }
        self.queue.report_drops(None).map_err(|closed| violation("ledger", closed.to_string()))?;
        self.step()?;
        self.engine.update_status();
        let snapshot = self.vehicles.0[0].status.snapshot();
        accounts(self.offered, &snapshot.ledger, &snapshot.sensors)?;
        adds_up("at the end, the core", self.engine.pipeline.ledger())?;
        self.observe();
        if !self.session.is_idle() || !self.waiting.is_empty() {
            let events = self.session.events();
            let found = format!("{events} events without an outcome, {} observations still wait", self.waiting.len());
            return Err(violation("outcomes", found));
        }
        let mut hasher = DefaultHasher::new();
        for map in &self.maps {
            hasher.write(&map.select(&[]));
        }
        let sum = |of: &dyn Fn(&SimulatedReader) -> u64| self.readers.iter().map(of).sum();
        let outcome = Outcome {
            simulated_ns: self.now_ns,
            events: self.taken,
            maps: self.maps.len() as u64,
            refused: snapshot.refused(),
            lost: snapshot.ledger.lost,
            read: (sum(&|reader| reader.updates), sum(&|reader| reader.skipped)),
            healed_in,
            fresh_in,
            ..Outcome::default()
        };
        self.check_recording(outcome, hasher)
    }

    /// Closes the recording and verifies it.
    fn check_recording(self, outcome: Outcome, mut hasher: DefaultHasher) -> Result<Outcome, Violation> {
        let now = self.instant();
        let layers = self.maps.first().map_or(0, |map| map.layers.len() as u64);
        let Some(mut writer) = self.writer else { return Ok(Outcome { digest: hasher.finish(), ..outcome }) };
        // Ends the queue of the recorder.
        drop(self.engine);
        while writer.write_next(now) {}
        let counts = writer.counts();
        writer.finish();
        let mut recorded = self.recorded_at_crash.unwrap_or_else(|| {
            let expected = Some((self.taken, outcome.maps * layers));
            let (durable, lost) = (counts.durable_events("car"), counts.lost());
            Recorded { files: self.disk.files(), counts, expected, durable, lost }
        });
        if let (Some(InjectedFault::CorruptRecording), Some(file)) = (self.injected, recorded.files.get_mut(&1)) {
            let middle = file.bytes.len() / 2;
            file.bytes[middle] ^= 1;
        }
        recorded.files.values().for_each(|file| hasher.write(&file.bytes));
        let recorded = recorded.check()?;
        Ok(Outcome { recorded, digest: hasher.finish(), ..outcome })
    }
}
