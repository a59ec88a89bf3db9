//! Conditions that end a run before its time.
//!
//! Invariant: a condition is a function of the state, the time and the energy error.

use super::control::Target;
use super::so::{self, Mat};

/// A condition that ends a run once it has held for some time.
#[derive(Clone, Debug, PartialEq)]
pub struct Stop<const N: usize> {
    /// What must hold after a step.
    pub condition: Condition<N>,
    /// For how long it must hold, in s; zero for at once.
    pub for_s: f64,
}

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

impl<const N: usize> Stop<N> {
    /// Does the condition hold, at a time in seconds, for an attitude, its velocity if that has a name, and the energy error?
    pub(super) fn holds(
        &self,
        time_s: f64,
        g: &Mat<N>,
        velocity: Option<Mat<N>>,
        energy_error: impl Fn() -> f64,
    ) -> bool {
        match &self.condition {
            Condition::PointingErrorBelow(target, angle) => target.error(time_s, g).1 < *angle,
            Condition::AngleAbove(target, angle) => target.error(time_s, g).1 > *angle,
            Condition::RateBelow(rate) => {
                velocity.is_some_and(|velocity| so::inner(&velocity, &velocity).sqrt() < *rate)
            }
            Condition::EnergyErrorAbove(energy) => energy_error().abs() > *energy,
        }
    }
}
