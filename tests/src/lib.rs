//! What the whole-system tests share: the built command, a way to run it, damaged recordings, the simulation of the
//! whole system, attacks on its listeners, and locks of tests that run one at a time.

use std::path::PathBuf;
use std::process::{Command, Output};
use std::sync::OnceLock;

pub mod attack;
pub mod damage;
pub mod packets;
pub mod serial;
pub mod simulation;

#[cfg(feature = "siege")]
pub mod machines;
#[cfg(feature = "siege")]
pub mod roles;
#[cfg(feature = "siege")]
pub mod siege;

/// The folder of the built command, brought up to date once for all tests of this process.
///
/// `cargo test --workspace` has just built them, beside the tests of their packages; after a `cargo test` of this
/// package alone they may be old.
///
/// # Panics
/// If cargo cannot build it.
pub fn binaries() -> &'static PathBuf {
    static BINARIES: OnceLock<PathBuf> = OnceLock::new();
    BINARIES.get_or_init(|| {
        let test = std::env::current_exe().expect("the path of this test");
        let folder = test.ancestors().nth(2).expect("target/<profile>/deps/<test>").to_path_buf();
        let mut cargo = cargo();
        // The same build as `cargo test --workspace`, so that nothing is built twice.
        cargo.args(["test", "--quiet", "--workspace", "--no-run", "--target-dir"]);
        cargo.arg(folder.parent().expect("target"));
        if folder.ends_with("release") {
            cargo.arg("--release");
        }
        let built = cargo.output().expect("cargo runs");
        assert!(built.status.success(), "cargo test --no-run: {}", String::from_utf8_lossy(&built.stderr));
        folder
    })
}

/// A build in the folder of the repository, without what cargo has set for the program that runs it. A build script
/// that reads the name or the folder of the package would run again, and half of all crates with it.
pub fn cargo() -> Command {
    let mut cargo = Command::new(env!("CARGO"));
    let of_package = |name: &str| name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_");
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_str().is_some_and(of_package)) {
        cargo.env_remove(name);
    }
    cargo.current_dir(workspace());
    cargo
}

/// The folder of the repository.
pub fn workspace() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").to_path_buf()
}

/// Runs a command of this workspace in `folder` to its end.
///
/// # Panics
/// If the command cannot be started.
pub fn run(folder: &std::path::Path, program: &str, arguments: &[&str]) -> Output {
    Command::new(binaries().join(program)).args(arguments).current_dir(folder).output().expect("the binary starts")
}
