//! Pages for people: the page at `/`, the description at `/docs`, the layouts of viewers, the
//! charts and the attitudes of a job.
//!
//! Invariant: a page uses the public routes alone and requests nothing else; its policy allows it
//! no script and no style but the two that were built in.

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY};
use axum::response::{Html, IntoResponse, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use sha2::{Digest, Sha256};
use tokio::sync::{Semaphore, oneshot, watch};

use super::give_way;
use super::problem::Problem;
use crate::chart::{ChartError, draw_log};
use crate::log::LAYOUT;
use crate::log::course::LogChart;
use crate::log::members::{self, Members};
use crate::log::messages::Member;
use crate::log::samples::{Curve, Samples, Window, read_course};
use crate::log::stretch::{self, Stretch};
use crate::log::{LogError, part_path};
use crate::scenario::Inertia;

/// Number of attitudes in one answer, if the client does not say, and at most.
pub(super) const STRETCH: usize = 300;
pub(super) const MAX_STRETCH: usize = 2000;

/// Number of points of one course, if the client does not say, and at most.
pub(super) const POINTS: usize = 500;
pub(super) const MAX_POINTS: usize = 5000;

/// Number of members in one answer, if the client does not say, and at most.
pub(super) const MEMBERS: usize = 20;
pub(super) const MAX_MEMBERS: usize = 200;

/// Number of logs that are read at once for charts, and as many for attitudes: a long log keeps a
/// thread busy for seconds.
const READERS: usize = 2;

const STYLE: &str = concat!(include_str!("page/uplot/uplot.css"), include_str!("page/style.css"));

/// Scripts of ours, of which comment lines and indentation are left out: no text of theirs goes over several lines.
const FIRST: &str = include_str!("page/body.js");
const OURS: &str = concat!(
    include_str!("page/client.js"),
    include_str!("page/chart.js"),
    include_str!("page/members.js"),
    include_str!("page/json.js"),
    include_str!("page/schema.js"),
    include_str!("page/editor.js"),
    include_str!("page/form.js"),
    include_str!("page/list.js"),
    include_str!("page/page.js"),
);

/// Returns a script without the lines and spaces that are for its readers.
fn lean(script: &str) -> String {
    let lines = script.lines().map(str::trim_start);
    lines.filter(|line| !line.is_empty() && !line.starts_with("//")).fold(
        String::new(),
        |mut lean, line| {
            lean.push_str(line);
            lean.push('\n');
            lean
        },
    )
}

/// A page as one file.
struct OneFile {
    text: String,
    /// Content that a browser may load for it: what is in it, by its hash, and answers of this
    /// service.
    policy: String,
}

static PAGE: LazyLock<OneFile> = LazyLock::new(|| {
    let others = [
        include_str!("page/codemirror/codemirror.js"),
        "\n",
        include_str!("page/uplot/uplot.js"),
        "\n",
    ];
    let script = [lean(FIRST), others.concat(), lean(OURS)].concat();
    OneFile::new(include_str!("page/page.html"), STYLE, &script)
});

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

/// Reads logs for pictures: a few at a time, on threads that give way, and each chart once however many ask for it at
/// the same time.
#[derive(Clone, Debug)]
pub(super) struct Pictures {
    drawing: Arc<Mutex<HashMap<Wanted, watch::Sender<Option<Drawn>>>>>,
    charts: Arc<Semaphore>,
    stretches: Arc<Semaphore>,
}

/// A chart of a log.
type Wanted = (PathBuf, &'static str);

/// A chart, or why there is none; shared by all requests that wait for it.
type Drawn = Arc<Result<String, ChartError>>;

impl Pictures {
    pub(super) fn new() -> Self {
        let turns = || Arc::new(Semaphore::new(READERS));
        Self { drawing: Arc::default(), charts: turns(), stretches: turns() }
    }

    /// Returns the chart with the file name `name` of a finished log.
    pub(super) async fn chart(&self, name: &str, log: PathBuf) -> Result<Response, Problem> {
        let which = LogChart::ALL.into_iter().find(|which| which.file() == name);
        let which = which.ok_or_else(|| Problem::not_found("chart of this name"))?;
        match &*self.drawn(which, log).await? {
            Ok(svg) => Ok(([(CONTENT_TYPE, "image/svg+xml")], svg.clone()).into_response()),
            Err(ChartError::Empty) => Err(Problem::not_found("sample for a chart in the log")),
            Err(error) => Err(Problem::unreadable(error)),
        }
    }

    async fn drawn(&self, which: LogChart, log: PathBuf) -> Result<Drawn, Problem> {
        let wanted = (log, which.file());
        let mut seen = {
            let mut drawing = self.drawing();
            match drawing.get(&wanted) {
                Some(drawn) => drawn.subscribe(),
                None => {
                    let (drawn, seen) = watch::channel(None);
                    drawing.insert(wanted.clone(), drawn.clone());
                    tokio::spawn(self.clone().draw(which, wanted, drawn));
                    seen
                }
            }
        };
        let drawn = seen.wait_for(Option::is_some).await;
        // This fails only if the task panicked, or the service is shutting down.
        let drawn = drawn.map_err(|error| Problem::unreadable(&error))?.clone();
        drawn.ok_or_else(|| Problem::not_found("chart of this name"))
    }

    /// Draws a chart when its turn comes, unless no request waits for it any more.
    async fn draw(self, which: LogChart, wanted: Wanted, drawn: watch::Sender<Option<Drawn>>) {
        let turn = tokio::select! {
            turn = self.charts.acquire() => turn,
            () = self.unwanted(&wanted, &drawn) => return,
        };
        let log = wanted.0.clone();
        let chart = aside(move || draw_log(own_file(&log)?, which)).await;
        drop(turn);
        self.drawing().remove(&wanted);
        if let Ok(chart) = chart {
            drawn.send_replace(Some(Arc::new(chart)));
        }
    }

    /// Ends when no request waits for a chart; then it is taken off the list.
    async fn unwanted(&self, wanted: &Wanted, drawn: &watch::Sender<Option<Drawn>>) {
        loop {
            drawn.closed().await;
            let mut drawing = self.drawing();
            // It stays if another request came since.
            if drawn.is_closed() {
                drawing.remove(wanted);
                return;
            }
        }
    }

    fn drawing(&self) -> MutexGuard<'_, HashMap<Wanted, watch::Sender<Option<Drawn>>>> {
        self.drawing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the attitudes of a log from a time on; for one that is being written, its first
    /// ones.
    pub(super) async fn attitudes(
        &self,
        log: PathBuf,
        finished: bool,
        wanted: stretch::Wanted,
    ) -> Result<Stretch, Problem> {
        let path = if finished { log } else { part_path(&log) };
        let _turn = self.stretches.acquire().await.map_err(|error| Problem::unreadable(&error))?;
        let read = aside(move || stretch::read_stretch(own_file(&path)?, wanted)).await;
        match read.map_err(|error| Problem::unreadable(&error))? {
            Ok(stretch) => Ok(stretch),
            // It has not begun yet, or finished at this moment.
            Err(_) if !finished => Ok(Stretch::default()),
            Err(error) => Err(Problem::unreadable(&error)),
        }
    }

    /// Returns the course of a quantity; `None` if there is no file. A caller that no longer waits
    /// ends the reading.
    pub(super) async fn samples(
        &self,
        path: PathBuf,
        curve: Curve,
        window: Window,
        inertia: Option<Inertia>,
    ) -> Result<Option<Samples>, Problem> {
        let read = move |file: &Path, stopped: Stopped<'_>| {
            let velocity = |momentum: &[f64]| {
                inertia
                    .as_ref()
                    .map_or_else(Vec::new, |inertia| angular_velocity(inertia, momentum))
            };
            read_course(file, curve, window, &velocity, stopped)
        };
        self.read(path, read).await
    }

    /// Returns the members of an ensemble that have ended; `None` if there is no file. A caller
    /// that no longer waits ends the reading.
    pub(super) async fn members(
        &self,
        path: PathBuf,
        wanted: members::Wanted,
    ) -> Result<Option<Members>, Problem> {
        self.read(path, move |file, stopped| members::read_members(file, wanted, stopped)).await
    }

    /// Returns how a member of an ensemble began and ended; `None` if it has not ended, or there is none.
    pub(super) async fn member(
        &self,
        path: PathBuf,
        member: u64,
    ) -> Result<Option<Member>, Problem> {
        self.read(path, move |file, stopped| members::read_member(file, member, stopped)).await
    }

    /// Reads something from a log in its turn; `None` if there is no file.
    async fn read<T: Send + 'static>(
        &self,
        path: PathBuf,
        read: impl FnOnce(&Path, Stopped<'_>) -> Result<Option<T>, LogError> + Send + 'static,
    ) -> Result<Option<T>, Problem> {
        let _turn = self.stretches.acquire().await.map_err(|error| Problem::unreadable(&error))?;
        let waiting = Arc::new(());
        let waits = Arc::downgrade(&waiting);
        let found = aside(move || match own_file(&path) {
            Err(LogError::Storage { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                Ok(None)
            }
            file => read(file?, &|| waits.strong_count() == 0),
        });
        let found = found.await.map_err(|error| Problem::unreadable(&error))?;
        drop(waiting);
        found.map_err(|error| Problem::unreadable(&error))
    }
}

/// Function that returns whether no caller waits any more.
type Stopped<'a> = &'a (dyn Fn() -> bool + Sync);

/// Returns the angular velocity of a momentum, both in body coordinates: `J w = m` for n = 3, else
/// `(d_i + d_j) w_ij = m_ij`. Empty if the momentum is not of this body.
pub(super) fn angular_velocity(inertia: &Inertia, momentum: &[f64]) -> Vec<f64> {
    let by = |moments: &[f64]| {
        let parts = momentum.iter().zip(moments);
        if momentum.len() == moments.len() {
            parts.map(|(m, j)| m / j).collect()
        } else {
            Vec::new()
        }
    };
    match inertia {
        Inertia::Principal(moments) => by(moments),
        // In space the vector stands for the planes in the order of the axes.
        Inertia::SecondMoments(d) if d.len() == 3 => by(&[d[1] + d[2], d[0] + d[2], d[0] + d[1]]),
        Inertia::SecondMoments(d) => {
            let pairs = d.iter().enumerate();
            let sums: Vec<_> =
                pairs.flat_map(|(i, a)| d[i + 1..].iter().map(move |b| a + b)).collect();
            by(&sums)
        }
        Inertia::Matrix(rows) => {
            let row = |i: usize| rows.get(i).and_then(|row| <[f64; 3]>::try_from(&row[..]).ok());
            let (Some(a), Some(b), Some(c)) = (row(0), row(1), row(2)) else { return Vec::new() };
            let Ok(m) = <[f64; 3]>::try_from(momentum) else { return Vec::new() };
            // Cramer's rule; the matrix is its own transpose.
            let volume = |u: [f64; 3], v: [f64; 3], w: [f64; 3]| {
                let minor = |i: usize, j: usize| v[i] * w[j] - v[j] * w[i];
                u[0] * minor(1, 2) + u[1] * minor(2, 0) + u[2] * minor(0, 1)
            };
            let whole = volume(a, b, c);
            vec![volume(m, b, c) / whole, volume(a, m, c) / whole, volume(a, b, m) / whole]
        }
    }
}

/// Does work that takes the processor for long on a thread of its own, which gives way.
async fn aside<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> io::Result<T> {
    let (done, result) = oneshot::channel();
    std::thread::Builder::new().name("picture".to_owned()).spawn(move || {
        give_way();
        let _ = done.send(work());
    })?;
    result.await.map_err(io::Error::other)
}

/// Returns a path that is a file: a link planted in the data directory must not lead out of it.
fn own_file(path: &Path) -> Result<&Path, LogError> {
    let storage = |source| LogError::Storage { path: path.to_owned(), action: "read", source };
    let metadata = path.symlink_metadata().map_err(storage)?;
    if metadata.is_file() { Ok(path) } else { Err(storage(std::io::ErrorKind::NotFound.into())) }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;
    use std::sync::Arc;

    use super::{FIRST, LogChart, OURS, Pictures, READERS, lean};

    #[tokio::test]
    async fn a_chart_is_drawn_once_for_all_who_wait_and_not_at_all_for_nobody() {
        let pictures = Pictures::new();
        let all = pictures.charts.acquire_many(READERS as u32).await.expect("open");
        let ask = || {
            let pictures = pictures.clone();
            tokio::spawn(async move {
                pictures.drawn(LogChart::Energy, PathBuf::from("no/such.mcap")).await
            })
        };
        let asked: Vec<_> = (0..60).map(|_| ask()).collect();
        while pictures.drawing().values().map(|drawn| drawn.receiver_count()).sum::<usize>() < 60 {
            tokio::task::yield_now().await;
        }
        assert_eq!(pictures.drawing().len(), 1);
        drop(all);
        let mut drawn = Vec::new();
        for answer in asked {
            drawn.push(answer.await.expect("no panic").expect("an answer"));
        }
        assert!(drawn.iter().all(|one| one.is_err() && Arc::ptr_eq(one, &drawn[0])));
        assert!(pictures.drawing().is_empty());

        let all = pictures.charts.acquire_many(READERS as u32).await.expect("open");
        let left = ask();
        while pictures.drawing().is_empty() {
            tokio::task::yield_now().await;
        }
        left.abort();
        while !pictures.drawing().is_empty() {
            tokio::task::yield_now().await;
        }
        drop(all);
        // A later visitor is served.
        assert!(ask().await.expect("no panic").expect("an answer").is_err());
    }

    #[test]
    fn no_text_of_a_script_goes_over_several_lines() {
        for line in FIRST.lines().chain(OURS.lines()) {
            assert!(line.matches('`').count().is_multiple_of(2), "{line}");
        }
        let lean = lean(OURS);
        assert!(lean.len() < OURS.len() && !lean.contains("\n//") && !lean.contains("\n "));
    }
}
