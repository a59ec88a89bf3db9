//! 3 · An accuracy → a method and a step: pilot runs on the scene itself choose.
//!
//! 1. Each method is tried over the first part of the run, against a reference; its step is moved until the error that
//!    it will have at the end is expected just below the one asked for.
//! 2. The cheapest is run over the whole time, against a reference of the whole time, and its
//!    step corrected, until the cheapest is one that was seen to reach the accuracy. For an
//!    ensemble, every member is then checked.
//! 3. A run longer than any reference is compared with itself with halved steps, as far as the
//!    work allowed goes; from there its errors are extrapolated by the power of time by which they
//!    grew. Where they grow exponentially, or round-off alone grows past the requested error, it is
//!    refused with the time until which that can be reached.
//!
//! Cost is counted in steps, sweeps and gradients; only the estimate of a run's time is timed, on its first steps.
//!
//! Invariant: the choice is a function of the scenario alone: the same scenario, the same bytes.

use std::time::Instant;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::plan::{Advice, Counts, Fails, FirstSteps, Plan};
use crate::scenario::{Accuracy, Scenario, ScenarioError};
use crate::study::measure::{
    End, Measured, Probe, first_steps_of_bodies, measure, time_of_step, variant,
};
use crate::study::reference::{Growth, MOST_STEPS, Reference, ReferenceError};
use crate::study::{Scales, StudyError, Watch, nearest_sigma};

mod search;

use search::{Contender, MARGIN, ROUND_OFF, TO_BE_SEEN, Trial, Unmet, needed};

/// Work that the choice of a method may cost, in nanoseconds by the plan's figures: counted, so that it ends at the same
/// place on every machine.
const SETTLING_NS: u64 = 15_000_000_000;
/// The first steps of a run that are made to see what a step costs, and the work that they may be, in nanoseconds and at
/// least in sweeps.
const FIRST_STEPS: u64 = 64;
const FIRST_NS: f64 = 3e5;
const FIRST_SWEEPS: f64 = 24.0;
/// Harder steps: only `FEW_STEPS` are made, within `HARD_NS` of work; one unfinished by then counts
/// as `UNENDED` times as hard.
const FEW_STEPS: u64 = 4;
const HARD_NS: f64 = 3e8;
const UNENDED: f64 = 4.0;
/// Steps that took this long, in nanoseconds, are not timed again: other load on the machine matters little then.
const LONG_NS: f64 = 2e7;
/// Factor on the allowed work of adaptive first steps, which are not all alike.
const OWN_STEPS_MORE: f64 = 30.0;
/// Length of the pilot runs, in easy steps of the scene.
const PILOT_STEPS: f64 = 600.0;
/// Share of the allowed work that the reference of the whole run may take.
const REFERENCE_PART: f64 = 0.4;
/// Reason why an accuracy was not turned into a method and a step.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum Unsettled {
    /// It was cancelled.
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
        /// The obstacle.
        why: Obstacle,
    },
}

/// Obstacle that keeps a scene from reaching an accuracy.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum Obstacle {
    /// There is nothing to compare a run with.
    #[error(transparent)]
    Reference(ReferenceError),
    /// The reference itself is not known to that accuracy.
    #[error(
        "{growth}; double precision reaches it until t = {until_s:.3} s, and only {least:.1e} at t = {time_s:.3e} s; ask for a shorter run or a larger error"
    )]
    Untold {
        /// The least error that can be measured.
        least: f64,
        /// The time of the reference.
        time_s: f64,
        /// Time until which the requested error can be measured.
        until_s: f64,
        /// Growth of the errors.
        growth: Growth,
    },
    /// An obstacle at one member of the ensemble.
    #[error("member {member}: {why}")]
    Member {
        /// Number of the member.
        member: u64,
        /// The obstacle.
        why: Box<Obstacle>,
    },
    /// There are more members than can be checked.
    #[error(
        "{members} members are too many to check each of them: at most about {most} can be checked on this scene; give `method` and `step_s`, or ask for fewer members"
    )]
    TooManyMembers {
        /// The members asked for.
        members: u64,
        /// Members for which the allowed work is enough.
        most: u64,
    },
    /// The search used up the allowed work.
    #[error(
        "the search for a method was abandoned as too expensive, after an estimated {allowed_s:.1} s of computing; give `method` and `step_s`"
    )]
    TooExpensive {
        /// Allowed computing time, by the plan's figures.
        allowed_s: f64,
    },
    /// The run that was chosen is longer than any may be.
    #[error("the run that reaches it cannot be made: {0}")]
    TooLong(ScenarioError),
    /// All methods were tried.
    #[error("no method was found to reach it{}", least.map_or_else(String::new, |least| format!("; the least error expected is {least:.1e}")))]
    NoMethod {
        /// Least error expected of any method.
        least: Option<f64>,
    },
}

