//! The time loop of several bodies: a stepper carries their state forward, samples go to a sink, as
//! [`crate::trajectory`] does for one.
//!
//! Invariant: a sample holds finite numbers only, belongs to an accepted step, and comes in order of time; at a checkpoint the
//! stepper starts anew from what the checkpoint holds.

use super::{Bodies, BodiesCondition, BodiesState, Configuration, Forces};
use crate::failure::{Failure, FailureCode};
use crate::lanes::Real;
use crate::nonlinear::Convergence;
use crate::so::{self, Mat, Vector};
use crate::state::Pace;
use crate::stop;
use crate::system::{Energy, free_directions};
pub use crate::trajectory::{Ending, Schedule};

/// A scheme for several bodies.
pub trait BodiesStepper<const N: usize>: Send {
    /// Order of the scheme.
    fn order(&self) -> u32;

    /// Begins at a state; whatever was there before is forgotten.
    fn start(&mut self, state: &BodiesState<N>);

    /// Carries the state forward by `h` seconds.
    ///
    /// # Errors
    /// Any failure; the state is then untouched.
    fn step(&mut self, bodies: &Bodies<N>, h: f64) -> Result<Convergence, Failure>;

    /// The state; of a scheme with a time of its own that where it was last brought to ([`BodiesStepper::synchronise`]).
    fn state(&self) -> BodiesState<N>;

    /// Brings a scheme with a time of its own to the end of the last step, of `h` seconds as all; returns the sweeps of that.
    ///
    /// # Errors
    /// Any failure.
    fn synchronise(&mut self, _bodies: &Bodies<N>, _h: f64) -> Result<u32, Failure> {
        Ok(0)
    }

    /// Goes on from a checkpoint of the trajectory that was started, with this state.
    fn resume(&mut self, state: &BodiesState<N>, _checkpoint: &Checkpoint) {
        self.start(state);
    }

    /// Its position in its own time; `None` for a scheme with none.
    fn own_time(&self) -> Option<OwnTime> {
        None
    }

    /// Its longest own step in s, if it was set.
    fn own_step_s(&mut self) -> Option<&mut f64> {
        None
    }

    /// Pace of time where it was last brought to, and since it was last asked; `None` for a scheme with no time of its own.
    fn pace(&mut self) -> Option<Pace> {
        None
    }
}

/// Position of a scheme in its own time: the end of its last own step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OwnTime {
    /// The state there, see [`BodiesState::numbers`].
    pub numbers: Vec<f64>,
    /// The time there, in seconds since the start.
    pub time_s: f64,
    /// Part of that time lost to rounding.
    pub carry_s: f64,
    /// Own steps made.
    pub steps: u64,
}

/// One body in a sample.
#[derive(Clone, Debug, PartialEq)]
pub struct BodySample<const N: usize> {
    /// The attitude g.
    pub attitude: Mat<N>,
    /// The body momentum, skew.
    pub momentum: Mat<N>,
    /// The body angular velocity, skew, in rad/s.
    pub angular_velocity: Mat<N>,
    /// The centre of mass, of a pinned body its pivot, in m.
    pub position: Vector<N>,
    /// Its velocity in m/s.
    pub velocity: Vector<N>,
    /// Mass times velocity, in kg m/s; zero for a pinned body.
    pub linear_momentum: Vector<N>,
}

/// One sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// Number of the step that ended here; 0 at the start.
    pub step: u64,
    /// Time in seconds since the start.
    pub time_s: f64,
    /// The bodies, in their order.
    pub bodies: Vec<BodySample<N>>,
    /// Energy H = T + U.
    pub energy: Option<Energy>,
    /// Energy now minus energy at the start.
    pub energy_error: Option<f64>,
    /// The largest distance of an attitude from the group.
    pub orthogonality_error: Option<f64>,
    /// Total angular momentum about the origin, in space coordinates, skew.
    pub angular_momentum: Option<Mat<N>>,
    /// Total linear momentum of what moves freely.
    pub linear_momentum: Option<Vector<N>>,
    /// Size of the change of the conserved part of the total angular momentum since the start; `None` also where nothing of
    /// it is conserved.
    pub momentum_drift: Option<f64>,
    /// How the nonlinear solver ended the step; `None` at the start.
    pub convergence: Option<Convergence>,
    /// Pace of time for the scheme; `None` for one with no time of its own.
    pub pace: Option<Pace>,
}

