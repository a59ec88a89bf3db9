//! Results of a run in addition to its log: figures, the last state, and why it failed if it did.

use std::collections::BTreeMap;
use std::fmt;

use nalgebra::DMatrix;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::log::messages::Figures;
use crate::scenario::{Entry, Expect};
use crate::solve::failure::{Failure, FailureCode};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::so::{self, Mat};
use crate::solve::state::{Checkpoint, State};
use crate::solve::system::Energy;
use crate::solve::tangent::symplectic_error;

/// Outcome of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// All steps were made.
    Succeeded,
    /// A step could not be made; see the diagnosis.
    Failed,
    /// It was cancelled.
    Cancelled,
}

impl Outcome {
    /// Returns the word in logs and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

/// Results of a run in addition to its log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Summary {
    /// Outcome of the run.
    pub outcome: Outcome,
    /// Steps made.
    pub steps: u64,
    /// Time reached, in seconds.
    pub time_s: f64,
    /// Samples logged.
    pub samples: u64,
    /// The step at which this run resumed an interrupted one; 0 if it began at the start.
    pub resumed_step: u64,
    /// The last state.
    #[serde(rename = "final")]
    pub last: FinalState,
    /// Error of the last state against a reference, where it was asked for: see
    /// [`crate::advise::error_at_end`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<f64>,
    /// A bound in place of `error`, where the reference is known no better.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error_below: Option<f64>,
    /// Energy; absent if `/energy` was not logged.
    pub energy: Option<EnergySummary>,
    /// Distance from the group; absent if `/orthogonality` was not logged.
    pub orthogonality: Option<OrthogonalitySummary>,
    /// Drift of the conserved momentum; absent if `/momentum` was not logged or nothing is conserved.
    pub momentum: Option<MomentumSummary>,
    /// Largest error of the impulse that the steps have put in for torques by tables, against the exact integral of the
    /// tables, in N m s; absent without such torques, or if `/momentum` was not logged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table_impulse_max_error: Option<f64>,
    /// The control; absent without one, or if `/control` was not logged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub control: Option<ControlSummary>,
    /// The nonlinear solver.
    pub solver: SolverSummary,
    /// Wall time of the whole run in seconds.
    pub wall_s: f64,
    /// Time inside the integrator alone, per step; 0 where none was made.
    pub ns_per_step: f64,
    /// The log. In answers of the service a link is in its place.
    #[schemars(skip)]
    pub log: String,
    /// The derivatives by the start, where they were carried along.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub derivatives: Option<DerivativesSummary>,
    /// The covariance at the end, where one was carried along.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<CovarianceSummary>,
    /// Reason why the run failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diagnosis: Option<Diagnosis>,
    /// The condition of `until` that ended the run before its time, and when.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Outcome of the members of an ensemble; all else here is of member 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ensemble: Option<EnsembleSummary>,
    /// Warning that the run may mean little, though no step of it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warning: Option<String>,
    /// Expectations of the scenario that the run did not meet.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unmet: Vec<String>,
}

/// Derivatives at the end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DerivativesSummary {
    /// Size of the state transition matrix: the root of the sum of the squares of its entries.
    pub transition_norm: f64,
    /// How far it is from a symplectic one: see [`symplectic_error`].
    pub symplectic_error: f64,
}

/// Covariance at the end of a run, to first order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CovarianceSummary {
    /// Root mean square of the turn from the run, in radians: next to that of an ensemble.
    pub attitude_spread_rad: f64,
    /// Standard deviation of the turn in the direction in which it is largest, in radians.
    pub largest_attitude_deviation_rad: f64,
    /// Standard deviation of each component of the body momentum.
    pub body_momentum_deviation: Vec<f64>,
}

impl CovarianceSummary {
    /// Returns that of the last sample; `None` if there is no covariance.
    pub(super) fn of<const N: usize>(reached: &Checkpoint<N>) -> Option<Self> {
        let derivatives = reached.derivatives.as_ref()?;
        let attitude_spread_rad = derivatives.attitude_spread_rad()?;
        let d = so::dimension(N);
        let entry = |i: usize, j: usize| derivatives.covariance[2 * d * i + j];
        let of_attitude = DMatrix::from_fn(d, d, entry).symmetric_eigenvalues();
        let deviation = |variance: f64| variance.max(0.0).sqrt();
        Some(Self {
            attitude_spread_rad,
            largest_attitude_deviation_rad: deviation(of_attitude.max()),
            body_momentum_deviation: (d..2 * d).map(|i| deviation(entry(i, i))).collect(),
        })
    }
}

