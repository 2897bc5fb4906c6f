//! `clearway repair`: a damaged recording -> a whole recording of all that can be read, and a report of the rest.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::terminal::{Exit, counted, print_line};
use clearway_journal::repair::repair;

/// Write all that can be read of a damaged MCAP file to a new one, and report what is lost.
///
/// The file that is read stays as it is; the file that is written must not exist. It is read again before the command
/// ends.
#[derive(Args)]
#[command(
    after_help = "Exit codes: 0 nothing is lost, 1 the new file lacks what is lost or may have changed, 2 no message can \
    be read and no file is written, 3 wrong use.

Example:
  clearway repair damaged.mcap repaired.mcap"
)]
pub struct RepairArguments {
    /// The damaged file: MCAP of any program, or a ROS 2 bag in sqlite.
    input: PathBuf,
    /// The new file.
    output: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Repairs the file and prints what is lost.
pub fn run(options: &RepairArguments) -> Result<Exit> {
    let report = repair(&options.input, &options.output)?;
    if options.json {
        print_line(&format!("{:#}", report.to_json()))?;
    } else {
        let messages = counted(report.messages, "message");
        print_line(&format!("{} has {messages} of {}", options.output.display(), options.input.display()))?;
        for damage in &report.damages {
            let effect = match (damage.is_loss, report.has_all_records) {
                (false, _) => "damaged, and nothing is lost",
                (true, true) => "changed, and no record is lost",
                (true, false) => "lost",
            };
            print_line(&format!("{effect}: {damage}"))?;
        }
        if let Some(incomplete) = &report.incomplete {
            print_line(&format!("{} is not whole: {incomplete}", options.input.display()))?;
        }
        if report.lacks_config {
            let new = options.output.display();
            print_line(&format!("{new} has no configuration, so verify cannot make its maps again"))?;
        }
    }
    Ok(if report.is_loss { Exit::Differs } else { Exit::Good })
}
