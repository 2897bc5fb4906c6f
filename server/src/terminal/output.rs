//! Text -> stdout; the text of an error.

use std::io::{ErrorKind, Write};

use anyhow::{Context, Error, Result};

pub use clearway_daemon::base::counted::counted;

/// The text of an error and of its causes. A cause that the text before it contains already is left out.
pub fn with_causes(error: &Error) -> String {
    let mut text = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

/// The age of a map, ms, for people; the age of a map of the future is negative.
pub fn age_text(age_ms: f64) -> String {
    if age_ms < 0.0 { format!("{:.0} ms ahead of the clock", -age_ms) } else { format!("{age_ms:.0} ms old") }
}

/// The text without the control characters that would command a terminal; a file may have brought them.
pub fn printable(text: &str) -> String {
    text.chars().map(|c| if c.is_control() && !matches!(c, '\n' | '\t') { '\u{fffd}' } else { c }).collect()
}

/// The text on one line, which it cannot leave or turn round: a space for each control character of terminals and of
/// the direction of text. A server may have passed it on from another one.
pub fn one_line(text: &str) -> String {
    let commands = |c: char| c.is_control() || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    text.chars().map(|c| if commands(c) { ' ' } else { c }).collect()
}

/// Prints `text` on stdout, as [`printable`] has it. `false` if the reader of stdout has closed it (`| head`), which is
/// no error.
///
/// # Errors
/// If stdout cannot be written, such as a file on a full disk.
pub fn print(text: &str) -> Result<bool> {
    let mut stdout = std::io::stdout();
    match stdout.write_all(printable(text).as_bytes()).and_then(|()| stdout.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error).context("write to stdout"),
    }
}

/// Prints `line` and a line end, as [`print()`] does.
///
/// # Errors
/// As [`print()`].
pub fn print_line(line: &str) -> Result<bool> {
    print(&format!("{line}\n"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_of_another_server_makes_no_line_of_its_own() {
        assert_eq!(one_line("top\n\u{1b}[31mcar: OK\u{202e}"), "top  [31mcar: OK ");
    }

    #[test]
    fn an_error_names_each_cause_once() {
        let cause = std::io::Error::other("the disk is full");
        assert_eq!(with_causes(&Error::new(cause).context("write a.png")), "write a.png: the disk is full");
        let cause = std::io::Error::other("the disk is full");
        assert_eq!(with_causes(&Error::new(cause).context("a.png: the disk is full")), "a.png: the disk is full");
    }
}
