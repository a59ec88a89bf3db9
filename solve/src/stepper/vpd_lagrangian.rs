//! VPD in Lagrangian form: Shen, Tran, Leok (2022), equations (22, vil).
//!
//! (22a, vil1) gives the momentum that each stage must have, `dL/dOmega(U_k, Omega_k) = mu_k`, and is implicit for
//! Omega_k. Each sweep makes one Newton correction of it,
//!
//! ```text
//! Omega_k <- Omega_k - (d^2L/dOmega^2)^-1 (dL/dOmega(U_k, Omega_k) - mu_k)
//! ```
//!
//! with the second derivative of the beginning of the step, so that the sweeps converge to the
//! solution of (22a, vil1) whatever the Lagrangian. For a hyperregular one this is the map of the Hamiltonian form.
//!
//! The state is the attitude and the momentum in space. A step adds to each what is small relative to it, and what rounding
//! takes off a sum is carried to the next step, as in [`super::vpd_so3`]: in space the momentum is what forces make of
//! it and nothing else.
//!
//! Invariant: nothing is asked of the system but the derivatives of its Lagrangian.

use std::marker::PhantomData;

use nalgebra::DMatrix;

use super::galerkin::{Dynamics, GalerkinStep};
use super::{Stepper, check_root};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::RigidBody;
use crate::lagrangian::{Lagrangian, corrected, inverse_hessian, velocity_of_momentum};
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::so::{self, Mat};
use crate::space;
use crate::tableau::Tableau;
use crate::trajectory::State;

/// The stepper: the shared step and the state. It takes any [`Lagrangian`] `S`, a rigid body if none is named.
#[derive(Clone, Debug)]
pub struct VpdLagrangian<const N: usize, S: ?Sized = RigidBody<N>> {
    step: GalerkinStep<N>,
    state: State<N>,
    attitude: Sum<N>,
    /// In space.
    momentum: Sum<N>,
    system: PhantomData<fn(&S)>,
}

/// A sum, and what rounding has taken off it.
#[derive(Clone, Debug)]
struct Sum<const N: usize> {
    value: Mat<N>,
    carry: Mat<N>,
}

impl<const N: usize> Sum<N> {
    fn new(value: Mat<N>) -> Self {
        Self { value, carry: Mat::zeros() }
    }

    /// Adds `change` and what is carried.
    fn add(&mut self, change: &Mat<N>) {
        for i in 0..N * N {
            let (sum, left) = space::sum(self.value[i], change[i] + self.carry[i]);
            (self.value[i], self.carry[i]) = (sum, left);
        }
    }
}

impl<const N: usize, S: ?Sized> VpdLagrangian<N, S> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let (attitude, momentum) = (Sum::new(state.attitude), Sum::new(state.momentum));
        let step = GalerkinStep::new(tableau, stop.to_the_floor());
        Self { step, state, attitude, momentum, system: PhantomData }
    }

    /// The same again.
    fn copied(&self) -> Self {
        let Self { step, state, attitude, momentum, .. } = self;
        let (state, system) = (state.clone(), PhantomData);
        let (attitude, momentum) = (attitude.clone(), momentum.clone());
        Self { step: step.clone(), state, attitude, momentum, system }
    }
}

impl<const N: usize, S: Lagrangian<N> + ?Sized> VpdLagrangian<N, S> {
    /// Carries the state forward by `h`, by any root.
    ///
    fn advance(&mut self, lagrangian: &S, h: f64) -> Result<Convergence, Failure> {
        let Self { step, state, attitude, momentum, .. } = self;
        let (g0, zero) = (state.attitude, Mat::zeros());
        let singular = || {
            let has_values = is_finite(&lagrangian.momentum(&g0, &zero));
            let code = if has_values { FailureCode::Diverged } else { FailureCode::NonFinite };
            Failure::new(code, None, f64::INFINITY, f64::MAX)
        };
        let omega =
            velocity_of_momentum(lagrangian, &g0, &state.momentum, &zero).ok_or_else(singular)?;
        let inverse = inverse_hessian(lagrangian, &g0, &omega).ok_or_else(singular)?;
        let mut dynamics = Euler { lagrangian, g0, inverse };
        let convergence = step.solve(&mut dynamics, h, &state.momentum, &omega)?;
        let (turn, impulse) = step.changes(&dynamics, h);
        if !(is_finite(&turn) && is_finite(&impulse)) {
            return Err(Failure::new(FailureCode::NonFinite, None, f64::INFINITY, f64::MAX));
        }
        momentum.add(&skew(&so::conjugate(&g0, &impulse)));
        // What is carried turns along, and the deficit of g^T g from one is added.
        let deficit = (Mat::<N>::identity() - so::transposed_product(&g0, &g0)) * 0.5;
        attitude.add(&(so::product(&g0, &(turn + deficit)) + so::product(&attitude.carry, &turn)));
        state.attitude = attitude.value;
        state.momentum = skew(&so::conjugate(&attitude.value.transpose(), &momentum.value));
        Ok(convergence)
    }
}

/// The skew part, of what is skew but for rounding.
fn skew<const N: usize>(x: &Mat<N>) -> Mat<N> {
    so::asym(x) * 0.5
}

fn is_finite<const N: usize>(x: &Mat<N>) -> bool {
    x.iter().all(|x| x.is_finite())
}

/// (22a, vil1) and the force, in the frame of g0.
struct Euler<'a, const N: usize, S: ?Sized> {
    lagrangian: &'a S,
    g0: Mat<N>,
    inverse: DMatrix<f64>,
}

impl<const N: usize, S: Lagrangian<N> + ?Sized> Dynamics<N> for Euler<'_, N, S> {
    fn velocity(&mut self, _k: usize, u: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let residual = self.lagrangian.momentum(&(self.g0 * u), omega) - mu;
        omega - corrected(&self.inverse, &residual)
    }

    fn gradient(&self, u: &Mat<N>, _mu: impl FnOnce() -> Mat<N>, omega: &Mat<N>) -> Option<Mat<N>> {
        // dH/dg = -dL/dg
        Some(-self.lagrangian.force(&(self.g0 * u), omega))
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.lagrangian.begin_sweep()
    }

    fn check(&self, u: &Mat<N>) -> Result<(), Failure> {
        self.lagrangian.check(&(self.g0 * u))
    }
}

impl<const N: usize, S: Lagrangian<N> + ?Sized> Stepper<N, S> for VpdLagrangian<N, S> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
        self.attitude = Sum::new(state.attitude);
        self.momentum = Sum::new(skew(&so::conjugate(&state.attitude, &state.momentum)));
    }

    /// # Errors
    /// Any failure; [`FailureCode::Diverged`] also where the momentum has no velocity: the Lagrangian is not hyperregular
    /// there.
    fn step(&mut self, lagrangian: &S, h: f64) -> Result<Convergence, Failure> {
        let before = self.copied();
        let convergence = self.advance(lagrangian, h)?;
        if convergence.rung == Rung::Newton {
            let halves = Self { step: before.step.by_sweeps(), ..before.copied() };
            let root = check_root(convergence, halves, lagrangian, h, &self.state.attitude);
            if let Err(failure) = root {
                *self = before;
                return Err(failure);
            }
        }
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
