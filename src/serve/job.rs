//! One job as the engine knows it, and as clients see it.
//!
//! ```text
//! queued → running → succeeded | failed | cancelled
//! ```

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use chrono::{DateTime, SubsecRound, Utc};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use uuid::Uuid;

use super::store::{Ending, Record, StoreError};
use crate::plan::Plan;
use crate::run::{Control, Reason, RunError};
use crate::scenario::{Scenario, ScenarioError};

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum State {
    Queued,
    Running,
    Succeeded,
    Failed,
    Cancelled,
}

impl State {
    /// All of them, in the order of a job's life.
    pub(super) const ALL: [Self; 5] =
        [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// True once nothing more happens to the job.
    pub(super) fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// The state in answers and queries.
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
    pub(super) plan: Option<Box<RawValue>>,
    /// How it ended; only where a single job is asked for.
    pub(super) record: Option<Record>,
}

#[derive(Debug)]
pub(super) enum Phase {
    Queued,
    Running {
        control: Arc<Control>,
        since: Instant,
    },
    /// Out of the queue: being cancelled or forgotten.
    Leaving,
    Ended {
        state: State,
        steps_done: u64,
        has_log: bool,
    },
}

#[derive(Debug)]
pub(super) struct Job {
    pub(super) name: String,
    pub(super) attempts: u32,
    /// Whether the last run ended with its process and without having come further.
    pub(super) suspect: bool,
    /// It ends its process, time and again: it is not run, its log is given an end; so often that was tried.
    pub(super) given_up: Option<u32>,
    /// Whether a client stopped it before the process ended.
    pub(super) cancelled: bool,
    /// The key under which the client sent it.
    pub(super) key: Option<Uuid>,
    pub(super) steps: u64,
    /// The step up to which earlier runs have written its log.
    pub(super) came_to: u64,
    /// The plan as JSON, until the record holds it; as text, for there may be many jobs, and many who ask.
    pub(super) plan: Option<Box<RawValue>>,
    /// What its log is expected to take of the disk beyond what earlier runs have written.
    pub(super) log_bytes: u64,
    pub(super) phase: Phase,
}

impl Job {
    pub(super) fn new(scenario: &Scenario, plan: &Plan, attempts: u32) -> Self {
        Self {
            name: scenario.name().to_owned(),
            attempts,
            suspect: false,
            given_up: None,
            cancelled: false,
            key: None,
            steps: plan.total_steps(),
            came_to: 0,
            plan: serde_json::value::to_raw_value(plan).ok(),
            log_bytes: plan.log_bytes,
            phase: Phase::Queued,
        }
    }

    /// The same job, of whose log the beginning is on the disk.
    pub(super) fn come_to(self, step: u64) -> Self {
        let left = self.steps.saturating_sub(step) as f64 / self.steps.max(1) as f64;
        Self { came_to: step, log_bytes: (self.log_bytes as f64 * left) as u64, ..self }
    }

    /// A job whose scenario cannot be read.
    pub(super) fn unnamed(attempts: u32) -> Self {
        Self {
            name: String::new(),
            attempts,
            suspect: false,
            given_up: None,
            cancelled: false,
            key: None,
            steps: 0,
            came_to: 0,
            plan: None,
            log_bytes: 0,
            phase: Phase::Leaving,
        }
    }

    pub(super) fn ended(ending: Ending) -> Self {
        let Ending { name, state, attempts, steps, steps_done, has_log, .. } = ending;
        Self {
            name,
            steps,
            phase: Phase::Ended { state, steps_done, has_log },
            ..Self::unnamed(attempts)
        }
    }

    pub(super) fn state(&self) -> State {
        match self.phase {
            Phase::Queued | Phase::Leaving => State::Queued,
            Phase::Running { .. } => State::Running,
            Phase::Ended { state, .. } => state,
        }
    }

    /// How much of `log_bytes` is on the disk by now, about.
    pub(super) fn bytes_written(&self) -> u64 {
        let Phase::Running { control, .. } = &self.phase else { return 0 };
        let made = control.durable_step.load(Ordering::Relaxed).saturating_sub(self.came_to);
        let to_make = self.steps.saturating_sub(self.came_to).max(1);
        (self.log_bytes as f64 * (made as f64 / to_make as f64).min(1.0)) as u64
    }

