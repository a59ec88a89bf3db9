//! Sweeps on many machines: a sweep is cut into parts of some seconds each, as `vpd sweep --shard`
//! cuts it; workers make them, and the caller puts them together.
//!
//! Invariant: the parts in the bucket are the checkpoint. Another call for the same sweep, by the
//! same build, resumes with the parts that exist; the table is that of one machine, byte for byte.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use futures_util::{StreamExt, TryStreamExt, stream};
use serde::{Deserialize, Serialize};
use temporalio_client::errors::{WorkflowGetResultError, WorkflowStartError};
use temporalio_client::{
    Client, WorkflowGetResultOptions, WorkflowIdConflictPolicy, WorkflowStartOptions,
};

use super::work::{Part, part_flow_id, task_timeout};
use super::{ClusterConfig, ClusterError, connect};
use crate::serve::chain;
use crate::serve::store::bucket::Bucket;
use crate::study::Watch;
use crate::sweep::{self, Options, Shard, Sweep, SweepError};

/// Approximate computing time of a part.
const PART_S: f64 = 5.0;

/// Largest number of parts of a sweep: each is an object, and a workflow.
const MOST_PARTS: u64 = 20_000;

/// Number of parts that are handed over at once; more of them wait here and not in the queue.
const UNDER_WAY: usize = 500;

/// Pause before Temporal is asked again.
const PAUSE: Duration = Duration::from_secs(2);

