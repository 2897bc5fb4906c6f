//! Observations over zenoh: `clearway/<vehicle>/ingest/{scan,packet,end,sensor}/<sensor>` and `.../{pose,road}`;
//! reports go to `clearway/<vehicle>/ingest/report`.
//!
//! zenoh's callback only queues a sample, within two bounds; one task a vehicle decodes the queued samples. A sample
//! that exceeds a bound is counted as `queue`, and its client learns of it because its numbers then have a gap. Reports
//! are dropped under congestion, so that a stopped peer does not delay the others; the newest acknowledgement is
//! therefore repeated for a while.
//!
//! With roles ([`Senders`]) a sample needs a certificate with the role of an ingester, as over gRPC. zenoh's access
//! control refuses the others first; this check also holds if it is configured otherwise.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use tokio::sync::mpsc::{Receiver, channel, error::TrySendError, unbounded_channel};
use zenoh::Session;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, SampleKind};
use zenoh::session::ZenohId;

use super::gateway::Gateway;
use super::observation::ObservationError;
use super::receipt::{ClientSession, OutcomeSender};
use crate::zenoh_session::{PeerNames, ZenohError};

/// Greatest number of queued samples of one vehicle. Together they have at most twice the bytes of its longest message.
const QUEUED_MAX: usize = 256;
/// Greatest number of clients of one vehicle that are remembered. A new client replaces the idle client that was silent
/// longest.
const CLIENTS_MAX: usize = 64;
/// Period and number of the repetitions of the newest acknowledgement.
const REPEAT: (Duration, u32) = (Duration::from_secs(1), 10);
/// Time without an observation after which a client has ended, and the sensors that it has declared with it. Ours:
/// zenoh does not tell when a client behind a router is gone; a sensor that is silent for so long is no longer there.
const SILENT_MAX: Duration = Duration::from_secs(600);

/// A sample that is not decoded yet.
struct QueuedSample {
    /// The key after `clearway/<vehicle>/ingest/`.
    key: String,
    payload: ZBytes,
    /// The session that has sent it, as the sample states.
    source: Option<ZenohId>,
}

/// Who may send observations and queries, if clients have roles.
pub struct Senders {
    peers: PeerNames,
    may_call: MayCall,
}

/// Whether a client with these names in its certificate may do what this RPC does, to this vehicle if one is named; if
/// not, why.
type MayCall = Box<dyn Fn(&str, Option<&str>, &[String]) -> Result<(), String> + Send + Sync>;

impl Senders {
    /// The senders of a session whose peers connect to this server: each shows its own certificate.
    pub fn new(session: &Session, may_call: MayCall) -> Self {
        Self { peers: PeerNames::new(session), may_call }
    }

    /// Checks by the certificate of its link that the sender of a sample or query may do what an RPC does, to a vehicle
    /// if one is named.
    ///
    /// # Errors
    /// Why it may not.
    pub async fn check(&mut self, rpc: &str, vehicle: Option<&str>, source: Option<ZenohId>) -> Result<(), String> {
        let Some(source) = source else {
            return Err("the message does not state its source; with roles it must (zenoh's source_info)".into());
        };
        let name = self.peers.name(source).await.map(str::to_owned);
        (self.may_call)(rpc, vehicle, name.as_slice())
    }
}

/// The subscription to the observations of one vehicle, and the publisher of its reports.
pub struct Ingest {
    gateway: Arc<Gateway>,
    samples: Receiver<QueuedSample>,
    bytes_queued: Arc<AtomicUsize>,
    reports: Publisher<'static>,
    /// `None`: every peer may send.
    senders: Option<Senders>,
    // The last field, so that it is dropped last.
    _subscriber: Subscriber<()>,
}

impl Ingest {
    /// Subscribes to the keys of a vehicle.
    ///
    /// # Errors
    /// [`ZenohError`] if the publisher or the subscriber cannot be declared.
    pub async fn subscribe(
        session: &Session,
        gateway: Arc<Gateway>,
        senders: Option<Senders>,
    ) -> Result<Self, ZenohError> {
        let prefix = format!("clearway/{}/ingest/", gateway.vehicle);
        let key = format!("{prefix}report");
        let reports = session.declare_publisher(key.clone()).congestion_control(CongestionControl::Drop);
        let reports = reports.encoding(Encoding::APPLICATION_PROTOBUF.with_schema("clearway.v1.IngestReport"));
        let reports = reports.await.map_err(ZenohError::of(format!("publisher {key}")))?;

        let (sender, samples) = channel(QUEUED_MAX);
        let bytes_queued = Arc::new(AtomicUsize::new(0));
        let keys = format!("{prefix}**");
        let subscriber = session.declare_subscriber(keys.clone()).allowed_origin(Locality::Remote).callback({
            let (gateway, bytes_queued) = (gateway.clone(), bytes_queued.clone());
            move |sample| {
                let key = sample.key_expr().as_str().strip_prefix(&prefix).unwrap_or_default();
                if key == "report" || sample.kind() != SampleKind::Put {
                    return;
                }
                let bytes = sample.payload().len();
                let before = bytes_queued.fetch_add(bytes, Ordering::Relaxed);
                let fits = before <= gateway.limits.message_bytes_max;
                let source = sample.source_info().map(|source| source.source_id().zid());
                let sample = QueuedSample { key: key.to_owned(), payload: sample.payload().clone(), source };
                if !fits || matches!(sender.try_send(sample), Err(TrySendError::Full(_))) {
                    bytes_queued.fetch_sub(bytes, Ordering::Relaxed);
                    gateway.record_refusal("queue");
                }
            }
        });
        let subscriber = subscriber.await.map_err(ZenohError::of(format!("subscribe to {keys}")))?;
        Ok(Self { gateway, samples, bytes_queued, reports, senders, _subscriber: subscriber })
    }

