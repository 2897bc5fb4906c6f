//! Observations -> a server, and the outcome of each.
//!
//! ```no_run
//! use clearway_client::{Client, Observation};
//!
//! # async fn send(points: [Vec<f32>; 3], stamp_ns: i64) -> Result<(), clearway_client::ClientError> {
//! let mut ingester = Client::connect("localhost:50051").await?.ingest("car").await?;
//! let level = [0.0, 0.0, 0.0, 1.0];
//! ingester.send(Observation::pose(stamp_ns, [12.0, 3.0, 0.0], level, 8.0)).await?;
//! ingester.send(Observation::scan("top", stamp_ns, &points[0], &points[1], &points[2])).await?;
//! for refusal in ingester.settled().await? {
//!     println!("observation {}: {}", refusal.number, refusal.message);
//! }
//! # Ok(())
//! # }
//! ```

use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use futures::future::BoxFuture;
use tokio::sync::watch;

use crate::error::ClientError;
use crate::observation::{Observation, Refusal};

/// Most observations that may be sent without an acknowledgement. Ours: several round trips at 10 scans per second, but
/// no long queue of old scans.
const IN_FLIGHT_MAX: u64 = 16;
/// Longest time without a report while observations are unacknowledged. Ours: a server that works reports much sooner.
const REPORT_TIMEOUT: Duration = Duration::from_secs(10);
/// Most refusals kept until they are read. If there are more, the oldest are dropped and counted.
const REFUSALS_MAX: usize = 4096;

/// Function that gives one observation to a transport. It is `Sync`, so that the futures of an [`Ingester`] are `Send`.
pub(crate) type SendObservation =
    Box<dyn FnMut(v1::Observation) -> BoxFuture<'static, Result<(), ClientError>> + Send + Sync>;

/// Sender of one vehicle's observations, over gRPC ([`Client::ingest`](crate::Client::ingest)) or zenoh
/// (`ZenohClient::ingest`).
pub struct Ingester {
    address: String,
    send: SendObservation,
    reports: ReportReceiver,
    sent: u64,
}

/// Receiver of the server's reports. A transport writes to it; an [`Ingester`] reads from it.
#[derive(Clone, Debug)]
pub(crate) struct ReportReceiver(Arc<watch::Sender<Outcomes>>);

/// Outcomes reported so far.
#[derive(Debug, Default)]
struct Outcomes {
    acknowledged: u64,
    refusals: Vec<Refusal>,
    forgotten: u64,
    ended: Option<ClientError>,
}

impl ReportReceiver {
    pub(crate) fn new() -> Self {
        Self(Arc::new(watch::Sender::new(Outcomes::default())))
    }

    pub(crate) fn push(&self, report: v1::IngestReport) {
        self.0.send_modify(|outcomes| {
            outcomes.acknowledged = outcomes.acknowledged.max(report.acknowledged);
            outcomes.refusals.extend(report.refused.into_iter().map(|refused| Refusal {
                number: refused.number,
                reason: refused.reason,
                message: refused.message,
                count: refused.count,
            }));
            let over = outcomes.refusals.len().saturating_sub(REFUSALS_MAX);
            outcomes.refusals.drain(..over);
            outcomes.forgotten += over as u64;
        });
    }

    pub(crate) fn end(&self, error: ClientError) {
        self.0.send_modify(|outcomes| outcomes.ended = outcomes.ended.take().or(Some(error)));
    }
}

impl Ingester {
    pub(crate) fn new(address: String, send: SendObservation, reports: ReportReceiver) -> Self {
        Self { address, send, reports, sent: 0 }
    }

    /// Sends an observation and returns its number. It waits while too many observations are unacknowledged.
    ///
    /// # Errors
    /// Why the stream has ended: [`ClientError::Refused`] if the sensor is unknown or the message is too long,
    /// [`ClientError::Unreachable`] if the connection failed, [`ClientError::Ended`] if the server ended the stream,
    /// [`ClientError::Silent`] if no report arrives, [`ClientError::Zenoh`] if zenoh fails.
    pub async fn send(&mut self, observation: Observation) -> Result<u64, ClientError> {
        let number = self.sent + 1;
        self.wait_acknowledged(number.saturating_sub(IN_FLIGHT_MAX)).await?;
        let Observation(observation) = observation;
        let delivered = (self.send)(v1::Observation { number, ..observation }).await;
        if let Err(error) = delivered {
            // The reason for which the stream ended is more precise than a failed send.
            return Err(self.wait_ended().await.unwrap_or(error));
        }
        self.sent = number;
        Ok(number)
    }

    /// Waits until the server has reported the outcome of every observation sent. Returns the refusals that were not
    /// read before.
    ///
    /// # Errors
    /// As [`Ingester::send`].
    pub async fn settled(&mut self) -> Result<Vec<Refusal>, ClientError> {
        self.wait_acknowledged(self.sent).await?;
        Ok(self.refusals())
    }

    /// Returns the refusals known so far that were not read before, by number of the observation; at most the newest
    /// 4096.
    pub fn refusals(&mut self) -> Vec<Refusal> {
        let mut refusals = Vec::new();
        self.reports.0.send_if_modified(|outcomes| {
            refusals = std::mem::take(&mut outcomes.refusals);
            false
        });
        // Observations refused before the engine are reported before observations that wait for the engine.
        refusals.sort_by_key(|refusal| refusal.number);
        refusals
    }

    /// Number of refusals that were dropped for newer refusals before they were read.
    pub fn forgotten_refusals(&self) -> u64 {
        self.reports.0.borrow().forgotten
    }

    async fn wait_acknowledged(&self, number: u64) -> Result<(), ClientError> {
        let mut outcomes = self.reports.0.subscribe();
        loop {
            {
                let outcomes = outcomes.borrow_and_update();
                if outcomes.acknowledged >= number {
                    return Ok(());
                }
                if let Some(error) = &outcomes.ended {
                    return Err(error.clone());
                }
            }
            if !matches!(tokio::time::timeout(REPORT_TIMEOUT, outcomes.changed()).await, Ok(Ok(()))) {
                let acknowledged = outcomes.borrow().acknowledged;
                return Err(ClientError::Silent { address: self.address.clone(), sent: self.sent, acknowledged });
            }
        }
    }

    /// Waits for the reason why the stream has ended.
    async fn wait_ended(&self) -> Option<ClientError> {
        let mut outcomes = self.reports.0.subscribe();
        let ended = outcomes.wait_for(|outcomes| outcomes.ended.is_some());
        let outcomes = tokio::time::timeout(REPORT_TIMEOUT, ended).await.ok()?.ok()?;
        outcomes.ended.clone()
    }
}
