//! Several bodies: orders, momenta, the literal step, joints, and solutions known otherwise.

use vpd_solve::bodies::explicit::{Attitudes, BodiesRk};
use vpd_solve::bodies::splitting::BodiesSplitting;
use vpd_solve::bodies::trajectory::{
    BodiesStepper, Course, Ending, Sample, Schedule, integrate, integrate_members,
};
use vpd_solve::bodies::vpd::BodiesVpd;
use vpd_solve::bodies::{
    Bodies, BodiesError, BodiesState, Body, Change, Hold, Interaction, Site, Start,
};
use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::tableau::Tableau;

use crate::literal::{StageLaw, step_and_stages};

pub(crate) fn v<const N: usize>(x: [f64; N]) -> Vector<N> {
    Vector::from(x)
}

pub(crate) fn diagonal<const N: usize>(x: [f64; N]) -> Mat<N> {
    Mat::from_diagonal(&v(x))
}

/// A point or a rate that differs from body to body.
pub(crate) fn varied<const N: usize>(a: usize, scale: f64) -> Vector<N> {
    Vector::from_fn(|i, _| scale * libm::sin(1.3 * (a + 1) as f64 + 2.1 * i as f64))
}

pub(crate) fn turned<const N: usize>(a: usize, scale: f64) -> Mat<N> {
    let coordinates: Vec<f64> = (0..so::dimension(N))
        .map(|i| scale * libm::cos(0.7 * (a + 2) as f64 + 1.9 * i as f64))
        .collect();
    so::hat(&coordinates)
}

/// `k` bodies with a spring between each two, free or pinned.
fn in_springs<const N: usize>(k: usize, free: bool) -> (Bodies<N>, BodiesState<N>) {
    in_springs_of(1.0, k, free)
}

fn in_springs_of<const N: usize>(
    rest_length: f64,
    k: usize,
    free: bool,
) -> (Bodies<N>, BodiesState<N>) {
    let place = |a: usize| {
        varied::<N>(a, 0.6) + Vector::from_fn(|i, _| if i == 0 { 2.0 * a as f64 } else { 0.0 })
    };
    let body = |a: usize| Body {
        second_moments: Mat::from_fn(
            |i, j| if i == j { 0.3 + 0.1 * ((a + i) % 4) as f64 } else { 0.0 },
        ),
        mass_kg: 1.0 + 0.3 * a as f64,
        hold: if free { Hold::Free } else { Hold::Pivot(place(a)) },
    };
    let start = |a: usize| Start {
        attitude: so::exp(&turned(a, 0.4)),
        angular_velocity: turned(a + 3, 0.6),
        position: place(a),
        velocity: varied(a + 5, 0.1),
    };
    let pairs = (0..k).flat_map(|a| (a + 1..k).map(move |b| (a, b)));
    let spring = |(a, b): (usize, usize)| Interaction::Spring {
        sites: [Site::Body(a, varied(a, 0.5)), Site::Body(b, varied(b + 7, 0.4))],
        stiffness: 0.7,
        rest_length,
    };
    let bodies =
        Bodies::new((0..k).map(body).collect(), pairs.map(spring).collect()).expect("a system");
    let state = bodies.state(&(0..k).map(start).collect::<Vec<_>>());
    (bodies, state)
}

/// A chain of three links that hangs from a point of space, or floats with a spring between its ends.
pub(crate) fn chain(hung: bool) -> (Bodies<3>, BodiesState<3>) {
    let hold = |a: usize| match (a, hung) {
        (0, true) => Hold::Joint {
            parent: None,
            parent_point: v([0.0, 0.0, 1.0]),
            own_point: v([0.0, 0.0, 0.5]),
        },
        (0, false) => Hold::Free,
        (a, _) => Hold::Joint {
            parent: Some(a - 1),
            parent_point: v([0.0, 0.0, -0.5]),
            own_point: v([0.0, 0.0, 0.5]),
        },
    };
    let link = |a: usize| Body {
        second_moments: diagonal([0.01, 0.012, 0.08]),
        mass_kg: 1.0,
        hold: hold(a),
    };
    let start = |a: usize| Start {
        attitude: so::exp(&so::hat(&[0.6 + 0.2 * a as f64, 0.1 * a as f64, 0.0])),
        angular_velocity: so::hat(&[0.3, 0.5 - 0.1 * a as f64, 0.4 * a as f64]),
        position: Vector::zeros(),
        velocity: v([0.1, 0.0, 0.0]),
    };
    let weights = (0..3).map(|body| Interaction::Uniform {
        body,
        point: Vector::zeros(),
        weight: 9.81,
        direction: v([0.0, 0.0, 1.0]),
    });
    let spring = Interaction::Spring {
        sites: [Site::Body(0, v([0.1, 0.0, 0.0])), Site::Body(2, v([0.0, 0.1, 0.0]))],
        stiffness: 2.0,
        rest_length: 0.5,
    };
    let interactions = if hung { weights.collect() } else { vec![spring] };
    let bodies = Bodies::new((0..3).map(link).collect(), interactions).expect("a system");
    let state = bodies.state(&(0..3).map(start).collect::<Vec<_>>());
    (bodies, state)
}

pub(crate) fn vpd<const N: usize>(stages: usize, state: &BodiesState<N>) -> BodiesVpd<N> {
    BodiesVpd::new(Tableau::gauss(stages).expect("1 to 8 stages"), StopRule::default(), state)
}

fn run<const N: usize>(
    bodies: &Bodies<N>,
    state: &BodiesState<N>,
    stepper: &mut dyn BodiesStepper<N>,
    (step_s, steps, every): (f64, u64, u64),
) -> Vec<Sample<N>> {
    let mut samples = Vec::new();
    let course = Course { initial: state, checkpoint: None, step_s, steps, every };
    let end = integrate(bodies, stepper, course, &mut samples, |_| true).expect("a list takes all");
    assert_eq!(end.ending, Ending::Completed);
    samples
}

/// The state after some steps.
fn after<const N: usize>(
    bodies: &Bodies<N>,
    state: &BodiesState<N>,
    stepper: &mut dyn BodiesStepper<N>,
    step_s: f64,
    steps: u64,
) -> BodiesState<N> {
    stepper.start(state);
    for _ in 0..steps {
        stepper.step(bodies, step_s).expect("a step that is solved");
    }
    stepper.state()
}

