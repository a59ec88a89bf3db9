//! The routes. A handler unpacks, makes one call, packs.
//!
//! Invariant: what a client sends reaches the inside as a checked type (`JobId`, `Scenario`, `ListQuery`) or
//! not at all; and every route is in the list that also makes the API's description.

use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::extract::{FromRequestParts, Path, Query, Request, State as Shared};
use axum::http::header::{CONTENT_ENCODING, CONTENT_TYPE, HOST, LOCATION, X_CONTENT_TYPE_OPTIONS};
use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::{MethodRouter, delete, get, post};
use axum::{Json, Router};
use schemars::JsonSchema;
use serde::Deserialize;
use serde_json::Value;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::set_header::SetResponseHeaderLayer;
use tower_http::trace::TraceLayer;
use uuid::Uuid;

use super::config::Scope;
use super::engine::{Engine, Refusal};
use super::gate::{self, Gate};
use super::job::State;
use super::openapi::{self, Operation};
use super::page::{self, MAX_STRETCH, Pictures, STRETCH};
use super::problem::{self, Problem};
use super::studies::{self, Question, Studies, StudyRefusal, StudyView};
use super::view::{JobEvent, JobList, JobView, ScenarioList, Status};
use super::{ServeConfig, download, follow, metrics, store};
use crate::advise;
use crate::log::stretch::Stretch;
use crate::scenario::{SHIPPED, Scenario, ScenarioError, schema};

/// Jobs on a page of the list, unless the client says otherwise, and at most.
const PAGE: usize = 50;
const MAX_PAGE: usize = 500;

/// Longest idempotency key, bytes.
const MAX_KEY: usize = 255;

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

#[derive(Clone, Debug)]
struct App {
    engine: Engine,
    studies: Studies,
    pictures: Pictures,
    public_url: Option<String>,
}

/// A route: where it is, what it says of itself, who may use it, what it does.
struct Route {
    method: Method,
    path: &'static str,
    /// `None`: everybody.
    scope: Option<Scope>,
    /// Whether pages of other origins may read the answer.
    shared: bool,
    operation: Operation,
    handler: MethodRouter<App>,
}

impl Route {
    fn new(
        path: &'static str,
        scope: Scope,
        operation: Operation,
        handler: MethodRouter<App>,
    ) -> Self {
        let (method, scope) = (Method::GET, Some(scope));
        Self { method, path, scope, shared: false, operation, handler }
    }

    fn method(self, method: Method) -> Self {
        Self { method, ..self }
    }

    fn open(self) -> Self {
        Self { scope: None, ..self }
    }

    fn shared(self) -> Self {
        Self { shared: true, ..self }
    }
}

