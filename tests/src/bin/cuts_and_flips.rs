//! Cuts a recording at many bytes and changes many of its bits, and judges what is read of each copy.
//!
//! `cargo run --release -p clearway-tests --bin cuts_and_flips -- drive.mcap --flips 10000` cuts at every byte, repairs
//! every 499th cut and every changed copy, and verifies what was repaired; the exit code is 1 if damage is not named,
//! costs more than its chunk, or causes a panic, or if a repaired copy lacks what can be read or does not verify. With
//! `--clearway PROGRAM` that program does the same with every 4999th cut, and its exit codes are judged.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use clap::Parser;
use clearway_tests::damage::{DamageOutcome, Original, rechunk};
use tempfile::TempDir;

/// Cuts a recording at many bytes and changes many of its bits.
#[derive(Parser)]
struct CutsArguments {
    /// The recording.
    file: PathBuf,
    /// Cut at every so many bytes.
    #[arg(long, default_value_t = 1)]
    cut_step: usize,
    /// Repair and verify at every so many bytes, and at each start of a record.
    #[arg(long, default_value_t = 499)]
    repair_step: usize,
    /// Run `info`, `verify` and `repair` of this program on every so many bytes' cut.
    #[arg(long)]
    clearway: Option<PathBuf>,
    /// The bytes between two cuts that --clearway gets.
    #[arg(long, default_value_t = 4999)]
    clearway_step: usize,
    /// Number of changed bits.
    #[arg(long, default_value_t = 10_000)]
    flips: usize,
    /// Change every bit of this many bytes at the start and at the end.
    #[arg(long, default_value_t = 0)]
    flips_at_ends: usize,
    /// Write the recording again in chunks of this size first.
    #[arg(long)]
    chunk_bytes: Option<u64>,
    /// Seed of the changed bits.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Copies at once.
    #[arg(long, default_value_t = 2)]
    threads: usize,
}

fn main() -> ExitCode {
    let arguments = CutsArguments::parse();
    let bytes = std::fs::read(&arguments.file).expect("the recording can be read");
    let bytes = match arguments.chunk_bytes {
        Some(chunk_bytes) => rechunk(&bytes, chunk_bytes).expect("the recording is whole"),
        None => bytes,
    };
    let original = Original::read(bytes).expect("the recording is whole");
    println!("{} bytes, {} chunks, seed {}", original.length(), original.chunks(), arguments.seed);
    let cuts = original.length().div_ceil(arguments.cut_step);
    let is_good = judge("cuts", cuts, arguments.threads, || {
        let original = &original;
        move |index| original.cut(index * arguments.cut_step)
    });
    let mut repairs: Vec<usize> = (0..original.length()).step_by(arguments.repair_step).collect();
    repairs.extend(original.near_records(0));
    let is_good = judge("repaired cuts", repairs.len(), arguments.threads, || {
        let (original, repairs, folder) = (&original, &repairs, tempfile::tempdir().expect("a folder"));
        move |index| original.repair_cut(repairs[index], folder.path())
    }) && is_good;
    let is_good = arguments.clearway.as_ref().is_none_or(|clearway| {
        let cuts = original.length().div_ceil(arguments.clearway_step);
        judge("cuts read by the program", cuts, arguments.threads, || {
            let (original, folder) = (&original, tempfile::tempdir().expect("a folder"));
            move |index| original.cut_by_program(index * arguments.clearway_step, clearway, folder.path())
        })
    }) && is_good;
    let folder = TempDir::new().expect("a folder");
    let copies = AtomicUsize::new(0);
    let copy = || {
        let copy = folder.path().join(format!("{}.mcap", copies.fetch_add(1, Ordering::Relaxed)));
        original.copy(&copy).expect("a copy")
    };
    let ends = arguments.flips_at_ends.min(original.length() / 2);
    let is_good = judge("flips at the ends", ends * 16, arguments.threads, || {
        let (original, copy) = (&original, copy());
        move |index| {
            let (byte, bit) = (index / 8, (index % 8) as u8);
            copy.flip(original, if byte < ends { byte } else { original.length() - 2 * ends + byte }, bit)
        }
    }) && is_good;
    let is_good = judge("flips", arguments.flips, arguments.threads, || {
        let (original, copy) = (&original, copy());
        move |index| {
            let random = random(arguments.seed, index as u64);
            copy.flip(original, (random >> 3) as usize % original.length(), (random & 7) as u8)
        }
    }) && is_good;
    if is_good { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Judges `count` copies on several threads and prints the counts; `start` makes the judge of a thread.
fn judge<J: FnMut(usize) -> Result<DamageOutcome, String>>(
    what: &str,
    count: usize,
    threads: usize,
    start: impl Fn() -> J + Sync,
) -> bool {
    let (next, began) = (AtomicUsize::new(0), Instant::now());
    let outcomes = Mutex::new((BTreeMap::<&str, u64>::new(), Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                let mut judge = start();
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= count {
                        break;
                    }
                    let judged = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| judge(index)));
                    let mut outcomes = outcomes.lock().expect("no thread panics here");
                    let (counts, failures) = &mut *outcomes;
                    match judged.unwrap_or_else(|_| Err(format!("{what} {index}: panic"))) {
                        Ok(outcome) => {
                            *counts.entry("refused by name").or_default() += u64::from(outcome.refused);
                            *counts.entry("no message lost").or_default() +=
                                u64::from(!outcome.refused && outcome.lost == 0);
                            *counts.entry("lost messages").or_default() += outcome.lost;
                            *counts.entry("of them named by topic").or_default() += outcome.named.min(outcome.lost);
                            *counts.entry("repaired and verified").or_default() += u64::from(outcome.repaired);
                        }
                        Err(failure) => failures.push(format!("{index}: {failure}")),
                    }
                }
            });
        }
    });
    let (counts, failures) = outcomes.into_inner().expect("all threads have ended");
    println!("{count} {what}, {} failed, {:.0} s: {counts:?}", failures.len(), began.elapsed().as_secs_f64());
    failures.iter().take(20).for_each(|failure| println!("  {failure}"));
    failures.is_empty()
}

/// A number from a seed (splitmix64).
fn random(seed: u64, index: u64) -> u64 {
    let mut z = seed.wrapping_add((index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
