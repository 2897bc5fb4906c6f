//! Observations over gRPC: `clearway.v1.IngestService`.
//!
//! A stream reads its next observation only while its events in flight are within the vehicle's limits and the peer
//! receives its reports. A fast client therefore waits, and the server holds no more than the limits. The engine
//! returns the outcome of each event by its [`Receipt`](crate::ingest::receipt::Receipt); the stream collects outcomes
//! into as few reports as the transport can send. It runs in a task of its own, so that a peer that takes no reports
//! keeps neither a permit nor an event.

use std::error::Error;
use std::net::Ipv4Addr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use futures::future::{BoxFuture, OptionFuture};
use futures::{FutureExt, Stream, stream};
use tokio::sync::mpsc::{self, UnboundedReceiver, channel, unbounded_channel};
use tonic::{Code, Request, Response, Status, Streaming};

use crate::ingest::admission::{AdmissionPermit, OpenStream};
use crate::ingest::gateway::{Gateway, Gateways};
use crate::ingest::receipt::{ClientSession, ObservationId, Outcome, OutcomeSender};
use crate::publish::listen::CallPermit;
use crate::publish::listen::access::caller;

use v1::ingest_service_server::{IngestService, IngestServiceServer};

/// A new stream must name its vehicle within this time. Ours: no client has a reason to wait.
const OPENING_TIMEOUT: Duration = Duration::from_secs(10);

/// The implementation of `clearway.v1.IngestService`.
pub struct GrpcIngest {
    gateways: Gateways,
}

impl GrpcIngest {
    /// The service for the vehicles of these gateways.
    pub fn new(gateways: Gateways) -> Self {
        Self { gateways }
    }

    /// The service as tonic serves it. It refuses a message that is too long before it allocates memory for it.
    pub fn into_service(self) -> IngestServiceServer<Self> {
        let message_bytes_max = self.gateways.message_bytes_max();
        IngestServiceServer::new(self).max_decoding_message_size(message_bytes_max)
    }
}

#[tonic::async_trait]
impl IngestService for GrpcIngest {
    type StreamStream = Pin<Box<dyn Stream<Item = Result<v1::IngestReport, Status>> + Send>>;

    async fn stream(
        &self,
        request: Request<Streaming<v1::Observation>>,
    ) -> Result<Response<Self::StreamStream>, Status> {
        let caller = caller(&request);
        let slot = request.extensions().get::<Arc<CallPermit>>().map(|call| call.slot.clone());
        let host = slot.as_ref().map_or(Ipv4Addr::UNSPECIFIED.into(), |slot| slot.address());
        let full = |of: &str, error| {
            slot.as_ref().inspect(|slot| slot.count("streams"));
            Status::resource_exhausted(format!("{of}: {error}; close one first"))
        };
        let unnamed = self.gateways.open_unnamed_stream(host);
        let unnamed = unnamed.map_err(|error| full("streams that have not named their vehicle", error))?;
        let mut observations = request.into_inner();
        let first = tokio::time::timeout(OPENING_TIMEOUT, observations.message())
            .await
            .map_err(|_| Status::deadline_exceeded(format!("no observation within {OPENING_TIMEOUT:?}")))?;
        // The vehicle of an unreadable observation is unknown: the first vehicle counts it, so that one ledger has it.
        let first = first.inspect_err(|status| {
            let gateway = self.gateways.all().first().filter(|_| is_refusal(status));
            gateway.inspect(|gateway| gateway.record_refusal("message"));
        })?;
        let first = first.ok_or_else(|| Status::invalid_argument("a stream without an observation"))?;
        let gateway = self.gateways.find(&first.vehicle)?.clone();
        caller.check_vehicle(&gateway.vehicle)?;
        let open = gateway.open_stream(host);
        let open = open.map_err(|error| full(&format!("vehicle {}", gateway.vehicle), error))?;
        drop(unnamed);
        let session = ClientSession::of_sender(0, &gateway.name_stream(host));
        let mut stream = IngestStream::new(observations, gateway, self.gateways.clone(), session, open);
        if first.body.is_none() {
            stream.acknowledge_opening(&first);
        } else {
            stream.wait_for_admission(first);
        }
        let (report_sender, mut reports) = channel(1);
        tokio::spawn(stream.run(report_sender));
        Ok(Response::new(Box::pin(stream::poll_fn(move |context| reports.poll_recv(context)))))
    }
}

