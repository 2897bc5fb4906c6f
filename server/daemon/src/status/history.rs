//! The last ten minutes of one vehicle: a row of numbers each second, and the changes of its state. Pure: every time is
//! given, as the time since the server started.

use std::collections::VecDeque;
use std::time::Duration;

use serde::Serialize;

use super::health::State;

/// Length of the history. Ours: who is called looks at it within minutes; Prometheus keeps days.
pub const SPAN: Duration = Duration::from_secs(600);
/// Time after the server's start from which a state counts. Ours: the longest revolution, and the first packets.
const STARTS_FOR: Duration = Duration::from_secs(2);
/// Most changes of the state. Ours: a state gets better only after three seconds, so there are no more in ten minutes.
const CHANGES_MAX: usize = 400;

/// Names of a row's numbers: the fields of [`clearway_proto::v1::Vehicle`], and the total of `latency_ms`.
pub const COLUMNS: [&str; 5] = ["map_age_ms", "latency_ms_total", "map_rate_hz", "loss", "drivable_share"];

/// The last ten minutes of one vehicle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct History {
    rows: VecDeque<(Duration, [f32; COLUMNS.len()])>,
    changes: VecDeque<(Duration, StateChange)>,
}

/// A state that a vehicle took.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StateChange {
    /// The state: "ok", "warn" or "error".
    pub state: &'static str,
    /// Why, worst first, at the moment with the most reasons: the cause often shows after its first symptom.
    pub reasons: Vec<String>,
    /// Part of the recording that was written then, by the name that it has when it is closed; empty without one.
    pub file: String,
}

/// A history as JSON. `at_ms` is in ms since the Unix epoch, by the clock of now.
#[derive(Serialize)]
struct Written<'a> {
    now_ms: i64,
    columns: [&'static str; COLUMNS.len()],
    /// `at_ms`, then the number of each column; null if it was not known.
    rows: Vec<(i64, &'a [f32; COLUMNS.len()])>,
    changes: Vec<WrittenChange<'a>>,
}

#[derive(Serialize)]
struct WrittenChange<'a> {
    at_ms: i64,
    #[serde(flatten)]
    change: &'a StateChange,
}

impl History {
    /// True if a second has begun that has no row.
    pub fn is_row_due(&self, now: Duration) -> bool {
        self.rows.back().is_none_or(|(last, _)| last.as_secs() < now.as_secs())
    }

    /// Adds the numbers of [`COLUMNS`], if their second has no row.
    pub fn push_row(&mut self, now: Duration, numbers: [Option<f64>; COLUMNS.len()]) {
        if !self.is_row_due(now) {
            return;
        }
        self.rows.push_back((now, numbers.map(|number| number.map_or(f32::NAN, |number| number as f32))));
        while self.rows.front().is_some_and(|(first, _)| now.as_secs() >= first.as_secs() + SPAN.as_secs()) {
            self.rows.pop_front();
        }
        self.forget_changes(now);
    }

    /// Adds the state with its reasons, if it is another than the last one; else keeps the reasons, if there are more.
    /// `file` is asked only for another state. A start is no error: that nothing has come in the first seconds is left
    /// out.
    pub fn push_state(&mut self, now: Duration, state: State, reasons: &[String], file: impl FnOnce() -> String) {
        if now < STARTS_FOR && state == State::Error {
            return;
        }
        match self.changes.back_mut() {
            Some((_, last)) if last.state == state.as_str() => {
                if reasons.len() > last.reasons.len() {
                    last.reasons = reasons.to_vec();
                }
            }
            _ => {
                let change = StateChange { state: state.as_str(), reasons: reasons.to_vec(), file: file() };
                self.changes.push_back((now, change));
                self.forget_changes(now);
            }
        }
    }

    /// The state in which the ten minutes began stays.
    fn forget_changes(&mut self, now: Duration) {
        let is_past =
            |changes: &VecDeque<_>| changes.get(1).is_some_and(|(second, _)| now.saturating_sub(*second) >= SPAN);
        while is_past(&self.changes) || self.changes.len() > CHANGES_MAX {
            self.changes.pop_front();
        }
    }

    /// The history as a JSON object, at `now`, which is `now_ms` since the Unix epoch.
    pub fn to_json(&self, now: Duration, now_ms: i64) -> String {
        let at_ms = |at: Duration| now_ms - now.saturating_sub(at).as_millis() as i64;
        let written = Written {
            now_ms,
            columns: COLUMNS,
            rows: self.rows.iter().map(|(at, numbers)| (at_ms(*at), numbers)).collect(),
            changes: self.changes.iter().map(|(at, change)| WrittenChange { at_ms: at_ms(*at), change }).collect(),
        };
        serde_json::to_string(&written).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn the_ring_forgets_after_ten_minutes_and_counts_nothing_twice() {
        let mut history = History::default();
        for tick in 0..5 * 1200_u32 {
            let now = Duration::from_millis(200) * tick;
            // A minute of each state, again and again.
            let state = State::ALL[now.as_secs() as usize / 60 % 3];
            // The cause shows half a second after the symptom, and is gone first.
            let reasons = ["the newest map is old".to_owned(), format!("{state:?}")];
            let shown = if (3..200).contains(&(tick % 300)) { &reasons[..] } else { &reasons[..1] };
            history.push_state(now, state, shown, String::new);
            history.push_row(now, [Some(f64::from(tick)), None, Some(10.5), Some(0.1), None]);
        }
        let now = Duration::from_millis(1_199_800);
        let written: Value = serde_json::from_str(&history.to_json(now, 2_000_000)).unwrap();
        assert_eq!(written["columns"], json!(COLUMNS));
        let rows = written["rows"].as_array().unwrap();
        assert_eq!(rows.len(), 600);
        assert_eq!(rows[0], json!([1_400_200, [3000.0, null, 10.5, 0.1, null]]));
        assert!(rows.windows(2).all(|two| two[0][0].as_i64().unwrap() + 1000 == two[1][0].as_i64().unwrap()));
        let changes = written["changes"].as_array().unwrap();
        assert_eq!(changes.len(), 11, "ten minutes, and the state in which they began");
        let reasons = json!(["the newest map is old", "Ok"]);
        assert_eq!(changes[0], json!({"at_ms": 1_340_200, "state": "ok", "reasons": reasons, "file": ""}));
        assert!(changes.windows(2).all(|two| two[0]["state"] != two[1]["state"]));
    }
}
