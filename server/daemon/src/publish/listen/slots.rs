//! The connection slots of one listener: limits of connections and calls, in all and for one address.
//!
//! A newcomer takes a free slot, or the slot of the connection that has been without a call for the longest time. It is
//! refused only if every connection has a call in progress. Some slots are kept for known peers. So idle, silent and
//! half-open connections can never keep another peer out, however many hosts open them.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use super::access::Caller;
use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::config::Connections;

/// Longest time from the connection to its first request, with the TLS handshake. Ours: every client sends at once.
const FIRST_REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Most connections over the limit that are open at once to receive an error; others get none. Ours: few file handles.
const REFUSED_MAX: usize = 16;

/// Connections that only known peers may use: at least half of all are for every peer.
fn kept_connections(limits: &Connections) -> usize {
    limits.kept.min(limits.max / 2)
}

/// Calls that only known peers may have in progress: at least half of all are for every peer.
fn kept_calls(limits: &Connections) -> usize {
    kept_connections(limits).min(limits.calls_max / 2)
}

/// The address that limits count: an IPv4 address, or a network of IPv6 with a prefix of 64 bits, because a host may
/// take any address of its network.
fn counted_address(peer: IpAddr) -> IpAddr {
    match peer {
        IpAddr::V4(_) => peer,
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() >> 64 << 64).into(),
    }
}

/// The connection slots of one listener.
#[derive(Debug)]
pub struct ConnectionSlots(Mutex<Slots>);

#[derive(Debug)]
struct Slots {
    limits: Connections,
    open: BTreeMap<u64, OpenConnection>,
    /// Number of connections and calls so far, which numbers them.
    count: u64,
    /// Connections and calls that were refused or closed by the server, by reason.
    closed: BTreeMap<&'static str, u64>,
    /// Time of the listener's newest heartbeat.
    heartbeat: Option<Instant>,
}

/// What a call was allowed by.
#[derive(Debug)]
pub struct Authorization {
    /// The RPC or the path.
    pub path: String,
    /// The names in the certificate and of the token.
    pub names: Vec<String>,
    /// The client, with the vehicles and layers that it may reach.
    pub caller: Caller,
}

#[derive(Debug)]
struct OpenConnection {
    address: IpAddr,
    is_known: bool,
    /// The limit that the connection exceeds, as a text: it is served nothing else.
    refusal: Option<String>,
    opened: Instant,
    has_requested: bool,
    idle_since: Instant,
    calls: BTreeMap<u64, Authorization>,
    /// When the client's certificate ends, in seconds since the Unix epoch.
    certificate_end_s: Option<i64>,
    closing: CancellationToken,
}

impl OpenConnection {
    fn is_counted(&self) -> bool {
        self.refusal.is_none() && !self.closing.is_cancelled()
    }

    /// The reason to close the connection now.
    fn fault(&self, idle: Duration, now: Instant) -> Option<&'static str> {
        let past = |since: Instant, limit| now.saturating_duration_since(since) > limit;
        let has_ended = self.certificate_end_s.is_some_and(|end_s| now_ns() / 1_000_000_000 > end_s);
        match self.has_requested {
            _ if has_ended => Some("certificate_end"),
            false => past(self.opened, FIRST_REQUEST_TIMEOUT.min(idle)).then_some("no_request"),
            true => (self.calls.is_empty() && past(self.idle_since, idle)).then_some("idle"),
        }
    }
}

impl Slots {
    fn count(&mut self, reason: &'static str) {
        *self.closed.entry(reason).or_default() += 1;
    }

    fn next_number(&mut self) -> u64 {
        self.count += 1;
        self.count
    }

    /// Finds room for one more connection, if need be by closing an idle one.
    ///
    /// # Errors
    /// What is exhausted, as a text.
    fn make_room(&mut self, peer: IpAddr, is_known: bool) -> Result<(), String> {
        let (address, limits) = (counted_address(peer), &self.limits);
        let open =
            |of: &dyn Fn(&OpenConnection) -> bool| self.open.values().filter(|c| c.is_counted() && of(c)).count();
        let (all, unknown) = (open(&|_| true), open(&|connection| !connection.is_known));
        let of_address = open(&|connection| connection.address == address);
        let (most, kept) = (limits.max, kept_connections(limits));
        if of_address >= limits.per_address_max && !self.close_idlest(|connection| connection.address == address) {
            return Err(format!(
                "{of_address} connections of {peer} are open, which connections.per_address_max allows"
            ));
        }
        let is_full = all >= most || (!is_known && unknown >= most - kept);
        if is_full && !self.close_idlest(|connection| is_known || !connection.is_known) {
            return Err(match all >= most {
                true => {
                    format!("{most} connections are open, which connections.max allows; try again when one is closed")
                }
                false => format!(
                    "{unknown} connections are open; of the {most} that connections.max allows, {kept} are kept for known \
                     peers"
                ),
            });
        }
        Ok(())
    }

