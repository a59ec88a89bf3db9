//! The step to try after a failure: tried here first, not guessed.
//!
//! Steps are halved until one carries the run, and then taken longer again as far as they still do: what failed and what
//! did not are brought to within a fifth of each other. A try begins where the run began, for the state that it failed at may
//! have gone astray long before.
//!
//! Invariant: an advised step was tried, and carried as much of the run as is said; the scenario is accepted with it as it
//! is; the work is bounded, counted and not timed, and ends when the run is cancelled.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::Control;
use super::summary::{self, Advised, Diagnosis, Tried};
use crate::plan::{NEAR_SIGMA, Plan};
use crate::scenario::{SMALLEST_STEP_S, Scenario, dividing};
use crate::solve::control::ControlState;
use crate::solve::failure::{Failure, FailureCode, two_digits};
use crate::solve::hamiltonian::{RigidBody, TimeScale};
use crate::solve::nonlinear::StopRule;
use crate::solve::so;
use crate::solve::state::{Checkpoint, Pace, State};
use crate::solve::stepper::vpd_adaptive::VpdAdaptive;
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::system::System;
use crate::solve::tableau::Tableau;
use crate::solve::trajectory::Schedule;
use crate::solve::work::Work;

/// Work of a search in nanoseconds, by the plan's figures: this many runs like the one that failed, but at least
/// `LEAST_NS` and at most `MOST_NS`.
const RUNS: f64 = 100.0;
const LEAST_NS: f64 = 6e8;
const MOST_NS: f64 = 2e9;
/// Steps that failed and steps that did not are brought as near as this.
const NEAR: f64 = 1.2;
/// Part of the search that one try may take: there are some that fail, one that does not, and a few
/// between.
const SHARE: f64 = 1.0 / 8.0;
/// Number of stages for adaptive steps.
const OWN_STAGES: usize = 2;
/// Number of sweeps assumed for a step: most take fewer.
const SWEEPS: f64 = 8.0;
/// Number of times that the energy is checked in a try.
const LOOKS: u64 = 2000;
/// Largest error of the energy, as a part of what moves: half of what is warned of, because the
/// checks are few.
const LOST: f64 = 0.5 * summary::MEANINGLESS;

/// Limits of the work of a search, and its way to be stopped.
#[derive(Clone, Debug)]
pub(super) struct Patience {
    pub(super) most_sweeps: u64,
    /// The same work in adaptive steps.
    most_own_sweeps: u64,
    pub(super) stop: Arc<AtomicBool>,
}

impl Patience {
    /// Returns the limits for one of `members` members of a run.
    pub(super) fn of(plan: &Plan, control: &Control, members: u64) -> Self {
        let most_ns = (RUNS * plan.work_s * 1e9).clamp(LEAST_NS, MOST_NS);
        let most = |sweep_ns: f64| (most_ns / sweep_ns / members.max(1) as f64) as u64;
        Self {
            most_sweeps: most(plan.sweep_cost_ns()),
            most_own_sweeps: most(plan.own_sweep_cost_ns(OWN_STAGES)),
            stop: control.settling.cancelled.clone(),
        }
    }
}

/// A run of which a step failed.
#[derive(Clone, Copy)]
pub(super) struct Broken<'a, const N: usize> {
    /// State where it began.
    pub(super) initial: &'a State<N>,
    /// State before that step.
    pub(super) reached: &'a Checkpoint<N>,
    pub(super) schedule: Schedule,
    /// Scenario whose `step_s` it is; `None` for adaptive steps.
    pub(super) asked: Option<&'a Scenario>,
    pub(super) failure: &'a Failure,
}

/// Returns an adaptive stepper for `body`, and its longest step in seconds, if it has a point
/// source to which steps could adapt.
pub(super) fn own_steps<const N: usize>(
    plan: &Plan,
    body: &RigidBody<N>,
) -> Option<(Box<dyn Stepper<N>>, f64)> {
    let scale = TimeScale::of(body).filter(|_| plan.own_steps.is_none())?;
    let plain = !body.is_driven() && plan.model.wheels.is_none();
    let own_s = two_digits(plan.easy_own_step_s(OWN_STAGES));
    let tableau = Tableau::gauss(OWN_STAGES).filter(|_| plain)?;
    let stepper = VpdAdaptive::new(tableau, StopRule::default(), scale).with_steps_of(own_s);
    Some((Box::new(stepper), own_s))
}

