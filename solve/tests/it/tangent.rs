//! The derivative of a step of VPD and its adjoint: against differences of the step, symplectic, and one the transpose of the
//! other.

use vpd_solve::hamiltonian::{BodyRate, Kinetic, Law, RigidBody, Term, Torque};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::tableau::Tableau;
use vpd_solve::tangent::{Tangent, TangentError, stages_of, symplectic_error};

use crate::given::{Numbers, dipole};

/// What makes a body, and how fast each of it changes.
struct Varied<const N: usize> {
    second_moments: [f64; N],
    rate: BodyRate<N>,
}

impl<const N: usize> Varied<N> {
    /// A body with one term of each law.
    fn new(numbers: &mut Numbers) -> Self {
        let mut laws = Law::examples(|| numbers.next());
        // A spring without a length of its own has no square root.
        laws.push(Law::Spring { stiffness: 0.3, rest_length: 0.0, body_point: numbers.vector() });
        let far = |numbers: &mut Numbers| numbers.vector::<N>() + Vector::<N>::repeat(2.0);
        let terms: Vec<_> = laws.into_iter().map(|law| Term { law, space: far(numbers) }).collect();
        let rates = terms.iter().map(|term| {
            let law = rate_of(&term.law, numbers);
            (term.clone(), Term { law, space: numbers.vector() })
        });
        let terms_rate = rates.collect();
        let second_moments = std::array::from_fn(|i| 0.9 + 0.2 * i as f64);
        let moments_rate = Vector::<N>::from_fn(|_, _| numbers.next());
        let rate =
            BodyRate { second_moments: Mat::from_diagonal(&moments_rate), terms: terms_rate };
        Self { second_moments, rate }
    }

    /// The body where the parameter is `e`.
    fn at(&self, e: f64) -> RigidBody<N> {
        let moments =
            std::array::from_fn(|i| self.second_moments[i] + e * self.rate.second_moments[(i, i)]);
        let at = |(term, rate): &(Term<N>, Term<N>)| Term {
            law: moved(&term.law, &rate.law, e),
            space: term.space + rate.space * e,
        };
        let terms = self.rate.terms.iter().map(at).collect();
        RigidBody::new(Kinetic::of_second_moments(moments), terms, 0.0)
    }
}

/// A rate of each field of a law.
fn rate_of<const N: usize>(law: &Law<N>, numbers: &mut Numbers) -> Law<N> {
    let rest_length = numbers.next();
    let (strength, body_point) = (numbers.next(), numbers.vector());
    match law {
        Law::Uniform { .. } => Law::Uniform { weight: strength, body_point },
        Law::PointSource { .. } => Law::PointSource { strength, body_point },
        // A length is not negative.
        Law::Spring { rest_length: 0.0, .. } => {
            Law::Spring { stiffness: strength, rest_length: 0.0, body_point }
        }
        Law::Spring { .. } => Law::Spring { stiffness: strength, rest_length, body_point },
        Law::GravityGradient { .. } => {
            Law::GravityGradient { strength, matrix: so::symmetric_part(&numbers.matrix()) }
        }
    }
}

/// `law + e rate`.
fn moved<const N: usize>(law: &Law<N>, rate: &Law<N>, e: f64) -> Law<N> {
    match (law, rate) {
        (
            Law::Uniform { weight, body_point },
            Law::Uniform { weight: weight_rate, body_point: point_rate },
        ) => Law::Uniform {
            weight: weight + e * weight_rate,
            body_point: body_point + point_rate * e,
        },
        (
            Law::PointSource { strength, body_point },
            Law::PointSource { strength: strength_rate, body_point: point_rate },
        ) => Law::PointSource {
            strength: strength + e * strength_rate,
            body_point: body_point + point_rate * e,
        },
        (
            Law::Spring { stiffness, rest_length, body_point },
            Law::Spring {
                stiffness: stiffness_rate,
                rest_length: length_rate,
                body_point: point_rate,
            },
        ) => Law::Spring {
            stiffness: stiffness + e * stiffness_rate,
            rest_length: rest_length + e * length_rate,
            body_point: body_point + point_rate * e,
        },
        (
            Law::GravityGradient { strength, matrix },
            Law::GravityGradient { strength: strength_rate, matrix: matrix_rate },
        ) => Law::GravityGradient {
            strength: strength + e * strength_rate,
            matrix: matrix + matrix_rate * e,
        },
        _ => panic!("a rate is of the kind of its law"),
    }
}

