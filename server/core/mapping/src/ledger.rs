//! What became of everything that reached the core: the counts of a vehicle and of each of its sensors.
//!
//! In: every event with its outcome. Out: a [`Ledger`] for the vehicle and one for each sensor. All counting is done
//! here, by [`Ledgers::record`].

use std::collections::BTreeMap;

use clearway_lidar::telemetry::TELEMETRY_LENGTH;

use crate::error::EventError;
use crate::event::{Body, Cause, Event};
use crate::inputs::InputOutcome;
use crate::sensor::self_filter::RemovedPoints;

/// Greatest count of lost readings for each cause. A recording states these counts, and it may come from an untrusted
/// source: the limit keeps every sum of them within 64 bits.
const LOST_MAX: u64 = 1 << 60;

/// Counts of what became of everything that reached a vehicle, or one of its sensors. For each ledger `received =
/// decoded + telemetry + the sum of refused`, exactly. The ledger of the vehicle alone counts what belongs to no
/// sensor: poses, roads, declarations of sensors, and readings of unknown senders.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ledger {
    /// Number of datagrams and scans, and of `End` events for unknown sensors.
    pub received: u64,
    /// Number of data packets and scans that were accepted.
    pub decoded: u64,
    /// Number of telemetry datagrams that were accepted.
    pub telemetry: u64,
    /// Number of refused datagrams, scans and `End` events, by [`EventError::reason`].
    pub refused: BTreeMap<&'static str, u64>,
    /// Number of readings that were dropped because the event queue was full.
    pub lost: u64,
    /// Number of datagrams that the kernel dropped. Those of a socket of several sensors count for the vehicle alone.
    pub kernel_drops: u64,
    /// Number of accepted ego poses.
    pub poses: u64,
    /// Number of refused ego poses.
    pub poses_refused: u64,
    /// Number of accepted roads.
    pub roads: u64,
    /// Number of refused roads, by [`EventError::reason`].
    pub roads_refused: BTreeMap<&'static str, u64>,
    /// Number of accepted declarations of sensors, repeated ones included.
    pub sensors: u64,
    /// Number of refused declarations of sensors.
    pub sensors_refused: u64,
    /// Number of points of scans that were removed because they are no positions: not finite, or beyond any sensor's
    /// reach.
    pub points_dropped: u64,
    /// Number of returns that were removed because they lie on or in the vehicle.
    pub own_body: u64,
    /// Number of returns that were removed because their ray crosses the vehicle.
    pub through_body: u64,
    /// Number of returns that were removed because they lie in a blind sector of the configuration.
    pub blind: u64,
}

impl Ledger {
    /// Number of refused datagrams and scans without copies of packets, which leave no trace in a map.
    pub fn refused_sum(&self) -> u64 {
        self.refused.iter().filter(|(reason, _)| **reason != "duplicate").map(|(_, count)| count).sum()
    }

    /// Counts readings that never became events: dropped, or refused before the event queue.
    pub fn record_lost(&mut self, cause: Cause, count: u64) {
        let (sum, is_received) = match cause {
            Cause::Queue => (&mut self.lost, false),
            Cause::Kernel => (&mut self.kernel_drops, false),
            Cause::Sender => (self.refused.entry("source").or_default(), true),
            Cause::Length => (self.refused.entry("length").or_default(), true),
            Cause::Observation => (self.refused.entry("observation").or_default(), true),
        };
        let count = count.min(LOST_MAX.saturating_sub(*sum));
        *sum += count;
        self.received += if is_received { count } else { 0 };
    }

    fn record_refused(&mut self, reason: &'static str, count: u64) {
        *self.refused.entry(reason).or_default() += count;
    }

    fn record_removed(&mut self, removed: RemovedPoints) {
        self.points_dropped += removed.no_position;
        self.own_body += removed.own_body;
        self.through_body += removed.through_body;
        self.blind += removed.blind;
    }
}

/// The ledgers of one vehicle.
#[derive(Clone, Debug)]
pub(crate) struct Ledgers {
    vehicle: Ledger,
    /// By source.
    sensors: Vec<Ledger>,
}

impl Ledgers {
    /// Empty ledgers of a vehicle with this number of configured sensors.
    pub fn new(sensors: usize) -> Self {
        Self { vehicle: Ledger::default(), sensors: vec![Ledger::default(); sensors] }
    }