/// Returns the diagnosis: what failed, and with what smaller step it does not; or with which of
/// `own_steps`.
pub(super) fn diagnosis<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    broken: &Broken<'_, N>,
    own_steps: Option<(Box<dyn Stepper<N>>, f64)>,
    patience: Patience,
) -> Diagnosis {
    let Broken { initial, reached, schedule, failure, .. } = broken;
    let stiffness = stiffness(body, stepper, broken);
    let Patience { most_sweeps, most_own_sweeps, stop } = patience;
    let body = body.clone().with_work(Work::limited(most_sweeps, stop.clone()));
    let start = body.energy(&initial.attitude, &initial.momentum);
    // For adaptive steps, the longest is what may be shorter.
    let longest_s = stepper.own_step_s().map(|longest| *longest);
    let reached_in_longest;
    let searched = match longest_s {
        None => *broken,
        Some(step_s) => {
            let in_longest = |steps: u64| (steps as f64 * schedule.step_s / step_s).floor() as u64;
            let step = in_longest(reached.step);
            reached_in_longest = Checkpoint { step, ..(*reached).clone() };
            let steps = in_longest(schedule.steps).max(1);
            let schedule = Schedule { step_s, steps, every: schedule.every };
            Broken { reached: &reached_in_longest, schedule, asked: None, ..*broken }
        }
    };
    let adapts = longest_s.is_some();
    let start = start.total();
    let mut search =
        Search { body: &body, stepper, broken: &searched, start, adapts, nearest: None };
    let mut advised = search.advised(most_sweeps as f64);
    let mut passed = None;
    if adapts {
        advised = advised.of_own_steps();
    } else if let Some((mut stepper, own_s)) = own_steps {
        let body = body.clone().with_work(Work::limited(most_own_sweeps, stop));
        let stepper = stepper.as_mut();
        let mut search = Search { body: &body, stepper, broken, start, adapts, nearest: None };
        let tried = search.passes(own_s, most_own_sweeps as f64);
        passed = tried.map(|tried| (own_s, tried));
    }
    let diagnosis = summary::diagnosis(failure, stiffness, reached.step, schedule.step_s, advised);
    match passed {
        Some((own_s, tried)) => diagnosis.with_own_steps(own_s, tried),
        None => diagnosis,
    }
}

/// Returns the fastest frequency of the potential where the run began or failed, if that is what
/// asks for a smaller step and not how fast the body turns.
fn stiffness<const N: usize>(
    body: &RigidBody<N>,
    stepper: &dyn Stepper<N>,
    broken: &Broken<'_, N>,
) -> Option<f64> {
    /// A step of less than this part of a radian is short for any frequency.
    const SHORT_RAD: f64 = 0.5;
    let &Broken { initial, reached, schedule, .. } = broken;
    // Of a body under control, with the wheels and the command of that time.
    let acting = stepper.acting().unwrap_or(body);
    let failed_s = reached.step as f64 * schedule.step_s;
    let (mut frequency, mut rate) = (0.0_f64, 0.0_f64);
    for (body, time_s, state) in [(body, 0.0, initial), (acting, failed_s, &reached.state())] {
        let State { attitude, momentum } = state;
        frequency = frequency.max(body.fastest_frequency(time_s, attitude));
        if let Some(omega) = body.observed_velocity(time_s, attitude, momentum) {
            rate = rate.max(so::inner(&omega, &omega).sqrt());
        }
    }
    (frequency * schedule.step_s.abs() > SHORT_RAD && frequency > 2.0 * rate).then_some(frequency)
}

/// Outcome of a try.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Went {
    /// To its end, with its energy.
    Well,
    /// Into a failure, or astray.
    Badly,
    /// Nowhere: the work is done, or it was cancelled.
    Out,
}

