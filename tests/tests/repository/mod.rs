//! The documents and the rules of the repository.

mod kit;
mod modules;
mod packages;
mod pages;
mod ratchet;
mod readme;
mod tidy;
mod wire;

use std::fs;
use std::path::{Path, PathBuf};

use clearway_tests::workspace;

/// Folders of built, third-party and recorded files.
const NOT_SOURCES: [&str; 7] = ["target", "node_modules", "corpus", "build", "dist", "__pycache__", "snapshots"];

/// The visible entries of a folder that are sources or folders of sources, in order.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("the folder is readable");
    let mut entries: Vec<_> = entries.map(|entry| entry.expect("the entry is readable").path()).collect();
    entries.retain(|path| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        !name.starts_with('.') && !NOT_SOURCES.contains(&name)
    });
    entries.sort();
    entries
}

/// All folders of the repository.
fn folders() -> Vec<PathBuf> {
    let (mut found, mut open) = (Vec::new(), vec![workspace()]);
    while let Some(folder) = open.pop() {
        open.extend(entries(&folder).into_iter().filter(|path| path.is_dir() && !path.is_symlink()));
        found.push(folder);
    }
    found
}

/// All files below `folder` with one of the endings, in order.
fn files(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for path in entries(folder) {
        if path.is_dir() && path.is_symlink() {
            // The folder that it names is listed where it lies.
        } else if path.is_dir() {
            found.extend(files(&path, endings));
        } else if path.extension().and_then(|ending| ending.to_str()).is_some_and(|ending| endings.contains(&ending)) {
            found.push(path);
        }
    }
    found
}

/// The folders of all crates' sources; the crates of fuzz targets have none.
fn sources() -> Vec<PathBuf> {
    folders()
        .into_iter()
        .filter(|folder| folder.ends_with("src") && folder.with_file_name("Cargo.toml").is_file())
        .collect()
}

/// A path as it is written from the repository on.
fn shown(path: &Path) -> String {
    path.strip_prefix(workspace()).unwrap_or(path).display().to_string()
}
