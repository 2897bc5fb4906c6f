//! Copies of the vehicles at some moments of a replay, from which a jump begins.

use super::vehicle::VehicleCopy;

/// Most copies. Ours: one has about 20 MB with an HDL-64E and all layers, and a jump makes at most a sixteenth of the
/// drive again.
const COPIES_MAX: usize = 16;
/// Recorded time between two copies of a short drive. Ours: a jump is then made within a second.
const PERIOD_NS: i64 = 1_000_000_000;

/// The state of all vehicles after a number of readings.
pub struct Snapshot {
    /// Recorded time of the newest of these readings.
    pub at_ns: i64,
    /// Number of readings.
    pub readings: u64,
    /// State of each vehicle.
    pub vehicles: Vec<VehicleCopy>,
}

/// The copies of one replay, in order; the first is that before the first reading.
pub struct Snapshots {
    copies: Vec<Snapshot>,
    period_ns: i64,
}

impl Snapshots {
    /// Only the state before the first reading.
    pub fn new(vehicles: Vec<VehicleCopy>) -> Self {
        Self { copies: vec![Snapshot { at_ns: i64::MIN, readings: 0, vehicles }], period_ns: PERIOD_NS }
    }

    /// True if a copy at this moment is worth its memory.
    pub fn is_due(&self, at_ns: i64, readings: u64) -> bool {
        let last = self.copies.last();
        last.is_none_or(|last| readings > last.readings && at_ns.saturating_sub(last.at_ns) >= self.period_ns)
    }

    /// Adds a copy. If there are too many, every second copy is dropped, and later copies are farther apart.
    pub fn add(&mut self, snapshot: Snapshot) {
        self.copies.push(snapshot);
        if self.copies.len() > COPIES_MAX {
            let mut index = 0;
            self.copies.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.period_ns *= 2;
        }
    }

    /// The newest copy that has no reading after `at_ns`.
    pub fn before(&self, at_ns: i64) -> &Snapshot {
        let place = self.copies.partition_point(|copy| copy.at_ns <= at_ns);
        &self.copies[place.saturating_sub(1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_thin_out_and_the_first_stays() {
        let mut snapshots = Snapshots::new(Vec::new());
        for readings in 1..=1000_u64 {
            let at_ns = readings as i64 * 1_000_000_000;
            if snapshots.is_due(at_ns, readings) {
                snapshots.add(Snapshot { at_ns, readings, vehicles: Vec::new() });
            }
        }
        assert!(snapshots.copies.len() <= COPIES_MAX);
        assert_eq!(snapshots.before(0).readings, 0);
        let before = snapshots.before(700_000_000_000);
        assert!((600..=700).contains(&before.readings), "{}", before.readings);
        assert!(!snapshots.is_due(700_000_000_000, 700), "an earlier moment needs no further copy");
    }
}
