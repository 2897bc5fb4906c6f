//! Files and folders, in the order given -> readings. What a file is, its first bytes tell, else its name: pcap,
//! pcapng, MCAP, KITTI `.bin`, `.pcd`. A folder stands for the files in it, by name.

pub mod capture;
pub mod kitti;
pub mod mcap;

use std::collections::{BTreeSet, VecDeque};
use std::io::Read;
use std::path::{Path, PathBuf};

use clearway_mapping::event::Body;

use capture::CaptureError;
use kitti::ScanError;
use mcap::{McapError, Untold, Wanted};
use super::ros::Intake;
use crate::ingest::queue::Reading;

/// What a file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// pcap or pcapng.
    Capture,
    /// MCAP.
    Mcap,
    /// One scan: KITTI `.bin` or `.pcd`.
    Scan,
}

/// Why files cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    /// A file or folder cannot be opened.
    #[error("{}: {source}", file.display())]
    Open {
        /// Which.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file of no known kind.
    #[error("{}: not pcap, pcapng, MCAP, KITTI .bin or .pcd", file.display())]
    Kind {
        /// Which.
        file: PathBuf,
    },
    /// A bag in the older storage of ROS 2.
    #[error(
        "{}: a ROS 2 bag in sqlite3; MCAP is read: write `output_bags: [{{uri: converted, storage_id: mcap, all_topics: true}}]` \
         into convert.yaml, then `ros2 bag convert -i {} -o convert.yaml`",
        file.display(), file.display()
    )]
    Sqlite {
        /// Which.
        file: PathBuf,
    },
    /// A folder without any such file.
    #[error("{}: no pcap, pcapng, mcap, bin or pcd file in this folder", file.display())]
    Empty {
        /// Which.
        file: PathBuf,
    },
    /// A capture is damaged.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// An MCAP file is damaged.
    #[error(transparent)]
    Mcap(#[from] McapError),
    /// A scan cannot be read.
    #[error(transparent)]
    Scan(#[from] ScanError),
}

/// A file that ended in the middle of something; what came before was taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Truncated {
    /// Which.
    pub file: PathBuf,
    /// How it ended.
    pub reason: String,
}

/// The readings of several files; an iterator that stops at the first file that cannot be read.
pub struct Readings {
    files: VecDeque<(PathBuf, Kind)>,
    wanted: Wanted,
    /// Takes the ROS messages of the next file of a bag.
    intake: Option<Intake>,
    /// Messages refused in files already closed, and not told to the door yet.
    untold: Untold,
    open: Option<Open>,
    scans: u64,
    bytes_before: u64,
    /// Stamp of the newest reading behind which unfinished revolutions may be, and the sensors they may be of.
    pending_ends: (i64, BTreeSet<u16>),
    truncated: Vec<Truncated>,
    notes: Vec<String>,
    over: bool,
}

enum Open {
    Capture(PathBuf, Box<capture::Source>),
    Mcap(PathBuf, Box<mcap::Source>),
}

impl Readings {
    /// Looks at the files, without reading them yet; `wanted` is what is read of MCAP files.
    ///
    /// # Errors
    /// [`FilesError`] for the first file that is missing or of no known kind.
    pub fn open(files: &[PathBuf], wanted: Wanted) -> Result<Self, FilesError> {
        let mut all = VecDeque::new();
        for file in files {
            if file.is_dir() {
                all.extend(folder(file)?);
            } else {
                all.push_back((file.clone(), kind(file)?));
            }
        }
        Ok(Self {
            files: all,
            wanted,
            intake: None,
            untold: Untold::new(),
            open: None,
            scans: 0,
            bytes_before: 0,
            pending_ends: Default::default(),
            truncated: Vec::new(),
            notes: Vec::new(),
            over: false,
        })
    }

    /// The files still to be opened.
    pub fn files(&self) -> impl Iterator<Item = (&Path, Kind)> {
        self.files.iter().map(|(file, kind)| (file.as_path(), *kind))
    }

