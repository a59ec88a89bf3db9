//! Long work on a thread of its own, while the interpreter goes on: other threads run, Ctrl-C is heard, and a bar moves.

use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use pyo3::prelude::*;

/// Signals are looked for, and the bar is moved, this often.
const LOOK: Duration = Duration::from_millis(50);

/// Who is told how far the work is.
#[derive(Clone, Copy, Default)]
pub(crate) struct Follow<'a, 'py> {
    /// A function of what is done and of the whole.
    pub(crate) progress: Option<&'a Bound<'py, PyAny>>,
    /// Returns these two.
    pub(crate) done: Option<&'a (dyn Fn() -> (u64, u64) + 'a)>,
}

impl Follow<'_, '_> {
    fn tell(&self) -> PyResult<()> {
        match (self.progress, self.done) {
            (Some(progress), Some(done)) => progress.call1(done()).map(drop),
            _ => Ok(()),
        }
    }
}

/// Does the work, and stops it by `stop` at a signal or if the function of the progress raises; their exception is the error.
pub(crate) fn watched<T: Send>(
    py: Python<'_>,
    stop: impl Fn(),
    follow: Follow<'_, '_>,
    work: impl FnOnce() -> T + Send,
) -> PyResult<T> {
    thread::scope(|scope| {
        let (running, ended) = mpsc::channel::<()>();
        let worker = scope.spawn(move || {
            let _running = running;
            work()
        });
        let mut heard = Ok(());
        let ended = std::sync::Mutex::new(ended);
        let wait = || {
            let ended = ended.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            ended.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout)
        };
        while py.detach(wait) {
            if heard.is_ok() {
                heard = py.check_signals().and_then(|()| follow.tell());
                if heard.is_err() {
                    stop();
                }
            }
        }
        let done = worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        heard.and_then(|()| follow.tell()).map(|()| done)
    })
}
