//! One job as the engine knows it, and as clients see it.
//!
//! ```text
//! queued → running → succeeded | failed | cancelled
//!    ↑        |
//!    └────────┘  the store refuses something for now, or a method and a step have been settled
//! ```

use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use chrono::{DateTime, Utc};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use uuid::Uuid;

use super::engine::Refusal;
use super::ids::{created, now};
use super::store::{Ending, LogSum, Record, Size, StoreError};
use crate::advise::Unsettled;
use crate::plan::Plan;
use crate::run::{Control, Outcome, Reason, RunError, Summary};
use crate::scenario::ScenarioError;

/// State of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[schemars(rename = "JobState")]
pub(super) enum State {
    Queued,
    Running,
    Succeeded,
    Failed,
    Cancelled,
}

impl State {
    /// All states, in the order of a job's life.
    pub(super) const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// Returns true once nothing more happens to the job.
    pub(super) fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// Returns the state in answers and queries.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

/// A job as seen from outside.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) id: Uuid,
    pub(super) name: String,
    pub(super) state: State,
    pub(super) created: Option<DateTime<Utc>>,
    pub(super) attempts: u32,
    pub(super) steps: u64,
    pub(super) steps_done: u64,
    pub(super) durable_step: u64,
    pub(super) eta_s: Option<f64>,
    pub(super) has_log: bool,
    /// Size and checksum of the finished log.
    pub(super) log: Option<LogSum>,
    /// Reason why it waits although a run of it began.
    pub(super) trouble: Option<Trouble>,
    pub(super) plan: Option<Box<RawValue>>,
    /// Its end; only where a single job is asked for.
    pub(super) record: Option<Record>,
}

#[derive(Debug)]
pub(super) enum Phase {
    Queued,
    Running {
        control: Arc<Control>,
        since: Instant,
    },
    /// Taken out of the queue: being cancelled or forgotten.
    Leaving,
    Ended {
        state: State,
        steps_done: u64,
        has_log: bool,
        log: Option<LogSum>,
    },
    /// Its record is damaged or out of reach: nothing is done with it, and it is looked at again at the next start.
    Aside(Fault),
}

/// Reason why a job waits although a run of it began: the store refused something that it may do
/// later.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub(super) struct Trouble {
    /// `storage_full`, `storage_moved` or `storage_error`.
    code: Cow<'static, str>,
    /// Operation that failed.
    message: String,
    /// Number of times in a row.
    times: u32,
}

impl Trouble {
    pub(super) fn new(code: &'static str, message: String) -> Self {
        Self { code: code.into(), message, times: 1 }
    }

    /// Counts one more in a row.
    pub(super) fn again(self, before: Option<&Self>) -> Self {
        Self { times: before.map_or(0, |before| before.times) + 1, ..self }
    }

    /// Returns the time that the job rests: longer each time, but not too long to wait for the next
    /// try.
    pub(super) fn pause(&self) -> Duration {
        const FIRST: Duration = Duration::from_millis(100);
        const LONGEST: Duration = Duration::from_secs(15);
        FIRST.saturating_mul(1 << self.times.min(16)).min(LONGEST)
    }
}

#[derive(Debug)]
pub(super) struct Job {
    pub(super) name: String,
    pub(super) attempts: u32,
    /// Whether the process ended during its last run: it is run in a process of its own.
    pub(super) suspect: bool,
    /// Whether a client stopped it.
    pub(super) cancelled: bool,
    /// The key under which the client sent it.
    pub(super) key: Option<Uuid>,
    /// Its size; `None` as long as its method and step are not settled.
    pub(super) size: Option<Size>,
    /// Bytes that its log is expected to take of the disk beyond those that earlier runs have
    /// written.
    pub(super) owed_bytes: u64,
    /// The plan as JSON, until the record holds it; as text, because there may be many jobs, and
    /// many clients.
    pub(super) plan: Option<Box<RawValue>>,
    pub(super) trouble: Option<Trouble>,
    pub(super) phase: Phase,
}

impl Size {
    pub(super) fn of(plan: &Plan) -> Self {
        let Plan { log_bytes, memory_bytes, .. } = *plan;
        Self { steps: plan.total_steps(), log_bytes, memory_bytes }
    }
}