impl DerivativesSummary {
    /// Returns the summary of a run from one state to another; `None` if there is no transition matrix.
    pub(super) fn of<const N: usize>(reached: &Checkpoint<N>, initial: &State<N>) -> Option<Self> {
        let transition = &reached.derivatives.as_ref()?.transition;
        let transition_norm = transition.iter().map(|x| x * x).sum::<f64>().sqrt();
        let error = || symplectic_error(transition, &initial.momentum, &reached.momentum);
        (transition_norm > 0.0).then(|| Self { transition_norm, symplectic_error: error() })
    }
}

/// Outcome of the members of an ensemble.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EnsembleSummary {
    /// Members whose end is in the log.
    pub members: u64,
    /// Number of members that made all their steps, or were stopped by a condition of `until`.
    pub succeeded: u64,
    /// Number of those that were stopped, by the pointer of the condition.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub stopped: BTreeMap<String, u64>,
    /// Number of failed members, by code.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub failed: BTreeMap<String, u64>,
    /// Root mean square of the angles between the attitudes at the end and their mean, in radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude_spread_rad: Option<f64>,
    /// Standard deviation of each component of the body momentum at the end.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub body_momentum_deviation: Vec<f64>,
    /// Largest |H - H0| of any member that succeeded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub energy_max_abs_error: Option<f64>,
    /// Largest distance of any of them from the group.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orthogonality_max: Option<f64>,
    /// Spread of each of several bodies at the end, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub bodies: BTreeMap<String, BodySpread>,
}

/// Spread of one of several bodies over the members of an ensemble.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BodySpread {
    /// Root mean square of the angles between the attitudes and their mean, in radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude_spread_rad: Option<f64>,
    /// Standard deviation of each component of the body momentum.
    pub body_momentum_deviation: Vec<f64>,
    /// Standard deviation of each component of the centre of mass, in m.
    pub position_deviation_m: Vec<f64>,
    /// Standard deviation of each component of its velocity, in m/s.
    pub velocity_deviation_m_s: Vec<f64>,
}

/// The state a run ended at.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FinalState {
    /// Rotation matrix, row by row; absent if no channel needed it.
    pub attitude: Option<Vec<Vec<f64>>>,
    /// Body momentum, as in a scenario: 3-vector for n = 3, else skew matrix; absent for several bodies.
    #[serde(default, skip_serializing_if = "serde_json::Value::is_null")]
    #[schemars(with = "Vec<Entry>")]
    pub body_momentum: serde_json::Value,
    /// Several bodies, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub bodies: BTreeMap<String, FinalBody>,
}

/// The state that one of several bodies ended at.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FinalBody {
    /// Rotation matrix, row by row.
    pub attitude: Vec<Vec<f64>>,
    /// Body momentum, as in a scenario: 3-vector for n = 3, else skew matrix.
    #[schemars(with = "Vec<Entry>")]
    pub body_momentum: serde_json::Value,
    /// The centre of mass, of a pinned body its pivot, in m.
    pub position: Vec<f64>,
    /// Linear momentum in kg m/s; zero for a pinned body.
    pub linear_momentum: Vec<f64>,
}

/// Energy over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EnergySummary {
    /// H at the start.
    pub initial: f64,
    /// Largest |H - H0|.
    pub max_abs_error: f64,
    /// H - H0 at the last sample.
    pub final_error: f64,
    /// Least H. In a scene that changes with time or has torques the energy itself changes, and the errors are
    /// those of its balance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub least: Option<f64>,
    /// Largest H.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest: Option<f64>,
    /// H at the last sample.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<f64>,
}

/// Distance from the group over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct OrthogonalitySummary {
    /// Largest spectral norm of g g^T - I.
    pub max: f64,
    /// Mean of the same.
    pub mean: f64,
}

