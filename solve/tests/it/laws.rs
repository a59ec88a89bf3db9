//! Laws of the group, the potential and the step, for n = 2 to 8.

use nalgebra::{DMatrix, Matrix3, Vector3};
use vpd_solve::hamiltonian::{DrivenTerm, Factor, Kinetic, Law, Path, RigidBody, Term};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::system::System;
use vpd_solve::tableau::Tableau;

use crate::given::Numbers;
use crate::literal;

/// A body with one term of each kind.
pub(crate) fn body<const N: usize>(numbers: &mut Numbers) -> RigidBody<N> {
    let far = |numbers: &mut Numbers| numbers.vector::<N>() + Vector::<N>::repeat(2.0);
    let term = |law, space| Term { law, space };
    let terms = vec![
        term(Law::Uniform { weight: 0.7, body_point: numbers.vector() }, numbers.vector()),
        term(Law::PointSource { strength: 0.5, body_point: numbers.vector() }, far(numbers)),
        term(
            Law::Spring { stiffness: 0.8, rest_length: 0.4, body_point: numbers.vector() },
            far(numbers),
        ),
        term(
            Law::Spring { stiffness: 0.3, rest_length: 0.0, body_point: numbers.vector() },
            numbers.vector(),
        ),
        term(
            Law::GravityGradient { strength: 0.6, matrix: so::symmetric_part(&numbers.matrix()) },
            numbers.vector(),
        ),
    ];
    RigidBody::new(kinetic(), terms, 0.0)
}

fn kinetic<const N: usize>() -> Kinetic<N> {
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (2.0 + 0.2 * (i + j) as f64) });
    Kinetic::Principal { weights }
}

/// One term of each law, a new one included.
fn every_term<const N: usize>(numbers: &mut Numbers) -> Vec<Term<N>> {
    let laws = Law::examples(|| numbers.next());
    let far = |law| Term { law, space: numbers.vector() + Vector::<N>::repeat(2.0) };
    laws.into_iter().map(far).collect()
}

/// For each law a body with it alone.
fn every_law<const N: usize>(numbers: &mut Numbers) -> Vec<RigidBody<N>> {
    let body = |term| RigidBody::new(kinetic(), vec![term], 0.0);
    every_term(numbers).into_iter().map(body).collect()
}

/// Takes steps of the given sizes.
pub(crate) fn advance<const N: usize>(
    stepper: &mut dyn Stepper<N>,
    body: &RigidBody<N>,
    start: &State<N>,
    steps: &[f64],
) -> State<N> {
    stepper.start(start);
    for &h in steps {
        stepper.step(body, h).expect("a step that can be solved");
        stepper.synchronise(body, h).expect("a step that can be solved");
    }
    let attitude = stepper.attitude().expect("a scheme with an attitude");
    State { attitude, momentum: stepper.momentum() }
}

/// Runs a generic law for each of the sizes.
macro_rules! for_sizes {
    ($law:ident) => {
        $law::<2>();
        $law::<3>();
        $law::<4>();
        $law::<5>();
        $law::<8>();
    };
}

#[test]
fn coordinates_and_pairing() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(1);
        let (x, y) = (numbers.skew::<N>(), numbers.skew::<N>());
        let (vx, vy) = (so::vee(&x), so::vee(&y));
        assert_eq!(vx.len(), so::dimension(N));
        assert_eq!(so::hat::<N>(&vx), x);
        let dot: f64 = vx.iter().zip(&vy).map(|(a, b)| a * b).sum();
        assert!((so::inner(&x, &y) - dot).abs() < 1e-15);
        // <X, asym(A)> = tr(X A^T)
        let a = numbers.matrix::<N>();
        assert!((so::inner(&x, &so::asym(&a)) - x.dot(&a)).abs() < 1e-14);
    }
    for_sizes!(law);
    let (v, w) = (Vector3::new(1.0, 2.0, 3.0), Vector3::new(-0.5, 0.25, 4.0));
    assert_eq!(so::hat::<3>(v.as_slice()) * w, v.cross(&w));
}

