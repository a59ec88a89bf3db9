//! State that the forms of VPD carry from step to step, besides the system: the shared step, the
//! motion, and the time and work of a driven body.
//!
//! Invariant: a step that fails leaves the motion as it was.

use super::{GalerkinStep, Motion};
use crate::failure::Failure;
use crate::hamiltonian::{BodyAtTime, RigidBody};
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::so::{Mat, Vector};
use crate::state::State;
use crate::stepper::Clock;
use crate::stepper::checks::check_root;
use crate::tableau::Tableau;

/// The step, the motion and the clock.
#[derive(Clone, Debug)]
pub(in crate::stepper) struct StepperState<const N: usize> {
    pub(in crate::stepper) step: GalerkinStep<N>,
    pub(in crate::stepper) motion: Motion<N>,
    pub(in crate::stepper) clock: Clock<N>,
    /// Moments of a driven body at the stages and the end of the step (empty otherwise).
    pub(in crate::stepper) bodies: Vec<BodyAtTime<N>>,
    /// The space vectors of the potential, from where the step begins.
    pub(in crate::stepper) seen: Vec<Vector<N>>,
}

impl<const N: usize> StepperState<N> {
    /// Creates the state for steps of `tableau` that are solved until `stop`.
    pub(in crate::stepper) fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        Self {
            step: GalerkinStep::new(tableau, stop),
            motion: Motion::new(&state),
            clock: Clock::default(),
            bodies: Vec::new(),
            seen: Vec::new(),
        }
    }

    /// See [`crate::stepper::Stepper::start`].
    pub(in crate::stepper) fn start(&mut self, state: &State<N>) {
        self.step.forget();
        self.motion = Motion::new(state);
        self.clock = Clock::default();
    }

    /// Takes `body` as it is at the stages of a step of length `h`, if it is driven.
    pub(in crate::stepper) fn update_bodies(&mut self, body: Option<&RigidBody<N>>, h: f64) {
        self.bodies.clear();
        if let Some(body) = body.filter(|body| body.is_driven()) {
            self.bodies = self.step.bodies(body, self.clock.time, h);
        }
    }

    /// Carries the motion forward by a step of length `h`, whose equations `solve` solves for any root.
    ///
    /// # Errors
    /// Those of `solve`, and those of [`check_root`].
    pub(in crate::stepper) fn step(
        &mut self,
        h: f64,
        mut solve: impl FnMut(&mut Self, f64) -> Result<Convergence, Failure>,
    ) -> Result<Convergence, Failure> {
        let convergence = solve(self, h)?;
        if convergence.rung == Rung::Newton {
            let mut end = self.motion.clone();
            self.step.carry(&mut end);
            let mut halves = Self { step: self.step.by_sweeps(), ..self.clone() };
            let half = || {
                solve(&mut halves, 0.5 * h)?;
                halves.advance(0.5 * h);
                Ok(Some(*halves.motion.attitude()))
            };
            check_root(convergence, self.step.order(), end.attitude(), half)?;
        }
        self.advance(h);
        Ok(convergence)
    }

    /// Advances by the step that was solved.
    fn advance(&mut self, h: f64) {
        if !self.bodies.is_empty() {
            let work_and_impulse =
                self.step.work_and_impulse(h, &self.bodies, self.motion.attitude());
            self.clock.advance(h, &work_and_impulse);
        }
        self.step.carry(&mut self.motion);
    }
}