impl<const N: usize> Sample<N> {
    /// Is every number of it finite?
    pub fn is_finite(&self) -> bool {
        let bodies = self.bodies.iter().all(|body| {
            let matrices = [&body.attitude, &body.momentum, &body.angular_velocity];
            let vectors = [&body.position, &body.velocity, &body.linear_momentum];
            matrices
                .into_iter()
                .flatten()
                .chain(vectors.into_iter().flatten())
                .all(|x| x.is_finite())
        });
        let figures = [
            self.energy.map(|energy| energy.total()),
            self.energy_error,
            self.orthogonality_error,
            self.momentum_drift,
        ];
        let angular = self.angular_momentum.iter().flatten();
        let linear = self.linear_momentum.iter().flatten();
        bodies
            && figures.into_iter().flatten().all(f64::is_finite)
            && self.pace.is_none_or(|pace| pace.is_finite())
            && angular.chain(linear).all(|x| x.is_finite())
    }
}

/// Length and resolution of a trajectory, and where it begins.
#[derive(Clone, Copy, Debug)]
pub struct Course<'a, const N: usize> {
    /// The state at t = 0.
    pub initial: &'a BodiesState<N>,
    /// Checkpoint to go on from.
    pub checkpoint: Option<&'a Checkpoint>,
    /// The step h in seconds.
    pub step_s: f64,
    /// Number of steps.
    pub steps: u64,
    /// A sample is taken every k steps, at the start and at the end.
    pub every: u64,
}

/// State of a trajectory at a sample: all that it needs, in addition to its start, to go on from there.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// Steps made.
    pub step: u64,
    /// Samples recorded, that of this step included.
    pub samples: u64,
    /// Sweeps of the nonlinear solver in all.
    pub iterations: u64,
    /// How the last step was solved.
    pub convergence: Option<Convergence>,
    /// The state, see [`BodiesState::numbers`].
    pub numbers: Vec<f64>,
    /// Since when each of [`Bodies::stops`] has held, in s; `None` where it does not.
    pub holds_since_s: Vec<Option<f64>>,
    /// Own time of a scheme that has one.
    pub own_time: Option<OwnTime>,
}

/// Destination of samples.
pub trait Sink<const N: usize> {
    /// Error of keeping a sample.
    type Error;

    /// Takes one sample.
    ///
    /// # Errors
    /// Ends the trajectory.
    fn record(&mut self, sample: &Sample<N>) -> Result<(), Self::Error>;

    /// Returns whether a checkpoint is wanted at the last sample.
    fn wants_checkpoint(&self) -> bool {
        false
    }

    /// Takes the checkpoint it wanted.
    ///
    /// # Errors
    /// Ends the trajectory.
    fn checkpoint(&mut self, _checkpoint: &Checkpoint) -> Result<(), Self::Error> {
        Ok(())
    }
}

impl<const N: usize> Sink<N> for Vec<Sample<N>> {
    type Error = std::convert::Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Self::Error> {
        self.push(sample.clone());
        Ok(())
    }
}

/// Result of a trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// How it ended.
    pub ending: Ending,
    /// Where it ended.
    pub reached: Checkpoint,
    /// When, in s: at the end of a step, unless a condition stopped it within.
    pub time_s: f64,
}

/// Computes samples against a start.
struct Observer<const N: usize> {
    initial_energy: f64,
    initial_angular: Mat<N>,
    conserved: Option<Mat<N>>,
}

impl<const N: usize> Bodies<N> {
    /// Returns what a sample shows of a state; `None` where it has no velocity.
    pub fn seen(&self, state: &BodiesState<N>) -> Option<Vec<BodySample<N>>> {
        let count = self.bodies.len();
        let mut velocities = vec![Mat::zeros(); count];
        self.velocities(&state.attitudes, &state.momenta, &mut velocities).ok()?;
        let mut centres = vec![Vector::zeros(); count];
        self.centres(&state.attitudes, &state.places, &mut centres);
        // r' = x' + sum_b g_b Omega_b l_ab
        let turning: Vec<Mat<N>> = state
            .attitudes
            .iter()
            .zip(&velocities)
            .map(|(g, omega)| so::product(g, omega))
            .collect();
        let mut rates = vec![Vector::zeros(); count];
        let moving: Vec<Vector<N>> = self
            .trees
            .iter()
            .zip(&state.linear_momenta)
            .map(|(tree, p)| tree.mass_kg.map_or_else(Vector::zeros, |mass| p / mass))
            .collect();
        self.centres(&turning, &moving, &mut rates);
        let body = |a: usize| BodySample {
            attitude: state.attitudes[a],
            momentum: state.momenta[a],
            angular_velocity: velocities[a],
            position: centres[a],
            velocity: rates[a],
            linear_momentum: if self.is_pinned(a) {
                Vector::zeros()
            } else {
                rates[a] * self.bodies[a].mass_kg
            },
        };
        Some((0..count).map(body).collect())
    }

