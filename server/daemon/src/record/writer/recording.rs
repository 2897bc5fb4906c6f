//! The recorder without a thread of its own: items of the queue -> parts on the disk. Its owner passes the time; only
//! messages before the first event have the system's time.
//!
//! At most two parts are open: the part that is recorded, and the next part while vehicles warm up for it. A part that
//! the disk refuses is left as it is; after [`RETRY`] the next part begins, if the disk takes it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant, SystemTime};

use clearway_mapping::event::Event;
use clearway_proto::v1;
use flume::{Receiver, RecvTimeoutError};
use mcap::McapError;

use super::control::{Command, Request, Saved, recorded};
use super::counts::RecorderCounts;
use super::folder::{Files, RecordError, with_cause};
use super::handle::{Item, Link, RecordingHandle, WantedPart, link};
use super::part::Part;
use crate::base::clock::now_ns;
use crate::config::Recorder as Options;
use clearway_journal::encode::EncodedMap;
use clearway_journal::mcap_file::{McapFile, RecordingHeader};

/// Time between two attempts to begin a part on a disk that has failed. Ours: a disk that is full or was pulled out
/// needs a person.
const RETRY: Duration = Duration::from_secs(1);
/// Longest time between two looks at requests and at the time.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// What the writer knows about one vehicle.
#[derive(Clone, Copy, Default)]
struct VehicleState {
    /// The part of its messages.
    part: Option<u64>,
    /// The part for which it warms up.
    warm_up: Option<u64>,
    /// Sequence of the event after the newest written one.
    next_event: u64,
}

/// Writes a recording. After a failure of the disk it still empties its queue, and counts the messages as dropped.
pub struct RecordingWriter<F: Files> {
    files: F,
    options: Options,
    header: RecordingHeader,
    /// The open parts, the older one first.
    parts: VecDeque<Part<F::File>>,
    vehicles: Vec<VehicleState>,
    items: Receiver<Item>,
    wanted: WantedPart,
    /// Number of the newest part that was begun.
    newest_part: u64,
    /// Arrival of the newest event; `None` before the first.
    newest_ns: Option<i64>,
    /// Parts that were closed, when they began, and when they were closed.
    closed: VecDeque<(u64, Instant, Instant)>,
    sync_at: Option<Instant>,
    /// When the newest sync began; a message that waited in the queue meanwhile is no older.
    synced_at: Instant,
    retry_at: Option<Instant>,
    is_stopped: bool,
    waits: bool,
    counts: Arc<RecorderCounts>,
    reason: String,
}

impl<F: Files> RecordingWriter<F> {
    /// Begins the first part. Returns a handle for each vehicle, in the order of the header. With `waits` a full queue
    /// delays its sender and loses nothing, the recording has one part, and a failure ends it: right for files, wrong
    /// for live data.
    ///
    /// # Errors
    /// [`RecordError::Create`] if the file cannot be created, [`RecordError::Write`] if the header cannot be written.
    pub fn new(
        files: F,
        options: &Options,
        header: &RecordingHeader,
        waits: bool,
        now: Instant,
    ) -> Result<(Self, Vec<RecordingHandle>), RecordError> {
        let (link, handles) = link(options, header, waits);
        Ok((Self::begin(files, link, now)?, handles))
    }

    /// As [`RecordingWriter::new`], for handles that exist.
    pub(super) fn begin(files: F, link: Link, now: Instant) -> Result<Self, RecordError> {
        let Link { items, counts, wanted, options, header, waits } = link;
        let mut writer = Self {
            files,
            parts: VecDeque::new(),
            vehicles: vec![VehicleState::default(); header.vehicles.len()],
            options,
            header,
            items,
            wanted,
            newest_part: 0,
            newest_ns: None,
            closed: VecDeque::new(),
            sync_at: None,
            synced_at: now,
            retry_at: None,
            is_stopped: false,
            waits,
            counts,
            reason: String::new(),
        };
        writer.begin_part(now)?;
        writer.vehicles.iter_mut().for_each(|vehicle| vehicle.part = Some(1));
        Ok(writer)
    }

