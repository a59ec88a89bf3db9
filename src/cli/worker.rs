//! `vpd worker`: the arguments of a worker, and what it does.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::Args;

use super::process::{ClusterArgs, LogFormat};
use super::{CliError, Status};
use crate::serve::Limits;

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
pub(super) fn work(args: &WorkerArgs) -> Result<Status, CliError> {
    use super::process::{own_log, program, stop_signal, tell_of_lost_lines};
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
        Ok(Status::SUCCESS)
    });
    runtime.shutdown_background();
    worked
}

/// Returns an error that names the missing feature.
#[cfg(not(feature = "cluster"))]
pub(super) fn work(_: &WorkerArgs) -> Result<Status, CliError> {
    Err(CliError::Feature { wanted: "vpd worker", feature: "cluster" })
}
