//! Runs the job inside a log again and compares every sample, bit for bit.
//!
//! Invariant: a log is called the same only if it is finished and each of its samples was met again.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread;

use serde::Serialize;
use thiserror::Error;

use crate::advise::Settled;
use crate::log::order::{is_foreign_log, read_sorted};
use crate::log::reader::{self, Item};
use crate::log::schema::{Channel, Topic};
use crate::log::{JOB_RECORD, LogError, OUTCOME_RECORD, SCENARIO_ATTACHMENT, shown};
use crate::run::{self, Control, JobContext, RunError};
use crate::scenario::{Scenario, ScenarioError};

/// Number of messages that are passed between the readers at once.
const BATCH: usize = 256;

/// Result of a verification.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Verification {
    /// Whether every sample is the same.
    pub same: bool,
    /// Messages that were compared and found the same.
    pub messages: u64,
    /// End of the job in the log.
    pub state: String,
    /// The first difference of the logs.
    pub difference: Option<Difference>,
    /// The build that wrote the log, and this one.
    pub builds: [String; 2],
}

/// Difference of two logs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// The topic of the message in the log; of the new one if the log has no more.
    pub topic: String,
    /// Its time since the start of the log, in seconds.
    pub time_s: f64,
    /// Part in which it differs.
    pub what: &'static str,
}

