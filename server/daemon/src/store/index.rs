//! A finished part -> what it holds, for a search; and a search -> the parts.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use clearway_proto::v1;
use futures::TryStreamExt;
use object_store::{ObjectStore, ObjectStoreExt, path::Path as Key};
use prost::Message as _;
use serde::{Deserialize, Serialize};

use crate::base::counted::counted;
use clearway_journal::channel::Content;
use clearway_journal::mcap_reader::{McapReadError, McapReader};

/// Edge length of the cells that an entry has for the places of its vehicle, in metres; ours.
pub const CELL_M: f64 = 25.0;

/// What one part holds of one vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// The name of the part's object in the store.
    pub part: String,
    /// Name of the vehicle whose messages the part has.
    pub vehicle: String,
    /// Log times of the first and the last message, ns since the Unix epoch.
    pub from_ns: u64,
    /// Log time of the last message, ns since the Unix epoch.
    pub to_ns: u64,
    /// Length of the part, in bytes.
    pub bytes: u64,
    /// CRC-32 of the part.
    pub crc32: u32,
    /// Number of events.
    pub events: u64,
    /// Number of layers of maps.
    pub layers: u64,
    /// The cells, of [`CELL_M`], in which the vehicle was, in the frame of its map: column (x) and row (y).
    pub cells: BTreeSet<(i32, i32)>,
    /// Names of the sensors that made the maps.
    pub sensors: BTreeSet<String>,
    /// What was wrong: with the file, and with the sensors.
    pub faults: BTreeSet<String>,
}

/// What is searched for; an absent part of it allows all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Search {
    /// Name of the vehicle; all vehicles if `None`.
    pub vehicle: Option<String>,
    /// Parts that end before this are left out; ns since the Unix epoch.
    pub from_ns: Option<u64>,
    /// Parts that begin after this are left out.
    pub to_ns: Option<u64>,
    /// A place in the frame of the vehicle's map, and the greatest distance from it; x, y and distance in metres.
    pub near: Option<(f64, f64, f64)>,
    /// Only parts with a fault.
    pub with_faults: bool,
}

/// The parts that a search finds, and the entries that cannot be read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// The entries, ordered by vehicle and time.
    pub entries: Vec<Entry>,
    /// Number of parts that fit but for the place, because where the vehicle was is not known.
    pub without_place: u64,
    /// Names of objects of the index that are no entries, each with the reason.
    pub unreadable: BTreeMap<String, String>,
}

impl Entry {
    /// Reads a part: one entry for each vehicle in it. `crc32` is the CRC of the file, whose length is `bytes`.
    ///
    /// # Errors
    /// [`McapReadError`] if the part is not a recording.
    pub fn of_part(file: &Path, bytes: u64, crc32: u32) -> Result<Vec<Self>, McapReadError> {
        let mut reader = McapReader::open(file)?;
        let (mut entries, mut counts) = (BTreeMap::<String, Self>::new(), v1::RecordingCounts::default());
        for message in reader.by_ref() {
            let message = message?;
            if message.channel.content == Content::Counts {
                counts = v1::RecordingCounts::decode(message.data.clone()).unwrap_or(counts);
            }
            let Some(vehicle) = message.vehicle() else { continue };
            let entry = entries.entry(vehicle.to_owned()).or_insert_with(|| Self {
                part: String::new(),
                vehicle: vehicle.to_owned(),
                from_ns: message.log_ns,
                to_ns: message.log_ns,
                bytes,
                crc32,
                events: 0,
                layers: 0,
                cells: BTreeSet::new(),
                sensors: BTreeSet::new(),
                faults: BTreeSet::new(),
            });
            entry.from_ns = entry.from_ns.min(message.log_ns);
            entry.to_ns = entry.to_ns.max(message.log_ns);
            match message.journal_of() {
                Some(_) => entry.events += 1,
                None => {
                    entry.layers += 1;
                    if let Some(header) = message.map_header() {
                        entry.add_map(&header);
                    }
                }
            }
        }
        let from_ns = entries.values().map(|entry| entry.from_ns).min().unwrap_or_default();
        for entry in entries.values_mut() {
            entry.part = format!("parts/{from_ns:020}-{crc32:08x}.mcap");
            entry.faults.extend(reader.incomplete().map(|reason| format!("file: {reason}")));
            let of_vehicle = format!("/{}/", entry.vehicle);
            let dropped = counts.topics.iter().filter(|of| of.topic.starts_with(&of_vehicle)).map(|of| of.dropped);
            let dropped = Some(dropped.sum()).filter(|dropped| *dropped > 0);
            let lost = |dropped| format!("recorder: {} dropped: {}", counted(dropped, "message"), counts.reason);
            entry.faults.extend(dropped.map(lost));
            entry.faults.extend(reader.repaired().iter().map(|lost| format!("repaired file: {lost}")));
        }
        Ok(entries.into_values().collect())
    }

