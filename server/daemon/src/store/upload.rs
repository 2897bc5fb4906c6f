//! Finished parts of a folder -> the store, confirmed.
//!
//! A part is confirmed when it was read back from the store, its CRC equalled the file's CRC, and its index was written
//! after it. A file beside the part, `<part>.confirmed`, then says so; it is what makes the part deletable. A crash
//! between two steps repeats them: the name of a part has its CRC, so it is never written with other contents.

use std::fs::{self, File};
use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use object_store::{ObjectStore, ObjectStoreExt, WriteMultipart, path::Path as Key};
use serde::{Deserialize, Serialize};

use super::index::Entry;
use super::upload_limit::UploadLimit;
use crate::record::writer::{confirmation_of, is_being_written};
use clearway_journal::mcap_reader::McapReadError;

/// Bytes of one piece of a part, in one request, one request at a time; and most that are read back at once. S3 allows
/// 5 MiB or more.
const PIECE_BYTES: usize = 5 << 20;
/// Age after which a file without closing records is no longer being written. Ours: a program that copies a file writes
/// each second.
const STILL_WRITTEN: Duration = Duration::from_secs(60);

/// The store's confirmation of a part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Confirmation {
    /// The name of the part's object in the store.
    pub part: String,
    /// Length of the part, in bytes.
    pub bytes: u64,
    /// CRC-32 of the part, as it was read back from the store.
    pub crc32: u32,
}

/// A part is not confirmed. It stays where it is.
#[derive(Debug, thiserror::Error)]
pub enum UploadError {
    /// The part cannot be read.
    #[error("{}: {source}", file.display())]
    Read {
        /// Path of the part.
        file: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The part is not a recording.
    #[error(transparent)]
    Recording(#[from] McapReadError),
    /// The part has no event and no map.
    #[error("{}: a recording without an event or a map", file.display())]
    Nothing {
        /// Path of the part.
        file: PathBuf,
    },
    /// The store refused the part or did not answer.
    #[error("{}: {}", file.display(), reason(source))]
    Store {
        /// Path of the part.
        file: PathBuf,
        /// Error of the store.
        source: object_store::Error,
    },
    /// The store has other bytes than it was sent.
    #[error(
        "{}: the store confirmed the part {part} and holds other bytes: CRC {found:08x} and not {sent:08x}",
        file.display()
    )]
    Differs {
        /// Path of the part.
        file: PathBuf,
        /// The name of the object.
        part: String,
        /// CRC-32 of the file.
        sent: u32,
        /// CRC-32 of the object.
        found: u32,
    },
}

/// The address where a machine of AWS has its keys.
const MACHINE_KEYS: &str = "http://169.254.169.254/";

/// The reason of a store in one line: of the document in which S3 states an error, its code and message.
pub fn reason(error: &object_store::Error) -> String {
    let text = error.to_string();
    if text.contains(MACHINE_KEYS) {
        return format!(
            "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY are not set, and this machine has no keys: {text}"
        );
    }
    let Some((before, document)) = text.split_once("<?xml").or_else(|| text.split_once("<Error>")) else { return text };
    let of = |tag: &str| {
        let (_, rest) = document.split_once(&format!("<{tag}>"))?;
        rest.split_once(&format!("</{tag}>")).map(|(text, _)| text)
    };
    let stated: Vec<&str> = ["Code", "Message"].into_iter().filter_map(of).collect();
    format!("{} {}", before.trim_end(), stated.join(": ")).trim_end().to_owned()
}

/// Sends a finished part to the store, reads it back within the limit, and writes its confirmation beside it. Sending a
/// part again changes nothing.
///
/// # Errors
/// [`UploadError`]; the part is then not confirmed.
pub async fn upload(
    store: &dyn ObjectStore,
    file: &Path,
    limit: Option<&UploadLimit>,
) -> Result<Confirmation, UploadError> {
    let read = |source| UploadError::Read { file: file.to_owned(), source };
    let refused = |source| UploadError::Store { file: file.to_owned(), source };
    let (bytes, crc32) = crc_of(file).map_err(read)?;
    let entries = Entry::of_part(file, bytes, crc32)?;
    let first = entries.first().ok_or_else(|| UploadError::Nothing { file: file.to_owned() })?;
    let part = first.part.clone();
    let key = Key::from(part.as_str());
    send(store, &key, file).await?;
    let found = crc_in_store(store, &key, limit).await.map_err(refused)?;
    if found != (bytes, crc32) {
        return Err(UploadError::Differs { file: file.to_owned(), part, sent: crc32, found: found.1 });
    }
    for entry in &entries {
        let json = serde_json::to_vec_pretty(entry).expect("an entry has only text and numbers");
        store.put(&entry.key(), json.into()).await.map_err(refused)?;
    }
    let confirmation = Confirmation { part, bytes, crc32 };
    write_durably(&confirmation_of(file), &confirmation).map_err(read)?;
    Ok(confirmation)
}

