//! 4 · A scenario fitted to attitudes that were seen: least squares with the exact derivatives of the steps.
//!
//! The residual of a model g against an attitude h is `(g - h) / sqrt(2)`, of size `2 sin(angle / 2)` for n = 3: smooth at any
//! angle, and for small ones the angle. It changes by `g hat(xi) / sqrt(2)`. Invariant: a fitted scenario is accepted as it
//! is; residuals and their derivatives come from one run.

use std::f64::consts::FRAC_1_SQRT_2;

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt, TerminationReason};
use nalgebra::{DMatrix, DVector};
// That of the crate for least squares, which is another release.
use nalgebra_of_fit as dense;
use serde::Serialize;
use serde_json::{Value, json};
use thiserror::Error;

use crate::assemble::{Assembly, Task, assembled};
use crate::plan::Plan;
use crate::scenario;
use crate::scenario::{Derivatives, Framed, Scenario, ScenarioError, from_tree, set};
use crate::solve::failure::Failure;
use crate::solve::so::{self, Mat};

mod seen;
pub use seen::{Attitude, SeenError, read};

/// Singular values below this part of the largest, columns scaled to one length, are none: the fields are not determined.
const UNDETERMINED: f64 = 1e-9;

/// Reason why a scenario cannot be fitted.
#[derive(Debug, Error)]
pub enum FitError {
    /// The scenario cannot be planned, has no derivatives, or has no such field.
    #[error("{}: {}", if .0.pointer.is_empty() { "the scenario" } else { &.0.pointer }, .0.message)]
    Scenario(#[from] ScenarioError),
    /// The attitudes cannot be used.
    #[error(transparent)]
    Seen(#[from] SeenError),
    /// A step of the first run failed.
    #[error(
        "with the values that were given, the step at t = {time_s} s fails: {failure}; `vpd run` says more"
    )]
    Step {
        /// Time at which the step begins, in seconds.
        time_s: f64,
        /// The failure.
        failure: Failure,
    },
    /// Some fields can change together without a change of the attitudes.
    #[error("the attitudes do not determine {}: they can change together and leave the motion as it is; give one of them", .0.join(" and "))]
    Undetermined(Vec<String>),
    /// The search ended elsewhere than in a minimum.
    #[error("no minimum was found after {runs} runs ({reason}); begin nearer to it")]
    Lost {
        /// Runs made.
        runs: u64,
        /// The reason, as the search says it.
        reason: String,
    },
}

/// What is to be found.
#[derive(Clone, Copy, Debug)]
pub struct Question<'a> {
    /// The scenario to begin with: its step is the longest one taken, its duration is not used.
    pub scenario: &'a Scenario,
    /// The fields to be fitted: JSON pointers as in `derivatives.parameters`.
    pub fields: &'a [String],
    /// Whether the attitude at the start is fitted too.
    pub start_attitude: bool,
    /// The attitudes, of times that rise from 0 s or later.
    pub seen: &'a [Attitude],
}

/// One fitted number.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fitted {
    /// Its field; of the attitude at the start `start attitude 1` and so on, the turn in body coordinates, in rad.
    pub field: String,
    /// Its value at the beginning.
    pub before: f64,
    /// Its value in the minimum.
    pub value: f64,
    /// The standard error, by the scatter of the residuals.
    pub standard_error: f64,
}

/// A fitted scenario.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fit {
    /// The scenario.
    #[serde(skip)]
    pub scenario: Scenario,
    /// The fitted numbers.
    pub fitted: Vec<Fitted>,
    /// Their covariance, row by row.
    pub covariance: Vec<Vec<f64>>,
    /// Root of the mean square of the residuals before the fit, in rad.
    pub before_rad: f64,
    /// The same after it.
    pub after_rad: f64,
    /// Time in seconds, residual before and after, in rad, of each attitude.
    pub residuals: Vec<[f64; 3]>,
    /// Runs made.
    pub runs: u64,
}

