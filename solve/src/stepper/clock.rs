//! The time of a driven system, and what drives it puts in.
//!
//! Invariant: each input is a sum with its lost part, by the weights of the scheme that made the steps.

use super::galerkin::Sum;
use crate::hamiltonian::{Input, Time};
use crate::so::Mat;
use crate::space;

/// The time at which the next step begins, and the input since [`super::Stepper::start`].
#[derive(Clone, Debug)]
pub struct Clock<const N: usize> {
    /// In seconds.
    pub(super) time: f64,
    /// Energy, in J.
    pub(super) work: Scalar,
    /// Spatial momentum, in N m s.
    pub(super) impulse: Sum<N>,
    /// Strengths of torques by tables, in N m s.
    pub(super) table_impulse: Scalar,
}

/// A sum of numbers, and the part of it lost to rounding.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Scalar {
    pub(super) value: f64,
    carry: f64,
}

impl Scalar {
    fn add(&mut self, change: f64) {
        (self.value, self.carry) = space::sum(self.value, change + self.carry);
    }
}

impl<const N: usize> Default for Clock<N> {
    fn default() -> Self {
        let (work, table_impulse) = (Scalar::default(), Scalar::default());
        Self { time: 0.0, work, impulse: Sum::new(Mat::zeros()), table_impulse }
    }
}

impl<const N: usize> Clock<N> {
    /// The time `after` seconds from the beginning of a step of length `h`.
    pub(super) fn at(&self, h: f64, after: f64) -> Time {
        Time::in_step(self.time, h, after)
    }

    /// Advances by a step, with the input during it.
    pub(super) fn advance(&mut self, h: f64, put_in: &Input<N>) {
        self.time += h;
        self.work.add(put_in.power);
        self.table_impulse.add(put_in.tables);
        // Without torques it stays zero.
        if let Some(torque) = &put_in.torque {
            self.impulse.add(torque);
        }
    }

    /// Adds the energy by which a potential jumps.
    pub(super) fn add_jump(&mut self, energy: f64) {
        self.work.add(energy);
    }
}
