//! A body under control, with the stepper of its method: see [`crate::hamiltonian::Control`].
//!
//! Invariant: a command changes only between two steps, at the times that [`super::Knots`] ends them.

use super::{Clock, Stepper};
use crate::control::{ControlSample, ControlState};
use crate::failure::Failure;
use crate::hamiltonian::{Control, RigidBody};
use crate::noise::Noise;
use crate::nonlinear::Convergence;
use crate::so::Mat;
use crate::state::{Checkpoint, State};

/// The stepper: that of the method, the body with the command that acts, and what the controller knows.
pub struct Controlled<const N: usize> {
    method: Box<dyn Stepper<N>>,
    law: Control<N>,
    body: RigidBody<N>,
    control: ControlState,
    /// The noise of the control as it was given.
    noise: Option<Noise>,
    /// The last sample.
    sample: Option<ControlSample>,
    /// The time at which the next step begins, in s.
    time_s: f64,
}

impl<const N: usize> Controlled<N> {
    /// Creates a stepper of a body that is stepped by `method`; `None` unless it has a control: see
    /// [`RigidBody::with_control`].
    pub fn new(method: Box<dyn Stepper<N>>, body: RigidBody<N>) -> Option<Self> {
        let law = body.control()?.clone();
        let control = law.start();
        let noise = law.noise;
        Some(Self { method, law, body, control, noise, sample: None, time_s: 0.0 })
    }

    /// Lets the control do what is due.
    fn advance(&mut self) {
        let Self { method, law, body, control, time_s, .. } = self;
        let read = || (method.attitude().unwrap_or_else(Mat::identity), method.momentum());
        let (sample, jump) = law.advance(control, body, *time_s, read);
        if sample.is_some() {
            self.sample = sample;
        }
        if let Some(clock) = self.method.clock_mut().filter(|_| jump != 0.0) {
            clock.add_jump(jump);
        }
    }
}

impl<const N: usize> Stepper<N> for Controlled<N> {
    fn order(&self) -> u32 {
        self.method.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.method.start(state);
        self.time_s = 0.0;
        self.control = self.law.start();
        self.sample = None;
        self.law.hold(&self.control, &mut self.body);
        self.advance();
    }

    fn resume(&mut self, checkpoint: &Checkpoint<N>) {
        match &checkpoint.control {
            Some(control) if self.law.fits(control) => {
                self.method.resume(checkpoint);
                self.set_control(control);
            }
            _ => self.start(&checkpoint.state()),
        }
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        self.body.work_as(body);
        let solved = self.method.step(&self.body, h);
        body.count_as(&self.body);
        let solved = solved?;
        self.time_s += h;
        self.advance();
        Ok(solved)
    }

    fn acting(&self) -> Option<&RigidBody<N>> {
        Some(&self.body)
    }

    fn control(&self) -> Option<&ControlState> {
        Some(&self.control)
    }

    fn set_control(&mut self, control: &ControlState) {
        self.control.clone_from(control);
        self.sample = None;
        self.law.hold(&self.control, &mut self.body);
    }

    fn set_member(&mut self, member: u64) {
        if let (Some(noise), Some(given)) = (&mut self.law.noise, &self.noise) {
            noise.stream = given.stream.wrapping_add(member);
        }
    }

    fn control_sample(&self) -> Option<&ControlSample> {
        self.sample.as_ref()
    }

    fn set_time(&mut self, time_s: f64) {
        self.time_s = time_s;
        self.method.set_time(time_s);
    }

    fn clock(&self) -> Option<&Clock<N>> {
        self.method.clock()
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        self.method.clock_mut()
    }

    fn attitude(&self) -> Option<Mat<N>> {
        self.method.attitude()
    }

    fn momentum(&self) -> Mat<N> {
        self.method.momentum()
    }

    fn sigma_min(&self) -> Option<f64> {
        self.method.sigma_min()
    }
}