/// The derivative at zero by central differences of eighth order: for `e = 0.01` their error and rounding are near 1e-13.
fn difference(at: impl Fn(f64) -> Vec<f64>) -> Vec<f64> {
    const E: f64 = 0.01;
    let weights = [4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0];
    let mut sum = vec![0.0; at(0.0).len()];
    for (k, weight) in (1..).zip(weights) {
        let e = E * f64::from(k);
        let (ahead, behind) = (at(e), at(-e));
        for ((sum, ahead), behind) in sum.iter_mut().zip(ahead).zip(behind) {
            *sum += weight * (ahead - behind) / E;
        }
    }
    sum
}

fn step<const N: usize>(
    body: &RigidBody<N>,
    tableau: &Tableau,
    h: f64,
    start: &State<N>,
) -> State<N> {
    let mut stepper = Vpd::new(tableau.clone(), StopRule::default().to_the_floor());
    stepper.start(start);
    stepper.step(body, h).expect("a step that can be solved");
    State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() }
}

/// A state near `end`, by the coordinates of a change: those of the skew part of `g1^T g` and of mu.
fn coordinates<const N: usize>(end: &State<N>, state: &State<N>) -> Vec<f64> {
    let turn = so::transposed_product(&end.attitude, &state.attitude);
    let mut coordinates = so::vee(&so::skew(&turn));
    coordinates.extend(so::vee(&state.momentum));
    coordinates
}

/// `state` changed by e times the coordinate `number`.
fn changed<const N: usize>(state: &State<N>, number: usize, e: f64) -> State<N> {
    let d = so::dimension(N);
    let mut change = vec![0.0; 2 * d];
    change[number] = e;
    State {
        attitude: state.attitude * so::exp(&so::hat::<N>(&change[..d])),
        momentum: state.momentum + so::hat::<N>(&change[d..]),
    }
}

/// Lagrange's top: its motion is regular, and its derivatives grow with time alone.
fn heavy_top() -> (RigidBody<3>, State<3>) {
    let weight = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.0, 0.0, 0.5) };
    let terms = vec![Term { law: weight, space: Vector::<3>::new(0.0, 0.0, 1.0) }];
    let body = RigidBody::new(Kinetic::of_moments([1.0, 1.0, 0.6]), terms, 0.0);
    let attitude = so::exp(&so::hat(&[0.4, 0.0, 0.0]));
    (body, State { attitude, momentum: so::hat(&[0.1, 0.2, 1.5]) })
}

fn tableaux() -> Vec<Tableau> {
    // Radau IA of order 3 (Hairer, Wanner 1996, table IV.5.5): neither symplectic nor symmetric.
    let radau = Tableau::new(vec![vec![0.25, -0.25], vec![0.25, 5.0 / 12.0]], vec![0.25, 0.75]);
    let mut tableaux: Vec<_> = [1, 2, 3, 5, 8].into_iter().filter_map(Tableau::gauss).collect();
    tableaux.extend([radau.expect("of order 3"), Tableau::rk3()]);
    tableaux
}

/// The largest difference relative to the largest entry.
fn relative(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let size = a.iter().fold(1.0, |size: f64, x| size.max(x.abs()));
    a.iter().zip(b).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs())) / size
}

fn column(matrix: &[f64], columns: usize, number: usize) -> Vec<f64> {
    matrix.chunks_exact(columns).map(|row| row[number]).collect()
}

