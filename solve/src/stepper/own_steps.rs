//! Steps of one length in a time of its own, whatever moves in it.
//!
//! They do not end at the times k h that the time loop asks for: from the last own step before such a time an extra step leads
//! to it,
//!
//! ```text
//! dt = dtau sum_k b_k sigma_k,      dtau = (k h - t) / sum_k b_k sigma_k   extra step
//! ```
//!
//! and is forgotten after the sample. t is a sum, and its part lost to rounding is carried.
//!
//! Invariant: own steps are of one length and do not depend on the samples.

use super::galerkin::Length;
use crate::compensated::Sum;
use crate::failure::{Failure, FailureCode};
use crate::nonlinear::{Convergence, Rung};
use crate::state::Pace;

/// Most own steps between two times of the loop: with more, the step length does not fit the scene.
const MOST_STEPS: u64 = 100_000;
/// Error allowed in reaching a time, relative to it.
const ROUND_OFF: f64 = 2.0 * f64::EPSILON;
/// A few rounds of Newton's method; none is needed if the solution has the duration asked for.
const MOST_TRIES: u32 = 8;

/// The map of a motion `M` in its own time.
pub(crate) trait OwnMap<M> {
    /// Makes an own step; returns its end, how it was solved, and how many seconds it lasts.
    ///
    /// # Errors
    /// If the step cannot be solved.
    fn step(&mut self, from: &M, dtau: f64) -> Result<(M, Convergence, f64), Failure>;

    /// Makes an extra step; returns its end, its sweeps, its length, and how many seconds it lasts.
    ///
    /// # Errors
    /// If the step cannot be solved.
    fn extra_step(&mut self, from: &M, length: Length) -> Result<(M, u32, [f64; 2]), Failure>;

    /// sigma, the rate of the time.
    ///
    /// # Errors
    /// If the motion has no rate.
    fn sigma(&mut self, motion: &M) -> Result<f64, Failure>;
}

/// End of an own step.
#[derive(Clone, Debug)]
pub(crate) struct OwnStepEnd<M> {
    pub(crate) motion: M,
    pub(crate) time_s: Sum<f64>,
    /// Own steps so far.
    pub(crate) steps: u64,
}

impl<M> OwnStepEnd<M> {
    /// Returns the start of a trajectory.
    pub(crate) fn at_start(motion: M) -> Self {
        Self { motion, time_s: Sum::default(), steps: 0 }
    }
}

/// Where the motion is in its own steps, and in those of the time loop.
#[derive(Clone, Debug)]
pub(crate) struct OwnSteps<M> {
    /// Steps of the time loop.
    made: u64,
    pub(crate) last: OwnStepEnd<M>,
    /// The end of the own step from `last`, and how long it lasts: it ends after the time that the loop has reached.
    ahead: Option<(M, f64)>,
    /// The motion at the time of the loop, once it has been brought there.
    pub(crate) here: M,
    is_here: bool,
    /// The least dt / dtau of an own step since it was forgotten.
    least_sigma: f64,
    pub(crate) pace: Pace,
}

impl<M: Clone> OwnSteps<M> {
    /// Begins after `made` steps of the time loop at `here`, given the end of the last own step.
    pub(crate) fn new(made: u64, last: OwnStepEnd<M>, here: M) -> Self {
        let pace = Pace::default();
        Self { made, last, ahead: None, here, is_here: false, least_sigma: 1.0, pace }
    }

    /// Makes a step of the time loop: own steps until the next ends after it. Returns how they were solved: all sweeps, the
    /// largest increment, and the last rung of the ladder that any of them needed.
    ///
    /// # Errors
    /// If a step cannot be solved, or too many are needed; then the motion is as it was, and the own step ahead is forgotten.
    pub(crate) fn step(
        &mut self,
        map: &mut impl OwnMap<M>,
        h: f64,
        dtau: f64,
    ) -> Result<Convergence, Failure> {
        self.is_here = false;
        let begun = self.last.clone();
        let solved = self.go_to((self.made + 1) as f64 * h, map, dtau);
        match solved {
            Ok(_) => self.made += 1,
            Err(_) => (self.last, self.ahead) = (begun, None),
        }
        solved
    }