/// Fits fields of a scenario, and on demand the attitude at its start, to attitudes.
///
/// Standard errors and covariance are those of equal, independent errors of the attitudes about all axes, of the size that is
/// left in the minimum.
///
/// # Errors
/// [`FitError`]; a field is refused as `derivatives.parameters` refuses it.
pub fn fit(question: Question<'_>) -> Result<Fit, FitError> {
    let Question { scenario, fields, start_attitude, seen } = question;
    let mut asked = scenario.clone();
    asked.derivatives =
        Some(Derivatives { state: start_attitude, parameters: fields.to_vec(), covariance: None });
    asked.check().map_err(as_asked)?;
    let plan = Plan::new(&asked)?;
    let d = so::dimension(plan.dimension);
    seen::check(seen, plan.dimension)?;
    let initial = &scenario.scene.initial;
    let mut given = initial.momentum.iter().chain(&initial.angular_velocity);
    if start_attitude && given.any(|given| matches!(given, Framed::Space(_))) {
        let message = "is given in space and would turn against the body with the fitted attitude; give it in the body";
        return Err(ScenarioError::invalid("/scene/initial", message).into());
    }
    let document = serde_json::to_value(&asked).unwrap_or_default();
    let value = |pointer: &String| document.pointer(pointer).and_then(Value::as_f64);
    let mut first: Vec<f64> = fields.iter().filter_map(value).collect();
    first.resize(fields.len() + if start_attitude { d } else { 0 }, 0.0);
    let count = first.len();
    if seen.len() * d <= count {
        return Err(SeenError::TooFew { count: seen.len(), unknowns: count }.into());
    }
    let model = Model { document: &document, fields, start_attitude, seen };
    let begun = model.run(&first)?;
    let mut search = Search { model, values: first.clone(), found: begun.clone(), runs: 1 };
    undetermined(&begun, &search.model.names(d))?;
    let (ended, report) = LevenbergMarquardt::new().minimize(search);
    search = ended;
    let Search { model, values, found: end, runs } = search;
    match report.termination {
        // What rounding allows was reached.
        TerminationReason::NoImprovementPossible(_) => {}
        reason if reason.was_successful() => {}
        reason => return Err(FitError::Lost { runs, reason: format!("{reason:?}") }),
    }
    let names = model.names(d);
    undetermined(&end, &names)?;
    // The covariance is that of d numbers an attitude: sigma^2 (J^T J)^-1
    let freedom = (seen.len() * d - count) as f64;
    let variance = end.residuals.norm_squared() / freedom;
    let normal = end.jacobian.tr_mul(&end.jacobian);
    let inverse = normal.cholesky().ok_or_else(|| FitError::Undetermined(names.clone()))?.inverse();
    let covariance = inverse * variance;
    let fitted = names.into_iter().enumerate().map(|(k, field)| Fitted {
        field,
        before: first[k],
        value: values[k],
        standard_error: covariance[(k, k)].sqrt(),
    });
    let fitted = fitted.collect();
    let sizes = |run: &Seen| -> Vec<f64> {
        let each = plan.dimension * plan.dimension;
        let of_each = run.residuals.as_slice().chunks_exact(each);
        of_each.map(|r| r.iter().map(|x| x * x).sum::<f64>().sqrt()).collect()
    };
    let (before, after) = (sizes(&begun), sizes(&end));
    let mean = |run: &Seen| run.residuals.norm() / (seen.len() as f64).sqrt();
    let rows = seen.iter().zip(before.iter().zip(&after));
    let mut scenario =
        Scenario { derivatives: scenario.derivatives.clone(), ..model.scenario(&values)? };
    if start_attitude {
        let rows = end.start.row_iter().map(|row| row.iter().copied().collect());
        scenario.scene.initial.attitude = Some(scenario::Attitude::Matrix(rows.collect()));
        scenario.check()?;
    }
    Ok(Fit {
        scenario,
        fitted,
        covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
        before_rad: mean(&begun),
        after_rad: mean(&end),
        residuals: rows.map(|(seen, (&before, &after))| [seen.time_s, before, after]).collect(),
        runs,
    })
}