/// All routes but that of their description.
fn routes() -> Vec<Route> {
    use Scope::{Admin, Read, Submit};
    let op = Operation::new;
    vec![
        Route::new(
            "/jobs",
            Submit,
            op("submitJob", "Take a job; it is on the disk before the answer")
                .header::<String>(
                    "Idempotency-Key",
                    "The same key with the same scenario gives the same job, also after a restart",
                )
                .body::<Scenario>(Some(SHIPPED[0].1))
                .json::<JobView>(202, "Taken")
                .json::<JobView>(200, "Taken before under this key, and ended"),
            post(submit_job),
        )
        .method(Method::POST),
        Route::new(
            "/jobs",
            Read,
            op("listJobs", "Jobs, newest first")
                .query::<State>("state", "Only those in this state")
                .query::<Limit>("limit", "How many at most; 50 if absent")
                .query::<Uuid>("cursor", "`next_cursor` of the page before")
                .json::<JobList>(200, "A page"),
            get(list_jobs),
        ),
        Route::new(
            "/jobs/{id}",
            Read,
            op("getJob", "State, progress, plan, summary or diagnosis, links")
                .json::<JobView>(200, "The job"),
            get(get_job),
        ),
        Route::new(
            "/jobs/{id}",
            Admin,
            op("forgetJob", "Forget a job that does not run, and its log").empty(204, "Forgotten"),
            delete(forget_job),
        )
        .method(Method::DELETE),
        Route::new(
            "/jobs/{id}/cancel",
            Submit,
            op("cancelJob", "Stop a job; what it logged becomes a finished log")
                .json::<JobView>(202, "It ends at its next step")
                .json::<JobView>(200, "It has ended"),
            post(cancel_job),
        )
        .method(Method::POST),
        Route::new(
            "/jobs/{id}/scenario.json",
            Read,
            op("getJobScenario", "The scenario as accepted").json::<Scenario>(200, "The scenario"),
            get(get_job_scenario),
        ),
        Route::new(
            "/jobs/{id}/events",
            Read,
            op(
                "followJob",
                "Server-sent events: state (the job), progress; until the job has ended",
            )
            .answer::<JobEvent>(200, "text/event-stream", "Events"),
            get(get_events),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/log.mcap",
            Read,
            op("getLog", "The finished log; single ranges, ETag")
                .raw(200, "application/octet-stream", "The whole log")
                .raw(206, "application/octet-stream", "A range of it")
                .empty(304, "Not changed"),
            get(get_log),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/live.mcap",
            Read,
            op("followLog", "The log as its chunks are closed, to its end").raw(
                200,
                "application/octet-stream",
                "The bytes of the finished log",
            ),
            get(get_live),
        )
        .shared(),
        Route::new(
            "/studies",
            Submit,
            op("submitStudy", "Take a study: many runs of one scene, one table")
                .body::<studies::Request>(None)
                .json::<StudyView>(202, "Taken; kept in memory"),
            post(submit_study),
        )
        .method(Method::POST),
        Route::new(
            "/studies/{id}",
            Read,
            op("getStudy", "State, progress, table, links").json::<StudyView>(200, "The study"),
            get(get_study),
        ),
        Route::new(
            "/studies/{id}",
            Admin,
            op("forgetStudy", "Forget a study that does not run").empty(204, "Forgotten"),
            delete(forget_study),
        )
        .method(Method::DELETE),
        Route::new(
            "/studies/{id}/cancel",
            Submit,
            op("cancelStudy", "Stop a study").json::<StudyView>(202, "It ends within a step"),
            post(cancel_study),
        )
        .method(Method::POST),
        Route::new(
            "/studies/{id}/table.csv",
            Read,
            op("getStudyTable", "The table of a study").raw(200, "text/csv", "One row a run"),
            get(get_study_table),
        )
        .shared(),
        Route::new(
            "/studies/{id}/charts/{name}",
            Read,
            op("getStudyChart", "A chart of a study").raw(200, "image/svg+xml", "The chart"),
            get(get_study_chart),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/attitudes.json",
            Read,
            op("getAttitudes", "Attitudes one after another, and the shapes of the scene")
                .query::<f64>("from_s", "Time of the first one in seconds; 0 while the job runs")
                .query::<Samples>("samples", "How many at most; 300 if absent")
                .json::<Stretch>(200, "Attitudes"),
            get(get_attitudes),
        ),
        Route::new(
            "/jobs/{id}/charts/{chart}",
            Read,
            op(
                "getChart",
                "`energy.svg`, `orthogonality.svg` or `momentum.svg`, drawn from the log",
            )
            .raw(200, "image/svg+xml", "The chart"),
            get(get_chart),
        ),
        Route::new(
            "/layouts/foxglove.json",
            Read,
            op("getFoxgloveLayout", "A layout for Foxglove").json::<Value>(200, "The layout"),
            get(page::layout),
        )
        .open()
        .shared(),
        Route::new(
            "/layouts/lichtblick.json",
            Read,
            op("getLichtblickLayout", "A layout for Lichtblick").json::<Value>(200, "The layout"),
            get(page::layout),
        )
        .open()
        .shared(),
        Route::new(
            "/scenarios",
            Read,
            op("listScenarios", "Shipped examples").json::<ScenarioList>(200, "Names and texts"),
            get(list_scenarios),
        ),
        Route::new(
            "/scenarios/{name}",
            Read,
            op("getScenario", "A shipped example").json::<Scenario>(200, "The scenario"),
            get(get_scenario),
        ),
        Route::new(
            "/scenario.schema.json",
            Read,
            op("getSchema", "The JSON Schema of a scenario").json::<Value>(200, "The schema"),
            get(get_schema),
        ),
        Route::new(
            "/metrics",
            Read,
            op("getMetrics", "Figures for Prometheus").raw(
                200,
                metrics::MEDIA_TYPE,
                "OpenMetrics text",
            ),
            get(get_metrics),
        ),
        Route::new(
            "/healthz",
            Read,
            op("isAlive", "Liveness").json::<Status>(200, "Alive"),
            get(healthz),
        )
        .open(),
        Route::new(
            "/readyz",
            Read,
            op("isReady", "Readiness").json::<Status>(200, "Takes jobs"),
            get(readyz),
        )
        .open(),
        Route::new(
            "/",
            Read,
            op("readPage", "The page for people").raw(200, "text/html; charset=utf-8", "A page"),
            get(page::page),
        )
        .open(),
        Route::new(
            "/docs",
            Read,
            op("readDocs", "This description as a page").raw(
                200,
                "text/html; charset=utf-8",
                "A page",
            ),
            get(async || Html(include_str!("docs.html"))),
        )
        .open(),
    ]
}

