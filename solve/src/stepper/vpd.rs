//! VPD in Hamiltonian form: the variational polar decomposition integrator of Shen, Tran, Leok (2022),
//! equations (24, vih).
//!
//! Invariant: on success the state has moved by one step of the tableau's order and its attitude is on the
//! group to round-off; on failure it has not moved. No sine, cosine or exponential is used.

use std::marker::PhantomData;

use super::galerkin::{Dynamics, GalerkinStep};
use super::{Stepper, check_root};
use crate::failure::Failure;
use crate::hamiltonian::{Hamiltonian, RigidBody};
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::so::{self, Mat, Vector};
use crate::tableau::Tableau;
use crate::trajectory::State;

/// The stepper: the shared step, the state, and scratch for the potential. It takes any [`Hamiltonian`] `S`, a rigid body
/// if none is named.
#[derive(Clone, Debug)]
pub struct Vpd<const N: usize, S: ?Sized = RigidBody<N>> {
    step: GalerkinStep<N>,
    state: State<N>,
    seen: Vec<Vector<N>>,
    system: PhantomData<fn(&S)>,
}

impl<const N: usize, S: ?Sized> Vpd<N, S> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let step = GalerkinStep::new(tableau, stop);
        Self { step, state, seen: Vec::new(), system: PhantomData }
    }
}

/// (24f, vih6): `Omega = dH/dmu`; of a rigid body with the space vectors of the potential as seen from g0.
struct Canonical<'a, const N: usize, S: ?Sized> {
    system: &'a S,
    g0: &'a Mat<N>,
    seen: &'a [Vector<N>],
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Dynamics<N> for Canonical<'_, N, S> {
    fn velocity(&mut self, _k: usize, u: &Mat<N>, mu: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        match self.system.as_body() {
            Some(body) => body.velocity(mu),
            None => self.system.velocity(&so::product(self.g0, u), mu),
        }
    }

    fn gradient(&self, u: &Mat<N>, mu: impl FnOnce() -> Mat<N>, _omega: &Mat<N>) -> Option<Mat<N>> {
        match self.system.as_body() {
            Some(body) => (!body.is_free()).then(|| body.gradient(u, self.seen)),
            None => Some(self.system.gradient(&so::product(self.g0, u), &mu())),
        }
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.system.begin_sweep()
    }

    fn check(&self, u: &Mat<N>) -> Result<(), Failure> {
        match self.system.as_body() {
            Some(body) => body.check_distances(u, self.seen),
            None => self.system.check(&so::product(self.g0, u)),
        }
    }
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Stepper<N, S> for Vpd<N, S> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
    }

    fn step(&mut self, system: &S, h: f64) -> Result<Convergence, Failure> {
        let Self { step, state, seen, .. } = self;
        if let Some(body) = system.as_body() {
            body.seen_from(&state.attitude, seen);
        }
        let omega = system.velocity(&state.attitude, &state.momentum);
        let mut dynamics = Canonical { system, g0: &state.attitude, seen };
        let convergence = step.solve(&mut dynamics, h, &state.momentum, &omega)?;
        // The product drifts off the group like any product; one correction in space puts it back.
        let attitude = so::orthonormalised(&so::product(&state.attitude, step.rotation()));
        if convergence.rung == Rung::Newton {
            let step = step.by_sweeps();
            let halves = Self { step, state: state.clone(), seen: Vec::new(), system: PhantomData };
            check_root(convergence, halves, system, h, &attitude)?;
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
