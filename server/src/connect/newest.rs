//! A server -> its newest map, waited for if wanted.

use std::time::{Duration, Instant};

use anyhow::{Error, Result};
use clearway_client::{ClientError, MapView, now_ns};

use super::server::{ServerOptions, explain};
use crate::terminal::usage_error;

/// Interval at which a server is asked again. Ours: a tenth of a second is a revolution.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Longest wait: a day.
const WAIT_MAX: Duration = Duration::from_secs(86_400);

/// The newest map with one layer, or with all. With a `wait` in seconds above 0 it is fresh, unless none comes in that
/// time; then the answer of the server holds.
///
/// # Errors
/// [`ClientError`] if the server refuses or does not answer; if the wait is no time.
pub async fn newest(server: &ServerOptions, vehicle: &str, layer: Option<&str>, wait: f64) -> Result<MapView> {
    let limit = Duration::try_from_secs_f64(wait);
    let limit = limit.map_err(|_| usage_error(format!("--wait={wait}: 0 or more seconds are allowed")))?;
    let until = Instant::now() + limit.min(WAIT_MAX);
    let layers: Vec<String> = layer.map(str::to_owned).into_iter().collect();
    let ask = async || server.connect().await?.newest(vehicle, &layers).await.map_err(explain);
    loop {
        let answer = ask().await;
        let is_fresh = answer.as_ref().is_ok_and(|map| !map.is_stale(now_ns()));
        if is_fresh || Instant::now() >= until || answer.as_ref().is_err_and(|error| !is_passing(error)) {
            return answer;
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// True for an error that passes by itself: no server answers yet, or it has no map yet.
fn is_passing(error: &Error) -> bool {
    match error.downcast_ref::<ClientError>() {
        Some(ClientError::Unreachable { .. }) => true,
        Some(error) => error.to_string().contains("no map"),
        None => false,
    }
}
