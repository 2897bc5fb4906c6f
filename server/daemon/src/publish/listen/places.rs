//! The connections of one listener: how many there may be, in all and of one address, and which are closed because
//! they do nothing.
//!
//! A newcomer takes a free place, or the place of the connection that has been without a request for the longest time.
//! It is refused only if every connection has a request in progress. Some places are kept for known peers. So idle,
//! silent and half-open connections can never keep another peer out, however many hosts open them.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

use super::access::Caller;
use super::flow::{Flow, Flows};
use crate::base::sync::locked;
use crate::config;

/// Longest time from the connection to its first request, with the TLS handshake. Ours: every client sends at once.
const FIRST_REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest time that a connection over the limit stays open: enough for a handshake, one call and its answer.
const OVER_LIMIT_TIMEOUT: Duration = Duration::from_secs(5);
/// Most connections over the limit that are open at once to receive an error; others are closed without one. Ours: a
/// small share of the file handles of a process.
const OVER_LIMIT_MAX: usize = 16;

/// The limits of one listener.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Most connections.
    pub connections_max: usize,
    /// What says so, in an error.
    pub allowed_by: &'static str,
    /// Most connections of one address.
    pub per_address_max: usize,
    /// Connections that only known peers may use.
    pub kept: usize,
    /// Addresses that are known.
    pub known: Vec<IpAddr>,
    /// Longest time without a request.
    pub idle: Duration,
    /// Longest time in which nothing of what waits for the peer is sent.
    pub stalled: Duration,
}

impl Limits {
    /// The limits of a configuration, for a listener with at most `connections_max` connections. At least half of them
    /// are for every peer.
    pub fn new(config: &config::Connections, connections_max: usize, allowed_by: &'static str) -> Self {
        Self {
            connections_max,
            allowed_by,
            per_address_max: config.per_address_max,
            kept: config.kept.min(connections_max / 2),
            known: config.known.clone(),
            idle: Duration::from_secs(config.idle_s),
            stalled: Duration::from_secs(config.stalled_s),
        }
    }
}

/// What counts as one address: an IPv4 address, or a network of IPv6 with a prefix of 64 bits, because a host may take
/// any address of its network.
fn host_of(peer: IpAddr) -> IpAddr {
    match peer {
        IpAddr::V4(_) => peer,
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() >> 64 << 64).into(),
    }
}

/// The connections of one listener.
#[derive(Debug)]
pub struct Places {
    limits: Mutex<Limits>,
    open: Mutex<Open>,
    /// Connections that were refused or closed by the server, by reason.
    closed: Mutex<BTreeMap<&'static str, u64>>,
    flows: Arc<Flows>,
    beat: Mutex<Option<Instant>>,
}

/// The connections of all listeners of a server, which share its file handles.
#[derive(Clone, Debug, Default)]
pub struct AllPlaces(Arc<Mutex<Vec<Arc<Places>>>>);

impl AllPlaces {
    /// Adds those of one listener.
    pub fn add(&self, places: Arc<Places>) {
        locked(&self.0).push(places);
    }

    /// Closes up to `count` connections without a request, those that have been so for the longest time first, to free
    /// their file handles. Returns how many.
    pub fn free(&self, count: usize) -> usize {
        let all = locked(&self.0).clone();
        let mut idle: Vec<_> = all
            .iter()
            .flat_map(|places| places.idle().into_iter().map(move |(key, occupant)| (key, occupant, places)))
            .collect();
        idle.sort_by_key(|(key, ..)| *key);
        idle.truncate(count);
        for (_, occupant, places) in &idle {
            occupant.closing.cancel();
            places.count("made_room");
        }
        idle.len()
    }
}

/// What a request was allowed by, while it is in progress.
#[derive(Debug)]
pub struct Grant {
    /// The RPC or the path.
    pub path: String,
    /// The names in the certificate and of the token.
    pub names: Vec<String>,
    /// What the client may reach.
    pub caller: Caller,
}

#[derive(Debug, Default)]
struct Open {
    next: u64,
    all: BTreeMap<u64, Arc<Occupant>>,
}

/// What is known of one connection.
#[derive(Debug)]
struct Occupant {
    peer: IpAddr,
    /// What counts as one address.
    host: IpAddr,
    is_known: AtomicBool,
    over_limit: Mutex<Option<String>>,
    opened: Instant,
    closing: CancellationToken,
    activity: Mutex<Activity>,
    flows: Mutex<Vec<Arc<Flow>>>,
    grants: Mutex<Vec<Weak<Grant>>>,
    /// Pieces of responses that the transport was given since the last [`Place::take_pieces`].
    pieces: AtomicU32,
    /// That of the newest request: a WebSocket outlives its response.
    newest_grant: Mutex<Option<Arc<Grant>>>,
}

