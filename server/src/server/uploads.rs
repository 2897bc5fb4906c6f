//! Finished parts of the recording -> the store of the configuration, confirmed, while the server runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use object_store::ObjectStore;

use crate::config::Store;
use crate::record::writer::{RecorderControl, RecorderCounts};
use crate::store::{location, upload};

/// Time between two looks for finished parts, and between two attempts with a store that is away. Ours: a part is
/// minutes long.
const PERIOD: Duration = Duration::from_secs(2);

/// A file as it was when the store confirmed it: path, length, time of the newest change.
type Seen = (PathBuf, u64, SystemTime);

/// Sends each finished part to the store until the task is aborted. What the store does not confirm stays, and is sent
/// again.
pub(super) async fn upload_finished(options: Store, control: RecorderControl, counts: Arc<RecorderCounts>) {
    let mut store = None;
    let mut confirmed = BTreeSet::new();
    let mut every = tokio::time::interval(PERIOD);
    loop {
        every.tick().await;
        let outcome = upload_all(&options, &control, &counts, &mut store, &mut confirmed).await;
        if let Err(reason) = &outcome {
            tracing::warn!(store = options.url, reason, "parts wait for the store");
        }
        counts.set_store_problem(outcome.err().unwrap_or_default());
    }
}

/// Sends all parts that wait.
///
/// # Errors
/// Why the first of them is not confirmed, as a text.
async fn upload_all(
    options: &Store,
    control: &RecorderControl,
    counts: &RecorderCounts,
    store: &mut Option<Arc<dyn ObjectStore>>,
    confirmed: &mut BTreeSet<Seen>,
) -> Result<(), String> {
    let finished = control.list().into_iter().filter(|part| !part.is_unfinished);
    let parts: Vec<PathBuf> = finished.map(|part| part.file.into()).collect();
    let mut waiting = Vec::new();
    for part in parts {
        let Some(seen) = seen(&part) else { continue };
        if confirmed.contains(&seen) {
            continue;
        }
        // A restart finds the confirmation of an earlier run.
        if upload::is_confirmed(&part) {
            confirmed.insert(seen);
        } else {
            waiting.push((part, seen));
        }
    }
    let mut left = waiting.len() as u64;
    counts.set_waiting_for_store(left);
    let mut outcome = Ok(());
    for (part, seen) in waiting {
        let opened = match store {
            Some(store) => store.clone(),
            None => location::open(&options.url).map_err(|error| {
                counts.add_store_failure();
                error.to_string()
            })?,
        };
        *store = Some(opened.clone());
        match upload::upload(&*opened, &part).await {
            Ok(_) => {
                left -= 1;
                counts.add_confirmed(left);
                confirmed.insert(seen);
                tracing::info!(part = %part.display(), "the store has confirmed a part");
                if options.delete {
                    upload::delete_confirmed(&part).map_err(|error| format!("{}: {error}", part.display()))?;
                }
            }
            Err(error) => {
                counts.add_store_failure();
                outcome = outcome.and(Err(error.to_string()));
            }
        }
    }
    outcome
}

fn seen(part: &Path) -> Option<Seen> {
    let metadata = part.metadata().ok()?;
    Some((part.to_owned(), metadata.len(), metadata.modified().ok()?))
}
