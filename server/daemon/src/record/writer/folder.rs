//! The files of a recording: their names, how they become visible, and which old files are deleted.
//!
//! The parts of `drive.mcap` are `drive.mcap`, `drive.part-0002.mcap`, `drive.part-0003.mcap`, ... A part is written as
//! `drive.unfinished.mcap` or `drive.part-0002.unfinished.mcap`, and gets its name when it is closed and on the disk.
//! So a file without `unfinished` in its name is whole, and no file with such a name is ever written again.
//!
//! The recorder holds a lock (`flock`) of each file that it writes, and the kernel ends it with the process. So an
//! unfinished file without a lock was left by a crash. It is read like any other, and treated as a part: it is listed
//! as left, counts towards `keep_mb`, goes to the store, and is deleted when it is the oldest.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clearway_proto::v1;
use mcap::McapError;

use crate::config::Recorder as Options;
use clearway_journal::mcap_file::Disk;

/// Age of an unfinished file after which it counts as left, on a file system without locks.
const STILL_WRITTEN: Duration = Duration::from_secs(60);

/// A recording cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file or the recorder's thread cannot be created.
    #[error("recorder.file = {}: {source}", file.display())]
    Create {
        /// Path of the recording.
        file: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The header cannot be written.
    #[error("recording {}: {}", file.display(), with_cause(source))]
    Write {
        /// Path of the recording.
        file: PathBuf,
        /// Error of the MCAP writer.
        source: McapError,
    },
}

/// The text of an error, with its cause: the library's text says that writing failed, the cause has the reason.
pub(super) fn with_cause(error: &McapError) -> String {
    std::error::Error::source(error).map_or(error.to_string(), |cause| format!("{error}: {cause}"))
}

/// Where the parts of a recording are written: a folder, or a simulated disk in tests.
pub trait Files: Send {
    /// The file of one part.
    type File: Disk;

    /// Creates the file of a part, which must not exist.
    ///
    /// # Errors
    /// [`io::Error`] if it exists or the disk fails.
    fn create(&mut self, part: u64) -> io::Result<Self::File>;

    /// Deletes the file of a part that holds nothing that no other part holds.
    ///
    /// # Errors
    /// [`io::Error`] if the disk fails, or keeps every file.
    fn discard(&mut self, part: u64) -> io::Result<()> {
        let _ = part;
        Err(ErrorKind::Unsupported.into())
    }

    /// Gives a closed part its name.
    ///
    /// # Errors
    /// [`io::Error`] if a file of that name exists or the disk fails.
    fn complete(&mut self, part: u64) -> io::Result<()>;

    /// The path of the part while it is written.
    fn path(&self, part: u64) -> PathBuf;

    /// Links the `parts` that are not deleted into a folder of their own, where they stay when old parts are deleted;
    /// returns the links.
    ///
    /// # Errors
    /// [`io::Error`] if all are deleted or the disk fails.
    fn keep(&mut self, parts: &[u64], name: &str) -> io::Result<Vec<PathBuf>> {
        let _ = (parts, name);
        Ok(Vec::new())
    }

    /// Deletes the oldest whole parts beyond the configured size and age.
    fn delete_old(&mut self) {}
}

/// The folder of one recording.
#[derive(Debug)]
pub struct Folder {
    file: PathBuf,
    /// The configured file, by which the files of earlier runs are named too.
    family: PathBuf,
    replaces: bool,
    keep_bytes: Option<u64>,
    keep_time: Option<Duration>,
    saved_bytes: Option<u64>,
    awaits_store: bool,
}

impl Folder {
    /// The folder of the configured file. It creates missing folders, and says so in the log.
    ///
    /// # Errors
    /// [`io::Error`] if the file is a folder, exists and must not be replaced, or if its folder cannot be created.
    pub fn open(options: &Options) -> io::Result<Self> {
        let mut folder = Self::of(options);
        if folder.file.is_dir() {
            return Err(io::Error::new(ErrorKind::IsADirectory, "a folder; name a file, such as drive.mcap in it"));
        }
        if options.is_numbered {
            folder.file = next_free_name(&folder.file);
        }
        if !folder.parent().is_dir() {
            fs::create_dir_all(folder.parent())?;
            tracing::info!(folder = %folder.parent().display(), "the folder of the recording did not exist: created");
        }
        if !folder.replaces && is_taken(&folder.file) {
            if folder.file.symlink_metadata().is_ok() {
                return Err(ErrorKind::AlreadyExists.into());
            }
            let taken = "parts of an earlier recording of this name are beside it; name another file";
            return Err(io::Error::new(ErrorKind::AlreadyExists, taken));
        }
        for left in folder.list().into_iter().filter(|part| part.is_left) {
            tracing::warn!(file = left.file, bytes = left.bytes, "an earlier run has left this part unfinished");
        }
        Ok(folder)
    }

