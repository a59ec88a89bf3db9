//! The solver for what is solved by sweeps: repeats a sweep until its increments are round-off, turns to Newton's method where sweeps
//! converge slowly or not at all, or reports why there is no solution.
//!
//! # When it stops
//!
//! `change_k` is the increment of sweep `k`, relative to the size of the unknowns; `q` the contraction, the worse of
//! `change_k / change_(k-1)` and the one before. The first line that holds decides.
//!
//! | after sweep k | what it means | result |
//! |---|---|---|
//! | `change_k` is not finite | overflow | [`FailureCode::NonFinite`] |
//! | `change_k <= tolerance` | solved | converged |
//! | `q <= FAST` and `q change_k <= EARLY tolerance` | the next sweep would change nothing that counts | converged, if the rule allows it ([`StopRule::stop_early`]) |
//! | `change_k` grew once, and `change_k <= ROUND_OFF` | the last digit | converged |
//! | `change_k` grew twice in a row, and `change_k <= ROUND_OFF_FLOOR` | the last digits | converged |
//! | no new smallest increment for `CYCLE` sweeps, `change_k <= ROUND_OFF_FLOOR` | a limit cycle of rounding | converged |
//! | grew `PATIENCE` times in a row, `change_k <= 1000 ROUND_OFF_FLOOR` | rounding of large intermediate values | [`FailureCode::Stalled`] |
//! | grew `PATIENCE` times in a row | sweeps diverge | [`FailureCode::Diverged`] |
//! | `k = TRIAL`, and `change_k > SLOW change_(k - TRIAL_SPAN)` | sweeps converge slowly | Newton's method, if the rule allows it |
//! | `k = max_iterations` | sweeps run out | [`FailureCode::MaxIterations`] |
//!
//! Newton's method has the same first two lines and the last, at a tolerance of at least 1e-15; a correction that does not
//! reduce the residual is halved up to `HALVINGS` times, and then it has diverged. A failure of the method that was turned to
//! is reported as the failure of the sweeps before, which explains more.
//!
//! Invariant: an iteration ends at its tolerance, at the round-off floor, or with a [`Failure`]; it never
//! runs out silently. Every decision depends on computed floats alone, so it repeats to the bit.

use super::failure::{Failure, FailureCode};
use super::lanes::Real;

mod newton;
mod step_history;

use newton::Newton;
pub use step_history::{Continued, Extrapolation, StepHistory};

/// Conditions under which an iteration has converged or failed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopRule {
    /// The increment (relative to the size of the unknowns) at which the iteration has converged.
    pub tolerance: f64,
    /// Sweeps, or corrections of Newton's method, after which it has failed.
    pub max_iterations: u32,
    /// Rungs that may be tried.
    pub rungs: Rungs,
    /// Stop when the predicted next increment is below tolerance / 100; the omitted part has a constant sign and
    /// drifts.
    pub stop_early: bool,
}

impl StopRule {
    /// Makes a rule that goes to round-off go to the last digit that sweeps find: the error left at
    /// its tolerance is biased, and would add up to a line. A rule with a tolerance of its own
    /// stays as it is.
    pub fn to_the_floor(self) -> Self {
        let round_off = Self::default().tolerance;
        if self.tolerance > round_off {
            self
        } else {
            Self { tolerance: 0.0, stop_early: false, ..self }
        }
    }
}

impl StopRule {
    /// The tolerance, zero if it is that of rounding.
    pub(crate) fn looser_than_rounding(&self) -> f64 {
        if self.tolerance > Self::default().tolerance { self.tolerance } else { 0.0 }
    }

    /// May another iteration be tried before the sweeps? Not where Newton's method is asked for, or few sweeps.
    pub(crate) fn allows_another(&self) -> bool {
        self.rungs != Rungs::Newton && self.max_iterations >= Self::default().max_iterations
    }
}

/// The rungs of the solver that may be tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rungs {
    /// Sweeps, and Newton's method where they converge slowly or not at all.
    Both,
    /// Sweeps alone.
    FixedPoint,
    /// Newton's method alone.
    Newton,
}

impl Default for StopRule {
    /// Returns the rule that goes to round-off.
    fn default() -> Self {
        Self { tolerance: 1e-15, max_iterations: 100, rungs: Rungs::Both, stop_early: true }
    }
}

