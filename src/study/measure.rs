//! One run of a study, in memory: no log, no files.
//!
//! Invariant: all figures but the time repeat to the bit.

use std::cell::Cell;
use std::convert::Infallible;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use nalgebra::DMatrix;

use super::spread;
use super::{Entry, Watch};
use crate::assemble::{Assembly, Task, assembled, assembled_bodies};
use crate::log::schema::Channel;
use crate::plan::{Counts, Plan};
use crate::scenario::{
    Adaptive, Ensemble, LogOptions, Method, MethodName, Scenario, ScenarioError, Steps,
};
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::RigidBody;
use crate::solve::nonlinear::Rung;
use crate::solve::so::{self, Mat};
use crate::solve::state::{Checkpoint, State};
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::system::{Energy, System};
use crate::solve::trajectory::{
    self, Ending, Observables, Origin, Sample, Schedule, Sink, Trajectory,
};
use crate::solve::work::Work;

mod bodies;

pub(crate) use bodies::first_steps_of_bodies;

/// A state of any size: of one body, or of several, whose matrices stand one below the other.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The attitudes g, n columns.
    pub attitude: DMatrix<f64>,
    /// The body momenta, each skew, likewise.
    pub momentum: DMatrix<f64>,
    /// Several bodies: their centres of mass in m, a row for each; no rows for one.
    pub position: DMatrix<f64>,
    /// Several bodies: mass times velocity in kg m/s, likewise.
    pub linear_momentum: DMatrix<f64>,
}

impl Point {
    /// Returns the point of a state of one body.
    pub(super) fn of<const N: usize>(attitude: &Mat<N>, momentum: &Mat<N>) -> Self {
        let sized = |m: &Mat<N>| DMatrix::from_fn(N, N, |i, j| m[(i, j)]);
        let none = DMatrix::zeros(0, N);
        Self {
            attitude: sized(attitude),
            momentum: sized(momentum),
            position: none.clone(),
            linear_momentum: none,
        }
    }

    /// Returns it as a state of one body of this dimension, which is its own.
    pub(super) fn state<const N: usize>(&self) -> State<N> {
        let sized = |m: &DMatrix<f64>| Mat::<N>::from_fn(|i, j| m[(i, j)]);
        State { attitude: sized(&self.attitude), momentum: sized(&self.momentum) }
    }

    /// Returns n.
    pub(super) fn dimension(&self) -> usize {
        self.attitude.ncols()
    }

    /// Returns `|g - h|_F / sqrt(2)`, for n = 3 the spectral norm of the difference of two rotations; of several bodies the
    /// largest.
    pub fn attitude_distance(&self, other: &Self) -> f64 {
        half_norm(&self.attitude, &other.attitude)
    }

    /// Returns `|p - q|_F / sqrt(2)`, for n = 3 the length of the difference of the vectors; of several bodies the largest.
    pub fn momentum_distance(&self, other: &Self) -> f64 {
        half_norm(&self.momentum, &other.momentum)
    }

    /// Returns the largest distance of a centre of mass from where it is in the other, in m.
    pub fn position_distance(&self, other: &Self) -> f64 {
        longest_row(&self.position, &other.position)
    }

    /// Returns the largest difference of a linear momentum, in kg m/s.
    pub fn linear_momentum_distance(&self, other: &Self) -> f64 {
        longest_row(&self.linear_momentum, &other.linear_momentum)
    }
}

/// Returns the largest `|A - B|_F / sqrt(2)` of the square blocks of two matrices.
fn half_norm(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
    let n = a.ncols();
    let of_block = |first: usize| {
        let (a, b) = (a.rows(first, n), b.rows(first, n));
        (0.5 * a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>()).sqrt()
    };
    (0..a.nrows()).step_by(n.max(1)).map(of_block).fold(0.0, f64::max)
}

fn longest_row(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
    let lengths = a.row_iter().zip(b.row_iter()).map(|(a, b)| (a - b).norm());
    lengths.fold(0.0, f64::max)
}

/// The largest sizes that a motion reached, in parts of which its errors are measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sizes {
    /// Of a body momentum, in kg m^2/s; in a potential at least that by which a body turns a millionth of a radian meanwhile.
    pub momentum: f64,
    /// Several bodies: of the distance of a centre of mass from where it began, in m; at least a millionth of how far they
    /// are from each other.
    pub way_m: f64,
    /// Several bodies: of a linear momentum, in kg m/s; at least that which goes this way meanwhile.
    pub linear_momentum: f64,
}