/// The largest difference of each kind of number: attitudes, momenta, places, linear momenta.
pub(crate) fn apart<const N: usize>(a: &BodiesState<N>, b: &BodiesState<N>) -> [f64; 4] {
    let matrices = |a: &[Mat<N>], b: &[Mat<N>]| {
        a.iter().zip(b).map(|(a, b)| (a - b).amax()).fold(0.0, f64::max)
    };
    let vectors = |a: &[Vector<N>], b: &[Vector<N>]| {
        a.iter().zip(b).map(|(a, b)| (a - b).amax()).fold(0.0, f64::max)
    };
    [
        matrices(&a.attitudes, &b.attitudes),
        matrices(&a.momenta, &b.momenta),
        vectors(&a.places, &b.places),
        vectors(&a.linear_momenta, &b.linear_momenta),
    ]
}

#[test]
fn each_variable_has_the_order_of_the_tableau() {
    let scenes = [in_springs::<3>(3, true), in_springs::<3>(2, false), chain(true), chain(false)];
    for (scene, (bodies, state)) in scenes.iter().enumerate() {
        let reference = after(bodies, state, &mut vpd(8, state), 0.02, 50);
        // The coarsest step for which the order shows: links turn faster.
        let coarse_s =
            if scene < 2 { [0.0125, 0.05, 0.1, 0.1] } else { [0.0125, 0.025, 0.05, 0.05] };
        for (stages, coarse_s) in (1..).zip(coarse_s) {
            let error = |part: u64| {
                let steps = (1.0 / coarse_s) as u64 * part;
                let end =
                    after(bodies, state, &mut vpd(stages, state), coarse_s / part as f64, steps);
                apart(&end, &reference)
            };
            let (one, two) = (error(1), error(2));
            for (what, (one, two)) in one.into_iter().zip(two).enumerate() {
                // What does not move has no error.
                if one < 1e-12 {
                    continue;
                }
                let order = libm::log2(one / two);
                let due = 2.0 * stages as f64;
                assert!(
                    (order - due).abs() < 0.45,
                    "scene {scene}, {stages} stages, {what}: order {order}"
                );
            }
        }
    }
}

#[test]
fn sixteenth_order_reaches_round_off_in_long_steps() {
    let (bodies, state) = in_springs::<3>(3, true);
    let reference = after(&bodies, &state, &mut vpd(8, &state), 0.05, 40);
    let error = |steps: u64| {
        let end = after(&bodies, &state, &mut vpd(8, &state), 2.0 / steps as f64, steps);
        apart(&reference, &end).into_iter().fold(0.0, f64::max)
    };
    let order = libm::log(error(4) / error(6)) / libm::log(1.5);
    assert!((order - 16.0).abs() < 1.0, "order {order}");
    assert!(error(10) < 2e-15, "{:e}", error(10));
}

#[test]
fn momenta_of_free_tops_are_kept_to_round_off() {
    let (bodies, state) = in_springs::<3>(3, true);
    let samples = run(&bodies, &state, &mut vpd(2, &state), (0.02, 20_000, 100));
    let (linear, size) = drift_of_linear(&samples);
    assert!(linear <= 1e-15 * size * 4.0, "linear {linear:e} of {size:e}");
    let angular = samples[0].angular_momentum.expect("logged");
    let size = so::inner(&angular, &angular).sqrt();
    let drift = samples.iter().filter_map(|sample| sample.momentum_drift).fold(0.0, f64::max);
    assert!(drift <= 1e-14 * size, "angular {drift:e} of {size:e}");
    let from_group = samples.iter().filter_map(|sample| sample.orthogonality_error);
    assert!(from_group.fold(0.0, f64::max) < 1e-15);
    // The line of the centre of mass.
    let masses: Vec<f64> = bodies.bodies().iter().map(|body| body.mass_kg).collect();
    let total: f64 = masses.iter().sum();
    let centre = |sample: &Sample<3>| {
        sample
            .bodies
            .iter()
            .zip(&masses)
            .map(|(body, mass)| body.position * *mass)
            .sum::<Vector<3>>()
            / total
    };
    let velocity = samples[0].linear_momentum.expect("logged") / total;
    let last = samples.last().expect("some");
    let off = centre(last) - centre(&samples[0]) - velocity * last.time_s;
    assert!(off.norm() < 1e-13 * last.time_s, "{:e}", off.norm());
}

fn drift_of_linear(samples: &[Sample<3>]) -> (f64, f64) {
    let of = |sample: &Sample<3>| sample.linear_momentum.expect("logged");
    let first = of(&samples[0]);
    let drift = samples.iter().map(|sample| (of(sample) - first).norm()).fold(0.0, f64::max);
    // Of the bodies, whose changes add up to nothing.
    let size = samples
        .iter()
        .flat_map(|sample| sample.bodies.iter().map(|body| body.linear_momentum.norm()));
    (drift, size.fold(0.0, f64::max))
}

/// The figures are in docs/performance.md.
#[test]
#[ignore = "half a minute: cargo test --release a_million_steps_of_three_tops -- --ignored --nocapture"]
fn a_million_steps_of_three_tops() {
    // Springs without a length at rest, which are smooth where their ends meet; the centre of mass stays at the origin.
    let (bodies, mut state) = in_springs_of::<3>(0.0, 3, true);
    let masses: Vec<f64> = bodies.bodies().iter().map(|body| body.mass_kg).collect();
    let total: f64 = masses.iter().sum();
    let centre = state.places.iter().zip(&masses).map(|(x, mass)| x * *mass);
    let centre = centre.sum::<Vector<3>>() / total;
    let velocity = state.linear_momenta.iter().sum::<Vector<3>>() / total;
    for (a, mass) in masses.iter().enumerate() {
        state.places[a] -= centre;
        state.linear_momenta[a] -= velocity * *mass;
    }
    let samples = run(&bodies, &state, &mut vpd(2, &state), (0.02, 1_000_000, 1000));
    let (linear, size) = drift_of_linear(&samples);
    let angular = samples[0].angular_momentum.expect("logged");
    let angular_size = so::inner(&angular, &angular).sqrt();
    let drift = samples.iter().filter_map(|sample| sample.momentum_drift).fold(0.0, f64::max);
    let energy = |sample: &Sample<3>| sample.energy_error.expect("logged");
    let mean =
        |samples: &[Sample<3>]| samples.iter().map(energy).sum::<f64>() / samples.len() as f64;
    let (first, second) = (mean(&samples[..500]), mean(&samples[500..]));
    println!(
        "linear {:.1e}, angular {:.1e} relative; mean energy error {first:.2e}, then {second:.2e} J",
        linear / size,
        drift / angular_size
    );
    assert!(linear <= 2e-15 * size && drift <= 1e-14 * angular_size);
    let largest = samples.iter().map(|sample| energy(sample).abs()).fold(0.0, f64::max);
    assert!((second - first).abs() < 0.05 * largest, "{first:e}, {second:e} of {largest:e}");
}

