//! The records of an MCAP file -> how many it has, and how many it should have by its own count.

use std::collections::BTreeMap;

use mcap::records::{Record, Statistics};

use crate::base::counted::counted;

/// The numbers of records that were read, and those that the file states.
#[derive(Default)]
pub(super) struct RecordCounts {
    messages: BTreeMap<u16, u64>,
    attachments: u32,
    metadata: u32,
    stated: Option<Statistics>,
    has_ended: bool,
}

impl RecordCounts {
    /// Counts a record.
    pub(super) fn add(&mut self, record: &Record<'_>) {
        match record {
            Record::Message { header, .. } => *self.messages.entry(header.channel_id).or_default() += 1,
            Record::Attachment { .. } => self.attachments += 1,
            Record::Metadata(_) => self.metadata += 1,
            Record::Statistics(of) => self.stated = Some(of.clone()),
            _ => {}
        }
    }

    /// Ends the counting. The file's own counts can be used from here on, if they are `sound`.
    pub(super) fn end(&mut self, are_sound: bool) {
        self.has_ended = true;
        self.stated = self.stated.take().filter(|_| are_sound);
    }

    fn stated(&self) -> Option<&Statistics> {
        self.stated.as_ref().filter(|_| self.has_ended)
    }

    /// True if a message of this channel was read.
    pub(super) fn has_message_of(&self, channel_id: u16) -> bool {
        self.messages.contains_key(&channel_id)
    }

    /// Number of messages by the file's own count, if it can be trusted; `None` before the end.
    pub(super) fn stated_messages(&self) -> Option<u64> {
        self.stated().map(|stated| stated.message_count)
    }

    /// Number of messages that the file lacks by its own count, if that can be trusted; 0 before the end.
    pub(super) fn missing_messages(&self) -> u64 {
        self.stated_messages().map_or(0, |stated| stated.saturating_sub(self.messages.values().sum()))
    }

    /// True if the file states its counts and has no message, attachment or metadata less.
    pub(super) fn are_all_there(&self) -> bool {
        self.stated().is_some_and(|stated| {
            let messages = self.messages.values().sum::<u64>() >= stated.message_count;
            messages && self.attachments >= stated.attachment_count && self.metadata >= stated.metadata_count
        })
    }

    /// What is wrong with the number of messages, if the damaged parts of the file name this many lost ones; `None`
    /// without a damaged part.
    pub(super) fn fault(&self, named: Option<u64>, topic: impl Fn(u16) -> String) -> Option<String> {
        let stated = self.stated()?;
        let read: u64 = self.messages.values().sum();
        if read > stated.message_count || (named.is_none() && read < stated.message_count) {
            return Some(format!("has {}, and {} by its own count", counted(read, "message"), stated.message_count));
        }
        let read_of = |id| self.messages.get(id).copied().unwrap_or_default();
        let by_channel = stated.channel_message_counts.iter();
        let lost = by_channel.map(|(id, stated)| (*id, stated.saturating_sub(read_of(id))));
        let lost: BTreeMap<u16, u64> = lost.filter(|(_, lost)| *lost > 0).collect();
        // Damage over several chunks may have destroyed an index that counts their messages.
        (named? < lost.values().sum()).then(|| {
            let lost = lost.iter().map(|(id, lost)| format!("{} of {}", counted(*lost, "message"), topic(*id)));
            format!("lost in all, by its own count: {}", lost.collect::<Vec<_>>().join(", "))
        })
    }
}
