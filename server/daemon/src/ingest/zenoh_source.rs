//! The observations of one zenoh session for one vehicle -> the vehicle's gateway, and reports back.

use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use clearway_proto::v1;
use futures::{StreamExt, stream};
use prost::Message;
use tokio::sync::Mutex;
use tokio::sync::mpsc::unbounded_channel;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::session::ZenohId;

use super::admission::{AdmissionPermit, SourceQueue};
use super::gateway::Gateway;
use super::observation::ObservationError;
use super::receipt::{ClientSession, ObservationId, Outcome, OutcomeSender};
use crate::zenoh_session::Senders;

/// Greatest number of sources of one vehicle. A new source replaces the longest silent source without queued samples.
/// Ours: the sensors of a vehicle seldom have more than one session each.
pub(super) const SOURCES_MAX: usize = 16;
/// Greatest number of clients of one source that are remembered. A new client replaces the idle client that was silent
/// longest.
const CLIENTS_MAX: usize = 64;
/// Period and number of the repetitions of the newest acknowledgement.
const REPEAT: (Duration, u32) = (Duration::from_secs(1), 10);
/// Time without an observation after which a source or a client has ended, and the sensors that it has declared with
/// it. Ours: zenoh does not tell when a client behind a router is gone; a sensor that is silent for so long is no
/// longer there.
pub(super) const SILENT_MAX: Duration = Duration::from_secs(600);

/// A sample that is not decoded yet.
pub(super) struct Sample {
    /// Bytes of the sample; empty if they are too long.
    pub payload: ZBytes,
    /// Length of the payload as it came.
    pub length: usize,
}

/// What all sources of a vehicle have in common.
pub(super) struct Common {
    pub gateway: Arc<Gateway>,
    pub reports: Publisher<'static>,
    /// `None`: every peer may send.
    pub senders: Option<Mutex<Senders>>,
}

/// One source: a zenoh session, as its samples state; or all sessions whose samples state none.
pub(super) struct Source {
    id: Option<ZenohId>,
    samples: Arc<SourceQueue<Sample>>,
    /// True if an observation was accepted.
    is_accepted: Arc<AtomicBool>,
    clients: Clients,
}

impl Source {
    /// A source whose samples come through this queue until it is closed.
    pub fn new(id: Option<ZenohId>, samples: Arc<SourceQueue<Sample>>, is_accepted: Arc<AtomicBool>) -> Self {
        Self { id, samples, is_accepted, clients: Clients { of: id, ..Clients::default() } }
    }

    /// Decodes the samples and sends reports, until the queue is closed and everything is reported.
    pub async fn run(mut self, common: &Common) {
        let gateway = &common.gateway;
        let (outcome_sender, mut outcomes): (OutcomeSender, _) = unbounded_channel();
        let mut repeat = tokio::time::interval(REPEAT.0);
        let samples = self.samples.clone();
        // A stream, because a source that stops waiting loses its turn.
        let mut admitted = pin!(stream::unfold((), |()| async { Some((samples.next(&gateway.admission).await?, ())) }));
        let mut is_open = true;
        while is_open || !self.clients.are_idle() {
            let has_credit = is_open && self.clients.have_credit(gateway.in_flight_max / SOURCES_MAX);
            tokio::select! {
                // Outcomes first, because they give credit.
                biased;
                Some((id, outcome)) = outcomes.recv() => {
                    self.record_outcome(id, outcome);
                    while let Ok((id, outcome)) = outcomes.try_recv() {
                        self.record_outcome(id, outcome);
                    }
                }
                sample = admitted.next(), if has_credit => match sample {
                    Some((key, sample, permit)) => self.push(&key, sample, permit, common, &outcome_sender).await,
                    None => is_open = false,
                },
                _ = repeat.tick() => {
                    self.clients.request_repetitions();
                    self.clients.forget_silent(Instant::now());
                }
            }
            self.clients.forgotten.drain(..).for_each(|mut session| gateway.end(&mut session));
            for report in self.clients.next_reports() {
                if let Err(error) = common.reports.put(report.encode_to_vec()).await {
                    tracing::debug!(%error, "zenoh: report");
                }
            }
        }
        self.clients.all.into_iter().for_each(|mut client| gateway.end(&mut client.session));
    }

    fn record_outcome(&mut self, id: ObservationId, outcome: Outcome) {
        if outcome == Outcome::Accepted {
            self.is_accepted.store(true, Ordering::Relaxed);
        }
        self.clients.record_outcome(id, outcome);
    }

