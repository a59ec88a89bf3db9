//! The one nonlinear solver: repeats a sweep until its increments are round-off, or says why not.
//!
//! Invariant: an iteration ends at its tolerance, at the round-off floor, or with a [`Failure`]; it never
//! runs out silently. Every decision depends on computed floats alone, so it repeats to the bit.

use super::failure::{Failure, FailureCode};

/// When an iteration has converged and when it is given up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopRule {
    /// The increment (relative to the size of the unknowns) at which the iteration has converged.
    pub tolerance: f64,
    /// Sweeps after which it is given up.
    pub max_iterations: u32,
}

impl Default for StopRule {
    /// To round-off.
    fn default() -> Self {
        Self { tolerance: 1e-15, max_iterations: 100 }
    }
}

/// A few units in the last place of the largest unknown.
const ROUND_OFF: f64 = 4e-15;
/// Below this an increment that no longer falls is round-off.
const ROUND_OFF_FLOOR: f64 = 1e-12;
/// A contraction that can be relied upon to go on.
const FAST: f64 = 0.1;
/// So many sweeps near round-off without a new smallest increment are a limit cycle: rounding alone can
/// carry the unknowns round a few neighbouring numbers, the increment falling and rising by turns.
const CYCLE: u32 = 6;
/// So many sweeps in a row without progress are divergence, not a transient.
const PATIENCE: u32 = 3;

/// Which rung of the solver made the step.
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
    /// The rung's name in logs and answers.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::FixedPoint => "fixed_point",
            Self::Newton => "newton",
            Self::Explicit => "explicit",
        }
    }
}

/// How a solve ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Convergence {
    /// Sweeps made.
    pub iterations: u32,
    /// The last increment, relative to the size of the unknowns.
    pub increment: f64,
    /// The rung that solved the step.
    pub rung: Rung,
}

impl Convergence {
    /// What a step without equations to solve reports.
    pub const EXPLICIT: Self = Self { iterations: 1, increment: 0.0, rung: Rung::Explicit };
}

/// Repeats `sweep`, which improves the unknowns in place and returns the relative size of its change.
///
/// # Errors
/// Those of the sweep, and [`FailureCode::MaxIterations`], [`FailureCode::Diverged`],
/// [`FailureCode::Stalled`], [`FailureCode::NonFinite`]; each with the last increments.
pub fn fixed_point(
    rule: StopRule,
    mut sweep: impl FnMut() -> Result<f64, Failure>,
) -> Result<Convergence, Failure> {
    // Ring of the last increments: a failure reports them, convergence needs two.
    let mut recent = [f64::INFINITY; 16];
    let mut grown = 0;
    let (mut smallest, mut since_smallest) = (f64::INFINITY, 0);
    for iteration in 1..=rule.max_iterations {
        let slot = iteration as usize % recent.len();
        let previous = recent[(iteration as usize + recent.len() - 1) % recent.len()];
        let increment = match sweep() {
            Ok(increment) => increment,
            Err(failure) => return Err(with_history(failure, iteration, &recent, slot)),
        };
        recent[slot] = increment;
        let give_up = |code, limit| {
            let failure = Failure::new(code, None, increment, limit);
            Err(with_history(failure, iteration, &recent, (slot + 1) % recent.len()))
        };
        if !increment.is_finite() {
            return give_up(FailureCode::NonFinite, f64::MAX);
        }
        grown = if increment >= previous { grown + 1 } else { 0 };
        if increment < smallest {
            (smallest, since_smallest) = (increment, 0);
        } else {
            since_smallest += 1;
        }
        // One increment that does not fall may be the wobble of a complex contraction factor; near the
        // round-off of the unknowns it is the end, above it two in a row are.
        // What is left after this sweep is about the increment times the contraction. Of the last two the worse:
        // one may be luck.
        let contraction = (increment / previous).max(previous / recent[(slot + 14) % recent.len()]);
        let foreseen = iteration > 2
            && contraction <= FAST
            && increment * contraction <= 1e-2 * rule.tolerance;
        let at_floor = (grown == 1 && increment <= ROUND_OFF)
            || (grown == 2 && increment <= ROUND_OFF_FLOOR)
            || (since_smallest >= CYCLE && increment <= ROUND_OFF_FLOOR);
        if increment <= rule.tolerance || foreseen || at_floor {
            return Ok(Convergence { iterations: iteration, increment, rung: Rung::FixedPoint });
        }
        if grown == PATIENCE {
            // Close to the floor it is round-off of large intermediate values that stops the fall.
            return if increment <= 1e3 * ROUND_OFF_FLOOR {
                give_up(FailureCode::Stalled, ROUND_OFF_FLOOR)
            } else {
                give_up(FailureCode::Diverged, previous)
            };
        }
        if iteration == rule.max_iterations {
            return give_up(FailureCode::MaxIterations, rule.tolerance);
        }
    }
    Err(Failure::new(FailureCode::MaxIterations, None, f64::INFINITY, rule.tolerance))
}

/// Adds the solver's figures to a failure; `oldest` is the slot of the ring where the history begins.
fn with_history(mut failure: Failure, iterations: u32, ring: &[f64; 16], oldest: usize) -> Failure {
    failure.iterations = iterations;
    failure.increments = (0..ring.len())
        .map(|k| ring[(oldest + k) % ring.len()])
        .filter(|increment| increment.is_finite())
        .collect();
    failure
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