#[test]
fn frequencies_label_the_orbit() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(13);
        let (x, g) = (numbers.skew::<N>(), numbers.rotation::<N>());
        let (here, there) = (so::frequencies(&x), so::frequencies(&so::conjugate(&g, &x)));
        assert!(here.iter().zip(&there).all(|(a, b)| (a - b).abs() < 1e-14), "n = {N}");
        // Twice <X, X> is the sum of their squares.
        let sum: f64 = here.iter().map(|frequency| frequency * frequency).sum();
        assert!((sum - 2.0 * so::inner(&x, &x)).abs() < 1e-14, "n = {N}");
        assert_eq!(here.len(), N);
    }
    for_sizes!(law);
}

#[test]
fn the_smallest_eigenvalue_of_a_symmetric_matrix() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(12);
        // The second one is as near as that.
        for gap in [0.0, 1e-15, 1e-9, 1e-5, 1e-3, 0.1, 2.0] {
            for size in [0.0, 1e-200, 1e-30, 1e-16, 1e-5, 1.0, 1e9] {
                let r = numbers.rotation::<N>();
                let smallest = numbers.next() - 1.0;
                let values = Vector::<N>::from_fn(|i, _| {
                    size * (smallest + [0.0, gap, 1.0 + gap][i.min(2)])
                });
                let p = so::product(&r, &(Mat::from_diagonal(&values) * r.transpose()));
                let found = so::smallest_eigenvalue(&((p + p.transpose()) * 0.5));
                let error = (found - values[0]).abs();
                assert!(error <= 1e-11 * p.amax(), "n = {N}, {gap:e}, {size:e}: {error:e}");
            }
        }
    }
    for_sizes!(law);
}

#[test]
fn the_distance_from_the_group_is_the_spectral_norm() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(13);
        for size in [0.0, 1e-15, 1e-9, 1e-3, 1.0, 1e3] {
            // A stretch along every axis, along all alike, along one, and none.
            for kind in 0..4 {
                let q = numbers.rotation::<N>();
                let stretched = match kind {
                    0 => Mat::identity() + numbers.matrix() * size,
                    1 => Mat::identity() * (1.0 + size),
                    2 => Mat::from_fn(|i, j| {
                        if i != j {
                            0.0
                        } else if i == 0 {
                            1.0 - size
                        } else {
                            1.0
                        }
                    }),
                    _ => Mat::identity(),
                };
                let g = so::product(&q, &stretched);
                let defect = so::product(&g, &g.transpose()) - Mat::<N>::identity();
                let defect = DMatrix::from_column_slice(N, N, defect.as_slice());
                let wanted = defect.symmetric_eigen().eigenvalues.amax();
                let found = so::orthogonality_error(&g);
                assert!(
                    (found - wanted).abs() <= 1e-14 * wanted,
                    "n = {N}, {size:e}, {kind}: {found:e}, not {wanted:e}"
                );
            }
        }
        assert_eq!(so::orthogonality_error(&Mat::<N>::identity()), 0.0);
        assert!(so::orthogonality_error(&(Mat::<N>::identity() * f64::NAN)).is_nan());
        assert!(so::orthogonality_error(&(Mat::<N>::identity() * 1e200)).is_nan());
    }
    for_sizes!(law);
}

#[test]
fn polar_factor() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(2);
        for _ in 0..20 {
            let q = numbers.rotation::<N>();
            let a = Mat::identity() + numbers.matrix() * 0.4;
            let u = so::polar(&a).expect("near the identity");
            assert!(so::orthogonality_error(&u) < 2e-15, "n = {N}");
            let p = Mat::identity() + so::stretch_of(&u, &(a - Mat::identity()));
            let defect: Mat<N> = u * p - a;
            assert!(defect.amax() < 1e-14);
            assert!(so::smallest_eigenvalue(&p) > 0.0);
            // polar(R) = R and polar(Q A) = Q polar(A)
            assert!((so::polar(&q).expect("regular") - q).amax() < 1e-15);
            assert!((so::polar(&(q * a)).expect("regular") - q * u).amax() < 1e-14);
        }
        assert_eq!(so::polar(&Mat::<N>::zeros()), None);
        assert_eq!(so::polar(&Mat::<N>::repeat(f64::NAN)), None);
    }
    for_sizes!(law);
}

