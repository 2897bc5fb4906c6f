//! The log on stderr: as text or JSON, at most [`LINES_MAX`] lines in [`PERIOD`] from one place of the program about
//! one vehicle and sensor, so that a fault that repeats itself fills no disk and hides no other.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::prelude::*;
use tracing_subscriber::{EnvFilter, fmt};

use super::usage::usage_error;
use clearway_daemon::base::sync::locked;

/// Most lines of one kind in a [`PERIOD`]. Ours: a start names each sensor and address once.
const LINES_MAX: u32 = 20;
/// Time in which lines of one kind are counted.
const PERIOD: Duration = Duration::from_secs(10);
/// Most kinds that are remembered. Ours: the places that log, for some vehicles and sensors.
const KINDS_MAX: usize = 4096;

/// Environment variable with the format of the log: `text` (the default) or `json`, one object a line.
const FORMAT: &str = "CLEARWAY_LOG_FORMAT";

/// Starts the log of this process. `RUST_LOG` selects what is logged.
///
/// # Errors
/// If the format is neither `text` nor `json`.
pub fn start() -> anyhow::Result<()> {
    let format = std::env::var(FORMAT).unwrap_or_default();
    let filter =
        EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,zenoh=error,object_store=warn"));
    let log = tracing_subscriber::registry().with(filter).with(Limit::default());
    let lines = fmt::layer().with_writer(std::io::stderr);
    match &*format {
        "" | "text" => log.with(lines.with_ansi(std::io::stderr().is_terminal())).init(),
        "json" => log.with(lines.json()).init(),
        other => return Err(usage_error(format!("{FORMAT}={other}: text and json are allowed"))),
    }
    Ok(())
}

/// Leaves out lines that repeat themselves, and says so.
#[derive(Default)]
struct Limit(Mutex<LineCounts>);

impl<S: Subscriber> Layer<S> for Limit {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let mut about = LineSubject::default();
        event.record(&mut about);
        let kind = (event.metadata().callsite(), about.0.finish());
        let target = event.metadata().target();
        // The lines of this function have their own kinds, so the counts must be free again.
        let admission = locked(&self.0).admit(kind, Instant::now());
        match admission {
            Admission::Admitted { left_out: 0 } => true,
            Admission::Admitted { left_out } => {
                tracing::warn!(left_out, of = target, "lines like the next one were left out");
                true
            }
            Admission::FirstLeftOut => {
                let seconds = PERIOD.as_secs();
                tracing::warn!(of = target, seconds, "lines like the last one are left out for a while");
                false
            }
            Admission::LeftOut => false,
        }
    }
}

/// What a line is about: its vehicle and its sensor, hashed.
#[derive(Default)]
struct LineSubject(DefaultHasher);

impl Visit for LineSubject {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if matches!(field.name(), "vehicle" | "sensor") {
            (field.name(), format!("{value:?}")).hash(&mut self.0);
        }
    }
}

/// Where a line comes from, and what it is about.
type LineKind = (Identifier, u64);

/// The lines of each kind in the newest period.
#[derive(Default)]
struct LineCounts(HashMap<LineKind, LineCount>);

struct LineCount {
    since: Instant,
    lines: u32,
}

/// What becomes of a line.
#[derive(Debug, PartialEq)]
enum Admission {
    /// It is logged; so many of its kind were left out before it.
    Admitted { left_out: u32 },
    /// It is the first of its kind that is left out.
    FirstLeftOut,
    /// It is left out, as the one before.
    LeftOut,
}

impl LineCounts {
    fn admit(&mut self, kind: LineKind, now: Instant) -> Admission {
        if self.0.len() >= KINDS_MAX && !self.0.contains_key(&kind) {
            // What was left out of a kind that is still noisy stays counted.
            self.0.retain(|_, count| now.duration_since(count.since) < PERIOD || count.lines > LINES_MAX);
        }
        let count = self.0.entry(kind).or_insert(LineCount { since: now, lines: 0 });
        let left_out = match now.duration_since(count.since) >= PERIOD {
            true => std::mem::replace(count, LineCount { since: now, lines: 0 }).lines.saturating_sub(LINES_MAX),
            false => 0,
        };
        count.lines = count.lines.saturating_add(1);
        match count.lines.checked_sub(LINES_MAX) {
            None | Some(0) => Admission::Admitted { left_out },
            Some(1) => Admission::FirstLeftOut,
            Some(_) => Admission::LeftOut,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use super::*;

    /// A log that can be read.
    #[derive(Clone, Default)]
    struct WrittenLines(Arc<Mutex<Vec<u8>>>);

    impl Write for WrittenLines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            locked(&self.0).write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_line_that_repeats_itself_is_left_out_and_one_of_another_vehicle_is_not() {
        let lines = WrittenLines::default();
        let writer = lines.clone();
        let log = fmt::layer().with_ansi(false).with_writer(move || writer.clone());
        tracing::subscriber::with_default(tracing_subscriber::registry().with(Limit::default()).with(log), || {
            let fail = |vehicle: &str| tracing::warn!(vehicle, "no packets");
            (0..100).for_each(|_| fail("car"));
            fail("van");
        });
        let text = String::from_utf8(locked(&lines.0).clone()).unwrap();
        assert_eq!(text.matches("no packets vehicle=\"car\"").count(), 20, "{text}");
        assert_eq!(text.matches("no packets vehicle=\"van\"").count(), 1, "{text}");
    }

    #[test]
    fn the_first_line_left_out_and_the_number_of_all_are_said() {
        let (mut counts, start) = (LineCounts::default(), Instant::now());
        let callsite = {
            use tracing::Callsite;
            tracing::callsite! { name: "test", kind: tracing::metadata::Kind::EVENT, fields: }.metadata().callsite()
        };
        let kind = (callsite, 0);
        let first: Vec<_> = (0..25).map(|_| counts.admit(kind.clone(), start)).collect();
        assert!(first[..20].iter().all(|admission| *admission == Admission::Admitted { left_out: 0 }), "{first:?}");
        assert_eq!(first[20], Admission::FirstLeftOut);
        assert!(first[21..].iter().all(|admission| *admission == Admission::LeftOut), "{first:?}");
        assert_eq!(counts.admit(kind.clone(), start + PERIOD), Admission::Admitted { left_out: 5 });
        assert_eq!(counts.admit(kind, start + PERIOD), Admission::Admitted { left_out: 0 });
    }
}
