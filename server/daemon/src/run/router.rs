//! Whether a router is connected to a server that is the client of one, in the status and the log; and why none is.

use std::net::ToSocketAddrs;
use std::time::{Duration, Instant};

use tokio::net::TcpStream;
use zenoh::Session;

use crate::publish::Vehicles;
use crate::status::network::Away;

/// Time between two looks for a router.
pub(super) const PERIOD: Duration = Duration::from_millis(500);
/// Time between two questions why no router is connected, and the longest time of one.
const ASK_PERIOD: Duration = Duration::from_secs(5);
const ASK_TIMEOUT: Duration = Duration::from_secs(2);

/// Notes in the status of the vehicles while no router is connected.
pub(super) async fn watch_router(session: Session, endpoints: Vec<String>, vehicles: Vehicles) {
    let mut away = Watch::new(endpoints, vehicles);
    let mut every = tokio::time::interval(PERIOD);
    loop {
        every.tick().await;
        away.note(session.info().routers_zid().await.next().is_some()).await;
    }
}

/// Since when no router is connected, and why.
pub(super) struct Watch {
    endpoints: Vec<String>,
    vehicles: Vehicles,
    away: Option<Away>,
    asked: Option<Instant>,
}

impl Watch {
    pub(super) fn new(endpoints: Vec<String>, vehicles: Vehicles) -> Self {
        Self { endpoints, vehicles, away: None, asked: None }
    }

    /// Notes whether a router is connected now.
    pub(super) async fn note(&mut self, is_connected: bool) {
        let endpoints = self.endpoints.join(", ");
        match (is_connected, &mut self.away) {
            (true, None) => return,
            (true, Some(away)) => {
                let seconds = away.since.elapsed().as_secs_f64();
                if !away.reason.is_empty() {
                    tracing::info!(endpoints, "zenoh: a router is connected, after {seconds:.1} s without one");
                }
                (self.away, self.asked) = (None, None);
            }
            (false, None) => {
                self.away = Some(Away { since: Instant::now(), endpoints, reason: String::new() });
            }
            (false, Some(away)) => {
                if self.asked.is_none_or(|asked| asked.elapsed() >= ASK_PERIOD) {
                    self.asked = Some(Instant::now());
                    let reason = why(&self.endpoints).await;
                    if reason != away.reason {
                        tracing::warn!(endpoints, reason, "zenoh: no router is connected; serving goes on without it");
                        away.reason = reason;
                    }
                }
            }
        }
        self.vehicles.0.iter().for_each(|served| served.status.network.set_away(self.away.clone()));
    }
}

/// Why no session with these endpoints comes about, as far as a connection shows it.
async fn why(endpoints: &[String]) -> String {
    let mut reasons = Vec::new();
    for endpoint in endpoints {
        let address = endpoint.split_once('/').map_or(endpoint.as_str(), |(_, address)| address);
        let address = address.split(['#', '?']).next().unwrap_or(address).to_owned();
        let connected = async {
            let resolved = address.clone();
            // The system's resolver blocks.
            let found = tokio::task::spawn_blocking(move || resolved.to_socket_addrs()).await;
            let all: Vec<_> = found.map_err(std::io::Error::other)??.collect();
            TcpStream::connect(&*all).await
        };
        reasons.push(match tokio::time::timeout(ASK_TIMEOUT, connected).await {
            Ok(Ok(_)) => format!("{address} accepts connections but no session (certificate, roles or limits)"),
            Ok(Err(error)) => format!("{address}: {error}"),
            Err(_) => format!("{address} does not answer"),
        });
    }
    reasons.join("; ")
}