#[test]
fn the_derivative_of_a_step_is_that_of_differences() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(21);
        let varied = Varied::<N>::new(&mut numbers);
        let body = varied.at(0.0);
        for tableau in tableaux() {
            // Without symplecticity the equations of a long step have several solutions here.
            let steps: &[f64] = if tableau.is_symplectic() { &[0.05, 0.2] } else { &[0.05] };
            for &h in steps {
                let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
                let mut tangent = Tangent::new(&body, tableau.clone()).expect("not driven");
                let of_step = tangent.of_step(h, &start, &[]).expect("a modest step");
                let end = step(&body, &tableau, h, &start);
                let label = format!("n = {N}, {} stages, h = {h}", tableau.stages());
                let own = of_step.end();
                assert!((own.attitude - end.attitude).amax() < 1e-14, "{label}");
                assert!((own.momentum - end.momentum).amax() < 1e-14, "{label}");
                let (transition, columns) = (of_step.transition(), 2 * so::dimension(N));
                for number in 0..columns {
                    let at = |e| {
                        let start = changed(&start, number, e);
                        coordinates(&end, &step(&body, &tableau, h, &start))
                    };
                    let error = relative(&column(transition, columns, number), &difference(at));
                    assert!(error < 1e-12, "{label}, {number}: {error:e}");
                }
                let by = of_step.by_parameters(std::slice::from_ref(&varied.rate));
                let at = |e| coordinates(&end, &step(&varied.at(e), &tableau, h, &start));
                let error = relative(&by, &difference(at));
                assert!(error < 1e-12, "{label}, parameter: {error:e}");
            }
        }
    }
    law::<2>();
    law::<3>();
    law::<4>();
    law::<5>();
}

fn product(a: &[f64], b: &[f64], size: usize) -> Vec<f64> {
    let matrix = |numbers: &[f64]| nalgebra::DMatrix::from_row_slice(size, size, numbers);
    (matrix(a) * matrix(b)).transpose().as_slice().to_vec()
}

/// Steps along a run, the stages from its stepper: the largest error of the derivative of one step, and that of all.
fn symplectic_errors<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    (tableau, h): (&Tableau, f64),
    start: &State<N>,
    steps: u32,
) -> [f64; 2] {
    let size = 2 * so::dimension(N);
    let mut tangent = Tangent::new(body, tableau.clone()).expect("not driven");
    let mut all: Vec<f64> =
        (0..size * size).map(|k| f64::from(u8::from(k % (size + 1) == 0))).collect();
    stepper.start(start);
    let (mut state, mut most) = (start.clone(), 0.0_f64);
    for _ in 0..steps {
        stepper.step(body, h).expect("a step that can be solved");
        let of_step = tangent.of_step(h, &state, &stages_of(stepper)).expect("solved");
        let transition = of_step.transition();
        let next =
            State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() };
        most = most.max(symplectic_error(transition, &state.momentum, &next.momentum));
        all = product(transition, &all, size);
        state = next;
    }
    [most, symplectic_error(&all, &start.momentum, &state.momentum)]
}

#[test]
fn the_derivative_is_symplectic() {
    let gauss = |stages| Tableau::gauss(stages).expect("gauss");
    for ((name, (body, start)), stages, h, steps) in [
        (("dipole", dipole()), 2, 0.01, 10_000),
        (("dipole", dipole()), 8, 0.1, 2_000),
        (("top", heavy_top()), 2, 0.02, 10_000),
    ] {
        let mut stepper = VpdSo3::new(gauss(stages), StopRule::default()).expect("n = 3");
        let [each, all] =
            symplectic_errors(&body, &mut stepper, (&gauss(stages), h), &start, steps);
        println!("{name}, {stages} stages, {steps} steps: {each:e} a step, {all:e} in all");
        assert!(each < 1e-14 && all < 1e-14, "{name}, {stages} stages: {each:e}, {all:e}");
    }
    fn law<const N: usize>(tableau: &Tableau) {
        let mut numbers = Numbers(22);
        let body = Varied::<N>::new(&mut numbers).at(0.0);
        let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
        let mut stepper = Vpd::new(tableau.clone(), StopRule::default().to_the_floor());
        let [each, all] = symplectic_errors(&body, &mut stepper, (tableau, 0.1), &start, 300);
        println!("n = {N}, {} stages: {each:e} a step, {all:e} in all", tableau.stages());
        assert!(each < 1e-13 && all < 1e-12, "n = {N}: {each:e}, {all:e}");
    }
    for tableau in tableaux() {
        law::<2>(&tableau);
        law::<3>(&tableau);
        law::<4>(&tableau);
        law::<5>(&tableau);
    }
}

