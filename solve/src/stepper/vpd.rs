//! VPD in Hamiltonian form: the variational polar decomposition integrator of Shen, Tran, Leok (2022),
//! equations (24, vih).
//!
//! Invariant: on success the state has moved by one step of the tableau's order and its attitude is on the
//! group to round-off; on failure it has not moved. No sine, cosine or exponential is used.

use std::marker::PhantomData;

use fearless_simd::Level;

use super::galerkin::{BodyView, Dynamics, Length, StepperState};
use super::{Clock, Stepper};
use crate::failure::Failure;
use crate::hamiltonian::{BodyAtTime, Hamiltonian, Rescaled, RigidBody};
use crate::nonlinear::{Convergence, StopRule};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::tableau::Tableau;

/// The stepper. It takes any [`Hamiltonian`] `S`, a rigid body if none is named.
#[derive(Clone, Debug)]
pub struct Vpd<const N: usize, S: ?Sized = RigidBody<N>> {
    carried: StepperState<N>,
    system: PhantomData<fn(&S)>,
}

impl<const N: usize, S: ?Sized> Vpd<N, S> {
    /// Creates a stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        Self { carried: StepperState::new(tableau, stop), system: PhantomData }
    }

    /// Returns the stepper on an older instruction set, or without lanes: a test compares the bits.
    pub fn on_level(mut self, level: Option<Level>) -> Self {
        self.carried.step = self.carried.step.on_level(level);
        self
    }
}

impl<const N: usize> Vpd<N, Rescaled<'_, N>> {
    /// Makes a step of length `h` in the system's own time; also returns its duration in seconds:
    /// `h sum_k b_k sigma(U_k)`.
    ///
    /// # Errors
    /// Those of [`Stepper::step`].
    pub fn timed_step(
        &mut self,
        system: &Rescaled<'_, N>,
        h: f64,
    ) -> Result<(Convergence, f64), Failure> {
        let g0 = *self.carried.motion.attitude();
        let convergence = self.carried.step(h, |carried, h| solve(carried, system, h))?;
        Ok((convergence, self.carried.step.lasted(system, &g0)))
    }
}

/// Solves the step of such a length, for any root.
pub(super) fn solve<const N: usize, S: Hamiltonian<N> + ?Sized>(
    carried: &mut StepperState<N>,
    system: &S,
    length: impl Into<Length>,
) -> Result<Convergence, Failure> {
    let length = length.into();
    carried.update_bodies(system.as_body(), length.h);
    let StepperState { step, motion, bodies, seen, .. } = carried;
    let (g0, p0) = (motion.attitude(), motion.body_momentum());
    let rescaled = system.as_rescaled().map(|rescaled| rescaled.body);
    if let Some(body) = system.as_body().filter(|_| bodies.is_empty()).or(rescaled) {
        body.seen_from(g0, seen);
    }
    let canonical = Canonical { system, g0, seen, bodies };
    step.solve(&canonical, length, p0, &system.velocity(g0, p0))
}

/// (24f, vih6): `Omega = dH/dmu`; for a rigid body with the space vectors of the potential as seen
/// from g0, for a driven one moment by moment.
struct Canonical<'a, const N: usize, S: ?Sized> {
    system: &'a S,
    g0: &'a Mat<N>,
    seen: &'a [Vector<N>],
    bodies: &'a [BodyAtTime<N>],
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Dynamics<N> for Canonical<'_, N, S> {
    fn velocity(&self, k: usize, u: &Mat<N>, mu: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        match (self.system.as_body(), self.bodies.get(k)) {
            (_, Some(body_at_time)) => body_at_time.body.velocity(mu),
            (Some(body), None) => body.velocity(mu),
            (None, None) => self.system.velocity(&so::product(self.g0, u), mu),
        }
    }

    fn gradient(
        &self,
        k: usize,
        u: &Mat<N>,
        mu: &dyn Fn() -> Mat<N>,
        omega: &Mat<N>,
    ) -> Option<Mat<N>> {
        match (self.system.as_body(), self.bodies.get(k)) {
            (body, Some(body_at_time)) => {
                body.inspect(|body| body.count(1));
                Some(body_at_time.gradient(&so::product(self.g0, u), &mu(), omega))
            }
            (Some(body), None) => (!body.is_free()).then(|| body.gradient_seen(u, self.seen)),
            (None, None) => Some(self.system.gradient(&so::product(self.g0, u), &mu())),
        }
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.system.begin_sweep()
    }

    fn mobility(&self) -> f64 {
        self.system.as_body().map_or(0.0, RigidBody::mobility)
    }

    fn body(&self) -> Option<BodyView<'_, N>> {
        let vectors = self.seen;
        if let Some(rescaled) = self.system.as_rescaled() {
            let (body, scale) = (rescaled.body, Some(rescaled.into()));
            return Some(BodyView { body, vectors, scale, weights: body.principal() });
        }
        let body = self.system.as_body().filter(|_| self.bodies.is_empty())?;
        Some(BodyView { body, vectors, scale: None, weights: body.principal() })
    }

    fn check(&self, k: usize, u: &Mat<N>) -> Result<(), Failure> {
        match (self.system.as_body(), self.bodies.get(k)) {
            (_, Some(body_at_time)) => body_at_time.check(&so::product(self.g0, u)),
            (Some(body), None) => body.check_distances_seen(u, self.seen),
            (None, None) => self.system.check(&so::product(self.g0, u)),
        }
    }
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Stepper<N, S> for Vpd<N, S> {
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

    fn step(&mut self, system: &S, h: f64) -> Result<Convergence, Failure> {
        self.carried.step(h, |carried, h| solve(carried, system, h))
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

    fn stage(&self, k: usize) -> Option<State<N>> {
        self.carried.step.stage(k)
    }
}
