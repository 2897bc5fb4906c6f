//! One open part: its file, and what it holds and lacks.

use std::time::Instant;

use clearway_mapping::event::Event;
use clearway_proto::v1;
use mcap::McapError;

use super::counts::RecorderCounts;
use clearway_journal::mcap_file::{Disk, McapFile};

/// One open part.
pub(super) struct Part<D: Disk> {
    pub(super) number: u64,
    pub(super) file: McapFile<D>,
    pub(super) began: Instant,
    /// Messages written and dropped, by topic.
    pub(super) topics: Vec<(u64, u64)>,
    /// Messages written since the newest sync, by topic: what a failure of the disk costs.
    pub(super) unsynced: Vec<u64>,
    /// True if it holds what no other part holds; a part for which vehicles only warm up does not.
    pub(super) is_needed: bool,
    /// True if the newest counts in the file are no longer true about what was dropped.
    pub(super) has_loss: bool,
}

impl<D: Disk> Part<D> {
    pub(super) fn add_written(&mut self, topic: usize) {
        self.topics[topic].0 += 1;
        self.unsynced[topic] += 1;
    }

    pub(super) fn write_event(&mut self, vehicle: usize, event: &Event, journal: usize) -> Result<(), McapError> {
        self.file.write_event(vehicle, event)?;
        self.topics[journal].0 += 1;
        Ok(())
    }

    /// What the part holds and lacks.
    pub(super) fn counts(&self, counts: &RecorderCounts, reason: &str, closed: bool) -> v1::RecordingCounts {
        let topics = counts.topics().iter().zip(&self.topics).map(|(topic, (written, dropped))| v1::TopicCount {
            topic: topic.to_owned(),
            offered: written + dropped,
            written: *written,
            dropped: *dropped,
        });
        v1::RecordingCounts { topics: topics.collect(), reason: reason.to_owned(), closed }
    }
}
