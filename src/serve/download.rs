//! The finished log over HTTP, as viewers read it: whole, or by single ranges (several are answered with the whole); with
//! a strong ETag; readable by pages of other origins.
//!
//! Invariant: a range is answered only out of the file that the client began with. The bytes are
//! never compressed: viewers rely on their length and positions.

use std::fs::{File, Metadata};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use axum::Router;
use axum::body::{Body, Bytes};
use axum::extract::Request;
use axum::http::header::{
    ACCEPT_RANGES, AUTHORIZATION, CONTENT_DISPOSITION, CONTENT_LENGTH, CONTENT_RANGE, CONTENT_TYPE,
    ETAG, HeaderName, IF_MATCH, IF_NONE_MATCH, IF_RANGE, LAST_MODIFIED, RANGE,
};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use tower_http::cors::{AllowOrigin, CorsLayer};
use tower_http::services::ServeFile;
#[cfg(feature = "cluster")]
use tower_http::services::{ServeDir, fs::DefaultServeDirFallback};
use tower_http::set_header::SetResponseHeaderLayer;
use uuid::Uuid;

use super::config::Cors;
use super::problem::Problem;

/// Bytes of a table that are sent at once.
const PIECE: usize = 64 << 10;

const CROSS_ORIGIN_RESOURCE_POLICY: HeaderName =
    HeaderName::from_static("cross-origin-resource-policy");

/// Answers one request for the log at `path`.
pub(super) async fn log(id: Uuid, path: PathBuf, request: Request) -> Result<Response, Problem> {
    let file = path.clone();
    let metadata = tokio::task::spawn_blocking(move || dated(&file)).await;
    match metadata.map_err(std::io::Error::other).flatten() {
        // A link planted in the data directory must not lead out of it.
        Ok(metadata) if metadata.is_file() => {}
        Ok(_) => return Err(Problem::not_found("log at this address")),
        Err(error) => return Err(Problem::unreadable(&error)),
    }
    ranged(id, Source::File(ServeFile::new(path)), request).await
}

/// Answers one request for a log in a bucket.
#[cfg(feature = "cluster")]
pub(super) async fn from_bucket(
    id: Uuid,
    log: super::engine::cluster::Served,
    mut request: Request,
) -> Result<Response, Problem> {
    // The one path that it serves.
    *request.uri_mut() = axum::http::Uri::from_static("/log.mcap");
    let service = ServeDir::with_backend("", log).append_index_html_on_directories(false);
    ranged(id, Source::Bucket(service), request).await
}

/// Handler of ranges and ETags.
enum Source {
    File(ServeFile),
    #[cfg(feature = "cluster")]
    Bucket(ServeDir<DefaultServeDirFallback, super::engine::cluster::Served>),
}

impl Source {
    async fn answer(&mut self, request: Request) -> Result<Response, Problem> {
        let answer = match self {
            Self::File(file) => file.try_call(request).await.map(IntoResponse::into_response),
            #[cfg(feature = "cluster")]
            Self::Bucket(log) => log.try_call(request).await.map(IntoResponse::into_response),
        };
        answer.map_err(|error| Problem::unreadable(&error))
    }
}

async fn ranged(id: Uuid, mut source: Source, mut request: Request) -> Result<Response, Problem> {
    let wanted = Wanted::of(request.headers());
    let condition = request.headers_mut().remove(IF_RANGE);
    request.headers_mut().remove(RANGE);
    if let Some(wanted) = wanted {
        let mut probe = Request::new(Body::empty());
        *probe.method_mut() = Method::HEAD;
        let head = source.answer(probe).await?;
        let head = head.headers();
        let bytes = head.get(CONTENT_LENGTH).and_then(|bytes| bytes.to_str().ok()?.parse().ok());
        // Only an equal strong ETag shows that it is the same file; a date is too coarse for that.
        if condition.is_none_or(|etag| head.get(ETAG) == Some(&etag))
            && let Some(range) = wanted.header(bytes.unwrap_or(u64::MAX))
        {
            request.headers_mut().insert(RANGE, range);
        }
    }
    let response = source.answer(request).await?;
    Ok(if response.status().is_success() { as_log(id, response) } else { response })
}

/// Returns the table of a sweep, streamed. For one that is being made, these are the whole lines
/// that exist, without the first, which describes them.
pub(super) async fn table(path: PathBuf, finished: bool) -> Result<Body, Problem> {
    let open = move || {
        if !path.symlink_metadata()?.is_file() {
            return Err(io::Error::from(io::ErrorKind::NotFound));
        }
        let mut file = File::open(path)?;
        let mut length = file.metadata()?.len();
        if !finished {
            let mut reader = BufReader::new(&file);
            let skipped = reader.skip_until(b'\n')? as u64;
            length = whole_lines(&file, length)?.max(skipped);
            file.seek(SeekFrom::Start(skipped))?;
            length -= skipped;
        }
        Ok(file.take(length))
    };
    let opened = tokio::task::spawn_blocking(open).await.map_err(io::Error::other).flatten();
    let file = opened.map_err(|error| Problem::unreadable(&error))?;
    let pieces = stream::try_unfold(file, |mut file| async move {
        tokio::task::spawn_blocking(move || {
            let mut bytes = vec![0; PIECE];
            let length = file.read(&mut bytes)?;
            bytes.truncate(length);
            Ok((length > 0).then(|| (Bytes::from(bytes), file)))
        })
        .await
        .map_err(io::Error::other)
        .flatten()
    });
    Ok(Body::from_stream(pieces))
}