impl Job {
    pub(super) fn new(name: &str, attempts: u32) -> Self {
        Self {
            name: name.to_owned(),
            attempts,
            suspect: false,
            cancelled: false,
            key: None,
            size: None,
            owed_bytes: 0,
            plan: None,
            trouble: None,
            phase: Phase::Queued,
        }
    }

    /// Returns the same job, planned.
    pub(super) fn planned(self, plan: &Plan) -> Self {
        let text = serde_json::value::to_raw_value(plan).ok();
        Self { size: Some(Size::of(plan)), plan: text, ..self }
    }

    pub(super) fn ended(ending: Ending) -> Self {
        let Ending { name, state, attempts, steps, steps_done, has_log, log, .. } = ending;
        Self {
            size: Some(Size { steps, log_bytes: 0, memory_bytes: 0 }),
            phase: Phase::Ended { state, steps_done, has_log, log },
            ..Self::new(&name, attempts)
        }
    }

    fn steps(&self) -> u64 {
        self.size.map_or(0, |size| size.steps)
    }

    /// Returns about how many bytes of `owed_bytes` are on the disk by now.
    pub(super) fn bytes_written(&self) -> u64 {
        let Phase::Running { control, .. } = &self.phase else { return 0 };
        let from = control.resumed_step.load(Ordering::Relaxed);
        let made = control.durable_step.load(Ordering::Relaxed).saturating_sub(from);
        let to_make = self.steps().saturating_sub(from).max(1);
        (self.owed_bytes as f64 * (made as f64 / to_make as f64).min(1.0)) as u64
    }

    /// Returns the bytes of memory that its run takes.
    pub(super) fn memory_bytes(&self) -> u64 {
        self.size.map_or(0, |size| size.memory_bytes)
    }

    pub(super) fn state(&self) -> State {
        match self.phase {
            Phase::Queued | Phase::Leaving => State::Queued,
            Phase::Running { .. } => State::Running,
            Phase::Ended { state, .. } => state,
            Phase::Aside(_) => State::Failed,
        }
    }

    pub(super) fn view(&self, id: Uuid) -> View {
        let (mut steps_done, mut durable_step, mut eta_s, mut has_log) = (0, 0, None, false);
        let mut sum = None;
        match &self.phase {
            Phase::Running { control, since } => {
                steps_done = control.steps_done.load(Ordering::Relaxed);
                let resumed_step = control.resumed_step.load(Ordering::Relaxed);
                // What an earlier run left is on the disk before this one adds to it.
                durable_step = control.durable_step.load(Ordering::Relaxed).max(resumed_step);
                let left = self.steps().saturating_sub(steps_done) as f64;
                let made = steps_done.saturating_sub(resumed_step);
                eta_s = (made > 0).then(|| since.elapsed().as_secs_f64() * left / made as f64);
            }
            Phase::Ended { steps_done: done, has_log: logged, log, .. } => {
                (steps_done, has_log) = (*done, *logged);
                durable_step = if has_log { steps_done } else { 0 };
                sum.clone_from(log);
            }
            Phase::Queued | Phase::Leaving | Phase::Aside(_) => {}
        }
        View {
            id,
            name: self.name.clone(),
            state: self.state(),
            created: created(id),
            attempts: self.attempts,
            steps: self.steps(),
            steps_done,
            durable_step,
            eta_s,
            has_log,
            log: sum,
            trouble: self.trouble.clone(),
            plan: self.plan.clone(),
            record: match &self.phase {
                Phase::Aside(fault) => {
                    Some(Record { finished: None, ..self.record(State::Failed, Some(fault)) })
                }
                _ => None,
            },
        }
    }

    /// Returns the record of a run that came to its end.
    pub(super) fn record_of(&self, summary: &Summary) -> Record {
        let state = match summary.outcome {
            Outcome::Succeeded => State::Succeeded,
            Outcome::Failed => State::Failed,
            Outcome::Cancelled => State::Cancelled,
        };
        let diagnosis =
            summary.diagnosis.as_ref().and_then(|found| serde_json::to_value(found).ok());
        let mut summary = serde_json::to_value(summary).unwrap_or_default();
        // The path of the log is internal; clients have a link.
        if let Some(summary) = summary.as_object_mut() {
            summary.remove("log");
        }
        Record { has_log: true, summary: Some(summary), diagnosis, ..self.record(state, None) }
    }

