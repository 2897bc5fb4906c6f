//! Files and folders, in the given order -> readings.
//!
//! The first bytes of a file give its kind, or else its name does: pcap, pcapng, MCAP, ROS 2 `.db3`, KITTI `.bin`,
//! nuScenes `.pcd.bin`, `.pcd`. A folder stands for its files in alphabetical order, and numbered files in the order of
//! their numbers: a bag or a recording in parts is one drive.
//!
//! | file | in -> out |
//! |---|---|
//! | `kinds` | file or folder -> files with their kinds, or why they cannot be read |
//! | [`capture`] | pcap, pcapng -> readings |
//! | [`mcap`] | recording or ROS 2 bag, in MCAP or sqlite -> readings |
//! | `late_poses` | readings of a bag -> the same, poses before the scans that wait for them |
//! | `unread_topics` | channels of a bag -> what is not read of them, and what helps |
//! | `pose_gap` | readings -> how far scans are from poses |
//! | [`ground_revolutions`] | revolutions -> the points from which a mount is estimated |
//! | [`kitti`] | one scan, `.bin`, `.pcd.bin` or `.pcd` -> reading |

pub mod capture;
pub mod ground_revolutions;
mod kinds;
pub mod kitti;
mod late_poses;
pub mod mcap;
mod pose_gap;
mod unread_topics;

