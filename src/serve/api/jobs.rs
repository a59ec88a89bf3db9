//! Handlers of `/jobs`: unpack, one call, pack.

use std::path::PathBuf;

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, Query, Request, State as Shared};
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use foxglove::remote_data_loader_backend::Manifest;
use schemars::JsonSchema;
use serde::Deserialize;
use uuid::Uuid;

use super::App;
use super::request::{JobId, is_plain_json, json_text, named, off_thread, within};
use crate::advise::Settled;
use crate::log::members::{self, MemberOrder, MemberQuantity, Members};
use crate::log::part_path;
use crate::log::samples::{Curve, Samples as CourseOf, Window};
use crate::log::stretch::{Stretch, Wanted};
use crate::scenario::{Inertia, Scenario, ScenarioError};
#[cfg(feature = "cluster")]
use crate::serve::engine::Engine;
use crate::serve::engine::Refusal;
use crate::serve::job::State;
use crate::serve::page::{
    MAX_MEMBERS, MAX_POINTS, MAX_STRETCH, MEMBERS, POINTS, STRETCH, angular_velocity,
};
use crate::serve::problem::Problem;
use crate::serve::view::{self, JobList, JobView, Reach, percent_encoded};
use crate::serve::{download, follow, store};
use crate::study::{Watch, scene_of};

/// Number of jobs on a page of the list, unless the client says otherwise, and at most.
const PAGE: usize = 50;
const MAX_PAGE: usize = 500;

/// Longest part of a name to look for, characters: no name is longer.
const MAX_NAME: usize = 200;

/// Description of the times that a query may hold.
const A_TIME: &str = "a time in seconds, 0 or more, is allowed";

/// Longest idempotency key, bytes.
const MAX_KEY: usize = 255;

/// A size of a page.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "PageSize")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Limit(#[schemars(range(min = 1, max = 500))] usize);

/// A part of a name.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "NamePart")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Name(#[schemars(length(max = 200))] String);

/// A number of points.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "PointCount")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Points(#[schemars(range(min = 2, max = 5000))] usize);

/// A number of members.
#[derive(JsonSchema)]
#[schemars(transparent)]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Rows(#[schemars(range(min = 1, max = 200))] usize);

/// A number of rows that are left out.
#[derive(JsonSchema)]
#[schemars(transparent)]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Offset(#[schemars(range(max = 100_000))] usize);

/// The number of an axis.
#[derive(JsonSchema)]
#[schemars(transparent)]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Axis(#[schemars(range(min = 1, max = 16))] usize);

/// A time in seconds.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "Seconds")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Time(#[schemars(range(min = 0.0))] f64);

/// An idempotency key.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "IdempotencyKey")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Key(#[schemars(length(min = 1, max = 255))] String);

/// A number of attitudes.
#[derive(JsonSchema)]
#[schemars(transparent, rename = "AttitudeCount")]
#[allow(dead_code, reason = "only its schema is used")]
pub(super) struct Samples(#[schemars(range(min = 1, max = 2000))] usize);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery {
    state: Option<State>,
    name: Option<String>,
    limit: Option<String>,
    cursor: Option<String>,
}

pub(super) async fn submit_job(
    Shared(app): Shared<App>,
    reach: Reach,
    headers: HeaderMap,
    body: Bytes,
) -> Result<Response, Problem> {
    if !is_plain_json(&headers) {
        return Err(Problem::not_json());
    }
    let key = idempotency_key(&headers)?;
    let sent = body.to_vec();
    let checked = move || {
        let scenario = Scenario::from_json(&body)?;
        let planned = match scenario.accuracy {
            None => {
                let settled = Settled::new(&scenario, &Watch::default())?;
                let plan = settled.plan()?;
                Some((settled, plan))
            }
            // A worker settles it; that there is a scene to settle it for is checked here.
            Some(_) => {
                scene_of(&scenario)?;
                None
            }
        };
        Ok::<_, ScenarioError>((scenario, planned))
    };
    let (scenario, planned) = app.submissions.check(checked).await??;
    let view = app.engine.submit(scenario, planned, key, sent).await?;
    let location = [(LOCATION, format!("/jobs/{}", view.id))];
    let status = if view.state.is_final() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, location, Json(JobView::new(view, &reach))).into_response())
}

