//! The search for a method and a step: pilots choose, runs over the whole time decide, members are made sure of.
//!
//! Invariant: the step that is taken was seen to get there as far as a reference reaches, and past it, as far as the work
//! allowed goes, not to differ from its half by more than what is asked.

use crate::method::Integrator;
use crate::plan::Candidate;
use crate::scenario::{Accuracy, Scenario};
use crate::study::measure::{Measured, Probe, measure, of_method};
use crate::study::reference::{Growth, QUARTERS, Reference};
use crate::study::{Entry, Scales, StudyError, Watch, entries};

use super::Obstacle;

/// Margin below the requested error that is aimed at where the whole run is seen.
pub(super) const MARGIN: f64 = 1.25;
/// Margin where the errors were extrapolated to the end.
const CARRIED_MARGIN: f64 = 10.0;
/// Errors that grow faster than this power of time are not extrapolated.
const FASTEST_GROWTH: f64 = 3.0;
/// Power of time that is added to the observed growth when errors are extrapolated.
const DOUBT: f64 = 0.5;
/// A smaller error than this is luck.
pub(super) const ROUND_OFF: f64 = 1e-16;
/// Number of steps tried for a method.
const TRIES: u32 = 7;
/// Number of steps tried for a method over the whole run, next to those that are far too large: where a body is pushed
/// after the first part of its run, the step that this asked for is.
const WHOLE_TRIES: u32 = 6;
const FAR_TRIES: u32 = 12;
/// Factor by which a step is too large that is far too large.
const FAR_TOO_LARGE: f64 = 2.0;
/// Number of steps tried for a member of an ensemble.
const MEMBER_TRIES: u32 = 8;
/// A step that is larger by less than this is not tried over the whole run.
const WORTH_A_TRY: f64 = 0.93;
/// Part of the run up to which errors, by their growth in the first part, must stay small enough.
/// Beyond it they are checked by a run.
pub(super) const TO_BE_SEEN: f64 = 0.5;
/// Number of steps tried where a run is followed past its reference.
const FOLLOWING_TRIES: u32 = 5;
/// Shares of the remaining work for following a run, at first and with a smaller step.
const FOLLOWED_PART: f64 = 0.3;
const MENDED_PART: f64 = 0.6;
/// Factor by which a run that is not seen to its end is made more accurate.
const UNSEEN: f64 = 1e3;
/// Distance at which two runs no longer show how errors depend on the step.
const LOST: f64 = 1e-2;
/// A step that is to be smaller by a factor in this range is halved.
const NEARLY_HALF: std::ops::Range<f64> = 1.6..2.4;
/// Work of a run and of the same with halved steps, in steps of the run.
const RUN_AND_HALF: f64 = 3.0;

/// Returns the methods that are tried, those with cheap steps first: a method that costs much more
/// than one that reaches the accuracy is not tried.
fn methods(scene: &Scenario, asked: Accuracy, scales: &Scales) -> Vec<Entry> {
    let mut all = entries(scene, Integrator::tried(asked.symplectic));
    if scales.adapts {
        all.sort_by_key(|entry| entry.integrator != Integrator::VpdAdaptive);
    }
    all
}

/// Returns the error to which a reference has to be known.
pub(super) fn needed(asked: Accuracy) -> f64 {
    asked.error / (2.0 * MARGIN)
}

/// A step of a method, and what is known of a run with it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Choice {
    pub(super) step_s: f64,
    /// The error expected at the end of the run.
    pub(super) expected: f64,
    /// Cost of a second of motion, in a run by itself.
    cost_ns: f64,
    /// Part of that which a member of the ensemble takes: [`crate::plan::Plan::part_of_member`].
    part: f64,
    /// The time to which the run was seen.
    pub(super) seen_s: f64,
    /// Whether that is as far as it can be seen.
    sure: bool,
}

/// A method with its steps.
pub(super) struct Contender {
    pub(super) entry: Entry,
    pub(super) choice: Option<Choice>,
    /// The last step that was seen to reach the accuracy, while a larger one is tried.
    sure: Option<Choice>,
    /// The step of the least error expected of those that are not: small enough, but not by the margin of an error that is
    /// extrapolated.
    nearly: Option<Choice>,
    /// The least error that was met.
    pub(super) least: Option<f64>,
    /// Whether it was given up because another method was cheaper.
    is_dear: bool,
    tries: u32,
    far_tries: u32,
}

