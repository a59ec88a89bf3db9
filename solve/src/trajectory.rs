//! The time loop: a stepper carries a state forward, samples go to a sink. ([`super::ensemble`] carries several, by the
//! same bookkeeping.)
//!
//! Invariant: a sample holds finite numbers only, belongs to an accepted step, and comes in order of
//! time; time is `k h`, never a sum, but for an end within a step. At a checkpoint the stepper starts anew from what the checkpoint
//! holds, so that a trajectory which is resumed there is, to the bit, the one that was not interrupted.

use super::control::ControlSample;
use super::failure::{Failure, FailureCode};
use super::nonlinear::Convergence;
use super::pointing::Pointed;
use super::so::{self, Mat};
use super::state::{Checkpoint, Derivatives, Pace, State};
use super::stepper::{Knots, Stepper};
use super::stop::{self, Stop};
use super::system::{Energy, System};

/// Length and resolution of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// The step h in seconds, finite and above zero.
    pub step_s: f64,
    /// Number of steps.
    pub steps: u64,
    /// A sample is taken every k steps (0: as 1), at the start and at the end.
    pub every: u64,
}

/// Quantities computed at a sample in addition to the state, as the caller asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Observables {
    /// Kinetic and potential energy.
    pub energy: bool,
    /// Distance of the attitude from the group.
    pub orthogonality: bool,
    /// Spatial momentum and the drift of its conserved part.
    pub momentum: bool,
    /// The smallest singular value met in the step.
    pub sigma_min: bool,
    /// Pace of time, for a scheme with a time of its own.
    pub pace: bool,
    /// Samples of the control.
    pub control: bool,
    /// Where the body points.
    pub pointing: bool,
    /// Derivatives, of a stepper that carries them along.
    pub derivatives: bool,
}

impl std::ops::BitOr for Observables {
    type Output = Self;

    /// Returns the observables that either of the two asks for.
    fn bitor(self, other: Self) -> Self {
        let Self {
            energy,
            orthogonality,
            momentum,
            sigma_min,
            pace,
            control,
            pointing,
            derivatives,
        } = other;
        Self {
            energy: self.energy | energy,
            orthogonality: self.orthogonality | orthogonality,
            momentum: self.momentum | momentum,
            sigma_min: self.sigma_min | sigma_min,
            pace: self.pace | pace,
            control: self.control | control,
            pointing: self.pointing | pointing,
            derivatives: self.derivatives | derivatives,
        }
    }
}

/// One sample. Values that were not asked for are `None`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// Number of the step that ended here; 0 at the start.
    pub step: u64,
    /// Time in seconds since the start.
    pub time_s: f64,
    /// The attitude g; `None` from a scheme that carries none.
    pub attitude: Option<Mat<N>>,
    /// The body momentum mu, skew.
    pub momentum: Mat<N>,
    /// The body angular velocity Omega, skew; `None` for a system that does not name it.
    pub angular_velocity: Option<Mat<N>>,
    /// Energy H = T + U.
    pub energy: Option<Energy>,
    /// Energy now minus energy at the start; for a driven system also minus the input since.
    pub energy_error: Option<f64>,
    /// Energy put in by time and torques since the start, in J; `None` also for a system that is
    /// not driven.
    pub work: Option<f64>,
    /// Change of the Jacobi integral since the start, in J; `None` also for a system that has none,
    /// see [`System::turning_frame`].
    pub jacobi_error: Option<f64>,
    /// Spectral norm of g g^T - I.
    pub orthogonality_error: Option<f64>,
    /// Spatial momentum g mu g^T.
    pub spatial_momentum: Option<Mat<N>>,
    /// Size of the change of the conserved part of the spatial momentum since the start, for a
    /// system that is pushed less the impulse since; `None` also where the scene conserves none.
    pub momentum_drift: Option<f64>,
    /// Spatial momentum put in by torques that are no potential's since the start, in N m s; `None`
    /// also for a system that is not pushed.
    pub impulse: Option<Mat<N>>,
    /// Impulse of the torques by tables since the start, by the weights of the steps, less the exact one, in N m s; `None`
    /// also for a system without any: see [`System::table_impulse`].
    pub table_impulse_error: Option<f64>,
    /// How the nonlinear solver ended the step; `None` at the start.
    pub convergence: Option<Convergence>,
    /// Smallest singular value of the interpolated matrices of the step; `None` at the start.
    pub sigma_min: Option<f64>,
    /// Pace of time for the scheme; `None` for one with no time of its own.
    pub pace: Option<Pace>,
    /// Sample of the control at this time; `None` also if there is none then.
    pub control: Option<ControlSample>,
    /// Where the body points; `None` also where the scene does not ask.
    pub pointing: Option<Pointed>,
    /// Derivatives by the start and by parameters.
    pub derivatives: Option<Derivatives>,
}

