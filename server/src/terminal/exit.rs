//! The exit codes of every subcommand.

use std::process::ExitCode;

/// The end of a command that it can name itself; an error ends it as [`Exit::Unreadable`], or as [`Exit::WrongUse`] if
/// it is an error of usage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// The command did all it was asked to do, and its input was whole.
    Good = 0,
    /// The result is not what it should be: a map differs, or a repaired recording lacks a part of the damaged one.
    Differs = 1,
    /// An input is missing, damaged, cut or refused, a server does not answer, or the command failed.
    Unreadable = 2,
    /// The command line is wrong, whatever the files are. A value that does not fit the files is
    /// [`Exit::Unreadable`].
    WrongUse = 3,
    /// The newest map is stale, or none has come; the state of a vehicle is "error"; the recorder has failed.
    Stale = 4,
    /// The state of a vehicle is "warn", and of none "error".
    Warn = 5,
}

/// The exit codes, as the help text lists them.
pub const EXIT_CODES: &str = "Exit codes: 0 good, 1 the result differs, 2 an input cannot be read or is not whole, or \
    the command failed (a value that does not fit the files too), 3 wrong use, \
    4 the map is stale (get, watch), a vehicle's state is error (status) or the recorder has failed (recorder), 5 the \
    state is warn (status).";

impl Exit {
    /// [`Exit::Stale`] if the newest map is stale.
    pub fn from_stale(is_stale: bool) -> Self {
        if is_stale { Self::Stale } else { Self::Good }
    }

    /// [`Exit::Unreadable`] if an input was not whole.
    pub fn from_incomplete(is_incomplete: bool) -> Self {
        if is_incomplete { Self::Unreadable } else { Self::Good }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}
