//! `clearway watch`: a server -> one line for each map, and a line when the maps stop.

use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use clearway_client::{ClientError, MapStream, StreamEvent, Subscription, Update, now_ns};
use serde_json::json;

use super::connection::{ServerOptions, explain};
use super::output::{block_on, print_line};

/// Time without a first map after which the command says that it waits.
const FIRST_MAP_TIMEOUT: Duration = Duration::from_secs(1);

/// Print a line for each map: sequence number, age, drivable share, bytes, skipped maps.
///
/// If no newer map arrives before the last one becomes stale, a line says so; the lines continue when maps arrive
/// again.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway watch
  clearway watch --server vehicle.local:50051 --layers drivability,occupancy --max-rate-hz 2
  clearway watch --count 10 --json")]
pub struct Options {
    #[command(flatten)]
    server: ServerOptions,
    /// Read over zenoh instead of gRPC, from this endpoint, such as tcp/localhost:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with_all = ["address", "ca", "cert", "key"])]
    zenoh: Option<String>,
    /// The vehicle, if the server has several.
    #[arg(long, value_name = "NAME")]
    vehicle: Option<String>,
    /// Layers, separated by commas; all if absent. Over zenoh one layer; drivability if absent.
    #[arg(long, alias = "layer", value_name = "LAYER", value_delimiter = ',')]
    layers: Vec<String>,
    /// Greatest number of maps a second; every map if absent.
    #[arg(long, value_name = "HZ", conflicts_with = "zenoh")]
    max_rate_hz: Option<f64>,
    /// Receive only the cells that have changed since the last map.
    #[arg(long, conflicts_with = "zenoh")]
    deltas: bool,
    /// Print each line as a JSON object.
    #[arg(long)]
    json: bool,
    /// End after this many maps; at Ctrl-C if absent.
    #[arg(long, value_name = "MAPS")]
    count: Option<u64>,
}

/// Prints lines until the stream ends, the count is reached or the reader of stdout has closed it.
///
/// # Errors
/// [`ClientError`](clearway_client::ClientError) if the server refuses, does not answer or ends the stream.
pub fn run(options: &Options) -> Result<()> {
    block_on(watch(options))
}

async fn watch(options: &Options) -> Result<()> {
    let mut maps = subscribe(options).await?;
    let mut last = None;
    let mut printed = 0;
    while options.count.is_none_or(|count| printed < count) {
        let update = match next(&mut maps, printed == 0).await {
            Ok(StreamEvent::Fresh(update) | StreamEvent::Stale(update)) => update,
            Err(error) if matches!(error.downcast_ref(), Some(ClientError::ReplayEnded { .. })) => {
                eprintln!("clearway: {error}");
                break;
            }
            Err(error) => return Err(error),
        };
        let id = (update.map.header().boot_id, update.map.sequence());
        let is_new = last.replace(id) != Some(id);
        let line = if is_new || options.json { line(&update, options.json) } else { stopped_line(&update) };
        if !print_line(&line)? {
            break;
        }
        printed += u64::from(is_new);
    }
    Ok(())
}

/// The next event of the stream. Says on stderr that it waits if this is the first one and does not come soon.
async fn next(maps: &mut MapStream, is_first: bool) -> Result<StreamEvent> {
    if is_first {
        if let Ok(event) = tokio::time::timeout(FIRST_MAP_TIMEOUT, maps.next_or_stale()).await {
            return event.map_err(explain);
        }
        eprintln!(
            "clearway: no map yet; waiting for the first one (`clearway vehicles` shows what the server receives)"
        );
    }
    maps.next_or_stale().await.map_err(explain)
}

async fn subscribe(options: &Options) -> Result<MapStream> {
    let Options { zenoh, vehicle, layers, max_rate_hz, deltas, .. } = options;
    if let Some(endpoint) = zenoh {
        return subscribe_over_zenoh(endpoint, options).await;
    }
    let subscription = Subscription {
        vehicle: vehicle.clone().unwrap_or_default(),
        layers: layers.clone(),
        max_rate_hz: *max_rate_hz,
        deltas: *deltas,
        ..Subscription::default()
    };
    options.server.connect().await?.subscribe(subscription).await.map_err(explain)
}

/// The line for a new map.
fn line(update: &Update, as_json: bool) -> String {
    let (map, skipped, now) = (&update.map, update.skipped, now_ns());
    let share = map.metric("drivable_share");
    if as_json {
        let document = json!({
            "vehicle": map.vehicle(), "sequence": map.sequence(), "age_ms": map.age_ms(now), "stale": map.is_stale(now),
            "drivable_share": share, "bytes": map.bytes().len(), "skipped": skipped,
            "lost": update.lost, "left_out": update.left_out,
            "layers": map.layers().iter().map(|layer| &layer.name).collect::<Vec<_>>(),
        });
        return document.to_string();
    }
    let share = share.map_or("    -".into(), |share| format!("{:5.1}", 100.0 * share));
    let stale = if map.is_stale(now) { "  STALE" } else { "" };
    format!(
        "{} #{:06}  age {:7.1} ms  drivable {share} %  {:6} bytes  skipped {skipped}{stale}",
        map.vehicle(),
        map.sequence(),
        map.age_ms(now),
        map.bytes().len()
    )
}

/// The line for a map that has become stale without a newer one.
fn stopped_line(update: &Update) -> String {
    let map = &update.map;
    format!(
        "{} #{:06}  age {:7.1} ms  STALE: no newer map has arrived; waiting",
        map.vehicle(),
        map.sequence(),
        map.age_ms(now_ns())
    )
}

#[cfg(feature = "zenoh")]
async fn subscribe_over_zenoh(endpoint: &str, options: &Options) -> Result<MapStream> {
    let layer = match &options.layers[..] {
        [] => "drivability",
        [layer] => layer,
        several => bail!("--layers {}: over zenoh each layer has its own key; name one", several.join(",")),
    };
    let client = clearway_client::ZenohClient::connect(endpoint).await?;
    let vehicle = match &options.vehicle {
        Some(name) => name.clone(),
        None => match &client.vehicles().await?[..] {
            [] => bail!("no server at {endpoint} publishes a vehicle"),
            [only] => only.clone(),
            several => bail!("{endpoint} has {}: name one with --vehicle", several.join(", ")),
        },
    };
    Ok(client.subscribe(&vehicle, layer).await?)
}

#[cfg(not(feature = "zenoh"))]
async fn subscribe_over_zenoh(endpoint: &str, _: &Options) -> Result<MapStream> {
    bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
}
