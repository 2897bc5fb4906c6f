//! `clearway verify`: a recording -> whether each of its maps is the map of its events.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;

use super::exit::Exit;
use super::output::{counted, print_line};
use crate::record::verify::{Report, verify};

/// Compute every map of a recording again from its events, and name the first differences.
#[derive(Args)]
#[command(
    after_help = "Exit codes: 0 all maps are equal, 1 a map differs, 2 the file cannot be read, is not whole or has no event, 3 wrong use.

Example:
  clearway replay drive.pcap --record drive.mcap
  clearway verify drive.mcap"
)]
pub struct Options {
    /// The recording (MCAP).
    file: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Prints what differs and what is damaged.
///
/// # Errors
/// [`VerifyError`](crate::record::verify::VerifyError) if the recording cannot be read or its maps cannot be made.
pub fn run(options: &Options) -> Result<Exit> {
    let report = verify(&options.file)?;
    if options.json {
        print_line(&format!("{:#}", report.to_json()))?;
    } else {
        for line in lines(&report, &options.file) {
            print_line(&line)?;
        }
    }
    Ok(match () {
        () if report.different > 0 => Exit::Differs,
        () => Exit::from_incomplete(!report.is_good() || report.incomplete.is_some()),
    })
}

fn lines(report: &Report, file: &Path) -> Vec<String> {
    let file = file.display();
    let [events, maps, equal] = [(report.events, "event"), (report.maps, "map"), (report.equal, "layer")]
        .map(|(count, noun)| counted(count, noun));
    let unjudged = match report.unjudged {
        0 => String::new(),
        layers => format!(", {} after missing events cannot be judged", counted(layers, "layer")),
    };
    let counts = format!("{events}, {maps}, {equal} equal{unjudged}");
    let result = match report.different {
        0 if report.events == 0 => "no event, so nothing is verified".to_owned(),
        0 if report.incomplete.is_some() => "every readable map is the map of its events".to_owned(),
        0 => "every map is the map of its events".to_owned(),
        different => counted(different, "difference"),
    };
    let mut lines = vec![format!("{file}: {result}: {counts}")];
    lines.extend(report.differences.iter().map(ToString::to_string));
    lines.extend(report.incomplete.iter().map(|incomplete| format!("the file is {incomplete}")));
    lines
}
