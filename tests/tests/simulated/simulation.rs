//! The whole system under faults drawn from seeds: it counts everything, it recovers, and its recording is equal to its
//! maps. Injected faults show that each check can fail.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use clearway_tests::simulation::{Failure, InjectedFault, Outcome, run};

/// Seeds of a test, among them a seed with a full queue; the program `campaign` runs as many as wanted.
const SEEDS: Range<u64> = 40..80;
/// Seeds among which an injected fault must be found.
const INJECTED: u64 = 24;

/// These seeds, on every core.
fn all(seeds: Range<u64>) -> Vec<Result<Outcome, Failure>> {
    let next = AtomicU64::new(seeds.start);
    let run_seeds = || {
        let seeds =
            std::iter::repeat_with(|| next.fetch_add(1, Ordering::Relaxed)).take_while(|seed| *seed < seeds.end);
        seeds.map(|seed| run(seed, None)).collect::<Vec<_>>()
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(run_seeds)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("the seed is printed above")).collect()
    })
}

#[test]
fn every_fault_of_forty_seeds_is_counted_and_recovered_from() {
    let (good, failed): (Vec<_>, Vec<_>) = all(SEEDS).into_iter().partition(Result::is_ok);
    let failed: Vec<String> = failed.into_iter().filter_map(Result::err).map(|failure| failure.to_string()).collect();
    assert!(failed.is_empty(), "{} seeds fail:\n{}", failed.len(), failed.join("\n"));
    // Without faults this test would show nothing.
    let sum = |of: &dyn Fn(&Outcome) -> u64| good.iter().flatten().map(of).sum::<u64>();
    let (refused, lost, skipped) = (sum(&|run| run.refused), sum(&|run| run.lost), sum(&|run| run.read.1));
    let whole = sum(&|run| u64::from(run.recorded));
    assert!(refused > 400 && lost > 40 && skipped > 40, "{refused} refused, {lost} lost, {skipped} skipped");
    let seeds = SEEDS.end - SEEDS.start;
    assert!((seeds / 4..seeds * 3 / 4).contains(&whole), "{whole} recordings are whole");
}

#[test]
fn the_same_seed_runs_the_same() {
    for seed in [3, 4] {
        assert_eq!(run(seed, None), run(seed, None), "seed {seed}");
    }
}

#[test]
fn an_injected_fault_is_found_by_its_check() {
    let faults = [
        (InjectedFault::UncountedDatagram, "ledger"),
        (InjectedFault::CorruptMap, "reader"),
        (InjectedFault::UnreportedSkips, "reader"),
        (InjectedFault::StalledReader, "converge"),
        (InjectedFault::FreedCells, "covered"),
        (InjectedFault::UnrecordedEvent, "recording"),
        (InjectedFault::CorruptRecording, "recording"),
        (InjectedFault::LostOutcome, "outcomes"),
        (InjectedFault::SilentSensor, "converge"),
        (InjectedFault::StuckStamp, "stamps"),
    ];
    for (injected, check) in faults {
        let found = (0..INJECTED).find_map(|seed| run(seed, Some(injected)).err());
        let found = found.unwrap_or_else(|| panic!("{injected:?} is not found"));
        assert_eq!(found.violation.check, check, "{injected:?}: {found}");
        let said = found.to_string();
        assert!(said.contains(&format!("--seed {}", found.seed)), "{said}");
    }
}
