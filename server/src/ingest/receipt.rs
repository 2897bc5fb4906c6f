//! What becomes of an event -> whoever sent it. The ticket lies beside the event on the queue; the recording, and so a
//! replay, knows nothing of it.

use std::collections::VecDeque;

use clearway_mapping::error::EventError;
use clearway_proto::v1;
use tokio::sync::mpsc::UnboundedSender;

/// What became of one event.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The core took it; the map it completed, if any, is there.
    Taken,
    /// It was not taken.
    Refused {
        /// The ledger's key.
        reason: &'static str,
        /// What was wrong, and what is allowed.
        message: String,
    },
}

impl Verdict {
    /// Of a step of the pipeline.
    pub fn of(outcome: Result<(), EventError>) -> Self {
        match outcome {
            Ok(()) => Self::Taken,
            Err(rejected) => Self::Refused { reason: rejected.reason(), message: rejected.to_string() },
        }
    }
}

/// Which observation of which client (0 where there is only one).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark {
    /// As the client names itself.
    pub client: u64,
    /// As the client counts.
    pub number: u64,
}

/// Where verdicts arrive. Unbounded, but no fuller than the events that are in flight.
pub type Verdicts = UnboundedSender<(Mark, Verdict)>;

/// Tells exactly once what became of an event: a ticket that is dropped untold, as with a queue whose engine has
/// stopped, says that.
#[derive(Debug)]
pub struct Ticket {
    mark: Mark,
    verdicts: Option<Verdicts>,
}

impl Ticket {
    /// For one event of an observation.
    pub fn new(mark: Mark, verdicts: &Verdicts) -> Self {
        Self { mark, verdicts: Some(verdicts.clone()) }
    }

    /// Tells it.
    pub fn tell(mut self, verdict: Verdict) {
        self.send(verdict);
    }

    fn send(&mut self, verdict: Verdict) {
        if let Some(verdicts) = self.verdicts.take() {
            // A sender that has gone does not care any more.
            let _ = verdicts.send((self.mark, verdict));
        }
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        let message = "the vehicle's engine has stopped".to_owned();
        self.send(Verdict::Refused { reason: "stopped", message });
    }
}

/// One client's observations on their way, and what there is to report to it.
#[derive(Debug, Default)]
pub struct Account {
    client: u64,
    /// Greatest number seen.
    newest: Option<u64>,
    in_flight: VecDeque<InFlight>,
    events: usize,
    bytes: usize,
    acknowledged: u64,
    /// What the last report acknowledged.
    reported: Option<u64>,
    refused: Vec<v1::Refused>,
}

#[derive(Debug)]
struct InFlight {
    number: u64,
    events_left: usize,
    bytes: usize,
}

impl Account {
    /// Of a client that has sent nothing.
    pub fn new(client: u64) -> Self {
        Self { client, ..Self::default() }
    }