impl<const N: usize> Sample<N> {
    /// Is every number of it finite?
    pub fn is_finite(&self) -> bool {
        let &Self {
            step: _,
            time_s,
            ref attitude,
            ref momentum,
            ref angular_velocity,
            energy,
            energy_error,
            work,
            jacobi_error,
            orthogonality_error,
            ref spatial_momentum,
            momentum_drift,
            ref impulse,
            table_impulse_error,
            convergence,
            sigma_min,
            pace,
            ref control,
            ref pointing,
            ref derivatives,
        } = self;
        let figures = [
            Some(time_s),
            energy.map(|energy| energy.kinetic),
            energy.map(|energy| energy.potential),
            energy.map(|energy| energy.total()),
            energy_error,
            work,
            jacobi_error,
            orthogonality_error,
            momentum_drift,
            table_impulse_error,
            convergence.map(|convergence| convergence.increment),
            sigma_min,
        ];
        let matrices = [
            attitude.as_ref(),
            Some(momentum),
            angular_velocity.as_ref(),
            spatial_momentum.as_ref(),
            impulse.as_ref(),
        ];
        figures.into_iter().flatten().all(f64::is_finite)
            && pace.is_none_or(|pace| pace.is_finite())
            && control.as_ref().is_none_or(ControlSample::is_finite)
            && pointing.as_ref().is_none_or(Pointed::is_finite)
            && derivatives.as_ref().is_none_or(Derivatives::is_finite)
            && matrices.into_iter().flatten().flatten().all(|x| x.is_finite())
    }
}

/// Destination of samples: the MCAP log, or a `Vec` that keeps them.
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
    fn checkpoint(&mut self, _checkpoint: &Checkpoint<N>) -> Result<(), Self::Error> {
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

/// Start of a trajectory, and where it resumes if it was interrupted.
#[derive(Clone, Copy, Debug)]
pub struct Origin<'a, const N: usize> {
    /// The state at t = 0: drifts and errors are measured against it.
    pub initial: &'a State<N>,
    /// Checkpoint to go on from: also one of another start, with the energy that belongs to that.
    pub checkpoint: Option<&'a Checkpoint<N>>,
}

impl<'a, const N: usize> From<&'a State<N>> for Origin<'a, N> {
    fn from(initial: &'a State<N>) -> Self {
        Self { initial, checkpoint: None }
    }
}

/// How a trajectory ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Ending {
    /// All steps were made.
    Completed,
    /// One of the conditions that end the run held: its number in [`System::stops`].
    Stopped(usize),
    /// The caller asked to stop.
    Cancelled,
    /// The step after the last one reached failed.
    Failed(Failure),
}

/// Result of a trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory<const N: usize> {
    /// How it ended.
    pub ending: Ending,
    /// Where it ended.
    pub reached: Checkpoint<N>,
    /// When, in s: at the end of a step, unless a condition stopped it within.
    pub time_s: f64,
}

