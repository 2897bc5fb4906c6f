//! The whole system in one thread and on a clock of its own: simulated sensors, bad networks, the real event queue,
//! engine, recorder and readers' streams, and the recording verified at the end. Nothing sleeps; one seed decides
//! everything.
//!
//! | file | in -> out |
//! |---|---|
//! | [`mod@fault_plan`] | seed -> which faults occur, and when |
//! | [`drive`] | a simulated car with several sensors -> its readings, cast once |
//! | [`sensor_fault`] | readings -> what faulty sensors send, and invalid messages |
//! | `network` | what sensors send -> what arrives at the event queue, through bad networks |
//! | `test_bed` | what arrives -> maps, tick after tick |
//! | [`readers`] | the newest map -> readers of every kind, on the server's own streams |
//! | [`recording_check`] | the server's own recorder -> a disk that fails as planned, verified |
//! | `shutdown_check` | the end of the run -> everything is accounted for |
//! | [`checks`] | what must be true |
//!
//! Faults end at [`fault_plan::HEAL_NS`]; by [`fault_plan::END_NS`] the system must have recovered from all of them.

use std::fmt;

use checks::Violation;
use drive::drives;
use fault_plan::FaultPlan;
pub use fault_plan::InjectedFault;
pub use shutdown_check::{Outcome, REVOLUTIONS_TO_HEAL};
use test_bed::TestBed;

pub mod checks;
pub mod drive;
pub mod fault_plan;
mod network;
pub mod readers;
pub mod recording_check;
pub mod sensor_fault;
mod shutdown_check;
mod test_bed;

/// A run that violated a check.
#[derive(Clone, Debug, PartialEq)]
pub struct Failure {
    /// Seed of the run.
    pub seed: u64,
    /// Time of the violation, in ns after the beginning of the run.
    pub at_ns: i64,
    /// The check, and what it found.
    pub violation: Violation,
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self { seed, violation: Violation { check, found }, .. }, seconds) = (self, self.at_ns as f64 * 1e-9);
        writeln!(f, "seed {seed}, {seconds:.2} s, {check}: {found}")?;
        write!(f, "    again: cargo run --release -p clearway-tests --bin campaign -- --seed {seed}")
    }
}

/// The faults that a seed draws.
pub fn fault_plan(seed: u64) -> FaultPlan {
    let rig = &drives()[0].rig;
    FaultPlan::from_seed(seed, drives().len(), rig.scanners.len(), rig.scanners.len() + rig.units.len())
}

/// Simulates one run.
///
/// # Errors
/// [`Failure`] with the first violated check.
pub fn run(seed: u64, injected: Option<InjectedFault>) -> Result<Outcome, Failure> {
    let plan = fault_plan(seed);
    let mut test_bed = TestBed::new(&plan, injected);
    let outcome = test_bed.run();
    let at_ns = test_bed.now_ns;
    outcome.and_then(|()| test_bed.end()).map_err(|violation| Failure { seed, at_ns, violation })
}
