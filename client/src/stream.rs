//! Updates, as fast as they come, to the newest map, as fast as it is asked for.
//!
//! In: maps from a background task. Out: the newest one, with the number of those in between. A reader that is
//! slow, or that only looks now and then, never gets an old map from a queue: there is none.

use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::ClientError;
use crate::view::MapView;

/// One look at the stream.
#[derive(Clone, Debug)]
pub struct Update {
    /// The newest map.
    pub map: MapView,
    /// Maps made since the previous look and not seen by this reader.
    pub skipped: u64,
}

/// The newest map of one vehicle, kept up to date in the background until this is dropped.
#[derive(Debug)]
pub struct MapStream {
    slot: watch::Receiver<Slot>,
    /// `Slot::made` at the previous look; `None` before the first.
    seen: Option<u64>,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Slot {
    newest: Option<MapView>,
    /// Maps since the start of the stream, those that were skipped included.
    made: u64,
    ended: Option<ClientError>,
}

impl MapStream {
    /// Runs `feed` in the background; it ends with the reason why there are no more maps.
    pub(crate) fn spawn<F: Future<Output = ClientError> + Send + 'static>(feed: impl FnOnce(Feed) -> F) -> Self {
        let (sender, slot) = watch::channel(Slot::default());
        let feed = feed(Feed { slot: sender.clone() });
        let task = tokio::spawn(async move {
            let reason = feed.await;
            sender.send_modify(|slot| slot.ended = Some(reason));
        });
        Self { slot, seen: None, task }
    }

    /// Waits for a map newer than the one given last.
    ///
    /// # Errors
    /// Why the stream is over, once its last map has been given: then subscribe again.
    pub async fn next(&mut self) -> Result<Update, ClientError> {
        loop {
            {
                let slot = self.slot.borrow_and_update();
                if let Some(map) = slot.newest.as_ref().filter(|_| self.seen != Some(slot.made)) {
                    // The first look has missed nothing: the reader was not there before.
                    let skipped = self.seen.map_or(0, |seen| slot.made - seen - 1);
                    self.seen = Some(slot.made);
                    return Ok(Update { map: map.clone(), skipped });
                }
                if let Some(reason) = &slot.ended {
                    return Err(reason.clone());
                }
            }
            if self.slot.changed().await.is_err() {
                return Err(ClientError::Ended { address: "the background task".into() });
            }
        }
    }

    /// The newest map at this moment, without waiting and without counting as a look; `None` before the first. It may
    /// be stale: ask [`MapView::is_stale`].
    pub fn newest(&self) -> Option<MapView> {
        self.slot.borrow().newest.clone()
    }

    /// Why there will be no more maps; `None` while the stream goes on.
    pub fn ended(&self) -> Option<ClientError> {
        self.slot.borrow().ended.clone()
    }
}

impl Drop for MapStream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The background task's end of a [`MapStream`].
pub(crate) struct Feed {
    slot: watch::Sender<Slot>,
}

impl Feed {
    /// Makes a map the newest; `skipped` maps lie between it and the one before.
    pub(crate) fn put(&self, map: MapView, skipped: u64) {
        self.slot.send_modify(|slot| {
            slot.made += 1 + skipped;
            slot.newest = Some(map);
        });
    }
}
