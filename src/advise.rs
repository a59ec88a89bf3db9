//! 3 · An accuracy → a method and a step: pilot runs on the scene itself choose.
//!
//! 1. Each method is tried over the first part of the run, against a reference; its step is moved until the error that
//!    it will have at the end is expected just below the one asked for.
//! 2. The cheapest is run over the whole time, against a reference of the whole time, and its step mended, until the
//!    cheapest is one that was seen to get there. Of an ensemble then every member.
//! 3. A run longer than any reference has its errors carried on as the power of time by which they grew; where they grow
//!    exponentially, or round-off alone grows past what is asked, it is refused with the time until which it can be had.
//!
//! Cost is counted in steps, sweeps and gradients, never timed.
//!
//! Invariant: the choice is a function of the scenario alone: the same scenario, the same bytes.

use thiserror::Error;

use crate::plan::{Advice, Candidate, Counts, Plan};
use crate::scenario::{Accuracy, MethodName, Scenario, ScenarioError, TableauName};
use crate::study::measure::{End, Measured, Probe, measure, variant};
use crate::study::reference::{Growth, MOST_STEPS, QUARTERS, Reference, ReferenceError};
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
/// Of the work allowed, what the reference of the whole run may take.
const REFERENCE_PART: f64 = 0.4;
/// The error asked for is aimed at with this margin where the whole run is seen.
const MARGIN: f64 = 1.25;
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
/// Steps that are tried for a method over the whole run.
const WHOLE_TRIES: u32 = 4;
/// And for a member of an ensemble.
const MEMBER_TRIES: u32 = 8;

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
    Reference(ReferenceError),
    /// The reference itself is not known so well.
    #[error(
        "{growth}, doubles reach it until t = {until_s:.3} s, and {least:.1e} at t = {time_s:.3e} s; ask for less time, or for more error"
    )]
    Untold {
        /// The least error that can be told.
        least: f64,
        /// The time of the reference.
        time_s: f64,
        /// Until when what is asked can be told.
        until_s: f64,
        /// How errors grow.
        growth: Growth,
    },
    /// A member of the ensemble is not known so well.
    #[error("member {member}: {why}")]
    Member {
        /// Which.
        member: u64,
        /// What keeps it from the accuracy.
        why: Box<Obstacle>,
    },
    /// More members than can be looked at.
    #[error(
        "{members} members are too many to make sure of each, at most about {most} on this scene; give `method` and `step_s`, or ask for fewer"
    )]
    TooManyMembers {
        /// The members asked for.
        members: u64,
        /// Those that the work allowed is enough for.
        most: u64,
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
    plan.estimate(settled.log.compression, work_of_step(settled, &plan)?);
    if advice.is_some() {
        plan.formulation.why = "the cheapest that reached the accuracy in pilot runs";
    }
    plan.advice = advice;
    Ok(plan)
}

/// The work of a step at the start of the run; `None` if the first fails, for then there are no others.
fn work_of_step(settled: &Scenario, plan: &Plan) -> Result<Option<Counts>, ScenarioError> {
    let most_ns = FIRST_NS.max(FIRST_SWEEPS * plan.sweep_cost_ns());
    let watch = Watch { allowance_ns: Some((most_ns as u64).into()), ..Watch::default() };
    let probe = Probe::of(&settled.method, plan.step_s, plan.steps.min(FIRST_STEPS));
    let run = measure(settled, probe, &watch)?;
    let failed = matches!(run.end, End::Failed(_)) && run.steps == 0;
    let Counts { steps, sweeps, gradients } = run.counts();
    let steps = steps.max(1.0);
    Ok((!failed).then_some(Counts {
        steps: 1.0,
        sweeps: sweeps / steps,
        gradients: gradients / steps,
    }))
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

/// The error at the end of a run, as well as a reference tells it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ErrorAtEnd {
    /// Known to a third of itself.
    About(f64),
    /// No larger than this: the reference is known no better.
    Below(f64),
}

