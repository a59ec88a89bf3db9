//! The worker: takes a job from the queue, settles its method and step, runs it, publishes how it
//! ended.
//!
//! Invariant: whatever happens in a run (a failure, a full disk, a panic), the thread goes on and the job gets
//! exactly one result, or none: if the service stops, so that it goes on at the next start; if the store refuses
//! something for now, so that it is tried again after a rest; if its record cannot be used, so that a person looks at
//! it. A job during which the process ended runs in a process of its own, so that it harms no other.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::{Identity, Index, Shared};
use crate::advise::Settled;
use crate::plan::Plan;
use crate::run::{Control, Summary};
use crate::scenario::Scenario;
use crate::serve::apart;
use crate::serve::chain;
use crate::serve::engine::Refusal;
use crate::serve::errand::{Broken, Done, Errand};
use crate::serve::job::{Fault, Phase, State, Trouble};
use crate::serve::store::{Ending, KeptPlan, Line, LogSum, Record, Size, StoreError, Waiting};

/// Number of attempts to write a result before its job rests, and the pauses between, which double.
const PUBLISHING: (u32, Duration) = (5, Duration::from_millis(100));

/// Number of attempts to finish the log of a job that ends its process: an attempt may end its process as well.
const MAX_GIVING_UP: u32 = 2;

/// A job in the hands of a worker.
struct Turn {
    id: Uuid,
    attempt: u32,
    /// Whether the process ended during its last run.
    suspect: bool,
    control: Arc<Control>,
}

/// Result of a turn.
enum Carried {
    /// Method and step are settled: it is a job of this plan.
    Settled(Box<Plan>),
    Ended(Box<Summary>),
    /// It was cancelled before it began a log.
    Cancelled,
    /// It has no log, and never will.
    GivenUp(Fault),
}

impl Shared {
    /// Runs a worker thread.
    pub(super) fn work(&self) {
        while let Some(turn) = self.next() {
            let caught = catch_unwind(AssertUnwindSafe(|| self.carry_out(&turn)));
            let result = caught.unwrap_or_else(|_| Err(Broken::Fault(Fault::panicked())));
            // Whatever a run met in a directory that is not there any more is not the job's fault.
            let result = self.store.check().map_err(Broken::from).and(result);
            self.conclude(&turn, result);
            // Others may have waited for its memory.
            self.work.notify_all();
        }
    }