/// Reason why a log cannot be verified.
#[derive(Debug, Error)]
pub enum VerifyError {
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// It is not whole: how its job ended is unknown.
    #[error("the log is not finished: {damage}")]
    Unfinished {
        /// Damage at its end.
        damage: String,
    },
    /// The scenario or the outcome is missing.
    #[error("the log holds no {what}")]
    Missing {
        /// The missing part.
        what: &'static str,
    },
    /// This build does not take the scenario.
    #[error("this build does not accept the scenario of the log: {0}")]
    Scenario(#[from] ScenarioError),
    /// It is of an ensemble that was stopped: how far each of its threads came is not known.
    #[error("an ensemble that was cancelled cannot be repeated up to the same place")]
    Cancelled,
    /// The job could not be run.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The second log cannot be placed.
    #[error("cannot create a temporary directory: {0}")]
    Place(#[from] std::io::Error),
}

/// Runs the job of `log` again, into a temporary directory, and compares. Blocks.
///
/// # Errors
/// If the log is not finished, or its job cannot be run here.
pub fn verify(log: &Path) -> Result<Verification, VerifyError> {
    Repetition::of(log)?.run()
}

/// The job of a log, to be run again.
#[derive(Debug)]
pub struct Repetition {
    log: PathBuf,
    kept: Kept,
    control: Control,
}

impl Repetition {
    /// Reads what a log says of its job.
    ///
    /// # Errors
    /// If the log is not finished, or does not say how its job can be run again.
    pub fn of(log: &Path) -> Result<Self, VerifyError> {
        let kept = kept(log)?;
        let mut control = Control::default();
        if kept.state() == "cancelled" {
            if kept.scenario.ensemble.is_some() {
                return Err(VerifyError::Cancelled);
            }
            // The whole job is run again, because an accuracy chooses its step by how far the job was
            // to go.
            let steps = kept.outcome.get("steps").and_then(|steps| steps.parse().ok());
            let missing = VerifyError::Missing { what: "number of steps" };
            control.cancelled_at = Some(steps.ok_or(missing)?);
        }
        Ok(Self { log: log.to_owned(), kept, control })
    }

    /// Returns the handle to follow and interrupt it from other threads.
    pub fn control(&self) -> &Control {
        &self.control
    }

    /// Runs the job into a temporary directory, and compares. Blocks.
    ///
    /// # Errors
    /// If it cannot be run here, or is interrupted.
    pub fn run(&self) -> Result<Verification, VerifyError> {
        let Self { log, kept: Kept { scenario, build, .. }, control } = self;
        let place = tempfile::tempdir()?;
        let again = place.path().join("again.mcap");
        let plan =
            Settled::new(scenario, &control.settling).map_err(ScenarioError::from)?.plan()?;
        run::execute(&plan, &JobContext { log: &again, control })?;
        let (messages, difference) = compare(log, &again)?;
        let builds = [build.clone(), env!("VPD_BUILD").to_owned()];
        let state = self.kept.state().to_owned();
        Ok(Verification { same: difference.is_none(), messages, state, difference, builds })
    }
}

/// Records of a log about its job.
#[derive(Debug)]
struct Kept {
    scenario: Scenario,
    outcome: BTreeMap<String, String>,
    build: String,
}

impl Kept {
    /// Returns how the job ended.
    fn state(&self) -> &str {
        self.outcome.get("state").map_or("", String::as_str)
    }
}

fn kept(log: &Path) -> Result<Kept, VerifyError> {
    let (mut scenario, mut outcome, mut build) = (None, None, String::new());
    let ending = reader::read(log, |item| {
        match item {
            Item::Attachment { name: SCENARIO_ATTACHMENT, data } => {
                scenario = Some(Scenario::from_json(data));
            }
            Item::Metadata { name: OUTCOME_RECORD, entries } => outcome = Some(entries.clone()),
            Item::Metadata { name: JOB_RECORD, entries } => {
                build = entries.get("vpd_build").cloned().unwrap_or_default();
            }
            _ => {}
        }
        ControlFlow::Continue(())
    })?;
    if !ending.finished {
        let damage = ending.damage.unwrap_or_default();
        return Err(VerifyError::Unfinished { damage });
    }
    Ok(Kept {
        scenario: scenario.ok_or(VerifyError::Missing { what: "scenario" })??,
        outcome: outcome.ok_or(VerifyError::Missing { what: "outcome" })?,
        build,
    })
}

/// A message of a sample or of the scene.
#[derive(PartialEq)]
struct Entry {
    topic: Topic,
    time_ns: u64,
    data: Vec<u8>,
}

/// Compares two logs message by message: returns how many are the same from the start, and the
/// first difference.
fn compare(log: &Path, again: &Path) -> Result<(u64, Option<Difference>), LogError> {
    // Both in the same order: another program may have put the messages of the log in one of its own.
    let sorted = is_foreign_log(log)?;
    thread::scope(|scope| {
        let (send, kept) = sync_channel(4);
        let (send_again, made) = sync_channel(4);
        let readers = [
            scope.spawn(move || send_all(log, sorted, &send)),
            scope.spawn(move || send_all(again, sorted, &send_again)),
        ];
        let compared = meet(kept.iter().flatten(), made.iter().flatten());
        // A reader without a receiver stops.
        drop((kept, made));
        for reader in readers {
            reader.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        }
        Ok(compared)
    })
}

fn meet(
    mut kept: impl Iterator<Item = Entry>,
    mut made: impl Iterator<Item = Entry>,
) -> (u64, Option<Difference>) {
    let mut start_ns = None;
    let mut same = 0;
    loop {
        let (old, new) = (kept.next(), made.next());
        if let Some(entry) = &old {
            start_ns.get_or_insert(entry.time_ns);
        }
        let (entry, what) = match (old, new) {
            (None, None) => return (same, None),
            (Some(old), None) => (old, "the new run has no such message"),
            (None, Some(new)) => (new, "the log has no such message"),
            (Some(old), Some(new)) if old == new => {
                same += 1;
                continue;
            }
            (Some(old), Some(new)) if old.topic != new.topic => (old, "topic"),
            (Some(old), Some(new)) if old.time_ns != new.time_ns => (old, "time"),
            (Some(old), Some(_)) => (old, "content"),
        };
        let since_ns = entry.time_ns.saturating_sub(start_ns.unwrap_or(entry.time_ns));
        let topic = entry.topic.name();
        return (same, Some(Difference { topic, time_s: since_ns as f64 * 1e-9, what }));
    }
}

/// Sends the messages of a log, but for its lines about the job.
fn send_all(log: &Path, sorted: bool, out: &SyncSender<Vec<Entry>>) -> Result<(), LogError> {
    let mut batch = Vec::with_capacity(BATCH);
    let mut visit = |item: Item<'_>| {
        let Item::Message { topic, time_ns, data, .. } = item else {
            return ControlFlow::Continue(());
        };
        match Topic::parse(topic) {
            Some(topic) if topic.member == 0 && topic.channel != Channel::Log => {
                batch.push(Entry { topic, time_ns, data: data.to_vec() });
            }
            _ => return ControlFlow::Continue(()),
        }
        if batch.len() < BATCH || out.send(std::mem::take(&mut batch)).is_ok() {
            ControlFlow::Continue(())
        } else {
            ControlFlow::Break(())
        }
    };
    if sorted {
        read_sorted(log, &mut visit)?
    } else {
        reader::read(log, &mut visit)?
    };
    // The receiver is gone once a difference was found.
    let _ = out.send(batch);
    Ok(())
}

impl fmt::Display for Verification {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [there, here] = &self.builds;
        match &self.difference {
            None => writeln!(f, "the same        {} messages, bit for bit", self.messages)?,
            Some(Difference { topic, time_s, what }) => {
                writeln!(f, "not the same    {topic} at t = {time_s} s: {what}")?;
                writeln!(f, "before that     {} messages are the same", self.messages)?;
            }
        }
        let [there, here] = [there, here].map(|build| shown(build));
        writeln!(f, "outcome         {}", shown(&self.state))?;
        if there == here {
            write!(f, "build           {here}, the one that wrote the log")
        } else {
            write!(f, "build           {here}; the log was written by {there}")
        }
    }
}