#[derive(Debug)]
struct Activity {
    requests: u64,
    in_progress: u32,
    /// Since when no request is in progress.
    idle_since: Instant,
    /// Since when the socket takes no byte of what is to be sent.
    blocked_since: Option<Instant>,
}

impl Occupant {
    /// Since when it has been without a request; `None` while it has one, and if it is being closed.
    fn idle_since(&self) -> Option<Instant> {
        let activity = locked(&self.activity);
        (activity.in_progress == 0 && !self.closing.is_cancelled()).then_some(activity.idle_since)
    }

    fn is_known(&self) -> bool {
        self.is_known.load(Ordering::Relaxed)
    }

    fn is_over_limit(&self) -> bool {
        locked(&self.over_limit).is_some()
    }

    fn counts(&self) -> bool {
        !self.is_over_limit() && !self.closing.is_cancelled()
    }

    /// Why the connection is to be closed now.
    fn fault(&self, limits: &Limits, now: Instant) -> Option<&'static str> {
        let past = |since: Instant, limit: Duration| now.saturating_duration_since(since) > limit;
        if self.is_over_limit() {
            return past(self.opened, OVER_LIMIT_TIMEOUT).then_some("over_limit_timeout");
        }
        let activity = locked(&self.activity);
        if activity.requests == 0 && past(self.opened, FIRST_REQUEST_TIMEOUT.min(limits.idle)) {
            return Some("no_request");
        }
        if activity.in_progress == 0 && activity.requests > 0 && past(activity.idle_since, limits.idle) {
            return Some("idle");
        }
        let is_blocked = activity.blocked_since.is_some_and(|since| past(since, limits.stalled));
        drop(activity);
        let mut flows = locked(&self.flows);
        flows.retain(|flow| Arc::strong_count(flow) > 1);
        let is_stalled =
            is_blocked || flows.iter().any(|flow| flow.stuck_since().is_some_and(|s| past(s, limits.stalled)));
        is_stalled.then_some("stalled")
    }
}

impl Places {
    /// No connection yet. `flows` is what waits for all peers of this listener.
    pub fn new(limits: Limits, flows: Arc<Flows>) -> Arc<Self> {
        Arc::new(Self {
            limits: Mutex::new(limits),
            open: Mutex::default(),
            closed: Mutex::default(),
            flows,
            beat: Mutex::default(),
        })
    }

    /// Uses other limits from now on; open connections stay.
    pub fn set_limits(&self, limits: Limits) {
        *locked(&self.limits) = limits;
    }

    /// Number of open connections, and the connections that were refused or closed by the server, by reason.
    pub fn counts(&self) -> (usize, BTreeMap<&'static str, u64>) {
        (locked(&self.open).all.len(), locked(&self.closed).clone())
    }

    /// Counts a connection that was refused or closed.
    pub fn count(&self, reason: &'static str) {
        *locked(&self.closed).entry(reason).or_default() += 1;
    }

    /// The connections without a request, each with what says how soon it may be closed.
    fn idle(&self) -> Vec<((bool, Instant), Arc<Occupant>)> {
        let open = locked(&self.open);
        let idle = |occupant: &Arc<Occupant>| Some(((occupant.is_known(), occupant.idle_since()?), occupant.clone()));
        open.all.values().filter_map(idle).collect()
    }

    /// Notes that the listener is at work.
    pub fn beat(&self) {
        *locked(&self.beat) = Some(Instant::now());
    }

    /// How long the listener has given no sign of life; `None` before its first.
    pub fn silent(&self) -> Option<Duration> {
        locked(&self.beat).map(|at| at.elapsed())
    }

    /// Closes the connections with a request that was allowed and no longer is.
    pub fn recheck(&self, is_allowed: impl Fn(&Grant) -> bool) {
        for occupant in locked(&self.open).all.values().filter(|occupant| !occupant.closing.is_cancelled()) {
            let mut grants = locked(&occupant.grants);
            grants.retain(|grant| grant.strong_count() > 0);
            if grants.iter().filter_map(Weak::upgrade).any(|grant| !is_allowed(&grant)) {
                tracing::info!(peer = %occupant.peer, "connection closed: its client has lost its role");
                occupant.closing.cancel();
                self.count("role_lost");
            }
        }
    }

