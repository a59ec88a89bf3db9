//! Steps in a time of their own: the structure they keep, their orders, their samples, and what they spare near charges.

use std::ops::RangeInclusive;

use vpd_solve::failure::Failure;
use vpd_solve::hamiltonian::{Hamiltonian, Kinetic, Law, Rescaled, RigidBody, Term, TimeScale};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::{Checkpoint, State};
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_adaptive::VpdAdaptive;
use vpd_solve::system::{Energy, System};
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{Ending, Observables, Origin, Sample, Schedule, Sink, integrate};

use crate::encounters::{Scene, flyby, heavy_dipole};
use crate::given::Numbers;
use crate::vrkmk::symplectic_defect;

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn total<const N: usize>(body: &RigidBody<N>, state: &State<N>) -> f64 {
    body.energy(&state.attitude, &state.momentum).total()
}

/// Every law, and two charges that time looks at.
fn crowded<const N: usize>() -> (RigidBody<N>, TimeScale, State<N>) {
    let mut numbers = Numbers(71);
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.3 * (i + j) as f64) });
    let matrix = so::symmetric_part(&numbers.matrix());
    let mut terms = vec![
        Term { law: Law::GravityGradient { strength: 0.8, matrix }, space: numbers.vector() },
        Term {
            law: Law::Uniform { weight: 0.7, body_point: numbers.vector() },
            space: numbers.vector(),
        },
        Term {
            law: Law::Spring { stiffness: 0.6, rest_length: 0.5, body_point: numbers.vector() },
            space: numbers.vector() * 3.0,
        },
    ];
    for strength in [-0.5, 0.4] {
        let law = Law::PointSource { strength, body_point: numbers.vector() };
        terms.push(Term { law, space: numbers.vector() });
    }
    let body = RigidBody::new(Kinetic::Principal { weights }, terms, 0.3);
    let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * 1.5 };
    (body, TimeScale::new(vec![0.0, 0.0, 0.0, 0.8, 1.1]), start)
}

/// The same Hamiltonian as a system of no known kind: the step does not know what it is.
struct Unknown<'a, const N: usize> {
    of: Rescaled<'a, N>,
    /// Leaves the term of H - H0 out of the gradient.
    without: Option<&'a RigidBody<N>>,
}

impl<const N: usize> System<N> for Unknown<'_, N> {
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        self.of.energy(g, mu)
    }

    fn check(&self, g: &Mat<N>) -> Result<(), Failure> {
        self.of.check(g)
    }
}

impl<const N: usize> Hamiltonian<N> for Unknown<'_, N> {
    fn velocity(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        self.of.velocity(g, mu)
    }

    fn gradient(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        match self.without {
            Some(body) => body.gradient(g) * self.of.sigma(g),
            None => self.of.gradient(g, mu),
        }
    }
}

/// The end of `steps` own steps of length h, and the time.
fn own_steps<const N: usize>(
    system: &Rescaled<'_, N>,
    start: &State<N>,
    stages: usize,
    h: f64,
    steps: usize,
) -> (State<N>, f64) {
    let mut stepper = Vpd::new(gauss(stages), StopRule::default());
    stepper.start(start);
    let mut time = 0.0;
    for _ in 0..steps {
        time += stepper.timed_step(system, h).expect("a small step").1;
    }
    (State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() }, time)
}

fn distance<const N: usize>(a: &State<N>, b: &State<N>) -> f64 {
    (a.attitude - b.attitude).amax().max((a.momentum - b.momentum).amax())
}