#[test]
fn tangent_map_of_the_polar_factor_and_its_adjoint() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(3);
        let a = Mat::<N>::identity() + numbers.matrix() * 0.3;
        let (b, s) = (numbers.matrix::<N>(), numbers.skew::<N>());
        let u = so::polar(&a).expect("regular");
        let p = so::symmetric_part(&u.tr_mul(&a));
        let tangent = so::polar_tangent(&u, &p, &b).expect("regular");
        let e = 1e-5;
        let ahead = so::polar(&(a + b * e)).expect("regular");
        let behind = so::polar(&(a - b * e)).expect("regular");
        let difference = u.transpose() * (ahead - behind) / (2.0 * e);
        assert!((difference - tangent).amax() < 1e-9, "n = {N}");
        // tr(dP*(S) B^T) = <S, dP(B)>
        let adjoint = so::polar_tangent_adjoint(&u, &p, &s).expect("regular");
        assert!((adjoint.dot(&b) - so::inner(&s, &tangent)).abs() < 1e-13);
    }
    for_sizes!(law);
}

#[test]
fn lyapunov_equations() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(4);
        for spread in [1e-6, 0.1, 0.6] {
            let c = numbers.skew::<N>();
            let root = Mat::<N>::identity() + numbers.matrix() * (spread / N as f64);
            let p = root * root.transpose();
            let x = so::lyapunov(&p, &c, &Mat::zeros()).expect("positive definite");
            assert!((p * x + x * p - c).amax() < 1e-14, "n = {N}, spread {spread}");
            assert_eq!(x, -x.transpose());
            // The multiplier's equation, with a rotation for M.
            let f = so::retraction(&(numbers.skew::<N>() * (2.0 * spread / N as f64)))
                .expect("defined");
            let x = so::lyapunov(&f, &c, &Mat::zeros()).expect("less than a quarter turn");
            assert!((f * x + x * f.transpose() - c).amax() < 1e-14, "n = {N}, spread {spread}");
        }
    }
    for_sizes!(law);
    // Half a turn: eigenvalues i and -i sum to zero.
    let quarter = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let half = quarter * quarter;
    assert_eq!(so::lyapunov(&half, &so::hat(&[1.0, 0.0, 0.0]), &Mat::zeros()), None);
    let four = Mat::<4>::from_fn(|i, j| {
        [[0.0, -1.0], [1.0, 0.0]][i % 2][j % 2] * f64::from(u8::from(i / 2 == j / 2))
    });
    assert_eq!(so::lyapunov(&four, &Numbers(5).skew::<4>(), &Mat::zeros()), None);
}

#[test]
fn retraction_and_its_inverse() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(6);
        for size in [1e-8, 0.1, 0.5] {
            let omega = numbers.skew::<N>() * size;
            let u = so::retraction(&omega).expect("defined everywhere");
            assert!(so::orthogonality_error(&u) < 2e-15);
            let back = so::inverse_retraction(&u).expect("within a quarter turn");
            assert!((back - omega).amax() < 1e-14, "n = {N}: {:e}", (back - omega).amax());
            // Rigidity: P(I + Omega) = I + Omega + O(Omega^2).
            let second_order = 2.0 * omega.norm_squared() + 1e-15;
            assert!((u - Mat::identity() - omega).amax() < second_order);
        }
    }
    for_sizes!(law);
    let half_turn = Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0));
    assert_eq!(so::inverse_retraction(&half_turn), None);
}

