//! `clearway watch`: a server -> one line for each map, and a line when the maps stop.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use clap::builder::RangedI64ValueParser;
use clearway_client::{ClientError, MapStream, Staleness, StreamEvent, Subscription, Update, now_ns};
use serde_json::json;

use crate::cli::connection::{ServerOptions, explain};
use crate::cli::shared::exit::Exit;
#[cfg(feature = "zenoh")]
use crate::cli::shared::files;
use crate::cli::shared::output::{block_on, counted, print_line, with_causes};

/// Time between two lines while no fresh map comes. Ours: a person sees that the command still waits.
const STALE_PERIOD: Duration = Duration::from_secs(1);
/// The layer that is read over zenoh if none is named.
#[cfg(feature = "zenoh")]
const DEFAULT_LAYER: &str = "freespace";
/// Interval at which the age of the last map is read after the stream has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Print a line for each map: sequence number, age, drivable share, bytes, skipped maps.
///
/// If no map arrives, or no newer one before the last one becomes stale, a line says STALE and why once a second until
/// maps arrive again. It waits for a server or router that is not there, at the start and later, unless --count or
/// --until-stale says when it ends. The exit code is 4 if the last line says STALE, and 2 if the server refuses or ends
/// the stream, or if a replay ends before a map or the maps of --count have come.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway watch
  clearway watch --server vehicle.local:50051 --layers freespace,occupancy --max-rate-hz 5
  clearway watch --count 10 --json
  clearway watch --until-stale || echo \"the maps are stale\"")]
pub struct WatchArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// Read over zenoh instead of gRPC, from this endpoint, such as tcp/localhost:7447; or, with
    /// certificates, tls/HOST:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "address")]
    zenoh: Option<String>,
    /// Believe only maps that are signed with the private key of this public key (`zenoh.signing_key` of the server).
    #[arg(long, value_name = "FILE.pub", requires = "zenoh")]
    signed_by: Option<PathBuf>,
    /// The vehicle, if the server has several.
    #[arg(long, value_name = "NAME")]
    vehicle: Option<String>,
    /// Layers, separated by commas; all if absent. Over zenoh one layer; freespace if absent.
    #[arg(long, alias = "layer", value_name = "LAYER", value_delimiter = ',')]
    layers: Vec<String>,
    /// Greatest number of maps a second; every map if absent.
    #[arg(long, value_name = "HZ", conflicts_with = "zenoh")]
    max_rate_hz: Option<f64>,
    /// Print each line as a JSON object.
    #[arg(long)]
    json: bool,
    /// End after this many maps; at Ctrl-C if absent. If a replay ends before, the exit code is 2.
    #[arg(long, value_name = "MAPS", value_parser = RangedI64ValueParser::<u64>::new().range(1..))]
    count: Option<u64>,
    /// End with exit code 4 as soon as the map is stale, or none has come for a second.
    #[arg(long)]
    until_stale: bool,
}

/// Prints lines until the stream or a replay ends, the count is reached, the map is stale with `--until-stale`,
/// or the reader of stdout has closed it.
///
/// # Errors
/// [`ClientError`](clearway_client::ClientError) if the server refuses, does not answer or ends the stream.
pub fn run(options: &WatchArguments) -> Result<Exit> {
    block_on(watch(options))
}

async fn watch(options: &WatchArguments) -> Result<Exit> {
    let mut maps = subscribe_when_there(options).await?;
    let mut newest: Option<Update> = None;
    let (mut printed, mut is_stale) = (0, false);
    while options.count.is_none_or(|count| printed < count) && !(is_stale && options.until_stale) {
        let event = tokio::time::timeout(STALE_PERIOD, maps.next_or_stale()).await;
        let (said, is_new) = match event {
            Ok(Ok(StreamEvent::Fresh(update) | StreamEvent::Stale(update))) => {
                let is_new = newest.as_ref().map(id) != Some(id(&update));
                is_stale = update.map.is_stale(now_ns());
                let said =
                    if is_new { line(&update, &maps, options.json) } else { stale_line(Some(&update), &maps, options) };
                newest = Some(update);
                (said, is_new)
            }
            Ok(Err(error @ ClientError::ReplayEnded { .. })) => {
                eprintln!("clearway: {error}");
                let wanted = options.count.unwrap_or(1);
                if printed < wanted {
                    eprintln!("clearway: {printed} of {} came before the replay ended", counted(wanted, "map"));
                    return Ok(Exit::Unreadable);
                }
                break;
            }
            Ok(Err(ended)) => {
                if let Some(last) = newest.filter(|_| !is_stale) {
                    wait_until_stale(&last).await;
                    print_line(&stale_line(Some(&last), &maps, options))?;
                }
                return Err(explain(ended));
            }
            // A fresh map is not repeated: maps may be rarer than this period.
            Err(_) if newest.as_ref().is_some_and(|last| !last.map.is_stale(now_ns())) => continue,
            Err(_) => {
                is_stale = true;
                (stale_line(newest.as_ref(), &maps, options), false)
            }
        };
        if !print_line(&said)? {
            break;
        }
        printed += u64::from(is_new);
    }
    Ok(Exit::from_stale(is_stale))
}

/// Identity of a map.
fn id(update: &Update) -> (u64, u64) {
    (update.map.header().boot_id, update.map.sequence())
}

