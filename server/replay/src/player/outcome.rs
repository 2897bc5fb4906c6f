//! How a replay ends: at its end, stopped, or with an error.

use std::time::Duration;

use clearway_daemon::ingest::queue::QueueClosedError;

use super::timeline::Remarks;
use crate::files::FilesError;

/// How a replay ended.
#[derive(Debug, Default)]
pub struct Played {
    /// False if it was stopped before the end of its range.
    pub reached_end: bool,
    /// Greatest time by which an event was replayed too late: the machine was too slow for the rate.
    pub behind_max: Duration,
    /// What the files have beside their readings; empty if their end was not reached.
    pub remarks: Remarks,
}

/// A replay cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum PlayError {
    /// A file cannot be read.
    #[error(transparent)]
    Files(#[from] FilesError),
    /// A queue is closed.
    #[error(transparent)]
    Queue(#[from] QueueClosedError),
    /// A reader has not acknowledged a map in lockstep.
    #[error(
        "lockstep: map {sequence} of vehicle {vehicle} was not acknowledged within {seconds} s; awaited: {readers}"
    )]
    Unacknowledged {
        /// Name of the vehicle.
        vehicle: String,
        /// Sequence of the map.
        sequence: u64,
        /// The longest wait, in seconds.
        seconds: f64,
        /// The readers that have not acknowledged it.
        readers: String,
    },
}
