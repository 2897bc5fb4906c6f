//! Messages written by rosbags and by this crate, whole and damaged.

#[path = "../fuzz/entries.rs"]
mod entries;

mod clouds;
mod frames;
mod golden;
mod hostile;
mod velodyne_scan;

/// Stamp of the golden messages.
pub const STAMP_NS: i64 = 1_700_000_000_250_000_000;

/// A message written by rosbags (`golden/make.py`).
pub fn golden(name: &str) -> Vec<u8> {
    std::fs::read(format!("{}/tests/golden/{name}.cdr", env!("CARGO_MANIFEST_DIR"))).unwrap()
}
