//! VPD in Hamiltonian form: the variational polar decomposition integrator of Shen, Tran, Leok (2022),
//! equations (vih).
//!
//! Invariant: on success the state has moved by one step of the tableau's order and its attitude is on the
//! group to round-off; on failure it has not moved. No sine, cosine or exponential is used.

use super::galerkin::{Dynamics, GalerkinStep};
use super::{Stepper, check_root};
use crate::failure::Failure;
use crate::hamiltonian::RigidBody;
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::so::{self, Mat, Vector};
use crate::tableau::Tableau;
use crate::trajectory::State;

/// The stepper: the shared step, the state, and scratch for the potential.
#[derive(Clone, Debug)]
pub struct Vpd<const N: usize> {
    step: GalerkinStep<N>,
    state: State<N>,
    seen: Vec<Vector<N>>,
}

impl<const N: usize> Vpd<N> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        Self { step: GalerkinStep::new(tableau, stop), state, seen: Vec::new() }
    }
}

/// (vih6): `Omega = dH/dmu`, with the space vectors of the potential as seen from g0.
struct Hamiltonian<'a, const N: usize> {
    body: &'a RigidBody<N>,
    seen: &'a [Vector<N>],
}

impl<const N: usize> Dynamics<N> for Hamiltonian<'_, N> {
    fn velocity(&mut self, _k: usize, _u: &Mat<N>, mu: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        self.body.velocity(mu)
    }

    fn gradient(&self, u: &Mat<N>, _omega: &Mat<N>) -> Option<Mat<N>> {
        (!self.body.is_free()).then(|| self.body.gradient(u, self.seen))
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.body.work().begin_sweep()
    }

    fn check(&self, u: &Mat<N>) -> Result<(), Failure> {
        self.body.check_distances(u, self.seen)
    }
}

impl<const N: usize> Stepper<N> for Vpd<N> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        let Self { step, state, seen } = self;
        body.seen_from(&state.attitude, seen);
        let omega = body.velocity(&state.momentum);
        let mut dynamics = Hamiltonian { body, seen };
        let convergence = step.solve(&mut dynamics, h, &state.momentum, &omega)?;
        // The product drifts off the group like any product; one correction in space puts it back.
        let attitude = so::orthonormalised(&so::product(&state.attitude, step.rotation()));
        if convergence.rung == Rung::Newton {
            let halves = Self { step: step.by_sweeps(), state: state.clone(), seen: Vec::new() };
            check_root(convergence, halves, body, h, &attitude)?;
        }
        *state = State { attitude, momentum: step.momentum() };
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.state.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        self.state.momentum
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.step.sigma_min())
    }
}
