//! Errors over HTTP: RFC 9457 problem details. The only place that knows status codes.
//!
//! Invariants: every answer of 400 and above is a problem with a fixed `code` to match on, whoever made it
//! (`fill` sees to that); no answer names a file of the machine.

use std::any::Any;

use axum::Json;
use axum::extract::rejection::{BytesRejection, QueryRejection};
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, RETRY_AFTER};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};

use super::chain;
use super::engine::Refusal;
use crate::scenario::{ScenarioError, ScenarioErrorKind};

const MEDIA_TYPE: &str = "application/problem+json";

/// Longest detail in an answer, bytes: enough to say what is wrong, too short to echo a body.
const MAX_DETAIL: usize = 1024;

/// Seconds after which a full queue or a restarting service is worth another try.
const RETRY_S: u64 = 5;

/// Longest wait suggested for a log, seconds.
const MAX_RETRY_S: f64 = 60.0;

/// An error as a client sees it.
#[derive(Debug)]
pub(super) struct Problem {
    status: StatusCode,
    code: &'static str,
    detail: String,
    pointer: Option<String>,
    retry_after_s: Option<u64>,
}

impl Problem {
    fn new(status: StatusCode, code: &'static str, detail: impl Into<String>) -> Self {
        Self { status, code, detail: detail.into(), pointer: None, retry_after_s: None }
    }

    fn retry(self, seconds: u64) -> Self {
        Self { retry_after_s: Some(seconds), ..self }
    }

    /// No resource of this name.
    pub(super) fn not_found(what: &str) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", format!("there is no {what} of this name"))
    }

    /// A query parameter that cannot be used.
    pub(super) fn bad_query(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad_query", detail)
    }

    /// A body that is not plain JSON by its headers.
    pub(super) fn not_json() -> Self {
        let detail = "send the scenario as plain JSON with Content-Type: application/json";
        Self::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", detail)
    }

    /// The service stops or does not take jobs.
    pub(super) fn not_ready() -> Self {
        Refusal::Stopping.into()
    }

    /// A file that should be there cannot be read.
    pub(super) fn unreadable(error: &dyn std::error::Error) -> Self {
        tracing::error!(error = chain(error), "file unreadable");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "storage_error",
            "the service could not read the file",
        )
    }

    /// What a bare status of the library below us means.
    fn from_status(status: StatusCode) -> Self {
        let (code, detail) = match status {
            StatusCode::BAD_REQUEST => ("bad_request", "the request cannot be understood"),
            StatusCode::NOT_FOUND => ("not_found", "there is nothing at this address"),
            StatusCode::METHOD_NOT_ALLOWED => {
                ("method_not_allowed", "this address has other methods: see Allow")
            }
            StatusCode::PRECONDITION_FAILED => {
                ("precondition_failed", "the file is not the one that was asked for")
            }
            StatusCode::PAYLOAD_TOO_LARGE => ("too_large", "a scenario has at most 1 MiB"),
            StatusCode::RANGE_NOT_SATISFIABLE => {
                ("bad_range", "ask for one range that lies within the file")
            }
            status if status.is_client_error() => ("bad_request", "the request cannot be answered"),
            _ => ("internal", "the service failed to answer; its log says why"),
        };
        Self::new(status, code, detail)
    }

    fn body(&self) -> Value {
        let mut end = self.detail.len().min(MAX_DETAIL);
        while !self.detail.is_char_boundary(end) {
            end -= 1;
        }
        let mut body = json!({
            "type": format!("urn:vpd:problem:{}", self.code),
            "title": title(self.code),
            "status": self.status.as_u16(),
            "detail": &self.detail[..end],
            "code": self.code,
        });
        if let Some(pointer) = &self.pointer {
            body["pointer"] = json!(pointer);
        }
        body
    }
}

/// The code as a sentence opens: `queue_full` → `Queue full`.
fn title(code: &str) -> String {
    let mut words = code.replace('_', " ");
    if let Some(first) = words.get_mut(..1) {
        first.make_ascii_uppercase();
    }
    words
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(self.body())).into_response();
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE));
        if let Some(seconds) = self.retry_after_s {
            response.headers_mut().insert(RETRY_AFTER, seconds.into());
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

impl From<Refusal> for Problem {
    fn from(refusal: Refusal) -> Self {
        let detail = refusal.to_string();
        let with = |status, code| Self::new(status, code, detail);
        match refusal {
            Refusal::QueueFull { .. } => {
                with(StatusCode::TOO_MANY_REQUESTS, "queue_full").retry(RETRY_S)
            }
            Refusal::Stopping => with(StatusCode::SERVICE_UNAVAILABLE, "stopping").retry(RETRY_S),
            Refusal::UnknownJob => with(StatusCode::NOT_FOUND, "unknown_job"),
            Refusal::NoLog => with(StatusCode::NOT_FOUND, "no_log"),
            Refusal::JobRunning => with(StatusCode::CONFLICT, "job_running"),
            Refusal::JobEnded => with(StatusCode::CONFLICT, "job_ended"),
            Refusal::LogUnfinished { eta_s } => {
                let wait = eta_s.unwrap_or(RETRY_S as f64).ceil().clamp(1.0, MAX_RETRY_S);
                with(StatusCode::CONFLICT, "log_unfinished").retry(wait as u64)
            }
            Refusal::Store(error) => {
                tracing::error!(error = chain(&error), "store failed");
                match error.code() {
                    "storage_full" => with(StatusCode::INSUFFICIENT_STORAGE, "storage_full"),
                    code => with(StatusCode::INTERNAL_SERVER_ERROR, code),
                }
            }
        }
    }
}

impl From<BytesRejection> for Problem {
    fn from(rejection: BytesRejection) -> Self {
        Self::from_status(rejection.status())
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

/// The answer where a handler panicked.
pub(super) fn panicked(_: Box<dyn Any + Send>) -> Response {
    tracing::error!("a handler panicked");
    Problem::from_status(StatusCode::INTERNAL_SERVER_ERROR).into_response()
}