#[test]
fn its_derivatives_are_those_of_its_energy() {
    fn law<const N: usize>() {
        let (body, scale, State { attitude: g, momentum: mu }) = crowded::<N>();
        // Off the motion of this energy the second term counts.
        let system =
            Rescaled::new(&body, &scale, total(&body, &State { attitude: g, momentum: mu }) - 0.7);
        let e = 1e-5;
        for k in 0..so::dimension(N) {
            let mut unit = vec![0.0; so::dimension(N)];
            unit[k] = 1.0;
            let eta = so::hat::<N>(&unit);
            let at = |d: f64| system.energy(&(g * so::exp(&(eta * d))), &mu).total();
            let slope = (at(e) - at(-e)) / (2.0 * e);
            let found = so::inner(&system.gradient(&g, &mu), &eta);
            assert!((slope - found).abs() < 1e-8, "n = {N}: {slope} {found}");
            let at = |d: f64| system.energy(&g, &(mu + eta * d)).total();
            let slope = (at(e) - at(-e)) / (2.0 * e);
            let found = so::inner(&system.velocity(&g, &mu), &eta);
            assert!((slope - found).abs() < 1e-8, "n = {N}: {slope} {found}");
        }
    }
    law::<2>();
    law::<3>();
    law::<4>();
    law::<5>();
}

/// A body that turns fast, far from the one charge that time looks at.
fn spinning() -> (RigidBody<3>, TimeScale, State<3>) {
    let terms = vec![
        Term {
            law: Law::Uniform { weight: 0.3, body_point: Vector::<3>::new(0.0, 0.0, 1.0) },
            space: Vector::<3>::new(0.0, 0.0, 1.0),
        },
        Term {
            law: Law::PointSource { strength: 0.1, body_point: Vector::<3>::new(1.0, 0.0, 0.0) },
            space: Vector::<3>::new(0.0, 6.0, 3.0),
        },
    ];
    let moments = [1.0, 0.8, 0.5];
    let spin = [0.7, -0.6, 0.9];
    let momentum = so::hat(&[0, 1, 2].map(|i| moments[i] * spin[i]));
    let body = RigidBody::new(Kinetic::of_moments(moments), terms, 0.0);
    (body, TimeScale::new(vec![0.0, 0.8]), State { attitude: Mat::identity(), momentum })
}

/// The stages side by side make the step that knows nothing of the system but its derivatives.
#[test]
fn in_lanes_it_is_the_same_map() {
    fn law<const N: usize>(
        (body, scale, start): (RigidBody<N>, TimeScale, State<N>),
        stages: RangeInclusive<usize>,
        steps: &[f64],
    ) {
        let of = Rescaled::new(&body, &scale, total(&body, &start));
        for stages in stages {
            for &h in steps {
                let mut quick = Vpd::new(gauss(stages), StopRule::default());
                let mut plain = Vpd::new(gauss(stages), StopRule::default());
                quick.start(&start);
                plain.start(&start);
                quick.step(&of, h).expect("a small step");
                plain.step(&Unknown { of, without: None }, h).expect("a small step");
                let apart = (quick.attitude().expect("carried")
                    - plain.attitude().expect("carried"))
                .amax()
                .max((quick.momentum() - plain.momentum()).amax());
                assert!(apart < 3e-14, "n = {N}, {stages} stages, {h}: {apart:e}");
            }
        }
    }
    const SHORT: [f64; 3] = [0.05, 0.2, 0.4];
    law(crowded::<2>(), 1..=8, &SHORT);
    law(crowded::<3>(), 1..=8, &SHORT);
    law(crowded::<4>(), 1..=8, &SHORT);
    law(crowded::<5>(), 1..=8, &SHORT);
    law(crowded::<8>(), 1..=8, &SHORT);
    // Up to 1.3 rad.
    law(spinning(), 3..=8, &[0.4, 0.6, 0.8, 1.0]);
}