/// Says of an error of derivatives that it is one of a fit.
fn as_asked(error: ScenarioError) -> ScenarioError {
    match error.pointer.strip_prefix("/derivatives/parameters/") {
        Some(_) => ScenarioError { pointer: "--fields".into(), ..error },
        None if error.pointer == "/derivatives" => {
            let message = format!("derivatives, which a fit needs, {}", error.message);
            ScenarioError { pointer: String::new(), message, ..error }
        }
        None => error,
    }
}

/// Refuses fields that change the attitudes alike.
fn undetermined(run: &Seen, names: &[String]) -> Result<(), FitError> {
    /// A field takes part in a combination with at least this share.
    const SHARE: f64 = 0.1;
    let mut scaled = run.jacobian.clone();
    for mut column in scaled.column_iter_mut() {
        let norm = column.norm();
        if norm > 0.0 {
            column /= norm;
        }
    }
    let singular = scaled.svd(false, true);
    let (values, Some(directions)) = (singular.singular_values, singular.v_t) else {
        return Ok(());
    };
    let (least, value) = values.argmin();
    if value > UNDETERMINED * values.max() {
        return Ok(());
    }
    let taking_part =
        names.iter().enumerate().filter(|(k, _)| directions[(least, *k)].abs() > SHARE);
    Err(FitError::Undetermined(taking_part.map(|(_, name)| name.clone()).collect()))
}

/// The scenario as a function of the unknowns: the fields, and the turn of the attitude at the start.
struct Model<'a> {
    document: &'a Value,
    fields: &'a [String],
    start_attitude: bool,
    seen: &'a [Attitude],
}

/// The residuals of a run, n^2 for each attitude, and their derivatives by the unknowns.
#[derive(Clone)]
struct Seen {
    residuals: DVector<f64>,
    jacobian: DMatrix<f64>,
    /// The attitude at the start.
    start: DMatrix<f64>,
}

impl Model<'_> {
    fn names(&self, d: usize) -> Vec<String> {
        let turned = if self.start_attitude { d } else { 0 };
        let turns = (1..=turned).map(|k| format!("start attitude {k}"));
        self.fields.iter().cloned().chain(turns).collect()
    }

    fn scenario(&self, values: &[f64]) -> Result<Scenario, ScenarioError> {
        let mut document = self.document.clone();
        for (pointer, value) in self.fields.iter().zip(values) {
            set(&mut document, pointer, json!(value))?;
        }
        let scenario: Scenario = from_tree(document)?;
        scenario.check()?;
        Ok(scenario)
    }

    fn run(&self, values: &[f64]) -> Result<Seen, FitError> {
        let plan = Plan::new(&self.scenario(values)?)?;
        assembled(&plan, Run { model: self, values, step_s: plan.step_s })
    }
}

/// Levenberg and Marquardt's view of it.
struct Search<'a> {
    model: Model<'a>,
    values: Vec<f64>,
    found: Seen,
    runs: u64,
}

impl LeastSquaresProblem<f64, dense::Dyn, dense::Dyn> for Search<'_> {
    type ResidualStorage = dense::VecStorage<f64, dense::Dyn, dense::U1>;
    type JacobianStorage = dense::VecStorage<f64, dense::Dyn, dense::Dyn>;
    type ParameterStorage = dense::VecStorage<f64, dense::Dyn, dense::U1>;

    fn set_params(&mut self, values: &dense::DVector<f64>) {
        if self.values == values.as_slice() {
            return;
        }
        self.values = values.as_slice().to_vec();
        self.runs += 1;
        let (rows, columns) = self.found.jacobian.shape();
        // No body, or no step: as far from all attitudes as it gets, so that the search comes back.
        self.found = self.model.run(&self.values).unwrap_or_else(|_| Seen {
            residuals: DVector::repeat(rows, 2.0),
            jacobian: DMatrix::zeros(rows, columns),
            start: DMatrix::zeros(0, 0),
        });
    }

    fn params(&self) -> dense::DVector<f64> {
        dense::DVector::from_column_slice(&self.values)
    }

    fn residuals(&self) -> Option<dense::DVector<f64>> {
        Some(dense::DVector::from_column_slice(self.found.residuals.as_slice()))
    }

    fn jacobian(&self) -> Option<dense::DMatrix<f64>> {
        let jacobian = &self.found.jacobian;
        let (rows, columns) = jacobian.shape();
        Some(dense::DMatrix::from_column_slice(rows, columns, jacobian.as_slice()))
    }
}

