//! Damaged copies of a recording: whether the reader names the damage and loses no more than the damaged chunk, and
//! whether the repaired copy has all the rest and verifies.

use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use clearway_daemon::record::verify;
use clearway_journal::mcap_reader::{McapReadError, McapReader, Message};
use clearway_journal::repair::{RepairError, repair};
use mcap::MAGIC;
use mcap::records::op;

/// Length of the record that ends the data of a file.
const DATA_END_BYTES: usize = 13;

/// A whole recording, from which damaged copies are made.
pub struct Original {
    bytes: Arc<[u8]>,
    /// A hash of each message, in file order.
    messages: Vec<u32>,
    /// The messages of each chunk, as indices.
    chunks: Vec<Range<usize>>,
    /// The end of each chunk in the file, in bytes.
    ends: Vec<usize>,
    /// The start of each record outside of chunks, in bytes.
    records: Vec<usize>,
}

/// What was read of a damaged copy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DamageOutcome {
    /// True if the file was refused as a whole, by name.
    pub refused: bool,
    /// Number of messages that were not read.
    pub lost: u64,
    /// Number of lost messages that the report names with their topic.
    pub named: u64,
    /// True if the copy was repaired, and the new file is whole and verifies.
    pub repaired: bool,
}

impl Original {
    /// Reads a whole recording.
    ///
    /// # Errors
    /// If it is not whole.
    pub fn read(bytes: Vec<u8>) -> Result<Self, String> {
        let summary = mcap::Summary::read(&bytes).map_err(|error| error.to_string())?.ok_or("no summary")?;
        let (mut indexes, mut chunks, mut ends, mut from) = (summary.chunk_indexes.clone(), Vec::new(), Vec::new(), 0);
        indexes.sort_by_key(|index| index.chunk_start_offset);
        for index in &indexes {
            let end = from + summary.stream_chunk(&bytes, index).map_err(|error| error.to_string())?.count();
            chunks.push(from..end);
            ends.push((index.chunk_start_offset + index.chunk_length) as usize);
            from = end;
        }
        let records = records(&bytes).into_iter().map(|(_, at)| at).collect();
        let bytes: Arc<[u8]> = bytes.into();
        let (messages, incomplete) = messages_of(reader(bytes.clone(), bytes.len())?)?;
        match incomplete {
            Some(incomplete) => Err(incomplete),
            None => Ok(Self { bytes, messages, chunks, ends, records }),
        }
    }

    /// Length of the recording, in bytes.
    pub fn length(&self) -> usize {
        self.bytes.len()
    }

    /// Number of chunks with messages.
    pub fn chunks(&self) -> usize {
        self.chunks.iter().filter(|chunk| !chunk.is_empty()).count()
    }

    /// The bytes within `distance` of the start of a record, at most as many as the file has.
    pub fn near_records(&self, distance: usize) -> Vec<usize> {
        let near = |at: &usize| at.saturating_sub(distance)..(at + distance + 1).min(self.length());
        let mut bytes: Vec<usize> = self.records.iter().flat_map(near).collect();
        bytes.sort_unstable();
        bytes.dedup();
        bytes
    }

    /// The messages of the chunks that end within the first `length` bytes: what a cut must not cost.
    fn before(&self, length: usize) -> &[u32] {
        let whole = self.ends.iter().zip(&self.chunks).take_while(|(end, _)| **end <= length);
        &self.messages[..whole.last().map_or(0, |(_, chunk)| chunk.end)]
    }

    /// Reads the first `length` bytes.
    ///
    /// # Errors
    /// If the cut is not named, or a message of a whole chunk before it is lost, or one is read that was not recorded.
    pub fn cut(&self, length: usize) -> Result<DamageOutcome, String> {
        let read = match reader(self.bytes.clone(), length) {
            Ok(read) => read,
            Err(_) if length < MAGIC.len() => return Ok(DamageOutcome { refused: true, ..DamageOutcome::default() }),
            Err(error) => return Err(error),
        };
        let (messages, incomplete) = messages_of(read)?;
        incomplete.ok_or("the cut is not named")?;
        let expected = self.before(length);
        if messages != expected {
            return Err(format!("{} messages are read, and {} are before the cut", messages.len(), expected.len()));
        }
        Ok(DamageOutcome { lost: (self.messages.len() - messages.len()) as u64, ..DamageOutcome::default() })
    }

    /// Writes the first `length` bytes to a file in `folder`, repairs it, and verifies the repaired file.
    ///
    /// # Errors
    /// As [`Original::cut`], of the repaired file; and if it is not whole or a map in it differs.
    pub fn repair_cut(&self, length: usize, folder: &Path) -> Result<DamageOutcome, String> {
        let file = folder.join("cut.mcap");
        std::fs::write(&file, &self.bytes[..length]).map_err(|error| error.to_string())?;
        let Some(messages) = repaired(&file)? else {
            return match self.before(length) {
                [] => Ok(DamageOutcome { refused: true, ..DamageOutcome::default() }),
                lost => Err(format!("{} messages are before the cut, and nothing is repaired", lost.len())),
            };
        };
        if messages != self.before(length) {
            return Err(format!("{} messages are repaired, and not those before the cut", messages.len()));
        }
        let lost = (self.messages.len() - messages.len()) as u64;
        Ok(DamageOutcome { lost, repaired: true, ..DamageOutcome::default() })
    }

