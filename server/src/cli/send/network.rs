//! The options of the bad network that `clearway send` simulates between a capture and a server.

use anyhow::Result;
use clap::Args;
use clearway_sim::impair::{Counts, Faults, Impairment};
use clearway_sim::vehicle::{Datagram, Kind};
use serde_json::{Value, json};

use super::udp;

/// Data packets from the beginning of one burst of losses to the next, on average; ours.
const PACKETS_PER_BURST: f64 = 200.0;

/// The options of the bad network.
#[derive(Args)]
#[command(next_help_heading = "Bad network (simulated)")]
pub struct NetworkOptions {
    /// Share of the datagrams to lose, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    loss: f64,
    /// Most data packets to lose in a row; about one packet in 200 begins such a burst.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    burst: u32,
    /// Share of the datagrams to send twice, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    duplicate: f64,
    /// Most data packets by which a packet is late; one packet in four and every copy is.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    reorder: u32,
    /// Share of the datagrams to cut short, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    truncate: f64,
    /// Share of the datagrams in which to flip a bit, in percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    flip: f64,
    /// Most milliseconds by which each datagram is delayed.
    #[arg(long, default_value = "0", value_name = "MS")]
    delay: u32,
    /// Seed of the random numbers; the same seed makes the same network.
    #[arg(long, default_value = "0")]
    seed: u64,
}

fn share(text: &str) -> Result<f64, String> {
    let percent = text.parse().ok().filter(|percent| (0.0..=100.0).contains(percent));
    percent.map(|percent: f64| percent / 100.0).ok_or_else(|| "0 to 100 percent is allowed".into())
}

impl NetworkOptions {
    /// The network of these options; `None` if it has no fault.
    pub fn network(&self) -> Option<Network> {
        let faults = Faults {
            loss: self.loss,
            burst: if self.burst > 0 { 1.0 / PACKETS_PER_BURST } else { 0.0 },
            burst_packets: self.burst,
            duplicate: self.duplicate,
            reorder: self.reorder,
            truncate: self.truncate,
            flip: self.flip,
            delay_ns: i64::from(self.delay) * 1_000_000,
            seed: self.seed,
        };
        (faults != Faults { seed: self.seed, ..Faults::default() }).then(|| Network(Impairment::new(faults)))
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
    format!(
        "bad network: {taken} datagrams sent, {arrived} delivered: {packets_lost} data packets lost in {gaps} gaps, \
         {telemetry_lost} telemetry datagrams lost, {duplicated} delivered twice, {reordered} late, {truncated} cut \
         short, {flipped} with a flipped bit"
    )
}
