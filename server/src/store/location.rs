//! A path or a URL -> the store.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, Checksum};
use object_store::local::LocalFileSystem;
use object_store::prefix::PrefixStore;
use object_store::{ClientOptions, ObjectStore, RetryConfig};

/// Longest time of one request. Ours: 8 MiB, the size of one piece of a part, at 1 Mbit/s.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(70);
/// Longest time in which a request is repeated. Ours; after it the part waits until the folder is looked at again.
const RETRY_TIMEOUT: Duration = Duration::from_secs(5);

/// A store cannot be opened.
#[derive(Debug, thiserror::Error)]
#[error("store {url}: {reason}")]
pub struct OpenError {
    /// The path or URL of the store.
    pub url: String,
    /// The reason.
    pub reason: String,
}

/// Opens a store: a folder by its path, which is created if it does not exist, or `s3://BUCKET/PREFIX`. The
/// environment variables `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION`, `AWS_ENDPOINT_URL` (of a
/// compatible server) and `AWS_ALLOW_HTTP` are those of the AWS tools.
///
/// # Errors
/// [`OpenError`] for another kind of URL, a folder that cannot be created, or variables that contradict each other. A
/// server that does not answer is no error here.
pub fn open(url: &str) -> Result<Arc<dyn ObjectStore>, OpenError> {
    let wrong = |reason: String| OpenError { url: url.to_owned(), reason };
    match url.split_once("://") {
        None => {
            let folder = Path::new(url);
            std::fs::create_dir_all(folder).map_err(|error| wrong(error.to_string()))?;
            let store = LocalFileSystem::new_with_prefix(folder).map_err(|error| wrong(error.to_string()))?;
            Ok(Arc::new(store.with_fsync(true)))
        }
        Some(("s3", path)) => {
            // Another part of this process may have set the provider already; both are ring.
            let _ = rustls::crypto::ring::default_provider().install_default();
            let (bucket, prefix) = path.split_once('/').unwrap_or((path, ""));
            let retry = RetryConfig { retry_timeout: RETRY_TIMEOUT, ..RetryConfig::default() };
            let store = AmazonS3Builder::from_env()
                .with_bucket_name(bucket)
                .with_checksum_algorithm(Checksum::SHA256)
                .with_client_options(client_options().with_timeout(REQUEST_TIMEOUT))
                .with_retry(retry)
                .build()
                .map_err(|error| wrong(error.to_string()))?;
            Ok(match prefix.trim_matches('/') {
                "" => Arc::new(store),
                prefix => Arc::new(PrefixStore::new(store, prefix)),
            })
        }
        Some((scheme, _)) => {
            Err(wrong(format!("{scheme}:// is not known; a folder and s3://BUCKET/PREFIX are allowed")))
        }
    }
}

/// Options from the environment that replacing the client's options would lose.
fn client_options() -> ClientOptions {
    let allows_http = std::env::var("AWS_ALLOW_HTTP").is_ok_and(|value| value == "true" || value == "1");
    ClientOptions::new().with_allow_http(allows_http)
}