    /// Closes the connection that has been idle for the longest time among these; unknown peers first.
    fn close_idlest(&mut self, among: impl Fn(&OpenConnection) -> bool) -> bool {
        let idle = self.open.values().filter(|c| c.is_counted() && c.calls.is_empty() && among(c));
        let Some(idlest) = idle.min_by_key(|connection| (connection.is_known, connection.idle_since)) else {
            return false;
        };
        idlest.closing.cancel();
        self.count("made_room");
        true
    }

    /// Closes the connections for which there is a reason.
    fn close(&mut self, reason: impl Fn(&OpenConnection) -> Option<&'static str>) {
        for connection in self.open.values().filter(|connection| !connection.closing.is_cancelled()) {
            if let Some(reason) = reason(connection) {
                tracing::info!(address = %connection.address, reason, "connection closed");
                connection.closing.cancel();
                *self.closed.entry(reason).or_default() += 1;
            }
        }
    }
}

impl ConnectionSlots {
    /// The slots of a listener without a connection.
    pub fn new(limits: Connections) -> Arc<Self> {
        let (open, closed) = (BTreeMap::new(), BTreeMap::new());
        Arc::new(Self(Mutex::new(Slots { limits, open, count: 0, closed, heartbeat: None })))
    }

    /// Uses other limits from now on; open connections stay.
    pub fn set_limits(&self, limits: Connections) {
        locked(&self.0).limits = limits;
    }

    /// Number of open connections, and the connections and calls that were refused or closed by the server, by reason.
    pub fn counts(&self) -> (usize, BTreeMap<&'static str, u64>) {
        let slots = locked(&self.0);
        (slots.open.len(), slots.closed.clone())
    }

    /// Counts a connection or a call that was refused or closed.
    pub fn count(&self, reason: &'static str) {
        locked(&self.0).count(reason);
    }

    /// How long the listener has given no sign of life; `None` before its first.
    pub fn silent(&self) -> Option<Duration> {
        locked(&self.0).heartbeat.map(|at| at.elapsed())
    }

    /// Longest time in which a peer takes no byte of what is sent to it.
    pub fn stalled_max(&self) -> Duration {
        Duration::from_secs(locked(&self.0).limits.stalled_s)
    }

    /// Closes the connections with a call that was allowed and no longer is.
    pub fn recheck(&self, is_allowed: impl Fn(&Authorization) -> bool) {
        locked(&self.0).close(|connection| (!connection.calls.values().all(&is_allowed)).then_some("role_lost"));
    }

    /// Closes up to `most` connections without a call, idle connections first, to free file handles; returns how many.
    pub fn free(&self, most: usize) -> usize {
        let mut slots = locked(&self.0);
        (0..most).take_while(|_| slots.close_idlest(|_| true)).count()
    }

    /// Notes that the listener is at work, and closes the connections that are idle or whose certificate has ended.
    pub fn sweep(&self) {
        let (mut slots, now) = (locked(&self.0), Instant::now());
        slots.heartbeat = Some(now);
        let idle = Duration::from_secs(slots.limits.idle_s);
        slots.close(|connection| connection.fault(idle, now));
    }

    /// Admits a connection of this peer. Over a limit it gets a slot in which it can only receive an error, and of
    /// these there are a few.
    pub fn admit(self: &Arc<Self>, peer: IpAddr) -> ConnectionSlot {
        let (mut slots, now) = (locked(&self.0), Instant::now());
        let is_known = slots.limits.known.contains(&peer);
        let refusal = slots.make_room(peer, is_known).err();
        if refusal.is_some() {
            let refused = slots.open.values().filter(|c| c.refusal.is_some() && !c.closing.is_cancelled());
            let refused: Vec<_> = refused.collect();
            // The oldest: a peer that has a certificate shows it at once, and then it is within the limit.
            if let Some(oldest) = refused.first().filter(|_| refused.len() >= REFUSED_MAX) {
                oldest.closing.cancel();
            }
        }
        let (number, closing) = (slots.next_number(), CancellationToken::new());
        let connection = OpenConnection {
            address: counted_address(peer),
            is_known,
            refusal,
            opened: now,
            has_requested: false,
            idle_since: now,
            calls: BTreeMap::new(),
            certificate_end_s: None,
            closing: closing.clone(),
        };
        slots.open.insert(number, connection);
        ConnectionSlot { number, peer, closing, slots: self.clone() }
    }
}

/// The slot of one connection; it is free again when this is dropped.
#[derive(Debug)]
pub struct ConnectionSlot {
    number: u64,
    /// The address of the peer.
    pub peer: IpAddr,
    /// Is cancelled when the connection is to be closed.
    pub closing: CancellationToken,
    slots: Arc<ConnectionSlots>,
}

impl ConnectionSlot {
    /// The address that limits count: the peer's, or its IPv6 network of 64 bits.
    pub fn address(&self) -> IpAddr {
        counted_address(self.peer)
    }

    /// Counts a refusal or an end of this connection.
    pub fn count(&self, reason: &'static str) {
        self.slots.count(reason);
    }