/// Conserved momentum over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MomentumSummary {
    /// Largest drift.
    pub max_drift: f64,
}

/// The control over its samples that fall on samples of the log.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ControlSummary {
    /// Their number.
    pub samples: u64,
    /// Number of those where a limit cut a command.
    pub saturated: u64,
    /// Angle to the target at the last of them, in radians; absent without a target.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pointing_error_rad: Option<f64>,
}

impl ControlSummary {
    /// Returns that of the figures of a run.
    pub(super) fn of(figures: &Figures) -> Option<Self> {
        Some(Self {
            samples: figures.control_samples?,
            saturated: figures.control_saturated.unwrap_or_default(),
            pointing_error_rad: figures.pointing_error_last,
        })
    }
}

/// The nonlinear solver over the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SolverSummary {
    /// Mean number of sweeps.
    pub iterations_per_step: f64,
    /// How the last step was solved; absent if none was made.
    pub kind: Option<String>,
}

/// Diagnosis of a step that could not be made, with advice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Diagnosis {
    /// The failure code; fixed.
    pub code: String,
    /// The step that failed, counted from 1; the log holds all samples before it.
    pub step: u64,
    /// The time at which that step began, in seconds.
    pub time_s: f64,
    /// The step size in seconds.
    pub step_s: f64,
    /// The stage at which the failure was seen, counted from 0.
    pub stage: Option<usize>,
    /// Measured value; absent where it is not finite.
    pub measured: Option<f64>,
    /// The limit it broke; absent where there is none.
    pub limit: Option<f64>,
    /// Sweeps of the nonlinear solver in the failed step.
    pub iterations: u32,
    /// The last increments of the nonlinear solver, oldest first.
    pub increments: Vec<f64>,
    /// Description of what happened, for a person.
    pub cause: String,
    /// Advice, for a person.
    pub advice: String,
    /// A step in seconds that carries the run, as far as it was tried; absent if none was found.
    /// For adaptive steps it is the longest.
    pub advised_step_s: Option<f64>,
    /// The longest step of `vpd_adaptive` that carries the run past a point source, as far as it was tried.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub advised_largest_step_s: Option<f64>,
}

impl Diagnosis {
    /// Adds the result for adaptive steps, which were tried.
    pub(super) fn with_own_steps(self, largest_step_s: f64, tried: Tried) -> Self {
        let advice = format!(
            "steps that adapt to the point source work here: try \"method\": {{ \"name\": \"vpd_adaptive\" }}, \
             \"step\": {{ \"adaptive\": {{ \"largest_step_s\": {} }} }}",
            serde_json::json!(largest_step_s)
        );
        let advice = format!("{}; otherwise {}", tried.appended_to(advice), self.advice);
        Self { advice, advised_largest_step_s: Some(largest_step_s), ..self }
    }
}

pub(super) fn energy(figures: &Figures) -> Option<EnergySummary> {
    Some(EnergySummary {
        initial: figures.energy_initial?,
        max_abs_error: figures.energy_max_abs_error?,
        final_error: figures.energy_final_error?,
        least: figures.energy_least,
        largest: figures.energy_largest,
        last: figures.energy_last,
    })
}

/// Largest error of a meaningful run, as a part of the energy that moves; the same as in a
/// stability map.
pub(super) const MEANINGLESS: f64 = 0.1;

/// The energy of a run, as far as it was measured.
#[derive(Clone, Copy, Debug)]
pub(super) struct EnergySeen {
    /// Energy at the start.
    initial: f64,
    /// Largest |H - H0|.
    error: f64,
    /// Largest kinetic energy; of a driven body also the largest change of its energy.
    kinetic: f64,
    pub(super) is_driven: bool,
}

impl EnergySeen {
    /// Returns the energy at the samples; `None` if `/energy` was not logged.
    pub(super) fn at_samples(figures: &Figures, is_driven: bool) -> Option<Self> {
        let change = figures.energy_largest? - figures.energy_least?;
        let kinetic = figures.kinetic_max?;
        Some(Self {
            initial: figures.energy_initial?,
            error: figures.energy_max_abs_error?,
            kinetic: if is_driven { kinetic.max(change) } else { kinetic },
            is_driven,
        })
    }

