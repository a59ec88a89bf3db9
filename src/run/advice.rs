//! The step to try after a failure: tried here first, not guessed.
//!
//! Invariant: an advised step was tried and got past the place where the run failed.

use super::summary::{self, Diagnosis};
use crate::scenario::SMALLEST_STEP_S;
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::RigidBody;
use crate::solve::stepper::Stepper;
use crate::solve::trajectory::{Checkpoint, Schedule, State};

/// Steps of a try at most.
const TRY_STEPS: f64 = 5000.0;
/// Smaller and smaller steps to try.
const TRIES: usize = 20;

/// A run of which a step failed.
pub(super) struct Broken<'a, const N: usize> {
    /// Where it began.
    pub(super) initial: &'a State<N>,
    /// Where it stood before that step.
    pub(super) reached: &'a Checkpoint<N>,
    pub(super) schedule: Schedule,
    pub(super) failure: &'a Failure,
}

/// What failed, and with what smaller step it does not.
pub(super) fn diagnosis<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    broken: &Broken<'_, N>,
) -> Diagnosis {
    let advised = advised_step(body, stepper, broken);
    let Broken { reached, schedule, failure, .. } = broken;
    summary::diagnosis(failure, reached.step, schedule.step_s, advised)
}

/// A smaller step for such a run; `None` if none was found in reasonable time.
fn advised_step<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    broken: &Broken<'_, N>,
) -> Option<f64> {
    let &Broken { initial, reached, schedule, failure } = broken;
    let (last, done) = (&reached.state(), reached.step);
    let Schedule { step_s: h, steps: asked, .. } = schedule;
    let energy = body.energy(&initial.attitude, &initial.momentum);
    let start = energy.total();
    // What the energy may change by in a run that means anything; no limit where nothing moves at first.
    let allowed = 0.5 * energy.kinetic.max(start.abs()).max(energy.potential.abs());
    let allowed = if allowed > 0.0 { allowed } else { f64::INFINITY };
    let mut met = failure.clone();
    let mut step_s = h;
    for _ in 0..TRIES {
        step_s = met.smaller_step(step_s);
        if step_s < SMALLEST_STEP_S {
            return None;
        }
        let count = |steps: u64| (steps as f64 * h / step_s).ceil();
        // From the beginning if the place is soon passed: the run may have gone astray before it failed.
        let (from, past, left) = if count(done + 2) <= TRY_STEPS {
            (initial, count(done + 2), count(asked))
        } else {
            (last, count(2), count(asked - done))
        };
        if past > TRY_STEPS {
            return None;
        }
        stepper.start(from);
        let steps = left.min(TRY_STEPS) as u64;
        match (0..steps).try_for_each(|_| stepper.step(body, step_s).map(|_| ())) {
            Err(again) => met = again,
            Ok(()) => {
                let attitude = stepper.attitude().unwrap_or(initial.attitude);
                let change = body.energy(&attitude, &stepper.momentum()).total() - start;
                if change.abs() <= allowed {
                    return Some(step_s);
                }
                // Past it, but astray: half the step again.
                met = Failure { increments: Vec::new(), turn_rad: None, ..met };
            }
        }
    }
    None
}
