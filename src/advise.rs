//! 3 · An accuracy → a method and a step: pilot runs on the scene itself choose.
//!
//! Each method is tried over the time of the run, or as much of it as is soon done, against a reference;
//! its step is moved until the error is just below the one asked for. The cheapest that gets there is
//! taken. Cost is counted in sweeps, never timed.
//!
//! Where the run is longer than the pilots their errors are carried on, as the power of time by which they grew.
//!
//! Invariant: the choice is a function of the scenario alone: the same scenario, the same bytes.

use thiserror::Error;

use crate::plan::{Advice, Candidate, Plan};
use crate::scenario::{Accuracy, MethodName, Scenario, ScenarioError, TableauName};
use crate::solve::nonlinear::Rung;
use crate::study::measure::{End, Measured, Probe, measure, variant};
use crate::study::reference::{EIGHTHS, Reference, ReferenceError};
use crate::study::{Entry, Scales, StudyError, Watch, entries, with_order, with_tableau};

/// Work that the choice of a method may cost, in nanoseconds by the plan's figures: counted, so that it ends at the same
/// place on every machine.
const SETTLING_NS: u64 = 15_000_000_000;
/// The first steps of a run that are made to see what a step costs, and the work that they may be, in nanoseconds and at
/// least in sweeps.
const FIRST_STEPS: u64 = 64;
const FIRST_NS: f64 = 3e5;
const FIRST_SWEEPS: f64 = 24.0;
/// Easy steps of the scene that pilots are worth.
const PILOT_STEPS: f64 = 600.0;
/// The error asked for is aimed at with this margin where pilots saw the whole run.
const MARGIN: f64 = 2.0;
/// And with this one where their errors were carried on.
const CARRIED_MARGIN: f64 = 10.0;
/// Errors that grow faster than this power of time are not carried on.
const FASTEST_GROWTH: f64 = 3.0;
/// Errors are carried on by this much of a power of time faster than they were seen to grow.
const DOUBT: f64 = 0.5;
/// A smaller error than this is luck.
const ROUND_OFF: f64 = 1e-16;
/// Steps that are tried for a method.
const TRIES: u32 = 7;

/// Why an accuracy was not turned into a method and a step.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum Unsettled {
    /// Somebody stopped it.
    #[error("the choice of a method was cancelled")]
    Cancelled,
    /// A field is wrong.
    #[error(transparent)]
    Refused(ScenarioError),
    /// No method is known to reach the accuracy.
    #[error("{asked:e} asked for, but {why}")]
    OutOfReach {
        /// The error asked for.
        asked: f64,
        /// What stands in the way.
        why: Obstacle,
    },
}

/// What keeps a scene from an accuracy.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum Obstacle {
    /// There is nothing to hold a run against.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
    /// The reference itself is not known so well.
    #[error(
        "errors grow on this scene so that only {least:.1e} can be told at t = {time_s:.3e} s; ask for that, or for a shorter time"
    )]
    Untold {
        /// The least error that can be told.
        least: f64,
        /// The time of the reference.
        time_s: f64,
    },
    /// The search has cost all that it may.
    #[error(
        "the search for a method was given up as too expensive, after {allowed_s:.1} s of computing as counted; give `method` and `step_s`"
    )]
    TooExpensive {
        /// The computing that it may cost, by the plan's figures.
        allowed_s: f64,
    },
    /// The run that was chosen is longer than any may be.
    #[error("the run that reaches it cannot be made: {0}")]
    TooLong(ScenarioError),
    /// All methods were tried.
    #[error("no method was found to reach it{}", least.map_or_else(String::new, |least| format!("; the least error expected is {least:.1e}")))]
    NoMethod {
        /// The least error that was expected of any.
        least: Option<f64>,
    },
}

impl Unsettled {
    fn of(error: StudyError, asked: Accuracy, allowed_ns: u64) -> Self {
        let out_of_reach = |why| Self::OutOfReach { asked: asked.error, why };
        match error {
            StudyError::Scenario(error) => Self::Refused(error),
            StudyError::Reference(error) => out_of_reach(error.into()),
            StudyError::Failed => out_of_reach(Obstacle::NoMethod { least: None }),
            StudyError::Cancelled => Self::Cancelled,
            StudyError::TooExpensive => {
                out_of_reach(Obstacle::TooExpensive { allowed_s: allowed_ns as f64 * 1e-9 })
            }
        }
    }
}