    /// Writes the first `length` bytes to a file in `folder`, and runs `info`, `verify` and `repair` of the program
    /// `clearway` on it.
    ///
    /// # Errors
    /// If a command ends with another exit code than it should, does not name the file, or panics.
    pub fn cut_by_program(&self, length: usize, clearway: &Path, folder: &Path) -> Result<DamageOutcome, String> {
        let (file, repaired) = (folder.join("cut.mcap"), folder.join("repaired.mcap"));
        std::fs::write(&file, &self.bytes[..length]).map_err(|error| error.to_string())?;
        let run = |command: &str, files: &[&Path], expected: i32| {
            let output = Command::new(clearway).arg(command).args(files).output().map_err(|error| error.to_string())?;
            let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
            let is_right = output.status.code() == Some(expected);
            if is_right { Ok(said) } else { Err(format!("cut {length}: {command}: {}: {said}", output.status)) }
        };
        for command in ["info", "verify"] {
            let said = run(command, &[&file], 2)?;
            if !said.contains("cut.mcap") {
                return Err(format!("cut {length}: {command} does not name the file: {said}"));
            }
        }
        let kept = self.before(length).len();
        // What follows the end of the data repeats what is before it.
        let data_end = records(&self.bytes).into_iter().find(|(kind, _)| *kind == op::DATA_END);
        let has_all = data_end.is_some_and(|(_, at)| length >= at + DATA_END_BYTES);
        let expected = if has_all { 0 } else { 1 + i32::from(kept == 0) };
        run("repair", &[&file, &repaired], expected)?;
        if kept > 0 {
            run("info", &[&repaired], 0)?;
            run("verify", &[&repaired], 0)?;
            std::fs::remove_file(&repaired).map_err(|error| error.to_string())?;
        }
        Ok(DamageOutcome { lost: (self.messages.len() - kept) as u64, repaired: kept > 0, ..DamageOutcome::default() })
    }

    /// Copies the recording to `file`.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn copy(&self, file: &Path) -> Result<Copy, String> {
        std::fs::write(file, &self.bytes).map_err(|error| error.to_string())?;
        Ok(Copy { file: file.to_owned() })
    }
}

/// A copy of a recording with one bit changed at a time.
pub struct Copy {
    file: PathBuf,
}

impl Copy {
    /// Changes bit `bit` of the byte at `at`, reads the copy, and changes the bit back.
    ///
    /// # Errors
    /// If the change is not named, or costs more than the chunk that it is in, or a message is read that was not
    /// recorded.
    pub fn flip(&self, original: &Original, at: usize, bit: u8) -> Result<DamageOutcome, String> {
        let byte = original.bytes[at];
        self.write(at, byte ^ (1 << bit))?;
        let outcome = self.read(original);
        self.write(at, byte)?;
        outcome.map_err(|error| format!("byte {at}, bit {bit}: {error}"))
    }

    fn write(&self, at: usize, byte: u8) -> Result<(), String> {
        let mut file = std::fs::OpenOptions::new().write(true).open(&self.file).map_err(|error| error.to_string())?;
        file.seek(SeekFrom::Start(at as u64)).and_then(|_| file.write_all(&[byte])).map_err(|error| error.to_string())
    }

    fn read(&self, original: &Original) -> Result<DamageOutcome, String> {
        let name = self.file.display().to_string();
        let mut reader = match McapReader::open(&self.file) {
            Ok(reader) => reader,
            Err(error) => return refused(&error, &name),
        };
        let messages = reader.by_ref().map(|message| message.map(|message| hash(&message)));
        let messages = match messages.collect::<Result<Vec<_>, _>>() {
            Ok(messages) => messages,
            Err(error) => return refused(&error, &name),
        };
        reader.incomplete().ok_or("the change is not named")?;
        let lost = original.messages.len().checked_sub(messages.len()).ok_or("more messages than were recorded")?;
        let same = original.messages.iter().zip(&messages).take_while(|(was, is)| was == is).count();
        // What is lost is one chunk, or nothing; the messages after it are all there.
        let is_one_chunk = |chunk: &Range<usize>| chunk.len() == lost && chunk.contains(&same);
        let chunk = original.chunks.iter().find(|chunk| is_one_chunk(chunk));
        let from = chunk.map_or(same, |chunk| chunk.start);
        if lost > 0 && chunk.is_none() || messages[from..] != original.messages[from + lost..] {
            return Err(format!(
                "{lost} messages are lost after {same}, which is not one chunk: {:?}",
                reader.damages()
            ));
        }
        let named = reader.damages().iter().flat_map(|damage| damage.messages.values()).sum();
        let is_repaired = match repaired(&self.file)? {
            Some(kept) if kept != messages => return Err("the repaired file has other messages".into()),
            kept => kept.is_some(),
        };
        Ok(DamageOutcome { refused: false, lost: lost as u64, named, repaired: is_repaired })
    }
}