#[test]
fn symplectic_with_its_second_term_alone() {
    fn law<const N: usize>() {
        let (body, scale, start) = crowded::<N>();
        let of = Rescaled::new(&body, &scale, total(&body, &start));
        for stages in [1, 2, 4] {
            let mut stepper = Vpd::new(gauss(stages), StopRule::default());
            let with = symplectic_defect(&mut stepper, &of, &start, 0.4, 4e-3);
            let control = Unknown { of, without: Some(&body) };
            let mut stepper = Vpd::new(gauss(stages), StopRule::default());
            let without = symplectic_defect(&mut stepper, &control, &start, 0.4, 4e-3);
            let time = time_defect(&of, &start, stages, 0.4);
            println!(
                "n = {N}, {stages} stages: {with:.1e}, without {without:.1e}, time {time:.1e}"
            );
            assert!(with <= 1e-11, "n = {N}, {stages} stages: {with:e}");
            assert!(time <= 1e-10, "n = {N}, {stages} stages: {time:e}");
            assert!(without > 1e-2, "n = {N}, {stages} stages: {without:e}");
        }
    }
    law::<3>();
    law::<4>();
}

/// Returns the defect of the condition that makes the map symplectic in t and its momentum -H0,
/// too. With H0 as a parameter of a symplectic map the images of directions (e, n) of the state and
/// of the change of H0 must have
///
/// ```text
/// omega(d/de (g, m), d/dH0 (g, m)) = -dt/de
/// ```
fn time_defect<const N: usize>(
    system: &Rescaled<'_, N>,
    start: &State<N>,
    stages: usize,
    h: f64,
) -> f64 {
    let e = 4e-3;
    let zero = Mat::<N>::zeros();
    let m0 = so::conjugate(&start.attitude, &start.momentum);
    let end = |turn: &Mat<N>, push: &Mat<N>, energy: f64| {
        let attitude = so::exp(turn) * start.attitude;
        let momentum = so::conjugate(&attitude.transpose(), &(m0 + push));
        let shifted = system.with_energy(system.energy_of_motion() + energy);
        let (end, time) = own_steps(&shifted, &State { attitude, momentum }, stages, h, 1);
        (end.attitude, so::conjugate(&end.attitude, &end.momentum), time)
    };
    let (g1, m1, _) = end(&zero, &zero, 0.0);
    let image = |turn: &Mat<N>, push: &Mat<N>, energy: f64| {
        let (mut dg, mut dm, mut dt) = (zero, zero, 0.0);
        for (k, weight) in [(1.0, 45.0), (2.0, -9.0), (3.0, 1.0)] {
            for sign in [1.0, -1.0] {
                let d = sign * k * e;
                let (g, m, t) = end(&(turn * d), &(push * d), energy * d);
                let weight = sign * weight / (60.0 * e);
                dg += g * weight;
                dm += m * weight;
                dt += t * weight;
            }
        }
        (so::asym(&(dg * g1.transpose())) * 0.5, dm, dt)
    };
    let of_energy = image(&zero, &zero, 1.0);
    let mut defect = 0.0_f64;
    for k in 0..so::dimension(N) {
        let mut unit = vec![0.0; so::dimension(N)];
        unit[k] = 1.0;
        let unit = so::hat::<N>(&unit);
        for (turn, push) in [(unit, zero), (zero, unit)] {
            let a = image(&turn, &push, 0.0);
            let form = so::inner(&of_energy.1, &a.0)
                - so::inner(&a.1, &of_energy.0)
                - so::inner(&m1, &(a.0 * of_energy.0 - of_energy.0 * a.0));
            defect = defect.max((form - a.2).abs());
        }
    }
    defect
}

