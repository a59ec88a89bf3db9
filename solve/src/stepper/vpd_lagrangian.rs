//! VPD in Lagrangian form: Shen, Tran, Leok (2022), equations (22, vil).
//!
//! (22a, vil1) gives the momentum that each stage must have, `dL/dOmega(U_k, Omega_k) = mu_k`, and
//! is implicit in Omega_k. Each sweep makes one Newton correction of it,
//!
//! ```text
//! Omega_k <- Omega_k - (d^2L/dOmega^2)^-1 (dL/dOmega(U_k, Omega_k) - mu_k)
//! ```
//!
//! with the second derivative at the beginning of the step, so that the sweeps converge to the
//! solution of (22a, vil1) whatever the Lagrangian. Where its inverse Legendre transform has a formula, that of a rigid body
//! for one, Omega_k follows from it. For a hyperregular Lagrangian this is the map of the Hamiltonian form.
//!
//! Invariant: the system provides only its Lagrangian and what follows from it; a rigid body that is not
//! driven also provides the terms of its potential, whose forces are then those of [`super::vpd`].

use std::marker::PhantomData;

use nalgebra::DMatrix;

use super::galerkin::{BodyView, Dynamics, StepperState};
use super::{Clock, Stepper};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{BodyAtTime, RigidBody};
use crate::lagrangian::{Lagrangian, corrected, inverse_hessian, velocity_of_momentum};
use crate::nonlinear::{Convergence, StopRule};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::tableau::Tableau;

/// The stepper, for any [`Lagrangian`] `S`; a rigid body if none is named.
#[derive(Clone, Debug)]
pub struct VpdLagrangian<const N: usize, S: ?Sized = RigidBody<N>> {
    carried: StepperState<N>,
    system: PhantomData<fn(&S)>,
}

impl<const N: usize, S: ?Sized> VpdLagrangian<N, S> {
    /// Creates a stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        Self { carried: StepperState::new(tableau, stop.to_the_floor()), system: PhantomData }
    }
}

/// Solves the step of length `h`, for any root.
fn solve<const N: usize, S: Lagrangian<N> + ?Sized>(
    carried: &mut StepperState<N>,
    lagrangian: &S,
    h: f64,
) -> Result<Convergence, Failure> {
    carried.update_bodies(lagrangian.as_body(), h);
    let StepperState { step, motion, bodies, seen, .. } = carried;
    let body = lagrangian.as_body().filter(|_| bodies.is_empty());
    if let Some(body) = body {
        body.seen_from(motion.attitude(), seen);
    }
    let (g0, p0, zero) = (*motion.attitude(), *motion.body_momentum(), Mat::zeros());
    let singular = || {
        let has_values = lagrangian.momentum(&g0, &zero).iter().all(|x| x.is_finite());
        let code = if has_values { FailureCode::Diverged } else { FailureCode::NonFinite };
        Failure::new(code, None, f64::INFINITY, f64::MAX)
    };
    let omega = velocity_of_momentum(lagrangian, &g0, &p0, &zero).ok_or_else(singular)?;
    let inverse = match lagrangian.inverse_legendre(&g0, &p0) {
        Some(_) => None,
        None => Some(inverse_hessian(lagrangian, &g0, &omega).ok_or_else(singular)?),
    };
    step.solve(&Euler { lagrangian, body, g0, seen, inverse, bodies }, h, &p0, &omega)
}

/// (22a, vil1) and the force, in the frame of g0; for a rigid body with the space vectors as seen
/// from g0, so that rounding of an attitude exerts no force along them.
struct Euler<'a, const N: usize, S: ?Sized> {
    lagrangian: &'a S,
    /// The Lagrangian, if it is a body that is not driven.
    body: Option<&'a RigidBody<N>>,
    g0: Mat<N>,
    seen: &'a [Vector<N>],
    /// (d^2L/dOmega^2)^-1; `None` where a formula takes its place.
    inverse: Option<DMatrix<f64>>,
    bodies: &'a [BodyAtTime<N>],
}

impl<const N: usize, S: Lagrangian<N> + ?Sized> Dynamics<N> for Euler<'_, N, S> {
    fn velocity(&self, k: usize, u: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        if let Some(body_at_time) = self.bodies.get(k) {
            return body_at_time.body.velocity(mu);
        }
        let g = so::product(&self.g0, u);
        match &self.inverse {
            Some(inverse) => {
                omega - corrected(inverse, &(self.lagrangian.momentum(&g, omega) - mu))
            }
            None => self.lagrangian.inverse_legendre(&g, mu).unwrap_or(*omega),
        }
    }

    fn gradient(
        &self,
        k: usize,
        u: &Mat<N>,
        mu: &dyn Fn() -> Mat<N>,
        omega: &Mat<N>,
    ) -> Option<Mat<N>> {
        Some(match (self.body, self.bodies.get(k)) {
            (_, Some(body_at_time)) => {
                self.lagrangian.as_body().inspect(|body| body.count(1));
                body_at_time.gradient(&so::product(&self.g0, u), &mu(), omega)
            }
            (Some(body), None) => body.gradient_seen(u, self.seen),
            // dH/dg = -dL/dg
            (None, None) => -self.lagrangian.force(&so::product(&self.g0, u), omega),
        })
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.lagrangian.begin_sweep()
    }

    fn mobility(&self) -> f64 {
        self.lagrangian.as_body().map_or(0.0, RigidBody::mobility)
    }

    fn body(&self) -> Option<BodyView<'_, N>> {
        let (body, vectors) = (self.body?, self.seen);
        Some(BodyView { body, vectors, scale: None, weights: body.principal() })
    }

    fn check(&self, k: usize, u: &Mat<N>) -> Result<(), Failure> {
        match (self.body, self.bodies.get(k)) {
            (_, Some(body_at_time)) => body_at_time.check(&so::product(&self.g0, u)),
            (Some(body), None) => body.check_distances_seen(u, self.seen),
            (None, None) => self.lagrangian.check(&so::product(&self.g0, u)),
        }
    }
}

impl<const N: usize, S: Lagrangian<N> + ?Sized> Stepper<N, S> for VpdLagrangian<N, S> {
    fn order(&self) -> u32 {
        self.carried.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.carried.start(state);
    }

    fn clock(&self) -> Option<&Clock<N>> {
        Some(&self.carried.clock)
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        Some(&mut self.carried.clock)
    }

    /// # Errors
    /// Any failure; [`FailureCode::Diverged`] also where no velocity belongs to the momentum: the
    /// Lagrangian is not hyperregular there.
    fn step(&mut self, lagrangian: &S, h: f64) -> Result<Convergence, Failure> {
        self.carried.step(h, |carried, h| solve(carried, lagrangian, h))
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(*self.carried.motion.attitude())
    }

    fn momentum(&self) -> Mat<N> {
        *self.carried.motion.body_momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.carried.step.sigma_min())
    }
}
