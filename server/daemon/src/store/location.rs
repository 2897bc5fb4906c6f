//! A path or a URL -> the store.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, Checksum};
use object_store::local::LocalFileSystem;
use object_store::prefix::PrefixStore;
use object_store::{ClientOptions, ObjectStore, RetryConfig};

use super::upload_limit::{REQUEST_TIMEOUT, UploadLimit};
use crate::base::file_advice::advised;

/// Longest time in which a request is repeated. Ours; after it the part waits until the folder is looked at again.
const RETRY_TIMEOUT: Duration = Duration::from_secs(5);

/// A store cannot be opened.
#[derive(Debug, thiserror::Error)]
#[error("store {url}: {reason}")]
pub struct OpenError {
    /// The path or URL of the store.
    pub url: String,
    /// Why the store cannot be opened.
    pub reason: String,
}

/// Opens a store to write: a folder by its path or as `file:///PATH`, which is created if it does not exist, or
/// `s3://BUCKET/PREFIX`. The environment variables `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION` and
/// `AWS_ENDPOINT_URL` (of a compatible server, also by `http`) have the meaning that the AWS tools give them.
///
/// # Errors
/// [`OpenError`] for another kind of URL, a folder that cannot be created, or variables that contradict each other. A
/// server that does not answer is no error here.
pub fn open(url: &str) -> Result<Arc<dyn ObjectStore>, OpenError> {
    open_limited(url, None)
}

/// As [`open`]; what is sent to a bucket has this limit.
///
/// # Errors
/// As [`open`].
pub fn open_limited(url: &str, limit: Option<&UploadLimit>) -> Result<Arc<dyn ObjectStore>, OpenError> {
    if let Some(folder) = folder(url) {
        let wrong = |source| OpenError { url: url.to_owned(), reason: advised(folder, source).to_string() };
        std::fs::create_dir_all(folder).map_err(wrong)?;
    }
    opened(url, limit)
}

/// The folder that a text names by its path or as `file:///PATH`; `None` for other URLs.
pub fn folder(url: &str) -> Option<&Path> {
    match url.split_once("://") {
        None => Some(Path::new(url)),
        Some(("file", path)) => Some(Path::new(path)).filter(|path| path.is_absolute()),
        Some(_) => None,
    }
}

/// As [`open`], to read: a folder must exist.
///
/// # Errors
/// As [`open`], and for a folder that does not exist.
pub fn open_existing(url: &str) -> Result<Arc<dyn ObjectStore>, OpenError> {
    opened(url, None)
}

fn opened(url: &str, limit: Option<&UploadLimit>) -> Result<Arc<dyn ObjectStore>, OpenError> {
    let wrong = |reason: String| OpenError { url: url.to_owned(), reason };
    if let Some(folder) = folder(url) {
        if !folder.is_dir() {
            return Err(wrong("there is no such folder".to_owned()));
        }
        let store = LocalFileSystem::new_with_prefix(folder).map_err(|error| wrong(error.to_string()))?;
        return Ok(Arc::new(store.with_fsync(true)));
    }
    let Some((bucket, prefix)) = url.strip_prefix("s3://").map(|path| path.split_once('/').unwrap_or((path, "")))
    else {
        return Err(wrong("a folder, file:///FOLDER and s3://BUCKET/PREFIX are allowed".to_owned()));
    };
    if bucket.is_empty() {
        return Err(wrong("the bucket is missing: s3://BUCKET/PREFIX is allowed".to_owned()));
    }
    // Another part of this process may have set the provider already; both are ring.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let retry = RetryConfig { retry_timeout: RETRY_TIMEOUT, ..RetryConfig::default() };
    let mut store = AmazonS3Builder::from_env()
        .with_bucket_name(bucket)
        .with_checksum_algorithm(Checksum::SHA256)
        .with_client_options(client_options())
        .with_retry(retry);
    if let Some(limit) = limit {
        store = store.with_http_connector(limit.clone());
    }
    let store = store.build().map_err(|error| wrong(error.to_string()))?;
    Ok(match prefix.trim_matches('/') {
        "" => Arc::new(store),
        prefix => Arc::new(PrefixStore::new(store, prefix)),
    })
}

/// An endpoint that is named by `http` is used so, as by the AWS tools.
fn client_options() -> ClientOptions {
    let is_http = |name| std::env::var(name).is_ok_and(|url| url.starts_with("http://"));
    let allows_http = ["AWS_ENDPOINT_URL", "AWS_ENDPOINT", "AWS_ENDPOINT_URL_S3"].into_iter().any(is_http);
    ClientOptions::new().with_allow_http(allows_http).with_timeout(REQUEST_TIMEOUT)
}