    /// Returns the energy of several bodies at the start and at the end alone.
    pub(super) fn between(first: Energy, last: Energy) -> Self {
        let error = (last.total() - first.total()).abs();
        // One that begins and ends at rest has moved between.
        let potential = (last.potential - first.potential).abs();
        let kinetic = first.kinetic.max(last.kinetic).max(potential);
        Self { initial: first.total(), error, kinetic, is_driven: false }
    }

    /// Returns the energy at the start and at the end alone, where the energy that a driven body
    /// received is not known.
    pub(super) fn at_the_ends<const N: usize>(
        body: &RigidBody<N>,
        start: &State<N>,
        end: &State<N>,
    ) -> Self {
        let [first, last] = [start, end].map(|at| body.energy(&at.attitude, &at.momentum));
        // A run that begins and ends at rest has moved between: by about as much as the torque does in a radian.
        let torque = |at: &State<N>| {
            let torque = body.gradient(&at.attitude);
            so::inner(&torque, &torque).sqrt()
        };
        let moved = first.kinetic.max(last.kinetic).max(torque(start)).max(torque(end));
        let change = (last.total() - first.total()).abs();
        let is_driven = body.is_driven();
        let error = if is_driven { 0.0 } else { change };
        Self { initial: first.total(), error, kinetic: moved, is_driven }
    }
}

/// Returns a warning if a run lost its energy without a step that fails: steps over a near charge,
/// each of them finite.
pub(super) fn warning(seen: EnergySeen) -> Option<String> {
    /// At rest nothing moves, and the round-off of the potential is no loss.
    const ROUND_OFF: f64 = 1e-9;
    let EnergySeen { initial, error, kinetic, .. } = seen;
    let lost = error > MEANINGLESS * kinetic && error > ROUND_OFF * initial.abs();
    lost.then(|| {
        format!(
            "the energy was off by {error:.1e} J, but at most {kinetic:.1e} J was in motion: the result is not \
             meaningful; take a smaller step"
        )
    })
}

pub(super) fn orthogonality(figures: &Figures, samples: u64) -> Option<OrthogonalitySummary> {
    let mean = figures.orthogonality_sum? / samples as f64;
    Some(OrthogonalitySummary { max: figures.orthogonality_max?, mean })
}

/// A matrix row by row.
pub(super) fn rows<const N: usize>(m: &Mat<N>) -> Vec<Vec<f64>> {
    (0..N).map(|i| (0..N).map(|j| m[(i, j)]).collect()).collect()
}

/// A momentum as in a scenario.
pub(super) fn momentum<const N: usize>(m: &Mat<N>) -> serde_json::Value {
    if N == 3 { serde_json::json!(so::vee(m)) } else { serde_json::json!(rows(m)) }
}

pub(super) fn final_state<const N: usize>(
    attitude: Option<&Mat<N>>,
    momentum: &Mat<N>,
) -> FinalState {
    let body_momentum = self::momentum(momentum);
    FinalState { attitude: attitude.map(rows), body_momentum, bodies: BTreeMap::new() }
}

/// Result of a search for a smaller step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Advised {
    /// A step that was tried.
    Step { step_s: f64, tried: Tried },
    /// The work allowed was done before one was found.
    NotFound {
        /// The smallest step that failed.
        tried_s: f64,
    },
    /// No step works.
    NoneWorks,
    /// Nothing was tried, so nothing is advised.
    Untried,
    /// The longest of adaptive steps, which was tried.
    OwnStep { largest_step_s: f64, tried: Tried },
}

impl Advised {
    /// Returns the same for adaptive steps.
    pub(super) fn of_own_steps(self) -> Self {
        match self {
            Self::Step { step_s, tried } => Self::OwnStep { largest_step_s: step_s, tried },
            other => other,
        }
    }
}

/// Extent to which a step was tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Tried {
    /// Over the whole run.
    Throughout,
    /// For this long, from the start and, if the run had come there with its energy, from where it failed.
    For { time_s: f64 },
}

