//! Control of a body by samples: every so often the state is read, a command computed, and held until the next one.
//!
//! Between two commands nothing depends on the state, so that the body is one of those that change with time:
//!
//! ```text
//! a torque in the body       mu' = [mu, Omega] - dH/dg + F_tau
//! wheels, motor torques u    mu = J Omega + sum_i a_i h_i,   h_i' = u_i
//! a magnetic moment m        U = -m . g^T B(t)
//! ```
//!
//! J is then the inertia without the wheels about their axes, and the momentum of a wheel about its axis
//! `h_i = j_i (w_i + a_i . Omega)`. Motor torques are internal: a body that wheels alone turn is Hamiltonian, and its spatial
//! momentum stays; its energy changes by the work of the motors, `dH/dt = -sum_i u_i a_i . Omega`. The field of a magnetic moment
//! is a potential.
//!
//! Invariant: a command is a function of the state at its sample, of those before it and of the time.

use std::cell::Cell;

use nalgebra::{DMatrix, Matrix3, Vector3};

use super::RigidBody;
use super::driven::{DipoleField, DrivenTerm, Factor, Path, Spin, Torque};
use super::term::{Law, Term};
use crate::control::{ControlLaw, ControlSample, ControlState, Target};
use crate::noise::{Kind, Noise};
use crate::so::{self, Mat, Vector};
use crate::time::{Time, rounding_s};

/// A law of control, where it aims, and what it acts through.
#[derive(Clone, Debug, PartialEq)]
pub struct Control<const N: usize> {
    /// Time between samples, in s.
    pub every_s: f64,
    /// Time from a sample to when its command acts, in s, at most `every_s`.
    pub delay_s: f64,
    /// Commands of torque are whole multiples of this, in N m; zero for any.
    pub quantum_n_m: f64,
    /// The attitude aimed at.
    pub target: Option<Target<N>>,
    /// The laws; their commands add up.
    pub laws: Vec<ControlLaw>,
    /// What commands act through.
    pub actuator: Actuator<N>,
    /// Noise of what is read, and of a torque that is held between samples.
    pub noise: Option<Noise>,
}

/// What a command acts through.
#[derive(Clone, Debug, PartialEq)]
pub enum Actuator<const N: usize> {
    /// A torque on the body.
    Torque {
        /// Largest size of each component, in N m.
        limit: f64,
    },
    /// Reaction wheels.
    Wheels(ReactionWheels<N>),
    /// Three coils in a magnetic field; n = 3. A torque wanted asks for the moment `B x torque / |B|^2`.
    Magnetorquers {
        /// Largest size of each component of the moment, in A m^2.
        limit: f64,
        /// The field.
        field: DipoleField,
    },
}

/// Wheels with motors; n = 3.
#[derive(Clone, Debug, PartialEq)]
pub struct ReactionWheels<const N: usize> {
    /// Their axes as elements of so(n), each of length one.
    axes: Vec<Mat<N>>,
    /// Their moments of inertia about these, in kg m^2.
    moments: Vec<f64>,
    /// Their momenta about these at the start, in N m s.
    momenta: Vec<f64>,
    /// Largest motor torque, in N m.
    torque_limit: f64,
    /// Largest momentum relative to the body, in N m s.
    momentum_limit: f64,
    /// A torque wanted of the body is minus the sum of its products with these, times the axes.
    shares: Vec<Mat<N>>,
}