/// The paper's step of each body by its literal equations, the forces of springs by formulas of their own, each from the
/// stages of all bodies, again and again.
fn literal<const N: usize>(
    k: usize,
    bodies: &Bodies<N>,
    free: bool,
    tableau: &Tableau,
    h: f64,
    start: &BodiesState<N>,
) -> BodiesState<N> {
    let stages = tableau.stages();
    let springs: Vec<(usize, usize, Vector<N>, Vector<N>)> = (0..k)
        .flat_map(|a| (a + 1..k).map(move |b| (a, b, varied(a, 0.5), varied(b + 7, 0.4))))
        .collect();
    let masses: Vec<f64> = bodies.bodies().iter().map(|body| body.mass_kg).collect();
    let mut u: Vec<Vec<Mat<N>>> = start.attitudes.iter().map(|g| vec![*g; stages]).collect();
    let mut force: Vec<Vec<Vector<N>>> = vec![vec![Vector::zeros(); stages]; k];
    let conjugate = |i: usize, j: usize| tableau.b(j) * (1.0 - tableau.a(j, i) / tableau.b(i));
    let mut end = start.clone();
    for _ in 0..25 {
        let p = |a: usize, i: usize| {
            let impulse = (0..stages).map(|j| force[a][j] * (h * conjugate(i, j)));
            start.linear_momenta[a] + impulse.sum::<Vector<N>>()
        };
        let x = |a: usize, i: usize| {
            if !free {
                return start.places[a];
            }
            let way = (0..stages).map(|j| p(a, j) * (h * tableau.a(i, j) / masses[a]));
            start.places[a] + way.sum::<Vector<N>>()
        };
        let mut gradients = vec![vec![Mat::<N>::zeros(); stages]; k];
        let mut next = vec![vec![Vector::<N>::zeros(); stages]; k];
        for i in 0..stages {
            for (a, b, y, z) in &springs {
                let apart = x(*a, i) + u[*a][i] * y - x(*b, i) - u[*b][i] * z;
                let pull = apart * (0.7 * (1.0 - 1.0 / apart.norm()));
                // dV/dg = (g^T dV/dr) y^T - y (g^T dV/dr)^T
                let seen = [u[*a][i].transpose() * pull, u[*b][i].transpose() * pull];
                gradients[*a][i] += seen[0] * y.transpose() - y * seen[0].transpose();
                gradients[*b][i] -= seen[1] * z.transpose() - z * seen[1].transpose();
                next[*a][i] -= pull;
                next[*b][i] += pull;
            }
        }
        for a in 0..k {
            let moments = bodies.bodies()[a].second_moments;
            let weights = Mat::<N>::from_fn(|i, j| {
                if i == j { 0.0 } else { 1.0 / (moments[(i, i)] + moments[(j, j)]) }
            });
            let law = StageLaw {
                velocity: &|_, mu: &Mat<N>| mu.component_mul(&weights),
                gradient: &|i, _| gradients[a][i],
                rounds: [40, 40],
            };
            let from = State { attitude: start.attitudes[a], momentum: start.momenta[a] };
            let (reached, stages_of_body) = step_and_stages(&law, tableau, h, &from);
            (end.attitudes[a], end.momenta[a]) = (reached.attitude, reached.momentum);
            u[a] = stages_of_body;
            if free {
                let way = (0..stages).map(|i| p(a, i) * (h * tableau.b(i) / masses[a]));
                end.places[a] = start.places[a] + way.sum::<Vector<N>>();
                let impulse = (0..stages).map(|i| next[a][i] * (h * tableau.b(i)));
                end.linear_momenta[a] = start.linear_momenta[a] + impulse.sum::<Vector<N>>();
            }
        }
        force = next;
    }
    end
}

fn compare_with_literal<const N: usize>(k: usize, free: bool, tableau: &Tableau, h: f64) {
    let (bodies, state) = in_springs::<N>(k, free);
    let expected = literal(k, &bodies, free, tableau, h, &state);
    let mut stepper = BodiesVpd::new(tableau.clone(), StopRule::default(), &state);
    let found = after(&bodies, &state, &mut stepper, h, 1);
    let error = apart(&expected, &found).into_iter().fold(0.0, f64::max);
    assert!(
        error <= 1e-14,
        "n = {N}, {k} bodies, free: {free}, {} stages: {error:e}",
        tableau.stages()
    );
}

#[test]
fn the_fast_step_is_the_literal_one() {
    let gauss = |stages| Tableau::gauss(stages).expect("1 to 8 stages");
    for free in [true, false] {
        compare_with_literal::<3>(2, free, &gauss(2), 0.1);
        compare_with_literal::<3>(3, free, &gauss(3), 0.1);
        compare_with_literal::<4>(2, free, &gauss(2), 0.1);
        compare_with_literal::<4>(3, free, &gauss(1), 0.05);
    }
    // One that is not symplectic by itself: places and attitudes take its conjugate.
    compare_with_literal::<3>(2, true, &Tableau::rk3(), 0.05);
}

