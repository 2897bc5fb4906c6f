//! Many runs of the whole-house simulation, or one of them again.
//!
//! `cargo run --release -p clearway-tests --bin campaign -- --seeds 10000` prints figures and every seed that fails,
//! and then ends with 1; `--seed 17` runs one seed and prints what it has in store.

use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use clap::Parser;
use clearway_tests::simulation::{self, Failure, Outcome};
use indicatif::{ProgressBar, ProgressStyle};

/// Runs the whole house on a simulated clock, under faults drawn from seeds.
#[derive(Parser)]
struct Arguments {
    /// How many seeds.
    #[arg(long, default_value_t = 10_000)]
    seeds: u64,
    /// The first of them.
    #[arg(long, default_value_t = 0)]
    from: u64,
    /// This seed alone, and what it has in store.
    #[arg(long)]
    seed: Option<u64>,
    /// Runs at once; as many as there are cores where absent.
    #[arg(long)]
    threads: Option<usize>,
}

/// Where there is no terminal, so many seeds make a line.
const SEEDS_A_LINE: u64 = 500;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let (first, end) = match arguments.seed {
        Some(seed) => (seed, seed + 1),
        None => (arguments.from, arguments.from + arguments.seeds),
    };
    if let Some(seed) = arguments.seed {
        println!("{:#?}", simulation::fate(seed));
    }
    // Cast before the clock starts.
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
                        Ok(outcome) => add(&mut sum.lock().expect("nobody panics here"), &outcome),
                        Err(failure) => {
                            bar.suspend(|| println!("{failure}"));
                            let mut failures = failures.lock().expect("nobody panics here");
                            failures.push(failure);
                            bar.set_message(format!("({} fail)", failures.len()));
                        }
                    }
                    bar.inc(1);
                    // Who redirects the output sees no bar.
                    if bar.is_hidden() && bar.position().is_multiple_of(SEEDS_A_LINE) {
                        eprintln!("{} of {} seeds, {} s", bar.position(), end - first, began.elapsed().as_secs());
                    }
                }
            });
        }
    });
    bar.finish_and_clear();
    let (sum, failures) = (sum.into_inner().expect("all have ended"), failures.into_inner().expect("all have ended"));
    report(end - first, &sum, &failures, began.elapsed().as_secs_f64());
    if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// A panic is a failure like any other.
fn run(seed: u64) -> Result<Outcome, Failure> {
    std::panic::catch_unwind(|| simulation::run(seed, None)).unwrap_or_else(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        let said = said.or_else(|| panic.downcast_ref::<&str>().map(|said| (*said).to_owned()));
        Err(Failure { seed, at_ns: 0, breach: simulation::checks::breach("panic", said.unwrap_or_default()) })
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
}

fn report(seeds: u64, sum: &Outcome, failures: &[Failure], seconds: f64) {
    let Outcome { events, maps, refused, lost, read: (read, skipped), healed_in, .. } = sum;
    let simulated = sum.simulated_ns as f64 * 1e-9;
    println!("{seeds} seeds, {} failed", failures.len());
    println!(
        "{:.2} simulated hours in {:.2} h: {:.0} times real time",
        simulated / 3600.0,
        seconds / 3600.0,
        simulated / seconds
    );
    println!(
        "{events} events, {refused} refused, {lost} lost, {maps} maps; readers got {read} and were told of {skipped} they missed"
    );
    println!("whole again {healed_in} turns after the faults at the latest");
    if !failures.is_empty() {
        let seeds: Vec<String> = failures.iter().map(|failure| failure.seed.to_string()).collect();
        println!("failing seeds: {}", seeds.join(" "));
    }
}
