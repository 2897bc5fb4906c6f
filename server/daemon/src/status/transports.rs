//! Readers of a vehicle's maps, and the maps that they did not get because they were late, by transport.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// The way by which a reader gets maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// A stream of `MapService.Watch`.
    Grpc,
    /// A browser that has the page open.
    Page,
    /// A key of zenoh with a subscriber.
    Zenoh,
    /// A topic of ROS 2 with a subscriber.
    Ros,
    /// A subscription of a client of Foxglove's WebSocket.
    Foxglove,
}

impl Transport {
    /// All transports, in the order of their numbers.
    pub const ALL: [Self; 5] = [Self::Grpc, Self::Page, Self::Zenoh, Self::Ros, Self::Foxglove];

    /// The name in the status and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Page => "page",
            Self::Zenoh => "zenoh",
            Self::Ros => "ros",
            Self::Foxglove => "foxglove",
        }
    }
}

/// The counts of one vehicle's readers.
#[derive(Debug, Default)]
pub struct Readers {
    now: [AtomicU32; Transport::ALL.len()],
    skips: [AtomicU64; Transport::ALL.len()],
}

impl Readers {
    /// Number of readers now.
    pub fn count(&self, transport: Transport) -> u32 {
        self.now[transport as usize].load(Ordering::Relaxed)
    }

    /// Counts maps that no reader of this transport got, because the server was late.
    pub fn skip_for_all(&self, transport: Transport, maps: u64) {
        let readers = u64::from(self.count(transport));
        self.skips[transport as usize].fetch_add(maps * readers, Ordering::Relaxed);
    }

    /// Number of maps that readers did not get because they or their links were late, since the server started.
    pub fn skips(&self, transport: Transport) -> u64 {
        self.skips[transport as usize].load(Ordering::Relaxed)
    }
}

/// One reader of a vehicle's maps, counted until it is dropped.
#[derive(Debug)]
pub struct Reader {
    readers: Arc<Readers>,
    transport: Transport,
    /// Boot id and sequence of the last map that the reader got.
    last: Option<(u64, u64)>,
}

impl Reader {
    /// Counts one more reader.
    pub fn new(readers: &Arc<Readers>, transport: Transport) -> Self {
        readers.now[transport as usize].fetch_add(1, Ordering::Relaxed);
        Self { readers: readers.clone(), transport, last: None }
    }

    /// Counts the maps between the last map that this reader got and this map, by boot id and sequence, as skipped;
    /// returns their number. None are between maps of different runs.
    pub fn got(&mut self, boot_id: u64, sequence: u64) -> u64 {
        let last = self.last.replace((boot_id, sequence)).filter(|(boot, _)| *boot == boot_id);
        let skipped = last.map_or(0, |(_, last)| sequence.saturating_sub(last + 1));
        self.skipped(skipped);
        skipped
    }

    /// Counts maps that this reader did not get because it was late.
    pub fn skipped(&self, maps: u64) {
        self.readers.skips[self.transport as usize].fetch_add(maps, Ordering::Relaxed);
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.readers.now[self.transport as usize].fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_is_counted_until_it_is_dropped_and_its_skips_stay() {
        let readers = Arc::new(Readers::default());
        let mut reader = Reader::new(&readers, Transport::Page);
        assert_eq!((readers.count(Transport::Page), readers.count(Transport::Grpc)), (1, 0));
        assert_eq!([reader.got(1, 5), reader.got(1, 6), reader.got(1, 9), reader.got(2, 30)], [0, 0, 2, 0]);
        drop(reader);
        assert_eq!((readers.count(Transport::Page), readers.skips(Transport::Page)), (0, 2));
    }
}
