//! Observations over zenoh: `clearway/<vehicle>/ingest/{scan,packet,end,sensor}/<sensor>`, `…/{pose,road}`; what becomes of them
//! goes to `clearway/<vehicle>/ingest/report`.
//!
//! zenoh's callbacks only put a sample aside, as many as there is room for; one task a vehicle reads them. Samples that
//! find no room are counted as `queue`, and their client is told by the holes in its numbers. Reports drop under
//! congestion, because a stopped peer may not hold up the others; so the newest acknowledgement is repeated for a while.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use clearway_proto::v1;
use prost::Message;
use tokio::sync::mpsc::{Receiver, channel, error::TrySendError, unbounded_channel};
use zenoh::Session;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::{Locality, SampleKind};

use super::gateway::Entrance;
use super::observation::ObservationError;
use super::receipt::{Account, Verdicts};
use crate::publish::zenoh::{ZenohError, failed};

/// Samples put aside for one vehicle; their bytes are no more than its longest message, twice.
const WAITING_MAX: usize = 256;
/// Clients remembered for each vehicle; of those with nothing on the way the one heard of longest ago makes room for
/// another.
const CLIENTS_MAX: usize = 64;
/// How often, and how many times, the newest acknowledgement is repeated.
const REPEAT: (Duration, u32) = (Duration::from_secs(1), 10);

/// A sample put aside.
struct Waiting {
    /// Key behind `clearway/<vehicle>/ingest/`.
    key: String,
    payload: ZBytes,
}

/// The samples of one vehicle, and whoever puts them aside.
pub struct Ingest {
    entrance: Arc<Entrance>,
    waiting: Receiver<Waiting>,
    bytes_waiting: Arc<AtomicUsize>,
    reports: Publisher<'static>,
    // Last, and only held.
    _subscriber: Subscriber<()>,
}

impl Ingest {
    /// Subscribes to a vehicle's keys.
    ///
    /// # Errors
    /// What zenoh says.
    pub async fn subscribe(session: &Session, entrance: Arc<Entrance>) -> Result<Self, ZenohError> {
        let prefix = format!("clearway/{}/ingest/", entrance.vehicle);
        let key = format!("{prefix}report");
        let reports = session.declare_publisher(key.clone()).congestion_control(CongestionControl::Drop);
        let reports = reports.encoding(Encoding::APPLICATION_PROTOBUF.with_schema("clearway.v1.IngestReport"));
        let reports = reports.await.map_err(failed(format!("publisher {key}")))?;

        let (put_aside, waiting) = channel(WAITING_MAX);
        let bytes_waiting = Arc::new(AtomicUsize::new(0));
        let keys = format!("{prefix}**");
        let subscriber = session.declare_subscriber(keys.clone()).allowed_origin(Locality::Remote).callback({
            let (entrance, bytes_waiting) = (entrance.clone(), bytes_waiting.clone());
            move |sample| {
                let key = sample.key_expr().as_str().strip_prefix(&prefix).unwrap_or_default();
                if key == "report" || sample.kind() != SampleKind::Put {
                    return;
                }
                let bytes = sample.payload().len();
                let before = bytes_waiting.fetch_add(bytes, Ordering::Relaxed);
                let fits = before <= entrance.limits.message_bytes_max;
                let sample = Waiting { key: key.to_owned(), payload: sample.payload().clone() };
                if !fits || matches!(put_aside.try_send(sample), Err(TrySendError::Full(_))) {
                    bytes_waiting.fetch_sub(bytes, Ordering::Relaxed);
                    entrance.count("queue");
                }
            }
        });
        let subscriber = subscriber.await.map_err(failed(format!("subscribe to {keys}")))?;
        Ok(Self { entrance, waiting, bytes_waiting, reports, _subscriber: subscriber })
    }

    /// Reads and reports until it is dropped.
    pub async fn run(mut self) {
        let (verdicts, mut told): (Verdicts, _) = unbounded_channel();
        let mut clients = Clients::default();
        let mut repeat = tokio::time::interval(REPEAT.0);
        loop {
            let (events_max, bytes_max) = (self.entrance.in_flight_max, self.entrance.limits.message_bytes_max);
            tokio::select! {
                // Verdicts first: they make room.
                biased;
                Some((mark, verdict)) = told.recv() => {
                    if let Some(client) = clients.known(mark.client) {
                        client.account.tell(mark.number, verdict);
                    }
                }
                sample = self.waiting.recv(), if clients.have_room(events_max, bytes_max) => {
                    // The subscriber is held here, so there is always a sender.
                    let Some(Waiting { key, payload }) = sample else { return };
                    let bytes = Bytes::from(payload.to_bytes().into_owned());
                    self.bytes_waiting.fetch_sub(bytes.len(), Ordering::Relaxed);
                    self.take(&key, bytes, &mut clients, &verdicts);
                }
                _ = repeat.tick() => clients.repeat(),
            }
            while let Ok((mark, verdict)) = told.try_recv() {
                if let Some(client) = clients.known(mark.client) {
                    client.account.tell(mark.number, verdict);
                }
            }
            for report in clients.reports() {
                if let Err(error) = self.reports.put(report.encode_to_vec()).await {
                    tracing::debug!(%error, "zenoh: report");
                }
            }
        }
    }