/// The error at the end of the run of a scenario with a method and a step, against a reference at that time. The run is
/// made once more, in memory.
///
/// # Errors
/// If there is no such reference, or the run fails.
pub fn error_at_end(scenario: &Scenario) -> Result<ErrorAtEnd, StudyError> {
    /// A larger error is the size of the motion.
    const LARGEST: f64 = 1e-2;
    let watch = Watch::default();
    let Plan { step_s, steps, .. } = Plan::new(scenario)?;
    let time_s = step_s * steps as f64;
    let scales = Scales::of(scenario, time_s, &watch)?;
    let reference = Reference::known_to(scenario, time_s, LARGEST, &scales, &watch)?;
    let run = measure(scenario, Probe::of(&scenario.method, step_s, steps), &watch)?;
    if !run.completed() {
        return Err(StudyError::Failed);
    }
    let (error, known) = (reference.distance(&run.last), 3.0 * reference.error);
    Ok(if error > known { ErrorAtEnd::About(error) } else { ErrorAtEnd::Below(error + known) })
}

/// The methods that are tried, those first whose steps are cheap: what costs much more than one that gets there is not
/// tried.
fn methods(scene: &Scenario, asked: Accuracy) -> Vec<Entry> {
    use MethodName as M;
    use TableauName as T;
    let mut methods: Vec<_> = [2, 4, 6, 8].map(|order| with_order(M::Splitting, order)).to_vec();
    methods.extend([T::Rk4, T::Rk8].map(|tableau| with_tableau(M::RkProjected, tableau)));
    methods.push(with_tableau(M::Rkmk, T::Rk8));
    let gauss = [T::Gauss1, T::Gauss2, T::Gauss3, T::Gauss4, T::Gauss6, T::Gauss8];
    methods.extend(gauss.map(|tableau| with_tableau(M::QuaternionGauss, tableau)));
    methods.extend([4, 8].map(|order| with_order(M::Lgvi, order)));
    methods.extend(gauss.map(|tableau| with_tableau(M::VpdReduced, tableau)));
    methods.extend(gauss.map(|tableau| with_tableau(M::Vpd, tableau)));
    methods.extend([T::Gauss2, T::Gauss4].map(|tableau| with_tableau(M::Vrkmk, tableau)));
    methods.retain(|method| !(asked.symplectic && method.name.is_explicit()));
    entries(scene, methods)
}

/// A step of a method, and what is known of a run with it.
#[derive(Clone, Copy, Debug)]
struct Choice {
    step_s: f64,
    /// The error expected at the end of the run.
    expected: f64,
    /// What a second of motion costs.
    cost_ns: f64,
    /// Was the run seen, as far as a reference reaches?
    seen: bool,
}

/// A method with its steps.
struct Contender {
    entry: Entry,
    choice: Option<Choice>,
    /// The last step that was seen to get there, while a larger one is tried.
    sure: Option<Choice>,
    /// The least error that was met.
    least: Option<f64>,
    tries: u32,
}

impl Contender {
    fn cost_ns(&self) -> f64 {
        self.choice.map_or(f64::INFINITY, |choice| choice.cost_ns)
    }
}

