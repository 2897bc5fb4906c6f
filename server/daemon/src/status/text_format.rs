//! The two formats of metrics: OpenMetrics, and Prometheus' older text format.

use std::collections::BTreeSet;
use std::fmt::Write as _;

/// The format of the metrics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// OpenMetrics 1.0, which Prometheus prefers.
    OpenMetrics,
    /// Prometheus' text format 0.0.4.
    Prometheus,
}

impl Format {
    /// The format that the header `Accept` of a request asks for.
    pub fn accepted(accept: &str) -> Self {
        if accept.contains("application/openmetrics-text") { Self::OpenMetrics } else { Self::Prometheus }
    }

    /// The content type.
    pub fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Prometheus => "text/plain; version=0.0.4; charset=utf-8",
        }
    }
}

/// OpenMetrics -> text format 0.0.4, in which the names of counters end in `_total` in the comments too.
pub(super) fn to_text_format(open: &str) -> String {
    let counters: BTreeSet<&str> =
        open.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" counter")).collect();
    let mut text = String::with_capacity(open.len());
    for line in open.lines().filter(|line| *line != "# EOF") {
        let comment = line.strip_prefix("# ").and_then(|rest| rest.split_once(' '));
        let named = comment.and_then(|(kind, rest)| Some((kind, rest.split_once(' ')?)));
        let _ = match named.filter(|(_, (name, _))| counters.contains(name)) {
            Some((kind, (name, rest))) => writeln!(text, "# {kind} {name}_total {rest}"),
            None => writeln!(text, "{line}"),
        };
    }
    text
}
