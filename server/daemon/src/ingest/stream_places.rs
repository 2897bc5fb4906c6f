//! Places for the streams of senders: so many at once, of which some are kept from each sender for the others.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};

use crate::base::sync::locked;

/// The places of a vehicle, or of a server.
#[derive(Clone, Debug)]
pub struct StreamPlaces {
    places: usize,
    /// Number of places that one sender never has.
    kept: usize,
    /// Open streams, by what counts as one sender.
    open: Arc<Mutex<BTreeMap<IpAddr, usize>>>,
}

/// The place of one stream, free again when this is dropped.
#[derive(Debug)]
pub struct StreamPlace {
    sender: IpAddr,
    open: Arc<Mutex<BTreeMap<IpAddr, usize>>>,
}

/// Why a stream has no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StreamLimitError {
    /// All are taken.
    #[error("all {places} streams are open")]
    All {
        /// Number of places.
        places: usize,
    },
    /// The sender has as many as one may have.
    #[error("{sender} has {streams} of {places} streams open, and the others are kept for other senders")]
    OfSender {
        /// The sender.
        sender: IpAddr,
        /// Number of its streams.
        streams: usize,
        /// Number of places.
        places: usize,
    },
}

impl StreamPlaces {
    /// So many places, all free, of which a sender never has `kept`; the only place is for everyone.
    pub fn new(places: usize, kept: usize) -> Self {
        Self { places, kept: kept.min(places.saturating_sub(1)), open: Arc::default() }
    }

    /// Number of places, free or not.
    pub fn places(&self) -> usize {
        self.places
    }

    /// A place for a stream of this sender.
    ///
    /// # Errors
    /// [`StreamLimitError`] if there is none for it.
    pub fn take(&self, sender: IpAddr) -> Result<StreamPlace, StreamLimitError> {
        let mut open = locked(&self.open);
        let places = self.places;
        if open.values().sum::<usize>() >= places {
            return Err(StreamLimitError::All { places });
        }
        let streams = open.entry(sender).or_default();
        if *streams + self.kept >= places {
            return Err(StreamLimitError::OfSender { sender, streams: *streams, places });
        }
        *streams += 1;
        Ok(StreamPlace { sender, open: self.open.clone() })
    }
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        let mut open = locked(&self.open);
        let streams = open.get(&self.sender).map_or(0, |streams| streams.saturating_sub(1));
        match streams {
            0 => _ = open.remove(&self.sender),
            streams => _ = open.insert(self.sender, streams),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_sender_never_has_all_places() {
        let (a, b): (IpAddr, IpAddr) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
        let places = StreamPlaces::new(3, 1);
        let mut held: Vec<_> = (0..2).map(|_| places.take(a).unwrap()).collect();
        assert_eq!(places.take(a).unwrap_err(), StreamLimitError::OfSender { sender: a, streams: 2, places: 3 });
        held.push(places.take(b).unwrap());
        for sender in [a, b] {
            assert_eq!(places.take(sender).unwrap_err(), StreamLimitError::All { places: 3 });
        }
        held.remove(0);
        assert!(places.take(b).is_ok(), "the place of a dropped stream is free again");
        drop(held);
        assert!(locked(&places.open).is_empty());
        assert!(StreamPlaces::new(1, 1).take(a).is_ok(), "the only place is for everyone");
    }
}
