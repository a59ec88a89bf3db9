//! 3 · The one door: scenario → plan → body and stepper → samples → log.
//!
//! Invariant: the only place that turns runtime n into const N. A numerical failure is a [`Summary`] with a
//! [`Diagnosis`] and a finished log; only the log itself can make a run an error.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::log::LogError;
use crate::log::schema::Channel;
use crate::log::writer::{Level, LogHeader, LogWriter, Outcome as LogOutcome};
use crate::plan::{Formulation, Model, ModelKinetic, Plan, space_vector};
use crate::scenario::{Expect, MethodName, PotentialTerm, Scenario, ScenarioError};
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use crate::solve::so::{self, Mat, Vector};
use crate::solve::stepper::Stepper;
use crate::solve::stepper::lgvi::Lgvi;
use crate::solve::stepper::quaternion_gauss::QuaternionGauss;
use crate::solve::stepper::rk::Rk;
use crate::solve::stepper::rkmk::Rkmk;
use crate::solve::stepper::splitting::Splitting;
use crate::solve::stepper::vpd::Vpd;
use crate::solve::stepper::vpd_lagrangian::VpdLagrangian;
use crate::solve::stepper::vpd_reduced::VpdReduced;
use crate::solve::stepper::vrkmk::Vrkmk;
use crate::solve::trajectory::{
    self, Ending, Observables, Sample, Schedule, Sink, State, Trajectory,
};

mod geometry;

/// What a run shares with those who wait for it.
#[derive(Clone, Copy, Debug)]
pub struct JobContext<'a> {
    /// Where the finished log goes.
    pub log: &'a Path,
    /// Steps done so far; the run writes it.
    pub steps_done: &'a AtomicU64,
    /// Set it to stop the run after its current step.
    pub cancelled: &'a AtomicBool,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// All steps were made.
    Succeeded,
    /// A step could not be made; see the diagnosis.
    Failed,
    /// Somebody stopped it.
    Cancelled,
}

impl Outcome {
    /// The word in logs and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

/// What a run leaves behind, beside its log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// How it ended.
    pub outcome: Outcome,
    /// Steps made.
    pub steps: u64,
    /// Time reached, in seconds.
    pub time_s: f64,
    /// Samples logged.
    pub samples: u64,
    /// The last state.
    #[serde(rename = "final")]
    pub last: FinalState,
    /// Energy; absent if `/energy` was not logged.
    pub energy: Option<EnergySummary>,
    /// Distance from the group; absent if `/orthogonality` was not logged.
    pub orthogonality: Option<OrthogonalitySummary>,
    /// Drift of the conserved momentum; absent if `/momentum` was not logged or nothing is conserved.
    pub momentum: Option<MomentumSummary>,
    /// The nonlinear solver.
    pub solver: SolverSummary,
    /// Wall time of the whole run in seconds.
    pub wall_s: f64,
    /// Time inside the integrator alone, per step.
    pub ns_per_step: f64,
    /// The log.
    pub log: String,
    /// Why the run failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diagnosis: Option<Diagnosis>,
    /// What the scenario expected and the run did not keep to.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unmet: Vec<String>,
}

/// The state a run ended at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinalState {
    /// Rotation matrix, row by row; absent if no channel needed it.
    pub attitude: Option<Vec<Vec<f64>>>,
    /// Body momentum, as in a scenario: 3-vector for n = 3, else skew matrix.
    pub body_momentum: serde_json::Value,
}

/// Energy over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnergySummary {
    /// H at the start.
    pub initial: f64,
    /// Largest |H - H0|.
    pub max_abs_error: f64,
    /// H - H0 at the last sample.
    pub final_error: f64,
}

/// Distance from the group over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OrthogonalitySummary {
    /// Largest spectral norm of g g^T - I.
    pub max: f64,
    /// Mean of the same.
    pub mean: f64,
}

/// Conserved momentum over the samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MomentumSummary {
    /// Largest drift.
    pub max_drift: f64,
}

/// The nonlinear solver over the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SolverSummary {
    /// Mean number of sweeps.
    pub iterations_per_step: f64,
    /// How the last step was solved; absent if none was made.
    pub kind: Option<String>,
}