    /// The name of the entry's object in the store.
    pub fn key(&self) -> Key {
        Key::from_iter([
            "index".to_owned(),
            self.vehicle.clone(),
            format!("{:020}-{:08x}.json", self.from_ns, self.crc32),
        ])
    }

    fn add_map(&mut self, header: &v1::Header) {
        if let Some(pose) = &header.map_from_ego {
            self.cells.insert(((pose.x / CELL_M).floor() as i32, (pose.y / CELL_M).floor() as i32));
        }
        for sensor in &header.sensors {
            self.sensors.insert(sensor.name.clone());
            // A drive's first and last revolutions are partial by nature.
            if !["", "start", "end"].contains(&sensor.partial.as_str()) {
                self.faults.insert(format!("sensor {}: {}", sensor.name, sensor.partial));
            }
        }
    }

    fn fits(&self, search: &Search) -> bool {
        let is_near = |(x, y, distance_m): (f64, f64, f64)| {
            let outside = |at: f64, cell: i32| {
                let low = f64::from(cell) * CELL_M;
                (low - at).max(at - low - CELL_M).max(0.0)
            };
            self.cells.iter().any(|(column, row)| outside(x, *column).hypot(outside(y, *row)) <= distance_m)
        };
        search.vehicle.as_ref().is_none_or(|vehicle| *vehicle == self.vehicle)
            && search.from_ns.is_none_or(|from| self.to_ns >= from)
            && search.to_ns.is_none_or(|to| self.from_ns <= to)
            && search.near.is_none_or(is_near)
            && !(search.with_faults && self.faults.is_empty())
    }
}

/// Searches the index of a store.
///
/// # Errors
/// [`object_store::Error`] if the store does not answer. An object that is no entry is no error.
pub async fn search(store: &dyn ObjectStore, search: &Search) -> object_store::Result<Found> {
    let mut folder = vec!["index".to_owned()];
    folder.extend(search.vehicle.clone());
    let mut keys: Vec<Key> =
        store.list(Some(&Key::from_iter(folder))).map_ok(|meta| meta.location).try_collect().await?;
    keys.sort();
    let mut found = Found::default();
    for key in keys {
        // The name has the time of the first message, so later parts need not be read.
        let first = key.filename().and_then(|name| name.split('-').next()?.parse::<u64>().ok());
        if first.zip(search.to_ns).is_some_and(|(first, to)| first > to) {
            continue;
        }
        let bytes = store.get(&key).await?.bytes().await?;
        match serde_json::from_slice::<Entry>(&bytes) {
            Ok(entry) if entry.fits(search) => found.entries.push(entry),
            Ok(entry) => {
                let elsewhere = Search { near: None, ..search.clone() };
                found.without_place += u64::from(entry.cells.is_empty() && entry.fits(&elsewhere));
            }
            Err(error) => _ = found.unreadable.insert(key.to_string(), error.to_string()),
        }
    }
    Ok(found)
}
