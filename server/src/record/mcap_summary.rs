//! The end of an MCAP file -> the schemas and channels that its summary repeats.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::Record;

use super::chunk::{RECORD_HEAD_BYTES, split_record};

/// Length of the fields of the footer.
const FOOTER_BYTES: usize = 20;
/// Greatest length of a summary that is read. Ours: a summary has about 100 bytes for each chunk.
const SUMMARY_BYTES_MAX: u64 = 256 << 20;

/// Reads the schemas and channels of the summary of a file, up to the first damage; none if the file is cut.
///
/// # Errors
/// If the file cannot be read.
pub(super) fn schemas_and_channels(file: &Path) -> io::Result<Vec<Record<'static>>> {
    let mut file = File::open(file)?;
    let length = file.metadata()?.len();
    let end_bytes = RECORD_HEAD_BYTES + FOOTER_BYTES + MAGIC.len();
    let footer_at = length.saturating_sub(end_bytes as u64);
    file.seek(SeekFrom::Start(footer_at))?;
    let mut end = Vec::new();
    (&mut file).take(end_bytes as u64).read_to_end(&mut end)?;
    let Ok(Record::Footer(footer)) = split_record(&mut &*end) else { return Ok(Vec::new()) };
    let summary_bytes = footer_at.saturating_sub(footer.summary_start);
    if footer.summary_start == 0 || summary_bytes > SUMMARY_BYTES_MAX {
        return Ok(Vec::new());
    }
    file.seek(SeekFrom::Start(footer.summary_start))?;
    let mut summary = Vec::new();
    file.take(summary_bytes).read_to_end(&mut summary)?;
    let (mut described, mut rest) = (Vec::new(), &*summary);
    while let Ok(record) = split_record(&mut rest) {
        if matches!(record, Record::Schema { .. } | Record::Channel(_)) {
            described.push(record.into_owned());
        }
    }
    Ok(described)
}