#[test]
#[ignore = "half a minute: cargo test --release the_derivative_stays_symplectic -- --ignored --nocapture"]
fn the_derivative_stays_symplectic() {
    let (body, start) = heavy_top();
    let gauss = Tableau::gauss(2).expect("gauss");
    let mut stepper = VpdSo3::new(gauss.clone(), StopRule::default()).expect("n = 3");
    let [each, all] = symplectic_errors(&body, &mut stepper, (&gauss, 0.02), &start, 100_000);
    println!("top, 100000 steps: {each:e} a step, {all:e} in all");
    assert!(each < 1e-14 && all < 1e-12, "{each:e}, {all:e}");
}

#[test]
#[ignore = "times: cargo test --release the_derivative_costs -- --ignored --nocapture"]
fn the_derivative_costs() {
    use std::time::Instant;
    use vpd_solve::tangent::WithDerivatives;
    let (body, start) = heavy_top();
    for (stages, h) in [(1, 0.01), (2, 0.02), (4, 0.05), (8, 0.1), (8, 0.3)] {
        let tableau = Tableau::gauss(stages).expect("gauss");
        let new = || VpdSo3::new(tableau.clone(), StopRule::default()).expect("n = 3");
        let (mut alone, inside) = (new(), Box::new(new()));
        let with = WithDerivatives::new(inside, &body, tableau.clone(), true, Vec::new());
        let mut with = with.expect("not driven");
        let mut best = [f64::INFINITY; 2];
        for _ in 0..50 {
            let steppers: [&mut dyn Stepper<3>; 2] = [&mut alone, &mut with];
            for (stepper, best) in steppers.into_iter().zip(&mut best) {
                stepper.start(&start);
                let begin = Instant::now();
                for _ in 0..200 {
                    stepper.step(&body, h).expect("a step that can be solved");
                }
                *best = best.min(begin.elapsed().as_secs_f64() / 200.0 * 1e9);
            }
        }
        let [alone, with] = best;
        println!("{stages} stages, h = {h}: {alone:.0} ns, {with:.0} ns: {:.2}", with / alone);
    }
}

/// A tangent carried forward and an adjoint carried backward: their pairing is the same at each step.
#[test]
fn the_pairing_of_tangent_and_adjoint_is_constant() {
    let (body, start) = heavy_top();
    let (tableau, h, steps) = (Tableau::gauss(3).expect("gauss"), 0.02, 10_000);
    let mut tangent = Tangent::new(&body, tableau.clone()).expect("not driven");
    let mut stepper = VpdSo3::new(tableau, StopRule::default()).expect("n = 3");
    stepper.start(&start);
    let mut numbers = Numbers(23);
    let mut changes = vec![(0..6).map(|_| numbers.next()).collect::<Vec<f64>>()];
    let (mut run, mut state) = (Vec::new(), start);
    for step in 0..steps {
        stepper.step(&body, h).expect("a step that can be solved");
        let of_step = tangent.of_step(h, &state, &stages_of(&stepper)).expect("solved");
        changes.push(of_step.push_forward(&changes[step]));
        let next =
            State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() };
        run.push((state, stages_of(&stepper)));
        state = next;
    }
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut adjoint: Vec<f64> = (0..6).map(|_| numbers.next()).collect();
    let pairing = dot(&adjoint, &changes[steps]);
    let mut most = 0.0_f64;
    for (step, (state, stages)) in run.iter().enumerate().rev() {
        adjoint = tangent.of_step(h, state, stages).expect("solved").pull_back(&adjoint, &[]).0;
        let size = dot(&adjoint, &adjoint).sqrt() * dot(&changes[step], &changes[step]).sqrt();
        most = most.max((dot(&adjoint, &changes[step]) - pairing).abs() / size);
    }
    println!("pairing {pairing:e}, changes by {most:e} of the sizes in {steps} steps");
    assert!(most < 1e-13, "{most:e}");
}

