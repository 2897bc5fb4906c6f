//! A second session of a reader that knows several routers, to another router than its first session, while the first
//! brings no maps.
//!
//! A zenoh session has one router. If the link between that router and the one of a vehicle's server is cut, the
//! session is whole and its maps stop. Then a stream subscribes through another router too, until the first brings maps
//! again.
//! A session to both routers at all times would cost both of them every map.

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use futures::StreamExt;
use futures::stream::FuturesUnordered;
use tokio::sync::{Mutex, watch};
use zenoh::{Config, Session};

use super::subscription::{Arrivals, LayerSubscription};
use crate::error::ClientError;
use crate::stream::LatestSlot;
use crate::zenoh::query::{LayerKey, failed};

/// Time without a map, in periods of the maps and at least, after which another router is tried. Ours: the newest map
/// is then still valid, and most late maps come before.
const SILENT_PERIODS: f64 = 1.6;
const SILENT_MIN: Duration = Duration::from_millis(160);
/// Longest such time, and that before the first map: the default validity.
const SILENT_MAX: Duration = Duration::from_millis(300);
/// Maps through the first session after which the second is not needed. Ours: a second of maps.
const BACK_AFTER: u64 = 10;
/// Time after which a second session that brings no map either ends, and until it is tried again. Ours: a vehicle that
/// is switched off costs no second session of each of its readers.
const VAIN_AFTER: Duration = Duration::from_secs(5);
const AGAIN_AFTER: Duration = Duration::from_secs(30);
/// Time until another attempt, after one has failed or while the first session itself has no router.
const RETRY: Duration = Duration::from_millis(200);

/// The second session that the streams of one client share.
pub(super) struct Standby {
    first: Session,
    /// The settings of the sessions, and the endpoint of each router.
    config: Config,
    endpoints: Vec<String>,
    second: Mutex<Weak<Session>>,
}

impl Standby {
    /// For the client of a session; `None` if it knows one router alone.
    pub fn new(first: &Session, config: &Config, endpoint: &str) -> Option<Self> {
        let endpoints: Vec<_> = endpoint.split(',').map(str::to_owned).collect();
        let (first, config) = (first.clone(), config.clone());
        (endpoints.len() > 1).then(|| Self { first, config, endpoints, second: Mutex::default() })
    }

    /// Fills the slot through another router while the first subscription brings no maps. It ends with the session of
    /// that subscription.
    pub async fn cover(&self, layer: &LayerKey, slot: &LatestSlot, mut first: watch::Receiver<Arrivals>) {
        loop {
            silent(&mut first).await;
            // Without a router the first session looks for another one itself.
            let covered = match self.has_router().await {
                true => self.cover_once(layer, slot, &mut first).await,
                false => Ok(true),
            };
            match covered {
                Ok(true) => tokio::time::sleep(RETRY).await,
                // It was in vain, unless the first has maps again.
                Ok(false) => _ = tokio::time::timeout(AGAIN_AFTER, first.changed()).await,
                Err(error) => {
                    tracing::debug!(%error, key = %layer.key, "no other router");
                    _ = tokio::time::timeout(AGAIN_AFTER, first.changed()).await;
                }
            }
        }
    }

    async fn has_router(&self) -> bool {
        self.first.info().routers_zid().await.next().is_some()
    }

    /// Subscribes through another router until the first subscription has maps again. Returns false if none came there
    /// either.
    async fn cover_once(
        &self,
        layer: &LayerKey,
        slot: &LatestSlot,
        first: &mut watch::Receiver<Arrivals>,
    ) -> Result<bool, ClientError> {
        let session = self.second().await?;
        let second = LayerSubscription::open(&session, layer.clone(), slot.clone()).await;
        let second = second.map_err(failed(format!("subscribe to {}", layer.key)))?;
        tracing::debug!(key = %layer.key, "maps come through another router");
        let (back, began, arrivals) = (first.borrow().count + BACK_AFTER, Instant::now(), second.arrivals());
        loop {
            let newest = *arrivals.borrow();
            let quiet = if newest.count == 0 { began.elapsed() } else { newest.at.elapsed() };
            let Some(left) = VAIN_AFTER.checked_sub(quiet) else { return Ok(false) };
            // An error means that the first subscription has ended, and this stream with it.
            if tokio::time::timeout(left, first.wait_for(|arrivals| arrivals.count >= back)).await.is_ok() {
                return Ok(true);
            }
        }
    }

    /// The second session, which ends with its last stream: at a router that is not that of the first.
    async fn second(&self) -> Result<Arc<Session>, ClientError> {
        let mut second = self.second.lock().await;
        let own: Vec<_> = self.first.info().routers_zid().await.collect();
        if let Some(session) = second.upgrade()
            && session.info().routers_zid().await.any(|router| !own.contains(&router))
        {
            return Ok(session);
        }
        let mut attempts: FuturesUnordered<_> = self.endpoints.iter().map(|endpoint| self.open(endpoint)).collect();
        let mut wrong = None;
        while let Some(attempt) = attempts.next().await {
            match attempt {
                Ok(session) if session.info().routers_zid().await.any(|router| !own.contains(&router)) => {
                    let session = Arc::new(session);
                    *second = Arc::downgrade(&session);
                    return Ok(session);
                }
                Ok(same) => _ = same.close().await,
                Err(error) => wrong = Some(error),
            }
        }
        let all = self.endpoints.join(", ");
        Err(wrong.unwrap_or(ClientError::Zenoh { what: format!("connect to {all}"), reason: "one router".into() }))
    }

    async fn open(&self, endpoint: &str) -> Result<Session, ClientError> {
        let (mut config, what) = (self.config.clone(), format!("connect to {endpoint}"));
        let endpoints = format!("[{endpoint:?}]");
        config.insert_json5("connect/endpoints", &endpoints).map_err(failed(what.clone()))?;
        zenoh::open(config).await.map_err(failed(what))
    }
}

/// Waits until a subscription has brought no map for longer than its maps are apart.
async fn silent(arrivals: &mut watch::Receiver<Arrivals>) {
    loop {
        let newest = *arrivals.borrow_and_update();
        let periods = newest.period.mul_f64(SILENT_PERIODS).clamp(SILENT_MIN, SILENT_MAX);
        let allowed = if newest.count == 0 { SILENT_MAX } else { periods };
        let Some(left) = allowed.checked_sub(newest.at.elapsed()) else { return };
        if let Ok(Err(_)) = tokio::time::timeout(left, arrivals.changed()).await {
            // The subscription has ended, and its stream with it.
            std::future::pending::<()>().await;
        }
    }
}
