//! When the collocation of a VPD step in matrices and in vectors stops: its tuned constants, each with what it moves, the
//! convergence of an iteration, and how a solve ends.

use crate::failure::Failure;
use crate::hamiltonian::CLOSEST_APPROACH;

// How far an iteration goes.

/// Iterations of any kind after which a step is left to [`super`].
pub(super) const MOST_ITERATIONS: u32 = 40;
/// Error of a momentum left at the end of a step, relative to the largest momentum.
pub(super) const ROUND_OFF: f64 = 1e-16;
/// Fraction of [`ROUND_OFF`] allowed when early stopping is off. About an axis with a small moment of
/// inertia an error of the momentum turns the body farther than the turn of the step says: with
/// moments of 0.01 and 1 a tenth of it still shows as a drift of the energy over a million steps,
/// this fraction does not.
pub(super) const LAST_DIGIT: f64 = 0.03;
/// Fraction of it that the last inner passes may leave, and all of a step that is extrapolated from the last nine: the
/// error left has the same sign step after step, and over a million steps it has to stay below a random
/// walk of roundings. With a hundredth a drift of the energy shows.
pub(super) const SAME_SIGN: f64 = 3e-3;
/// Change by an inner pass, in units of [`ROUND_OFF`] of the momentum, that is rounding.
pub(super) const ROUNDING_CHANGE: f64 = 3.0;
/// Below this part of the momentum a change that no longer falls is rounding.
const FLOOR: f64 = 1e-14;
/// Least turn in rad by which errors are divided.
pub(super) const LEAST_TURN_RAD: f64 = 1e-3;
/// Error left in a collocation in vectors that is still to be improved, relative to the momentum.
pub(super) const COLLOCATION_ROUND_OFF: f64 = 1e-15;

// How the work is divided, in matrices.

/// Passes over attitudes and momenta for each torque, for a system in a time of its own.
pub(super) const PASSES_PER_TORQUE: usize = 2;
/// Usual number of inner passes in a sweep; each further pass counts as a sweep.
pub(super) const USUAL_PASSES: u32 = 8;
/// Number of steps that are remembered: with fewer the polynomial through them misses more, with
/// more it multiplies their rounding errors.
pub(super) const REMEMBERED_STEPS: usize = 9;
/// Angle in rad of a step up to which it may be guessed from the one before.
pub(super) const MODEST_TURN_RAD: f64 = 0.5;
/// Cost of a sweep over all unknowns, in sweeps of the collocation; the former run where the latter does not converge.
pub(super) const COST_OF_A_SWEEP: u32 = 4;

// The same in vectors.

/// Inner passes between two torques.
pub(super) const PASSES_BETWEEN_TORQUES: u32 = 2;
/// Inner passes after an evaluation of the defect.
pub(super) const PASSES_PER_DEFECT: u32 = 4;
/// Contraction of an error by new torques, assumed until it is measured.
pub(super) const TORQUE_CONTRACTION: f64 = 0.02;
/// Number of torques, or evaluations, after which a step that does not converge is abandoned.
pub(super) const PATIENCE: u32 = 6;
/// Least fraction of sigma^-2 that a diverging step may leave.
pub(super) const LEAST_SCALE: f64 = 0.25;
/// Largest stretch `|P - I|` of a stage whose square is round-off: the errors of f and its multiplier due to
/// collocation and to P = I are as small as that, and enter delta times K, which is, too.
pub(super) const SMALL_STRETCH: f64 = 1e-8;

// What is accepted without the full checks.

/// `n max |F|`, in vectors `n max |E|`, up to which no singular value of an interpolated matrix is
/// below two thirds, in vectors one half.
pub(super) const MODEST_STRETCH: f64 = 0.5;
/// `|U - I|_F^2` up to which no two attitudes are a quarter turn apart: at a quarter turn
/// `|U - V|_F^2 = 2 n - 2 tr(U^T V)` is 4.
pub(super) const MODEST_TURN_SQUARE: f64 = 1.0;
/// Largest deviation from a rotation allowed for f of a solved step.
pub(super) const MOST_OFF_THE_GROUP: f64 = 1e-9;
/// Minus the square of the relative distance to a point of the potential that is near.
pub(super) const FAR_ENOUGH: f64 = -CLOSEST_APPROACH * CLOSEST_APPROACH;

/// Why a step is not solved here.
pub(super) enum SolveError {
    /// The iteration does not converge.
    NotConverged,
    /// The work was stopped.
    Cancelled(Failure),
}

impl From<Failure> for SolveError {
    fn from(failure: Failure) -> Self {
        Self::Cancelled(failure)
    }
}

/// Measures of a solution: the largest entry of any F, in vectors of any E, and the largest square
/// of |C|.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solved {
    pub(super) sweeps: u32,
    /// The length of the step.
    pub(super) h: f64,
    /// The last change of a momentum, relative to the largest.
    pub(super) increment: f64,
    /// The largest entry of any F, in vectors of any E.
    pub(super) stretch: f64,
    /// The largest `|C|_F^2`.
    pub(super) change_square: f64,
    /// Nearness as returned by [`crate::hamiltonian::RigidBody::torque`].
    pub(super) proximity: f64,
}

/// Convergence of an iteration: of sweeps, inner passes or defect evaluations.
#[derive(Debug)]
pub(super) struct Contraction {
    /// Contraction of an error by an iteration, assumed until it is measured.
    expected: f64,
    /// Last change, at first that before the first iteration; a change much smaller than expected says nothing
    /// of the next.
    last: f64,
    first: bool,
}

impl Contraction {
    pub(super) fn new(expected: f64, before: f64) -> Self {
        Self { expected, last: before, first: true }
    }

    /// Returns whether `change` no longer falls because it is rounding of momenta of this size.
    pub(super) fn at_floor(&self, change: f64, size: f64) -> bool {
        !self.first && change >= self.last && change <= FLOOR * size
    }

    /// Returns the error left after an iteration whose change was `change`.
    pub(super) fn left(&mut self, change: f64) -> f64 {
        let change = change.max(0.3 * self.expected * self.last);
        let contraction =
            if self.first { self.expected } else { (change / self.last).clamp(0.0, 1.0) };
        (self.last, self.first) = (change, false);
        // No change leaves no error.
        if change > 0.0 { change * contraction } else { change }
    }
}
