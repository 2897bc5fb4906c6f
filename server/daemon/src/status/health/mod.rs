//! How well a vehicle is served: what is known of it at one time -> `ok`, `warn` or `error`, with reasons in words.
//!
//! Pure: [`findings`] is a function of [`Facts`], and [`Health`] adds what is remembered from one assessment to the
//! next. A worse state is believed at once, a better state only after [`BETTER_AFTER`].

use std::time::Duration;

use clearway_proto::v1::ReplayPhase;

/// Time without a packet after which a sensor is silent. Ours: ten revolutions of the slowest sensor, and more than two
/// scans a second need.
pub const SILENT_AFTER: Duration = Duration::from_secs(2);
/// Time for which the newest map must be older than its validity before that is an error. Ours: a second; planners are
/// told at once, but one late map is no alarm.
const STALE_ERROR_AFTER: Duration = Duration::from_secs(1);
/// Time for which a better state must last. Ours: an operator reads one state instead of a flicker.
const BETTER_AFTER: Duration = Duration::from_secs(3);
/// Sensors that have a reason each; more of them have one in common. Ours: two lines are read at a glance.
const APART_MAX: usize = 2;
/// Share of lost packets above which a vehicle warns, and below which it no longer does. Ours: 1 % is one packet in
/// each revolution of a VLP-16 of 76 packets.
const LOSS_WARNS: f64 = 0.01;
const LOSS_ENDS: f64 = 0.005;
/// Completeness of the newest revolution below which a sensor warns. Ours.
const COMPLETENESS_MIN: f32 = 0.9;
/// Greatest ratio of a revolution's packets to the packets that its model sends; above it they are of another model.
/// Ours: an HDL-32E, which can be read as a VLP-16, sends 2.4 times as many.
const MODEL_PACKETS_MAX: f64 = 1.5;

/// State of a vehicle, better states first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum State {
    /// Fresh maps are made, and nothing is known to be wrong.
    Ok,
    /// Maps are made, but something is wrong with them or with an input.
    Warn,
    /// No fresh map is made.
    #[default]
    Error,
}

impl State {
    /// The name on the wire and in metrics.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Error => "error",
        }
    }

    /// All states, from the best to the worst.
    pub const ALL: [Self; 3] = [Self::Ok, Self::Warn, Self::Error];
}

/// What is known of a vehicle at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Facts {
    /// What of the vehicle has stopped or hangs.
    pub fault: Option<String>,
    /// Time since the server started.
    pub up: Duration,
    /// True if its maps have a layer, so that maps are expected.
    pub makes_maps: bool,
    /// Age of the newest map; `None` before the first.
    pub map_age: Option<Duration>,
    /// Time by which the capture of the newest map is ahead of the server's clock.
    pub map_ahead: Duration,
    /// Time since the newest map that was fresh when it was published.
    pub not_fresh_for: Duration,
    /// Age at which a map is stale.
    pub validity: Duration,
    /// True if the maps carry the stamps of a recording, so that their age is not counted by the server's clock.
    pub has_recorded_stamps: bool,
    /// Phase of the replay that makes the maps, and since when it lasts; `None` if they are made live.
    pub replay: Option<(ReplayPhase, Duration)>,
    /// What the replay waits for in lockstep; empty: nothing.
    pub replay_awaited: String,
    /// Facts of each of the vehicle's sensors.
    pub sensors: Vec<SensorFacts>,
    /// The addresses that sent datagrams in the last seconds and are none of the vehicle's sensors.
    pub unknown_senders: Vec<String>,
    /// Share of the packets of the last 10 s that were lost or refused, 0 to 1; `None` if none was expected.
    pub loss: Option<f64>,
    /// Fault of the recording, in words; `None` if there is none.
    pub recorder_problem: Option<String>,
    /// What is wrong with the long-term store.
    pub store_problem: Option<String>,
    /// What is wrong with the server's network.
    pub network_problems: Vec<String>,
    /// Other servers that serve a vehicle of the same name.
    pub claimed_by: Vec<String>,
}

