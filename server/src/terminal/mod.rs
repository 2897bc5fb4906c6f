//! What a person or a program that runs the command sees: output, progress, log, errors of usage, exit codes.

mod exit;
pub mod logs;
mod output;
mod progress;
mod screen;
mod usage;

pub use exit::{EXIT_CODES, Exit};
pub use output::{age_text, counted, one_line, print, print_line, printable, with_causes};
pub use progress::draw_progress;
#[cfg(feature = "tools")]
pub use progress::progress_bar;
pub use screen::Screen;
pub use usage::{print_error, print_usage, usage_error, with_tip};
