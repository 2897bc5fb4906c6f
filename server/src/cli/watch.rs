//! `clearway watch`: a server -> one line for each map, and a line when the maps stop.

use std::time::Duration;

use anyhow::Result;
use clap::Args;
use clap::builder::RangedI64ValueParser;
use clearway_client::{ClientError, MapStream, Staleness, StreamEvent, Update, now_ns};
use serde_json::json;

use crate::connect::{MapOptions, explain};
use crate::terminal::{Exit, counted, print_line};

/// Time between two lines while no fresh map comes. Ours: a person sees that the command still waits.
const STALE_PERIOD: Duration = Duration::from_secs(1);
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
    maps: MapOptions,
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
pub async fn run(options: &WatchArguments) -> Result<Exit> {
    // Nothing but a person or the server ends an endless command.
    let is_endless = options.count.is_none() && !options.until_stale;
    let mut maps = options.maps.subscribe(is_endless).await?;
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
            let vehicle = &options.maps.vehicle;
            json!({"vehicle": vehicle, "sequence": null, "age_ms": null, "stale": true, "reasons": reasons}).to_string()
        }
        None if reasons.is_empty() => {
            "STALE: waiting for the first map (`clearway status` says why none has come)".to_owned()
        }
        None => format!("STALE: waiting for the first map: {}", reasons.join("; ")),
    }
}