    /// Logs and counts the end of the connection under `reason`, and closes it.
    pub fn close(&self, reason: &'static str) {
        tracing::info!(peer = %self.peer, reason, "connection closed");
        self.count(reason);
        self.closing.cancel();
    }

    /// The peer has shown a certificate or token that has a role: it may use the slots kept for known peers.
    pub fn set_known(&self) {
        let mut slots = locked(&self.slots.0);
        let Some(connection) = slots.open.get_mut(&self.number) else { return };
        let was_known = std::mem::replace(&mut connection.is_known, true);
        if !was_known && connection.refusal.is_some() && slots.make_room(self.peer, true).is_ok() {
            slots.open.get_mut(&self.number).into_iter().for_each(|connection| connection.refusal = None);
        }
    }

    /// The end of the certificate that the client has shown, in seconds since the Unix epoch.
    pub fn set_certificate_end(&self, end_s: Option<i64>) {
        locked(&self.slots.0).open.get_mut(&self.number).into_iter().for_each(|of| of.certificate_end_s = end_s);
    }

    /// Notes that a request has come; a connection over a limit still has to end in time.
    ///
    /// # Errors
    /// The limit that the connection exceeds, as a text: it is served nothing else.
    pub fn begin_request(&self) -> Result<(), String> {
        let mut slots = locked(&self.slots.0);
        let Some(connection) = slots.open.get_mut(&self.number) else { return Ok(()) };
        connection.refusal.clone().map_or(Ok(()), Err)?;
        (connection.has_requested, connection.idle_since) = (true, Instant::now());
        Ok(())
    }

    /// Begins a call; `None` if too many calls of all peers or of this peer's address are in progress.
    pub fn begin_call(self: &Arc<Self>, authorization: Authorization) -> Option<CallPermit> {
        let (mut slots, address) = (locked(&self.slots.0), self.address());
        let calls = |of: &dyn Fn(&OpenConnection) -> bool| -> usize {
            slots.open.values().filter(|connection| of(connection)).map(|connection| connection.calls.len()).sum()
        };
        let (all, of_address) = (calls(&|_| true), calls(&|connection| connection.address == address));
        let (limits, is_known) = (&slots.limits, slots.open.get(&self.number)?.is_known);
        let calls_max = limits.calls_max - if is_known { 0 } else { kept_calls(limits) };
        if all >= calls_max || of_address >= limits.calls_per_address_max {
            return None;
        }
        let number = slots.next_number();
        slots.open.get_mut(&self.number)?.calls.insert(number, authorization);
        Some(CallPermit { number, slot: self.clone() })
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        locked(&self.slots.0).open.remove(&self.number);
    }
}

/// The permit of one call, which is in progress until this is dropped.
#[derive(Debug)]
pub struct CallPermit {
    number: u64,
    /// The slot of the call's connection.
    pub slot: Arc<ConnectionSlot>,
}

impl Drop for CallPermit {
    fn drop(&mut self) {
        if let Some(connection) = locked(&self.slot.slots.0).open.get_mut(&self.slot.number) {
            connection.calls.remove(&self.number);
            connection.idle_since = Instant::now();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slots(limits: Connections) -> Arc<ConnectionSlots> {
        ConnectionSlots::new(limits)
    }

    fn begin(slot: &Arc<ConnectionSlot>) -> Option<CallPermit> {
        let (path, names, caller) = Default::default();
        slot.begin_call(Authorization { path, names, caller })
    }

    #[test]
    fn a_host_with_a_network_of_ipv6_counts_as_one_address() {
        let slots = slots(Connections { per_address_max: 2, calls_per_address_max: 2, ..Default::default() });
        let of = |address: &str| Arc::new(slots.admit(address.parse().unwrap()));
        let held = ["2001:db8::1", "2001:db8::2"].map(|address| begin(&of(address)).expect("a call"));
        let third = of("2001:db8::ffff:3");
        assert!(third.begin_request().is_err() && begin(&third).is_none());
        for other in ["2001:db8:0:1::1", "10.0.0.1"].map(of) {
            assert!(other.begin_request().is_ok() && begin(&other).is_some());
        }
        drop(held);
    }

    #[test]
    fn the_last_calls_are_for_known_peers() {
        let slots = slots(Connections { calls_max: 4, kept: 9, ..Default::default() });
        let peer = |last: u8, is_known: bool| {
            let slot = Arc::new(slots.admit([127, 0, 0, last].into()));
            if is_known {
                slot.set_known();
            }
            slot
        };
        let mut held: Vec<_> = (1..=2).map(|last| begin(&peer(last, false)).expect("room")).collect();
        assert!(begin(&peer(3, false)).is_none());
        held.extend((3..=4).map(|last| begin(&peer(last, true)).expect("it is kept")));
        assert!(begin(&peer(5, true)).is_none());
        drop(held);
        assert!(begin(&peer(5, false)).is_some());
    }
}