#[test]
fn the_exponential() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(12);
        for size in [1e-9, 1e-3, 0.099, 0.101, 1.0, 30.0] {
            let x = numbers.skew::<N>() * size;
            let u = so::exp(&x);
            assert!(so::orthogonality_error(&u) < 4e-15, "n = {N}");
            let round_off = 1e-15 * (4.0 + N as f64 * size);
            let back = so::exp(&-x);
            assert!((u.transpose() - back).amax() < round_off, "n = {N}, {size}");
            let twice = so::exp(&(x * 2.0));
            assert!((u * u - twice).amax() < round_off, "n = {N}, {size}");
            // exp(A X A^T) = A exp(X) A^T
            let a = numbers.rotation::<N>();
            let turned = so::exp(&so::conjugate(&a, &x));
            assert!((so::conjugate(&a, &u) - turned).amax() < round_off, "n = {N}, {size}");
        }
        // A rotation of each plane (2 k, 2 k + 1) by its own angle.
        let angle = |i: usize| 0.3 + 0.5 * (i / 2) as f64;
        let pair = |i: usize, j: usize| i / 2 == j / 2 && i.max(j) | 1 < N;
        let x = Mat::<N>::from_fn(|i, j| match (pair(i, j), i == j) {
            (true, false) => angle(i) * if i > j { 1.0 } else { -1.0 },
            _ => 0.0,
        });
        let expected = Mat::<N>::from_fn(|i, j| match (pair(i, j), i == j) {
            (true, true) => libm::cos(angle(i)),
            (true, false) => libm::sin(angle(i)) * if i > j { 1.0 } else { -1.0 },
            (false, same) => f64::from(u8::from(same)),
        });
        assert!((so::exp(&x) - expected).amax() < 1e-15, "n = {N}");
        assert!(so::exp(&Mat::<N>::repeat(f64::NAN)).iter().all(|x| x.is_nan()));
        assert!(so::exp(&Mat::<N>::repeat(f64::INFINITY)).iter().all(|x| x.is_nan()));
        assert!(so::exp(&(numbers.skew::<N>() * 1e9)).iter().all(|x| x.is_nan()));
    }
    for_sizes!(law);
}

#[test]
fn the_exponential_is_the_sum_of_its_series() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(31);
        for size in [0.0, 1e-9, 1e-3, 0.2, 0.49, 0.51, 2.0, 40.0] {
            let x = numbers.skew::<N>() * size;
            let e = so::exp(&x);
            assert!(so::orthogonality_error(&e) < 2e-15 * (1.0 + size), "n = {N}, {size}");
            if size <= 2.0 {
                let mut term = Mat::<N>::identity();
                let mut sum = term;
                for k in 1..40 {
                    term = term * x / f64::from(k);
                    sum += term;
                }
                assert!((e - sum).amax() < 3e-15, "n = {N}, {size}: {:e}", (e - sum).amax());
            }
        }
        assert!(!so::exp(&Mat::<N>::repeat(f64::INFINITY)).iter().all(|x| x.is_finite()));
    }
    law::<2>();
    law::<3>();
    law::<4>();
    law::<5>();
    law::<8>();
}

#[test]
fn the_gradient_is_the_derivative_of_the_energy() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(7);
        let all = body::<N>(&mut numbers);
        let each = every_law(&mut numbers);
        for body in [all].into_iter().chain(each) {
            let g0 = numbers.rotation::<N>();
            let u = numbers.rotation::<N>();
            let mut seen = Vec::new();
            body.seen_from(&g0, &mut seen);
            let gradient = body.gradient_seen(&u, &seen);
            let potential = |turn: &Mat<N>| {
                let attitude = g0 * u * so::retraction(turn).expect("small");
                body.energy(&attitude, &Mat::zeros()).potential
            };
            for _ in 0..10 {
                let eta = numbers.skew::<N>();
                // Five points, fourth order: e^4 and round-off over e balance near 1e-3.
                let e = 1e-3;
                let at = |k: f64| potential(&(eta * (k * e)));
                let difference = (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * e);
                let error = (difference - so::inner(&gradient, &eta)).abs();
                let size = 1.0 + gradient.norm() * eta.norm();
                assert!(error < 1e-10 * size, "n = {N}, {body:?}: {error:e} of {size}");
            }
            // The same gradient from the other side.
            let g = g0 * u;
            let difference = so::conjugate(&g, &gradient) - body.spatial_gradient(&g);
            let size = N as f64 * gradient.norm().max(1.0);
            assert!(difference.amax() < 1e-14 * size, "n = {N}: {:e}", difference.amax());
        }
    }
    for_sizes!(law);
}

