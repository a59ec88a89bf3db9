//! The routes. A handler unpacks, makes one call, packs.
//!
//! Invariant: what a client sends reaches the inside as a checked type (`JobId`, `Scenario`, `ListQuery`) or
//! not at all; and every route is in the list that also makes the API's description.

use std::net::SocketAddr;
use std::time::Duration;

use axum::extract::{Path, Request, State as Shared};
use axum::http::header::{CONTENT_TYPE, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, delete, get, post};
use axum::{Json, Router};
use serde_json::{Value, json};
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::classify::ServerErrorsFailureClass;
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::set_header::SetResponseHeaderLayer;
use tower_http::trace::TraceLayer;
use uuid::Uuid;

use super::config::{Cors, Scope};
use super::engine::{Engine, Refusal};
use super::gate::{self, Gate};
use super::job::State;
use super::link::LinkKey;
use super::openapi::{self, Operation};
use super::page::{self, Pictures};
use super::problem::{self, Problem};
use super::studies::{Body as StudyRequest, Studies, StudyList, StudyView};
use super::submission::SubmissionSlots;
use super::view::{JobEvent, JobList, JobView, ScenarioList, Status};
use super::{ServeConfig, download, metrics};
use crate::log::members::{MemberOrder, MemberQuantity, Members};
use crate::log::samples::{Curve, Samples};
use crate::log::stretch::Stretch;
use crate::scenario::{SHIPPED, Scenario, schema};

mod jobs;
mod request;
mod studies;

use request::json_text;

const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// State of the handlers.
#[derive(Clone, Debug)]
pub(super) struct App {
    engine: Engine,
    /// `None` where jobs go to other machines.
    studies: Option<Studies>,
    pictures: Pictures,
    public_url: Option<String>,
    /// Address on which viewers follow while a job runs.
    live: Option<SocketAddr>,
    /// Key that signs links, where there are tokens.
    links: Option<LinkKey>,
    /// Slots in which submissions are checked.
    submissions: SubmissionSlots,
}

impl App {
    pub(super) fn new(
        engine: Engine,
        studies: Option<Studies>,
        submissions: SubmissionSlots,
        config: &ServeConfig,
        links: Option<LinkKey>,
    ) -> Self {
        let public_url = config.public_url.as_ref().map(|url| url.trim_end_matches('/').to_owned());
        let pictures = Pictures::new();
        Self { engine, studies, pictures, public_url, live: None, links, submissions }
    }

    fn studies(&self) -> Result<&Studies, Refusal> {
        self.studies.as_ref().ok_or(Refusal::NoStudies)
    }

    pub(super) fn with_live(self, address: SocketAddr) -> Self {
        Self { live: Some(address), ..self }
    }
}

