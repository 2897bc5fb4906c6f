//! Requests to a store whose bodies are sent no faster than the rate of uploads allows.

use std::error::Error;
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

use super::rate::UploadRate;
use crate::base::sync::locked;

/// Longest time for which a connection is made, as by default in other requests to stores.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Longest time in which nothing of a request is sent, and in which its answer arrives. Ours: 8 MiB, the size of one
/// piece of a part, leave the kernel's buffers or arrive in this time at 1 Mbit/s.
pub const SILENT_MAX: Duration = Duration::from_secs(70);

/// Makes clients whose requests share one rate.
#[derive(Debug)]
pub struct PacedConnector(pub UploadRate);

impl HttpConnector for PacedConnector {
    fn connect(&self, _options: &ClientOptions) -> object_store::Result<HttpClient> {
        let client = Client::builder().http1_only().connect_timeout(CONNECT_TIMEOUT);
        let client = client.user_agent(concat!("clearway/", env!("CARGO_PKG_VERSION")));
        let client =
            client.build().map_err(|source| object_store::Error::Generic { store: "S3", source: source.into() })?;
        Ok(HttpClient::new(Paced { client, rate: self.0.clone() }))
    }
}

#[derive(Debug)]
struct Paced {
    client: Client,
    rate: UploadRate,
}

/// No byte was sent or received for [`SILENT_MAX`].
#[derive(Debug, thiserror::Error)]
#[error("nothing was sent or received for {SILENT_MAX:?}")]
struct SilentError;

fn silent() -> HttpError {
    HttpError::new(HttpErrorKind::Timeout, SilentError)
}

#[tonic::async_trait]
impl HttpService for Paced {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let (parts, body) = request.into_parts();
        let url = parts.uri.to_string().parse().map_err(|error| HttpError::new(HttpErrorKind::Request, error))?;
        let mut request = reqwest::Request::new(parts.method, url);
        *request.headers_mut() = parts.headers;
        let sent = Arc::new(Mutex::new(Instant::now()));
        *request.body_mut() = Some(match body.content_length() {
            0 => Bytes::new().into(),
            _ => paced(body, self.rate.clone(), sent.clone()),
        });
        let mut answer = std::pin::pin!(self.client.execute(request));
        let answer = loop {
            let until = *locked(&sent) + SILENT_MAX;
            tokio::select! {
                answer = &mut answer => break answer.map_err(of_client)?,
                () = tokio::time::sleep_until(until.into()) => {
                    if Instant::now() >= *locked(&sent) + SILENT_MAX {
                        return Err(silent());
                    }
                }
            }
        };
        // Uploads have short answers: a part is read back in ranges.
        let mut response = HttpResponse::new(HttpResponseBody::from(Bytes::new()));
        (*response.status_mut(), *response.headers_mut()) = (answer.status(), answer.headers().clone());
        let bytes = tokio::time::timeout(SILENT_MAX, answer.bytes()).await.map_err(|_| silent())?.map_err(of_client)?;
        *response.body_mut() = bytes.into();
        Ok(response)
    }
}

/// The body, each of whose pieces waits until the rate allows it.
fn paced(body: HttpRequestBody, rate: UploadRate, sent: Arc<Mutex<Instant>>) -> reqwest::Body {
    let left = (body, Bytes::new(), rate, sent);
    reqwest::Body::wrap_stream(stream::try_unfold(left, |(mut body, mut chunk, rate, sent)| async move {
        while chunk.is_empty() {
            let next = std::future::poll_fn(|context| std::pin::Pin::new(&mut body).poll_frame(context)).await;
            let Some(frame) = next.transpose()? else { return Ok(None) };
            chunk = frame.into_data().unwrap_or_default();
        }
        let piece = chunk.split_to(rate.piece_bytes().min(chunk.len()));
        rate.take(piece.len()).await;
        *locked(&sent) = Instant::now();
        Ok::<_, HttpError>(Some((piece, (body, chunk, rate, sent))))
    }))
}

/// An error of the client, by what it may be repeated for. The URL is left out: it may hold a signature.
fn of_client(error: reqwest::Error) -> HttpError {
    let error = error.without_url();
    let io = |error: &reqwest::Error| {
        let mut source = error.source();
        while let Some(error) = source {
            if error.is::<std::io::Error>() {
                return true;
            }
            source = error.source();
        }
        false
    };
    let kind = match &error {
        error if error.is_timeout() => HttpErrorKind::Timeout,
        error if error.is_connect() => HttpErrorKind::Connect,
        error if error.is_decode() => HttpErrorKind::Decode,
        error if io(error) => HttpErrorKind::Interrupted,
        error if error.is_request() => HttpErrorKind::Request,
        _ => HttpErrorKind::Unknown,
    };
    HttpError::new(kind, error)
}
