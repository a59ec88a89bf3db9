//! Checks of requests: the name that was called, the rate, the page, the token or link, and the
//! size of the body.
//!
//! Invariant: a request reaches a handler only under a name of ours, within the rate of its address, not from a page
//! of another origin if it changes anything, with a token of the route's scope or a link to what it reads if there are
//! tokens, and with a body that is whole and small.

use std::net::IpAddr;
use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, CONTENT_LENGTH, EXPECT, HOST, ORIGIN, TRANSFER_ENCODING};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, Method, Uri};
use axum::middleware::Next;
use axum::response::Response;
use futures_util::StreamExt;
use governor::clock::{Clock, DefaultClock};
use governor::state::keyed::HashMapStateStore;
use governor::{Quota, RateLimiter};

use super::ServeConfig;
use super::config::{Cors, Scope, Tokens};
use super::link::{LinkKey, Subject};
use super::problem::Problem;

/// The address of the client, in the extensions of each request.
#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub(super) IpAddr);

/// Largest request body, bytes.
const MAX_BODY: usize = 1 << 20;

/// Bytes of a body that is too large that are read and thrown away: a client that is still sending
/// would not see the answer.
const DRAINED: usize = 16 << 20;

/// Longest time for that.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// Longest time for a body.
const BODY_TIMEOUT: Duration = Duration::from_secs(30);

/// Number of addresses whose rate is remembered before the quiet ones are forgotten.
const REMEMBERED: usize = 10_000;

/// Paths for monitors, which are answered however busy their address is.
const PROBES: [&str; 2] = ["/healthz", "/readyz"];

/// Header in which a browser names the relation of the page to the address that it calls.
const SEC_FETCH_SITE: &str = "sec-fetch-site";

/// Checks that each request passes.
#[derive(Clone, Debug)]
pub(super) struct Gate(Arc<Rules>);

#[derive(Debug)]
struct Rules {
    hosts: Vec<String>,
    /// The origin of the page where a proxy serves it.
    public_origin: Option<String>,
    cors: Cors,
    tokens: Tokens,
    /// Key that signs links, where there are tokens.
    links: Option<LinkKey>,
    rate: RateLimiter<IpAddr, HashMapStateStore<IpAddr>, DefaultClock>,
}

impl Gate {
    pub(super) fn new(config: &ServeConfig, links: Option<LinkKey>) -> Self {
        let public = config.public_url.as_ref().and_then(|url| url.parse::<Uri>().ok());
        let public_host = public.as_ref().and_then(|url| url.host().map(str::to_owned));
        let public_origin =
            public.and_then(|url| Some(format!("{}://{}", url.scheme()?, url.authority()?)));
        let hosts = config.hosts.iter().cloned().chain(public_host);
        let rate = NonZeroU32::new(config.limits.requests_per_s).unwrap_or(NonZeroU32::MIN);
        Self(Arc::new(Rules {
            hosts: hosts.map(|host| host.to_ascii_lowercase()).collect(),
            public_origin,
            cors: config.cors.clone(),
            tokens: config.tokens.clone(),
            links,
            rate: RateLimiter::hashmap(Quota::per_second(rate)),
        }))
    }

    /// Returns whether a name is ours. An address is: a page that rebinds a name to our address
    /// still calls the name.
    fn knows(&self, authority: &Authority) -> bool {
        let host = authority.host().to_ascii_lowercase();
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        bare.parse::<IpAddr>().is_ok()
            || host == "localhost"
            || host.ends_with(".localhost")
            || self.0.hosts.contains(&host)
    }

    /// Returns whether the origin is that of our own page, under the name that was called or the
    /// one of a proxy.
    fn is_own(&self, origin: &str, request: &Request) -> bool {
        let own = called(request).is_some_and(|called| {
            let (_, asking) = origin.split_once("://").unwrap_or_default();
            asking.eq_ignore_ascii_case(called.as_str())
        });
        own || self.0.public_origin.as_deref() == Some(origin)
    }

    /// Refuses a change by a page of another origin, unless that was named: `*` is for reading.
    fn check_change(&self, request: &Request) -> Result<(), Problem> {
        let changes = !matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
        match foreign_page(request, |origin| self.is_own(origin, request)) {
            Some(origin) if changes && !self.0.cors.names(origin) => Err(Problem::foreign_page()),
            _ => Ok(()),
        }
    }

    /// Refuses a page of an origin that may not read: browsers do not check that for a socket.
    fn check_reader(&self, request: &Request) -> Result<(), Problem> {
        match foreign_page(request, |origin| self.is_own(origin, request)) {
            Some(origin) if !self.0.cors.admits(origin) => Err(Problem::foreign_page()),
            _ => Ok(()),
        }
    }

    fn check_host(&self, request: &Request) -> Result<(), Problem> {
        match called(request) {
            None => Err(Problem::bad_host()),
            Some(authority) if self.knows(&authority) => Ok(()),
            Some(_) => Err(Problem::misdirected()),
        }
    }

    fn check_rate(&self, request: &Request) -> Result<(), Problem> {
        if PROBES.contains(&request.uri().path()) {
            return Ok(());
        }
        let Some(Peer(peer)) = request.extensions().get() else { return Ok(()) };
        let rate = &self.0.rate;
        if rate.len() > REMEMBERED {
            rate.retain_recent();
        }
        rate.check_key(peer).map_err(|until| {
            Problem::too_often(until.wait_time_from(DefaultClock::default().now()))
        })
    }

