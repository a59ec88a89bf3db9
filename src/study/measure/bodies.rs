//! The same of several bodies: a run, its times, its first steps.
//!
//! Invariant: that of [`super`].

use std::cell::Cell;
use std::convert::Infallible;
use std::time::{Duration, Instant};

use nalgebra::DMatrix;

use super::{Begin, End, Energies, HARDLY, LEAST_NS, Measured, Point, Probe, Sizes, size};
use crate::assemble::{BodiesAssembly, BodiesTask, assembled_bodies};
use crate::plan::Plan;
use crate::scenario::Ensemble;
use crate::solve::bodies::trajectory::{self, BodySample, Course, Sample, Sink, Trajectory};
use crate::solve::bodies::{Bodies, BodiesState};
use crate::solve::so::{Mat, Vector};
use crate::solve::work::Work;
use crate::study::{Watch, spread};

impl Point {
    /// Returns the point at which bodies are seen.
    fn of_bodies<const N: usize>(seen: &[BodySample<N>]) -> Self {
        let matrices = |of: fn(&BodySample<N>) -> &Mat<N>| {
            DMatrix::from_fn(N * seen.len(), N, |i, j| of(&seen[i / N])[(i % N, j)])
        };
        let vectors = |of: fn(&BodySample<N>) -> &Vector<N>| {
            DMatrix::from_fn(seen.len(), N, |i, j| of(&seen[i])[j])
        };
        Self {
            attitude: matrices(|body| &body.attitude),
            momentum: matrices(|body| &body.momentum),
            position: vectors(|body| &body.position),
            linear_momentum: vectors(|body| &body.linear_momentum),
        }
    }

    /// Returns it as a state of these bodies, whose own it is.
    fn state_of_bodies<const N: usize>(&self, bodies: &Bodies<N>) -> BodiesState<N> {
        let matrix = |from: &DMatrix<f64>, a: usize| Mat::from_fn(|i, j| from[(a * N + i, j)]);
        let vector = |from: &DMatrix<f64>, a: usize| Vector::from_fn(|j, _| from[(a, j)]);
        let body = |a: usize| BodySample {
            attitude: matrix(&self.attitude, a),
            momentum: matrix(&self.momentum, a),
            angular_velocity: Mat::zeros(),
            position: vector(&self.position, a),
            velocity: Vector::zeros(),
            linear_momentum: vector(&self.linear_momentum, a),
        };
        bodies.state_of(&(0..bodies.bodies().len()).map(body).collect::<Vec<_>>())
    }
}

/// See [`super::measure`].
pub(super) struct Measurement<'a> {
    pub(super) probe: Probe<'a>,
    pub(super) ensemble: Option<&'a Ensemble>,
    pub(super) watch: &'a Watch,
    pub(super) most_sweeps: u64,
}