/// A run to each of the attitudes, in steps that end at their times.
struct Run<'a> {
    model: &'a Model<'a>,
    values: &'a [f64],
    step_s: f64,
}

impl Task for Run<'_> {
    type Output = Result<Seen, FitError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        let Self { model: Model { fields, seen, .. }, values, step_s } = self;
        let Assembly { body, mut stepper, mut initial, .. } = assembly;
        let d = so::dimension(N);
        let turn = &values[fields.len()..];
        if !turn.is_empty() {
            initial.attitude *= so::exp(&so::hat(turn));
        }
        let by_turn = by_turn::<N>(turn);
        let rows = N * N * seen.len();
        let mut residuals = DVector::zeros(rows);
        let mut jacobian = DMatrix::zeros(rows, values.len());
        stepper.start(&initial);
        let mut time_s = 0.0;
        for (k, Attitude { time_s: next_s, attitude }) in seen.iter().enumerate() {
            let span_s = next_s - time_s;
            // A rounding more than a whole number of steps is that number.
            let parts = (span_s / step_s - 1e-9).ceil().max(if span_s > 0.0 { 1.0 } else { 0.0 });
            for part in 0..parts as u64 {
                stepper.step(&body, span_s / parts).map_err(|failure| {
                    let time_s = time_s + span_s * (part as f64 / parts);
                    FitError::Step { time_s, failure }
                })?;
            }
            time_s = *next_s;
            let g = stepper.attitude().unwrap_or(initial.attitude);
            let error = Mat::<N>::from_fn(|i, j| g[(i, j)] - attitude[(i, j)]) * FRAC_1_SQRT_2;
            let at = N * N * k;
            residuals.rows_mut(at, N * N).copy_from_slice(error.as_slice());
            let Some(derivatives) = stepper.derivatives() else { continue };
            let mut put = |column: usize, turn: &[f64]| {
                let change = g * so::hat::<N>(turn) * FRAC_1_SQRT_2;
                jacobian.view_mut((at, column), (N * N, 1)).copy_from_slice(change.as_slice());
            };
            for (column, of) in derivatives.sensitivity.chunks_exact(2 * d).enumerate() {
                put(column, &of[..d]);
            }
            for (j, of_start) in by_turn.iter().enumerate() {
                let rows = derivatives.transition.chunks_exact(2 * d).take(d);
                let moved: Vec<f64> =
                    rows.map(|row| row.iter().zip(of_start).map(|(a, b)| a * b).sum()).collect();
                put(fields.len() + j, &moved);
            }
        }
        let start = DMatrix::from_fn(N, N, |i, j| initial.attitude[(i, j)]);
        Ok(Seen { residuals, jacobian, start })
    }
}

/// How `exp(hat(turn))` changes, in its own frame, with each number of the turn: `sum (-ad)^k / (k + 1)!` on the coordinates.
fn by_turn<const N: usize>(turn: &[f64]) -> Vec<Vec<f64>> {
    if turn.is_empty() {
        return Vec::new();
    }
    let x = so::hat::<N>(turn);
    let column = |j: usize| {
        let mut unit = vec![0.0; turn.len()];
        unit[j] = 1.0;
        let mut term = so::hat::<N>(&unit);
        let mut sum = term;
        for k in 1..40 {
            term = (term * x - x * term) / f64::from(k + 1);
            sum += term;
        }
        so::vee(&sum)
    };
    (0..turn.len()).map(column).collect()
}
