//! Paths of the command line -> open files, or errors that name the file, what is wrong and what to do.

use std::fs::{self, File};
use std::io::{Error, Write as _};
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use clearway_journal::file_advice::{advised, open_to_read};

/// Opens a file to read; returns it and its length in bytes.
///
/// # Errors
/// If it does not exist, is a folder, a pipe or a device, is empty, or cannot be read.
pub fn open(file: &Path) -> Result<(File, u64)> {
    let opened = open_to_read(file).map_err(|error| wrong(file, error))?;
    let metadata = opened.metadata().map_err(|error| wrong(file, error))?;
    if metadata.is_dir() {
        bail!("{}: this is a folder; name a file", file.display());
    }
    if metadata.is_file() && metadata.len() == 0 {
        bail!("{}: the file is empty; check that what wrote it has ended without an error", file.display());
    }
    Ok((opened, metadata.len()))
}

/// Reads a whole file, which may be empty.
///
/// # Errors
/// If it does not exist, is a folder, or cannot be read.
pub fn read(file: &Path) -> Result<Vec<u8>> {
    fs::read(file).map_err(|error| wrong(file, error))
}

/// Reads a whole text file, which may be empty.
///
/// # Errors
/// As [`read`], and if it is not text.
pub fn read_text(file: &Path) -> Result<String> {
    String::from_utf8(read(file)?).with_context(|| format!("{}: not a text file", file.display()))
}

/// Creates a file that does not exist yet.
///
/// # Errors
/// If it exists or cannot be created.
pub fn create_new(file: &Path) -> Result<File> {
    File::create_new(file).map_err(|error| wrong(file, error))
}

/// Creates a folder, unless it exists.
///
/// # Errors
/// If a file has its name or it cannot be created.
pub fn create_folder(folder: &Path) -> Result<()> {
    if folder.is_file() {
        bail!("{}: this is a file; name a folder", folder.display());
    }
    fs::create_dir_all(folder).map_err(|error| wrong(folder, error))
}

/// Writes a file that does not exist yet.
///
/// # Errors
/// If it exists or cannot be written.
pub fn write_new(file: &Path, bytes: &[u8]) -> Result<()> {
    create_new(file)?.write_all(bytes).map_err(|error| wrong(file, error))
}

/// Writes a file; an existing file is replaced.
///
/// # Errors
/// If it cannot be written.
pub fn write(file: &Path, bytes: &[u8]) -> Result<()> {
    fs::write(file, bytes).map_err(|error| wrong(file, error))
}

fn wrong(file: &Path, error: Error) -> anyhow::Error {
    anyhow!("{}: {}", file.display(), advised(file, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_an_empty_file_and_a_file_that_exists_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("empty"), "").unwrap();
        let error = |result: Result<File>| result.unwrap_err().to_string();
        let opened = |file: &Path| error(open(file).map(|(file, _)| file));
        assert!(opened(&at("absent")).ends_with("absent: No such file"));
        assert!(opened(folder.path()).ends_with("this is a folder; name a file"));
        assert!(opened(&at("empty")).contains("empty: the file is empty; check that"));
        assert!(error(create_new(&at("empty"))).contains("exists and is not overwritten; delete it"));
        assert!(create_folder(&at("empty")).unwrap_err().to_string().ends_with("this is a file; name a folder"));
        assert!(write(folder.path(), b"").unwrap_err().to_string().ends_with("this is a folder; name a file"));
    }
}