/// Why a step could not be made, and what to do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Diagnosis {
    /// The failure code; fixed.
    pub code: String,
    /// The step that failed, counted from 1; the log holds all samples before it.
    pub step: u64,
    /// The time at which that step began, in seconds.
    pub time_s: f64,
    /// The step size in seconds.
    pub step_s: f64,
    /// The stage at which it was seen, counted from 0.
    pub stage: Option<usize>,
    /// What was measured; absent where it is not finite.
    pub measured: Option<f64>,
    /// The limit it broke; absent where there is none.
    pub limit: Option<f64>,
    /// Sweeps of the nonlinear solver in the failed step.
    pub iterations: u32,
    /// The last increments of the nonlinear solver, oldest first.
    pub increments: Vec<f64>,
    /// What happened, for a person.
    pub cause: String,
    /// What to do about it, for a person.
    pub advice: String,
    /// A step in seconds that should work.
    pub advised_step_s: Option<f64>,
}

/// Why a run has no result.
#[derive(Debug, Error)]
pub enum RunError {
    /// The scenario cannot be planned.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// The log could not be written.
    #[error(transparent)]
    Log(#[from] LogError),
}

impl RunError {
    /// The failure code of a job that ends so.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Scenario(_) => "invalid_input",
            Self::Log(error) => error.code(),
        }
    }
}

/// Runs a scenario to its end and writes its log. Blocks.
///
/// # Errors
/// If the scenario cannot be planned or the log cannot be written; no log is left then.
pub fn execute(scenario: &Scenario, context: &JobContext<'_>) -> Result<Summary, RunError> {
    let plan = Plan::new(scenario)?;
    macro_rules! for_dimension {
        ($($n:literal)*) => {
            match plan.dimension {
                3 => run(scenario, &plan, in_space(&plan), context),
                $($n => run::<$n>(scenario, &plan, in_any_dimension(&plan), context),)*
                n => Err(ScenarioError::invalid("/scene/inertia", format!("n = {n} is not supported")).into()),
            }
        };
    }
    for_dimension!(2 4 5 6 7 8 9 10 11 12 13 14 15 16)
}

fn run<const N: usize>(
    scenario: &Scenario,
    plan: &Plan,
    stepper: Option<Box<dyn Stepper<N>>>,
    context: &JobContext<'_>,
) -> Result<Summary, RunError> {
    let mut stepper = stepper.expect("the plan refuses a method that cannot run the scene");
    let begun = Instant::now();
    let (body, initial) = problem::<N>(&plan.model);
    let schedule = Schedule { step_s: plan.step_s, steps: plan.steps, every: plan.every };
    let writer = LogWriter::<N>::create(context.log, header(scenario, plan))?;
    let mut recorder =
        Recorder { writer, extremes: Extremes::default(), elsewhere: Duration::ZERO };
    recorder.writer.message(Level::Info, 0.0, &format!("started: {}", scenario.name()))?;
    let integrating = Instant::now();
    let end = trajectory::integrate(
        &body,
        stepper.as_mut(),
        &initial,
        schedule,
        observables(plan),
        &mut recorder,
        |steps| {
            context.steps_done.store(steps, Ordering::Relaxed);
            !context.cancelled.load(Ordering::Relaxed)
        },
    )?;
    let inside = integrating.elapsed().saturating_sub(recorder.elsewhere);
    context.steps_done.store(end.steps, Ordering::Relaxed);
    let time_s = end.steps as f64 * plan.step_s;
    let (outcome, diagnosis) = match &end.ending {
        Ending::Completed => (Outcome::Succeeded, None),
        Ending::Cancelled => (Outcome::Cancelled, None),
        Ending::Failed(failure) => {
            (Outcome::Failed, Some(diagnosis(failure, end.steps, plan.step_s)))
        }
    };
    let Recorder { mut writer, extremes, .. } = recorder;
    match &diagnosis {
        Some(diagnosis) => writer.message(Level::Error, time_s, &diagnosis.to_string())?,
        None => writer.message(
            Level::Info,
            time_s,
            &format!("{}: step {}", outcome.as_str(), end.steps),
        )?,
    }
    let mut summary = Summary {
        outcome,
        steps: end.steps,
        time_s,
        samples: end.samples,
        last: final_state(&end),
        energy: extremes.energy,
        orthogonality: extremes
            .orthogonality
            .map(|(max, sum)| OrthogonalitySummary { max, mean: sum / end.samples as f64 }),
        momentum: extremes.drift.map(|max_drift| MomentumSummary { max_drift }),
        solver: SolverSummary {
            iterations_per_step: end.iterations as f64 / end.steps.max(1) as f64,
            kind: end.convergence.map(|solved| solved.rung.as_str().to_owned()),
        },
        wall_s: 0.0,
        ns_per_step: inside.as_nanos() as f64 / end.steps.max(1) as f64,
        log: context.log.display().to_string(),
        diagnosis,
        unmet: Vec::new(),
    };
    if let Some(expect) = &scenario.expect {
        summary.unmet = unmet(expect, &summary);
    }
    writer.finish(log_outcome(&summary))?;
    summary.wall_s = begun.elapsed().as_secs_f64();
    Ok(summary)
}

