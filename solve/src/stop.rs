//! Conditions that end a run before its time.
//!
//! Invariant: a condition is a function of the state, the time and the energy error.

use super::control::Target;
use super::failure::Failure;
use super::so::{self, Mat};

/// A condition that ends a run once it has held for some time.
#[derive(Clone, Debug, PartialEq)]
pub struct Stop<const N: usize> {
    /// What must hold after a step.
    pub condition: Condition<N>,
    /// For how long it must hold, in s; zero for at once.
    pub for_s: f64,
    /// Whether the time at which it comes to hold is located within the step, to [`EXACT_S`]. One that must hold for some time,
    /// or that holds at the start, ends the run after a step, and so does any with a scheme that has a time of its own.
    pub exact: bool,
}

/// The error of a time that is located, in s.
pub const EXACT_S: f64 = 1e-9;

/// What may hold after a step.
#[derive(Clone, Debug, PartialEq)]
pub enum Condition<const N: usize> {
    /// The attitude is nearer to a target than an angle in rad: see [`Target::error`].
    PointingErrorBelow(Target<N>, f64),
    /// The attitude is farther from a target than an angle in rad.
    AngleAbove(Target<N>, f64),
    /// The angular velocity is smaller than a rate in rad/s (the norm `<Omega, Omega>^(1/2)`).
    RateBelow(f64),
    /// The size of the energy error is larger than this, in J.
    EnergyErrorAbove(f64),
}

impl<const N: usize> Condition<N> {
    /// Returns a number above zero where the condition holds, and continuous: at a time in seconds, for an attitude, its velocity
    /// if that has a name, and the energy error.
    pub(super) fn margin(
        &self,
        time_s: f64,
        g: &Mat<N>,
        velocity: Option<Mat<N>>,
        energy_error: impl Fn() -> f64,
    ) -> f64 {
        match self {
            Self::PointingErrorBelow(target, angle) => angle - target.error(time_s, g).1,
            Self::AngleAbove(target, angle) => target.error(time_s, g).1 - angle,
            Self::RateBelow(rate) => {
                velocity.map_or(-1.0, |velocity| rate - so::inner(&velocity, &velocity).sqrt())
            }
            Self::EnergyErrorAbove(energy) => energy_error().abs() - energy,
        }
    }
}

/// Takes note of whether a condition holds at a time; returns whether it has now held for `for_s` seconds.
pub(super) fn is_over(since_s: &mut Option<f64>, holds: bool, time_s: f64, for_s: f64) -> bool {
    *since_s = if holds { since_s.or(Some(time_s)) } else { None };
    since_s.is_some_and(|since_s| time_s - since_s >= for_s - super::time::rounding_s(time_s))
}

/// Returns the part of a step, in s, at whose end a condition comes to hold that holds at the end of the whole step and not at its
/// beginning: by bisection, for steps that end at knots make a margin no more than continuous. `holds` says whether it does after
/// a part.
///
/// # Errors
/// Those of `holds`.
pub(super) fn located(
    step_s: f64,
    mut holds: impl FnMut(f64) -> Result<bool, Failure>,
) -> Result<f64, Failure> {
    let (mut before_s, mut after_s) = (0.0, step_s);
    while after_s - before_s > EXACT_S {
        let middle_s = 0.5 * (before_s + after_s);
        // In a step so long that its numbers are farther apart.
        if middle_s <= before_s || middle_s >= after_s {
            break;
        }
        if holds(middle_s)? {
            after_s = middle_s;
        } else {
            before_s = middle_s;
        }
    }
    Ok(after_s)
}
