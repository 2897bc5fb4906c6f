//! Requests to a running recorder, for gRPC, zenoh, the page and the rules of `recorder.save_on`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use clearway_proto::v1;
use tokio::sync::oneshot;

use super::counts::RecorderCounts;
use super::folder::Folder;
use crate::config::Recorder as Options;

/// A request of an operator to the recorder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Records again after [`Command::Stop`].
    Start,
    /// Closes the file; nothing is recorded until [`Command::Start`].
    Stop,
    /// Begins the next part.
    Split,
    /// Keeps the last seconds; 0: the configured number. `reason` is a part of a folder's name.
    Save {
        /// Number of seconds.
        seconds: u64,
        /// Why the seconds are kept; a part of the folder's name.
        reason: String,
    },
}

/// What a request has saved; nothing unless it is [`Command::Save`].
#[derive(Debug, Default)]
pub(super) struct Saved {
    /// The saved files.
    pub files: Vec<PathBuf>,
    /// How much of the time that was asked for they have.
    pub recorded: Duration,
}

/// How much of the `time` before `now` was recorded in these parts: number, begin and end, the oldest first. A time in
/// two parts counts once.
pub(super) fn recorded(parts: &[(u64, Instant, Instant)], time: Duration, now: Instant) -> Duration {
    let (mut left, mut recorded) = (time, Duration::ZERO);
    for (_, began, ended) in parts {
        let [from, to] = [began, ended].map(|at| now.saturating_duration_since(*at).min(left));
        recorded += from.saturating_sub(to);
        left = to;
    }
    recorded
}

/// A request on its way to the recorder.
pub(super) struct Request {
    pub command: Command,
    pub answer: oneshot::Sender<Result<Saved, String>>,
}

/// A request that cannot be followed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ControlError {
    /// The server has no recorder.
    #[error("nothing is recorded: the configuration has no recorder.file")]
    NoRecorder,
    /// The reason of a save is not allowed.
    #[error("reason = {0:?}: 1 to 40 letters, digits and `-` are allowed")]
    Reason(String),
    /// The recorder cannot follow the request now: the reason.
    #[error("{0}")]
    Refused(String),
    /// The recorder has ended or hangs.
    #[error("the recorder does not answer")]
    NoAnswer,
}

/// Sends requests to the recorder; clones share it.
#[derive(Clone, Debug)]
pub struct RecorderControl {
    pub(super) requests: Sender<Request>,
    pub(super) counts: Arc<RecorderCounts>,
    pub(super) options: Options,
}

impl RecorderControl {
    /// Sends a request and waits for what it has done: the state after it, and the files that were saved.
    ///
    /// # Errors
    /// [`ControlError::Reason`] if the reason of a save is not allowed, [`ControlError::Refused`] if the recorder
    /// cannot do it now, [`ControlError::NoAnswer`] if it has ended.
    pub async fn send(&self, mut command: Command) -> Result<v1::RecordingResponse, ControlError> {
        if let Command::Save { reason, .. } = &mut command {
            if reason.is_empty() {
                *reason = "request".to_owned();
            }
            if reason.len() > 40 || !reason.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-') {
                return Err(ControlError::Reason(std::mem::take(reason)));
            }
        }
        let (answer, answered) = oneshot::channel();
        self.requests.send(Request { command, answer }).map_err(|_| ControlError::NoAnswer)?;
        let saved = answered.await.map_err(|_| ControlError::NoAnswer)?.map_err(ControlError::Refused)?;
        let files = saved.files.iter().map(|file| file.display().to_string()).collect();
        Ok(v1::RecordingResponse { files, saved_s: saved.recorded.as_secs_f64(), ..self.status() })
    }

    /// All parts on the disk, oldest first.
    pub fn list(&self) -> Vec<v1::RecordedPart> {
        Folder::of(&self.options).list()
    }

    /// The state and the counts of the recorder, without files.
    pub fn status(&self) -> v1::RecordingResponse {
        v1::RecordingResponse { status: Some(self.counts.to_proto()), ..v1::RecordingResponse::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_save_counts_the_seconds_that_its_parts_have_and_none_twice() {
        let start = Instant::now();
        let at = |s| start + Duration::from_secs(s);
        // Two parts that overlap by a warm-up, a stop of 5 s, and a part that is still written.
        let parts = [(1, at(0), at(20)), (2, at(18), at(40)), (3, at(45), at(60))];
        for (asked_s, recorded_s) in [(10, 10), (15, 15), (20, 15), (30, 25), (60, 55), (100, 55)] {
            assert_eq!(recorded(&parts, Duration::from_secs(asked_s), at(60)), Duration::from_secs(recorded_s));
        }
    }
}