/// The finished parts of a folder that are not confirmed, oldest first. A file that is still being written is left out.
///
/// # Errors
/// If the folder cannot be read.
pub fn unconfirmed(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut parts = Vec::new();
    for entry in fs::read_dir(folder)? {
        let file = entry?.path();
        if file.extension().is_some_and(|extension| extension == "mcap")
            && file.is_file()
            && !is_confirmed(&file)
            && is_finished(&file)?
        {
            parts.push((file.metadata()?.modified()?, file));
        }
    }
    parts.sort();
    Ok(parts.into_iter().map(|(_, file)| file).collect())
}

/// True if the store has confirmed this part as it is now, so that it may be deleted.
pub fn is_confirmed(file: &Path) -> bool {
    let confirmation = fs::read(confirmation_of(file)).ok();
    let confirmation = confirmation.and_then(|json| serde_json::from_slice::<Confirmation>(&json).ok());
    confirmation.is_some_and(|of| crc_of(file).is_ok_and(|found| found == (of.bytes, of.crc32)))
}

/// Deletes a part that the store has confirmed, and its confirmation. Returns false, and deletes nothing, if it has
/// not.
///
/// # Errors
/// If the files cannot be deleted.
pub fn delete_confirmed(file: &Path) -> io::Result<bool> {
    if !is_confirmed(file) {
        return Ok(false);
    }
    fs::remove_file(file)?;
    fs::remove_file(confirmation_of(file))?;
    Ok(true)
}

/// True if no recorder writes the file, and it has its closing records or has not changed for long: a crash has left it
/// without them. Other programs, which copy a file into the folder, hold no lock.
fn is_finished(file: &Path) -> io::Result<bool> {
    if is_being_written(file) {
        return Ok(false);
    }
    let mut opened = File::open(file)?;
    let length = opened.metadata()?.len();
    let mut end = Vec::new();
    io::Seek::seek(&mut opened, io::SeekFrom::Start(length.saturating_sub(mcap::MAGIC.len() as u64)))?;
    opened.read_to_end(&mut end)?;
    let age = file.metadata()?.modified()?.elapsed().unwrap_or_default();
    Ok(length > mcap::MAGIC.len() as u64 && end == mcap::MAGIC || age > STILL_WRITTEN)
}

async fn send(store: &dyn ObjectStore, key: &Key, file: &Path) -> Result<(), UploadError> {
    let read = |source| UploadError::Read { file: file.to_owned(), source };
    let refused = |source| UploadError::Store { file: file.to_owned(), source };
    let mut opened = File::open(file).map_err(read)?;
    let upload = store.put_multipart(key).await.map_err(refused)?;
    let mut pieces = WriteMultipart::new_with_chunk_size(upload, PIECE_BYTES);
    loop {
        let mut piece = Vec::new();
        (&mut opened).take(PIECE_BYTES as u64).read_to_end(&mut piece).map_err(read)?;
        if piece.is_empty() {
            break;
        }
        pieces.wait_for_capacity(1).await.map_err(refused)?;
        pieces.put(piece.into());
    }
    pieces.finish().await.map(drop).map_err(refused)
}

/// The length and the CRC-32 of an object, which is read in ranges.
async fn crc_in_store(
    store: &dyn ObjectStore,
    key: &Key,
    limit: Option<&UploadLimit>,
) -> object_store::Result<(u64, u32)> {
    let length = store.head(key).await?.size;
    let most = limit.map_or(PIECE_BYTES as u64, UploadLimit::answer_bytes);
    let (mut read, mut crc) = (0, crc32fast::Hasher::new());
    while read < length {
        let range = read..length.min(read + most);
        if let Some(limit) = limit {
            limit.take(range.end - range.start).await;
        }
        read = range.end;
        crc.update(&store.get_range(key, range).await?);
    }
    Ok((length, crc.finalize()))
}

/// The length and the CRC-32 of a file.
fn crc_of(file: &Path) -> io::Result<(u64, u32)> {
    let (mut source, mut crc, mut length) = (BufReader::new(File::open(file)?), crc32fast::Hasher::new(), 0);
    let mut buffer = vec![0; 1 << 16];
    loop {
        match source.read(&mut buffer)? {
            0 => return Ok((length, crc.finalize())),
            read => {
                crc.update(&buffer[..read]);
                length += read as u64;
            }
        }
    }
}

/// Writes a file under a temporary name, and renames it once it is on the disk.
fn write_durably(file: &Path, confirmation: &Confirmation) -> io::Result<()> {
    let partial = file.with_extension("partial");
    let mut opened = File::create(&partial)?;
    opened.write_all(&serde_json::to_vec(confirmation)?)?;
    opened.sync_all()?;
    fs::rename(partial, file)?;
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_of_a_bucket_is_one_line_with_its_code_and_message() {
        let document = "<?xml version=\"1.0\"?><Error><Code>NoSuchBucket</Code><Message>The specified bucket does not \
                        exist</Message><BucketName>b</BucketName><RequestId>x</RequestId></Error>";
        let error = |text: String| object_store::Error::Generic { store: "S3", source: text.into() };
        let stated = reason(&error(format!("Server returned non-2xx status code: 404 Not Found: {document}")));
        let ending = "404 Not Found: NoSuchBucket: The specified bucket does not exist";
        assert!(stated.ends_with(ending) && !stated.contains('<'), "{stated}");
        let plain = reason(&error("connection refused".into()));
        assert!(plain.ends_with("connection refused"), "{plain}");
    }
}
