//! Files -> observations -> a server: drives as tunnelled packets, scans, poses, roads.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::{Ingester, Observation, Refusal};
use serde_json::json;

use super::{Server, say};

mod files;

/// Send scans (KITTI .bin, .pcd), ego poses (.tum: "seconds x y z qx qy qz qw" lines), roads (.rddf, .rndf) and drives
/// (.pcap, .pcapng, as tunnelled packets with their own stamps) to a server, which says what it refused.
#[derive(Args)]
pub struct Options {
    /// The files. Scans are stamped as the poses are, one each, or from now on at --hz where there are none.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    #[command(flatten)]
    server: Server,
    /// Over zenoh instead, by this endpoint, such as tcp/localhost:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "address")]
    zenoh: Option<String>,
    /// The vehicle; over zenoh, and where there are several, it must be given.
    #[arg(long, default_value = "")]
    vehicle: String,
    /// Whose scans or packets; over zenoh, and where there are several, it must be given.
    #[arg(long, default_value = "")]
    sensor: String,
    /// Scans a second, where no poses stamp them.
    #[arg(long, default_value_t = 10.0, value_parser = hz)]
    hz: f64,
    /// Place on Earth that is 0, 0 of the map frame, for roads; their first point unless given.
    #[arg(long, value_name = "LATITUDE,LONGITUDE", allow_hyphen_values = true, value_parser = origin)]
    origin: Option<[f64; 2]>,
    /// The lane of an .rndf that is painted; the first unless given.
    #[arg(long, value_name = "SEGMENT.LANE")]
    lane: Option<String>,
    /// As fast as the server takes it, instead of at the recorded pace.
    #[arg(long)]
    fast: bool,
    /// Print one JSON object at the end.
    #[arg(long)]
    json: bool,
}

fn hz(text: &str) -> Result<f64, String> {
    let found = text.parse().ok().filter(|hz| (0.1..=100.0).contains(hz));
    found.ok_or_else(|| "0.1 to 100 is allowed".into())
}

fn origin(text: &str) -> Result<[f64; 2], String> {
    let parts = text.split_once(',').map(|(latitude, longitude)| (latitude.trim().parse(), longitude.trim().parse()));
    match parts {
        Some((Ok(latitude), Ok(longitude)))
            if (-90.0..=90.0).contains(&latitude) && (-180.0..=180.0).contains(&longitude) =>
        {
            Ok([latitude, longitude])
        }
        _ => Err("two numbers of degrees are needed, such as 30.39,-97.73".into()),
    }
}

/// Sends.
///
/// # Errors
/// What cannot be read, and what the server or the transport says; a refusal is no error, but is said.
pub async fn run(options: Options) -> Result<()> {
    let plan = files::Plan::of(&options)?;
    let ingester = match &options.zenoh {
        Some(endpoint) => over_zenoh(endpoint, &options.vehicle).await?,
        None => options.server.connect().await?.ingest(&options.vehicle).await?,
    };
    let mut sender =
        Sender { ingester, paced: !options.fast, begun: None, sent: BTreeMap::new(), refusals: Vec::new() };
    for (stamp_ns, item) in &plan.items {
        let (kind, observation) = item.read(&options.sensor, *stamp_ns)?;
        sender.send(kind, *stamp_ns, observation).await?;
    }
    for file in &plan.drives {
        for chunk in files::chunks(file)? {
            let packets = chunk.with_context(|| file.display().to_string())?;
            let stamp_ns = packets.last().map_or(0, |(stamp_ns, _)| *stamp_ns);
            sender.send("packets", stamp_ns, Observation::packets(&options.sensor, &packets)).await?;
        }
    }
    sender.refusals.extend(sender.ingester.settled().await?);
    report(&sender, &plan.notes, options.json)
}

#[cfg(feature = "zenoh")]
async fn over_zenoh(endpoint: &str, vehicle: &str) -> Result<Ingester> {
    Ok(clearway_client::ZenohClient::connect(endpoint).await?.ingest(vehicle).await?)
}

#[cfg(not(feature = "zenoh"))]
async fn over_zenoh(endpoint: &str, _: &str) -> Result<Ingester> {
    bail!("--zenoh {endpoint}: this clearway was built without zenoh")
}

struct Sender {
    ingester: Ingester,
    paced: bool,
    /// When the first observation went, and its stamp.
    begun: Option<(Instant, i64)>,
    sent: BTreeMap<&'static str, u64>,
    refusals: Vec<Refusal>,
}

impl Sender {
    async fn send(&mut self, kind: &'static str, stamp_ns: i64, observation: Observation) -> Result<()> {
        let (begun, first_ns) = *self.begun.get_or_insert((Instant::now(), stamp_ns));
        if self.paced {
            let due = Duration::from_nanos(u64::try_from(stamp_ns.saturating_sub(first_ns)).unwrap_or(0));
            tokio::time::sleep(due.saturating_sub(begun.elapsed())).await;
        }
        if let Err(error) = self.ingester.send(observation).await {
            let told = self.ingester.refusals();
            told.iter().for_each(|refusal| eprintln!("refused {}: {}", refusal.reason, refusal.message));
            bail!(error);
        }
        *self.sent.entry(kind).or_default() += 1;
        self.refusals.extend(self.ingester.refusals());
        Ok(())
    }
}

fn report(sender: &Sender, notes: &[String], as_json: bool) -> Result<()> {
    let reasons = clearway_client::observation::by_reason(&sender.refusals);
    if as_json {
        say(&json!({ "sent": sender.sent, "refused": reasons, "notes": notes }).to_string())?;
        return Ok(());
    }
    let sent: Vec<String> = sender.sent.iter().map(|(kind, n)| format!("{n} {kind}")).collect();
    say(&format!("sent {}; every one was acknowledged", sent.join(", ")))?;
    for (reason, count) in &reasons {
        let first = sender.refusals.iter().find(|refusal| refusal.reason == **reason);
        say(&format!("refused {count}: {reason}: {}", first.map_or("", |refusal| &refusal.message)))?;
    }
    for note in notes {
        say(note)?;
    }
    Ok(())
}
