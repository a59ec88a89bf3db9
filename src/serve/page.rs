//! What people look at: the page at `/`, the description at `/docs`, the layouts of viewers, the charts and the
//! attitudes of a job.
//!
//! Invariant: a page uses the public routes alone and asks nobody else for anything; its policy allows it
//! no script and no style but the two that were built in.

use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock};

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY};
use axum::response::{Html, IntoResponse, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest, Sha256};
use tokio::sync::Semaphore;

use super::problem::Problem;
use crate::chart::{ChartError, LogChart, draw_log};
use crate::log::stretch::{Stretch, read_stretch};
use crate::log::{LogError, part_path};

/// Attitudes in one answer, if the client does not say, and at most.
pub(super) const STRETCH: usize = 300;
pub(super) const MAX_STRETCH: usize = 2000;

/// Logs that are read for pictures at once: a long log keeps a thread busy for seconds.
const READERS: usize = 2;

const STYLE: &str = include_str!("page/style.css");
const SCRIPT: &str = concat!(
    include_str!("page/body.js"),
    include_str!("page/client.js"),
    include_str!("page/editor.js"),
    include_str!("page/page.js"),
);

/// The layout of panels for Foxglove and Lichtblick: both read the same.
pub(crate) const LAYOUT: &str = include_str!("page/layout.json");

/// A page as one file.
struct OneFile {
    text: String,
    /// What a browser may load for it: what is in it, by its hash, and answers of this service.
    policy: String,
}

static PAGE: LazyLock<OneFile> =
    LazyLock::new(|| OneFile::new(include_str!("page/page.html"), STYLE, SCRIPT));

static DOCS: LazyLock<OneFile> = LazyLock::new(|| {
    let (style, script) = (include_str!("page/docs.css"), include_str!("page/docs.js"));
    OneFile::new(include_str!("page/docs.html"), style, script)
});

impl OneFile {
    fn new(frame: &str, style: &str, script: &str) -> Self {
        let hash = |text: &str| BASE64_STANDARD.encode(Sha256::digest(text));
        Self {
            text: frame.replace("/*style*/", style).replace("/*script*/", script),
            policy: format!(
                "default-src 'none'; script-src 'sha256-{}'; style-src 'sha256-{}'; img-src blob: data:; \
                 connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
                hash(script),
                hash(style)
            ),
        }
    }

    fn answer(&'static self) -> Response {
        let headers = [
            (CONTENT_SECURITY_POLICY, self.policy.as_str()),
            (REFERRER_POLICY, "no-referrer"),
            (CACHE_CONTROL, "no-cache"),
        ];
        (headers, Html(self.text.as_str())).into_response()
    }
}

pub(super) async fn page() -> Response {
    PAGE.answer()
}

pub(super) async fn docs() -> Response {
    DOCS.answer()
}

pub(super) async fn layout() -> Response {
    ([(CONTENT_TYPE, "application/json"), (CACHE_CONTROL, "no-cache")], LAYOUT).into_response()
}

/// Reads logs for pictures, a few at a time.
#[derive(Clone, Debug)]
pub(super) struct Pictures(Arc<Semaphore>);

impl Pictures {
    pub(super) fn new() -> Self {
        Self(Arc::new(Semaphore::new(READERS)))
    }

    /// The chart with the file name `name` of a finished log.
    pub(super) async fn chart(&self, name: &str, log: PathBuf) -> Result<Response, Problem> {
        let which = LogChart::ALL.into_iter().find(|which| which.file() == name);
        let which = which.ok_or_else(|| Problem::not_found("chart"))?;
        let drawn = self.read(move || draw_log(own_file(&log)?, which)).await?;
        match drawn {
            Ok(svg) => Ok(([(CONTENT_TYPE, "image/svg+xml")], svg).into_response()),
            Err(ChartError::Empty) => Err(Problem::not_found("sample in the log for a chart")),
            Err(error) => Err(Problem::unreadable(&error)),
        }
    }

    /// Attitudes of a log from a time on; of one that is being written, its first ones.
    pub(super) async fn attitudes(
        &self,
        log: PathBuf,
        finished: bool,
        from_s: f64,
        samples: usize,
    ) -> Result<Stretch, Problem> {
        let path = if finished { log } else { part_path(&log) };
        let read = self.read(move || read_stretch(own_file(&path)?, from_s, samples)).await?;
        match read {
            Ok(stretch) => Ok(stretch),
            // Not begun yet, or finished at this moment.
            Err(_) if !finished => Ok(Stretch::default()),
            Err(error) => Err(Problem::unreadable(&error)),
        }
    }

    async fn read<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Problem> {
        let unreadable = |error: &dyn std::error::Error| Problem::unreadable(error);
        let turn = self.0.clone().acquire_owned().await.map_err(|error| unreadable(&error))?;
        let work = move || {
            let _turn = turn;
            work()
        };
        tokio::task::spawn_blocking(work).await.map_err(|error| unreadable(&error))
    }
}

/// A path that is a file: a link planted in the data directory must not lead out of it.
fn own_file(path: &Path) -> Result<&Path, LogError> {
    let storage = |source| LogError::Storage { path: path.to_owned(), action: "read", source };
    let metadata = path.symlink_metadata().map_err(storage)?;
    if metadata.is_file() { Ok(path) } else { Err(storage(std::io::ErrorKind::NotFound.into())) }
}
