//! Two recordings -> whether they are of one drive: readings that arrived at the same time from the same sensor are the
//! same bytes. Stamps alone do not tell, because simulated drives begin at the same time.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;

use anyhow::{Result, bail};
use clearway_mapping::event::{Body, Event};

use clearway_journal::reader::{RecordedMessage, RecordingReader};

/// Number of pairs of readings after which the answer is known. Ours: about a second of a sensor.
const PAIRS_MAX: u64 = 2000;
/// Most readings of one recording that wait for their counterpart. Ours: many seconds of a sensor.
const WAITING_MAX: usize = 100_000;

/// Time of arrival, vehicle, sensor, and number among the readings of that time.
type ReadingKey = (i64, String, u16, u32);

/// The readings of one recording that have no counterpart yet.
struct RecordingSide {
    recording: RecordingReader,
    waiting: BTreeMap<ReadingKey, u64>,
    /// Sequence from which the events of each vehicle are new; earlier ones are repeated for a keyframe.
    next_event: BTreeMap<String, u64>,
    /// Arrival and number of the newest reading of each vehicle and sensor.
    newest: BTreeMap<(String, u16), (i64, u32)>,
    /// Arrival of the newest reading; `None` at the end of the recording.
    reached_ns: Option<i64>,
}

impl RecordingSide {
    fn open(file: &Path) -> Result<Self> {
        let recording = RecordingReader::open(file)?;
        let (waiting, next_event, newest) = Default::default();
        Ok(Self { recording, waiting, next_event, newest, reached_ns: Some(i64::MIN) })
    }

    /// The next reading and the hash of its bytes.
    fn next(&mut self) -> Result<Option<(ReadingKey, u64)>> {
        for message in self.recording.by_ref() {
            let RecordedMessage::Event { vehicle, event } = message? else { continue };
            let vehicle = vehicle.to_string();
            let next_event = self.next_event.entry(vehicle.clone()).or_default();
            if event.sequence < *next_event {
                continue;
            }
            *next_event = event.sequence.saturating_add(1);
            let Some(hash) = hash_of(&event) else { continue };
            let newest = self.newest.entry((vehicle.clone(), event.source)).or_insert((i64::MIN, 0));
            let number = if newest.0 == event.arrival_ns { newest.1 + 1 } else { 0 };
            *newest = (event.arrival_ns, number);
            self.reached_ns = Some(event.arrival_ns);
            return Ok(Some(((event.arrival_ns, vehicle, event.source, number), hash)));
        }
        self.reached_ns = None;
        Ok(None)
    }
}

/// The hash of a datagram or scan.
fn hash_of(event: &Event) -> Option<u64> {
    let mut hasher = DefaultHasher::new();
    match &event.body {
        Body::Datagram(payload) => payload.hash(&mut hasher),
        Body::Scan(scan) => {
            scan.stamp_ns.hash(&mut hasher);
            for axis in [&scan.x, &scan.y, &scan.z] {
                axis.iter().for_each(|value| value.to_bits().hash(&mut hasher));
            }
        }
        _ => return None,
    }
    Some(hasher.finish())
}

/// Refuses recordings of different drives: most of the readings of the same time differ. Recordings that have no
/// reading of the same time cannot be told apart here.
///
/// # Errors
/// If a recording cannot be read, or they are of different drives.
pub fn check(before: &Path, after: &Path) -> Result<()> {
    let mut sides = [RecordingSide::open(before)?, RecordingSide::open(after)?];
    let (mut equal, mut different) = (0_u64, 0_u64);
    // The side that is behind is read next, so that few readings wait for their counterpart.
    while equal + different < PAIRS_MAX
        && let Some(side) = (0..2).filter(|&side| sides[side].reached_ns.is_some()).min_by_key(|&s| sides[s].reached_ns)
    {
        let Some((key, hash)) = sides[side].next()? else { continue };
        match sides[1 - side].waiting.remove(&key) {
            Some(other) if other == hash => equal += 1,
            Some(_) => different += 1,
            None => _ = sides[side].waiting.insert(key, hash),
        }
        if sides[side].waiting.len() > WAITING_MAX {
            sides[side].waiting.pop_first();
        }
    }
    if different > equal {
        let pairs = equal + different;
        bail!(
            "{} and {} are different drives: of {pairs} readings that arrived at the same time from the same sensor, \
             {different} differ",
            before.display(),
            after.display()
        );
    }
    Ok(())
}