impl From<ReferenceError> for Obstacle {
    fn from(error: ReferenceError) -> Self {
        match error {
            ReferenceError::Chaotic { time_s, difference, until_s, growth, .. } => {
                Self::Untold { least: 2.0 * MARGIN * difference, time_s, until_s, growth }
            }
            error => Self::Reference(error),
        }
    }
}

impl Unsettled {
    fn of(error: StudyError, asked: Accuracy, allowed_ns: u64) -> Self {
        let out_of_reach = |why| Self::OutOfReach { asked: asked.error, why };
        match error {
            // Nobody gave the step.
            StudyError::Scenario(error) if is_of_steps(&error) => {
                out_of_reach(Obstacle::TooLong(error))
            }
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

/// Is it the length of a step, or the number of steps, that is refused?
fn is_of_steps(error: &ScenarioError) -> bool {
    matches!(error.pointer.as_str(), "/steps" | "/step_s")
}

/// Error for a scenario that came without a method and gets none: the accuracy is the field at
/// fault.
impl From<Unsettled> for ScenarioError {
    fn from(unsettled: Unsettled) -> Self {
        match unsettled {
            Unsettled::Refused(error) => error,
            other => Self::invalid("/accuracy/error", other.to_string()),
        }
    }
}

/// Plans any scenario: an accuracy is first turned into a method and a step. Blocks until that is
/// done; to be able to stop it, use [`Settled::new`].
///
/// # Errors
/// The errors of [`Plan::new`], and at `/accuracy/error` where no method is known to reach it.
pub fn plan(scenario: &Scenario) -> Result<Plan, ScenarioError> {
    Settled::new(scenario, &Watch::default())?.plan()
}

/// Scenario with everything that only runs can show: a method and a step for its accuracy, and the
/// work of its first steps. A stored copy is enough to plan it again without any run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settled {
    /// The scenario as requested.
    asked: Scenario,
    /// The scenario with the method and step chosen for its accuracy, and how they were chosen.
    choice: Option<(Scenario, Advice)>,
    /// Measurements of the first steps.
    #[serde(flatten)]
    first: FirstSteps,
    /// Least sigma that adaptive steps would meet, where the potential has point sources.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    nearest_sigma: Option<f64>,
}

impl Settled {
    /// Makes the runs. Another thread may stop them by `watch`, which may also allow them less work
    /// than they take by default.
    ///
    /// # Errors
    /// If they were stopped, or no method is known to reach the accuracy.
    pub fn new(scenario: &Scenario, watch: &Watch) -> Result<Self, Unsettled> {
        // A scenario built in Rust was not checked yet.
        scenario.check().map_err(Unsettled::Refused)?;
        let asked = scenario.clone();
        let choice = scenario.accuracy.map(|asked| settle(scenario, asked, watch)).transpose()?;
        let mut settled = Self { asked, choice, first: FirstSteps::default(), nearest_sigma: None };
        let plan = settled.plan().map_err(Unsettled::Refused)?;
        if !plan.bodies.is_empty() {
            if let Some((sweeps, ns)) = first_steps_of_bodies(&plan) {
                let step = Some(Counts { steps: 1.0, sweeps, ..Counts::default() });
                settled.first = FirstSteps { step, step_ns: Some(ns), fails: None };
            }
            return Ok(settled);
        }
        plan.exact_motion().map_err(Unsettled::Refused)?;
        settled.first = first_of_each(&plan).map_err(Unsettled::Refused)?;
        let plan = settled.plan().map_err(Unsettled::Refused)?;
        settled.nearest_sigma = nearest_sigma(&plan.settled, plan.steps as f64 * plan.step_s)
            .map_err(Unsettled::Refused)?;
        Ok(settled)
    }

    /// Restores the choice for an accuracy that a record of an older build holds.
    #[cfg(feature = "serve")]
    pub(crate) fn chosen(asked: Scenario, settled: Scenario, advice: Advice) -> Self {
        let choice = Some((settled, advice));
        Self { asked, choice, first: FirstSteps::default(), nearest_sigma: None }
    }

    /// Returns the plan. No run is made.
    ///
    /// # Errors
    /// The errors of [`Plan::new`].
    pub fn plan(&self) -> Result<Plan, ScenarioError> {
        let Some((settled, advice)) = &self.choice else {
            let mut plan = Plan::new(&self.asked)?;
            plan.estimate(self.first);
            plan.offer_own_steps(self.nearest_sigma);
            plan.warn_of_fast_changes();
            return Ok(plan);
        };
        let mut plan = Plan::new(settled)?;
        plan.estimate(self.first);
        plan.offer_own_steps(self.nearest_sigma);
        plan.formulation.why = "the cheapest that reached the accuracy in trial runs";
        plan.advice = Some(advice.clone());
        plan.asked = self.asked.clone();
        Ok(plan)
    }
}

/// Returns the work of a step and the nanoseconds that it takes here, by the first steps of the
/// run; for an ensemble, by those of a few members, because they begin elsewhere.
fn first_of_each(plan: &Plan) -> Result<FirstSteps, ScenarioError> {
    let mut members = vec![0];
    if let Some(ensemble) = &plan.ensemble {
        members.extend([1, ensemble.members / 2, ensemble.members - 1]);
        members.dedup();
    }
    let (mut works, mut times_ns) = (Vec::new(), Vec::new());
    let mut failing_ns = Vec::new();
    let mut looked_at = 0.0;
    for &member in &members {
        let First { steps, work, fails, hard_ns, ns } = work_of_steps(plan, member)?;
        looked_at += 1.0;
        if fails {
            failing_ns.push(ns);
        } else {
            let timed_ns = hard_ns.or_else(|| time_of_step(plan, steps, member));
            times_ns.push(timed_ns.unwrap_or_else(|| plan.work_ns(work)));
            works.push(work);
        }
        // A hard member takes all the work that is allowed.
        if hard_ns.is_some() {
            break;
        }
    }
    let part = failing_ns.len() as f64 / looked_at;
    let fails = mean(&failing_ns).map(|ns| Fails { part, ns });
    Ok(FirstSteps { step: Counts::mean(&works), step_ns: mean(&times_ns), fails })
}

fn mean(of: &[f64]) -> Option<f64> {
    (!of.is_empty()).then(|| of.iter().sum::<f64>() / of.len() as f64)
}

/// The first steps of a member.
struct First {
    /// Number of steps made.
    steps: u64,
    /// Work of one step.
    work: Counts,
    /// Whether the very first step failed.
    fails: bool,
    /// Nanoseconds that one step took here, where they are hard.
    hard_ns: Option<f64>,
    /// Nanoseconds that all steps took here.
    ns: f64,
}

/// Makes the first steps: a few milliseconds as counted, and 0.3 s where they are hard.
fn work_of_steps(plan: &Plan, member: u64) -> Result<First, ScenarioError> {
    let mut most_ns = FIRST_NS.max(FIRST_SWEEPS * plan.sweep_cost_ns());
    if plan.own_steps.is_some() {
        most_ns *= OWN_STEPS_MORE;
    }
    let mut begun = Instant::now();
    let mut run = first_steps(plan, member, FIRST_STEPS, most_ns)?;
    let hard = run.end == End::Cancelled && run.steps < FEW_STEPS;
    if hard {
        begun = Instant::now();
        run = first_steps(plan, member, FEW_STEPS, HARD_NS.max(most_ns))?;
    }
    let ns = begun.elapsed().as_nanos() as f64;
    let first_failed = matches!(run.end, End::Failed(_)) && run.steps == 0;
    let unended = run.steps == 0 && !first_failed;
    let part = if unended { UNENDED } else { 1.0 / run.steps.max(1) as f64 };
    let Counts { sweeps, passes, gradients, pieces, .. } = run.counts();
    let work = Counts {
        steps: 1.0,
        sweeps: part * sweeps,
        passes: part * passes,
        gradients: part * gradients,
        pieces: part * pieces,
    };
    let hard_ns = (hard && (ns > LONG_NS || run.steps == 0)).then_some(part * ns);
    Ok(First { steps: run.steps, work, fails: first_failed, hard_ns, ns })
}

/// Makes the first `steps` steps of a member's run, or those that fit into `most_ns` of work.
fn first_steps(
    plan: &Plan,
    member: u64,
    steps: u64,
    most_ns: f64,
) -> Result<Measured, ScenarioError> {
    let settled = &plan.settled;
    let steps = plan.steps.min(steps);
    // A body that rests or stays in a plane has members that do not.
    let by_itself = variant(settled, &settled.method, plan.step_s, steps)?.sweep_cost_ns();
    let most_ns = most_ns * by_itself / plan.sweep_cost_ns();
    let watch = Watch { allowance_ns: Some((most_ns.ceil() as u64).into()), ..Watch::default() };
    let probe = Probe::of(&settled.method, plan.step_s, steps);
    let mut probe = Probe { member, ..probe };
    // With adaptive steps, samples are steps, too.
    if plan.own_steps.is_some() {
        probe.every = plan.every.min(probe.steps);
    }
    measure(settled, probe, &watch)
}

/// The error at the end of a run, as well as a reference shows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ErrorAtEnd {
    /// Known to a third of itself.
    About(f64),
    /// No larger than this: the reference is known no better.
    Below(f64),
}

/// Returns the error at the end of a planned run, against a reference at that time. The run is made
/// once more, in memory. One that is too long for a reference is also made with smaller steps.
///
/// # Errors
/// If there is no such reference, or the run fails.
pub fn error_at_end(plan: &Plan) -> Result<ErrorAtEnd, StudyError> {
    /// A larger error is as large as the motion itself.
    const LARGEST: f64 = 1e-2;
    let watch = Watch::default();
    let Plan { step_s, steps, settled: scenario, .. } = plan;
    let (step_s, steps) = (*step_s, *steps);
    let time_s = step_s * steps as f64;
    let scales = Scales::of(scenario, time_s, &watch)?;
    // A rotation is off by the roundings of its rate: of the inertia, of its inverse, of the
    // momentum.
    let turned = 2.0 * f64::EPSILON * scales.fastest_rad_s * time_s;
    let mut reference = match Reference::known_to(scenario, time_s, LARGEST, &scales, &watch) {
        Err(too_far @ StudyError::Reference(ReferenceError::TooFar { .. })) => {
            return against_halves(plan, turned, &watch)?.ok_or(too_far);
        }
        known => known?,
    };
    let run = measure(scenario, Probe::of(&scenario.method, step_s, steps), &watch)?;
    if !run.completed() {
        return Err(StudyError::Failed);
    }
    let error = reference.distance(&run.last);
    reference.round_start(scenario, 0, error, &watch)?;
    let known = 3.0 * reference.error.max(reference.cross_check).max(turned);
    Ok(if error > known { ErrorAtEnd::About(error) } else { ErrorAtEnd::Below(error + known) })
}

/// Returns the error at the end of a run against the same run with halved steps, and of that
/// against one with quartered steps:
///
/// ```text
/// d_1 = |z_h - z_{h/2}|,   d_2 = |z_{h/2} - z_{h/4}| = 2^-p d_1      where both are errors of the scheme, p its order
/// ```
///
/// Where d_2 is not much smaller, both are round-off and only a bound is known. `None` where that
/// takes too long or shows nothing.
fn against_halves(
    plan: &Plan,
    turned: f64,
    watch: &Watch,
) -> Result<Option<ErrorAtEnd>, StudyError> {
    /// Work of the three runs, in steps of the first, and the work allowed.
    const STEPS: f64 = 7.0;
    const MOST_NS: f64 = 6e10;
    /// Largest ratio of d_2 to d_1 for errors of the scheme: order 2 has 1/4.
    const FALLS: f64 = 0.3;
    /// Larger errors are as large as the motion itself.
    const LARGEST: f64 = 1e-2;
    let Plan { step_s, steps, settled: scenario, .. } = plan;
    if STEPS * *steps as f64 * plan.work_step_ns.max(plan.sweep_cost_ns()) > MOST_NS {
        return Ok(None);
    }
    let mut before = None::<Measured>;
    let mut apart = Vec::new();
    for part in [1, 2, 4] {
        let probe = Probe::of(&scenario.method, step_s / part as f64, steps * part);
        let run = measure(scenario, Probe { keep: true, ..probe }, watch)?;
        if !run.completed() {
            return if part == 1 { Err(StudyError::Failed) } else { Ok(None) };
        }
        if let Some(before) = before {
            let time_s = step_s * *steps as f64;
            apart.push(Reference::of_runs(time_s, &scenario.method, &run, &before.points).error);
        }
        before = Some(run);
    }
    let (first, second) = (apart[0], apart[1]);
    if second > LARGEST {
        return Ok(None);
    }
    let known = 3.0 * (second + turned);
    let is_of_scheme = second <= FALLS * first && first > known;
    Ok(Some(if is_of_scheme { ErrorAtEnd::About(first) } else { ErrorAtEnd::Below(first + known) }))
}

fn settle(
    scenario: &Scenario,
    asked: Accuracy,
    watch: &Watch,
) -> Result<(Scenario, Advice), Unsettled> {
    let out_of_reach = |why| Unsettled::OutOfReach { asked: asked.error, why };
    let allowed_ns = watch.left_ns().min(SETTLING_NS);
    let reported = |error| Unsettled::of(error, asked, allowed_ns);
    let allowance_ns = Some(allowed_ns.into());
    let watch = &Watch { cancelled: watch.cancelled.clone(), allowance_ns, ..Watch::default() };
    let duration_s = scenario.duration_s.unwrap_or_default();
    let scales = Scales::of(scenario, duration_s, watch).map_err(reported)?;
    let known = |time_s: f64| {
        Reference::known_to(scenario, time_s, needed(asked), &scales, watch).map_err(reported)
    };
    let pilot_s = duration_s.min(PILOT_STEPS * scales.easy_step_s);
    let left_ns = watch.left_ns();
    // For a motion past a point source, the passage itself matters.
    let pilot_s = if scales.adapts { duration_s } else { pilot_s };
    let near = known(pilot_s)?;
    let paid_ns = (left_ns - watch.left_ns()).max(1);
    let affordable_s = pilot_s * REFERENCE_PART * watch.left_ns() as f64 / paid_ns as f64;
    let far_s = duration_s.min(MOST_STEPS * scales.easy_step_s).min(affordable_s).max(pilot_s);
    let far = if far_s > pilot_s { known(far_s)? } else { near.clone() };
    let trial = Trial { scenario, asked, duration_s, scales, near, far };
    trial.carried(TO_BE_SEEN).map_err(out_of_reach)?;
    let mut contenders = trial.contenders(watch).map_err(reported)?;
    let unmet = |unmet| match unmet {
        Unmet::Study(error) => reported(error),
        Unmet::Obstacle(why) => out_of_reach(why),
    };
    loop {
        trial.decide(&mut contenders, watch).map_err(unmet)?;
        let is_settled = contenders.iter().any(|tried| tried.choice.is_some());
        if is_settled || !trial.reconsider(&mut contenders, watch).map_err(reported)? {
            break;
        }
    }
    // The sort is stable: among equals the first in the list wins.
    contenders.sort_by(|a, b| a.cost_ns().total_cmp(&b.cost_ns()));
    let least = contenders.iter().filter_map(|tried| tried.least).min_by(f64::total_cmp);
    // One that is small enough, but expected from a part of the run, explains nothing.
    let least = least.filter(|&least| least > asked.error);
    let Some(Contender { entry, choice: Some(choice), .. }) = contenders.first_mut() else {
        return Err(out_of_reach(Obstacle::NoMethod { least }));
    };
    *choice = trial.every_member(entry, *choice, watch).map_err(unmet)?;
    let choice = *choice;
    let steps = trial.steps(choice.step_s, duration_s);
    let settled = Scenario {
        method: entry.method.clone(),
        step_s: Some(duration_s / steps as f64),
        steps: Some(steps),
        duration_s: None,
        accuracy: None,
        ..scenario.clone()
    };
    settled.check().map_err(|error| match is_of_steps(&error) {
        true => out_of_reach(Obstacle::TooLong(error)),
        false => Unsettled::Refused(error),
    })?;
    let advice = Advice {
        error: asked.error,
        expected_error: choice.expected,
        margin: asked.error / choice.expected.max(ROUND_OFF),
        pilot_time_s: choice.seen_s,
        reference_error: trial.far.error,
        candidates: contenders.iter().map(Contender::reported).collect(),
    };
    Ok((settled, advice))
}
