//! The selection of one reader of `Watch`: checked, then applied to the newest maps.
//!
//! In: a [`v1::Selection`], the capture stamps of the newest maps, acknowledgements. Out: whether a map may be sent
//! now, and how many of the maps between were missed or left out because of the rate. No clock is read: the same maps
//! and the same acknowledgements give the same updates.

use std::collections::VecDeque;

use bytes::Bytes;
use clearway_proto::region::{self, RegionError};
use clearway_proto::v1;
use tonic::Status;

use crate::publish::served::Served;
use clearway_journal::encode::EncodedMap;

/// Greatest `max_in_flight`. Ours: more maps on the way would only be older ones.
const IN_FLIGHT_MAX: u32 = 64;

/// A reader's selection of maps, checked against the vehicle.
#[derive(Clone, Debug)]
pub struct Selection {
    /// The layers to send; all if empty.
    pub layers: Vec<String>,
    /// The part of each layer to send; the whole layer if absent.
    pub region: Option<v1::Region>,
    /// True if layers may be sent as deltas.
    pub deltas: bool,
    /// True if the state of the vehicle is sent while no map comes.
    pub states: bool,
    /// True if the newest plan is sent with each map.
    pub plans: bool,
    /// Which maps are sent.
    pub rate: Rate,
    /// How many maps may be on the way.
    pub credits: Credits,
}

impl Selection {
    /// Checks the selection of a reader of this vehicle.
    ///
    /// # Errors
    /// `InvalidArgument` for an unknown layer, a value that is not allowed, or a region outside the grids; it names the
    /// value and what is allowed.
    pub fn new(served: &Served, selection: v1::Selection) -> Result<Self, Status> {
        let v1::Selection { vehicle: _, layers, max_in_flight, max_rate_hz, region, deltas, states, plans } = selection;
        served.check_layers(&layers)?;
        if max_in_flight > IN_FLIGHT_MAX {
            let text = format!("max_in_flight {max_in_flight}: 0 to {IN_FLIGHT_MAX} is allowed");
            return Err(Status::invalid_argument(text));
        }
        let selection = Self {
            layers,
            region,
            deltas,
            states,
            plans,
            rate: Rate::new(max_rate_hz)?,
            credits: Credits::new(max_in_flight as usize),
        };
        let refused = |error: RegionError| Status::invalid_argument(error.to_string());
        selection.region.as_ref().map_or(Ok(()), region::check).map_err(refused)?;
        // If there is a map already, a region outside its grids is refused before the stream begins.
        if let Some(newest) = served.newest.borrow().clone().filter(|_| selection.region.is_some()) {
            selection.bytes(&newest, None)?;
        }
        Ok(selection)
    }

    /// The payload of a map, as a delta against `base` if there is one.
    ///
    /// # Errors
    /// `InvalidArgument` if the region lies outside a layer's grid.
    pub fn bytes(&self, map: &EncodedMap, base: Option<&EncodedMap>) -> Result<Bytes, Status> {
        let bytes = map.encode_for(&self.layers, self.region.as_ref(), base);
        bytes.map_err(|error| Status::invalid_argument(error.to_string()))
    }
}

/// Selects maps by their capture stamps, so that the mean rate stays below a limit.
#[derive(Clone, Debug)]
pub struct Rate {
    /// Least mean time between two maps, in ns; 0 sends every map.
    period_ns: i64,
    /// Capture stamp from which the next map is due; `None` before the first map.
    due_ns: Option<i64>,
}

impl Rate {
    fn new(max_rate_hz: Option<f64>) -> Result<Self, Status> {
        let period_ns = match max_rate_hz {
            None => 0,
            // Saturates: a very small rate sends one map.
            Some(hz) if hz.is_finite() && hz > 0.0 => (1e9 / hz) as i64,
            Some(hz) => {
                let text = format!("max_rate_hz {hz}: more than 0 and finite is allowed; absent, every map is sent");
                return Err(Status::invalid_argument(text));
            }
        };
        Ok(Self { period_ns, due_ns: None })
    }

    /// True if a map captured at `stamp_ns` is due.
    pub fn is_due(&self, stamp_ns: i64) -> bool {
        self.period_ns == 0 || self.due_ns.is_none_or(|due_ns| stamp_ns >= due_ns)
    }