    /// The folder of the configured file, as it is.
    pub(super) fn of(options: &Options) -> Self {
        let keep_bytes = Some(options.keep_mb << 20).filter(|bytes| *bytes > 0);
        let keep_time = Some(Duration::from_secs(options.keep_hours * 3600)).filter(|time| !time.is_zero());
        let family = if options.family.as_os_str().is_empty() { &options.file } else { &options.family };
        let (file, family) = (options.file.clone(), family.clone());
        let saved_bytes = Some(options.saved_mb << 20).filter(|bytes| *bytes > 0);
        let (replaces, awaits_store) = (options.replaces, options.awaits_store);
        Self { file, family, replaces, keep_bytes, keep_time, saved_bytes, awaits_store }
    }

    fn parent(&self) -> &Path {
        parent_of(&self.file)
    }

    /// The folder of the saves.
    fn saved(&self) -> PathBuf {
        self.parent().join("saved")
    }

    /// Deletes the oldest saves beyond the configured length, but never the newest. Their names begin with their time.
    fn delete_old_saves(&self) {
        let Some(keep) = self.saved_bytes else { return };
        let folders = |of: &Path| fs::read_dir(of).into_iter().flatten().filter_map(Result::ok);
        let length_of = |save: &Path| folders(save).filter_map(|file| Some(file.metadata().ok()?.len())).sum::<u64>();
        let mut saves: Vec<_> = folders(&self.saved()).map(|entry| entry.path()).collect();
        saves.sort();
        let mut bytes: u64 = saves.iter().map(|save| length_of(save)).sum();
        saves.pop();
        for save in saves.into_iter().take_while(|save| {
            let is_over = bytes > keep;
            bytes -= if is_over { length_of(save) } else { 0 };
            is_over
        }) {
            match fs::remove_dir_all(&save) {
                Ok(()) => tracing::info!(save = %save.display(), "deleted an old save of the recording"),
                Err(error) => tracing::warn!(save = %save.display(), %error, "an old save cannot be deleted"),
            }
        }
    }

    /// The path of a whole part.
    fn finished(&self, part: u64) -> PathBuf {
        match part {
            1 => self.file.clone(),
            _ => with_infix(&self.file, &format!("part-{part:04}")),
        }
    }

    /// Makes created, renamed and deleted names survive a power cut.
    fn sync_names(&self) -> io::Result<()> {
        File::open(self.parent())?.sync_all()
    }

    /// All parts on the disk, oldest first.
    pub(super) fn list(&self) -> Vec<v1::RecordedPart> {
        let part = |(path, bytes, modified): (PathBuf, u64, SystemTime)| {
            let since = modified.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
            let is_unfinished = is_unfinished(&path);
            let is_left = is_unfinished && !is_being_written(&path);
            let modified_ns = i64::try_from(since.as_nanos()).unwrap_or(i64::MAX);
            v1::RecordedPart { file: path.display().to_string(), bytes, is_unfinished, modified_ns, is_left }
        };
        self.parts().into_iter().map(part).collect()
    }

    /// All files of this recording and of earlier runs with the same configuration: path, length, time of the newest
    /// change; oldest first.
    fn parts(&self) -> Vec<(PathBuf, u64, SystemTime)> {
        let Ok(entries) = fs::read_dir(self.parent()) else { return Vec::new() };
        let mut parts: Vec<_> = entries
            .filter_map(Result::ok)
            .filter(|entry| is_part_of(&self.family, &entry.path()))
            .filter_map(|entry| {
                let metadata = entry.metadata().ok()?;
                Some((entry.path(), metadata.len(), metadata.modified().ok()?))
            })
            .collect();
        parts.sort_by(|a, b| (a.2, &a.0).cmp(&(b.2, &b.0)));
        parts
    }
}

