//! The command `clearway`: the list of its subcommands and the function that runs each.
//!
//! Each subcommand is one file with its options (as clap reads them from the command line) and its `run`.

mod check;
mod completions;
mod connection;
mod drawing;
mod fleet;
mod info;
mod ingest;
mod recorder;
#[cfg(feature = "store")]
mod recordings;
mod repair;
mod replay;
mod replay_state;
mod screen;
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

use std::fmt::Write as _;
use std::process::ExitCode;

use anyhow::Result;
use clap::builder::StyledStr;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use shared::exit::{EXIT_CODES, Exit};
use shared::logs;
use shared::output::{printable, with_causes};

/// Clearway turns LIDAR packets into maps of where a vehicle may drive.
#[derive(Parser)]
#[command(name = "clearway", version, after_help = after_help())]
struct Arguments {
    /// Format of the log on stderr; the environment variable RUST_LOG, such as RUST_LOG=warn, selects its lines.
    #[arg(
        long,
        value_enum,
        default_value = "text",
        global = true,
        value_name = "text|json",
        hide_possible_values = true,
        display_order = 900
    )]
    log_format: logs::LogFormat,
    #[command(subcommand)]
    command: Command,
}

/// The subcommands, in the order of the help text.
#[derive(Subcommand)]
enum Command {
    Serve(serve::Options),
    Replay(Box<replay::ReplayArguments>),
    View(view::ViewArguments),
    Transport(transport::Options),
    Verify(verify::Options),
    Check(check::Options),
    Watch(watch::Options),
    Vehicles(vehicles::Options),
    Status(status::Options),
    Top(top::Options),
    Recorder(recorder::Options),
    Info(info::Options),
    Repair(repair::Options),
    #[cfg(feature = "store")]
    Upload(upload::Options),
    #[cfg(feature = "store")]
    Recordings(recordings::Options),
    Ingest(ingest::Options),
    #[cfg(feature = "tools")]
    #[command(flatten)]
    Tool(tool_commands::ToolCommand),
    Completions(completions::Options),
}

/// The subcommands by purpose, as `clearway --help` lists them.
const GROUPS: [(&str, &[&str]); 8] = [
    ("Make maps", &["demo", "serve", "replay", "view", "transport"]),
    ("Check maps and configurations", &["verify", "evaluate", "check", "init"]),
    ("Read maps from a server", &["watch", "get", "vehicles", "status", "top"]),
    ("Control a server", &["recorder"]),
    ("Read files", &["export", "info", "repair"]),
    ("Keep recordings", &["upload", "recordings"]),
    ("Send sensor data", &["send", "ingest", "simulate"]),
    ("Shell", &["completions"]),
];

/// What the help text says after the options.
fn after_help() -> String {
    let without = "This build is without the feature `tools`: `demo`, `evaluate`, `init`, `get`, `export`, `send` and \
        `simulate` are not in it.";
    if cfg!(feature = "tools") { EXIT_CODES.to_owned() } else { format!("{EXIT_CODES}\n\n{without}") }
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let matches = command().try_get_matches();
    let arguments = match matches.and_then(|matches| Arguments::from_arg_matches(&matches)) {
        Ok(arguments) => arguments,
        Err(usage) => return print_usage(&usage),
    };
    logs::start(arguments.log_format);
    match run(arguments.command) {
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

/// Prints an error of usage, or the help that was asked for.
fn print_usage(usage: &clap::Error) -> ExitCode {
    // A closed stdout or stderr changes nothing.
    let _ = usage.print();
    if usage.use_stderr() { Exit::WrongUse.into() } else { Exit::Good.into() }
}

fn run(command: Command) -> Result<Exit> {
    match command {
        Command::Serve(options) => serve::run(&options)?,
        Command::Replay(options) => return replay::run(*options),
        Command::View(options) => return view::run(options),
        Command::Transport(options) => transport::run(&options)?,
        Command::Verify(options) => return verify::run(&options),
        Command::Check(options) => check::run(&options)?,
        Command::Watch(options) => return watch::run(&options),
        Command::Vehicles(options) => vehicles::run(&options)?,
        Command::Status(options) => return status::run(&options),
        Command::Top(options) => top::run(&options)?,
        Command::Recorder(options) => return recorder::run(options),
        Command::Info(options) => return info::run(&options),
        Command::Repair(options) => return repair::run(&options),
        #[cfg(feature = "store")]
        Command::Upload(options) => return upload::run(&options),
        #[cfg(feature = "store")]
        Command::Recordings(options) => return recordings::run(&options),
        Command::Ingest(options) => ingest::run(&options)?,
        #[cfg(feature = "tools")]
        Command::Tool(command) => return tool_commands::run(command),
        Command::Completions(options) => completions::run(&options, self::command())?,
    }
    Ok(Exit::Good)
}

/// The command line as clap reads it; its help lists the subcommands by purpose.
fn command() -> clap::Command {
    let command = Arguments::command();
    let list = grouped_subcommands(&command);
    let template = format!("{{about}}\n\n{{usage-heading}} {{usage}}\n{list}\nOptions:\n{{options}}{{after-help}}\n");
    let names: Vec<String> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
    // `--speed -1` is then a wrong speed and not an unknown option.
    let numbers = |command: clap::Command, name| command.mut_subcommand(name, |c| c.allow_negative_numbers(true));
    names.into_iter().fold(command, numbers).help_template(StyledStr::from(template))
}

/// The list of subcommands under the headings of [`GROUPS`]. clap lists them under one heading only.
fn grouped_subcommands(command: &clap::Command) -> String {
    let styles = clap::builder::Styles::styled();
    let (header, literal) = (styles.get_header(), styles.get_literal());
    let mut list = String::new();
    for (purpose, names) in GROUPS {
        // Writing to a string cannot fail.
        let _ = writeln!(list, "\n{header}{purpose}:{header:#}");
        for subcommand in names.iter().filter_map(|name| command.find_subcommand(name)) {
            let about = subcommand.get_about().map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(list, "  {literal}{:<11}{literal:#}  {about}", subcommand.get_name());
        }
    }
    list
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
    fn help_lists_every_subcommand_once() {
        let command = command();
        let mut defined: Vec<&str> = command.get_subcommands().map(clap::Command::get_name).collect();
        let grouped = GROUPS.iter().flat_map(|(_, names)| *names).copied();
        let mut listed: Vec<&str> = grouped.filter(|name| command.find_subcommand(name).is_some()).collect();
        defined.sort_unstable();
        listed.sort_unstable();
        assert_eq!(listed, defined);
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