impl<const N: usize> ReactionWheels<N> {
    /// Creates wheels: axes (unit vectors of the body), moments in kg m^2, momenta at the start in N m s, and the limits of torque
    /// (N m) and of momentum relative to the body (N m s). `None` if n is not 3, the numbers of them differ, or no torque can be
    /// shared among the axes: up to three must be independent, and more must span space.
    pub fn new(
        axes: &[[f64; 3]],
        moments: Vec<f64>,
        momenta: Vec<f64>,
        torque_limit: f64,
        momentum_limit: f64,
    ) -> Option<Self> {
        /// Determinant of unit vectors below which they count as dependent.
        const DEPENDENT: f64 = 1e-12;
        let k = axes.len();
        if N != 3 || k == 0 || moments.len() != k || momenta.len() != k {
            return None;
        }
        let a = DMatrix::from_fn(3, k, |i, j| axes[j][i]);
        // The least motor torques: A^T (A A^T)^-1 of three or more, (A^T A)^-1 A^T of fewer.
        let shares = if k < 3 {
            let gram = a.transpose() * &a;
            if !(gram.determinant() > DEPENDENT) {
                return None;
            }
            gram.try_inverse()? * a.transpose()
        } else {
            let gram = Matrix3::from_fn(|i, j| (0..k).map(|m| a[(i, m)] * a[(j, m)]).sum());
            if !(gram.determinant() > DEPENDENT) {
                return None;
            }
            let inverse = gram.try_inverse()?;
            a.transpose() * DMatrix::from_fn(3, 3, |i, j| inverse[(i, j)])
        };
        let hat = |v: [f64; 3]| so::hat::<N>(&v);
        Some(Self {
            axes: axes.iter().map(|&axis| hat(axis)).collect(),
            moments,
            momenta,
            torque_limit,
            momentum_limit,
            shares: (0..k).map(|i| hat([shares[(i, 0)], shares[(i, 1)], shares[(i, 2)]])).collect(),
        })
    }

    /// `sum_i a_i x_i`
    fn along(&self, x: &[f64]) -> Mat<N> {
        self.axes.iter().zip(x).fold(Mat::zeros(), |sum, (axis, x)| sum + axis * *x)
    }
}

impl<const N: usize> Control<N> {
    /// The first time later than `after_s` at which a sample is taken or a command begins to act.
    pub(super) fn next_knot(&self, after_s: f64) -> f64 {
        let next = |delay_s: f64| {
            let number = ((after_s - delay_s) / self.every_s).floor().max(-1.0);
            let mut time_s = (number + 1.0) * self.every_s + delay_s;
            if time_s <= after_s {
                time_s = (number + 2.0) * self.every_s + delay_s;
            }
            time_s
        };
        let sample_s = next(0.0);
        if self.acts_between() { sample_s.min(next(self.delay_s)) } else { sample_s }
    }

    /// Do commands begin to act between two samples?
    fn acts_between(&self) -> bool {
        self.delay_s > 0.0 && self.delay_s < self.every_s
    }

    /// What is known before the first sample.
    pub(crate) fn start(&self) -> ControlState {
        let (acting, momenta) = match &self.actuator {
            Actuator::Torque { .. } => (so::dimension(N), Vec::new()),
            Actuator::Wheels(wheels) => (wheels.axes.len(), wheels.momenta.clone()),
            Actuator::Magnetorquers { .. } => (3, Vec::new()),
        };
        ControlState {
            acting: vec![0.0; acting],
            momenta,
            integral: vec![0.0; so::dimension(N)],
            ..ControlState::default()
        }
    }

    /// Is it what a controller of this control may know? One from a file may be of another.
    pub(crate) fn fits(&self, state: &ControlState) -> bool {
        let own = self.start();
        let ControlState { acting, waiting, momenta, integral, field, .. } = state;
        let same = |a: &[f64], b: &[f64]| a.len() == b.len();
        same(acting, &own.acting)
            && same(momenta, &own.momenta)
            && same(integral, &own.integral)
            && (waiting.is_empty() || same(waiting, &own.acting))
            && matches!(field.len(), 0 | 3)
    }

    /// The time of the next sample.
    fn sample_s(&self, state: &ControlState) -> f64 {
        state.samples as f64 * self.every_s
    }

    /// The time from which the waiting command acts.
    fn acts_s(&self, state: &ControlState) -> f64 {
        (state.samples as f64 - 1.0) * self.every_s + self.delay_s
    }

