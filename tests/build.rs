//! Finds the recorded drives, for the tests of every crate that names this file as its build script.
//!
//! `$CLEARWAY_DATA`, else `shared/data` beside the repository, if it holds an `INDEX.md`. Then `cfg(clearway_data)` is
//! set and `env!("CLEARWAY_DATA")` is the path; else that is empty, and the tests that need it report themselves
//! ignored.

use std::env;
use std::path::{Path, PathBuf};

fn main() {
    println!("cargo::rerun-if-env-changed=CLEARWAY_DATA");
    println!("cargo::rustc-check-cfg=cfg(clearway_data)");
    let package = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("set by cargo"));
    let data = env::var_os("CLEARWAY_DATA").map(PathBuf::from).or_else(|| beside(&package));
    let data = data.filter(|data| data.join("INDEX.md").is_file()).and_then(|data| data.canonicalize().ok());
    if let Some(data) = &data {
        println!("cargo::rerun-if-changed={}", data.join("INDEX.md").display());
        println!("cargo::rustc-cfg=clearway_data");
    }
    println!("cargo::rustc-env=CLEARWAY_DATA={}", data.unwrap_or_default().display());
}

/// `shared/data` beside the repository that holds `package`.
fn beside(package: &Path) -> Option<PathBuf> {
    let repository = package.ancestors().find(|folder| folder.join("ARCHITECTURE.md").is_file())?;
    Some(repository.parent()?.join("shared/data"))
}
