//! Files -> the result of each, several at a time.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Result, bail};

use crate::terminal::{Exit, counted, with_causes};
use clearway_daemon::base::sync::locked;
use clearway_daemon::config::{Calibrations, Config};
use clearway_daemon::record::{recorded_config, recorded_vehicles, run_config, verify};
use clearway_journal::compare::{After, Comparison, compare};
use clearway_journal::reader::RecordingReader;
use clearway_journal::verify::Report;

/// What is checked of each recording.
pub enum Check {
    /// That its maps are the maps of its events.
    Verify,
    /// What another configuration changes in its maps; without one, the recorded configuration with overrides.
    Config { config: Option<Box<NewConfig>>, set: Vec<String> },
    /// What differs in the maps of another recording.
    Against(PathBuf),
}

/// A configuration and its calibration tables.
pub struct NewConfig(Config, Calibrations);

impl NewConfig {
    /// Reads a configuration, with overrides, and its calibration tables.
    ///
    /// # Errors
    /// [`ConfigError`](clearway_daemon::config::ConfigError).
    pub fn load(file: &Path, set: &[String]) -> Result<Self> {
        let config = Config::load(file, set)?;
        let tables = config.calibrations(file)?;
        Ok(Self(config, tables))
    }
}

/// The result of one file.
pub struct Checked {
    pub file: PathBuf,
    /// Time that the check took, in seconds.
    pub seconds: f64,
    pub outcome: CheckOutcome,
}

/// What a check found.
pub enum CheckOutcome {
    Verified(Report),
    Compared(Comparison),
    /// The file cannot be read, or its maps cannot be made or compared: the reason.
    Unreadable(String),
}

impl Checked {
    /// The result of files, patterns and stores that name no recording.
    pub fn not_found(given: &[String], reason: String) -> Self {
        let (file, outcome) = (given.join(" ").into(), CheckOutcome::Unreadable(reason));
        Self { file, seconds: 0.0, outcome }
    }

    /// [`Exit::Differs`] if a map differs, else [`Exit::Unreadable`] if the file could not be checked, is not whole,
    /// has no event or no map to compare, else [`Exit::Good`].
    pub fn exit(&self) -> Exit {
        match &self.outcome {
            CheckOutcome::Verified(report) if report.different > 0 => Exit::Differs,
            CheckOutcome::Verified(report) => Exit::from_incomplete(!report.is_good() || report.incomplete.is_some()),
            CheckOutcome::Compared(comparison) if !comparison.is_equal() => Exit::Differs,
            CheckOutcome::Compared(comparison) => {
                Exit::from_incomplete(comparison.incomplete.is_some() || comparison.before + comparison.after == 0)
            }
            CheckOutcome::Unreadable(_) => Exit::Unreadable,
        }
    }

    /// Why the file was not checked; `None` if it was.
    pub fn not_checked(&self) -> Option<&String> {
        let CheckOutcome::Unreadable(reason) = &self.outcome else { return None };
        Some(reason)
    }

    /// True if the maps that were compared are equal, and the file is not whole.
    pub fn is_equal_but_not_whole(&self) -> bool {
        let (incomplete, maps) = match &self.outcome {
            CheckOutcome::Verified(report) => (&report.incomplete, report.equal),
            CheckOutcome::Compared(comparison) => (&comparison.incomplete, comparison.before + comparison.after),
            CheckOutcome::Unreadable(_) => return false,
        };
        self.exit() == Exit::Unreadable && incomplete.is_some() && maps > 0
    }

    /// True if the whole file was checked and all its maps are equal.
    pub fn is_good(&self) -> bool {
        self.exit() == Exit::Good
    }
}

/// Number of the maps that changed most that are listed for each recording. Ours: they fit a screen.
const WORST: usize = 5;

/// Checks all files, as many at the same time as there are processors; the results are in the order of the files.
pub fn check_all(files: &[PathBuf], check: &Check) -> Vec<Checked> {
    let jobs = std::thread::available_parallelism().map_or(1, usize::from);
    let next = AtomicUsize::new(0);
    let results: Mutex<Vec<Option<Checked>>> = Mutex::new(files.iter().map(|_| None).collect());
    std::thread::scope(|scope| {
        for _ in 0..jobs.min(files.len()) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(file) = files.get(index) else { break };
                    let result = check_one(file, check);
                    let mut results = locked(&results);
                    results[index] = Some(result);
                    // A person sees that the command goes on; the results are printed at the end.
                    if std::io::stderr().is_terminal() {
                        let checked = results.iter().flatten().count();
                        eprintln!("clearway: {checked} of {} checked", counted(files.len() as u64, "file"));
                    }
                }
            });
        }
    });
    results.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner).into_iter().flatten().collect()
}

fn check_one(file: &Path, check: &Check) -> Checked {
    let began = Instant::now();
    let outcome = outcome_of(file, check).unwrap_or_else(|error| CheckOutcome::Unreadable(with_causes(&error)));
    Checked { file: file.to_owned(), seconds: began.elapsed().as_secs_f64(), outcome }
}

/// The outcome of a file, or of a recording in a store, which is copied here meanwhile.
fn outcome_of(file: &Path, check: &Check) -> Result<CheckOutcome> {
    #[cfg(feature = "store")]
    if let Some(url) = file.to_str().filter(|text| super::files::is_url(text)) {
        let copy = crate::process::block_on(clearway_daemon::store::fetch::fetch(url))?;
        // A reason names the copy, which is gone when it is read.
        return outcome(copy.path(), check)
            .map_err(|error| anyhow::anyhow!(with_causes(&error).replace(&copy.path().display().to_string(), url)));
    }
    outcome(file, check)
}

fn outcome(file: &Path, check: &Check) -> Result<CheckOutcome> {
    Ok(match check {
        Check::Verify => CheckOutcome::Verified(verify(file)?),
        Check::Against(other) => {
            super::same_drive::check(file, other)?;
            let comparison = compare(file, &After::Recording(other), WORST)?;
            if comparison.layers.values().all(|layer| layer.maps == 0) {
                bail!(
                    "no map in common with {}: no vehicle and layer has maps of one stamp on both sides; are they \
                     recordings of the same drive?",
                    other.display()
                );
            }
            CheckOutcome::Compared(comparison)
        }
        Check::Config { config, set } => {
            let given = match config.as_deref() {
                Some(NewConfig(config, tables)) => recorded_vehicles(config, tables.clone()),
                None => {
                    let config = overridden(file, set)?;
                    let no_tables = vec![Vec::new(); config.vehicles.len()];
                    recorded_vehicles(&config, no_tables)
                }
            };
            let (config, tables) = run_config(&RecordingReader::open(file)?)?;
            let recorded = &recorded_vehicles(&config, tables);
            CheckOutcome::Compared(compare(file, &After::Config { given: &given, recorded }, WORST)?)
        }
    })
}

/// The recorded configuration with overrides.
fn overridden(file: &Path, set: &[String]) -> Result<Config> {
    let recording = RecordingReader::open(file)?;
    run_config(&recording)?;
    Ok(recorded_config(&recording, set)?)
}