    /// Returns the record of an end without a summary.
    pub(super) fn record(&self, state: State, fault: Option<&Fault>) -> Record {
        Record {
            name: self.name.clone(),
            state,
            attempts: self.attempts,
            finished: Some(now()),
            steps: self.steps(),
            steps_done: 0,
            has_log: false,
            log: None,
            plan: self.plan.clone(),
            summary: None,
            diagnosis: fault.and_then(|fault| serde_json::to_value(fault).ok()),
        }
    }
}

/// Reason why a job ended without a summary of its run.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "JobFault")]
pub(super) struct Fault {
    /// The code; fixed.
    code: Cow<'static, str>,
    /// Description of what happened, for a person.
    message: String,
    /// Advice, for a person.
    advice: Cow<'static, str>,
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl Fault {
    fn new(code: &'static str, message: impl Into<String>) -> Self {
        let advice = match code {
            "record_damaged" => {
                "check the disk for errors and the permissions in the data directory; its content is left as it is, and read again at the next start"
            }
            "worker_crashed" => {
                "the job crashes its process: submit it with fewer samples or a smaller n, or report it"
            }
            "scenario_rejected" => {
                "submit the scenario again and correct the field that the answer names"
            }
            "accuracy_out_of_reach" => {
                "ask for a larger error or a shorter run, or give a method and a step"
            }
            "too_expensive" | "log_too_large" | "too_much_memory" => {
                "submit a shorter run, or one with fewer samples or members, or raise the limit of the service"
            }
            _ => "this is a fault of the program: report it with the scenario",
        };
        Self { code: code.into(), message: message.into(), advice: advice.into() }
    }

    pub(super) fn rejected(error: &ScenarioError) -> Self {
        Self::new(
            "scenario_rejected",
            format!("this build does not accept the stored scenario: {error}"),
        )
    }

    /// Returns the fault of an accuracy without a method and step; `None` if the search was
    /// stopped.
    pub(super) fn unsettled(error: &Unsettled) -> Option<Self> {
        match error {
            Unsettled::Cancelled => None,
            Unsettled::Refused(error) => Some(Self::rejected(error)),
            Unsettled::OutOfReach { .. } => {
                Some(Self::new("accuracy_out_of_reach", error.to_string()))
            }
        }
    }

    /// Returns the fault of a job beyond the limits of the service, which shows only once method
    /// and step are settled.
    pub(super) fn beyond(refusal: &Refusal) -> Self {
        Self::new(refusal.code(), refusal.to_string())
    }

    /// Returns the fault of a record that cannot be read: only the state of the job is left.
    pub(super) fn damaged(error: Option<&StoreError>) -> Self {
        let why = error.map_or_else(String::new, |error| format!(": the service {error}"));
        Self::new("record_damaged", format!("the record of this job cannot be used{why}"))
    }

    pub(super) fn worker_crashed() -> Self {
        Self::new(
            "worker_crashed",
            "the process ended in several runs of this job, without any progress",
        )
    }

    /// Returns whether the job is abandoned because its runs end their process.
    pub(super) fn is_of_the_process(&self) -> bool {
        self.code == "worker_crashed"
    }

    /// Returns the reason for the log.
    pub(super) fn reason(&self) -> Reason<'_> {
        Reason { code: &self.code, cause: &self.message, advice: &self.advice }
    }

    pub(super) fn panicked() -> Self {
        Self::new("internal", "the run panicked")
    }

    /// Returns the fault of a run. The cause may name files of the machine: it goes to the
    /// service's own log, not into the record.
    pub(super) fn run(error: &RunError) -> Self {
        Self::new(error.code(), "the run broke off")
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::Ordering;
    use std::time::Instant;

    use uuid::Uuid;

    use super::{Job, Phase};
    use crate::run::Control;

    #[test]
    fn what_an_earlier_run_left_is_on_the_disk() {
        let control = Arc::new(Control::default());
        let phase = Phase::Running { control: control.clone(), since: Instant::now() };
        let job = Job { phase, ..Job::new("dipole", 2) };
        let durable_step = || job.view(Uuid::nil()).durable_step;
        assert_eq!(durable_step(), 0);
        control.resumed_step.store(500, Ordering::Relaxed);
        assert_eq!(durable_step(), 500);
        control.durable_step.store(600, Ordering::Relaxed);
        assert_eq!(durable_step(), 600);
    }
}
