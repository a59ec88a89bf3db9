//! VPD in Hamiltonian form, with steps of one length in a time of its own that slows down near the points of the potential:
//! the map of [`super::vpd`] for the Hamiltonian K of [`crate::hamiltonian::Rescaled`].
//!
//! Its own steps do not end at the times k h that the time loop asks for: from the last own step before such a time an
//! extra step leads to it,
//!
//! ```text
//! dt = dtau sum_k b_k sigma(U_k),      dtau = (k h - t) / sum_k b_k sigma(U_k)   extra step
//! ```
//!
//! and forgotten after the sample. t is a sum, and its part lost to rounding is carried.
//!
//! Invariant: own steps are of one length and do not depend on the samples; H0 is the energy at the start of the trajectory,
//! wherever it is resumed.

use super::Stepper;
use super::galerkin::{Length, Motion, StepperState};
use super::vpd::solve;
use crate::compensated::Sum;
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{Rescaled, RigidBody, TimeScale};
use crate::nonlinear::{Convergence, Rung, StopRule};
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
    /// Steps of the time loop.
    made: u64,
    last: OwnStepEnd<N>,
    /// The own step from `last`, and how long it lasts: it ends after the time that the loop has reached.
    ahead: StepperState<N>,
    lasts: Option<f64>,
    aside: StepperState<N>,
    /// The least dt / dtau of an own step since the last sample.
    least_sigma: f64,
    pace: Pace,
}

/// End of an own step.
#[derive(Clone, Debug)]
struct OwnStepEnd<const N: usize> {
    motion: Motion<N>,
    time_s: Sum<f64>,
    /// Own steps so far.
    steps: u64,
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
            made: 0,
            last: OwnStepEnd::new(&start),
            lasts: None,
            aside: carried.clone(),
            least_sigma: 1.0,
            ahead: carried,
            pace: Pace::default(),
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

impl<const N: usize> OwnStepEnd<N> {
    fn new(state: &State<N>) -> Self {
        Self { motion: Motion::new(state), time_s: Sum::default(), steps: 0 }
    }
}

/// Most own steps between two times of the loop: with more, the step length does not fit the scene.
pub(crate) const MOST_STEPS: u64 = 100_000;

/// The failure of a scheme whose `MOST_STEPS` own steps of `dtau` last `lasted_s`, where `goal_s` seconds were to be gone.
pub(crate) fn too_many_steps(lasted_s: f64, goal_s: f64, dtau: f64) -> Failure {
    // sigma as the distance it belongs to, and the distance at which `MOST_STEPS` steps would suffice.
    let near = |sigma: f64| libm::cbrt(sigma * sigma);
    let all = MOST_STEPS as f64 * dtau;
    Failure::new(FailureCode::PotentialSingularity, None, near(lasted_s / all), near(goal_s / all))
}

impl<const N: usize> Stepper<N> for VpdAdaptive<N> {
    fn order(&self) -> u32 {
        self.ahead.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        (self.start, self.energy, self.made) = (state.clone(), None, 0);
        (self.last, self.lasts, self.least_sigma) = (OwnStepEnd::new(state), None, 1.0);
        self.aside.start(state);
        self.pace = Pace::default();
    }

    fn resume(&mut self, checkpoint: &Checkpoint<N>) {
        let state = checkpoint.state();
        self.last = match &checkpoint.own_time {
            Some(OwnTime { attitude, momentum, time_s, carry_s, steps }) => OwnStepEnd {
                motion: Motion::new(&State { attitude: *attitude, momentum: *momentum }),
                time_s: Sum { value: *time_s, carry: *carry_s },
                steps: *steps,
            },
            None => OwnStepEnd::new(&state),
        };
        (self.made, self.lasts, self.least_sigma) = (checkpoint.step, None, 1.0);
        self.aside.start(&state);
    }

    fn own_step_s(&mut self) -> Option<&mut f64> {
        self.longest_s.as_mut()
    }

    fn own_time(&self) -> Option<OwnTime<N>> {
        let OwnStepEnd { motion, time_s: Sum { value: time_s, carry: carry_s }, steps } =
            &self.last;
        let (attitude, momentum) = (*motion.attitude(), *motion.body_momentum());
        Some(OwnTime { attitude, momentum, time_s: *time_s, carry_s: *carry_s, steps: *steps })
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        let begun = self.last.clone();
        let goal = (self.made + 1) as f64 * h;
        let dtau = self.longest_s.unwrap_or(h);
        let result = self.go_to(body, goal, dtau);
        match result {
            Ok(_) => self.made += 1,
            Err(_) => (self.last, self.lasts) = (begun, None),
        }
        result
    }