/// If the strength of a term swings and its space vector turns, the energy changes by the input of
/// both.
#[test]
fn the_power_of_every_law_is_the_rate_of_its_energy() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(12);
        let axis = |k: usize| Vector::<N>::from_fn(|i, _| f64::from(u8::from(i == k)));
        for term in every_term::<N>(&mut numbers) {
            let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
            let plain = RigidBody::new(kinetic(), Vec::new(), 0.0);
            let body = plain.with_driven_term(DrivenTerm {
                term,
                path: Path::Turning { plane: [axis(0), axis(1)], rate: 1.3 },
                factor: Factor::Harmonic { mean: 1.0, amplitude: 0.3, rate: 2.1, phase: 0.5 },
            });
            let energy =
                |t, state: &State<N>| body.energy_at(t, &state.attitude, &state.momentum).total();
            let mut stepper = Vpd::new(Tableau::gauss(4).expect("4 stages"), StopRule::default());
            let end = advance(&mut stepper, &body, &start, &[0.02]);
            let change = energy(0.02, &end) - energy(0.0, &start);
            assert!(change.abs() > 1e-5, "{body:?}: {change:e}");
            assert!((change - stepper.work()).abs() < 1e-13, "{body:?}: {change:e}");
        }
    }
    for_sizes!(law);
}

#[test]
fn kinetic_energy_of_an_inertia_tensor() {
    let mut numbers = Numbers(8);
    let root = Matrix3::identity() + numbers.matrix::<3>() * 0.2;
    let inertia = root * root.transpose();
    let inverse = inertia.try_inverse().expect("regular");
    let body = RigidBody::new(Kinetic::Tensor { inertia, inverse }, Vec::new(), 0.25);
    let mu = numbers.vector::<3>();
    let momentum = so::hat::<3>(mu.as_slice());
    let omega = so::vee(&body.velocity(&momentum));
    assert!((Vector3::from_column_slice(&omega) - inverse * mu).amax() < 1e-15);
    let energy = body.energy(&Mat::identity(), &momentum);
    assert!((energy.kinetic - 0.5 * mu.dot(&(inverse * mu))).abs() < 1e-15);
    assert_eq!(energy.potential, 0.25);
    assert!((body.momentum(&body.velocity(&momentum)) - momentum).amax() < 1e-15);
}

#[test]
fn conserved_directions_are_those_the_potential_leaves_free() {
    let point = |space: [f64; 4]| Term {
        law: Law::PointSource { strength: 1.0, body_point: Vector::<4>::new(0.0, 0.0, 1.0, 0.0) },
        space: Vector::<4>::from(space),
    };
    let body =
        |terms| RigidBody::<4>::new(Kinetic::Principal { weights: Mat::repeat(1.0) }, terms, 0.0);
    let rank =
        |terms| body(terms).conserved_directions().map(|q: Mat<4>| q.trace().round() as usize);
    assert_eq!(rank(vec![]), Some(4));
    assert_eq!(rank(vec![point([0.0, 2.0, 0.0, 0.0])]), Some(3));
    assert_eq!(rank(vec![point([0.0, 2.0, 0.0, 0.0]), point([0.0, -3.0, 0.0, 0.0])]), Some(3));
    assert_eq!(rank(vec![point([0.0, 2.0, 0.0, 0.0]), point([1.0, 2.0, 0.0, 0.0])]), Some(2));
    assert_eq!(
        rank(vec![
            point([0.0, 2.0, 0.0, 0.0]),
            point([1.0, 2.0, 0.0, 0.0]),
            point([0.0, 0.0, 1.0, 1.0])
        ]),
        None
    );
}

#[test]
fn the_rearranged_step_is_the_papers() {
    fn law<const N: usize>(stages: &[usize], steps: &[f64]) {
        let mut numbers = Numbers(9);
        let body = body::<N>(&mut numbers);
        let state = State { attitude: numbers.rotation(), momentum: numbers.skew() };
        let tableaux = stages.iter().copied().map(Tableau::gauss);
        for tableau in tableaux.chain([Some(Tableau::rk3())]).flatten() {
            for &h in steps {
                let oracle = literal::step(&body, &tableau, h, &state);
                let mut ours = Vpd::new(tableau.clone(), StopRule::default());
                let ours = advance(&mut ours, &body, &state, &[h]);
                let attitude = (ours.attitude - oracle.attitude).amax();
                let difference = attitude.max((ours.momentum - oracle.momentum).amax());
                assert!(difference < 3e-15, "n = {N}, h = {h}: {difference:e}");
            }
        }
    }
    // With n = 8 no sweeps, the paper's or ours, find a step of 0.4.
    law::<2>(&[1, 2, 3, 5, 8], &[0.05, 0.2, 0.4]);
    law::<3>(&[1, 2, 3, 5, 8], &[0.05, 0.2, 0.4]);
    law::<4>(&[1, 2, 3, 5, 8], &[0.05, 0.2, 0.4]);
    law::<5>(&[1, 2, 3, 8], &[0.05, 0.4]);
    law::<6>(&[2, 3], &[0.05, 0.4]);
    law::<8>(&[2], &[0.2]);
}

