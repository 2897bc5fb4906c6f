//! The thread of a replay: takes the readings of a timeline when they are due, and steps the engines with them.
//!
//! One thread does everything, so a pause is a thread that waits, and a jump exchanges pipelines between two steps.
//! Readings and observations of live clients pass through the vehicles' event queues as ever.

use std::time::{Duration, Instant};

use clearway_daemon::base::clock::now_ns;
use clearway_daemon::base::counted::counted;
use clearway_daemon::replay_control::{Command, ControlError, ReplayInput, check};
use clearway_proto::v1::{self, ReplayPhase};
use tokio::runtime::Handle;
use tokio::sync::oneshot;

use super::clock::ReplayClock;
use super::outcome::{PlayError, Played};
use super::snapshots::{Snapshot, Snapshots};
use super::timeline::{Ahead, Timeline};
use super::vehicle::{ReplayedVehicle, report_refused};
use crate::files::FilesError;

/// Interval at which a waiting replay looks for live observations and readers. Ours: short beside a revolution.
const POLL: Duration = Duration::from_millis(20);
/// Least time between two reports of the position. Ours: what a time bar shows.
const REPORT: Duration = Duration::from_millis(100);
/// Waits shorter than this are slept exactly; tokio's timers have a millisecond.
const EXACT: Duration = Duration::from_millis(2);
/// Time behind the drive from which a replay says so. Ours: the default validity of a map.
pub const BEHIND_MAX: Duration = Duration::from_millis(300);
/// Longest wait for readers to leave after the end, if the replay ends there. Ours: they have been told.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(2);

/// Maps that a client has asked for, after which the replay pauses.
struct Step {
    /// Number of maps that are not made yet.
    left: u32,
    /// Takes the state when they are made.
    outcome: oneshot::Sender<Result<v1::ReplayState, ControlError>>,
}

/// What a replay does besides what clients can change ([`v1::ReplayState`]).
#[derive(Clone, Copy, Debug)]
pub struct PlayerOptions {
    /// The replay is published: clients can control it, and it waits for a stop after its end.
    pub is_served: bool,
    /// The replay is recorded, so it cannot jump.
    pub is_recorded: bool,
    /// Ends after the end of the range.
    pub exits_at_end: bool,
    /// Pauses before the first reading, after the readers that it waits for have come.
    pub begins_paused: bool,
    /// Longest wait for the acknowledgement of a map in lockstep.
    pub acknowledge_timeout: Duration,
    /// The boot id that maps are served with, if their header differs from the recorded one; each jump adds 1.
    pub boot_id: u64,
}

/// Why the player leaves its loop before the end.
#[derive(Debug, thiserror::Error)]
enum Interrupt {
    #[error("stopped")]
    Stopped,
    #[error(transparent)]
    Failed(#[from] PlayError),
}

/// A map that readers have to acknowledge before the replay goes on.
#[derive(Clone, Copy)]
struct AwaitedMap {
    vehicle: usize,
    sequence: u64,
    since: Instant,
}

/// Plays the readings of all vehicles through their engines, at the rate of the clock.
pub struct Player {
    timeline: Timeline,
    vehicles: Vec<ReplayedVehicle>,
    input: ReplayInput,
    options: PlayerOptions,
    state: v1::ReplayState,
    reported: Instant,
    clock: ReplayClock,
    readings: Ahead,
    /// Number of readings taken.
    taken: u64,
    /// Recorded time of the newest of them.
    newest_ns: Option<i64>,
    snapshots: Snapshots,
    step: Option<Step>,
    awaited: Option<AwaitedMap>,
    /// Greatest time by which an event was too late.
    behind_max: Duration,
    runtime: Handle,
}

impl Player {
    /// A replay before its first reading. `input.state` holds how it begins.
    ///
    /// # Errors
    /// [`FilesError`] if a file cannot be opened.
    pub fn new(
        timeline: Timeline,
        vehicles: Vec<ReplayedVehicle>,
        input: ReplayInput,
        options: PlayerOptions,
        runtime: Handle,
    ) -> Result<Self, FilesError> {
        let state = input.state.borrow().clone();
        let readings = timeline.start(0)?;
        vehicles.iter().for_each(|vehicle| vehicle.engine.set_replay_phase(state.phase()));
        let copies = vehicles.iter().filter(|_| options.is_served).map(ReplayedVehicle::copy).collect();
        Ok(Self {
            clock: ReplayClock::new(state.rate),
            snapshots: Snapshots::new(copies),
            reported: Instant::now(),
            timeline,
            vehicles,
            input,
            options,
            state,
            readings,
            taken: 0,
            newest_ns: None,
            step: None,
            awaited: None,
            behind_max: Duration::ZERO,
            runtime,
        })
    }