    /// Brings the control of `body` up to a time: lets commands act that waited, and takes the sample that is due, at the attitude
    /// and the momentum that `read` returns. Returns that sample, and the energy in J by which the potential jumps.
    pub(crate) fn advance(
        &self,
        state: &mut ControlState,
        body: &mut RigidBody<N>,
        time_s: f64,
        read: impl FnOnce() -> (Mat<N>, Mat<N>),
    ) -> (Option<ControlSample>, f64) {
        let until_s = time_s + rounding_s(time_s);
        let (acts_s, sample_s) = (self.acts_s(state), self.sample_s(state));
        let acts = !state.waiting.is_empty() && acts_s <= until_s;
        if !acts && !(sample_s <= until_s) {
            return (None, 0.0);
        }
        let (g, mu) = read();
        let mut jump = 0.0;
        if acts {
            let command = std::mem::take(&mut state.waiting);
            jump += self.act(state, body, acts_s, command, &g);
        }
        if !(sample_s <= until_s) {
            return (None, jump);
        }
        let sample = self.sample(state, body, sample_s, &g, &mu);
        state.samples += 1;
        if self.delay_s > 0.0 {
            state.waiting = sample.command.clone();
            self.disturb(state, body);
        } else {
            jump += self.act(state, body, sample_s, sample.command.clone(), &g);
        }
        (Some(sample), jump)
    }

    /// Lets a command act on the body from a time on; returns the energy by which the potential jumps.
    fn act(
        &self,
        state: &mut ControlState,
        body: &mut RigidBody<N>,
        time_s: f64,
        command: Vec<f64>,
        g: &Mat<N>,
    ) -> f64 {
        let mut jump = 0.0;
        match &self.actuator {
            Actuator::Torque { .. } => {}
            Actuator::Wheels(_) => state.momenta = self.wheel_momenta(state, time_s),
            Actuator::Magnetorquers { field, .. } => {
                let field = field.at::<N>(Time::of(time_s)).0;
                let field = so::to_body(g, &field);
                jump = (0..3).map(|i| (state.acting[i] - command[i]) * field[i]).sum();
            }
        }
        state.acting = command;
        state.since_s = time_s;
        self.hold(state, body);
        jump
    }

    /// Sets the torque noise of the last sample in the body.
    fn disturb(&self, state: &ControlState, body: &mut RigidBody<N>) {
        let Some(noise) = self.torque_noise() else { return };
        let Some(last) = state.samples.checked_sub(1) else { return };
        // Behind the command, if that is a torque.
        if let Some(Torque::Body(torque)) = body.driven.torques.last_mut() {
            *torque = noise.draw(Kind::Torque, last);
        }
    }

    fn torque_noise(&self) -> Option<&Noise> {
        self.noise.as_ref().filter(|noise| noise.torque > 0.0)
    }

    /// Sets what acts in the body: the command, and the torque noise.
    pub(crate) fn hold(&self, state: &ControlState, body: &mut RigidBody<N>) {
        self.disturb(state, body);
        match &self.actuator {
            Actuator::Torque { .. } => {
                let commanded = body.driven.commanded;
                if let Some(Torque::Body(torque)) = body.driven.torques.get_mut(commanded) {
                    *torque = so::hat(&state.acting);
                }
            }
            Actuator::Wheels(wheels) => {
                body.wheels = Some(wheels.along(&state.momenta));
                body.driven.spin =
                    Some(Spin { rate: wheels.along(&state.acting), since_s: state.since_s });
            }
            Actuator::Magnetorquers { .. } => {
                let commanded = body.driven.commanded;
                if let Some(term) = body.driven.terms.get_mut(commanded) {
                    term.term.law = moment::<N>(&state.acting);
                }
            }
        }
    }

    /// The momenta of the wheels at a time, under the command that acts.
    fn wheel_momenta(&self, state: &ControlState, time_s: f64) -> Vec<f64> {
        let acting = state.momenta.iter().zip(&state.acting);
        acting.map(|(momentum, torque)| momentum + torque * (time_s - state.since_s)).collect()
    }