#[test]
fn one_pinned_body_is_the_body_of_today() {
    let moments = [0.3, 0.5, 0.9];
    let second =
        diagonal([(0.5 + 0.9 - 0.3) / 2.0, (0.3 + 0.9 - 0.5) / 2.0, (0.3 + 0.5 - 0.9) / 2.0]);
    let (point, direction) = (v([0.1, 0.2, -0.4]), v([0.0, 0.0, 1.0]));
    let start = Start {
        attitude: so::exp(&so::hat(&[0.3, -0.2, 0.5])),
        angular_velocity: so::hat(&[0.5, 1.0, -0.7]),
        position: Vector::zeros(),
        velocity: Vector::zeros(),
    };
    let body = Body { second_moments: second, mass_kg: 0.0, hold: Hold::Pivot(Vector::zeros()) };
    let weight = Interaction::Uniform { body: 0, point, weight: 2.0, direction };
    let bodies = Bodies::new(vec![body], vec![weight]).expect("a system");
    let state = bodies.state(&[start]);
    let law = Law::Uniform { weight: 2.0, body_point: point };
    let alone =
        RigidBody::new(Kinetic::of_moments(moments), vec![Term { law, space: direction }], 0.0);
    for stages in [1, 2, 4, 8] {
        let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
        let mut one = VpdSo3::new(tableau, StopRule::default()).expect("as many lanes");
        one.start(&State { attitude: state.attitudes[0], momentum: state.momenta[0] });
        (0..200).for_each(|_| {
            one.step(&alone, 0.02).expect("solved");
        });
        let found = after(&bodies, &state, &mut vpd(stages, &state), 0.02, 200);
        let error = (one.attitude().expect("one") - found.attitudes[0]).amax();
        let of_momentum = (one.momentum() - found.momenta[0]).amax();
        assert!(error < 1e-13 && of_momentum < 1e-13, "{stages}: {error:e}, {of_momentum:e}");
    }
}

#[test]
fn methods_agree() {
    let (bodies, state) = in_springs::<3>(3, true);
    let reference = after(&bodies, &state, &mut vpd(4, &state), 0.02, 50);
    let rk = |kind| BodiesRk::new(Tableau::rk8(), kind, &state).expect("explicit");
    for kind in [Attitudes::Projected, Attitudes::Lie] {
        let end = after(&bodies, &state, &mut rk(kind), 0.02, 50);
        let error = apart(&reference, &end).into_iter().fold(0.0, f64::max);
        assert!(error < 1e-12, "{kind:?}: {error:e}");
    }
    for (order, most) in [(2, 1e-3), (4, 1e-6), (6, 1e-9), (8, 1e-12)] {
        let mut splitting = BodiesSplitting::new(order, &bodies, &state).expect("an order");
        let error = |splitting: &mut BodiesSplitting, part: u64| {
            let end = after(&bodies, &state, splitting, 0.02 / part as f64, 50 * part);
            apart(&reference, &end).into_iter().fold(0.0, f64::max)
        };
        let one = error(&mut splitting, 1);
        assert!(one < most, "splitting {order}: {one:e}");
        if order < 8 {
            let slope = libm::log2(one / error(&mut splitting, 2));
            assert!((slope - f64::from(order)).abs() < 0.4, "splitting {order}: order {slope}");
        }
    }
    let (bodies, state) = chain(true);
    assert!(BodiesSplitting::new(4, &bodies, &state).is_none());
    let reference = after(&bodies, &state, &mut vpd(4, &state), 0.01, 100);
    let mut lie = BodiesRk::new(Tableau::rk8(), Attitudes::Lie, &state).expect("explicit");
    let end = after(&bodies, &state, &mut lie, 0.005, 200);
    let error = apart(&reference, &end).into_iter().fold(0.0, f64::max);
    assert!(error < 1e-9, "chain by rkmk: {error:e}");
}

/// Two bodies under gravity: an ellipse in closed form.
#[test]
fn two_spheres_follow_keplers_ellipse() {
    let sphere = |mass_kg: f64| Body {
        second_moments: diagonal([0.1 * mass_kg; 3]),
        mass_kg,
        hold: Hold::Free,
    };
    let (m1, m2, constant) = (3.0_f64, 1.0_f64, 2.0_f64);
    let pull = Interaction::MutualGravity { bodies: [0, 1], constant };
    let source = Interaction::PointSource {
        sites: [Site::Body(0, Vector::zeros()), Site::Body(1, Vector::zeros())],
        strength: -constant * m1 * m2,
    };
    // a = 1, from the pericentre: n^2 a^3 = G (m1 + m2).
    let n = (constant * (m1 + m2)).sqrt();
    // Half of a mild ellipse and more; a whole eccentric one, which ends where it began.
    for (e, time, [fine, coarse]) in
        [(0.3_f64, 3.0, [60, 300]), (0.9, std::f64::consts::TAU / n, [500, 4000])]
    {
        let (r, speed) = (1.0 - e, n * ((1.0 + e) / (1.0 - e)).sqrt());
        let at = |part: f64| Start {
            attitude: Mat::identity(),
            angular_velocity: so::hat(&[0.1, 0.4, 0.2]),
            position: v([part * r, 0.0, 0.0]),
            velocity: v([0.0, part * speed, 0.0]),
        };
        // Kepler's equation.
        let mut anomaly = n * time;
        for _ in 0..60 {
            let off = anomaly - e * libm::sin(anomaly) - n * time;
            anomaly -= off / (1.0 - e * libm::cos(anomaly));
        }
        let (cos, sin) = (libm::cos(anomaly), libm::sin(anomaly));
        let expected = v([cos - e, (1.0 - e * e).sqrt() * sin, 0.0]);
        for interaction in [pull.clone(), source.clone()] {
            let bodies =
                Bodies::new(vec![sphere(m1), sphere(m2)], vec![interaction]).expect("a system");
            let state = bodies.state(&[at(-m2 / (m1 + m2)), at(m1 / (m1 + m2))]);
            let error = |stages: usize, steps: u64| {
                let h = time / steps as f64;
                let end = after(&bodies, &state, &mut vpd(stages, &state), h, steps);
                (end.places[1] - end.places[0] - expected).norm()
            };
            assert!(error(8, fine) < 1e-12, "e = {e}: {:e}", error(8, fine));
            let order = libm::log2(error(2, coarse) / error(2, 2 * coarse));
            assert!((order - 4.0).abs() < 0.1, "e = {e}: order {order}");
        }
    }
}