/// What is told of a scenario that came without a method and keeps none: the accuracy is the field at fault.
impl From<Unsettled> for ScenarioError {
    fn from(unsettled: Unsettled) -> Self {
        match unsettled {
            Unsettled::Refused(error) => error,
            other => Self::invalid("/accuracy/error", other.to_string()),
        }
    }
}

/// The plan of any scenario: an accuracy is turned into a method and a step first. Takes as long as that takes; who
/// must be able to stop it calls [`settled`] and [`plan_of`].
///
/// # Errors
/// Those of [`Plan::new`], and at `/accuracy/error` where no method is known to reach it.
pub fn plan(scenario: &Scenario) -> Result<Plan, ScenarioError> {
    let (settled, advice) = settled(scenario, &Watch::default())?;
    plan_of(&settled, advice)
}

/// The plan of a scenario with a method and a step, and with it how they were chosen. Its first steps are made, a few
/// milliseconds of them at most as counted, for what they tell of the cost of the others.
///
/// # Errors
/// Those of [`Plan::new`].
pub fn plan_of(settled: &Scenario, advice: Option<Advice>) -> Result<Plan, ScenarioError> {
    let mut plan = Plan::new(settled)?;
    plan.estimate(settled.log.compression, sweeps_per_step(settled, &plan)?);
    if advice.is_some() {
        plan.formulation.why = "the cheapest that reached the accuracy in pilot runs";
    }
    plan.advice = advice;
    Ok(plan)
}

/// The sweeps of a step at the start of the run; `None` if the first fails, for then there are no others.
fn sweeps_per_step(settled: &Scenario, plan: &Plan) -> Result<Option<f64>, ScenarioError> {
    let most_ns = FIRST_NS.max(FIRST_SWEEPS * plan.sweep_cost_ns());
    let watch = Watch { allowance_ns: Some((most_ns as u64).into()), ..Watch::default() };
    let probe = Probe::of(&settled.method, plan.step_s, plan.steps.min(FIRST_STEPS));
    let run = measure(settled, probe, &watch)?;
    let failed = matches!(run.end, End::Failed(_)) && run.steps == 0;
    Ok((!failed).then(|| run.sweeps as f64 / run.steps.max(1) as f64))
}

/// The scenario with a method and a step, and how they were chosen if it came with an accuracy. Another thread may stop
/// it by `watch`, which may also allow it less work than it takes by itself.
///
/// # Errors
/// If it was stopped, or no method is known to reach the accuracy.
pub fn settled(
    scenario: &Scenario,
    watch: &Watch,
) -> Result<(Scenario, Option<Advice>), Unsettled> {
    match scenario.accuracy {
        None => Ok((scenario.clone(), None)),
        Some(asked) => {
            let (settled, advice) = settle(scenario, asked, watch)?;
            Ok((settled, Some(advice)))
        }
    }
}

/// The error at the end of the scenario's run against a reference at that time. The run is made once more, in
/// memory.
///
/// # Errors
/// If there is no such reference, or the run fails.
pub fn error_at_end(scenario: &Scenario) -> Result<f64, StudyError> {
    let watch = Watch::default();
    let (scenario, _) = settled(scenario, &watch).map_err(ScenarioError::from)?;
    let Plan { step_s, steps, .. } = Plan::new(&scenario)?;
    let time_s = step_s * steps as f64;
    let scales = Scales::of(&scenario, time_s, &watch)?;
    let reference = Reference::at(&scenario, time_s, &scales, &watch)?;
    let run = measure(&scenario, Probe::of(&scenario.method, step_s, steps), &watch)?;
    if run.completed() { Ok(reference.distance(&run.last)) } else { Err(StudyError::Failed) }
}