    fn go_to(
        &mut self,
        goal: f64,
        map: &mut impl OwnMap<M>,
        dtau: f64,
    ) -> Result<Convergence, Failure> {
        let (begun_s, most_steps) = (self.last.time_s.value, self.last.steps + MOST_STEPS);
        let mut solved = Convergence { iterations: 0, increment: 0.0, rung: Rung::FixedPoint };
        loop {
            let (motion, dt) = match self.ahead.take() {
                Some(ahead) => ahead,
                None => {
                    let (motion, step, dt) = map.step(&self.last.motion, dtau)?;
                    solved.iterations = solved.iterations.saturating_add(step.iterations);
                    solved.increment = solved.increment.max(step.increment);
                    if step.rung == Rung::Newton {
                        solved.rung = Rung::Newton;
                    }
                    self.least_sigma = self.least_sigma.min(dt / dtau);
                    (motion, dt)
                }
            };
            let mut end_s = self.last.time_s;
            end_s.add(dt);
            if end_s.value > goal || (end_s.value == goal && end_s.carry > 0.0) {
                self.ahead = Some((motion, dt));
                return Ok(solved);
            }
            let steps = self.last.steps + 1;
            self.last = OwnStepEnd { motion, time_s: end_s, steps };
            if steps == most_steps {
                return Err(too_many_steps(end_s.value - begun_s, goal - begun_s, dtau));
            }
        }
    }

    /// Brings the motion to the time of the loop. Returns the sweeps.
    ///
    /// # Errors
    /// If the extra step cannot be solved.
    pub(crate) fn synchronise(
        &mut self,
        map: &mut impl OwnMap<M>,
        h: f64,
        dtau: f64,
    ) -> Result<u32, Failure> {
        if self.is_here {
            return Ok(0);
        }
        let time_s = self.made as f64 * h;
        let OwnStepEnd { motion, time_s: then_s, steps } = &self.last;
        let lasting = (time_s - then_s.value) - then_s.carry;
        let ahead_s = self.ahead.as_ref().map(|&(_, dt)| dt);
        let (mut sweeps, mut missing) = (0, 0.0);
        let mut reached = motion.clone();
        if lasting > 0.0 {
            let sigma = match ahead_s {
                Some(dt) => dt / dtau,
                None => map.sigma(motion)?,
            };
            let mut length = Length { h: lasting / sigma, lasting: Some(lasting) };
            for _ in 0..MOST_TRIES {
                let (end, solved, [made, lasts]) = map.extra_step(motion, length)?;
                reached = end;
                sweeps += solved;
                missing = lasting - lasts;
                if missing.abs() <= ROUND_OFF * time_s {
                    break;
                }
                // Newton's method: dt/dh is about sigma at the end.
                length.h = made + missing / map.sigma(&reached)?;
            }
        }
        let sigma = map.sigma(&reached)?;
        // A step is part of all intervals that it crosses.
        let around = ahead_s.map_or(sigma, |dt| dt / dtau);
        self.pace = Pace {
            sigma,
            step_s: ahead_s.unwrap_or(0.0),
            steps: *steps,
            least_sigma: self.least_sigma.min(around),
            time_error_s: -missing,
        };
        (self.here, self.is_here) = (reached, true);
        Ok(sweeps)
    }

    /// Begins to look for the least dt / dtau anew.
    pub(crate) fn forget_least_sigma(&mut self) {
        self.least_sigma = 1.0;
    }
}

/// The failure of a scheme whose `MOST_STEPS` own steps of `dtau` last `lasted_s`, where `goal_s` seconds were to be gone.
fn too_many_steps(lasted_s: f64, goal_s: f64, dtau: f64) -> Failure {
    // sigma as the distance it belongs to, and the distance at which `MOST_STEPS` steps would suffice.
    let near = |sigma: f64| libm::cbrt(sigma * sigma);
    let all = MOST_STEPS as f64 * dtau;
    Failure::new(FailureCode::PotentialSingularity, None, near(lasted_s / all), near(goal_s / all))
}
