//! Several bodies in steps that adapt: the structure they keep, their orders, their samples, and what they spare.

use vpd_solve::bodies::trajectory::{
    BodiesStepper, Checkpoint, Course, Ending, Sample, Schedule, Sink, integrate, integrate_members,
};
use vpd_solve::bodies::vpd::BodiesVpd;
use vpd_solve::bodies::vpd_adaptive::BodiesVpdAdaptive;
use vpd_solve::bodies::{
    Bodies, BodiesCondition, BodiesState, BodiesStop, BodiesTimeScale, Body, Hold, Interaction,
    Site, Start,
};
use vpd_solve::failure::FailureCode;
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd_adaptive::VpdAdaptive;
use vpd_solve::tableau::Tableau;
use vpd_solve::work::Work;

use crate::bodies::{Forms, apart, chain, diagonal, turned, v, varied, vpd};
use crate::encounters::flyby;

fn total<const N: usize>(bodies: &Bodies<N>, state: &BodiesState<N>) -> f64 {
    bodies.energy(state, &bodies.seen(state).expect("regular")).total()
}

fn worst(differences: [f64; 4]) -> f64 {
    differences.into_iter().fold(0.0, f64::max)
}

fn tableau(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn adaptive<const N: usize>(
    scale: &BodiesTimeScale,
    state: &BodiesState<N>,
    stages: usize,
    largest_step_s: f64,
) -> BodiesVpdAdaptive<N> {
    BodiesVpdAdaptive::new(tableau(stages), StopRule::default(), scale.clone(), state)
        .with_steps_of(largest_step_s)
}

/// A scene, and the rate of its time.
type Scene<const N: usize> = (Bodies<N>, BodiesTimeScale, BodiesState<N>);

/// Three free bodies with every law between them, of which time looks at two.
fn crowded() -> Scene<3> {
    let body = |a: usize| Body {
        second_moments: diagonal([0.2, 0.3 + 0.1 * a as f64, 0.55]),
        mass_kg: 1.0 + 0.3 * a as f64,
        hold: Hold::Free,
    };
    let start = |a: usize| Start {
        attitude: so::exp(&turned(a, 0.7)),
        angular_velocity: turned(a + 3, 0.5),
        position: varied(a, 0.6) + v([1.6 * a as f64, 0.0, 0.0]),
        velocity: varied(a + 5, 0.4),
    };
    let interactions = vec![
        Interaction::MutualGravity { bodies: [0, 1], constant: 0.5 },
        Interaction::Spring {
            sites: [Site::Body(0, varied(0, 0.5)), Site::Body(2, varied(7, 0.4))],
            stiffness: 0.7,
            rest_length: 0.8,
        },
        Interaction::PointSource {
            sites: [Site::Body(1, varied(1, 0.4)), Site::Body(2, varied(3, 0.4))],
            strength: -0.6,
        },
        Interaction::Uniform {
            body: 1,
            point: varied(2, 0.3),
            weight: 0.4,
            direction: v([0.0, 0.3, 1.0]),
        },
    ];
    let bodies = Bodies::new((0..3).map(body).collect(), interactions).expect("a system");
    let state = bodies.state(&(0..3).map(start).collect::<Vec<_>>());
    (bodies, BodiesTimeScale::new(vec![1.2, 0.0, 0.9, 0.0]), state)
}

/// A chain, hung or floating, with a charge on its last link and one in space.
fn charged_chain(hung: bool) -> Scene<3> {
    let (of, state) = chain(hung);
    let weights = (0..3).map(|body| Interaction::Uniform {
        body,
        point: Vector::zeros(),
        weight: 9.81,
        direction: v([0.0, 0.0, 1.0]),
    });
    let source = Interaction::PointSource {
        sites: [Site::Body(2, v([0.1, 0.0, -0.5])), Site::Space(v([0.4, -0.5, -1.4]))],
        strength: -0.4,
    };
    let interactions = weights.chain([source]).collect();
    let bodies = Bodies::new(of.bodies().to_vec(), interactions).expect("a system");
    (bodies, BodiesTimeScale::new(vec![0.0, 0.0, 0.0, 1.1]), state)
}

/// Two spheres on an ellipse of half the long axis 1, of this eccentricity, from the apocentre.
fn binary(e: f64) -> Scene<3> {
    let sphere = |mass_kg: f64| Body {
        // Far smaller than the nearest distance.
        second_moments: diagonal([1e-12 * mass_kg; 3]),
        mass_kg,
        hold: Hold::Free,
    };
    let pull = Interaction::MutualGravity { bodies: [0, 1], constant: CONSTANT };
    let bodies = Bodies::new(vec![sphere(M[0]), sphere(M[1])], vec![pull]).expect("a system");
    let (r, speed) = (1.0 + e, mean_motion() * ((1.0 - e) / (1.0 + e)).sqrt());
    let at = |part: f64| Start {
        attitude: Mat::identity(),
        angular_velocity: so::hat(&[0.1, 0.4, 0.2]),
        position: v([-part * r, 0.0, 0.0]),
        velocity: v([0.0, -part * speed, 0.0]),
    };
    let state = bodies.state(&[at(-M[1] / (M[0] + M[1])), at(M[0] / (M[0] + M[1]))]);
    (bodies, BodiesTimeScale::new(vec![1.0]), state)
}

const M: [f64; 2] = [3.0, 1.0];
const CONSTANT: f64 = 2.0;

/// n^2 a^3 = G (m1 + m2)
fn mean_motion() -> f64 {
    (CONSTANT * (M[0] + M[1])).sqrt()
}

/// Where the second sphere is from the first, and its velocity, by Kepler's equation.
fn kepler(e: f64, time_s: f64) -> [Vector<3>; 2] {
    let n = mean_motion();
    let mean = std::f64::consts::PI + n * time_s;
    let mut anomaly = mean;
    for _ in 0..100 {
        let off = anomaly - e * libm::sin(anomaly) - mean;
        anomaly -= off / (1.0 - e * libm::cos(anomaly));
    }
    let (cos, sin) = (libm::cos(anomaly), libm::sin(anomaly));
    let minor = (1.0 - e * e).sqrt();
    let rate = n / (1.0 - e * cos);
    [v([cos - e, minor * sin, 0.0]), v([-sin * rate, minor * cos * rate, 0.0])]
}

/// The state after `steps` own steps, and the time.
fn own_steps<const N: usize>(
    (bodies, scale, start): &Scene<N>,
    energy: f64,
    stages: usize,
    h: f64,
    steps: usize,
) -> (BodiesState<N>, f64) {
    let mut stepper = vpd(stages, start).rescaled(scale.clone(), energy);
    let mut time_s = 0.0;
    for _ in 0..steps {
        time_s += stepper.timed_step(bodies, h).expect("a small step").1;
    }
    (stepper.state(), time_s)
}

/// The state at a time, as a sample shows it.
fn at_time<const N: usize>(
    (bodies, scale, start): &Scene<N>,
    stages: usize,
    largest_step_s: f64,
    time_s: f64,
) -> BodiesState<N> {
    let mut stepper = adaptive(scale, start, stages, largest_step_s);
    stepper.step(bodies, time_s).expect("it adapts");
    stepper.synchronise(bodies, time_s).expect("it adapts");
    stepper.state()
}

/// Off the motion of its energy, where the second term counts, against differences of `sigma (H - H0)`.
#[test]
fn forces_are_the_gradient_of_the_rescaled_energy() {
    let scene = crowded();
    let (bodies, scale, state) = &scene;
    let energy = total(bodies, state) - 0.7;
    let rescaled = |state: &BodiesState<3>| {
        let sigma = scale.sigma(bodies, &state.attitudes, &state.places).expect("apart");
        sigma * (total(bodies, state) - energy)
    };
    // To second order a short step is made of the derivatives halfway; forth less back leaves those at the start.
    let h = 1e-4;
    let step = |h: f64| own_steps(&scene, energy, 2, h, 1).0;
    let (forth, back) = (step(h), step(-h));
    for body in 0..3 {
        for i in 0..3 {
            let slope = |changed: &dyn Fn(&mut BodiesState<3>, f64)| {
                let at = |by: f64| {
                    let mut state = state.clone();
                    changed(&mut state, by);
                    rescaled(&state)
                };
                (at(1e-5) - at(-1e-5)) / 2e-5
            };
            let force = -slope(&|state, by| state.places[body][i] += by);
            let found = (forth.linear_momenta[body][i] - back.linear_momenta[body][i]) / (2.0 * h);
            assert!((force - found).abs() < 1e-7, "force {i} on {body}: {found}, not {force}");
            let velocity = slope(&|state, by| state.linear_momenta[body][i] += by);
            let found = (forth.places[body][i] - back.places[body][i]) / (2.0 * h);
            assert!((velocity - found).abs() < 1e-7, "velocity: {found}, not {velocity}");
            let axis = |by: f64| {
                let mut axis = [0.0; 3];
                axis[i] = by;
                so::hat::<3>(&axis)
            };
            let spatial = |state: &BodiesState<3>| {
                so::vee(&so::conjugate(&state.attitudes[body], &state.momenta[body]))[i]
            };
            let torque = -slope(&|state, by| {
                // Turned in space, with the momentum it carries along.
                state.attitudes[body] = so::exp(&axis(by)) * state.attitudes[body];
            });
            let found = (spatial(&forth) - spatial(&back)) / (2.0 * h);
            assert!((torque - found).abs() < 1e-7, "torque {i} on {body}: {found}, not {torque}");
        }
    }
}

/// The form of the start is that of the end, also in the time and its momentum -H0; with an H0 for each start of its own, which
/// leaves the term of H - H0 out, it is not.
#[test]
fn symplectic_in_the_state_and_the_time() {
    let scenes = [(crowded(), 3), (charged_chain(true), 0), (charged_chain(false), 1)];
    for ((scene, moving), h) in scenes.into_iter().zip([0.2, 0.04, 0.04]) {
        let (bodies, scale, start) = &scene;
        let energy = total(bodies, start);
        let with = |state: &BodiesState<3>, energy: f64| {
            let mut stepper = vpd(2, state).rescaled(scale.clone(), energy);
            let (_, time_s) = stepper.timed_step(bodies, h).expect("a small step");
            (stepper.state(), time_s)
        };
        let forms = Forms::new(start, moving, |state| with(state, energy));
        let defect = forms.defect();
        let of_time = forms.time_defect(|change| with(start, energy + change));
        let own = |state: &BodiesState<3>| with(state, total(bodies, state));
        let without = Forms::new(start, moving, own).defect();
        println!("{moving} moving: {defect:.1e}, time {of_time:.1e}, without {without:.1e}");
        assert!(defect <= 2e-11, "{defect:e}");
        assert!(of_time <= 2e-11, "time {of_time:e}");
        assert!(without > 1e-3, "{without:e}");
    }
}

/// On ellipses of e = 0.9 and 0.97, against Kepler's equation, after two revolutions and a bit.
#[test]
fn orders_on_keplers_ellipse() {
    let period_s = std::f64::consts::TAU / mean_motion();
    let time_s = 2.3 * period_s;
    for e in [0.9, 0.97] {
        let scene = binary(e);
        let known = kepler(e, time_s);
        for (stages, coarse) in [(1, 400.0), (2, 100.0), (4, 20.0), (8, 12.0)] {
            let error = |parts: f64| {
                let end = at_time(&scene, stages, period_s / parts, time_s);
                let place = end.places[1] - end.places[0];
                let velocity = end.linear_momenta[1] / M[1] - end.linear_momenta[0] / M[0];
                (place - known[0]).norm().max((velocity - known[1]).norm() / mean_motion())
            };
            if stages == 8 {
                println!("e = {e}, 8 stages: {:.1e}, {:.1e}", error(coarse), error(2.0 * coarse));
                assert!(error(2.0 * coarse) < 2e-12, "{:e}", error(2.0 * coarse));
                continue;
            }
            let (one, two) = (error(coarse), error(2.0 * coarse));
            let order = libm::log2(one / two);
            println!("e = {e}, {stages} stages: order {order:.2} ({one:.0e}, {two:.0e})");
            assert!((order - 2.0 * stages as f64).abs() < 0.35, "{stages} stages: {order}");
        }
    }
}

#[test]
fn energy_stays_and_momenta_are_kept() {
    let (bodies, scale, start) = binary(0.97);
    let energy = total(&bodies, &start);
    let period_s = std::f64::consts::TAU / mean_motion();
    for (stages, parts, limit) in [(2, 100.0, 2e-3), (8, 20.0, 1e-13)] {
        let mut stepper = vpd(stages, &start).rescaled(scale.clone(), energy);
        let first = bodies.angular_momentum(&start);
        let (mut halves, mut rescaled, mut linear, mut angular) =
            ([0.0_f64; 2], 0.0_f64, 0.0_f64, 0.0_f64);
        let (mut sweeps, steps) = (0, 20_000);
        for k in 0..steps {
            sweeps += stepper.step(&bodies, period_s / parts).expect("a step of ease").iterations;
            let state = stepper.state();
            let off = (total(&bodies, &state) - energy).abs();
            let sigma = scale.sigma(&bodies, &state.attitudes, &state.places).expect("apart");
            halves[k / (steps / 2)] = halves[k / (steps / 2)].max(off);
            rescaled = rescaled.max(sigma * off);
            linear = linear.max(state.linear_momenta.iter().sum::<Vector<3>>().norm());
            angular = angular.max((bodies.angular_momentum(&state) - first).amax());
        }
        println!(
            "{stages} stages: energy {:.2e} and {:.2e} of {energy:.2}, rescaled {rescaled:.1e}, linear {linear:.1e}, \
             angular {angular:.1e}, {:.1} sweeps a step",
            halves[0],
            halves[1],
            f64::from(sweeps) / steps as f64
        );
        assert!(rescaled <= limit && halves[1] <= 2.0 * halves[0] + limit, "{halves:?}");
        assert!(linear <= 1e-13 && angular <= 1e-13, "{linear:e} {angular:e}");
    }
}

/// With one stage, as steps of one length do.
#[test]
fn one_stage_goes_back_the_way_it_came() {
    for (bodies, scale, start) in [crowded(), charged_chain(true), charged_chain(false)] {
        let energy = total(&bodies, &start);
        let mut stepper = vpd(1, &start).rescaled(scale, energy);
        let mut time_s = 0.0;
        for h in [0.03, 0.03, 0.03, -0.03, -0.03, -0.03] {
            time_s += stepper.timed_step(&bodies, h).expect("a small step").1;
        }
        let off = worst(apart(&stepper.state(), &start));
        assert!(off <= 5e-14 && time_s.abs() <= 5e-15, "{off:e}, time {time_s:e}");
    }
}

/// The rescaled step of one pinned body past a charge is that of the program for one body.
#[test]
fn one_pinned_body_is_the_body_of_one() {
    let one = flyby();
    let charge = v([0.0, 0.05, -1.0]);
    let body = Body {
        second_moments: diagonal([0.3, 0.1, 0.9]),
        mass_kg: 1.0,
        hold: Hold::Pivot(Vector::zeros()),
    };
    let weight = Interaction::Uniform {
        body: 0,
        point: v([0.0, 0.0, -1.0]),
        weight: 1.0,
        direction: v([0.0, 0.0, 1.0]),
    };
    let source = Interaction::PointSource {
        sites: [Site::Body(0, charge), Site::Space(v([0.0, 0.0, -1.011_249_2]))],
        strength: -1.0,
    };
    let bodies = Bodies::new(vec![body], vec![weight, source]).expect("a system");
    let mut state = bodies.state(&[Start {
        attitude: one.start.attitude,
        angular_velocity: Mat::zeros(),
        position: Vector::zeros(),
        velocity: Vector::zeros(),
    }]);
    state.momenta[0] = one.start.momentum;
    let scale = BodiesTimeScale::new(vec![0.0, charge.norm()]);
    let mut several = adaptive(&scale, &state, 4, 0.1);
    let mut single =
        VpdAdaptive::new(tableau(4), StopRule::default(), one.scale.clone()).with_steps_of(0.1);
    single.start(&one.start);
    for _ in 0..20 {
        several.step(&bodies, 0.1).expect("it adapts");
        single.step(&one.body, 0.1).expect("it adapts");
    }
    several.synchronise(&bodies, 0.1).expect("it adapts");
    single.synchronise(&one.body, 0.1).expect("it adapts");
    let end = several.state();
    let off = (end.attitudes[0] - single.attitude().expect("carried")).amax();
    let of_momentum = (end.momenta[0] - single.momentum()).amax();
    println!("{off:.1e}, {of_momentum:.1e}");
    assert!(off < 1e-11 && of_momentum < 1e-11, "{off:e} {of_momentum:e}");
    let paces = [several.pace().expect("its own time"), single.pace().expect("its own time")];
    assert_eq!(paces[0].steps, paces[1].steps);
    assert!((paces[0].least_sigma - paces[1].least_sigma).abs() < 1e-12, "{paces:?}");
}

/// Keeps samples and checkpoints, one of these every k samples.
#[derive(Default)]
struct Kept {
    samples: Vec<Sample<3>>,
    checkpoints: Vec<Checkpoint>,
    every: usize,
}

impl Sink<3> for Kept {
    type Error = std::convert::Infallible;

    fn record(&mut self, sample: &Sample<3>) -> Result<(), Self::Error> {
        self.samples.push(sample.clone());
        Ok(())
    }

    fn wants_checkpoint(&self) -> bool {
        self.every > 0 && self.samples.len().is_multiple_of(self.every)
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<(), Self::Error> {
        self.checkpoints.push(checkpoint.clone());
        Ok(())
    }
}

/// Samples come at uniform times, each as good as an end of a step, and a run that is resumed is the one that was not interrupted.
#[test]
fn samples_and_checkpoints_of_a_binary() {
    let e = 0.95;
    let (bodies, scale, start) = binary(e);
    let step_s = std::f64::consts::TAU / mean_motion() / 31.0;
    let travel = |stages: usize, checkpoint: Option<&Checkpoint>, samples: &[Sample<3>]| {
        let mut kept = Kept { every: 7, samples: samples.to_vec(), ..Kept::default() };
        let course = Course { initial: &start, checkpoint, step_s, steps: 70, every: 1 };
        let mut stepper = adaptive(&scale, &start, stages, 2.0 * step_s);
        let Ok(end) = integrate(&bodies, &mut stepper, course, &mut kept, |_| true);
        assert_eq!(end.ending, Ending::Completed);
        (kept, end)
    };
    let (whole, end) = travel(8, None, &[]);
    let mut least = 1.0_f64;
    for (k, sample) in whole.samples.iter().enumerate() {
        assert_eq!(sample.time_s, k as f64 * step_s);
        let pace = sample.pace.expect("its own time");
        assert!(pace.time_error_s.abs() <= 1e-14, "{pace:?}");
        assert!(pace.sigma > 0.0 && pace.sigma <= 1.0 && pace.step_s <= 2.0 * step_s, "{pace:?}");
        least = least.min(pace.least_sigma);
        let apart = sample.bodies[1].position - sample.bodies[0].position;
        let error = (apart - kepler(e, sample.time_s)[0]).norm();
        assert!(error < 3e-11, "at {}: {error:e}", sample.time_s);
    }
    // sigma is about (rho / near)^(3/2) at the pericentre, 0.05.
    assert!(least > 0.011 && least < 0.03, "{least}");
    for checkpoint in &whole.checkpoints {
        let before = &whole.samples[..checkpoint.samples as usize];
        let (rest, reached) = travel(8, Some(checkpoint), before);
        assert_eq!(rest.samples, whole.samples);
        assert_eq!(reached, end);
    }
}

/// Each member has its own energy at the start, and a condition ends a run at the time of a step.
#[test]
fn members_and_conditions() {
    let (bodies, scale, start) = binary(0.95);
    let mut other = start.clone();
    other.linear_momenta[1] *= 1.1;
    let starts = [start.clone(), other.clone()];
    let mut steppers: Vec<Box<dyn BodiesStepper<3>>> = starts
        .iter()
        .map(|_| Box::new(adaptive(&scale, &start, 4, 0.1)) as Box<dyn BodiesStepper<3>>)
        .collect();
    let schedule = Schedule { step_s: 0.05, steps: 30, every: 3 };
    let mut samples = [Vec::new(), Vec::new()];
    let record = |m: usize, sample: &Sample<3>| {
        samples[m].push(sample.clone());
        Ok::<(), std::convert::Infallible>(())
    };
    let Ok(_) = integrate_members(&bodies, &mut steppers, &starts, schedule, record, |_| true);
    let alone = |start: &BodiesState<3>, bodies: &Bodies<3>| {
        let mut samples = Vec::new();
        let course = Course { initial: start, checkpoint: None, step_s: 0.05, steps: 30, every: 3 };
        let Ok(end) =
            integrate(bodies, &mut adaptive(&scale, start, 4, 0.1), course, &mut samples, |_| true);
        (samples, end)
    };
    for (samples, start) in samples.iter().zip(&starts) {
        assert_eq!(samples, &alone(start, &bodies).0);
    }
    let sites = [0, 1].map(|body| Site::Body(body, Vector::zeros()));
    let condition = BodiesCondition::DistanceBelow(sites, 1.0);
    let stopped = bodies.with_stops(vec![BodiesStop { condition, for_s: 0.0, exact: false }]);
    let (samples, end) = alone(&start, &stopped);
    assert_eq!(end.ending, Ending::Stopped(0));
    let distance = |time_s: f64| kepler(0.95, time_s)[0].norm();
    assert!(distance(end.time_s) < 1.0 && distance(end.time_s - 0.05) >= 1.0, "{}", end.time_s);
    assert_eq!(samples.last().map(|sample| sample.time_s), Some(end.time_s));
}

/// Two spheres that turn pass each other: the evaluations of all forces for an error at the end, by either kind of step.
#[test]
fn a_flyby_takes_fewer_evaluations() {
    let body = |mass_kg: f64, moments: [f64; 3]| Body {
        second_moments: diagonal(moments),
        mass_kg,
        hold: Hold::Free,
    };
    let two = vec![body(1.0, [1e-6; 3]), body(0.1, [1e-7; 3])];
    let pull = Interaction::MutualGravity { bodies: [0, 1], constant: 1.0 };
    let bodies = Bodies::new(two, vec![pull]).expect("a system");
    let start = |place: [f64; 3], velocity: [f64; 3], spin: [f64; 3]| Start {
        attitude: Mat::identity(),
        angular_velocity: so::hat(&spin),
        position: v(place),
        velocity: v(velocity),
    };
    let state = bodies.state(&[
        start([0.0; 3], [0.0; 3], [0.0, 0.1, 0.3]),
        start([-5.0, 0.4, 0.0], [0.7, 0.0, 0.0], [0.2, 0.0, 0.4]),
    ]);
    let near = (state.places[1] - state.places[0]).norm();
    let scene = (bodies, BodiesTimeScale::new(vec![near]), state);
    let (bodies, scale, state) = &scene;
    let time_s = 10.0;
    let truth = at_time(&scene, 8, 0.1, time_s);
    let closest = (0..100)
        .map(|k| at_time(&scene, 8, 0.25, time_s * (k + 1) as f64 / 100.0))
        .map(|state| (state.places[1] - state.places[0]).norm())
        .fold(f64::INFINITY, f64::min);
    let evaluations = |stages: usize, adapts: bool| {
        (2..)
            .map(|doublings| time_s / f64::from(1 << doublings))
            .find_map(|h| {
                let watched = bodies.clone().watched(Work::default());
                let end = if adapts {
                    let mut stepper = adaptive(scale, state, stages, h);
                    let stepped = stepper.step(&watched, time_s);
                    stepped.and_then(|_| stepper.synchronise(&watched, time_s)).ok()?;
                    stepper.state()
                } else {
                    let mut stepper = vpd(stages, state);
                    for _ in 0..(time_s / h) as u64 {
                        stepper.step(&watched, h).ok()?;
                    }
                    stepper.state()
                };
                (worst(apart(&end, &truth)) <= 1e-8).then(|| watched.work().gradients())
            })
            .expect("some step does")
    };
    let least = |adapts: bool| [2, 4, 8].map(|stages| evaluations(stages, adapts));
    let (fixed, adapting) = (least(false), least(true));
    let best = |of: [u64; 3]| of.into_iter().min().expect("three");
    let ratio = best(fixed) as f64 / best(adapting) as f64;
    println!(
        "closest {closest:.3}: {fixed:?} in steps of one length, {adapting:?} adapting, {ratio:.1} times fewer"
    );
    assert!(ratio > 5.0, "{fixed:?}, {adapting:?}");
}

/// A near miss, e = 0.999: steps of one length as long as a thousandth of a revolution do not solve it, and steps that adapt, of
/// which a revolution takes a few dozen, do.
#[test]
fn a_near_miss_is_passed() {
    let e = 0.999;
    let scene = binary(e);
    let (bodies, scale, start) = &scene;
    let period_s = std::f64::consts::TAU / mean_motion();
    let mut fixed = vpd(4, start);
    let failed = (0..1000).find_map(|_| fixed.step(bodies, period_s / 1000.0).err());
    println!("steps of one length: {failed:?}");
    let kept = fixed.state();
    assert!(failed.is_some() || (total(bodies, &kept) / total(bodies, start) - 1.0).abs() > 0.1);
    let mut stepper = adaptive(scale, start, 8, period_s / 24.0);
    stepper.step(bodies, period_s).expect("it adapts");
    stepper.synchronise(bodies, period_s).expect("it adapts");
    let pace = stepper.pace().expect("its own time");
    let end = stepper.state();
    let error = (end.places[1] - end.places[0] - kepler(e, period_s)[0]).norm();
    println!(
        "{} own steps, the shortest {:.1e} of the longest: {error:.1e}",
        pace.steps, pace.least_sigma
    );
    assert!(error < 1e-9 && pace.steps < 200, "{error:e}, {pace:?}");
}

/// Points that meet head on: the run ends with their distance.
#[test]
fn a_collision_is_told() {
    let (bodies, scale, mut start) = binary(0.9);
    start.linear_momenta.iter_mut().for_each(|p| *p = Vector::zeros());
    let mut stepper = adaptive(&scale, &start, 4, 0.05);
    stepper.start(&start);
    let failed = (0..200).find_map(|_| stepper.step(&bodies, 0.05).err()).expect("they meet");
    assert_eq!(failed.code, FailureCode::PotentialSingularity, "{failed:?}");
}

#[test]
fn bits_are_those_of_one_number_at_a_time() {
    for (bodies, scale, start) in [crowded(), charged_chain(true)] {
        let energy = total(&bodies, &start);
        let end = |stepper: BodiesVpd<3>| {
            let mut stepper = stepper.rescaled(scale.clone(), energy);
            for _ in 0..30 {
                stepper.step(&bodies, 0.03).expect("a small step");
            }
            stepper.state()
        };
        assert_eq!(end(vpd(3, &start)), end(vpd(3, &start).on_level(None)));
    }
}
