//! The work of a run, counted where it is done, and its end.
//!
//! Invariant: counts depend on what is computed alone, so a run that ends at a count ends at the same place each time.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::failure::{Failure, FailureCode};

/// Counts gradients, sweeps, passes and pieces, and refuses a sweep past the most allowed or after it was cancelled. A step may be
/// many sweeps, and a sweep long: it is asked before each.
#[derive(Clone, Debug)]
pub struct Work {
    gradients: Cell<u64>,
    sweeps: Cell<u64>,
    passes: Cell<u64>,
    pieces: Cell<u64>,
    most_sweeps: u64,
    stop: Arc<AtomicBool>,
}

impl Default for Work {
    /// Counts without a limit.
    fn default() -> Self {
        Self::limited(u64::MAX, Arc::default())
    }
}

impl Work {
    /// Allows at most `most_sweeps` sweeps, and none once `stop` is set.
    pub fn limited(most_sweeps: u64, stop: Arc<AtomicBool>) -> Self {
        let none = || Cell::new(0);
        Self {
            gradients: none(),
            sweeps: none(),
            passes: none(),
            pieces: none(),
            most_sweeps,
            stop,
        }
    }

    /// Takes over the counts of another.
    pub(super) fn take_over(&self, other: &Self) {
        self.gradients.set(other.gradients());
        self.sweeps.set(other.sweeps());
        self.passes.set(other.passes());
        self.pieces.set(other.pieces());
    }

    /// Gradients of the potential taken so far.
    pub fn gradients(&self) -> u64 {
        self.gradients.get()
    }

    /// Sweeps begun so far: for an explicit scheme or a composition, steps.
    pub fn sweeps(&self) -> u64 {
        self.sweeps.get()
    }

    /// Passes so far over attitudes and momenta within sweeps of the collocation with a deferred
    /// defect; they take no gradient, and of a defect only the new part.
    pub fn passes(&self) -> u64 {
        self.passes.get()
    }

    /// Pieces in which motions of the free body were computed, beyond the first of each.
    pub fn pieces(&self) -> u64 {
        self.pieces.get()
    }

    /// Are all allowed sweeps made?
    pub fn is_spent(&self) -> bool {
        self.sweeps() >= self.most_sweeps
    }

    /// Takes note of gradients.
    pub(super) fn add_gradients(&self, gradients: u64) {
        self.gradients.set(self.gradients() + gradients);
    }

    /// Takes note of a pass within a sweep.
    pub(super) fn add_pass(&self) {
        self.passes.set(self.passes() + 1);
    }

    /// Takes note of the pieces of a free motion.
    pub(super) fn add_pieces(&self, pieces: f64) {
        self.pieces.set(self.pieces() + (pieces - 1.0) as u64);
    }

    /// Takes note of a sweep that begins.
    ///
    /// # Errors
    /// [`FailureCode::Stopped`] if it is not to begin.
    pub(super) fn begin_sweep(&self) -> Result<(), Failure> {
        if self.is_spent() || self.stop.load(Ordering::Relaxed) {
            let (made, most) = (self.sweeps() as f64, self.most_sweeps as f64);
            return Err(Failure::new(FailureCode::Stopped, None, made, most));
        }
        self.sweeps.set(self.sweeps() + 1);
        Ok(())
    }
}
