//! The state of a running demo, once a second and at its end.
//!
//! In: the vehicle's status, the car's skipped time. Out: a line for people.

use std::time::Duration;

use clearway_sim::send::Sent;

use clearway_daemon::status::Snapshot;
use clearway_journal::counted::counted;

/// The state of the demo at one moment.
#[derive(Clone, Debug)]
pub struct DemoReport {
    /// Time since the car started.
    pub elapsed: Duration,
    /// Ledger, rates, latency.
    pub snapshot: Snapshot,
    /// Age of the newest map, from the end of its capture, in ms; `None` before the first map.
    pub age_ms: Option<f64>,
    /// How long a map is valid after the end of its capture.
    pub validity: Duration,
    /// Simulated time skipped since the start, because the machine is too slow.
    pub skipped: Duration,
    /// The part of `skipped` since the report before.
    pub newly_skipped: Duration,
    /// The sensors' name in a line.
    pub sensors: &'static str,
}

/// The end of a demo.
#[derive(Clone, Debug)]
pub struct DemoSummary {
    /// The last report, with complete counts.
    pub last: DemoReport,
    /// Counts of what the cars sent.
    pub sent: Sent,
    /// Processor time of this process over the time, the simulation's too; `None` where the system does not tell it.
    pub cores: Option<f64>,
}

impl Default for DemoReport {
    fn default() -> Self {
        Self {
            elapsed: Duration::ZERO,
            snapshot: Snapshot::default(),
            age_ms: None,
            validity: Duration::ZERO,
            skipped: Duration::ZERO,
            newly_skipped: Duration::ZERO,
            sensors: "HDL-64E",
        }
    }
}

impl DemoReport {
    /// The report that follows this report.
    pub fn next(&self, elapsed: Duration, snapshot: Snapshot, age_ms: Option<f64>, skipped: Duration) -> Self {
        let newly_skipped = skipped.saturating_sub(self.skipped);
        Self { elapsed, snapshot, age_ms, skipped, newly_skipped, ..*self }
    }

    /// True if the newest map is older than it is valid.
    pub fn is_stale(&self) -> bool {
        self.age_ms.is_some_and(|age_ms| age_ms > self.validity.as_secs_f64() * 1e3)
    }

    /// The report in one line.
    pub fn line(&self) -> String {
        let number = |value: Option<f64>, unit: &str| value.map_or("-".into(), |value| format!("{value:.1} {unit}"));
        let mut line = format!(
            "{:>4} s  {:>18}  {:>16}  {} refused  {} lost  age {}{}  latency {}  drivable {}",
            self.elapsed.as_secs(),
            counted(self.snapshot.revolutions(), "revolution"),
            counted(self.snapshot.ledger.received, "packet"),
            self.snapshot.refused(),
            self.snapshot.ledger.lost + self.snapshot.ledger.kernel_drops,
            number(self.age_ms, "ms"),
            if self.is_stale() { " STALE" } else { "" },
            number(self.snapshot.latency_ms_p50, "ms"),
            number(self.snapshot.drivable_share.map(|share| 100.0 * share), "%"),
        );
        if !self.newly_skipped.is_zero() {
            let (seconds, sensors) = (self.newly_skipped.as_secs_f64(), self.sensors);
            line += &format!("  simulation skipped {seconds:.1} s: this machine is too slow for {sensors}");
        }
        line
    }
}

impl DemoSummary {
    /// The summary as text. Its last line has the figures of the first vehicle's maps, and the cores.
    pub fn text(&self) -> String {
        let (sent, last) = (&self.sent, &self.last.snapshot);
        let mut text = format!(
            "Sent {} and {}; {} received, {} made of the first vehicle.",
            counted(sent.packets, "data packet"),
            counted(sent.telemetry, "telemetry datagram"),
            last.ledger.received,
            counted(last.maps, "map")
        );
        if !self.last.skipped.is_zero() {
            let (skipped, all) = (self.last.skipped.as_secs_f64(), self.last.elapsed.as_secs_f64());
            text += &format!("\nThe simulation skipped {skipped:.1} s of {all:.1} s: this machine was too slow.");
        }
        let figure = |value: Option<f64>, unit: &str| value.map_or("-".into(), |value| format!("{value:.1} {unit}"));
        text + &format!(
            "\nlatency {} from the last packet to the map, {} a map, {} with the simulation",
            figure(last.latency_ms_p50, "ms"),
            figure((last.maps > 0).then_some(last.map_bytes / 1e3), "kB"),
            figure(self.cores, "cores")
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(age_ms: f64, skipped_ms: u64) -> DemoReport {
        let before = DemoReport { validity: Duration::from_millis(300), ..DemoReport::default() };
        before.next(Duration::from_secs(1), Snapshot::default(), Some(age_ms), Duration::from_millis(skipped_ms))
    }

    #[test]
    fn a_line_states_that_the_map_is_stale() {
        assert!(report(300.5, 0).line().contains("age 300.5 ms STALE  latency"));
        assert!(report(299.5, 0).line().contains("age 299.5 ms  latency"));
    }

    #[test]
    fn the_last_line_has_latency_size_and_cores() {
        let snapshot = Snapshot { maps: 30, latency_ms_p50: Some(7.12), map_bytes: 4300.0, ..Snapshot::default() };
        let last = DemoReport { snapshot, ..DemoReport::default() };
        let text = DemoSummary { last, sent: Sent::default(), cores: Some(0.44) }.text();
        let expected = "latency 7.1 ms from the last packet to the map, 4.3 kB a map, 0.4 cores with the simulation";
        assert_eq!(text.lines().last(), Some(expected));
    }

    #[test]
    fn a_line_states_what_was_skipped_since_the_line_before() {
        let first = report(50.0, 400);
        let text = "simulation skipped 0.4 s: this machine is too slow for HDL-64E";
        assert!(first.line().ends_with(text), "{}", first.line());
        let second = first.next(Duration::from_secs(2), Snapshot::default(), None, first.skipped);
        assert!(!second.line().contains("skipped"), "{}", second.line());
        assert_eq!(second.skipped, first.skipped);
    }
}