/// A few units in the last place of the largest unknown.
const ROUND_OFF: f64 = 4e-15;
/// Below this an increment that no longer falls is round-off.
pub(crate) const ROUND_OFF_FLOOR: f64 = 1e-12;
/// A contraction that persists.
const FAST: f64 = 0.1;
/// Fraction of the tolerance below which a predicted increment is not computed: the omitted part has a constant sign,
/// and a tenth of the tolerance at each step shows as a drift of the energy.
const EARLY: f64 = 1e-2;
/// Number of sweeps after which convergence is judged, and number of latest sweeps over which ...
const TRIAL: u32 = 16;
const TRIAL_SPAN: usize = 4;
/// ... the increment must have fallen to this part. Slower than that, Newton's method is faster.
const SLOW: f64 = 0.1;
/// This many sweeps near round-off without a new smallest increment are a limit cycle: rounding alone can
/// carry the unknowns round a few neighbouring numbers, the increment falling and rising by turns.
const CYCLE: u32 = 6;
/// This many sweeps in a row without progress are divergence, not a transient.
const PATIENCE: u32 = 3;

/// Smallest size whose last digit is a normal number: what is smaller, numbers do not hold to their full precision.
pub(crate) const SMALLEST_SIZE: f64 = f64::MIN_POSITIVE / f64::EPSILON;

/// Returns a change in parts of a size, at least of the smallest: at rest zero of zero is no change.
pub(crate) fn relative(change: f64, size: f64) -> f64 {
    change / size.max_or_nan(SMALLEST_SIZE)
}

/// Rung of the solver that made the step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rung {
    /// Fixed-point sweeps.
    FixedPoint,
    /// Newton's method.
    Newton,
    /// Nothing to solve: an explicit scheme.
    Explicit,
}

impl Rung {
    /// All rungs.
    pub const ALL: [Self; 3] = [Self::FixedPoint, Self::Newton, Self::Explicit];

    /// The rung's name in logs and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::FixedPoint => "fixed_point",
            Self::Newton => "newton",
            Self::Explicit => "explicit",
        }
    }
}

/// Result of a solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Convergence {
    /// Sweeps made; corrections of Newton's method, each of several sweeps.
    pub iterations: u32,
    /// The last increment, relative to the size of the unknowns.
    pub increment: f64,
    /// The rung that solved the step.
    pub rung: Rung,
}

impl Convergence {
    /// Result of a step without equations to solve.
    pub const EXPLICIT: Self = Self { iterations: 1, increment: 0.0, rung: Rung::Explicit };
}

/// The equations of a step, as a sweep over their unknowns.
pub trait Equations {
    /// Sets the unknowns to their first guess, a function of the state alone.
    ///
    /// # Errors
    /// Fails if there is none.
    fn guess(&mut self) -> Result<(), Failure>;

    /// Updates unknowns that one sweep determines, before Newton's method: their residuals from the guess would
    /// dominate the others.
    ///
    /// # Errors
    /// Fails where the unknowns make no sense.
    fn prime(&mut self) -> Result<(), Failure> {
        Ok(())
    }

    /// Improves the unknowns in place; returns the size of its change, relative to theirs. The new
    /// unknowns depend on the old ones alone.
    ///
    /// # Errors
    /// Fails where they make no sense.
    fn sweep(&mut self) -> Result<f64, Failure>;

    /// Appends the unknowns, in units that make them about one in size: all from which a sweep begins, and all
    /// against which its change is measured.
    fn unknowns(&self, values: &mut Vec<f64>);

    /// Sets the unknowns, in the order and the units of [`Equations::unknowns`].
    fn set(&mut self, values: &[f64]);

    /// The size of an increment that rounding alone may make.
    fn floor(&self) -> f64 {
        ROUND_OFF_FLOOR
    }
}

/// A solver and its workspace.
#[derive(Clone, Debug)]
pub struct Solver {
    rule: StopRule,
    newton: Newton,
}

impl Solver {
    /// Creates a solver that follows `rule`.
    pub fn new(rule: StopRule) -> Self {
        Self { rule, newton: Newton::default() }
    }

    /// The rule that it follows.
    pub fn rule(&self) -> StopRule {
        self.rule
    }

    /// Returns the same solver by sweeps alone.
    pub fn by_sweeps(&self) -> Self {
        Self::new(StopRule { rungs: Rungs::FixedPoint, ..self.rule })
    }