/// Gravity to the second degree, against differences of the potential: forces and torques.
#[test]
fn forces_are_the_gradient_of_the_energy() {
    let body = |a: usize, mass_kg: f64| Body {
        second_moments: diagonal([0.2, 0.3 + 0.1 * a as f64, 0.55]),
        mass_kg,
        hold: Hold::Free,
    };
    let interactions = vec![
        Interaction::MutualGravity { bodies: [0, 1], constant: 1.5 },
        Interaction::GravityGradient {
            body: 1,
            strength: 0.8,
            matrix: diagonal([0.3, 0.5, 0.2]),
            direction: v([0.3, 1.0, -0.2]),
        },
        Interaction::Spring {
            sites: [Site::Body(0, v([0.2, 0.0, 0.1])), Site::Space(v([1.0, 2.0, 0.0]))],
            stiffness: 1.2,
            rest_length: 0.4,
        },
    ];
    let bodies = Bodies::new(vec![body(0, 2.0), body(1, 1.0)], interactions).expect("a system");
    let start = |a: usize| Start {
        attitude: so::exp(&turned(a, 0.7)),
        angular_velocity: Mat::zeros(),
        position: varied(a, 1.0) + v([2.0 * a as f64, 0.0, 0.0]),
        velocity: Vector::zeros(),
    };
    let state = bodies.state(&[start(0), start(1)]);
    let energy = |state: &BodiesState<3>| {
        bodies.energy(state, &bodies.seen(state).expect("regular")).potential
    };
    // From rest, a short step changes momenta by the forces at its middle, which is the start to second order.
    let h = 1e-4;
    let end = after(&bodies, &state, &mut vpd(2, &state), h, 1);
    for body in 0..2 {
        for i in 0..3 {
            let shifted = |by: f64| {
                let mut state = state.clone();
                state.places[body][i] += by;
                energy(&state)
            };
            let force = -(shifted(1e-5) - shifted(-1e-5)) / 2e-5;
            let found = end.linear_momenta[body][i] / h;
            assert!((force - found).abs() < 1e-7, "force {i} on {body}: {found}, not {force}");
            let turned = |by: f64| {
                let mut state = state.clone();
                let mut axis = [0.0; 3];
                axis[i] = by;
                state.attitudes[body] *= so::exp(&so::hat(&axis));
                energy(&state)
            };
            let torque = -(turned(1e-5) - turned(-1e-5)) / 2e-5;
            let found = so::vee(&end.momenta[body])[i] / h;
            assert!((torque - found).abs() < 1e-7, "torque {i} on {body}: {found}, not {torque}");
        }
    }
}

/// A double pendulum whose links swing in a plane, against its own equations for two angles, solved with 40 digits (`docs/known.py`).
#[test]
fn a_planar_chain_is_the_double_pendulum() {
    const GRAVITY: f64 = 9.81;
    let (m, c, j) = ([1.2, 0.7], 0.4, [0.06, 0.05]);
    let link = |a: usize| Body {
        // The moment about x is d_y + d_z.
        second_moments: diagonal([0.01, 0.005, j[a] - 0.005]),
        mass_kg: m[a],
        hold: Hold::Joint {
            parent: a.checked_sub(1),
            parent_point: if a == 0 { Vector::zeros() } else { v([0.0, 0.0, -c]) },
            own_point: v([0.0, 0.0, c]),
        },
    };
    let weights = (0..2).map(|body| Interaction::Uniform {
        body,
        point: Vector::zeros(),
        weight: m[body] * GRAVITY,
        direction: v([0.0, 0.0, 1.0]),
    });
    let bodies = Bodies::new(vec![link(0), link(1)], weights.collect()).expect("a system");
    let (angles, rates) = ([0.9, 0.3], [0.4, -1.1]);
    let start = |a: usize| Start {
        attitude: so::exp(&so::hat(&[angles[a], 0.0, 0.0])),
        angular_velocity: so::hat(&[rates[a], 0.0, 0.0]),
        position: Vector::zeros(),
        velocity: Vector::zeros(),
    };
    let state = bodies.state(&[start(0), start(1)]);
    // At 2 s: the angles, and their rates.
    let known =
        [[0.3708705437824024, 1.399150700936682], [1.8680657905206313, -1.6323260480607709]];
    let end = after(&bodies, &state, &mut vpd(4, &state), 0.005, 400);
    let seen = bodies.seen(&end).expect("regular");
    for a in 0..2 {
        let g = &end.attitudes[a];
        let apart = libm::atan2(g[(2, 1)], g[(1, 1)]) - known[0][a];
        let of_rate = so::vee(&seen[a].angular_velocity)[0] - known[1][a];
        assert!(apart.abs() < 1e-13 && of_rate.abs() < 1e-13, "link {a}: {apart:e}, {of_rate:e}");
        // It stays in the plane.
        assert!(g[(0, 1)].abs() < 1e-14 && g[(0, 2)].abs() < 1e-14);
    }
}

/// Three links that swing in space, against Newton's and Euler's equations of each with the forces in the joints as unknowns, solved
/// with 40 digits (`docs/known.py`).
#[test]
fn a_chain_in_space_follows_newton_and_euler() {
    // At 1 s.
    let attitudes = [
        [
            [0.9896256650544787, -0.12901245397332745, 0.06322048548738662],
            [0.11542292656388235, 0.9759654676727307, 0.184848462081178],
            [-0.08554876439148272, -0.17563368876763977, 0.980731470016621],
        ],
        [
            [0.8443421269616833, -0.5244098629139822, 0.10991209358555164],
            [0.48136096028875786, 0.8325116415952722, 0.2742553418225977],
            [-0.23532530367069657, -0.17865794772940666, 0.955355085382085],
        ],
        [
            [0.5619058067475614, -0.8124472531713413, 0.15553560736279906],
            [0.7054035562666839, 0.5688308414116753, 0.42289158973098623],
            [-0.43205056087185845, -0.12790986933473145, 0.8927325345124846],
        ],
    ];
    let rates = [
        [-1.3229277638284813, -0.4132280763957685, 0.005042638514890113],
        [-1.6117538180579063, 0.6298676514724317, 0.3610196082910432],
        [-1.53020400371447, 0.7094659609331293, 0.6769479051712574],
    ];
    let (bodies, state) = chain(true);
    for (stages, steps) in [(4, 100), (8, 50)] {
        let end = after(&bodies, &state, &mut vpd(stages, &state), 1.0 / steps as f64, steps);
        let seen = bodies.seen(&end).expect("regular");
        for a in 0..3 {
            let known = Mat::<3>::from_fn(|i, j| attitudes[a][i][j]);
            let error = (end.attitudes[a] - known).amax();
            let of_rate = (seen[a].angular_velocity - so::hat(&rates[a])).amax();
            assert!(
                error < 1e-13 && of_rate < 1e-13,
                "{stages} stages, link {a}: {error:e}, {of_rate:e}"
            );
        }
    }
}

