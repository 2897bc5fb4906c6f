//! A damaged part of an MCAP file: where it is, and what is lost with it.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, UNIX_EPOCH};

use mcap::records::MessageIndex;
use serde_json::{Value, json};

use crate::counted::counted;

/// A part of a file that cannot be read, as its reader finds it: before the names of its channels are known.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct LostPart {
    /// The bytes of the file from the first up to, without, the second.
    pub(super) bytes: (u64, u64),
    pub(super) reason: String,
    /// False if other records of the file repeat all that the part held, as they do for indexes and the summary.
    pub(super) is_loss: bool,
    /// Least and greatest log time by the fields of a damaged chunk, ns since the Unix epoch.
    pub(super) chunk_ns: Option<(u64, u64)>,
    /// Least and greatest log time of the lost messages by their indexes, within `chunk_ns`; ns since the Unix epoch.
    pub(super) index_ns: Option<(u64, u64)>,
    /// Number of lost messages, by id of the channel, as far as known.
    pub(super) messages: BTreeMap<u16, u64>,
}

impl LostPart {
    /// A lost part without known messages or times.
    pub(super) fn new(bytes: (u64, u64), reason: String, is_loss: bool) -> Self {
        Self { bytes, reason, is_loss, chunk_ns: None, index_ns: None, messages: BTreeMap::new() }
    }

    /// Adds the messages of an index, from this position of the chunk's content on. A time outside of the chunk's is
    /// damage of the index.
    pub(super) fn add_index(&mut self, index: &MessageIndex, from: u64) {
        let lost = || index.records.iter().filter(|entry| entry.offset >= from);
        // An index may be in the file twice.
        let count = lost().count() as u64;
        if count > 0 {
            self.messages.entry(index.channel_id).and_modify(|lost| *lost = count.max(*lost)).or_insert(count);
        }
        let (first, last) = self.chunk_ns.unwrap_or((0, u64::MAX));
        for at in lost().map(|entry| entry.log_time).filter(|at| (first..=last).contains(at)) {
            self.index_ns = Some(self.index_ns.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
        }
    }
}

/// A part of an MCAP file that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// The bytes of the file, from the first up to, without, the second.
    pub bytes: (u64, u64),
    /// The kind of damage.
    pub reason: String,
    /// False if other records of the file repeat all that the part held.
    pub is_loss: bool,
    /// Least and greatest log time of the lost messages, ns since the Unix epoch; `None` if it is not known or if no
    /// message is lost.
    pub log_ns: Option<(u64, u64)>,
    /// Number of lost messages by topic, as far as known: the index behind a chunk counts its messages.
    pub messages: BTreeMap<String, u64>,
}

impl Damage {
    /// The damage for which a part is lost, with the name of each channel's topic.
    pub(super) fn new(part: &LostPart, topic: impl Fn(u16) -> String) -> Self {
        Self {
            bytes: part.bytes,
            reason: part.reason.clone(),
            is_loss: part.is_loss,
            log_ns: part.index_ns.or(part.chunk_ns),
            messages: part.messages.iter().map(|(id, count)| (topic(*id), *count)).collect(),
        }
    }

    /// The damage as one JSON object.
    pub fn to_json(&self) -> Value {
        let (first, last) = self.log_ns.unzip();
        json!({
            "bytes": [self.bytes.0, self.bytes.1], "reason": self.reason, "is_loss": self.is_loss,
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