/// Reason why a sweep has no table.
#[derive(Debug, thiserror::Error)]
pub enum SweepOnError {
    /// The sweep or its table is at fault.
    #[error(transparent)]
    Sweep(#[from] SweepError),
    /// The other machines cannot be reached.
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    /// The bucket refuses a request.
    #[error("the bucket failed: {0}")]
    Record(String),
    /// No worker could make a part.
    #[error("part {part} was not made: {message}")]
    Part {
        /// The part, as `3/40`.
        part: String,
        /// Reason for that.
        message: String,
    },
}

impl SweepOnError {
    /// Returns whether the input is wrong, and not the execution.
    pub(crate) fn is_bad_input(&self) -> bool {
        match self {
            Self::Sweep(error) => error.is_bad_input(),
            Self::Cluster(error) => error.is_bad_input(),
            Self::Record(_) | Self::Part { .. } => false,
        }
    }
}

/// A part that a worker makes.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[allow(unreachable_pub, reason = "as open as what the macros make of its workflow")]
pub struct PartTask {
    /// Digest of the sweep.
    pub(super) digest: String,
    /// Build that is to make it: numbers of others may differ.
    pub(super) build: String,
    /// The part, as `3/40`.
    pub(super) part: String,
    pub(super) lease_s: f64,
}

impl PartTask {
    /// Returns the name of its object.
    pub(super) fn object(&self) -> String {
        let Self { digest, build, part, .. } = self;
        format!("sweeps/{digest}/{build}/{}.csv", part.replace('/', "-of-"))
    }
}

/// Returns the name of the object that holds a sweep.
pub(super) fn sweep_object(digest: &str) -> String {
    format!("sweeps/{digest}/sweep.json")
}

/// Has workers make the table of a sweep, or its missing parts. `watch` counts members.
///
/// # Errors
/// If the sweep asks for an accuracy; if bucket or Temporal do not answer at the start, a part is abandoned, or the table
/// cannot be written.
pub async fn sweep_on(
    config: &ClusterConfig,
    sweep: &Sweep,
    table: &Path,
    replaces: bool,
    watch: &Watch,
) -> Result<u64, SweepOnError> {
    if !replaces && table.symlink_metadata().is_ok() {
        return Err(SweepError::Exists { path: table.to_owned(), finished: true }.into());
    }
    let (seconds, _) = sweep.estimate().map_err(SweepError::from)?;
    let parts = ((seconds / PART_S).ceil() as u64).clamp(1, sweep.members().min(MOST_PARTS));
    let bucket = Bucket::open(&config.bucket).await.map_err(ClusterError::from)?;
    let client = connect(config).await?;
    let digest = sweep.digest();
    let failed = |error: &dyn std::error::Error| SweepOnError::Record(chain(error));
    bucket.keep(&sweep_object(&digest), sweep.to_json()).await.map_err(|error| failed(&error))?;
    watch.total.store(sweep.members(), Ordering::Relaxed);
    // They go next to the table, because they are as large as it.
    let folder = table.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let folder = tempfile::tempdir_in(folder)
        .map_err(|source| SweepOnError::Sweep(SweepError::io(table, "write", source)))?;
    let made = stream::iter(1..=parts).map(|number| {
        let task = PartTask {
            digest: digest.clone(),
            build: env!("VPD_BUILD").to_owned(),
            part: format!("{number}/{parts}"),
            lease_s: config.lease.as_secs_f64(),
        };
        let path = folder.path().join(format!("{number}.csv"));
        let (bucket, client) = (&bucket, &client);
        async move {
            let text = part(bucket, client, &config.queue, &task).await?;
            let members = text.iter().filter(|byte| **byte == b'\n').count().saturating_sub(2);
            watch.done.fetch_add(members as u64, Ordering::Relaxed);
            let written = fs::write(&path, text);
            written.map_err(|source| SweepError::io(&path, "write", source))?;
            Ok::<PathBuf, SweepOnError>(path)
        }
    });
    let paths: Vec<_> = made.buffered(UNDER_WAY).try_collect().await?;
    let members = sweep::merge(&paths, table, replaces)?;
    // The sweep is in the table now.
    if let Err(error) = bucket.drop_sweep(&digest).await {
        tracing::warn!(error = chain(&error), "parts of the sweep stay in the bucket");
    }
    Ok(members)
}

/// Returns the text of a part, made by a worker unless it exists.
async fn part(
    bucket: &Bucket,
    client: &Client,
    queue: &str,
    task: &PartTask,
) -> Result<Vec<u8>, SweepOnError> {
    let gave_up = |message: String| SweepOnError::Part { part: task.part.clone(), message };
    loop {
        match bucket.kept(&task.object()).await {
            Ok(Some(text)) => return Ok(text.into()),
            Ok(None) => {}
            Err(error) => return Err(SweepOnError::Record(chain(&error))),
        }
        let options = WorkflowStartOptions::new(queue, part_flow_id(task))
            .task_timeout(task_timeout(Duration::from_secs_f64(task.lease_s)))
            .id_conflict_policy(WorkflowIdConflictPolicy::UseExisting)
            .build();
        match client.start_workflow(Part::run, task.clone(), options).await {
            Ok(handle) => match handle.get_result(WorkflowGetResultOptions::default()).await {
                Ok(()) => continue,
                Err(error @ WorkflowGetResultError::Failed(_)) => {
                    return Err(gave_up(chain(&error)));
                }
                Err(error) => {
                    tracing::warn!(part = task.part, error = chain(&error), "asked again")
                }
            },
            // The part exists by now, or will.
            Err(WorkflowStartError::AlreadyStarted { .. }) => {}
            Err(error) => tracing::warn!(part = task.part, error = chain(&error), "asked again"),
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// Makes a part on this machine and returns its text. Blocking.
pub(super) fn make(
    text: &[u8],
    part: &str,
    scratch: &Path,
    watch: &Arc<Watch>,
) -> Result<Vec<u8>, SweepError> {
    let sweep = Sweep::from_json(text)?;
    let shard = part.parse::<Shard>().map_err(|message| {
        SweepError::Field(crate::scenario::ScenarioError::invalid("", message))
    })?;
    let failed = |source| SweepError::io(scratch, "write", source);
    let folder = tempfile::tempdir_in(scratch).map_err(failed)?;
    let table = folder.path().join("part.csv");
    let options = Options { threads: 1, shard: Some(shard), replaces: true };
    sweep::run(&sweep, &table, options, watch, |_| Ok::<_, SweepError>(()))?;
    fs::read(&table).map_err(failed)
}
