//! Files of one or several vehicles -> their readings in the order of recorded time.
//!
//! A thread of its own reads ahead, so that decoding of files and making of maps use two cores. The readings are the
//! same each time the timeline is opened, so a place in it is the number of readings before it.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};

use clearway_daemon::ingest::queue::Reading;

use super::faults::Faults;
use crate::files::mcap::{McapOptions, RefusedMessages};
use crate::files::{FilesError, Readings, Truncated};

/// Readings that may be decoded ahead. Ours: 0.3 s of an HDL-64E.
const AHEAD: usize = 1024;

/// The files of one vehicle, in the order of their times.
#[derive(Clone, Debug)]
pub struct Track {
    /// Paths of the files, in the order of their times.
    pub files: Vec<PathBuf>,
    /// Options with which the files are read.
    pub options: McapOptions,
}

/// The files of all vehicles, in one recorded time.
#[derive(Clone, Debug)]
pub struct Timeline {
    /// The vehicles' files, in the order of the configuration.
    pub tracks: Vec<Track>,
    /// Bytes read since the timeline was last opened, for a progress bar.
    pub bytes_read: Arc<AtomicU64>,
    /// Faults that the readings get.
    pub faults: Faults,
}

/// One reading of the timeline.
#[derive(Debug)]
pub struct TimedReading {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Recorded time: the reading's arrival, or for a pose that a scan waits for, the scan's arrival; without a step of
    /// the clock that is a fault.
    pub at_ns: i64,
    /// The reading that arrives at this time.
    pub reading: Reading,
    /// Messages of this vehicle that were refused before it became readings.
    pub refused: RefusedMessages,
}

/// What a timeline has beside its readings; known at its end.
#[derive(Debug, Default)]
pub struct Remarks {
    /// Files that are truncated or damaged.
    pub truncated: Vec<Truncated>,
    /// Topics and packets that were ignored or refused, for people.
    pub notes: Vec<String>,
    /// Messages that were refused after the last reading, by vehicle.
    pub refused: Vec<RefusedMessages>,
}

impl Timeline {
    /// Recorded time of the first and of the last reading, `None` without readings, and what the files have beside.
    /// Reads all files.
    ///
    /// # Errors
    /// [`FilesError`] if a file cannot be read.
    pub fn extent(&self) -> Result<(Option<(i64, i64)>, Remarks), FilesError> {
        let mut merged = self.open()?;
        let mut extent: Option<(i64, i64)> = None;
        while let Some(next) = merged.next()? {
            let (begin, end) = extent.unwrap_or((merged.begin_ns.unwrap_or(next.at_ns), next.at_ns));
            extent = Some((begin.min(next.at_ns), end.max(next.at_ns)));
        }
        Ok((extent, merged.remarks()))
    }

