//! What waits in the server for its readers: bytes of one response, of its connection, of its address, and of all.
//!
//! A response gives its next message to the transport only while all four are within their limits, so that readers that
//! do not read cost the server no more than these, and skip maps instead. A connection for which nothing waits may
//! always have one message: nothing that others do can stop a reader that reads.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use crate::base::sync::locked;

/// Most bytes that wait for one response, for one connection, for one address and for all. Ours: a map of the default
/// grids has less than 64 KiB; a message may exceed a limit once.
const RESPONSE_BYTES_MAX: usize = 128 << 10;
const CONNECTION_BYTES_MAX: usize = 1 << 20;
const ADDRESS_BYTES_MAX: usize = 8 << 20;
const ALL_BYTES_MAX: usize = 32 << 20;

/// What waits for all readers of one listener.
#[derive(Debug)]
pub struct Flows {
    responses_max: usize,
    responses_per_address_max: usize,
    kept: usize,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    bytes: usize,
    responses: usize,
    addresses: HashMap<IpAddr, Share>,
    connections: HashMap<u64, Share>,
}

#[derive(Debug, Default)]
struct Share {
    bytes: usize,
    responses: usize,
}

impl Flows {
    /// At most so many responses at once, in all and for one address. So many of all, but no more than half, are kept
    /// for known peers.
    pub fn new(responses_max: usize, responses_per_address_max: usize, kept: usize) -> Arc<Self> {
        let kept = kept.min(responses_max / 2);
        Arc::new(Self { responses_max, responses_per_address_max, kept, held: Mutex::default() })
    }

    /// Begins a response; `None` if there are too many.
    pub fn begin(self: &Arc<Self>, peer: IpAddr, connection: u64, is_known: bool) -> Option<Arc<Flow>> {
        let mut held = locked(&self.held);
        let of_address = held.addresses.get(&peer).map_or(0, |share| share.responses);
        let responses_max = self.responses_max - if is_known { 0 } else { self.kept };
        if held.responses >= responses_max || of_address >= self.responses_per_address_max {
            return None;
        }
        held.responses += 1;
        held.addresses.entry(peer).or_default().responses += 1;
        held.connections.entry(connection).or_default().responses += 1;
        let state = Mutex::new(State { bytes: 0, is_polled: true, moved: Instant::now() });
        Some(Arc::new(Flow { peer, connection, flows: self.clone(), state }))
    }

    /// Bytes that wait for all readers.
    pub fn bytes(&self) -> usize {
        locked(&self.held).bytes
    }
}

/// What waits for one response.
#[derive(Debug)]
pub struct Flow {
    peer: IpAddr,
    connection: u64,
    flows: Arc<Flows>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    bytes: usize,
    /// True if the transport has asked for the next piece since it got the last one.
    is_polled: bool,
    moved: Instant,
}

impl Flow {
    /// Since when a piece waits that the transport cannot send; `None` if none does.
    pub fn stuck_since(&self) -> Option<Instant> {
        let state = locked(&self.state);
        (state.bytes > 0 || !state.is_polled).then_some(state.moved)
    }

    /// True if the response may have one more message.
    pub fn is_within_limits(&self) -> bool {
        let own = locked(&self.state).bytes;
        let held = locked(&self.flows.held);
        let of_connection = held.connections.get(&self.connection).map_or(0, |share| share.bytes);
        let of_address = held.addresses.get(&self.peer).map_or(0, |share| share.bytes);
        of_connection == 0
            || (own < RESPONSE_BYTES_MAX
                && of_connection < CONNECTION_BYTES_MAX
                && of_address < ADDRESS_BYTES_MAX
                && held.bytes < ALL_BYTES_MAX)
    }

    /// Records bytes that wait.
    pub fn add(&self, bytes: usize) {
        let mut state = locked(&self.state);
        if state.bytes == 0 {
            state.moved = Instant::now();
        }
        state.bytes += bytes;
        self.change(|held| *held += bytes);
    }

    /// Records that bytes no longer wait.
    pub fn remove(&self, bytes: usize) {
        let mut state = locked(&self.state);
        (state.bytes, state.moved) = (state.bytes - bytes, Instant::now());
        self.change(|held| *held -= bytes);
    }

    fn change(&self, change: impl Fn(&mut usize)) {
        let mut held = locked(&self.flows.held);
        change(&mut held.bytes);
        held.addresses.get_mut(&self.peer).into_iter().for_each(|share| change(&mut share.bytes));
        held.connections.get_mut(&self.connection).into_iter().for_each(|share| change(&mut share.bytes));
    }

    /// Records whether the transport has asked for the next piece since it got the last one.
    pub fn set_polled(&self, is_polled: bool) {
        let mut state = locked(&self.state);
        if state.is_polled != is_polled {
            (state.is_polled, state.moved) = (is_polled, Instant::now());
        }
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        let mut held = locked(&self.flows.held);
        held.responses -= 1;
        let Held { addresses, connections, .. } = &mut *held;
        release(addresses, &self.peer);
        release(connections, &self.connection);
    }
}

/// Ends a response in a share, which goes with its last one.
fn release<K: std::hash::Hash + Eq>(shares: &mut HashMap<K, Share>, key: &K) {
    if let Some(share) = shares.get_mut(key) {
        share.responses -= 1;
        if share.responses == 0 {
            shares.remove(key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_responses_are_for_known_peers() {
        let flows = Flows::new(4, 4, 9);
        let address = |last: u8| IpAddr::from([127, 0, 0, last]);
        let mut held: Vec<_> = (1..=2).map(|last| flows.begin(address(last), 1, false).expect("room")).collect();
        assert!(flows.begin(address(3), 1, false).is_none());
        held.extend((3..=4).map(|last| flows.begin(address(last), 1, true).expect("it is kept")));
        assert!(flows.begin(address(5), 1, true).is_none());
        drop(held);
        assert!(flows.begin(address(5), 1, false).is_some());
    }
}
