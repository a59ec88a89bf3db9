//! Failures of a step, by name.
//!
//! Invariant: the only numerical failures of the program; each carries the code that users match on, the
//! quantity that was measured and its limit. Codes are fixed: files and scripts rely on them.

use std::fmt;

/// The fixed vocabulary of numerical failures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureCode {
    /// The iteration cap was reached while the increment still fell.
    MaxIterations,
    /// The increments of the iteration grow.
    Diverged,
    /// The increments stopped falling far above round-off.
    Stalled,
    /// The equations of the step are solved, but not by the solution that smaller steps lead to.
    SecondRoot,
    /// A stage's interpolated matrix is singular or orientation-reversing: it has no polar factor in SO(n).
    LeftGlPlus,
    /// A stage's interpolated matrix is too close to a singular one.
    IllConditioned,
    /// Neighbouring nodes of a step are a quarter turn or more apart: the polar factor may have flipped.
    BranchJump,
    /// A Lyapunov operator of the step is singular.
    LyapunovSingular,
    /// A body point came too close to a point of the potential.
    PotentialSingularity,
    /// A table over time was read at a time that it does not cover.
    OutsideTable,
    /// A term follows an orbit that does not close.
    OpenOrbit,
    /// A value is infinite or not a number.
    NonFinite,
    /// The caller has stopped the work: see [`super::work`]. No log shows it.
    Stopped,
}

impl FailureCode {
    /// The code in logs, answers and scripts.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::MaxIterations => "not_converged.max_iterations",
            Self::Diverged => "not_converged.diverged",
            Self::Stalled => "not_converged.stalled",
            Self::SecondRoot => "not_converged.second_root",
            Self::LeftGlPlus => "polar.left_gl_plus",
            Self::IllConditioned => "polar.ill_conditioned",
            Self::BranchJump => "polar.branch_jump",
            Self::LyapunovSingular => "lyapunov_singular",
            Self::PotentialSingularity => "potential_singularity",
            Self::OutsideTable => "outside_table",
            Self::OpenOrbit => "open_orbit",
            Self::NonFinite => "non_finite",
            Self::Stopped => "stopped",
        }
    }

    /// The common reason, for a person.
    pub fn cause(self) -> &'static str {
        match self {
            Self::MaxIterations => {
                "the implicit equations of the step converge too slowly: the step is large for how fast the body turns"
            }
            Self::Diverged => {
                "the implicit equations of the step diverge: the step is too large for how fast the body turns"
            }
            Self::Stalled => {
                "the implicit equations of the step stopped converging above round-off: the scene combines values of very different sizes"
            }
            Self::SecondRoot => {
                "the implicit equations of the step have several solutions, and the one found is not the one that smaller steps lead to: the step is too large"
            }
            Self::LeftGlPlus => {
                "the body turns so far within the step that the interpolated matrix is singular or reverses orientation"
            }
            Self::IllConditioned => {
                "the body turns so far within the step that the interpolated matrix is nearly singular"
            }
            Self::BranchJump => {
                "the body turns by a quarter turn or more between neighbouring nodes of the step: the attitude may have flipped to another branch"
            }
            Self::LyapunovSingular => {
                "a Lyapunov equation of the step is singular: the body turns by half a turn or more within it"
            }
            Self::PotentialSingularity => {
                "a body point came too close to a point of the potential for the force to mean anything"
            }
            Self::OutsideTable => "a table over time does not cover the time of the step",
            Self::OpenOrbit => {
                "a term follows an orbit whose eccentricity is one or more: Kepler's equation for closed orbits does not apply"
            }
            Self::NonFinite => "a value of the step is infinite or not a number",
            Self::Stopped => "the step was stopped before its end",
        }
    }
}

impl fmt::Display for FailureCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A step that could not be made. The state before it is untouched.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{code}: {}", code.cause())]
pub struct Failure {
    /// Code of the failure.
    pub code: FailureCode,
    /// Stage (0-based) at which it was seen, where it belongs to one.
    pub stage: Option<usize>,
    /// The measured quantity: last increment, smallest eigenvalue, distance ratio, ...
    pub measured: f64,
    /// The limit it broke.
    pub limit: f64,
    /// Sweeps of the nonlinear solver until then.
    pub iterations: u32,
    /// The last increments of the nonlinear solver, oldest first, at most 16.
    pub increments: Vec<f64>,
    /// The angle in radians by which the body would turn in the step at its first velocity; `None` where
    /// the scheme does not say.
    pub turn_rad: Option<f64>,
}

impl Failure {
    /// A failure seen outside the iteration count; the solver adds its own figures.
    pub fn new(code: FailureCode, stage: Option<usize>, measured: f64, limit: f64) -> Self {
        Self { code, stage, measured, limit, iterations: 0, increments: Vec::new(), turn_rad: None }
    }

    /// Creates the failure of a value that is infinite or not a number: at a stage, or at the end.
    pub(crate) fn not_finite(stage: Option<usize>) -> Self {
        Self::new(FailureCode::NonFinite, stage, f64::INFINITY, f64::MAX)
    }

    /// Returns this failure of an iteration, or the close approach that `check` found in it: a
    /// charge that was met explains a failed iteration better than the iteration does. The counts
    /// of the solver stay.
    pub(crate) fn explained_by(self, check: Result<(), Self>) -> Self {
        match check {
            Ok(()) => self,
            Err(met) => Self { iterations: self.iterations, increments: self.increments, ..met },
        }
    }

    /// Ratio of the last two increments: how fast the iteration converged, above 1 if it did not.
    pub fn contraction(&self) -> Option<f64> {
        match self.increments.as_slice() {
            [.., before, last] if *before > 0.0 => Some(last / before),
            _ => None,
        }
    }

    /// A smaller step to try, by what was measured at a step of `h`: the fixed point contracts in proportion
    /// to h, so one that contracts by 0.3 is asked for; without a measured contraction half the step; and
    /// never a turn of more than half a radian. Rounded down to two digits.
    pub fn smaller_step(&self, h: f64) -> f64 {
        let factor = match self.contraction() {
            Some(rho) if rho.is_finite() && rho > 0.3 => (0.3 / rho).clamp(0.01, 0.5),
            _ => 0.5,
        };
        const EASY_TURN_RAD: f64 = 0.5;
        let gentle = self.turn_rad.map_or(1.0, |turn| EASY_TURN_RAD / turn.max(EASY_TURN_RAD));
        two_digits(h * factor.min(gentle))
    }
}

/// A positive number rounded down to two decimal digits, as they would be written.
pub fn two_digits(x: f64) -> f64 {
    let exponent = libm::log10(x).floor() - 1.0;
    let digits = (x / libm::pow(10.0, exponent)).floor();
    format!("{digits}e{exponent}").parse().unwrap_or(x)
}