/// The methods that are tried.
fn methods(scene: &Scenario) -> Vec<Entry> {
    use MethodName as M;
    use TableauName as T;
    let mut methods = vec![with_order(M::Splitting, 4), with_order(M::Splitting, 8)];
    let gauss = [T::Gauss2, T::Gauss3, T::Gauss4, T::Gauss6, T::Gauss8];
    methods.extend(gauss.map(|tableau| with_tableau(M::QuaternionGauss, tableau)));
    methods.push(with_order(M::Lgvi, 4));
    methods.extend(gauss.map(|tableau| with_tableau(M::VpdReduced, tableau)));
    methods.extend(gauss.map(|tableau| with_tableau(M::Vpd, tableau)));
    methods.extend([T::Gauss2, T::Gauss4].map(|tableau| with_tableau(M::Vrkmk, tableau)));
    entries(scene, methods)
}

/// A pilot that reached the accuracy, or the best that did not.
#[derive(Clone, Copy, Debug)]
struct Pilot {
    steps: u64,
    /// The error expected at the end of the run.
    expected: f64,
    cost_ns: f64,
}

fn settle(
    scenario: &Scenario,
    asked: Accuracy,
    watch: &Watch,
) -> Result<(Scenario, Advice), Unsettled> {
    let out_of_reach = |why| Err(Unsettled::OutOfReach { asked: asked.error, why });
    let allowed_ns = watch.left_ns().min(SETTLING_NS);
    let told = |error| Unsettled::of(error, asked, allowed_ns);
    let allowance_ns = Some(allowed_ns.into());
    let watch = &Watch { cancelled: watch.cancelled.clone(), allowance_ns, ..Watch::default() };
    let duration_s = scenario.duration_s.unwrap_or_default();
    let scales = Scales::of(scenario, duration_s, watch).map_err(told)?;
    let pilot_s = duration_s.min(PILOT_STEPS * scales.easy_step_s);
    let reference = Reference::at(scenario, pilot_s, &scales, watch).map_err(told)?;
    if reference.error > asked.error / (2.0 * MARGIN) {
        let least = 2.0 * MARGIN * reference.error;
        return out_of_reach(Obstacle::Untold { least, time_s: pilot_s });
    }
    let trial = Trial { scenario, asked, duration_s, scales, reference };
    let mut found: Vec<(Entry, Option<Pilot>, Option<f64>)> = Vec::new();
    let mut cheapest = f64::INFINITY;
    for entry in methods(scenario) {
        let (reached, least) = trial.search(&entry, cheapest, watch).map_err(told)?;
        cheapest = cheapest.min(reached.map_or(f64::INFINITY, |pilot| pilot.cost_ns));
        found.push((entry, reached, least));
    }
    // The sort is stable: of equals the first in the list.
    let cost = |pilot: &Option<Pilot>| pilot.map_or(f64::INFINITY, |pilot| pilot.cost_ns);
    found.sort_by(|a, b| cost(&a.1).total_cmp(&cost(&b.1)));
    let Some((entry, Some(pilot), _)) = found.first().cloned() else {
        let least = found.iter().filter_map(|(_, _, least)| *least).min_by(f64::total_cmp);
        return out_of_reach(Obstacle::NoMethod { least });
    };
    let steps = trial.whole_steps(pilot.steps);
    let settled = Scenario {
        method: entry.method.clone(),
        step_s: Some(duration_s / steps as f64),
        steps: Some(steps),
        duration_s: None,
        accuracy: None,
        ..scenario.clone()
    };
    settled.check().map_err(|error| match error.pointer.as_str() {
        "/steps" | "/step_s" => {
            Unsettled::OutOfReach { asked: asked.error, why: Obstacle::TooLong(error) }
        }
        _ => Unsettled::Refused(error),
    })?;
    let candidates = found.iter().map(|(entry, reached, least)| Candidate {
        method: entry.method.name,
        tableau: entry.tableau.clone(),
        step_s: reached.map(|pilot| pilot_s / pilot.steps as f64),
        expected_error: reached.map_or(*least, |pilot| Some(pilot.expected)),
        cost_us: reached.map(|pilot| 1e-3 * pilot.cost_ns / pilot_s),
    });
    let advice = Advice {
        error: asked.error,
        expected_error: pilot.expected,
        margin: asked.error / pilot.expected.max(ROUND_OFF),
        pilot_time_s: pilot_s,
        reference_error: trial.reference.error,
        candidates: candidates.collect(),
    };
    Ok((settled, advice))
}

/// What the search for a step needs to know.
struct Trial<'a> {
    scenario: &'a Scenario,
    asked: Accuracy,
    duration_s: f64,
    scales: Scales,
    reference: Reference,
}

