//! The zenoh session of a server that is the client of a router: it is opened once the router answers, and serving does
//! not wait for that.

use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::{Mutex, Notify};
use zenoh::{Config as Settings, Session};

use super::over_zenoh::{OverZenoh, Users};
use super::router::{PERIOD, Watch};
use crate::record::writer::RecorderControl;
use crate::zenoh_session;

/// Longest time for which a start waits for a router. Ours: that of a handshake on a bad link; without a router,
/// vehicles are served to the other readers.
const START_WAITS_MAX: Duration = Duration::from_secs(2);

/// The attempts to open a session, until one succeeds. They go on while [`Opening::first`] or [`Opening::finish`]
/// waits.
pub(super) struct Opening {
    attempts: BoxFuture<'static, Session>,
    failed: Arc<Notify>,
}

/// What uses the session, once there is one.
#[derive(Clone, Default)]
pub(super) struct Connected(pub Arc<Mutex<Option<OverZenoh>>>);

impl Opening {
    /// Begins to open a session.
    pub(super) fn begin(settings: Settings, users: &Users) -> Self {
        let failed = Arc::new(Notify::new());
        let (options, vehicles) = (users.config.zenoh.clone(), users.vehicles.clone());
        let notify = failed.clone();
        let attempts = async move {
            let mut away = Watch::new(options.connect.clone(), vehicles);
            loop {
                match zenoh_session::open(settings.clone(), &options).await {
                    Ok(session) => {
                        away.note(true).await;
                        return session;
                    }
                    Err(error) => tracing::debug!(%error, "no session"),
                }
                notify.notify_one();
                away.note(false).await;
                tokio::time::sleep(PERIOD).await;
            }
        };
        Self { attempts: attempts.boxed(), failed }
    }

    /// The session, if the first attempt succeeds soon.
    pub(super) async fn first(&mut self) -> Option<Session> {
        tokio::select! {
            session = &mut self.attempts => Some(session),
            () = self.failed.notified() => None,
            () = tokio::time::sleep(START_WAITS_MAX) => None,
        }
    }

    /// Waits for the session, and starts what uses it.
    pub(super) async fn finish(self, users: Users, control: Option<RecorderControl>, connected: Connected) {
        let session = self.attempts.await;
        let started = async {
            let mut over_zenoh = OverZenoh::start(session, &users).await?;
            over_zenoh.serve_recorder(&users.config, control.as_ref()).await?;
            Ok::<_, zenoh_session::ZenohError>(over_zenoh)
        };
        match started.await {
            Ok(over_zenoh) => *connected.0.lock().await = Some(over_zenoh),
            Err(error) => tracing::error!(%error, "no maps over zenoh"),
        }
    }
}