    /// Decodes samples and sends reports until the future is dropped.
    pub async fn run(mut self) {
        let (outcome_sender, mut outcomes): (OutcomeSender, _) = unbounded_channel();
        let mut clients = Clients::default();
        let mut repeat = tokio::time::interval(REPEAT.0);
        loop {
            let (events_max, bytes_max) = (self.gateway.in_flight_max, self.gateway.limits.message_bytes_max);
            tokio::select! {
                // Outcomes first, because they give credit.
                biased;
                Some((id, outcome)) = outcomes.recv() => {
                    if let Some(client) = clients.get_mut(id.client) {
                        client.session.record_outcome(id.number, outcome);
                    }
                }
                sample = self.samples.recv(), if clients.have_credit(events_max, bytes_max) => {
                    // The channel cannot end, because `self` holds the subscriber with the sender.
                    let Some(QueuedSample { key, payload, source }) = sample else { return };
                    let bytes = Bytes::from(payload.to_bytes().into_owned());
                    self.bytes_queued.fetch_sub(bytes.len(), Ordering::Relaxed);
                    let allowed = match &mut self.senders {
                        Some(senders) => {
                            let vehicle = Some(&*self.gateway.vehicle);
                            senders.check("/clearway.v1.IngestService/Stream", vehicle, source).await
                        }
                        None => Ok(()),
                    };
                    self.push(&key, bytes, allowed, &mut clients, &outcome_sender).await;
                }
                _ = repeat.tick() => {
                    clients.request_repetitions();
                    clients.forget_silent(Instant::now());
                }
            }
            clients.forgotten.drain(..).for_each(|mut session| self.gateway.end(&mut session));
            while let Ok((id, outcome)) = outcomes.try_recv() {
                if let Some(client) = clients.get_mut(id.client) {
                    client.session.record_outcome(id.number, outcome);
                }
            }
            for report in clients.next_reports() {
                if let Err(error) = self.reports.put(report.encode_to_vec()).await {
                    tracing::debug!(%error, "zenoh: report");
                }
            }
        }
    }

    async fn push(
        &self,
        key: &str,
        bytes: Bytes,
        allowed: Result<(), String>,
        clients: &mut Clients,
        outcomes: &OutcomeSender,
    ) {
        let (length, bytes_max) = (bytes.len(), self.gateway.limits.message_bytes_max);
        let decoded = match length <= bytes_max {
            false => Err(ObservationError::Length { bytes: length, bytes_max }),
            true => v1::Observation::decode(bytes)
                .map_err(|reason| ObservationError::Message { reason: reason.to_string() }),
        };
        let mut observation = match decoded {
            Ok(observation) => observation,
            // Its client is unknown; client 0 gets the report.
            Err(error) => return self.gateway.refuse_message(&mut clients.get_or_insert(0).session, 0, &error),
        };
        let session = &mut clients.get_or_insert(observation.client).session;
        let number = observation.number;
        session.refuse_missed(number);
        if let Err(denied) = allowed {
            if session.check_number(number).is_ok() {
                session.begin(number, 0, 0);
            }
            return self.gateway.refuse(session, number, "role", denied);
        }
        match sensor_of_key(key, observation.body.as_ref()) {
            Some(sensor) => sensor.clone_into(&mut observation.sensor),
            None => {
                let message = format!(
                    "key ingest/{key} with another body: scan/<sensor>, packet/<sensor>, end/<sensor>, \
                     sensor/<sensor>, pose and road are allowed"
                );
                return self.gateway.refuse(session, number, "key", message);
            }
        }
        // The gateway counts and reports an unknown sensor itself.
        let time = self.gateway.wait_for_time(&observation).await;
        let _ = self.gateway.push(observation, length, time, session, outcomes);
    }
}

/// The sensor that `key` names, empty if it names none; `None` if the key is unknown or does not match the body.
fn sensor_of_key<'k>(key: &'k str, body: Option<&v1::observation::Body>) -> Option<&'k str> {
    use v1::observation::Body;
    let (kind, sensor) = key.split_once('/').unwrap_or((key, ""));
    let matches = match body? {
        Body::Scan(_) => kind == "scan",
        Body::Packets(_) => kind == "packet",
        Body::End(_) => kind == "end",
        Body::EgoPose(_) => key == "pose",
        Body::Road(_) => key == "road",
        Body::Declaration(declared) => kind == "sensor" && sensor == declared.name,
    };
    matches.then_some(sensor)
}