/// Returns the key of a request as an id of ours: no text of a client becomes a name of a file.
fn idempotency_key(headers: &HeaderMap) -> Result<Option<Uuid>, Problem> {
    let Some(key) = headers.get("idempotency-key") else { return Ok(None) };
    let key = key.as_bytes();
    if key.is_empty() || key.len() > MAX_KEY {
        return Err(Problem::bad_header("an Idempotency-Key has 1 to 255 characters"));
    }
    Ok(Some(Uuid::new_v5(&Uuid::NAMESPACE_OID, key)))
}

/// Returns the problem of a field of a query.
fn bad(field: &'static str) -> impl Fn(String) -> Problem {
    move |message| Problem::bad_query(format!("{field}: {message}"))
}

pub(super) async fn list_jobs(
    Shared(app): Shared<App>,
    reach: Reach,
    query: Result<Query<ListQuery>, QueryRejection>,
) -> Result<Json<JobList>, Problem> {
    let Query(ListQuery { state, name, limit, cursor }) = query?;
    let wanted = format!("1 to {MAX_PAGE} are allowed");
    let limit = within(limit, PAGE, 1..=MAX_PAGE, wanted).map_err(bad("limit"))?;
    if name.as_ref().is_some_and(|name| name.chars().count() > MAX_NAME) {
        return Err(Problem::bad_query(format!("name has at most {MAX_NAME} characters")));
    }
    let unusable = |text| format!("{text:?} given, a `next_cursor` of this list is needed");
    let cursor = cursor.map(|text| store::parse_id(&text).ok_or_else(|| unusable(text)));
    let cursor = cursor.transpose().map_err(bad("cursor"))?;
    let (page, next) = app.engine.list(state, name.as_deref(), limit, cursor).await?;
    let jobs = page.into_iter().map(|view| JobView::new(view, &reach)).collect();
    let mut filter = state.map_or(String::new(), |state| format!("state={}&", state.as_str()));
    if let Some(name) = name {
        filter += &format!("name={}&", percent_encoded(&name));
    }
    let link = next.map(|next| format!("/jobs?{filter}limit={limit}&cursor={next}"));
    Ok(Json(JobList::new(jobs, next, link)))
}

pub(super) async fn get_job(
    Shared(app): Shared<App>,
    reach: Reach,
    JobId(id): JobId,
) -> Result<Json<JobView>, Problem> {
    Ok(Json(JobView::new(app.engine.get(id).await?, &reach)))
}

pub(super) async fn cancel_job(
    Shared(app): Shared<App>,
    reach: Reach,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    let view = app.engine.cancel(id).await?;
    let status = if view.state.is_final() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, Json(JobView::new(view, &reach))).into_response())
}

