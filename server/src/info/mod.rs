//! A recording, a capture, a scan or a folder of them -> a description of its contents, and what is wrong with it.

mod capture;
mod recording;
mod scan;
mod span;

use std::path::Path;

use anyhow::{Context, Result};
use clearway_daemon::base::files;
use clearway_replay::files::{Kind, Truncated, files_of_folder, kind, missing_parts};
use serde_json::{Map, Value, json};

use crate::terminal::printable;

/// Describes the files of a folder in the order of a replay. Of scans, which are many, the first stands for all. A file
/// that cannot be read is not whole, and costs the others nothing.
///
/// # Errors
/// If no file of the folder has a known kind.
pub fn of_folder(folder: &Path) -> Result<Value> {
    let found = files_of_folder(folder)?;
    let scans = found.iter().filter(|(_, kind)| *kind == Kind::Scan).count();
    let mut is_first_scan = true;
    let mut files = Map::new();
    for (file, kind) in &found {
        if *kind != Kind::Scan || std::mem::take(&mut is_first_scan) {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let unread = |error: anyhow::Error| json!({"complete": false, "state": format!("{error:#}")});
            files.insert(printable(&name), of_file(file).unwrap_or_else(unread));
        }
    }
    for Truncated { file, reason } in missing_parts(folder) {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        files.insert(printable(&name), json!({"complete": false, "state": reason}));
    }
    Ok(json!({"kind": "folder", "scans": scans, "files": files}))
}

/// Describes a file.
///
/// # Errors
/// If it cannot be read or its kind is not known; the error names it.
pub fn of_file(file: &Path) -> Result<Value> {
    files::open(file)?;
    let mut document = match kind(file)? {
        // Its errors name the file.
        Kind::Mcap => recording::describe(file)?,
        Kind::Scan => scan::describe(file).with_context(|| file.display().to_string())?,
        Kind::Capture => capture::describe(file).with_context(|| file.display().to_string())?,
    };
    document["size_bytes"] = std::fs::metadata(file)?.len().into();
    Ok(document)
}
