//! A ROS 2 bag in sqlite (`.db3`) -> the records that an MCAP file of the same messages would have, in the order of
//! their times. Nothing is written beside the bag: where SQLite would, it reads a copy. A bag is a file of others: only
//! plain tables are read, of values and in queries that are limited.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::File;
use std::io::{Error, Read};
use std::path::{Path, PathBuf};

use mcap::records::{Channel, MessageHeader, Record, SchemaHeader};
use rusqlite::limits::Limit;
use rusqlite::{Connection, Error as SqlError, OpenFlags, OptionalExtension, params};
use tempfile::TempDir;

use super::chunk::{RECORD_BYTES_MAX, may_decompress};
use super::damage::LostPart;
use crate::counted::counted;

/// Number of messages that are read at once. Ours: a message of points has about a megabyte.
const BATCH: i64 = 1024;
/// The messages after a time and an id.
const BY_TIME: &str = "SELECT id, topic_id, timestamp, data FROM messages WHERE (timestamp, id) > (?1, ?2) \
    ORDER BY timestamp, id LIMIT ?3";
/// The message of a row.
const BY_ROW: &str = "SELECT id, topic_id, timestamp, data FROM messages WHERE rowid = ?1";
/// Most messages of a bag without an index of the times: their order is kept in memory, 8 bytes for each. Ours: rosbag2
/// and every library that writes bags makes the index.
const UNSORTED_MAX: usize = 250_000;
/// Longest name of a topic, a type or an encoding, in bytes. Ours: names of ROS 2 are shorter.
const NAME_BYTES_MAX: usize = 1024;
/// Number of bytes of messages after which no more are read at once.
const BATCH_BYTES: usize = 16 << 20;
/// Most steps of a query in SQLite's machine. Ours: with an index of the times a batch takes 30 for each message of the
/// batch; without it, the order takes some 50 for each message of the bag.
const QUERY_STEPS_MAX: i32 = 1_000_000_000;
/// The first of the two tables that is a view, of a module, or has columns that are computed when they are read.
const NOT_PLAIN: &str = "SELECT name FROM pragma_table_list AS listed WHERE lower(name) IN ('topics', 'messages') AND \
    (type <> 'table' OR EXISTS (SELECT 1 FROM pragma_table_xinfo(listed.name) WHERE hidden > 0))";
/// True if no index begins with the times.
const NOT_SORTED: &str = "SELECT NOT EXISTS (SELECT 1 FROM pragma_index_list('messages') AS listed, \
    pragma_index_info(listed.name) AS info WHERE NOT partial AND seqno = 0 AND lower(info.name) = 'timestamp')";
/// First bytes of a message that rosbag2 has compressed with zstd. No message in CDR starts with them.
const ZSTD: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];

/// A bag while it is read.
pub(super) struct BagRecords {
    bag: Connection,
    /// Holds the copy that is read; removed after the connection.
    _copy: Option<TempDir>,
    waiting: VecDeque<Record<'static>>,
    /// Rows of the messages in the order of their times, if no index has it.
    order: Option<std::vec::IntoIter<i64>>,
    /// Time and id of the newest message.
    newest: (i64, i64),
    bytes_read: u64,
    /// Bytes of the messages so far, decompressed.
    decompressed: u64,
    has_ended: bool,
    lost: Vec<LostPart>,
}

