//! A scenario with a potential of the caller's own, for any n → samples → log.
//!
//! Invariant: body, terms, start and steps are those of the scenario; the log is one of a user-defined system, see
//! [`super::Recording`].

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;

use thiserror::Error;

use super::{Control, JobContext, Kept, Run, RunError, Summary};
use crate::assemble::assembled;
use crate::log::columns::Columns;
use crate::plan::{Motion, Plan};
use crate::scenario::{MethodName, Scenario, ScenarioError};
use crate::solve::hamiltonian::{Potential, RigidBody, gradient_error};
use crate::solve::so::{self, Mat};

/// A potential energy U(g) of a caller who learns n when the program runs, as an interpreter does; in Rust
/// [`Potential`] is the one for a known n.
pub trait PotentialOfRows: Debug + Send + Sync {
    /// U(g) in J at one attitude; `g`, from body to space coordinates, is n x n, row by row.
    fn energy(&self, g: &[f64]) -> f64;

    /// `D_ij = dU/dg_ij` in J at each of the attitudes `g`, most often the stages of a step: k x n x n, row by row, as the
    /// attitudes are. What is missing is as good as NaN.
    fn gradients(&self, g: &[f64]) -> Vec<f64>;
}

/// Reason why a scenario does not run with a potential of one's own.
#[derive(Debug, Error)]
pub enum PotentialError {
    /// The scenario is refused, with a potential or at all.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// The gradient is not that of the energy, or the run failed.
    #[error(transparent)]
    Run(#[from] RunError),
}

/// Runs a scenario with a potential in addition to its terms, by `vpd`, and writes the log. Blocks. The log holds no scenario,
/// because it does not hold the law: `verify` refuses it, and an interrupted one begins anew.
///
/// # Errors
/// [`PotentialError`]: scenes of several bodies, and those that time, torques, wheels or a control drive, are refused, and so is
/// what changes the method or the steps.
pub fn execute_with(
    scenario: &Scenario,
    potential: Arc<dyn PotentialOfRows>,
    context: &JobContext<'_>,
) -> Result<Summary, PotentialError> {
    let plan = planned(scenario)?;
    Ok(assembled(&plan, Run { plan: &plan, context, kept: Kept::Log, potential: Some(potential) })?)
}

/// Does the same, and keeps the samples in memory.
///
/// # Errors
/// The same.
pub fn collect_with(
    scenario: &Scenario,
    potential: Arc<dyn PotentialOfRows>,
    control: &Control,
) -> Result<(Summary, Columns), PotentialError> {
    let plan = planned(scenario)?;
    let mut columns = super::columns(&plan);
    let context = JobContext { log: Path::new(""), control };
    let kept = Kept::Memory(&mut columns);
    let run = Run { plan: &plan, context: &context, kept, potential: Some(potential) };
    let summary = assembled(&plan, run)?;
    Ok((summary, columns))
}

fn planned(scenario: &Scenario) -> Result<Plan, ScenarioError> {
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
            return Err(ScenarioError::invalid(pointer, message));
        }
    }
    asked.method.name = MethodName::Vpd;
    let mut plan = Plan::new(&asked)?;
    // What the terms alone would do, nothing or a turn in a plane, no longer counts.
    plan.formulation.motion = Motion::General;
    plan.formulation.carries_attitude = true;
    Ok(plan)
}

/// Returns the body with the potential.
///
/// # Errors
/// If its gradient at an attitude is not that of its energy.
pub(super) fn added<const N: usize>(
    body: RigidBody<N>,
    potential: Arc<dyn PotentialOfRows>,
    attitude: &Mat<N>,
) -> Result<RigidBody<N>, RunError> {
    /// A gradient that is off by more has an error of its formula.
    const WRONG: f64 = 1e-3;
    let potential = Rows(potential);
    let off = gradient_error::<N>(&potential, attitude);
    if !(off < WRONG) {
        return Err(RunError::Invalid(format!(
            "at the start the gradient of the potential differs by {off:.1e} of its size from differences of its energy; D_ij = dU/dg_ij is needed"
        )));
    }
    Ok(body.with_potential(Arc::new(potential)))
}

#[derive(Debug)]
struct Rows(Arc<dyn PotentialOfRows>);

impl<const N: usize> Potential<N> for Rows {
    fn energy(&self, g: &Mat<N>) -> f64 {
        self.0.energy(g.transpose().as_slice())
    }

    fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let found = Potential::<N>::gradients(self, std::slice::from_ref(g)).pop();
        found.unwrap_or_else(|| Mat::repeat(f64::NAN))
    }

    // asym(g^T D)
    fn gradients(&self, g: &[Mat<N>]) -> Vec<Mat<N>> {
        let rows: Vec<f64> =
            g.iter().flat_map(|g| g.transpose().iter().copied().collect::<Vec<_>>()).collect();
        let slopes = self.0.gradients(&rows);
        let slopes = slopes.chunks_exact(N * N).map(Mat::from_row_slice);
        g.iter().zip(slopes).map(|(g, d)| so::asym(&(g.transpose() * d))).collect()
    }
}