impl Contender {
    /// Returns the cost of a second of motion, of a member where there is an ensemble.
    pub(super) fn cost_ns(&self) -> f64 {
        self.choice.map_or(f64::INFINITY, |choice| choice.part * choice.cost_ns)
    }

    /// Returns its entry in the plan.
    pub(super) fn reported(&self) -> Candidate {
        let Self { entry, choice, least, .. } = self;
        Candidate {
            method: entry.integrator,
            tableau: entry.tableau.clone(),
            step_s: choice.map(|choice| choice.step_s),
            expected_error: choice.map_or(*least, |choice| Some(choice.expected)),
            cost_us: choice.map(|_| 1e-3 * self.cost_ns()),
        }
    }
}

/// Reason why a member keeps the ensemble from its accuracy.
pub(super) enum Unmet {
    Study(StudyError),
    Obstacle(Obstacle),
}

impl<E: Into<StudyError>> From<E> for Unmet {
    fn from(error: E) -> Self {
        Self::Study(error.into())
    }
}

fn of_member(member: u64, why: Obstacle) -> Unmet {
    Unmet::Obstacle(Obstacle::Member { member, why: Box::new(why) })
}

/// A member of an ensemble as it was seen.
struct Seen {
    /// The solution from its start, if there is one.
    reference: Option<Reference>,
    /// Whether two families of methods agree on it.
    is_sure: bool,
    /// The step with which the member kept the accuracy.
    step_s: f64,
}

/// Outcome of following a choice past the reference.
enum Followed {
    /// This choice reaches the accuracy.
    Reached(Choice),
    /// No choice reaches it; holds the least error met.
    Missed(Option<f64>),
}

/// Inputs of the search for a step.
pub(super) struct Trial<'a> {
    pub(super) scenario: &'a Scenario,
    pub(super) asked: Accuracy,
    pub(super) duration_s: f64,
    pub(super) scales: Scales,
    /// Reference for the first part of the run.
    pub(super) near: Reference,
    /// Reference that reaches as far as possible: over the whole run, if it is not too long.
    pub(super) far: Reference,
}

/// Returns `steps` or a few more, a multiple of `of`.
fn multiple(steps: f64, of: u64) -> u64 {
    of * (steps / of as f64).ceil().max(1.0) as u64
}

