//! The thread that makes the studies, one after the other.
//!
//! Invariant: whatever happens in a study, the thread goes on and the study ends once, or not at
//! all if the service stops, so that it is made again at the next start. The end that is shown is
//! on the disk.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::sync::{Arc, PoisonError};
use std::thread;
use std::time::Duration;

use uuid::Uuid;

use super::question::{Answer, Kind};
use super::{Phase, Record, Shared, Study};
use crate::run::Control;
use crate::serve::errand::{Broken, Done, Errand};
use crate::serve::job::State;
use crate::serve::store::StoreError;
use crate::serve::{apart, chain};

/// Longest study of methods: no client waits longer, and other studies wait behind it.
const LONGEST: Duration = Duration::from_secs(900);

/// A sweep may take days. After this long it lets the studies that wait go first, and continues behind them.
const TURN: Duration = Duration::from_secs(5);

/// Pause between attempts to write a result: long enough not to spin, short enough to notice space that returns.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// A study in the hands of the thread.
struct Turn {
    id: Uuid,
    kind: Kind,
    attempt: u32,
    suspect: bool,
    control: Arc<Control>,
}

impl Shared {
    /// Runs the thread.
    pub(super) fn work(&self) {
        while let Some(turn) = self.next() {
            let (answer, late) = thread::scope(|scope| {
                let (ended, end) = mpsc::channel();
                let turn = &turn;
                let late = scope.spawn(move || self.limit(turn, &end));
                let answer = catch_unwind(AssertUnwindSafe(|| self.answer(turn)));
                drop(ended);
                (answer, late.join().unwrap_or_default())
            });
            // Whatever a study met in a directory that is not there any more is not its own fault.
            let moved = self.store.check().map_err(Broken::from);
            let answer = answer.map(|answer| moved.and(answer));
            let (state, error, answer) = match answer {
                Ok(Ok(answer)) => (State::Succeeded, None, answer),
                Ok(Err(Broken::Stopped)) => {
                    if self.index().stopping {
                        return self.hand_back(&turn);
                    }
                    if !turn.control.cancelled.load(Ordering::Relaxed) {
                        self.give_way(&turn);
                        continue;
                    }
                    let error =
                        late.then(|| format!("the study took longer than {} s", LONGEST.as_secs()));
                    let state = if late { State::Failed } else { State::Cancelled };
                    (state, error, Answer::default())
                }
                Ok(Err(Broken::Trouble(trouble))) => {
                    tracing::warn!(study = %turn.id, ?trouble, "study waits for the store");
                    self.postpone(&turn);
                    continue;
                }
                Ok(Err(broken)) => (State::Failed, Some(reported(&broken)), Answer::default()),
                Err(_) => {
                    let error = "the study failed; the service's log says why".to_owned();
                    (State::Failed, Some(error), Answer::default())
                }
            };
            if !self.ends(turn.id, state, &error, &answer) {
                return self.hand_back(&turn);
            }
        }
    }

    /// Makes a study, here or in a process of its own.
    fn answer(&self, turn: &Turn) -> Result<Answer, Broken> {
        let Turn { id, attempt, control, .. } = turn;
        self.runtime.block_on(self.store.begin_attempt(*id, *attempt))?;
        let request = self.runtime.block_on(self.store.request(*id))?;
        let request = String::from_utf8_lossy(&request).into_owned();
        let errand = Errand::Study { request, folder: self.store.folder(*id) };
        let done = match self.program.as_ref().filter(|_| turn.suspect) {
            Some(program) => apart::carry_out(program, &errand, control, None),
            None => errand.carry_out(control),
        };
        match done? {
            Done::Studied(answer) => Ok(answer),
            Done::Settled(_) | Done::Ran(_) => Err(Broken::Unanswered("no answer".to_owned())),
        }
    }

