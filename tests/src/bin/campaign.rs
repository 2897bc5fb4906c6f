//! Runs many simulations of the whole system, or one of them again.
//!
//! `cargo run --release -p clearway-tests --bin campaign -- --seeds 10000` prints counts and every seed that fails;
//! the exit code is 1 if one fails. `--seed 17` runs one seed and prints its faults.

use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use clap::Parser;
use clearway_tests::simulation::{self, Failure, Outcome};
use indicatif::{ProgressBar, ProgressStyle};

/// Simulates the whole system on a clock of its own, with faults drawn from seeds.
#[derive(Parser)]
struct CampaignArguments {
    /// Number of seeds.
    #[arg(long, default_value_t = 10_000)]
    seeds: u64,
    /// First seed.
    #[arg(long, default_value_t = 0)]
    from: u64,
    /// Runs this seed alone and prints its faults.
    #[arg(long)]
    seed: Option<u64>,
    /// Simulations at once; by default one for each core.
    #[arg(long)]
    threads: Option<usize>,
}

/// Seeds between two lines of progress where there is no terminal.
const SEEDS_A_LINE: u64 = 500;

fn main() -> ExitCode {
    let arguments = CampaignArguments::parse();
    let (first, end) = match arguments.seed {
        Some(seed) => (seed, seed + 1),
        None => (arguments.from, arguments.from + arguments.seeds),
    };
    if let Some(seed) = arguments.seed {
        println!("{:#?}", simulation::fault_plan(seed));
    }
    // The drives are made before the time measurement starts.
    simulation::drive::drives();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = arguments.threads.unwrap_or(cores).max(1);
    let bar = ProgressBar::new(end - first).with_style(
        ProgressStyle::with_template("{bar:40} {pos}/{len} seeds, {elapsed}, {eta} left {msg}").expect("a template"),
    );
    let (next, sum, failures) = (AtomicU64::new(first), Mutex::new(Outcome::default()), Mutex::new(Vec::new()));
    let began = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= end {
                        break;
                    }
                    match run(seed) {
                        Ok(outcome) => add(&mut sum.lock().expect("no thread panics here"), &outcome),
                        Err(failure) => {
                            bar.suspend(|| println!("{failure}"));
                            let mut failures = failures.lock().expect("no thread panics here");
                            failures.push(failure);
                            bar.set_message(format!("({} fail)", failures.len()));
                        }
                    }
                    bar.inc(1);
                    // Redirected output has no bar.
                    if bar.is_hidden() && bar.position().is_multiple_of(SEEDS_A_LINE) {
                        eprintln!("{} of {} seeds, {} s", bar.position(), end - first, began.elapsed().as_secs());
                    }
                }
            });
        }
    });
    bar.finish_and_clear();
    let (sum, failures) =
        (sum.into_inner().expect("all threads have ended"), failures.into_inner().expect("all threads have ended"));
    report(end - first, &sum, &failures, began.elapsed().as_secs_f64());
    if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs one seed; a panic is a failure like any other.
fn run(seed: u64) -> Result<Outcome, Failure> {
    std::panic::catch_unwind(|| simulation::run(seed, None)).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        let said = said.or_else(|| panic.downcast_ref::<&str>().map(|said| (*said).to_owned()));
        Err(Failure { seed, at_ns: 0, violation: simulation::checks::violation("panic", said.unwrap_or_default()) })
    })
}

fn add(sum: &mut Outcome, outcome: &Outcome) {
    sum.simulated_ns += outcome.simulated_ns;
    sum.events += outcome.events;
    sum.maps += outcome.maps;
    sum.refused += outcome.refused;
    sum.lost += outcome.lost;
    sum.read = (sum.read.0 + outcome.read.0, sum.read.1 + outcome.read.1);
    sum.healed_in = sum.healed_in.max(outcome.healed_in);
    sum.fresh_in = sum.fresh_in.max(outcome.fresh_in);
}

fn report(seeds: u64, sum: &Outcome, failures: &[Failure], seconds: f64) {
    let Outcome { events, maps, refused, lost, read: (read, skipped), healed_in, fresh_in, .. } = sum;
    let simulated = sum.simulated_ns as f64 * 1e-9;
    println!("{seeds} seeds, {} failed", failures.len());
    println!(
        "{:.2} simulated hours in {:.2} h: {:.0} times real time",
        simulated / 3600.0,
        seconds / 3600.0,
        simulated / seconds
    );
    println!(
        "{events} events, {refused} refused, {lost} lost, {maps} maps; readers received {read} and skipped {skipped}"
    );
    println!("whole at most {healed_in} revolutions after the faults, fresh at most {fresh_in}");
    if !failures.is_empty() {
        let seeds: Vec<String> = failures.iter().map(|failure| failure.seed.to_string()).collect();
        println!("failing seeds: {}", seeds.join(" "));
    }
}
