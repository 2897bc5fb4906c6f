//! Observations -> a server, which tells what became of each.
//!
//! ```no_run
//! use clearway_client::{Client, Observation};
//!
//! # async fn tell(points: [Vec<f32>; 3], stamp_ns: i64) -> Result<(), clearway_client::ClientError> {
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

use crate::ClientError;
use crate::observation::{Observation, Refusal};

/// Observations on their way without an acknowledgement: some round trips of 10 Hz scans, and no heap of old ones.
const IN_FLIGHT_MAX: u64 = 16;
/// A server that takes anything at all reports sooner.
const REPORT_TIMEOUT: Duration = Duration::from_secs(10);
/// Refusals kept until they are asked for; of more, the oldest go, and are counted.
const REFUSALS_MAX: usize = 4096;

/// Hands one observation to a transport.
pub(crate) type Deliver = Box<dyn FnMut(v1::Observation) -> BoxFuture<'static, Result<(), ClientError>> + Send>;

/// A way to send one vehicle's observations, over gRPC ([`Client::ingest`](crate::Client::ingest)) or zenoh
/// (`ZenohClient::ingest`).
pub struct Ingester {
    address: String,
    deliver: Deliver,
    heard: Ear,
    sent: u64,
}

/// What the server has reported; transports write it.
#[derive(Clone, Debug)]
pub(crate) struct Ear(Arc<watch::Sender<Heard>>);

#[derive(Debug, Default)]
struct Heard {
    acknowledged: u64,
    refusals: Vec<Refusal>,
    forgotten: u64,
    ended: Option<ClientError>,
}

impl Ear {
    pub(crate) fn new() -> Self {
        Self(Arc::new(watch::Sender::new(Heard::default())))
    }

    pub(crate) fn report(&self, report: v1::IngestReport) {
        self.0.send_modify(|heard| {
            heard.acknowledged = heard.acknowledged.max(report.acknowledged);
            heard.refusals.extend(report.refused.into_iter().map(|refused| Refusal {
                number: refused.number,
                reason: refused.reason,
                message: refused.message,
                count: refused.count,
            }));
            let over = heard.refusals.len().saturating_sub(REFUSALS_MAX);
            heard.refusals.drain(..over);
            heard.forgotten += over as u64;
        });
    }

    pub(crate) fn end(&self, error: ClientError) {
        self.0.send_modify(|heard| heard.ended = heard.ended.take().or(Some(error)));
    }
}

impl Ingester {
    pub(crate) fn new(address: String, deliver: Deliver, heard: Ear) -> Self {
        Self { address, deliver, heard, sent: 0 }
    }

    /// Sends an observation and gives its number; waits while too many are on their way.
    ///
    /// # Errors
    /// How the stream has ended: [`ClientError::Refused`] for a sensor nobody knows, listing the known ones, or a
    /// message that is too long; [`ClientError::Unreachable`], or [`ClientError::Silent`] where no report comes.
    pub async fn send(&mut self, observation: Observation) -> Result<u64, ClientError> {
        let number = self.sent + 1;
        self.acknowledged(number.saturating_sub(IN_FLIGHT_MAX)).await?;
        let Observation(observation) = observation;
        let delivered = (self.deliver)(v1::Observation { number, ..observation }).await;
        if let Err(error) = delivered {
            // The stream's own end says more than that it has ended.
            return Err(self.ended().await.unwrap_or(error));
        }
        self.sent = number;
        Ok(number)
    }

    /// Waits until the server has told what became of everything sent; gives what it refused since this was last asked.
    ///
    /// # Errors
    /// As [`Ingester::send`].
    pub async fn settled(&mut self) -> Result<Vec<Refusal>, ClientError> {
        self.acknowledged(self.sent).await?;
        Ok(self.refusals())
    }

    /// What the server has refused since this was last asked, as far as it is known, by number; the newest 4096.
    pub fn refusals(&mut self) -> Vec<Refusal> {
        let mut refusals = Vec::new();
        self.heard.0.send_if_modified(|heard| {
            refusals = std::mem::take(&mut heard.refusals);
            false
        });
        // What never reached the engine is told before what waits for it.
        refusals.sort_by_key(|refusal| refusal.number);
        refusals
    }

    /// Refusals that nobody asked for in time and that were dropped for newer ones.
    pub fn forgotten_refusals(&self) -> u64 {
        self.heard.0.borrow().forgotten
    }

    async fn acknowledged(&self, number: u64) -> Result<(), ClientError> {
        let mut heard = self.heard.0.subscribe();
        loop {
            {
                let heard = heard.borrow_and_update();
                if heard.acknowledged >= number {
                    return Ok(());
                }
                if let Some(error) = &heard.ended {
                    return Err(error.clone());
                }
            }
            if !matches!(tokio::time::timeout(REPORT_TIMEOUT, heard.changed()).await, Ok(Ok(()))) {
                let acknowledged = heard.borrow().acknowledged;
                return Err(ClientError::Silent { address: self.address.clone(), sent: self.sent, acknowledged });
            }
        }
    }

    /// Why the stream has ended; it may take a moment to be known.
    async fn ended(&self) -> Option<ClientError> {
        let mut heard = self.heard.0.subscribe();
        let ended = heard.wait_for(|heard| heard.ended.is_some());
        let heard = tokio::time::timeout(REPORT_TIMEOUT, ended).await.ok()?.ok()?;
        heard.ended.clone()
    }
}