/// What is known of one sensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorFacts {
    /// Name of the sensor.
    pub name: String,
    /// Time since its newest packet or scan that could be read; `None` before the first.
    pub silent: Option<Duration>,
    /// True if packets of it have arrived in the last seconds, but none of them could be read.
    pub is_refused: bool,
    /// Why its newest scan is not, or not as it should be, in the newest map: "late", "ahead", "empty",
    /// "silent"; else empty.
    pub left_out: String,
    /// Share of the sensor's newest revolution that is covered, 0 to 1.
    pub completeness: Option<f32>,
    /// Packets of its newest revolution, if it is whole, and how many its model sends in one.
    pub packets: Option<[u32; 2]>,
    /// Name of the clock in use.
    pub clock: String,
    /// Time by which the host's clock is ahead of the sensor's, in ms.
    pub clock_offset_ms: i64,
    /// The senders that send its data at once, if there are several.
    pub senders: Vec<String>,
    /// Width of the sectors that have lost their returns, in degrees.
    pub blocked_deg: f64,
    /// What is remarkable about the values that it sends.
    pub remarks: Vec<String>,
    /// Height (m), pitch and roll (degrees) by which the ground contradicts the configured mount, if it does.
    pub mount: Option<[f64; 3]>,
}

/// One thing that is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// State that the finding causes.
    pub state: State,
    /// The fault, in words.
    pub text: String,
}

/// The assessment of one vehicle, with what is remembered between two of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Health {
    state: State,
    /// Since when the state lasts.
    since: Duration,
    reasons: Vec<String>,
    /// Since when a better state lasts.
    better_since: Option<Duration>,
    /// True once a state was better than the first.
    was_better: bool,
    is_lossy: bool,
}

impl Health {
    /// Assesses the vehicle at `facts.up`, which never goes back. True if the state has changed.
    pub fn update(&mut self, facts: &Facts) -> bool {
        self.is_lossy = facts.loss > Some(if self.is_lossy { LOSS_ENDS } else { LOSS_WARNS });
        let findings = findings(facts, self.is_lossy);
        let found = findings.first().map_or(State::Ok, |worst| worst.state);
        let before = self.state;
        if found >= self.state {
            self.better_since = None;
        } else {
            let since = *self.better_since.get_or_insert(facts.up);
            // The first maps of a server are no recovery, and neither is a pause that a user asked for.
            if self.was_better && !is_paused(facts) && facts.up.saturating_sub(since) < BETTER_AFTER {
                return false;
            }
            (self.was_better, self.better_since) = (true, None);
        }
        if found != before {
            self.since = facts.up;
        }
        self.state = found;
        self.reasons = findings.into_iter().map(|finding| finding.text).collect();
        self.state != before
    }

    /// State of the newest assessment.
    pub fn state(&self) -> State {
        self.state
    }

    /// Since when the state lasts, as the time since the server started.
    pub fn since(&self) -> Duration {
        self.since
    }

    /// Why it is not `ok`, worst first.
    pub fn reasons(&self) -> &[String] {
        &self.reasons
    }
}

/// Everything that is wrong, worst first; equally bad things in the order of the data's way.
fn findings(facts: &Facts, is_lossy: bool) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut add = |state, text: String| findings.push(Finding { state, text });
    if let Some(fault) = &facts.fault {
        add(State::Error, fault.clone());
    }
    silence(facts, &mut add);
    staleness(facts, &mut add);
    omission(facts, &mut add);
    for sensor in &facts.sensors {
        sensor_findings(sensor, facts.validity, &mut add);
    }
    if let Some(loss) = facts.loss.filter(|_| is_lossy) {
        add(State::Warn, format!("{:.1} % of the packets of the last 10 s were lost or refused", 100.0 * loss));
    }
    if !facts.unknown_senders.is_empty() {
        let senders = facts.unknown_senders.join(", ");
        add(State::Warn, format!("datagrams of {senders} are refused: vehicle.udp.from names other senders"));
    }
    if let Some(problem) = &facts.recorder_problem {
        add(State::Warn, format!("recorder: {problem}"));
    }
    if let Some(problem) = &facts.store_problem {
        add(State::Warn, problem.clone());
    }
    for problem in &facts.network_problems {
        add(State::Warn, problem.clone());
    }
    for server in &facts.claimed_by {
        add(State::Warn, format!("server {server} serves a vehicle of the same name"));
    }
    findings.sort_by_key(|finding| std::cmp::Reverse(finding.state));
    findings
}