/// Carries a state of any system forward along `schedule` by a stepper for it and gives the samples to `sink`: the first at the start,
/// then one every `schedule.every` steps, and the last accepted state whatever happens. A trajectory
/// that resumes at a checkpoint gives the samples after it.
/// `go_on(steps_done)` is asked before each step.
///
/// # Errors
/// Those of the sink. A step that fails is not an error but an [`Ending`].
pub fn integrate<'a, const N: usize, Y: System<N> + ?Sized, S: Sink<N>>(
    system: &Y,
    stepper: &mut dyn Stepper<N, Y>,
    origin: impl Into<Origin<'a, N>>,
    schedule: Schedule,
    observables: Observables,
    sink: &mut S,
    mut go_on: impl FnMut(u64) -> bool,
) -> Result<Trajectory<N>, S::Error> {
    let Schedule { step_s, steps, every } = schedule;
    let every = every.max(1);
    let Origin { initial, checkpoint } = origin.into();
    let mut bookkeeping = Bookkeeping::new(system, initial, step_s, observables);
    let is_located = system.stops().iter().any(|stop| stop.exact);
    let mut knots = Knots::default();
    stepper.start(initial);
    if let Some(found) = checkpoint {
        stepper.resume(found);
        bookkeeping.resume_job(found);
    }
    loop {
        let step = bookkeeping.reached.step;
        let over = step == steps || !bookkeeping.goes_on();
        if over || step % every == 0 {
            let settled = bookkeeping.needs_sample().then(|| stepper.synchronise(system, step_s));
            if let Some(sample) = bookkeeping.sample(system, settled, stepper) {
                sink.record(&sample)?;
            }
            // Not at the end: nothing goes on from there, and a step that failed must not be tried anew.
            if !over && bookkeeping.goes_on() && sink.wants_checkpoint() {
                put_in(&mut bookkeeping.reached, stepper);
                sink.checkpoint(&bookkeeping.reached)?;
                stepper.resume(&bookkeeping.reached);
            }
        }
        if over || !bookkeeping.goes_on() {
            break;
        }
        if go_on(step) {
            let begun = is_located.then(|| bookkeeping.begun(stepper));
            bookkeeping.stepped(knots.step(system, stepper, step as f64 * step_s, step_s));
            bookkeeping.look_for_a_stop(system, stepper);
            if let Some(begun) = begun {
                bookkeeping.end_within(system, stepper, begun);
            }
        } else {
            bookkeeping.cancelled();
        }
    }
    Ok(bookkeeping.end())
}

/// The progress record of one trajectory: how far it came, and its samples.
pub(super) struct Bookkeeping<const N: usize> {
    observer: Observer<N>,
    step_s: f64,
    ending: Ending,
    /// Steps and sweeps are those made, attitude and momentum those of the last sample.
    reached: Checkpoint<N>,
    /// The step of the last sample.
    sampled: Option<u64>,
    /// The time at which a condition stopped the last step within, in s.
    ends_s: Option<f64>,
}

impl<const N: usize> Bookkeeping<N> {
    pub(super) fn new<Y: System<N> + ?Sized>(
        system: &Y,
        initial: &State<N>,
        step_s: f64,
        observables: Observables,
    ) -> Self {
        let reached = Checkpoint::at_start(initial);
        let observer = Observer::new(system, initial, observables);
        Self { observer, step_s, ending: Ending::Completed, reached, sampled: None, ends_s: None }
    }

    fn resume_job(&mut self, found: &Checkpoint<N>) {
        self.reached = found.clone();
        self.sampled = (found.samples > 0).then_some(found.step);
    }

    pub(super) fn goes_on(&self) -> bool {
        self.ending == Ending::Completed
    }

    pub(super) fn cancelled(&mut self) {
        self.ending = Ending::Cancelled;
    }

    /// Takes note of a step that was tried.
    pub(super) fn stepped(&mut self, result: Result<Convergence, Failure>) {
        match result {
            Ok(solved) => {
                self.reached.convergence = Some(solved);
                self.reached.iterations += u64::from(solved.iterations);
                self.reached.step += 1;
            }
            Err(Failure { code: FailureCode::Stopped, .. }) => self.cancelled(),
            Err(failure) => self.ending = Ending::Failed(failure),
        }
    }

    /// Returns the checkpoint of the state that a stepper holds, from which a part of its next step can be made.
    pub(super) fn begun<Y: ?Sized>(&self, stepper: &dyn Stepper<N, Y>) -> Checkpoint<N> {
        let mut begun = self.reached.clone();
        put_in(&mut begun, stepper);
        (begun.attitude, begun.momentum) = (stepper.attitude(), stepper.momentum());
        begun.derivatives = stepper.derivatives();
        begun
    }