    /// Returns the state in which bodies are seen so, by their attitudes, momenta, places and linear momenta.
    ///
    /// # Panics
    /// If there are not as many as bodies.
    pub fn state_of(&self, seen: &[BodySample<N>]) -> BodiesState<N> {
        assert_eq!(seen.len(), self.bodies.len(), "all bodies are seen");
        let (mut places, mut linear_momenta) = (self.fixed.clone(), Vec::new());
        for (tree, place) in self.trees.iter().zip(&mut places) {
            let Some(mass) = tree.mass_kg else {
                linear_momenta.push(Vector::zeros());
                continue;
            };
            let (mut at, mut p) = (Vector::zeros(), Vector::zeros());
            for &a in &tree.bodies {
                at += seen[a].position * (self.bodies[a].mass_kg / mass);
                p += seen[a].linear_momentum;
            }
            *place = at;
            linear_momenta.push(p);
        }
        BodiesState {
            attitudes: seen.iter().map(|body| body.attitude).collect(),
            momenta: seen.iter().map(|body| body.momentum).collect(),
            places,
            linear_momenta,
        }
    }

    /// Returns about how fast everything changes at a state, in rad/s: the largest of the bodies' angular velocities, of the
    /// roots of their angular accelerations, and of the forces on trees in parts of their linear momenta. Where nothing can be
    /// computed, 0.
    pub fn rate(&self, state: &BodiesState<N>) -> f64 {
        let BodiesState { attitudes, momenta, places, linear_momenta } = state;
        let mut velocities = vec![Mat::zeros(); self.bodies.len()];
        let mut accelerations = velocities.clone();
        let mut forces = Forces::none(self.bodies.len(), self.trees.len());
        let at_state = self.velocities(attitudes, momenta, &mut velocities).and_then(|()| {
            self.forces(Configuration { attitudes, places, velocities: &velocities }, &mut forces)
        });
        // [mu, Omega] and the torque, in the body.
        let rates: Vec<Mat<N>> = (0..self.bodies.len())
            .map(|a| {
                let torque = so::conjugate(&attitudes[a].transpose(), &forces.torques[a]);
                so::asym(&so::product(&momenta[a], &velocities[a])) + so::skew(&torque)
            })
            .collect();
        if at_state.and_then(|()| self.velocities(attitudes, &rates, &mut accelerations)).is_err() {
            return 0.0;
        }
        let size = |x: &Mat<N>| so::inner(x, x).sqrt();
        let turning = velocities.iter().map(size);
        let turned = accelerations.iter().map(|x| size(x).sqrt());
        let moved =
            forces.forces.iter().zip(linear_momenta).map(|(force, p)| force.norm() / p.norm());
        turning.chain(turned).chain(moved).filter(|rate| rate.is_finite()).fold(0.0, f64::max)
    }

    /// Returns the energy of a state, in J, of which `bodies` is seen.
    pub fn energy(&self, state: &BodiesState<N>, bodies: &[BodySample<N>]) -> Energy {
        let turning: f64 =
            bodies.iter().map(|body| 0.5 * so::inner(&body.momentum, &body.angular_velocity)).sum();
        let moving = self
            .trees
            .iter()
            .zip(&state.linear_momenta)
            .map(|(tree, p)| tree.mass_kg.map_or(0.0, |mass| p.norm_squared() / (2.0 * mass)));
        Energy {
            kinetic: turning + moving.sum::<f64>(),
            potential: self.potential(&state.attitudes, &state.places),
        }
    }

    /// Returns the total angular momentum about the origin: `sum (g mu g^T + p wedge x)`, with `g' = g Omega`.
    pub fn angular_momentum(&self, state: &BodiesState<N>) -> Mat<N> {
        let mut total = Mat::zeros();
        for (g, mu) in state.attitudes.iter().zip(&state.momenta) {
            total += so::conjugate(g, mu);
        }
        for (x, p) in state.places.iter().zip(&state.linear_momenta) {
            total += so::wedge(p, x);
        }
        total
    }
}

