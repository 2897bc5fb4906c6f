//! The outcome of an event -> a report to the client that sent it. The receipt is on the queue together with its
//! event. It is not recorded, so a replay has no receipts.

use std::collections::{BTreeSet, VecDeque};

use clearway_mapping::error::EventError;
use clearway_proto::v1;
use tokio::sync::mpsc::UnboundedSender;

use super::admission::AdmissionPermit;
use super::sensor_senders::SensorSender;

/// The outcome of one event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The core accepted it, and the map that it completed, if any, is published.
    Accepted,
    /// The event was refused, by the gateway or by the core.
    Refused {
        /// Key in the ledger under which the refusal is counted.
        reason: &'static str,
        /// The wrong value, and what is allowed.
        message: String,
    },
}

impl From<Result<(), EventError>> for Outcome {
    fn from(result: Result<(), EventError>) -> Self {
        match result {
            Ok(()) => Self::Accepted,
            Err(error) => Self::Refused { reason: error.reason(), message: error.to_string() },
        }
    }
}

/// Identifies an observation among all observations of its stream or session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ObservationId {
    /// The client's id; 0 on a stream of a single client.
    pub client: u64,
    /// The client's number of the observation.
    pub number: u64,
}

/// Where outcomes are sent. Unbounded, but it holds no more outcomes than there are events in flight.
pub type OutcomeSender = UnboundedSender<(ObservationId, Outcome)>;

/// Delivers the outcome of one event exactly once. A receipt that is dropped undelivered, for example with the queue of
/// a stopped engine, delivers a refusal with the reason `stopped`.
#[derive(Debug)]
pub struct Receipt {
    id: ObservationId,
    outcomes: Option<OutcomeSender>,
    _permit: AdmissionPermit,
}

impl Receipt {
    /// A receipt for one event of the observation `id`, which holds `permit` until then.
    pub fn new(id: ObservationId, permit: AdmissionPermit, outcomes: &OutcomeSender) -> Self {
        Self { id, outcomes: Some(outcomes.clone()), _permit: permit }
    }

    /// Sends the outcome to the client that sent the observation.
    pub fn deliver(mut self, outcome: Outcome) {
        self.send(outcome);
    }

    fn send(&mut self, outcome: Outcome) {
        if let Some(outcomes) = self.outcomes.take() {
            // An error means that the client has gone; then the outcome has no receiver.
            let _ = outcomes.send((self.id, outcome));
        }
    }
}

impl Drop for Receipt {
    fn drop(&mut self) {
        let message = "the vehicle's engine has stopped".to_owned();
        self.send(Outcome::Refused { reason: "stopped", message });
    }
}

/// The number of an observation is not greater than all numbers before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("number {number}: more than {newest} is allowed")]
pub struct NumberError {
    /// Number of the refused observation.
    pub number: u64,
    /// The greatest number among the observations before.
    pub newest: u64,
}

/// One client's observations in flight, and the report that is due to it.
#[derive(Debug, Default)]
pub struct ClientSession {
    client: u64,
    /// What names the client alone; `None` if it need not be told from others.
    sender: Option<SensorSender>,
    /// Greatest number received.
    newest: Option<u64>,
    in_flight: VecDeque<InFlight>,
    /// Events in flight.
    events: usize,
    acknowledged: u64,
    /// The acknowledgement of the last report.
    reported: Option<u64>,
    refused: Vec<v1::Refused>,
    /// Indices of the sensors that the client has declared.
    declared: BTreeSet<u16>,
}

#[derive(Debug)]
struct InFlight {
    number: u64,
    events_left: usize,
}

impl ClientSession {
    /// The session of a client that has sent nothing yet.
    pub fn new(client: u64) -> Self {
        Self { client, ..Self::default() }
    }

    /// The session of a client that is told from others by this name.
    pub fn of_sender(client: u64, name: &str) -> Self {
        Self { client, sender: Some(SensorSender::Named(name.into())), ..Self::default() }
    }

    /// The client as a sender of data of sensors.
    pub fn sender(&self) -> Option<&SensorSender> {
        self.sender.as_ref()
    }

    /// Remembers that the client has declared this sensor; false if it had done so before.
    pub fn declare(&mut self, source: u16) -> bool {
        self.declared.insert(source)
    }

    /// The sensors that the client has declared, which it has no more.
    pub fn take_declared(&mut self) -> BTreeSet<u16> {
        std::mem::take(&mut self.declared)
    }