/// The gradient of a sum over the states of a run by one pass backward is that by the derivatives of all its steps.
#[test]
fn the_gradient_by_the_adjoint_is_that_by_the_tangent() {
    fn law<const N: usize>(steps: u64) {
        let mut numbers = Numbers(24);
        let varied = Varied::<N>::new(&mut numbers);
        let body = varied.at(0.0);
        // Each term by itself, and all that changes together.
        let of_term = |rate: &(Term<N>, Term<N>)| BodyRate {
            terms: vec![rate.clone()],
            ..BodyRate::default()
        };
        let mut rates: Vec<_> = varied.rate.terms.iter().map(of_term).collect();
        rates.push(varied.rate);
        let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
        let (tableau, h, size) = (Tableau::gauss(2).expect("gauss"), 0.05, 2 * so::dimension(N));
        let mut tangent = Tangent::new(&body, tableau.clone()).expect("not driven");
        let weights: Vec<f64> = (0..size).map(|_| numbers.next()).collect();
        // Every seventh state counts, and the end.
        let by_state = |step: u64, state: &State<N>| {
            let here = step.is_multiple_of(7) || step == steps;
            here.then(|| weights.iter().map(|w| w * (1.0 + state.momentum[(0, 1)])).collect())
        };
        let mut stepper = Vpd::new(tableau, StopRule::default());
        let found =
            tangent.gradient(&mut stepper, &start, (h, steps), by_state, &rates).expect("solved");

        let (mut by_start, mut by_parameters) = (vec![0.0; size], vec![0.0; rates.len()]);
        let (mut all, mut sensitivity) = (Vec::new(), vec![0.0; size * rates.len()]);
        for k in 0..size * size {
            all.push(f64::from(u8::from(k % (size + 1) == 0)));
        }
        let mut state = start.clone();
        let length = steps.isqrt();
        for step in 0..=steps {
            for (i, x) in by_state(step, &state).into_iter().flatten().enumerate() {
                (0..size).for_each(|j| by_start[j] += x * all[i * size + j]);
                let column = sensitivity.chunks_exact(size).map(|column| column[i]);
                column.zip(&mut by_parameters).for_each(|(s, sum)| *sum += x * s);
            }
            if step == steps {
                break;
            }
            if step % length == 0 {
                stepper.start(&state);
            }
            stepper.step(&body, h).expect("a step that can be solved");
            let of_step = tangent.of_step(h, &state, &stages_of(&stepper)).expect("solved");
            let (transition, by) = (of_step.transition(), of_step.by_parameters(&rates));
            all = product(transition, &all, size);
            let columns = sensitivity.chunks_exact_mut(size).zip(by.chunks_exact(size));
            for (column, by) in columns {
                let row = |row: &[f64]| row.iter().zip(&*column).map(|(a, b)| a * b).sum::<f64>();
                let carried: Vec<f64> = transition.chunks_exact(size).map(row).collect();
                (0..size).for_each(|i| column[i] = carried[i] + by[i]);
            }
            state = State {
                attitude: stepper.attitude().expect("carried"),
                momentum: stepper.momentum(),
            };
        }
        let errors =
            [relative(&found.start, &by_start), relative(&found.parameters, &by_parameters)];
        println!("n = {N}, {steps} steps: {errors:?} of {:?}", by_parameters);
        assert!(errors.iter().all(|error| *error < 1e-12), "n = {N}: {errors:?}");
    }
    law::<2>(100);
    law::<3>(1003);
    law::<4>(200);
    law::<5>(50);
}

/// The rate between two terms is what leads from one to the other.
#[test]
fn the_rate_of_a_term_is_the_difference_of_two() {
    let mut numbers = Numbers(25);
    let varied = Varied::<4>::new(&mut numbers);
    for (term, rate) in &varied.rate.terms {
        let at = |e: f64| Term {
            law: moved(&term.law, &rate.law, e),
            space: term.space + rate.space * e,
        };
        let found = at(2.0).quotient(&at(0.0), 2.0).expect("of one kind");
        assert!((found.space - rate.space).amax() < 1e-14);
        let again = moved(&term.law, &found.law, 2.0);
        assert_eq!(format!("{again:.12?}"), format!("{:.12?}", at(2.0).law));
    }
    let [(uniform, _), (source, _), ..] = varied.rate.terms.as_slice() else {
        panic!("there is one term of each law");
    };
    assert_eq!(uniform.quotient(source, 1.0), None);
}

#[test]
fn a_driven_body_is_refused() {
    let (body, _) = dipole();
    let torque = Torque::OfMomentum(0.1);
    let body = body.with_torque(torque);
    let refused = Tangent::new(&body, Tableau::gauss(1).expect("gauss")).err();
    assert_eq!(refused, Some(TangentError::Driven));
}

