//! 5 · The log: what a job did, as an MCAP file that common viewers open.
//!
//! [`writer`] takes the samples of a trajectory and [`reader`] gives them back; [`inspect`] sums a
//! file up. What stands on which topic is in [`schema`], the messages are in [`messages`], and
//! [`scene`] draws the body and its surroundings, [`stretch`] reads a part of a log for drawing, [`samples`] a quantity over
//! time, [`members`] one of all members of an ensemble, [`rows`] all of each sample, [`columns`] all samples as arrays, `order` puts the messages of other programs' logs in the order of time, [`course`] keeps what charts show. [`resume`] resumes a
//! log that was interrupted.
//!
//! Invariant: a file named `.mcap` is finished and says how it ended. Until then it is named `.mcap.part`, and each of
//! its whole chunks ends with a checkpoint to go on from. Same inputs give the same bytes: no clock, thread or machine
//! shows in a log.

use std::io;
use std::path::{Path, PathBuf};

mod background;
pub mod columns;
mod container;
pub mod course;
mod curve;
mod end;
pub(crate) mod field;
pub mod inspect;
pub mod members;
pub mod messages;
pub(crate) mod order;
pub(crate) mod overview;
pub(crate) mod part;
pub mod reader;
pub mod resume;
pub mod rows;
pub mod samples;
pub mod scene;
pub mod schema;
mod spread;
pub mod stretch;
pub mod writer;

/// Opcode of the private record that ends a chunk: where an interrupted run goes on.
pub const CHECKPOINT_OPCODE: u8 = 0x80;
/// Name of the metadata record that comes first: scenario, plan, versions.
pub const JOB_RECORD: &str = "vpd.job";
/// Entry of that record with the names of several bodies, a list as JSON.
pub const BODIES_ENTRY: &str = "bodies";
/// Name of the metadata record that comes last and makes a log finished: how the job ended.
pub const OUTCOME_RECORD: &str = "vpd.outcome";
/// Beginning of the name of the library in the header of a log.
pub(crate) const LIBRARY_NAME: &str = "vpd/";
/// Name of the attachment that holds the scenario.
pub const SCENARIO_ATTACHMENT: &str = "scenario.json";
/// Prefix of the names of the attachments that hold the chart data of a long log, each a
/// `vpd.Overview`.
pub const OVERVIEW_ATTACHMENTS: &str = "overview/";

/// A layout of panels for these logs, for Foxglove and Lichtblick: both read the same.
pub const LAYOUT: &str = include_str!("log/layout.json");

/// The most bytes of a chunk before compression, and of any record. The writer keeps below it; the
/// reader allocates no more at once, whatever a damaged file asks for.
pub const MAX_CHUNK_BYTES: u64 = 32 << 20;

/// Error of a log.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The disk or the quota is full.
    #[error("no space left for the log {}: {source}", path.display())]
    StorageFull {
        /// The file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The file system failed in another way.
    #[error("cannot {action} the log {}: {source}", path.display())]
    Storage {
        /// The file.
        path: PathBuf,
        /// Operation that failed: "create", "write", ...
        action: &'static str,
        /// Error of the system.
        source: io::Error,
    },
    /// The folder in which it is to stand does not exist.
    #[error("cannot create the log {}: there is no folder {}; create it, or name another file with -o", path.display(), part::folder(path).display())]
    NoFolder {
        /// The file.
        path: PathBuf,
    },
    /// The MCAP layer refused for a reason other than the file system.
    #[error("cannot {action} the log {}: {source}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Operation that failed.
        action: &'static str,
        /// Error of the MCAP layer.
        source: mcap::McapError,
    },
    /// A time that a log cannot hold: negative, not a number, beyond the year 2106, or before the
    /// message that came last.
    #[error("the log cannot hold the time {time_s} s after its epoch {epoch_ns} ns")]
    Time {
        /// Seconds since the start.
        time_s: f64,
        /// Nanoseconds from 1970 to the start.
        epoch_ns: u64,
    },
    /// A sample holds an infinity or NaN, which plots cannot show.
    #[error("the sample of step {step} holds a value that is not finite")]
    NotFinite {
        /// The sample's step.
        step: u64,
    },
    /// The file at its place is to be kept: a finished log, or an unfinished one of another job.
    #[error("{} already exists{}; --force replaces it, -o names another file", path.display(), if *finished { "" } else { ", unfinished and of another scenario or build" })]
    Exists {
        /// The file.
        path: PathBuf,
        /// Whether it is a finished log.
        finished: bool,
    },
    /// What is at its place is no regular file.
    #[error("cannot write the log {}: it is {kind}, which nothing replaces; name a regular file, or run without a log: --no-log", path.display())]
    NoFile {
        /// The place.
        path: PathBuf,
        /// What is there: "a device", "a pipe", ...
        kind: &'static str,
    },
    /// A file of another program.
    #[error("{} is an MCAP file of another program ({}), not a log of vpd", path.display(), shown(library))]
    Foreign {
        /// The file.
        path: PathBuf,
        /// The library that wrote it, by its own word.
        library: String,
    },
    /// The file does not begin as a log does.
    #[error("{} is not a log: it does not begin like an MCAP file", path.display())]
    NotALog {
        /// The file.
        path: PathBuf,
    },
    /// Reading the log that an earlier run left was cancelled; nothing was changed.
    #[error("resuming the log {} was interrupted", path.display())]
    Interrupted {
        /// The file.
        path: PathBuf,
    },
    /// An earlier write failed; the log is abandoned.
    #[error("the log {} is abandoned: an earlier write failed", path.display())]
    GivenUp {
        /// The file.
        path: PathBuf,
    },
}