impl BagRecords {
    /// Opens a bag and reads its topics.
    ///
    /// # Errors
    /// If it is not a bag, or its tables cannot be read.
    pub(super) fn open(file: &Path) -> rusqlite::Result<Self> {
        let copied = |error: Error| {
            let advice = "the bag has a -wal of a crash, and reading it needs a copy of both files in the folder for \
                          temporary files (TMPDIR)";
            let code = rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_CANTOPEN);
            rusqlite::Error::SqliteFailure(code, Some(format!("{advice}: {error}")))
        };
        let (file, copy, is_unchanging) = readable(file).map_err(copied)?;
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut bag = match is_unchanging {
            true => {
                let uri = format!("file:{}?immutable=1", percent_encoded(&file));
                Connection::open_with_flags(uri, flags | OpenFlags::SQLITE_OPEN_URI)?
            }
            false => Connection::open_with_flags(&file, flags)?,
        };
        bag.set_limit(Limit::SQLITE_LIMIT_LENGTH, RECORD_BYTES_MAX as i32)?;
        bag.progress_handler(QUERY_STEPS_MAX, Some(|| true))?;
        if let Some(name) = bag.query_row(NOT_PLAIN, [], |row| row.get::<_, String>(0)).optional()? {
            return Err(refused(format!("{name:?} is no plain table")));
        }
        let is_unsorted: bool = bag.query_row(NOT_SORTED, [], |row| row.get(0))?;
        let mut waiting = VecDeque::new();
        let mut topics = bag.prepare("SELECT id, name, type, serialization_format FROM topics ORDER BY id")?;
        let mut rows = topics.query([])?;
        while let Some(row) = rows.next()? {
            let (id, topic, name, encoding): (_, String, String, String) =
                (row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?);
            if let Some(long) = [&topic, &name, &encoding].into_iter().find(|text| text.len() > NAME_BYTES_MAX) {
                return Err(refused(format!("a name of {} bytes, of at most {NAME_BYTES_MAX}", long.len())));
            }
            // Some recorders leave out the name of the only encoding that ROS 2 has.
            let message_encoding = if encoding.is_empty() { "cdr".to_owned() } else { encoding };
            // A bag has no definitions of its types; an empty encoding says so.
            let header = SchemaHeader { id, name, encoding: String::new() };
            waiting.push_back(Record::Schema { header, data: Vec::new().into() });
            let channel = Channel { id, schema_id: id, topic, message_encoding, metadata: BTreeMap::new() };
            waiting.push_back(Record::Channel(channel));
        }
        drop(rows);
        drop(topics);
        let order = if is_unsorted { Some(rows_by_time(&bag)?.into_iter()) } else { None };
        let newest = (i64::MIN, i64::MIN);
        let (bytes_read, decompressed) = (0, 0);
        Ok(Self {
            bag,
            _copy: copy,
            waiting,
            order,
            newest,
            bytes_read,
            decompressed,
            has_ended: false,
            lost: Vec::new(),
        })
    }

    /// Number of bytes of the messages so far.
    pub(super) fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// True if the bag was read to its end.
    pub(super) fn has_end(&self) -> bool {
        self.has_ended && self.lost.is_empty()
    }

    /// The part that cannot be read.
    pub(super) fn lost(&self) -> &[LostPart] {
        &self.lost
    }

    /// The topics with a message.
    ///
    /// # Errors
    /// If the table cannot be read.
    pub(super) fn with_messages(&self) -> rusqlite::Result<BTreeSet<u16>> {
        let mut topics = self.bag.prepare("SELECT DISTINCT topic_id FROM messages")?;
        topics.query_map([], |row| row.get(0))?.collect()
    }

    /// The next record; `None` at the end.
    pub(super) fn next(&mut self) -> Option<Record<'static>> {
        if self.waiting.is_empty()
            && !self.has_ended
            && let Err(error) = self.read_batch()
        {
            // The pages of a table hang on each other: what follows a damaged page cannot be found.
            self.has_ended = true;
            let left = self.messages_left().map_or(String::new(), |left| format!("{} ", counted(left, "message")));
            let after =
                if self.newest.0 > i64::MIN { format!("after the time {} ", self.newest.0) } else { String::new() };
            let reason = format!("{left}{after}cannot be read: {error}");
            let bytes = (self.bytes_read, self.bytes_read);
            self.lost.push(LostPart::new(bytes, reason, true));
        }
        self.waiting.pop_front()
    }

    /// Number of messages after the newest one, by the index of the times, if that can be read.
    fn messages_left(&self) -> Option<u64> {
        let count = "SELECT COUNT(*) FROM messages WHERE timestamp > ?1";
        let left: i64 = self.bag.query_row(count, [self.newest.0], |row| row.get(0)).ok()?;
        u64::try_from(left).ok()
    }

    fn read_batch(&mut self) -> rusqlite::Result<()> {
        let mut messages = self.bag.prepare(if self.order.is_some() { BY_ROW } else { BY_TIME })?;
        let mut rows = match &mut self.order {
            // After the last row there is none.
            Some(order) => messages.query([order.next()])?,
            None => messages.query(params![self.newest.0, self.newest.1, BATCH])?,
        };
        self.has_ended = true;
        let mut bytes = 0;
        while bytes < BATCH_BYTES
            && let Some(row) = rows.next()?
        {
            let (id, channel_id, time): (i64, u16, i64) = (row.get(0)?, row.get(1)?, row.get(2)?);
            let data: Vec<u8> = row.get(3)?;
            self.bytes_read += data.len() as u64;
            let data = if data.starts_with(ZSTD) { decompressed(&data)? } else { data };
            self.decompressed += data.len() as u64;
            if !may_decompress(self.decompressed, self.bytes_read) {
                return Err(refused("the bag decompresses to far too much".into()));
            }
            bytes += data.len();
            let log_time = u64::try_from(time).unwrap_or(0);
            let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time: log_time };
            self.waiting.push_back(Record::Message { header, data: data.into() });
            self.newest = (time, id);
            self.has_ended = false;
        }
        Ok(())
    }
}

