//! The first and the last time of what a file holds; numbers as they are printed.

use clearway_journal::damage::utc;

/// The first and the last time of what a file holds, ns since the Unix epoch.
#[derive(Clone, Copy, Default)]
pub struct Span(Option<(i64, i64)>);

impl Span {
    pub fn extend(&mut self, at: i64) {
        self.0 = Some(self.0.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
    }

    pub fn seconds(self) -> Option<f64> {
        self.0.map(|(first, last)| last.saturating_sub(first) as f64 * 1e-9)
    }

    /// The first time as date and time in UTC.
    pub fn begins(self) -> Option<String> {
        self.0.map(|(first, _)| utc(first.try_into().unwrap_or(0)))
    }

    /// The last time as date and time in UTC.
    pub fn ends(self) -> Option<String> {
        self.0.map(|(_, last)| utc(last.try_into().unwrap_or(0)))
    }
}

/// The value to a thousandth, as seconds, metres and revolutions per minute are printed.
pub fn rounded(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}
