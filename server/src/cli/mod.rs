//! The command `clearway`: the list of its subcommands and the function that runs each.
//!
//! Each subcommand is one file with its options (as clap reads them from the command line) and its `run`, which returns
//! the exit code. An error is printed with its causes; [`Exit`] says how it ends the command.

mod check;
mod completions;
mod info;
mod ingest;
mod recorder;
#[cfg(feature = "store")]
mod recordings;
mod repair;
mod replay;
mod serve;
mod status;
mod top;
mod transport;
#[cfg(feature = "store")]
mod upload;
mod vehicles;
mod verify;
mod view;
mod watch;

// The subcommands that never run on a vehicle.
#[cfg(feature = "tools")]
mod demo;
#[cfg(feature = "tools")]
mod evaluate;
#[cfg(feature = "tools")]
mod export;
#[cfg(feature = "tools")]
mod get;
#[cfg(feature = "tools")]
mod init;
#[cfg(feature = "tools")]
mod send;
#[cfg(feature = "tools")]
mod simulate;

use std::process::ExitCode;

use anyhow::Result;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::process::block_on;
use crate::terminal::logs;
use crate::terminal::{EXIT_CODES, Exit, print_error, print_usage, with_tip};

/// Clearway turns LIDAR packets into maps of where a vehicle may drive.
#[derive(Parser)]
#[command(name = "clearway", version, after_help = after_help())]
struct ClearwayArguments {
    #[command(subcommand)]
    command: ClearwayCommand,
}

/// The subcommands, in the order of the help text.
#[derive(Subcommand)]
enum ClearwayCommand {
    Serve(serve::ServeArguments),
    Replay(Box<replay::ReplayArguments>),
    View(view::ViewArguments),
    Transport(transport::TransportArguments),
    Verify(verify::VerifyArguments),
    Check(check::CheckArguments),
    Watch(watch::WatchArguments),
    Vehicles(vehicles::VehiclesArguments),
    Status(status::StatusArguments),
    Top(top::TopArguments),
    Recorder(recorder::RecorderArguments),
    Info(info::InfoArguments),
    Repair(repair::RepairArguments),
    #[cfg(feature = "store")]
    Upload(upload::UploadArguments),
    #[cfg(feature = "store")]
    Recordings(recordings::RecordingsArguments),
    Ingest(ingest::IngestArguments),
    #[cfg(feature = "tools")]
    Demo(demo::DemoArguments),
    #[cfg(feature = "tools")]
    Evaluate(evaluate::EvaluateArguments),
    #[cfg(feature = "tools")]
    Init(init::InitArguments),
    #[cfg(feature = "tools")]
    Get(get::GetArguments),
    #[cfg(feature = "tools")]
    Export(export::ExportArguments),
    #[cfg(feature = "tools")]
    Send(send::SendArguments),
    #[cfg(feature = "tools")]
    Simulate(simulate::SimulateArguments),
    Completions(completions::CompletionsArguments),
}

/// The pages by subject, from the repository or the package's folder of documents on.
const PAGES: &str = "Pages:
  a planner                 client/README.md
  drives, replay and tests  server/README.md
  recordings, black box     server/guide/recordings.md
  a first sensor            deploy/guide/first-sensor.md
  sensors and time          deploy/guide/sensors-and-time.md
  configuration             deploy/guide/configuration.md
  operations                deploy/guide/operations.md
  ROS 2                     client/ros2/README.md
A package of Debian has them in /usr/share/doc/clearway.";

/// What the help text says after the options.
fn after_help() -> String {
    let without = "This build is without the feature `tools`: `demo`, `evaluate`, `init`, `get`, `export`, `send` and \
        `simulate` are not in it.";
    let help = format!("{PAGES}\n\n{EXIT_CODES}");
    if cfg!(feature = "tools") { help } else { format!("{help}\n\n{without}") }
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let matches = command().try_get_matches();
    let exit = match matches.and_then(|matches| ClearwayArguments::from_arg_matches(&matches)) {
        Ok(arguments) => logs::start().and_then(|()| run(arguments.command)).unwrap_or_else(print_error),
        Err(usage) => print_usage(&with_tip(usage, &command(), std::env::args())),
    };
    exit.into()
}

fn run(command: ClearwayCommand) -> Result<Exit> {
    match command {
        ClearwayCommand::Serve(options) => serve::run(&options),
        ClearwayCommand::Replay(options) => block_on(replay::run(*options)),
        ClearwayCommand::View(options) => block_on(view::run(options)),
        ClearwayCommand::Transport(options) => block_on(transport::run(&options)),
        ClearwayCommand::Verify(options) => verify::run(&options),
        ClearwayCommand::Check(options) => check::run(&options),
        ClearwayCommand::Watch(options) => block_on(watch::run(&options)),
        ClearwayCommand::Vehicles(options) => block_on(vehicles::run(&options)),
        ClearwayCommand::Status(options) => block_on(status::run(&options)),
        ClearwayCommand::Top(options) => block_on(top::run(&options)),
        ClearwayCommand::Recorder(options) => block_on(recorder::run(options)),
        ClearwayCommand::Info(options) => info::run(&options),
        ClearwayCommand::Repair(options) => repair::run(&options),
        #[cfg(feature = "store")]
        ClearwayCommand::Upload(options) => block_on(upload::run(&options)),
        #[cfg(feature = "store")]
        ClearwayCommand::Recordings(options) => block_on(recordings::run(&options)),
        ClearwayCommand::Ingest(options) => block_on(ingest::run(&options)),
        #[cfg(feature = "tools")]
        ClearwayCommand::Demo(options) => block_on(demo::run(options)),
        #[cfg(feature = "tools")]
        ClearwayCommand::Evaluate(options) => evaluate::run(options),
        #[cfg(feature = "tools")]
        ClearwayCommand::Init(options) => init::run(options),
        #[cfg(feature = "tools")]
        ClearwayCommand::Get(options) => block_on(get::run(&options)),
        #[cfg(feature = "tools")]
        ClearwayCommand::Export(options) => export::run(options),
        #[cfg(feature = "tools")]
        ClearwayCommand::Send(options) => send::run(options),
        #[cfg(feature = "tools")]
        ClearwayCommand::Simulate(options) => simulate::run(&options),
        ClearwayCommand::Completions(options) => completions::run(&options, self::command()),
    }
}

/// The command line as clap reads it.
fn command() -> clap::Command {
    let command = ClearwayArguments::command();
    let names: Vec<String> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
    // `--speed -1` is then a wrong speed and not an unknown option.
    let numbers = |command: clap::Command, name| command.mut_subcommand(name, |c| c.allow_negative_numbers(true));
    names.into_iter().fold(command, numbers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        command().debug_assert();
    }

    #[test]
    fn every_line_of_the_help_fits_a_terminal_of_120_columns() {
        let help = command().render_help().to_string();
        assert!(help.lines().all(|line| line.chars().count() <= 120), "{help}");
    }
}
