//! A map with known classes, and the binary `clearway`.

pub mod copied;

use std::process::{Command, Output};

pub use fixture::{CAPTURE_END_NS, CLASSES, map};

#[path = "../../../client/tests/common/mod.rs"]
mod fixture;
#[path = "../../../tests/tests/fixture/venv.rs"]
pub mod venv;

pub fn clearway(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_clearway")).args(arguments).output().unwrap()
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}