impl<const N: usize> Observer<N> {
    fn new(bodies: &Bodies<N>, initial: &BodiesState<N>) -> Self {
        let seen = bodies.seen(initial).unwrap_or_default();
        let vectors = bodies.space_vectors();
        Self {
            initial_energy: bodies.energy(initial, &seen).total(),
            initial_angular: bodies.angular_momentum(initial),
            conserved: free_directions(&vectors),
        }
    }

    fn sample(
        &self,
        bodies: &Bodies<N>,
        state: &BodiesState<N>,
        (step, time_s): (u64, f64),
        convergence: Option<Convergence>,
        pace: Option<Pace>,
    ) -> Result<Sample<N>, Failure> {
        let seen = bodies.seen(state).ok_or(Failure::not_finite(None))?;
        let energy = bodies.energy(state, &seen);
        let angular = bodies.angular_momentum(state);
        let drift = self.conserved.map(|q| {
            let change = q * (angular - self.initial_angular) * q;
            so::inner(&change, &change).sqrt()
        });
        let from_group = state
            .attitudes
            .iter()
            .map(so::orthogonality_error)
            .fold(0.0, |most: f64, x| Real::max_or_nan(most, x));
        let sample = Sample {
            step,
            time_s,
            bodies: seen,
            energy: Some(energy),
            energy_error: Some(energy.total() - self.initial_energy),
            orthogonality_error: Some(from_group),
            angular_momentum: Some(angular),
            linear_momentum: Some(state.linear_momenta.iter().sum()),
            momentum_drift: drift,
            convergence,
            pace,
        };
        if sample.is_finite() { Ok(sample) } else { Err(Failure::not_finite(None)) }
    }
}

/// Carries a state forward along a course and gives the samples to `sink`: the first at the start, then one every
/// `every` steps, and the last accepted state whatever happens. `go_on(steps_done)` is asked before each step.
///
/// # Errors
/// Those of the sink. A step that fails is not an error but an [`Ending`].
pub fn integrate<const N: usize, S: Sink<N>>(
    bodies: &Bodies<N>,
    stepper: &mut dyn BodiesStepper<N>,
    course: Course<'_, N>,
    sink: &mut S,
    mut go_on: impl FnMut(u64) -> bool,
) -> Result<Trajectory, S::Error> {
    let Course { initial, checkpoint, step_s, steps, every } = course;
    let every = every.max(1);
    let mut bookkeeping = Bookkeeping::new(bodies, initial, step_s);
    stepper.start(initial);
    if let Some(found) = checkpoint {
        stepper.resume(initial.with_numbers(&found.numbers).as_ref().unwrap_or(initial), found);
        bookkeeping.resume(found);
    }
    loop {
        let step = bookkeeping.reached.step;
        let over = step == steps || !bookkeeping.goes_on();
        if (over || step.is_multiple_of(every))
            && let Some(sample) = bookkeeping.sample(bodies, stepper)
        {
            sink.record(&sample)?;
            if !over && sink.wants_checkpoint() {
                bookkeeping.reached.own_time = stepper.own_time();
                sink.checkpoint(&bookkeeping.reached)?;
                let state = stepper.state();
                stepper.resume(&state, &bookkeeping.reached);
            }
        }
        if over || !bookkeeping.goes_on() {
            break;
        }
        if go_on(step) {
            bookkeeping.step(bodies, stepper);
        } else {
            bookkeeping.ending = Ending::Cancelled;
        }
    }
    Ok(bookkeeping.end())
}

