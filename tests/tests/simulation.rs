//! The whole house under faults drawn from seeds: it counts everything, heals, and its recording is its maps; and the
//! checks that say so can fail.

use std::sync::atomic::{AtomicU64, Ordering};

use clearway_tests::simulation::{Failure, Outcome, Plant, run};

const SEEDS: u64 = 100;
/// Seeds among which a planted fault must show.
const PLANTED: u64 = 24;

/// All seeds below `seeds`, on every core.
fn all(seeds: u64) -> Vec<Result<Outcome, Failure>> {
    let next = AtomicU64::new(0);
    let take = || {
        let seeds = std::iter::repeat_with(|| next.fetch_add(1, Ordering::Relaxed)).take_while(|seed| *seed < seeds);
        seeds.map(|seed| run(seed, None)).collect::<Vec<_>>()
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(take)).collect();
        threads.into_iter().flat_map(|thread| thread.join().expect("a seed above says why it panicked")).collect()
    })
}

#[test]
fn whatever_goes_wrong_is_counted_recorded_and_healed_from_for_a_hundred_seeds() {
    let (good, failed): (Vec<_>, Vec<_>) = all(SEEDS).into_iter().partition(Result::is_ok);
    let failed: Vec<String> = failed.into_iter().filter_map(Result::err).map(|failure| failure.to_string()).collect();
    assert!(failed.is_empty(), "{} of {SEEDS} seeds fail:\n{}", failed.len(), failed.join("\n"));
    // Faults that never happened would prove nothing.
    let sum = |of: &dyn Fn(&Outcome) -> u64| good.iter().flatten().map(of).sum::<u64>();
    let (refused, lost, skipped) = (sum(&|run| run.refused), sum(&|run| run.lost), sum(&|run| run.read.1));
    let whole = sum(&|run| u64::from(run.recorded));
    assert!(refused > 1000 && lost > 100 && skipped > 100, "{refused} refused, {lost} lost, {skipped} skipped");
    assert!((SEEDS / 4..SEEDS * 3 / 4).contains(&whole), "{whole} recordings are whole");
}

#[test]
fn the_same_seed_runs_the_same() {
    for seed in [3, 4] {
        assert_eq!(run(seed, None), run(seed, None), "seed {seed}");
    }
}

#[test]
fn a_planted_fault_is_found_by_the_check_it_is_meant_for() {
    let plants = [
        (Plant::UncountedDatagram, "ledger"),
        (Plant::SpoiltMap, "reader"),
        (Plant::UntoldSkips, "reader"),
        (Plant::AsleepReader, "converge"),
        (Plant::FreedCells, "covered"),
        (Plant::UnrecordedEvent, "recording"),
        (Plant::RottenRecording, "recording"),
        (Plant::LostVerdict, "verdicts"),
        (Plant::EndlessSilence, "converge"),
        (Plant::StuckStamp, "stamps"),
    ];
    for (plant, check) in plants {
        let found = (0..PLANTED).find_map(|seed| run(seed, Some(plant)).err());
        let found = found.unwrap_or_else(|| panic!("{plant:?} is not found"));
        assert_eq!(found.breach.check, check, "{plant:?}: {found}");
        let said = found.to_string();
        assert!(said.contains(&format!("--seed {}", found.seed)), "{said}");
    }
}