impl Files for Folder {
    type File = File;

    fn create(&mut self, part: u64) -> io::Result<File> {
        let path = self.path(part);
        if !self.replaces && self.finished(part).exists() {
            return Err(ErrorKind::AlreadyExists.into());
        }
        let file = File::create_new(&path)?;
        // Waits only for a look of [`is_being_written`].
        if let Err(error) = file.lock() {
            tracing::warn!(file = %path.display(), %error, "other programs cannot see that this file is being written");
        }
        self.sync_names()?;
        Ok(file)
    }

    fn discard(&mut self, part: u64) -> io::Result<()> {
        fs::remove_file(self.path(part))
    }

    fn complete(&mut self, part: u64) -> io::Result<()> {
        let (unfinished, finished) = (self.path(part), self.finished(part));
        if self.replaces {
            fs::rename(&unfinished, &finished)?;
        } else {
            rename_new(&unfinished, &finished)?;
        }
        self.sync_names()
    }

    fn path(&self, part: u64) -> PathBuf {
        with_infix(&self.finished(part), "unfinished")
    }

    fn keep(&mut self, parts: &[u64], name: &str) -> io::Result<Vec<PathBuf>> {
        let left = |part: &u64| {
            let (finished, unfinished) = (self.finished(*part), self.path(*part));
            // A part that is still written is whole as soon as it is closed: the link is the same file. A part that the
            // disk has refused stays unfinished.
            match unfinished.exists() && !finished.exists() {
                true if is_being_written(&unfinished) => (unfinished, finished),
                true => (unfinished.clone(), unfinished),
                false => (finished.clone(), finished),
            }
        };
        let left: Vec<(PathBuf, PathBuf)> = parts.iter().map(left).filter(|(source, _)| source.exists()).collect();
        if left.is_empty() {
            return Err(io::Error::new(ErrorKind::NotFound, "the parts of that time are deleted"));
        }
        let folder = self.saved().join(name);
        let mut links = Vec::new();
        let failed = |error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", folder.display()));
        fs::create_dir_all(&folder).map_err(failed)?;
        for (source, name) in left {
            let link = folder.join(name.file_name().unwrap_or_default());
            match fs::hard_link(&source, &link) {
                Err(error) if error.kind() != ErrorKind::AlreadyExists => return Err(failed(error)),
                _ => links.push(link),
            }
        }
        for synced in [&*folder, folder.parent().unwrap_or(&folder), self.parent()] {
            File::open(synced)?.sync_all()?;
        }
        self.delete_old_saves();
        Ok(links)
    }

    fn delete_old(&mut self) {
        let mut parts = self.parts();
        parts.retain(|(path, ..)| !is_unfinished(path) || !is_being_written(path));
        // The newest part is never deleted, however long it is.
        parts.pop();
        let mut bytes: u64 = self.parts().iter().map(|(_, bytes, _)| bytes).sum();
        for (path, length, modified) in parts {
            let is_over = self.keep_bytes.is_some_and(|keep| bytes > keep);
            let is_old = self.keep_time.is_some_and(|keep| modified.elapsed().is_ok_and(|age| age > keep));
            let confirmation = confirmation_of(&path);
            if (!is_over && !is_old) || (self.awaits_store && !confirmation.exists()) {
                continue;
            }
            match fs::remove_file(&path) {
                Ok(()) => {
                    bytes -= length;
                    // Of a part that is not there it means nothing.
                    let _ = fs::remove_file(confirmation);
                    tracing::info!(file = %path.display(), is_over, is_old, "deleted an old part of the recording");
                }
                Err(error) => tracing::warn!(file = %path.display(), %error, "an old part cannot be deleted"),
            }
        }
    }
}

/// True if the name of the file says that it has no end yet.
fn is_unfinished(path: &Path) -> bool {
    path.to_string_lossy().ends_with(".unfinished.mcap")
}

/// True if a recorder of this or another process writes the file.
pub fn is_being_written(path: &Path) -> bool {
    match File::open(path).map(|file| file.try_lock_shared()) {
        Ok(Ok(())) => false,
        Ok(Err(TryLockError::WouldBlock)) => true,
        // A file system without locks: a file that has not changed for long is not being written.
        Ok(Err(TryLockError::Error(_))) | Err(_) => {
            let age = path.metadata().and_then(|of| of.modified()).ok().and_then(|at| at.elapsed().ok());
            age.is_none_or(|age| age < STILL_WRITTEN)
        }
    }
}