    /// Solves `equations` from their first guess: by sweeps, and by Newton's method where they contract too
    /// slowly or not at all; or by the rung that the rule names.
    ///
    /// # Errors
    /// Those of the equations, and [`FailureCode::MaxIterations`], [`FailureCode::Diverged`],
    /// [`FailureCode::Stalled`], [`FailureCode::NonFinite`]; each with the last increments.
    pub fn solve(&mut self, equations: &mut impl Equations) -> Result<Convergence, Failure> {
        self.watched(equations, |_| {})
    }

    /// Solves as [`Solver::solve`] does; `watch` sees the increments of the sweeps.
    fn watched(
        &mut self,
        equations: &mut impl Equations,
        mut watch: impl FnMut(f64),
    ) -> Result<Convergence, Failure> {
        equations.guess()?;
        let sweep = || equations.sweep().inspect(|increment| watch(*increment));
        match self.rule.rungs {
            Rungs::FixedPoint => fixed_point(self.rule, sweep),
            Rungs::Newton => self.newton.solve(self.rule, equations),
            Rungs::Both => match swept(Progress::new(self.rule, true), sweep) {
                Ok(Some(convergence)) => Ok(convergence),
                Err(stopped) if stopped.code == FailureCode::Stopped => Err(stopped),
                // If neither converges, the failure of the sweeps explains more.
                stuck => {
                    // Sweeps that converged, but reached their limit, are near a solution.
                    if let Err(Failure { code: FailureCode::MaxIterations, .. }) = stuck
                        && let Ok(convergence) = self.newton.solve(self.rule, equations)
                    {
                        return Ok(convergence);
                    }
                    // From the guess: the iterate of diverging sweeps is no better.
                    equations.guess()?;
                    let newton = self.newton.solve(self.rule, equations);
                    newton.map_err(|failure| match failure.code {
                        FailureCode::Stopped => failure,
                        _ => stuck.err().unwrap_or(failure),
                    })
                }
            },
        }
    }
}

/// Repeats `sweep`, which improves the unknowns in place and returns the relative size of its change.
///
/// # Errors
/// Those of the sweep, and [`FailureCode::MaxIterations`], [`FailureCode::Diverged`],
/// [`FailureCode::Stalled`], [`FailureCode::NonFinite`]; each with the last increments.
pub fn fixed_point(
    rule: StopRule,
    sweep: impl FnMut() -> Result<f64, Failure>,
) -> Result<Convergence, Failure> {
    swept(Progress::new(rule, false), sweep)
        .map(|solved| solved.expect("a fixed point is not left half-way"))
}

/// [`fixed_point`] from its beginning; `None` where it converges too slowly.
fn swept(
    mut progress: Progress,
    mut sweep: impl FnMut() -> Result<f64, Failure>,
) -> Result<Option<Convergence>, Failure> {
    loop {
        let increment = sweep().map_err(|failure| progress.failure_of(failure))?;
        match progress.judged(increment)? {
            Verdict::Continue => {}
            Verdict::Converged(convergence) => return Ok(Some(convergence)),
            Verdict::SwitchToNewton => return Ok(None),
        }
    }
}

/// Progress of a fixed-point iteration, as its increments show it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Progress {
    rule: StopRule,
    leave: bool,
    history: History,
    iteration: u32,
    grown: u32,
    smallest: f64,
    since_smallest: u32,
    /// Contraction of the steps before, if there were any.
    expected: f64,
}

/// Decision after a sweep.
#[derive(Clone, Copy, Debug)]
pub(super) enum Verdict {
    /// Another sweep.
    Continue,
    /// The equations are solved.
    Converged(Convergence),
    /// Sweeps converge too slowly.
    SwitchToNewton,
}

impl Progress {
    /// Begins an iteration; if `leave`, it is left for Newton's method where that is quicker.
    pub(super) fn new(rule: StopRule, leave: bool) -> Self {
        let (smallest, since_smallest) = (f64::INFINITY, 0);
        Self {
            rule,
            leave,
            history: History::new(),
            iteration: 0,
            grown: 0,
            smallest,
            since_smallest,
            expected: f64::INFINITY,
        }
    }

    /// Begins again, as if new.
    pub(super) fn restart(&mut self) {
        self.history.count = 0;
        (self.iteration, self.grown) = (0, 0);
        (self.smallest, self.since_smallest) = (f64::INFINITY, 0);
    }

    /// A failure of the next sweep, with the figures of the iteration.
    fn failure_of(&self, failure: Failure) -> Failure {
        self.history.of(failure, self.iteration + 1)
    }

