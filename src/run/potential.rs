//! A scenario with a potential of the caller's own, for any n → samples → log.
//!
//! Invariant: body, terms, start and steps are those of the scenario; the log is one of a user-defined system, see
//! [`Recording`].

use std::fmt::Debug;
use std::sync::Arc;

use thiserror::Error;

use super::{JobContext, Recording, RunError, Summary, header};
use crate::assemble::{Assembly, Task, assembled};
use crate::plan::{Motion, Plan};
use crate::scenario::{MethodName, Scenario, ScenarioError};
use crate::solve::hamiltonian::{Potential, gradient_error};
use crate::solve::so::{self, Mat};
use crate::solve::trajectory::Schedule;

/// A potential energy U(g) of a caller who learns n when the program runs, as an interpreter does; in Rust
/// [`Potential`] is the one for a known n.
pub trait PotentialOfRows: Debug + Send + Sync {
    /// U(g) in J; `g`, from body to space coordinates, is n x n, row by row.
    fn energy(&self, g: &[f64]) -> f64;

    /// `D_ij = dU/dg_ij` in J, n x n, row by row; of another length it is as good as NaN.
    fn slope(&self, g: &[f64]) -> Vec<f64>;
}

/// Reason why a scenario does not run with a potential of one's own.
#[derive(Debug, Error)]
pub enum PotentialError {
    /// The scenario is refused, with a potential or at all.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// The slope is not that of the energy.
    #[error(
        "at the start the slope of the potential differs by {0:.1e} of its size from differences of its energy; D_ij = dU/dg_ij is needed"
    )]
    Slope(f64),
    /// The run failed.
    #[error(transparent)]
    Run(#[from] RunError),
}

/// Runs a scenario with a potential in addition to its terms, by `vpd`, and writes the log. Blocks.
///
/// # Errors
/// [`PotentialError`]: scenes of several bodies, and those that time, torques, wheels or a control drive, are refused, and so is
/// what changes the method or the steps.
pub fn execute_with(
    scenario: &Scenario,
    potential: Arc<dyn PotentialOfRows>,
    context: &JobContext<'_>,
) -> Result<Summary, PotentialError> {
    let mut asked = scenario.clone();
    let others = [
        (scenario.bodies().is_some(), "/scene/bodies"),
        (!scenario.scene.is_plain(), "/scene"),
        (scenario.ensemble.is_some(), "/ensemble"),
        (scenario.accuracy.is_some(), "/accuracy"),
        (scenario.derivatives.is_some(), "/derivatives"),
        (scenario.adaptive().is_some(), "/step"),
        (!scenario.until.is_empty(), "/until"),
        (!matches!(scenario.method.name, MethodName::Auto | MethodName::Vpd), "/method/name"),
    ];
    for (given, pointer) in others {
        if given {
            let message = "a potential of your own is for one body that nothing else drives, by vpd in steps of one length";
            return Err(ScenarioError::invalid(pointer, message).into());
        }
    }
    asked.method.name = MethodName::Vpd;
    let mut plan = Plan::new(&asked)?;
    // What the terms alone would do, nothing or a turn in a plane, no longer counts.
    plan.formulation.motion = Motion::General;
    plan.formulation.carries_attitude = true;
    assembled(&plan, WithPotential { plan: &plan, potential, context })
}

struct WithPotential<'a> {
    plan: &'a Plan,
    potential: Arc<dyn PotentialOfRows>,
    context: &'a JobContext<'a>,
}

impl Task for WithPotential<'_> {
    type Output = Result<Summary, PotentialError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        /// A slope that is off by more has an error of its formula.
        const WRONG: f64 = 1e-3;
        let Self { plan, potential, context } = self;
        let Assembly { body, mut stepper, initial, .. } = assembly;
        let potential = Rows(potential);
        let off = gradient_error::<N>(&potential, &initial.attitude);
        if !(off < WRONG) {
            return Err(PotentialError::Slope(off));
        }
        let body = body.with_potential(Arc::new(potential));
        let recording = Recording {
            channels: plan.channels.iter().map(|channel| channel.topic).collect(),
            epoch_ns: plan.asked.epoch_ns(),
            compression: plan.asked.log.compression,
            scene: header(plan).scene,
            ..Recording::new(plan.asked.name())
        };
        let schedule = Schedule { step_s: plan.step_s, steps: plan.steps, every: plan.every };
        Ok(recording.run(&body, stepper.as_mut(), &initial, schedule, context)?)
    }
}

#[derive(Debug)]
struct Rows(Arc<dyn PotentialOfRows>);

impl<const N: usize> Potential<N> for Rows {
    fn energy(&self, g: &Mat<N>) -> f64 {
        self.0.energy(g.transpose().as_slice())
    }

    // asym(g^T D)
    fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let slope = self.0.slope(g.transpose().as_slice());
        if slope.len() != N * N {
            return Mat::repeat(f64::NAN);
        }
        so::asym(&(g.transpose() * Mat::from_row_slice(&slope)))
    }
}
