//! Several sensors, one map: whose turn makes it, and what the others bring.
//!
//! In: the newest turn of each sensor, ego frame at its own end; the event that completed one. Out: whether that turn
//! makes a map, and the map's sweep: the maker's points and every other sensor's newest ones, carried rigidly by the
//! vehicle's motion from their own end to the map's stamp. Everything is decided by events:
//!
//! - Sensors lead in this order: the configured lead, then the others as they are configured. A sensor that gives no
//!   turn for `deadline_ms` of event time, or whose turns come that much later after their stamps (or that much before
//!   them) than the timeliest sensor's, does not lead; the next one's turns make the maps until it is back.
//! - `deadline_ms` after the last map (`period_ms` where that is more) any sensor's turn makes one: nobody holds the
//!   map.
//! - The rows of radial maps are the lead's, once it has given a turn, whoever makes the map: to a sensor of few planes
//!   a row may be all there is, and one return in it would make all of it drivable.
//! - A turn farther than `deadline_ms` from the map's stamp is not in it, and its sensor is named with its age.
//!
//! Between two maps the order in which different sensors' turns come makes no difference to the layers made of the
//! sweep.

use crate::config::FusionConfig;
use crate::sensor::pipeline::{Intake, Moment};
use crate::map::{Part, SensorState};
use crate::sensor::motion::{Compensation, Motion};
use crate::sensor::sweep::Sweep;

const NS_A_MS: i64 = 1_000_000;

/// The last map made.
#[derive(Clone, Copy, Debug)]
struct Made {
    maker: usize,
    stamp_ns: i64,
    event_ns: i64,
}

/// One vehicle's fusion, with the buffer it reuses.
pub(crate) struct Fusion {
    lead: usize,
    pub deadline_ns: i64,
    period_ns: i64,
    last: Option<Made>,
    /// The map's sweep where more than one sensor is in it.
    sweep: Sweep,
    fused: bool,
}

/// What a map says of its sensors.
pub(crate) struct Gathered {
    /// The earliest first firing of those in it.
    pub start_ns: i64,
    /// The least known of the motion of any of them.
    pub compensation: Compensation,
    pub sensors: Vec<SensorState>,
}

impl Fusion {
    pub fn new(config: &FusionConfig, lead: usize) -> Self {
        Self {
            lead,
            deadline_ns: i64::from(config.deadline_ms) * NS_A_MS,
            period_ns: i64::from(config.period_ms) * NS_A_MS,
            last: None,
            sweep: Sweep::default(),
            fused: false,
        }
    }

    /// Index of the sensor whose turn made the newest map.
    pub fn maker(&self) -> Option<usize> {
        self.last.map(|made| made.maker)
    }

    /// The newest map's points; those of the lead's newest turn before the first map.
    pub fn sweep<'a>(&'a self, intakes: &'a [Intake]) -> &'a Sweep {
        let maker = self.maker().unwrap_or(self.lead);
        if self.fused { &self.sweep } else { &intakes[maker].turn.sweep }
    }

    /// Whether the turn that sensor `source` has just completed makes a map.
    pub fn makes_map(&self, source: usize, intakes: &[Intake], now: Moment) -> bool {
        let since_ns = now.event_ns.saturating_sub(self.last.map_or(0, |made| made.event_ns));
        let overdue = since_ns > self.deadline_ns.max(self.period_ns);
        let leads = self.order(intakes.len()).find(|&index| {
            index == source || (self.is_fresh(&intakes[index], now) && self.is_timely(&intakes[index], intakes, now))
        });
        let may = self.is_timely(&intakes[source], intakes, now) && (overdue || leads == Some(source));
        let newer = self.is_newer(source, &intakes[source], overdue);
        may && newer && (overdue || self.is_due(source, &intakes[source]))
    }

    /// Whether `period_ms` has passed since this sensor made the last map. A clock set back is due at once.
    fn is_due(&self, source: usize, intake: &Intake) -> bool {
        self.last.is_none_or(|made| {
            let since_ns = intake.turn.end_ns.saturating_sub(made.stamp_ns);
            made.maker != source || since_ns < 0 || since_ns >= self.period_ns - self.period_ns / 10
        })
    }

    /// Whether the turn ended after the last map's stamp: where another sensor takes over, its newest turn may be the
    /// older one. The same sensor's stamps rise by themselves, unless its clock was set back; all clocks may have been,
    /// once a map is overdue and the turn older by more than the deadline. A turn that ended long before it was
    /// completed is none of another clock: its sensor was silent until now.
    fn is_newer(&self, source: usize, intake: &Intake, overdue: bool) -> bool {
        self.last.is_none_or(|made| {
            let newer_ns = intake.turn.end_ns.saturating_sub(made.stamp_ns);
            let set_back = overdue && newer_ns < -self.deadline_ns && !self.came_late(intake);
            made.maker == source || newer_ns > 0 || set_back
        })
    }