/// A run to be made.
#[derive(Debug)]
pub(crate) struct Probe<'a, M = Method> {
    pub(crate) method: &'a M,
    pub(crate) step_s: f64,
    pub(crate) steps: u64,
    /// Number k, where a sample is taken every k steps.
    pub(crate) every: u64,
    /// The run is stopped once |H - H0| is above this.
    pub(crate) energy_limit: f64,
    /// Whether the states at the samples are kept.
    pub(crate) keep: bool,
    /// Start of the run.
    pub(crate) begin: Begin<'a>,
    /// Member of the scene's ensemble that runs.
    pub(crate) member: u64,
}

/// Start of a run.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Begin<'a> {
    /// The start of the scene, or of its member.
    Scene,
    /// Another state, which the run reaches after so many of its steps: what depends on time counts from the start.
    State { point: &'a Point, step: u64 },
    /// A rounding away from the scene's start, whose energy an adaptive method takes for that of
    /// the motion.
    Near(&'a Point),
}

impl<M> Clone for Probe<'_, M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for Probe<'_, M> {}

impl<'a, M> Probe<'a, M> {
    /// Returns a run from the start of the scene to the end, whatever the energy does, with a
    /// sample at either.
    pub(crate) fn of(method: &'a M, step_s: f64, steps: u64) -> Self {
        Self {
            method,
            step_s,
            steps,
            every: steps,
            energy_limit: f64::INFINITY,
            keep: false,
            begin: Begin::Scene,
            member: 0,
        }
    }

    /// Returns the same run of another method.
    pub(crate) fn with<'b, P>(self, method: &'b P) -> Probe<'b, P>
    where
        'a: 'b,
    {
        let Self { method: _, step_s, steps, every, energy_limit, keep, begin, member } = self;
        Probe { method, step_s, steps, every, energy_limit, keep, begin, member }
    }
}

/// End of a run of a study.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum End {
    Completed,
    Cancelled,
    /// Past the energy limit.
    BlewUp,
    Failed(Failure),
}

impl End {
    /// Returns the end of a trajectory, which is over once its energy is past the limit.
    fn of(ending: Ending, blown: bool) -> Self {
        match ending {
            Ending::Completed | Ending::Stopped(_) | Ending::Cancelled if blown => Self::BlewUp,
            Ending::Completed | Ending::Stopped(_) => Self::Completed,
            Ending::Cancelled => Self::Cancelled,
            Ending::Failed(failure) => Self::Failed(failure),
        }
    }
}

/// Results of a run of a study.
#[derive(Clone, Debug)]
pub(crate) struct Measured {
    pub(crate) end: End,
    pub(crate) steps: u64,
    pub(crate) last: Point,
    /// The states at the samples, where they were asked for.
    pub(crate) points: Vec<Point>,
    /// Time, H - H0 and the orthogonality error at each sample.
    pub(crate) series: Vec<(f64, f64, f64)>,
    pub(crate) iterations: u64,
    pub(crate) rung: Option<Rung>,
    pub(crate) force_evaluations: u64,
    /// Sweeps, those of Newton's method and of a step that failed included.
    pub(crate) sweeps: u64,
    /// Number of pieces of the exact free body, beyond the first of each of its motions.
    pub(crate) passes: u64,
    pub(crate) pieces: u64,
    /// Cost by the plan's figures.
    pub(crate) cost_ns: f64,
    /// Largest size of the body angular velocity at a sample, rad/s.
    pub(crate) fastest_rad_s: f64,
    /// The number of that sample.
    pub(crate) fastest_sample: usize,
    pub(crate) energies: Energies,
    pub(crate) sizes: Sizes,
    /// The shortest step in parts of the longest, where they adapt.
    pub(crate) least_sigma: Option<f64>,
}

/// The energies of a run.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Energies {
    first: Option<Energy>,
    largest_kinetic: f64,
    largest_potential: f64,
    largest_change: f64,
}