fn settle(
    scenario: &Scenario,
    asked: Accuracy,
    watch: &Watch,
) -> Result<(Scenario, Advice), Unsettled> {
    let out_of_reach = |why| Unsettled::OutOfReach { asked: asked.error, why };
    let allowed_ns = watch.left_ns().min(SETTLING_NS);
    let told = |error| Unsettled::of(error, asked, allowed_ns);
    let allowance_ns = Some(allowed_ns.into());
    let watch = &Watch { cancelled: watch.cancelled.clone(), allowance_ns, ..Watch::default() };
    let duration_s = scenario.duration_s.unwrap_or_default();
    let scales = Scales::of(scenario, duration_s, watch).map_err(told)?;
    let needed = asked.error / (2.0 * MARGIN);
    let known = |time_s: f64| -> Result<Reference, Unsettled> {
        match Reference::known_to(scenario, time_s, needed, &scales, watch) {
            Ok(reference) if reference.error > needed => {
                Err(out_of_reach(reference.chaotic(needed).into()))
            }
            known => known.map_err(told),
        }
    };
    let pilot_s = duration_s.min(PILOT_STEPS * scales.easy_step_s);
    let left_ns = watch.left_ns();
    let near = known(pilot_s)?;
    let paid_ns = (left_ns - watch.left_ns()).max(1);
    let affordable_s = pilot_s * REFERENCE_PART * watch.left_ns() as f64 / paid_ns as f64;
    let far_s = duration_s.min(MOST_STEPS * scales.easy_step_s).min(affordable_s).max(pilot_s);
    let far = if far_s > pilot_s { known(far_s)? } else { near.clone() };
    let trial = Trial { scenario, asked, duration_s, scales, near, far };
    trial.carried().map_err(out_of_reach)?;
    let mut contenders = trial.contenders(watch).map_err(told)?;
    trial.decide(&mut contenders, watch).map_err(told)?;
    // The sort is stable: of equals the first in the list.
    contenders.sort_by(|a, b| a.cost_ns().total_cmp(&b.cost_ns()));
    let Some(Contender { entry, choice: Some(choice), .. }) = contenders.first() else {
        let least = contenders.iter().filter_map(|tried| tried.least).min_by(f64::total_cmp);
        return Err(out_of_reach(Obstacle::NoMethod { least }));
    };
    let choice = trial.every_member(entry, *choice, watch).map_err(|unmet| match unmet {
        Unmet::Study(error) => told(error),
        Unmet::Obstacle(why) => out_of_reach(why),
    })?;
    let steps = trial.steps(choice.step_s, duration_s);
    let settled = Scenario {
        method: entry.method.clone(),
        step_s: Some(duration_s / steps as f64),
        steps: Some(steps),
        duration_s: None,
        accuracy: None,
        ..scenario.clone()
    };
    settled.check().map_err(|error| match error.pointer.as_str() {
        "/steps" | "/step_s" => out_of_reach(Obstacle::TooLong(error)),
        _ => Unsettled::Refused(error),
    })?;
    let candidates = contenders.iter().map(|Contender { entry, choice, least, .. }| Candidate {
        method: entry.method.name,
        tableau: entry.tableau.clone(),
        step_s: choice.map(|choice| choice.step_s),
        expected_error: choice.map_or(*least, |choice| Some(choice.expected)),
        cost_us: choice.map(|choice| 1e-3 * choice.cost_ns),
    });
    let advice = Advice {
        error: asked.error,
        expected_error: choice.expected,
        margin: asked.error / choice.expected.max(ROUND_OFF),
        pilot_time_s: trial.far.time_s,
        reference_error: trial.far.error,
        candidates: candidates.collect(),
    };
    Ok((settled, advice))
}

/// Why a member keeps the ensemble from its accuracy.
enum Unmet {
    Study(StudyError),
    Obstacle(Obstacle),
}

impl<E: Into<StudyError>> From<E> for Unmet {
    fn from(error: E) -> Self {
        Self::Study(error.into())
    }
}

/// What the search for a step needs to know.
struct Trial<'a> {
    scenario: &'a Scenario,
    asked: Accuracy,
    duration_s: f64,
    scales: Scales,
    /// Of the first part of the run.
    near: Reference,
    /// As far as a reference reaches: of the whole run, if it is not too long.
    far: Reference,
}

/// So many steps as a reference can be met with.
fn multiple(steps: f64) -> u64 {
    QUARTERS * (steps / QUARTERS as f64).ceil().max(1.0) as u64
}