/// Carries members of an ensemble forward, each by a stepper of its own, and gives the samples to `record` with the number of
/// their member, in the order of time, those of a time in that of the members. `go_on(steps_done)` is asked before each step.
///
/// # Errors
/// Those of `record`. A step that fails is not an error but an [`Ending`] of its member.
///
/// # Panics
/// If there are fewer steppers than starts.
pub fn integrate_members<const N: usize, E>(
    bodies: &Bodies<N>,
    steppers: &mut [Box<dyn BodiesStepper<N>>],
    starts: &[BodiesState<N>],
    schedule: Schedule,
    mut record: impl FnMut(usize, &Sample<N>) -> Result<(), E>,
    mut go_on: impl FnMut(u64) -> bool,
) -> Result<Vec<Trajectory>, E> {
    let Schedule { step_s, steps, every } = schedule;
    let every = every.max(1);
    assert!(steppers.len() >= starts.len(), "a stepper for each member");
    steppers.iter_mut().zip(starts).for_each(|(stepper, start)| stepper.start(start));
    let mut members: Vec<Bookkeeping<N>> =
        starts.iter().map(|start| Bookkeeping::new(bodies, start, step_s)).collect();
    for step in 0..=steps {
        let is_over = step == steps;
        let goes_on = is_over || go_on(step);
        let mut is_anyone_left = false;
        for (m, (member, stepper)) in members.iter_mut().zip(steppers.iter_mut()).enumerate() {
            if !member.goes_on() {
                continue;
            }
            if !goes_on {
                member.ending = Ending::Cancelled;
            }
            if (is_over || !goes_on || step.is_multiple_of(every))
                && let Some(sample) = member.sample(bodies, stepper.as_mut())
            {
                record(m, &sample)?;
            }
        }
        if is_over {
            break;
        }
        let mut ended = Vec::new();
        for (m, (member, stepper)) in members.iter_mut().zip(steppers.iter_mut()).enumerate() {
            if !member.goes_on() {
                continue;
            }
            member.step(bodies, stepper.as_mut());
            if member.goes_on() {
                is_anyone_left = true;
            } else {
                ended.extend(member.sample(bodies, stepper.as_mut()).map(|sample| (m, sample)));
            }
        }
        // One may have ended within the step before another did.
        ended.sort_by(|(_, a), (_, b)| a.time_s.total_cmp(&b.time_s));
        ended.iter().try_for_each(|(m, sample)| record(*m, sample))?;
        if !is_anyone_left {
            break;
        }
    }
    Ok(members.into_iter().map(Bookkeeping::end).collect())
}

/// The progress record of one trajectory: how far it came, and its samples.
struct Bookkeeping<const N: usize> {
    observer: Observer<N>,
    step_s: f64,
    ending: Ending,
    /// Steps and sweeps are those made, the numbers those of the last sample.
    reached: Checkpoint,
    /// The step of the last sample.
    sampled: Option<u64>,
    /// The time at which a condition stopped the last step within, in s.
    ends_s: Option<f64>,
}

impl<const N: usize> Bookkeeping<N> {
    fn new(bodies: &Bodies<N>, initial: &BodiesState<N>, step_s: f64) -> Self {
        let observer = Observer::new(bodies, initial);
        let (ending, reached) = (Ending::Completed, Checkpoint::default());
        Self { observer, step_s, ending, reached, sampled: None, ends_s: None }
    }

    fn resume(&mut self, found: &Checkpoint) {
        self.reached = found.clone();
        self.sampled = (found.samples > 0).then_some(found.step);
    }

    fn goes_on(&self) -> bool {
        self.ending == Ending::Completed
    }

    /// Makes a step, or a part of one where a condition ends the run within.
    fn step(&mut self, bodies: &Bodies<N>, stepper: &mut dyn BodiesStepper<N>) {
        let is_located = bodies.stops().iter().any(|stop| stop.exact);
        let begun = is_located.then(|| (stepper.state(), self.reached.clone()));
        let mut solved = stepper.step(bodies, self.step_s);
        if !bodies.stops().is_empty() && solved.is_ok() {
            // Conditions are looked at after each step.
            let settled = stepper.synchronise(bodies, self.step_s);
            self.reached.iterations += u64::from(settled.as_ref().copied().unwrap_or_default());
            solved = settled.and(solved);
        }
        self.stepped(solved);
        self.look_for_a_stop(bodies, stepper);
        if let Some((state, reached)) = begun {
            self.end_within(bodies, stepper, &state, reached);
        }
    }

    /// Returns the margin of a condition at the state that a stepper holds: see [`BodiesCondition::margin`]. Where nothing can be
    /// seen, it does not hold.
    fn margin(
        &self,
        condition: &BodiesCondition<N>,
        bodies: &Bodies<N>,
        stepper: &dyn BodiesStepper<N>,
        time_s: f64,
    ) -> f64 {
        let state = stepper.state();
        let Some(seen) = bodies.seen(&state) else { return -1.0 };
        condition.margin(time_s, &seen, || {
            bodies.energy(&state, &seen).total() - self.observer.initial_energy
        })
    }

    /// Ends the trajectory after a step if one of the conditions has held for as long as it asks.
    fn look_for_a_stop(&mut self, bodies: &Bodies<N>, stepper: &dyn BodiesStepper<N>) {
        let stops = bodies.stops();
        if stops.is_empty() || !self.goes_on() {
            return;
        }
        let time_s = self.reached.step as f64 * self.step_s;
        self.reached.holds_since_s.resize(stops.len(), None);
        for (number, stop) in stops.iter().enumerate() {
            let holds = self.margin(&stop.condition, bodies, stepper, time_s) > 0.0;
            let since_s = &mut self.reached.holds_since_s[number];
            if stop::is_over(since_s, holds, time_s, stop.for_s) && self.goes_on() {
                self.ending = Ending::Stopped(number);
            }
        }
    }