    /// The counts of the recording.
    pub fn counts(&self) -> Arc<RecorderCounts> {
        self.counts.clone()
    }

    /// Writes events and maps, and answers requests, until all handles are dropped.
    pub(super) fn run(mut self, requests: &std::sync::mpsc::Receiver<Request>) {
        loop {
            self.counts.beat();
            let until_sync = self.sync_at.map(|at| at.saturating_duration_since(Instant::now()));
            match self.items.recv_timeout(until_sync.unwrap_or(POLL_INTERVAL).min(POLL_INTERVAL)) {
                Ok(item) => self.write(item, Instant::now()),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            self.tick(Instant::now());
            while let Ok(request) = requests.try_recv() {
                let answer = self.answer(&request.command, Instant::now());
                // Fails only if the caller no longer waits.
                let _ = request.answer.send(answer);
            }
        }
        self.finish();
    }

    /// Writes the first queued item, if there is one, at the time `now`. Returns true if there was one.
    pub fn write_next(&mut self, now: Instant) -> bool {
        self.counts.beat();
        let item = self.items.try_recv();
        let is_item = item.is_ok();
        if let Ok(item) = item {
            self.write(item, now);
        }
        self.tick(now);
        is_item
    }

    /// Writes the items that are still queued and closes the file.
    pub fn finish(mut self) {
        while let Ok(item) = self.items.try_recv() {
            self.write(item, Instant::now());
        }
        self.wanted.store(0, Ordering::Release);
        while let Some(part) = self.parts.pop_front() {
            self.close(part, Instant::now());
        }
        self.counts.set_ended();
    }

    /// Does what has become due.
    fn tick(&mut self, now: Instant) {
        if self.sync_at.is_some_and(|at| at <= now) {
            self.sync(now);
        }
        if self.retry_at.is_some_and(|at| at <= now) {
            self.retry_at = None;
            self.begin_or_fail(now);
        }
        // The time of a part counts from its first message, so that no series of empty parts is written.
        self.parts.iter_mut().filter(|part| part.topics.iter().all(|of| of.0 == 0)).for_each(|part| part.began = now);
        let is_due = self.parts.front().is_some_and(|part| {
            let (mb, s, age) = (self.options.part_mb, self.options.part_s, now.saturating_duration_since(part.began));
            (mb > 0 && part.file.bytes() >= mb << 20) || (s > 0 && age >= Duration::from_secs(s))
        });
        if is_due && self.parts.len() == 1 && !self.waits && !self.is_stopped {
            self.begin_or_fail(now);
        }
    }

    /// Answers a request of an operator.
    fn answer(&mut self, command: &Command, now: Instant) -> Result<Saved, String> {
        match command {
            Command::Start if self.is_stopped => {
                self.is_stopped = false;
                self.begin_part(now).map_err(|error| {
                    self.fail(&error.to_string(), now);
                    error.to_string()
                })?;
            }
            Command::Start if self.parts.is_empty() => {
                return Err(format!("the disk has failed, and the recorder tries again by itself: {}", self.reason));
            }
            Command::Start => return Err("the recorder is not stopped".to_owned()),
            Command::Stop if self.is_stopped => return Err("the recorder is stopped already".to_owned()),
            Command::Stop => {
                (self.is_stopped, self.retry_at) = (true, None);
                self.wanted.store(0, Ordering::Release);
                self.close_left(now);
            }
            Command::Split => self.split(now)?,
            Command::Save { seconds, reason } => return self.save(*seconds, reason, now),
        }
        Ok(Saved::default())
    }

    fn split(&mut self, now: Instant) -> Result<(), String> {
        match (self.is_stopped, self.waits, self.parts.len()) {
            (true, ..) => Err("the recorder is stopped".to_owned()),
            (_, true, _) => Err("a replay is recorded to one file".to_owned()),
            (.., 0) => Err(format!("the disk has failed: {}", self.reason)),
            // The next part is on its way.
            (.., 2..) => Ok(()),
            (.., 1) => self.begin_part(now).map_err(|error| error.to_string()),
        }
    }

    /// Links the parts that hold the last `seconds` into a folder of their own. Their last part ends soon after.
    fn save(&mut self, seconds: u64, reason: &str, now: Instant) -> Result<Saved, String> {
        let seconds = if seconds == 0 { self.options.save_s } else { seconds };
        self.sync(now);
        let time = Duration::from_secs(seconds);
        let closed = self.closed.iter().copied().filter(|(.., at)| now.saturating_duration_since(*at) <= time);
        let of_time: Vec<_> = closed.chain(self.parts.iter().map(|part| (part.number, part.began, now))).collect();
        let parts: Vec<u64> = of_time.iter().map(|(part, ..)| *part).collect();
        if parts.is_empty() {
            return Err("there is no part to save".to_owned());
        }
        let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let name = format!("{}-{reason}", since.as_millis());
        let links = self.files.keep(&parts, &name).map_err(|error| error.to_string())?;
        // The oldest parts are deleted first.
        let deleted = parts.len().saturating_sub(links.len());
        let saved = Saved { recorded: recorded(&of_time[deleted..], time, now), files: links };
        let (files, saved_s) = (saved.files.len(), saved.recorded.as_secs_f64());
        tracing::info!(reason, seconds, saved_s, files, "saved the last seconds of the recording");
        if deleted > 0 {
            tracing::warn!(reason, seconds, deleted, "parts of the last seconds were deleted before they were saved");
        }
        if self.parts.len() == 1 && !self.waits && !self.is_stopped {
            self.split(now)?;
        }
        Ok(saved)
    }

    fn write(&mut self, item: Item, now: Instant) {
        match item {
            Item::Event(vehicle, event) => self.write_event(vehicle, &event, now),
            Item::Map(vehicle, map, _hop) => self.write_map(vehicle, &map, now),
            Item::WarmUp { vehicle, part, from_ns, first_event, repeated } => {
                self.vehicles[vehicle].warm_up = Some(part);
                let phase = v1::KeyframePhase::WarmUp.into();
                let keyframe = v1::Keyframe { phase, first_event, ..v1::Keyframe::default() };
                self.in_part(part, now, |part| part.file.write_keyframe(vehicle, from_ns, &keyframe));
                let journal = self.counts.first_topic(vehicle);
                for event in &repeated {
                    self.in_part(part, now, |part| part.write_event(vehicle, event, journal));
                }
            }
            Item::Begin { vehicle, part, handover } => {
                let phase = v1::KeyframePhase::Begin.into();
                let (next_map, (epoch, newest_end_ns)) = (handover.next_map, handover.newest);
                let (first_event, refused) = (self.vehicles[vehicle].next_event, handover.refused());
                let keyframe = v1::Keyframe { phase, first_event, next_map, refused, epoch, newest_end_ns };
                self.in_part(part, now, |part| part.file.write_keyframe(vehicle, 0, &keyframe));
                let is_open = self.parts.iter().any(|open| open.number == part);
                let state = &mut self.vehicles[vehicle];
                (state.part, state.warm_up) = (Some(part).filter(|_| is_open), None);
                self.close_left(now);
            }
            Item::Dropped { vehicle, topics } => {
                let part = self.vehicles[vehicle].part;
                let part = self.parts.iter_mut().find(|open| Some(open.number) == part);
                if let Some(part) = part {
                    topics.iter().for_each(|(topic, count)| part.topics[*topic].1 += count);
                    (part.has_loss, part.is_needed) = (true, true);
                    self.reason = "the recorder's queue was full".to_owned();
                    self.write_losses(now);
                }
            }
            Item::Leave { vehicle } => {
                let state = &mut self.vehicles[vehicle];
                (state.part, state.warm_up) = (None, None);
                self.close_left(now);
            }
        }
    }

    fn write_event(&mut self, vehicle: usize, event: &Event, now: Instant) {
        self.newest_ns = Some(event.arrival_ns);
        let journal = self.counts.first_topic(vehicle);
        let VehicleState { part, warm_up, .. } = self.vehicles[vehicle];
        let mut is_written = false;
        for number in [part, warm_up.filter(|warm_up| part != Some(*warm_up))].into_iter().flatten() {
            is_written |= self.in_part(number, now, |open| {
                open.write_event(vehicle, event, journal)?;
                // An event for a warm-up alone is an additional copy, unless the vehicle has no part.
                let is_first_copy = part.is_none_or(|part| part == number);
                open.unsynced[journal] += u64::from(is_first_copy);
                open.is_needed |= is_first_copy;
                Ok(())
            });
        }
        self.vehicles[vehicle].next_event = event.sequence.saturating_add(1);
        // A part that has failed has counted its last messages as dropped.
        if is_written { self.counts.add_written(journal) } else { self.counts.add_dropped(journal) }
    }

    fn write_map(&mut self, vehicle: usize, map: &EncodedMap, now: Instant) {
        let first = self.counts.first_topic(vehicle) + 1;
        let topics = first..first + map.layers.len();
        let part = self.vehicles[vehicle].part;
        let is_written = part.is_some_and(|part| {
            self.in_part(part, now, |part| {
                part.file.write_map(vehicle, map)?;
                topics.clone().for_each(|topic| part.add_written(topic));
                Ok(())
            })
        });
        for topic in topics {
            if is_written { self.counts.add_written(topic) } else { self.counts.add_dropped(topic) }
        }
    }

    /// Writes to an open part. Returns true if it is open and has taken it; a failure ends the part.
    fn in_part(
        &mut self,
        number: u64,
        now: Instant,
        write: impl FnOnce(&mut Part<F::File>) -> Result<(), McapError>,
    ) -> bool {
        let Some(part) = self.parts.iter_mut().find(|part| part.number == number) else { return false };
        match write(part) {
            Ok(()) => {
                self.sync_at.get_or_insert(self.synced_at + self.sync_period());
                true
            }
            Err(error) => {
                self.abandon(number, &error, now);
                false
            }
        }
    }

    /// Time from the begin of a sync to the begin of the next one. The other half of `flush_ms` is for the sync itself.
    fn sync_period(&self) -> Duration {
        Duration::from_millis(self.options.flush_ms) / 2
    }

    /// Waits until the disk has all that was written, and moves the durable mark of each vehicle.
    fn sync(&mut self, now: Instant) {
        (self.sync_at, self.synced_at) = (None, now);
        let began = Instant::now();
        let failed: Vec<(u64, McapError)> = self
            .parts
            .iter_mut()
            .filter_map(|part| match part.file.sync() {
                Ok(()) => {
                    part.unsynced.fill(0);
                    None
                }
                Err(error) => Some((part.number, error)),
            })
            .collect();
        self.counts.set_late(began.elapsed() > self.sync_period());
        for (number, error) in failed {
            self.abandon(number, &error, Instant::now());
        }
        for (index, vehicle) in self.vehicles.iter().enumerate() {
            if vehicle.part.is_some_and(|part| self.parts.iter().any(|open| open.number == part)) {
                self.counts.set_durable(index, vehicle.next_event);
            }
        }
    }

    /// Writes the counts into each part that has lost messages since the newest counts in it.
    fn write_losses(&mut self, now: Instant) {
        let numbers: Vec<u64> = self.parts.iter().filter(|part| part.has_loss).map(|part| part.number).collect();
        let (counts, reason) = (self.counts.clone(), self.reason.clone());
        for number in numbers {
            self.in_part(number, now, |part| {
                part.has_loss = false;
                part.file.write_counts(&part.counts(&counts, &reason, false))
            });
        }
    }

    fn begin_or_fail(&mut self, now: Instant) {
        let number = self.newest_part + 1;
        if let Err(error) = self.begin_part(now) {
            self.fail(&format!("part {number} cannot be begun: {error}"), now);
        }
    }

    /// Begins the next part, which the vehicles then warm up for.
    fn begin_part(&mut self, now: Instant) -> Result<(), RecordError> {
        let number = self.newest_part + 1;
        let path = self.files.path(number);
        let create = |source| RecordError::Create { file: path.clone(), source };
        let disk = self.files.create(number).map_err(create)?;
        let begins_ns = self.newest_ns.unwrap_or_else(now_ns);
        let written = McapFile::create(disk, self.options.maps, &self.header, number, begins_ns);
        // A file without a whole header is of no use; once it is deleted, its number is free again.
        let is_free = written.is_err() && self.files.discard(number).is_ok();
        self.newest_part = if is_free { self.newest_part } else { number };
        let file = written.map_err(|source| RecordError::Write { file: path.clone(), source })?;
        let count = self.counts.topics().len();
        let (topics, unsynced) = (vec![(0, 0); count], vec![0; count]);
        let is_needed = number == 1;
        self.parts.push_back(Part { number, file, began: now, topics, unsynced, is_needed, has_loss: false });
        self.counts.set_file(path.display().to_string(), number);
        self.wanted.store(number, Ordering::Release);
        Ok(())
    }

    /// Leaves a part that the disk refuses as it is.
    fn abandon(&mut self, number: u64, error: &McapError, now: Instant) {
        let Some(index) = self.parts.iter().position(|part| part.number == number) else { return };
        if let Some(part) = self.parts.remove(index) {
            self.counts.move_to_dropped(&part.unsynced);
            part.file.abandon();
            self.closed.push_back((number, part.began, now));
        }
        for vehicle in &mut self.vehicles {
            vehicle.part = vehicle.part.filter(|part| *part != number);
            vehicle.warm_up = vehicle.warm_up.filter(|part| *part != number);
        }
        self.fail_part(number, error, now);
    }

    /// Notes that the disk refuses a part; what the disk has taken of it stays.
    fn fail_part(&mut self, number: u64, error: &McapError, now: Instant) {
        let left = self.files.path(number);
        self.fail(&format!("{}; what was written before is in {}", with_cause(error), left.display()), now);
    }

    /// Notes a failure of the disk, and when to try again.
    fn fail(&mut self, reason: &str, now: Instant) {
        if self.counts.stop_reason().is_none() {
            let file = self.files.path(self.newest_part);
            tracing::error!(file = %file.display(), reason, "the recording stops here; maps are still served");
        }
        self.reason = reason.to_owned();
        self.counts.set_failed(reason);
        if !self.waits && !self.is_stopped {
            self.retry_at = Some(now + RETRY);
        }
    }

    /// Closes the parts that no vehicle writes to any more, if another part or nothing is wanted.
    fn close_left(&mut self, now: Instant) {
        let wanted = self.wanted.load(Ordering::Acquire);
        while let Some(part) = self.parts.front() {
            let number = part.number;
            let uses = |vehicle: &VehicleState| vehicle.part == Some(number) || vehicle.warm_up == Some(number);
            if number == wanted || self.vehicles.iter().any(uses) {
                break;
            }
            if let Some(part) = self.parts.pop_front() {
                self.close(part, now);
            }
        }
        if self.is_stopped && self.parts.is_empty() {
            self.counts.set_stopped();
        }
    }

    /// Writes the final counts and closing records of a part, and gives it its name; deletes a part that is not needed.
    fn close(&mut self, part: Part<F::File>, now: Instant) {
        let number = part.number;
        let losses = if part.topics.iter().any(|(_, dropped)| *dropped > 0) { &*self.reason } else { "" };
        let counts = part.counts(&self.counts, losses, true);
        let Part { mut file, began, unsynced, is_needed, .. } = part;
        let closed = file.write_counts(&counts).and_then(|()| file.finish());
        if closed.is_ok() && !is_needed && self.files.discard(number).is_ok() {
            self.files.delete_old();
            return;
        }
        let closed = closed.and_then(|()| self.files.complete(number).map_err(McapError::Io));
        match closed {
            Ok(()) => {
                for (index, vehicle) in self.vehicles.iter().enumerate() {
                    if vehicle.part.is_none_or(|part| part == number) {
                        self.counts.set_durable(index, vehicle.next_event);
                    }
                }
                self.closed.push_back((number, began, now));
                self.files.delete_old();
            }
            Err(error) => {
                self.counts.move_to_dropped(&unsynced);
                self.fail_part(number, &error, now);
            }
        }
    }
}
