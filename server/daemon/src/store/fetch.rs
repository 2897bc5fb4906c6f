//! The URL of a store -> the recordings in it; the URL of a recording -> a copy here.

use std::io::Write;

use anyhow::{Context, Result};
use futures::TryStreamExt;
use object_store::{ObjectStore, ObjectStoreExt, path::Path as Key};
use tempfile::NamedTempFile;

use super::location;

/// The store of a URL, `s3://BUCKET` without a prefix, and the key of the rest.
fn split(url: &str) -> (String, Key) {
    let (scheme, rest) = url.split_once("://").unwrap_or(("", url));
    let (bucket, key) = rest.split_once('/').unwrap_or((rest, ""));
    (format!("{scheme}://{bucket}"), Key::from(key))
}

/// The URLs of the recordings (`*.mcap`) under a URL, or the URL itself if it names one, in alphabetical order.
///
/// # Errors
/// If the store is not known or does not answer.
pub async fn list(url: &str) -> Result<Vec<String>> {
    if url.ends_with(".mcap") {
        return Ok(vec![url.to_owned()]);
    }
    let (root, prefix) = split(url);
    let store = location::open_existing(&root)?;
    let found: Vec<_> = store.list(Some(&prefix)).try_collect().await.with_context(|| url.to_owned())?;
    let keys = found.into_iter().map(|object| object.location).filter(|key| key.as_ref().ends_with(".mcap"));
    let mut urls: Vec<String> = keys.map(|key| format!("{root}/{key}")).collect();
    urls.sort();
    Ok(urls)
}

/// A copy of a recording in a store, which is deleted when it is dropped.
///
/// # Errors
/// If the store has no such recording or does not answer, or the copy cannot be written.
pub async fn fetch(url: &str) -> Result<NamedTempFile> {
    let (root, key) = split(url);
    let mut file = NamedTempFile::with_suffix(".mcap").context("a copy of a recording in a store")?;
    copy(&*location::open_existing(&root)?, &key, &mut file).await.with_context(|| url.to_owned())?;
    Ok(file)
}

/// Copies an object of a store.
///
/// # Errors
/// If the store has no such object or does not answer, or the copy cannot be written.
pub async fn copy(store: &dyn ObjectStore, key: &Key, to: &mut impl Write) -> Result<()> {
    let mut content = store.get(key).await?.into_stream();
    while let Some(bytes) = content.try_next().await? {
        to.write_all(&bytes).context("write the copy")?;
    }
    Ok(to.flush()?)
}