    /// Whether the job runs and may yet be what ended the process.
    pub(super) fn is_suspect(&self) -> bool {
        match &self.phase {
            Phase::Running { control, .. } => {
                let came_from = control.resumed_step.load(Ordering::Relaxed);
                self.suspect && control.durable_step.load(Ordering::Relaxed) <= came_from
            }
            _ => false,
        }
    }

    pub(super) fn view(&self, id: Uuid) -> View {
        let (mut steps_done, mut durable_step, mut eta_s, mut has_log) = (0, 0, None, false);
        match &self.phase {
            Phase::Running { control, since } => {
                steps_done = control.steps_done.load(Ordering::Relaxed);
                durable_step = control.durable_step.load(Ordering::Relaxed);
                let left = self.steps.saturating_sub(steps_done) as f64;
                let made = steps_done.saturating_sub(control.resumed_step.load(Ordering::Relaxed));
                eta_s = (made > 0).then(|| since.elapsed().as_secs_f64() * left / made as f64);
            }
            Phase::Ended { steps_done: done, has_log: log, .. } => {
                (steps_done, has_log) = (*done, *log);
                durable_step = if has_log { steps_done } else { 0 };
            }
            Phase::Queued | Phase::Leaving => {}
        }
        View {
            id,
            name: self.name.clone(),
            state: self.state(),
            created: created(id),
            attempts: self.attempts,
            steps: self.steps,
            steps_done,
            durable_step,
            eta_s,
            has_log,
            plan: self.plan.clone(),
            record: None,
        }
    }

    /// The record of an end without a summary.
    pub(super) fn record(&self, state: State, fault: Option<&Fault>) -> Record {
        Record {
            name: self.name.clone(),
            state,
            attempts: self.attempts,
            finished: Some(Utc::now().trunc_subsecs(3)),
            steps: self.steps,
            steps_done: 0,
            has_log: false,
            plan: self.plan.clone(),
            summary: None,
            diagnosis: fault.and_then(|fault| serde_json::to_value(fault).ok()),
        }
    }
}

/// When a job or a study was taken: its id says it.
pub(super) fn created(id: Uuid) -> Option<DateTime<Utc>> {
    let (seconds, nanos) = id.get_timestamp()?.to_unix();
    DateTime::from_timestamp(i64::try_from(seconds).ok()?, nanos)
}

/// Why a job ended without a summary of its run.
#[derive(Debug, Serialize)]
pub(super) struct Fault {
    code: &'static str,
    message: String,
    advice: &'static str,
}

impl Fault {
    fn new(code: &'static str, message: impl Into<String>) -> Self {
        let advice = match code {
            "storage_full" => {
                "free space on the disk of the data directory, then submit the job again"
            }
            "storage_error" => {
                "look for disk errors in the log of the service, then submit the job again"
            }
            "worker_crashed" => {
                "the job ends its process: submit it with fewer samples or a smaller n, or report it"
            }
            "record_damaged" => "look for disk errors; if the job has a log, its outcome is there",
            "scenario_rejected" => "submit the scenario again and mend what the answer names",
            _ => "this is a fault of the program: report it with the scenario",
        };
        Self { code, message: message.into(), advice }
    }

    pub(super) fn storage(error: &StoreError) -> Self {
        Self::new(error.code(), format!("the service {error}"))
    }

    pub(super) fn rejected(error: &ScenarioError) -> Self {
        Self::new(
            "scenario_rejected",
            format!("this build does not take the kept scenario: {error}"),
        )
    }

    /// A record that cannot be read: what is left of the job is its state.
    pub(super) fn damaged() -> Self {
        Self::new("record_damaged", "the result of this job cannot be read")
    }

    pub(super) fn worker_crashed() -> Self {
        Self::new(
            "worker_crashed",
            "the process ended in several runs of this job, without any progress",
        )
    }

    /// For the log.
    pub(super) fn reason(&self) -> Reason<'_> {
        Reason { code: self.code, cause: &self.message, advice: self.advice }
    }

    pub(super) fn panicked() -> Self {
        Self::new("internal", "the run panicked")
    }

    /// The cause may name files of the machine: it goes to the service's own log, not into the record.
    pub(super) fn run(error: &RunError) -> Self {
        let message = match error.code() {
            "storage_full" => "the disk filled up while the log was written",
            "storage_error" => "the log could not be written",
            _ => "the run broke off",
        };
        Self::new(error.code(), message)
    }
}
