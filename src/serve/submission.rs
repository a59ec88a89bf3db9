//! Submission slots: submissions are checked here, on a few threads that give way to those that
//! answer.
//!
//! Invariant: a slot is held by the work and not by the client: a client that leaves frees none,
//! and work that no client waits for any more is not begun.

use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex, PoisonError};
use std::{io, thread};

use tokio::sync::oneshot;

use super::engine::Refusal;
use super::give_way;

/// Number of submissions that are checked at once. More of them would be kept a little sooner, and
/// every request for a state would wait behind them all.
const SLOTS: usize = 4;

type Work = Box<dyn FnOnce() + Send>;

/// A handle on the slots; copies are the same.
#[derive(Clone, Debug)]
pub(super) struct SubmissionSlots(Sender<Work>);

impl SubmissionSlots {
    /// Starts its threads; they end when the last handle is gone.
    pub(super) fn open() -> io::Result<Self> {
        let (work, waiting) = mpsc::channel();
        let waiting = Arc::new(Mutex::new(waiting));
        for number in 1..=SLOTS {
            let waiting = waiting.clone();
            thread::Builder::new().name(format!("submission-{number}")).spawn(move || {
                give_way();
                while let Some(work) = next(&waiting) {
                    work();
                }
            })?;
        }
        Ok(Self(work))
    }

    /// Waits for a slot and does the work in it. Returns an error if that panics.
    pub(super) async fn check<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let (answer, answered) = oneshot::channel();
        let work = move || {
            if !answer.is_closed()
                && let Ok(found) = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work))
            {
                let _ = answer.send(found);
            }
        };
        self.0.send(Box::new(work)).map_err(|_| Refusal::Stopping)?;
        answered.await.map_err(|_| Refusal::Broken)
    }
}

fn next(waiting: &Mutex<Receiver<Work>>) -> Option<Work> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
}
