//! The command `clearway`: watch, get and export maps, look into recordings and captures, send captures, scans, poses
//! and roads.
//!
//! Exit codes: 0 fine, 1 failure, 2 usage.

mod command;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use command::{export, get, info, ingest, send, vehicles, watch};

/// Maps of where a vehicle may drive, from a clearway-server or a recording.
#[derive(Parser)]
#[command(name = "clearway", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Watch(watch::Options),
    Get(get::Options),
    Vehicles(vehicles::Options),
    Info(info::Options),
    Export(export::Options),
    Send(send::Options),
    Ingest(ingest::Options),
}

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::from_default_env())
        .with_writer(std::io::stderr)
        .init();
    let outcome = match Arguments::parse().command {
        Command::Watch(options) => command::block_on(watch::run(options)),
        Command::Get(options) => command::block_on(get::run(options)),
        Command::Vehicles(options) => command::block_on(vehicles::run(options)),
        Command::Info(options) => info::run(&options),
        Command::Export(options) => export::run(&options),
        Command::Send(options) => send::run(&options),
        Command::Ingest(options) => command::block_on(ingest::run(options)),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("clearway: {error:#}");
            ExitCode::FAILURE
        }
    }
}
