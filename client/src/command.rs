//! The subcommands, one file each, and what they share.

pub mod document;
pub mod export;
pub mod get;
pub mod info;
pub mod ingest;
pub mod network;
mod npy;
pub mod recording;
pub mod send;
pub mod vehicles;
pub mod watch;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};

/// Where a server listens unless told otherwise.
pub const SERVER: &str = "localhost:50051";

/// zenoh needs the multi-thread runtime.
pub fn block_on(work: impl Future<Output = Result<()>>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().context("start the runtime")?;
    runtime.block_on(work)
}

/// Progress through a file, on a terminal only.
pub fn progress_bar(length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg}").unwrap_or_else(|_| {
        // The template is a constant; the plain bar serves as well.
        ProgressStyle::default_bar()
    });
    // indicatif draws nothing where stderr is no terminal.
    ProgressBar::new(length).with_style(style)
}

/// Prints one line on stdout; a reader that has gone (`| head`) ends the command in peace.
pub fn say(line: &str) -> Result<bool> {
    use std::io::Write;
    match writeln!(std::io::stdout(), "{line}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error).context("write to stdout"),
    }
}