    /// Judges the iteration by its newest increment.
    ///
    /// # Errors
    /// Fails if it does not converge.
    #[inline] // A caller would wait for what comes back by way of memory.
    pub(super) fn judged(&mut self, increment: f64) -> Result<Verdict, Failure> {
        let Self { rule, leave, history, iteration, grown, smallest, since_smallest, expected } =
            self;
        let [previous, before] = history.last_two();
        *iteration += 1;
        history.note(increment);
        if !increment.is_finite() {
            return Err(history.failure(FailureCode::NonFinite, f64::MAX));
        }
        *grown = if increment >= previous { *grown + 1 } else { 0 };
        if increment < *smallest {
            (*smallest, *since_smallest) = (increment, 0);
        } else {
            *since_smallest += 1;
        }
        // The error left after this sweep is about the increment times the contraction, the worse
        // of the last two: one may be accidental.
        let contraction =
            if *iteration > 2 { (increment / previous).max(previous / before) } else { *expected };
        let stops_early = rule.stop_early
            && contraction <= FAST
            && increment * contraction <= EARLY * rule.tolerance;
        // One increment that does not fall may be the oscillation of a complex contraction factor; near the
        // round-off of the unknowns it is the end, above it two in a row are.
        let at_floor = (*grown == 1 && increment <= ROUND_OFF)
            || (*grown == 2 && increment <= ROUND_OFF_FLOOR)
            || (*since_smallest >= CYCLE && increment <= ROUND_OFF_FLOOR);
        if increment <= rule.tolerance || stops_early || at_floor {
            let (iterations, rung) = (*iteration, Rung::FixedPoint);
            return Ok(Verdict::Converged(Convergence { iterations, increment, rung }));
        }
        if *grown == PATIENCE {
            // Close to the floor it is round-off of large intermediate values that stops the fall.
            return Err(if increment <= 1e3 * ROUND_OFF_FLOOR {
                history.failure(FailureCode::Stalled, ROUND_OFF_FLOOR)
            } else {
                history.failure(FailureCode::Diverged, previous)
            });
        }
        if *leave && *iteration == TRIAL && increment > SLOW * history.before(TRIAL_SPAN) {
            return Ok(Verdict::SwitchToNewton);
        }
        if *iteration == rule.max_iterations {
            return Err(history.failure(FailureCode::MaxIterations, rule.tolerance));
        }
        Ok(Verdict::Continue)
    }
}

/// The last increments of an iteration.
#[derive(Clone, Copy, Debug)]
struct History {
    ring: [f64; 16],
    count: usize,
}

impl History {
    fn new() -> Self {
        Self { ring: [f64::INFINITY; 16], count: 0 }
    }

    fn note(&mut self, increment: f64) {
        self.ring[self.count % self.ring.len()] = increment;
        self.count += 1;
    }

    /// The increment `back` before the last; infinite before the first.
    fn before(&self, back: usize) -> f64 {
        if back < self.count {
            self.ring[(self.count - 1 - back) % self.ring.len()]
        } else {
            f64::INFINITY
        }
    }

    fn last(&self) -> f64 {
        self.before(0)
    }

    fn last_two(&self) -> [f64; 2] {
        [self.before(0), self.before(1)]
    }

    /// A failure of the iteration itself.
    fn failure(&self, code: FailureCode, limit: f64) -> Failure {
        self.of(Failure::new(code, None, self.last(), limit), self.count as u32)
    }

    /// A failure with the figures of the iteration.
    fn of(&self, failure: Failure, iterations: u32) -> Failure {
        let kept = self.count.min(self.ring.len());
        let increments = (0..kept).rev().map(|back| self.before(back));
        Failure {
            iterations,
            increments: increments.filter(|x| x.is_finite()).collect(),
            ..failure
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_cycle_at_round_off_is_convergence() {
        let cycle = [4.96e-15, 2.49e-15, 2.46e-15];
        let mut increments = [1e-3, 1e-7, 1e-11].into_iter().chain(cycle.into_iter().cycle());
        let solved = fixed_point(StopRule::default(), || Ok(increments.next().expect("endless")));
        assert!(solved.is_ok_and(|solved| solved.iterations <= 15));
        // Above the floor it is not.
        let mut increments = cycle.into_iter().cycle().map(|increment| increment * 1e6);
        let failed = fixed_point(StopRule::default(), || Ok(increments.next().expect("endless")));
        assert_eq!(failed.map_err(|failure| failure.code), Err(FailureCode::MaxIterations));
    }
}
