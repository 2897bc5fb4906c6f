//! Recordings -> digests of their maps. Equal digests mean equal bytes.

use std::collections::BTreeMap;
use std::path::Path;

use bytes::Bytes;
use clearway_journal::reader::{RecordedMessage, RecordingError, RecordingReader};
use clearway_proto::v1;
use prost::Message;
use ring::digest::{SHA256, digest};

/// The SHA-256 of the bytes of each recorded map, by vehicle, sequence and layer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Digests(BTreeMap<(String, u64, String), Vec<u8>>);

impl Digests {
    /// Digests the maps of a recording.
    ///
    /// # Errors
    /// [`RecordingError`] if the file cannot be read.
    ///
    /// # Panics
    /// If a map cannot be decoded, has no header, or is there twice.
    pub fn of(recording: &Path) -> Result<Self, RecordingError> {
        let mut digests = BTreeMap::new();
        for message in RecordingReader::open(recording)? {
            let RecordedMessage::Map { vehicle, layer, bytes } = message? else { continue };
            let digest = sha256(&bytes);
            let before = digests.insert((vehicle, sequence(bytes), layer), digest);
            assert!(before.is_none(), "{}: a map is there twice", recording.display());
        }
        Ok(Self(digests))
    }

    /// Number of maps, of one layer each.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True without any map.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The first 16 hexadecimal digits of the digest of all digests, in the order of vehicle, sequence and layer.
    pub fn sum(&self) -> String {
        hexadecimal(&sha256(&self.0.values().flatten().copied().collect::<Vec<_>>()))
    }

    /// Says which map is the first that differs, or that one of them lacks; `None` if all are equal.
    pub fn first_difference(&self, other: &Self) -> Option<String> {
        let keys = self.0.keys().chain(other.0.keys());
        let (vehicle, sequence, layer) = keys.filter(|key| self.0.get(*key) != other.0.get(*key)).min()?;
        Some(format!("vehicle {vehicle}, sequence {sequence}, layer {layer}"))
    }
}

/// The first 16 hexadecimal digits of the SHA-256 of these bytes.
pub fn digest_of(bytes: &[u8]) -> String {
    hexadecimal(&sha256(bytes))
}

fn sha256(bytes: &[u8]) -> Vec<u8> {
    digest(&SHA256, bytes).as_ref().to_vec()
}

fn hexadecimal(digest: &[u8]) -> String {
    digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

fn sequence(map: Bytes) -> u64 {
    v1::Map::decode(map).expect("a map").header.expect("a header").sequence
}