/// One open stream.
struct IngestStream {
    /// `None` once the stream reads no more observations.
    observations: Option<Streaming<v1::Observation>>,
    /// The observation that is not admitted yet.
    waiting: Option<BoxFuture<'static, (v1::Observation, AdmissionPermit)>>,
    gateway: Arc<Gateway>,
    gateways: Gateways,
    session: ClientSession,
    outcome_sender: OutcomeSender,
    outcomes: UnboundedReceiver<(ObservationId, Outcome)>,
    /// The status that ends the stream, after everything in flight is reported.
    end: Option<Status>,
    // The last field, so that it is dropped last.
    _open: OpenStream,
}

impl IngestStream {
    fn new(
        observations: Streaming<v1::Observation>,
        gateway: Arc<Gateway>,
        gateways: Gateways,
        session: ClientSession,
        open: OpenStream,
    ) -> Self {
        let (outcome_sender, outcomes) = unbounded_channel();
        Self {
            observations: Some(observations),
            waiting: None,
            gateway,
            gateways,
            session,
            outcome_sender,
            outcomes,
            end: None,
            _open: open,
        }
    }

    /// Reads observations and sends reports, until the peer hangs up, or everything is reported and no more
    /// observations will come.
    async fn run(mut self, reports: mpsc::Sender<Result<v1::IngestReport, Status>>) {
        loop {
            while let Ok((id, outcome)) = self.outcomes.try_recv() {
                self.session.record_outcome(id.number, outcome);
            }
            let has_report = self.session.has_report();
            if !has_report && self.observations.is_none() && self.waiting.is_none() && self.session.is_idle() {
                if let Some(end) = self.end.take() {
                    // An error means that the peer has hung up.
                    let _ = reports.send(Err(end)).await;
                }
                return;
            }
            let has_credit =
                !has_report && self.waiting.is_none() && self.session.has_credit(self.gateway.in_flight_max);
            tokio::select! {
                // Outcomes first, because they give credit.
                biased;
                Some((id, outcome)) = self.outcomes.recv() => self.session.record_outcome(id.number, outcome),
                () = reports.closed() => return,
                Ok(place) = reports.reserve(), if has_report => {
                    if let Some(report) = self.session.next_report() {
                        place.send(Ok(report));
                    }
                }
                () = self.gateways.stopped(), if self.observations.is_some() => {
                    self.stop_reading(Some(Status::unavailable("the server stops")));
                }
                Some((waited, permit)) = OptionFuture::from(self.waiting.as_mut()) => self.push(waited, permit),
                observation = next_observation(&mut self.observations), if has_credit => match observation {
                    Ok(Some(observation)) => self.wait_for_admission(observation),
                    Ok(None) => self.stop_reading(None),
                    Err(status) => {
                        if is_refusal(&status) {
                            self.gateway.record_refusal("message");
                        }
                        self.stop_reading(Some(status));
                    }
                },
            }
        }
    }

    /// Acknowledges an observation without a body, which only opens the stream.
    fn acknowledge_opening(&mut self, first: &v1::Observation) {
        // A first number is always valid.
        let _ = self.session.check_number(first.number);
        self.session.begin(first.number, 0);
    }

    fn wait_for_admission(&mut self, mut observation: v1::Observation) {
        use v1::observation::Body::{EgoPose, End};
        observation.client = 0;
        let gateway = self.gateway.clone();
        let admitting = async move {
            let is_light = matches!(observation.body, None | Some(EgoPose(_) | End(_)));
            let permit = gateway.admission.admit(is_light).await;
            (observation, permit)
        };
        self.waiting = Some(admitting.boxed());
    }

    fn push(&mut self, observation: v1::Observation, permit: AdmissionPermit) {
        self.waiting = None;
        if let Err(unknown) = self.gateway.push(observation, permit, &mut self.session, &self.outcome_sender) {
            self.stop_reading(Some(unknown.into()));
        }
    }

    fn stop_reading(&mut self, end: Option<Status>) {
        (self.observations, self.waiting) = (None, None);
        self.end = end;
    }
}

impl Drop for IngestStream {
    /// The sensors that the stream has declared end with it.
    fn drop(&mut self) {
        self.gateway.end(&mut self.session);
    }
}

/// True if the message was too long or not an observation, false for a failure of the network, which has a source.
fn is_refusal(status: &Status) -> bool {
    matches!(status.code(), Code::OutOfRange | Code::Internal) && status.source().is_none()
}

async fn next_observation(
    observations: &mut Option<Streaming<v1::Observation>>,
) -> Result<Option<v1::Observation>, Status> {
    match observations {
        Some(observations) => observations.message().await,
        None => std::future::pending().await,
    }
}
