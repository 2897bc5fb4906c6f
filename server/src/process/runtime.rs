//! The runtime of a command, and the signals that end it.

#[cfg(feature = "tools")]
use std::sync::Arc;
#[cfg(feature = "tools")]
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};
use futures::future::select_all;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

/// Threads of the runtime at least, because zenoh needs several, whatever the machine has.
const THREADS_MIN: usize = 2;

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

/// A flag that is set at the signals of [`stop_signal`], for work that blocks.
///
/// # Errors
/// As [`stop_signal`].
#[cfg(feature = "tools")]
pub fn stop_flag() -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let stopped = {
        let _entered = runtime.enter();
        stop_signal()?
    };
    let of_thread = Arc::clone(&flag);
    std::thread::spawn(move || {
        runtime.block_on(stopped);
        of_thread.store(true, Ordering::Relaxed);
    });
    Ok(flag)
}