pub(super) async fn forget_job(
    Shared(app): Shared<App>,
    JobId(id): JobId,
) -> Result<StatusCode, Problem> {
    app.engine.forget(id).await?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn get_log(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    request: Request,
) -> Result<Response, Problem> {
    #[cfg(feature = "cluster")]
    if let Engine::Cluster(cluster) = &app.engine {
        return download::from_bucket(id, cluster.served(id).await?, request).await;
    }
    download::log(id, app.engine.log(id).await?, request).await
}

#[derive(Deserialize)]
pub(super) struct ManifestQuery {
    job: String,
}

/// Fields that it does not know it leaves to the loader.
pub(super) async fn get_manifest(
    Shared(app): Shared<App>,
    reach: Reach,
    query: Result<Query<ManifestQuery>, QueryRejection>,
) -> Result<Json<Manifest>, Problem> {
    let Query(ManifestQuery { job }) = query?;
    let id = store::parse_id(&job).ok_or(Refusal::UnknownJob)?;
    // Refused as the log itself is.
    app.engine.log(id).await?;
    Ok(Json(view::manifest(app.engine.get(id).await?, &reach)))
}

pub(super) async fn get_live(
    Shared(app): Shared<App>,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    Ok(follow::log(app.engine, id).await?)
}

pub(super) async fn get_events(
    Shared(app): Shared<App>,
    reach: Reach,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    app.engine.brief(id).await?;
    Ok(follow::events(app.engine, id, reach))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StretchQuery {
    from_s: Option<String>,
    every_s: Option<String>,
    samples: Option<String>,
}

pub(super) async fn get_attitudes(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    query: Result<Query<StretchQuery>, QueryRejection>,
) -> Result<Json<Stretch>, Problem> {
    let Query(StretchQuery { from_s, every_s, samples }) = query?;
    let wanted = format!("1 to {MAX_STRETCH} are allowed");
    let samples = within(samples, STRETCH, 1..=MAX_STRETCH, wanted).map_err(bad("samples"))?;
    let from_s = within(from_s, 0.0, 0.0..=f64::MAX, A_TIME).map_err(bad("from_s"))?;
    let every_s = within(every_s, 0.0, 0.0..=f64::MAX, A_TIME).map_err(bad("every_s"))?;
    let view = app.engine.brief(id).await?;
    let log = match view.state.is_final() {
        true => app.engine.log(id).await?,
        false => app.engine.log_so_far(&view).await?,
    };
    let wanted = Wanted { from_s, every_s, samples };
    let mut stretch = app.pictures.attitudes(log, view.state.is_final(), wanted).await?;
    if let Some(inertia) = inertia(&app, id).await {
        let momenta = stretch.body_momentum.iter();
        stretch.angular_velocity = momenta.map(|m| angular_velocity(&inertia, m)).collect();
    }
    Ok(Json(stretch))
}

/// Returns the inertia of the body of a job; `None` if there are several, or this build does not take its scenario.
async fn inertia(app: &App, id: Uuid) -> Option<Inertia> {
    accepted(app, id).await.and_then(|scenario| scenario.scene.inertia)
}

async fn accepted(app: &App, id: Uuid) -> Option<Scenario> {
    let text = app.engine.scenario(id).await.ok()?;
    off_thread(move || Scenario::from_json(&text).ok()).await
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SamplesQuery {
    channel: Option<String>,
    points: Option<String>,
    from_s: Option<String>,
    to_s: Option<String>,
}

/// Returns the problem of a field of a query, with its pointer.
fn invalid(pointer: &'static str) -> impl Fn(String) -> Problem {
    move |message| ScenarioError::invalid(pointer, message).into()
}

pub(super) async fn get_samples(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    query: Result<Query<SamplesQuery>, QueryRejection>,
) -> Result<Json<CourseOf>, Problem> {
    let Query(SamplesQuery { channel, points, from_s, to_s }) = query?;
    let curve = named(channel, Curve::EnergyError, Curve::ALL, Curve::name);
    let curve = curve.map_err(invalid("/channel"))?;
    let wanted = format!("2 to {MAX_POINTS} are allowed");
    let points = within(points, POINTS, 2..=MAX_POINTS, wanted).map_err(invalid("/points"))?;
    let from_s = within(from_s, 0.0, 0.0..=f64::MAX, A_TIME).map_err(invalid("/from_s"))?;
    let wanted = format!("a time of from_s ({from_s} s) or later is allowed");
    let to_s = within(to_s, f64::MAX, from_s..=f64::MAX, wanted).map_err(invalid("/to_s"))?;
    let (log, eta_s) = readable(&app, id).await?;
    let inertia = match curve {
        Curve::AngularVelocity => inertia(&app, id).await,
        _ => None,
    };
    let window = Window { from_s, to_s, points };
    match app.pictures.samples(log, curve, window, inertia).await? {
        Some(samples) if eta_s.is_none() && samples.time_s.is_empty() && from_s == 0.0 => {
            Err(Problem::not_found("sample of this channel in the log"))
        }
        Some(samples) => Ok(Json(samples)),
        // The job waits, or has ended at this moment.
        None => Err(Refusal::LogUnfinished { eta_s: eta_s.flatten() }.into()),
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MembersQuery {
    channel: Option<String>,
    axis: Option<String>,
    order: Option<String>,
    offset: Option<String>,
    limit: Option<String>,
}

pub(super) async fn get_members(
    Shared(app): Shared<App>,
    JobId(id): JobId,
    query: Result<Query<MembersQuery>, QueryRejection>,
) -> Result<Json<Members>, Problem> {
    let Query(MembersQuery { channel, axis, order, offset, limit }) = query?;
    let all = MemberQuantity::ALL;
    let quantity = named(channel, MemberQuantity::Distance, all, MemberQuantity::name);
    let quantity = quantity.map_err(invalid("/channel"))?;
    let most = accepted(&app, id).await.map_or(1, |scenario| scenario.dimension());
    let wanted = format!("the axes are numbered from 1 to {most}");
    let axis = within(axis, 1, 1..=most, wanted).map_err(invalid("/axis"))?;
    let order = named(order, MemberOrder::Largest, MemberOrder::ALL, MemberOrder::name);
    let order = order.map_err(invalid("/order"))?;
    let wanted = "a whole number, 0 or more, is allowed";
    let offset = within(offset, 0, 0..=usize::MAX, wanted).map_err(invalid("/offset"))?;
    let wanted = format!("1 to {MAX_MEMBERS} are allowed");
    let limit = within(limit, MEMBERS, 1..=MAX_MEMBERS, wanted).map_err(invalid("/limit"))?;
    let (path, eta_s) = readable(&app, id).await?;
    let wanted = members::Wanted { quantity, axis: axis - 1, order, offset, limit };
    match app.pictures.members(path, wanted).await? {
        Some(found) if found.time_s.is_empty() && eta_s.is_none() => {
            Err(Problem::not_found("member with this channel in the log"))
        }
        Some(found) => Ok(Json(found)),
        None => Err(Refusal::LogUnfinished { eta_s: eta_s.flatten() }.into()),
    }
}

pub(super) async fn get_job_member(
    Shared(app): Shared<App>,
    Path((id, member)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(Refusal::UnknownJob)?;
    let number = member.strip_suffix(".json").and_then(|number| number.parse().ok());
    let unknown = || Problem::not_found("ended member with this number");
    let number: u64 = number.ok_or_else(unknown)?;
    let (path, _) = readable(&app, id).await?;
    let member = app.pictures.member(path, number).await?.ok_or_else(unknown)?;
    let scenario = app.engine.settled(id).await?.ok_or_else(unknown)?;
    Ok(json_text(scenario.member(&member).ok_or_else(unknown)?.to_json()))
}

/// Returns the log of a job as far as it is on the disk and, for one that has not ended, the time
/// that is left.
async fn readable(app: &App, id: Uuid) -> Result<(PathBuf, Option<Option<f64>>), Problem> {
    let view = app.engine.brief(id).await?;
    Ok(match view.state.is_final() {
        true => (app.engine.log(id).await?, None),
        false => (part_path(&app.engine.log_so_far(&view).await?), Some(view.eta_s)),
    })
}

pub(super) async fn get_chart(
    Shared(app): Shared<App>,
    Path((id, chart)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(Refusal::UnknownJob)?;
    app.pictures.chart(&chart, app.engine.log(id).await?).await
}

pub(super) async fn get_job_scenario(
    Shared(app): Shared<App>,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    Ok(json_text(app.engine.scenario(id).await?))
}

pub(super) async fn get_job_sent(
    Shared(app): Shared<App>,
    JobId(id): JobId,
) -> Result<Response, Problem> {
    Ok(json_text(app.engine.sent(id).await?))
}