/// The rows of all messages in the order of their times.
///
/// # Errors
/// If there are more than [`UNSORTED_MAX`], or the table cannot be read.
fn rows_by_time(bag: &Connection) -> rusqlite::Result<Vec<i64>> {
    let mut rows = bag.prepare("SELECT rowid FROM messages ORDER BY timestamp, id LIMIT ?1")?;
    let rows: Vec<_> = rows.query_map([UNSORTED_MAX as i64 + 1], |row| row.get(0))?.collect::<Result<_, _>>()?;
    if rows.len() > UNSORTED_MAX {
        let advice = "sqlite3 BAG 'CREATE INDEX timestamp_idx ON messages (timestamp)' makes it, as rosbag2 does";
        let what = "its messages have no index of their times";
        return Err(refused(format!("{what}, and it has more than {UNSORTED_MAX} messages: {advice}")));
    }
    Ok(rows)
}

/// The bag to open, the folder of the copy if it is one, and true if no program writes it and SQLite need not look.
fn readable(file: &Path) -> Result<(PathBuf, Option<TempDir>, bool), Error> {
    let beside = |ending: &str| {
        let mut name = file.as_os_str().to_owned();
        name.push(ending);
        PathBuf::from(name)
    };
    // Bytes 18 and 19 of the head: 2 if the bag is written with a log of its own, -wal, whose index SQLite writes.
    let mut head = [0; 20];
    let has_log = File::open(file)?.read_exact(&mut head).is_ok() && head[18..] == [2, 2];
    let log = beside("-wal");
    if !has_log || beside("-shm").exists() {
        return Ok((file.to_owned(), None, false));
    }
    if !log.exists() {
        return Ok((file.to_owned(), None, true));
    }
    let folder = tempfile::tempdir()?;
    let copy = folder.path().join("bag.db3");
    std::fs::copy(file, &copy)?;
    std::fs::copy(&log, folder.path().join("bag.db3-wal"))?;
    Ok((copy, Some(folder), false))
}

/// A path in a URI.
fn percent_encoded(path: &Path) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"/-_.~".contains(&byte);
    let of_byte = |&byte: &u8| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") };
    path.as_os_str().as_encoded_bytes().iter().map(of_byte).collect()
}

fn decompressed(data: &[u8]) -> rusqlite::Result<Vec<u8>> {
    let mut content = Vec::new();
    let frame = zstd::stream::read::Decoder::new(data).map(|frame| frame.take(RECORD_BYTES_MAX as u64 + 1));
    frame.and_then(|mut frame| frame.read_to_end(&mut content)).map_err(|error| refused(error.to_string()))?;
    if content.len() > RECORD_BYTES_MAX {
        return Err(refused(format!("a message decompresses to more than the {RECORD_BYTES_MAX} bytes that are read")));
    }
    Ok(content)
}

/// An error for a bag that SQLite reads and this reader does not.
fn refused(reason: String) -> SqlError {
    let code = rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_CORRUPT);
    SqlError::SqliteFailure(code, Some(reason))
}