/// The remembered clients of one vehicle, ordered from the longest silent to the most recent.
#[derive(Default)]
struct Clients {
    all: Vec<Client>,
    /// The sessions of clients that have ended since they were last taken.
    forgotten: Vec<ClientSession>,
}

struct Client {
    /// When its newest observation came.
    heard: Instant,
    id: u64,
    session: ClientSession,
    /// Number of repetitions of its newest acknowledgement that are left.
    repetitions: u32,
    /// True if a repetition is due now.
    is_due: bool,
}

impl Clients {
    /// The client `id`, which becomes the most recent one.
    fn get_or_insert(&mut self, id: u64) -> &mut Client {
        let at = self.all.iter().position(|client| client.id == id);
        let client = match at {
            Some(at) => self.all.remove(at),
            None => {
                let is_full = self.all.len() >= CLIENTS_MAX;
                if let Some(idle) = self.longest_idle().filter(|_| is_full) {
                    self.forget(idle);
                }
                Client { heard: Instant::now(), id, session: ClientSession::new(id), repetitions: 0, is_due: false }
            }
        };
        let client = self.all.push_mut(client);
        client.heard = Instant::now();
        client
    }

    fn get_mut(&mut self, id: u64) -> Option<&mut Client> {
        self.all.iter_mut().find(|client| client.id == id)
    }

    /// Forgets the clients without observations in flight that were silent for [`SILENT_MAX`].
    fn forget_silent(&mut self, now: Instant) {
        let is_over =
            |client: &Client| client.session.is_idle() && now.saturating_duration_since(client.heard) > SILENT_MAX;
        while let Some(silent) = self.all.iter().position(is_over) {
            self.forget(silent);
        }
    }

    fn forget(&mut self, index: usize) {
        let client = self.all.remove(index);
        self.forgotten.push(client.session);
    }

    /// Index of the longest silent client without observations in flight.
    fn longest_idle(&self) -> Option<usize> {
        self.all.iter().position(|client| client.session.is_idle())
    }

    /// True if another observation of any client, also of a new one, may be decoded: fewer than `events_max` events and
    /// `bytes_max` bytes of all clients are in flight, and a new client has space.
    fn have_credit(&self, events_max: usize, bytes_max: usize) -> bool {
        if self.all.len() >= CLIENTS_MAX && self.longest_idle().is_none() {
            return false;
        }
        let (events, bytes) =
            self.all.iter().map(|client| client.session.in_flight()).fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        events == 0 || (events < events_max && bytes < bytes_max)
    }

    fn request_repetitions(&mut self) {
        for client in self.all.iter_mut().filter(|client| client.repetitions > 0) {
            client.repetitions -= 1;
            client.is_due = true;
        }
    }

    /// The reports that are due now, one a client at most.
    fn next_reports(&mut self) -> Vec<v1::IngestReport> {
        let report = |client: &mut Client| {
            let is_due = std::mem::take(&mut client.is_due);
            let report = client.session.next_report();
            if report.is_some() {
                client.repetitions = REPEAT.1;
            }
            report.or_else(|| is_due.then(|| client.session.repeated_report()))
        };
        self.all.iter_mut().filter_map(report).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::receipt::Outcome;
    use super::*;

    #[test]
    fn a_new_client_replaces_the_longest_silent_idle_client_or_waits() {
        let mut clients = Clients::default();
        let has_space = |clients: &Clients| clients.have_credit(usize::MAX, usize::MAX);
        for id in 1..=CLIENTS_MAX as u64 {
            assert!(has_space(&clients), "client {id}");
            clients.get_or_insert(id).session.begin(1, 1, 10);
        }
        assert!(!has_space(&clients), "each has an event in flight");
        for id in [7, 3] {
            clients.get_mut(id).unwrap().session.record_outcome(1, Outcome::Accepted);
        }
        assert!(has_space(&clients));
        assert_eq!(clients.next_reports().len(), CLIENTS_MAX, "all reports are sent before another client comes");
        clients.get_or_insert(1000).session.begin(1, 1, 10);
        assert!(clients.get_mut(3).is_none() && clients.get_mut(7).is_some(), "3 was silent longer");
        assert_eq!(clients.next_reports().len(), 1, "the report of the new client");
        for id in (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)) {
            let client = clients.get_mut(id).expect("it has an event in flight");
            client.session.record_outcome(1, Outcome::Accepted);
        }
        let reported: Vec<_> =
            clients.next_reports().iter().map(|report| (report.client, report.acknowledged)).collect();
        let expected: Vec<_> = (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)).map(|id| (id, 1)).collect();
        assert_eq!(reported, expected, "each client gets its acknowledgement");
        assert_eq!(clients.all.len(), CLIENTS_MAX);
    }
}