    /// Bytes of all files.
    pub fn bytes(&self) -> u64 {
        self.files.iter().filter_map(|(file, _)| file.metadata().ok()).map(|metadata| metadata.len()).sum()
    }

    /// Bytes read so far.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_before
            + match &self.open {
                None => 0,
                Some(Open::Capture(_, source)) => source.bytes_read(),
                Some(Open::Mcap(_, source)) => source.recording().bytes_read(),
            }
    }

    /// Files that ended in the middle of something.
    pub fn truncated(&self) -> &[Truncated] {
        &self.truncated
    }

    /// What else a reader should know: topics left alone, frames that were no datagrams.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Messages that were refused since this was last asked, before they became readings.
    pub fn untold(&mut self) -> Untold {
        let mut untold = std::mem::take(&mut self.untold);
        if let Some(Open::Mcap(_, source)) = &mut self.open {
            add(&mut untold, source.untold());
        }
        untold
    }

    fn read(&mut self) -> Result<Option<Reading>, FilesError> {
        loop {
            let next = match &mut self.open {
                None => None,
                Some(Open::Capture(_, source)) => source.next().transpose()?,
                Some(Open::Mcap(_, source)) => source.next().transpose()?,
            };
            if let Some(reading) = next {
                let journal = matches!(&self.open, Some(Open::Mcap(_, source)) if source.is_journal());
                self.await_end(&reading, journal);
                return Ok(Some(reading));
            }
            self.close();
            let Some((file, kind)) = self.files.pop_front() else {
                let (arrival_ns, sources) = &mut self.pending_ends;
                let (arrival_ns, source) = (*arrival_ns, sources.pop_first());
                return Ok(source.map(|source| Reading { arrival_ns, source, body: Body::End }));
            };
            match kind {
                Kind::Capture => self.open = Some(Open::Capture(file.clone(), Box::new(capture::Source::open(&file)?))),
                Kind::Mcap => {
                    let source = mcap::Source::open(&file, &self.wanted, self.intake.take())?;
                    self.open = Some(Open::Mcap(file, Box::new(source)));
                }
                Kind::Scan => {
                    let reading = kitti::read(&file, self.scans)?;
                    self.scans += 1;
                    self.bytes_before += file.metadata().map_or(0, |metadata| metadata.len());
                    self.await_end(&reading, false);
                    return Ok(Some(reading));
                }
            }
        }
    }

    /// Takes note of a sensor whose end the files do not tell, as a journal does.
    fn await_end(&mut self, reading: &Reading, is_journal: bool) {
        let (newest_ns, sources) = &mut self.pending_ends;
        *newest_ns = reading.arrival_ns;
        if is_journal {
            sources.clear();
        } else if matches!(reading.body, Body::Datagram(_) | Body::Scan(_)) {
            sources.insert(reading.source);
        }
    }

    /// Takes note of how the open file ended.
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
                if source.recording().is_cut() {
                    let reason = "the file ends without its closing records, as after a crash".into();
                    self.truncated.push(Truncated { file: file.clone(), reason });
                }
                self.notes.extend(source.notes().into_iter().map(|note| format!("{}: {note}", file.display())));
                add(&mut self.untold, source.untold());
                self.intake = source.into_intake();
            }
        }
    }
}

fn add(untold: &mut Untold, more: Untold) {
    more.into_iter().for_each(|(whose, count)| *untold.entry(whose).or_default() += count);
}

impl Iterator for Readings {
    type Item = Result<Reading, FilesError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.over {
            return None;
        }
        let next = self.read().transpose();
        self.over = !matches!(next, Some(Ok(_)));
        next
    }
}