    /// Replays until the end of the range or until it is stopped; a served replay waits there for commands.
    ///
    /// # Errors
    /// [`PlayError`].
    pub fn run(mut self) -> Result<Played, PlayError> {
        let reached_end = match self.play() {
            Ok(()) => true,
            Err(Interrupt::Stopped) => self.state.phase() == ReplayPhase::Ended,
            Err(Interrupt::Failed(error)) => return Err(error),
        };
        let remarks = self.readings.end().map(std::mem::take).unwrap_or_default();
        Ok(Played { reached_end, behind_max: self.behind_max, remarks })
    }

    fn play(&mut self) -> Result<(), Interrupt> {
        self.await_readers()?;
        let first_ns = self.state.position_ns.max(self.state.from_ns);
        if first_ns > self.state.begin_ns {
            self.jump(first_ns, false)?;
        }
        loop {
            match self.state.phase() {
                ReplayPhase::Playing if !self.is_acknowledged()? => {
                    self.clock.pause();
                    self.wait(Instant::now())?;
                    self.step_waiting(None);
                }
                ReplayPhase::Playing => match self.readings.next_ns().map_err(PlayError::from)? {
                    Some(at_ns) if at_ns <= self.state.to_ns => self.wait_for(at_ns)?,
                    _ => self.end()?,
                },
                ReplayPhase::Ended if !self.options.is_served => return Ok(()),
                ReplayPhase::Ended if self.options.exits_at_end => {
                    self.let_readers_leave();
                    return Ok(());
                }
                _ => {
                    self.clock.pause();
                    self.wait(Instant::now() + POLL)?;
                    self.step_waiting(None);
                }
            }
        }
    }

    /// Waits until as many readers are there as the state demands.
    fn await_readers(&mut self) -> Result<(), Interrupt> {
        while self.state.phase() == ReplayPhase::Waiting {
            let readers: u32 = self.vehicles.iter().map(|vehicle| vehicle.engine.status.readers_sum()).sum();
            if readers >= self.state.readers_awaited {
                self.state.readers_awaited = 0;
                let paused = self.options.begins_paused;
                self.set_phase(if paused { ReplayPhase::Paused } else { ReplayPhase::Playing });
            } else {
                self.wait(Instant::now() + POLL)?;
            }
        }
        Ok(())
    }

    /// Steps the next reading, of recorded time `at_ns`, when it is due, unless a command comes before.
    fn wait_for(&mut self, at_ns: i64) -> Result<(), Interrupt> {
        if self.step.is_some() {
            // A step is as fast as possible, and its maps get stamps of the present.
            self.clock.restart(None);
        }
        let due = self.step.is_none().then(|| self.clock.due(at_ns, now_ns())).flatten();
        let now = Instant::now();
        let left = due.map_or(Duration::ZERO, |due| due.saturating_duration_since(now));
        self.note_delay(due.map_or(Duration::ZERO, |due| now.saturating_duration_since(due)));
        let has_command = !self.input.commands.is_empty();
        if left > EXACT || has_command {
            // The last part is slept exactly.
            let until = Instant::now() + left.saturating_sub(EXACT / 2).min(POLL);
            let waited = self.wait(until);
            self.step_waiting(None);
            return waited;
        }
        std::thread::sleep(left);
        Ok(self.take_next()?)
    }