/// The shipped binary asteroid, against its equations in the plane of its orbit, solved with 40 digits (`docs/known.py`).
#[test]
fn a_binary_asteroid_librates_as_its_plane_equations_say() {
    let body = |mass_kg: f64, [a, b, c]: [f64; 3]| Body {
        second_moments: diagonal([(b + c - a) / 2.0, (c + a - b) / 2.0, (a + b - c) / 2.0]),
        mass_kg,
        hold: Hold::Free,
    };
    let two =
        vec![body(2.353, [0.4574, 0.4764, 0.5069]), body(0.135, [0.002161, 0.003184, 0.003757])];
    let pull = Interaction::MutualGravity { bodies: [0, 1], constant: 6.6743e-8 };
    let bodies = Bodies::new(two, vec![pull]).expect("a system");
    let start = |x_km: f64, speed: f64, angle: f64, spin: f64| Start {
        attitude: so::exp(&so::hat(&[0.0, 0.0, angle])),
        angular_velocity: so::hat(&[0.0, 0.0, spin]),
        position: v([x_km, 0.0, 0.0]),
        velocity: v([0.0, speed, 0.0]),
    };
    let state = bodies.state(&[
        start(-0.138256, -1.38517e-5, 0.0, 0.00063133),
        start(2.409744, 0.0002414299, 0.1, 0.00010019),
    ]);
    // After 100,000 s, a revolution and a half: the moon from the primary, and how far each has turned.
    let known = v([-1.8165055557057055, -1.751420599901015, 0.0]);
    let turns = [63.130094523103054, 10.04389163954756];
    let end = after(&bodies, &state, &mut vpd(4, &state), 100.0, 1000);
    let error = (end.places[1] - end.places[0] - known).norm();
    assert!(error < 1e-12, "{error:e} km");
    for (body, turn) in turns.into_iter().enumerate() {
        let g = &end.attitudes[body];
        let off = libm::remainder(libm::atan2(g[(1, 0)], g[(0, 0)]) - turn, std::f64::consts::TAU);
        assert!(off.abs() < 1e-12, "body {body}: {off:e}");
    }
    let energy = |state: &BodiesState<3>| {
        bodies.energy(state, &bodies.seen(state).expect("regular")).total()
    };
    let lost = (energy(&end) / energy(&state) - 1.0).abs();
    assert!(lost < 1e-12, "{lost:e}");
}

#[test]
fn joints_stay_closed() {
    let (bodies, state) = chain(true);
    let samples = run(&bodies, &state, &mut vpd(3, &state), (0.01, 2000, 20));
    for sample in &samples {
        let point = |a: usize, z: f64| {
            sample.bodies[a].position + sample.bodies[a].attitude * v([0.0, 0.0, z])
        };
        assert!((point(0, 0.5) - v([0.0, 0.0, 1.0])).norm() < 2e-15);
        for a in 1..3 {
            let gap = (point(a, 0.5) - point(a - 1, -0.5)).norm();
            assert!(gap < 2e-15, "{gap:e}");
        }
        // Rotations about the vertical leave all alone.
        assert!(sample.momentum_drift.expect("conserved") < 1e-13);
        assert!(sample.energy_error.expect("logged").abs() < 1e-6);
    }
}

/// Starts beside a state: turns of the bodies, changes of their velocities by their own inertia, and of free ones shifts. Joints
/// hold, and none changes what another body has to itself.
#[test]
fn a_state_beside_another_is_turned_pushed_and_moved() {
    fn change<const N: usize>(a: usize) -> Change<N> {
        Change {
            turn: turned(a, 0.3),
            momentum: turned(a + 2, 0.02),
            shift: varied(a, 0.4),
            velocity: varied(a + 1, 0.2),
        }
    }
    fn compare<const N: usize>(bodies: &Bodies<N>, state: &BodiesState<N>, free: &[usize]) {
        let changes: Vec<Change<N>> = (0..bodies.bodies().len()).map(change).collect();
        let beside = bodies.beside(state, &changes).expect("velocities");
        let seen = bodies.seen(state).expect("velocities");
        let found = bodies.seen(&beside).expect("velocities");
        for (a, (before, after)) in seen.iter().zip(&found).enumerate() {
            let Change { turn, momentum, shift, velocity } = &changes[a];
            let attitude = before.attitude * so::exp(turn);
            assert!((attitude - after.attitude).amax() < 1e-14);
            // (D_i + D_j) dOmega_ij = delta_ij
            let moments = bodies.bodies()[a].second_moments;
            let gained = after.angular_velocity - before.angular_velocity;
            let own = moments * gained + gained * moments;
            assert!((own - momentum).amax() < 1e-13, "{a}: {:e}", (own - momentum).amax());
            if free.contains(&a) {
                assert!((after.position - before.position - shift).norm() < 1e-14);
                assert!((after.velocity - before.velocity - velocity).norm() < 1e-14);
            }
        }
    }
    fn one_changed<const N: usize>(bodies: &Bodies<N>, state: &BodiesState<N>) {
        let none = Change {
            turn: Mat::zeros(),
            momentum: Mat::zeros(),
            shift: Vector::zeros(),
            velocity: Vector::zeros(),
        };
        let beside = bodies.beside(state, &[none, change(1)]).expect("velocities");
        assert_eq!(beside.momenta[0], state.momenta[0]);
        assert_eq!(
            (beside.places[0], beside.linear_momenta[0]),
            (state.places[0], state.linear_momenta[0])
        );
        assert!((beside.momenta[1] - state.momenta[1]).amax() > 1e-3);
    }
    let (bodies, state) = in_springs::<3>(3, true);
    compare(&bodies, &state, &[0, 1, 2]);
    let (bodies, state) = in_springs::<4>(2, false);
    compare(&bodies, &state, &[]);
    let (bodies, state) = in_springs::<5>(2, true);
    compare(&bodies, &state, &[0, 1]);
    one_changed(&bodies, &state);
    for (hung, free) in [(true, &[][..]), (false, &[0][..])] {
        let (bodies, state) = chain(hung);
        compare(&bodies, &state, free);
        let changes: Vec<Change<3>> = (0..3).map(change).collect();
        let beside = bodies.beside(&state, &changes).expect("velocities");
        let seen = bodies.seen(&beside).expect("velocities");
        let point = |a: usize, z: f64| seen[a].position + seen[a].attitude * v([0.0, 0.0, z]);
        for a in 1..3 {
            assert!((point(a, 0.5) - point(a - 1, -0.5)).norm() < 2e-15);
        }
    }
}