impl Trial<'_> {
    fn is_whole(&self) -> bool {
        self.duration_s <= self.reference.time_s
    }

    /// The steps of the whole run, for so many of a pilot.
    fn whole_steps(&self, steps: u64) -> u64 {
        (steps as f64 * self.duration_s / self.reference.time_s).ceil() as u64
    }

    /// The cheapest step of a method that is expected to reach the accuracy, and the least error met. Given
    /// up where it costs more than `cheapest`.
    fn search(
        &self,
        entry: &Entry,
        cheapest: f64,
        watch: &Watch,
    ) -> Result<(Option<Pilot>, Option<f64>), StudyError> {
        let time_s = self.reference.time_s;
        let margin = if self.is_whole() { MARGIN } else { CARRIED_MARGIN };
        let goal = self.asked.error / margin;
        let multiple = |steps: f64| EIGHTHS * (steps / EIGHTHS as f64).ceil().max(1.0) as u64;
        // A radian a step, and then by the order of the method; never back to where a step failed.
        let mut steps = multiple(time_s * self.scales.fastest_rad_s);
        let (mut reached, mut least) = (None::<Pilot>, None::<f64>);
        let mut too_few = 0;
        for _ in 0..TRIES {
            let every = steps / EIGHTHS;
            let whole = Probe::of(&entry.method, time_s / steps as f64, steps);
            let probe = Probe { every, keep: true, ..whole };
            let run = measure(self.scenario, probe, watch)?;
            watch.advance(0)?;
            let cost_ns = self.cost_ns(entry, &run)?;
            let expected = run.completed().then(|| self.expected(&run)).flatten();
            let ratio = match expected {
                Some(expected) => {
                    least = Some(least.map_or(expected, |least| least.min(expected)));
                    if expected <= goal && reached.is_none_or(|reached| steps < reached.steps) {
                        reached = Some(Pilot { steps, expected, cost_ns });
                    }
                    libm::pow(expected.max(ROUND_OFF) / goal, 1.0 / f64::from(entry.order))
                }
                None => 2.0,
            };
            if expected.is_none_or(|expected| expected > goal) {
                too_few = too_few.max(steps);
            }
            if reached.is_none() && cost_ns > 2.0 * cheapest {
                break;
            }
            // A little more than the order asks for, in bounds.
            let next = multiple(steps as f64 * (1.03 * ratio).clamp(0.4, 4.0));
            let next = match reached {
                Some(reached) if next >= reached.steps => break,
                Some(_) if next <= too_few => break,
                _ => next.max(too_few + EIGHTHS),
            };
            steps = next;
        }
        Ok((reached, least))
    }

    /// The error expected at the end of the run; `None` where errors grow too fast to be carried on.
    fn expected(&self, run: &Measured) -> Option<f64> {
        let errors: Vec<f64> = run
            .points
            .iter()
            .enumerate()
            .map(|(eighth, point)| self.reference.distance_at(eighth, point))
            .collect();
        let largest = |errors: &[f64]| errors.iter().copied().fold(0.0, f64::max);
        // Not the last alone: an error that swings may pass through zero there.
        let late = largest(&errors[errors.len() / 2..]);
        if self.is_whole() {
            return Some(late);
        }
        let early = largest(&errors[..errors.len() / 2 + 1]).max(self.reference.error);
        let growth = libm::log2(late / early).max(1.0);
        let ratio = self.duration_s / self.reference.time_s;
        (growth <= FASTEST_GROWTH).then(|| late * libm::pow(ratio, growth + DOUBT))
    }

    /// What a run costs on a common machine, by the plan's figures for a sweep.
    fn cost_ns(&self, entry: &Entry, run: &Measured) -> Result<f64, ScenarioError> {
        let plan = variant(self.scenario, &entry.method, 1.0, 1)?;
        let whole = run.rung == Some(Rung::Explicit) || entry.method.name == MethodName::Lgvi;
        // A correction of Newton's method is several sweeps; each sweep takes a gradient at every stage.
        let sweeps =
            run.iterations.max(run.force_evaluations / plan.formulation.stages.max(1) as u64);
        let count = if whole { run.steps } else { sweeps };
        Ok(count as f64 * plan.sweep_cost_ns())
    }
}