/// The file `name` is refused by this error: its first bytes, or the version in its metadata or in the name of a
/// schema, are changed.
fn refused(error: &McapReadError, name: &str) -> Result<DamageOutcome, String> {
    let is_of_damage = matches!(error, McapReadError::NotMcap { .. } | McapReadError::Version { .. });
    match is_of_damage && error.to_string().contains(name) {
        true => Ok(DamageOutcome { refused: true, ..DamageOutcome::default() }),
        false => Err(format!("{name}: {error}")),
    }
}

/// Repairs `file`, verifies the new file and removes it; returns its messages, or `None` if there is no message.
///
/// # Errors
/// If a map in the new file differs, or it is not whole, or there is a new file although nothing was repaired.
fn repaired(file: &Path) -> Result<Option<Vec<u32>>, String> {
    let output = file.with_extension("repaired.mcap");
    match repair(file, &output) {
        Ok(_) => {}
        Err(RepairError::Nothing { .. } | RepairError::Read(_)) if !output.exists() => return Ok(None),
        Err(error) => return Err(format!("repair: {error}")),
    }
    let (messages, incomplete) = messages_of(McapReader::open(&output).map_err(|error| error.to_string())?)?;
    // A repaired file whose configuration is lost has messages and no maps that could be made again.
    let report = verify(&output).map_err(|error| error.to_string());
    std::fs::remove_file(&output).map_err(|error| error.to_string())?;
    match (incomplete, report) {
        (Some(incomplete), _) => Err(format!("the repaired file is {incomplete}")),
        (None, Ok(report)) if report.different > 0 => {
            Err(format!("the repaired file does not verify: {}", report.differences[0]))
        }
        (None, Err(error)) if !error.contains("config") => Err(format!("the repaired file does not verify: {error}")),
        (None, _) => Ok(Some(messages)),
    }
}

/// The kind and the start of each record outside of chunks.
pub fn records(bytes: &[u8]) -> Vec<(u8, usize)> {
    let (mut at, mut found) = (MAGIC.len(), Vec::new());
    while at + 9 <= bytes.len() {
        found.push((bytes[at], at));
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
    }
    found
}

fn reader(bytes: Arc<[u8]>, length: usize) -> Result<McapReader, String> {
    let source = Cursor::new(bytes).take(length as u64);
    McapReader::from_source(Path::new("damaged.mcap"), source).map_err(|error| error.to_string())
}

/// A hash of each message, and how the file is incomplete.
fn messages_of(mut reader: McapReader) -> Result<(Vec<u32>, Option<String>), String> {
    let messages = reader.by_ref().map(|message| message.map(|message| hash(&message)));
    let messages = messages.collect::<Result<_, _>>().map_err(|error| error.to_string())?;
    Ok((messages, reader.incomplete()))
}

fn hash(message: &Message) -> u32 {
    let mut hash = crc32fast::Hasher::new();
    hash.update(message.channel.topic.as_bytes());
    hash.update(&message.log_ns.to_le_bytes());
    hash.update(&message.data);
    hash.finalize()
}

/// The same recording in chunks of about `chunk_bytes` bytes before compression.
///
/// # Errors
/// If the recording is not whole.
pub fn rechunk(bytes: &[u8], chunk_bytes: u64) -> mcap::McapResult<Vec<u8>> {
    rewritten(bytes, mcap::WriteOptions::new().chunk_size(Some(chunk_bytes)).compression_threads(0))
}

/// The same recording, written with these options.
///
/// # Errors
/// If the recording is not whole.
pub fn rewritten(bytes: &[u8], options: mcap::WriteOptions) -> mcap::McapResult<Vec<u8>> {
    let messages = mcap::MessageStream::new(bytes)?.collect::<mcap::McapResult<Vec<_>>>()?;
    with_messages(bytes, &messages, options)
}

/// The metadata and attachments of a recording with these messages, written with these options.
///
/// # Errors
/// If the recording is not whole.
pub fn with_messages(
    bytes: &[u8],
    messages: &[mcap::Message<'_>],
    options: mcap::WriteOptions,
) -> mcap::McapResult<Vec<u8>> {
    let mut writer = options.create(Cursor::new(Vec::new()))?;
    for record in mcap::read::LinearReader::new(bytes)? {
        match record? {
            mcap::records::Record::Metadata(metadata) => writer.write_metadata(&metadata)?,
            mcap::records::Record::Attachment { header, data, .. } => {
                let mcap::records::AttachmentHeader { log_time, create_time, name, media_type } = header;
                writer.attach(&mcap::Attachment { log_time, create_time, name, media_type, data })?;
            }
            _ => {}
        }
    }
    for message in messages {
        writer.write(message)?;
    }
    writer.finish()?;
    Ok(writer.into_inner().into_inner())
}
