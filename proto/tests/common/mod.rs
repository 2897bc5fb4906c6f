//! Reads the files in `golden/`, and writes them if `CLEARWAY_BLESS=1` is set.

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

/// Compares bytes with a golden file; writes the file first if `CLEARWAY_BLESS` is set.
pub fn assert_golden(file: &str, encoded: &[u8]) {
    let path = golden(file);
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        std::fs::write(&path, encoded).unwrap();
    }
    let stored = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert!(stored == encoded, "{file} differs from what the encoder writes; CLEARWAY_BLESS=1 writes it again");
}

/// Writes seeds of a fuzz corpus if `CLEARWAY_BLESS` is set.
pub fn bless(corpus: &str, seeds: impl IntoIterator<Item = (&'static str, Vec<u8>)>) {
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        seeds.into_iter().for_each(|(name, seed)| std::fs::write(format!("{corpus}/{name}"), seed).unwrap());
    }
}

/// JSON with its keys in alphabetical order.
pub fn pretty(value: &Value) -> Vec<u8> {
    let mut value = value.clone();
    value.sort_all_objects();
    let mut text = serde_json::to_string_pretty(&value).unwrap();
    text.push('\n');
    text.into_bytes()
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