/// Why a replay stands still; `None` if it plays, or nothing is replayed.
fn standing(facts: &Facts) -> Option<String> {
    let awaited = &facts.replay_awaited;
    match facts.replay?.0 {
        ReplayPhase::Waiting => Some("the replay waits for readers".to_owned()),
        ReplayPhase::Paused => Some("the replay is paused".to_owned()),
        ReplayPhase::Ended => Some("the replay has ended".to_owned()),
        ReplayPhase::Playing if !awaited.is_empty() => Some(format!("the replay waits for {awaited}")),
        ReplayPhase::Playing | ReplayPhase::Unspecified => None,
    }
}

fn is_paused(facts: &Facts) -> bool {
    matches!(facts.replay, Some((ReplayPhase::Paused, _)))
}

/// True if packets and maps are expected: of live sensors, and of a replay that has played for a while.
fn expects_data(facts: &Facts) -> bool {
    let plays = |(_, since)| standing(facts).is_none() && since > SILENT_AFTER;
    facts.replay.is_none_or(plays)
}

/// Sensors from which nothing arrives. One silent sensor of several is a warning, because the others make maps.
fn silence(facts: &Facts, add: &mut impl FnMut(State, String)) {
    if !expects_data(facts) {
        return;
    }
    if facts.sensors.iter().all(|sensor| sensor.silent.is_none() && !sensor.is_refused) {
        let names = facts.sensors.iter().map(|sensor| sensor.name.as_str()).collect::<Vec<_>>().join(", ");
        let from = if names.is_empty() { String::new() } else { format!(" from {names}") };
        add(State::Error, format!("no packets{from} since the server started {} ago", seconds(facts.up)));
        return;
    }
    let age = |sensor: &SensorFacts| sensor.silent.unwrap_or(facts.up);
    let silent: Vec<_> = facts.sensors.iter().filter(|sensor| age(sensor) > SILENT_AFTER).collect();
    let state = if silent.len() == facts.sensors.len() { State::Error } else { State::Warn };
    if silent.len() > APART_MAX && !silent.iter().any(|sensor| sensor.is_refused) {
        let longest = seconds(silent.iter().map(|sensor| age(sensor)).max().unwrap_or_default());
        add(state, in_common(facts, &silent, &format!("silent for {longest}"), |_| ""));
        return;
    }
    for sensor in silent {
        let (name, refused) = (&sensor.name, if sensor.is_refused { "readable " } else { "" });
        add(
            state,
            match sensor.silent {
                Some(silent) => format!("no {refused}packets from {name} for {}", seconds(silent)),
                None => format!("no {refused}packets from {name} since the server started {} ago", seconds(facts.up)),
            },
        );
    }
}

/// Sensors whose scans are not, or not as they should be, in the newest map, although they send.
fn omission(facts: &Facts, add: &mut impl FnMut(State, String)) {
    let is_left_out = |sensor: &&SensorFacts| !is_silent(sensor) && !sensor.left_out.is_empty();
    let left_out: Vec<_> = facts.sensors.iter().filter(is_left_out).collect();
    if left_out.len() > APART_MAX {
        add(State::Warn, in_common(facts, &left_out, "left out of the newest map", |sensor| &sensor.left_out));
        return;
    }
    for SensorFacts { name, left_out, .. } in left_out {
        add(State::Warn, format!("{name} is left out of the newest map: its scan is {left_out}"));
    }
}

/// One reason for many sensors, with a remark for each.
fn in_common(facts: &Facts, of: &[&SensorFacts], what: &str, remark: impl Fn(&SensorFacts) -> &str) -> String {
    let named = |sensor: &&SensorFacts| format!("{} {}", sensor.name, remark(sensor)).trim_end().to_owned();
    let names = of.iter().map(named).collect::<Vec<_>>().join(", ");
    format!("{} of {} sensors {what}: {names}", of.len(), facts.sensors.len())
}

fn is_silent(sensor: &SensorFacts) -> bool {
    sensor.silent.is_none_or(|silent| silent > SILENT_AFTER)
}

