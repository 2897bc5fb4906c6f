//! `clearway verify`: recordings -> whether each of their maps is the map of its events, or what a change of the
//! configuration or of the program changed in them.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::terminal::{Exit, print, print_line, printable};
use crate::verify::checked::{Check, Checked, NewConfig, check_all};
use crate::verify::files::{Shard, find};
use crate::verify::{report, table};
use clearway_daemon::base::files;

/// Compute every map of recordings again from their events, and name the first differences.
///
/// Or compare their maps with the maps of another configuration or recording.
#[derive(Args)]
#[command(
    after_help = "Exit codes: 0 all maps are equal, 1 a map differs, 2 a file cannot be checked, is not whole, has
no event, has maps of which none can be judged, or is another drive than that of --against or has no map in common
with it, 3 wrong use. A file in which no map is recorded, or whose events make none, is no fault; its line says so.

Examples:
  clearway verify drive.mcap
  clearway verify 'drives/**/*.mcap' --junit verify.xml
  clearway verify drives --shard 2/5 --json
  clearway verify s3://fleet/clearway/parts --shard 2/5
  clearway verify drives --config new.toml
  clearway verify drive.mcap --set vehicle.maps.reach.vehicle_width_m=2.5
  clearway verify before.mcap --against after.mcap"
)]
pub struct VerifyArguments {
    /// Recordings (MCAP), folders of them, patterns in quotes, such as 'drives/**/*.mcap', or URLs of a store or of a
    /// recording in it, such as s3://BUCKET/PREFIX.
    #[arg(required = true, value_name = "FILES")]
    files: Vec<String>,
    /// Check part I of N of the files: every N-th of the sorted list, from the I-th on. All parts together are all
    /// files; a part without files is no error.
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Write the results to this file as JUnit XML, with one test case for each recording.
    #[arg(long, value_name = "FILE.xml")]
    junit: Option<PathBuf>,
    #[command(flatten)]
    change: ChangeArguments,
}

/// The options that compare the recorded maps with others.
#[derive(Args)]
#[command(next_help_heading = "Compare a change")]
struct ChangeArguments {
    /// Compare the recorded maps with the maps that this configuration makes of the recorded events.
    #[arg(long, value_name = "NEW.toml", conflicts_with = "against")]
    config: Option<PathBuf>,
    /// Override a key of that configuration, or of the recorded one; may be given several times.
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "against")]
    set: Vec<String>,
    /// Compare the maps with the maps of this recording of the same drive.
    #[arg(long, value_name = "OTHER.mcap")]
    against: Option<PathBuf>,
}

impl ChangeArguments {
    fn check(&self) -> Result<Check> {
        Ok(match (&self.config, &self.against) {
            (_, Some(other)) => Check::Against(other.clone()),
            (None, None) if self.set.is_empty() => Check::Verify,
            (config, None) => {
                let config = config.as_ref().map(|file| NewConfig::load(file, &self.set)).transpose()?;
                Check::Config { config: config.map(Box::new), set: self.set.clone() }
            }
        })
    }
}

/// Checks the files and prints the results. The exit code is 2 if a file cannot be checked as a whole, else 1 if a map
/// differs.
pub fn run(options: &VerifyArguments) -> Result<Exit> {
    let check = options.change.check()?;
    options.junit.as_deref().map_or(Ok(()), report::check_junit)?;
    let results = match find(&options.files, options.shard) {
        Ok(files) => check_all(&files, &check),
        // In the reports too: a machine that collects them has to find the reason.
        Err(error) => vec![Checked::not_found(&options.files, format!("{error:#}"))],
    };
    if let Some(file) = &options.junit {
        files::write(file, report::junit(&results).as_bytes())?;
    }
    let reasons: Vec<&String> = results.iter().filter_map(Checked::not_checked).collect();
    let different: BTreeSet<&String> = reasons.iter().copied().collect();
    different.iter().for_each(|reason| eprintln!("clearway: {}", printable(reason)));
    // One mistake of the command line: the table would say nothing but the same.
    let is_one_mistake = different.len() == 1 && reasons.len() == results.len();
    if options.json {
        print_line(&format!("{:#}", report::json(&results)))?;
    } else if !is_one_mistake {
        print(&table::text(&results, &check))?;
    }
    Ok(exit(&results))
}

fn exit(results: &[Checked]) -> Exit {
    let has = |exit: Exit| results.iter().any(|result| result.exit() == exit);
    match () {
        () if has(Exit::Unreadable) => Exit::Unreadable,
        () if has(Exit::Differs) => Exit::Differs,
        () => Exit::Good,
    }
}
