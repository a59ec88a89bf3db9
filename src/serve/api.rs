//! The routes. A handler unpacks, makes one call, packs.
//!
//! Invariant: what a client sends reaches the inside as a checked type (`JobId`, `Scenario`, `ListQuery`) or
//! not at all.

use axum::body::Bytes;
use axum::extract::rejection::{BytesRejection, QueryRejection};
use axum::extract::{FromRequestParts, Path, Query, Request, State as Shared};
use axum::http::header::{CONTENT_ENCODING, CONTENT_TYPE, HOST, LOCATION, X_CONTENT_TYPE_OPTIONS};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::middleware::map_response;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use serde::Deserialize;
use serde_json::{Value, json};
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::limit::RequestBodyLimitLayer;
use tower_http::set_header::SetResponseHeaderLayer;
use tower_http::trace::TraceLayer;
use uuid::Uuid;

use super::engine::{Engine, Refusal};
use super::job::{State, View};
use super::problem::{self, Problem};
use super::{ServeConfig, download, store};
use crate::advise;
use crate::scenario::{SHIPPED, Scenario, ScenarioError, schema};

/// Largest request body, bytes.
const MAX_BODY: usize = 1 << 20;

/// Jobs on a page of the list, unless the client says otherwise, and at most.
const PAGE: usize = 50;
const MAX_PAGE: usize = 500;

#[derive(Clone, Debug)]
struct App {
    engine: Engine,
    public_url: Option<String>,
}

/// All routes of the service.
pub(super) fn router(engine: Engine, config: &ServeConfig) -> Router {
    let log = Router::new().route("/jobs/{id}/log.mcap", get(get_log));
    let public_url = config.public_url.as_ref().map(|url| url.trim_end_matches('/').to_owned());
    Router::new()
        .route("/jobs", get(list_jobs).post(submit_job))
        .route("/jobs/{id}", get(get_job).delete(forget_job))
        .route("/jobs/{id}/cancel", post(cancel_job))
        .route("/jobs/{id}/scenario.json", get(get_job_scenario))
        .merge(download::share(log, &config.cors))
        .route("/scenario.schema.json", get(get_schema))
        .route("/scenarios", get(list_scenarios))
        .route("/scenarios/{name}", get(get_scenario))
        .route("/healthz", get(healthz))
        .route("/readyz", get(readyz))
        .layer(RequestBodyLimitLayer::new(MAX_BODY))
        .layer(map_response(problem::fill))
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(SetResponseHeaderLayer::overriding(
            X_CONTENT_TYPE_OPTIONS,
            HeaderValue::from_static("nosniff"),
        ))
        .layer(TraceLayer::new_for_http())
        .with_state(App { engine, public_url })
}

/// The id in the path of a job.
struct JobId(Uuid);

impl<S: Send + Sync> FromRequestParts<S> for JobId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let text = Path::<String>::from_request_parts(parts, state).await;
        let id = text.ok().and_then(|Path(text)| store::parse_id(&text));
        id.map(Self).ok_or_else(|| Refusal::UnknownJob.into())
    }
}

/// How the client reached us, for links that viewers follow; none if it did not say.
struct Base(Option<String>);

