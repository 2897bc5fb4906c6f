//! One line a map, as they come.

use anyhow::{Result, bail};
use clap::Args;
use clearway_client::{MapStream, Subscription, Update, now_ns};
use serde_json::json;

use super::{Server, say};

/// Watch maps as they come, one line each: sequence, age, drivable share, bytes, skipped.
#[derive(Args)]
pub struct Options {
    #[command(flatten)]
    server: Server,
    /// Over zenoh instead, by this endpoint, such as tcp/localhost:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "address")]
    zenoh: Option<String>,
    /// The vehicle, where there are several.
    #[arg(long)]
    vehicle: Option<String>,
    /// Layers, separated by commas; all unless given. Over zenoh one, drivability unless given.
    #[arg(long, value_delimiter = ',')]
    layers: Vec<String>,
    /// At most so many maps a second; all unless given.
    #[arg(long, value_name = "HZ", conflicts_with = "zenoh")]
    max_rate_hz: Option<f64>,
    /// Let only what has changed travel.
    #[arg(long, conflicts_with = "zenoh")]
    deltas: bool,
    /// One JSON object a line.
    #[arg(long)]
    json: bool,
    /// End after so many maps.
    #[arg(long)]
    count: Option<u64>,
}

/// Watches until the stream ends, the count is reached or nobody reads the lines any more.
///
/// # Errors
/// What the server or the transport says.
pub async fn run(options: Options) -> Result<()> {
    let mut maps = match &options.zenoh {
        Some(endpoint) => over_zenoh(endpoint, &options).await?,
        None => {
            let Options { vehicle, layers, max_rate_hz, deltas, .. } = &options;
            let (vehicle, layers) = (vehicle.clone().unwrap_or_default(), layers.clone());
            let (max_rate_hz, deltas) = (*max_rate_hz, *deltas);
            let subscription = Subscription { vehicle, layers, max_rate_hz, deltas, ..Subscription::default() };
            options.server.connect().await?.subscribe(subscription).await?
        }
    };
    let mut seen = 0;
    while options.count.is_none_or(|count| seen < count) {
        if !say(&line(&maps.next().await?, options.json))? {
            break;
        }
        seen += 1;
    }
    Ok(())
}

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

#[cfg(feature = "zenoh")]
async fn over_zenoh(endpoint: &str, options: &Options) -> Result<MapStream> {
    let layer = match &options.layers[..] {
        [] => "drivability",
        [layer] => layer,
        several => bail!("--layers {}: zenoh has one layer a key; name one", several.join(",")),
    };
    let client = clearway_client::ZenohClient::connect(endpoint).await?;
    let vehicle = match &options.vehicle {
        Some(name) => name.clone(),
        None => match &client.vehicles().await?[..] {
            [] => bail!("no vehicle is served at {endpoint}"),
            [only] => only.clone(),
            several => bail!("{endpoint} has {}: name one with --vehicle", several.join(", ")),
        },
    };
    Ok(client.subscribe(&vehicle, layer).await?)
}

#[cfg(not(feature = "zenoh"))]
async fn over_zenoh(endpoint: &str, _: &Options) -> Result<MapStream> {
    bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
}