/// A route: its path, its description, its scope, its handler.
struct Route {
    method: Method,
    path: &'static str,
    /// Scope that is needed; `None` if none is.
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

/// Returns all routes but that of their description.
fn routes() -> Vec<Route> {
    use Scope::{Admin, Read, Submit};
    let op = Operation::new;
    vec![
        Route::new(
            "/jobs",
            Submit,
            op("submitJob", "Submit a job; it is on the disk before the answer is sent")
                .header::<jobs::Key>(
                    "Idempotency-Key",
                    "The same key with the same scenario gives the same job, also after a restart",
                )
                .body::<Scenario>(example)
                .json::<JobView>(202, "Accepted")
                .json::<JobView>(200, "Accepted before under this key, and ended"),
            post(jobs::submit_job),
        )
        .method(Method::POST),
        Route::new(
            "/jobs",
            Read,
            op("listJobs", "Jobs, newest first")
                .query::<State>("state", "Only those in this state")
                .query::<jobs::Name>("name", "Only those with this text in their names; case is ignored")
                .query::<jobs::Limit>("limit", "How many at most; 50 if absent")
                .query::<Uuid>("cursor", "`next_cursor` of the previous page")
                .json::<JobList>(200, "A page"),
            get(jobs::list_jobs),
        ),
        Route::new(
            "/jobs/{id}",
            Read,
            op("getJob", "State, progress, plan, summary or diagnosis, links")
                .json::<JobView>(200, "The job"),
            get(jobs::get_job),
        ),
        Route::new(
            "/jobs/{id}",
            Admin,
            op("forgetJob", "Forget a job that does not run, and its log").empty(204, "Forgotten"),
            delete(jobs::forget_job),
        )
        .method(Method::DELETE),
        Route::new(
            "/jobs/{id}/cancel",
            Submit,
            op("cancelJob", "Stop a job; what it logged becomes a finished log")
                .json::<JobView>(202, "It ends at its next step")
                .json::<JobView>(200, "It has ended"),
            post(jobs::cancel_job),
        )
        .method(Method::POST),
        Route::new(
            "/jobs/{id}/scenario.json",
            Read,
            op("getJobScenario", "The scenario as accepted").json::<Scenario>(200, "The scenario"),
            get(jobs::get_job_scenario),
        ),
        Route::new(
            "/jobs/{id}/sent.json",
            Read,
            op("getJobSent", "The scenario as it was sent; as accepted if that text is not kept")
                .json::<Scenario>(200, "The scenario"),
            get(jobs::get_job_sent),
        ),
        Route::new(
            "/jobs/{id}/events",
            Read,
            op(
                "followJob",
                "Server-sent events: state (the job), progress; until the job has ended",
            )
            .answer::<JobEvent>(200, "text/event-stream", "Events"),
            get(jobs::get_events),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/log.mcap",
            Read,
            op("getLog", "The finished log; single ranges, ETag")
                .raw(200, "application/octet-stream", "The whole log")
                .raw(206, "application/octet-stream", "A range of it")
                .empty(304, "Not changed"),
            get(jobs::get_log),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/live.mcap",
            Read,
            op("followLog", "The log while it is written, chunk by chunk, to its end").raw(
                200,
                "application/octet-stream",
                "The bytes of the finished log",
            ),
            get(jobs::get_live),
        )
        .shared(),
        Route::new(
            "/manifest",
            Read,
            op("getManifest", "The finished log of a job for Foxglove's remote data loader")
                .query::<Uuid>("job", "The id of the job")
                .required()
                .json::<Value>(200, "Where the log is read"),
            get(jobs::get_manifest),
        ),
        Route::new(
            "/studies",
            Submit,
            op("submitStudy", "Submit a study: many runs of one scene, one table")
                .body::<StudyRequest>(|| json!({ "kind": "precision", "scenario": example(), "until_s": 0.5 }))
                .json::<StudyView>(202, "Accepted; it is on the disk"),
            post(studies::submit_study),
        )
        .method(Method::POST),
        Route::new(
            "/studies",
            Read,
            op(
                "listStudies",
                "Studies, newest first; the oldest ended ones beyond 64 are forgotten",
            )
            .json::<StudyList>(200, "All of them, without their tables"),
            get(studies::list_studies),
        ),
        Route::new(
            "/studies/{id}",
            Read,
            op("getStudy", "State, progress, table, links").json::<StudyView>(200, "The study"),
            get(studies::get_study),
        ),
        Route::new(
            "/studies/{id}",
            Admin,
            op("forgetStudy", "Forget a study that does not run").empty(204, "Forgotten"),
            delete(studies::forget_study),
        )
        .method(Method::DELETE),
        Route::new(
            "/studies/{id}/cancel",
            Submit,
            op("cancelStudy", "Stop a study").json::<StudyView>(202, "It ends within a step"),
            post(studies::cancel_study),
        )
        .method(Method::POST),
        Route::new(
            "/studies/{id}/table.csv",
            Read,
            op("getStudyTable", "The table of a study; for a sweep that is running, the rows so far").raw(
                200,
                "text/csv",
                "One row a run",
            ),
            get(studies::get_study_table),
        )
        .shared(),
        Route::new(
            "/studies/{id}/members/{member}",
            Read,
            op("getMember", "The scenario of a member of a sweep; `0.json` is that of the first")
                .json::<Scenario>(200, "The scenario"),
            get(studies::get_member),
        )
        .shared(),
        Route::new(
            "/studies/{id}/charts/{name}",
            Read,
            op("getStudyChart", "A chart of a study").raw(200, "image/svg+xml", "The chart"),
            get(studies::get_study_chart),
        )
        .shared(),
        Route::new(
            "/jobs/{id}/attitudes.json",
            Read,
            op("getAttitudes", "Attitudes one after another, of several bodies also their places, and the shapes of the scene")
                .query::<jobs::Time>(
                    "from_s",
                    "Time of the first one in seconds; 0 if absent; while the job runs always 0",
                )
                .query::<jobs::Time>("every_s", "The shortest time between two in seconds; 0 if absent")
                .query::<jobs::Samples>(
                    "samples",
                    "How many times at most; 300 if absent; of many bodies fewer, so that there are at most 8000 attitudes",
                )
                .json::<Stretch>(200, "Attitudes"),
            get(jobs::get_attitudes),
        ),
        Route::new(
            "/jobs/{id}/samples",
            Read,
            op("getSamples", "A quantity over time in few points that keep its extremes, also while the job runs")
                .query::<Curve>("channel", "The quantity; energy_error if absent")
                .query::<jobs::Points>("points", "How many at most; 500 if absent")
                .query::<jobs::Time>("from_s", "Beginning in seconds; 0 if absent")
                .query::<jobs::Time>("to_s", "End in seconds; that of the log if absent")
                .json::<Samples>(200, "The smallest and the largest value behind each point"),
            get(jobs::get_samples),
        ),
        Route::new(
            "/jobs/{id}/members",
            Read,
            op("getMembers", "A quantity of all members of an ensemble over time, and those that stand out; also while it runs")
                .query::<MemberQuantity>("channel", "The quantity; distance if absent")
                .query::<jobs::Axis>("axis", "The axis for axis_angle; 1 if absent")
                .query::<MemberOrder>("order", "The order of the rows; largest if absent")
                .query::<jobs::Offset>("offset", "Rows that are skipped; 0 if absent")
                .query::<jobs::Rows>("limit", "Rows at most; 20 if absent")
                .json::<Members>(200, "Quantiles over time, and rows of members"),
            get(jobs::get_members),
        ),
        Route::new(
            "/jobs/{id}/members/{member}",
            Read,
            op("getJobMember", "The scenario of one member of an ensemble as a separate run; `0.json` is that of the first")
                .json::<Scenario>(200, "The scenario"),
            get(jobs::get_job_member),
        ),
        Route::new(
            "/jobs/{id}/charts/{chart}",
            Read,
            op(
                "getChart",
                "`energy.svg`, `orthogonality.svg`, `momentum.svg`, `pace.svg` (of steps that adapt), `pointing.svg` (of scenes with `pointing`) or `spread.svg` (of ensembles and covariances), drawn from the log",
            )
            .raw(200, "image/svg+xml", "The chart"),
            get(jobs::get_chart),
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
            op("getMetrics", "Metrics for Prometheus").raw(
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
            op("isReady", "Readiness").json::<Status>(200, "Ready for jobs"),
            get(readyz),
        )
        .open(),
        Route::new(
            "/",
            Read,
            op("readPage", "The web page").raw(200, "text/html; charset=utf-8", "A page"),
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
            get(page::docs),
        )
        .open(),
    ]
}

/// Returns a scenario, as the list of them shows it.
fn example() -> Value {
    let dipole = SHIPPED.iter().find(|(name, _)| *name == "dipole");
    dipole.and_then(|(_, text)| serde_json::from_str(text).ok()).unwrap_or_default()
}

/// Returns all routes of the service.
pub(super) fn router(app: App, gate: Gate, cors: &Cors) -> Router {
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
    let all = own
        .merge(download::share(shared, cors))
        .route("/openapi.json", get(async move || Json(description)))
        .layer(from_fn(gate::whole_body));
    guarded(all, gate).with_state(app)
}

/// Adds the layers that every request passes, whichever listener it comes by.
pub(super) fn guarded<S: Clone + Send + Sync + 'static>(
    router: Router<S>,
    gate: Gate,
) -> Router<S> {
    router
        .layer(from_fn_with_state(gate, gate::admit))
        .layer(map_response(problem::fill))
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(SetResponseHeaderLayer::overriding(
            X_CONTENT_TYPE_OPTIONS,
            HeaderValue::from_static("nosniff"),
        ))
        .layer(PropagateRequestIdLayer::new(REQUEST_ID))
        .layer(TraceLayer::new_for_http().make_span_with(span).on_failure(report))
        .layer(SetRequestIdLayer::new(REQUEST_ID, MakeRequestUuid))
}

/// Returns a request for the service's own log: without its query, which may hold a signature.
fn span(request: &Request) -> tracing::Span {
    let id = request.headers().get(REQUEST_ID).and_then(|id| id.to_str().ok()).unwrap_or_default();
    let (method, path) = (request.method(), request.uri().path());
    tracing::info_span!("request", id, %method, path)
}

/// Reports an answer of a status above 499, or one that broke off, in the service's own log. Only
/// those that are a fault are errors there: a service that is full says so to every client that asks.
fn report(failure: ServerErrorsFailureClass, latency: Duration, _: &tracing::Span) {
    match failure {
        ServerErrorsFailureClass::StatusCode(status)
            if status != StatusCode::INTERNAL_SERVER_ERROR =>
        {
            tracing::debug!(%status, ?latency, "request refused");
        }
        failure => tracing::error!(%failure, ?latency, "response failed"),
    }
}

async fn get_metrics(Shared(app): Shared<App>) -> Result<Response, Problem> {
    let text = app.engine.metrics().await?;
    Ok(([(CONTENT_TYPE, metrics::MEDIA_TYPE)], text).into_response())
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
    shipped
        .map(|(_, text)| json_text(*text))
        .ok_or_else(|| Problem::not_found("scenario of this name"))
}

async fn healthz() -> Json<Status> {
    Json(Status { status: "ok" })
}

async fn readyz(Shared(app): Shared<App>) -> Result<Json<Status>, Problem> {
    app.engine.check()?;
    Ok(Json(Status { status: "ready" }))
}
