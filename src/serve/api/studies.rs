//! Handlers of `/studies`: unpack, one call, pack.

use axum::Json;
use axum::body::{Body, Bytes};
use axum::extract::{Path, State as Shared};
use axum::http::header::{CONTENT_TYPE, LOCATION};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};

use super::App;
use super::request::{StudyId, is_plain_json, json_text, off_thread};
use crate::serve::download;
use crate::serve::problem::Problem;
use crate::serve::store;
use crate::serve::studies::{Question, Studies, StudyList, StudyRefusal, StudyView, TableOf};

pub(super) async fn submit_study(
    Shared(app): Shared<App>,
    headers: HeaderMap,
    body: Bytes,
) -> Result<Response, Problem> {
    if !is_plain_json(&headers) {
        return Err(Problem::not_json());
    }
    let text = body.clone();
    let question = app.submissions.check(move || Question::from_json(&text)).await??;
    let submit = move || Ok::<_, Problem>(app.studies()?.submit(question, &body)?);
    let view = off_thread(submit).await?;
    let location = [(LOCATION, format!("/studies/{}", view.id))];
    Ok((StatusCode::ACCEPTED, location, Json(view)).into_response())
}

pub(super) async fn list_studies(Shared(app): Shared<App>) -> Json<StudyList> {
    Json(app.studies().map_or_else(|_| StudyList::default(), Studies::list))
}

pub(super) async fn get_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<Json<StudyView>, Problem> {
    Ok(Json(app.studies()?.get(id)?))
}

pub(super) async fn cancel_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<(StatusCode, Json<StudyView>), Problem> {
    let view = off_thread(move || Ok::<_, Problem>(app.studies()?.cancel(id)?)).await?;
    Ok((StatusCode::ACCEPTED, Json(view)))
}

pub(super) async fn forget_study(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<StatusCode, Problem> {
    off_thread(move || Ok::<_, Problem>(app.studies()?.forget(id)?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

pub(super) async fn get_study_table(
    Shared(app): Shared<App>,
    StudyId(id): StudyId,
) -> Result<Response, Problem> {
    let table = off_thread(move || Ok::<_, Problem>(app.studies()?.table(id)?)).await?;
    let content = match table {
        TableOf::Text(text) => Body::from(text),
        TableOf::File { path, finished } => download::table(path, finished).await?,
    };
    Ok(([(CONTENT_TYPE, "text/csv")], content).into_response())
}

pub(super) async fn get_member(
    Shared(app): Shared<App>,
    Path((id, member)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(StudyRefusal::Unknown)?;
    let member = member.strip_suffix(".json").and_then(|number| number.parse().ok());
    let member = member.ok_or(StudyRefusal::NoFile)?;
    let member = move || Ok::<_, Problem>(app.studies()?.member(id, member)?);
    Ok(json_text(off_thread(member).await?))
}

pub(super) async fn get_study_chart(
    Shared(app): Shared<App>,
    Path((id, name)): Path<(String, String)>,
) -> Result<Response, Problem> {
    let id = store::parse_id(&id).ok_or(StudyRefusal::Unknown)?;
    if !name.ends_with(".svg") {
        return Err(StudyRefusal::NoFile.into());
    }
    let text = off_thread(move || Ok::<_, Problem>(app.studies()?.file(id, &name)?)).await?;
    Ok(([(CONTENT_TYPE, "image/svg+xml")], text).into_response())
}