/// Returns the length of a file of `length` bytes up to the end of its last whole line.
fn whole_lines(mut file: &File, length: u64) -> io::Result<u64> {
    let mut end = length;
    let mut bytes = vec![0; PIECE];
    while end > 0 {
        let from = end.saturating_sub(PIECE as u64);
        let piece = &mut bytes[..(end - from) as usize];
        file.seek(SeekFrom::Start(from))?;
        file.read_exact(piece)?;
        if let Some(at) = piece.iter().rposition(|&byte| byte == b'\n') {
            return Ok(from + at as u64 + 1);
        }
        end = from;
    }
    Ok(0)
}

/// Returns the metadata of a path. HTTP knows no date before 1970: a file that has one, from a
/// clock that was wrong, gets another.
fn dated(path: &Path) -> io::Result<Metadata> {
    let metadata = path.symlink_metadata()?;
    if metadata.is_file() && metadata.modified()? < UNIX_EPOCH {
        File::options().append(true).open(path)?.set_modified(UNIX_EPOCH)?;
    }
    Ok(metadata)
}

/// The range of bytes that a client wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wanted {
    /// From the first to the last one; to the end without a last one.
    From(u64, Option<u64>),
    /// The last ones, as many.
    Last(u64),
}

impl Wanted {
    /// Returns the range that a request asks for in the form of RFC 9110 (14.1). Anything else is to
    /// be ignored (14.2), and so may be more than one range: then the whole file is the answer.
    fn of(headers: &HeaderMap) -> Option<Self> {
        let mut values = headers.get_all(RANGE).iter();
        let range = values.next()?.to_str().ok()?.strip_prefix("bytes=")?;
        let (first, last) = range.trim_matches([' ', '\t']).split_once('-')?;
        match (first, last) {
            _ if values.next().is_some() => None,
            ("", count) => Some(Self::Last(position(count)?)),
            (first, "") => Some(Self::From(position(first)?, None)),
            (first, last) => {
                let range = (position(first)?, position(last)?);
                is_at_most(first, last).then_some(Self::From(range.0, Some(range.1)))
            }
        }
    }

    /// Returns the header by which the layer below answers for a file of `bytes`.
    fn header(self, bytes: u64) -> Option<HeaderValue> {
        let text = match self {
            Self::From(first, None) => format!("bytes={first}-"),
            Self::From(first, Some(last)) => format!("bytes={first}-{last}"),
            Self::Last(count) => format!("bytes=-{}", count.min(bytes)),
        };
        text.try_into().ok()
    }
}

/// Returns the number that digits stand for; the largest one for those beyond it, which no file
/// reaches either.
fn position(digits: &str) -> Option<u64> {
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then(|| digits.parse().unwrap_or(u64::MAX))
}

/// Returns whether a number of any length is at most another: a longer one is larger, once zeros are gone.
fn is_at_most(first: &str, last: &str) -> bool {
    let [first, last] = [first, last].map(|number| number.trim_start_matches('0'));
    (first.len(), first) <= (last.len(), last)
}

/// Names an answer as the log of a job.
pub(super) fn as_log(id: Uuid, answer: impl IntoResponse) -> Response {
    let mut response = answer.into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/octet-stream"));
    if let Ok(name) = HeaderValue::try_from(format!("attachment; filename=\"vpd-{id}.mcap\"")) {
        headers.insert(CONTENT_DISPOSITION, name);
    }
    response
}

/// Lets pages of other origins read what `router` answers.
pub(super) fn share<S: Clone + Send + Sync + 'static>(router: Router<S>, cors: &Cors) -> Router<S> {
    let origins = match cors {
        Cors::Nobody => return router,
        Cors::Any => AllowOrigin::any(),
        Cors::Origins(origins) => AllowOrigin::list(
            origins.iter().filter_map(|origin| HeaderValue::try_from(origin).ok()),
        ),
    };
    let cors = CorsLayer::new()
        .allow_origin(origins)
        .allow_methods([Method::GET, Method::HEAD, Method::OPTIONS])
        .allow_headers([RANGE, IF_MATCH, IF_NONE_MATCH, IF_RANGE, AUTHORIZATION, CONTENT_TYPE])
        .expose_headers([
            ACCEPT_RANGES,
            CONTENT_LENGTH,
            CONTENT_RANGE,
            CONTENT_TYPE,
            ETAG,
            LAST_MODIFIED,
        ])
        .max_age(Duration::from_secs(600));
    let policy = HeaderValue::from_static("cross-origin");
    router
        .layer(cors)
        .layer(SetResponseHeaderLayer::overriding(CROSS_ORIGIN_RESOURCE_POLICY, policy))
}