    /// Admits a connection of this peer. Over a limit it gets a place in which it can only receive an error, and of
    /// these there are a few.
    pub fn admit(self: &Arc<Self>, peer: IpAddr) -> Place {
        let limits = locked(&self.limits).clone();
        let mut open = locked(&self.open);
        let is_known = limits.known.contains(&peer);
        let over_limit = self.make_room(&open, &limits, peer, is_known).err();
        if over_limit.is_some() {
            let of_limit = open.all.values().filter(|o| o.is_over_limit() && !o.closing.is_cancelled());
            let of_limit: Vec<_> = of_limit.collect();
            // The oldest: a peer that has a certificate shows it at once, and then it is within the limit.
            if let Some(oldest) = of_limit.first().filter(|_| of_limit.len() >= OVER_LIMIT_MAX) {
                oldest.closing.cancel();
            }
        }
        let now = Instant::now();
        let occupant = Arc::new(Occupant {
            peer,
            host: host_of(peer),
            is_known: is_known.into(),
            over_limit: Mutex::new(over_limit),
            opened: now,
            closing: CancellationToken::new(),
            activity: Mutex::new(Activity { requests: 0, in_progress: 0, idle_since: now, blocked_since: None }),
            flows: Mutex::default(),
            grants: Mutex::default(),
            pieces: AtomicU32::new(0),
            newest_grant: Mutex::default(),
        });
        open.next += 1;
        let number = open.next;
        open.all.insert(number, occupant.clone());
        Place { number, occupant, places: self.clone() }
    }

    /// Finds room for one more connection, if need be by closing an idle one.
    ///
    /// # Errors
    /// What is exhausted, as a text.
    fn make_room(&self, open: &Open, limits: &Limits, peer: IpAddr, is_known: bool) -> Result<(), String> {
        let host = host_of(peer);
        let of_peer = |occupant: &Occupant| occupant.host == host;
        let count = |of: &dyn Fn(&Occupant) -> bool| open.all.values().filter(|o| o.counts() && of(o)).count();
        let of_address = count(&of_peer);
        if of_address >= limits.per_address_max && !self.close_idlest(open, "made_room", of_peer) {
            return Err(format!(
                "{of_address} connections of {peer} are open, which connections.per_address_max allows"
            ));
        }
        let (all, unknown) = (count(&|_| true), count(&|occupant| !occupant.is_known()));
        let is_full = all >= limits.connections_max || (!is_known && unknown >= limits.connections_max - limits.kept);
        if is_full && !self.close_idlest(open, "made_room", |occupant| is_known || !occupant.is_known()) {
            let (most, by) = (limits.connections_max, limits.allowed_by);
            return Err(match all >= most {
                true => format!("{most} connections are open, which {by} allows; try again when one is closed"),
                false => format!(
                    "{unknown} connections are open; of the {most} that {by} allows, {} are kept for known peers",
                    limits.kept
                ),
            });
        }
        Ok(())
    }

    /// Closes the one of these connections that has been idle for the longest time; those of unknown peers first.
    fn close_idlest(&self, open: &Open, reason: &'static str, of: impl Fn(&Occupant) -> bool) -> bool {
        let idle = open.all.values().filter(|occupant| occupant.counts() && of(occupant));
        let idle = idle.filter_map(|occupant| Some(((occupant.is_known(), occupant.idle_since()?), occupant)));
        let Some((_, idlest)) = idle.min_by_key(|(key, _)| *key) else { return false };
        idlest.closing.cancel();
        self.count(reason);
        true
    }

    /// Closes the connections that have been idle or stalled for too long.
    pub fn sweep(&self) {
        let limits = locked(&self.limits).clone();
        let now = Instant::now();
        for occupant in locked(&self.open).all.values().filter(|occupant| !occupant.closing.is_cancelled()) {
            if let Some(reason) = occupant.fault(&limits, now) {
                tracing::info!(peer = %occupant.peer, reason, "connection closed");
                occupant.closing.cancel();
                self.count(reason);
            }
        }
    }
}

/// The place of one connection; it is free again when this is dropped.
#[derive(Debug)]
pub struct Place {
    number: u64,
    occupant: Arc<Occupant>,
    places: Arc<Places>,
}

impl Place {
    /// The address of the peer.
    pub fn peer(&self) -> IpAddr {
        self.occupant.peer
    }

    /// What counts as one address: that of the peer, or its IPv6 network of 64 bits.
    pub fn host(&self) -> IpAddr {
        self.occupant.host
    }

    /// Is cancelled when the connection is to be closed.
    pub fn closing(&self) -> CancellationToken {
        self.occupant.closing.clone()
    }

    /// Why the connection is served nothing; `None` if it is served.
    pub fn over_limit(&self) -> Option<String> {
        locked(&self.occupant.over_limit).clone()
    }