    /// True if no observation is in flight.
    pub fn is_idle(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// True if another observation may be read: fewer than `events_max` events are in flight, or no observation.
    pub fn has_credit(&self, events_max: usize) -> bool {
        self.is_idle() || self.events < events_max
    }

    /// Checks the number of the next observation and remembers it.
    ///
    /// # Errors
    /// [`NumberError`] if it is not greater than all numbers before it.
    pub fn check_number(&mut self, number: u64) -> Result<(), NumberError> {
        match self.newest {
            Some(newest) if number <= newest => Err(NumberError { number, newest }),
            _ => {
                self.newest = Some(number);
                Ok(())
            }
        }
    }

    /// Puts an observation of so many events in flight. [`ClientSession::record_outcome`] follows for each event.
    pub fn begin(&mut self, number: u64, events: usize) {
        self.events += events;
        self.in_flight.push_back(InFlight { number, events_left: events });
        self.acknowledge_finished();
    }

    /// Adds a refusal of `count` observations, or events of one observation, to the next report.
    pub fn refuse(&mut self, number: u64, reason: &'static str, message: String, count: u64) {
        match self.refused.iter_mut().rev().find(|refused| refused.number == number && refused.reason == reason) {
            Some(refused) => refused.count += count,
            None => self.refused.push(v1::Refused { number, reason: reason.to_owned(), message, count }),
        }
    }

    /// Records the outcome of one event of the observation `number`.
    pub fn record_outcome(&mut self, number: u64, outcome: Outcome) {
        if let Outcome::Refused { reason, message } = outcome {
            self.refuse(number, reason, message, 1);
        }
        // Outcomes arrive in the order of the events, so it is the first observation or near it.
        if let Some(observation) = self.in_flight.iter_mut().find(|observation| observation.number == number) {
            observation.events_left = observation.events_left.saturating_sub(1);
            self.events = self.events.saturating_sub(1);
        }
        self.acknowledge_finished();
    }

    fn acknowledge_finished(&mut self) {
        while let Some(first) = self.in_flight.pop_front_if(|observation| observation.events_left == 0) {
            self.acknowledged = first.number;
        }
    }

    /// Number of events in flight.
    pub fn events(&self) -> usize {
        self.events
    }

    /// Refuses the numbers between the newest one and `number` as `missed`: no observation with them arrived.
    pub fn refuse_missed(&mut self, number: u64) {
        if let Some(first) = self.newest.and_then(|newest| newest.checked_add(1))
            && number > first
        {
            let missed = number - first;
            let message = format!(
                "{missed} observations from number {first} on never came, or found the server's queue full, or waited \
                 there when a newer scan came"
            );
            self.refuse(first, "missed", message, missed);
        }
    }

    /// The acknowledgement of the last report, to repeat it.
    pub fn repeated_report(&self) -> v1::IngestReport {
        v1::IngestReport { acknowledged: self.acknowledged, refused: Vec::new(), client: self.client }
    }

    /// True if anything is not reported yet.
    pub fn has_report(&self) -> bool {
        self.reported != Some(self.acknowledged) || !self.refused.is_empty()
    }

    /// A report of everything that is not reported yet, if there is anything.
    pub fn next_report(&mut self) -> Option<v1::IngestReport> {
        if !self.has_report() {
            return None;
        }
        self.reported = Some(self.acknowledged);
        let refused = std::mem::take(&mut self.refused);
        Some(v1::IngestReport { acknowledged: self.acknowledged, refused, client: self.client })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(reason: &'static str) -> Outcome {
        Outcome::Refused { reason, message: reason.to_owned() }
    }

    #[test]
    fn an_observation_is_acknowledged_after_its_last_event_and_all_before_it() {
        let mut session = ClientSession::new(7);
        session.begin(1, 2);
        session.begin(4, 1);
        session.record_outcome(4, refused("stamp"));
        session.record_outcome(1, Outcome::Accepted);
        let report = session.next_report().unwrap();
        assert_eq!((report.acknowledged, report.client, report.refused.len()), (0, 7, 1));
        assert_eq!((report.refused[0].number, &*report.refused[0].reason), (4, "stamp"));
        assert!(session.next_report().is_none(), "nothing is reported twice");
        session.record_outcome(1, Outcome::Accepted);
        assert_eq!(session.next_report().unwrap().acknowledged, 4);
        assert!(session.is_idle() && session.events == 0);
    }

    #[test]
    fn datagrams_refused_for_one_reason_become_one_refusal_with_their_count() {
        let mut session = ClientSession::new(0);
        session.begin(1, 3);
        for reason in ["length", "azimuth", "length"] {
            session.record_outcome(1, refused(reason));
        }
        let report = session.next_report().unwrap();
        let refused: Vec<_> = report.refused.iter().map(|r| (&*r.reason, r.count)).collect();
        assert_eq!(refused, [("length", 2), ("azimuth", 1)]);
        assert_eq!(report.acknowledged, 1);
    }

    #[test]
    fn one_observation_always_has_credit_and_more_have_it_within_the_limits() {
        let mut session = ClientSession::new(0);
        session.begin(1, 100);
        assert!(!session.has_credit(100) && session.has_credit(101));
        (0..100).for_each(|_| session.record_outcome(1, Outcome::Accepted));
        assert!(session.has_credit(1));
    }

    #[test]
    fn a_number_that_does_not_rise_is_refused_with_what_is_allowed() {
        let mut session = ClientSession::new(0);
        assert_eq!(session.check_number(3), Ok(()));
        assert_eq!(session.check_number(3).unwrap_err().to_string(), "number 3: more than 3 is allowed");
        assert_eq!(session.check_number(4), Ok(()));
    }

    #[test]
    fn a_receipt_that_is_dropped_delivers_that_the_engine_has_stopped() {
        let (sender, mut outcomes) = tokio::sync::mpsc::unbounded_channel();
        let id = ObservationId { client: 1, number: 2 };
        drop(Receipt::new(id, None, &sender));
        Receipt::new(id, None, &sender).deliver(Outcome::Accepted);
        assert!(matches!(outcomes.try_recv(), Ok((of, Outcome::Refused { reason: "stopped", .. })) if of == id));
        assert_eq!(outcomes.try_recv(), Ok((id, Outcome::Accepted)));
        assert!(outcomes.try_recv().is_err(), "each is delivered once");
    }
}