impl Energies {
    fn take(&mut self, energy: Energy) {
        let first = self.first.get_or_insert(energy);
        self.largest_change = self.largest_change.max((energy.potential - first.potential).abs());
        self.largest_kinetic = self.largest_kinetic.max(energy.kinetic);
        self.largest_potential = self.largest_potential.max(energy.potential.abs());
    }

    /// Largest kinetic energy, and no less than the rounding errors of the potential.
    pub(crate) fn kinetic(&self) -> f64 {
        /// A few roundings, in parts of 1e-6.
        const ROUNDING: f64 = 1e-8;
        self.largest_kinetic.max(ROUNDING * self.largest_potential)
    }

    /// The energy that moved: that of a body at rest in a field that changes is the field's.
    pub(crate) fn moved(&self) -> f64 {
        self.kinetic().max(self.largest_change)
    }
}

impl Measured {
    pub(crate) fn energy_error(&self) -> f64 {
        self.series.iter().map(|&(_, energy, _)| energy.abs()).fold(0.0, f64::max)
    }

    pub(crate) fn orthogonality_error(&self) -> f64 {
        self.series.iter().map(|&(_, _, orthogonality)| orthogonality).fold(0.0, f64::max)
    }

    pub(crate) fn counts(&self) -> Counts {
        Counts {
            steps: self.steps as f64,
            sweeps: self.sweeps as f64,
            gradients: self.force_evaluations as f64,
            passes: self.passes as f64,
            pieces: self.pieces as f64,
        }
    }

    pub(crate) fn completed(&self) -> bool {
        self.end == End::Completed
    }
}

/// Returns the plan of a scene with another method and step.
pub(crate) fn variant(
    scene: &Scenario,
    method: &Method,
    step_s: f64,
    steps: u64,
) -> Result<Plan, ScenarioError> {
    let mut scenario = scene.clone();
    // Another method has steps of one length, or adaptive steps of the study's.
    if *method != scene.method {
        scenario.step = match (&scene.step, method.name) {
            (Some(Steps::Adaptive(adaptive)), MethodName::VpdAdaptive) => {
                let own = Adaptive { largest_step_s: None, ..adaptive.clone() };
                Some(Steps::Adaptive(own))
            }
            _ => None,
        };
    }
    scenario.method = method.clone();
    (scenario.step_s, scenario.steps, scenario.duration_s) = (Some(step_s), Some(steps), None);
    (scenario.accuracy, scenario.ensemble) = (None, None);
    // What is compared is at one time, wherever the run itself would end.
    scenario.until.clear();
    let of_state = if scene.bodies().is_some() { Channel::BodyState } else { Channel::State };
    let channels = vec![of_state, Channel::Energy, Channel::Orthogonality];
    scenario.log = LogOptions { channels: Some(channels), ..LogOptions::default() };
    Plan::new(&scenario)
}

/// Returns the plan of a scene with another method, for what the method makes of it: of one step that any scene may take.
pub(crate) fn of_method(scene: &Scenario, method: &Method) -> Result<Plan, ScenarioError> {
    // A step may hold so many samples of a control.
    let step_s = scene.scene.control.as_ref().map_or(1.0, |control| control.every_s.min(1.0));
    variant(scene, method, step_s, 1)
}

/// Number of runs that this process has made to measure them.
static RUNS: AtomicU64 = AtomicU64::new(0);

/// Returns the number of runs made so far to choose a method, to estimate, or for a study.
#[cfg(feature = "serve")]
pub(crate) fn runs() -> u64 {
    RUNS.load(Ordering::Relaxed)
}

/// An angle in radians, and a part of a length, by which a body hardly moves: in a potential the roundings of its forces
/// would be all that is compared.
const HARDLY: f64 = 1e-6;