    /// Records that a map captured at `stamp_ns` was sent. The next map is due one period after this map was due,
    /// however late it came, so that the mean rate is kept even if the map rate is no multiple of it; a reader that was
    /// away does not catch up. The quarter of a period allows for jitter of the maps.
    pub fn send(&mut self, stamp_ns: i64) {
        let quarter_ns = self.period_ns / 4;
        self.due_ns = match self.due_ns {
            None => Some(stamp_ns.saturating_add(3 * quarter_ns)),
            // A replay has jumped back.
            Some(due_ns) if due_ns.saturating_sub(stamp_ns) > self.period_ns.saturating_mul(2) => {
                Some(stamp_ns.saturating_add(3 * quarter_ns))
            }
            // A requested keyframe was sent between two maps that are due.
            Some(due_ns) if stamp_ns < due_ns => Some(due_ns),
            Some(due_ns) => Some(due_ns.saturating_add(self.period_ns).max(stamp_ns.saturating_add(quarter_ns))),
        };
    }

    /// How many of `between` maps, captured between two sent maps, the rate would have allowed.
    fn room(&self, between: u64, sent_ns: [i64; 2]) -> u64 {
        if self.period_ns == 0 {
            return between;
        }
        let periods = sent_ns[1].saturating_sub(sent_ns[0]) / self.period_ns;
        between.min(u64::try_from(periods - 1).unwrap_or(0))
    }

    /// Maps between two sent maps: (missed, left out because of the rate).
    pub fn between(&self, last: Sent, next: Sent) -> (u64, u64) {
        if last.boot_id != next.boot_id {
            // A jump of a replay, which leaves nothing out.
            return (0, 0);
        }
        let all = next.sequence.saturating_sub(last.sequence.saturating_add(1));
        let missed = self.room(all, [last.stamp_ns, next.stamp_ns]);
        (missed, all - missed)
    }
}

/// Sequence and capture stamp of a sent map.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    /// Boot id of the map.
    pub boot_id: u64,
    /// Sequence of the map.
    pub sequence: u64,
    /// End of its capture, in ns since the Unix epoch.
    pub stamp_ns: i64,
}

/// Maps on the way to a reader that it has not acknowledged.
#[derive(Clone, Debug)]
pub struct Credits {
    max_in_flight: usize,
    in_flight: VecDeque<u64>,
    /// Sequence of the last map sent, and of the last one acknowledged.
    sent: Option<u64>,
    acknowledged: Option<u64>,
}

impl Credits {
    fn new(max_in_flight: usize) -> Self {
        Self { max_in_flight, in_flight: VecDeque::new(), sent: None, acknowledged: None }
    }

    /// True if the reader acknowledges.
    pub fn are_limited(&self) -> bool {
        self.max_in_flight > 0
    }

