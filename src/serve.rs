//! The service: jobs over HTTP.
//!
//! ```text
//! POST /jobs → store (durable) → queue → worker thread → run → store (log) → GET /jobs/{id}/log.mcap
//! ```
//!
//! Invariants
//! - tokio stops here: a step never runs on an async thread, and no lock is held over an `.await`.
//! - 202 means kept: the scenario is on the disk before the answer, and a job without a result is run again
//!   after a restart, three times at most.
//! - A job ends once. Its state is never ahead of its record on the disk.
//! - The queue is bounded and says so; a client that leaves does not undo what it asked for.
//! - Only finished logs are served.
//!
//! Reads in this order: `api` (routes, thin handlers), `problem` (the only place that knows status codes),
//! `download` (the log over HTTP), `engine` (queue and workers), `job` (its
//! life), `store` (the record).

mod api;
mod download;
mod engine;
mod job;
mod problem;
mod store;

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::oneshot;

use engine::Engine;
use store::{DataLock, Store};

/// How long a stop waits for runs to end; together with what comes before and after, less than ten seconds.
const DRAIN: Duration = Duration::from_secs(9);

/// How long a stop waits for answers in flight; a download that is cut off goes on with a range.
const LAST_ANSWERS: Duration = Duration::from_secs(3);

/// What the service needs to know.
#[derive(Clone, Debug)]
pub struct ServeConfig {
    /// Directory of jobs and logs; made if it is not there. One service at a time.
    pub data: PathBuf,
    /// How many jobs run at once, at least 1.
    pub workers: usize,
    /// How many jobs may wait; one more is answered 429.
    pub queue_limit: usize,
    /// Which web pages may read the logs.
    pub cors: Cors,
    /// Address under which viewers reach the service, as `https://example.org/vpd`; absent: the one
    /// that the client used.
    pub public_url: Option<String>,
}

/// Which web pages (viewers) may read logs from this service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Cors {
    /// All of them.
    Any,
    /// None but our own.
    Nobody,
    /// Those of the listed origins, as `https://app.foxglove.dev`.
    Origins(Vec<String>),
}

impl FromStr for Cors {
    type Err = String;

    /// `*`, `none`, or origins with commas between.
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "*" => Ok(Self::Any),
            "none" => Ok(Self::Nobody),
            _ => text
                .split(',')
                .map(|origin| checked_origin(origin.trim()))
                .collect::<Result<_, _>>()
                .map(Self::Origins),
        }
    }
}

fn checked_origin(text: &str) -> Result<String, String> {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://"));
    match host {
        Some(host)
            if !host.is_empty()
                && host.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.:[]".contains(&b)) =>
        {
            Ok(text.to_owned())
        }
        _ => Err(format!(
            "not an origin: {text:?}; write `*`, `none` or scheme://host[:port] with commas between"
        )),
    }
}

/// Why the service could not start, or not end in order.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Another process serves this directory.
    #[error(
        "the data directory {path} is in use by another vpd: stop it, or choose another directory with --data"
    )]
    DataInUse {
        /// The directory.
        path: PathBuf,
    },
    /// The directory cannot be made, locked or opened.
    #[error("cannot use the data directory {path}")]
    Data {
        /// The directory.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The record of the jobs cannot be read.
    #[error("cannot read the jobs in the data directory: {message}")]
    Record {
        /// What failed, and why.
        message: String,
    },
    /// A worker thread cannot be started, or the listener failed.
    #[error("the system refuses a thread or a socket")]
    System(#[from] std::io::Error),
    /// A run did not stop in time; it is run again at the next start.
    #[error("a run did not stop within {} s; its job is run again at the next start", DRAIN.as_secs())]
    Unfinished,
}

/// Serves until `shutdown` completes, then stops in order: no new jobs, running ones are interrupted without
/// a result and queued ones stay queued, so that both run after the next start. Returns within ten seconds.
/// The caller ends its runtime without waiting for blocking tasks.
pub async fn serve(
    listener: TcpListener,
    config: ServeConfig,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), ServeError> {
    let lock = DataLock::take(&config.data)?;
    let store = Store::open(&config.data)?;
    let (engine, drained) = Engine::start(store, config.workers, config.queue_limit).await?;
    let app = api::router(engine.clone(), &config);

    let (stop, stopped) = oneshot::channel::<()>();
    let server = axum::serve(listener, app).with_graceful_shutdown(async {
        let _ = stopped.await;
    });
    let mut server = std::pin::pin!(server.into_future());
    tokio::select! {
        result = &mut server => result?,
        () = shutdown => tracing::info!("stopping"),
    }

    engine.stop();
    let _ = stop.send(());
    // Both at once: the answers in flight end while the runs stop.
    let answered = tokio::time::timeout(LAST_ANSWERS, server);
    let (_, workers) = tokio::join!(answered, tokio::time::timeout(DRAIN, drained.wait()));
    if workers.is_err() {
        // A run that goes on still writes to the directory: nobody else may have it while we live.
        std::mem::forget(lock);
        return Err(ServeError::Unfinished);
    }
    tracing::info!("stopped");
    Ok(())
}

/// An error and its causes in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text.push_str(&format!(": {error}"));
        cause = error.source();
    }
    text
}