/// Makes a run and measures it.
///
/// # Errors
/// If the scene cannot be planned with the method.
pub(crate) fn measure(
    scene: &Scenario,
    probe: Probe<'_>,
    watch: &Watch,
) -> Result<Measured, ScenarioError> {
    RUNS.fetch_add(1, Ordering::Relaxed);
    let plan = variant(scene, probe.method, probe.step_s, probe.steps)?;
    let sweep_ns = plan.sweep_cost_ns();
    let most_sweeps = (watch.left_ns() as f64 / sweep_ns).ceil() as u64;
    let ensemble = scene.ensemble.as_ref();
    let mut run = if scene.bodies().is_some() {
        assembled_bodies(&plan, bodies::Measurement { probe, ensemble, watch, most_sweeps })
    } else {
        let mut run = assembled(&plan, Measurement { probe, ensemble, watch, most_sweeps });
        let time_s = probe.step_s * probe.steps as f64;
        let hardly = HARDLY / (plan.model.kinetic.mobility() * time_s);
        let in_potential = !(plan.model.terms.is_empty() && plan.model.driven.is_empty());
        if in_potential && hardly.is_finite() {
            run.sizes.momentum = run.sizes.momentum.max(hardly);
        }
        run
    };
    run.cost_ns = plan.work_ns(run.counts());
    // A sample is about as much work as a sweep.
    watch.pay((run.cost_ns + run.series.len() as f64 * sweep_ns).ceil() as u64);
    Ok(run)
}

struct Measurement<'a> {
    probe: Probe<'a>,
    ensemble: Option<&'a Ensemble>,
    watch: &'a Watch,
    most_sweeps: u64,
}

impl Task for Measurement<'_> {
    type Output = Measured;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Measured {
        let Assembly { body, mut stepper, initial, .. } = assembly;
        let body = body.with_work(Work::limited(self.most_sweeps, self.watch.cancelled.clone()));
        let Probe { begin, member, .. } = self.probe;
        let initial = match (begin, self.ensemble) {
            (Begin::State { point, .. }, _) => point.state(),
            (_, Some(ensemble)) => spread::start(&initial, ensemble, member),
            (_, None) => initial,
        };
        stepper.set_member(member);
        let checkpoint = match begin {
            Begin::Scene => None,
            Begin::Near(point) => Some(Checkpoint::at_start(&point.state())),
            // The samples of a loop are counted from where it is started.
            Begin::State { .. } if stepper.control().is_some() => None,
            Begin::State { step, .. } => {
                Some(Checkpoint { step, ..Checkpoint::at_start(&initial) })
            }
        };
        let origin = Origin { initial: &initial, checkpoint: checkpoint.as_ref() };
        let mut run = run_of(&body, stepper.as_mut(), origin, self.probe, self.watch);
        run.force_evaluations = body.work().gradients();
        run.sweeps = body.work().sweeps();
        run.passes = body.work().passes();
        run.pieces = body.work().pieces();
        run
    }
}

/// Runs a system, whatever its law; its work is not counted.
pub(super) fn run_of<'a, const N: usize, Y: System<N> + ?Sized, M>(
    system: &Y,
    stepper: &mut dyn Stepper<N, Y>,
    origin: impl Into<Origin<'a, N>>,
    probe: Probe<'_, M>,
    watch: &Watch,
) -> Measured {
    let Probe { step_s, steps, every, energy_limit, keep, .. } = probe;
    let origin = origin.into();
    let before = origin.checkpoint.map_or(0, |found| found.step);
    let blown = Cell::new(false);
    let mut gauge = Gauge {
        energy_limit,
        blown: &blown,
        keep,
        points: Vec::new(),
        series: Vec::new(),
        fastest: (0.0, 0),
        energies: Energies::default(),
        momentum: 0.0,
        least_sigma: None,
    };
    let observables =
        Observables { energy: true, orthogonality: true, pace: true, ..Observables::default() };
    let trajectory = trajectory::integrate(
        system,
        stepper,
        origin,
        Schedule { step_s, steps: before + steps, every },
        observables,
        &mut gauge,
        |_| !blown.get() && !watch.is_cancelled(),
    );
    let Ok(Trajectory { ending, reached, .. }) = trajectory;
    let Gauge { points, series, fastest, energies, momentum, least_sigma, .. } = gauge;
    let State { attitude, momentum: last } = reached.state();
    Measured {
        end: End::of(ending, blown.get()),
        steps: reached.step - before,
        last: Point::of(&attitude, &last),
        points,
        series,
        iterations: reached.iterations,
        rung: reached.convergence.map(|solved| solved.rung),
        force_evaluations: 0,
        sweeps: 0,
        passes: 0,
        pieces: 0,
        cost_ns: 0.0,
        fastest_rad_s: fastest.0,
        fastest_sample: fastest.1,
        energies,
        sizes: Sizes { momentum, ..Sizes::default() },
        least_sigma,
    }
}

