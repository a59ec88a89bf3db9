//! Work and precision, and the map of stability, of a user-defined system: steppers, one table.
//!
//! Gradients are not counted (their column is 0), and there is no search for an accuracy; both need
//! a scene, of which the plan knows the cost.
//!
//! Invariant: all figures but the times repeat to the bit.

use std::convert::Infallible;
use std::time::Instant;

use super::measure::{Begin, Measured, Point, Probe, run_of};
use super::reference::ReferenceError;
use super::stability::{Map, Mapper, Runs};
use super::table::{Row, Table};
use super::{Scales, StudyError, Watch};
use crate::solve::nonlinear::Rung;
use crate::solve::so;
use crate::solve::state::{Checkpoint, State};
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::system::System;
use crate::solve::trajectory::{self, Ending, Observables, Origin, Sample, Schedule, Sink};

/// A method that takes part.
pub struct Candidate<'a, const N: usize, Y: ?Sized> {
    /// Its name, for the table.
    pub name: &'a str,
    /// Its tableau, for the table.
    pub tableau: &'a str,
    /// Makes the stepper.
    pub stepper: &'a dyn Fn() -> Box<dyn Stepper<N, Y>>,
}

/// A system, its start, and the options of its study.
pub struct Question<'a, const N: usize, Y: ?Sized> {
    /// The system.
    pub system: &'a Y,
    /// The state at t = 0.
    pub initial: &'a State<N>,
    /// The end of all runs, in seconds.
    pub time_s: f64,
    /// Steps of the first run of each candidate, at least 1: it should turn by about a radian in one.
    pub first_steps: u64,
    /// Largest number of times that the step is halved.
    pub halvings: u32,
}

/// Results of the measurements.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnPrecision {
    /// The state at the end, to `error`.
    pub reference: Point,
    /// Distance of two solutions of the reference's family, or of its last and the nearest of the
    /// other: the larger.
    pub error: f64,
    /// One row per run: each candidate with its steps from the largest down.
    pub table: Table,
}

/// Errors of a reference above this mean nothing.
const USELESS: f64 = 1e-6;
/// Distance at which two solutions count as the same.
const AGREED: f64 = 1e-13;
/// Number of turns in which times are measured.
const REPEATS: u32 = 3;

