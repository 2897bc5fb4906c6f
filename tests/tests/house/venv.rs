//! Python environments of the tests' own, below the target directory: made anew only where what is wanted has changed.
#![allow(dead_code, reason = "each test file uses its part")]

use std::ffi::OsString;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

const HINT: &str = "these tests need Debian's python3 and python3-venv, and a package registry";
/// What the decoders of others are that messages and files are checked with.
const VIEWERS: &str = include_str!("../../python/requirements.txt");

/// Runs a command to its end; gives what it says on stdout.
pub fn run(command: &mut Command, hint: &str) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}; {hint}"));
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let complained = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}; {hint}\n{said}{complained}", output.status);
    said
}

/// The interpreter of an environment with the packages that `packages` names for its folder; `wanted` tells when they
/// are others.
pub fn environment(name: &str, wanted: &str, packages: impl FnOnce(&Path) -> Vec<OsString>) -> PathBuf {
    // Tests of one process run side by side.
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let _mine = ONE_AT_A_TIME.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let environment = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let (interpreter, stamp) = (environment.join("bin/python"), environment.join("installed"));
    if std::fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return interpreter;
    }
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&environment), HINT);
    let pip = ["-m", "pip", "install", "--quiet", "--no-input"];
    run(Command::new(&interpreter).args(pip).args(packages(&environment)), HINT);
    std::fs::write(&stamp, wanted).expect("a file of ours");
    interpreter
}

/// A script of `tests/python`, with what it needs.
pub fn script(name: &str) -> Command {
    let mut hasher = DefaultHasher::new();
    VIEWERS.hash(&mut hasher);
    let packages = |_: &Path| VIEWERS.lines().map(OsString::from).collect();
    let interpreter = environment("python-viewers", &format!("{:016x}", hasher.finish()), packages);
    let mut command = Command::new(interpreter);
    // Cargo runs tests in their package's folder.
    command.arg("-B").arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/python").join(name));
    command
}
