//! The limit of what uploads send to a bucket, so that they leave the maps on the same link what the operator wants.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::stream;
use hyper::body::Body;
use object_store::client::{
    ClientOptions, HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpRequestBody, HttpResponse,
    HttpResponseBody, HttpService,
};
use reqwest::Client;

use crate::base::sync::locked;
use crate::base::token_bucket::TokenBucket;

/// Longest time of one request without a limit of uploads. Ours: a piece of a part (5 MiB) arrives in this time at 400
/// kbit/s.
pub(super) const REQUEST_TIMEOUT: Duration = Duration::from_secs(105);
/// Longest time for which a connection is made, as by default in other requests to stores.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Bytes that are sent at once: the limit of a twentieth of a second, and at least this many. Ours: a map waits behind
/// one of them for a few milliseconds more on a link that bears the limit.
const PIECE: (u32, u32) = (20, 2000);
/// Pieces of an answer, which is requested in ranges: what a store has begun to send cannot be held back.
const ANSWER_PIECES: u64 = 4;

/// A limit that all uploads of a process share, in bytes: a token bucket. Clones share it.
#[derive(Clone, Debug)]
pub struct UploadLimit {
    bytes_s: u32,
    piece_bytes: u32,
    bucket: Arc<Mutex<TokenBucket>>,
}

impl UploadLimit {
    /// A limit of so many kbit/s; `None` for 0.
    pub fn new(kbit_s: u32) -> Option<Self> {
        let bytes_s = kbit_s.saturating_mul(125);
        let piece_bytes = PIECE.1.max(bytes_s / PIECE.0);
        // Two pieces, because a timer may be late by part of one.
        let bucket = Arc::new(Mutex::new(TokenBucket::new(2 * piece_bytes, bytes_s)));
        (bytes_s > 0).then_some(Self { bytes_s, piece_bytes, bucket })
    }

    /// Bytes of an answer that are requested at once.
    pub fn answer_bytes(&self) -> u64 {
        ANSWER_PIECES * u64::from(self.piece_bytes)
    }

    /// Waits until these bytes may be sent or requested.
    pub async fn take(&self, bytes: u64) {
        let mut left = bytes;
        while left > 0 {
            let piece = left.min(self.piece_bytes.into());
            let wait = locked(&self.bucket).take_many(piece as u32, Instant::now());
            match wait {
                Some(wait) => tokio::time::sleep(wait).await,
                None => left -= piece,
            }
        }
    }

    /// The body, in pieces that wait until the limit allows them.
    fn body(&self, body: HttpRequestBody) -> reqwest::Body {
        let left = (body, Bytes::new(), self.clone());
        reqwest::Body::wrap_stream(stream::try_unfold(left, |(mut body, mut chunk, limit)| async move {
            while chunk.is_empty() {
                let next = std::future::poll_fn(|context| std::pin::Pin::new(&mut body).poll_frame(context)).await;
                let Some(frame) = next.transpose()? else { return Ok(None) };
                chunk = frame.into_data().unwrap_or_default();
            }
            let piece = chunk.split_to(chunk.len().min(limit.piece_bytes as usize));
            limit.take(piece.len() as u64).await;
            Ok::<_, HttpError>(Some((piece, (body, chunk, limit))))
        }))
    }
}

impl HttpConnector for UploadLimit {
    fn connect(&self, _options: &ClientOptions) -> object_store::Result<HttpClient> {
        let client = Client::builder().http1_only().connect_timeout(CONNECT_TIMEOUT);
        let client = client.user_agent(concat!("clearway/", env!("CARGO_PKG_VERSION")));
        let client =
            client.build().map_err(|source| object_store::Error::Generic { store: "S3", source: source.into() })?;
        Ok(HttpClient::new(LimitedClient { client, limit: self.clone() }))
    }
}

/// A client whose requests are sent within the limit.
#[derive(Debug)]
struct LimitedClient {
    client: Client,
    limit: UploadLimit,
}

#[tonic::async_trait]
impl HttpService for LimitedClient {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let (parts, body) = request.into_parts();
        let url = parts.uri.to_string().parse().map_err(|error| HttpError::new(HttpErrorKind::Request, error))?;
        let mut request = reqwest::Request::new(parts.method, url);
        *request.headers_mut() = parts.headers;
        let bytes = body.content_length();
        // The answers of other uploads have a share of the limit.
        let sending = Duration::from_secs_f64(2.0 * bytes as f64 / f64::from(self.limit.bytes_s));
        *request.timeout_mut() = Some(REQUEST_TIMEOUT + sending);
        *request.body_mut() = Some(if bytes == 0 { Bytes::new().into() } else { self.limit.body(body) });
        let answer = self.client.execute(request).await.map_err(of_client)?;
        let mut response = HttpResponse::new(HttpResponseBody::from(Bytes::new()));
        (*response.status_mut(), *response.headers_mut()) = (answer.status(), answer.headers().clone());
        // Uploads have short answers: a part is read back in ranges.
        *response.body_mut() = answer.bytes().await.map_err(of_client)?.into();
        Ok(response)
    }
}

/// An error of the client, by what it may be repeated for. The URL is left out: it may hold a signature.
fn of_client(error: reqwest::Error) -> HttpError {
    let kind = match &error {
        error if error.is_timeout() => HttpErrorKind::Timeout,
        error if error.is_connect() => HttpErrorKind::Connect,
        _ => HttpErrorKind::Interrupted,
    };
    HttpError::new(kind, error.without_url())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_limit_of_the_configuration_holds() {
        assert!(UploadLimit::new(0).is_none());
        let limit = UploadLimit::new(8000).unwrap();
        let start = Instant::now();
        limit.take(300_000).await;
        // Two pieces of 50 kB are there at the begin.
        assert!(start.elapsed() >= Duration::from_millis(199), "{:?} for 300 kB at 1 MB/s", start.elapsed());
    }
}