impl Trial<'_> {
    fn is_whole(&self) -> bool {
        self.duration_s <= self.far.time_s
    }

    fn goal(&self) -> f64 {
        self.asked.error / if self.is_whole() { MARGIN } else { CARRIED_MARGIN }
    }

    /// The steps of such a size over a time: as they were tried, so that the run is the one that was seen.
    fn steps(&self, step_s: f64, time_s: f64) -> u64 {
        // The last digit of a quotient is no step too many.
        let steps = time_s / step_s * (1.0 - 1e-12);
        if time_s <= self.far.time_s { multiple(steps) } else { steps.ceil().max(1.0) as u64 }
    }

    /// Makes sure that errors may be carried on to the end of the run.
    fn carried(&self) -> Result<(), Obstacle> {
        let Growth::Exponential { tenfold_s } = self.far.growth() else { return Ok(()) };
        if self.is_whole() {
            return Ok(());
        }
        let needed = self.asked.error / (2.0 * CARRIED_MARGIN);
        let decades = libm::log10(needed / self.far.error.max(ROUND_OFF));
        let until_s = (self.far.time_s + tenfold_s * decades).max(0.0);
        if until_s >= self.duration_s {
            return Ok(());
        }
        let grown = self.far.error
            * libm::pow(10.0, ((self.duration_s - self.far.time_s) / tenfold_s).min(300.0));
        let growth = self.far.growth();
        Err(Obstacle::Untold { least: grown.min(2.0), time_s: self.duration_s, until_s, growth })
    }

    /// All methods with the steps that the first part of the run asks for.
    fn contenders(&self, watch: &Watch) -> Result<Vec<Contender>, StudyError> {
        let mut cheapest = f64::INFINITY;
        let mut contenders = Vec::new();
        for entry in methods(self.scenario, self.asked) {
            let (choice, least) = self.search(&entry, cheapest, watch)?;
            cheapest = cheapest.min(choice.map_or(f64::INFINITY, |choice| choice.cost_ns));
            contenders.push(Contender { entry, choice, sure: None, least, tries: 0 });
        }
        Ok(contenders)
    }

    /// The cheapest step of a method that is expected to reach the accuracy, and the least error met. Given
    /// up where it costs more than `cheapest`.
    fn search(
        &self,
        entry: &Entry,
        cheapest: f64,
        watch: &Watch,
    ) -> Result<(Option<Choice>, Option<f64>), StudyError> {
        /// What costs so many times more by its usual sweeps is not even tried.
        const TOO_DEAR: f64 = 6.0;
        let (time_s, goal) = (self.near.time_s, self.goal());
        // A radian a step, and then by the order of the method; never back to where a step failed.
        let mut steps = multiple(time_s * self.scales.fastest_rad_s);
        let (mut reached, mut least) = (None::<(u64, Choice)>, None::<f64>);
        let mut too_few = 0;
        let usual_ns = variant(self.scenario, &entry.method, 1.0, 1)?.step_ns;
        for _ in 0..TRIES {
            if reached.is_none() && usual_ns * steps as f64 > TOO_DEAR * cheapest * time_s {
                break;
            }
            let run = self.run(entry, &self.near, steps, 0, watch)?;
            let cost_ns = run.cost_ns / time_s;
            let expected = run.completed().then(|| self.expected(&self.near, &run)).flatten();
            let ratio = match expected {
                Some(expected) => {
                    least = Some(least.map_or(expected, |least| least.min(expected)));
                    // Near its border a step may need so many sweeps that a smaller one is cheaper.
                    let better = reached.is_none_or(|(_, best)| cost_ns < best.cost_ns);
                    if expected <= goal && better {
                        let step_s = time_s / steps as f64;
                        let seen = self.near.time_s >= self.far.time_s;
                        reached = Some((steps, Choice { step_s, expected, cost_ns, seen }));
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
                Some((reached, _)) if next >= reached => break,
                Some(_) if next <= too_few => break,
                _ => next.max(too_few + QUARTERS),
            };
            steps = next;
        }
        Ok((reached.map(|(_, choice)| choice), least))
    }

    /// Runs the cheapest as far as a reference reaches and mends its step, until the cheapest is one that was seen there.
    fn decide(&self, contenders: &mut [Contender], watch: &Watch) -> Result<(), StudyError> {
        let time_s = self.far.time_s;
        loop {
            let cheapest = contenders
                .iter_mut()
                .filter(|tried| tried.choice.is_some())
                .min_by(|a, b| a.cost_ns().total_cmp(&b.cost_ns()));
            let Some(Contender { entry, choice, sure, least, tries }) = cheapest else {
                return Ok(());
            };
            let Some(at) = choice.filter(|choice| !choice.seen) else { return Ok(()) };
            *tries += 1;
            let steps = self.steps(at.step_s, time_s);
            let run = self.run(entry, &self.far, steps, 0, watch)?;
            let (step_s, cost_ns) = (time_s / steps as f64, run.cost_ns / time_s);
            let expected = run.completed().then(|| self.expected(&self.far, &run)).flatten();
            if let Some(expected) = expected {
                *least = Some(least.map_or(expected, |least| least.min(expected)));
            }
            if let Some(expected) = expected.filter(|&expected| expected <= self.goal()) {
                let reached = Choice { step_s, expected, cost_ns, seen: true };
                if sure.is_none_or(|sure| reached.cost_ns < sure.cost_ns) {
                    *sure = Some(reached);
                }
            }
            let ratio = expected.map_or(2.0, |expected| {
                let order = f64::from(entry.order);
                libm::pow(expected.max(ROUND_OFF) / self.goal(), 1.0 / order)
            });
            let factor = (1.03 * ratio).clamp(0.4, 4.0);
            // As much larger as pays for another try, or smaller until it gets there.
            let goes_on =
                if sure.is_some() { expected.is_some_and(|_| factor < 0.93) } else { true };
            *choice = if *tries < WHOLE_TRIES && goes_on {
                let factor = if sure.is_some() { factor } else { factor.max(1.03) };
                let expected = self.goal();
                Some(Choice {
                    step_s: step_s / factor,
                    expected,
                    cost_ns: cost_ns * factor,
                    seen: false,
                })
            } else {
                *sure
            };
        }
    }

    /// A run over the time of a reference, with its states at each quarter.
    fn run(
        &self,
        entry: &Entry,
        reference: &Reference,
        steps: u64,
        member: u64,
        watch: &Watch,
    ) -> Result<Measured, StudyError> {
        let whole = Probe::of(&entry.method, reference.time_s / steps as f64, steps);
        let probe = Probe { every: steps / QUARTERS, keep: true, member, ..whole };
        let run = measure(self.scenario, probe, watch)?;
        watch.advance(0)?;
        Ok(run)
    }

    /// The choice with a step that is small enough for every member of an ensemble.
    fn every_member(
        &self,
        entry: &Entry,
        mut choice: Choice,
        watch: &Watch,
    ) -> Result<Choice, Unmet> {
        let members = self.scenario.ensemble.as_ref().map_or(1, |ensemble| ensemble.members);
        let left_ns = watch.left_ns();
        for member in 1..members {
            choice = self.of_member(entry, choice, member, watch)?;
            if member == 1 {
                let cost_ns = (left_ns - watch.left_ns()).max(1);
                let most = 2 + watch.left_ns() / cost_ns;
                if members > most {
                    return Err(Unmet::Obstacle(Obstacle::TooManyMembers { members, most }));
                }
            }
        }
        Ok(choice)
    }

    /// The choice with a step that is small enough for a member, too.
    fn of_member(
        &self,
        entry: &Entry,
        mut choice: Choice,
        member: u64,
        watch: &Watch,
    ) -> Result<Choice, Unmet> {
        let obstacle = |why| Unmet::Obstacle(Obstacle::Member { member, why: Box::new(why) });
        let out_of_sight = |error: StudyError| match error {
            StudyError::Reference(error) => obstacle(error.into()),
            error => error.into(),
        };
        let time_s = self.far.time_s;
        let mut reference = self.far.of_member(self.scenario, member, watch)?;
        let mut is_sure = false;
        for _ in 0..MEMBER_TRIES {
            let steps = self.steps(choice.step_s, time_s);
            let run = self.run(entry, &self.far, steps, member, watch)?;
            let expected = reference.as_ref().filter(|_| run.completed());
            let expected = expected.and_then(|reference| self.expected(reference, &run));
            if let Some(expected) = expected.filter(|&expected| expected <= self.goal()) {
                let cost_ns = choice.cost_ns.max(run.cost_ns / time_s);
                return Ok(Choice { expected: choice.expected.max(expected), cost_ns, ..choice });
            }
            if !is_sure {
                // Is it the step that is too large, or the reference that is not known?
                let needed = self.asked.error / (2.0 * MARGIN);
                let known =
                    Reference::of(self.scenario, member, time_s, needed, &self.scales, watch);
                reference = Some(known.map_err(out_of_sight)?);
                is_sure = true;
                continue;
            }
            let order = f64::from(entry.order);
            let ratio =
                expected.map_or(2.0, |expected| libm::pow(expected / self.goal(), 1.0 / order));
            choice.step_s = time_s / steps as f64 / (1.03 * ratio).clamp(1.03, 4.0);
        }
        Err(obstacle(Obstacle::NoMethod { least: None }))
    }

    /// The error expected at the end of the run; `None` where errors grow too fast to be carried on.
    fn expected(&self, reference: &Reference, run: &Measured) -> Option<f64> {
        let errors: Vec<f64> = run
            .points
            .iter()
            .enumerate()
            .map(|(quarter, point)| reference.distance_at(quarter, point))
            .collect();
        let largest = |errors: &[f64]| errors.iter().copied().fold(0.0, f64::max);
        // Not the last alone: an error that swings may pass through zero there. And no more is known than by the reference.
        let late = largest(&errors[errors.len() / 2..]) + reference.error;
        if self.duration_s <= reference.time_s {
            return Some(late);
        }
        let early = largest(&errors[..errors.len() / 2 + 1]).max(reference.error);
        let growth = libm::log2(late / early).max(1.0);
        let ratio = self.duration_s / reference.time_s;
        // What will be seen to its end is a guess here; what will not is to hold.
        if self.is_whole() {
            return Some(late * libm::pow(ratio, growth.min(FASTEST_GROWTH)));
        }
        (growth <= FASTEST_GROWTH).then(|| late * libm::pow(ratio, growth + DOUBT))
    }
}
