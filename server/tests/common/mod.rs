//! A map with known classes, and the binary `clearway`.

// Each test file uses a part of this.
#![allow(dead_code, unused_imports)]

use std::process::{Command, Output};

pub use fixture::{CAPTURE_END_NS, CLASSES, map};

#[path = "../../../client/tests/common/mod.rs"]
mod fixture;

pub fn clearway(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_clearway")).args(arguments).output().unwrap()
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}