use std::collections::{BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;
use clearway_mapping::scan_file::ScanFormat;

pub use kinds::{FilesError, Kind, Truncated, files_of_folder, kind, missing_parts};
use mcap::{Before, McapOptions, RefusedMessages};

/// Greatest time by which the files of a split bag overlap, in ns. Ours: recorders write what they have buffered.
const SPLIT_OVERLAP_NS_MAX: i64 = 5_000_000_000;

/// An iterator over the readings of several files; it ends with the error of the first file that cannot be read.
pub struct Readings {
    files: VecDeque<(PathBuf, Kind)>,
    options: McapOptions,
    /// What the next file may continue.
    before: Before,
    /// Refused messages of closed files that are not reported to the event queue yet.
    refused: RefusedMessages,
    open: Option<Open>,
    scans: u64,
    /// Format of the newest scan file.
    scan_format: Option<ScanFormat>,
    bytes_before: u64,
    /// Stamp of the newest reading, and the sensors that may have an unfinished revolution.
    pending_ends: (i64, BTreeSet<u16>),
    truncated: Vec<Truncated>,
    notes: Vec<String>,
    has_ended: bool,
    /// True until the first reading of the open file.
    is_file_new: bool,
    /// Stamp of the first reading of the open file.
    file_began_ns: i64,
}

enum Open {
    Capture(PathBuf, Box<capture::Source>),
    Mcap(PathBuf, Box<mcap::Source>),
}

impl Readings {
    /// Finds the kind of each file, without reading it; `options` apply to MCAP files.
    ///
    /// # Errors
    /// [`FilesError::Open`] if a file or folder cannot be opened, [`FilesError::Kind`] if a file is
    /// of another kind, [`FilesError::Empty`] if a folder has no suitable file.
    pub fn open(files: &[PathBuf], options: McapOptions) -> Result<Self, FilesError> {
        let (mut all, mut truncated) = (VecDeque::new(), Vec::new());
        for file in files {
            if file.is_dir() {
                all.extend(files_of_folder(file)?);
                truncated.extend(missing_parts(file));
            } else {
                all.push_back((file.clone(), kind(file)?));
            }
        }
        Ok(Self {
            files: all,
            options,
            before: Before::default(),
            refused: RefusedMessages::new(),
            open: None,
            scans: 0,
            scan_format: None,
            bytes_before: 0,
            pending_ends: Default::default(),
            truncated,
            notes: Vec::new(),
            has_ended: false,
            is_file_new: false,
            file_began_ns: i64::MIN,
        })
    }

    /// The files that are not open yet, with their kinds.
    pub fn files(&self) -> impl Iterator<Item = (&Path, Kind)> {
        self.files.iter().map(|(file, kind)| (file.as_path(), *kind))
    }

    /// Those of them that are MCAP files or bags.
    pub fn bag(&self) -> Vec<PathBuf> {
        self.files().filter(|(_, kind)| *kind == Kind::Mcap).map(|(file, _)| file.to_owned()).collect()
    }

    /// Number of bytes of these files.
    pub fn bytes(&self) -> u64 {
        self.files.iter().filter_map(|(file, _)| file.metadata().ok()).map(|metadata| metadata.len()).sum()
    }

    /// Number of bytes read so far.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_before
            + match &self.open {
                None => 0,
                Some(Open::Capture(_, source)) => source.bytes_read(),
                Some(Open::Mcap(_, source)) => source.recording().bytes_read(),
            }
    }

    /// Arrival of the first reading that waits, ns: the newest reading, which was logged later, is due with it.
    pub fn waiting_ns(&self) -> Option<i64> {
        match &self.open {
            Some(Open::Mcap(_, source)) => source.waiting_ns(),
            _ => None,
        }
    }

    /// Format of the newest scan file; `None` before the first.
    pub fn scan_format(&self) -> Option<ScanFormat> {
        self.scan_format
    }

    /// The truncated and damaged files so far.
    pub fn truncated(&self) -> &[Truncated] {
        &self.truncated
    }

    /// Topics and packets that were ignored or refused, for people.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Returns the messages since the last call that were refused before they became readings.
    pub fn drain_refused(&mut self) -> RefusedMessages {
        let mut refused = std::mem::take(&mut self.refused);
        if let Some(Open::Mcap(_, source)) = &mut self.open {
            add(&mut refused, source.drain_refused());
        }
        refused
    }

    fn read(&mut self) -> Result<Option<Reading>, FilesError> {
        loop {
            let next = match &mut self.open {
                None => None,
                Some(Open::Capture(_, source)) => source.next().transpose()?,
                Some(Open::Mcap(_, source)) => source.next().transpose()?,
            };
            if let Some(reading) = next {
                let is_journal = matches!(&self.open, Some(Open::Mcap(_, source)) if source.is_journal());
                self.check_overlap(&reading)?;
                self.note_unfinished(&reading, is_journal);
                return Ok(Some(reading));
            }
            self.close();
            let Some((file, kind)) = self.files.pop_front() else {
                let (arrival_ns, sources) = &mut self.pending_ends;
                let (arrival_ns, source) = (*arrival_ns, sources.pop_first());
                return Ok(source.map(|source| Reading { arrival_ns, source, body: Body::End }));
            };
            self.is_file_new = true;
            match kind {
                Kind::Capture => self.open = Some(Open::Capture(file.clone(), Box::new(capture::Source::open(&file)?))),
                Kind::Mcap => {
                    let before = std::mem::take(&mut self.before);
                    let source = mcap::Source::open(&file, &self.options, before, &self.bag())?;
                    self.open = Some(Open::Mcap(file, Box::new(source)));
                }
                Kind::Scan => {
                    let (format, reading) = kitti::read_with_format(&file, self.scans)?;
                    self.scan_format = Some(format);
                    self.scans += 1;
                    self.bytes_before += file.metadata().map_or(0, |metadata| metadata.len());
                    self.note_unfinished(&reading, false);
                    return Ok(Some(reading));
                }
            }
        }
    }

    /// Refuses a file whose first reading is older than the last of the file before. The events of a recording stand in
    /// the order in which the engine took them, also from part to part. The files of a split bag may overlap a little;
    /// a file that begins no later than the file before it has the same drive.
    fn check_overlap(&mut self, reading: &Reading) -> Result<(), FilesError> {
        if !std::mem::take(&mut self.is_file_new) {
            return Ok(());
        }
        let (file, is_bag) = match &self.open {
            Some(Open::Capture(file, _)) => (file, false),
            Some(Open::Mcap(file, source)) if !source.is_later_part() => (file, !source.is_journal()),
            _ => return Ok(()),
        };
        let newest_ns = self.pending_ends.0;
        let began_ns = std::mem::replace(&mut self.file_began_ns, reading.arrival_ns);
        let may_overlap = is_bag
            && reading.arrival_ns > began_ns
            && newest_ns.saturating_sub(reading.arrival_ns) <= SPLIT_OVERLAP_NS_MAX;
        if reading.arrival_ns < newest_ns && !may_overlap {
            let overlap_s = (newest_ns - reading.arrival_ns) as f64 * 1e-9;
            return Err(FilesError::Overlap { file: file.clone(), overlap_s });
        }
        Ok(())
    }

    /// Remembers the sensor of a reading, whose last revolution may need an end. A journal contains the ends itself.
    fn note_unfinished(&mut self, reading: &Reading, is_journal: bool) {
        let (newest_ns, sources) = &mut self.pending_ends;
        *newest_ns = reading.arrival_ns;
        if is_journal {
            sources.clear();
        } else if matches!(reading.body, Body::Datagram(_) | Body::Scan(_)) {
            sources.insert(reading.source);
        }
    }

    /// Closes the open file and remembers how it ended.
    fn close(&mut self) {
        self.bytes_before = self.bytes_read();
        match self.open.take() {
            None => {}
            Some(Open::Capture(file, source)) => {
                if let Some(reason) = source.truncated() {
                    self.truncated.push(Truncated { file: file.clone(), reason });
                }
                self.notes.extend(source.notes().into_iter().map(|note| format!("{}: {note}", file.display())));
            }
            Some(Open::Mcap(file, mut source)) => {
                if let Some(reason) = source.recording().incomplete() {
                    self.truncated.push(Truncated { file: file.clone(), reason });
                }
                self.notes.extend(source.notes().into_iter().map(|note| format!("{}: {note}", file.display())));
                add(&mut self.refused, source.drain_refused());
                self.before = source.into_before();
            }
        }
    }
}

fn add(refused: &mut RefusedMessages, more: RefusedMessages) {
    more.into_iter().for_each(|(key, count)| *refused.entry(key).or_default() += count);
}

impl Iterator for Readings {
    type Item = Result<Reading, FilesError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.has_ended {
            return None;
        }
        let next = self.read().transpose();
        self.has_ended = !matches!(next, Some(Ok(_)));
        next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_scans_is_read_in_order_and_ends_once() {
        let folder = tempfile::tempdir().unwrap();
        for (name, x) in [("1.bin", 1.0f32), ("0.bin", 0.0)] {
            let bytes: Vec<u8> = [x, 0.0, 0.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
            std::fs::write(folder.path().join(name), bytes).unwrap();
        }
        let readings: Vec<_> = Readings::open(&[folder.path().to_owned()], McapOptions::default())
            .unwrap()
            .collect::<Result<_, _>>()
            .unwrap();
        let x = |reading: &Reading| match &reading.body {
            Body::Scan(scan) => scan.x[0],
            _ => f32::NAN,
        };
        assert_eq!(readings.len(), 3);
        assert_eq!((x(&readings[0]), x(&readings[1])), (0.0, 1.0));
        assert_eq!(readings[2].body, Body::End);
    }
}