/// What a file is.
///
/// # Errors
/// [`FilesError::Open`] where it cannot be read, [`FilesError::Kind`] where it is nothing known.
pub fn kind(file: &Path) -> Result<Kind, FilesError> {
    let mut magic = Vec::new();
    std::fs::File::open(file)
        .and_then(|open| open.take(8).read_to_end(&mut magic))
        .map_err(|source| FilesError::Open { file: file.to_owned(), source })?;
    match &magic[..] {
        // pcap in both byte orders, with micro- and nanoseconds; pcapng's section header.
        [0xd4, 0xc3, 0xb2, 0xa1, ..] | [0xa1, 0xb2, 0xc3, 0xd4, ..] => return Ok(Kind::Capture),
        [0x4d, 0x3c, 0xb2, 0xa1, ..] | [0xa1, 0xb2, 0x3c, 0x4d, ..] => return Ok(Kind::Capture),
        [0x0a, 0x0d, 0x0d, 0x0a, ..] => return Ok(Kind::Capture),
        [0x89, b'M', b'C', b'A', b'P', ..] => return Ok(Kind::Mcap),
        b"SQLite f" => return Err(FilesError::Sqlite { file: file.to_owned() }),
        _ => {}
    }
    // Without its magic a file is read as what its name says, and the reader says what is wrong with it.
    kind_by_name(file).ok_or_else(|| FilesError::Kind { file: file.to_owned() })
}

fn kind_by_name(file: &Path) -> Option<Kind> {
    match file.extension()?.to_str()? {
        "pcap" | "pcapng" => Some(Kind::Capture),
        "mcap" => Some(Kind::Mcap),
        "bin" | "pcd" => Some(Kind::Scan),
        _ => None,
    }
}

fn folder(folder: &Path) -> Result<Vec<(PathBuf, Kind)>, FilesError> {
    let open = |source| FilesError::Open { file: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(open)? {
        let file = entry.map_err(open)?.path();
        let bag = file.extension().is_some_and(|extension| extension == "db3");
        if file.is_file() && (bag || kind_by_name(&file).is_some()) {
            files.push((file.clone(), kind(&file)?));
        }
    }
    if files.is_empty() {
        return Err(FilesError::Empty { file: folder.to_owned() });
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bytes_tell_what_a_file_is_and_then_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str, bytes: &[u8]| {
            let file = folder.path().join(name);
            std::fs::write(&file, bytes).unwrap();
            file
        };
        assert_eq!(kind(&at("drive", &[0xd4, 0xc3, 0xb2, 0xa1, 2, 0])).unwrap(), Kind::Capture);
        assert_eq!(kind(&at("a.bin", &[0x89, b'M', b'C', b'A', b'P'])).unwrap(), Kind::Mcap);
        assert_eq!(kind(&at("b.bin", &[0; 16])).unwrap(), Kind::Scan);
        assert!(matches!(kind(&at("notes.txt", b"hello")), Err(FilesError::Kind { .. })));
        let bag = Readings::open(&[at("bag_0.db3", b"SQLite format 3\0").parent().unwrap().into()], Wanted::default());
        assert!(bag.err().unwrap().to_string().contains("ros2 bag convert -i"));
        assert!(matches!(kind(Path::new("/no/such/file")), Err(FilesError::Open { .. })));
    }

    #[test]
    fn a_folder_of_scans_is_read_by_name_and_ends_once() {
        let folder = tempfile::tempdir().unwrap();
        for (name, x) in [("1.bin", 1.0f32), ("0.bin", 0.0)] {
            let bytes: Vec<u8> = [x, 0.0, 0.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
            std::fs::write(folder.path().join(name), bytes).unwrap();
        }
        let readings: Vec<_> =
            Readings::open(&[folder.path().to_owned()], Wanted::default()).unwrap().collect::<Result<_, _>>().unwrap();
        let x = |reading: &Reading| match &reading.body {
            Body::Scan(scan) => scan.x[0],
            _ => f32::NAN,
        };
        assert_eq!(readings.len(), 3);
        assert_eq!((x(&readings[0]), x(&readings[1])), (0.0, 1.0));
        assert_eq!(readings[2].body, Body::End);
    }
}