fn staleness(facts: &Facts, add: &mut impl FnMut(State, String)) {
    if !facts.makes_maps {
        return;
    }
    let standing = standing(facts);
    let stands = standing.is_some();
    // A pause is what a user asked for, and so is what follows from it.
    let warn = if is_paused(facts) { State::Ok } else { State::Warn };
    standing.into_iter().for_each(|why| add(warn, why));
    let Some(age) = facts.map_age else {
        if expects_data(facts) {
            add(State::Error, "no map yet".to_owned());
        }
        return;
    };
    if facts.has_recorded_stamps {
        add(warn, "maps are replayed with the stamps of the recording: readers call them stale".to_owned());
    }
    // A replay that stands still does what it was asked to do.
    let is_long = !stands && age.max(facts.not_fresh_for) > facts.validity + STALE_ERROR_AFTER;
    let state = if is_long { State::Error } else { warn };
    // A map with the stamp of the recording does not age while the replay stands still.
    if age > facts.validity && (expects_data(facts) || !facts.has_recorded_stamps) {
        add(state, format!("the newest map is {} old, and valid for {}", seconds(age), seconds(facts.validity)));
    } else if facts.map_ahead > facts.validity {
        let ahead = seconds(facts.map_ahead);
        add(state, format!("the stamps are {ahead} ahead of this server's clock: readers call the maps stale"));
    }
}

fn sensor_findings(sensor: &SensorFacts, validity: Duration, add: &mut impl FnMut(State, String)) {
    let name = &sensor.name;
    if let Some([height_m, pitch_deg, roll_deg]) = sensor.mount {
        let place = if height_m < 0.0 { "lower" } else { "higher" };
        let tilt = if pitch_deg.abs().max(roll_deg.abs()) < 0.5 {
            String::new()
        } else {
            format!(", and the ground is tilted by {pitch_deg:+.1} deg in pitch and {roll_deg:+.1} deg in roll")
        };
        let height = height_m.abs();
        add(State::Warn, format!("{name} is {height:.1} m {place} over the ground than configured{tilt}"));
    }
    if is_silent(sensor) {
        return;
    }
    sensor.remarks.iter().for_each(|remark| add(State::Warn, format!("{name}: {remark}")));
    if !sensor.senders.is_empty() {
        let senders = sensor.senders.join(", ");
        add(State::Warn, format!("several send the data of {name}, each in place of the others': {senders}"));
    }
    if let Some(completeness) = sensor.completeness.filter(|share| *share < COMPLETENESS_MIN) {
        add(State::Warn, format!("{name} covers {:.0} % of its revolution", 100.0 * completeness));
    }
    if let Some([packets, of_model]) = sensor.packets
        && f64::from(packets) > MODEL_PACKETS_MAX * f64::from(of_model)
    {
        let text = "packets a revolution, more than its model: check `model` of the sensor";
        add(State::Warn, format!("{name} sends {packets} instead of {of_model} {text}"));
    }
    if sensor.blocked_deg > 0.0 {
        add(State::Warn, format!("{:.0} deg of {name} are blocked", sensor.blocked_deg));
    }
    if sensor.clock == "holdover" || sensor.clock == "gps_unlocked" {
        add(State::Warn, format!("the clock of {name} is {}", sensor.clock));
    }
    // Beyond half of it maps may be stale when they are made, or of the future.
    if !validity.is_zero() && u128::from(sensor.clock_offset_ms.unsigned_abs()) > validity.as_millis() / 2 {
        let offset_s = sensor.clock_offset_ms.unsigned_abs() as f64 / 1e3;
        let way = if sensor.clock_offset_ms < 0 { "behind" } else { "ahead of" };
        add(State::Warn, format!("the host's clock is {offset_s:.1} s {way} the clock of {name}"));
    }
}

/// A duration for people: tenths of a second below ten seconds.
pub(super) fn seconds(duration: Duration) -> String {
    let seconds = duration.as_secs_f64();
    if seconds < 9.95 { format!("{seconds:.1} s") } else { format!("{seconds:.0} s") }
}

#[cfg(test)]
mod tests;
