//! The table `[recorder]`.

use std::path::PathBuf;

use clearway_journal::RecordedMaps;
use clearway_mapping::memory::config::GROUND_S_MAX;
use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// The table `[recorder]`: what is recorded, where to and for how long.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Recorder {
    /// MCAP file to write; a relative path starts at the configuration's folder. Empty: nothing is recorded.
    pub file: PathBuf,
    /// Longest time from a message to the disk, in ms: what a crash or a power cut may cost of the recording. A sync
    /// begins after half of it.
    pub flush_ms: u64,
    /// Events and maps that may wait for the disk; more are counted as dropped. A constant but in tests.
    #[serde(skip)]
    pub queue: usize,
    /// Length in MiB from which the next part begins; 0: no limit.
    pub part_mb: u64,
    /// Time in seconds after which the next part begins; 0: no limit.
    pub part_s: u64,
    /// Time in ms for which the new pipeline of a part processes events before its maps are served and recorded.
    pub warm_up_ms: u64,
    /// Total length in MiB beyond which the oldest parts are deleted; 0: none is.
    pub keep_mb: u64,
    /// Age in hours beyond which parts are deleted; 0: none is.
    pub keep_hours: u64,
    /// Number of seconds that a save keeps, unless the request says otherwise.
    pub save_s: u64,
    /// Total length in MiB of the saved files beyond which the oldest saves are deleted; 0: none is.
    pub saved_mb: u64,
    /// Conditions on which the last `save_s` seconds are saved without a request.
    pub save_on: Vec<SaveRule>,
    /// What is recorded of the maps, beside all events.
    pub maps: RecordedMaps,
    /// True if an existing file is replaced when the new one is whole; never configured, only by `--force`.
    #[serde(skip)]
    pub replaces: bool,
    /// True if no part is deleted that the store has not confirmed; never configured, only by `[store]`.
    #[serde(skip)]
    pub awaits_store: bool,
    /// True if a file that exists stays, and the recording gets the next free name; never configured, only by `serve`.
    #[serde(skip)]
    pub is_numbered: bool,
    /// The configured file, if `file` is another name because the configured name is taken.
    #[serde(skip)]
    pub family: PathBuf,
}

/// A condition on which the last seconds are saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SaveRule {
    /// A vehicle's newest map has become older than its `valid_ms`.
    MapStale,
    /// A sensor that was in the maps of its vehicle no longer is, or its data no longer arrive.
    SensorLost,
}

impl Default for Recorder {
    fn default() -> Self {
        Self {
            file: PathBuf::new(),
            flush_ms: 1000,
            queue: 16_384,
            part_mb: 0,
            part_s: 0,
            warm_up_ms: 10_000,
            keep_mb: 0,
            keep_hours: 0,
            save_s: 60,
            saved_mb: 0,
            save_on: Vec::new(),
            maps: RecordedMaps::Full,
            replaces: false,
            awaits_store: false,
            is_numbered: false,
            family: PathBuf::new(),
        }
    }
}

impl Recorder {
    /// `remembers` is true if a vehicle has a memory of ground.
    pub(super) fn check(&self, remembers: bool) -> Result<(), ValueError> {
        let ranges = [
            ("recorder.flush_ms", self.flush_ms, 10..=60_000, "10 to 60000 ms"),
            ("recorder.part_mb", self.part_mb, 0..=1 << 20, "0 to 1048576 MiB"),
            ("recorder.part_s", self.part_s, 0..=86_400, "0 to 86400 s"),
            ("recorder.warm_up_ms", self.warm_up_ms, 100..=600_000, "100 to 600000 ms"),
            ("recorder.keep_mb", self.keep_mb, 0..=1 << 30, "0 to 1073741824 MiB"),
            ("recorder.keep_hours", self.keep_hours, 0..=876_000, "0 to 876000 h"),
            ("recorder.saved_mb", self.saved_mb, 0..=1 << 30, "0 to 1073741824 MiB"),
            ("recorder.save_s", self.save_s, 1..=86_400, "1 to 86400 s"),
        ];
        for (key, value, allowed, text) in ranges {
            if !allowed.contains(&value) {
                return Err(ValueError::new(key, value, text));
            }
        }
        // Else each new part would change the maps: its pipeline would remember less ground.
        if remembers && !self.file.as_os_str().is_empty() && (self.warm_up_ms as f32) < 1e3 * GROUND_S_MAX {
            let allowed = format!("at least the {GROUND_S_MAX} s for which vehicle.maps.memory keeps ground");
            return Err(ValueError::new("recorder.warm_up_ms", self.warm_up_ms, allowed));
        }
        Ok(())
    }
}
