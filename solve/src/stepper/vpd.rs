//! VPD in Hamiltonian form: the variational polar decomposition integrator of Shen, Tran, Leok (2022),
//! equations (24, vih).
//!
//! Invariant: on success the state has moved by one step of the tableau's order and its attitude is on the
//! group to round-off; on failure it has not moved. No sine, cosine or exponential is used.

use std::marker::PhantomData;

use fearless_simd::Level;

use super::galerkin::{Dynamics, GalerkinStep, Motion};
use super::{Clock, Stepper, check_root};
use crate::failure::Failure;
use crate::hamiltonian::{Hamiltonian, Moment, RigidBody};
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::so::{self, Mat, Vector};
use crate::tableau::Tableau;
use crate::trajectory::State;

/// The stepper: the shared step, the state, and scratch for the potential. It takes any [`Hamiltonian`] `S`, a rigid body
/// if none is named.
#[derive(Clone, Debug)]
pub struct Vpd<const N: usize, S: ?Sized = RigidBody<N>> {
    step: GalerkinStep<N>,
    motion: Motion<N>,
    clock: Clock,
    seen: Vec<Vector<N>>,
    /// Of a driven body, at the stages and the end of the step.
    moments: Vec<Moment<N>>,
    system: PhantomData<fn(&S)>,
}

impl<const N: usize, S: ?Sized> Vpd<N, S> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let step = GalerkinStep::new(tableau, stop);
        Self {
            step,
            motion: Motion::new(&state),
            clock: Clock::default(),
            seen: Vec::new(),
            moments: Vec::new(),
            system: PhantomData,
        }
    }

    /// The same stepper on an older instruction set, or without lanes: a test compares the bits.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { step: self.step.on_level(level), ..self }
    }
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Vpd<N, S> {
    /// Solves the step of length `h`, for any root.
    fn solve(&mut self, system: &S, h: f64) -> Result<Convergence, Failure> {
        let Self { step, motion, clock, seen, moments, .. } = self;
        let (g0, p0) = (motion.attitude(), motion.body_momentum());
        moments.clear();
        match system.as_body() {
            Some(body) if body.is_driven() => *moments = step.moments(body, clock.time, h),
            Some(body) => body.seen_from(g0, seen),
            None => {}
        }
        let mut canonical = Canonical { system, g0, seen, moments };
        step.solve(&mut canonical, h, p0, &system.velocity(g0, p0))
    }

    /// Goes on by the step that was solved.
    fn advance(&mut self, h: f64) {
        if !self.moments.is_empty() {
            let work = self.step.work(h, &self.moments, self.motion.attitude());
            self.clock.advance(h, work);
        }
        self.motion.advance(self.step.solution());
    }
}

/// (24f, vih6): `Omega = dH/dmu`; of a rigid body with the space vectors of the potential as seen from g0, of a driven one
/// moment by moment.
struct Canonical<'a, const N: usize, S: ?Sized> {
    system: &'a S,
    g0: &'a Mat<N>,
    seen: &'a [Vector<N>],
    moments: &'a [Moment<N>],
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Dynamics<N> for Canonical<'_, N, S> {
    fn velocity(&mut self, _k: usize, u: &Mat<N>, mu: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        match self.system.as_body() {
            Some(body) => body.velocity(mu),
            None => self.system.velocity(&so::product(self.g0, u), mu),
        }
    }

    fn gradient(
        &self,
        k: usize,
        u: &Mat<N>,
        mu: &dyn Fn() -> Mat<N>,
        omega: &Mat<N>,
    ) -> Option<Mat<N>> {
        match (self.system.as_body(), self.moments.get(k)) {
            (_, Some(moment)) => Some(moment.gradient(&so::product(self.g0, u), &mu(), omega)),
            (Some(body), None) => (!body.is_free()).then(|| body.gradient(u, self.seen)),
            (None, None) => Some(self.system.gradient(&so::product(self.g0, u), &mu())),
        }
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.system.begin_sweep()
    }

    fn body(&self) -> Option<(&RigidBody<N>, &[Vector<N>])> {
        let body = self.system.as_body().filter(|_| self.moments.is_empty())?;
        Some((body, self.seen))
    }

    fn check(&self, k: usize, u: &Mat<N>) -> Result<(), Failure> {
        match (self.system.as_body(), self.moments.get(k)) {
            (_, Some(moment)) => moment.check(&so::product(self.g0, u)),
            (Some(body), None) => body.check_distances(u, self.seen),
            (None, None) => self.system.check(&so::product(self.g0, u)),
        }
    }
}

impl<const N: usize, S: Hamiltonian<N> + ?Sized> Stepper<N, S> for Vpd<N, S> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.motion = Motion::new(state);
        self.clock = Clock::default();
    }

    fn set_time(&mut self, time_s: f64) {
        self.clock.time = time_s;
    }

    fn work(&self) -> f64 {
        self.clock.work
    }

    fn step(&mut self, system: &S, h: f64) -> Result<Convergence, Failure> {
        let convergence = self.solve(system, h)?;
        if convergence.rung == Rung::Newton {
            let (step, motion) = (self.step.by_sweeps(), self.motion.clone());
            let halves = Self {
                step,
                motion,
                clock: self.clock,
                seen: Vec::new(),
                moments: Vec::new(),
                system: PhantomData,
            };
            let mut end = self.motion.clone();
            end.advance(self.step.solution());
            check_root(convergence, halves, system, h, end.attitude())?;
        }
        self.advance(h);
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(*self.motion.attitude())
    }

    fn momentum(&self) -> Mat<N> {
        *self.motion.body_momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.step.sigma_min())
    }
}