    /// Ledgers in which each sensor has this many refused readings; a recording states no more of them.
    pub fn with_refused(refused: &[u64]) -> Self {
        let of_sensor = |count: &u64| Ledger {
            refused: BTreeMap::from([("earlier", (*count).min(LOST_MAX))]),
            ..Ledger::default()
        };
        Self { vehicle: Ledger::default(), sensors: refused.iter().map(of_sensor).collect() }
    }

    /// Adds empty ledgers, or removes the last ones, until there is one for each of so many sensors.
    pub fn set_sensors(&mut self, sensors: usize) {
        self.sensors.resize(sensors, Ledger::default());
    }

    /// Forgets the counts of a sensor that was withdrawn, in a list of so many indices. Those of the vehicle stay.
    pub fn remove_sensor(&mut self, source: u16, sensors: usize) {
        self.sensors.iter_mut().skip(usize::from(source)).take(1).for_each(|ledger| *ledger = Ledger::default());
        self.set_sensors(sensors);
    }

    /// The ledger of the whole vehicle.
    pub fn vehicle(&self) -> &Ledger {
        &self.vehicle
    }

    /// The ledger of each sensor, by source.
    pub fn sensors(&self) -> &[Ledger] {
        &self.sensors
    }

    /// Counts one event and what became of it.
    pub fn record(&mut self, event: &Event, outcome: &Result<InputOutcome, EventError>) {
        match (&event.body, outcome) {
            (Body::Datagram(_) | Body::Scan(_) | Body::End | Body::Withdrawn, Ok(outcome)) => {
                self.record_reading(event, outcome)
            }
            (Body::Datagram(_) | Body::Scan(_), Err(error)) => {
                let refuse = |ledger: &mut Ledger| {
                    ledger.received += 1;
                    ledger.record_refused(error.reason(), 1);
                };
                match error {
                    EventError::Source { .. } => refuse(&mut self.vehicle),
                    _ => self.each(event.source, refuse),
                }
            }
            // An accepted `End` is not a reading; an `End` for an unknown sensor counts as one refused reading.
            (Body::End | Body::Withdrawn, Err(_)) => self.vehicle.record_lost(Cause::Sender, 1),
            (Body::EgoPose(_), Ok(_)) => self.vehicle.poses += 1,
            (Body::EgoPose(_), Err(_)) => self.vehicle.poses_refused += 1,
            (Body::Road(_), Ok(_)) => self.vehicle.roads += 1,
            (Body::Road(_), Err(error)) => *self.vehicle.roads_refused.entry(error.reason()).or_default() += 1,
            (Body::Sensor(_), Ok(_)) => {
                self.vehicle.sensors += 1;
                self.sensors.resize(self.sensors.len().max(usize::from(event.source) + 1), Ledger::default());
            }
            (Body::Sensor(_), Err(_)) => self.vehicle.sensors_refused += 1,
            (Body::Lost { cause, count }, _) if cause.has_source() => {
                self.each(event.source, |ledger| ledger.record_lost(*cause, *count));
            }
            (Body::Lost { cause, count }, _) => self.vehicle.record_lost(*cause, *count),
            (Body::Plan(_), _) => {}
        }
    }

    /// Counts an accepted datagram, scan or end of a sensor.
    fn record_reading(&mut self, event: &Event, outcome: &InputOutcome) {
        let is_reading = !matches!(event.body, Body::End | Body::Withdrawn);
        let is_telemetry = matches!(&event.body, Body::Datagram(payload) if payload.len() == TELEMETRY_LENGTH);
        self.each(event.source, |ledger| {
            ledger.received += u64::from(is_reading);
            ledger.telemetry += u64::from(is_telemetry);
            ledger.decoded += u64::from(is_reading && !is_telemetry);
            if outcome.packets_unfit > 0 {
                ledger.decoded -= outcome.packets_unfit;
                ledger.record_refused("model", outcome.packets_unfit);
            }
            ledger.record_removed(outcome.completed_scan.unwrap_or_default());
        });
    }

    /// Changes the ledger of the vehicle, and the ledger of the sensor if there is such a sensor.
    fn each(&mut self, source: u16, record: impl Fn(&mut Ledger)) {
        record(&mut self.vehicle);
        if let Some(sensor) = self.sensors.get_mut(usize::from(source)) {
            record(sensor);
        }
    }
}
