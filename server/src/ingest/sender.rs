//! What is planned -> a server, at the recorded pace or as fast as it accepts.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clearway_client::{Ingester, Observation, Refusal};

use super::packets::PacketGroups;
use super::plan::IngestPlan;

/// What was sent, and what became of it.
#[derive(Default)]
pub struct SentObservations {
    /// Number of scans, poses, roads and packets sent, by kind.
    pub counts: BTreeMap<&'static str, u64>,
    pub refusals: Vec<Refusal>,
    /// What is left out of the files, and why.
    pub notes: Vec<String>,
}

impl SentObservations {
    /// True if all that was sent was refused.
    pub fn is_all_refused(&self) -> bool {
        let [sent, refused] = [self.counts.values().sum::<u64>(), self.refusals.iter().map(|of| of.count).sum()];
        sent > 0 && refused >= sent
    }
}

/// A stream of observations to a server.
struct ObservationSender {
    ingester: Ingester,
    /// True if each observation is sent at the time of its stamp.
    is_paced: bool,
    /// When the first observation was sent, and its stamp.
    started: Option<(Instant, i64)>,
    sent: SentObservations,
}

/// Sends the observations of a plan, its scans and drives as readings of `sensor`; returns when the outcome of each is
/// known.
///
/// # Errors
/// If a file cannot be read, or the server ends the stream.
pub async fn send(plan: IngestPlan, ingester: Ingester, sensor: &str, is_paced: bool) -> Result<SentObservations> {
    let sent = SentObservations { notes: plan.notes, ..SentObservations::default() };
    let mut sender = ObservationSender { ingester, is_paced, started: None, sent };
    for (stamp_ns, item) in &plan.items {
        let (kind, observation) = item.read(sensor, *stamp_ns)?;
        sender.send(kind, 1, *stamp_ns, observation).await?;
    }
    for file in &plan.drives {
        let mut groups = PacketGroups::open(file)?;
        for group in groups.by_ref() {
            let packets = group.with_context(|| file.display().to_string())?;
            let stamp_ns = packets.last().map_or(0, |(stamp_ns, _)| *stamp_ns);
            let observation = Observation::packets(sensor, &packets);
            sender.send("packets", packets.len() as u64, stamp_ns, observation).await?;
        }
        sender.sent.notes.extend(groups.notes().into_iter().map(|note| format!("{}: {note}", file.display())));
    }
    sender.sent.refusals.extend(sender.ingester.settled().await?);
    Ok(sender.sent)
}

impl ObservationSender {
    async fn send(&mut self, kind: &'static str, count: u64, stamp_ns: i64, observation: Observation) -> Result<()> {
        let (started, first_ns) = *self.started.get_or_insert((Instant::now(), stamp_ns));
        if self.is_paced {
            let due = Duration::from_nanos(u64::try_from(stamp_ns.saturating_sub(first_ns)).unwrap_or(0));
            tokio::time::sleep(due.saturating_sub(started.elapsed())).await;
        }
        if let Err(error) = self.ingester.send(observation).await {
            for refusal in self.ingester.refusals() {
                eprintln!("refused {}: {}", refusal.reason, refusal.message);
            }
            bail!(error);
        }
        *self.sent.counts.entry(kind).or_default() += count;
        self.sent.refusals.extend(self.ingester.refusals());
        Ok(())
    }
}