    /// Starts to read ahead, after the first `skipped` readings.
    ///
    /// # Errors
    /// [`FilesError`] if a file cannot be opened.
    pub fn start(&self, skipped: u64) -> Result<Ahead, FilesError> {
        let mut merged = self.open()?;
        let (sender, readings) = sync_channel(AHEAD);
        let bytes_read = self.bytes_read.clone();
        let read = move || {
            for _ in 0..skipped {
                match merged.next() {
                    Ok(Some(_)) => {}
                    Ok(None) | Err(_) => break,
                }
            }
            loop {
                let next = merged.next();
                bytes_read
                    .store(merged.tracks.iter().map(|(readings, _)| readings.bytes_read()).sum(), Ordering::Relaxed);
                let (item, is_last) = match next {
                    Ok(Some(reading)) => (Ok(Item::Reading(reading)), false),
                    Ok(None) => (Ok(Item::End(merged.remarks())), true),
                    Err(error) => (Err(error), true),
                };
                // Fails if the reader has gone, as after a jump.
                if sender.send(item).is_err() || is_last {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new().name("replayed files".into()).spawn(read);
        thread.map_err(|source| FilesError::Open { file: "the thread that reads files".into(), source })?;
        Ok(Ahead { readings, next: None, end: None })
    }

    fn open(&self) -> Result<Merged, FilesError> {
        let open = |track: &Track| Ok((Readings::open(&track.files, track.options.clone())?, None));
        let tracks = self.tracks.iter().map(open).collect::<Result<_, FilesError>>()?;
        Ok(Merged { tracks, faults: self.faults.clone(), number: 0, begin_ns: None })
    }
}

enum Item {
    Reading(TimedReading),
    End(Remarks),
}

/// The readings of all vehicles. The next reading can be looked at before it is taken.
pub struct Ahead {
    readings: Receiver<Result<Item, FilesError>>,
    next: Option<TimedReading>,
    end: Option<Remarks>,
}

impl Ahead {
    /// Recorded time of the next reading; `None` at the end.
    ///
    /// # Errors
    /// [`FilesError`] if a file cannot be read further.
    pub fn next_ns(&mut self) -> Result<Option<i64>, FilesError> {
        if self.next.is_none() && self.end.is_none() {
            match self.readings.recv() {
                Ok(Ok(Item::Reading(reading))) => self.next = Some(reading),
                Ok(Ok(Item::End(remarks))) => self.end = Some(remarks),
                Ok(Err(error)) => return Err(error),
                Err(_) => self.end = Some(Remarks::default()),
            }
        }
        Ok(self.next.as_ref().map(|next| next.at_ns))
    }

    /// Takes the reading that [`Ahead::next_ns`] has looked at.
    pub fn take(&mut self) -> Option<TimedReading> {
        self.next.take()
    }

    /// The remarks, if the end was reached.
    pub fn end(&mut self) -> Option<&mut Remarks> {
        self.end.as_mut()
    }
}

/// The readings of several vehicles, each vehicle with its next reading.
struct Merged {
    tracks: Vec<(Readings, Option<Reading>)>,
    faults: Faults,
    /// Number of readings so far, with readings that a fault has dropped.
    number: u64,
    /// Recorded time of the first reading.
    begin_ns: Option<i64>,
}

impl Merged {
    /// The next reading that no fault drops.
    fn next(&mut self) -> Result<Option<TimedReading>, FilesError> {
        while let Some(TimedReading { vehicle, at_ns, reading, refused }) = self.earliest()? {
            self.number += 1;
            let begin_ns = *self.begin_ns.get_or_insert(at_ns);
            let after_s = at_ns.saturating_sub(begin_ns) as f64 * 1e-9;
            if let Some(reading) = self.faults.apply(reading, vehicle, self.number, after_s) {
                return Ok(Some(TimedReading { vehicle, at_ns, reading, refused }));
            }
        }
        Ok(None)
    }

    /// The earliest of the vehicles' next readings; at equal times the reading of the first vehicle.
    fn earliest(&mut self) -> Result<Option<TimedReading>, FilesError> {
        for (readings, next) in &mut self.tracks {
            if next.is_none() {
                *next = readings.next().transpose()?;
            }
        }
        let due_ns = |(readings, next): &(Readings, Option<Reading>)| {
            let arrival_ns = next.as_ref()?.arrival_ns;
            Some(readings.waiting_ns().map_or(arrival_ns, |waiting_ns| arrival_ns.min(waiting_ns)))
        };
        let times = self.tracks.iter().enumerate().filter_map(|(i, track)| Some((due_ns(track)?, i)));
        let Some((at_ns, vehicle)) = times.min() else { return Ok(None) };
        let (readings, next) = &mut self.tracks[vehicle];
        let refused = readings.drain_refused();
        Ok(next.take().map(|reading| TimedReading { vehicle, at_ns, reading, refused }))
    }

    fn remarks(&mut self) -> Remarks {
        let mut remarks = Remarks::default();
        for (readings, _) in &mut self.tracks {
            remarks.truncated.extend_from_slice(readings.truncated());
            remarks.notes.extend_from_slice(readings.notes());
            remarks.refused.push(readings.drain_refused());
        }
        remarks.notes.extend(self.faults.notes());
        remarks
    }
}
