//! What the event queue takes, drops and counts.

use clearway_mapping::ledger::Ledger;

use super::*;
use crate::ingest::receipt::ObservationId;

/// A reading that arrives now.
fn reading(source: u16, body: Body) -> LiveReading {
    LiveReading::new(Arrival::Now, source, body)
}

/// A datagram of a sensor.
fn datagram(source: u16, received_ns: Option<i64>) -> LiveReading {
    LiveReading::new(Arrival::Received(received_ns), source, Body::End)
}

fn unreported(queue: &EventQueue) -> Ledger {
    let mut ledger = Ledger::default();
    queue.drops().add_unreported_to(&mut ledger, []);
    ledger
}

#[test]
fn events_are_numbered_without_gaps_and_a_full_queue_becomes_one_loss() {
    let (queue, events) = event_queue(2);
    queue.push((0..5).map(|_| reading(1, Body::End))).unwrap();
    assert_eq!(unreported(&queue).lost, 3);
    let received: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
    assert_eq!(received.iter().map(|e| e.sequence).collect::<Vec<_>>(), [0, 1]);
    queue.push([reading(0, Body::End)]).unwrap();
    let received: Vec<_> = events.try_iter().map(|queued| queued.event).collect();
    assert_eq!(received[0].body, Body::Lost { cause: Cause::Queue, count: 3 });
    assert_eq!((received[0].sequence, received[0].source), (2, 1));
    assert_eq!((received[1].sequence, received[1].source), (3, 0));
    assert_eq!(unreported(&queue), Ledger::default());
}

#[test]
fn drops_are_reported_at_once_then_seldom_and_completely_at_the_end() {
    let (queue, events) = event_queue(16);
    let flood = |queue: &EventQueue| (0..9).for_each(|port| queue.refuse_unknown_sender(([10, 0, 0, 9], port).into()));
    flood(&queue);
    queue.record_drop(1, Cause::Length, 2);
    let ledger = unreported(&queue);
    assert_eq!((ledger.received, ledger.refused["source"], ledger.refused["length"]), (11, 9, 2));
    queue.push([reading(0, Body::End)]).unwrap();
    let bodies = |events: &Receiver<QueuedEvent>| events.try_iter().map(|queued| queued.event.body).collect::<Vec<_>>();
    let lost = |cause, count| Body::Lost { cause, count };
    assert_eq!(bodies(&events), [lost(Cause::Sender, 9), lost(Cause::Length, 2), Body::End]);
    flood(&queue);
    queue.record_drop(0, Cause::Kernel, 5);
    queue.report_drops(None).unwrap();
    assert_eq!(bodies(&events), [lost(Cause::Kernel, 5), lost(Cause::Sender, 9)]);
    assert_eq!(unreported(&queue), Ledger::default());
    let senders = queue.drops().unknown_senders();
    assert_eq!(senders.iter().map(|s| s.address.port()).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6, 7, 8]);
    assert!(senders.iter().all(|sender| sender.datagrams == 1), "each was forgotten before it came again");
}

#[test]
fn a_receipt_delivers_that_the_queue_was_full_or_the_engine_stopped() {
    let (sender, mut outcomes) = tokio::sync::mpsc::unbounded_channel();
    let observation = |number, arrival| {
        let receipt = Receipt::new(ObservationId { client: 0, number }, None, &sender);
        [LiveReading { receipt: Some(receipt), ..LiveReading::new(arrival, 0, Body::End) }]
    };
    let (queue, events) = event_queue(1);
    queue.push(observation(1, Arrival::Captured(42))).unwrap();
    assert!(outcomes.try_recv().is_err(), "the engine has not handled the event yet");
    queue.push(observation(2, Arrival::Now)).unwrap();
    let (id, outcome) = outcomes.try_recv().unwrap();
    assert!(id.number == 2 && matches!(outcome, Outcome::Refused { reason: "queue", .. }), "{outcome:?}");
    assert_eq!(unreported(&queue).lost, 1, "the loss is also reported to the engine");

    let QueuedEvent { event, receipt: first, .. } = events.recv().unwrap();
    assert_eq!(event.arrival_ns, 42, "the event keeps the stamp of its capture");
    first.unwrap().deliver(Outcome::Accepted);
    assert_eq!(outcomes.try_recv().unwrap().1, Outcome::Accepted);
    drop(events);
    assert_eq!(queue.push(observation(3, Arrival::Now)), Err(QueueClosedError));
    assert!(matches!(outcomes.try_recv().unwrap().1, Outcome::Refused { reason: "stopped", .. }));
}

