//! One pcap or pcapng file -> readings with the capture's stamps.
//!
//! A capture may hold several sensors; one replay is of one. The first sender of a data packet is the sensor, the data
//! packets and telemetry of others are left alone and named. Any other datagram goes through the door like a live one
//! and is refused with its reason.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::net::IpAddr;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use clearway_lidar::capture::{Capture, CaptureError as Error};
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_mapping::event::Body;

use crate::ingest::queue::Reading;

/// Why a capture cannot be read on.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// It cannot be opened.
    #[error("{}: {source}", file.display())]
    Open {
        /// The capture.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is none, or damaged.
    #[error("{}: {source}", file.display())]
    Read {
        /// The capture.
        file: PathBuf,
        /// What is wrong with it.
        source: Error,
    },
}

/// An open capture; an iterator over its readings. One that was cut off gives what it holds, then ends.
pub struct Source {
    file: PathBuf,
    capture: Capture<'static>,
    sensor: Option<IpAddr>,
    others: BTreeMap<IpAddr, u64>,
    truncated: Option<String>,
}

impl Source {
    /// Opens a capture.
    ///
    /// # Errors
    /// [`CaptureError`] where it cannot be opened or is no capture.
    pub fn open(file: &Path) -> Result<Self, CaptureError> {
        let open = File::open(file).map_err(|source| CaptureError::Open { file: file.to_owned(), source })?;
        let capture = Capture::new(BufReader::new(open));
        let capture = capture.map_err(|source| CaptureError::Read { file: file.to_owned(), source })?;
        Ok(Self { file: file.to_owned(), capture, sensor: None, others: BTreeMap::new(), truncated: None })
    }

    /// Bytes read, in whole packets.
    pub fn bytes_read(&self) -> u64 {
        self.capture.offset()
    }

    /// Where and how the file was cut off, once its end has been met.
    pub fn truncated(&self) -> Option<String> {
        self.truncated.clone()
    }

    /// What was not taken, and why.
    pub fn notes(&self) -> Vec<String> {
        let others =
            self.others.iter().map(|(sender, n)| format!("{n} datagrams of another sensor, {sender}, left alone"));
        let skipped = self.capture.skipped();
        let skipped = [
            (skipped.not_udp, "packets that are not UDP passed over"),
            (skipped.fragmented, "pieces of fragmented datagrams passed over"),
            (skipped.unreadable, "unreadable packets passed over"),
        ];
        others.chain(skipped.into_iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}"))).collect()
    }
}

impl Iterator for Source {
    type Item = Result<Reading, CaptureError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let datagram = match self.capture.next()? {
                Ok(datagram) => datagram,
                Err(error @ Error::Truncated { .. }) => {
                    self.truncated = Some(error.to_string());
                    return None;
                }
                Err(source) => return Some(Err(CaptureError::Read { file: self.file.clone(), source })),
            };
            let sender = datagram.source.ip();
            let length = datagram.payload.len();
            if length == PACKET_LENGTH {
                self.sensor.get_or_insert(sender);
            }
            let of_a_sensor = length == PACKET_LENGTH || length == TELEMETRY_LENGTH;
            if of_a_sensor && self.sensor.is_some_and(|sensor| sensor != sender) {
                *self.others.entry(sender).or_default() += 1;
                continue;
            }
            let body = Body::Datagram(Bytes::from(datagram.payload));
            return Some(Ok(Reading { arrival_ns: datagram.stamp_ns, source: 0, body }));
        }
    }
}