    fn take(&self, key: &str, bytes: Bytes, clients: &mut Clients, verdicts: &Verdicts) {
        let (length, bytes_max) = (bytes.len(), self.entrance.limits.message_bytes_max);
        let read = match length <= bytes_max {
            false => Err(ObservationError::Length { bytes: length, bytes_max }),
            true => v1::Observation::decode(bytes)
                .map_err(|reason| ObservationError::Message { reason: reason.to_string() }),
        };
        let mut observation = match read {
            Ok(observation) => observation,
            // Nobody knows whose it was.
            Err(error) => return self.entrance.refuse_error(&mut clients.of(0).account, 0, &error),
        };
        let account = &mut clients.of(observation.client).account;
        let number = observation.number;
        account.miss(number);
        match sensor_of(key, observation.body.as_ref()) {
            Some(sensor) => sensor.clone_into(&mut observation.sensor),
            None => {
                let message = format!(
                    "key ingest/{key} with another body: scan/<sensor>, packet/<sensor>, end/<sensor>, sensor/<sensor>, pose and road are allowed"
                );
                return self.entrance.refuse(account, number, "key", message);
            }
        }
        // Refused and reported there.
        let _ = self.entrance.take(observation, length, account, verdicts);
    }
}

/// The sensor a key names, empty for none; `None` where the key is none of ours or does not tell of such a body.
fn sensor_of<'k>(key: &'k str, body: Option<&v1::observation::Body>) -> Option<&'k str> {
    use v1::observation::Body;
    let (kind, sensor) = key.split_once('/').unwrap_or((key, ""));
    let fits = match body? {
        Body::Scan(_) => kind == "scan",
        Body::Packets(_) => kind == "packet",
        Body::End(_) => kind == "end",
        Body::EgoPose(_) => key == "pose",
        Body::Road(_) => key == "road",
        Body::Declaration(declared) => kind == "sensor" && sensor == declared.name,
    };
    fits.then_some(sensor)
}

/// The clients heard of, the one heard of longest ago first.
#[derive(Default)]
struct Clients(Vec<Client>);

struct Client {
    id: u64,
    account: Account,
    /// Repetitions of its newest acknowledgement still to come.
    repetitions: u32,
    /// Whether one is to come now.
    is_due: bool,
}

impl Clients {
    /// The client of this name, now the newest.
    fn of(&mut self, id: u64) -> &mut Client {
        let at = self.0.iter().position(|client| client.id == id);
        let client = match at {
            Some(at) => self.0.remove(at),
            None => {
                let is_full = self.0.len() >= CLIENTS_MAX;
                if let Some(settled) = self.settled().filter(|_| is_full) {
                    self.0.remove(settled);
                }
                Client { id, account: Account::new(id), repetitions: 0, is_due: false }
            }
        };
        self.0.push_mut(client)
    }

    fn known(&mut self, id: u64) -> Option<&mut Client> {
        self.0.iter_mut().find(|client| client.id == id)
    }

    /// Where the one heard of longest ago stands that has nothing on the way.
    fn settled(&self) -> Option<usize> {
        self.0.iter().position(|client| client.account.is_settled())
    }

    /// Whether another observation may be read, be it a newcomer's: all of them together may have so much on the way.
    fn have_room(&self, events_max: usize, bytes_max: usize) -> bool {
        if self.0.len() >= CLIENTS_MAX && self.settled().is_none() {
            return false;
        }
        let (events, bytes) =
            self.0.iter().map(|client| client.account.in_flight()).fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        events == 0 || (events < events_max && bytes < bytes_max)
    }

    fn repeat(&mut self) {
        for client in self.0.iter_mut().filter(|client| client.repetitions > 0) {
            client.repetitions -= 1;
            client.is_due = true;
        }
    }

    /// What each is to be told now.
    fn reports(&mut self) -> Vec<v1::IngestReport> {
        let report = |client: &mut Client| {
            let is_due = std::mem::take(&mut client.is_due);
            let news = client.account.report();
            if news.is_some() {
                client.repetitions = REPEAT.1;
            }
            news.or_else(|| is_due.then(|| client.account.newest_report()))
        };
        self.0.iter_mut().filter_map(report).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::receipt::Verdict;
    use super::*;

    #[test]
    fn a_newcomer_takes_the_place_of_a_client_with_nothing_on_the_way_or_waits_for_one() {
        let mut clients = Clients::default();
        let roomy = |clients: &Clients| clients.have_room(usize::MAX, usize::MAX);
        for id in 1..=CLIENTS_MAX as u64 {
            assert!(roomy(&clients), "client {id}");
            clients.of(id).account.enter(1, 1, 10);
        }
        assert!(!roomy(&clients), "each has an event on the way");
        for id in [7, 3] {
            clients.known(id).unwrap().account.tell(1, Verdict::Taken);
        }
        assert!(roomy(&clients));
        assert_eq!(clients.reports().len(), CLIENTS_MAX, "told before anybody else is heard");
        clients.of(1000).account.enter(1, 1, 10);
        assert!(clients.known(3).is_none() && clients.known(7).is_some(), "3 was heard of longer ago");
        assert_eq!(clients.reports().len(), 1, "the newcomer's");
        for id in (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)) {
            clients.known(id).expect("it has an event on the way").account.tell(1, Verdict::Taken);
        }
        let told: Vec<_> = clients.reports().iter().map(|report| (report.client, report.acknowledged)).collect();
        let expected: Vec<_> = (1..=CLIENTS_MAX as u64).filter(|id| ![3, 7].contains(id)).map(|id| (id, 1)).collect();
        assert_eq!(told, expected, "each hears its verdict");
        assert_eq!(clients.0.len(), CLIENTS_MAX);
    }
}