/// In matrices and, for n = 3, in vectors: the formulas of a law in lanes next to those for one attitude.
#[test]
fn the_step_of_every_law_is_the_papers() {
    fn law<const N: usize>(in_lanes: impl Fn(&Tableau) -> Vec<Box<dyn Stepper<N>>>) {
        let mut numbers = Numbers(14);
        let tableau = Tableau::gauss(2).expect("2 stages");
        for body in every_law::<N>(&mut numbers) {
            let state = State { attitude: numbers.rotation(), momentum: numbers.skew() };
            let oracle = literal::step(&body, &tableau, 0.1, &state);
            for mut stepper in in_lanes(&tableau) {
                let ours = advance(stepper.as_mut(), &body, &state, &[0.1]);
                let attitude = (ours.attitude - oracle.attitude).amax();
                let difference = attitude.max((ours.momentum - oracle.momentum).amax());
                assert!(difference < 3e-15, "{body:?}: {difference:e}");
            }
        }
    }
    fn matrices<const N: usize>(tableau: &Tableau) -> Vec<Box<dyn Stepper<N>>> {
        vec![Box::new(Vpd::new(tableau.clone(), StopRule::default()))]
    }
    law::<2>(matrices);
    law::<3>(|tableau| {
        let vectors = VpdSo3::new(tableau.clone(), StopRule::default()).expect("2 stages");
        let mut steppers = matrices::<3>(tableau);
        steppers.push(Box::new(vectors));
        steppers
    });
    law::<4>(matrices);
    law::<5>(matrices);
}

#[test]
fn a_free_body_keeps_its_spatial_momentum() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(10);
        let weights =
            Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.3 * (i + j) as f64) });
        let body = RigidBody::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
        let start = State { attitude: numbers.rotation::<N>(), momentum: numbers.skew() };
        let spatial = so::conjugate(&start.attitude, &start.momentum);
        let mut stepper = Vpd::new(Tableau::gauss(2).expect("2 stages"), StopRule::default());
        stepper.start(&start);
        let (mut drift, mut orthogonality) = (0.0_f64, 0.0_f64);
        for _ in 0..10_000 {
            stepper.step(&body, 0.02).expect("a small step");
            let g = stepper.attitude().expect("carried");
            drift = drift.max((so::conjugate(&g, &stepper.momentum()) - spatial).amax());
            orthogonality = orthogonality.max(so::orthogonality_error(&g));
        }
        assert!(drift <= 1e-13, "n = {N}: drift {drift:e}");
        assert!(orthogonality <= 1e-15 * N as f64, "n = {N}: orthogonality {orthogonality:e}");
    }
    for_sizes!(law);
}

#[test]
fn the_midpoint_step_is_its_own_reverse() {
    // With more stages the scheme is biased towards g0, and symmetric to its order only.
    let mut numbers = Numbers(11);
    let body = body::<3>(&mut numbers);
    let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
    let mut stepper = Vpd::new(Tableau::gauss(1).expect("1 stage"), StopRule::default());
    let end = advance(&mut stepper, &body, &start, &[0.1, 0.1, 0.1, -0.1, -0.1, -0.1]);
    let defect = (end.attitude - start.attitude).amax().max((end.momentum - start.momentum).amax());
    assert!(defect < 1e-14, "{defect:e}");
}