    /// Returns whether a request has the rights of `scope`, by its token or by a link to this path.
    fn check_token(
        &self,
        request: &Request,
        scope: Scope,
        here: Option<Subject>,
    ) -> Result<(), Problem> {
        if self.0.tokens.is_empty() {
            return Ok(());
        }
        let held = bearer(request.headers()).and_then(|token| self.0.tokens.scope(token));
        match held {
            None if scope == Scope::Read && self.is_link(request, here) => Ok(()),
            None => Err(Problem::unauthorised()),
            Some(held) if held < scope => Err(Problem::forbidden(scope)),
            Some(_) => Ok(()),
        }
    }

    fn is_link(&self, request: &Request, here: Option<Subject>) -> bool {
        let (Some(links), Some(subject), Some(query)) =
            (&self.0.links, here, request.uri().query())
        else {
            return false;
        };
        matches!(*request.method(), Method::GET | Method::HEAD) && links.opens(subject, query)
    }
}

/// Returns the name and port that were called. An absolute address in the request line takes
/// precedence over the header (RFC 9112, 3.2.2).
fn called(request: &Request) -> Option<Authority> {
    if let Some(authority) = request.uri().authority() {
        return Some(authority.clone());
    }
    let mut hosts = request.headers().get_all(HOST).iter();
    let host = hosts.next().and_then(|host| host.to_str().ok()?.parse().ok());
    host.filter(|_| hosts.next().is_none())
}

/// Returns the origin of the page that asks, if one does and it is not our own; empty if the
/// browser does not send it.
fn foreign_page(request: &Request, is_own: impl Fn(&str) -> bool) -> Option<&str> {
    let header = |name| request.headers().get(name).map(|value| value.to_str().unwrap_or_default());
    match header(SEC_FETCH_SITE) {
        // No page can set this header, and behind a proxy only the browser knows.
        Some("same-origin" | "none") => None,
        site => {
            let origin = header(ORIGIN.as_str()).or(site.map(|_| ""))?;
            (!is_own(origin)).then_some(origin)
        }
    }
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let (kind, token) = headers.get(AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    kind.eq_ignore_ascii_case("bearer").then(|| token.trim())
}

/// Refuses a body in any coding but `chunked`, once: what reads it below us looks at the last
/// coding alone, and would take the others for content (RFC 9112, 6.1).
fn check_coding(headers: &HeaderMap) -> Result<(), Problem> {
    let mut codings = headers.get_all(TRANSFER_ENCODING).iter();
    match (codings.next(), codings.next()) {
        (None, _) => Ok(()),
        (Some(coding), None) if coding.as_bytes().eq_ignore_ascii_case(b"chunked") => Ok(()),
        _ => Err(Problem::unknown_coding()),
    }
}

/// Checks form, host, rate and page, for every request.
pub(super) async fn admit(
    State(gate): State<Gate>,
    request: Request,
    next: Next,
) -> Result<Response, Problem> {
    check_coding(request.headers())?;
    gate.check_host(&request)?;
    gate.check_rate(&request)?;
    gate.check_change(&request)?;
    Ok(next.run(request).await)
}

/// Checks the token, for the requests of one route.
pub(super) async fn authorise(
    State((gate, scope)): State<(Gate, Scope)>,
    request: Request,
    next: Next,
) -> Result<Response, Problem> {
    let here = Subject::at(request.uri().path());
    gate.check_token(&request, scope, here)?;
    Ok(next.run(request).await)
}

/// Checks page and token, for viewers of the live view.
pub(super) async fn look_on(
    State(gate): State<Gate>,
    request: Request,
    next: Next,
) -> Result<Response, Problem> {
    gate.check_reader(&request)?;
    gate.check_token(&request, Scope::Read, Some(Subject::Live))?;
    Ok(next.run(request).await)
}

/// Reads the body before anything else happens, so that half a body does nothing.
pub(super) async fn whole_body(request: Request, next: Next) -> Result<Response, Problem> {
    if matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS) {
        return Ok(next.run(request).await);
    }
    let (parts, body) = request.into_parts();
    let announced = parts.headers.get(CONTENT_LENGTH).and_then(|n| n.to_str().ok()?.parse().ok());
    // A client that expects an answer first gets it before it sends.
    if announced.is_some_and(|n: usize| n > MAX_BODY) && parts.headers.contains_key(EXPECT) {
        return Err(Problem::too_large());
    }
    let read = tokio::time::timeout(BODY_TIMEOUT, read(body.into_data_stream())).await;
    let body = read.map_err(|_| Problem::too_slow())??;
    Ok(next.run(Request::from_parts(parts, Body::from(body))).await)
}

async fn read(mut stream: BodyDataStream) -> Result<Bytes, Problem> {
    let mut body = Vec::new();
    while let Some(piece) = stream.next().await {
        let piece = piece.map_err(|_| Problem::broken_body())?;
        if body.len() + piece.len() > MAX_BODY {
            let _ = tokio::time::timeout(DRAIN_TIMEOUT, drain(stream)).await;
            return Err(Problem::too_large());
        }
        body.extend_from_slice(&piece);
    }
    Ok(body.into())
}

pub(super) async fn drain(mut stream: BodyDataStream) {
    let mut length = 0;
    while let Some(Ok(piece)) = stream.next().await
        && length < DRAINED
    {
        length += piece.len();
    }
}