/// Waits until the last map of a stream that has ended is stale.
async fn wait_until_stale(last: &Update) {
    while !last.map.is_stale(now_ns()) {
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

impl WatchArguments {
    /// True if nothing but a person or the server ends the command.
    fn is_endless(&self) -> bool {
        self.count.is_none() && !self.until_stale
    }
}

/// Subscribes; an endless command waits until a server answers.
async fn subscribe_when_there(options: &WatchArguments) -> Result<MapStream> {
    let mut said = String::new();
    loop {
        let error = match subscribe(options).await {
            Ok(maps) => return Ok(maps),
            Err(error) => error,
        };
        let is_away = matches!(error.downcast_ref(), Some(ClientError::Unreachable { .. }));
        if !is_away || !options.is_endless() {
            return Err(error);
        }
        let text = with_causes(&error);
        if text != said {
            eprintln!("clearway: {text}; waiting for it");
            said = text;
        }
        tokio::time::sleep(STALE_PERIOD).await;
    }
}

async fn subscribe(options: &WatchArguments) -> Result<MapStream> {
    let WatchArguments { zenoh, vehicle, layers, max_rate_hz, .. } = options;
    if let Some(endpoint) = zenoh {
        return subscribe_over_zenoh(endpoint, options).await;
    }
    let subscription = Subscription {
        vehicle: vehicle.clone().unwrap_or_default(),
        layers: layers.clone(),
        max_rate_hz: *max_rate_hz,
        reconnects: options.is_endless(),
        ..Subscription::default()
    };
    options.server.connect().await?.subscribe(subscription).await.map_err(explain)
}

/// The line for a new map.
fn line(update: &Update, maps: &MapStream, as_json: bool) -> String {
    let (map, skipped, now, hostile) = (&update.map, update.skipped, now_ns(), maps.passed_over().hostile());
    let share = map.metric("drivable_share");
    if as_json {
        let document = json!({
            "vehicle": map.vehicle(), "sequence": map.sequence(), "age_ms": map.age_ms(now), "stale": map.is_stale(now),
            "stale_because": map.staleness(now).map(|why| why.to_string()),
            "reasons": maps.reasons(),
            "drivable_share": share, "bytes": map.bytes().len(), "skipped": skipped,
            "lost": update.lost, "left_out": update.left_out, "passed_over": hostile,
            "layers": map.layers().iter().map(|layer| &layer.name).collect::<Vec<_>>(),
        });
        return document.to_string();
    }
    let share = share.map_or("    -".into(), |share| format!("{:5.1}", 100.0 * share));
    let stale = map.staleness(now).map_or(String::new(), |why| format!("  STALE: {why}"));
    let passed_over = match hostile {
        0 => String::new(),
        messages => format!("  passed over {messages} messages that are no maps of this server"),
    };
    format!(
        "{} #{:06}  age {:7.1} ms  drivable {share} %  {:6} bytes  skipped {skipped}{stale}{passed_over}",
        map.vehicle(),
        map.sequence(),
        map.age_ms(now),
        map.bytes().len()
    )
}

/// The line while no fresh map is there: the newest one is stale, or none has come. It says why in the server's words,
/// if there are any.
fn stale_line(newest: Option<&Update>, maps: &MapStream, options: &WatchArguments) -> String {
    let reasons = maps.reasons();
    match newest {
        Some(update) if options.json => line(update, maps, true),
        Some(Update { map, .. }) => {
            let guess = || map.staleness(now_ns()).unwrap_or(Staleness::NoNewer).to_string();
            let why = if reasons.is_empty() { guess() } else { reasons.join("; ") };
            let (vehicle, sequence, age_ms) = (map.vehicle(), map.sequence(), map.age_ms(now_ns()));
            format!("{vehicle} #{sequence:06}  age {age_ms:7.1} ms  STALE: {why}; waiting")
        }
        None if options.json => {
            let vehicle = &options.vehicle;
            json!({"vehicle": vehicle, "sequence": null, "age_ms": null, "stale": true, "reasons": reasons}).to_string()
        }
        None if reasons.is_empty() => {
            "STALE: waiting for the first map (`clearway status` says why none has come)".to_owned()
        }
        None => format!("STALE: waiting for the first map: {}", reasons.join("; ")),
    }
}

#[cfg(feature = "zenoh")]
async fn subscribe_over_zenoh(endpoint: &str, options: &WatchArguments) -> Result<MapStream> {
    let layer = match &options.layers[..] {
        [] => DEFAULT_LAYER,
        [layer] => layer,
        several => bail!("--layers {}: over zenoh each layer has its own key; name one", several.join(",")),
    };
    let mut connecting = std::pin::pin!(options.server.connect_over_zenoh(endpoint));
    let mut client = match tokio::time::timeout(STALE_PERIOD, &mut connecting).await {
        Ok(connected) => connected?,
        Err(_) => {
            eprintln!("clearway: {endpoint} does not answer yet");
            connecting.await?
        }
    };
    if let Some(file) = &options.signed_by {
        client = client.signed_by(clearway_client::PublicKey::from_pem(&files::read_text(file)?)?);
    }
    let vehicle = match (&options.vehicle, &client.vehicles().await?[..]) {
        (Some(name), present) => {
            if !present.contains(name) {
                let others = if present.is_empty() { "none" } else { &present.join(", ") };
                eprintln!("clearway: --vehicle {name}: no server at {endpoint} publishes it now (others: {others})");
            }
            name.clone()
        }
        (None, []) => bail!("no server at {endpoint} publishes a vehicle"),
        (None, [only]) => only.clone(),
        (None, several) => bail!("{endpoint} has {}: name one with --vehicle", several.join(", ")),
    };
    Ok(client.subscribe(&vehicle, layer).await?)
}

#[cfg(not(feature = "zenoh"))]
async fn subscribe_over_zenoh(endpoint: &str, _: &WatchArguments) -> Result<MapStream> {
    bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
}
