//! The keys of a terminal: a line of stdin -> what it asks of the replay.

use std::io::{BufRead, IsTerminal};

use clearway_proto::v1::{ReplayControl, ReplayPhase, ReplayState};
use tokio::runtime::Handle;

use super::state::line as describe;
use clearway_daemon::replay::ReplayHandle;

/// The keys, as they are printed at the start.
pub const KEYS: &str = "keys, each with Enter: p pause or play, n next map, SECONDS seek, < and > 5 s back and forward, \
                        + and - faster and slower, m max speed, l loop, ? state, q quit";

/// How far `<` and `>` jump, in ns. Ours.
const JUMP_NS: i64 = 5_000_000_000;

/// What a line asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum Key {
    /// A change of the replay.
    Control(ReplayControl),
    /// The state, as a line.
    State,
    /// The end of the replay.
    Quit,
}

/// What a line asks of a replay in this state; `None` if it is no key.
pub fn key(line: &str, state: &ReplayState) -> Option<Key> {
    let nothing = ReplayControl::default();
    let seek =
        |ns: i64| ReplayControl { seek_ns: Some(ns.clamp(state.from_ns, state.to_ns)), ..ReplayControl::default() };
    let rate = |factor: f64| {
        let now = if state.rate.is_finite() { state.rate } else { 1.0 };
        ReplayControl { rate: Some((now * factor).clamp(0.1, 1000.0)), ..ReplayControl::default() }
    };
    let is_still = matches!(state.phase(), ReplayPhase::Paused | ReplayPhase::Ended);
    let control = match line.trim() {
        "p" if state.phase() == ReplayPhase::Ended => ReplayControl { paused: Some(false), ..seek(state.from_ns) },
        "p" => ReplayControl { paused: Some(!is_still), ..nothing },
        "n" => ReplayControl { step: Some(1), ..nothing },
        "<" => seek(state.position_ns.saturating_sub(JUMP_NS)),
        ">" => seek(state.position_ns.saturating_add(JUMP_NS)),
        "+" => rate(2.0),
        "-" => rate(0.5),
        "m" => ReplayControl { rate: Some(f64::INFINITY), ..nothing },
        "l" => ReplayControl { repeat: Some(!state.repeat), ..nothing },
        "?" => return Some(Key::State),
        "q" => return Some(Key::Quit),
        seconds => match seconds.parse::<f64>() {
            // Not clamped: a time outside is refused with what is allowed.
            Ok(at) if at.is_finite() => {
                ReplayControl { seek_ns: Some(state.begin_ns.saturating_add((at * 1e9) as i64)), ..nothing }
            }
            _ => return None,
        },
    };
    Some(Key::Control(control))
}

/// Follows the keys in a thread, if stdin is a terminal. The thread ends with the process.
pub fn follow(replay: ReplayHandle, runtime: Handle) {
    if !std::io::stdin().is_terminal() {
        return;
    }
    eprintln!("{KEYS}");
    let read = move || obey(std::io::stdin().lock(), &replay, &runtime);
    if let Err(error) = std::thread::Builder::new().name("keys".to_owned()).spawn(read) {
        tracing::warn!(%error, "no thread for the keys");
    }
}

/// Does what each line asks for.
fn obey(lines: impl BufRead, replay: &ReplayHandle, runtime: &Handle) {
    for line in lines.lines().map_while(Result::ok) {
        let state = replay.state().borrow().clone();
        match key(&line, &state) {
            None => eprintln!("{KEYS}"),
            Some(Key::State) => eprintln!("{}", describe(&state)),
            Some(Key::Quit) => replay.stop(),
            // A step waits for its maps; the next key does not.
            Some(Key::Control(request)) => drop(runtime.spawn(control(replay.clone(), request))),
        }
    }
}

/// Changes how the replay goes on, and prints its state after that.
async fn control(replay: ReplayHandle, request: ReplayControl) {
    match replay.control(request).await {
        Ok(state) => eprintln!("{}", describe(&state)),
        Err(error) => eprintln!("{error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clearway_daemon::replay::control::Command;

    #[test]
    fn a_step_that_waits_holds_up_no_key_after_it() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let (replay, mut input) = ReplayHandle::new(ReplayState { to_ns: 9, end_ns: 9, ..Default::default() });
        // Nothing answers the step.
        obey(&b"n\np\n"[..], &replay, runtime.handle());
        let requests = [input.commands.blocking_recv(), input.commands.blocking_recv()];
        let of = |command: &Option<Command>| match command {
            Some(Command::Change(request, _)) => (request.step, request.paused),
            other => panic!("{other:?}"),
        };
        let mut requests = requests.each_ref().map(of);
        requests.sort();
        assert_eq!(requests, [(None, Some(true)), (Some(1), None)]);
    }

    #[test]
    fn a_line_asks_for_what_its_key_says() {
        let mut state = ReplayState { end_ns: 60_000_000_000, to_ns: 60_000_000_000, rate: 1.0, ..Default::default() };
        (state.position_ns, state.phase) = (3_000_000_000, ReplayPhase::Playing.into());
        let control = |line: &str, state: &ReplayState| match key(line, state) {
            Some(Key::Control(control)) => control,
            other => panic!("{line}: {other:?}"),
        };
        assert_eq!(control("p", &state).paused, Some(true));
        assert_eq!(control(" 12.5 ", &state).seek_ns, Some(12_500_000_000));
        assert_eq!(control("<", &state).seek_ns, Some(0), "no further than the begin");
        assert_eq!(control("+", &state).rate, Some(2.0));
        state.set_phase(ReplayPhase::Ended);
        assert_eq!(control("p", &state).seek_ns, Some(0), "it begins again");
        assert_eq!((key("q", &state), key("x", &state), key("nan", &state)), (Some(Key::Quit), None, None));
    }
}