impl BodiesTask for Measurement<'_> {
    type Output = Measured;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Measured {
        let Self { probe, ensemble, watch, most_sweeps } = self;
        let BodiesAssembly { bodies, mut stepper, initial, .. } = assembly;
        let bodies = bodies.watched(Work::limited(most_sweeps, watch.cancelled.clone()));
        let initial = match (probe.begin, ensemble) {
            (Begin::State { point, .. } | Begin::Near(point), _) => point.state_of_bodies(&bodies),
            (Begin::Scene, Some(ensemble)) => {
                spread::start_of_bodies(&bodies, &initial, ensemble, probe.member)
            }
            (Begin::Scene, None) => initial,
        };
        let Probe { step_s, steps, every, energy_limit, keep, .. } = probe;
        let blown = Cell::new(false);
        let mut gauge = Gauge {
            energy_limit,
            blown: &blown,
            keep,
            points: Vec::new(),
            series: Vec::new(),
            fastest: (0.0, 0),
            energies: Energies::default(),
            sizes: Sizes::default(),
            begun: Vec::new(),
            pushes: Vec::new(),
            before: None,
        };
        let way = Course { initial: &initial, checkpoint: None, step_s, steps, every };
        let end = trajectory::integrate(&bodies, stepper.as_mut(), way, &mut gauge, |_| {
            !blown.get() && !watch.is_cancelled()
        });
        let Ok(Trajectory { ending, reached, .. }) = end;
        let last = initial.with_numbers(&reached.numbers).unwrap_or_else(|| initial.clone());
        let seen = bodies.seen(&last).unwrap_or_default();
        let Gauge { points, series, fastest, energies, sizes, pushes, .. } = gauge;
        let pushed = pushes.iter().map(|push| push.change_n / push.momentum);
        let moved_rad_s = pushed.filter(|rate| rate.is_finite()).fold(0.0, f64::max);
        let work = bodies.work();
        Measured {
            end: End::of(ending, blown.get()),
            steps: reached.step,
            last: Point::of_bodies(&seen),
            points,
            series,
            iterations: reached.iterations,
            rung: reached.convergence.map(|solved| solved.rung),
            force_evaluations: work.gradients(),
            sweeps: work.sweeps(),
            passes: 0,
            pieces: 0,
            cost_ns: 0.0,
            fastest_rad_s: fastest.0.max(moved_rad_s),
            fastest_sample: fastest.1,
            energies,
            sizes: at_least(sizes, &bodies, &initial, step_s * steps as f64),
            least_sigma: None,
        }
    }
}

/// Returns the sizes of a motion, each at least that of bodies which hardly move in `time_s`.
fn at_least<const N: usize>(
    sizes: Sizes,
    bodies: &Bodies<N>,
    initial: &BodiesState<N>,
    time_s: f64,
) -> Sizes {
    let Some(seen) = bodies.seen(initial) else { return sizes };
    let largest = |of: &mut dyn Iterator<Item = f64>| of.fold(0.0, f64::max);
    let from_first = |body: &BodySample<N>| (body.position - seen[0].position).norm();
    let apart_m = largest(&mut seen.iter().map(from_first));
    let inertia = largest(&mut bodies.bodies().iter().map(|body| body.second_moments.trace()));
    let mass_kg = largest(&mut bodies.bodies().iter().map(|body| body.mass_kg));
    let Sizes { momentum, way_m, linear_momentum } = sizes;
    Sizes {
        momentum: momentum.max(HARDLY * inertia / time_s),
        way_m: way_m.max(HARDLY * apart_m),
        linear_momentum: linear_momentum.max(HARDLY * apart_m * mass_kg / time_s),
    }
}

/// How hard a body is pushed.
#[derive(Clone, Copy, Debug, Default)]
struct Push {
    /// The largest size of its linear momentum.
    momentum: f64,
    /// The largest change of it between two samples, by their time.
    change_n: f64,
}

/// Takes the figures of each sample.
struct Gauge<'a, const N: usize> {
    energy_limit: f64,
    blown: &'a Cell<bool>,
    keep: bool,
    points: Vec<Point>,
    series: Vec<(f64, f64, f64)>,
    /// Largest angular velocity, and the number of the sample.
    fastest: (f64, usize),
    energies: Energies,
    sizes: Sizes,
    /// Where each body began.
    begun: Vec<Vector<N>>,
    pushes: Vec<Push>,
    before: Option<(f64, Vec<Vector<N>>)>,
}

