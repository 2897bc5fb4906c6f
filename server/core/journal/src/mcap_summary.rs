//! The end of an MCAP file -> the schemas and channels that its summary repeats.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::{Record, op};

use super::chunk::{RECORD_HEAD_BYTES, split_record};

/// Length of the fields of the footer.
const FOOTER_BYTES: usize = 20;
/// The head of the record that ends the data; the CRC of the data follows it.
const DATA_END: [u8; RECORD_HEAD_BYTES] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0];
/// Greatest length of a summary that is read. Ours: a summary has about 100 bytes for each chunk.
const SUMMARY_BYTES_MAX: u64 = 16 << 20;

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
    if footer.summary_start == 0 {
        return Ok(Vec::new());
    }
    let from = footer_at.saturating_sub(SUMMARY_BYTES_MAX);
    file.seek(SeekFrom::Start(from))?;
    let mut tail = Vec::new();
    file.take(footer_at - from).read_to_end(&mut tail)?;
    // The summary begins behind the end of the data. The footer is wrong about where, if a part was cut out.
    let ends = tail.windows(DATA_END.len()).rposition(|bytes| bytes == DATA_END);
    let Some(mut rest) = ends.and_then(|end| tail.get(end + DATA_END.len() + size_of::<u32>()..)) else {
        return Ok(Vec::new());
    };
    let mut described = Vec::new();
    while let Ok(record) = split_record(&mut rest) {
        if matches!(record, Record::Schema { .. } | Record::Channel(_)) {
            described.push(record.into_owned());
        }
    }
    Ok(described)
}
