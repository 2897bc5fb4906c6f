//! Whether a router delivers what the server publishes, in the status and the log.
//!
//! A router whose access control denies the server's puts drops them without an answer, and sends nothing back to the
//! session that published it. So a second session reads one status of the server's first vehicle through the router:
//! once a minute, because each time costs a thin uplink a status and a handshake.

use std::time::{Duration, Instant};

use zenoh::Session;

use crate::config::Zenoh as Options;
use crate::publish::Vehicles;
use crate::status::network::Undelivered;
use crate::zenoh_session::{self, ZenohError};

/// Time from one delivered status to the next attempt.
const PERIOD: Duration = Duration::from_secs(60);
/// Time from an attempt that shows nothing to the next one.
const RETRY_PERIOD: Duration = Duration::from_secs(5);
/// Longest wait for a status, which is published once a second. Ours: a full queue of a thin link drops some.
const WAIT: Duration = Duration::from_secs(5);
/// Attempts without a status after which that is named. Ours: a router that restarts meanwhile costs one.
const ATTEMPTS: u32 = 2;

/// Notes in the status of the vehicles while a router is connected and does not deliver what this server publishes.
pub(super) async fn watch_delivery(session: Session, settings: zenoh::Config, options: Options, vehicles: Vehicles) {
    let Some(first) = vehicles.0.first() else { return };
    let key = format!("clearway/{}/status", first.status.name);
    let endpoints = options.connect.join(", ");
    let (mut missing, mut since) = (0, Instant::now());
    loop {
        let begun = Instant::now();
        // Without a router before or after, a missing status says nothing about access control.
        let delivered = match has_router(&session).await {
            true => attempt(settings.clone(), &options, &key).await.ok(),
            false => None,
        };
        match delivered {
            Some(true) => {
                if missing >= ATTEMPTS {
                    tracing::info!(endpoints, key, "zenoh: the router delivers what this server publishes");
                }
                missing = 0;
            }
            Some(false) if has_router(&session).await => {
                since = if missing == 0 { begun } else { since };
                missing += 1;
                if missing == ATTEMPTS {
                    let reason = "its access control must let this server put";
                    tracing::warn!(endpoints, key, reason, "zenoh: the router delivers nothing of this server");
                }
            }
            // A router that is not there is named as such.
            _ if !has_router(&session).await => missing = 0,
            _ => {}
        }
        let named =
            (missing >= ATTEMPTS).then(|| Undelivered { since, endpoints: endpoints.clone(), key: key.clone() });
        vehicles.0.iter().for_each(|served| served.status.network.set_undelivered(named.clone()));
        match delivered {
            Some(true) => tokio::time::sleep(PERIOD).await,
            Some(false) => {}
            None => tokio::time::sleep(RETRY_PERIOD).await,
        }
    }
}

async fn has_router(session: &Session) -> bool {
    session.info().routers_zid().await.next().is_some()
}

/// Whether a second session receives a sample on this key in time.
///
/// # Errors
/// [`ZenohError`] if the second session or its subscription does not come about.
async fn attempt(settings: zenoh::Config, options: &Options, key: &str) -> Result<bool, ZenohError> {
    let reader = zenoh_session::open(settings, options).await?;
    let subscribed = reader.declare_subscriber(key.to_owned()).await;
    let subscriber = subscribed.map_err(ZenohError::of(format!("subscriber {key}")))?;
    let received = tokio::time::timeout(WAIT, subscriber.recv_async()).await.is_ok_and(|sample| sample.is_ok());
    reader.close().await.map_err(ZenohError::of("close"))?;
    Ok(received)
}
