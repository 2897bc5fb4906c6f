//! Damaged copies of a recording, and whether the reader names the damage and loses no more than the damaged chunk.

use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clearway::record::mcap_reader::{McapReader, Message};

/// A whole recording.
pub struct Original {
    bytes: Arc<[u8]>,
    /// A hash of each message, in file order.
    messages: Vec<u32>,
    /// The messages of each chunk, as indices.
    chunks: Vec<Range<usize>>,
}

/// What was read of a damaged copy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// True if the file was refused as a whole, by name.
    pub refused: bool,
    /// Number of messages that were not read.
    pub lost: u64,
    /// Number of lost messages that the report names with their topic.
    pub named: u64,
}

impl Original {
    /// Reads a whole recording.
    ///
    /// # Errors
    /// If it is not whole.
    pub fn read(bytes: Vec<u8>) -> Result<Self, String> {
        let summary = mcap::Summary::read(&bytes).map_err(|error| error.to_string())?.ok_or("no summary")?;
        let (mut indexes, mut chunks, mut from) = (summary.chunk_indexes.clone(), Vec::new(), 0);
        indexes.sort_by_key(|index| index.chunk_start_offset);
        for index in &indexes {
            let end = from + summary.stream_chunk(&bytes, index).map_err(|error| error.to_string())?.count();
            chunks.push(from..end);
            from = end;
        }
        let bytes: Arc<[u8]> = bytes.into();
        let (messages, incomplete) = messages_of(reader(bytes.clone(), bytes.len())?)?;
        match incomplete {
            Some(incomplete) => Err(incomplete),
            None => Ok(Self { bytes, messages, chunks }),
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

    /// Reads the first `length` bytes.
    ///
    /// # Errors
    /// If the cut is not named, or a whole chunk before it is lost.
    pub fn cut(&self, length: usize) -> Result<Outcome, String> {
        let read = match reader(self.bytes.clone(), length) {
            Ok(read) => read,
            // Shorter than the magic bytes.
            Err(_) if length < 8 => return Ok(Outcome { refused: true, ..Outcome::default() }),
            Err(error) => return Err(error),
        };
        let (messages, incomplete) = messages_of(read)?;
        incomplete.ok_or("the cut is not named")?;
        let is_boundary = messages.is_empty() || self.chunks.iter().any(|chunk| chunk.end == messages.len());
        if messages[..] != self.messages[..messages.len().min(self.messages.len())] || !is_boundary {
            return Err("the messages before the cut are not those of whole chunks".into());
        }
        Ok(Outcome { lost: (self.messages.len() - messages.len()) as u64, ..Outcome::default() })
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

/// A copy of a recording, one bit of which is changed at a time.
pub struct Copy {
    file: PathBuf,
}

impl Copy {
    /// Changes bit `bit` of the byte at `at`, reads the copy, and changes the bit back.
    ///
    /// # Errors
    /// If the change is not named, or costs more than the chunk that it is in, or a message is read that was not
    /// recorded.
    pub fn flip(&self, original: &Original, at: usize, bit: u8) -> Result<Outcome, String> {
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

    fn read(&self, original: &Original) -> Result<Outcome, String> {
        let mut reader = match McapReader::open(&self.file) {
            Ok(reader) => reader,
            Err(error) if error.to_string().contains(&self.file.display().to_string()) => {
                return Ok(Outcome { refused: true, ..Outcome::default() });
            }
            Err(error) => return Err(error.to_string()),
        };
        let mut messages = Vec::new();
        for message in reader.by_ref() {
            match message {
                Ok(message) => messages.push(hash(&message)),
                Err(_) => return Ok(Outcome { refused: true, ..Outcome::default() }),
            }
        }
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
        Ok(Outcome { refused: false, lost: lost as u64, named })
    }
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
    let options = mcap::WriteOptions::new().chunk_size(Some(chunk_bytes)).compression_threads(0);
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
    for message in mcap::MessageStream::new(bytes)? {
        writer.write(&message?)?;
    }
    writer.finish()?;
    Ok(writer.into_inner().into_inner())
}