#[test]
fn orders_in_state_and_time() {
    fn law<const N: usize>() {
        let (body, scale, start) = crowded::<N>();
        let system = Rescaled::new(&body, &scale, total(&body, &start));
        let truth = own_steps(&system, &start, 8, 0.05, 40);
        for stages in 1..=4 {
            let steps = [80, 20, 12, 8][stages - 1];
            let error = |steps: usize| {
                let (state, time) = own_steps(&system, &start, stages, 2.0 / steps as f64, steps);
                (distance(&state, &truth.0), (time - truth.1).abs())
            };
            let (coarse, fine) = (error(steps), error(2 * steps));
            let (state, time) = ((coarse.0 / fine.0).log2(), (coarse.1 / fine.1).log2());
            println!(
                "n = {N}, {stages} stages: {state:.2}, time {time:.2} ({:.0e}, {:.0e})",
                fine.0, fine.1
            );
            let order = 2.0 * stages as f64;
            assert!((state - order).abs() < 0.3, "n = {N}, {stages} stages: {state}");
            // Only where rounding does not hide it.
            if fine.1 > 1e-14 {
                assert!((time - order).abs() < 0.3, "n = {N}, {stages} stages: time {time}");
            }
        }
    }
    law::<3>();
    law::<4>();
}

#[test]
fn one_stage_goes_back_the_way_it_came() {
    fn law<const N: usize>() {
        let (body, scale, start) = crowded::<N>();
        let system = Rescaled::new(&body, &scale, total(&body, &start));
        let mut stepper = Vpd::new(gauss(1), StopRule::default());
        stepper.start(&start);
        let mut time = 0.0;
        for h in [0.1, 0.1, 0.1, -0.1, -0.1, -0.1] {
            time += stepper.timed_step(&system, h).expect("a small step").1;
        }
        let end =
            State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() };
        let off = distance(&end, &start);
        assert!(off <= 2e-14 && time.abs() <= 2e-15, "n = {N}: {off:e}, time {time:e}");
    }
    law::<3>();
    law::<4>();
}

/// Keeps samples and checkpoints, one of these every k samples.
#[derive(Default)]
struct Kept<const N: usize> {
    samples: Vec<Sample<N>>,
    checkpoints: Vec<Checkpoint<N>>,
    every: usize,
}

impl<const N: usize> Sink<N> for Kept<N> {
    type Error = std::convert::Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Self::Error> {
        self.samples.push(sample.clone());
        Ok(())
    }

    fn wants_checkpoint(&self) -> bool {
        self.every > 0 && self.samples.len().is_multiple_of(self.every)
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<N>) -> Result<(), Self::Error> {
        self.checkpoints.push(checkpoint.clone());
        Ok(())
    }
}

const ALL: Observables = Observables {
    energy: true,
    orthogonality: true,
    momentum: true,
    sigma_min: true,
    pace: true,
    control: false,
    pointing: false,
    derivatives: false,
};

fn adaptive(scene: &Scene, stages: usize, largest_step_s: f64) -> VpdAdaptive<3> {
    VpdAdaptive::new(gauss(stages), StopRule::default(), scene.scale.clone())
        .with_steps_of(largest_step_s)
}

fn sampled(scene: &Scene, stages: usize, own_h: f64, samples: u64, every: usize) -> Kept<3> {
    let mut kept = Kept { every, ..Kept::default() };
    let schedule = Schedule { step_s: scene.until / samples as f64, steps: samples, every: 1 };
    let mut stepper = adaptive(scene, stages, own_h);
    let Ok(end) =
        integrate(&scene.body, &mut stepper, &scene.start, schedule, ALL, &mut kept, |_| true);
    assert_eq!(end.ending, Ending::Completed, "{}", scene.name);
    kept
}

