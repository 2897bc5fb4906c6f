//! A capture -> the datagrams of one sensor, in groups.

use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, Result};
use clearway_daemon::base::files;
use clearway_lidar::capture::{Capture, CaptureError, Datagram};
use clearway_lidar::capture_sensor::CaptureSensor;

/// Most datagrams of a drive in one observation: 50 ms of an HDL-64E.
const PACKETS: usize = 175;
/// Longest time between the first and the last datagram of one observation, in nanoseconds; ours, because it delays
/// each packet by as much.
const PACKETS_NS: i64 = 20_000_000;
/// Datagrams with their stamps, in nanoseconds since the Unix epoch.
type StampedPackets = Vec<(i64, Vec<u8>)>;

/// The datagrams of one sensor of a capture, in groups that make one observation each: an iterator. A capture that is
/// cut off gives the groups before the cut.
pub struct PacketGroups {
    capture: Capture<'static>,
    /// The datagram that begins the next group.
    pending: Option<Result<Datagram, CaptureError>>,
    sensor: CaptureSensor,
}

impl PacketGroups {
    /// Opens a capture.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn open(file: &Path) -> Result<Self> {
        let (opened, _) = files::open(file)?;
        let capture = Capture::new(BufReader::new(opened)).with_context(|| file.display().to_string())?;
        Ok(Self { capture, pending: None, sensor: CaptureSensor::default() })
    }

    /// The datagrams of other sensors, and the packets that are no UDP datagrams, so far; for people.
    pub fn notes(&self) -> Vec<String> {
        self.sensor.notes().into_iter().chain(self.capture.skipped().notes()).collect()
    }
}

impl Iterator for PacketGroups {
    type Item = Result<StampedPackets, CaptureError>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut packets = StampedPackets::new();
        while packets.len() < PACKETS {
            let first_ns = packets.first().map(|(stamp_ns, _)| *stamp_ns);
            let near =
                |stamp_ns: i64| first_ns.is_none_or(|first| (0..=PACKETS_NS).contains(&stamp_ns.saturating_sub(first)));
            let is_next = |next: &Result<Datagram, CaptureError>| {
                packets.is_empty() || next.as_ref().is_ok_and(|d| near(d.stamp_ns))
            };
            match self.pending.take().or_else(|| self.capture.next()) {
                Some(next) if !is_next(&next) => {
                    self.pending = Some(next);
                    break;
                }
                Some(Ok(datagram)) if self.sensor.has_sent(&datagram) => {
                    packets.push((datagram.stamp_ns, datagram.payload));
                }
                Some(Ok(_)) => {}
                Some(Err(CaptureError::Truncated { .. })) | None => break,
                Some(Err(error)) => return Some(Err(error)),
            }
        }
        (!packets.is_empty()).then_some(Ok(packets))
    }
}