/// Of a free body and of a top all exponents are zero; those of a chaotic motion come in pairs of two signs.
#[test]
fn lyapunov_exponents() {
    let gauss = Tableau::gauss(2).expect("gauss");
    let exponents = |(body, start): (RigidBody<3>, State<3>), h: f64, steps: u64| {
        let mut tangent = Tangent::new(&body, gauss.clone()).expect("not driven");
        let mut stepper = VpdSo3::new(gauss.clone(), StopRule::default()).expect("n = 3");
        let found = tangent.lyapunov(&mut stepper, &start, (h, steps), |_| true).expect("solved");
        let found = found.expect("nobody stops it");
        println!("{found:?}");
        assert!(found.sum.abs() < 1e-12, "{:e}", found.sum);
        found
    };
    let free = || {
        let body = RigidBody::new(Kinetic::of_moments([1.0, 1.4, 1.7]), Vec::new(), 0.0);
        (body, State { attitude: Mat::identity(), momentum: so::hat(&[0.3, 0.1, 1.2]) })
    };
    // What grows with time alone, like t, has exponents that fall like log(t) / t.
    for regular in [free(), heavy_top()] {
        let found = exponents(regular, 0.05, 16_000);
        let most = 2.0 * 800.0_f64.ln() / 800.0;
        assert!(found.exponents.iter().all(|exponent| exponent.abs() < most), "{found:?}");
    }
    let found = exponents(dipole(), 0.01, 20_000);
    assert!(found.exponents[0] > 3.0 * found.errors[0], "{found:?}");
    for (i, exponent) in found.exponents.iter().enumerate() {
        let pair = exponent + found.exponents[5 - i];
        assert!(pair.abs() < 0.05, "{found:?}");
    }
}

/// In vectors, from the stages of the stepper, a step has the derivative that it has in matrices, with the same bits with and
/// without lanes.
#[test]
fn in_vectors_it_is_that_in_matrices() {
    let mut numbers = Numbers(23);
    let space = Vector::<3>::new(2.0, 1.5, 2.5);
    let terms: Vec<_> =
        Law::<3>::examples(|| numbers.next()).into_iter().map(|law| Term { law, space }).collect();
    let rates = terms.iter().map(|term| BodyRate {
        second_moments: so::symmetric_part(&numbers.matrix()),
        terms: vec![(term.clone(), Term { law: term.law.clone(), space: space * 0.3 })],
    });
    let rates: Vec<_> = rates.collect();
    let body = RigidBody::new(Kinetic::of_moments([1.0, 1.3, 0.6]), terms, 0.0);
    let start = State {
        attitude: so::exp(&so::hat(&[0.4, 0.2, -0.3])),
        momentum: so::hat(&[0.1, 0.2, 0.8]),
    };
    let gradient = [0.3, -0.2, 0.5, 0.7, 0.1, -0.4];
    for count in 1..=8 {
        let tableau = Tableau::gauss(count).expect("gauss");
        let mut stepper = VpdSo3::new(tableau.clone(), StopRule::default()).expect("n = 3");
        stepper.start(&start);
        stepper.step(&body, 0.1).expect("a modest step");
        let of_step = |stages: &[State<3>], lanes: bool| {
            let mut tangent = Tangent::new(&body, tableau.clone()).expect("not driven");
            if !lanes {
                tangent = tangent.on_level(None);
            }
            let of_step = tangent.of_step(0.1, &start, stages).expect("a modest step");
            let (by_start, by_parameters) = of_step.pull_back(&gradient, &rates);
            let end = of_step.end().momentum.as_slice().to_vec();
            let transition = of_step.transition().to_vec();
            [transition, of_step.by_parameters(&rates), by_start, by_parameters, end]
        };
        let stages = stages_of(&stepper);
        let own = of_step(&stages, true);
        assert_eq!(own, of_step(&stages, false), "{count} stages");
        // Without stages the equations are solved and differentiated in matrices.
        for (own, other) in own.iter().zip(&of_step(&[], true)) {
            let size = own.iter().fold(1.0, |size: f64, x| size.max(x.abs()));
            let error =
                own.iter().zip(other).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
            assert!(own.len() == other.len() && error < 1e-13 * size, "{count} stages: {error:e}");
        }
    }
}
