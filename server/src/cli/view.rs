//! `clearway view`: recorded drives on the page, paused, to step through.

use std::path::PathBuf;
use std::process::Command;

use anyhow::Result;
use clap::Args;
use clearway_proto::v1::ReplayControl;
use clearway_replay::{ReplayOptions, ReplayRun, ServedReplay, describe};

use crate::arguments::values::offset;
use crate::process::stop_signal;
use crate::terminal::{Exit, print_line, printable};

/// Look at recorded drives on the page: paused at the first map, with a time bar, a step and all layers.
///
/// Replays the files as recorded on free ports of this machine, and prints the address of the page. `clearway
/// transport` works too.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway view drive.mcap
  clearway view drive.mcap --from 12.5 --open")]
pub struct ViewArguments {
    /// Recordings, captures, or folders of them, as of `clearway replay`.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Stand at this many seconds after the first event; the whole drive is in the time bar.
    #[arg(long, value_name = "SECONDS", value_parser = offset)]
    from: Option<f64>,
    /// Open the page with the browser of the desktop (xdg-open).
    #[arg(long)]
    open: bool,
}

/// Serves the page until a signal.
pub async fn run(arguments: ViewArguments) -> Result<Exit> {
    let ViewArguments { files, from: seek_s, open } = arguments;
    let served = ServedReplay { seek_s, any_port: true, paused: true, ..ServedReplay::default() };
    let options = ReplayOptions { files, served: Some(served), ..ReplayOptions::default() };
    let stop = stop_signal()?;
    let replay = ReplayRun::start(options).await?;
    if let Some(description) = describe(replay.mount()) {
        eprintln!("extrinsics {description}");
    }
    if let Some(page) = replay.running.page.map(|at| format!("http://{at}/")) {
        print_line(&page)?;
        if open && let Err(error) = Command::new("xdg-open").arg(&page).spawn() {
            tracing::warn!(%error, "xdg-open");
        }
    }
    let handle = replay.handle();
    let first_maps = async {
        if seek_s.is_none() {
            let step = u32::try_from(handle.state().borrow().vehicles.len()).ok();
            // Fails if the replay ends before.
            let _ = handle.control(ReplayControl { step, ..ReplayControl::default() }).await;
        }
    };
    let summary = tokio::join!(replay.play(stop), first_maps).0?;
    summary.remarks().iter().for_each(|remark| eprintln!("{}", printable(remark)));
    Ok(Exit::from_incomplete(!summary.truncated.is_empty()))
}
