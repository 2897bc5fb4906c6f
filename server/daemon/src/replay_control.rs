//! What clients may ask of a replay, and how they reach it: checked [`v1::ReplayControl`] requests -> the thread that
//! replays; its [`v1::ReplayState`] -> clients.

use clearway_proto::v1;
use tokio::sync::{mpsc, oneshot, watch};

/// Least and greatest finite rate. Ours: below a tenth a map a second is due; no machine makes maps a thousand times
/// faster than a sensor.
pub const RATES: std::ops::RangeInclusive<f64> = 0.1..=1000.0;
/// Most maps of one step. Ours: a day of a 10 Hz sensor.
pub const STEP_MAX: u32 = 1_000_000;

/// A request that a replay refuses; nothing has changed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ControlError {
    /// The rate is not allowed.
    #[error("rate {0}: 0.1 to 1000 is allowed, or infinity for as fast as possible")]
    Rate(f64),
    /// The number of maps of a step is not allowed.
    #[error("step {0}: 1 to {STEP_MAX} maps are allowed")]
    Step(u32),
    /// A time lies outside the recording, or outside the range that is played.
    #[error(
        "{what} {} s: the replay plays {} s to {} s, counted from its first event",
        to_microseconds(*at_s), to_microseconds(*from_s), to_microseconds(*to_s)
    )]
    Outside {
        /// Field of the request with the time.
        what: &'static str,
        /// The requested time, in seconds after the first event.
        at_s: f64,
        /// Begin of the played range, in seconds after the first event.
        from_s: f64,
        /// End of the played range, in seconds after the first event.
        to_s: f64,
    },
    /// The range ends before it begins.
    #[error("from {} s, to {} s: the range must end after it begins", to_microseconds(*from_s), to_microseconds(*to_s))]
    Range {
        /// Begin, in seconds after the first event.
        from_s: f64,
        /// End, in seconds after the first event.
        to_s: f64,
    },
    /// The replay is recorded, and the recording's events must follow each other.
    #[error("{0}: the replay is recorded (--record), and a recording has no jumps")]
    Recorded(&'static str),
    /// The replay has ended or failed.
    #[error("the replay is over")]
    Over,
}

impl From<ControlError> for tonic::Status {
    fn from(error: ControlError) -> Self {
        let text = error.to_string();
        match error {
            ControlError::Rate(_) | ControlError::Step(_) | ControlError::Range { .. } => Self::invalid_argument(text),
            ControlError::Outside { .. } => Self::out_of_range(text),
            ControlError::Recorded(_) => Self::failed_precondition(text),
            ControlError::Over => Self::unavailable(text),
        }
    }
}

/// A number of seconds with at least three and at most six decimals, so that two that differ look different.
fn to_microseconds(seconds: f64) -> String {
    let text = format!("{seconds:.6}");
    let (milliseconds, rest) = text.split_at(text.len() - 3);
    format!("{milliseconds}{}", rest.trim_end_matches('0'))
}

/// Checks a rate.
///
/// # Errors
/// [`ControlError::Rate`] if it is not a number within [`RATES`] and not infinity.
pub fn check_rate(rate: f64) -> Result<f64, ControlError> {
    let is_allowed = RATES.contains(&rate) || rate == f64::INFINITY;
    if is_allowed { Ok(rate) } else { Err(ControlError::Rate(rate)) }
}

/// Checks a request against the state of the replay, and returns the range that it leads to.
///
/// # Errors
/// [`ControlError`] for the first field that is not allowed.
pub fn check(
    request: &v1::ReplayControl,
    state: &v1::ReplayState,
    is_recorded: bool,
) -> Result<(i64, i64), ControlError> {
    let seconds = |ns: i64| ns.saturating_sub(state.begin_ns) as f64 * 1e-9;
    let within = |what, at: Option<i64>, (from, to): (i64, i64)| match at {
        Some(at) if !(from..=to).contains(&at) => {
            Err(ControlError::Outside { what, at_s: seconds(at), from_s: seconds(from), to_s: seconds(to) })
        }
        _ => Ok(()),
    };
    let files = (state.begin_ns, state.end_ns);
    within("from", request.from_ns, files)?;
    within("to", request.to_ns, files)?;
    let (from, to) = (request.from_ns.unwrap_or(state.from_ns), request.to_ns.unwrap_or(state.to_ns));
    // A drive of one scan begins and ends at once.
    if from >= to && (request.from_ns.is_some() || request.to_ns.is_some()) {
        return Err(ControlError::Range { from_s: seconds(from), to_s: seconds(to) });
    }
    within("seek", request.seek_ns, (from, to))?;
    request.rate.map(check_rate).transpose()?;
    if let Some(step) = request.step.filter(|step| !(1..=STEP_MAX).contains(step)) {
        return Err(ControlError::Step(step));
    }
    let jump = [("seek", request.seek_ns.is_some()), ("repeat", request.repeat == Some(true))];
    match jump.iter().find(|(_, jumps)| *jumps && is_recorded) {
        Some((what, _)) => Err(ControlError::Recorded(what)),
        None => Ok((from, to)),
    }
}