impl<const N: usize> Sink<N> for Gauge<'_, N> {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Infallible> {
        let energy_error = sample.energy_error.unwrap_or_default();
        let orthogonality = sample.orthogonality_error.unwrap_or_default();
        self.series.push((sample.time_s, energy_error, orthogonality));
        self.blown.set(self.blown.get() || energy_error.abs() > self.energy_limit);
        if let Some(energy) = sample.energy {
            self.energies.take(energy);
        }
        if self.begun.is_empty() {
            self.begun = sample.bodies.iter().map(|body| body.position).collect();
            self.pushes = vec![Push::default(); sample.bodies.len()];
        }
        for (a, body) in sample.bodies.iter().enumerate() {
            let rate = size(&body.angular_velocity);
            if rate > self.fastest.0 {
                self.fastest = (rate, self.series.len() - 1);
            }
            let Sizes { momentum, way_m, linear_momentum } = &mut self.sizes;
            let p = body.linear_momentum.norm();
            *momentum = momentum.max(size(&body.momentum));
            *way_m = way_m.max((body.position - self.begun[a]).norm());
            *linear_momentum = linear_momentum.max(p);
            let push = &mut self.pushes[a];
            push.momentum = push.momentum.max(p);
            if let Some((before_s, before)) = &self.before {
                let change = (body.linear_momentum - before[a]).norm();
                push.change_n = push.change_n.max(change / (sample.time_s - before_s));
            }
        }
        let momenta = sample.bodies.iter().map(|body| body.linear_momentum).collect();
        self.before = Some((sample.time_s, momenta));
        if self.keep {
            self.points.push(Point::of_bodies(&sample.bodies));
        }
        Ok(())
    }
}

/// Returns [`Bodies::rate`] at the start.
pub(super) struct Rate;

impl BodiesTask for Rate {
    type Output = f64;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> f64 {
        assembly.bodies.rate(&assembly.initial)
    }
}

/// Returns the nanoseconds of a step; infinite if one fails.
pub(super) struct Timing {
    pub(super) step_s: f64,
    pub(super) steps: u64,
}

impl BodiesTask for Timing {
    type Output = f64;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> f64 {
        let BodiesAssembly { bodies, mut stepper, initial, .. } = assembly;
        let begun = Instant::now();
        let mut made = 0;
        while made == 0 || begun.elapsed().as_nanos() < LEAST_NS {
            stepper.start(&initial);
            for _ in 0..self.steps {
                if stepper.step(&bodies, self.step_s).is_err() {
                    return f64::INFINITY;
                }
            }
            made += self.steps;
        }
        begun.elapsed().as_nanos() as f64 / made as f64
    }
}

/// Makes the first steps of a plan of several bodies; returns the sweeps and the nanoseconds of one, `None` if the first fails.
pub(crate) fn first_steps_of_bodies(plan: &Plan) -> Option<(f64, f64)> {
    /// Work that they may be, by the plan's figures: counted, for logs tell of it, and have the same bytes on every machine.
    const MOST_NS: f64 = 3e8;
    let steps = (MOST_NS / plan.work_step_ns.max(1.0)).clamp(2.0, 32.0) as u32;
    assembled_bodies(plan, FirstStepsOfBodies { step_s: plan.step_s, steps })
}

/// See [`first_steps_of_bodies`].
struct FirstStepsOfBodies {
    step_s: f64,
    /// Of which the first ones have no history to begin from.
    steps: u32,
}

impl BodiesTask for FirstStepsOfBodies {
    type Output = Option<(f64, f64)>;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Self::Output {
        let BodiesAssembly { bodies, mut stepper, initial, .. } = assembly;
        let begun = Instant::now();
        stepper.start(&initial);
        let (mut steps, mut of_first) = (0_u32, Duration::ZERO);
        while steps < self.steps {
            if stepper.step(&bodies, self.step_s).is_err() {
                break;
            }
            steps += 1;
            // Steps that follow others begin from these.
            if steps == self.steps / 2 {
                of_first = begun.elapsed();
            }
        }
        let later = steps.saturating_sub(self.steps / 2);
        let (counted, time) = match (later, steps) {
            (0, 0) => return None,
            (0, steps) => (steps, begun.elapsed()),
            (later, _) => (later, begun.elapsed().saturating_sub(of_first)),
        };
        let sweeps = bodies.work().sweeps() as f64 / f64::from(steps);
        Some((sweeps, time.as_nanos() as f64 / f64::from(counted)))
    }
}