#[test]
fn a_closed_queue_ends_after_its_events_although_clones_remain() {
    let (sender, mut outcomes) = tokio::sync::mpsc::unbounded_channel();
    let (queue, events) = event_queue(2);
    let clone = queue.clone();
    queue.push([reading(0, Body::End)]).unwrap();
    queue.close();
    assert_eq!(events.iter().count(), 1);
    let receipt = Some(Receipt::new(ObservationId { client: 0, number: 1 }, None, &sender));
    assert_eq!(clone.push([LiveReading { receipt, ..reading(0, Body::End) }]), Err(QueueClosedError));
    assert!(matches!(outcomes.try_recv().unwrap().1, Outcome::Refused { reason: "stopped", .. }));
}

#[test]
fn a_captured_reading_follows_the_refusals_before_it_all_at_its_own_stamp() {
    let (queue, events) = event_queue(4);
    let push = |arrival_ns| queue.push_captured(Reading { arrival_ns, source: 0, body: Body::End }).unwrap();
    let mut received = events.iter().map(|queued| (queued.event.arrival_ns, queued.event.body));
    let refused = |count| Body::Lost { cause: Cause::Observation, count };
    queue.drops().record_refused_messages(1, "ros_message", 2);
    push(REPORT_PERIOD_NS as i64);
    assert_eq!(received.next(), Some((REPORT_PERIOD_NS as i64, refused(2))));
    assert_eq!(received.next(), Some((REPORT_PERIOD_NS as i64, Body::End)));
    queue.drops().record_refused_messages(1, "ros_message", 3);
    push(REPORT_PERIOD_NS as i64 + 42);
    assert_eq!(received.next(), Some((REPORT_PERIOD_NS as i64 + 42, Body::End)), "no report is due yet");
    queue.report_drops(Some(7)).unwrap();
    assert_eq!(received.next(), Some((7, refused(3))));
    assert_eq!(unreported(&queue), Ledger::default());
}

#[test]
fn live_readings_are_counted_while_a_captured_reading_waits_for_space() {
    let (queue, events) = event_queue(1);
    queue.push([reading(0, Body::End)]).unwrap();
    let waiting = std::thread::spawn({
        let queue = queue.clone();
        move || queue.push_captured(Reading { arrival_ns: 42, source: 0, body: Body::End })
    });
    // It makes no difference whether the other thread has begun to wait.
    for _ in 0..3 {
        queue.push([reading(1, Body::End)]).unwrap();
    }
    assert_eq!(unreported(&queue).lost, 3);
    let received: Vec<_> = events.iter().take(3).map(|queued| queued.event).collect();
    assert_eq!(waiting.join().unwrap(), Ok(()));
    assert_eq!(received[1].body, Body::Lost { cause: Cause::Queue, count: 3 });
    assert_eq!(received.iter().map(|event| event.sequence).collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(received[2].arrival_ns, 42);

    queue.push([reading(0, Body::End)]).unwrap();
    let waiting = std::thread::spawn({
        let queue = queue.clone();
        move || queue.push_captured(Reading { arrival_ns: 43, source: 0, body: Body::End })
    });
    drop(events);
    assert_eq!(waiting.join().unwrap(), Err(QueueClosedError), "the wait ends with the engine");
}

#[test]
fn a_flood_from_one_sensor_leaves_the_share_of_another() {
    let (queue, events) = event_queue(16);
    let queue = queue.with_shares(8, 2);
    queue.push((0..100).map(|_| datagram(0, None))).unwrap();
    queue.push((0..4).map(|_| datagram(1, None))).unwrap();
    let of = |events: &Receiver<QueuedEvent>, source| {
        let readings = events.try_iter().filter(|queued| queued.event.body == Body::End);
        readings.filter(|queued| queued.event.source == source).count()
    };
    assert_eq!(unreported(&queue).lost, 0, "the second push reported the loss of the first");
    assert_eq!(of(&events, 1), 4);
    queue.push((0..100).map(|_| datagram(0, None))).unwrap();
    assert_eq!((of(&events, 0), unreported(&queue).lost), (4, 96), "the share is free again");
}

#[test]
fn a_datagram_has_the_kernels_stamp_if_that_is_plausible() {
    let now_ns = 1_000 * RECEIVED_AGE_NS_MAX;
    let (queue, events) = event_queue_with_clock(Clock::new(move || now_ns), 8);
    let stamps = [Some(now_ns - 4_000_000_000), None, Some(now_ns + 1), Some(now_ns - RECEIVED_AGE_NS_MAX - 1)];
    queue.push(stamps.map(|ns| datagram(0, ns))).unwrap();
    let arrivals: Vec<_> = events.try_iter().map(|queued| queued.event.arrival_ns).collect();
    assert_eq!(arrivals, [now_ns - 4_000_000_000, now_ns, now_ns, now_ns]);
}

#[test]
fn a_queue_without_an_engine_refuses_readings() {
    let (queue, events) = event_queue(2);
    drop(events);
    assert_eq!(queue.push([reading(0, Body::End)]), Err(QueueClosedError));
}
