//! How far a long command is.

use indicatif::{ProgressBar, ProgressStyle};

/// A progress bar on stderr of `length` bytes; nothing is drawn if stderr is not a terminal.
pub fn progress_bar(length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg}").expect("the template is a constant");
    ProgressBar::new(length).with_style(style)
}
