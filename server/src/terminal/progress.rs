//! How far a long command is: a bar on stderr, which is not drawn if stderr is not a terminal.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// A progress bar of `length` bytes.
#[cfg(feature = "tools")]
pub fn progress_bar(length: u64) -> ProgressBar {
    bar(length, "{bar:40} {percent:>3} % {msg}")
}

fn bar(length: u64, template: &str) -> ProgressBar {
    ProgressBar::new(length).with_style(ProgressStyle::with_template(template).expect("the template is a constant"))
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
    let bar = bar(bytes, "{bar:40} {bytes}/{total_bytes} {bytes_per_sec} {eta}");
    let drawn = bar.clone();
    let task = tokio::spawn(async move {
        loop {
            drawn.set_position(bytes_read.load(Ordering::Relaxed));
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    DrawnProgress { bar, task }
}
