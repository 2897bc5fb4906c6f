//! The turns, the bounds and the losses of sources that send more than the engine takes.

use futures::FutureExt;

use super::*;

/// So that 97,536 bytes are shared, and each source has 24,384 of its own.
fn bytes() -> QueueBytes {
    QueueBytes::new(97_536)
}

/// The samples that are admitted while the engine releases nothing.
fn admitted(queue: &SourceQueue<u32>, admission: &Admission) -> Option<(u32, AdmissionPermit)> {
    queue.next(admission).now_or_never().flatten().map(|(_, sample, permit)| (sample, permit))
}

#[test]
fn sources_that_always_send_are_admitted_in_turn_and_a_pose_at_once() {
    let admission = Admission::default();
    let [flood, honest] = [(); 2].map(|()| SourceQueue::new(&bytes()));
    (0..9).for_each(|sample| assert_eq!(flood.push("scan/top", sample, 10), 0));
    honest.push("scan/top", 100, 10);
    let mut queued: Vec<_> = (0..QUEUED_MAX).map(|_| admitted(&flood, &admission).expect("a permit")).collect();
    let (mut of_flood, mut of_honest) = (Box::pin(flood.next(&admission)), Box::pin(honest.next(&admission)));
    assert!((&mut of_flood).now_or_never().is_none() && (&mut of_honest).now_or_never().is_none());
    let poses = SourceQueue::new(&bytes());
    poses.push("pose", 1, 10);
    assert!(admitted(&poses, &admission).is_some_and(|(_, permit)| permit.is_none()), "a pose waits for nothing");
    queued.remove(0);
    assert!((&mut of_honest).now_or_never().is_none());
    let third = of_flood.now_or_never().flatten().expect("it asked first");
    let mut of_flood = Box::pin(flood.next(&admission));
    assert!((&mut of_flood).now_or_never().is_none(), "it asks again");
    queued.remove(0);
    assert!((&mut of_flood).now_or_never().is_none(), "the other asked before it");
    assert_eq!(of_honest.now_or_never().flatten().expect("its turn").1, 100);
    drop(third);
    assert_eq!(of_flood.now_or_never().flatten().expect("its turn").1, 3);
}

#[test]
fn a_source_that_ends_while_it_waits_takes_no_permit() {
    let admission = Admission::default();
    let [first, ended, next] = [(); 3].map(|()| SourceQueue::new(&bytes()));
    (0..QUEUED_MAX as u32).for_each(|sample| assert_eq!(first.push("scan/top", sample, 10), 0));
    assert_eq!([&ended, &next].map(|queue| queue.push("scan/top", 7, 10)), [0, 0]);
    let queued: Vec<_> = (0..QUEUED_MAX).map(|_| admitted(&first, &admission).expect("a permit")).collect();
    let [mut of_ended, mut of_next] = [&ended, &next].map(|queue| Box::pin(queue.next(&admission)));
    assert!((&mut of_ended).now_or_never().is_none() && (&mut of_next).now_or_never().is_none());
    drop((of_ended, queued));
    assert!(of_next.now_or_never().is_some());
}

#[test]
fn the_newest_scan_replaces_the_oldest_of_its_sensor_while_it_waits_and_nothing_else() {
    let admission = Admission::default();
    let queue = SourceQueue::new(&bytes());
    assert_eq!([1, 2].map(|sample| queue.push("scan/top", sample, 40_000)), [0, 0], "within the shared bytes");
    assert_eq!(queue.push("scan/rear", 3, 20_000), 0, "within its own bytes");
    assert_eq!(queue.push("scan/top", 4, 40_000), 1, "the first is lost");
    assert_eq!(queue.push("packet/top", 5, 40_000), 1, "packets replace nothing");
    assert_eq!(queue.push("scan/rear", 6, 90_000), 2, "it has no space beside the scans of another sensor");
    let all = std::iter::from_fn(|| admitted(&queue, &admission).map(|(sample, _)| sample));
    assert_eq!(all.collect::<Vec<_>>(), [2, 4]);
    queue.close();
    assert!(queue.next(&admission).now_or_never().expect("it is closed").is_none());
}

#[test]
fn a_source_that_fills_its_queue_leaves_the_others_their_part() {
    let bytes = bytes();
    let [flood, other, small] = [(); 3].map(|()| SourceQueue::new(&bytes));
    let of_flood: Vec<_> = (0..4).map(|sample| flood.push("packet/top", sample, 40_000)).collect();
    assert_eq!(of_flood, [0, 0, 1, 1]);
    assert_eq!(other.push("scan/top", 1, 24_000), 0);
    let queued = (0..300).filter(|&sample| small.push("pose", sample, 10) == 0).count();
    assert_eq!(queued, SAMPLES_MAX);
    drop((flood, small));
    assert_eq!(other.push("scan/top", 2, 90_000), 0, "a source that ends gives its bytes back");
}

#[test]
fn one_host_never_has_all_streams() {
    let (a, b): (IpAddr, IpAddr) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
    let limits = StreamLimits::new(3, 1);
    let mut held: Vec<_> = (0..2).map(|_| limits.open(a).unwrap()).collect();
    assert_eq!(limits.open(a).unwrap_err(), StreamLimitError::Host { host: a, streams: 2, streams_max: 3 });
    held.push(limits.open(b).unwrap());
    for host in [a, b] {
        assert_eq!(limits.open(host).unwrap_err(), StreamLimitError::All { streams_max: 3 });
    }
    held.remove(0);
    assert!(limits.open(b).is_ok(), "a dropped stream leaves its place");
    assert!(StreamLimits::new(1, 1).open(a).is_ok(), "the only stream is for any host");
}
