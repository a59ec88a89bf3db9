//! What the processes of `vpd serve` and `vpd worker` share: the arguments by which they find each other, their own log, the
//! signals.

use std::io::{self, IsTerminal};
use std::path::PathBuf;
use std::sync::OnceLock;
use std::time::Duration;

use clap::{Args, ValueEnum};
use tracing::level_filters::LevelFilter;
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

#[cfg(feature = "cluster")]
use super::CliError;

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

/// Format of the service's own log.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum LogFormat {
    Text,
    Json,
}

/// Lines of the service's own log that wait to be written; more are lost, and counted.
const LOG_LINES: usize = 10_000;

/// Pause between checks for lost lines.
const LOST_LINES_PAUSE: Duration = Duration::from_secs(10);

/// Starts the service's own log. The rest of it is written when the guard is dropped.
pub(super) fn own_log(format: LogFormat) -> (WorkerGuard, ErrorCounter) {
    let asked = std::env::var("RUST_LOG").unwrap_or_default();
    let (filter, refused) = match detail(&asked) {
        Ok(filter) => (filter, None),
        Err(refused) => (Targets::new().with_default(LevelFilter::INFO), Some(refused)),
    };
    // Written by a thread of its own: a stderr that is not read must not stall the threads that answer.
    let (out, rest) =
        NonBlockingBuilder::default().buffered_lines_limit(LOG_LINES).finish(io::stderr());
    let lost = out.error_counter();
    let log = tracing_subscriber::fmt()
        .with_max_level(LevelFilter::TRACE)
        .with_writer(out)
        // A closed stderr must not turn a line of the log into a panic.
        .log_internal_errors(false)
        .with_ansi(io::stderr().is_terminal());
    match format {
        LogFormat::Text => log.finish().with(filter).init(),
        LogFormat::Json => log.json().finish().with(filter).init(),
    }
    if let Some(refused) = refused {
        tracing::warn!(
            "RUST_LOG is not used: {refused:?} given, levels and targets with a level are allowed, as in `debug` or `vpd=trace,info`"
        );
    }
    (rest, lost)
}

/// Parses the value of `RUST_LOG`, levels and targets with a level: `vpd=trace,info`. Without a
/// level, info.
///
/// # Errors
/// The part that is neither.
fn detail(asked: &str) -> Result<Targets, &str> {
    let mut targets = Targets::new().with_default(LevelFilter::INFO);
    for part in asked.split(',').map(str::trim).filter(|part| !part.is_empty()) {
        let (target, level) = part.split_once('=').map_or((None, part), |(t, l)| (Some(t), l));
        let level: LevelFilter = level.parse().map_err(|_| part)?;
        let is_target = |c: char| c.is_alphanumeric() || "_:-".contains(c);
        targets = match target {
            None => targets.with_default(level),
            Some(target) if !target.is_empty() && target.chars().all(is_target) => {
                targets.with_target(target, level)
            }
            Some(_) => return Err(part),
        };
    }
    Ok(targets)
}

/// The program in place of this process, which is that of another.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Names the program to be started for a separate process.
pub(super) fn set_program(program: PathBuf) {
    // The first name stays: a process is one program.
    let _ = PROGRAM.set(program);
}

/// Returns the path of this program, to start others like it.
pub(super) fn program() -> Option<PathBuf> {
    if let Some(program) = PROGRAM.get() {
        return Some(program.clone());
    }
    // This works even if the file was replaced since.
    if cfg!(target_os = "linux") {
        Some("/proc/self/exe".into())
    } else {
        std::env::current_exe().ok()
    }
}

/// Reports in the service's own log how many of its lines were dropped, each time there are more.
pub(super) async fn tell_of_lost_lines(lost: ErrorCounter) {
    let mut reported = 0;
    loop {
        tokio::time::sleep(LOST_LINES_PAUSE).await;
        let lines = lost.dropped_lines();
        if lines > reported {
            reported = lines;
            tracing::warn!(lines, "lines of this log are lost: they were not read in time");
        }
    }
}

/// Ends when the process is asked to stop: SIGTERM or ctrl-c. From this call on neither ends the process by itself.
#[cfg(unix)]
pub(super) fn stop_signal() -> io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) =
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

/// Ends when the process is asked to stop by ctrl-c. From this call on that does not end the process by itself.
#[cfg(not(unix))]
pub(super) fn stop_signal() -> io::Result<impl Future<Output = ()>> {
    let mut interrupt = tokio::signal::windows::ctrl_c()?;
    Ok(async move {
        interrupt.recv().await;
    })
}

#[cfg(test)]
mod tests {
    use super::detail;

    #[test]
    fn rust_log_takes_levels_and_targets_with_a_level() {
        let level = |asked: &str, target: &str| {
            let targets = detail(asked).expect("usable");
            [tracing::Level::INFO, tracing::Level::DEBUG].map(|l| targets.would_enable(target, &l))
        };
        assert_eq!(level("", "vpd"), [true, false]);
        assert_eq!(level("debug", "vpd"), [true, true]);
        assert_eq!(level(" vpd=debug, warn", "vpd::serve"), [true, true]);
        assert_eq!(level("vpd=debug,warn", "hyper"), [false, false]);
        assert_eq!(level("off", "vpd"), [false, false]);
        for unusable in ["bogus", "[[[", "=,=", "vpd=loud", "debug,vpd=loud", "vpd[job]=debug"] {
            assert!(detail(unusable).is_err(), "{unusable}");
        }
    }
}
