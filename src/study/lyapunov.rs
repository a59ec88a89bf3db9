//! The Lyapunov exponents of a scene, all of them, by the exact derivatives of its steps.
//!
//! Invariant: the states on the way are those of a run of the scenario with derivatives.

use std::sync::atomic::Ordering;

use thiserror::Error;

use super::Watch;
use crate::assemble::{Assembly, Task, assembled};
use crate::plan::Plan;
use crate::scenario::{Derivatives, Scenario, ScenarioError};
use crate::solve::failure::Failure;
use crate::solve::tangent::{Lyapunov, Tangent, TangentError};

/// Reason why a scene has no exponents.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ExponentsError {
    /// The scenario cannot be planned, or its steps have no derivatives.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// A step failed.
    #[error("step {step} fails: {failure}; `vpd run` says more")]
    Step {
        /// Steps made before it.
        step: u64,
        /// The failure.
        failure: Failure,
    },
    /// The equations of a derivative have no solution to working precision.
    #[error(
        "the derivative of step {step} does not exist to working precision: give a shorter step_s"
    )]
    Singular {
        /// Steps made before it.
        step: u64,
    },
    /// It was cancelled.
    #[error("it was cancelled")]
    Cancelled,
}

/// Returns the exponents along the whole run of a scenario with a step. Of `watch` the steps done can be read.
///
/// # Errors
/// [`ExponentsError`]; at `/derivatives` of the scenario for scenes without derivatives.
pub fn exponents(scenario: &Scenario, watch: &Watch) -> Result<Lyapunov, ExponentsError> {
    let mut asked = scenario.clone();
    asked.derivatives = Some(Derivatives { state: true, ..Derivatives::default() });
    asked.check().map_err(|error| match error.pointer.as_str() {
        "/derivatives" => {
            let message = format!("{}; exponents are made of them", error.message);
            ScenarioError { message, ..error }
        }
        _ => error,
    })?;
    let mut plan = Plan::new(&asked)?;
    // What is carried is a frame, not the derivative of the whole.
    plan.settled.derivatives = None;
    watch.expect(plan.steps);
    assembled(&plan, Exponents { plan: &plan, watch })
}

struct Exponents<'a> {
    plan: &'a Plan,
    watch: &'a Watch,
}

impl Task for Exponents<'_> {
    type Output = Result<Lyapunov, ExponentsError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        let Self { plan, watch } = self;
        let Assembly { body, mut stepper, initial, .. } = assembly;
        let failed = |error: TangentError| {
            let step = watch.done.load(Ordering::Relaxed);
            match error {
                TangentError::Step(failure) => ExponentsError::Step { step, failure },
                TangentError::Driven | TangentError::UserPotential | TangentError::Singular => {
                    ExponentsError::Singular { step }
                }
            }
        };
        let mut tangent = Tangent::new(&body, plan.model.tableau.clone()).map_err(failed)?;
        let go_on = |step| {
            watch.done.store(step, Ordering::Relaxed);
            !watch.is_cancelled()
        };
        let found = tangent.lyapunov(stepper.as_mut(), &initial, (plan.step_s, plan.steps), go_on);
        found.map_err(failed)?.ok_or(ExponentsError::Cancelled)
    }
}