/// Takes the figures of each sample.
struct Gauge<'a> {
    energy_limit: f64,
    blown: &'a Cell<bool>,
    keep: bool,
    points: Vec<Point>,
    series: Vec<(f64, f64, f64)>,
    /// Largest velocity, and the number of the sample.
    fastest: (f64, usize),
    energies: Energies,
    momentum: f64,
    least_sigma: Option<f64>,
}

impl<const N: usize> Sink<N> for Gauge<'_> {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Infallible> {
        let energy_error = sample.energy_error.unwrap_or_default();
        let orthogonality = sample.orthogonality_error.unwrap_or_default();
        self.series.push((sample.time_s, energy_error, orthogonality));
        self.blown.set(self.blown.get() || energy_error.abs() > self.energy_limit);
        let attitude = sample.attitude.unwrap_or_else(Mat::identity);
        let rate = sample.angular_velocity.as_ref().map_or(0.0, size);
        if rate > self.fastest.0 {
            self.fastest = (rate, self.series.len() - 1);
        }
        if let Some(pace) = sample.pace {
            let least = self.least_sigma.unwrap_or(1.0);
            self.least_sigma = Some(least.min(pace.least_sigma));
        }
        self.momentum = self.momentum.max(size(&sample.momentum));
        if let Some(energy) = sample.energy {
            self.energies.take(energy);
        }
        if self.keep {
            self.points.push(Point::of(&attitude, &sample.momentum));
        }
        Ok(())
    }
}

fn size<const N: usize>(x: &Mat<N>) -> f64 {
    so::inner(x, x).sqrt()
}

/// How fast a scene changes.
pub(crate) struct Rates {
    /// A first guess of how fast it moves, in rad/s: the larger of its velocity at the start and the root of its
    /// acceleration there.
    pub(crate) turn_rad_s: f64,
    /// How fast torques damp it, in 1/s.
    pub(crate) damping_per_s: f64,
}

/// Returns how fast a scene changes at its start.
///
/// # Errors
/// If the scene cannot be planned.
pub(crate) fn initial_rates(scene: &Scenario) -> Result<Rates, ScenarioError> {
    struct AtStart;
    impl Task for AtStart {
        type Output = Rates;

        fn perform<const N: usize>(self, assembly: Assembly<N>) -> Rates {
            let Assembly { body, initial, .. } = assembly;
            let turn_rad_s = rate_at(&body, &initial);
            Rates { turn_rad_s, damping_per_s: body.damping_rate() }
        }
    }
    let plan = of_method(scene, &Method::default())?;
    if scene.bodies().is_some() {
        let turn_rad_s = assembled_bodies(&plan, bodies::Rate);
        return Ok(Rates { turn_rad_s, damping_per_s: 0.0 });
    }
    Ok(assembled(&plan, AtStart))
}

/// Returns the first guess of how fast a body moves, in rad/s, from a state.
pub(crate) fn rate_at<const N: usize>(body: &RigidBody<N>, state: &State<N>) -> f64 {
    let mut seen = Vec::new();
    body.seen_from(&state.attitude, &mut seen);
    let omega = body.velocity(&state.momentum);
    let rate = body.momentum_rate(&Mat::identity(), &state.momentum, &omega, &seen);
    size(&omega).max(size(&body.velocity(&rate)).sqrt())
}

/// Work and time of the steps of a scenario, without a log: for the bench that makes the table of
/// costs.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Nanoseconds of a step, the least of some turns.
    pub step_ns: f64,
    /// Sweeps of a step.
    pub sweeps: f64,
    /// Passes of a step within them: [`crate::solve::work::Work::passes`].
    pub passes: f64,
    /// Gradients of the potential, each at one attitude, of a step.
    pub gradients: f64,
}

