//! The service: jobs over HTTP.
//!
//! ```text
//! POST /jobs → store (durable) → queue → worker thread → run → store (log) → GET /jobs/{id}/log.mcap
//! ```
//!
//! Invariants
//! - tokio stops here: a step never runs on an async thread, and no lock is held over an `.await`.
//! - 202 means kept: the scenario is on the disk before the answer, and a job without a result goes
//!   on after a restart, unless it was what ended the process.
//! - A job ends once. Its state is never ahead of its record on the disk.
//! - The queue is bounded and says so; a client that leaves does not undo what it asked for.
//! - Only finished logs are served, or streams that end with one.
//! - Other machines are served with tokens only, unless a flag says otherwise.
//!
//! Reads in this order: `config`, `listen` (connections) within `handles`, `gate` (access) with
//! `link` (signed addresses), `api` (routes, thin handlers) with `openapi` (their description),
//! `view` (the form of answers) and `problem` (the only place that knows status codes),
//! `submission` (slots in which submissions are checked), `download` and `follow` (the log over
//! HTTP, finished and growing), `viewers` (the live view), `engine` (queue and workers), `errand`
//! (the work of a worker) and `apart` (in a process of its own), `job` (its life), `ids` (their
//! order), `store` (the record), `metrics`.

mod api;
pub(crate) mod apart;
mod config;
mod download;
mod engine;
mod errand;
mod follow;
mod gate;
mod handles;
mod ids;
mod job;
mod link;
mod listen;
mod metrics;
mod openapi;
mod page;
mod problem;
mod store;
mod studies;
mod submission;
mod view;
mod viewers;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::live::Live;

pub use config::{Cors, Limits, Scope, ServeConfig, Tokens};
#[cfg(feature = "cluster")]
pub use engine::cluster::sweeps::{SweepOnError, sweep_on};
#[cfg(feature = "cluster")]
pub use engine::cluster::work::{WorkConfig, work};
#[cfg(feature = "cluster")]
pub use engine::cluster::{ClusterConfig, ClusterError};
#[cfg(feature = "cluster")]
pub use store::bucket::BucketError;

use api::App;
use engine::Engine;
#[cfg(feature = "cluster")]
use engine::cluster::Cluster;
use engine::local::Local;
use gate::Gate;
use link::LinkKey;
use listen::Open;
#[cfg(feature = "cluster")]
use store::bucket::Bucket;
use store::{DataDirectory, DataLock, Store, StudyStore};
use studies::Studies;
use submission::SubmissionSlots;

/// Time that a stop waits for runs to end; together with what comes before and after, less than ten
/// seconds.
const DRAIN: Duration = Duration::from_secs(9);

/// Time that a stop waits for answers in flight; a download that is cut off goes on with a range.
const LAST_ANSWERS: Duration = Duration::from_secs(3);