impl Tried {
    /// Returns an advice, and for how long it was tried if that is not the whole run.
    fn appended_to(self, advice: String) -> String {
        match self {
            Self::Throughout => advice,
            Self::For { time_s } => format!("{advice}; it was tried for {time_s:.3} s only"),
        }
    }
}

/// Returns a description of what happened, for a person: the common reason, or the stiffness where
/// that is it.
fn cause(failure: &Failure, frequency: Option<f64>, step_s: f64) -> String {
    use FailureCode as Code;
    let of_size = matches!(failure.code, Code::MaxIterations | Code::Diverged | Code::Stalled);
    match frequency.filter(|_| of_size) {
        Some(frequency) => format!(
            "the implicit equations of the step are not solved: the potential is stiff; its fastest oscillation of {frequency:.1e} rad/s \
             goes through {:.1e} rad in a step, and that limits the step, not how fast the body turns",
            frequency * step_s.abs()
        ),
        None => failure.code.cause().to_owned(),
    }
}

pub(super) fn diagnosis(
    failure: &Failure,
    frequency: Option<f64>,
    steps_done: u64,
    step_s: f64,
    advised: Advised,
) -> Diagnosis {
    let finite = |x: f64| x.is_finite().then_some(x);
    let written = |step_s: f64| serde_json::json!(step_s);
    let (advice, advised_step_s) = match advised {
        Advised::Step { step_s, tried } => {
            let advice = format!("try \"step_s\": {}", written(step_s));
            (tried.appended_to(advice), Some(step_s))
        }
        Advised::OwnStep { largest_step_s, tried } => {
            let written = written(largest_step_s);
            let advice = format!("try \"largest_step_s\": {written}");
            (tried.appended_to(advice), Some(largest_step_s))
        }
        Advised::NotFound { tried_s } => (
            format!(
                "no step is advised: the search ended before it found one that works, and {} s still fails; check the scene at this time",
                written(tried_s)
            ),
            None,
        ),
        Advised::Untried => {
            ("no other step was tried; check the law at this state".to_owned(), None)
        }
        Advised::NoneWorks => {
            ("no smaller step got past this time; check the scene there".to_owned(), None)
        }
    };
    Diagnosis {
        code: failure.code.as_str().to_owned(),
        step: steps_done + 1,
        time_s: steps_done as f64 * step_s,
        step_s,
        stage: failure.stage,
        measured: finite(failure.measured),
        limit: finite(failure.limit),
        iterations: failure.iterations,
        increments: failure.increments.clone(),
        cause: cause(failure, frequency, step_s),
        advice,
        advised_step_s,
        advised_largest_step_s: None,
    }
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { code, step, time_s, cause, advice, .. } = self;
        write!(f, "{code} at step {step} (t = {time_s} s): {cause}. {advice}.")
    }
}

/// Returns the expectations that a run did not meet.
pub(super) fn unmet(expect: &Expect, summary: &Summary) -> Vec<String> {
    let mut unmet = Vec::new();
    if summary.outcome != Outcome::Succeeded {
        unmet.push(format!("outcome: {}", summary.outcome.as_str()));
    }
    let mut hold = |name: &str, value: Option<f64>, bound: Option<f64>| {
        if let Some(bound) = bound {
            match value {
                Some(value) if value <= bound => {}
                Some(value) => unmet.push(format!("{name}: {value:e}, at most {bound:e} expected")),
                None => unmet.push(format!("{name}: not measured, at most {bound:e} expected")),
            }
        }
    };
    hold("energy_error_max", summary.energy.map(|e| e.max_abs_error), expect.energy_error_max);
    hold(
        "orthogonality_error_max",
        summary.orthogonality.map(|o| o.max),
        expect.orthogonality_error_max,
    );
    hold("momentum_drift_max", summary.momentum.map(|m| m.max_drift), expect.momentum_drift_max);
    let attitude_error = expect.final_attitude.as_ref().zip(summary.last.attitude.as_ref());
    let attitude_error = attitude_error.map(|(expected, reached)| {
        let pairs = expected.iter().flatten().zip(reached.iter().flatten());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    });
    hold("final_attitude_error_max", attitude_error, expect.final_attitude_error_max);
    unmet
}
