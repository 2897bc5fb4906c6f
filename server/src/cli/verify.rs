//! `clearway verify`: a recording -> whether each of its maps is the map of its events.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::Args;

use super::output::{counted, print_line};
use crate::record::verify::verify;

/// Compute every map of a recording again from its events, and name the first differences.
#[derive(Args)]
#[command(after_help = "Exit codes: 0 all maps are equal, 1 a map differs or the file cannot be read, 2 wrong usage.

Example:
  clearway replay drive.pcap --record drive.mcap
  clearway verify drive.mcap")]
pub struct Options {
    /// The recording (MCAP).
    file: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Prints what differs; the exit code is 1 if anything does.
///
/// # Errors
/// [`VerifyError`](crate::record::verify::VerifyError) if the recording cannot be read or its maps cannot be made.
pub fn run(options: &Options) -> Result<ExitCode> {
    let report = verify(&options.file)?;
    if options.json {
        print_line(&format!("{:#}", report.to_json()))?;
    } else {
        let file = options.file.display();
        let cut = if report.cut { "; the file is cut off, as after a crash, and this is all it holds" } else { "" };
        let [events, maps, equal] = [(report.events, "event"), (report.maps, "map"), (report.equal, "layer")]
            .map(|(count, noun)| counted(count, noun));
        let counts = format!("{events}, {maps}, {equal} equal{cut}");
        if report.is_good() {
            print_line(&format!("{file}: every map is the map of its events: {counts}"))?;
        } else {
            print_line(&format!("{file}: {}: {counts}", counted(report.different, "difference")))?;
            for difference in &report.differences {
                print_line(&difference.to_string())?;
            }
        }
    }
    Ok(if report.is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
