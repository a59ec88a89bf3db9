//! The thread that makes the studies, one after the other.
//!
//! Invariant: whatever happens in a study, the thread goes on and the study ends once, or not at all if the service
//! stops, so that it is made again at the next start.

use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use uuid::Uuid;

use super::question::{Answer, Question, Unanswered};
use super::{Phase, Record, Shared};
use crate::serve::chain;
use crate::serve::job::State;
use crate::study::{StudyError, Watch};

/// Longest study: nobody waits longer, and others wait behind it.
const LONGEST: Duration = Duration::from_secs(900);

/// A study in the hands of the thread.
struct Task {
    id: Uuid,
    attempt: u32,
    question: Box<Question>,
    watch: Arc<Watch>,
}

impl Shared {
    /// The life of the thread.
    pub(super) fn work(&self) {
        while let Some(Task { id, attempt, question, watch }) = self.next() {
            if let Err(error) = self.runtime.block_on(self.store.begin_attempt(id, attempt)) {
                tracing::warn!(study = %id, error = chain(&error), "attempt not noted");
            }
            let (ended, late) = limited(&watch);
            let answer = std::panic::catch_unwind(|| question.answer(&watch));
            drop(ended);
            let late = late.join().unwrap_or_default();
            let (state, error, answer) = match answer {
                Ok(Ok(answer)) => (State::Succeeded, None, answer),
                Ok(Err(Unanswered::Study(StudyError::Cancelled))) => {
                    if self.index().stopping {
                        return self.hand_back(id, attempt);
                    }
                    let error = late.then(|| format!("took longer than {} s", LONGEST.as_secs()));
                    let state = if late { State::Failed } else { State::Cancelled };
                    (state, error, Answer::default())
                }
                Ok(Err(error)) => (State::Failed, Some(error.to_string()), Answer::default()),
                Err(_) => {
                    let error = "the study failed; the service's log says why".to_owned();
                    (State::Failed, Some(error), Answer::default())
                }
            };
            self.end(id, state, error, answer);
        }
    }

    /// The oldest waiting study, marked as running; none once the service stops.
    fn next(&self) -> Option<Task> {
        let mut index = self.index();
        loop {
            if index.stopping {
                return None;
            }
            if let Some(id) = index.queue.pop_front()
                && let Some(study) = index.studies.get_mut(&id)
                && let Phase::Queued(question) = std::mem::replace(&mut study.phase, Phase::Running)
            {
                study.attempts += 1;
                let (attempt, watch) = (study.attempts, study.watch.clone());
                return Some(Task { id, attempt, question, watch });
            }
            index = self.work.wait(index).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Writes how a study ended, then shows it.
    pub(super) fn end(&self, id: Uuid, state: State, error: Option<String>, answer: Answer) {
        let Some(record) = self.index().studies.get(&id).map(|study| Record {
            kind: study.kind,
            name: study.name.clone(),
            state,
            runs: study.watch.total.load(Ordering::Relaxed),
            runs_done: study.watch.done.load(Ordering::Relaxed),
            error,
            answer,
        }) else {
            return;
        };
        let written = serde_json::to_vec(&record)
            .map(|text| self.runtime.block_on(self.store.publish(id, text)));
        // Shown all the same: it is made again at the next start.
        match written {
            Ok(Ok(())) => {}
            Ok(Err(error)) => {
                tracing::error!(study = %id, error = chain(&error), "result not written");
            }
            Err(error) => tracing::error!(study = %id, %error, "result not written"),
        }
        tracing::info!(study = %id, state = state.as_str(), "study ended");
        if let Some(study) = self.index().studies.get_mut(&id) {
            study.phase = Phase::Ended(Arc::new(record));
        }
    }

    /// Leaves a study for the next start; its attempt does not count.
    fn hand_back(&self, id: Uuid, attempt: u32) {
        if let Err(error) = self.runtime.block_on(self.store.take_back_attempt(id, attempt)) {
            tracing::warn!(study = %id, error = chain(&error), "attempt counted");
        }
        tracing::info!(study = %id, "study interrupted; it is made again at the next start");
    }
}

/// Cancels a study that takes too long, unless the sender is dropped before; tells whether it did.
fn limited(watch: &Arc<Watch>) -> (mpsc::Sender<()>, JoinHandle<bool>) {
    let (ended, end) = mpsc::channel();
    let watch = watch.clone();
    let late = thread::spawn(move || {
        let late = end.recv_timeout(LONGEST) == Err(RecvTimeoutError::Timeout);
        if late {
            watch.cancelled.store(true, Ordering::Relaxed);
        }
        late
    });
    (ended, late)
}
