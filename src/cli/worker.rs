//! `vpd worker`: the arguments of a worker, and those by which service and workers find each other.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::CliError;
use super::serve::LogFormat;
use crate::serve::Limits;

/// Whether this program can work with other machines.
pub(super) const CLUSTER: bool = cfg!(feature = "cluster");

/// Addresses of the other machines. A program without the feature hides these, and says so if they
/// are given.
#[derive(Debug, Args)]
#[cfg_attr(not(feature = "cluster"), allow(dead_code, reason = "refused where they are given"))]
pub(super) struct ClusterArgs {
    /// The record that service and workers share: s3://NAME/PREFIX, with credentials in AWS_ACCESS_KEY_ID and its like, or
    /// file:///DIRECTORY on a file system of all machines.
    #[arg(long, env = "VPD_BUCKET", hide = !CLUSTER, value_name = "URL")]
    pub(super) bucket: Option<String>,
    /// Address of Temporal, as 127.0.0.1:7233; namespace, key and certificates are in TEMPORAL_NAMESPACE and its like.
    #[arg(long, env = "TEMPORAL_ADDRESS", hide = !CLUSTER, value_name = "ADDRESS")]
    pub(super) temporal: Option<String>,
    /// Name of Temporal's task queue, the same for service and workers; 1 to 200 bytes.
    #[arg(long, env = "VPD_TASK_QUEUE", default_value = "vpd", value_parser = queue, hide = !CLUSTER, value_name = "NAME")]
    pub(super) task_queue: String,
}

fn queue(text: &str) -> Result<String, String> {
    /// Temporal refuses names longer than 1000 bytes, and may be told to refuse shorter ones.
    const MOST: usize = 200;
    match text.len() {
        1..=MOST => Ok(text.to_owned()),
        bytes => Err(format!("a name of {bytes} bytes given, 1 to {MOST} are allowed")),
    }
}

#[cfg(feature = "cluster")]
impl ClusterArgs {
    /// Returns the configuration, if everything needed was given.
    pub(super) fn config(&self, lease_s: f64) -> Result<crate::serve::ClusterConfig, CliError> {
        let needed = |given: &Option<String>, wanted| {
            let given = given.clone().filter(|given| !given.is_empty());
            given.ok_or(CliError::Needed { wanted })
        };
        Ok(crate::serve::ClusterConfig {
            bucket: needed(&self.bucket, "--bucket URL (or VPD_BUCKET)")?,
            temporal: needed(&self.temporal, "--temporal ADDRESS (or TEMPORAL_ADDRESS)")?,
            queue: self.task_queue.clone(),
            lease: std::time::Duration::from_secs_f64(lease_s),
        })
    }
}

#[derive(Debug, Args)]
#[cfg_attr(not(feature = "cluster"), allow(dead_code, reason = "refused where they are given"))]
pub(super) struct WorkerArgs {
    #[command(flatten)]
    cluster: ClusterArgs,
    /// Directory for logs that are being written, of this worker alone; nothing in it is missed.
    #[arg(long, env = "VPD_SCRATCH", default_value = "vpd-scratch", value_name = "DIR")]
    scratch: PathBuf,
    /// Jobs that run at once; one a core by default.
    #[arg(long, env = "VPD_WORKERS", value_name = "N")]
    workers: Option<NonZeroUsize>,
    /// Longest job that is taken, in seconds of estimated computing.
    #[arg(long, env = "VPD_MAX_RUN_S", default_value_t = Limits::default().run_s, value_name = "S")]
    max_run_s: f64,
    /// Largest log that is taken on, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_LOG_BYTES", default_value_t = Limits::default().log_bytes, value_name = "N")]
    max_log_bytes: u64,
    /// Memory that one run may take, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_MEMORY_BYTES", default_value_t = Limits::default().memory_bytes, value_name = "N")]
    max_memory_bytes: u64,
    /// How the worker's own log is written, on stderr: text, or JSON with one object a line.
    #[arg(long, env = "VPD_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
}

/// Works until it is asked to stop.
#[cfg(feature = "cluster")]
pub(super) fn work(args: &WorkerArgs) -> Result<ExitCode, CliError> {
    use super::serve::{own_log, program, stop_signal, tell_of_lost_lines};
    use crate::serve::{self, ServeError, WorkConfig};
    let (_rest, lost) = own_log(args.log_format);
    let workers = args.workers.or_else(|| std::thread::available_parallelism().ok());
    let config = WorkConfig {
        // Each job names the length of its lease.
        cluster: args.cluster.config(0.0)?,
        scratch: args.scratch.clone(),
        workers: workers.map_or(1, NonZeroUsize::get),
        limits: Limits {
            run_s: args.max_run_s,
            log_bytes: args.max_log_bytes,
            memory_bytes: args.max_memory_bytes,
            ..Limits::default()
        },
        program: program(),
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let worked = runtime.block_on(async {
        let stop = stop_signal().map_err(ServeError::System)?;
        tokio::spawn(tell_of_lost_lines(lost));
        serve::work(config, stop).await?;
        Ok(ExitCode::SUCCESS)
    });
    runtime.shutdown_background();
    worked
}

/// Returns an error that names the missing feature.
#[cfg(not(feature = "cluster"))]
pub(super) fn work(_: &WorkerArgs) -> Result<ExitCode, CliError> {
    Err(CliError::Feature { wanted: "vpd worker", feature: "cluster" })
}