    /// Remembers the greatest delay, and logs once that there is one.
    fn note_delay(&mut self, behind: Duration) {
        if self.behind_max <= BEHIND_MAX && behind > BEHIND_MAX {
            tracing::warn!("this machine is too slow for the rate of the replay: its maps are late");
        }
        self.behind_max = self.behind_max.max(behind);
    }

    /// Waits for one command until a time, and applies it.
    fn wait(&mut self, until: Instant) -> Result<(), Interrupt> {
        let commands = &mut self.input.commands;
        let command = self.runtime.block_on(async {
            tokio::select! {
                biased;
                command = commands.recv() => Some(command),
                () = tokio::time::sleep_until(until.into()) => None,
            }
        });
        match command {
            None => {}
            Some(Some(Command::Change(request, outcome))) => {
                match (self.change(&request)?, request.step) {
                    // Answered when its maps are made.
                    (Ok(()), Some(left)) => self.step = Some(Step { left, outcome }),
                    // Fails if the client has gone.
                    (changed, _) => _ = outcome.send(changed.map(|()| self.state.clone())),
                }
            }
            Some(Some(Command::Stop) | None) => return Err(Interrupt::Stopped),
        }
        Ok(())
    }

    /// Takes the next reading and steps its vehicle.
    fn take_next(&mut self) -> Result<(), PlayError> {
        let Some(vehicle) = self.push_next()? else { return Ok(()) };
        let made = self.step_waiting(Some(vehicle));
        if let Some(sequence) = made {
            if self.state.lockstep {
                self.awaited = Some(AwaitedMap { vehicle, sequence, since: Instant::now() });
            }
            self.copy_if_due();
            if let Some(step) = &mut self.step {
                step.left -= 1;
                if step.left == 0 {
                    self.end_step(ReplayPhase::Paused);
                }
            }
        }
        if self.reported.elapsed() >= REPORT {
            self.report();
        }
        Ok(())
    }

    /// Pushes the next reading to the queue of its vehicle; returns the vehicle.
    fn push_next(&mut self) -> Result<Option<usize>, PlayError> {
        let Some(next) = self.readings.take() else { return Ok(None) };
        self.taken += 1;
        self.newest_ns = Some(next.at_ns);
        self.state.position_ns = next.at_ns;
        let queue = &self.vehicles[next.vehicle].queue;
        report_refused(queue, next.refused);
        queue.push_captured(next.reading)?;
        Ok(Some(next.vehicle))
    }

    /// Steps the events that wait on the queue of one vehicle, or of all. Returns the sequence of the newest map, if
    /// one was made of that vehicle.
    fn step_waiting(&mut self, vehicle: Option<usize>) -> Option<u64> {
        let now_ns = now_ns();
        let (clock, state, boot_id) = (&mut self.clock, &self.state, self.options.boot_id);
        let vehicles = self.vehicles.iter_mut().enumerate();
        let mut made = None;
        for (_, ReplayedVehicle { engine, events, .. }) in vehicles.filter(|(i, _)| vehicle.is_none_or(|v| v == *i)) {
            let before = engine.maps();
            engine.wires.acknowledgements.set_lockstep(state.lockstep);
            while let Ok(queued) = events.try_recv() {
                engine.replayed = clock.replayed(state, boot_id, state.position_ns, now_ns);
                engine.step(queued);
            }
            if vehicle.is_none() {
                engine.update_status();
            }
            let newest = engine.pipeline.newest_map().filter(|map| map.sequence >= before);
            newest.iter().for_each(|map| clock.note_map(state.position_ns, map.capture_end_ns));
            made = newest.map(|map| map.sequence);
        }
        made
    }

