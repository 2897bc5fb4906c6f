//! `--record` -> whether the file may be written; `--force` and the end of a replay -> the former recording or the new
//! one under its name.

use std::io::Error;
use std::path::{Path, PathBuf};

use super::options::{Options, ReplayError};
use clearway_daemon::record::writer::{is_same_file, later_part_of, next_free_name, parent_of, unfinished_name};

/// Refuses a file of `--record` that is replayed, is no file, or may not be replaced.
///
/// # Errors
/// The variants of [`ReplayError`] whose names begin with `Record`.
pub(super) fn check_record(options: &Options, record: &Path) -> Result<(), ReplayError> {
    // A name such as `new/../drive.mcap` names a file only when its folders exist. The recorder says if that fails.
    if let Some(folder) = record.parent() {
        let _ = std::fs::create_dir_all(folder);
    }
    // A folder stands for the files in it.
    let is_in = |folder: &Path| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
        entries.map(|entry| entry.path()).any(|file| is_same_file(&file, record))
    };
    if options.files.iter().any(|file| is_same_file(file, record) || is_in(file)) {
        return Err(ReplayError::RecordsInput { file: record.to_owned() });
    }
    let others = [
        ("--config", &options.config),
        ("--calibration", &options.calibration),
        ("--fault-script", &options.fault_script),
        ("--ready-file", &options.ready_file),
    ];
    let unfinished = unfinished_name(record);
    let is_taken = |file: &Path| is_one(file, record) || is_one(file, &unfinished);
    if let Some((option, _)) = others.into_iter().find(|(_, file)| file.as_deref().is_some_and(is_taken)) {
        return Err(ReplayError::RecordOfOption { file: record.to_owned(), option });
    }
    let is_folder = record.as_os_str().as_encoded_bytes().ends_with(b"/");
    if is_folder || record.metadata().is_ok_and(|of| !of.is_file()) {
        return Err(ReplayError::RecordNoFile { file: record.to_owned() });
    }
    let folder = parent_of(record);
    if let Some(folder) = options.files.iter().find(|file| is_same_file(file, folder)) {
        return Err(ReplayError::RecordsIntoInput { file: record.to_owned(), folder: folder.clone() });
    }
    let exists = record.symlink_metadata();
    if !options.force && exists.is_ok() {
        return Err(ReplayError::RecordExists { file: record.to_owned() });
    }
    if exists.is_ok_and(|of| of.is_symlink()) {
        return Err(ReplayError::RecordLink { file: record.to_owned() });
    }
    // After a crash it is all that is left of a recording.
    if unfinished.symlink_metadata().is_ok() {
        return Err(ReplayError::RecordUnfinished { file: record.to_owned(), unfinished });
    }
    if record.to_string_lossy().ends_with(".unfinished.mcap") {
        return Err(ReplayError::RecordUnfinished { file: record.to_owned(), unfinished: record.to_owned() });
    }
    if let Some(part) = later_part_of(record) {
        return Err(ReplayError::RecordParts { file: record.to_owned(), part });
    }
    Ok(())
}

/// True if both name one file, also one that does not exist yet.
fn is_one(a: &Path, b: &Path) -> bool {
    is_same_file(a, b) || (a.file_name() == b.file_name() && is_same_file(parent_of(a), parent_of(b)))
}

/// The recording that `--force` replaces, under a second name until the new one is whole.
#[derive(Debug)]
pub(super) struct Former {
    record: PathBuf,
    kept: PathBuf,
}

impl Former {
    /// Gives the file of `--record` a second name, if `--force` may replace it.
    ///
    /// # Errors
    /// [`ReplayError::Former`] if it cannot have one: on a file system without links, or in a read-only folder.
    pub(super) fn keep(options: &Options) -> Result<Option<Self>, ReplayError> {
        let Some(record) = options.record.as_ref().filter(|record| options.force && record.exists()) else {
            return Ok(None);
        };
        let name = record.file_name().unwrap_or_default().to_string_lossy();
        let kept = record.with_file_name(format!(".{name}.{}.former", std::process::id()));
        remove_left(record, &name);
        std::fs::hard_link(record, &kept).map_err(|source| ReplayError::Former { file: record.clone(), source })?;
        Ok(Some(Self { record: record.clone(), kept }))
    }

    /// Deletes the former recording if the new one `is_whole`. Else gives the former its name back, and returns what
    /// the new one is named instead, if there is a new one.
    ///
    /// # Errors
    /// [`ReplayError::Former`] if the names cannot be changed.
    pub(super) fn end(self, is_whole: bool) -> Result<Option<PathBuf>, ReplayError> {
        let failed = |source: Error| ReplayError::Former { file: self.record.clone(), source };
        let is_replaced = self.record.exists() && !is_same_file(&self.record, &self.kept);
        let is_former = !is_replaced && self.record.exists();
        if is_whole || is_former {
            std::fs::remove_file(&self.kept).map_err(failed)?;
            return Ok(None);
        }
        let new = is_replaced.then(|| next_free_name(&self.record.with_extension("early.mcap")));
        new.as_ref().map_or(Ok(()), |new| std::fs::rename(&self.record, new)).map_err(failed)?;
        std::fs::rename(&self.kept, &self.record).map_err(failed)?;
        Ok(new)
    }
}

/// Removes the second names of `record` that killed replays have left, and names former recordings that they have left.
fn remove_left(record: &Path, name: &str) {
    let folder = parent_of(record);
    for entry in std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok) {
        let file_name = entry.file_name().to_string_lossy().into_owned();
        let process = file_name.strip_prefix(&format!(".{name}.")).and_then(|rest| rest.strip_suffix(".former"));
        if process.is_none_or(|process| Path::new("/proc").join(process).exists()) {
            continue;
        }
        let left = entry.path();
        let removed = is_same_file(&left, record).then(|| std::fs::remove_file(&left));
        if removed.is_none_or(|removed| removed.is_err()) {
            tracing::warn!(file = %left.display(), "a replay that was killed has left the recording that it replaced");
        }
    }
}