#[test]
fn a_failed_step_leaves_the_state_alone() {
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 100.0 });
    let body = RigidBody::<3>::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, -0.2, 0.5]) };
    for stages in [1, 2, 4] {
        let mut stepper =
            Vpd::new(Tableau::gauss(stages).expect("1 to 8 stages"), StopRule::default());
        stepper.start(&start);
        let failure = stepper.step(&body, 1.0).expect_err("60 radians in a step");
        assert_eq!(
            (stepper.attitude(), stepper.momentum()),
            (Some(start.attitude), start.momentum)
        );
        assert!(failure.smaller_step(1.0) < 1.0, "{failure:?}");
    }
}

#[test]
fn an_inertia_is_the_same_by_moments_by_second_moments_and_by_its_tensor() {
    let d = [0.5, 0.3, 0.2];
    let moments = [d[1] + d[2], d[2] + d[0], d[0] + d[1]];
    // Axes of the body turned: the tensor in the new ones.
    let turn = so::exp(&so::hat::<3>(&[0.4, -0.7, 0.2]));
    let tensor = turn * Matrix3::from_diagonal(&Vector3::from(moments)) * turn.transpose();
    let omega = Vector3::new(0.3, -1.1, 0.8);
    let momentum = |kinetic: Kinetic<3>, omega: Vector3<f64>| {
        let body = RigidBody::new(kinetic, Vec::new(), 0.0);
        Vector3::from_vec(so::vee(&body.momentum(&so::hat(omega.as_slice()))))
    };
    let expected = omega.component_mul(&Vector3::from(moments));
    let by_tensor = Kinetic::of_tensor(tensor).expect("positive definite");
    for found in [
        momentum(Kinetic::of_moments(moments), omega),
        momentum(Kinetic::of_second_moments(d), omega),
        turn.transpose() * momentum(by_tensor, turn * omega),
    ] {
        assert!((found - expected).norm() < 1e-15, "{found} {expected}");
    }
    assert!(Kinetic::<3>::of_tensor(-tensor).is_none());
}

/// Makes steps of such a turn, as far as they are solved, up to 400; returns how far the attitude
/// gets from the group, and their number.
fn steps_of<const N: usize>(stages: usize, turn_rad: f64, terms: Vec<Term<N>>) -> (f64, usize) {
    let body = RigidBody::<N>::new(
        Kinetic::of_second_moments(std::array::from_fn(|i| 0.6 + 0.2 * i as f64)),
        terms,
        0.0,
    );
    let coordinates: Vec<f64> = (0..so::dimension(N)).map(|k| (1.0 + k as f64).sin()).collect();
    let momentum = so::hat::<N>(&coordinates);
    let omega = body.velocity(&momentum);
    let h = turn_rad / so::inner(&omega, &omega).sqrt();
    let mut stepper = Vpd::new(Tableau::gauss(stages).expect("gauss"), StopRule::default());
    stepper.start(&State { attitude: so::exp(&so::hat(&coordinates)), momentum });
    let (mut off, mut made) = (0.0_f64, 0);
    while made < 400 && stepper.step(&body, h).is_ok() {
        off = off.max(so::orthogonality_error(&stepper.attitude().expect("carried")));
        made += 1;
    }
    (off, made)
}

/// The distance from the group by rounding must not grow, however far a step turns.
#[test]
fn long_steps_stay_on_the_group() {
    fn check<const N: usize>() {
        let body_point = Vector::<N>::from_fn(|i, _| 0.1 + 0.2 * i as f64);
        let law = Law::Uniform { weight: 0.05, body_point };
        let term = Term { law, space: Vector::<N>::repeat(0.5) };
        let mut made = 0;
        for terms in [Vec::new(), vec![term]] {
            for stages in [2, 3, 4, 8] {
                for turn_rad in [0.5, 1.0, 1.2, 1.5, 1.8, 2.1] {
                    let (off, steps) = steps_of(stages, turn_rad, terms.clone());
                    assert!(off < 1e-14, "n = {N}, {stages} stages, {turn_rad} rad: {off:e}");
                    made += if turn_rad > 1.1 { steps } else { 0 };
                }
            }
        }
        assert!(made > 4000, "n = {N}: {made} long steps");
    }
    check::<3>();
    check::<4>();
    check::<6>();
}
