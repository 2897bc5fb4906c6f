//! One pcap or pcapng file -> readings with the capture's stamps.
//!
//! A capture may have packets of several sensors; a replay uses one of them, as [`CaptureSensor`] chooses. Data packets
//! and telemetry of other senders are ignored and counted. Any other datagram becomes a reading as a live one does, and
//! the core refuses it with a reason.

use std::io::BufReader;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use clearway_daemon::base::file_advice::open_to_read;
use clearway_daemon::ingest::queue::Reading;
use clearway_lidar::capture::{Capture, CaptureError as Error};
use clearway_lidar::capture_sensor::CaptureSensor;
use clearway_mapping::event::Body;

/// A capture cannot be read further.
#[derive(Debug, thiserror::Error)]
pub enum CaptureError {
    /// The file cannot be opened.
    #[error("{}: {source}", file.display())]
    Open {
        /// Path of the capture.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file is not a capture, or is damaged.
    #[error("{}: {source}", file.display())]
    Read {
        /// Path of the capture.
        file: PathBuf,
        /// Why the capture cannot be read on.
        source: Error,
    },
}

/// An open capture; an iterator over its readings. A truncated capture yields its whole packets and then ends.
pub struct Source {
    file: PathBuf,
    capture: Capture<'static>,
    sensor: CaptureSensor,
    truncated: Option<String>,
}

impl Source {
    /// Opens a capture.
    ///
    /// # Errors
    /// [`CaptureError::Open`] if the file cannot be opened, [`CaptureError::Read`] if it is not a capture.
    pub fn open(file: &Path) -> Result<Self, CaptureError> {
        let open = open_to_read(file).map_err(|source| CaptureError::Open { file: file.to_owned(), source })?;
        let capture = Capture::new(BufReader::new(open));
        let capture = capture.map_err(|source| CaptureError::Read { file: file.to_owned(), source })?;
        Ok(Self { file: file.to_owned(), capture, sensor: CaptureSensor::default(), truncated: None })
    }

    /// Number of bytes read, in whole packets.
    pub fn bytes_read(&self) -> u64 {
        self.capture.offset()
    }

    /// Where and how the file is truncated or damaged, which ends its readings; known after the last one.
    pub fn truncated(&self) -> Option<String> {
        self.truncated.clone()
    }

    /// The datagrams and packets that were ignored, and why, for people.
    pub fn notes(&self) -> Vec<String> {
        self.sensor.notes().into_iter().chain(self.capture.skipped().notes()).collect()
    }
}

impl Iterator for Source {
    type Item = Result<Reading, CaptureError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let datagram = match self.capture.next()? {
                Ok(datagram) => datagram,
                Err(error @ (Error::Truncated { .. } | Error::Damaged { .. })) => {
                    self.truncated = Some(error.to_string());
                    return None;
                }
                Err(source) => return Some(Err(CaptureError::Read { file: self.file.clone(), source })),
            };
            if !self.sensor.has_sent(&datagram) {
                continue;
            }
            let body = Body::Datagram(Bytes::from(datagram.payload));
            return Some(Ok(Reading { arrival_ns: datagram.stamp_ns, source: 0, body }));
        }
    }
}