/// Makes the steps of a scenario again and again.
///
/// # Errors
/// If it cannot be planned.
pub fn effort(scenario: &Scenario) -> Result<Effort, ScenarioError> {
    const TURNS: usize = 5;
    let Plan { step_s, steps, .. } = Plan::new(scenario)?;
    let run = measure(scenario, Probe::of(&scenario.method, step_s, steps), &Watch::default())?;
    let plan = variant(scenario, &scenario.method, step_s, steps)?;
    let turns = (0..TURNS).map(|_| turn_ns(&plan));
    let Counts { steps, sweeps, passes, gradients, pieces: _ } = run.counts();
    let steps = steps.max(1.0);
    Ok(Effort {
        step_ns: turns.fold(f64::INFINITY, f64::min),
        sweeps: sweeps / steps,
        passes: passes / steps,
        gradients: gradients / steps,
    })
}

/// Returns the nanoseconds that a step takes, each the least over `repeats` turns in which all runs
/// take part one after the other, so that a disturbance of the machine affects all alike. Stops
/// early if cancelled.
pub(crate) fn time(
    scene: &Scenario,
    runs: &[(&Entry, f64, u64)],
    repeats: u32,
    watch: &Watch,
) -> Result<Vec<f64>, ScenarioError> {
    let mut least = vec![f64::INFINITY; runs.len()];
    for _ in 0..repeats {
        for (least, &(entry, step_s, steps)) in least.iter_mut().zip(runs) {
            if watch.is_cancelled() {
                return Ok(Vec::new());
            }
            let plan = variant(scene, &entry.method, step_s, steps)?;
            *least = least.min(turn_ns(&plan));
        }
    }
    Ok(least)
}

/// Returns the nanoseconds of a step of a planned run; infinite if one fails.
fn turn_ns(plan: &Plan) -> f64 {
    let Plan { step_s, steps, .. } = *plan;
    if plan.bodies.is_empty() {
        assembled(plan, Timing::of(step_s, steps))
    } else {
        assembled_bodies(plan, bodies::Timing { step_s, steps })
    }
}

/// Returns the nanoseconds that one of the first steps of a member's run takes on this machine: the
/// least of some turns, until three agree or enough time has gone by; `None` if a step fails.
pub(crate) fn time_of_step(plan: &Plan, steps: u64, member: u64) -> Option<f64> {
    const MOST_TURNS: usize = 12;
    const AGREEING: usize = 3;
    /// Largest ratio of two turns that nothing disturbed.
    const NEAR: f64 = 1.1;
    /// Enough time, in nanoseconds: a few times as long as others keep a core, so that a turn that
    /// was interrupted is not the only one.
    const ENOUGH_NS: u128 = 20_000_000;
    let begun = Instant::now();
    let (mut least, mut agreeing) = (f64::INFINITY, 0);
    for _ in 0..MOST_TURNS {
        let timing = Timing {
            ensemble: plan.settled.ensemble.as_ref(),
            member,
            ..Timing::of(plan.step_s, steps)
        };
        let turn = assembled(plan, timing);
        if turn * NEAR < least {
            agreeing = 0;
        }
        least = least.min(turn);
        agreeing += usize::from(turn <= NEAR * least);
        if agreeing == AGREEING || !least.is_finite() || begun.elapsed().as_nanos() > ENOUGH_NS {
            break;
        }
    }
    least.is_finite().then_some(least)
}

/// Nanoseconds that are long enough for the clock.
const LEAST_NS: u128 = 100_000;

struct Timing<'a> {
    step_s: f64,
    steps: u64,
    ensemble: Option<&'a Ensemble>,
    member: u64,
}

impl Timing<'_> {
    fn of(step_s: f64, steps: u64) -> Self {
        Self { step_s, steps, ensemble: None, member: 0 }
    }
}

impl Task for Timing<'_> {
    type Output = f64;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> f64 {
        let Assembly { body, mut stepper, initial, .. } = assembly;
        let initial = match self.ensemble {
            Some(ensemble) => spread::start(&initial, ensemble, self.member),
            None => initial,
        };
        stepper.set_member(self.member);
        let begun = Instant::now();
        let mut made = 0;
        while made == 0 || begun.elapsed().as_nanos() < LEAST_NS {
            stepper.start(&initial);
            let mut knots = Knots::default();
            for step in 0..self.steps {
                let begun_s = step as f64 * self.step_s;
                if knots.step(&body, stepper.as_mut(), begun_s, self.step_s).is_err() {
                    return f64::INFINITY;
                }
            }
            made += self.steps;
        }
        begun.elapsed().as_nanos() as f64 / made as f64
    }
}
