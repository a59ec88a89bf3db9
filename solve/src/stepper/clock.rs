//! The time of a driven system, and what drives it puts in.
//!
//! Invariant: each input is a sum with its lost part, by the weights of the scheme that made the steps.

use crate::compensated::Sum;
use crate::hamiltonian::WorkAndImpulse;
use crate::so::Mat;
use crate::time::Time;

/// The time at which the next step begins, and the input since [`super::Stepper::start`].
#[derive(Clone, Debug)]
pub struct Clock<const N: usize> {
    /// In seconds.
    pub(super) time: f64,
    /// Energy, in J.
    pub(super) work: Sum<f64>,
    /// Spatial momentum, in N m s.
    pub(super) impulse: Sum<Mat<N>>,
    /// Strengths of torques by tables, in N m s.
    pub(super) table_impulse: Sum<f64>,
}

impl<const N: usize> Default for Clock<N> {
    fn default() -> Self {
        let (work, table_impulse) = (Sum::default(), Sum::default());
        Self { time: 0.0, work, impulse: Sum::new(Mat::zeros(), Mat::zeros()), table_impulse }
    }
}

impl<const N: usize> Clock<N> {
    /// The time `after` seconds from the beginning of a step of length `h`.
    pub(super) fn at(&self, h: f64, after: f64) -> Time {
        Time::in_step(self.time, h, after)
    }

    /// Advances by a step, with the input during it.
    pub(super) fn advance(&mut self, h: f64, work_and_impulse: &WorkAndImpulse<N>) {
        self.time += h;
        self.work.add(work_and_impulse.power);
        self.table_impulse.add(work_and_impulse.tables);
        // Without torques it stays zero.
        if let Some(torque) = &work_and_impulse.torque {
            self.impulse.add(torque);
        }
    }

    /// Returns the input so far, of a clock that has advanced by one step.
    pub(super) fn work_and_impulse(&self) -> WorkAndImpulse<N> {
        let Self { work, impulse, table_impulse, .. } = self;
        WorkAndImpulse {
            power: work.value,
            torque: Some(impulse.value),
            tables: table_impulse.value,
        }
    }

    /// Adds the energy by which a potential jumps.
    pub(super) fn add_jump(&mut self, energy: f64) {
        self.work.add(energy);
    }
}
