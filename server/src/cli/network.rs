//! The bad network that `clearway send` can put between a capture and a server: options -> faults, counts -> text.

use clap::Args;
use clearway_sim::impair::{Counts, Faults};
use serde_json::{Value, json};

/// One packet in so many begins a burst, where there are bursts.
const PACKETS_A_BURST: f64 = 200.0;

/// What the network does to the datagrams on their way.
#[derive(Args)]
pub struct Network {
    /// Share of the datagrams to lose, percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    loss: f64,
    /// Also lose up to this many data packets in a row, about once in 200.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    burst: u32,
    /// Share to send twice, percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    duplicate: f64,
    /// Send one data packet in four, and every copy, up to this many data packets late.
    #[arg(long, default_value = "0", value_name = "PACKETS")]
    reorder: u32,
    /// Share to cut short, percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    truncate: f64,
    /// Share in which to flip a bit, percent.
    #[arg(long, default_value = "0", value_name = "PERCENT", value_parser = share)]
    flip: f64,
    /// Delay each by up to this, milliseconds.
    #[arg(long, default_value = "0", value_name = "MS")]
    delay: u32,
    /// The same seed does the same.
    #[arg(long, default_value = "0")]
    seed: u64,
}

fn share(text: &str) -> Result<f64, String> {
    let percent = text.parse().ok().filter(|percent| (0.0..=100.0).contains(percent));
    percent.map(|percent: f64| percent / 100.0).ok_or_else(|| "0 to 100 percent is allowed".into())
}

impl Network {
    /// What was asked for; `None`: nothing.
    pub fn faults(&self) -> Option<Faults> {
        let faults = Faults {
            loss: self.loss,
            burst: if self.burst > 0 { 1.0 / PACKETS_A_BURST } else { 0.0 },
            burst_packets: self.burst,
            duplicate: self.duplicate,
            reorder: self.reorder,
            truncate: self.truncate,
            flip: self.flip,
            delay_ns: i64::from(self.delay) * 1_000_000,
            seed: self.seed,
        };
        (faults != Faults { seed: self.seed, ..Faults::default() }).then_some(faults)
    }
}

/// What was done, for a server's ledger to be held against.
pub fn document(counts: &Counts) -> Value {
    json!({
        "taken": counts.sent, "arrived": counts.arrived, "packets_lost": counts.packets_lost, "gaps": counts.gaps,
        "telemetry_lost": counts.telemetry_lost, "duplicated": counts.duplicated, "reordered": counts.reordered,
        "truncated": counts.truncated, "flipped": counts.flipped,
    })
}

/// The same as a line.
pub fn line(counts: &Counts) -> String {
    let Counts { sent: taken, arrived, packets_lost, telemetry_lost, gaps, duplicated, reordered, truncated, flipped } =
        counts;
    format!(
        "the network took {taken} and delivered {arrived}: {packets_lost} data packets lost in {gaps} gaps, {telemetry_lost} \
         telemetry datagrams lost, {duplicated} delivered twice, {reordered} late, {truncated} cut short, {flipped} with a \
         bit flipped"
    )
}