/// The stepper that the plan chose, of those for any n; `None` for the others.
fn in_any_dimension<const N: usize>(plan: &Plan) -> Option<Box<dyn Stepper<N>>> {
    let Formulation { method, carries_attitude, .. } = plan.formulation;
    let (tableau, stop) = (plan.model.tableau.clone(), plan.model.stop);
    Some(match method {
        MethodName::Auto | MethodName::Vpd => Box::new(Vpd::new(tableau, stop)),
        MethodName::VpdLagrangian => Box::new(VpdLagrangian::new(tableau, stop)),
        MethodName::VpdReduced => Box::new(VpdReduced::new(tableau, stop, carries_attitude)),
        MethodName::Vrkmk => Box::new(Vrkmk::new(tableau, stop)),
        MethodName::VrkmkProjected => Box::new(Vrkmk::new(tableau, stop).projected()),
        MethodName::Rkmk => Box::new(Rkmk::new(tableau)?),
        MethodName::Rk => Box::new(Rk::new(tableau, false)?),
        MethodName::RkProjected => Box::new(Rk::new(tableau, true)?),
        MethodName::Splitting | MethodName::Lgvi | MethodName::QuaternionGauss => return None,
    })
}

/// The stepper that the plan chose, for n = 3.
fn in_space(plan: &Plan) -> Option<Box<dyn Stepper<3>>> {
    let Formulation { method, order, stages, .. } = plan.formulation;
    Some(match method {
        MethodName::Splitting => Box::new(Splitting::new(order)?),
        MethodName::Lgvi => Box::new(Lgvi::new(order, plan.model.stop)?),
        MethodName::QuaternionGauss => Box::new(QuaternionGauss::new(stages, plan.model.stop)?),
        _ => return in_any_dimension(plan),
    })
}

/// The body and its state at the start, with their const size.
pub(crate) fn problem<const N: usize>(model: &Model) -> (RigidBody<N>, State<N>) {
    let kinetic = match &model.kinetic {
        ModelKinetic::Principal { weights } => {
            Kinetic::Principal { weights: Mat::from_fn(|i, j| weights[(i, j)]) }
        }
        ModelKinetic::Tensor { inertia } => Kinetic::Tensor {
            inertia: *inertia,
            inverse: inertia
                .cholesky()
                .expect("the plan checked that the inertia is positive definite")
                .inverse(),
        },
    };
    let terms = model.terms.iter().map(term).collect();
    let attitude = Mat::from_fn(|i, j| model.attitude[(i, j)]);
    let state = State {
        // Decimal text puts a rotation a digit off the group; the run starts on it.
        attitude: so::polar(&attitude).expect("the plan checked that the attitude is a rotation"),
        momentum: Mat::from_fn(|i, j| model.momentum[(i, j)]),
    };
    (RigidBody::new(kinetic, terms, model.constant), state)
}

fn term<const N: usize>(given: &PotentialTerm) -> Term<N> {
    let point = |v: &[f64]| Vector::<N>::from_column_slice(v);
    let law = match given {
        PotentialTerm::Uniform(t) => {
            Law::Uniform { weight: t.weight, body_point: point(&t.body_point) }
        }
        PotentialTerm::PointSource(t) => {
            Law::PointSource { strength: t.strength, body_point: point(&t.body_point) }
        }
        PotentialTerm::Spring(t) => Law::Spring {
            stiffness: t.stiffness,
            rest_length: t.rest_length,
            body_point: point(&t.body_point),
        },
        PotentialTerm::GravityGradient(t) => {
            let rows = t.matrix.as_ref().expect("the plan filled in the matrix");
            // Exactly symmetric: text may leave the two halves a digit apart.
            let matrix = so::symmetric_part(&Mat::from_fn(|i, j| rows[i][j]));
            Law::GravityGradient { strength: t.strength, matrix }
        }
    };
    Term { law, space: point(space_vector(given)) }
}

/// What the asked channels need at a sample.
fn observables(plan: &Plan) -> Observables {
    Observables {
        energy: plan.logs(Channel::Energy),
        orthogonality: plan.logs(Channel::Orthogonality),
        momentum: plan.logs(Channel::Momentum),
        sigma_min: plan.logs(Channel::Solver),
    }
}

/// Passes samples to the log, keeps their extremes, and measures the time that is not the integrator's.
struct Recorder<const N: usize> {
    writer: LogWriter<N>,
    extremes: Extremes,
    elsewhere: Duration,
}