impl Trial<'_> {
    fn is_whole(&self) -> bool {
        self.duration_s <= self.far.time_s
    }

    /// Number of members of the ensemble; one without one.
    fn members(&self) -> u64 {
        self.scenario.ensemble.as_ref().map_or(1, |ensemble| ensemble.members)
    }

    fn goal(&self) -> f64 {
        self.goal_seen_to(self.far.time_s)
    }

    /// Returns the error that is aimed at where a run is seen to `time_s`.
    fn goal_seen_to(&self, time_s: f64) -> f64 {
        self.asked.error / if time_s >= self.duration_s { MARGIN } else { CARRIED_MARGIN }
    }

    /// Returns the number of steps of this size over a time, as they were tried, so that the run is
    /// the one seen.
    pub(super) fn steps(&self, step_s: f64, time_s: f64) -> u64 {
        // The last digit of a quotient must not add a step.
        multiple(time_s / step_s * (1.0 - 1e-12), self.unit(time_s))
    }

    /// Returns the number of which the steps over a time are a multiple, so that a reference can be
    /// met and, over the whole run, samples fall on the requested times.
    fn unit(&self, time_s: f64) -> u64 {
        let sampled = if time_s >= self.duration_s { self.scenario.multiple_of_steps() } else { 1 };
        let mut multiples = (1..QUARTERS).map(|k| k * sampled);
        multiples.find(|steps| steps % QUARTERS == 0).unwrap_or(QUARTERS * sampled)
    }

    /// Checks that errors may be extrapolated to the end of the run, or to this part of it.
    pub(super) fn carried(&self, part: f64) -> Result<(), Obstacle> {
        let Growth::Exponential { tenfold_s } = self.far.growth() else { return Ok(()) };
        if self.is_whole() {
            return Ok(());
        }
        let needed = self.asked.error / (2.0 * CARRIED_MARGIN);
        let decades = libm::log10(needed / self.far.error.max(ROUND_OFF));
        let until_s = (self.far.time_s + tenfold_s * decades).max(0.0);
        if until_s >= part * self.duration_s {
            return Ok(());
        }
        let grown = self.far.error
            * libm::pow(10.0, ((self.duration_s - self.far.time_s) / tenfold_s).min(300.0));
        let growth = self.far.growth();
        Err(Obstacle::Untold { least: grown.min(2.0), time_s: self.duration_s, until_s, growth })
    }

    /// Returns all methods with the steps that the first part of the run asks for.
    pub(super) fn contenders(&self, watch: &Watch) -> Result<Vec<Contender>, StudyError> {
        let mut cheapest = f64::INFINITY;
        let mut contenders = Vec::new();
        for entry in methods(self.scenario, self.asked, &self.scales) {
            let found = self.search(&entry, cheapest, watch)?;
            cheapest = cheapest.min(found.cost_ns());
            contenders.push(found);
        }
        Ok(contenders)
    }

    /// Searches again for the steps of methods that were given up next to a cheaper one, which did not reach the accuracy
    /// over the whole run. Returns whether there is another choice.
    pub(super) fn reconsider(
        &self,
        contenders: &mut [Contender],
        watch: &Watch,
    ) -> Result<bool, StudyError> {
        let mut cheapest = f64::INFINITY;
        for contender in contenders.iter_mut().filter(|contender| contender.is_dear) {
            let found = self.search(&contender.entry, cheapest, watch)?;
            cheapest = cheapest.min(found.cost_ns());
            *contender = found;
        }
        Ok(cheapest.is_finite())
    }

    /// Returns the cheapest step of a method that is expected to reach the accuracy. Gives up where it costs more than
    /// `cheapest`.
    fn search(&self, entry: &Entry, cheapest: f64, watch: &Watch) -> Result<Contender, StudyError> {
        /// Methods that cost this many times more by their usual sweeps are not even tried.
        const TOO_DEAR: f64 = 6.0;
        let (time_s, goal) = (self.near.time_s, self.goal());
        let unit = self.unit(time_s);
        // A radian a step, and then by the order of the method; never back to where a step failed.
        let mut steps = multiple(time_s * self.scales.fastest_rad_s, unit);
        let (mut reached, mut least) = (None::<(u64, Choice)>, None::<f64>);
        let (mut too_few, mut is_dear) = (0, false);
        let plan = of_method(self.scenario, &entry.method)?;
        let part = plan.part_of_member(self.members());
        let usual_ns = part * plan.step_ns;
        for _ in 0..TRIES {
            is_dear = reached.is_none() && usual_ns * steps as f64 > TOO_DEAR * cheapest * time_s;
            if is_dear {
                break;
            }
            let run = self.run(entry, time_s, steps, 0, watch)?;
            let cost_ns = run.cost_ns / time_s;
            let expected = run.completed().then(|| self.expected(&self.near, &run)).flatten();
            let ratio = match expected {
                Some(expected) => {
                    least = Some(least.map_or(expected, |least| least.min(expected)));
                    // Near the largest step that works, a smaller one may be cheaper, for it needs fewer sweeps.
                    let better = reached.is_none_or(|(_, best)| cost_ns < best.cost_ns);
                    if expected <= goal && better {
                        let step_s = time_s / steps as f64;
                        let seen_s = self.near.time_s;
                        let sure = seen_s >= self.duration_s;
                        let choice = Choice { step_s, expected, cost_ns, part, seen_s, sure };
                        reached = Some((steps, choice));
                    }
                    libm::pow(expected.max(ROUND_OFF) / goal, 1.0 / f64::from(entry.order))
                }
                None => 2.0,
            };
            if expected.is_none_or(|expected| expected > goal) {
                too_few = too_few.max(steps);
            }
            is_dear = reached.is_none() && part * cost_ns > 2.0 * cheapest;
            if is_dear {
                break;
            }
            // A little more than the order asks for, in bounds.
            let next = multiple(steps as f64 * (1.03 * ratio).clamp(0.4, 4.0), unit);
            let next = match reached {
                Some((reached, _)) if next >= reached => break,
                Some(_) if next <= too_few => break,
                _ => next.max(too_few + unit),
            };
            steps = next;
        }
        let (entry, choice) = (entry.clone(), reached.map(|(_, choice)| choice));
        let (sure, nearly) = (None, None);
        Ok(Contender { entry, choice, sure, nearly, least, is_dear, tries: 0, far_tries: 0 })
    }

    /// Runs the cheapest as far as a reference reaches, follows it past that, and corrects its
    /// step, until the cheapest is one that was seen to reach the accuracy.
    pub(super) fn decide(&self, contenders: &mut [Contender], watch: &Watch) -> Result<(), Unmet> {
        let time_s = self.far.time_s;
        let mut follow_s = None;
        loop {
            let cheapest = contenders
                .iter_mut()
                .filter(|tried| tried.choice.is_some())
                .min_by(|a, b| a.cost_ns().total_cmp(&b.cost_ns()));
            let Some(contender) = cheapest else { return Ok(()) };
            let Contender { entry, choice, sure, nearly, least, tries, far_tries, .. } = contender;
            let Some(at) = choice.filter(|choice| !choice.sure) else { return Ok(()) };
            if at.seen_s >= time_s {
                let until_s =
                    *follow_s.get_or_insert_with(|| self.affordable_s(at, FOLLOWED_PART, watch));
                let order = f64::from(entry.order);
                let mut harsher = 1.0;
                *choice = match self.follow(entry, at, until_s, None, watch)? {
                    Followed::Reached(choice) => {
                        if choice.seen_s >= self.duration_s {
                            harsher = libm::pow(at.step_s / choice.step_s, order).max(1.0);
                        }
                        Some(choice)
                    }
                    Followed::Missed(met) => {
                        *least = (*least).into_iter().chain(met).min_by(f64::total_cmp);
                        None
                    }
                };
                // The errors of the others must be smaller by the same factor.
                for Contender { entry, choice, .. } in &mut *contenders {
                    if let Some(other) = choice.as_mut().filter(|other| !other.sure) {
                        let smaller = libm::pow(harsher, 1.0 / f64::from(entry.order));
                        other.step_s /= smaller;
                        other.cost_ns *= smaller;
                    }
                }
                continue;
            }
            let steps = self.steps(at.step_s, time_s);
            let run = self.run(entry, time_s, steps, 0, watch)?;
            let (step_s, cost_ns) = (time_s / steps as f64, run.cost_ns / time_s);
            let expected = run.completed().then(|| self.expected(&self.far, &run)).flatten();
            if *tries + *far_tries == 0 {
                // What the first part of the run let expect no longer counts.
                *least = None;
            }
            if let Some(expected) = expected {
                *least = Some(least.map_or(expected, |least| least.min(expected)));
            }
            if let Some(expected) = expected {
                let whole = self.is_whole();
                let tried = Choice { step_s, expected, cost_ns, seen_s: time_s, sure: whole, ..at };
                if expected > self.goal() {
                    let near = expected <= self.goal_seen_to(self.duration_s);
                    if near && nearly.is_none_or(|nearly| expected < nearly.expected) {
                        *nearly = Some(tried);
                    }
                } else if sure.is_none_or(|sure| tried.cost_ns < sure.cost_ns) {
                    *sure = Some(tried);
                }
            }
            let ratio = expected.map_or(2.0, |expected| {
                let order = f64::from(entry.order);
                libm::pow(expected.max(ROUND_OFF) / self.goal(), 1.0 / order)
            });
            let factor = (1.03 * ratio).clamp(0.4, 4.0);
            if sure.is_none() && factor > FAR_TOO_LARGE && *far_tries < FAR_TRIES {
                *far_tries += 1;
            } else {
                *tries += 1;
            }
            // Larger if that is worth another try, or smaller until it reaches the accuracy.
            let goes_on = sure.is_none() || (expected.is_some() && factor < WORTH_A_TRY);
            *choice = if *tries < WHOLE_TRIES && goes_on {
                // An error that swings with the step is not brought down by a little.
                let least = if *tries > 2 { 1.25 } else { 1.03 };
                let factor = if sure.is_some() { factor } else { factor.max(least) };
                Some(Choice {
                    step_s: step_s / factor,
                    expected: self.goal(),
                    cost_ns: cost_ns * factor,
                    ..at
                })
            } else {
                // What is not sure enough from here is, if the run can be followed to its end.
                let seen = |choice: &Choice| {
                    self.affordable_s(*choice, FOLLOWED_PART, watch) >= self.duration_s
                };
                sure.or(nearly.filter(seen))
            };
        }
    }

    /// Returns the time to which a choice may be followed for this share of the remaining work, in
    /// all members.
    fn affordable_s(&self, choice: Choice, part: f64, watch: &Watch) -> f64 {
        let members = self.members();
        let allowed_ns = part * watch.left_ns() as f64 / members as f64;
        self.duration_s.min(allowed_ns / (RUN_AND_HALF * choice.cost_ns))
    }

    /// Follows a choice past the reference, as it will be made, against the same with halved steps,
    /// and corrects its step until the two are near each other. A run chooses the step; that of a
    /// `member` of an ensemble may only make it smaller.
    ///
    /// ```text
    /// |z_h(t) - z_{h/2}(t)| = (1 - 2^-p) |z_h(t) - z(t)|,      p the order; and round-off of both
    /// ```
    fn follow(
        &self,
        entry: &Entry,
        mut choice: Choice,
        mut until_s: f64,
        member: Option<u64>,
        watch: &Watch,
    ) -> Result<Followed, Unmet> {
        let number = member.unwrap_or(0);
        choice.sure = true;
        if until_s < self.duration_s {
            self.carried(1.0).map_err(Unmet::Obstacle)?;
        }
        if until_s <= self.far.time_s {
            return Ok(Followed::Reached(self.with_care(entry, choice, member)));
        }
        let (mut reached, mut least) = (None::<Choice>, None::<(f64, Reference)>);
        let (mut before, mut last) = (None::<(u64, Measured)>, None::<f64>);
        for attempt in 1..=FOLLOWING_TRIES {
            // Work taken by others, and by a smaller step, is no longer available.
            if member.is_none() {
                let part = if attempt == 1 { FOLLOWED_PART } else { MENDED_PART };
                let affordable_s = self.affordable_s(choice, part, watch);
                // A larger step than one that reached the accuracy is not worth a shorter look.
                if affordable_s <= self.far.time_s || (affordable_s < until_s && reached.is_some())
                {
                    break;
                }
                until_s = until_s.min(affordable_s);
            }
            let whole = self.steps(choice.step_s, self.duration_s);
            let step_s = self.duration_s / whole as f64;
            let steps = multiple(until_s / step_s * (1.0 - 1e-12), QUARTERS).min(whole);
            let time_s = if steps == whole { self.duration_s } else { step_s * steps as f64 };
            let halved = before.take().filter(|(halved, _)| *halved == steps);
            let is_half = halved.is_some();
            let run = match halved {
                Some((_, run)) => run,
                None => self.run(entry, time_s, steps, number, watch)?,
            };
            let finer = self.run(entry, time_s, 2 * steps, number, watch)?;
            let (mut expected, mut is_mended) = (None, true);
            if run.completed() && finer.completed() {
                let reference = Reference::of_runs(time_s, &entry.method, &finer, &run.points);
                expected = self.carried_on(&reference.apart, 0.0, time_s);
                let met = expected.unwrap_or(reference.error);
                if reached.is_none() {
                    is_mended = last.replace(met).is_none_or(|last| met <= 0.5 * last);
                    if least.as_ref().is_none_or(|(least, _)| met <= *least) {
                        least = Some((met, reference));
                    }
                    // An error that half the step does not reduce is round-off, unless the motion
                    // has been lost altogether. A smaller one shows nothing: near an anchor or a
                    // charge it matters where the steps fall.
                    if !is_mended && is_half && met < LOST {
                        break;
                    }
                }
            }
            let goal = self.goal_seen_to(time_s);
            let order = f64::from(entry.order);
            let factor = expected.map_or(2.0, |expected| {
                1.03 * libm::pow(expected.max(ROUND_OFF) / goal, 1.0 / order)
            });
            if let Some(expected) = expected.filter(|&expected| expected <= goal) {
                let cost_ns = run.cost_ns / time_s;
                let seen =
                    Choice { step_s, expected, cost_ns, seen_s: time_s, sure: true, ..choice };
                if reached.is_none_or(|reached| seen.cost_ns < reached.cost_ns) {
                    reached = Some(seen);
                }
                // A larger step is for all members, and not where errors were extrapolated.
                if member.is_some() || time_s < self.duration_s || factor > WORTH_A_TRY {
                    break;
                }
            } else if reached.is_some() {
                break;
            }
            let smaller = if reached.is_some() {
                factor.max(0.4)
            } else if NEARLY_HALF.contains(&factor) || (attempt > 1 && factor < 2.0) || !is_mended {
                // It has been run already.
                2.0
            } else {
                factor.clamp(1.03, 4.0)
            };
            choice.cost_ns = run.cost_ns / time_s * smaller;
            choice.step_s = step_s / smaller;
            before = Some((2 * steps, finer));
        }
        if let Some(reached) = reached {
            return Ok(Followed::Reached(self.with_care(entry, reached, member)));
        }
        let Some((least, reference)) = least else { return Ok(Followed::Missed(None)) };
        // Where errors grow so fast another method is no better off.
        match reference.growth() {
            growth @ Growth::Exponential { .. } => {
                let until_s = reference.until(needed(self.asked));
                Err(Unmet::Obstacle(Obstacle::Untold {
                    least,
                    time_s: reference.time_s,
                    until_s,
                    growth,
                }))
            }
            Growth::Power { .. } => Ok(Followed::Missed(Some(least))),
        }
    }

    /// Returns the choice with a smaller step where its run is not seen to the end: a motion may
    /// become harsher there.
    fn with_care(&self, entry: &Entry, choice: Choice, member: Option<u64>) -> Choice {
        if member.is_some() || choice.seen_s >= self.duration_s {
            return choice;
        }
        let smaller = libm::pow(UNSEEN, 1.0 / f64::from(entry.order));
        let (step_s, cost_ns) = (choice.step_s / smaller, choice.cost_ns * smaller);
        Choice { step_s, cost_ns, ..choice }
    }

    /// Makes a run over a time, with its states at each quarter.
    fn run(
        &self,
        entry: &Entry,
        time_s: f64,
        steps: u64,
        member: u64,
        watch: &Watch,
    ) -> Result<Measured, StudyError> {
        let whole = Probe::of(&entry.method, time_s / steps as f64, steps);
        let probe = Probe { every: steps / QUARTERS, keep: true, member, ..whole };
        let run = measure(self.scenario, probe, watch)?;
        watch.advance(0)?;
        Ok(run)
    }

    /// Returns the choice with a step that is small enough for every member of an ensemble.
    pub(super) fn every_member(
        &self,
        entry: &Entry,
        mut choice: Choice,
        watch: &Watch,
    ) -> Result<Choice, Unmet> {
        let members = self.members();
        let left_ns = watch.left_ns();
        let until_s = choice.seen_s;
        let far = Some(self.far.clone());
        let mut all = vec![Seen { reference: far, is_sure: true, step_s: choice.step_s }];
        loop {
            let is_new = (all.len() as u64) < members;
            let member = if is_new {
                let member = all.len() as u64;
                let needed = needed(self.asked);
                let reference = self.far.of_member(self.scenario, member, needed, watch)?;
                all.push(Seen { reference, is_sure: false, step_s: 0.0 });
                member
            } else {
                // A smaller step usually has the smaller error, but one before may have been small
                // by luck.
                match all.iter().position(|seen| seen.step_s != choice.step_s) {
                    Some(member) => member as u64,
                    None => return Ok(choice),
                }
            };
            let seen = &mut all[member as usize];
            choice = self.of_member(entry, choice, member, seen, watch)?;
            choice = match self.follow(entry, choice, until_s, Some(member), watch) {
                Ok(Followed::Reached(of_this)) => Choice {
                    expected: choice.expected.max(of_this.expected),
                    cost_ns: choice.cost_ns.max(of_this.cost_ns),
                    ..of_this
                },
                Ok(Followed::Missed(least)) => {
                    return Err(of_member(member, Obstacle::NoMethod { least }));
                }
                Err(Unmet::Obstacle(why)) => return Err(of_member(member, why)),
                Err(unmet) => return Err(unmet),
            };
            seen.step_s = choice.step_s;
            if is_new && member == 1 {
                let cost_ns = (left_ns - watch.left_ns()).max(1);
                let most = 2 + watch.left_ns() / cost_ns;
                if members > most {
                    return Err(Unmet::Obstacle(Obstacle::TooManyMembers { members, most }));
                }
            }
        }
    }

    /// Returns the choice with a step that is small enough for a member, too.
    fn of_member(
        &self,
        entry: &Entry,
        mut choice: Choice,
        member: u64,
        Seen { reference, is_sure, .. }: &mut Seen,
        watch: &Watch,
    ) -> Result<Choice, Unmet> {
        let obstacle = |why| of_member(member, why);
        let out_of_sight = |error: StudyError| match error {
            StudyError::Reference(error) => obstacle(error.into()),
            error => error.into(),
        };
        let time_s = self.far.time_s;
        for _ in 0..MEMBER_TRIES {
            let steps = self.steps(choice.step_s, time_s);
            let run = self.run(entry, time_s, steps, member, watch)?;
            let expected = reference.as_ref().filter(|_| run.completed());
            let expected = expected.and_then(|reference| self.expected(reference, &run));
            if let Some(expected) = expected.filter(|&expected| expected <= self.goal()) {
                let cost_ns = choice.cost_ns.max(run.cost_ns / time_s);
                return Ok(Choice { expected: choice.expected.max(expected), cost_ns, ..choice });
            }
            if !*is_sure {
                // Is it the step that is too large, or the reference that is not known?
                let needed = needed(self.asked);
                let known =
                    Reference::of(self.scenario, member, time_s, needed, &self.scales, watch);
                *reference = Some(known.map_err(out_of_sight)?);
                *is_sure = true;
                continue;
            }
            let order = f64::from(entry.order);
            let ratio =
                expected.map_or(2.0, |expected| libm::pow(expected / self.goal(), 1.0 / order));
            choice.step_s = time_s / steps as f64 / (1.03 * ratio).clamp(1.03, 4.0);
        }
        Err(obstacle(Obstacle::NoMethod { least: None }))
    }

    /// Returns the error expected at the end of the run; `None` where errors grow too fast to be
    /// extrapolated.
    fn expected(&self, reference: &Reference, run: &Measured) -> Option<f64> {
        let errors: Vec<f64> = run
            .points
            .iter()
            .enumerate()
            .map(|(quarter, point)| reference.distance_at(quarter, point))
            .collect();
        self.carried_on(&errors, reference.error, reference.time_s)
    }

    /// Extrapolates the errors at the quarters of a time, known to `known`, to the end of the run.
    fn carried_on(&self, errors: &[f64], known: f64, time_s: f64) -> Option<f64> {
        let largest = |errors: &[f64]| errors.iter().copied().fold(0.0, f64::max);
        // Not the last alone: an error that swings may pass through zero there. Nor is more known
        // than by the reference.
        let late = largest(&errors[errors.len() / 2..]) + known;
        if self.duration_s <= time_s {
            return Some(late);
        }
        let early = largest(&errors[..errors.len() / 2 + 1]).max(known).max(ROUND_OFF);
        let growth = libm::log2(late / early).max(1.0);
        let ratio = self.duration_s / time_s;
        // For a run that will be seen to its end this is a guess; for any other it has to hold.
        if self.is_whole() {
            return Some(late * libm::pow(ratio, growth.min(FASTEST_GROWTH)));
        }
        (growth <= FASTEST_GROWTH).then(|| late * libm::pow(ratio, growth + DOUBT))
    }
}