/// Where a try begins.
struct Origin<'a, const N: usize> {
    state: &'a State<N>,
    time_s: f64,
    /// What the controller knows there; at the start of a run it knows nothing.
    control: Option<&'a ControlState>,
}

impl<'a, const N: usize> Origin<'a, N> {
    fn start(state: &'a State<N>) -> Self {
        Self { state, time_s: 0.0, control: None }
    }
}

/// A search for a step.
struct Search<'a, const N: usize> {
    body: &'a RigidBody<N>,
    stepper: &'a mut dyn Stepper<N>,
    broken: &'a Broken<'a, N>,
    /// The energy at the start.
    start: f64,
    /// Whether its steps adapt, so that the longest of them is what is tried.
    adapts: bool,
    /// Shortest adaptive step that was seen.
    nearest: Option<Pace>,
}

impl<const N: usize> Search<'_, N> {
    fn advised(&mut self, most_sweeps: f64) -> Advised {
        let Schedule { step_s: asked, steps, .. } = self.broken.schedule;
        let most_steps = (most_sweeps * SHARE / SWEEPS).floor().max(1.0);
        let (mut failed, mut step_s) = (asked, self.short(0.5 * asked));
        let mut found = loop {
            if step_s < SMALLEST_STEP_S {
                return Advised::NoneWorks;
            }
            let span = Span::of(steps as f64 * asked / step_s, most_steps);
            match self.went(step_s, span) {
                Went::Well => break (step_s, span.tried(step_s)),
                Went::Badly => (failed, step_s) = (step_s, self.short(0.5 * step_s)),
                Went::Out => return Advised::NotFound { tried_s: failed },
            }
        };
        while failed > NEAR * found.0 {
            let between = self.short((failed * found.0).sqrt());
            let span = Span::of(steps as f64 * asked / between, most_steps);
            if between <= found.0 || between >= failed {
                break;
            }
            match self.went(between, span) {
                Went::Well => found = (between, span.tried(between)),
                Went::Badly => failed = between,
                Went::Out => break,
            }
        }
        Advised::Step { step_s: found.0, tried: found.1 }
    }

    /// Returns about this step or a little less, in few digits, with which the scenario is accepted
    /// as it is.
    fn short(&self, step_s: f64) -> f64 {
        let &Broken { schedule, asked, .. } = self.broken;
        let Some(asked) = asked else { return two_digits(step_s) };
        let of_few_digits =
            (0..20).map(|percent| two_digits(step_s * (1.0 - 0.01 * f64::from(percent))));
        let times_s = [asked.log.every_s, asked.duration_s].into_iter().flatten();
        let mut less = of_few_digits.chain(times_s.map(|time_s| dividing(time_s, step_s)));
        // A part of the step that failed always fits.
        let part = schedule.step_s / (schedule.step_s / step_s).ceil();
        less.find(|&less| asked.fits(less)).unwrap_or(part)
    }

    /// Returns how far adaptive steps were tried, if they carry the run past a point source and, if
    /// the run may be tried no further, past the place of the failure.
    fn passes(&mut self, own_s: f64, most_sweeps: f64) -> Option<Tried> {
        let &Broken { initial, reached, schedule, failure, .. } = self.broken;
        let Schedule { step_s, steps, .. } = schedule;
        let most = (most_sweeps * SHARE / SWEEPS * own_s / step_s).ceil();
        let span = Span::of(steps as f64, most.max((reached.step + 2) as f64));
        let went = self.travels(&Origin::start(initial), step_s, span.steps);
        let is_near = self.nearest.is_some_and(|pace| pace.least_sigma <= NEAR_SIGMA)
            || failure.code == FailureCode::PotentialSingularity;
        (went == Went::Well && is_near).then(|| span.tried(step_s))
    }

    /// Tries a step from the start and, where the place of the failure is too far from there, from just before it too, if
    /// the run had come there with its energy.
    fn went(&mut self, step_s: f64, span: Span) -> Went {
        let Broken { initial, reached, schedule, .. } = self.broken;
        let count = |steps: u64| (steps as f64 * schedule.step_s / step_s).ceil() as u64;
        let left = schedule.steps - reached.step;
        let past = count(left.min(2));
        let went = self.travels(&Origin::start(initial), step_s, span.steps);
        if went != Went::Well || span.is_whole || count(reached.step) + past <= span.steps {
            return went;
        }
        let last = reached.state();
        let energy = self.body.energy(&last.attitude, &last.momentum);
        if !self.body.is_driven() && (energy.total() - self.start).abs() > LOST * energy.kinetic {
            return went;
        }
        // A try that does not come past the place shows nothing.
        if past > span.steps {
            return Went::Out;
        }
        let time_s = reached.step as f64 * schedule.step_s;
        let origin = Origin { state: &last, time_s, control: reached.control.as_ref() };
        self.travels(&origin, step_s, count(left).min(span.steps))
    }

    /// Makes `steps` steps from an origin.
    fn travels(&mut self, origin: &Origin<'_, N>, step_s: f64, steps: u64) -> Went {
        /// The round-off of the potential is no loss.
        const ROUND_OFF: f64 = 1e-9;
        /// A loss of this many times what may be lost ends a try at once.
        const GONE: f64 = 4.0;
        let Self { body, stepper, start, adapts, nearest, .. } = self;
        let &Origin { state: from, time_s: from_s, control } = origin;
        let every = steps.div_ceil(LOOKS);
        let (mut kinetic, mut off) = (0.0_f64, 0.0_f64);
        stepper.start(from);
        if let Some(control) = control {
            stepper.set_control(control);
        }
        let mut knots = Knots::default();
        if let Some(own_s) = stepper.own_step_s().filter(|_| *adapts) {
            *own_s = step_s;
        }
        // A driven body gains and loses energy on the way, which is counted from here.
        let begun = if body.is_driven() {
            let body = stepper.acting().unwrap_or(body);
            body.energy_at(from_s, &from.attitude, &from.momentum).total()
        } else {
            *start
        };
        for step in 1..=steps {
            let time_s = |steps: u64| from_s + steps as f64 * step_s;
            let looked_at = step % every == 0 || step == steps;
            let mut made = knots.step(*body, *stepper, time_s(step - 1), step_s).map(drop);
            if looked_at {
                made = made.and_then(|()| stepper.synchronise(body, step_s).map(drop));
            }
            match made {
                Ok(()) => {}
                Err(Failure { code: FailureCode::Stopped, .. }) => return Went::Out,
                Err(_) => return Went::Badly,
            }
            if looked_at {
                if let Some(pace) = stepper.pace()
                    && nearest.is_none_or(|nearest| pace.least_sigma < nearest.least_sigma)
                {
                    *nearest = Some(pace);
                }
                let attitude = stepper.attitude().unwrap_or(from.attitude);
                let body = stepper.acting().unwrap_or(body);
                let energy = body.energy_at(time_s(step), &attitude, &stepper.momentum());
                kinetic = kinetic.max(energy.kinetic);
                off = off.max((energy.total() - begun - stepper.work()).abs());
                // No energy: infinite, or not a number; or so much lost that no more will move to
                // outweigh it.
                let is_gone = off > GONE * LOST * kinetic && off > ROUND_OFF * begun.abs();
                if !energy.total().is_finite() || is_gone {
                    return Went::Badly;
                }
            }
        }
        let lost = off > LOST * kinetic && off > ROUND_OFF * begun.abs();
        if lost { Went::Badly } else { Went::Well }
    }
}

/// Length of a try.
#[derive(Clone, Copy, Debug)]
struct Span {
    steps: u64,
    /// Whether that is the whole run.
    is_whole: bool,
}

impl Span {
    fn of(asked: f64, most: f64) -> Self {
        Self { steps: asked.ceil().min(most).max(1.0) as u64, is_whole: asked.ceil() <= most }
    }

    fn tried(self, step_s: f64) -> Tried {
        if self.is_whole {
            Tried::Throughout
        } else {
            Tried::For { time_s: self.steps as f64 * step_s }
        }
    }
}
