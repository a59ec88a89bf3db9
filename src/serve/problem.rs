//! Errors over HTTP: RFC 9457 problem details. The only place that knows status codes.
//!
//! Invariants: every answer of 400 and above is a problem with a fixed `code` to match on, wherever
//! it was made (`fill` ensures that); no answer names a file of the machine.

use std::any::Any;
use std::io;
use std::time::Duration;

use axum::Json;
use axum::extract::rejection::QueryRejection;
use axum::http::header::{CONNECTION, CONTENT_LENGTH, CONTENT_TYPE, RETRY_AFTER, WWW_AUTHENTICATE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use schemars::JsonSchema;
use serde::Serialize;

use super::config::Scope;
use super::engine::Refusal;
use super::studies::StudyRefusal;
use super::{chain, shortened};
use crate::scenario::{ScenarioError, ScenarioErrorKind};

pub(super) const MEDIA_TYPE: &str = "application/problem+json";

const UNPROCESSABLE: StatusCode = StatusCode::UNPROCESSABLE_ENTITY;

/// Longest detail in an answer, bytes: enough to say what is wrong, too short to echo a body.
const MAX_DETAIL: usize = 1024;

/// Longest pointer in an answer, bytes: a key of a body can be as long as the body.
const MAX_POINTER: usize = 200;

/// Seconds after which a full queue or a restarting service is worth another try.
const RETRY_S: u64 = 5;

/// Longest wait suggested for a log, seconds.
const MAX_RETRY_S: f64 = 60.0;

/// An error in an answer to a client.
#[derive(Debug)]
pub(super) struct Problem {
    status: StatusCode,
    code: &'static str,
    detail: String,
    pointer: Option<String>,
    retry_after_s: Option<u64>,
    /// Whether the connection ends with it: where a request ends is in doubt.
    closes: bool,
}

impl Problem {
    fn new(status: StatusCode, code: &'static str, detail: impl Into<String>) -> Self {
        Self {
            status,
            code,
            detail: detail.into(),
            pointer: None,
            retry_after_s: None,
            closes: false,
        }
    }

    fn retry(self, seconds: u64) -> Self {
        Self { retry_after_s: Some(seconds), ..self }
    }

    /// Reports that there is no resource of this name.
    pub(super) fn not_found(what: &str) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", format!("there is no {what}"))
    }

    /// Reports a query parameter that cannot be used.
    pub(super) fn bad_query(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad_query", detail)
    }

    /// Reports a body whose headers do not declare plain JSON.
    pub(super) fn not_json() -> Self {
        let detail = "send the scenario as plain JSON with Content-Type: application/json";
        Self::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", detail)
    }

    /// Reports a request that does not name the host it calls.
    pub(super) fn bad_host() -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad_host", "the request needs one Host header")
    }

    /// Reports a host name that is not ours.
    pub(super) fn misdirected() -> Self {
        let detail = "the service is not known by this name: use localhost or its address, or start it with --host NAME";
        Self::new(StatusCode::MISDIRECTED_REQUEST, "unknown_host", detail)
    }

    /// Reports too many requests from this address.
    pub(super) fn too_often(wait: Duration) -> Self {
        let detail = "too many requests from this address: wait a moment";
        let seconds = wait.as_secs_f64().ceil().max(1.0) as u64;
        Self::new(StatusCode::TOO_MANY_REQUESTS, "rate_limited", detail).retry(seconds)
    }

    /// Reports that there is no token, or none of ours.
    pub(super) fn unauthorised() -> Self {
        let detail = "send a token: Authorization: Bearer TOKEN; or, for a log, use a link that has not expired";
        Self::new(StatusCode::UNAUTHORIZED, "unauthorized", detail)
    }

    /// Reports a token without the required scope.
    pub(super) fn forbidden(scope: Scope) -> Self {
        let detail = format!("this needs a token with the scope {scope}");
        Self::new(StatusCode::FORBIDDEN, "forbidden", detail)
    }

    /// Reports a page of another origin that requests something not shared with other origins.
    pub(super) fn foreign_page() -> Self {
        let detail =
            "the request comes from a page of another origin: name that origin with --cors";
        Self::new(StatusCode::FORBIDDEN, "foreign_page", detail)
    }

    /// Reports a viewer that does not speak our protocol.
    pub(super) fn other_protocol() -> Self {
        let detail = "speak one of the subprotocols foxglove.sdk.v1 and foxglove.websocket.v1";
        Self::new(StatusCode::BAD_REQUEST, "other_protocol", detail)
    }

    /// Reports one viewer too many.
    pub(super) fn no_seat() -> Self {
        let detail = "the maximum number of viewers is connected: try again later";
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "too_many_viewers", detail).retry(RETRY_S)
    }

    /// Reports one connection too many.
    pub(super) fn too_many_connections() -> Self {
        let detail = "the maximum number of connections is open, in total or from this address: try again later, or keep fewer open";
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "too_many_connections", detail).retry(1)
    }

    /// Reports a body beyond the limit.
    pub(super) fn too_large() -> Self {
        Self::from_status(StatusCode::PAYLOAD_TOO_LARGE)
    }

    /// Reports a body that did not come in time.
    pub(super) fn too_slow() -> Self {
        let detail = "the body did not arrive within 30 s";
        Self::new(StatusCode::REQUEST_TIMEOUT, "too_slow", detail)
    }

    /// Reports a body that breaks off.
    pub(super) fn broken_body() -> Self {
        Self::from_status(StatusCode::BAD_REQUEST)
    }

    /// Reports a body in a coding that nobody here takes apart.
    pub(super) fn unknown_coding() -> Self {
        let detail =
            "send the body as it is, or with Transfer-Encoding: chunked and no other coding";
        Self { closes: true, ..Self::new(StatusCode::NOT_IMPLEMENTED, "unknown_coding", detail) }
    }

    /// Reports a clock that shows a date that HTTP cannot express.
    pub(super) fn timeless() -> Self {
        let detail = "the clock of this machine shows a date before 1970 or after 9999: set it";
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "clock_wrong", detail)
    }

    /// Reports a header that cannot be used.
    pub(super) fn bad_header(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad_header", detail)
    }

    /// Reports a file that should be there and cannot be read. One that is gone was forgotten
    /// during the request.
    pub(super) fn unreadable(error: &(dyn std::error::Error + 'static)) -> Self {
        if is_gone(error) {
            return Self::from_status(StatusCode::NOT_FOUND);
        }
        tracing::error!(error = chain(error), "file unreadable");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "storage_error",
            "the service could not read the file",
        )
    }

    /// Returns the meaning of a bare status of the library below us.
    fn from_status(status: StatusCode) -> Self {
        let (code, detail) = match status {
            StatusCode::BAD_REQUEST => ("bad_request", "the request cannot be understood"),
            StatusCode::NOT_FOUND => ("not_found", "there is nothing at this address"),
            StatusCode::METHOD_NOT_ALLOWED => (
                "method_not_allowed",
                "this address does not allow the method: see the header Allow",
            ),
            StatusCode::PRECONDITION_FAILED => {
                ("precondition_failed", "the file is not the version that was asked for")
            }
            StatusCode::PAYLOAD_TOO_LARGE => ("too_large", "a body may have at most 1 MiB"),
            StatusCode::RANGE_NOT_SATISFIABLE => {
                ("bad_range", "ask for one range that lies within the file")
            }
            status if status.is_client_error() => ("bad_request", "the request cannot be answered"),
            _ => ("internal", "the service failed to answer; its log says why"),
        };
        Self::new(status, code, detail)
    }

    /// Returns the text of the answer.
    pub(super) fn text(self) -> String {
        serde_json::to_string(&self.body()).unwrap_or_default()
    }

    fn body(self) -> Body {
        let pointer = self.pointer.map(|pointer| nearest(&pointer).to_owned());
        Body {
            kind: format!("urn:vpd:problem:{}", self.code),
            title: title(self.code),
            status: self.status.as_u16(),
            detail: shortened(self.detail, MAX_DETAIL),
            code: self.code,
            pointer,
        }
    }
}

