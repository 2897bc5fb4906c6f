//! Errors of usage: how they are made and what tip they have; how every error is printed.

use anyhow::Error;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command};

use super::exit::Exit;
use super::output::{printable, with_causes};

/// An error of usage that only the values of several options together show; the command ends with exit code 3.
pub fn usage_error(message: impl std::fmt::Display) -> Error {
    clap::Error::raw(ErrorKind::ArgumentConflict, format!("{message}\n")).into()
}

/// The error of an unknown word or option with a tip: of a word, the options of the subcommand that take a value; of an
/// option that the subcommand reads as a word, this. The tip of clap would pass an unknown option on as a word.
pub fn with_tip(mut usage: clap::Error, command: &Command, words: impl Iterator<Item = String>) -> clap::Error {
    let Some(ContextValue::String(given)) = usage.get(ContextKind::InvalidArg) else { return usage };
    if usage.kind() != ErrorKind::UnknownArgument {
        return usage;
    }
    let called = words.skip(1).fold(command, |called, word| called.find_subcommand(word).unwrap_or(called));
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
pub fn print_usage(usage: &clap::Error) -> Exit {
    // A closed stdout or stderr changes nothing.
    let _ = usage.print();
    if usage.use_stderr() { Exit::WrongUse } else { Exit::Good }
}

/// Prints why a command failed.
pub fn print_error(error: Error) -> Exit {
    match error.downcast::<clap::Error>() {
        Ok(usage) => print_usage(&usage),
        Err(error) => {
            eprintln!("clearway: {}", printable(&with_causes(&error)));
            Exit::Unreadable
        }
    }
}