    /// Ends a trajectory that a condition has stopped after a step within this step, where the first of the conditions that are
    /// located came to hold: by the scheme's own map over a part of the step, from the state in which that began.
    fn end_within(
        &mut self,
        bodies: &Bodies<N>,
        stepper: &mut dyn BodiesStepper<N>,
        begun: &BodiesState<N>,
        reached: Checkpoint,
    ) {
        let Ending::Stopped(after_step) = self.ending else { return };
        let found = self.reached.holds_since_s.iter().zip(bodies.stops()).enumerate();
        let located: Vec<usize> = found
            .filter(|(_, (since, stop))| since.is_some() && stop.exact && stop.for_s == 0.0)
            .map(|(number, _)| number)
            .collect();
        if located.is_empty() {
            return;
        }
        let held = std::mem::replace(&mut self.reached, reached).holds_since_s;
        let begun_s = self.reached.step as f64 * self.step_s;
        let mut first = (self.step_s, after_step);
        for number in located {
            let condition = &bodies.stops()[number].condition;
            stepper.start(begun);
            // One that holds from the beginning ends the run after the step.
            if self.margin(condition, bodies, stepper, begun_s) > 0.0 {
                continue;
            }
            let part_s = stop::located(self.step_s, |part_s| {
                stepper.start(begun);
                stepper.step(bodies, part_s)?;
                Ok(self.margin(condition, bodies, stepper, begun_s + part_s) > 0.0)
            });
            match part_s {
                Ok(part_s) if part_s < first.0 => first = (part_s, number),
                Ok(_) => {}
                Err(failure) => return self.stepped(Err(failure)),
            }
        }
        let (part_s, number) = first;
        stepper.start(begun);
        self.stepped(stepper.step(bodies, part_s));
        if matches!(self.ending, Ending::Stopped(_)) {
            self.reached.holds_since_s = held;
            self.ending = Ending::Stopped(number);
            self.ends_s = (part_s < self.step_s).then_some(begun_s + part_s);
        }
    }

    /// The time of the state that was reached, in s.
    fn time_s(&self) -> f64 {
        self.ends_s.unwrap_or(self.reached.step as f64 * self.step_s)
    }

    /// Takes note of a step that was tried.
    fn stepped(&mut self, result: Result<Convergence, Failure>) {
        match result {
            Ok(solved) => {
                self.reached.convergence = Some(solved);
                self.reached.iterations += u64::from(solved.iterations);
                self.reached.step += 1;
            }
            Err(Failure { code: FailureCode::Stopped, .. }) => self.ending = Ending::Cancelled,
            Err(failure) => self.ending = Ending::Failed(failure),
        }
    }

    /// Takes the sample of the state that was reached, unless there was one. A sample that cannot be taken ends the trajectory:
    /// what was reached is good up to the sample before.
    fn sample(
        &mut self,
        bodies: &Bodies<N>,
        stepper: &mut dyn BodiesStepper<N>,
    ) -> Option<Sample<N>> {
        let time_s = self.time_s();
        let Self { observer, ending, reached, sampled, step_s, .. } = self;
        let step = reached.step;
        if *sampled == Some(step) {
            return None;
        }
        let settled = stepper.synchronise(bodies, *step_s);
        if settled.is_err() {
            // All that is reported ends at the sample before.
            reached.step = sampled.unwrap_or(0);
        }
        let state = stepper.state();
        let sample = settled.and_then(|sweeps| {
            reached.iterations += u64::from(sweeps);
            let (solved, pace) = (reached.convergence, stepper.pace());
            observer.sample(bodies, &state, (step, time_s), solved, pace)
        });
        match sample {
            Ok(sample) => {
                reached.samples += 1;
                reached.numbers = state.numbers();
                *sampled = Some(step);
                Some(sample)
            }
            Err(Failure { code: FailureCode::Stopped, .. }) => {
                *ending = Ending::Cancelled;
                None
            }
            Err(failure) => {
                *ending = Ending::Failed(failure);
                None
            }
        }
    }

    fn end(self) -> Trajectory {
        Trajectory { time_s: self.time_s(), ending: self.ending, reached: self.reached }
    }
}
