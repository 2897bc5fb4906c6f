//! The records of an MCAP file -> how many it has, and how many it should have by the counts in its summary and, in a
//! recording, by the recorder's counts.

use std::collections::BTreeMap;

use clearway_proto::v1;
use mcap::records::{Record, Statistics};

use crate::counted::counted;

/// The numbers of records that were read, and the numbers that the file states.
#[derive(Default)]
pub(super) struct RecordCounts {
    messages: BTreeMap<u16, u64>,
    attachments: u32,
    metadata: u32,
    stated: Option<Statistics>,
    /// What the recorder has written and dropped, once it has closed the file.
    recorder: Option<v1::RecordingCounts>,
    has_ended: bool,
}

/// A number of messages that was read of a topic, and the number that should have been.
struct Missing {
    topic: String,
    read: u64,
    stated: u64,
}

impl RecordCounts {
    /// Counts a message, an attachment or a metadata record, and remembers the summary's counts.
    pub(super) fn add(&mut self, record: &Record<'_>) {
        match record {
            Record::Message { header, .. } => *self.messages.entry(header.channel_id).or_default() += 1,
            Record::Attachment { .. } => self.attachments += 1,
            Record::Metadata(_) => self.metadata += 1,
            Record::Statistics(of) => self.stated = Some(of.clone()),
            _ => {}
        }
    }

    /// Adds counts of the recorder; only the last counts, of the closed file, are complete.
    pub(super) fn add_recorder(&mut self, counts: v1::RecordingCounts) {
        self.recorder = Some(counts).filter(|counts| counts.closed);
    }

    /// Ends the counting. From here on the summary's counts can be used if they `are_sound`, and the recorder's counts
    /// unless the file `is_repaired`: then they count the damaged file.
    pub(super) fn end(&mut self, are_sound: bool, is_repaired: bool) {
        self.has_ended = true;
        self.stated = self.stated.take().filter(|_| are_sound);
        self.recorder = self.recorder.take().filter(|_| !is_repaired);
    }

    /// True if a message of this channel was read.
    pub(super) fn has_message_of(&self, channel_id: u16) -> bool {
        self.messages.contains_key(&channel_id)
    }

    /// Number of messages of this channel that were read.
    pub(super) fn messages_of(&self, channel_id: u16) -> u64 {
        self.messages.get(&channel_id).copied().unwrap_or(0)
    }

    /// True if the recorder has dropped messages.
    pub(super) fn has_dropped(&self) -> bool {
        self.recorder.iter().flat_map(|counts| &counts.topics).any(|topic| topic.dropped > 0)
    }

    /// The topics whose number of read messages differs from the stated number; `None` if the file states no numbers.
    fn differing(&self, topic: impl Fn(u16) -> String) -> Option<Vec<Missing>> {
        let mut read: BTreeMap<String, u64> = BTreeMap::new();
        self.messages.iter().for_each(|(id, count)| *read.entry(topic(*id)).or_default() += count);
        let mut stated: BTreeMap<String, u64> = BTreeMap::new();
        let of_recorder = self.recorder.iter().flat_map(|counts| &counts.topics);
        stated.extend(of_recorder.map(|count| (count.topic.clone(), count.written)));
        if let Some(of) = &self.stated {
            let mut of_summary: BTreeMap<String, u64> = BTreeMap::new();
            let by_channel = of.channel_message_counts.iter();
            by_channel.for_each(|(id, count)| *of_summary.entry(topic(*id)).or_default() += count);
            of_summary.into_iter().for_each(|(topic, count)| _ = stated.entry(topic).or_insert(count));
        }
        if !self.has_ended || (self.recorder.is_none() && self.stated.is_none()) {
            return None;
        }
        let differing = stated.into_iter().map(|(topic, stated)| {
            let read = read.get(&topic).copied().unwrap_or_default();
            Missing { topic, read, stated }
        });
        Some(differing.filter(|of| of.read != of.stated).collect())
    }

    /// Number of messages that the file lacks by its own counts; `None` before the end, or without counts that can be
    /// trusted.
    pub(super) fn missing_messages(&self, topic: impl Fn(u16) -> String) -> Option<u64> {
        let differing = self.differing(topic)?;
        Some(differing.iter().map(|of| of.stated.saturating_sub(of.read)).sum())
    }

    /// True if the file states its counts and has no message, attachment or metadata less.
    pub(super) fn are_all_there(&self, topic: impl Fn(u16) -> String) -> bool {
        let has_others = self.stated.as_ref().is_some_and(|stated| {
            self.attachments >= stated.attachment_count && self.metadata >= stated.metadata_count
        });
        has_others && self.missing_messages(topic) == Some(0)
    }

    /// What is wrong with the numbers of messages, if the damaged parts of the file name this many lost messages.
    pub(super) fn faults(&self, named: u64, topic: impl Fn(u16) -> String) -> Vec<String> {
        let differing = self.differing(topic).unwrap_or_default();
        let more = differing.iter().filter(|of| of.read > of.stated);
        let mut faults: Vec<String> = more
            .map(|of| {
                format!("has {} of {}, and {} by its own count", counted(of.read, "message"), of.topic, of.stated)
            })
            .collect();
        let lost: Vec<_> = differing.iter().filter(|of| of.read < of.stated).collect();
        // Damage over several chunks may have destroyed an index that counts their messages.
        if named < lost.iter().map(|of| of.stated - of.read).sum() {
            let lost = lost.iter().map(|of| format!("{} of {}", counted(of.stated - of.read, "message"), of.topic));
            faults.push(format!("lost in all, by its own count: {}", lost.collect::<Vec<_>>().join(", ")));
        }
        faults
    }
}
