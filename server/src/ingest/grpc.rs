//! Observations over gRPC: `clearway.v1.IngestService`.
//!
//! A stream reads its next observation only while the events before it are within the vehicle's limits and the peer
//! takes its reports: a fast ingester waits, and holds no more than that. What becomes of the events comes back from
//! the engine by [`Ticket`](super::receipt::Ticket) and is told in as few reports as the transport takes.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use futures::{Stream, stream};
use prost::Message;
use tokio::sync::OwnedSemaphorePermit;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tonic::{Code, Request, Response, Status, Streaming};

use super::gateway::{Entrance, Entrances};
use super::receipt::{Account, Mark, Verdict, Verdicts};

use v1::ingest_service_server::{IngestService, IngestServiceServer};

/// Whoever opens a stream says at once which vehicle it is for.
const OPENING_TIMEOUT: Duration = Duration::from_secs(10);

/// The service.
pub struct Ingest {
    entrances: Entrances,
}

impl Ingest {
    /// For these vehicles.
    pub fn new(entrances: Entrances) -> Self {
        Self { entrances }
    }

    /// As tonic serves it. A message's length is checked before room is made for it.
    pub fn service(self) -> IngestServiceServer<Self> {
        let message_bytes_max = self.entrances.message_bytes_max();
        IngestServiceServer::new(self).max_decoding_message_size(message_bytes_max)
    }
}

#[tonic::async_trait]
impl IngestService for Ingest {
    type StreamStream = Pin<Box<dyn Stream<Item = Result<v1::IngestReport, Status>> + Send>>;

    async fn stream(
        &self,
        request: Request<Streaming<v1::Observation>>,
    ) -> Result<Response<Self::StreamStream>, Status> {
        let full = |what: &str| Status::resource_exhausted(format!("{what}; close one first"));
        let place = self.entrances.stream().ok_or_else(|| full("every stream the server allows is open"))?;
        let mut observations = request.into_inner();
        let first = tokio::time::timeout(OPENING_TIMEOUT, observations.message())
            .await
            .map_err(|_| Status::deadline_exceeded(format!("no observation within {OPENING_TIMEOUT:?}")))?;
        // Nobody can read which vehicle it was for: the first one counts it, so that it is in one ledger.
        let first = first.inspect_err(|status| {
            self.entrances.all().first().filter(|_| is_refusal(status)).inspect(|first| first.count("message"));
        })?;
        let first = first.ok_or_else(|| Status::invalid_argument("a stream without an observation"))?;
        let entrance = self.entrances.find(&first.vehicle)?.clone();
        let own_place = entrance.stream().map_err(|streams_max| {
            full(&format!("vehicle {} has {streams_max} streams, as many as are allowed", entrance.vehicle))
        })?;
        let mut ingester = Ingester::new(observations, entrance, self.entrances.clone(), [place, own_place]);
        if first.body.is_none() {
            ingester.greet(&first);
        } else {
            ingester.take(first);
        }
        Ok(Response::new(Box::pin(ingester.reports())))
    }
}

/// One open stream.
struct Ingester {
    /// `None` when no more will come.
    observations: Option<Streaming<v1::Observation>>,
    entrance: Arc<Entrance>,
    entrances: Entrances,
    account: Account,
    verdicts: Verdicts,
    told: UnboundedReceiver<(Mark, Verdict)>,
    /// How the stream ends, once everything in flight is reported.
    end: Option<Status>,
    over: bool,
    // Last, and only held.
    _places: [OwnedSemaphorePermit; 2],
}

impl Ingester {
    fn new(
        observations: Streaming<v1::Observation>,
        entrance: Arc<Entrance>,
        entrances: Entrances,
        places: [OwnedSemaphorePermit; 2],
    ) -> Self {
        let (verdicts, told) = unbounded_channel();
        Self {
            observations: Some(observations),
            entrance,
            entrances,
            account: Account::new(0),
            verdicts,
            told,
            end: None,
            over: false,
            _places: places,
        }
    }

    fn reports(self) -> impl Stream<Item = Result<v1::IngestReport, Status>> {
        stream::unfold(self, |mut ingester| async move {
            if ingester.over {
                return None;
            }
            let report = ingester.next().await.transpose()?;
            ingester.over = report.is_err();
            Some((report, ingester))
        })
    }

    /// The next report; when there is something to tell. `None` when all is told and no more will come.
    async fn next(&mut self) -> Result<Option<v1::IngestReport>, Status> {
        loop {
            while let Ok((mark, verdict)) = self.told.try_recv() {
                self.account.tell(mark.number, verdict);
            }
            if let Some(report) = self.account.report() {
                return Ok(Some(report));
            }
            if self.observations.is_none() && self.account.is_settled() {
                return self.end.take().map_or(Ok(None), Err);
            }
            let (events_max, bytes_max) = (self.entrance.in_flight_max, self.entrance.limits.message_bytes_max);
            let room = self.account.has_room(events_max, bytes_max);
            tokio::select! {
                // Verdicts first: they make room.
                biased;
                Some((mark, verdict)) = self.told.recv() => self.account.tell(mark.number, verdict),
                () = self.entrances.stopped(), if self.observations.is_some() => {
                    self.finish(Some(Status::unavailable("the server stops")));
                }
                observation = next_observation(&mut self.observations), if room => match observation {
                    Ok(Some(observation)) => self.take(observation),
                    Ok(None) => self.finish(None),
                    Err(status) => {
                        if is_refusal(&status) {
                            self.entrance.count("message");
                        }
                        self.finish(Some(status));
                    }
                },
            }
        }
    }

    /// An observation that only opens the stream.
    fn greet(&mut self, first: &v1::Observation) {
        // The first number is greater than none.
        let _ = self.account.count(first.number);
        self.account.enter(first.number, 0, 0);
    }

    fn take(&mut self, mut observation: v1::Observation) {
        observation.client = 0;
        let bytes = observation.encoded_len();
        if let Err(unknown) = self.entrance.take(observation, bytes, &mut self.account, &self.verdicts) {
            self.finish(Some(unknown.into()));
        }
    }

    fn finish(&mut self, end: Option<Status>) {
        self.observations = None;
        self.end = end;
    }
}

/// Whether a message was too long, or no observation: not the network's doing.
fn is_refusal(status: &Status) -> bool {
    matches!(status.code(), Code::OutOfRange | Code::Internal)
}

async fn next_observation(
    observations: &mut Option<Streaming<v1::Observation>>,
) -> Result<Option<v1::Observation>, Status> {
    match observations {
        Some(observations) => observations.message().await,
        None => std::future::pending().await,
    }
}
