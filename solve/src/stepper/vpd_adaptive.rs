//! VPD in Hamiltonian form, with steps of one length in a time of its own that slows down near the points of the potential:
//! the map of [`super::vpd`] for the Hamiltonian H~ of [`crate::hamiltonian::Rescaled`].
//!
//! H0 is the energy at the start of the trajectory, wherever it is resumed.
//!
//! Invariant: that of its own steps (`own_steps.rs`).

use super::Stepper;
use super::galerkin::{Length, Motion, StepperState};
use super::own_steps::{OwnMap, OwnStepEnd, OwnSteps};
use super::vpd::solve;
use crate::compensated::Sum;
use crate::failure::Failure;
use crate::hamiltonian::{Rescaled, RigidBody, TimeScale};
use crate::nonlinear::{Convergence, StopRule};
use crate::so::Mat;
use crate::state::{Checkpoint, OwnTime, Pace, State};
use crate::tableau::Tableau;

/// The stepper.
#[derive(Clone, Debug)]
pub struct VpdAdaptive<const N: usize> {
    scale: TimeScale,
    /// dtau; that of the time loop if absent.
    longest_s: Option<f64>,
    start: State<N>,
    /// H0, once a body has been seen.
    energy: Option<f64>,
    steps: OwnSteps<Motion<N>>,
    ahead: StepperState<N>,
    aside: StepperState<N>,
}

/// The map of a body in its own time.
struct Map<'a, const N: usize> {
    system: Rescaled<'a, N>,
    ahead: &'a mut StepperState<N>,
    aside: &'a mut StepperState<N>,
}

impl<const N: usize> OwnMap<Motion<N>> for Map<'_, N> {
    fn step(
        &mut self,
        from: &Motion<N>,
        dtau: f64,
    ) -> Result<(Motion<N>, Convergence, f64), Failure> {
        let Self { system, ahead, .. } = self;
        ahead.motion = from.clone();
        let solved = ahead.step(dtau, |carried, h| solve(carried, system, h))?;
        Ok((ahead.motion.clone(), solved, ahead.step.lasted(system, from.attitude())))
    }

    fn extra_step(
        &mut self,
        from: &Motion<N>,
        length: Length,
    ) -> Result<(Motion<N>, u32, [f64; 2]), Failure> {
        let Self { system, aside, .. } = self;
        aside.motion = from.clone();
        let sweeps = solve(aside, system, length)?.iterations;
        let lasted = aside.step.lasted(system, from.attitude());
        aside.step.carry(&mut aside.motion);
        Ok((aside.motion.clone(), sweeps, [aside.step.length(), lasted]))
    }

    fn sigma(&mut self, motion: &Motion<N>) -> Result<f64, Failure> {
        Ok(self.system.sigma(motion.attitude()))
    }
}

impl<const N: usize> VpdAdaptive<N> {
    /// Creates a stepper for `tableau` that solves each step until `stop`. Its own steps are as
    /// long as those of the time loop, in a time whose rate is `scale`, so none lasts longer.
    pub fn new(tableau: Tableau, stop: StopRule, scale: TimeScale) -> Self {
        let start = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let carried = StepperState::new(tableau, stop);
        Self {
            scale,
            longest_s: None,
            energy: None,
            steps: begun(&start),
            aside: carried.clone(),
            ahead: carried,
            start,
        }
    }
}

impl<const N: usize> VpdAdaptive<N> {
    /// Sets own steps of `longest_s` seconds.
    pub fn with_steps_of(self, longest_s: f64) -> Self {
        Self { longest_s: Some(longest_s), ..self }
    }
}

/// Returns the own steps of a trajectory that begins at `state`.
fn begun<const N: usize>(state: &State<N>) -> OwnSteps<Motion<N>> {
    let motion = Motion::new(state);
    OwnSteps::new(0, OwnStepEnd::at_start(motion.clone()), motion)
}

impl<const N: usize> Stepper<N> for VpdAdaptive<N> {
    fn order(&self) -> u32 {
        self.ahead.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        (self.start, self.energy, self.steps) = (state.clone(), None, begun(state));
    }

    fn resume(&mut self, checkpoint: &Checkpoint<N>) {
        let here = Motion::new(&checkpoint.state());
        let last = match &checkpoint.own_time {
            Some(OwnTime { attitude, momentum, time_s, carry_s, steps }) => OwnStepEnd {
                motion: Motion::new(&State { attitude: *attitude, momentum: *momentum }),
                time_s: Sum { value: *time_s, carry: *carry_s },
                steps: *steps,
            },
            None => OwnStepEnd::at_start(here.clone()),
        };
        self.steps = OwnSteps::new(checkpoint.step, last, here);
    }

    fn own_step_s(&mut self) -> Option<&mut f64> {
        self.longest_s.as_mut()
    }

    fn own_time(&self) -> Option<OwnTime<N>> {
        let OwnStepEnd { motion, time_s: Sum { value: time_s, carry: carry_s }, steps } =
            &self.steps.last;
        let (attitude, momentum) = (*motion.attitude(), *motion.body_momentum());
        Some(OwnTime { attitude, momentum, time_s: *time_s, carry_s: *carry_s, steps: *steps })
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        let dtau = self.longest_s.unwrap_or(h);
        let (steps, mut map) = self.in_own_time(body);
        steps.step(&mut map, h, dtau)
    }

    fn synchronise(&mut self, body: &RigidBody<N>, h: f64) -> Result<u32, Failure> {
        let dtau = self.longest_s.unwrap_or(h);
        let (steps, mut map) = self.in_own_time(body);
        let sweeps = steps.synchronise(&mut map, h, dtau)?;
        steps.forget_least_sigma();
        Ok(sweeps)
    }

    fn pace(&self) -> Option<Pace> {
        Some(self.steps.pace)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(*self.steps.here.attitude())
    }

    fn momentum(&self) -> Mat<N> {
        *self.steps.here.body_momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.ahead.step.sigma_min())
    }
}

impl<const N: usize> VpdAdaptive<N> {
    /// Returns its steps and their map for `body`, with H0.
    fn in_own_time<'a>(
        &'a mut self,
        body: &'a RigidBody<N>,
    ) -> (&'a mut OwnSteps<Motion<N>>, Map<'a, N>) {
        let Self { scale, start, energy, steps, ahead, aside, .. } = self;
        let State { attitude, momentum } = &*start;
        let energy = *energy.get_or_insert_with(|| body.energy(attitude, momentum).total());
        (steps, Map { system: Rescaled::new(body, scale, energy), ahead, aside })
    }
}
