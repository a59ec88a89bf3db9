//! Following a job: its events, and its log while that grows.
//!
//! Invariant: what is streamed of a log is what its finished file holds at that place; a stream that cannot
//! keep this breaks off and does not end as if it were whole.

use std::convert::Infallible;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::{Stream, stream};
use uuid::Uuid;

use super::download;
use super::engine::{Engine, Refusal};
use super::job::View;
use super::view::{JobView, Progress, Reach};

/// Interval at which a job is looked at.
const LOOK: Duration = Duration::from_millis(100);

/// Bytes read of a log at once.
const PIECE: usize = 256 << 10;

/// State of a job that was sent last.
#[derive(Default)]
struct Sent {
    state: Option<super::job::State>,
    progress: Option<Progress>,
    over: bool,
}

/// Returns the events `state`, with the whole job, and `progress` until the job has ended; at most
/// one a [`LOOK`].
pub(super) fn events(engine: Engine, id: Uuid, reach: Reach) -> Response {
    let events = stream::unfold(Sent::default(), move |mut sent| {
        let (engine, reach) = (engine.clone(), reach.clone());
        async move {
            while !sent.over {
                // Before each look but the first: a job that makes steps has something new at every one.
                if sent.state.is_some() {
                    tokio::time::sleep(LOOK).await;
                }
                // The job was forgotten, or the service stops: nothing more will come.
                let view = engine.brief(id).await.ok().filter(|_| engine.check().is_ok())?;
                if sent.state != Some(view.state) {
                    let view = engine.get(id).await.ok()?;
                    sent.state = Some(view.state);
                    sent.over = view.state.is_final();
                    let event = Event::default().event("state");
                    let job = JobView::new(view, &reach);
                    return Some((Ok::<_, Infallible>(event.json_data(job).ok()?), sent));
                }
                let progress = Progress::of(&view);
                if sent.progress.as_ref() != Some(&progress) {
                    let event = Event::default().event("progress").json_data(&progress).ok()?;
                    sent.progress = Some(progress);
                    return Some((Ok(event), sent));
                }
            }
            None
        }
    });
    Sse::new(events).keep_alive(KeepAlive::default()).into_response()
}

/// Returns the log of a job from its first byte, as its chunks are closed, up to its last one.
pub(super) async fn log(engine: Engine, id: Uuid) -> Result<Response, Refusal> {
    if engine.brief(id).await?.state.is_final() {
        engine.log(id).await?;
    }
    Ok(download::as_log(
        id,
        Body::from_stream(pieces(Reading { engine, id, file: None, offset: 0 })),
    ))
}

struct Reading {
    engine: Engine,
    id: Uuid,
    file: Option<File>,
    offset: u64,
}

fn pieces(reading: Reading) -> impl Stream<Item = io::Result<Bytes>> {
    stream::try_unfold(reading, |mut reading| async move {
        loop {
            // The state is read first: a log that ended before is whole when it is read.
            let view = reading.engine.brief(reading.id).await.map_err(io::Error::other)?;
            let path = reading.engine.log_so_far(&view).await.map_err(io::Error::other)?;
            let (back, piece) = tokio::task::spawn_blocking(move || {
                let piece = reading.read(&view, &path);
                (reading, piece)
            })
            .await
            .map_err(io::Error::other)?;
            reading = back;
            match piece? {
                Piece::Some(bytes) => return Ok(Some((bytes, reading))),
                Piece::Last => return Ok(None),
                Piece::NotYet if reading.engine.check().is_ok() => tokio::time::sleep(LOOK).await,
                Piece::NotYet => return Err(io::Error::other("the service stops")),
            }
        }
    })
}

enum Piece {
    Some(Bytes),
    NotYet,
    Last,
}

impl Reading {
    /// Returns the next bytes of the file. Blocking.
    fn read(&mut self, view: &View, path: &Path) -> io::Result<Piece> {
        if self.file.is_none() {
            self.file = match view.state.is_final() {
                true => Some(open(path)?),
                // Once the run makes steps, the part that an interrupted run left of the log no
                // longer changes.
                false if view.steps_done > 0 => open(&crate::log::part_path(path)).ok(),
                false => None,
            };
        }
        let Some(file) = &mut self.file else { return Ok(Piece::NotYet) };
        let mut bytes = vec![0; PIECE];
        let length = file.read(&mut bytes)?;
        if length > 0 {
            bytes.truncate(length);
            self.offset += length as u64;
            return Ok(Piece::Some(bytes.into()));
        }
        if file.metadata()?.len() < self.offset {
            return Err(io::Error::other("the log was begun anew"));
        }
        match (view.state.is_final(), view.has_log) {
            (true, true) => Ok(Piece::Last),
            (true, false) => Err(io::Error::other("the job ended without a log")),
            (false, _) => Ok(Piece::NotYet),
        }
    }
}

/// Opens a regular file: a link planted in the data directory must not lead out of it.
fn open(path: &Path) -> io::Result<File> {
    if path.symlink_metadata()?.is_file() {
        File::open(path)
    } else {
        Err(io::Error::from(io::ErrorKind::NotFound))
    }
}