    /// Returns the oldest waiting job, marked as running; none once the service stops.
    fn next(&self) -> Option<Turn> {
        let mut index = self.index();
        loop {
            index.alive.as_ref()?;
            let now = Instant::now();
            while let Some(&(until, id)) = index.resting.first()
                && until <= now
            {
                index.resting.pop_first();
                index.queue.push_back(id);
            }
            if index.fits(self.limits.memory_bytes)
                && let Some(id) = index.queue.pop_front()
                && let Some(job) = index.jobs.get_mut(&id)
            {
                job.attempts += 1;
                let (attempt, suspect) = (job.attempts, job.suspect);
                let control = Arc::new(Control { live: self.live.clone(), ..Control::default() });
                if job.cancelled {
                    control.cancel();
                }
                job.phase = Phase::Running { control: control.clone(), since: now };
                index.running.insert(id);
                return Some(Turn { id, attempt, suspect, control });
            }
            index = match index.resting.first() {
                Some(&(until, _)) => {
                    let waited =
                        self.work.wait_timeout(index, until.saturating_duration_since(now));
                    waited.unwrap_or_else(PoisonError::into_inner).0
                }
                None => self.work.wait(index).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }

    fn carry_out(&self, turn: &Turn) -> Result<Carried, Broken> {
        let Turn { id, attempt, control, .. } = turn;
        let wait = &self.runtime;
        if control.cancelled.load(Ordering::Relaxed) && !self.store.has_begun(*id) {
            return Ok(Carried::Cancelled);
        }
        wait.block_on(self.store.begin_attempt(*id, *attempt))?;
        let text = wait.block_on(self.store.scenario(*id))?;
        let scenario = Scenario::from_json(&text).map_err(|error| Fault::rejected(&error))?;
        let kept = wait.block_on(self.store.settled(*id))?;
        let planned = |settled: &Settled| settled.plan().map_err(|error| Fault::rejected(&error));
        let settled = match kept {
            Some(settled) => settled,
            None => {
                let settle = Errand::Settle { scenario: Box::new(scenario) };
                let Done::Settled(settled) = self.errand(turn, &settle)? else {
                    return Err(Fault::panicked().into());
                };
                let plan = KeptPlan::new((*settled).clone(), &planned(&settled)?)?;
                wait.block_on(self.store.keep_plan(*id, &plan))?;
                // It runs with what is at hand, not with what can be read: this ends whatever becomes of the record.
                *settled
            }
        };
        if self.index().jobs.get(id).is_none_or(|job| job.size.is_none()) {
            let plan = planned(&settled)?;
            return self.admitted(turn, plan).map(|plan| Carried::Settled(Box::new(plan)));
        }
        self.store.reopen_log(*id)?;
        tracing::info!(job = %id, attempt, apart = turn.suspect, "job runs");
        let log = self.store.log_path(*id);
        let trace = turn.suspect.then(|| self.store.trace_path(*id));
        let run = Errand::Run { settled: Box::new(settled), log, trace };
        match self.errand(turn, &run) {
            Ok(Done::Ran(summary)) => Ok(Carried::Ended(summary)),
            Ok(_) => Err(Fault::panicked().into()),
            Err(Broken::Fault(fault)) if fault.is_of_the_process() => {
                let Errand::Run { settled, .. } = run else { return Err(fault.into()) };
                self.give_up(turn, settled, fault)
            }
            Err(broken) => Err(broken),
        }
    }

    /// Carries out an errand for a job, here or in a process of its own.
    fn errand(&self, turn: &Turn, errand: &Errand) -> Result<Done, Broken> {
        match self.program.as_ref().filter(|_| turn.suspect) {
            Some(program) => apart::carry_out(program, errand, &turn.control, None),
            None => errand.carry_out(&turn.control),
        }
    }

    /// Ends the log of a job that ends its process.
    fn give_up(&self, turn: &Turn, settled: Box<Settled>, fault: Fault) -> Result<Carried, Broken> {
        let Turn { id, control, .. } = turn;
        tracing::warn!(job = %id, "job abandoned: its runs crash the process");
        let errand =
            Errand::GiveUp { settled, log: self.store.log_path(*id), fault: fault.clone() };
        let ended = match &self.program {
            Some(program) => apart::carry_out(program, &errand, control, Some(MAX_GIVING_UP)),
            None => errand.carry_out(control),
        };
        match ended {
            Ok(Done::Ran(summary)) => {
                control.steps_done.store(summary.steps, Ordering::Relaxed);
                Ok(Carried::Ended(summary))
            }
            Ok(_) | Err(Broken::Fault(_) | Broken::Unanswered(_)) => {
                tracing::error!(job = %id, "the log of the job cannot be finished");
                Ok(Carried::GivenUp(fault))
            }
            Err(broken) => Err(broken),
        }
    }

    /// Returns the plan of a job, if the service takes on a job of this size.
    fn admitted(&self, turn: &Turn, plan: Plan) -> Result<Plan, Broken> {
        self.limits.admit(&plan).map_err(|refusal| Fault::beyond(&refusal))?;
        let free_bytes = self.store.free_bytes()?;
        let to_come = {
            let mut index = self.index();
            let before = index.jobs.get(&turn.id).map_or(0, |job| job.owed_bytes);
            index.promised_bytes -= before;
            let to_come = index.bytes_to_come();
            index.promised_bytes += before;
            to_come
        };
        let needed = to_come.saturating_add(plan.log_bytes);
        if needed.saturating_add(self.limits.reserve_bytes) > free_bytes {
            let refusal = Refusal::DiskFull;
            return Err(Broken::Trouble(Trouble::new("storage_full", refusal.to_string())));
        }
        Ok(plan)
    }

    fn conclude(&self, turn: &Turn, result: Result<Carried, Broken>) {
        let Turn { id, control, .. } = turn;
        let record = match result {
            Ok(Carried::Settled(plan)) => return self.put_back(turn, &plan),
            Ok(Carried::Ended(summary)) => self.record(turn, Ok(&summary)),
            Ok(Carried::Cancelled) => self.record(turn, Err((State::Cancelled, None))),
            Ok(Carried::GivenUp(fault)) | Err(Broken::Fault(fault)) => {
                self.record(turn, Err((State::Failed, Some(&fault))))
            }
            Err(Broken::Stopped) if self.index().alive.is_none() => return self.hand_back(turn),
            // The search for its accuracy was stopped, and it has no log.
            Err(Broken::Stopped) => self.record(turn, Err((State::Cancelled, None))),
            Err(Broken::Trouble(trouble)) => return self.rest(turn, trouble),
            Err(Broken::Aside(fault)) => return self.set_aside(turn, fault),
            Err(Broken::Unanswered(_)) => {
                self.record(turn, Err((State::Failed, Some(&Fault::panicked()))))
            }
        };
        let published = record.map(|record| self.publish(turn, record));
        // What publishing met in a directory that is not there any more is no fault of the job.
        let published = published.map(|published| match published {
            Err(Broken::Stopped) | Ok(_) => published,
            broken => self.store.check().map_err(Broken::from).and(broken),
        });
        let record = match published {
            Some(Ok(record)) => record,
            None | Some(Err(Broken::Stopped)) => return self.hand_back(turn),
            Some(Err(Broken::Trouble(trouble))) => return self.rest(turn, trouble),
            Some(Err(Broken::Aside(fault) | Broken::Fault(fault))) => {
                return self.set_aside(turn, fault);
            }
            Some(Err(Broken::Unanswered(_))) => return self.set_aside(turn, Fault::panicked()),
        };
        let _ = std::fs::remove_file(self.store.trace_path(*id));
        let steps_done = control.steps_done.load(Ordering::Relaxed);
        tracing::info!(job = %id, attempt = turn.attempt, steps_done, state = ?record.state, "job ended");
        self.metrics.end(&record, record.log.as_ref().map_or(0, |log| log.bytes));
        self.index().end(Ending::of(*id, &record));
    }

    /// Returns the record to publish; none if the service stops while the log is read through.
    fn record(
        &self,
        turn: &Turn,
        result: Result<&Summary, (State, Option<&Fault>)>,
    ) -> Option<Record> {
        let index = self.index();
        let job = index.jobs.get(&turn.id)?;
        let mut record = match result {
            Ok(summary) => job.record_of(summary),
            Err((state, fault)) => job.record(state, fault),
        };
        record.steps_done = turn.control.steps_done.load(Ordering::Relaxed);
        Some(record)
    }

    /// Writes the result, with the checksum of the log: a state that is shown must be on the disk.
    fn publish(&self, turn: &Turn, mut record: Record) -> Result<Record, Broken> {
        let id = turn.id;
        self.store.check()?;
        if record.has_log {
            let log = self.store.log_path(id);
            let stopped = || self.index().alive.is_none();
            let failed = StoreError::reading_a_log;
            let identity = Identity::of(&log.metadata().map_err(failed)?);
            record.log = Some(LogSum::of(&log, stopped).map_err(failed)?.ok_or(Broken::Stopped)?);
            self.sound().insert(id, identity);
        }
        let (tries, mut pause) = PUBLISHING;
        for _ in 1..tries {
            match self.runtime.block_on(self.store.publish(id, &record)) {
                Ok(record) => return Ok(record),
                Err(error) if error.is_transient() => {
                    tracing::error!(job = %id, error = chain(&error), "result not written; trying again");
                }
                Err(error) => return Err(error.into()),
            }
            let waited =
                self.halt.wait_timeout_while(self.index(), pause, |index| index.alive.is_some());
            let (index, _) = waited.unwrap_or_else(PoisonError::into_inner);
            index.alive.as_ref().ok_or(Broken::Stopped)?;
            pause *= 2;
        }
        Ok(self.runtime.block_on(self.store.publish(id, &record))?)
    }

    /// Takes back an attempt that returned: it does not count as a death of the process.
    fn take_back(&self, turn: &Turn) {
        let taken_back = self.runtime.block_on(self.store.take_back_attempt(turn.id, turn.attempt));
        if let Err(error) = taken_back {
            tracing::warn!(job = %turn.id, error = chain(&error), "attempt cannot be taken back");
        }
        if let Some(job) = self.index().jobs.get_mut(&turn.id) {
            job.attempts -= 1;
        }
    }

    /// Puts a job whose method and step are settled to the front of the queue.
    fn put_back(&self, turn: &Turn, plan: &Plan) {
        self.take_back(turn);
        let id = turn.id;
        let mut index = self.index();
        let Some(job) = index.jobs.get_mut(&id) else { return };
        job.plan = serde_json::value::to_raw_value(plan).ok();
        job.cancelled |= turn.control.cancelled.load(Ordering::Relaxed);
        let size = Size::of(plan);
        let line = Line::Waits(Waiting { id, name: job.name.clone(), size: Some(size) });
        index.owe(id, size, 0);
        index.back_to_queue(id);
        drop(index);
        self.store.add_to_index(&line);
        tracing::info!(job = %id, steps = size.steps, "method and step settled");
    }

    /// Leaves a job for the next start.
    fn hand_back(&self, turn: &Turn) {
        self.take_back(turn);
        let mut index = self.index();
        index.running.remove(&turn.id);
        if let Some(job) = index.jobs.get_mut(&turn.id) {
            job.phase = Phase::Queued;
        }
        drop(index);
        tracing::info!(job = %turn.id, "job interrupted; it is resumed at the next start");
    }

    /// Lets a job wait for the store. Its log so far stays.
    fn rest(&self, turn: &Turn, trouble: Trouble) {
        self.take_back(turn);
        let id = turn.id;
        let mut index = self.index();
        index.running.remove(&id);
        let Some(job) = index.jobs.get_mut(&id) else { return };
        let trouble = trouble.again(job.trouble.as_ref());
        let pause = trouble.pause();
        tracing::warn!(job = %id, ?trouble, ?pause, "job waits for the store");
        job.phase = Phase::Queued;
        job.cancelled |= turn.control.cancelled.load(Ordering::Relaxed);
        job.trouble = Some(trouble);
        index.resting.insert((Instant::now() + pause, id));
    }

    /// Leaves a job as it is, for an operator to look at its record; the next start tries again.
    fn set_aside(&self, turn: &Turn, fault: Fault) {
        self.take_back(turn);
        tracing::error!(job = %turn.id, ?fault, "job set aside; nothing of it is removed");
        self.metrics.set_aside();
        let mut index = self.index();
        index.running.remove(&turn.id);
        let Some(job) = index.jobs.get_mut(&turn.id) else { return };
        job.phase = Phase::Aside(fault);
        let owed_bytes = std::mem::take(&mut job.owed_bytes);
        index.promised_bytes -= owed_bytes;
    }
}

impl Index {
    /// Returns whether there is memory for the next job in addition to those that run. One alone
    /// always fits: it was admitted.
    fn fits(&self, memory_bytes: u64) -> bool {
        let Some(next) = self.queue.front().and_then(|id| self.jobs.get(id)) else { return false };
        let taken: u64 = self.running().map(super::Job::memory_bytes).sum();
        self.running.is_empty() || taken.saturating_add(next.memory_bytes()) <= memory_bytes
    }
}