impl FromRequestParts<App> for Base {
    type Rejection = std::convert::Infallible;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, Self::Rejection> {
        let host =
            parts.headers.get(HOST).and_then(|host| host.to_str().ok()?.parse::<Authority>().ok());
        Ok(Self(app.public_url.clone().or_else(|| host.map(|host| format!("http://{host}")))))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ListQuery {
    state: Option<State>,
    limit: Option<usize>,
    cursor: Option<String>,
}

async fn submit_job(
    Shared(app): Shared<App>,
    Base(base): Base,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, Problem> {
    if !is_plain_json(&headers) {
        return Err(Problem::not_json());
    }
    let body = body?;
    // A mebibyte of JSON takes a while to check: not on a thread that others wait for.
    let checked = move || {
        let scenario = Scenario::from_json(&body)?;
        let plan = advise::plan(&scenario)?;
        Ok::<_, ScenarioError>((scenario, plan))
    };
    let (scenario, plan) = off_thread(checked).await?;
    let view = app.engine.submit(scenario, plan).await?;
    let location = [(LOCATION, format!("/jobs/{}", view.id))];
    Ok((StatusCode::ACCEPTED, location, Json(job_json(&view, base.as_deref()))).into_response())
}

async fn list_jobs(
    Shared(app): Shared<App>,
    Base(base): Base,
    query: Result<Query<ListQuery>, QueryRejection>,
) -> Result<Json<Value>, Problem> {
    let Query(ListQuery { state, limit, cursor }) = query?;
    let limit = limit.unwrap_or(PAGE);
    if !(1..=MAX_PAGE).contains(&limit) {
        return Err(Problem::bad_query(format!("limit is 1 to {MAX_PAGE}")));
    }
    let unusable = || Problem::bad_query("cursor is not one that this list gave");
    let cursor = cursor.map(|text| store::parse_id(&text).ok_or_else(unusable)).transpose()?;
    let (page, next) = app.engine.list(state, limit, cursor);
    let jobs: Vec<_> = page.iter().map(|view| job_json(view, base.as_deref())).collect();
    let filter = state.map_or(String::new(), |state| format!("state={}&", state.as_str()));
    let link = next.map(|next| format!("/jobs?{filter}limit={limit}&cursor={next}"));
    Ok(Json(json!({ "jobs": jobs, "next_cursor": next, "links": { "next": link } })))
}

async fn get_job(
    Shared(app): Shared<App>,
    Base(base): Base,
    JobId(id): JobId,
) -> Result<Json<Value>, Problem> {
    Ok(Json(job_json(&app.engine.get(id).await?, base.as_deref())))
}

async fn cancel_job(
    Shared(app): Shared<App>,
    Base(base): Base,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    let view = app.engine.cancel(id).await?;
    let status = if view.state.is_final() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, Json(job_json(&view, base.as_deref()))).into_response())
}

async fn forget_job(Shared(app): Shared<App>, JobId(id): JobId) -> Result<StatusCode, Problem> {
    app.engine.forget(id).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn get_log(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    request: Request,
) -> Result<Response, Problem> {
    download::log(id, app.engine.log(id)?, request).await
}

async fn get_job_scenario(Shared(app): Shared<App>, JobId(id): JobId) -> Result<Response, Problem> {
    Ok(json_text(app.engine.scenario(id).await?))
}

async fn get_schema() -> Json<Value> {
    Json(schema())
}

async fn list_scenarios() -> Json<Value> {
    let scenarios: Vec<_> = SHIPPED
        .iter()
        .map(|(name, text)| {
            let scenario: Value = serde_json::from_str(text).unwrap_or_default();
            let link = format!("/scenarios/{name}");
            json!({ "name": name, "description": scenario["description"], "links": { "self": link } })
        })
        .collect();
    Json(json!({ "scenarios": scenarios }))
}

async fn get_scenario(Path(name): Path<String>) -> Result<Response, Problem> {
    let name = name.strip_suffix(".json").unwrap_or(&name);
    let shipped = SHIPPED.iter().find(|(shipped, _)| *shipped == name);
    shipped.map(|(_, text)| json_text(*text)).ok_or_else(|| Problem::not_found("scenario"))
}

async fn healthz() -> Json<Value> {
    Json(json!({ "status": "ok" }))
}

async fn readyz(Shared(app): Shared<App>) -> Result<Json<Value>, Problem> {
    if app.engine.is_ready() {
        Ok(Json(json!({ "status": "ready" })))
    } else {
        Err(Problem::not_ready())
    }
}

/// True for an uncompressed body of type `application/json` or `application/…+json`. A form on a web page cannot
/// send that, so no page can submit jobs behind the user's back.
fn is_plain_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    let json = kind
        .strip_prefix("application/")
        .is_some_and(|kind| kind == "json" || kind.ends_with("+json"));
    json && headers.get(CONTENT_ENCODING).is_none_or(|coding| coding == "identity")
}

fn json_text(text: impl Into<axum::body::Body>) -> Response {
    ([(CONTENT_TYPE, "application/json")], text.into()).into_response()
}

/// Runs blocking work away from the threads that answer.
async fn off_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(work).await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            Err(_) => std::future::pending().await,
        },
    }
}

/// A job as clients see it.
fn job_json(view: &View, base: Option<&str>) -> Value {
    let View { id, steps, steps_done, .. } = view;
    let percent = if *steps == 0 { 0.0 } else { 100.0 * *steps_done as f64 / *steps as f64 };
    let mut job = json!({
        "id": id,
        "name": view.name,
        "state": view.state,
        "created": view.created,
        "attempts": view.attempts,
        "progress": {
            "steps": steps,
            "steps_done": steps_done,
            "durable_step": view.durable_step,
            "percent": (percent * 100.0).floor() / 100.0,
            "eta_s": view.eta_s.map(|eta| (eta * 10.0).round() / 10.0),
        },
        "plan": view.plan,
    });
    if let Some(record) = &view.record {
        job["finished"] = json!(record.finished);
        job["summary"] = json!(record.summary);
        job["diagnosis"] = json!(record.diagnosis);
    }
    let mut links =
        json!({ "self": format!("/jobs/{id}"), "scenario": format!("/jobs/{id}/scenario.json") });
    if view.has_log || !view.state.is_final() {
        links["log"] = json!(format!("/jobs/{id}/log.mcap"));
    }
    if let Some(base) = base.filter(|_| view.has_log) {
        links["viewers"] = viewers(&format!("{base}/jobs/{id}/log.mcap"));
    }
    job["links"] = links;
    job
}

/// Links that open a log in viewers. A desktop link does nothing where the program is not installed.
fn viewers(log: &str) -> Value {
    let log = percent_encoded(log);
    json!({
        "foxglove": format!("https://app.foxglove.dev/~/view?ds=remote-file&ds.url={log}"),
        "foxglove_desktop": format!("foxglove://open?ds=remote-file&ds.url={log}"),
        "lichtblick_desktop": format!("lichtblick://open?ds=remote-file&ds.url={log}"),
        "rerun": format!("https://rerun.io/viewer?url={log}"),
    })
}

/// Everything but RFC 3986's unreserved characters as `%XX`.
fn percent_encoded(text: &str) -> String {
    let encode = |byte: u8| match byte {
        b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
            char::from(byte).to_string()
        }
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(encode).collect()
}
