//! Finds the recorded drives for the tests of every crate that names this file as its build script.
//!
//! `$CLEARWAY_DATA`, else `../shared/data` beside the repository. Where the folder exists, `cfg(clearway_data)` is set
//! and `env!("CLEARWAY_DATA")` is its path; elsewhere the tests that need it report themselves ignored.

use std::{env, path::PathBuf};

fn main() {
    println!("cargo::rerun-if-env-changed=CLEARWAY_DATA");
    println!("cargo::rustc-check-cfg=cfg(clearway_data)");
    let beside = || {
        let package = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR")?);
        package
            .ancestors()
            .find(|folder| folder.join("ARCHITECTURE.md").is_file())?
            .parent()
            .map(|p| p.join("shared/data"))
    };
    let Some(data) = env::var_os("CLEARWAY_DATA").map(PathBuf::from).or_else(beside) else { return };
    let index = data.join("INDEX.md");
    println!("cargo::rerun-if-changed={}", index.display());
    if let (true, Ok(data)) = (index.is_file(), data.canonicalize()) {
        println!("cargo::rustc-cfg=clearway_data");
        println!("cargo::rustc-env=CLEARWAY_DATA={}", data.display());
    }
}
