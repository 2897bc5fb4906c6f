//! `clearway upload`: a folder of finished recordings -> a store, confirmed part by part.

use std::path::PathBuf;

use anyhow::{Context, Result, anyhow};
use clap::Args;

use crate::terminal::{Exit, counted, print_line};
use clearway_daemon::base::file_advice::advised;
use clearway_daemon::store::location;
use clearway_daemon::store::upload::{self, UploadError};

/// Send the finished recordings of a folder to a store, and confirm each by reading it back.
///
/// A part that the store has not confirmed stays where it is and is sent again; nothing is deleted without --delete.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway upload recordings --store /mnt/archive
  clearway upload recordings --store s3://fleet/clearway --delete

Exit codes: 0 every part is confirmed, 2 a part is not, 3 wrong use.")]
pub struct UploadArguments {
    /// The folder with the recordings (.mcap). One that is still being written is left out.
    folder: PathBuf,
    /// The store: a folder, also as file:///FOLDER, or s3://BUCKET/PREFIX with the environment variables of the AWS
    /// tools.
    #[arg(long, value_name = "URL", env = "CLEARWAY_STORE")]
    store: String,
    /// Delete each part from the folder after the store has confirmed it.
    #[arg(long)]
    delete: bool,
}

/// Sends every finished part. A part that is not confirmed is [`Exit::Unreadable`].
pub async fn run(options: &UploadArguments) -> Result<Exit> {
    let folder = &options.folder;
    // A folder that is not there is an error before the store's is made.
    let parts =
        upload::unconfirmed(folder).map_err(|error| anyhow!("{}: {}", folder.display(), advised(folder, error)))?;
    let store = location::open(&options.store)?;
    let mut is_incomplete = false;
    for part in parts {
        match upload::upload(&*store, &part, None).await {
            Ok(confirmation) => {
                let bytes = counted(confirmation.bytes, "byte");
                print_line(&format!("{} is confirmed: {bytes}, {}", part.display(), confirmation.part))?;
                if options.delete {
                    upload::delete_confirmed(&part).with_context(|| part.display().to_string())?;
                }
            }
            Err(error @ UploadError::Nothing { .. }) => eprintln!("clearway: not sent, and kept: {error}"),
            Err(error) => {
                is_incomplete = true;
                eprintln!("clearway: not confirmed, and kept: {error}");
            }
        }
    }
    Ok(Exit::from_incomplete(is_incomplete))
}