/// All routes of the service.
pub(super) fn router(engine: Engine, studies: Studies, config: &ServeConfig) -> Router {
    let gate = Gate::new(config);
    let public_url = config.public_url.as_ref().map(|url| url.trim_end_matches('/').to_owned());
    let routes = routes();
    let described = routes.iter().map(|route| {
        let Route { method, path, scope, operation, .. } = route;
        (method, *path, *scope, operation)
    });
    let description = openapi::document(described);
    let (mut own, mut shared) = (Router::new(), Router::new());
    for Route { path, scope, shared: for_all, handler, .. } in routes {
        let handler = match scope {
            Some(scope) => {
                handler.route_layer(from_fn_with_state((gate.clone(), scope), gate::authorise))
            }
            None => handler,
        };
        let place = if for_all { &mut shared } else { &mut own };
        *place = std::mem::take(place).route(path, handler);
    }
    own.merge(download::share(shared, &config.cors))
        .route("/openapi.json", get(async move || Json(description)))
        .layer(from_fn(gate::whole_body))
        .layer(from_fn_with_state(gate, gate::admit))
        .layer(map_response(problem::fill))
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(SetResponseHeaderLayer::overriding(
            X_CONTENT_TYPE_OPTIONS,
            HeaderValue::from_static("nosniff"),
        ))
        .layer(PropagateRequestIdLayer::new(REQUEST_ID))
        .layer(TraceLayer::new_for_http().make_span_with(span))
        .layer(SetRequestIdLayer::new(REQUEST_ID, MakeRequestUuid))
        .with_state(App { engine, studies, pictures: Pictures::new(), public_url })
}

/// A request in the service's own log: without its query, which may hold a token.
fn span(request: &Request) -> tracing::Span {
    let id = request.headers().get(REQUEST_ID).and_then(|id| id.to_str().ok()).unwrap_or_default();
    let (method, path) = (request.method(), request.uri().path());
    tracing::info_span!("request", id, %method, path)
}

/// A size of a page.
#[derive(JsonSchema)]
#[schemars(transparent)]
#[allow(dead_code, reason = "only its schema is used")]
struct Limit(#[schemars(range(min = 1, max = 500))] usize);

/// A number of attitudes.
#[derive(JsonSchema)]
#[schemars(transparent)]
#[allow(dead_code, reason = "only its schema is used")]
struct Samples(#[schemars(range(min = 1, max = 2000))] usize);

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

/// The id in the path of a study.
struct StudyId(Uuid);

impl<S: Send + Sync> FromRequestParts<S> for StudyId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let text = Path::<String>::from_request_parts(parts, state).await;
        let id = text.ok().and_then(|Path(text)| store::parse_id(&text));
        id.map(Self).ok_or_else(|| StudyRefusal::Unknown.into())
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
    body: Bytes,
) -> Result<Response, Problem> {
    if !is_plain_json(&headers) {
        return Err(Problem::not_json());
    }
    let key = idempotency_key(&headers)?;
    // A mebibyte of JSON takes a while to check: not on a thread that others wait for.
    let checked = move || {
        let scenario = Scenario::from_json(&body)?;
        let plan = advise::plan(&scenario)?;
        Ok::<_, ScenarioError>((scenario, plan))
    };
    let (scenario, plan) = off_thread(checked).await?;
    let view = app.engine.submit(scenario, plan, key).await?;
    let location = [(LOCATION, format!("/jobs/{}", view.id))];
    let status = if view.state.is_final() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, location, Json(JobView::new(&view, base.as_deref()))).into_response())
}

/// The key of a request as an id of ours: no text of a client becomes a name of a file.
fn idempotency_key(headers: &HeaderMap) -> Result<Option<Uuid>, Problem> {
    let Some(key) = headers.get("idempotency-key") else { return Ok(None) };
    let key = key.as_bytes();
    if key.is_empty() || key.len() > MAX_KEY {
        return Err(Problem::bad_header("an Idempotency-Key has 1 to 255 characters"));
    }
    Ok(Some(Uuid::new_v5(&Uuid::NAMESPACE_OID, key)))
}

async fn list_jobs(
    Shared(app): Shared<App>,
    Base(base): Base,
    query: Result<Query<ListQuery>, QueryRejection>,
) -> Result<Json<JobList>, Problem> {
    let Query(ListQuery { state, limit, cursor }) = query?;
    let limit = limit.unwrap_or(PAGE);
    if !(1..=MAX_PAGE).contains(&limit) {
        return Err(Problem::bad_query(format!("limit is 1 to {MAX_PAGE}")));
    }
    let unusable = || Problem::bad_query("cursor is not one that this list gave");
    let cursor = cursor.map(|text| store::parse_id(&text).ok_or_else(unusable)).transpose()?;
    let (page, next) = app.engine.list(state, limit, cursor);
    let jobs = page.iter().map(|view| JobView::new(view, base.as_deref())).collect();
    let filter = state.map_or(String::new(), |state| format!("state={}&", state.as_str()));
    let link = next.map(|next| format!("/jobs?{filter}limit={limit}&cursor={next}"));
    Ok(Json(JobList::new(jobs, next, link)))
}

