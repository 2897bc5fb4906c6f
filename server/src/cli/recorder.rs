//! `clearway recorder`: requests to the recorder of a running server.

use anyhow::{Error, Result};
use clap::{Args, Subcommand};
use clearway_client::ClientError;
use clearway_proto::v1;
use serde_json::json;
use tonic::Code;

use crate::connect::{ServerOptions, explain};
use crate::terminal::{Exit, counted, print_line, usage_error};
use clearway_daemon::status::recorder_json;
use clearway_journal::damage::utc;

/// Control the recorder of a running server: start, stop, split, save the last seconds, list, status.
#[derive(Args)]
#[command(
    after_help = "Exit codes: 0 good, 2 the server does not answer or refuses, 3 wrong use, 4 the recorder has failed.

Examples:
  clearway recorder status
  clearway recorder save --seconds 60 --reason near-miss
  clearway recorder list --json"
)]
pub struct RecorderArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// Print one JSON object.
    #[arg(long, global = true)]
    json: bool,
    #[command(subcommand)]
    request: RecorderSubcommand,
}

#[derive(Clone, Subcommand)]
enum RecorderSubcommand {
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
pub async fn run(RecorderArguments { server, json, request }: RecorderArguments) -> Result<Exit> {
    let mut recorder = server.connect().await?.recorder().await?;
    let refused = |status: tonic::Status| match std::error::Error::source(&status) {
        // No answer of the server, but of the connection to it.
        Some(source) => {
            let (address, reason) = (server.address.clone(), source.to_string());
            explain(ClientError::Unreachable { address, reason })
        }
        None if status.code() == Code::InvalidArgument => usage_error(status.message()),
        None => Error::msg(status.message().to_owned()),
    };
    let is_status = matches!(request, RecorderSubcommand::Status);
    let asked_s = if let RecorderSubcommand::Save { seconds, .. } = request { seconds } else { 0 };
    let answer = match request {
        RecorderSubcommand::Start => recorder.start(v1::StartRecordingRequest {}).await,
        RecorderSubcommand::Stop => recorder.stop(v1::StopRecordingRequest {}).await,
        RecorderSubcommand::Split => recorder.split(v1::SplitRecordingRequest {}).await,
        RecorderSubcommand::Save { seconds, reason } => {
            recorder.save(v1::SaveRecordingRequest { seconds, reason }).await
        }
        RecorderSubcommand::Status => recorder.status(v1::RecordingStatusRequest {}).await,
        RecorderSubcommand::List => {
            let parts = recorder.list(v1::ListRecordingsRequest {}).await.map_err(refused)?.into_inner().parts;
            print_parts(&parts, json)?;
            return Ok(Exit::Good);
        }
    };
    let v1::RecordingResponse { status, files, saved_s } = answer.map_err(refused)?.into_inner();
    let status = status.unwrap_or_default();
    let exit = if status.state == "failed" { Exit::Stale } else { Exit::Good };
    if json {
        let mut document = recorder_json(&status);
        document["saved"] = files.into();
        document["saved_s"] = saved_s.into();
        print_line(&format!("{document:#}"))?;
        return Ok(exit);
    }
    let reason = if status.reason.is_empty() { String::new() } else { format!(": {}", status.reason) };
    let file = if status.file.is_empty() { String::new() } else { format!(" {}", status.file) };
    print_line(&format!("{}{file}, part {}{reason}", status.state, status.part))?;
    if status.store_waiting > 0 {
        let (parts, problem) = (counted(status.store_waiting, "part"), &status.store_problem);
        let why = if problem.is_empty() { String::new() } else { format!(": {problem}") };
        let since_ns = Some(status.store_problem_since_ns).filter(|ns| *ns > 0);
        let since = since_ns.map_or(String::new(), |ns| format!(" since {}", utc(ns)));
        print_line(&format!("  {parts} not yet in the store{since}{why}"))?;
    }
    for (vehicle, events) in status.durable_events.iter().filter(|_| is_status) {
        print_line(&format!("  {vehicle}: events below {events} are on the disk"))?;
    }
    for topic in status.topics.iter().filter(|_| is_status) {
        let v1::TopicCount { topic, offered, written, dropped } = topic;
        print_line(&format!("  {topic}: offered {offered}, written {written}, dropped {dropped}"))?;
    }
    for file in files {
        print_line(&format!("  saved {file}"))?;
    }
    // Servers of earlier versions do not say it.
    if saved_s > 0.0 {
        print_line(&format!("  {}", saved_line(saved_s, asked_s)))?;
    }
    Ok(exit)
}

/// How many seconds are saved, and how many were asked for if those are more; 0: the server's number.
fn saved_line(saved_s: f64, asked_s: u32) -> String {
    let is_less = saved_s + 0.05 < f64::from(asked_s);
    let asked = if is_less { format!(" of the {asked_s} s asked for: no more is recorded") } else { String::new() };
    format!("saved {saved_s:.1} s{asked}")
}

fn print_parts(parts: &[v1::RecordedPart], json: bool) -> Result<()> {
    if json {
        let part = |part: &v1::RecordedPart| {
            let v1::RecordedPart { file, bytes, is_unfinished, modified_ns, is_left } = part;
            json!({
                "file": file, "bytes": bytes, "is_unfinished": is_unfinished, "is_left": is_left,
                "modified_ns": modified_ns,
            })
        };
        let parts: Vec<_> = parts.iter().map(part).collect();
        print_line(&format!("{:#}", json!({ "parts": parts })))?;
        return Ok(());
    }
    for part in parts {
        let state = match (part.is_left, part.is_unfinished) {
            (true, _) => ", left unfinished by a crash or a full disk",
            (false, true) => ", unfinished",
            (false, false) => "",
        };
        let (megabytes, written) = (part.bytes as f64 / 1e6, utc(part.modified_ns.try_into().unwrap_or(0)));
        print_line(&format!("{}: {megabytes:.1} MB, written {written}{state}", part.file))?;
    }
    let megabytes = parts.iter().map(|part| part.bytes).sum::<u64>() as f64 / 1e6;
    print_line(&format!("{}, {megabytes:.1} MB", counted(parts.len() as u64, "part")))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_save_of_fewer_seconds_than_were_asked_for_says_both_numbers() {
        assert_eq!(saved_line(12.34, 60), "saved 12.3 s of the 60 s asked for: no more is recorded");
        assert_eq!(saved_line(60.0, 60), "saved 60.0 s");
        assert_eq!(saved_line(12.34, 0), "saved 12.3 s");
    }
}
