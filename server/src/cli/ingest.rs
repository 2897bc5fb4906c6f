//! `clearway ingest`: files -> observations (scans, poses, roads, tunnelled packets) -> a server.

use anyhow::{Result, bail};
use clap::Args;
use clearway_client::observation::by_reason;
use serde_json::json;

use crate::connect::{ServerOptions, explain};
use crate::ingest::plan::{FileOptions, IngestPlan};
use crate::ingest::sender::{SentObservations, send};
use crate::terminal::{Exit, counted, print_line, usage_error};

/// Send observations from files to a server: scans, poses, roads and the packets of drives.
///
/// Reads scans (KITTI .bin, nuScenes .pcd.bin, .pcd), ego poses (.tum: lines of "seconds x y z qx qy qz qw"), roads
/// (.rddf, .rndf) and drives (.pcap, .pcapng: their packets with their own stamps). Prints what the server has refused,
/// and why.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway ingest scans/*.bin poses.tum --sensor top
  clearway ingest drive.pcap --zenoh tcp/localhost:7447 --vehicle car --sensor top")]
pub struct IngestArguments {
    #[command(flatten)]
    files: FileOptions,
    #[command(flatten)]
    server: ServerOptions,
    /// Send over zenoh instead of gRPC, to this endpoint, such as tcp/localhost:7447; or, with certificates,
    /// tls/HOST:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "address")]
    zenoh: Option<String>,
    /// The vehicle; needed over zenoh, and if the server has several.
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    vehicle: String,
    /// The sensor of the scans or packets; needed over zenoh, and if the vehicle has several.
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    sensor: String,
    /// Send as fast as the server accepts, instead of at the recorded pace.
    #[arg(long)]
    fast: bool,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
}

/// Sends the observations.
pub async fn run(options: &IngestArguments) -> Result<Exit> {
    let plan = IngestPlan::new(&options.files)?;
    if !options.sensor.is_empty() && !plan.has_sensors() {
        return Err(usage_error("--sensor is for scans and drives, and the files have neither"));
    }
    let ingester = match &options.zenoh {
        Some(endpoint) => options.server.connect_over_zenoh(endpoint).await?.ingest(&options.vehicle).await?,
        None => options.server.connect().await?.ingest(&options.vehicle).await.map_err(explain)?,
    };
    let sent = send(plan, ingester, &options.sensor, !options.fast).await?;
    report(&sent, options.json)?;
    match sent.is_all_refused() {
        true => bail!("nothing was accepted"),
        false => Ok(Exit::Good),
    }
}

fn report(SentObservations { counts, refusals, notes }: &SentObservations, as_json: bool) -> Result<()> {
    let reasons = by_reason(refusals);
    if as_json {
        print_line(&json!({ "sent": counts, "refused": reasons, "notes": notes }).to_string())?;
        return Ok(());
    }
    let sent: Vec<_> = counts.iter().map(|(kind, count)| counted(*count, kind.trim_end_matches('s'))).collect();
    print_line(&format!("sent {}; the outcome of each is known", sent.join(", ")))?;
    for (reason, count) in &reasons {
        let first = refusals.iter().find(|refusal| refusal.reason == **reason);
        print_line(&format!("refused {count}: {reason}: {}", first.map_or("", |refusal| &refusal.message)))?;
    }
    notes.iter().try_for_each(|note| print_line(note).map(drop))
}
