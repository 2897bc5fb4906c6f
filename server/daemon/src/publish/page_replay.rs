//! The time bar of the page: the state of a replay as JSON, and requests of the page.
//!
//! A request is a JSON object with some of the fields of [`v1::ReplayControl`] under their own names; times are strings
//! of nanoseconds, because a browser's doubles cannot hold them, and the rate may be `"max"`. It is answered with the
//! state after the change, or with `error`.

use clearway_proto::v1;
use serde::Deserialize;
use serde_json::json;
use tokio::sync::watch;

use super::listen::access::Caller;
use crate::replay_control::ReplayHandle;

/// The replay as one page reaches it.
pub(super) struct PageReplay {
    pub handle: ReplayHandle,
    /// True if the client is an operator.
    may_control: bool,
}

impl PageReplay {
    /// The replay as a client reaches it; `None` if it may not reach all its vehicles, which have one time.
    pub fn new(handle: ReplayHandle, caller: &Caller) -> Option<Self> {
        let reaches_all = handle.state().borrow().vehicles.iter().all(|vehicle| caller.may_reach(vehicle));
        let may_control = caller.is_operator();
        reaches_all.then_some(Self { handle, may_control })
    }
}

/// Waits for the next change of the state; for ever if there is no replay, or it is over.
pub(super) async fn replay_changed(state: &mut Option<watch::Receiver<v1::ReplayState>>) -> v1::ReplayState {
    if let Some(state) = state
        && state.changed().await.is_ok()
    {
        return state.borrow_and_update().clone();
    }
    std::future::pending().await
}

/// The state as the page reads it; `error` is why a request was refused, or empty.
pub(super) fn replay_json(state: &v1::ReplayState, error: &str) -> String {
    let phase = state.phase().as_str_name().trim_start_matches("REPLAY_PHASE_").to_lowercase();
    let rate = if state.rate.is_finite() { json!(state.rate) } else { json!("max") };
    json!({
        "type": "replay", "phase": phase, "rate": rate, "repeat": state.repeat, "lockstep": state.lockstep,
        "as_live": state.as_live, "jumps": state.jumps, "readers_awaited": state.readers_awaited,
        "begin_ns": state.begin_ns.to_string(), "end_ns": state.end_ns.to_string(),
        "from_ns": state.from_ns.to_string(), "to_ns": state.to_ns.to_string(),
        "position_ns": state.position_ns.to_string(), "error": error,
    })
    .to_string()
}

impl PageReplay {
    /// Carries out a request, and answers it with the state after it.
    pub fn answer(&self, request: &ReplayRequest) -> impl Future<Output = String> + Send + use<> {
        let request = match self.may_control {
            true => request.to_control(),
            false => Err("the role operator is needed to control the replay".to_owned()),
        };
        let handle = self.handle.clone();
        async move {
            let outcome = match request {
                Err(error) => Err(error),
                Ok(request) => handle.control(request).await.map_err(|error| error.to_string()),
            };
            match outcome {
                Ok(state) => replay_json(&state, ""),
                Err(error) => replay_json(&handle.state().borrow(), &error),
            }
        }
    }
}

/// A request of the time bar.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct ReplayRequest {
    seek_ns: Option<String>,
    rate: Option<serde_json::Value>,
    repeat: Option<bool>,
    lockstep: Option<bool>,
    paused: Option<bool>,
    step: Option<u32>,
}

impl ReplayRequest {
    fn to_control(&self) -> Result<v1::ReplayControl, String> {
        let seek_ns =
            self.seek_ns.as_ref().map(|text| text.parse().map_err(|_| format!("seek_ns {text:?}: no integer")));
        let rate = self.rate.as_ref().map(|rate| match (rate.as_f64(), rate.as_str()) {
            (Some(rate), _) => Ok(rate),
            (None, Some("max")) => Ok(f64::INFINITY),
            _ => Err(format!("rate {rate}: a number or \"max\" is allowed")),
        });
        Ok(v1::ReplayControl {
            seek_ns: seek_ns.transpose()?,
            rate: rate.transpose()?,
            repeat: self.repeat,
            lockstep: self.lockstep,
            paused: self.paused,
            step: self.step,
            ..Default::default()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay_control::Command;

    #[tokio::test]
    async fn a_step_that_waits_holds_up_no_request_after_it() {
        let (handle, mut input) = ReplayHandle::new(v1::ReplayState::default());
        let page = PageReplay { handle, may_control: true };
        let [step, pause] =
            [r#"{"step":1}"#, r#"{"paused":true}"#].map(|text| page.answer(&serde_json::from_str(text).unwrap()));
        let mut step = tokio::spawn(step);
        let answers = async {
            let mut step = None;
            while let Some(Command::Change(request, outcome)) = input.commands.recv().await {
                if request.step.is_some() {
                    step = Some(outcome);
                } else {
                    let paused = v1::ReplayState { jumps: 7, ..Default::default() };
                    outcome.send(Ok(paused)).unwrap();
                    // The step is still owed.
                    return step;
                }
            }
            None
        };
        let (answer, owed) = tokio::join!(pause, answers);
        assert!(answer.contains("\"jumps\":7"), "{answer}");
        assert!(futures::poll!(&mut step).is_pending());
        drop(owed);
    }

    #[test]
    fn a_request_of_the_page_is_read_whole_or_refused() {
        let request = |text: &str| serde_json::from_str::<ReplayRequest>(text).map_err(|e| e.to_string())?.to_control();
        let control = request(r#"{"seek_ns":"1700000000123456789","rate":"max","paused":true}"#).unwrap();
        assert_eq!((control.seek_ns, control.paused), (Some(1_700_000_000_123_456_789), Some(true)));
        assert_eq!(control.rate, Some(f64::INFINITY));
        assert!(request(r#"{"seek_ns":"soon"}"#).is_err() && request(r#"{"jump":1}"#).is_err());
    }
}