    fn sample(
        &self,
        state: &mut ControlState,
        body: &RigidBody<N>,
        time_s: f64,
        g: &Mat<N>,
        mu: &Mat<N>,
    ) -> ControlSample {
        let now = body.at(Time::of(time_s)).body;
        let omega = now.velocity(mu);
        let read = self.read(state.samples, &now, (g, &omega, mu));
        let (error, angle, rate_error) = match &self.target {
            Some(target) => {
                let (error, angle) = target.error(time_s, &read.attitude);
                let turning = so::conjugate(&read.attitude.transpose(), &target.rate());
                (error, Some(angle), read.velocity - turning)
            }
            None => (Mat::zeros(), None, read.velocity),
        };
        for (sum, error) in state.integral.iter_mut().zip(so::vee(&error)) {
            *sum += error * self.every_s;
        }
        let mut torque = Mat::<N>::zeros();
        let mut moment = [0.0; 3];
        let mut friction = 0.0;
        let field = match &self.actuator {
            Actuator::Magnetorquers { field, .. } => {
                let field = so::to_body(g, &field.at::<N>(Time::of(time_s)).0);
                field.iter().copied().take(3).collect()
            }
            _ => Vec::new(),
        };
        for law in &self.laws {
            match *law {
                ControlLaw::Attitude { gain, rate_gain, integral_gain, feed_forward } => {
                    torque -= error * gain
                        + rate_error * rate_gain
                        + so::hat::<N>(&state.integral) * integral_gain;
                    if feed_forward {
                        torque -= so::asym(&so::product(&read.momentum, &read.velocity));
                    }
                }
                ControlLaw::Damping { rate_gain } => torque -= read.velocity * rate_gain,
                ControlLaw::BDot { gain } => {
                    for i in 0..field.len().min(state.field.len()).min(3) {
                        moment[i] -= gain * (field[i] - state.field[i]) / self.every_s;
                    }
                }
                ControlLaw::WheelFriction { coefficient } => friction += coefficient,
            }
        }
        let mut wanted = so::vee(&torque);
        let is_saturated = Cell::new(false);
        let note = |changed: bool| is_saturated.set(is_saturated.get() || changed);
        let limited = |value: f64, limit: f64| {
            note(value.abs() > limit);
            value.clamp(-limit, limit)
        };
        let whole = |value: f64| {
            let quantum = self.quantum_n_m;
            if quantum > 0.0 { libm::round(value / quantum) * quantum } else { value }
        };
        let (mut wheel_momenta, mut wheel_speeds) = (Vec::new(), Vec::new());
        let command = match &self.actuator {
            &Actuator::Torque { limit } => {
                wanted.iter().map(|&torque| whole(limited(torque, limit))).collect()
            }
            Actuator::Wheels(wheels) => {
                // The command of this sample acts after its delay; until then the last one does.
                let begins = self.wheel_momenta(state, time_s + self.delay_s);
                wheel_momenta = self.wheel_momenta(state, time_s);
                let mut command = Vec::with_capacity(wheels.axes.len());
                for (i, axis) in wheels.axes.iter().enumerate() {
                    let with_body = wheels.moments[i] * so::inner(axis, &omega);
                    if wheels.moments[i] > 0.0 {
                        wheel_speeds.push((wheel_momenta[i] - with_body) / wheels.moments[i]);
                    }
                    let motor = -so::inner(&wheels.shares[i], &torque);
                    let mut motor = whole(limited(motor, wheels.torque_limit));
                    if friction != 0.0 && wheels.moments[i] > 0.0 {
                        motor -= friction * (wheel_momenta[i] - with_body) / wheels.moments[i];
                    }
                    // Relative to the body the wheel stays below its limit at the end.
                    let relative = begins[i] - with_body;
                    let room = |limit: f64| (limit - relative) / self.every_s;
                    let (low, high) = (room(-wheels.momentum_limit), room(wheels.momentum_limit));
                    let kept = motor.clamp(low.min(0.0), high.max(0.0));
                    note(kept != motor);
                    command.push(kept);
                }
                command
            }
            &Actuator::Magnetorquers { limit, .. } => {
                // The moment across the field whose torque m x B is the wanted one, where that can be.
                let square: f64 = field.iter().map(|b| b * b).sum();
                if square > 0.0 {
                    let t = Vector3::from_column_slice(&wanted);
                    let b = Vector3::from_column_slice(&field);
                    let across = b.cross(&t) / square;
                    (0..3).for_each(|i| moment[i] += across[i]);
                }
                if self.laws.iter().any(|law| matches!(law, ControlLaw::BDot { .. })) {
                    wanted = moment.to_vec();
                }
                moment.iter().map(|&m| limited(m, limit)).collect()
            }
        };
        state.field.clone_from(&field);
        ControlSample {
            time_s,
            wanted,
            command,
            is_saturated: is_saturated.get(),
            pointing_error_rad: angle,
            attitude_error: if angle.is_some() { so::vee(&error) } else { Vec::new() },
            rate_error: so::vee(&rate_error),
            wheel_momenta,
            wheel_speeds,
            field,
            disturbance: self.torque_noise().map_or_else(Vec::new, |noise| {
                so::vee(&noise.draw::<N>(Kind::Torque, state.samples))
            }),
        }
    }