/// Returns whether an error says that there is no such file.
fn is_gone(error: &(dyn std::error::Error + 'static)) -> bool {
    let mut cause = Some(error);
    while let Some(error) = cause {
        let io = error.downcast_ref::<io::Error>().map(io::Error::kind);
        let store = error.downcast_ref::<object_store::Error>();
        if io == Some(io::ErrorKind::NotFound)
            || matches!(store, Some(object_store::Error::NotFound { .. }))
        {
            return true;
        }
        cause = error.source();
    }
    false
}

/// Returns a pointer to the field, or if that is too long, to what it lies in.
fn nearest(pointer: &str) -> &str {
    if pointer.len() <= MAX_POINTER {
        return pointer;
    }
    let begin = pointer.as_bytes().get(..=MAX_POINTER).unwrap_or_default();
    let end = begin.iter().rposition(|byte| *byte == b'/').unwrap_or(0);
    pointer.get(..end).unwrap_or_default()
}

/// The text of a problem.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "Problem")]
pub(super) struct Body {
    #[serde(rename = "type")]
    kind: String,
    title: String,
    status: u16,
    /// Description of the error, for a person.
    detail: String,
    /// Code of the error, for a program; fixed.
    code: &'static str,
    /// JSON pointer of the field at fault; of what it lies in, if it is longer than 200 bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pointer: Option<String>,
}

/// Returns the code as the beginning of a sentence: `queue_full` → `Queue full`.
fn title(code: &str) -> String {
    let mut words = code.replace('_', " ");
    if let Some(first) = words.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    words
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let Self { status, retry_after_s, closes, .. } = self;
        let mut response = (status, Json(self.body())).into_response();
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        if let Some(seconds) = retry_after_s {
            response.headers_mut().insert(RETRY_AFTER, seconds.into());
        }
        if closes {
            response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
        }
        if status == StatusCode::UNAUTHORIZED {
            response.headers_mut().insert(WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        response
    }
}

impl From<ScenarioError> for Problem {
    fn from(error: ScenarioError) -> Self {
        match error.kind {
            ScenarioErrorKind::Malformed => {
                Self::new(StatusCode::BAD_REQUEST, "malformed_json", error.message)
            }
            ScenarioErrorKind::Invalid => Self {
                pointer: Some(error.pointer),
                ..Self::new(StatusCode::UNPROCESSABLE_ENTITY, "invalid_input", error.message)
            },
        }
    }
}

impl From<StudyRefusal> for Problem {
    fn from(refusal: StudyRefusal) -> Self {
        let detail = refusal.to_string();
        let with = |status, code| Self::new(status, code, detail);
        match refusal {
            StudyRefusal::Store(error) => Refusal::Store(error).into(),
            StudyRefusal::QueueFull => {
                with(StatusCode::TOO_MANY_REQUESTS, "queue_full").retry(RETRY_S)
            }
            StudyRefusal::Drawing => with(StatusCode::TOO_MANY_REQUESTS, "busy").retry(1),
            StudyRefusal::Unknown => with(StatusCode::NOT_FOUND, "unknown_study"),
            StudyRefusal::NoFile => with(StatusCode::NOT_FOUND, "no_file"),
            StudyRefusal::Running => with(StatusCode::CONFLICT, "study_running"),
            StudyRefusal::Member(error) => error.into(),
            StudyRefusal::TooExpensive { .. } => {
                Self { pointer: Some("/vary".to_owned()), ..with(UNPROCESSABLE, "too_expensive") }
            }
            StudyRefusal::TableTooLarge { .. } => {
                Self { pointer: Some("/vary".to_owned()), ..with(UNPROCESSABLE, "log_too_large") }
            }
        }
    }
}

impl From<Refusal> for Problem {
    fn from(refusal: Refusal) -> Self {
        let (detail, code) = (refusal.to_string(), refusal.code());
        let with = |status| Self::new(status, code, detail);
        match refusal {
            Refusal::QueueFull { .. } => with(StatusCode::TOO_MANY_REQUESTS).retry(RETRY_S),
            Refusal::TooExpensive { pointer, .. } | Refusal::LogTooLarge { pointer, .. } => {
                Self { pointer: Some(pointer.to_owned()), ..with(UNPROCESSABLE) }
            }
            Refusal::TooMuchMemory { .. } => with(UNPROCESSABLE),
            Refusal::DiskFull => with(StatusCode::INSUFFICIENT_STORAGE).retry(MAX_RETRY_S as u64),
            Refusal::KeyReused => with(UNPROCESSABLE),
            Refusal::KeyBusy => with(StatusCode::CONFLICT).retry(1),
            Refusal::Stopping => with(StatusCode::SERVICE_UNAVAILABLE).retry(RETRY_S),
            Refusal::UnknownJob | Refusal::NoLog => with(StatusCode::NOT_FOUND),
            Refusal::JobRunning | Refusal::JobEnded => with(StatusCode::CONFLICT),
            Refusal::NoStudies => with(StatusCode::NOT_IMPLEMENTED),
            Refusal::LogDamaged | Refusal::Broken => with(StatusCode::INTERNAL_SERVER_ERROR),
            Refusal::LogUnfinished { eta_s } => {
                let wait = eta_s.unwrap_or(RETRY_S as f64).ceil().clamp(1.0, MAX_RETRY_S);
                with(StatusCode::CONFLICT).retry(wait as u64)
            }
            // The job was forgotten during the request.
            Refusal::Store(error) if is_gone(&error) => Refusal::UnknownJob.into(),
            Refusal::Store(error) => {
                tracing::error!(error = chain(&error), "store failed");
                match code {
                    "storage_moved" => {
                        let detail = "the data directory was moved or replaced: the service takes no jobs until it is back";
                        Self::new(StatusCode::SERVICE_UNAVAILABLE, code, detail).retry(RETRY_S)
                    }
                    "storage_full" => {
                        with(StatusCode::INSUFFICIENT_STORAGE).retry(MAX_RETRY_S as u64)
                    }
                    _ => with(StatusCode::INTERNAL_SERVER_ERROR),
                }
            }
        }
    }
}

impl From<QueryRejection> for Problem {
    fn from(rejection: QueryRejection) -> Self {
        Self::bad_query(rejection.body_text())
    }
}

/// Makes a problem of every bare error answer, keeping what its headers say (`Allow`, `Content-Range`).
pub(super) async fn fill(response: Response) -> Response {
    let status = response.status();
    let is_error = status.is_client_error() || status.is_server_error();
    if !is_error || response.headers().get(CONTENT_TYPE).is_some_and(|kind| kind == MEDIA_TYPE) {
        return response;
    }
    let mut headers = response.into_parts().0.headers;
    headers.remove(CONTENT_LENGTH);
    headers.remove(CONTENT_TYPE);
    let mut problem = Problem::from_status(status).into_response();
    problem.headers_mut().extend(headers);
    problem
}

/// Returns the answer where a handler panicked.
pub(super) fn panicked(_: Box<dyn Any + Send>) -> Response {
    tracing::error!("a handler panicked");
    Problem::from_status(StatusCode::INTERNAL_SERVER_ERROR).into_response()
}
