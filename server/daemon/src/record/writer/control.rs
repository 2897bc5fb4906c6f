//! Requests to a running recorder, for gRPC, zenoh, the page and the rules of `recorder.save_on`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Sender;

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

/// A request on its way to the recorder.
pub(super) struct Request {
    pub command: Command,
    pub answer: oneshot::Sender<Result<Vec<PathBuf>, String>>,
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
        let files = answered.await.map_err(|_| ControlError::NoAnswer)?.map_err(ControlError::Refused)?;
        let files = files.iter().map(|file| file.display().to_string()).collect();
        Ok(v1::RecordingResponse { files, ..self.status() })
    }

    /// All parts on the disk, oldest first.
    pub fn list(&self) -> Vec<v1::RecordedPart> {
        Folder::of(&self.options).list()
    }

    /// The state and the counts of the recorder, without files.
    pub fn status(&self) -> v1::RecordingResponse {
        v1::RecordingResponse { status: Some(self.counts.to_proto()), files: Vec::new() }
    }
}
