//! What every response of the page, the metrics and Foxglove has in common: who may ask, by which address, from which
//! page, and the headers that keep browsers from misusing the answer.

use axum::body::Body;
use axum::http::header::{self, HeaderMap, HeaderValue};
use axum::http::uri::{Authority, Uri};
use axum::http::{Method, Request, Response, StatusCode};
use axum::response::IntoResponse;
use tonic::{Code, Status};

use super::access::Caller;
use super::security::Current;

/// The page loads only what its own server serves, and no other page may show it in a frame.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; connect-src 'self'; \
     base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Name of the cookie and of the query parameter that hold a token.
const COOKIE: &str = "clearway_token";
const QUERY: &str = "token";

/// Checks a request, and says what its sender may reach.
///
/// # Errors
/// The response that refuses it: 405 for a method, 421 for a host, 403 for an origin or a role, 401 without a name. A
/// correct token in the query of a page's address becomes a cookie, with a redirection to the address without it.
pub fn check(
    request: &Request<impl Sized>,
    current: &Current,
    origins: &[&str],
    certified: &[String],
) -> Result<(Caller, Vec<String>), Box<Response<Body>>> {
    let refuse = |status: StatusCode, text: String| Box::new((status, text + "\n").into_response());
    if request.method() != Method::GET && request.method() != Method::HEAD {
        let text = format!("{}: GET and HEAD are allowed", request.method());
        return Err(Box::new((StatusCode::METHOD_NOT_ALLOWED, [(header::ALLOW, "GET, HEAD")], text).into_response()));
    }
    let headers = request.headers();
    for name in [header::HOST, header::ORIGIN] {
        let values: Vec<_> = headers.get_all(&name).iter().collect();
        if values.len() > 1 || values.iter().any(|value| value.to_str().is_err()) {
            return Err(refuse(StatusCode::BAD_REQUEST, format!("{name}: one value of ASCII characters is allowed")));
        }
    }
    let host = text_of(headers, header::HOST).or_else(|| request.uri().authority().map(Authority::as_str));
    let host = host.unwrap_or_default();
    if !current.is_own_host(host_of(host)) {
        let text = format!("host {host:?}: an address, localhost or a name in connections.hosts is allowed");
        return Err(refuse(StatusCode::MISDIRECTED_REQUEST, text));
    }
    if let Some(origin) = text_of(headers, header::ORIGIN) {
        // Without certificates of its own, the server may stand behind a proxy that has some.
        let is_scheme = |scheme: &str| scheme == "https" || (scheme == "http" && current.tls.is_none());
        let own = origin
            .split_once("://")
            .filter(|(scheme, authority)| is_scheme(scheme) && authority.eq_ignore_ascii_case(host));
        let is_own = own.is_some();
        if !is_own
            && !origins.contains(&origin)
            && !current.origins.iter().any(|listed| listed.eq_ignore_ascii_case(origin))
        {
            let text = format!("origin {origin:?}: the page itself, or an origin in connections.origins, is allowed");
            return Err(refuse(StatusCode::FORBIDDEN, text));
        }
    }
    let Some(access) = &current.access else { return Ok((Caller::unlimited(), Vec::new())) };
    let in_query = query_token(request);
    let token = in_query.or_else(|| header_token(headers));
    let names: Vec<String> = certified.iter().cloned().chain(token.and_then(|token| current.name_of(token))).collect();
    let caller = access.check_path(request.uri().path(), &names);
    let caller = caller.map_err(|status| refuse_role(&status, names.is_empty()))?;
    let is_page = !headers.contains_key(header::UPGRADE)
        && text_of(headers, header::ACCEPT).is_some_and(|kinds| kinds.contains("text/html"));
    match in_query.filter(|_| is_page) {
        None => Ok((caller, names)),
        Some(token) => Err(Box::new(redirect_with_cookie(request.uri(), token))),
    }
}

fn refuse_role(status: &Status, is_nameless: bool) -> Box<Response<Body>> {
    let code = match (is_nameless, status.code()) {
        (true, _) => StatusCode::UNAUTHORIZED,
        (false, Code::PermissionDenied) => StatusCode::FORBIDDEN,
        (false, _) => StatusCode::INTERNAL_SERVER_ERROR,
    };
    let text = format!("{}\n", status.message());
    let mut response = (code, text).into_response();
    if is_nameless {
        response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    Box::new(response)
}

/// A cookie that scripts cannot read and that other pages cannot send, and the address without the token. It is
/// relative to the address that the browser has, which may have more folders than the server's behind a proxy.
fn redirect_with_cookie(uri: &Uri, token: &str) -> Response<Body> {
    let cookie = format!("{COOKIE}={token}; Path=/; HttpOnly; Secure; SameSite=Strict");
    let pairs = uri.query().unwrap_or_default().split('&');
    let kept: Vec<_> = pairs.filter(|pair| pair.split_once('=').is_none_or(|(key, _)| key != QUERY)).collect();
    let page = uri.path().rsplit('/').next().unwrap_or_default();
    let address = match kept.join("&") {
        query if query.is_empty() => format!("./{page}"),
        query => format!("./{page}?{query}"),
    };
    (StatusCode::SEE_OTHER, [(header::SET_COOKIE, cookie), (header::LOCATION, address)]).into_response()
}

fn query_token<B>(request: &Request<B>) -> Option<&str> {
    let pairs = request.uri().query()?.split('&').filter_map(|pair| pair.split_once('='));
    pairs.into_iter().find(|(key, _)| *key == QUERY).map(|(_, token)| token)
}

fn header_token(headers: &HeaderMap) -> Option<&str> {
    let bearer = text_of(headers, header::AUTHORIZATION).and_then(|text| text.strip_prefix("Bearer "));
    let cookies = text_of(headers, header::COOKIE).into_iter().flat_map(|text| text.split("; "));
    bearer.or_else(|| cookies.filter_map(|pair| pair.split_once('=')).find(|(key, _)| *key == COOKIE).map(|(_, t)| t))
}

fn text_of(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// The host of `host:port`, without the brackets of an IPv6 address.
fn host_of(authority: &str) -> &str {
    match authority.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((address, port)) if port.is_empty() || port.starts_with(':') => address,
        _ => authority.rsplit_once(':').map_or(authority, |(host, _)| host),
    }
}

/// Adds the headers of every response.
pub fn protect(response: &mut Response<Body>) {
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
}