async fn get_job(
    Shared(app): Shared<App>,
    Base(base): Base,
    JobId(id): JobId,
) -> Result<Json<JobView>, Problem> {
    Ok(Json(JobView::new(&app.engine.get(id).await?, base.as_deref())))
}

async fn cancel_job(
    Shared(app): Shared<App>,
    Base(base): Base,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    let view = app.engine.cancel(id).await?;
    let status = if view.state.is_final() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, Json(JobView::new(&view, base.as_deref()))).into_response())
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

async fn get_live(Shared(app): Shared<App>, JobId(id): JobId) -> Result<Response, Problem> {
    Ok(follow::log(app.engine, id)?)
}

async fn get_events(
    Shared(app): Shared<App>,
    Base(base): Base,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    app.engine.brief(id)?;
    Ok(follow::events(app.engine, id, base))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StretchQuery {
    from_s: Option<f64>,
    samples: Option<usize>,
}

async fn get_attitudes(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    query: Result<Query<StretchQuery>, QueryRejection>,
) -> Result<Json<Stretch>, Problem> {
    let Query(StretchQuery { from_s, samples }) = query?;
    let samples = samples.unwrap_or(STRETCH);
    if !(1..=MAX_STRETCH).contains(&samples) {
        return Err(Problem::bad_query(format!("samples is 1 to {MAX_STRETCH}")));
    }
    let from_s = from_s.unwrap_or(0.0);
    if !(from_s >= 0.0 && from_s.is_finite()) {
        return Err(Problem::bad_query("from_s is a time in seconds, not below 0"));
    }
    let view = app.engine.brief(id)?;
    if view.state.is_final() && !view.has_log {
        return Err(Refusal::NoLog.into());
    }
    let log = app.engine.log_path(id);
    Ok(Json(app.pictures.attitudes(log, view.state.is_final(), from_s, samples).await?))
}

async fn get_chart(
    Shared(app): Shared<App>,
    Path((id, chart)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(Refusal::UnknownJob)?;
    app.pictures.chart(&chart, app.engine.log(id)?).await
}

async fn get_metrics(Shared(app): Shared<App>) -> Response {
    let text = off_thread(move || app.engine.metrics()).await;
    ([(CONTENT_TYPE, metrics::MEDIA_TYPE)], text).into_response()
}

async fn get_job_scenario(Shared(app): Shared<App>, JobId(id): JobId) -> Result<Response, Problem> {
    Ok(json_text(app.engine.scenario(id).await?))
}

async fn submit_study(
    Shared(app): Shared<App>,
    headers: HeaderMap,
    body: Bytes,
) -> Result<Response, Problem> {
    if !is_plain_json(&headers) {
        return Err(Problem::not_json());
    }
    let question = off_thread(move || Question::from_json(&body)).await?;
    let view = app.studies.submit(question)?;
    let location = [(LOCATION, format!("/studies/{}", view.id))];
    Ok((StatusCode::ACCEPTED, location, Json(view)).into_response())
}

async fn get_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<Json<StudyView>, Problem> {
    Ok(Json(app.studies.get(id)?))
}

async fn cancel_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<(StatusCode, Json<StudyView>), Problem> {
    Ok((StatusCode::ACCEPTED, Json(app.studies.cancel(id)?)))
}

async fn forget_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<StatusCode, Problem> {
    app.studies.forget(id)?;
    Ok(StatusCode::NO_CONTENT)
}

async fn get_study_table(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<Response, Problem> {
    let text = app.studies.file(id, "table.csv")?;
    Ok(([(CONTENT_TYPE, "text/csv")], text).into_response())
}

async fn get_study_chart(
    Shared(app): Shared<App>,
    Path((id, name)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(StudyRefusal::Unknown)?;
    if !name.ends_with(".svg") {
        return Err(StudyRefusal::NoFile.into());
    }
    let text = app.studies.file(id, &name)?;
    Ok(([(CONTENT_TYPE, "image/svg+xml")], text).into_response())
}

async fn get_schema() -> Json<Value> {
    Json(schema())
}

async fn list_scenarios() -> Json<ScenarioList> {
    Json(ScenarioList::shipped())
}

async fn get_scenario(Path(name): Path<String>) -> Result<Response, Problem> {
    let name = name.strip_suffix(".json").unwrap_or(&name);
    let shipped = SHIPPED.iter().find(|(shipped, _)| *shipped == name);
    shipped.map(|(_, text)| json_text(*text)).ok_or_else(|| Problem::not_found("scenario"))
}

async fn healthz() -> Json<Status> {
    Json(Status { status: "ok" })
}

async fn readyz(Shared(app): Shared<App>) -> Result<Json<Status>, Problem> {
    if app.engine.is_ready() {
        Ok(Json(Status { status: "ready" }))
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