    /// True if no map is on the way.
    pub fn are_all_back(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// True if one more map may be sent; always true for readers that never acknowledge.
    pub fn left(&self) -> bool {
        self.max_in_flight == 0 || self.in_flight.len() < self.max_in_flight
    }

    /// Records that a map was sent.
    pub fn send(&mut self, sequence: u64) {
        self.sent = Some(sequence);
        if self.max_in_flight > 0 {
            self.in_flight.push_back(sequence);
        }
    }

    /// Records that the reader has processed this map and all before it. A repeated acknowledgement changes nothing.
    ///
    /// # Errors
    /// `InvalidArgument` if the map was never sent on this stream.
    pub fn acknowledge(&mut self, sequence: u64) -> Result<(), Status> {
        let known = if self.max_in_flight == 0 {
            self.sent.is_some_and(|sent| sequence <= sent)
        } else {
            self.in_flight.contains(&sequence) || self.acknowledged.is_some_and(|last| sequence <= last)
        };
        if !known {
            let last = self.sent.map_or("none was sent yet".to_owned(), |sent| format!("the last one sent is {sent}"));
            let text = format!("acknowledged {sequence}: this map was never sent on this stream; {last}");
            return Err(Status::invalid_argument(text));
        }
        // By its place and not by its number: after a jump of a replay the numbers begin again.
        if let Some(place) = self.in_flight.iter().position(|&sent| sent == sequence) {
            self.in_flight.drain(..=place);
        }
        self.acknowledged = self.acknowledged.max(Some(sequence));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn no_more_maps_are_on_their_way_than_the_reader_allows() {
        let mut credits = Credits::new(2);
        credits.send(10);
        assert!(credits.left());
        credits.send(14);
        assert!(!credits.left());
        credits.acknowledge(10).unwrap();
        assert!(credits.left());
        credits.send(15);
        credits.acknowledge(10).unwrap();
        assert!(!credits.left(), "an old acknowledgement frees nothing");
        credits.acknowledge(15).unwrap();
        assert!(credits.in_flight.is_empty());
    }

    #[test]
    fn a_map_that_was_never_sent_cannot_be_acknowledged() {
        for max_in_flight in [0, 2] {
            let mut credits = Credits::new(max_in_flight);
            let refused = credits.acknowledge(0).unwrap_err();
            assert!(refused.message().contains("acknowledged 0") && refused.message().contains("none was sent yet"));
            credits.send(10);
            credits.send(14);
            let refused = credits.acknowledge(15).unwrap_err();
            assert_eq!(refused.code(), tonic::Code::InvalidArgument);
            assert!(refused.message().ends_with("the last one sent is 14"), "{refused}");
            assert!(credits.acknowledge(u64::MAX).is_err());
        }
        let mut credits = Credits::new(2);
        credits.send(10);
        credits.send(14);
        assert!(
            credits.acknowledge(9).is_err() && credits.acknowledge(12).is_err(),
            "skipped maps were not sent either"
        );
        credits.acknowledge(14).unwrap();
    }

    #[test]
    fn a_reader_that_never_acknowledges_gets_every_map() {
        let mut credits = Credits::new(0);
        (0..1000).for_each(|sequence| credits.send(sequence));
        assert!(credits.left() && credits.in_flight.is_empty());
    }

    /// Stamps of the sent maps, if maps are made at `stamps`.
    fn selected(hz: f64, stamps: impl IntoIterator<Item = i64>) -> Vec<i64> {
        let mut rate = Rate::new(Some(hz)).unwrap();
        let due = |stamp: &i64| {
            let due = rate.is_due(*stamp);
            if due {
                rate.send(*stamp);
            }
            due
        };
        stamps.into_iter().filter(due).collect()
    }

    #[test]
    fn maps_are_sent_at_the_requested_rate_and_no_faster() {
        // 10 Hz with 8 ms of jitter.
        let stamps = || (0..600).map(|scan| scan * 100 * MS + (scan * 37 % 17 - 8) * MS);
        for (hz, expected) in [(100.0, 600), (10.0, 600), (7.0, 420), (5.0, 300), (3.0, 180), (0.5, 30), (1e-300, 1)] {
            let got = selected(hz, stamps());
            assert!(got.len().abs_diff(expected) <= 1, "{hz} Hz: {} of {expected}", got.len());
            assert_eq!(got[0], stamps().next().unwrap(), "the first map is there at once");
            let mut rate = Rate::new(Some(hz)).unwrap();
            rate.send(0);
            for pair in got.windows(2) {
                let between = stamps().filter(|stamp| (pair[0] + 1..pair[1]).contains(stamp)).count() as u64;
                assert_eq!(rate.room(between, [pair[0], pair[1]]), 0, "{hz} Hz: a reader that keeps up misses no map");
            }
        }
    }

    #[test]
    fn maps_left_out_by_the_rate_are_counted_apart_from_missed_ones() {
        let rate = Rate::new(Some(5.0)).unwrap();
        // Away for 2 s of 10 Hz maps: 19 maps in between; 5 Hz had room for 9 of them.
        assert_eq!(rate.room(19, [0, 2000 * MS]), 9);
        assert_eq!(Rate::new(None).unwrap().room(19, [0, 2000 * MS]), 19);
        assert_eq!(rate.room(2, [0, 2000 * MS]), 2, "no more than there were");
    }

    #[test]
    fn an_invalid_rate_is_refused_with_its_value() {
        for hz in [0.0, -0.0, -1.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let refused = Rate::new(Some(hz)).unwrap_err();
            assert_eq!(refused.code(), tonic::Code::InvalidArgument);
            assert!(refused.message().starts_with(&format!("max_rate_hz {hz}: more than 0")), "{refused}");
        }
    }
}
