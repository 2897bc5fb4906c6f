//! A file -> its records, by the kind of the file: MCAP, or a ROS 2 bag in sqlite.

use std::collections::BTreeSet;
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

use mcap::records::Record;

#[cfg(feature = "sqlite")]
use super::bag_records::BagRecords;
use super::damage::LostPart;
use super::mcap_records::{FileEnd, McapRecords, McapSource, RecordsError};
use crate::file_advice::open_to_read;

/// First bytes of a bag in sqlite.
const SQLITE: &[u8] = b"SQLite format 3\0";

/// The records of a file while it is read.
pub(super) enum FileRecords {
    Mcap(Box<McapRecords>),
    #[cfg(feature = "sqlite")]
    Bag(Box<BagRecords>),
}

impl FileRecords {
    /// Opens a file: as a ROS 2 bag if its first bytes say so, else as MCAP.
    pub(super) fn open(path: &Path) -> Result<Self, RecordsError> {
        let mut file = open_to_read(path)?;
        let metadata = file.metadata()?;
        if metadata.is_file() && metadata.len() == 0 {
            return Err(Error::new(ErrorKind::UnexpectedEof, "the file is empty").into());
        }
        if metadata.is_file() {
            let mut start = Vec::new();
            (&mut file).take(SQLITE.len() as u64).read_to_end(&mut start)?;
            if start == SQLITE {
                return Ok(bag(path)?);
            }
        }
        Self::of_mcap(file)
    }

    /// The records of an MCAP file.
    pub(super) fn of_mcap(source: impl McapSource + 'static) -> Result<Self, RecordsError> {
        Ok(Self::Mcap(Box::new(McapRecords::open(Box::new(source))?)))
    }

    /// Number of bytes read so far.
    pub(super) fn offset(&self) -> u64 {
        match self {
            Self::Mcap(records) => records.offset(),
            #[cfg(feature = "sqlite")]
            Self::Bag(records) => records.bytes_read(),
        }
    }

    /// How the file ends, as far as it is read.
    pub(super) fn end(&self) -> FileEnd {
        match self {
            Self::Mcap(records) => records.end(),
            #[cfg(feature = "sqlite")]
            Self::Bag(records) => {
                FileEnd { is_closed: records.has_end(), has_all_data: records.has_end(), ..FileEnd::default() }
            }
        }
    }

    /// The parts so far that cannot be read.
    pub(super) fn lost(&self) -> &[LostPart] {
        match self {
            Self::Mcap(records) => records.lost(),
            #[cfg(feature = "sqlite")]
            Self::Bag(records) => records.lost(),
        }
    }

    /// The schemas and channels that the end of the file repeats; a second call returns none.
    pub(super) fn take_described(&mut self) -> Vec<Record<'static>> {
        match self {
            Self::Mcap(records) => records.take_described(),
            #[cfg(feature = "sqlite")]
            Self::Bag(_) => Vec::new(),
        }
    }

    /// The channels with a message; `None` if the file does not say.
    pub(super) fn with_messages(&self) -> Option<BTreeSet<u16>> {
        match self {
            Self::Mcap(records) => records.summary.with_messages.clone(),
            #[cfg(feature = "sqlite")]
            Self::Bag(records) => records.with_messages().ok(),
        }
    }

    /// The next record; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Record<'static>>, RecordsError> {
        match self {
            Self::Mcap(records) => records.next(),
            #[cfg(feature = "sqlite")]
            Self::Bag(records) => Ok(records.next()),
        }
    }
}

#[cfg(feature = "sqlite")]
fn bag(path: &Path) -> Result<FileRecords, Error> {
    let wrong = |error| Error::new(ErrorKind::InvalidData, format!("not a ROS 2 bag that can be read: {error}"));
    Ok(FileRecords::Bag(Box::new(BagRecords::open(path).map_err(wrong)?)))
}

#[cfg(not(feature = "sqlite"))]
fn bag(_: &Path) -> Result<FileRecords, Error> {
    let reason = "a ROS 2 bag in sqlite, and this clearway was built without the feature sqlite; `ros2 bag convert` \
        writes it as MCAP";
    Err(Error::new(ErrorKind::Unsupported, reason))
}
