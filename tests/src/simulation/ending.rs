//! The end of a run: every reading has its place and every observation its verdict, and the recording is verified.

use std::hash::{DefaultHasher, Hasher};
use std::sync::atomic::Ordering;

use super::checks::{Breach, accounts, adds_up, breach, describe};
use super::fate::{DiskFate, HEAL_NS, TURN_NS};
use super::house::House;
use super::readers::Reader;
use super::tape::Recorded;
use super::{FLUSH_MS, Outcome, Plant, TICK_NS, TURNS_TO_HEAL};

impl House<'_> {
    /// Everything ends in order, and must be as if nothing had been.
    pub fn end(mut self) -> Result<Outcome, Breach> {
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
        self.door.report_drops(None).map_err(|closed| breach("ledger", closed.to_string()))?;
        self.step()?;
        self.engine.update_status();
        let snapshot = self.vehicles.0[0].status.snapshot();
        accounts(self.offered, &snapshot.ledger, &snapshot.sensors)?;
        adds_up("in the end, the core", self.engine.pipeline.ledger())?;
        self.observe();
        if !self.account.is_idle() || !self.waiting.is_empty() {
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
        while scribe.write_next(now) {}
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
