//! Random worlds -> counts by type of world.
//!
//! In: seeds. Out: an [`EvaluatedSource`] with one row for each theme and each form of the ground, one for even and one
//! for odd seeds, and a line for each world. Several worlds are judged at once, each with a pipeline of its own, one
//! revolution each; the result does not depend on the number of threads.

use std::num::NonZero;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Result;
use clearway_mapping::config::MapsConfig;
use clearway_sim::random::{Form, RandomWorld, Theme, random_world};
use clearway_sim::scanner::ScannerConfig;

use super::super::options::EvaluateOptions;
use super::super::report::{EvaluatedRow, EvaluatedSource, EvaluatedWorld};
use super::worlds::drive;
use super::written::{WrittenFrame, write_sweep};

/// Judges the random worlds of all seeds.
///
/// # Errors
/// If a value of the configuration is not allowed, or a scan cannot be written.
pub fn judge_random_worlds(
    options: &EvaluateOptions,
    maps: &MapsConfig,
    source: &mut EvaluatedSource,
    judged: &mut (impl FnMut() + Send),
) -> Result<()> {
    let next = AtomicU64::new(options.seeds.start);
    let done = Mutex::new((Vec::new(), judged));
    let work = || -> Result<()> {
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= options.seeds.end {
                return Ok(());
            }
            let world = random_world(seed);
            let row = judge_random_world(&world, options, maps)?;
            let mut done = done.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            done.0.push((world, row));
            (done.1)();
        }
    };
    let threads = std::thread::available_parallelism().map_or(1, NonZero::get).min(8);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|thread| thread.join().expect("a world is judged without a panic"))
    })?;
    let mut worlds = done.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()).0;
    worlds.sort_by_key(|(world, _)| world.seed);
    add_up(&worlds, source);
    Ok(())
}

fn judge_random_world(world: &RandomWorld, options: &EvaluateOptions, maps: &MapsConfig) -> Result<EvaluatedRow> {
    let scanner = ScannerConfig {
        model: options.model.unwrap_or(ScannerConfig::default().model),
        ego_from_sensor: world.ego_from_sensor,
        seed: world.seed,
        ..ScannerConfig::default()
    };
    let mut row = EvaluatedRow::default();
    drive(world.scene.clone(), scanner, maps, 1, |pipeline, extrinsics, truth| {
        row.judge_map(pipeline, truth)?;
        if let Some(folder) = &options.write_scans {
            let rows = rows_of(world);
            let rows: Vec<&str> = rows.iter().map(|(name, _)| name.as_str()).collect();
            let (folder, name) = (&folder.join("random"), &world.seed.to_string());
            let frame = WrittenFrame { folder, name, path: PATH, rows: &rows };
            write_sweep(&frame, (pipeline.newest_sweep(), extrinsics), truth.points)?;
        }
        Ok(())
    })?;
    Ok(row)
}

/// The path that stands for random worlds.
const PATH: &str = "sim:random";

/// The rows in which a world is counted, and whether no parameter may be tuned on their worlds.
fn rows_of(world: &RandomWorld) -> [(String, bool); 4] {
    let parity = if world.seed.is_multiple_of(2) { ("even seeds", false) } else { ("odd seeds", true) };
    [
        (ALL.to_owned(), false),
        (parity.0.to_owned(), parity.1),
        (world.theme.name().to_owned(), false),
        (format!("ground: {}", world.form.name()), false),
    ]
}

/// Name of the row of all worlds.
const ALL: &str = "all worlds";

/// Sums the worlds by parity, theme and form. Types without a world have no row.
fn add_up(worlds: &[(RandomWorld, EvaluatedRow)], source: &mut EvaluatedSource) {
    // The rows are in the order of the types, whatever the first seed is.
    let mut order = vec![ALL.to_owned(), "even seeds".to_owned(), "odd seeds".to_owned()];
    order.extend(Theme::ALL.map(|theme| theme.name().to_owned()));
    order.extend(Form::ALL.map(|form| format!("ground: {}", form.name())));
    for name in order {
        for (world, row) in worlds {
            if let Some((_, final_only)) = rows_of(world).into_iter().find(|(known, _)| *known == name) {
                source.row(&name, final_only).merge(row);
            }
        }
    }
    source.worlds = worlds
        .iter()
        .map(|(world, row)| EvaluatedWorld {
            seed: world.seed,
            name: format!("{}, {}", world.theme.name(), world.form.name()),
            description: world.description.clone(),
            row: row.clone(),
        })
        .collect();
}
