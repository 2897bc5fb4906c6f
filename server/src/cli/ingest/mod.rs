//! `clearway ingest`: files -> observations (scans, poses, roads, tunnelled packets) -> a server.
//!
//! | file | in -> out |
//! |---|---|
//! | `files` | files -> observations and their stamps |

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::{Ingester, Observation, Refusal};
use serde_json::json;

use crate::cli::connection::{ServerOptions, explain};
use crate::cli::shared::output::{block_on, counted, print_line, usage_error};
use files::{FileOptions, IngestItem, IngestPlan, PacketGroups};

mod files;

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
///
/// # Errors
/// If a file cannot be read, if everything was refused, or as [`ClientError`](clearway_client::ClientError). A refused
/// observation beside accepted ones is not an error; the output says so.
pub fn run(options: &IngestArguments) -> Result<()> {
    block_on(ingest(options))
}

async fn ingest(options: &IngestArguments) -> Result<()> {
    let plan = IngestPlan::new(&options.files)?;
    let mut notes = plan.notes.clone();
    let has_scans = plan.items.iter().any(|(_, item)| matches!(item, IngestItem::Scan(_)));
    if !options.sensor.is_empty() && !has_scans && plan.drives.is_empty() {
        return Err(usage_error("--sensor is for scans and drives, and the files have neither"));
    }
    let ingester = match &options.zenoh {
        Some(endpoint) => ingest_over_zenoh(endpoint, options).await?,
        None => options.server.connect().await?.ingest(&options.vehicle).await.map_err(explain)?,
    };
    let mut sender = ObservationSender {
        ingester,
        paced: !options.fast,
        started: None,
        sent: BTreeMap::new(),
        refusals: Vec::new(),
    };
    for (stamp_ns, item) in &plan.items {
        let (kind, observation) = item.read(&options.sensor, *stamp_ns)?;
        sender.send(kind, 1, *stamp_ns, observation).await?;
    }
    for file in &plan.drives {
        let mut groups = PacketGroups::open(file)?;
        for group in groups.by_ref() {
            let packets = group.with_context(|| file.display().to_string())?;
            let stamp_ns = packets.last().map_or(0, |(stamp_ns, _)| *stamp_ns);
            let observation = Observation::packets(&options.sensor, &packets);
            sender.send("packets", packets.len() as u64, stamp_ns, observation).await?;
        }
        notes.extend(groups.notes().into_iter().map(|note| format!("{}: {note}", file.display())));
    }
    sender.refusals.extend(sender.ingester.settled().await?);
    report(&sender, &notes, options.json)?;
    match sender.is_all_refused() {
        true => bail!("nothing was accepted"),
        false => Ok(()),
    }
}

#[cfg(feature = "zenoh")]
async fn ingest_over_zenoh(endpoint: &str, options: &IngestArguments) -> Result<Ingester> {
    Ok(options.server.connect_over_zenoh(endpoint).await?.ingest(&options.vehicle).await?)
}

#[cfg(not(feature = "zenoh"))]
async fn ingest_over_zenoh(endpoint: &str, _: &IngestArguments) -> Result<Ingester> {
    bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
}

/// A stream of observations to a server, and the counts of what was sent and refused.
struct ObservationSender {
    ingester: Ingester,
    /// True if each observation is sent at the time of its stamp.
    paced: bool,
    /// When the first observation was sent, and its stamp.
    started: Option<(Instant, i64)>,
    /// Number of scans, poses, roads and packets sent, by kind.
    sent: BTreeMap<&'static str, u64>,
    refusals: Vec<Refusal>,
}

impl ObservationSender {
    async fn send(&mut self, kind: &'static str, count: u64, stamp_ns: i64, observation: Observation) -> Result<()> {
        let (started, first_ns) = *self.started.get_or_insert((Instant::now(), stamp_ns));
        if self.paced {
            let due = Duration::from_nanos(u64::try_from(stamp_ns.saturating_sub(first_ns)).unwrap_or(0));
            tokio::time::sleep(due.saturating_sub(started.elapsed())).await;
        }
        if let Err(error) = self.ingester.send(observation).await {
            for refusal in self.ingester.refusals() {
                eprintln!("refused {}: {}", refusal.reason, refusal.message);
            }
            bail!(error);
        }
        *self.sent.entry(kind).or_default() += count;
        self.refusals.extend(self.ingester.refusals());
        Ok(())
    }

    /// True if all that was sent was refused.
    fn is_all_refused(&self) -> bool {
        let [sent, refused] = [self.sent.values().sum::<u64>(), self.refusals.iter().map(|of| of.count).sum()];
        sent > 0 && refused >= sent
    }
}

fn report(sender: &ObservationSender, notes: &[String], as_json: bool) -> Result<()> {
    let reasons = clearway_client::observation::by_reason(&sender.refusals);
    if as_json {
        print_line(&json!({ "sent": sender.sent, "refused": reasons, "notes": notes }).to_string())?;
        return Ok(());
    }
    let sent = sender.sent.iter().map(|(kind, count)| counted(*count, kind.trim_end_matches('s')));
    let sent: Vec<String> = sent.collect();
    print_line(&format!("sent {}; the outcome of each is known", sent.join(", ")))?;
    for (reason, count) in &reasons {
        let first = sender.refusals.iter().find(|refusal| refusal.reason == **reason);
        print_line(&format!("refused {count}: {reason}: {}", first.map_or("", |refusal| &refusal.message)))?;
    }
    for note in notes {
        print_line(note)?;
    }
    Ok(())
}