/// Runs each candidate with a step that is halved, and measures errors against a reference: the first of `families`,
/// its step halved until two solutions agree, which the second must meet. Errors are of the attitude (for n = 3 the
/// spectral norm) plus of the body momentum in parts of its size at the end.
///
/// # Errors
/// If there is no reference to be trusted, or the study is cancelled.
pub fn precision<const N: usize, Y: System<N> + ?Sized>(
    question: Question<'_, N, Y>,
    families: [&Candidate<'_, N, Y>; 2],
    candidates: &[Candidate<'_, N, Y>],
    watch: &Watch,
) -> Result<OwnPrecision, StudyError> {
    let Question { time_s, halvings, .. } = question;
    let first_steps = question.first_steps.max(1);
    let no_step = || StudyError::from(ReferenceError::NoStep { time_s });
    let (reference, own) = solved(&question, families[0], None, watch)?.ok_or_else(no_step)?;
    let (_, other) =
        solved(&question, families[1], Some(&reference), watch)?.ok_or_else(no_step)?;
    let error = own.max(other);
    if !(error <= USELESS) {
        let allowed = USELESS;
        return Err(ReferenceError::Disagree { time_s, difference: error, allowed }.into());
    }
    let mut table = Table::default();
    for candidate in candidates {
        for halving in 0..=halvings {
            let Some(steps) = first_steps.checked_shl(halving) else { break };
            let run = run(&question, candidate, steps, REPEATS, watch)?;
            let row = run.row(candidate, time_s / steps as f64, &reference);
            let found = row.error;
            table.rows.push(row);
            if found.is_some_and(|found| found <= 3.0 * error.max(f64::EPSILON)) {
                break;
            }
        }
    }
    Ok(OwnPrecision { reference, error, table })
}

/// Finds where each candidate fails on the system, as [`stability`](super::stability::stability)
/// does it for scenes: a sweep of the step, and the border of what is usable. Steps are compared
/// with those of `exact`, best of order 16.
///
/// The body turns by as much as [`System::observed_velocity`] says, or by a radian in each of the question's first steps.
///
/// # Errors
/// If no step of `exact` keeps the energy, or the study is cancelled.
pub fn stability<const N: usize, Y: System<N> + ?Sized>(
    question: Question<'_, N, Y>,
    exact: &Candidate<'_, N, Y>,
    candidates: &[Candidate<'_, N, Y>],
    watch: &Watch,
) -> Result<Map, StudyError> {
    let scales = scales(&question, exact, watch)?;
    let mapper = Mapper { runs: OfSystem { question: &question, exact }, scales };
    let steps_s = mapper.sweep();
    watch.expect((candidates.len() * steps_s.len()) as u64);
    let along = |candidate| mapper.along(candidate, &steps_s, watch);
    let methods = candidates.iter().map(along).collect::<Result<Vec<_>, _>>()?;
    Ok(mapper.map(steps_s, methods))
}

/// Returns how fast a system moves, and a step in which `exact` keeps its energy.
fn scales<const N: usize, Y: System<N> + ?Sized>(
    question: &Question<'_, N, Y>,
    exact: &Candidate<'_, N, Y>,
    watch: &Watch,
) -> Result<Scales, StudyError> {
    /// Largest loss in an easy step, relative to the energy that moves.
    const KEPT: f64 = 1e-6;
    let Question { time_s, first_steps, halvings, .. } = *question;
    let first_steps = first_steps.max(1);
    // If the energy is all in one part, that part may be below zero.
    let State { attitude, momentum } = question.initial;
    let at_start = question.system.energy(attitude, momentum).kinetic.abs();
    for halving in 0..=halvings {
        let Some(steps) = first_steps.checked_shl(halving) else { break };
        let step_s = time_s / steps as f64;
        let probe = Probe { every: 1, ..Probe::of(exact, step_s, steps) };
        let run = OfSystem { question, exact }.run(probe, watch)?;
        watch.advance(0)?;
        let kinetic = run.energies.kinetic().max(at_start);
        let moved = run.energies.moved().max(kinetic);
        if run.completed() && run.energy_error() <= KEPT * moved {
            let named = (run.fastest_rad_s > 0.0).then_some(run.fastest_rad_s);
            return Ok(Scales {
                fastest_rad_s: named.unwrap_or(first_steps as f64 / time_s),
                kinetic,
                easy_step_s: step_s,
                adapts: false,
            });
        }
    }
    Err(ReferenceError::NoStep { time_s }.into())
}

/// A user-defined system, to be mapped.
struct OfSystem<'a, const N: usize, Y: ?Sized> {
    question: &'a Question<'a, N, Y>,
    exact: &'a Candidate<'a, N, Y>,
}

impl<'a, const N: usize, Y: System<N> + ?Sized> Runs for OfSystem<'a, N, Y> {
    type Method = Candidate<'a, N, Y>;

    fn run(&self, probe: Probe<'_, Self::Method>, watch: &Watch) -> Result<Measured, StudyError> {
        let mut stepper = (probe.method.stepper)();
        let elsewhere = match probe.begin {
            Begin::Scene => None,
            Begin::Near(point) => Some((point.state(), 0)),
            Begin::State { point, step } => Some((point.state(), step)),
        };
        let checkpoint =
            elsewhere.map(|(state, step)| Checkpoint { step, ..Checkpoint::at_start(&state) });
        let state = checkpoint.as_ref().map(Checkpoint::state);
        let initial = state.as_ref().unwrap_or(self.question.initial);
        let origin = Origin { initial, checkpoint: checkpoint.as_ref() };
        Ok(run_of(self.question.system, stepper.as_mut(), origin, probe, watch))
    }

    fn known_until_s(&self) -> Option<f64> {
        None
    }

    fn longest_step_s(&self) -> Option<f64> {
        None
    }

    fn exact(&self) -> &Self::Method {
        self.exact
    }

    fn label(&self, candidate: &Self::Method) -> String {
        format!("{} {}", candidate.name, candidate.tableau)
    }

    fn row(&self, candidate: &Self::Method, step_s: f64, run: &Measured) -> Row {
        let order = (candidate.stepper)().order();
        Row::named((candidate.name, candidate.tableau, order), "", step_s, run, None)
    }
}

/// Returns the best solution of a family, with its distance to the one before or, if given, to
/// `other`. `None` if no two runs succeed.
fn solved<const N: usize, Y: System<N> + ?Sized>(
    question: &Question<'_, N, Y>,
    family: &Candidate<'_, N, Y>,
    other: Option<&Point>,
    watch: &Watch,
) -> Result<Option<(Point, f64)>, StudyError> {
    let (mut before, mut best): (Option<Point>, Option<(Point, f64)>) = (None, None);
    for halving in 0..=question.halvings {
        let Some(steps) = question.first_steps.max(1).checked_shl(halving) else { break };
        let run = run(question, family, steps, 0, watch)?;
        let end = (run.outcome == "succeeded").then_some(run.end);
        if let (Some(end), Some(near)) = (&end, other.or(before.as_ref())) {
            let apart = distance(near, end);
            if best.as_ref().is_none_or(|(_, least)| apart < *least) {
                best = Some((end.clone(), apart));
            }
            if apart <= AGREED {
                break;
            }
        }
        before = end;
    }
    Ok(best)
}

fn distance(of: &Point, point: &Point) -> f64 {
    let size = (0.5 * of.momentum.norm_squared()).sqrt();
    let scale = if size > 0.0 { size } else { 1.0 };
    of.attitude_distance(point) + of.momentum_distance(point) / scale
}

/// A run that was made.
struct Run {
    end: Point,
    steps: u64,
    energy_error: f64,
    orthogonality_error: f64,
    iterations: u64,
    rung: Option<Rung>,
    order: u32,
    ns_per_step: f64,
    outcome: &'static str,
}

impl Run {
    fn row<const N: usize, Y: ?Sized>(
        &self,
        candidate: &Candidate<'_, N, Y>,
        step_s: f64,
        reference: &Point,
    ) -> Row {
        let succeeded = self.outcome == "succeeded";
        let any = self.steps > 0;
        Row {
            method: candidate.name.to_owned(),
            tableau: candidate.tableau.to_owned(),
            order: self.order,
            solver: self.rung.map_or("", Rung::as_str).to_owned(),
            step_s,
            steps: self.steps,
            error: succeeded.then(|| distance(reference, &self.end)),
            energy_error: any.then_some(self.energy_error),
            orthogonality_error: any.then_some(self.orthogonality_error),
            iterations_per_step: any.then(|| self.iterations as f64 / self.steps as f64),
            force_evaluations: 0,
            ns_per_step: Some(self.ns_per_step).filter(|ns| ns.is_finite()),
            outcome: self.outcome.to_owned(),
            failed_step: (!succeeded).then_some(self.steps + 1),
        }
    }
}

/// Keeps the largest errors.
#[derive(Default)]
struct Largest {
    energy: f64,
    orthogonality: f64,
}

impl<const N: usize> Sink<N> for Largest {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Infallible> {
        self.energy = self.energy.max(sample.energy_error.unwrap_or_default().abs());
        let off = sample.attitude.map_or(0.0, |g| so::orthogonality_error(&g));
        self.orthogonality = self.orthogonality.max(off);
        Ok(())
    }
}

fn run<const N: usize, Y: System<N> + ?Sized>(
    question: &Question<'_, N, Y>,
    candidate: &Candidate<'_, N, Y>,
    steps: u64,
    repeats: u32,
    watch: &Watch,
) -> Result<Run, StudyError> {
    watch.expect(1);
    let Question { system, initial, time_s, .. } = *question;
    let step_s = time_s / steps as f64;
    let mut stepper = (candidate.stepper)();
    let schedule = Schedule { step_s, steps, every: steps.div_ceil(1000) };
    let observables = Observables {
        energy: true,
        orthogonality: false,
        momentum: false,
        sigma_min: false,
        pace: false,
        control: false,
        pointing: false,
        derivatives: false,
    };
    let mut largest = Largest::default();
    let Ok(end) = trajectory::integrate(
        system,
        stepper.as_mut(),
        initial,
        schedule,
        observables,
        &mut largest,
        |_| !watch.is_cancelled(),
    );
    watch.advance(1)?;
    let outcome = match &end.ending {
        Ending::Completed | Ending::Stopped(_) => "succeeded",
        Ending::Cancelled => "cancelled",
        Ending::Failed(failure) => failure.code.as_str(),
    };
    let mut ns_per_step = f64::INFINITY;
    for _ in 0..if outcome == "succeeded" { repeats } else { 0 } {
        stepper.start(initial);
        let (begun, mut knots) = (Instant::now(), Knots::default());
        let made = (0..steps).take_while(|&step| {
            let begun_s = step as f64 * step_s;
            !watch.is_cancelled() && knots.step(system, stepper.as_mut(), begun_s, step_s).is_ok()
        });
        if made.count() as u64 == steps {
            ns_per_step = ns_per_step.min(begun.elapsed().as_nanos() as f64 / steps as f64);
        }
    }
    let State { attitude, momentum } = end.reached.state();
    Ok(Run {
        end: Point::of(&attitude, &momentum),
        steps: end.reached.step,
        energy_error: largest.energy,
        orthogonality_error: largest.orthogonality,
        iterations: end.reached.iterations,
        rung: end.reached.convergence.map(|solved| solved.rung),
        order: stepper.order(),
        ns_per_step,
        outcome,
    })
}