/// Priority of threads that compute, below those that answer: a tenth of the weight, where both
/// want the processor, and all of it where no request waits.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Reason why the service could not start, or not end in order.
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
    #[error("cannot use the data directory {path}: {source}")]
    Data {
        /// The directory.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The record of the jobs cannot be read.
    #[error("cannot read the jobs in the data directory: {message}")]
    Record {
        /// Operation that failed, and why.
        message: String,
    },
    /// Any client that reaches the address could run jobs.
    #[error(
        "{address} can be reached by other machines: give tokens (--tokens FILE), or insist with --insecure"
    )]
    Unguarded {
        /// The address.
        address: SocketAddr,
    },
    /// The address of the live view cannot be used.
    #[error("cannot listen for viewers on {address}: {source}")]
    Viewers {
        /// The address.
        address: SocketAddr,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A worker thread cannot be started, or the listener failed.
    #[error("the system refuses a thread or a socket: {0}")]
    System(#[from] std::io::Error),
    /// The other machines cannot be reached.
    #[cfg(feature = "cluster")]
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    /// A run did not stop in time; it is run again at the next start.
    #[error("a run did not stop within {} s; its job or study is run again at the next start", DRAIN.as_secs())]
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
    for address in [Some(listener.local_addr()?), config.live].into_iter().flatten() {
        if !address.ip().is_loopback() && config.tokens.is_empty() && !config.insecure {
            return Err(ServeError::Unguarded { address });
        }
    }
    let limits = handles::within(config.limits, config.workers, config.live.is_some());
    let lock = DataLock::take(&config.data)?;
    let door = match config.live {
        Some(address) => Some(viewers_door(address).await?),
        None => None,
    };
    let live = door.as_ref().map(|_| Arc::new(Live::default()));
    let data = lock.directory();
    let Parts { engine, studies, links, drained } =
        parts(&config, data, limits, live.clone()).await?;
    let gate = Gate::new(&config, links.clone());
    let (stop, stopped) = watch::channel(false);
    let app = App::new(engine.clone(), studies.clone(), SubmissionSlots::open()?, &config, links);
    let app = match &door {
        Some(door) => app.with_live(door.local_addr()?),
        None => app,
    };
    let app = api::router(app, gate.clone(), &config.cors);
    let open = Open::new(limits);
    tracing::info!("listening on http://{}", listener.local_addr()?);
    let server = listen::listen(listener, app, open.clone(), stopped.clone());
    let server = match door.zip(live) {
        Some((door, live)) => {
            let viewers = viewers::router(live, gate.clone(), stopped.clone());
            let viewers = api::guarded(viewers, gate);
            let viewers = listen::listen(door, viewers, open, stopped);
            tokio::spawn(async { tokio::join!(server, viewers).0 })
        }
        None => tokio::spawn(server),
    };
    shutdown.await;
    tracing::info!("stopping");
    engine.stop();
    if let Some(studies) = studies {
        studies.stop();
    }
    let _ = stop.send(true);
    // Both at once: the answers in flight end while the runs stop.
    let answered = tokio::time::timeout(LAST_ANSWERS, server);
    let (_, workers) = tokio::join!(answered, tokio::time::timeout(DRAIN, drained));
    if workers.is_err() {
        // A run that goes on still writes to the directory: no other process may have it while this one lives.
        std::mem::forget(lock);
        return Err(ServeError::Unfinished);
    }
    tracing::info!("stopped");
    Ok(())
}

/// Parts that serve the requests.
struct Parts {
    engine: Engine,
    studies: Option<Studies>,
    links: Option<LinkKey>,
    /// Completes once everything that ran at the stop has ended.
    drained: Pin<Box<dyn Future<Output = ()> + Send>>,
}

/// Returns the engine of the configuration, and the other parts that go with it.
async fn parts(
    config: &ServeConfig,
    data: &DataDirectory,
    limits: Limits,
    live: Option<Arc<Live>>,
) -> Result<Parts, ServeError> {
    let guarded = !config.tokens.is_empty();
    #[cfg(feature = "cluster")]
    if let Some(cluster) = &config.cluster {
        let bucket = Bucket::open(&cluster.bucket).await.map_err(ClusterError::from)?;
        let links = if guarded { Some(LinkKey::shared(&bucket).await?) } else { None };
        let engine = Cluster::start(cluster, bucket, &config.data, limits).await?;
        let (engine, drained) = (Engine::Cluster(engine), Box::pin(async {}));
        return Ok(Parts { engine, studies: None, links, drained });
    }
    let store = Store::open(data.clone())?;
    let failed = |source| ServeError::Data { path: config.data.clone(), source };
    let links = if guarded { Some(LinkKey::of(data.path()).map_err(failed)?) } else { None };
    let (workers, program) = (config.workers, config.program.clone());
    let (local, ended) = Local::start(store, workers, limits, live, program.clone()).await?;
    let (studies, studying) =
        Studies::start(StudyStore::open(data.clone())?, limits, program).await?;
    let studied = tokio::task::spawn_blocking(move || studying.join());
    let drained = Box::pin(async {
        let _ = tokio::join!(ended.wait(), studied);
    });
    Ok(Parts { engine: Engine::Local(local), studies: Some(studies), links, drained })
}

/// Listens for viewers.
async fn viewers_door(address: SocketAddr) -> Result<TcpListener, ServeError> {
    let wrong = |source| ServeError::Viewers { address, source };
    let door = TcpListener::bind(address).await.map_err(wrong)?;
    tracing::info!("viewers may connect to ws://{}", door.local_addr().map_err(wrong)?);
    Ok(door)
}

/// Lets this thread, which computes for long, give way to those that answer. Where threads have no
/// priority of their own they share alike.
fn give_way() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICENESS) {
        tracing::warn!(%error, "the priority of computing threads cannot be lowered");
    }
}

/// Returns the beginning of a text, of at most this many bytes.
fn shortened(mut text: String, most: usize) -> String {
    let mut end = text.len().min(most);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    text.truncate(end);
    text
}

/// Returns an error and its causes in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text.push_str(&format!(": {error}"));
        cause = error.source();
    }
    text
}
