//! The files in `golden/`, read and, with `CLEARWAY_BLESS=1`, written.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::PathBuf;

use clearway_proto::legend::encode_legend;
use clearway_proto::v1::{self, ClassMeaning};
use serde_json::Value;

/// `layer` with a legend of these classes.
pub fn with_legend(mut layer: v1::Layer, classes: &[(&str, ClassMeaning, u32)]) -> v1::Layer {
    encode_legend(&mut layer, classes.iter().copied());
    layer
}

pub fn golden(file: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("golden").join(file)
}

/// Compares with the file, or writes it when asked to bless.
pub fn assert_golden(file: &str, made: &[u8]) {
    let path = golden(file);
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        std::fs::write(&path, made).unwrap();
    }
    let stored = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert!(stored == made, "{file} differs from what the encoder makes; CLEARWAY_BLESS=1 writes it anew");
}

/// Writes seeds of a fuzz corpus, when asked to bless.
pub fn bless(corpus: &str, seeds: impl IntoIterator<Item = (&'static str, Vec<u8>)>) {
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        seeds.into_iter().for_each(|(name, seed)| std::fs::write(format!("{corpus}/{name}"), seed).unwrap());
    }
}

pub fn pretty(value: &Value) -> Vec<u8> {
    let mut text = serde_json::to_string_pretty(value).unwrap();
    text.push('\n');
    text.into_bytes()
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