/// The figures of a summary, as samples come in.
#[derive(Default)]
struct Extremes {
    energy: Option<EnergySummary>,
    /// Largest and sum.
    orthogonality: Option<(f64, f64)>,
    drift: Option<f64>,
}

impl<const N: usize> Sink<N> for Recorder<N> {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), LogError> {
        let begun = Instant::now();
        if let Some((energy, error)) = sample.energy.zip(sample.energy_error) {
            let (initial, before) = self
                .extremes
                .energy
                .map_or((energy.total(), 0.0), |e| (e.initial, e.max_abs_error));
            let max_abs_error = error.abs().max(before);
            self.extremes.energy =
                Some(EnergySummary { initial, max_abs_error, final_error: error });
        }
        if let Some(error) = sample.orthogonality_error {
            let (max, sum) = self.extremes.orthogonality.unwrap_or_default();
            self.extremes.orthogonality = Some((error.max(max), sum + error));
        }
        if let Some(drift) = sample.momentum_drift {
            self.extremes.drift = Some(drift.max(self.extremes.drift.unwrap_or_default()));
        }
        let result = self.writer.record(sample);
        self.elsewhere += begun.elapsed();
        result
    }
}

fn final_state<const N: usize>(end: &Trajectory<N>) -> FinalState {
    let rows = |m: &Mat<N>| -> Vec<Vec<f64>> {
        (0..N).map(|i| (0..N).map(|j| m[(i, j)]).collect()).collect()
    };
    let body_momentum = if N == 3 {
        serde_json::json!(so::vee(&end.momentum))
    } else {
        serde_json::json!(rows(&end.momentum))
    };
    FinalState { attitude: end.attitude.as_ref().map(rows), body_momentum }
}

fn diagnosis(failure: &Failure, steps_done: u64, step_s: f64) -> Diagnosis {
    let finite = |x: f64| x.is_finite().then_some(x);
    let advised_step_s = failure.advised_step(step_s);
    let advice = match advised_step_s {
        Some(advised) => format!("try \"step_s\": {advised} or a tableau with more stages"),
        None => "no step helps at this place; look at the scene there".to_owned(),
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
        cause: failure.code.cause().to_owned(),
        advice,
        advised_step_s,
    }
}

impl std::fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { code, step, time_s, cause, advice, .. } = self;
        write!(f, "{code} at step {step} (t = {time_s} s): {cause}. {advice}.")
    }
}

/// What an expectation asks and a run did not keep to.
fn unmet(expect: &Expect, summary: &Summary) -> Vec<String> {
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

/// What the log says of the job before its first sample.
fn header(scenario: &Scenario, plan: &Plan) -> LogHeader {
    let job = BTreeMap::from([
        ("vpd_version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("name".to_owned(), scenario.name().to_owned()),
        ("scenario".to_owned(), json(scenario)),
        ("plan".to_owned(), json(plan)),
    ]);
    LogHeader {
        epoch_ns: scenario.epoch_ns(),
        channels: plan.channels.iter().map(|channel| channel.topic).collect(),
        compression: scenario.log.compression,
        samples_per_chunk: plan.samples_per_chunk,
        scenario_json: scenario.to_json(),
        job,
        scene: geometry::scene(plan),
    }
}

/// What the log says of the job after its last sample: figures of the run, none of the clock.
fn log_outcome(summary: &Summary) -> LogOutcome {
    let mut entries = BTreeMap::from([
        ("steps".to_owned(), summary.steps.to_string()),
        ("samples".to_owned(), summary.samples.to_string()),
        ("time_s".to_owned(), json(&summary.time_s)),
        ("final".to_owned(), json(&summary.last)),
        ("iterations_per_step".to_owned(), json(&summary.solver.iterations_per_step)),
    ]);
    let mut figure = |name: &str, value: Option<f64>| {
        if let Some(value) = value {
            entries.insert(name.to_owned(), json(&value));
        }
    };
    figure("energy_max_abs_error", summary.energy.map(|energy| energy.max_abs_error));
    figure("orthogonality_max", summary.orthogonality.map(|orthogonality| orthogonality.max));
    figure("momentum_max_drift", summary.momentum.map(|momentum| momentum.max_drift));
    if let Some(diagnosis) = &summary.diagnosis {
        entries.insert("code".to_owned(), diagnosis.code.clone());
        entries.insert("diagnosis".to_owned(), json(diagnosis));
    }
    LogOutcome { state: summary.outcome.as_str().to_owned(), entries }
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("figures and names are JSON by construction")
}