/// Members side by side make the steps of their own runs, to the bit, and one that fails leaves the others alone.
#[test]
fn members_are_their_own_runs() {
    let (bodies, state) = in_springs::<3>(2, true);
    let changes = |size: f64| -> Vec<Change<3>> {
        let change = |a: usize| Change {
            turn: turned(a, size),
            momentum: turned(a + 2, size),
            shift: varied(a, size),
            velocity: varied(a + 1, size),
        };
        (0..2).map(change).collect()
    };
    let starts: Vec<BodiesState<3>> = [0.0, 0.1, 1e9]
        .map(|size| bodies.beside(&state, &changes(size)).expect("velocities"))
        .into();
    let mut steppers: Vec<Box<dyn BodiesStepper<3>>> =
        starts.iter().map(|start| Box::new(vpd(2, start)) as Box<_>).collect();
    let schedule = Schedule { step_s: 0.02, steps: 50, every: 7 };
    let mut samples = vec![Vec::new(); 3];
    let record = |m: usize, sample: &Sample<3>| {
        samples[m].push(sample.clone());
        Ok::<(), std::convert::Infallible>(())
    };
    let Ok(ends) = integrate_members(&bodies, &mut steppers, &starts, schedule, record, |_| true);
    for m in 0..2 {
        assert_eq!(ends[m].ending, Ending::Completed);
        let alone = run(&bodies, &starts[m], &mut vpd(2, &starts[m]), (0.02, 50, 7));
        assert_eq!(samples[m], alone, "member {m}");
        assert_eq!((ends[m].reached.step, ends[m].reached.samples), (50, 9));
    }
    assert!(matches!(ends[2].ending, Ending::Failed(_)), "{:?}", ends[2]);
}

/// With one stage; with more, as for one body, stages are taken relative to the start of the step.
#[test]
fn a_step_back_undoes_a_step() {
    let goes_back =
        |bodies: &Bodies<3>, state: &BodiesState<3>, stepper: &mut dyn BodiesStepper<3>| {
            let forth = after(bodies, state, stepper, 0.02, 1);
            let back = after(bodies, &forth, stepper, -0.02, 1);
            let error = apart(state, &back).into_iter().fold(0.0, f64::max);
            assert!(error < 5e-15, "{error:e}");
        };
    for (bodies, state) in [in_springs::<3>(3, true), chain(true), chain(false)] {
        goes_back(&bodies, &state, &mut vpd(1, &state));
    }
    let (bodies, state) = in_springs::<3>(3, true);
    for order in [2, 4, 6, 8] {
        let mut splitting = BodiesSplitting::new(order, &bodies, &state).expect("an order");
        goes_back(&bodies, &state, &mut splitting);
    }
}

#[test]
fn bits_are_those_of_one_number_at_a_time() {
    for k in [3, 5, 11] {
        let (bodies, state) = in_springs::<3>(k, true);
        let wide = after(&bodies, &state, &mut vpd(2, &state), 0.05, 30);
        let narrow = after(&bodies, &state, &mut vpd(2, &state).on_level(None), 0.05, 30);
        assert_eq!(wide, narrow, "{k} bodies");
    }
    let (bodies, state) = in_springs::<4>(2, true);
    let wide = after(&bodies, &state, &mut vpd(3, &state), 0.05, 30);
    let narrow = after(&bodies, &state, &mut vpd(3, &state).on_level(None), 0.05, 30);
    assert_eq!(wide, narrow);
    for hung in [true, false] {
        let (bodies, state) = chain(hung);
        let wide = after(&bodies, &state, &mut vpd(3, &state), 0.02, 30);
        let narrow = after(&bodies, &state, &mut vpd(3, &state).on_level(None), 0.02, 30);
        assert_eq!(wide, narrow, "a chain, hung: {hung}");
    }
}

/// The form `sum dp_a ^ dx_a + d(mu_a . theta_a)` of a start, and that of the end of a step, by differences of the step.
pub(crate) struct Forms {
    start: BodiesState<3>,
    end: BodiesState<3>,
    /// Places that move.
    moving: usize,
    /// Images of the unit vectors: `g exp(xi)`, `mu + dmu`, x, p; and by them of the time that the step takes.
    columns: Vec<(Vec<f64>, f64)>,
}

impl Forms {
    /// Of `step`, from a state to another and the time between.
    pub(crate) fn new(
        start: &BodiesState<3>,
        moving: usize,
        step: impl Fn(&BodiesState<3>) -> (BodiesState<3>, f64),
    ) -> Self {
        let k = start.attitudes.len();
        let moved = |at: usize, by: f64| {
            let mut state = start.clone();
            let (which, i) = (at / 3, at % 3);
            let mut axis = [0.0; 3];
            axis[i] = by;
            if which < k {
                state.attitudes[which] *= so::exp(&so::hat(&axis));
            } else if which < 2 * k {
                state.momenta[which - k] += so::hat::<3>(&axis);
            } else if which < 2 * k + moving {
                state.places[which - 2 * k][i] += by;
            } else {
                state.linear_momenta[which - 2 * k - moving][i] += by;
            }
            state
        };
        let end = step(start).0;
        let mut forms = Self { start: start.clone(), end, moving, columns: Vec::new() };
        let column = |at: usize| forms.differences(|by| step(&moved(at, by)));
        forms.columns = (0..6 * (k + moving)).map(column).collect();
        forms
    }

