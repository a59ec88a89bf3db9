//! The gradient of a function of a run, by one pass backward.

use super::{Tangent, TangentError, stages_of};
use crate::hamiltonian::BodyRate;
use crate::state::State;
use crate::stepper::Stepper;

/// The gradient of a function of the states of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Gradient {
    /// By the start: 2d numbers, for (xi, nu).
    pub start: Vec<f64>,
    /// By each parameter.
    pub parameters: Vec<f64>,
}

impl<const N: usize> Tangent<N> {
    /// The gradient of a function `F = sum_k F_k(state after k steps)` of a run of `stepper`, `steps` steps of `h` seconds, by the start of the run and by
    /// parameters, in one pass forward and one backward, whatever their number. `by_state(k, state)` returns the 2d
    /// derivatives of F_k by the state, left-trivialised as in [`super::Tangent`]; `None` if F_k is zero. It is asked from
    /// the last step to the start. For a function of the end alone it answers at the last step.
    ///
    /// States are kept at about the square root of the steps, and made again from there: memory grows with that root. At
    /// each the stepper starts anew.
    ///
    /// # Errors
    /// [`TangentError::Step`] of a step that fails, [`TangentError::Singular`].
    pub fn gradient(
        &mut self,
        stepper: &mut dyn Stepper<N>,
        start: &State<N>,
        (h, steps): (f64, u64),
        mut by_state: impl FnMut(u64, &State<N>) -> Option<Vec<f64>>,
        rates: &[BodyRate<N>],
    ) -> Result<Gradient, TangentError> {
        let length = steps.isqrt().max(1);
        let mut checkpoints = vec![start.clone()];
        let mut state = start.clone();
        for step in 0..steps {
            if step % length == 0 {
                stepper.start(&state);
            }
            stepper.step(&self.body, h)?;
            if (step + 1) % length == 0 || step + 1 == steps {
                state = self.state_of(stepper, &state);
                checkpoints.push(state.clone());
            }
        }
        let zero = vec![0.0; 2 * self.places.len()];
        let mut found = Gradient { start: zero, parameters: vec![0.0; rates.len()] };
        let mut after = steps;
        add(&mut found.start, by_state(steps, &state).as_deref());
        checkpoints.pop();
        while let Some(checkpoint) = checkpoints.pop() {
            let before = checkpoints.len() as u64 * length;
            // The states of this part of the run, each with the stages of the step from it.
            let mut part = Vec::new();
            stepper.start(&checkpoint);
            let mut state = checkpoint;
            for _ in before..after {
                stepper.step(&self.body, h)?;
                let next = self.state_of(stepper, &state);
                part.push((state, stages_of(stepper)));
                state = next;
            }
            while let Some((state, stages)) = part.pop() {
                let (start, parameters) =
                    self.of_step(h, &state, &stages)?.pull_back(&found.start, rates);
                found.start = start;
                add(&mut found.parameters, Some(&parameters));
                add(&mut found.start, by_state(before + part.len() as u64, &state).as_deref());
            }
            after = before;
        }
        Ok(found)
    }

    /// Where the stepper is; every scheme of VPD with an attitude has one.
    fn state_of(&self, stepper: &dyn Stepper<N>, before: &State<N>) -> State<N> {
        let attitude = stepper.attitude().unwrap_or(before.attitude);
        State { attitude, momentum: stepper.momentum() }
    }
}

fn add(sum: &mut [f64], terms: Option<&[f64]>) {
    for (sum, term) in sum.iter_mut().zip(terms.unwrap_or_default()) {
        *sum += term;
    }
}
