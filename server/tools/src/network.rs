//! A text of the command line -> the faults of a bad network; what the network did -> text and JSON.

use clearway_journal::counted::counted;
use clearway_sim::impair::Counts;
use serde_json::{Value, json};

pub use clearway_sim::impair::Faults;

/// Data packets from the beginning of one burst of losses to the next, on average; ours.
const PACKETS_PER_BURST: f64 = 200.0;

/// Reads faults such as `loss=5,reorder=8,seed=7`.
///
/// # Errors
/// The fault that is wrong, and what is allowed.
pub fn faults(text: &str) -> Result<Faults, String> {
    let mut faults = Faults::default();
    for fault in text.split(',') {
        let (name, value) = fault.split_once('=').ok_or_else(|| format!("{fault:?}: NAME=VALUE is allowed"))?;
        let percent = || {
            let percent = value.parse().ok().filter(|percent| (0.0..=100.0).contains(percent));
            percent.map(|percent: f64| percent / 100.0).ok_or_else(|| format!("{fault}: 0 to 100 percent is allowed"))
        };
        let count = || value.parse::<u32>().map_err(|_| format!("{fault}: a whole number from 0 on is allowed"));
        match name {
            "loss" => faults.loss = percent()?,
            "duplicate" => faults.duplicate = percent()?,
            "truncate" => faults.truncate = percent()?,
            "flip" => faults.flip = percent()?,
            "reorder" => faults.reorder = count()?,
            "delay_ms" => faults.delay_ns = i64::from(count()?) * 1_000_000,
            "seed" => faults.seed = count()?.into(),
            "burst" => {
                faults.burst_packets = count()?;
                faults.burst = if faults.burst_packets > 0 { 1.0 / PACKETS_PER_BURST } else { 0.0 };
            }
            _ => {
                let allowed = "loss, burst, duplicate, reorder, truncate, flip, delay_ms, seed";
                return Err(format!("{name:?}: allowed are {allowed}"));
            }
        }
    }
    match faults == (Faults { seed: faults.seed, ..Faults::default() }) {
        true => Err("a fault of the network is needed, such as loss=5".into()),
        false => Ok(faults),
    }
}

/// What the network did, as JSON, to compare with a server's counters.
pub fn document(counts: &Counts) -> Value {
    json!({
        "taken": counts.sent, "arrived": counts.arrived, "packets_lost": counts.packets_lost, "gaps": counts.gaps,
        "telemetry_lost": counts.telemetry_lost, "duplicated": counts.duplicated, "reordered": counts.reordered,
        "truncated": counts.truncated, "flipped": counts.flipped,
    })
}

/// What the network did, as a line of text.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_read_and_wrong_ones_are_named_with_what_is_allowed() {
        let read = faults("loss=5,burst=3,delay_ms=2,seed=7").unwrap();
        assert_eq!((read.loss, read.burst_packets, read.delay_ns, read.seed), (0.05, 3, 2_000_000, 7));
        for (text, error) in [
            ("loss=101", "loss=101: 0 to 100 percent is allowed"),
            ("loss=", "0 to 100 percent is allowed"),
            ("reorder=-1", "a whole number from 0 on is allowed"),
            ("loss", "NAME=VALUE is allowed"),
            ("jitter=5", "allowed are loss, burst"),
            ("seed=7", "a fault of the network is needed"),
        ] {
            assert!(faults(text).unwrap_err().contains(error), "{text}");
        }
    }
}