/// The file beside a part that says that the long-term store has confirmed it.
pub fn confirmation_of(part: &Path) -> PathBuf {
    let mut name = part.as_os_str().to_owned();
    name.push(".confirmed");
    name.into()
}

/// Renames a file unless the new name exists: a link cannot replace a file.
fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    match fs::hard_link(from, to) {
        Ok(()) => fs::remove_file(from),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Err(error),
        // A file system without links, as on a memory stick.
        Err(_) if !to.exists() => fs::rename(from, to),
        Err(_) => Err(ErrorKind::AlreadyExists.into()),
    }
}

/// The folder of a file.
pub fn parent_of(file: &Path) -> &Path {
    file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// `drive.mcap` with the infix `x` is `drive.x.mcap`.
fn with_infix(file: &Path, infix: &str) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let extension = file.extension().map_or("mcap".into(), |extension| extension.to_string_lossy());
    file.with_file_name(format!("{stem}.{infix}.{extension}"))
}

/// True if a recording to `file` would meet a file of an earlier one: its first part or, if that was deleted, another.
fn is_taken(file: &Path) -> bool {
    file.symlink_metadata().is_ok() || with_infix(file, "unfinished").exists() || later_part_of(file).is_some()
}

/// The name of the first part of the recording `file` while it is written.
pub fn unfinished_name(file: &Path) -> PathBuf {
    with_infix(file, "unfinished")
}

/// A part of the recording `file` other than the first.
pub fn later_part_of(file: &Path) -> Option<PathBuf> {
    let start = with_infix(file, "part-").file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut files = fs::read_dir(parent_of(file)).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
    let starts = |path: &Path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&start));
    files.find(|path| starts(path) && is_part_of(file, path))
}

/// True if `path` is named as a part of `file`, or of an earlier run that [`next_free_name`] has named.
fn is_part_of(file: &Path, path: &Path) -> bool {
    let text = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    let (base, name) = (text(file.file_stem()), text(path.file_name()));
    let extension = file.extension().map_or("mcap".to_owned(), |extension| extension.to_string_lossy().into_owned());
    let Some(rest) = name.strip_suffix(&format!(".{extension}")).and_then(|name| name.strip_prefix(&*base)) else {
        return false;
    };
    let rest = rest.strip_suffix(".unfinished").unwrap_or(rest);
    let (run, part) = rest.split_once(".part-").map_or((rest, None), |(run, part)| (run, Some(part)));
    (run.is_empty() || run.strip_prefix('-').is_some_and(is_number)) && part.is_none_or(is_number)
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit())
}

/// The path of the recording; `None` if the configuration names no file.
pub fn recording_path(options: &Options) -> Option<&Path> {
    (!options.file.as_os_str().is_empty()).then_some(options.file.as_path())
}

/// `file`, or if it exists or is being written, the first of `name-1.mcap`, `name-2.mcap`, ... that does not, so that a
/// server that starts again does not overwrite an earlier recording.
pub fn next_free_name(file: &Path) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let extension = file.extension().map_or("mcap".into(), |extension| extension.to_string_lossy().into_owned());
    let numbered = (1_u64..).map(|number| file.with_file_name(format!("{stem}-{number}.{extension}")));
    let mut names = std::iter::once(file.to_owned()).chain(numbered);
    names.find(|file| !is_taken(file)).unwrap_or_else(|| file.to_owned())
}

/// The files of the recording `file`, oldest first.
pub fn parts_of(file: &Path) -> Vec<PathBuf> {
    let folder = Folder::of(&Options { file: file.to_owned(), ..Options::default() });
    folder.parts().into_iter().map(|(path, ..)| path).collect()
}

/// True if both paths name the same file, also through links.
pub fn is_same_file(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let identity = |path: &Path| fs::metadata(path).ok().map(|metadata| (metadata.dev(), metadata.ino()));
    identity(a).is_some_and(|identity_of_a| identity(b) == Some(identity_of_a))
}

#[cfg(test)]
mod tests;