    /// Returns the margin of a condition at the state that a stepper holds: see [`Stop::margin`].
    fn margin<Y: System<N> + ?Sized>(
        &self,
        stop: &Stop<N>,
        system: &Y,
        stepper: &dyn Stepper<N, Y>,
        time_s: f64,
    ) -> f64 {
        let system = stepper.acting().unwrap_or(system);
        let g = stepper.attitude().unwrap_or_else(Mat::identity);
        let mu = stepper.momentum();
        let velocity = system.observed_velocity(time_s, &g, &mu);
        stop.condition.margin(time_s, &g, velocity, || {
            let work = self.reached.work + stepper.work();
            system.energy_at(time_s, &g, &mu).total() - self.observer.initial_energy - work
        })
    }

    /// Ends the trajectory after a step if one of the conditions of the system has held for as long as it asks.
    pub(super) fn look_for_a_stop<Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        stepper: &dyn Stepper<N, Y>,
    ) {
        let stops = system.stops();
        if stops.is_empty() || !self.goes_on() {
            return;
        }
        let time_s = self.reached.step as f64 * self.step_s;
        self.reached.holds_since_s.resize(stops.len(), None);
        for (number, stop) in stops.iter().enumerate() {
            let holds = self.margin(stop, system, stepper, time_s) > 0.0;
            let since_s = &mut self.reached.holds_since_s[number];
            let is_over = stop::is_over(since_s, holds, time_s, stop.for_s);
            if is_over && self.goes_on() {
                self.ending = Ending::Stopped(number);
            }
        }
    }

    /// Ends a trajectory that a condition has stopped after a step within this step, where the first of the conditions that are
    /// located came to hold: by the method's own map over a part of the step, from the state in which that began.
    pub(super) fn end_within<Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
        begun: Checkpoint<N>,
    ) {
        let Ending::Stopped(after_step) = self.ending else { return };
        let found = self.reached.holds_since_s.iter().zip(system.stops()).enumerate();
        let located: Vec<usize> = found
            .filter(|(_, (since, stop))| since.is_some() && stop.exact && stop.for_s == 0.0)
            .map(|(number, _)| number)
            .collect();
        if located.is_empty() || begun.own_time.is_some() {
            return;
        }
        let held = std::mem::take(&mut self.reached.holds_since_s);
        self.reached = begun;
        let mut first = (self.step_s, after_step);
        for number in located {
            match self.located(&system.stops()[number], system, stepper) {
                Ok(part_s) if part_s < first.0 => first = (part_s, number),
                Ok(_) => {}
                Err(failure) => return self.stepped(Err(failure)),
            }
        }
        let (part_s, number) = first;
        let (begun_s, solved) = self.part(system, stepper, part_s);
        self.stepped(solved);
        if matches!(self.ending, Ending::Stopped(_)) {
            self.reached.holds_since_s = held;
            self.ending = Ending::Stopped(number);
            self.ends_s = (part_s < self.step_s).then_some(begun_s + part_s);
        }
    }

    /// Makes the first `part_s` seconds of the step after the state reached; returns when that begins, and how it was solved.
    fn part<Y: System<N> + ?Sized>(
        &self,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
        part_s: f64,
    ) -> (f64, Result<Convergence, Failure>) {
        let begun_s = self.reached.step as f64 * self.step_s;
        stepper.resume(&self.reached);
        (begun_s, Knots::default().step(system, stepper, begun_s, part_s))
    }

    /// Returns the part of the step after the state reached, in s, at whose end a condition comes to hold that holds at the end of
    /// the whole step: see [`stop::located`]. The whole step if it holds from the beginning.
    fn located<Y: System<N> + ?Sized>(
        &self,
        stop: &Stop<N>,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
    ) -> Result<f64, Failure> {
        let begun_s = self.reached.step as f64 * self.step_s;
        stepper.resume(&self.reached);
        if self.margin(stop, system, stepper, begun_s) > 0.0 {
            return Ok(self.step_s);
        }
        stop::located(self.step_s, |part_s| {
            self.part(system, stepper, part_s).1?;
            Ok(self.margin(stop, system, stepper, begun_s + part_s) > 0.0)
        })
    }

    /// The time of the state that was reached, in s.
    pub(super) fn time_s(&self) -> f64 {
        self.ends_s.unwrap_or(self.reached.step as f64 * self.step_s)
    }

    /// Was there no sample of the state that was reached?
    pub(super) fn needs_sample(&self) -> bool {
        self.sampled != Some(self.reached.step)
    }

    /// Takes the sample of the state that was reached, unless there was one; `settled` is the
    /// result of bringing the stepper there. A sample that cannot be taken ends the trajectory: it
    /// is good up to the sample before, and all that is reported ends there.
    pub(super) fn sample<Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        settled: Option<Result<u32, Failure>>,
        stepper: &dyn Stepper<N, Y>,
    ) -> Option<Sample<N>> {
        let settled = settled?;
        let time_s = self.time_s();
        let Self { observer, ending, reached, sampled, .. } = self;
        let step = reached.step;
        let work_and_impulse = TotalInput {
            work: reached.work + stepper.work(),
            impulse: stepper.impulse().map(|since| reached.impulse + since),
            table_impulse: reached.table_impulse + stepper.table_impulse(),
        };
        let sample = settled.and_then(|sweeps| {
            reached.iterations += u64::from(sweeps);
            observer.sample(system, stepper, step, time_s, reached.convergence, &work_and_impulse)
        });
        match sample {
            Ok(sample) => {
                (reached.attitude, reached.momentum) = (sample.attitude, sample.momentum);
                reached.derivatives = stepper.derivatives();
                if step == 0 {
                    // The state as given, not as the scheme's variables hold it: a checkpoint there
                    // changes nothing.
                    let initial = &observer.initial;
                    reached.attitude = sample.attitude.map(|_| initial.attitude);
                    reached.momentum = initial.momentum;
                }
                reached.samples += 1;
                *sampled = Some(step);
                Some(sample)
            }
            Err(Failure { code: FailureCode::Stopped, .. }) => {
                *ending = Ending::Cancelled;
                reached.step = sampled.unwrap_or(0);
                None
            }
            Err(failure) => {
                *ending = Ending::Failed(failure);
                reached.step = sampled.unwrap_or(0);
                None
            }
        }
    }

    /// Returns the trajectory. Every way to an end leads past a sample of the last state.
    pub(super) fn end(self) -> Trajectory<N> {
        Trajectory { time_s: self.time_s(), ending: self.ending, reached: self.reached }
    }
}

