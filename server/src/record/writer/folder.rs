//! The files of a recording: their names, how they become visible, and which old ones are deleted.
//!
//! The parts of `drive.mcap` are `drive.mcap`, `drive.part-0002.mcap`, `drive.part-0003.mcap`, ... A part is written as
//! `drive.unfinished.mcap` or `drive.part-0002.unfinished.mcap`, and gets its name when it is closed and on the disk.
//! So a file without `unfinished` in its name is whole, and no file with such a name is ever written again. A crash
//! leaves one unfinished file, which is read like any other.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clearway_proto::v1;
use mcap::McapError;

use super::super::mcap_file::Disk;
use crate::config::Recorder as Options;

/// A recording cannot begin.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file or the recorder's thread cannot be created.
    #[error("recording {}: {source}", file.display())]
    Create {
        /// The recording.
        file: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The header cannot be written.
    #[error("recording {}: {source}", file.display())]
    Write {
        /// The recording.
        file: PathBuf,
        /// The reason.
        source: McapError,
    },
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

    /// Deletes the file of a part in which nothing was recorded.
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

    /// Links these parts into a folder of their own, where they stay when old parts are deleted; returns the links.
    ///
    /// # Errors
    /// [`io::Error`] if the disk fails.
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
    /// The folder of the configured file. It creates missing folders.
    ///
    /// # Errors
    /// [`io::Error`] if the file exists and must not be replaced, or if its folder cannot be created.
    pub fn open(options: &Options) -> io::Result<Self> {
        let mut folder = Self::of(options);
        if options.is_numbered {
            folder.file = next_free_name(&folder.file);
        }
        fs::create_dir_all(folder.parent())?;
        if !folder.replaces && is_taken(&folder.file) {
            return Err(ErrorKind::AlreadyExists.into());
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
        Self {
            file,
            family,
            replaces: options.replaces,
            keep_bytes,
            keep_time,
            saved_bytes,
            awaits_store: options.awaits_store,
        }
    }

    fn parent(&self) -> &Path {
        self.file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
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
            let is_unfinished = path.to_string_lossy().ends_with(".unfinished.mcap");
            let modified_ns = i64::try_from(since.as_nanos()).unwrap_or(i64::MAX);
            v1::RecordedPart { file: path.display().to_string(), bytes, is_unfinished, modified_ns }
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
        let file = match File::create_new(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists && self.replaces => {
                fs::remove_file(&path)?;
                File::create_new(&path)
            }
            file => file,
        }?;
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
        let folder = self.saved().join(name);
        fs::create_dir_all(&folder)?;
        let mut links = Vec::new();
        for part in parts {
            let finished = self.finished(*part);
            let link = folder.join(finished.file_name().unwrap_or_default());
            // A part that is still written is whole as soon as it is closed: the link is the same file.
            let source = if finished.exists() { finished } else { self.path(*part) };
            match fs::hard_link(&source, &link) {
                Err(error) if error.kind() != ErrorKind::AlreadyExists => return Err(error),
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
        parts.retain(|(path, ..)| !path.to_string_lossy().ends_with(".unfinished.mcap"));
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
        // A file system without links, such as that of a memory stick.
        Err(_) if !to.exists() => fs::rename(from, to),
        Err(_) => Err(ErrorKind::AlreadyExists.into()),
    }
}

/// `drive.mcap` with the infix `x` is `drive.x.mcap`.
fn with_infix(file: &Path, infix: &str) -> PathBuf {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let extension = file.extension().map_or("mcap".into(), |extension| extension.to_string_lossy());
    file.with_file_name(format!("{stem}.{infix}.{extension}"))
}

/// True if a recording to `file` would meet a file of an earlier one.
fn is_taken(file: &Path) -> bool {
    file.symlink_metadata().is_ok() || with_infix(file, "unfinished").exists()
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
mod tests {
    use super::*;

    fn folder(file: &Path, replaces: bool) -> io::Result<Folder> {
        Folder::open(&Options { file: file.to_owned(), replaces, keep_mb: 1, ..Options::default() })
    }

    #[test]
    fn a_new_run_never_overwrites_an_earlier_recording() {
        let temporary = tempfile::tempdir().unwrap();
        let file = temporary.path().join("car.mcap");
        for expected in ["car.mcap", "car-1.mcap", "car-2.mcap"] {
            let found = next_free_name(&file);
            assert_eq!(found, temporary.path().join(expected));
            File::create(found).unwrap();
        }
        File::create(temporary.path().join("car-3.unfinished.mcap")).unwrap();
        assert_eq!(next_free_name(&file), temporary.path().join("car-4.mcap"));
    }

    #[test]
    fn a_part_gets_its_name_when_it_is_closed_and_replaces_no_file() {
        let temporary = tempfile::tempdir().unwrap();
        let at = |name: &str| temporary.path().join(name);
        let mut parts = folder(&at("car.mcap"), false).unwrap();
        drop(parts.create(1).unwrap());
        assert!(at("car.unfinished.mcap").exists() && !at("car.mcap").exists());
        assert_eq!(folder(&at("car.mcap"), false).unwrap_err().kind(), ErrorKind::AlreadyExists);
        // Another program makes a file of that name meanwhile.
        fs::write(at("car.mcap"), "precious").unwrap();
        assert_eq!(parts.complete(1).unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(fs::read(at("car.mcap")).unwrap(), b"precious");
        assert!(at("car.unfinished.mcap").exists(), "nothing is lost");
        let mut replacing = folder(&at("car.mcap"), true).unwrap();
        replacing.complete(1).unwrap();
        assert_eq!(fs::read(at("car.mcap")).unwrap(), b"");
    }

    #[test]
    fn old_parts_are_deleted_beyond_the_size_and_saved_ones_stay() {
        let temporary = tempfile::tempdir().unwrap();
        let at = |name: &str| temporary.path().join(name);
        let mut parts = folder(&at("car.mcap"), false).unwrap();
        fs::write(at("car2.mcap"), vec![0; 3 << 20]).unwrap();
        for part in 1..=4 {
            drop(parts.create(part).unwrap());
            fs::write(parts.path(part), vec![0; 400 << 10]).unwrap();
            parts.complete(part).unwrap();
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(part);
            File::options().write(true).open(parts.finished(part)).unwrap().set_modified(time).unwrap();
        }
        let saved = parts.keep(&[1, 2], "fault").unwrap();
        parts.delete_old();
        let left: Vec<bool> = (1..=4).map(|part| parts.finished(part).exists()).collect();
        assert_eq!(left, [false, false, true, true], "two parts of 400 KiB fit into 1 MiB");
        assert!(saved.len() == 2 && saved.iter().all(|link| link.metadata().unwrap().len() == 400 << 10));
        assert!(at("car2.mcap").exists(), "a file of another name is not a part");
    }

    #[test]
    fn the_oldest_saves_are_deleted_beyond_the_configured_length_and_the_newest_stays() {
        let temporary = tempfile::tempdir().unwrap();
        let options = Options { file: temporary.path().join("car.mcap"), saved_mb: 1, ..Options::default() };
        let mut folder = Folder::open(&options).unwrap();
        fs::write(&options.file, vec![0; 400 << 10]).unwrap();
        let saves = || {
            let names = fs::read_dir(temporary.path().join("saved")).unwrap();
            let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        };
        for name in ["1-a", "2-b", "3-c", "4-d"] {
            folder.keep(&[1], name).unwrap();
        }
        assert_eq!(saves(), ["3-c", "4-d"], "each has 400 KiB");
        fs::write(&options.file, vec![0; 2 << 20]).unwrap();
        folder.keep(&[1], "5-e").unwrap();
        assert_eq!(saves(), ["5-e"], "the newest stays, however long it is");
        assert!(options.file.exists());
    }

    #[test]
    fn a_file_is_the_same_through_every_kind_of_link() {
        let temporary = tempfile::tempdir().unwrap();
        let at = |name: &str| temporary.path().join(name);
        fs::write(at("a"), "").unwrap();
        fs::hard_link(at("a"), at("hard")).unwrap();
        std::os::unix::fs::symlink(at("a"), at("soft")).unwrap();
        fs::write(at("b"), "").unwrap();
        assert!(is_same_file(&at("a"), &at("hard")) && is_same_file(&at("soft"), &at("hard")));
        assert!(!is_same_file(&at("a"), &at("b")) && !is_same_file(&at("absent"), &at("absent")));
    }
}