    /// Returns what the sensors show at sample `number`.
    fn read(
        &self,
        number: u64,
        now: &RigidBody<N>,
        (g, omega, mu): (&Mat<N>, &Mat<N>, &Mat<N>),
    ) -> Read<N> {
        let mut read = Read { attitude: *g, velocity: *omega, momentum: *mu };
        let Some(noise) = &self.noise else { return read };
        if noise.attitude > 0.0 {
            let turn = so::exp(&noise.draw(Kind::Attitude, number));
            read.attitude = so::product(g, &turn);
        }
        if noise.rate > 0.0 {
            read.velocity += noise.draw::<N>(Kind::Rate, number);
            read.momentum = now.momentum(&read.velocity);
        }
        read
    }
}

/// What the sensors of a controller show.
struct Read<const N: usize> {
    attitude: Mat<N>,
    velocity: Mat<N>,
    momentum: Mat<N>,
}

/// The potential of a magnetic moment in the body: `-m . q`.
fn moment<const N: usize>(m: &[f64]) -> Law<N> {
    let body_point = Vector::from_fn(|i, _| m.get(i).copied().unwrap_or_default());
    Law::Uniform { weight: -1.0, body_point }
}

/// The term of a magnetic moment in the body (in A m^2) in a field; n = 3.
pub fn magnetic_term<const N: usize>(m: &[f64; 3], field: DipoleField) -> DrivenTerm<N> {
    // The field takes the place of the space vector; its largest value says how large that is.
    let space = field.at::<N>(Time::of(0.0)).0;
    DrivenTerm {
        term: Term { law: moment(m), space },
        path: Path::Dipole(Box::new(field)),
        factor: Factor::Constant,
    }
}

impl<const N: usize> RigidBody<N> {
    /// Adds a control, to be stepped by [`crate::stepper::controlled::Controlled`]; after all torques. The inertia of a body with
    /// wheels is the one without theirs about their axes.
    pub fn with_control(mut self, control: Control<N>) -> Self {
        match &control.actuator {
            Actuator::Torque { .. } => {
                self.driven.commanded = self.driven.torques.len();
                self.driven.torques.push(Torque::Body(Mat::zeros()));
            }
            Actuator::Wheels(_) => {}
            Actuator::Magnetorquers { field, .. } => {
                self.driven.commanded = self.driven.terms.len();
                self.driven.terms.push(magnetic_term(&[0.0; 3], *field));
            }
        }
        if control.torque_noise().is_some() {
            self.driven.torques.push(Torque::Body(Mat::zeros()));
        }
        control.hold(&control.start(), &mut self);
        self.control = Some(Box::new(control));
        self
    }

    /// Its control, if it has one.
    pub fn control(&self) -> Option<&Control<N>> {
        self.control.as_deref()
    }
}
