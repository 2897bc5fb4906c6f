//! A damaged part of an MCAP file: where it is, and what is lost with it.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, UNIX_EPOCH};

use serde_json::{Value, json};

use crate::base::counted::counted;

/// A part of an MCAP file that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// The bytes of the file, from the first up to, without, the second.
    pub bytes: (u64, u64),
    /// The kind of damage.
    pub reason: String,
    /// Least and greatest log time of the lost messages, ns since the Unix epoch; `None` if it is not known or if no
    /// message is lost.
    pub log_ns: Option<(u64, u64)>,
    /// Number of lost messages by topic, as far as known: the index behind a chunk counts its messages.
    pub messages: BTreeMap<String, u64>,
}

impl Damage {
    /// The damage as one JSON object.
    pub fn to_json(&self) -> Value {
        let (first, last) = self.log_ns.unzip();
        json!({
            "bytes": [self.bytes.0, self.bytes.1], "reason": self.reason,
            "lost_from_ns": first, "lost_to_ns": last, "lost": self.messages,
        })
    }
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "bytes {} to {}: {}", self.bytes.0, self.bytes.1, self.reason)?;
        if !self.messages.is_empty() {
            let lost = self.messages.iter().map(|(topic, count)| format!("{} of {topic}", counted(*count, "message")));
            write!(f, "; lost: {}", lost.collect::<Vec<_>>().join(", "))?;
        }
        if let Some((first, last)) = self.log_ns {
            write!(f, "; lost from {} to {}", utc(first), utc(last))?;
        }
        Ok(())
    }
}

/// A time in ns since the Unix epoch for people: RFC 3339 in UTC, to the millisecond.
pub fn utc(ns: u64) -> String {
    humantime::format_rfc3339_millis(UNIX_EPOCH + Duration::from_nanos(ns)).to_string()
}
