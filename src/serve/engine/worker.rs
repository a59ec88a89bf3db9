//! The worker: takes a job from the queue, runs it, publishes how it ended.
//!
//! Invariant: whatever happens in a run (a failure, a full disk, a panic), the thread goes on and the job gets
//! exactly one result, or none if the service stops, so that it goes on at the next start. A job whose last
//! run ended with its process runs alone until it has come further, so that no other is blamed for it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::{Index, Shared};
use crate::run::{Control, JobContext, Outcome, RunError, Summary, execute, give_up};
use crate::scenario::Scenario;
use crate::serve::chain;
use crate::serve::job::{Fault, Job, Phase, State};
use crate::serve::store::{Ending, Record, StoreError};

/// Pause between attempts to write a result: long enough not to spin, short enough to notice space
/// that returns.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// How often a worker looks whether a suspect has come further.
const SUSPECT_PAUSE: Duration = Duration::from_millis(100);

/// A job in the hands of a worker.
struct Task {
    id: Uuid,
    attempt: u32,
    /// Not to be run: for the so manyeth time, its log is to be given an end.
    given_up: Option<u32>,
    control: Arc<Control>,
}

impl Shared {
    /// The life of a worker thread.
    pub(super) fn work(&self) {
        while let Some(task) = self.next() {
            let caught = catch_unwind(AssertUnwindSafe(|| self.run(&task)));
            let result = caught.unwrap_or_else(|_| Err(Broken::Fault(Fault::panicked())));
            self.conclude(&task, result);
            // Others may have waited for this one.
            self.work.notify_all();
        }
    }

    /// The oldest waiting job, marked as running; none once the service stops.
    fn next(&self) -> Option<Task> {
        let mut index = self.index();
        loop {
            index.alive.as_ref()?;
            if index.queue.is_empty() {
                index = self.work.wait(index).unwrap_or_else(PoisonError::into_inner);
            } else if index.must_wait() {
                let waited = self.work.wait_timeout(index, SUSPECT_PAUSE);
                index = waited.unwrap_or_else(PoisonError::into_inner).0;
            } else if let Some(id) = index.queue.pop_front()
                && let Some(job) = index.jobs.get_mut(&id)
            {
                let given_up = job.given_up.map(|tries| tries + 1);
                job.attempts += u32::from(given_up.is_none());
                let attempt = job.attempts;
                let trace = if given_up.is_some() { None } else { self.store.trace(id, attempt) };
                let live = self.live.clone();
                let control = Arc::new(Control { trace, live, ..Control::default() });
                control.cancelled.store(job.cancelled, Ordering::Relaxed);
                job.phase = Phase::Running { control: control.clone(), since: Instant::now() };
                index.running.insert(id);
                return Some(Task { id, attempt, given_up, control });
            }
        }
    }

    fn run(&self, task: &Task) -> Result<Summary, Broken> {
        let Task { id, attempt, control, .. } = task;
        let storage = |error: StoreError| {
            tracing::error!(job = %id, error = chain(&error), "store failed");
            Fault::storage(&error)
        };
        self.store.reopen_log(*id).map_err(storage)?;
        match task.given_up {
            Some(n) => self.runtime.block_on(self.store.begin_giving_up(*id, n)),
            None => self.runtime.block_on(self.store.begin_attempt(*id, *attempt)),
        }
        .map_err(storage)?;
        let text = self.runtime.block_on(self.store.scenario(*id)).map_err(storage)?;
        let scenario = Scenario::from_json(&text).map_err(|error| Fault::rejected(&error))?;
        let log = self.store.log_path(*id);
        if task.given_up.is_some() {
            tracing::warn!(job = %id, attempt, "job given up: its runs end the process");
            let fault = Fault::worker_crashed();
            return match give_up(&scenario, &log, fault.reason()) {
                Ok(summary) => {
                    control.steps_done.store(summary.steps, Ordering::Relaxed);
                    Ok(summary)
                }
                Err(error) => {
                    tracing::error!(job = %id, error = chain(&error), "its log is lost");
                    Err(Broken::Fault(fault))
                }
            };
        }
        tracing::info!(job = %id, attempt, "job runs");
        execute(&scenario, &JobContext { log: &log, control }).map_err(|error| match error {
            RunError::Interrupted => Broken::Interrupted,
            error => {
                tracing::error!(job = %id, error = chain(&error), "run broke off");
                Broken::Fault(Fault::run(&error))
            }
        })
    }

    fn conclude(&self, task: &Task, result: Result<Summary, Broken>) {
        let Task { id, attempt, control, .. } = task;
        let result = match result {
            Ok(summary) => Ok(summary),
            Err(Broken::Fault(fault)) => Err(fault),
            Err(Broken::Interrupted) => return self.hand_back(task),
        };
        let Some(record) = self.record(task, &result) else { return };
        if !record.has_log
            && let Err(error) = self.store.remove_leftovers(*id)
        {
            tracing::warn!(job = %id, error = chain(&error), "rubbish stays beside the job");
        }
        match self.publish(*id, &record) {
            Some(record) => {
                let steps_done = control.steps_done.load(Ordering::Relaxed);
                tracing::info!(job = %id, attempt, steps_done, state = ?record.state, "job ended");
                let log = std::fs::metadata(self.store.log_path(*id)).ok();
                let log = log.filter(|_| record.has_log);
                self.metrics.end(&record, log.map_or(0, |log| log.len()));
                self.index().end(Ending::of(*id, &record));
            }
            None => self.hand_back(task),
        }
    }

    /// What to publish.
    fn record(&self, task: &Task, result: &Result<Summary, Fault>) -> Option<Record> {
        let index = self.index();
        let job = index.jobs.get(&task.id)?;
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
        Some(record)
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
            let (index, _) = waited.unwrap_or_else(PoisonError::into_inner);
            index.alive.as_ref()?;
        }
    }

    /// Leaves a job for the next start; its attempt does not count as a crash.
    fn hand_back(&self, task: &Task) {
        let Task { id, attempt, given_up, .. } = *task;
        let taken_back = match given_up {
            Some(n) => self.runtime.block_on(self.store.take_back_giving_up(id, n)),
            None => self.runtime.block_on(self.store.take_back_attempt(id, attempt)),
        };
        if let Err(error) = taken_back {
            tracing::warn!(job = %id, error = chain(&error), "attempt counted");
        }
        let mut index = self.index();
        index.running.remove(&id);
        if let Some(job) = index.jobs.get_mut(&id) {
            job.attempts -= u32::from(given_up.is_none());
            job.phase = Phase::Queued;
        }
        drop(index);
        tracing::info!(job = %id, "job interrupted; it goes on at the next start");
    }
}

impl Index {
    /// Whether the next job has to wait: it, or one that runs, may be what ended the process.
    fn must_wait(&self) -> bool {
        let mut running = self.running();
        let next = self.queue.front().and_then(|id| self.jobs.get(id));
        if next.is_some_and(|job| job.suspect) {
            running.next().is_some()
        } else {
            running.any(Job::is_suspect)
        }
    }
}

/// Why a run has no summary.
enum Broken {
    Fault(Fault),
    Interrupted,
}

impl From<Fault> for Broken {
    fn from(fault: Fault) -> Self {
        Self::Fault(fault)
    }
}
