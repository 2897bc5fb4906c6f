//! The recorder's buttons on the page: requests of operators, and what came of them, as JSON.
//!
//! A request is `{"type":"recorder","command":"save","seconds":30}`; the commands are the calls of
//! [`clearway_proto::v1::recording_service_server::RecordingService`]: `start`, `stop`, `split`, `save`. The answer has
//! the state after it, the files that were saved, and `error`. Operators get one without asking when they connect, so a
//! page that has none shows no buttons.

use clearway_proto::v1;
use serde::Deserialize;
use serde_json::json;

use super::listen::access::Caller;
use crate::record::writer::{Command, RecorderControl};

/// The recorder as one page reaches it.
pub(super) struct PageRecorder(RecorderControl);

/// A request of a button.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RecorderRequest {
    command: Button,
    /// Seconds to save; 0: the configured number.
    #[serde(default)]
    seconds: u32,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Button {
    Start,
    Stop,
    Split,
    Save,
}

impl PageRecorder {
    /// The recorder as an operator reaches it whom nothing limits; `None` for other callers.
    pub fn new(control: RecorderControl, caller: &Caller) -> Option<Self> {
        caller.may_record().then_some(Self(control))
    }

    /// The state of the recorder.
    pub fn state(&self) -> String {
        answer(self.0.status(), "")
    }

    /// Carries out a request, and answers it.
    pub fn answer(&self, request: RecorderRequest) -> impl Future<Output = String> + Send + use<> {
        let command = match request.command {
            Button::Start => Command::Start,
            Button::Stop => Command::Stop,
            Button::Split => Command::Split,
            Button::Save => Command::Save { seconds: request.seconds.into(), reason: "page".to_owned() },
        };
        let control = self.0.clone();
        async move {
            match control.send(command).await {
                Ok(response) => answer(response, ""),
                Err(error) => answer(control.status(), &error.to_string()),
            }
        }
    }
}

fn answer(v1::RecordingResponse { status, files, .. }: v1::RecordingResponse, error: &str) -> String {
    let v1::RecorderStatus { state, file, part, .. } = status.unwrap_or_default();
    json!({ "type": "recorder", "state": state, "file": file, "part": part, "files": files, "error": error })
        .to_string()
}
