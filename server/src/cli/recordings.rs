//! `clearway recordings`: a store and a search -> the parts that it finds, copied if wanted.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::UNIX_EPOCH;

use anyhow::{Context, Error, Result};
use clap::Args;
use serde_json::json;
use tempfile::NamedTempFile;

use crate::terminal::{Exit, counted, print_line};
use clearway_daemon::store::fetch::copy;
use clearway_daemon::store::index::{Entry, Found, Search, search};
use clearway_daemon::store::location;
use clearway_daemon::store::upload::reason;
use clearway_journal::damage::utc;

/// Find recordings in a store by vehicle, time, place and faults, and fetch them.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway recordings --store /mnt/archive
  clearway recordings --store s3://fleet/clearway --vehicle car --from 2026-01-01T12:00:00Z --near 120,-35
  clearway recordings --store /mnt/archive --vehicle car --faults --out incident")]
pub struct RecordingsArguments {
    /// The store: a folder, also as file:///FOLDER, or s3://BUCKET/PREFIX with the environment variables of the AWS
    /// tools.
    #[arg(long, value_name = "URL", env = "CLEARWAY_STORE")]
    store: String,
    /// Only this vehicle.
    #[arg(long, value_name = "NAME")]
    vehicle: Option<String>,
    /// Only parts that do not end before this time, such as 2026-01-01T12:00:00Z.
    #[arg(long, value_name = "TIME", value_parser = time_ns)]
    from: Option<u64>,
    /// Only parts that do not begin after this time.
    #[arg(long, value_name = "TIME", value_parser = time_ns)]
    to: Option<u64>,
    /// Only parts in which the vehicle was near this place: x,y in metres in the frame of its map.
    #[arg(long, value_name = "X,Y", value_parser = place)]
    near: Option<(f64, f64)>,
    /// Greatest distance from --near, in metres.
    #[arg(long, value_name = "METRES", default_value_t = 50.0, requires = "near")]
    within: f64,
    /// Only parts with a fault.
    #[arg(long)]
    faults: bool,
    /// Fetch the parts that are found into this folder; a file that is there already is not overwritten.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Print one JSON array.
    #[arg(long)]
    json: bool,
}

/// Searches, fetches if wanted, and prints what is found.
pub async fn run(options: &RecordingsArguments) -> Result<Exit> {
    let wanted = Search {
        vehicle: options.vehicle.clone(),
        from_ns: options.from,
        to_ns: options.to,
        near: options.near.map(|(x, y)| (x, y, options.within)),
        with_faults: options.faults,
    };
    let store = location::open_existing(&options.store)?;
    let of_store = |error| Error::msg(format!("store {}: {}", options.store, reason(&error)));
    let Found { entries, without_place, unreadable } = search(&*store, &wanted).await.map_err(of_store)?;
    if let Some(folder) = &options.out {
        std::fs::create_dir_all(folder).with_context(|| format!("create the folder {}", folder.display()))?;
        // A part has an entry for each vehicle.
        let parts: BTreeSet<_> = entries.iter().map(|entry| entry.part.as_str()).collect();
        for part in parts {
            let file = folder.join(part.rsplit('/').next().unwrap_or(part));
            let mut unfinished = NamedTempFile::new_in(folder)?;
            copy(&*store, &part.into(), &mut unfinished)
                .await
                .with_context(|| format!("fetch {part} to {}", file.display()))?;
            unfinished.persist_noclobber(&file).with_context(|| format!("write {}", file.display()))?;
        }
    }
    if options.json {
        let found = json!({ "parts": entries, "without_place": without_place, "unreadable": unreadable });
        print_line(&format!("{found:#}"))?;
    } else {
        for entry in &entries {
            print_line(&line(entry))?;
        }
        print_line(&format!("{} found", counted(entries.len() as u64, "part")))?;
    }
    if without_place > 0 {
        let parts = counted(without_place, "part");
        eprintln!("clearway: {parts} left out that may be near: where the vehicle was is not known, for lack of poses");
    }
    for (name, reason) in &unreadable {
        eprintln!("clearway: {name} is no entry of the index: {reason}");
    }
    Ok(Exit::from_incomplete(!unreadable.is_empty()))
}

fn line(entry: &Entry) -> String {
    let list = |names: &BTreeSet<String>| names.iter().cloned().collect::<Vec<_>>().join(", ");
    let faults = if entry.faults.is_empty() { String::new() } else { format!("; FAULTS: {}", list(&entry.faults)) };
    format!(
        "{}: {}, {} to {}, {}, sensors {}{faults}",
        entry.part,
        entry.vehicle,
        utc(entry.from_ns),
        utc(entry.to_ns),
        counted(entry.bytes, "byte"),
        list(&entry.sensors)
    )
}

/// A time such as `2026-01-01T12:00:00Z`, as ns since the Unix epoch.
fn time_ns(text: &str) -> Result<u64, String> {
    let time = humantime::parse_rfc3339(text).ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let ns = time.and_then(|since| u64::try_from(since.as_nanos()).ok());
    ns.ok_or_else(|| "a time such as 2026-01-01T12:00:00Z, of 1970 or later, is allowed".to_owned())
}

fn place(text: &str) -> Result<(f64, f64), String> {
    let numbers = text.split_once(',').and_then(|(x, y)| Some((x.trim().parse().ok()?, y.trim().parse().ok()?)));
    numbers.ok_or_else(|| "two numbers are needed: x,y in metres".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_read_in_utc() {
        assert_eq!(time_ns("1970-01-01T00:00:00Z"), Ok(0));
        assert_eq!(time_ns("2026-01-01T12:00:00Z"), Ok(1_767_268_800_000_000_000));
        assert_eq!(time_ns("2024-02-29T12:00:00.5Z"), Ok(1_709_208_000_500_000_000));
        for wrong in ["", "2026-01-01", "12:00:00Z", "2026-01-01T12:00:00", "1969-12-31T23:59:59Z"] {
            assert!(time_ns(wrong).is_err(), "{wrong}");
        }
    }
}
