//! The worker: takes a job from the queue, runs it, publishes how it ended.
//!
//! Invariant: whatever happens in a run (a failure, a full disk, a panic), the thread goes on and the job gets
//! exactly one result, or none if the service stops, so that it runs again.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::Shared;
use crate::run::{JobContext, Outcome, Summary, execute};
use crate::scenario::Scenario;
use crate::serve::chain;
use crate::serve::job::{Control, Fault, Job, Phase, State};
use crate::serve::store::{Record, StoreError};

/// Pause between attempts to write a result: long enough not to spin, short enough to notice space
/// that returns.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// A job in the hands of a worker.
struct Task {
    id: Uuid,
    attempt: u32,
    control: Arc<Control>,
}

impl Shared {
    /// The life of a worker thread.
    pub(super) fn work(&self) {
        while let Some(task) = self.next() {
            let caught = catch_unwind(AssertUnwindSafe(|| self.run(&task)));
            let result = caught.unwrap_or_else(|_| Err(Fault::panicked()));
            self.conclude(&task, result);
        }
    }

    /// The oldest waiting job, marked as running; none once the service stops.
    fn next(&self) -> Option<Task> {
        let mut index = self.index();
        loop {
            index.alive.as_ref()?;
            let id = index.queue.pop_front();
            if let Some(id) = id
                && let Some(job) = index.jobs.get_mut(&id)
            {
                let control = Arc::new(Control::default());
                job.attempts += 1;
                job.phase = Phase::Running {
                    control: control.clone(),
                    since: Instant::now(),
                    unwanted: false,
                };
                return Some(Task { id, attempt: job.attempts, control });
            }
            if id.is_none() {
                index = self.work.wait(index).unwrap_or_else(std::sync::PoisonError::into_inner);
            }
        }
    }

    fn run(&self, task: &Task) -> Result<Summary, Fault> {
        let Task { id, attempt, control } = task;
        let storage = |error: StoreError| {
            tracing::error!(job = %id, error = chain(&error), "store failed");
            Fault::storage(&error)
        };
        tracing::info!(job = %id, attempt, "job runs");
        self.store.remove_leftovers(*id).map_err(storage)?;
        self.runtime.block_on(self.store.begin_attempt(*id, *attempt)).map_err(storage)?;
        let text = self.runtime.block_on(self.store.scenario(*id)).map_err(storage)?;
        let scenario = Scenario::from_json(&text).map_err(|error| Fault::rejected(&error))?;
        let log = self.store.log_path(*id);
        let context = JobContext {
            log: &log,
            steps_done: &control.steps_done,
            cancelled: &control.cancelled,
        };
        execute(&scenario, &context).map_err(|error| {
            tracing::error!(job = %id, error = chain(&error), "run broke off");
            Fault::run(&error)
        })
    }

    fn conclude(&self, task: &Task, result: Result<Summary, Fault>) {
        let Task { id, attempt, control } = task;
        let Some((record, unwanted)) = self.record(task, &result) else { return };
        let stopping = self.index().alive.is_none();
        if record.state == State::Cancelled && stopping && !unwanted {
            return self.hand_back(*id, *attempt);
        }
        if !record.has_log
            && let Err(error) = self.store.remove_leftovers(*id)
        {
            tracing::warn!(job = %id, error = chain(&error), "rubbish stays beside the job");
        }
        match self.publish(*id, &record) {
            Some(record) => {
                let steps_done = control.steps_done.load(Ordering::Relaxed);
                tracing::info!(job = %id, attempt, steps_done, state = ?record.state, "job ended");
                self.index().jobs.insert(*id, Job::ended(&record));
            }
            None => self.hand_back(*id, *attempt),
        }
    }

    /// What to publish, and whether a client wanted the job stopped.
    fn record(&self, task: &Task, result: &Result<Summary, Fault>) -> Option<(Record, bool)> {
        let index = self.index();
        let job = index.jobs.get(&task.id)?;
        let unwanted = matches!(job.phase, Phase::Running { unwanted: true, .. });
        let mut record = match result {
            Ok(summary) => {
                let state = match summary.outcome {
                    Outcome::Succeeded => State::Succeeded,
                    Outcome::Failed => State::Failed,
                    Outcome::Cancelled => State::Cancelled,
                };
                let diagnosis =
                    summary.diagnosis.as_ref().and_then(|found| serde_json::to_value(found).ok());
                let mut summary = serde_json::to_value(summary).unwrap_or_default();
                // Where the log stands is our affair; clients have a link.
                if let Some(summary) = summary.as_object_mut() {
                    summary.remove("log");
                }
                let summary = Some(summary);
                Record { has_log: true, summary, diagnosis, ..job.record(state, None) }
            }
            Err(fault) => job.record(State::Failed, Some(fault)),
        };
        record.steps_done = task.control.steps_done.load(Ordering::Relaxed);
        Some((record, unwanted))
    }

    /// Writes the result, however long the disk refuses it: a state that is shown must be on the disk.
    /// None if the service stops first.
    fn publish(&self, id: Uuid, record: &Record) -> Option<Record> {
        loop {
            match self.runtime.block_on(self.store.publish(id, record)) {
                Ok(record) => return Some(record),
                Err(error) => {
                    tracing::error!(job = %id, error = chain(&error), "result not written; trying again")
                }
            }
            let waited = self
                .halt
                .wait_timeout_while(self.index(), RETRY_PAUSE, |index| index.alive.is_some());
            let (index, _) = waited.unwrap_or_else(std::sync::PoisonError::into_inner);
            index.alive.as_ref()?;
        }
    }

    /// Leaves a job for the next start; its attempt does not count as a crash.
    fn hand_back(&self, id: Uuid, attempt: u32) {
        if let Err(error) = self.runtime.block_on(self.store.take_back_attempt(id, attempt)) {
            tracing::warn!(job = %id, error = chain(&error), "attempt counted");
        }
        if let Some(job) = self.index().jobs.get_mut(&id) {
            job.attempts -= 1;
            job.phase = Phase::Queued;
        }
        tracing::info!(job = %id, "job interrupted; it runs again at the next start");
    }
}
