//! `clearway recorder`: requests to the recorder of a running server.

use anyhow::{Error, Result};
use clap::{Args, Subcommand};
use clearway_proto::v1;

use crate::cli::client::connection::ServerOptions;
use crate::cli::shared::output::{block_on, print_line};

/// Control the recorder of a running server: start, stop, split, save the last seconds, list, status.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway recorder status
  clearway recorder save --seconds 60 --reason near-miss")]
pub struct Options {
    #[command(flatten)]
    server: ServerOptions,
    #[command(subcommand)]
    request: Request,
}

#[derive(Clone, Subcommand)]
enum Request {
    /// Record again after a stop.
    Start,
    /// End the recording and close its file.
    Stop,
    /// End the part that is being written when the next one has warmed up.
    Split,
    /// Keep the last seconds: link the parts that hold them into the folder `saved`.
    Save {
        /// Number of seconds; 0: the server's `recorder.save_s`.
        #[arg(long, default_value_t = 0)]
        seconds: u32,
        /// Why: letters, digits and `-`.
        #[arg(long, default_value = "request")]
        reason: String,
    },
    /// List the parts on the server's disk.
    List,
    /// Print the state, and the counts of each topic.
    Status,
}

/// Sends the request and prints the answer.
///
/// # Errors
/// If the server cannot be reached or refuses the request.
pub fn run(options: Options) -> Result<()> {
    block_on(send(options))
}

async fn send(Options { server, request }: Options) -> Result<()> {
    let mut recorder = server.connect().await?.recorder().await?;
    let refused = |status: tonic::Status| Error::msg(status.message().to_owned());
    let answer = match request {
        Request::Start => recorder.start(v1::StartRecordingRequest {}).await,
        Request::Stop => recorder.stop(v1::StopRecordingRequest {}).await,
        Request::Split => recorder.split(v1::SplitRecordingRequest {}).await,
        Request::Save { seconds, reason } => recorder.save(v1::SaveRecordingRequest { seconds, reason }).await,
        Request::Status => recorder.status(v1::RecordingStatusRequest {}).await,
        Request::List => {
            let parts = recorder.list(v1::ListRecordingsRequest {}).await.map_err(refused)?.into_inner().parts;
            for part in parts {
                let unfinished = if part.is_unfinished { ", unfinished" } else { "" };
                print_line(&format!("{}: {} bytes{unfinished}", part.file, part.bytes))?;
            }
            return Ok(());
        }
    };
    let v1::RecordingResponse { status, files } = answer.map_err(refused)?.into_inner();
    let status = status.unwrap_or_default();
    let reason = if status.reason.is_empty() { String::new() } else { format!(": {}", status.reason) };
    let file = if status.file.is_empty() { String::new() } else { format!(" {}", status.file) };
    print_line(&format!("{}{file}, part {}{reason}", status.state, status.part))?;
    for (vehicle, events) in &status.durable_events {
        print_line(&format!("  {vehicle}: events below {events} are on the disk"))?;
    }
    for topic in &status.topics {
        let v1::TopicCount { topic, offered, written, dropped } = topic;
        print_line(&format!("  {topic}: offered {offered}, written {written}, dropped {dropped}"))?;
    }
    for file in files {
        print_line(&format!("  saved {file}"))?;
    }
    Ok(())
}