    fn synchronise(&mut self, body: &RigidBody<N>, h: f64) -> Result<u32, Failure> {
        let time_s = self.made as f64 * h;
        let lasting = (time_s - self.last.time_s.value) - self.last.time_s.carry;
        let energy = self.energy(body);
        let dtau = self.longest_s.unwrap_or(h);
        let Self { scale, last, aside, lasts, least_sigma, pace, .. } = self;
        let system = Rescaled::new(body, scale, energy);
        let mut sweeps = 0;
        let mut missing = 0.0;
        aside.motion = last.motion.clone();
        if lasting > 0.0 {
            let sigma = lasts.map_or(system.sigma(last.motion.attitude()), |t| t / dtau);
            let mut length = Length { h: lasting / sigma, lasting: Some(lasting) };
            for _ in 0..MOST_TRIES {
                sweeps += solve(aside, &system, length)?.iterations;
                missing = lasting - aside.step.lasted(&system, last.motion.attitude());
                if missing.abs() <= ROUND_OFF * time_s {
                    break;
                }
                // Newton's method: dt/dh is about sigma at the end.
                let mut end = last.motion.clone();
                aside.step.carry(&mut end);
                length.h = aside.step.length() + missing / system.sigma(end.attitude());
            }
            aside.step.carry(&mut aside.motion);
        }
        let sigma = system.sigma(aside.motion.attitude());
        // A step is part of all intervals that it crosses.
        let around = lasts.map_or(sigma, |t| t / dtau);
        *pace = Pace {
            sigma,
            step_s: lasts.unwrap_or(0.0),
            steps: last.steps,
            least_sigma: least_sigma.min(around),
            time_error_s: -missing,
        };
        *least_sigma = 1.0;
        Ok(sweeps)
    }

    fn pace(&self) -> Option<Pace> {
        Some(self.pace)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(*self.aside.motion.attitude())
    }

    fn momentum(&self) -> Mat<N> {
        *self.aside.motion.body_momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.ahead.step.sigma_min())
    }
}

/// Error allowed in reaching a time, relative to it.
pub(crate) const ROUND_OFF: f64 = 2.0 * f64::EPSILON;
/// A few rounds of Newton's method; none is needed if the solution has the duration asked for.
pub(crate) const MOST_TRIES: u32 = 8;

impl<const N: usize> VpdAdaptive<N> {
    /// H0.
    fn energy(&mut self, body: &RigidBody<N>) -> f64 {
        let State { attitude, momentum } = &self.start;
        *self.energy.get_or_insert_with(|| body.energy(attitude, momentum).total())
    }

    /// Makes own steps until the next ends after `goal`. Returns how they were solved: all sweeps,
    /// and the last rung of the ladder that any of them needed.
    fn go_to(&mut self, body: &RigidBody<N>, goal: f64, dtau: f64) -> Result<Convergence, Failure> {
        let energy = self.energy(body);
        let Self { scale, last, ahead, lasts, least_sigma, .. } = self;
        let (begun_s, most_steps) = (last.time_s.value, last.steps + MOST_STEPS);
        let system = Rescaled::new(body, scale, energy);
        let mut solved = Convergence { iterations: 0, increment: 0.0, rung: Rung::FixedPoint };
        loop {
            let dt = match *lasts {
                Some(dt) => dt,
                None => {
                    ahead.motion = last.motion.clone();
                    let step = ahead.step(dtau, |carried, h| solve(carried, &system, h))?;
                    solved.iterations = solved.iterations.saturating_add(step.iterations);
                    solved.increment = solved.increment.max(step.increment);
                    if step.rung == Rung::Newton {
                        solved.rung = Rung::Newton;
                    }
                    let dt = ahead.step.lasted(&system, last.motion.attitude());
                    *least_sigma = least_sigma.min(dt / dtau);
                    *lasts.insert(dt)
                }
            };
            let mut end_s = last.time_s;
            end_s.add(dt);
            if end_s.value > goal || (end_s.value == goal && end_s.carry > 0.0) {
                return Ok(solved);
            }
            let steps = last.steps + 1;
            *last = OwnStepEnd { motion: ahead.motion.clone(), time_s: end_s, steps };
            *lasts = None;
            if steps == most_steps {
                return Err(too_many_steps(end_s.value - begun_s, goal - begun_s, dtau));
            }
        }
    }
}
