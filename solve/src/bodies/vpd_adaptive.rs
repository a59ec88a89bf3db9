//! VPD for several bodies with steps of one length in a time of its own that slows down where points of theirs come close: the
//! map of [`super::vpd`] for bodies in a rescaled time (`rescaled.rs`), in the steps of `stepper/own_steps.rs`. H0 is the
//! energy at the start of the trajectory, wherever it is resumed.
//!
//! Invariant: that of its own steps.

use super::motion::BodiesMotion;
use super::rescaled::BodiesTimeScale;
use super::trajectory::{BodiesStepper, Checkpoint, OwnTime};
use super::vpd::BodiesVpd;
use super::{Bodies, BodiesState};
use crate::compensated::Sum;
use crate::failure::Failure;
use crate::nonlinear::{Convergence, StopRule};
use crate::state::Pace;
use crate::stepper::galerkin::Length;
use crate::stepper::own_steps::{OwnMap, OwnStepEnd, OwnSteps};
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
    steps: OwnSteps<BodiesMotion<N>>,
}

/// Steppers in their own time.
#[derive(Clone, Debug)]
struct Own<const N: usize> {
    ahead: BodiesVpd<N>,
    aside: BodiesVpd<N>,
}

/// The map of bodies in their own time.
struct Map<'a, const N: usize> {
    bodies: &'a Bodies<N>,
    scale: &'a BodiesTimeScale,
    own: &'a mut Own<N>,
}

impl<const N: usize> OwnMap<BodiesMotion<N>> for Map<'_, N> {
    fn step(
        &mut self,
        from: &BodiesMotion<N>,
        dtau: f64,
    ) -> Result<(BodiesMotion<N>, Convergence, f64), Failure> {
        let Self { bodies, own: Own { ahead, .. }, .. } = self;
        ahead.motion = from.clone();
        let (solved, lasts_s) = ahead.timed_step(bodies, dtau)?;
        Ok((ahead.motion.clone(), solved, lasts_s))
    }

    fn extra_step(
        &mut self,
        from: &BodiesMotion<N>,
        length: Length,
    ) -> Result<(BodiesMotion<N>, u32, [f64; 2]), Failure> {
        let Self { bodies, own: Own { aside, .. }, .. } = self;
        aside.motion = from.clone();
        let (solved, made_and_lasted) = aside.advanced(bodies, length)?;
        Ok((aside.motion.clone(), solved.iterations, made_and_lasted))
    }

    fn sigma(&mut self, motion: &BodiesMotion<N>) -> Result<f64, Failure> {
        let BodiesState { attitudes, places, .. } = motion.state();
        self.scale.sigma(self.bodies, &attitudes, &places)
    }
}

/// Returns the own steps of a trajectory that begins at `state`.
fn begun<const N: usize>(state: &BodiesState<N>) -> OwnSteps<BodiesMotion<N>> {
    let motion = BodiesMotion::new(state);
    OwnSteps::new(0, OwnStepEnd::at_start(motion.clone()), motion)
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
            steps: begun(state),
        }
    }

    /// Sets own steps of `longest_s` seconds.
    pub fn with_steps_of(self, longest_s: f64) -> Self {
        Self { longest_s: Some(longest_s), ..self }
    }

    /// Returns its steps and their map for `bodies`, with H0.
    fn in_own_time<'a>(
        &'a mut self,
        bodies: &'a Bodies<N>,
    ) -> Result<(&'a mut OwnSteps<BodiesMotion<N>>, Map<'a, N>), Failure> {
        let Self { scale, plain, start, own, steps, .. } = self;
        if own.is_none() {
            let seen = bodies.seen(start).ok_or(Failure::not_finite(None))?;
            let energy = bodies.energy(start, &seen).total();
            let [ahead, aside] = plain.clone().map(|plain| plain.rescaled(scale.clone(), energy));
            *own = Some(Own { ahead, aside });
        }
        let own = own.as_mut().ok_or(Failure::not_finite(None))?;
        Ok((steps, Map { bodies, scale, own }))
    }

    /// Lets the next own step begin with a guess from its state alone.
    fn forget_steps(&mut self) {
        if let Some(Own { ahead, .. }) = &mut self.own {
            ahead.start(&self.steps.last.motion.state());
        }
    }
}

impl<const N: usize> BodiesStepper<N> for BodiesVpdAdaptive<N> {
    fn order(&self) -> u32 {
        self.plain[0].order()
    }

    fn start(&mut self, state: &BodiesState<N>) {
        (self.start, self.own, self.steps) = (state.clone(), None, begun(state));
    }

    fn resume(&mut self, state: &BodiesState<N>, checkpoint: &Checkpoint) {
        let own = checkpoint.own_time.as_ref();
        let then = own.and_then(|own| Some((own, state.with_numbers(&own.numbers)?)));
        let here = BodiesMotion::new(state);
        let last = match then {
            Some((own, state)) => OwnStepEnd {
                motion: BodiesMotion::new(&state),
                time_s: Sum { value: own.time_s, carry: own.carry_s },
                steps: own.steps,
            },
            None => OwnStepEnd::at_start(here.clone()),
        };
        self.steps = OwnSteps::new(checkpoint.step, last, here);
        self.forget_steps();
    }

    fn own_step_s(&mut self) -> Option<&mut f64> {
        self.longest_s.as_mut()
    }

    fn own_time(&self) -> Option<OwnTime> {
        let OwnStepEnd { motion, time_s: Sum { value: time_s, carry: carry_s }, steps } =
            &self.steps.last;
        let numbers = motion.state().numbers();
        Some(OwnTime { numbers, time_s: *time_s, carry_s: *carry_s, steps: *steps })
    }

    fn step(&mut self, bodies: &Bodies<N>, h: f64) -> Result<Convergence, Failure> {
        let dtau = self.longest_s.unwrap_or(h);
        let (steps, mut map) = self.in_own_time(bodies)?;
        let solved = steps.step(&mut map, h, dtau);
        if solved.is_err() {
            self.forget_steps();
        }
        solved
    }

    fn synchronise(&mut self, bodies: &Bodies<N>, h: f64) -> Result<u32, Failure> {
        let dtau = self.longest_s.unwrap_or(h);
        let (steps, mut map) = self.in_own_time(bodies)?;
        steps.synchronise(&mut map, h, dtau)
    }

    fn pace(&mut self) -> Option<Pace> {
        self.steps.forget_least_sigma();
        Some(self.steps.pace)
    }

    fn state(&self) -> BodiesState<N> {
        self.steps.here.state()
    }
}
