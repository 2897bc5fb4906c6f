//! Finished parts of the recording -> the store of the configuration, confirmed, while the server runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use object_store::path::Path as Key;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::config::Store;
use crate::record::writer::{RecorderControl, RecorderCounts};
use crate::store::location;
use crate::store::upload::{self, UploadError};
use crate::store::upload_limit::UploadLimit;

/// Time between two looks for finished parts, and the first between two attempts with a store that is away; each
/// further one is twice as long. Ours: a part is minutes long.
const PERIOD: Duration = Duration::from_secs(2);
/// Longest time between two attempts. Ours: a store that was away for an hour gets its parts a minute after its return.
const PERIOD_MAX: Duration = Duration::from_secs(60);

/// Longest time until the store answers whether it has a part. Ours: a part itself may take a minute on a thin link,
/// and a store that hangs is to be named before.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// A file as it was when it was read: path, length, time of the newest change.
type Seen = (PathBuf, u64, SystemTime);

/// What an attempt to store all parts found wrong.
enum Problem {
    /// A part or the configuration: the reason.
    Part(String),
    /// The store refuses or does not answer: the reason.
    Store(String),
}

/// The parts of the folder, and the store.
struct Uploads {
    options: Store,
    /// Age up to which a part may be in a save of the last seconds, and is not deleted.
    saved: Duration,
    control: RecorderControl,
    counts: Arc<RecorderCounts>,
    store: Option<Arc<dyn ObjectStore>>,
    limit: Option<UploadLimit>,
    answer_timeout: Duration,
    /// Parts that the store has confirmed, and parts without an event or a map.
    settled: BTreeSet<Seen>,
}

/// Sends each finished part to the store until the task is aborted. What the store does not confirm
/// stays, and is sent again. With `delete`, what it confirms is deleted once it is older than `saved`.
pub(super) async fn upload_finished(
    options: Store,
    saved: Duration,
    control: RecorderControl,
    counts: Arc<RecorderCounts>,
) {
    let mut uploads = Uploads::new(options, saved, control, counts);
    let mut period = PERIOD;
    loop {
        let problem = uploads.upload_all().await.err();
        period = period_after(period, problem.as_ref());
        let reason = problem.map(|(Problem::Part(reason) | Problem::Store(reason))| reason);
        if let Some(reason) = &reason {
            tracing::warn!(store = uploads.options.url, reason, "parts wait for the store");
        }
        uploads.counts.set_store_problem(reason);
        let until = Instant::now() + period;
        while Instant::now() < until {
            tokio::time::sleep(PERIOD).await;
            if uploads.options.delete {
                uploads.delete_old();
            }
            let waiting = uploads.waiting().len();
            uploads.counts.set_waiting_for_store(waiting as u64);
        }
    }
}

/// Says how many finished parts the store has not confirmed.
pub(super) fn log_unconfirmed(control: &RecorderControl) {
    let finished = control.list().into_iter().filter(|part| !part.is_unfinished);
    let parts = finished.filter(|part| !upload::is_confirmed(Path::new(&part.file))).count();
    if parts > 0 {
        tracing::info!(parts, "not in the store yet: the next start sends them");
    }
}

/// The time until the next attempt.
fn period_after(period: Duration, problem: Option<&Problem>) -> Duration {
    match problem {
        Some(Problem::Store(_)) => (2 * period).min(PERIOD_MAX),
        Some(Problem::Part(_)) | None => PERIOD,
    }
}

impl Uploads {
    fn new(options: Store, saved: Duration, control: RecorderControl, counts: Arc<RecorderCounts>) -> Self {
        let (limit, answer_timeout) = (UploadLimit::new(options.upload_kbit_s_max), ANSWER_TIMEOUT);
        Self { options, saved, control, counts, store: None, limit, answer_timeout, settled: BTreeSet::new() }
    }

    /// Sends the parts that wait, up to the first that the store refuses.
    ///
    /// # Errors
    /// Why the first of them is not confirmed.
    async fn upload_all(&mut self) -> Result<(), Problem> {
        let waiting = self.waiting();
        let mut left = waiting.len() as u64;
        self.counts.set_waiting_for_store(left);
        let mut outcome = Ok(());
        for (part, seen) in waiting {
            match self.upload(&part).await {
                Ok(is_new) => {
                    left -= 1;
                    if is_new {
                        self.counts.add_confirmed(left);
                        tracing::info!(part = %part.display(), "the store has confirmed a part");
                    }
                    self.counts.set_waiting_for_store(left);
                    self.settled.insert(seen);
                }
                Err(problem) => {
                    self.counts.add_store_failure();
                    let is_away = matches!(problem, Problem::Store(_));
                    outcome = outcome.and(Err(problem));
                    if is_away {
                        break;
                    }
                }
            }
        }
        outcome
    }

    /// Deletes the parts that the store has confirmed and that no save of the last seconds needs.
    fn delete_old(&mut self) {
        let parts = self.finished();
        let is_old = |seen: &Seen| seen.2.elapsed().is_ok_and(|age| age > self.saved);
        for (part, seen) in parts.into_iter().filter(|(part, seen)| is_old(seen) && upload::is_confirmed(part)) {
            if let Err(error) = upload::delete_confirmed(&part) {
                tracing::warn!(part = %part.display(), %error, "a confirmed part cannot be deleted");
            }
            self.settled.remove(&seen);
        }
    }

    /// The finished parts of the folder, also parts that an earlier run has left unfinished.
    fn finished(&self) -> Vec<(PathBuf, Seen)> {
        let parts = self.control.list().into_iter().filter(|part| !part.is_unfinished || part.is_left);
        let paths = parts.map(|part| PathBuf::from(part.file));
        paths.filter_map(|path| seen(&path).map(|seen| (path, seen))).collect()
    }

