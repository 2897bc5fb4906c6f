//! Finds what some tests need and not every machine has: the recorded drives and Chromium. Every crate whose tests need
//! them names this file as its build script. Without them these tests report themselves ignored.
//!
//! Recorded drives: `$CLEARWAY_DATA`, else `shared/data` beside the repository, if it holds an `INDEX.md`. Then
//! `cfg(clearway_data)` is set and `env!("CLEARWAY_DATA")` is the path; else that is empty.
//!
//! Chromium: if `chromium` and `chromedriver` are in the PATH, `cfg(clearway_chromium)` is set.

use std::env;
use std::path::{Path, PathBuf};

fn main() {
    find_drives();
    find_chromium();
}

fn find_drives() {
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

fn find_chromium() {
    println!("cargo::rerun-if-env-changed=PATH");
    println!("cargo::rustc-check-cfg=cfg(clearway_chromium)");
    let path = env::var_os("PATH").unwrap_or_default();
    let has = |program: &str| env::split_paths(&path).any(|folder| folder.join(program).is_file());
    if has("chromium") && has("chromedriver") {
        println!("cargo::rustc-cfg=clearway_chromium");
    }
}

/// `shared/data` beside the repository that holds `package`.
fn beside(package: &Path) -> Option<PathBuf> {
    let repository = package.ancestors().find(|folder| folder.join("ARCHITECTURE.md").is_file())?;
    Some(repository.parent()?.join("shared/data"))
}
