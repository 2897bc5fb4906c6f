//! `clearway view`: recorded drives on the page, paused, to step through.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::cli::replay;
use crate::cli::shared::exit::Exit;

/// Look at recorded drives on the page: paused, with a time bar, a step and all layers.
///
/// Replays the files as recorded on free ports of this machine, and prints the address of the page. The keys of
/// `clearway replay` work too.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway view drive.mcap
  clearway view drive.mcap --from 12.5 --open")]
pub struct Options {
    /// Recordings, captures, or folders of them, as of `clearway replay`.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Stand at this many seconds after the first event; the whole drive is in the time bar.
    #[arg(long, value_name = "SECONDS", value_parser = replay::options::offset)]
    from: Option<f64>,
    /// Open the page with the browser of the desktop (xdg-open).
    #[arg(long)]
    open: bool,
}

/// Serves the page until a signal or the key q.
///
/// # Errors
/// [`replay::ReplayError`].
pub fn run(options: Options) -> Result<Exit> {
    let Options { files, from, open } = options;
    let replayed =
        replay::Options { files, seek: from, serve: true, any_port: true, paused: true, ..replay::Options::default() };
    replay::view(replayed, open)
}
