//! VPD for several bodies with steps of one length in a time of its own that slows down where points of theirs come close: the
//! map of [`super::vpd`] for bodies in a rescaled time (`rescaled.rs`). Its own steps, its samples and its time are those of
//! [`crate::stepper::vpd_adaptive`].
//!
//! ```text
//! dt = dtau sum_k b_k sigma_k,      dtau = (k h - t) / sum_k b_k sigma_k   extra step to a time k h of the time loop
//! ```
//!
//! Invariant: own steps are of one length and do not depend on the samples; H0 is the energy at the start of the trajectory,
//! wherever it is resumed.

use super::motion::BodiesMotion;
use super::rescaled::BodiesTimeScale;
use super::trajectory::{BodiesStepper, Checkpoint, OwnTime};
use super::vpd::{BodiesVpd, Length};
use super::{Bodies, BodiesState};
use crate::compensated::Sum;
use crate::failure::Failure;
use crate::nonlinear::{Convergence, Rung, StopRule};
use crate::state::Pace;
use crate::stepper::vpd_adaptive::{MOST_STEPS, MOST_TRIES, ROUND_OFF, too_many_steps};
use crate::tableau::Tableau;

/// The stepper.
#[derive(Clone, Debug)]
pub struct BodiesVpdAdaptive<const N: usize> {
    scale: BodiesTimeScale,
    /// dtau; that of the time loop if absent.
    longest_s: Option<f64>,
    /// The steppers without a time of their own.
    plain: [BodiesVpd<N>; 2],
    start: BodiesState<N>,
    /// Once bodies have been seen, and their energy at the start.
    own: Option<Own<N>>,
    /// Steps of the time loop.
    made: u64,
    last: OwnStepEnd<N>,
    /// How long the own step ahead lasts: it ends after the time that the loop has reached.
    lasts: Option<f64>,
    /// The state at the time of the loop, once it has been brought there.
    aside: BodiesMotion<N>,
    is_there: bool,
    /// The least dt / dtau of an own step since [`BodiesStepper::pace`] was asked.
    least_sigma: f64,
    pace: Pace,
}

/// Steppers in their own time.
#[derive(Clone, Debug)]
struct Own<const N: usize> {
    /// At the end of the own step from `last`.
    ahead: BodiesVpd<N>,
    aside: BodiesVpd<N>,
}

/// End of an own step.
#[derive(Clone, Debug)]
struct OwnStepEnd<const N: usize> {
    motion: BodiesMotion<N>,
    time_s: Sum<f64>,
    /// Own steps so far.
    steps: u64,
}

impl<const N: usize> OwnStepEnd<N> {
    fn new(state: &BodiesState<N>) -> Self {
        Self { motion: BodiesMotion::new(state), time_s: Sum::default(), steps: 0 }
    }
}

impl<const N: usize> BodiesVpdAdaptive<N> {
    /// Creates a stepper for `tableau` that solves each step until `stop`, for systems of as many bodies and trees as `state`.
    /// Its own steps are as long as those of the time loop, in a time whose rate is `scale`, so none lasts longer.
    pub fn new(
        tableau: Tableau,
        stop: StopRule,
        scale: BodiesTimeScale,
        state: &BodiesState<N>,
    ) -> Self {
        let ahead = BodiesVpd::new(tableau, stop, state);
        Self {
            scale,
            longest_s: None,
            plain: [ahead.clone(), ahead.without_history()],
            start: state.clone(),
            own: None,
            made: 0,
            last: OwnStepEnd::new(state),
            lasts: None,
            aside: BodiesMotion::new(state),
            is_there: false,
            least_sigma: 1.0,
            pace: Pace::default(),
        }
    }

    /// Sets own steps of `longest_s` seconds.
    pub fn with_steps_of(self, longest_s: f64) -> Self {
        Self { longest_s: Some(longest_s), ..self }
    }

    /// The steppers on the motion with the energy of the start.
    fn own(&mut self, bodies: &Bodies<N>) -> Result<(), Failure> {
        if self.own.is_some() {
            return Ok(());
        }
        let seen = bodies.seen(&self.start).ok_or(Failure::not_finite(None))?;
        let energy = bodies.energy(&self.start, &seen).total();
        let [ahead, aside] =
            self.plain.clone().map(|plain| plain.rescaled(self.scale.clone(), energy));
        self.own = Some(Own { ahead, aside });
        Ok(())
    }

    /// sigma of a motion.
    fn sigma(&self, bodies: &Bodies<N>, motion: &BodiesMotion<N>) -> Result<f64, Failure> {
        let BodiesState { attitudes, places, .. } = motion.state();
        self.scale.sigma(bodies, &attitudes, &places)
    }

    /// Forgets the own step ahead.
    fn turn_back(&mut self) {
        self.lasts = None;
        if let Some(Own { ahead, .. }) = &mut self.own {
            ahead.start(&self.last.motion.state());
            ahead.motion = self.last.motion.clone();
        }
    }

