//! The interface of the engines, and the two that there are: on this machine (`local`), and on many
//! (`cluster`).
//!
//! Invariant: both engines give the same answers. The record holds the jobs, an engine only what is in flight.

#[cfg(feature = "cluster")]
pub(super) mod cluster;
pub(super) mod local;

use std::path::PathBuf;

use axum::body::Bytes;
use tokio::task::JoinHandle;
use uuid::Uuid;

use super::job::{State, View};
use super::store::StoreError;
use crate::advise::Settled;
use crate::plan::Plan;
use crate::scenario::Scenario;

/// Reason why the engine refuses a request.
#[derive(Debug, thiserror::Error)]
pub(super) enum Refusal {
    #[error("{limit} jobs are already waiting: try again later")]
    QueueFull { limit: usize },
    #[error("the service is stopping: try again once it is back")]
    Stopping,
    #[error(
        "the run is expected to take {estimate_s:.0} s of computing, more than the {limit_s:.0} s allowed here"
    )]
    TooExpensive { estimate_s: f64, limit_s: f64, pointer: &'static str },
    #[error(
        "the log is expected to take {estimate} bytes, more than the {limit} allowed here: {advice}"
    )]
    LogTooLarge { estimate: u64, limit: u64, advice: String, pointer: &'static str },
    #[error(
        "the run is expected to take {estimate} bytes of memory, more than the {limit} allowed here: ask for fewer members, or a smaller n"
    )]
    TooMuchMemory { estimate: u64, limit: u64 },
    #[error(
        "the disk has no room for the log of this job in addition to those of the jobs accepted before"
    )]
    DiskFull,
    #[error("this Idempotency-Key was used before with another scenario")]
    KeyReused,
    #[error("another request with this Idempotency-Key is still being answered")]
    KeyBusy,
    #[error("the service failed to check the request; its log says why")]
    Broken,
    #[error("there is no job with this id")]
    UnknownJob,
    #[error("the job is running: cancel it first")]
    JobRunning,
    #[error("the job has ended already")]
    JobEnded,
    #[error("the log can be read once the job has ended")]
    LogUnfinished { eta_s: Option<f64> },
    #[error("the job ended before it began a log")]
    NoLog,
    #[error("the log is missing, or is not what the job wrote: its checksum differs")]
    LogDamaged,
    #[error(
        "this service distributes jobs to other machines and makes no studies: use `vpd sweep` for sweeps"
    )]
    NoStudies,
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl Refusal {
    /// Returns the fixed code for programs.
    pub(super) fn code(&self) -> &'static str {
        match self {
            Self::QueueFull { .. } => "queue_full",
            Self::Stopping => "stopping",
            Self::TooExpensive { .. } => "too_expensive",
            Self::LogTooLarge { .. } => "log_too_large",
            Self::TooMuchMemory { .. } => "too_much_memory",
            Self::DiskFull => "storage_full",
            Self::KeyReused => "idempotency_key_reused",
            Self::KeyBusy => "idempotency_key_busy",
            Self::Broken => "internal",
            Self::UnknownJob => "unknown_job",
            Self::JobRunning => "job_running",
            Self::JobEnded => "job_ended",
            Self::LogUnfinished { .. } => "log_unfinished",
            Self::NoLog => "no_log",
            Self::LogDamaged => "log_damaged",
            Self::NoStudies => "no_studies",
            Self::Store(error) => error.code(),
        }
    }
}

/// A handle on the engine; copies are the same engine.
#[derive(Clone, Debug)]
pub(super) enum Engine {
    Local(local::Local),
    #[cfg(feature = "cluster")]
    Cluster(cluster::Cluster),
}

/// Makes the same call to the engine in use; `now` for results that the one on this machine has at
/// hand.
macro_rules! asked {
    ($engine:expr, $name:ident($($given:expr),*) now) => {
        match $engine {
            Self::Local(local) => local.$name($($given),*),
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.$name($($given),*).await,
        }
    };
    ($engine:expr, $name:ident($($given:expr),*)) => {
        match $engine {
            Self::Local(local) => local.$name($($given),*).await,
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.$name($($given),*).await,
        }
    };
}