/// What the thread that replays is asked.
#[derive(Debug)]
pub enum Command {
    /// A change, and where its outcome goes.
    Change(v1::ReplayControl, oneshot::Sender<Result<v1::ReplayState, ControlError>>),
    /// The replay is to end.
    Stop,
}

/// Controls a replay. Clones control the same one.
#[derive(Clone, Debug)]
pub struct ReplayHandle {
    commands: mpsc::UnboundedSender<Command>,
    state: watch::Receiver<v1::ReplayState>,
}

/// The other end of a [`ReplayHandle`].
#[derive(Debug)]
pub struct ReplayInput {
    /// The requests, in order.
    pub commands: mpsc::UnboundedReceiver<Command>,
    /// The state, which all handles see.
    pub state: watch::Sender<v1::ReplayState>,
}

impl ReplayHandle {
    /// A handle, and the input on which the replay receives its requests.
    pub fn new(state: v1::ReplayState) -> (Self, ReplayInput) {
        let (commands, requests) = mpsc::unbounded_channel();
        let (sender, state) = watch::channel(state);
        (Self { commands, state }, ReplayInput { commands: requests, state: sender })
    }

    /// Changes how the replay goes on; returns the state after the change.
    ///
    /// # Errors
    /// [`ControlError`]; then nothing has changed.
    pub async fn control(&self, request: v1::ReplayControl) -> Result<v1::ReplayState, ControlError> {
        let (outcome, answer) = oneshot::channel();
        self.commands.send(Command::Change(request, outcome)).map_err(|_| ControlError::Over)?;
        answer.await.map_err(|_| ControlError::Over)?
    }

    /// The state, which changes as the replay goes on.
    pub fn state(&self) -> watch::Receiver<v1::ReplayState> {
        self.state.clone()
    }

    /// Ends the replay before the end of its files.
    pub fn stop(&self) {
        // Fails if it has ended already.
        let _ = self.commands.send(Command::Stop);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_outside_what_is_allowed_is_refused_with_what_is() {
        let state = v1::ReplayState { end_ns: 12_000_000_000, to_ns: 12_000_000_000, ..Default::default() };
        let refused = |request: v1::ReplayControl| check(&request, &state, false).unwrap_err().to_string();
        let seek = |seek_ns| v1::ReplayControl { seek_ns: Some(seek_ns), ..Default::default() };
        assert_eq!(
            refused(seek(99_000_000_000)),
            "seek 99.000 s: the replay plays 0.000 s to 12.000 s, counted from its first event"
        );
        assert!(refused(seek(12_000_100_000)).starts_with("seek 12.0001 s: the replay plays 0.000 s to 12.000 s"));
        for rate in [0.0, -1.0, f64::NAN, 0.05, 1e6] {
            let text = refused(v1::ReplayControl { rate: Some(rate), ..Default::default() });
            assert!(text.contains("0.1 to 1000 is allowed"), "{text}");
        }
        let one_scan = v1::ReplayState::default();
        assert_eq!(check(&v1::ReplayControl::default(), &one_scan, false), Ok((0, 0)));
        let range = v1::ReplayControl { from_ns: Some(5), to_ns: Some(5), ..Default::default() };
        assert!(refused(range).contains("must end after it begins"));
        assert!(refused(v1::ReplayControl { step: Some(0), ..Default::default() }).contains("1 to 1000000"));
        assert_eq!(check(&seek(5), &state, true), Err(ControlError::Recorded("seek")));
        assert_eq!(check(&seek(5), &state, false), Ok((0, 12_000_000_000)));
    }
}