/// Adds what a stepper has put in, and what its control knows, to a checkpoint.
fn put_in<const N: usize, Y: ?Sized>(reached: &mut Checkpoint<N>, stepper: &dyn Stepper<N, Y>) {
    reached.work += stepper.work();
    reached.impulse += stepper.impulse().unwrap_or_else(Mat::zeros);
    reached.table_impulse += stepper.table_impulse();
    reached.own_time = stepper.own_time();
    reached.control = stepper.control().cloned();
}

/// Are two times of a run the same, but for rounding?
fn is_at(a_s: f64, b_s: f64) -> bool {
    (a_s - b_s).abs() <= super::time::rounding_s(b_s)
}

/// Input to a driven system since the start.
struct TotalInput<const N: usize> {
    work: f64,
    /// `None` from a stepper that does not know.
    impulse: Option<Mat<N>>,
    table_impulse: f64,
}

/// Computes the values that a sample holds in addition to the state, measured against the start.
struct Observer<const N: usize> {
    observables: Observables,
    driven: bool,
    pushed: bool,
    initial: State<N>,
    initial_energy: f64,
    conserved: Option<Mat<N>>,
    turning_frame: Option<Mat<N>>,
}

impl<const N: usize> Observer<N> {
    fn new<Y: System<N> + ?Sized>(
        system: &Y,
        initial: &State<N>,
        observables: Observables,
    ) -> Self {
        Self {
            observables,
            driven: system.is_driven(),
            pushed: system.is_pushed(),
            initial: initial.clone(),
            initial_energy: system.energy_at(0.0, &initial.attitude, &initial.momentum).total(),
            conserved: system.conserved_directions(),
            turning_frame: system.turning_frame(),
        }
    }

