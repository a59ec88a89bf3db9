//! The step to try after a failure: tried here first, not guessed.
//!
//! Invariant: an advised step got past the place where the run failed, or is so small that trying takes long.

use crate::assemble::Assembly;
use crate::scenario::SMALLEST_STEP_S;
use crate::solve::failure::Failure;
use crate::solve::trajectory::State;

/// Steps that a try may take.
const TRY_STEPS: u64 = 5000;
/// Smaller and smaller steps to try.
const TRIES: usize = 16;
/// So many steps beyond the place are tried too.
const BEYOND: u64 = 4;

/// A step that gets past a `failure` of the step after `done` steps of `h`; `None` if none was found. `last`
/// is the state before it.
pub(super) fn advised_step<const N: usize>(
    assembly: &mut Assembly<N>,
    last: &State<N>,
    done: u64,
    h: f64,
    failure: &Failure,
) -> Option<f64> {
    let Assembly { body, stepper, initial } = assembly;
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
        // From the beginning if that is soon done: the failed run may have gone astray before it failed.
        let count = |steps: u64| (steps as f64 * h / step_s).ceil();
        let whole = count(done + BEYOND);
        let (from, steps) =
            if whole <= TRY_STEPS as f64 { (&*initial, whole) } else { (last, count(BEYOND)) };
        if steps > TRY_STEPS as f64 {
            return Some(step_s);
        }
        stepper.start(from);
        let tried = (0..steps as u64).try_for_each(|_| stepper.step(body, step_s).map(|_| ()));
        match tried {
            Err(again) => met = again,
            Ok(()) => {
                let attitude = stepper.attitude().unwrap_or(initial.attitude);
                let change = body.energy(&attitude, &stepper.momentum()).total() - start;
                if change.abs() <= allowed {
                    return Some(step_s);
                }
                // Past it, but astray: a smaller step again.
                met = Failure { increments: Vec::new(), turn_rad: None, ..met };
            }
        }
    }
    None
}
