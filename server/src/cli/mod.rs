//! The command `clearway`: the list of its subcommands and the function that runs each.
//!
//! Each subcommand is one file with its options (as clap reads them from the command line) and its `run`.

mod check;
mod completions;
mod connection;
mod info;
mod ingest;
mod recorder;
#[cfg(feature = "store")]
mod recordings;
mod repair;
mod replay;
mod serve;
mod service_manager;
mod shared;
mod status;
mod top;
mod transport;
#[cfg(feature = "store")]
mod upload;
mod vehicles;
mod verify;
mod view;
mod watch;

// The subcommands of the feature `tools`, and what they share.
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
mod picture_options;
#[cfg(feature = "tools")]
mod send;
#[cfg(feature = "tools")]
mod simulate;
#[cfg(feature = "tools")]
mod tool_commands;

use std::process::ExitCode;

use anyhow::Result;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, CommandFactory, FromArgMatches, Parser, Subcommand};

use shared::exit::{EXIT_CODES, Exit};
use shared::logs;
use shared::output::{printable, with_causes};

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
    #[command(flatten)]
    Tool(tool_commands::ToolCommand),
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
    let arguments = match matches.and_then(|matches| ClearwayArguments::from_arg_matches(&matches)) {
        Ok(arguments) => arguments,
        Err(usage) => return print_usage(&with_tip(usage, std::env::args())),
    };
    match logs::start().and_then(|()| run(arguments.command)) {
        Ok(exit) => exit.into(),
        Err(error) => match error.downcast::<clap::Error>() {
            Ok(usage) => print_usage(&usage),
            Err(error) => {
                eprintln!("clearway: {}", printable(&with_causes(&error)));
                Exit::Unreadable.into()
            }
        },
    }
}

/// The error of an unknown word or option with a tip: of a word, the options of the subcommand that take a value; of an
/// option that the subcommand reads as a word, this. The tip of clap would pass an unknown option on as a word.
fn with_tip(mut usage: clap::Error, words: impl Iterator<Item = String>) -> clap::Error {
    let Some(ContextValue::String(given)) = usage.get(ContextKind::InvalidArg) else { return usage };
    if usage.kind() != ErrorKind::UnknownArgument {
        return usage;
    }
    let command = command();
    let called = words.skip(1).fold(&command, |called, word| called.find_subcommand(word).unwrap_or(called));
    let value = |argument: &Arg| argument.get_value_names().unwrap_or_default().join(" ");
    let tip = match given.strip_prefix("--") {
        Some(name) => called
            .get_positionals()
            .find(|argument| value(argument).eq_ignore_ascii_case(name))
            .map(|argument| format!("'{}' is a word without '{given}'", value(argument))),
        None if given.starts_with('-') => None,
        None => {
            let options = called.get_opts().filter(|option| option.get_action().takes_values());
            let named = options.filter_map(|option| Some(format!("--{} <{}>", option.get_long()?, value(option))));
            Some(named.collect::<Vec<_>>().join(", "))
                .filter(|options| !options.is_empty())
                .map(|options| format!("a value needs its option: {options}"))
        }
    };
    usage.remove(ContextKind::Suggested);
    if let Some(tip) = tip {
        usage.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![tip.into()]));
    }
    usage
}

/// Prints an error of usage, or the help that was asked for.
fn print_usage(usage: &clap::Error) -> ExitCode {
    // A closed stdout or stderr changes nothing.
    let _ = usage.print();
    if usage.use_stderr() { Exit::WrongUse.into() } else { Exit::Good.into() }
}

fn run(command: ClearwayCommand) -> Result<Exit> {
    match command {
        ClearwayCommand::Serve(options) => serve::run(&options)?,
        ClearwayCommand::Replay(options) => return replay::run(*options),
        ClearwayCommand::View(options) => return view::run(options),
        ClearwayCommand::Transport(options) => transport::run(&options)?,
        ClearwayCommand::Verify(options) => return verify::run(&options),
        ClearwayCommand::Check(options) => check::run(&options)?,
        ClearwayCommand::Watch(options) => return watch::run(&options),
        ClearwayCommand::Vehicles(options) => vehicles::run(&options)?,
        ClearwayCommand::Status(options) => return status::run(&options),
        ClearwayCommand::Top(options) => top::run(&options)?,
        ClearwayCommand::Recorder(options) => return recorder::run(options),
        ClearwayCommand::Info(options) => return info::run(&options),
        ClearwayCommand::Repair(options) => return repair::run(&options),
        #[cfg(feature = "store")]
        ClearwayCommand::Upload(options) => return upload::run(&options),
        #[cfg(feature = "store")]
        ClearwayCommand::Recordings(options) => return recordings::run(&options),
        ClearwayCommand::Ingest(options) => ingest::run(&options)?,
        #[cfg(feature = "tools")]
        ClearwayCommand::Tool(command) => return tool_commands::run(command),
        ClearwayCommand::Completions(options) => completions::run(&options, self::command())?,
    }
    Ok(Exit::Good)
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
    use anyhow::Error;

    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        command().debug_assert();
    }

    #[test]
    fn an_error_names_each_cause_once() {
        let cause = std::io::Error::other("the disk is full");
        assert_eq!(with_causes(&Error::new(cause).context("write a.png")), "write a.png: the disk is full");
        let cause = std::io::Error::other("the disk is full");
        assert_eq!(with_causes(&Error::new(cause).context("a.png: the disk is full")), "a.png: the disk is full");
    }

    #[test]
    fn every_line_of_the_help_fits_a_terminal_of_120_columns() {
        let help = command().render_help().to_string();
        assert!(help.lines().all(|line| line.chars().count() <= 120), "{help}");
    }
}