    /// Returns the oldest waiting study, marked as running; none once the service stops.
    fn next(&self) -> Option<Turn> {
        let mut index = self.index();
        loop {
            if index.stopping {
                return None;
            }
            if let Some(id) = index.queue.pop_front()
                && let Some(study) = index.studies.get_mut(&id)
            {
                study.phase = Phase::Running;
                study.attempts += 1;
                let &mut Study { kind, attempts: attempt, suspect, .. } = study;
                return Some(Turn { id, kind, attempt, suspect, control: study.control.clone() });
            }
            index = self.work.wait(index).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Ends a study, however long the disk refuses it; returns false if the service stops first.
    fn ends(&self, id: Uuid, state: State, error: &Option<String>, answer: &Answer) -> bool {
        loop {
            match self.end(id, state, error.clone(), answer.clone()) {
                Ok(()) => return true,
                Err(error) => {
                    tracing::error!(study = %id, error = chain(&error), "result not written");
                    if !error.is_transient() {
                        self.set_aside(id);
                        return true;
                    }
                }
            }
            let waited =
                self.work.wait_timeout_while(self.index(), RETRY_PAUSE, |index| !index.stopping);
            if waited.unwrap_or_else(PoisonError::into_inner).0.stopping {
                return false;
            }
        }
    }

    /// Writes how a study ended, then shows it.
    pub(super) fn end(
        &self,
        id: Uuid,
        state: State,
        error: Option<String>,
        answer: Answer,
    ) -> Result<(), StoreError> {
        let Some(record) = self.index().studies.get(&id).map(|study| Record {
            kind: study.kind,
            name: study.name.clone(),
            state,
            runs: study.control.settling.total.load(Ordering::Relaxed),
            runs_done: study.control.settling.done.load(Ordering::Relaxed),
            error,
            answer,
        }) else {
            return Ok(());
        };
        self.runtime.block_on(self.store.publish(id, &record))?;
        tracing::info!(study = %id, state = state.as_str(), "study ended");
        self.show(id, record);
        Ok(())
    }

    /// Leaves a study as it is, for an operator to look at its record; the next start tries again.
    fn set_aside(&self, id: Uuid) {
        let Some(record) = self.index().studies.get(&id).map(|study| Record {
            kind: study.kind,
            name: study.name.clone(),
            state: State::Failed,
            runs: 0,
            runs_done: 0,
            error: Some("the result could not be written".to_owned()),
            answer: Answer::default(),
        }) else {
            return;
        };
        self.show(id, record);
    }

    fn show(&self, id: Uuid, record: Record) {
        if let Some(study) = self.index().studies.get_mut(&id) {
            study.phase = Phase::Ended(Arc::new(record));
        }
    }

    /// Puts a study back that the store does not allow to be made for now.
    fn postpone(&self, turn: &Turn) {
        let mut index = self.index();
        if let Some(study) = index.studies.get_mut(&turn.id) {
            study.phase = Phase::Queued;
            study.attempts -= 1;
        }
        index.queue.push_front(turn.id);
        let waited = self.work.wait_timeout_while(index, RETRY_PAUSE, |index| !index.stopping);
        drop(waited);
    }

    /// Stops a study of methods that takes too long, and a sweep that has had its turn while others
    /// wait; until the study has ended, and with it the sender is dropped. Returns whether it was
    /// too long.
    fn limit(&self, turn: &Turn, end: &Receiver<()>) -> bool {
        let waited = |time| end.recv_timeout(time) == Err(RecvTimeoutError::Timeout);
        if turn.kind != Kind::Sweep {
            let late = waited(LONGEST);
            if late {
                turn.control.cancel();
            }
            return late;
        }
        while waited(TURN) {
            if !self.index().queue.is_empty() {
                turn.control.settling.cancelled.store(true, Ordering::Relaxed);
                break;
            }
        }
        false
    }

    /// Puts a sweep that was stopped in its turn behind those that wait; its attempt does not count.
    fn give_way(&self, turn: &Turn) {
        self.take_back_attempt(turn);
        let mut index = self.index();
        // One that was cancelled at this moment ends in its next turn: a cancellation holds the index.
        let cancelled = turn.control.cancelled.load(Ordering::Relaxed);
        turn.control.settling.cancelled.store(cancelled, Ordering::Relaxed);
        if let Some(study) = index.studies.get_mut(&turn.id) {
            study.phase = Phase::Queued;
            study.attempts -= 1;
            index.queue.push_back(turn.id);
        }
    }

    fn take_back_attempt(&self, turn: &Turn) {
        let Turn { id, attempt, .. } = *turn;
        if let Err(error) = self.runtime.block_on(self.store.take_back_attempt(id, attempt)) {
            tracing::warn!(study = %id, error = chain(&error), "attempt cannot be taken back");
        }
    }

    /// Leaves a study for the next start; its attempt does not count.
    fn hand_back(&self, turn: &Turn) {
        self.take_back_attempt(turn);
        tracing::info!(study = %turn.id, "study interrupted; it is made again at the next start");
    }
}

/// Returns why a study has no answer, for a person.
fn reported(broken: &Broken) -> String {
    match broken {
        Broken::Unanswered(message) => message.clone(),
        Broken::Fault(fault) | Broken::Aside(fault) => fault.to_string(),
        Broken::Trouble(_) => "the store refused the study".to_owned(),
        Broken::Stopped => "stopped".to_owned(),
    }
}