    /// Whether the turn was completed later than the deadline after its end, as the host's clock had it then.
    fn came_late(&self, intake: &Intake) -> bool {
        let host_ns = intake.turn.state.clock_offset_ms.saturating_mul(NS_A_MS);
        let since_ns = intake.turn.completed.arrival_ns.saturating_sub(intake.turn.end_ns).saturating_sub(host_ns);
        since_ns.saturating_abs() > self.deadline_ns
    }

    fn order(&self, sensors: usize) -> impl Iterator<Item = usize> {
        let lead = self.lead;
        std::iter::once(lead).chain((0..sensors).filter(move |index| *index != lead))
    }

    /// Whether the sensor gave a turn within the deadline. One that gave none yet has until the deadline of the
    /// vehicle's first event.
    fn is_fresh(&self, intake: &Intake, now: Moment) -> bool {
        now.event_ns.saturating_sub(intake.turn.completed.event_ns) <= self.deadline_ns
    }

    /// Whether the sensor's turns come no later after their stamps, nor earlier before them, than the timeliest fresh
    /// sensor's, give or take the deadline.
    pub fn is_timely(&self, intake: &Intake, intakes: &[Intake], now: Moment) -> bool {
        let off_ns =
            |intake: &Intake| intake.turn.completed.arrival_ns.saturating_sub(intake.turn.end_ns).saturating_abs();
        let fresh = intakes.iter().filter(|other| other.turns > 0 && self.is_fresh(other, now));
        let least_ns = fresh.map(off_ns).min();
        intake.turns == 0 || least_ns.is_none_or(|least_ns| off_ns(intake).saturating_sub(least_ns) <= self.deadline_ns)
    }

    /// The map's sweep and sensors, made by the newest turn of sensor `source`.
    pub fn gather(&mut self, source: usize, intakes: &[Intake], motion: &Motion, now: Moment) -> Gathered {
        let maker = &intakes[source].turn;
        self.last = Some(Made { maker: source, stamp_ns: maker.end_ns, event_ns: now.event_ns });
        self.fused = false;
        let mut gathered = Gathered {
            start_ns: maker.start_ns,
            compensation: maker.compensation,
            sensors: Vec::with_capacity(intakes.len()),
        };
        for (index, intake) in intakes.iter().enumerate() {
            let part = if index == source { maker.state.state } else { self.part(intake, maker.end_ns, now) };
            if index != source && part.contributes() {
                let (carried, compensation) = motion.carry(intake.turn.end_ns, maker.end_ns);
                self.fuse(&maker.sweep);
                self.sweep.append(&intake.turn.sweep, &carried);
                gathered.start_ns = gathered.start_ns.min(intake.turn.start_ns);
                gathered.compensation = gathered.compensation.min(compensation).min(intake.turn.compensation);
            }
            gathered.sensors.push(state(intake, part, maker.end_ns));
        }
        let lead = &intakes[self.lead].turn.sweep;
        if source != self.lead && lead.calibration.is_some() {
            self.fuse(&maker.sweep);
            self.sweep.take_rows(lead);
        }
        gathered
    }

    /// The map's sweep is no sensor's own.
    fn fuse(&mut self, maker: &Sweep) {
        if !self.fused {
            self.sweep.copy(maker);
            self.fused = true;
        }
    }

    fn part(&self, intake: &Intake, stamp_ns: i64, now: Moment) -> Part {
        let age_ns = stamp_ns.saturating_sub(intake.turn.end_ns);
        if intake.turns == 0 {
            Part::Silent
        } else if age_ns.saturating_abs() <= self.deadline_ns {
            intake.turn.state.state
        } else if !self.is_fresh(intake, now) {
            Part::Silent
        } else if age_ns > 0 {
            Part::Late
        } else {
            Part::Ahead
        }
    }
}

fn state(intake: &Intake, part: Part, stamp_ns: i64) -> SensorState {
    let turn = &intake.turn;
    let seen = if part.contributes() { turn.state.clone() } else { SensorState::default() };
    let age_ns = stamp_ns.saturating_sub(turn.end_ns);
    SensorState {
        name: intake.name().to_owned(),
        model: turn.state.model.clone(),
        refused: intake.ledger.refused_sum(),
        state: part,
        clock: turn.state.clock,
        clock_offset_ms: turn.state.clock_offset_ms,
        age_ms: (intake.turns > 0).then(|| (age_ns as f64 / NS_A_MS as f64) as f32),
        ..seen
    }
}