    /// The end of the range: the drops that are left, and then the phase.
    fn end(&mut self) -> Result<(), PlayError> {
        if let Some(remarks) = self.readings.end() {
            for (vehicle, refused) in self.vehicles.iter().zip(remarks.refused.drain(..)) {
                report_refused(&vehicle.queue, refused);
            }
            for index in 0..self.vehicles.len() {
                self.vehicles[index].queue.report_drops(self.newest_ns)?;
            }
        }
        self.step_waiting(None);
        // A drive of one scan has no length: it would begin again without an end.
        if self.state.repeat && self.newest_ns.is_some() && self.state.from_ns < self.state.to_ns {
            return self.jump(self.state.from_ns, true);
        }
        self.end_step(ReplayPhase::Ended);
        Ok(())
    }

    /// Goes to this phase, and ends the step, if there is one.
    fn end_step(&mut self, phase: ReplayPhase) {
        self.set_phase(phase);
        if let Some(step) = self.step.take() {
            // Fails if the client has gone.
            let _ = step.outcome.send(Ok(self.state.clone()));
        }
    }

    /// After the end: waits until all readers have left, at most a short time.
    fn let_readers_leave(&self) {
        let began = Instant::now();
        let are_there = || self.vehicles.iter().any(|vehicle| vehicle.engine.status.readers_sum() > 0);
        while are_there() && began.elapsed() < LEAVE_TIMEOUT {
            std::thread::sleep(POLL);
        }
    }

    /// True if no map waits for an acknowledgement.
    ///
    /// # Errors
    /// [`PlayError::Unacknowledged`] if it has waited too long.
    fn is_acknowledged(&mut self) -> Result<bool, PlayError> {
        let Some(AwaitedMap { vehicle, sequence, since }) = self.awaited else { return Ok(true) };
        let engine = &self.vehicles[vehicle].engine;
        let (status, vehicle) = (&engine.status, engine.status.name.to_string());
        let boot_id = engine.replayed.map_or(status.boot_id, |replayed| replayed.boot_id);
        let acknowledgements = &engine.wires.acknowledgements;
        let mut changes = acknowledgements.changes();
        let awaited = acknowledgements.awaited((boot_id, sequence));
        if !self.state.lockstep || awaited.as_ref().is_some_and(Vec::is_empty) {
            self.awaited = None;
            self.state.awaited.clear();
            return Ok(true);
        }
        let readers = awaited.map_or("any reader that acknowledges".to_owned(), |names| names.join(", "));
        if since.elapsed() >= self.options.acknowledge_timeout {
            let seconds = self.options.acknowledge_timeout.as_secs_f64();
            let error = PlayError::Unacknowledged { vehicle, sequence, seconds, readers };
            acknowledgements.time_out(error.to_string());
            return Err(error);
        }
        if since.elapsed() >= REPORT {
            self.state.awaited = format!("the acknowledgement of map {sequence} of vehicle {vehicle} by {readers}");
            self.report();
        }
        // Whichever comes first; then the caller looks for commands and asks again.
        if self.input.commands.is_empty() {
            // A timeout needs nothing further.
            let _ = self.runtime.block_on(async { tokio::time::timeout(POLL, changes.changed()).await });
        }
        Ok(false)
    }

    /// Applies a request of a client.
    fn change(&mut self, request: &v1::ReplayControl) -> Result<Result<(), ControlError>, PlayError> {
        let (from_ns, to_ns) = match check(request, &self.state, self.options.is_recorded) {
            Ok(range) => range,
            Err(error) => return Ok(Err(error)),
        };
        (self.state.from_ns, self.state.to_ns) = (from_ns, to_ns);
        if let Some(rate) = request.rate {
            self.state.rate = rate;
            self.clock.set_rate(rate);
        }
        self.state.repeat = request.repeat.unwrap_or(self.state.repeat);
        self.state.lockstep = request.lockstep.unwrap_or(self.state.lockstep);
        let is_waiting = self.state.phase() == ReplayPhase::Waiting;
        let position_ns = self.state.position_ns;
        let outside = (!(from_ns..=to_ns).contains(&position_ns)).then_some(position_ns.clamp(from_ns, to_ns));
        let seek_ns = request.seek_ns.or(outside.filter(|_| !self.options.is_recorded && !is_waiting));
        if let Some(at_ns) = seek_ns {
            self.jump(at_ns, true)?;
        }
        if self.step.is_some() && (seek_ns.is_some() || request.step.is_some() || request.paused.is_some()) {
            self.end_step(ReplayPhase::Paused);
        }
        match (request.step, request.paused) {
            (Some(_), _) => self.set_phase(ReplayPhase::Playing),
            (None, Some(true)) => self.set_phase(ReplayPhase::Paused),
            // At the end of the range it begins again.
            (None, Some(false)) if self.state.phase() == ReplayPhase::Ended && position_ns >= to_ns => {
                self.jump(from_ns, true)?;
            }
            (None, Some(false)) => self.set_phase(ReplayPhase::Playing),
            // The range may have grown.
            (None, None) if self.state.phase() == ReplayPhase::Ended && position_ns < to_ns => {
                self.set_phase(ReplayPhase::Playing);
            }
            (None, None) => {}
        }
        self.report();
        Ok(Ok(()))
    }

