//! The zenoh session of a server that is the client of a router: opened once a router answers, while serving goes on;
//! and in the status and the log whether a router is connected, and why none is; in the other modes, which endpoints
//! of `zenoh.connect` do not answer.

use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::net::TcpStream;
use tokio::sync::Mutex;

use super::over_zenoh::{OverZenoh, Users};
use crate::publish::Vehicles;
use crate::status::network::Away;
use crate::zenoh_session;

/// Time between two attempts to open the session, and between two looks for its router.
const PERIOD: Duration = Duration::from_millis(500);
/// Time between two questions why no router is connected, and the longest time of one.
const ASK_PERIOD: Duration = Duration::from_secs(5);
const ASK_TIMEOUT: Duration = Duration::from_secs(2);

/// What uses the session, once there is one; before, why the newest attempt to open it failed.
#[derive(Default)]
pub(super) struct Connection {
    pub over_zenoh: Option<OverZenoh>,
    pub failure: String,
}

/// The connection, which the server and its tasks share.
pub(super) type Connected = Arc<Mutex<Connection>>;

/// Opens the session as soon as a router answers, and starts what uses it.
pub(super) async fn connect(settings: zenoh::Config, users: Users, connected: Connected) {
    let session = loop {
        match zenoh_session::open(settings.clone(), &users.config.zenoh).await {
            Ok(session) => break session,
            Err(error) => connected.lock().await.failure = error.to_string(),
        }
        tokio::time::sleep(PERIOD).await;
    };
    match OverZenoh::start(session, &users).await {
        Ok(over_zenoh) => *connected.lock().await = Connection { over_zenoh: Some(over_zenoh), failure: String::new() },
        Err(error) => tracing::error!(%error, "no maps over zenoh"),
    }
}

/// Notes in the status of the vehicles while no router is connected, and why.
pub(super) async fn watch(connected: Connected, endpoints: Vec<String>, vehicles: Vehicles) {
    let (mut away, mut asked) = (None::<Away>, None::<Instant>);
    let mut every = tokio::time::interval(PERIOD);
    let all = endpoints.join(", ");
    loop {
        every.tick().await;
        let connection = connected.lock().await;
        let has_router = match &connection.over_zenoh {
            Some(over_zenoh) => over_zenoh.has_router().await,
            None => false,
        };
        let failure = connection.failure.clone();
        drop(connection);
        match (has_router, &mut away) {
            (true, None) => continue,
            (true, Some(was_away)) => {
                let seconds = was_away.since.elapsed().as_secs_f64();
                if !was_away.reason.is_empty() {
                    tracing::info!(endpoints = all, "zenoh: a router is connected, after {seconds:.1} s without one");
                }
                (away, asked) = (None, None);
            }
            (false, None) => {
                away = Some(Away { since: Instant::now(), endpoints: all.clone(), reason: String::new() });
            }
            (false, Some(away)) if asked.is_none_or(|asked| asked.elapsed() >= ASK_PERIOD) => {
                asked = Some(Instant::now());
                let reason = why(&endpoints, &failure).await;
                if reason != away.reason {
                    tracing::warn!(
                        endpoints = all,
                        reason,
                        "zenoh: no router is connected; serving goes on without it"
                    );
                    away.reason = reason;
                }
            }
            (false, Some(_)) => continue,
        }
        vehicles.0.iter().for_each(|served| served.status.network.set_away(away.clone()));
    }
}

/// Notes in the status of the vehicles, and in the log, which of these endpoints do not answer: no link of the open
/// session leads to them, and they accept no connection.
pub(super) async fn watch_each(session: zenoh::Session, endpoints: Vec<String>, vehicles: Vehicles) {
    let mut away = None::<Away>;
    let mut every = tokio::time::interval(ASK_PERIOD);
    while !endpoints.is_empty() {
        every.tick().await;
        let links = session.info().links().await;
        let linked: Vec<SocketAddr> = links.filter_map(|link| link.dst().address().as_str().parse().ok()).collect();
        let (mut silent, mut reasons) = (Vec::new(), Vec::new());
        for endpoint in &endpoints {
            if let Err(reason) = reach(endpoint, &linked).await {
                silent.push(endpoint.as_str());
                reasons.push(reason);
            }
        }
        let (silent, reason) = (silent.join(", "), reasons.join("; "));
        let (since, before) = away.map_or((Instant::now(), String::new()), |away| (away.since, away.reason));
        match (before == reason, reason.is_empty()) {
            (true, _) => {}
            (false, true) => tracing::info!("zenoh: every endpoint of zenoh.connect answers"),
            (false, false) => tracing::warn!(
                endpoints = silent,
                reason,
                "zenoh: endpoints of zenoh.connect do not answer; serving goes on without them"
            ),
        }
        away = (!reason.is_empty()).then_some(Away { since, endpoints: silent, reason });
        vehicles.0.iter().for_each(|served| served.status.network.set_away(away.clone()));
    }
}

/// Why no session with these endpoints comes about, as far as a connection and the last failure show it.
async fn why(endpoints: &[String], failure: &str) -> String {
    let mut reasons = Vec::new();
    for endpoint in endpoints {
        reasons.push(match reach(endpoint, &[]).await {
            Ok(address) if failure.is_empty() => format!("{address} accepts connections but no session"),
            Ok(address) => format!("{address} accepts connections but no session: {failure}"),
            Err(reason) => reason,
        });
    }
    reasons.join("; ")
}

/// Connects to an endpoint, unless it is one of the `linked` addresses, and returns its address.
///
/// # Errors
/// Why it accepts no connection.
async fn reach(endpoint: &str, linked: &[SocketAddr]) -> Result<String, String> {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let address = address.split(['#', '?']).next().unwrap_or(address).to_owned();
    let connected = async {
        let resolved = address.clone();
        // The system's resolver blocks.
        let found = tokio::task::spawn_blocking(move || resolved.to_socket_addrs()).await;
        let all: Vec<_> = found.map_err(std::io::Error::other)??.collect();
        let is_linked = all.iter().any(|at| linked.contains(at));
        if is_linked { Ok(()) } else { TcpStream::connect(&*all).await.map(drop) }
    };
    match tokio::time::timeout(ASK_TIMEOUT, connected).await {
        Ok(Ok(())) => Ok(address),
        Ok(Err(error)) => Err(format!("{address}: {error}")),
        Err(_) => Err(format!("{address} does not answer")),
    }
}