    /// `<W, m>`, m the spatial momentum.
    fn along(&self, rate: &Mat<N>, state: &State<N>) -> f64 {
        so::inner(rate, &so::conjugate(&state.attitude, &state.momentum))
    }

    fn sample<Y: System<N> + ?Sized>(
        &self,
        system: &Y,
        stepper: &dyn Stepper<N, Y>,
        step: u64,
        time_s: f64,
        convergence: Option<Convergence>,
        work_and_impulse: &TotalInput<N>,
    ) -> Result<Sample<N>, Failure> {
        let asked = self.observables;
        let &TotalInput { work, impulse, table_impulse } = work_and_impulse;
        let system = stepper.acting().unwrap_or(system);
        let impulse = impulse.filter(|_| self.pushed);
        let (attitude, momentum) = (stepper.attitude(), stepper.momentum());
        // A scheme without an attitude serves free bodies, whose energy needs none.
        let g = attitude.unwrap_or_else(Mat::identity);
        let energy = asked.energy.then(|| system.energy_at(time_s, &g, &momentum));
        let angular_velocity = system.observed_velocity(time_s, &g, &momentum);
        let pointing = (asked.pointing && attitude.is_some())
            .then(|| system.pointed(time_s, &g, angular_velocity.as_ref()?))
            .flatten();
        let sample = Sample {
            step,
            time_s,
            attitude,
            momentum,
            angular_velocity,
            energy,
            energy_error: energy.map(|now| now.total() - self.initial_energy - work),
            work: energy.filter(|_| self.driven).map(|_| work),
            jacobi_error: energy.zip(self.turning_frame).map(|(now, rate)| {
                // H - <W, m>, less its initial value.
                let turned = self.along(&rate, &State { attitude: g, momentum });
                (now.total() - turned) - (self.initial_energy - self.along(&rate, &self.initial))
            }),
            orthogonality_error: attitude
                .filter(|_| asked.orthogonality)
                .map(|g| so::orthogonality_error(&g)),
            spatial_momentum: attitude
                .filter(|_| asked.momentum)
                .map(|g| so::conjugate(&g, &momentum)),
            momentum_drift: if asked.momentum {
                self.drift(attitude, &momentum, impulse.as_ref())
            } else {
                None
            },
            impulse: impulse.filter(|_| asked.momentum),
            table_impulse_error: (asked.momentum && stepper.clock().is_some())
                .then(|| system.table_impulse(time_s))
                .flatten()
                .map(|exact| table_impulse - exact),
            convergence,
            sigma_min: if asked.sigma_min && step > 0 { stepper.sigma_min() } else { None },
            pace: if asked.pace { stepper.pace() } else { None },
            control: stepper
                .control_sample()
                .filter(|sample| asked.control && is_at(sample.time_s, time_s))
                .cloned(),
            pointing,
            derivatives: if asked.derivatives { stepper.derivatives() } else { None },
        };
        if sample.is_finite() { Ok(sample) } else { Err(Failure::not_finite(None)) }
    }

    /// Returns the change of what the scene conserves: the spatial momentum among the free
    /// directions, less the impulse of torques, or, without an attitude, the coadjoint orbit of the
    /// body momentum.
    fn drift(
        &self,
        attitude: Option<Mat<N>>,
        momentum: &Mat<N>,
        impulse: Option<&Mat<N>>,
    ) -> Option<f64> {
        let start = &self.initial;
        match attitude {
            // Nothing is known of a scheme that does not report the impulse of torques.
            Some(_) if self.pushed && impulse.is_none() => None,
            Some(g) => self.conserved.map(|q| {
                let mut change =
                    so::conjugate(&g, momentum) - so::conjugate(&start.attitude, &start.momentum);
                if let Some(impulse) = impulse {
                    change -= impulse;
                }
                let kept = so::product(&so::product(&q, &change), &q);
                so::inner(&kept, &kept).sqrt()
            }),
            None => {
                let (now, then) = (so::frequencies(momentum), so::frequencies(&start.momentum));
                Some(now.iter().zip(&then).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
            }
        }
    }
}