impl Engine {
    /// Takes a job, with its plan unless its accuracy is yet to be settled. When this returns the
    /// job is on record. A key that was used before, with the same scenario, returns the job of
    /// that time.
    pub(super) async fn submit(
        &self,
        scenario: Scenario,
        planned: Option<(Settled, Plan)>,
        key: Option<Uuid>,
        sent: Vec<u8>,
    ) -> Result<View, Refusal> {
        asked!(self, submit(scenario, planned, key, sent))
    }

    /// Returns one job, with its end or its plan.
    pub(super) async fn get(&self, id: Uuid) -> Result<View, Refusal> {
        asked!(self, get(id))
    }

    /// Returns one job, as far as it is known without its plan and its end.
    pub(super) async fn brief(&self, id: Uuid) -> Result<View, Refusal> {
        asked!(self, brief(id) now)
    }

    /// Returns jobs newest first, older than `cursor`, with `name` in their names in any case; and
    /// the cursor for more of them, if there are more.
    pub(super) async fn list(
        &self,
        state: Option<State>,
        name: Option<&str>,
        limit: usize,
        cursor: Option<Uuid>,
    ) -> Result<(Vec<View>, Option<Uuid>), Refusal> {
        match self {
            Self::Local(local) => Ok(local.list(state, name, limit, cursor)),
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.list(state, name, limit, cursor).await,
        }
    }

    /// Returns the file of the finished log of a job, checked to be what the job wrote.
    pub(super) async fn log(&self, id: Uuid) -> Result<PathBuf, Refusal> {
        asked!(self, log(id))
    }

    /// Returns the path of the finished log of a job; the unfinished one has its name with `.part`,
    /// as far as it has come.
    pub(super) async fn log_so_far(&self, view: &View) -> Result<PathBuf, Refusal> {
        match self {
            Self::Local(local) => Ok(local.log_path(view.id)),
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.log_so_far(view).await,
        }
    }

    /// Returns the figures of the service as text.
    pub(super) async fn metrics(&self) -> Result<String, Refusal> {
        match self {
            Self::Local(local) => {
                let local = local.clone();
                let text = tokio::task::spawn_blocking(move || local.metrics()).await;
                text.map_err(|_| Refusal::Stopping)
            }
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.metrics().await,
        }
    }

    /// Returns the scenario of a job, as accepted.
    pub(super) async fn scenario(&self, id: Uuid) -> Result<Bytes, Refusal> {
        asked!(self, scenario(id))
    }

    /// Returns the scenario of a job with the method and the step that were found for its accuracy;
    /// as accepted if none was.
    pub(super) async fn settled(&self, id: Uuid) -> Result<Option<Scenario>, Refusal> {
        let accepted = self.scenario(id).await?;
        let settled = asked!(self, settled(id))?;
        let planned = tokio::task::spawn_blocking(move || match settled {
            Some(settled) => settled.plan().map(|plan| plan.settled),
            None => Scenario::from_json(&accepted),
        });
        Ok(planned.await.map_err(|_| Refusal::Stopping)?.ok())
    }

    /// Returns the scenario of a job, as it was sent.
    pub(super) async fn sent(&self, id: Uuid) -> Result<Bytes, Refusal> {
        asked!(self, sent(id))
    }

    /// Stops a job: one that has not begun has ended when this returns, a running one ends soon.
    pub(super) async fn cancel(&self, id: Uuid) -> Result<View, Refusal> {
        asked!(self, cancel(id))
    }

    /// Forgets a job that does not run, and its log.
    pub(super) async fn forget(&self, id: Uuid) -> Result<(), Refusal> {
        asked!(self, forget(id))
    }

    /// Begins the stop: no new jobs, and what runs here is interrupted.
    pub(super) fn stop(&self) {
        match self {
            Self::Local(local) => local.stop(),
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.stop(),
        }
    }

    /// Checks whether jobs are taken.
    pub(super) fn check(&self) -> Result<(), Refusal> {
        match self {
            Self::Local(local) => local.check(),
            #[cfg(feature = "cluster")]
            Self::Cluster(cluster) => cluster.check(),
        }
    }
}

/// Runs a task to its end even if the caller, a request whose client has left, is dropped.
async fn to_the_end<T: Send + 'static>(task: impl Future<Output = T> + Send + 'static) -> T {
    joined(tokio::spawn(task)).await
}

/// Returns the result of a task; a panic in it is one here.
pub(super) async fn joined<T>(task: JoinHandle<T>) -> T {
    match task.await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // Only a runtime that goes down aborts a task, and it drops us next.
            Err(_) => std::future::pending().await,
        },
    }
}
