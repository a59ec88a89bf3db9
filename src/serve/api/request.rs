//! Types that handlers take from a request and give back, all checked.
//!
//! Invariant: no text of a client goes further than this.

use std::fmt::Display;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::str::FromStr;

use axum::extract::{FromRequestParts, Path};
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_ENCODING, CONTENT_TYPE, HOST};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::response::{IntoResponse, Response};
use uuid::Uuid;

use super::App;
use crate::serve::engine::{Refusal, joined};
use crate::serve::problem::Problem;
use crate::serve::store;
use crate::serve::studies::StudyRefusal;
use crate::serve::view::Reach;

/// The id in the path of a job.
pub(super) struct JobId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for JobId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let text = Path::<String>::from_request_parts(parts, state).await;
        let id = text.ok().and_then(|Path(text)| store::parse_id(&text));
        id.map(Self).ok_or_else(|| Refusal::UnknownJob.into())
    }
}

/// The id in the path of a study.
pub(super) struct StudyId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for StudyId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let text = Path::<String>::from_request_parts(parts, state).await;
        let id = text.ok().and_then(|Path(text)| store::parse_id(&text));
        id.map(Self).ok_or_else(|| StudyRefusal::Unknown.into())
    }
}

impl FromRequestParts<App> for Reach {
    type Rejection = std::convert::Infallible;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, Self::Rejection> {
        let host =
            parts.headers.get(HOST).and_then(|host| host.to_str().ok()?.parse::<Authority>().ok());
        let name = host.as_ref().map(Authority::host).filter(|_| app.public_url.is_none());
        let live = app.live.and_then(|live| live_address(live, name?));
        let base = app.public_url.clone().or_else(|| host.map(|host| format!("http://{host}")));
        Ok(Self { base, live, links: app.links.clone() })
    }
}

/// Returns the live view for a client that calls the service by `name`. Nothing leads from
/// elsewhere to the loopback of this machine, and nothing through a proxy to the view.
fn live_address(live: SocketAddr, name: &str) -> Option<String> {
    let near = name == "localhost"
        || name.trim_matches(['[', ']']).parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
    match live.ip() {
        ip if ip.is_loopback() => near.then(|| format!("ws://{live}")),
        ip if ip.is_unspecified() => Some(format!("ws://{name}:{}", live.port())),
        _ => Some(format!("ws://{live}")),
    }
}

/// Returns a value of a query, `absent` if it is not there; else an error with the value given and
/// what is `wanted`.
pub(super) fn within<T: FromStr + PartialOrd>(
    given: Option<String>,
    absent: T,
    range: RangeInclusive<T>,
    wanted: impl Display,
) -> Result<T, String> {
    let Some(given) = given else { return Ok(absent) };
    let value = given.parse().ok().filter(|value| range.contains(value));
    value.ok_or_else(|| format!("{given:?} given, {wanted}"))
}

/// Returns the one of `all` that a query names, `absent` if it names none; else an error with the
/// value given and those allowed.
pub(super) fn named<T: Copy, const K: usize>(
    given: Option<String>,
    absent: T,
    all: [T; K],
    name: fn(T) -> &'static str,
) -> Result<T, String> {
    let Some(given) = given else { return Ok(absent) };
    let found = all.into_iter().find(|&one| name(one) == given);
    found.ok_or_else(|| format!("{given:?} given, one of {} is allowed", all.map(name).join(", ")))
}

/// Returns true for an uncompressed body of type `application/json` or `application/…+json`. A form
/// on a web page cannot send that, so no page can submit jobs without the user's knowledge.
pub(super) fn is_plain_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    let json = kind
        .strip_prefix("application/")
        .is_some_and(|kind| kind == "json" || kind.ends_with("+json"));
    json && headers.get(CONTENT_ENCODING).is_none_or(|coding| coding == "identity")
}

pub(super) fn json_text(text: impl Into<axum::body::Body>) -> Response {
    ([(CONTENT_TYPE, "application/json")], text.into()).into_response()
}

/// Runs blocking work away from the threads that answer.
pub(super) async fn off_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    joined(tokio::task::spawn_blocking(work)).await
}