    /// Decodes an admitted sample and pushes its events, or refuses it.
    async fn push(
        &mut self,
        key: &str,
        Sample { payload, length }: Sample,
        permit: AdmissionPermit,
        common: &Common,
        outcomes: &OutcomeSender,
    ) {
        let gateway = &common.gateway;
        let bytes = Bytes::from(payload.to_bytes().into_owned());
        let bytes_max = gateway.limits.message_bytes_max;
        let decoded = match length <= bytes_max {
            false => Err(ObservationError::Length { bytes: length, bytes_max }),
            true => v1::Observation::decode(bytes)
                .map_err(|reason| ObservationError::Message { reason: reason.to_string() }),
        };
        let mut observation = match decoded {
            Ok(observation) => observation,
            // Its client is unknown; client 0 gets the report.
            Err(error) => return gateway.refuse_message(&mut self.clients.get_or_insert(0).session, 0, &error),
        };
        let session = &mut self.clients.get_or_insert(observation.client).session;
        let number = observation.number;
        session.refuse_missed(number);
        if let Some(senders) = &common.senders {
            let (rpc, vehicle) = ("/clearway.v1.IngestService/Stream", Some(&*gateway.vehicle));
            if let Err(denied) = senders.lock().await.check(rpc, vehicle, self.id).await {
                if session.check_number(number).is_ok() {
                    session.begin(number, 0);
                }
                return gateway.refuse(session, number, "role", denied);
            }
        }
        match sensor_of_key(key, observation.body.as_ref()) {
            Some(sensor) => sensor.clone_into(&mut observation.sensor),
            None => {
                let message = format!(
                    "key ingest/{key} with another body: scan/<sensor>, packet/<sensor>, end/<sensor>, \
                     sensor/<sensor>, pose and road are allowed"
                );
                return gateway.refuse(session, number, "key", message);
            }
        }
        // The gateway counts and reports an unknown sensor itself.
        let _ = gateway.push(observation, permit, session, outcomes);
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

/// The remembered clients of one source, ordered from the longest silent to the most recent.
#[derive(Default)]
struct Clients {
    /// Id of the zenoh session; `None` if the samples state none.
    of: Option<ZenohId>,
    all: Vec<Client>,
    /// The sessions of clients that have ended since they were last taken.
    forgotten: Vec<ClientSession>,
}

struct Client {
    /// Time at which the client's newest observation came.
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
                let of = self.of.map_or_else(|| "without a name".to_owned(), |of| of.to_string());
                let session = ClientSession::of_sender(id, &format!("client {id} of zenoh session {of}"));
                Client { heard: Instant::now(), id, session, repetitions: 0, is_due: false }
            }
        };
        let client = self.all.push_mut(client);
        client.heard = Instant::now();
        client
    }

    fn record_outcome(&mut self, id: ObservationId, outcome: Outcome) {
        if let Some(client) = self.all.iter_mut().find(|client| client.id == id.client) {
            client.session.record_outcome(id.number, outcome);
        }
    }

    /// True if no observation is in flight.
    fn are_idle(&self) -> bool {
        self.all.iter().all(|client| client.session.is_idle())
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

    /// True if another observation of any client, also of a new one, may be decoded: fewer than `events_max` events of
    /// all clients are in flight, and a new client has space.
    fn have_credit(&self, events_max: usize) -> bool {
        if self.all.len() >= CLIENTS_MAX && self.longest_idle().is_none() {
            return false;
        }
        let events: usize = self.all.iter().map(|client| client.session.events()).sum();
        events == 0 || events < events_max
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
    use super::*;

    #[test]
    fn a_new_client_replaces_the_longest_silent_idle_client_or_waits() {
        let mut clients = Clients::default();
        let has_space = |clients: &Clients| clients.have_credit(usize::MAX);
        for id in 1..=CLIENTS_MAX as u64 {
            assert!(has_space(&clients), "client {id}");
            clients.get_or_insert(id).session.begin(1, 1);
        }
        assert!(!has_space(&clients), "each has an event in flight");
        for id in [7, 3] {
            clients.record_outcome(ObservationId { client: id, number: 1 }, Outcome::Accepted);
        }
        assert!(has_space(&clients));
        assert_eq!(clients.next_reports().len(), CLIENTS_MAX, "all reports are sent before another client comes");
        clients.get_or_insert(1000).session.begin(1, 1);
        let is_known = |id| clients.all.iter().any(|client| client.id == id);
        assert!(!is_known(3) && is_known(7), "3 was silent longer");
        assert_eq!(clients.next_reports().len(), 1, "the report of the new client");
        for id in (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)) {
            clients.record_outcome(ObservationId { client: id, number: 1 }, Outcome::Accepted);
        }
        let reported: Vec<_> =
            clients.next_reports().iter().map(|report| (report.client, report.acknowledged)).collect();
        let expected: Vec<_> = (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)).map(|id| (id, 1)).collect();
        assert_eq!(reported, expected, "each client gets its acknowledgement");
        assert_eq!(clients.all.len(), CLIENTS_MAX);
    }
}