    /// How the end of a step changes, and the time that it takes: by differences of eighth order.
    fn differences(&self, end: impl Fn(f64) -> (BodiesState<3>, f64)) -> (Vec<f64>, f64) {
        let k = self.start.attitudes.len();
        let difference = |a: &BodiesState<3>, b: &BodiesState<3>| -> Vec<f64> {
            let turns = (0..k).flat_map(|body| {
                let by = a.attitudes[body] - b.attitudes[body];
                so::vee(&so::skew(&so::transposed_product(&self.end.attitudes[body], &by)))
            });
            let momenta = (0..k).flat_map(|body| so::vee(&(a.momenta[body] - b.momenta[body])));
            let vectors = |a: &[Vector<3>], b: &[Vector<3>]| -> Vec<f64> {
                (0..self.moving).flat_map(|i| (a[i] - b[i]).as_slice().to_vec()).collect()
            };
            turns
                .chain(momenta)
                .chain(vectors(&a.places, &b.places))
                .chain(vectors(&a.linear_momenta, &b.linear_momenta))
                .collect()
        };
        let size = 5e-3;
        let (mut sum, mut time_s) = (vec![0.0; 6 * (k + self.moving)], 0.0);
        for (times, weight) in (1..).zip([4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0]) {
            let by = f64::from(times) * size;
            let (forth, back) = (end(by), end(-by));
            let two = difference(&forth.0, &back.0);
            sum.iter_mut().zip(two).for_each(|(sum, two)| *sum += weight * two);
            time_s += weight * (forth.1 - back.1);
        }
        (sum.iter().map(|sum| sum / size).collect(), time_s / size)
    }

    /// omega((xi, nu), (eta, rho)) = nu . eta - rho . xi + mu . (xi x eta), and p ^ x.
    fn form(&self, state: &BodiesState<3>, a: &[f64], b: &[f64]) -> f64 {
        let (k, moving) = (state.attitudes.len(), self.moving);
        let at =
            |x: &[f64], which: usize| -> [f64; 3] { std::array::from_fn(|i| x[3 * which + i]) };
        let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
        let mut sum = 0.0;
        for body in 0..k {
            let mu = so::vee(&state.momenta[body]);
            let (xi, nu, eta, rho) = (at(a, body), at(a, k + body), at(b, body), at(b, k + body));
            let cross = [
                xi[1] * eta[2] - xi[2] * eta[1],
                xi[2] * eta[0] - xi[0] * eta[2],
                xi[0] * eta[1] - xi[1] * eta[0],
            ];
            sum += dot(nu, eta) - dot(rho, xi) - dot([mu[0], mu[1], mu[2]], cross);
        }
        for place in 2 * k..2 * k + moving {
            sum += dot(at(a, place + moving), at(b, place));
            sum -= dot(at(b, place + moving), at(a, place));
        }
        sum
    }

    /// The largest difference of the two.
    pub(crate) fn defect(&self) -> f64 {
        let size = self.columns.len();
        let unit = |at: usize| -> Vec<f64> {
            (0..size).map(|i| if i == at { 1.0 } else { 0.0 }).collect()
        };
        let mut defect = 0.0_f64;
        for a in 0..size {
            for b in 0..a {
                let before = self.form(&self.start, &unit(a), &unit(b));
                let after = self.form(&self.end, &self.columns[a].0, &self.columns[b].0);
                defect = defect.max((before - after).abs());
            }
        }
        defect
    }

    /// The defect of `omega(dz/de, dz/dH0) = -dt/de`, which makes a map symplectic in the time and its momentum -H0, too: `end` is
    /// that of the start with H0 changed.
    pub(crate) fn time_defect(&self, end: impl Fn(f64) -> (BodiesState<3>, f64)) -> f64 {
        let (by_energy, _) = self.differences(end);
        let off = |(image, time_s): &(Vec<f64>, f64)| {
            (self.form(&self.end, image, &by_energy) + time_s).abs()
        };
        self.columns.iter().map(off).fold(0.0, f64::max)
    }
}

#[test]
fn the_step_is_symplectic() {
    let check = |(bodies, state): (Bodies<3>, BodiesState<3>), moving: usize, h: f64| {
        let step = |state: &BodiesState<3>| (after(&bodies, state, &mut vpd(2, state), h, 1), h);
        let defect = Forms::new(&state, moving, step).defect();
        assert!(defect < 1e-11, "{moving} places move: {defect:e}");
    };
    check(in_springs::<3>(2, true), 2, 0.1);
    // In joints: hung, and free to move as a whole.
    for (hung, moving) in [(true, 0), (false, 1)] {
        check(chain(hung), moving, 0.02);
    }
}

#[test]
fn what_makes_no_system_is_refused() {
    let body = |hold| Body { second_moments: diagonal([0.1; 3]), mass_kg: 1.0, hold };
    let joint = |parent| Hold::Joint {
        parent: Some(parent),
        parent_point: Vector::<3>::zeros(),
        own_point: v([0.0, 0.0, 1.0]),
    };
    let made = |bodies| Bodies::new(bodies, Vec::new()).map(drop);
    assert_eq!(made(vec![body(joint(1)), body(joint(0))]), Err(BodiesError::Parent(0)));
    assert_eq!(made(vec![body(joint(5))]), Err(BodiesError::Parent(0)));
    // A child before its parent is well.
    assert_eq!(made(vec![body(joint(1)), body(Hold::Free)]), Ok(()));
    let weightless = Body { mass_kg: 0.0, ..body(Hold::Free) };
    assert_eq!(made(vec![weightless]), Err(BodiesError::Mass(0)));
    let flat = Body { second_moments: Mat::zeros(), ..body(Hold::Free) };
    assert_eq!(made(vec![body(Hold::Free), flat]), Err(BodiesError::Inertia(1)));
    let spring = Interaction::MutualGravity { bodies: [0, 3], constant: 1.0 };
    let unknown = Bodies::new(vec![body(Hold::Free)], vec![spring]).map(drop);
    assert_eq!(unknown, Err(BodiesError::Unknown(0)));
}