    /// The finished parts that are not settled.
    fn waiting(&mut self) -> Vec<(PathBuf, Seen)> {
        let mut waiting = Vec::new();
        for (part, seen) in self.finished() {
            if self.settled.contains(&seen) {
                continue;
            }
            // A restart finds the confirmation of an earlier run.
            if upload::is_confirmed(&part) {
                self.settled.insert(seen);
            } else {
                waiting.push((part, seen));
            }
        }
        waiting
    }

    /// Sends one part. Returns false if it has nothing that could be found again; then it stays where it is.
    async fn upload(&mut self, part: &Path) -> Result<bool, Problem> {
        let store = match &self.store {
            Some(store) => store.clone(),
            None => {
                let opened = location::open_limited(&self.options.url, self.limit.as_ref());
                opened.map_err(|error| Problem::Store(error.to_string()))?
            }
        };
        self.store = Some(store.clone());
        // Also a refusal is an answer: the part's own request then fails with the same reason.
        let answer = tokio::time::timeout(self.answer_timeout, store.head(&Key::from("clearway"))).await;
        if answer.is_err() {
            let reason = format!("{} has not answered for {:?}", self.options.url, self.answer_timeout);
            return Err(Problem::Store(reason));
        }
        match upload::upload(&*store, part, self.limit.as_ref()).await {
            Ok(_) => Ok(true),
            Err(UploadError::Nothing { .. }) => Ok(false),
            Err(error @ (UploadError::Store { .. } | UploadError::Differs { .. })) => {
                Err(Problem::Store(error.to_string()))
            }
            Err(error) => Err(Problem::Part(error.to_string())),
        }
    }
}

fn seen(part: &Path) -> Option<Seen> {
    let metadata = part.metadata().ok()?;
    Some((part.to_owned(), metadata.len(), metadata.modified().ok()?))
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;
    use object_store::throttle::{ThrottleConfig, ThrottledStore};

    use super::*;
    use crate::config::Recorder as Options;
    use crate::record::writer::Recorder;
    use clearway_journal::mcap_file::RecordingHeader;

    #[tokio::test]
    async fn a_store_that_hangs_is_named_before_a_part_is_sent() {
        let folder = tempfile::tempdir().unwrap();
        let options = Options { file: folder.path().join("car.mcap"), ..Options::default() };
        let (recorder, _handles) = Recorder::start(&options, &RecordingHeader::default(), false).unwrap();
        let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/drive.mcap");
        std::fs::copy(golden, folder.path().join("car-1.part-0001.mcap")).unwrap();
        let store = Store { url: "s3://drives".into(), ..Store::default() };
        let mut uploads = Uploads::new(store, Duration::ZERO, recorder.control(), recorder.counts());
        let hangs = ThrottleConfig { wait_get_per_call: Duration::from_secs(3600), ..ThrottleConfig::default() };
        uploads.store = Some(Arc::new(ThrottledStore::new(InMemory::new(), hangs)));
        uploads.answer_timeout = Duration::from_millis(10);
        let Err(Problem::Store(reason)) = uploads.upload_all().await else { panic!("the store hangs") };
        assert_eq!(reason, "s3://drives has not answered for 10ms");
        uploads.answer_timeout = ANSWER_TIMEOUT;
        uploads.store = Some(Arc::new(InMemory::new()));
        assert!(uploads.upload_all().await.is_ok(), "it has nothing of that name, and answers");
    }

    #[tokio::test]
    async fn a_store_that_vanishes_for_an_hour_costs_an_attempt_a_minute_and_then_gets_every_part() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/drive.mcap");
        let add = |part: u64| _ = std::fs::copy(golden, at(&format!("car-1.part-{part:04}.mcap"))).unwrap();
        let options = Options { file: at("car.mcap"), ..Options::default() };
        let (recorder, handles) = Recorder::start(&options, &RecordingHeader::default(), false).unwrap();
        let counts = recorder.counts();
        let store = Store { url: at("store").display().to_string(), ..Store::default() };
        let mut uploads = Uploads::new(store, Duration::ZERO, recorder.control(), counts.clone());
        add(1);
        assert!(uploads.upload_all().await.is_ok());
        assert_eq!(counts.to_proto().store_confirmed, 1);
        // The store vanishes: its folder is a file now.
        std::fs::rename(at("store"), at("kept")).unwrap();
        std::fs::write(at("store"), "").unwrap();
        (2..=4).for_each(add);
        let (mut passed, mut period) = (Duration::ZERO, PERIOD);
        while passed < Duration::from_secs(3600) {
            let problem = uploads.upload_all().await.err();
            assert!(matches!(problem, Some(Problem::Store(_))));
            period = period_after(period, problem.as_ref());
            passed += period;
        }
        let away = counts.to_proto();
        println!("{} attempts in an hour without the store", away.store_failures);
        assert_eq!((away.store_confirmed, away.store_waiting), (1, 3), "{away:?}");
        assert!((60..70).contains(&away.store_failures), "{away:?}");
        std::fs::remove_file(at("store")).unwrap();
        std::fs::rename(at("kept"), at("store")).unwrap();
        assert!(uploads.upload_all().await.is_ok());
        assert_eq!(counts.to_proto().store_confirmed, 4);
        // A part without an event has nothing that could be found again: it stays, and nothing waits for it.
        drop(handles);
        recorder.finish().unwrap();
        assert!(uploads.upload_all().await.is_ok());
        let end = counts.to_proto();
        assert_eq!((end.store_confirmed, end.store_waiting), (4, 0), "{end:?}");
        assert!(at("car.mcap").exists());
    }
}
