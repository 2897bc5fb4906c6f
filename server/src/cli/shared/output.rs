//! What the subcommands share to run and to print: stdout, the progress of a replay, the runtime, the signals.

use std::io::{ErrorKind, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, Error, Result};
use futures::future::select_all;
use indicatif::{ProgressBar, ProgressStyle};
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

pub use clearway_daemon::base::counted::counted;

/// Threads of the runtime at least, because zenoh needs several, whatever the machine has.
const THREADS_MIN: usize = 2;

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

/// An error of usage that only the values of several options together show; the command ends with exit code 3.
pub fn usage_error(message: impl std::fmt::Display) -> Error {
    clap::Error::raw(clap::error::ErrorKind::ArgumentConflict, format!("{message}\n")).into()
}

/// A progress bar of the bytes of a replay, which is cleared when this is dropped.
pub struct DrawnProgress {
    bar: ProgressBar,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for DrawnProgress {
    fn drop(&mut self) {
        self.task.abort();
        self.bar.finish_and_clear();
    }
}

/// Draws a progress bar of `bytes` on stderr in a task, ten times a second.
pub fn draw_progress(bytes: u64, bytes_read: Arc<AtomicU64>) -> DrawnProgress {
    let template = "{bar:40} {bytes}/{total_bytes} {bytes_per_sec} {eta}";
    let style = ProgressStyle::with_template(template).expect("the template is a constant");
    let bar = ProgressBar::new(bytes).with_style(style);
    let drawn = bar.clone();
    let task = tokio::spawn(async move {
        loop {
            drawn.set_position(bytes_read.load(Ordering::Relaxed));
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    DrawnProgress { bar, task }
}

/// Runs `work` to its end on a runtime of several threads.
///
/// # Errors
/// The error of `work`, or the system's if it has no threads to give.
pub fn block_on<T>(work: impl Future<Output = Result<T>>) -> Result<T> {
    let threads = std::thread::available_parallelism().map_or(THREADS_MIN, usize::from).max(THREADS_MIN);
    let runtime = Builder::new_multi_thread().worker_threads(threads).enable_all().build();
    runtime.context("start the runtime")?.block_on(work)
}

/// A future that resolves at SIGINT, SIGTERM or another signal that ends programs. They are caught from this call on.
///
/// # Errors
/// If the system refuses to catch them.
pub fn stop_signal() -> Result<impl Future<Output = ()>> {
    let [interrupt, terminate, quit] = [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::quit()];
    let kinds = [interrupt, terminate, quit, SignalKind::user_defined1(), SignalKind::user_defined2()];
    let mut signals = kinds.into_iter().map(signal).collect::<std::io::Result<Vec<_>>>()?;
    Ok(async move {
        select_all(signals.iter_mut().map(|signal| Box::pin(signal.recv()))).await;
    })
}