impl LogError {
    /// Returns the fixed code in answers and scripts.
    pub fn code(&self) -> &'static str {
        match self {
            Self::StorageFull { .. } => "storage_full",
            Self::Storage { .. } | Self::NoFolder { .. } => "storage_error",
            Self::Format { .. } => "log_format",
            Self::Time { .. } => "log_time",
            Self::NotFinite { .. } => "log_not_finite",
            Self::Exists { .. } => "log_exists",
            Self::NotALog { .. } | Self::Foreign { .. } => "not_a_log",
            Self::NoFile { .. } => "not_a_file",
            Self::Interrupted { .. } => "interrupted",
            Self::GivenUp { .. } => "log_given_up",
        }
    }

    /// Returns whether the file system may do later what it refused now.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::StorageFull { source, .. } | Self::Storage { source, .. } => is_transient(source),
            _ => false,
        }
    }

    /// Returns whether another process writes the log.
    pub fn is_busy(&self) -> bool {
        matches!(self, Self::Storage { source, .. } if part::is_busy(source))
    }

    fn io(path: &Path, action: &'static str, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                Self::StorageFull { path, source }
            }
            io::ErrorKind::NotFound if action == "create" && !part::folder(&path).is_dir() => {
                Self::NoFolder { path }
            }
            _ => Self::Storage { path, action, source },
        }
    }

    fn mcap(path: &Path, action: &'static str, source: mcap::McapError) -> Self {
        match source {
            mcap::McapError::Io(source) => Self::io(path, action, source),
            source => Self::Format { path: path.to_owned(), action, source },
        }
    }
}

/// Returns whether a refusal of the system is temporary (no room, no file handles, a disk that
/// fails) and not due to the file itself: trying again later may succeed.
pub(crate) fn is_transient(error: &io::Error) -> bool {
    use io::ErrorKind as K;
    // Those without a kind of their own: the limits of files, of the process and of the system, and a failing disk.
    #[cfg(unix)]
    {
        use rustix::io::Errno;
        let limits = [Errno::MFILE, Errno::NFILE, Errno::IO, Errno::NOBUFS, Errno::DQUOT];
        if limits.iter().any(|limit| error.raw_os_error() == Some(limit.raw_os_error())) {
            return true;
        }
    }
    matches!(
        error.kind(),
        K::StorageFull
            | K::QuotaExceeded
            | K::ReadOnlyFilesystem
            | K::StaleNetworkFileHandle
            | K::ResourceBusy
            | K::OutOfMemory
            | K::TimedOut
            | K::WouldBlock
            | K::Interrupted
    )
}

/// Returns a text of a file, which anyone may have written, as a terminal may show it: characters that steer it, or turn
/// the direction of writing, are escaped.
pub(crate) fn shown(text: &str) -> String {
    let steers = |c: char| {
        c.is_control()
            || matches!(c, '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{feff}')
    };
    let escaped = |c: char| if steers(c) { c.escape_unicode().to_string() } else { c.into() };
    text.chars().map(escaped).collect()
}

/// Returns the name of a log while it is being written: `.part` is added.
pub fn part_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    PathBuf::from(name)
}

/// Returns the log time of `time_s` after the epoch, in nanoseconds since 1970, rounded to the
/// nearest.
///
/// `None` if that is before the epoch, not a number, or beyond the 32-bit seconds (year 2106) of
/// the viewers' time stamps.
pub fn log_time(epoch_ns: u64, time_s: f64) -> Option<u64> {
    let since_ns = (time_s * 1e9).round();
    // 2^64, the first value that u64 does not hold.
    if !(0.0..18_446_744_073_709_551_616.0).contains(&since_ns) {
        return None;
    }
    let time_ns = epoch_ns.checked_add(since_ns as u64)?;
    (time_ns / 1_000_000_000 <= u64::from(u32::MAX)).then_some(time_ns)
}