    /// Makes own steps until the next ends after `goal`. Returns how they were solved: all sweeps, and the largest increment.
    fn go_to(&mut self, bodies: &Bodies<N>, goal: f64, dtau: f64) -> Result<Convergence, Failure> {
        self.own(bodies)?;
        let Self { own, last, lasts, least_sigma, .. } = self;
        let Some(Own { ahead, .. }) = own else { return Err(Failure::not_finite(None)) };
        let (begun_s, most_steps) = (last.time_s.value, last.steps + MOST_STEPS);
        let mut solved = Convergence { iterations: 0, increment: 0.0, rung: Rung::FixedPoint };
        loop {
            let dt = match *lasts {
                Some(dt) => dt,
                None => {
                    ahead.motion = last.motion.clone();
                    let (step, dt) = ahead.timed_step(bodies, dtau)?;
                    solved.iterations = solved.iterations.saturating_add(step.iterations);
                    solved.increment = solved.increment.max(step.increment);
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

impl<const N: usize> BodiesStepper<N> for BodiesVpdAdaptive<N> {
    fn order(&self) -> u32 {
        self.plain[0].order()
    }

    fn start(&mut self, state: &BodiesState<N>) {
        (self.start, self.own, self.made) = (state.clone(), None, 0);
        (self.last, self.lasts, self.least_sigma) = (OwnStepEnd::new(state), None, 1.0);
        (self.aside, self.is_there) = (BodiesMotion::new(state), false);
        self.pace = Pace::default();
    }

    fn resume(&mut self, state: &BodiesState<N>, checkpoint: &Checkpoint) {
        let own = checkpoint.own_time.as_ref();
        let then = own.and_then(|own| Some((own, state.with_numbers(&own.numbers)?)));
        self.last = match then {
            Some((own, state)) => OwnStepEnd {
                motion: BodiesMotion::new(&state),
                time_s: Sum { value: own.time_s, carry: own.carry_s },
                steps: own.steps,
            },
            None => OwnStepEnd::new(state),
        };
        (self.made, self.least_sigma) = (checkpoint.step, 1.0);
        (self.aside, self.is_there) = (BodiesMotion::new(state), false);
        self.turn_back();
    }

    fn own_step_s(&mut self) -> Option<&mut f64> {
        self.longest_s.as_mut()
    }

    fn own_time(&self) -> Option<OwnTime> {
        let OwnStepEnd { motion, time_s: Sum { value: time_s, carry: carry_s }, steps } =
            &self.last;
        let numbers = motion.state().numbers();
        Some(OwnTime { numbers, time_s: *time_s, carry_s: *carry_s, steps: *steps })
    }

    fn step(&mut self, bodies: &Bodies<N>, h: f64) -> Result<Convergence, Failure> {
        self.is_there = false;
        let begun = self.last.clone();
        let goal = (self.made + 1) as f64 * h;
        let dtau = self.longest_s.unwrap_or(h);
        let result = self.go_to(bodies, goal, dtau);
        match result {
            Ok(_) => self.made += 1,
            Err(_) => {
                self.last = begun;
                self.turn_back();
            }
        }
        result
    }

    fn synchronise(&mut self, bodies: &Bodies<N>, h: f64) -> Result<u32, Failure> {
        if self.is_there {
            return Ok(0);
        }
        let time_s = self.made as f64 * h;
        let lasting = (time_s - self.last.time_s.value) - self.last.time_s.carry;
        let dtau = self.longest_s.unwrap_or(h);
        self.own(bodies)?;
        let (mut sweeps, mut missing) = (0, 0.0);
        let mut reached = self.last.motion.clone();
        if lasting > 0.0 {
            let here = self.sigma(bodies, &self.last.motion)?;
            let sigma = self.lasts.map_or(here, |lasts| lasts / dtau);
            let mut length = Length { h: lasting / sigma, lasting: Some(lasting) };
            for _ in 0..MOST_TRIES {
                let Some(Own { aside, .. }) = &mut self.own else { break };
                aside.motion = self.last.motion.clone();
                let (solved, [made, lasts]) = aside.advanced(bodies, length)?;
                reached = aside.motion.clone();
                sweeps += solved.iterations;
                missing = lasting - lasts;
                if missing.abs() <= ROUND_OFF * time_s {
                    break;
                }
                // Newton's method: dt/dh is about sigma at the end.
                length.h = made + missing / self.sigma(bodies, &reached)?;
            }
        }
        let sigma = self.sigma(bodies, &reached)?;
        // A step is part of all intervals that it crosses.
        let around = self.lasts.map_or(sigma, |lasts| lasts / dtau);
        self.pace = Pace {
            sigma,
            step_s: self.lasts.unwrap_or(0.0),
            steps: self.last.steps,
            least_sigma: self.least_sigma.min(around),
            time_error_s: -missing,
        };
        (self.aside, self.is_there) = (reached, true);
        Ok(sweeps)
    }

    fn pace(&mut self) -> Option<Pace> {
        self.least_sigma = 1.0;
        Some(self.pace)
    }

    fn state(&self) -> BodiesState<N> {
        self.aside.state()
    }
}