    /// Goes to a recorded time and publishes the newest map and plan of that moment.
    fn jump(&mut self, to_ns: i64, counts: bool) -> Result<(), PlayError> {
        let copy = self.snapshots.before(to_ns);
        let is_back = self.newest_ns.is_some_and(|newest_ns| to_ns < newest_ns);
        if is_back || copy.readings > self.taken {
            self.vehicles.iter_mut().zip(&copy.vehicles).for_each(|(vehicle, copy)| vehicle.restore(copy));
            (self.taken, self.newest_ns) = (copy.readings, None);
            self.readings = self.timeline.start(copy.readings)?;
        }
        if counts {
            self.state.jumps += 1;
        }
        self.awaited = None;
        self.state.awaited.clear();
        while self.readings.next_ns()?.is_some_and(|at_ns| at_ns <= to_ns) {
            let Some(vehicle) = self.push_next()? else { break };
            let ReplayedVehicle { engine, events, .. } = &mut self.vehicles[vehicle];
            let before = engine.maps();
            events.try_iter().for_each(|queued| engine.step_silently(&queued.event));
            if let Some(map) = engine.pipeline.newest_map().filter(|map| map.sequence >= before) {
                self.clock.note_map(self.state.position_ns, map.capture_end_ns);
                self.copy_if_due();
            }
        }
        self.state.position_ns = to_ns;
        self.clock.restart(Some(to_ns));
        let (clock, state, boot_id) = (&self.clock, &self.state, self.options.boot_id);
        for ReplayedVehicle { engine, .. } in &mut self.vehicles {
            engine.replayed = clock.replayed(state, boot_id, to_ns, now_ns());
            engine.publish_newest_map();
        }
        if self.state.phase() == ReplayPhase::Ended {
            self.set_phase(ReplayPhase::Playing);
        }
        self.report();
        Ok(())
    }

    /// Copies the vehicles, if the last copy is old enough.
    fn copy_if_due(&mut self) {
        let at_ns = self.state.position_ns;
        if self.options.is_served && !self.options.is_recorded && self.snapshots.is_due(at_ns, self.taken) {
            let vehicles = self.vehicles.iter().map(ReplayedVehicle::copy).collect();
            self.snapshots.add(Snapshot { at_ns, readings: self.taken, vehicles });
        }
    }

    fn set_phase(&mut self, phase: ReplayPhase) {
        self.state.set_phase(phase);
        self.clock.pause();
        for vehicle in &self.vehicles {
            vehicle.engine.update_status();
            vehicle.engine.set_replay_phase(phase);
        }
        tracing::debug!(?phase, jumps = %counted(self.state.jumps, "jump"), "replay");
        self.report();
    }

    fn report(&mut self) {
        self.reported = Instant::now();
        self.state.maps = self.vehicles.iter().map(|vehicle| vehicle.engine.maps()).collect();
        self.input.state.send_if_modified(|state| {
            if state.awaited != self.state.awaited {
                self.vehicles.iter().for_each(|of| of.engine.status.set_replay_awaited(&self.state.awaited));
            }
            let changed = *state != self.state;
            state.clone_from(&self.state);
            changed
        });
    }
}