#[test]
fn samples_come_at_their_times_and_are_no_worse_than_ends_of_steps() {
    let scene = heavy_dipole();
    let truth = sampled(&scene, 8, 0.02, 61, 0);
    for stages in [1, 2, 4] {
        let own_h = 0.1;
        let kept = sampled(&scene, stages, own_h, 61, 0);
        // The ends of own steps, against the truth at their times: a sample of one step to there.
        let mut stepper = adaptive(&scene, stages, own_h);
        stepper.start(&scene.start);
        let mut at_ends = 0.0_f64;
        for _ in 0..61 {
            let step_s = scene.until / 61.0;
            stepper.step(&scene.body, step_s).expect("a small step");
            let own = stepper.own_time().expect("one");
            let mut exact = adaptive(&scene, 8, 0.02);
            exact.start(&scene.start);
            if own.time_s > 0.0 {
                exact.step(&scene.body, own.time_s).expect("a small step");
                exact.synchronise(&scene.body, own.time_s).expect("a small step");
                let here = State { attitude: own.attitude, momentum: own.momentum };
                let there = State {
                    attitude: exact.attitude().expect("carried"),
                    momentum: exact.momentum(),
                };
                at_ends = at_ends.max(distance(&here, &there));
            }
        }
        let state = |sample: &Sample<3>| State {
            attitude: sample.attitude.expect("carried"),
            momentum: sample.momentum,
        };
        let mut at_samples = 0.0_f64;
        let mut time_error = 0.0_f64;
        for (sample, exact) in kept.samples.iter().zip(&truth.samples) {
            at_samples = at_samples.max(distance(&state(sample), &state(exact)));
            time_error = time_error.max(sample.pace.expect("its own time").time_error_s.abs());
        }
        println!(
            "{stages} stages: samples {at_samples:.1e}, ends {at_ends:.1e}, time {time_error:.1e}"
        );
        assert!(at_samples <= 2.0 * at_ends + 1e-12, "{at_samples:e} {at_ends:e}");
        assert!(time_error <= 1e-14, "{time_error:e}");
    }
}

#[test]
fn a_resumed_run_is_the_one_that_was_not_interrupted() {
    let scene = flyby();
    let whole = sampled(&scene, 2, 0.3, 40, 7);
    for checkpoint in &whole.checkpoints {
        let mut kept = Kept { every: 7, ..Kept::default() };
        // The samples before the checkpoint: they tell when the next one is due.
        kept.samples = whole.samples[..checkpoint.samples as usize].to_vec();
        let origin = Origin { initial: &scene.start, checkpoint: Some(checkpoint) };
        let schedule = Schedule { step_s: scene.until / 40.0, steps: 40, every: 1 };
        let mut stepper = adaptive(&scene, 2, 0.3);
        let Ok(_) =
            integrate(&scene.body, &mut stepper, origin, schedule, ALL, &mut kept, |_| true);
        assert_eq!(kept.samples, whole.samples);
    }
}

/// |H - H0| and the momentum about the vertical over long runs past charges.
#[test]
fn energy_stays_past_charges() {
    for (scene, own_h, limit) in [(heavy_dipole(), 0.02, 5e-9), (flyby(), 0.02, 5e-8)] {
        let start = &scene.start;
        let h0 = total(&scene.body, start);
        let system = Rescaled::new(&scene.body, &scene.scale, h0);
        let mut stepper = Vpd::new(gauss(2), StopRule::default());
        stepper.start(start);
        let vertical = |g: &Mat<3>, mu: &Mat<3>| so::vee(&so::conjugate(g, mu))[2];
        let first = vertical(&start.attitude, &start.momentum);
        let (mut halves, mut momentum, mut sweeps) = ([0.0_f64; 2], 0.0_f64, 0);
        let steps = 100_000;
        for k in 0..steps {
            sweeps += stepper.step(&system, own_h).expect("a step of ease").iterations;
            let (g, mu) = (stepper.attitude().expect("carried"), stepper.momentum());
            let half = &mut halves[k / (steps / 2)];
            *half = half.max((scene.body.energy(&g, &mu).total() - h0).abs());
            momentum = momentum.max((vertical(&g, &mu) - first).abs());
        }
        println!(
            "{}: energy {:.2e} and {:.2e}, momentum {momentum:.1e}, {:.1} rounds a step",
            scene.name,
            halves[0],
            halves[1],
            f64::from(sweeps) / steps as f64
        );
        assert!(halves[1] <= limit && halves[1] <= 1.5 * halves[0], "{}: {halves:?}", scene.name);
        assert!(momentum <= 1e-13, "{}: {momentum:e}", scene.name);
    }
}