    /// Observations whose fate is not known yet.
    pub fn is_settled(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// Whether another observation may be read: so many events and bytes may be in flight, and one observation always.
    pub fn has_room(&self, events_max: usize, bytes_max: usize) -> bool {
        self.is_settled() || (self.events < events_max && self.bytes < bytes_max)
    }

    /// Takes note of a number; gives the one before, or what is wrong with a number that does not rise.
    ///
    /// # Errors
    /// The refusal's message.
    pub fn count(&mut self, number: u64) -> Result<Option<u64>, String> {
        match self.newest {
            Some(newest) if number <= newest => Err(format!("number {number}: more than {newest} is allowed")),
            before => {
                self.newest = Some(number);
                Ok(before)
            }
        }
    }

    /// An observation is about to enter as so many events; [`Account::tell`] will hear of each.
    pub fn enter(&mut self, number: u64, events: usize, bytes: usize) {
        self.events += events;
        self.bytes += bytes;
        self.in_flight.push_back(InFlight { number, events_left: events, bytes });
        self.settle();
    }

    /// An observation, or so many, did not become an event.
    pub fn refuse(&mut self, number: u64, reason: &'static str, message: String, count: u64) {
        match self.refused.iter_mut().rev().find(|refused| refused.number == number && refused.reason == reason) {
            Some(refused) => refused.count += count,
            None => self.refused.push(v1::Refused { number, reason: reason.to_owned(), message, count }),
        }
    }

    /// What became of one event.
    pub fn tell(&mut self, number: u64, verdict: Verdict) {
        if let Verdict::Refused { reason, message } = verdict {
            self.refuse(number, reason, message, 1);
        }
        // A vehicle's events end in the order they entered, so it is the first or near it.
        if let Some(observation) = self.in_flight.iter_mut().find(|observation| observation.number == number) {
            observation.events_left = observation.events_left.saturating_sub(1);
            self.events = self.events.saturating_sub(1);
        }
        self.settle();
    }

    fn settle(&mut self) {
        while let Some(first) = self.in_flight.pop_front_if(|observation| observation.events_left == 0) {
            self.bytes -= first.bytes;
            self.acknowledged = first.number;
        }
    }

    /// Events and bytes whose fate is not known yet.
    pub fn in_flight(&self) -> (usize, usize) {
        (self.events, self.bytes)
    }

    /// Takes note of the numbers between the newest one and this, which no observation had.
    pub fn miss(&mut self, number: u64) {
        if let Some(first) = self.newest.and_then(|newest| newest.checked_add(1))
            && number > first
        {
            let missed = number - first;
            let message =
                format!("{missed} observations from number {first} on never came, or found the server's queue full");
            self.refuse(first, "missed", message, missed);
        }
    }

    /// What the last report acknowledged, once more.
    pub fn newest_report(&self) -> v1::IngestReport {
        v1::IngestReport { acknowledged: self.acknowledged, refused: Vec::new(), client: self.client }
    }

    /// What has not been told yet, if anything.
    pub fn report(&mut self) -> Option<v1::IngestReport> {
        if self.reported == Some(self.acknowledged) && self.refused.is_empty() {
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

    fn refused(reason: &'static str) -> Verdict {
        Verdict::Refused { reason, message: reason.to_owned() }
    }

    #[test]
    fn an_observation_is_acknowledged_when_its_last_event_and_all_before_it_are_known() {
        let mut account = Account::new(7);
        account.enter(1, 2, 100);
        account.enter(4, 1, 50);
        account.tell(4, refused("stamp"));
        account.tell(1, Verdict::Taken);
        let report = account.report().unwrap();
        assert_eq!((report.acknowledged, report.client, report.refused.len()), (0, 7, 1));
        assert_eq!((report.refused[0].number, &*report.refused[0].reason), (4, "stamp"));
        assert!(account.report().is_none(), "told once");
        account.tell(1, Verdict::Taken);
        assert_eq!(account.report().unwrap().acknowledged, 4);
        assert!(account.is_settled() && account.bytes == 0 && account.events == 0);
    }

    #[test]
    fn datagrams_refused_for_one_reason_are_one_refusal_with_their_number() {
        let mut account = Account::new(0);
        account.enter(1, 3, 9);
        for reason in ["length", "azimuth", "length"] {
            account.tell(1, refused(reason));
        }
        let report = account.report().unwrap();
        let told: Vec<_> = report.refused.iter().map(|r| (&*r.reason, r.count)).collect();
        assert_eq!(told, [("length", 2), ("azimuth", 1)]);
        assert_eq!(report.acknowledged, 1);
    }

    #[test]
    fn there_is_room_for_one_observation_always_and_for_more_within_the_limits() {
        let mut account = Account::new(0);
        account.enter(1, 100, 1000);
        assert!(!account.has_room(100, 10_000) && !account.has_room(1000, 1000) && account.has_room(101, 1001));
        (0..100).for_each(|_| account.tell(1, Verdict::Taken));
        assert!(account.has_room(1, 1));
    }

    #[test]
    fn a_ticket_nobody_answered_says_that_the_engine_has_stopped() {
        let (verdicts, mut told) = tokio::sync::mpsc::unbounded_channel();
        let mark = Mark { client: 1, number: 2 };
        drop(Ticket::new(mark, &verdicts));
        Ticket::new(mark, &verdicts).tell(Verdict::Taken);
        assert!(matches!(told.try_recv(), Ok((m, Verdict::Refused { reason: "stopped", .. })) if m == mark));
        assert_eq!(told.try_recv(), Ok((mark, Verdict::Taken)));
        assert!(told.try_recv().is_err(), "once each");
    }
}
