//! The options of the bad network that `clearway send` simulates between a capture and a server.

use anyhow::Result;
use clap::Args;
use clearway_sim::impair::{Counts, Faults, Impairment};
use clearway_sim::vehicle::{Datagram, Kind};
use serde_json::{Value, json};

use super::udp;
use crate::cli::shared::output::{counted, usage_error};

/// Data packets from the beginning of one burst of losses to the next, on average; ours.
const PACKETS_PER_BURST: f64 = 200.0;

/// The options of the bad network.
#[derive(Args)]
#[command(next_help_heading = "Bad network (simulated)")]
pub struct NetworkOptions {
    /// Share of the datagrams to lose, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    loss: f64,
    /// Greatest number of data packets to lose in a row; about one packet in 200 begins such a burst.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    burst: u32,
    /// Share of the datagrams to send twice, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    duplicate: f64,
    /// Greatest number of data packets that overtake a late packet; one packet in four is late, and every copy.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    reorder: u32,
    /// Share of the datagrams to cut short, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    truncate: f64,
    /// Share of the datagrams in which to flip a bit, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    flip: f64,
    /// Greatest delay of a datagram, in milliseconds.
    #[arg(long, default_value = "0", value_name = "MS")]
    delay: u32,
    /// Seed of the random numbers; the same seed makes the same network. 0 if absent.
    #[arg(long)]
    seed: Option<u64>,
}

fn share(text: &str) -> Result<f64, String> {
    let percent = text.parse().ok().filter(|percent| (0.0..=100.0).contains(percent));
    percent.map(|percent: f64| percent / 100.0).ok_or_else(|| "0 to 100 percent is allowed".into())
}

impl NetworkOptions {
    /// The network of these options; `None` if it has no fault.
    ///
    /// # Errors
    /// If there is a seed and no fault that uses it.
    pub fn network(&self) -> Result<Option<Network>> {
        let seed = self.seed.unwrap_or(0);
        let faults = Faults {
            loss: self.loss,
            burst: if self.burst > 0 { 1.0 / PACKETS_PER_BURST } else { 0.0 },
            burst_packets: self.burst,
            duplicate: self.duplicate,
            reorder: self.reorder,
            truncate: self.truncate,
            flip: self.flip,
            delay_ns: i64::from(self.delay) * 1_000_000,
            seed,
        };
        let has_faults = faults != Faults { seed, ..Faults::default() };
        if self.seed.is_some() && !has_faults {
            return Err(usage_error("--seed needs a fault of the network that uses it, such as --loss 5"));
        }
        Ok(has_faults.then(|| Network(Impairment::new(faults))))
    }
}

/// A bad network, and the datagrams under way in it.
pub struct Network(Impairment);

impl Network {
    /// Sends a datagram into the network, and those that arrive to `sender`.
    ///
    /// # Errors
    /// As [`udp::Sender::send`].
    pub fn send(&mut self, sender: &mut udp::Sender, stamp_ns: i64, kind: udp::Kind, payload: &[u8]) -> Result<()> {
        let kind = match kind {
            udp::Kind::Data => Kind::Data,
            udp::Kind::Telemetry => Kind::Telemetry,
        };
        deliver(self.0.push(Datagram { stamp_ns, kind, payload: payload.to_vec() }), sender)
    }

    /// Sends the datagrams that are still under way to `sender`; returns what the network has done.
    ///
    /// # Errors
    /// As [`udp::Sender::send`].
    pub fn finish(mut self, sender: &mut udp::Sender) -> Result<Counts> {
        deliver(self.0.finish(), sender)?;
        Ok(self.0.counts())
    }
}

fn deliver(mut arriving: impl Iterator<Item = Datagram>, sender: &mut udp::Sender) -> Result<()> {
    arriving.try_for_each(|Datagram { stamp_ns, kind, payload }| {
        let kind = match kind {
            Kind::Data => udp::Kind::Data,
            Kind::Telemetry => udp::Kind::Telemetry,
        };
        sender.send(stamp_ns, kind, &payload)
    })
}

/// What the network has done, as JSON, to compare with a server's counters.
pub fn document(counts: &Counts) -> Value {
    json!({
        "taken": counts.sent, "arrived": counts.arrived, "packets_lost": counts.packets_lost, "gaps": counts.gaps,
        "telemetry_lost": counts.telemetry_lost, "duplicated": counts.duplicated, "reordered": counts.reordered,
        "truncated": counts.truncated, "flipped": counts.flipped,
    })
}

/// What the network has done, as a line of text.
pub fn line(counts: &Counts) -> String {
    let Counts { sent: taken, arrived, packets_lost, telemetry_lost, gaps, duplicated, reordered, truncated, flipped } =
        counts;
    let [taken, packets, telemetry, gaps] =
        [(taken, "datagram"), (packets_lost, "data packet"), (telemetry_lost, "telemetry datagram"), (gaps, "gap")]
            .map(|(count, noun)| counted(*count, noun));
    format!(
        "bad network: {taken} sent, {arrived} delivered: {packets} lost in {gaps}, {telemetry} lost, {duplicated} \
         delivered twice, {reordered} late, {truncated} cut short, {flipped} with a flipped bit"
    )
}