    /// The peer has shown a certificate or token that has a role: it may use the connections kept for known peers.
    pub fn set_known(&self) {
        if self.occupant.is_known.swap(true, Ordering::Relaxed) || !self.occupant.is_over_limit() {
            return;
        }
        let (places, limits) = (&self.places, locked(&self.places.limits).clone());
        let open = locked(&places.open);
        if places.make_room(&open, &limits, self.occupant.peer, true).is_ok() {
            *locked(&self.occupant.over_limit) = None;
        }
    }

    /// Counts a refusal or an end of this connection.
    pub fn count(&self, reason: &'static str) {
        self.places.count(reason);
    }

    /// Closes the connection, because its client sends too many of these.
    pub fn close_for_flood(&self, of: &str) {
        tracing::info!(peer = %self.peer(), reason = "flood", of, "connection closed");
        self.count("flood");
        self.occupant.closing.cancel();
    }

    /// Counts and logs that HTTP/2 has ended the connection because of what the client sent.
    pub fn close_for_breach(&self, of: h2::Reason) {
        let reason = if of == h2::Reason::ENHANCE_YOUR_CALM { "flood" } else { "http2" };
        tracing::info!(peer = %self.peer(), reason, of = of.description(), "connection closed");
        self.count(reason);
    }

    /// Records that the transport was given a piece of a response.
    pub fn add_piece(&self) {
        self.occupant.pieces.fetch_add(1, Ordering::Relaxed);
    }

    /// Number of pieces since the last call.
    pub fn take_pieces(&self) -> u32 {
        self.occupant.pieces.swap(0, Ordering::Relaxed)
    }

    /// Records whether the socket takes no byte at present.
    pub fn set_blocked(&self, is_blocked: bool) {
        let blocked_since = &mut locked(&self.occupant.activity).blocked_since;
        *blocked_since = is_blocked.then(|| blocked_since.unwrap_or_else(Instant::now));
    }

    /// A request is in progress until the return value is dropped.
    pub fn begin_request(self: &Arc<Self>) -> InProgress {
        let mut activity = locked(&self.occupant.activity);
        (activity.requests, activity.in_progress) = (activity.requests + 1, activity.in_progress + 1);
        InProgress(self.clone())
    }

    /// The request that this allows is in progress while the return value lives, and until the next request.
    pub fn grant(&self, grant: Grant) -> Arc<Grant> {
        let grant = Arc::new(grant);
        let mut grants = locked(&self.occupant.grants);
        grants.retain(|other| other.strong_count() > 0);
        grants.push(Arc::downgrade(&grant));
        *locked(&self.occupant.newest_grant) = Some(grant.clone());
        grant
    }

    /// What waits in the server for one response of this connection; `None` if the connection's address has too many
    /// responses in progress.
    pub fn begin_flow(&self) -> Option<Arc<Flow>> {
        let mut flows = locked(&self.occupant.flows);
        flows.retain(|flow| Arc::strong_count(flow) > 1);
        let flow = self.places.flows.begin(self.occupant.host, self.number, self.occupant.is_known())?;
        flows.push(flow.clone());
        Some(flow)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        locked(&self.places.open).all.remove(&self.number);
    }
}

/// A request in progress.
#[derive(Debug)]
pub struct InProgress(Arc<Place>);

impl InProgress {
    /// The connection of the request.
    pub fn place(&self) -> &Place {
        &self.0
    }
}

impl Drop for InProgress {
    fn drop(&mut self) {
        let mut activity = locked(&self.0.occupant.activity);
        activity.in_progress -= 1;
        activity.idle_since = Instant::now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Connections;

    #[test]
    fn a_host_with_a_network_of_ipv6_counts_as_one_address() {
        let config = Connections { per_address_max: 2, ..Connections::default() };
        let places = Places::new(Limits::new(&config, 100, "the test"), Flows::new(100, 2, 0));
        let of = |address: &str| Arc::new(places.admit(address.parse().unwrap()));
        let held: Vec<_> = ["2001:db8::1", "2001:db8::2"].map(of).map(|place| (place.begin_request(), place)).into();
        let flows: Vec<_> = held.iter().map(|(_, place)| place.begin_flow().expect("a call")).collect();
        let third = of("2001:db8::ffff:3");
        assert!(third.over_limit().is_some() && third.begin_flow().is_none());
        for other in ["2001:db8:0:1::1", "10.0.0.1"].map(of) {
            assert!(other.over_limit().is_none() && other.begin_flow().is_some());
        }
        drop((flows, held));
    }
}
