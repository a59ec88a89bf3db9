//! The comparator: known steps and errors, orders in every dimension, long runs, and the symplectic form,
//! which every variational scheme must keep and the others must not.

use nalgebra::Vector3;
use vpd_solve::failure::FailureCode;
use vpd_solve::hamiltonian::{Kinetic, RigidBody};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{self, Ending, Observables, Schedule};

use crate::given::{Numbers, dipole, distance, reference};
use crate::laws::{advance, body};
use crate::verification::{Invariants, classical};

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn vrkmk<const N: usize>(tableau: Tableau) -> Vrkmk<N> {
    Vrkmk::new(tableau, StopRule::default())
}

#[test]
fn one_step_of_the_dipole() {
    let (body, _) = dipole();
    let attitude = so::exp(&so::hat::<3>(&[0.3, -0.5, 0.7]));
    let momentum = attitude.tr_mul(&so::hat(&[0.4, -0.2, 0.1])) * attitude;
    let start = State { attitude, momentum };
    // Spatial momentum and first row of g after a step of 0.05, from an independent program.
    let rows = [
        (
            gauss(1),
            [0.433_689_213_687_479_4, -0.197_469_476_706_984_1],
            [0.545_865_382_770_852_6, -0.764_926_736_359_782_3, -0.341_932_847_053_924_4],
        ),
        (
            Tableau::rk3(),
            [0.433_786_906_555_933, -0.197_496_027_955_052_4],
            [0.545_595_247_113_510_2, -0.765_129_722_937_115_6, -0.341_909_832_273_540_3],
        ),
        (
            gauss(2),
            [0.433_776_353_796_734_2, -0.197_491_755_032_620_1],
            [0.545_615_193_021_163_1, -0.765_117_443_127_754, -0.341_905_483_088_714],
        ),
        (
            gauss(3),
            [0.433_776_424_218_800_2, -0.197_491_972_976_549_1],
            [0.545_614_584_719_048_9, -0.765_117_841_993_990_1, -0.341_905_561_236_314_4],
        ),
    ];
    for (tableau, [m1, m2], first_row) in rows {
        let end = advance(&mut vrkmk(tableau.clone()), &body, &start, &[0.05]);
        let m = so::vee(&so::conjugate(&end.attitude, &end.momentum));
        let momentum = Vector3::new(m[0] - m1, m[1] - m2, m[2] - 0.1).amax();
        let attitude = (end.attitude.row(0).transpose() - Vector3::from(first_row)).amax();
        assert!(momentum < 5e-15 && attitude < 5e-15, "{momentum:e}, {attitude:e}");
    }
}

/// Steps per second and the error they leave.
type Errors = Vec<(usize, f64)>;

/// Errors of the dipole at t = 0.5, from an independent program.
fn errors() -> [(&'static str, Tableau, Errors); 4] {
    let steps = [10, 20, 40, 52, 80, 100, 160, 320, 640];
    let with = |errors: [f64; 9]| steps.into_iter().zip(errors).collect();
    [
        (
            "GL2",
            gauss(1),
            with([
                3.647e-3, 9.304e-4, 2.338e-4, 1.384e-4, 5.852e-5, 3.746e-5, 1.463e-5, 3.659e-6,
                9.147e-7,
            ]),
        ),
        (
            "RK3",
            Tableau::rk3(),
            with([
                3.330e-4, 1.634e-6, 2.389e-6, 1.345e-6, 4.529e-7, 2.480e-7, 6.651e-8, 8.941e-9,
                1.157e-9,
            ]),
        ),
        (
            "GL4",
            gauss(2),
            with([
                1.449e-5, 8.997e-7, 5.610e-8, 1.963e-8, 3.503e-9, 1.435e-9, 2.189e-10, 1.368e-11,
                8.538e-13,
            ]),
        ),
        (
            "GL6",
            gauss(3),
            vec![
                (10, 6.122e-9),
                (14, 7.976e-10),
                (18, 1.750e-10),
                (22, 5.222e-11),
                (26, 1.910e-11),
                (32, 5.478e-12),
                (40, 1.433e-12),
                (52, 2.964e-13),
                (64, 8.6e-14),
                (80, 2.2e-14),
                (100, 5.6e-15),
            ],
        ),
    ]
}

#[test]
fn the_dipole_meets_its_reference() {
    let (body, start) = dipole();
    let reference = reference();
    for (name, tableau, rows) in errors() {
        for (per_second, expected) in rows {
            let steps = vec![1.0 / per_second as f64; per_second / 2];
            let end = advance(&mut vrkmk(tableau.clone()), &body, &start, &steps);
            let error = distance(&end, &reference);
            // A hundredth for the printed digits, and round-off.
            assert!(
                (error - expected).abs() <= 0.01 * expected + 1.5e-14,
                "{name} {per_second}: {error:e}, {expected:e} expected"
            );
        }
    }
}

#[test]
fn orders_and_what_the_truncation_leaves_of_them() {
    let (body, start) = dipole();
    let reference = reference();
    // Tableau, truncation (default where none), order, steps to t = 0.5 between which it is measured.
    let rows = [
        (gauss(1), None, 2, [40, 320]),
        (Tableau::rk3(), None, 3, [80, 640]),
        (Tableau::rk4(), None, 4, [40, 160]),
        (gauss(2), None, 4, [10, 160]),
        (gauss(3), None, 6, [5, 20]),
        (gauss(4), None, 8, [4, 8]),
        (Tableau::rk3(), Some(0), 2, [80, 640]),
        (gauss(2), Some(0), 2, [80, 640]),
        (gauss(2), Some(1), 3, [80, 320]),
        (gauss(3), Some(1), 3, [80, 320]),
        (gauss(3), Some(2), 5, [10, 40]),
    ];
    for (tableau, truncation, expected, [coarse, fine]) in rows {
        let mut stepper = vrkmk(tableau.clone());
        if let Some(q) = truncation {
            stepper = stepper.truncated(q);
        }
        assert_eq!(stepper.order(), expected, "{tableau:?}, {truncation:?}");
        let mut error = |steps: usize| {
            let end = advance(&mut stepper, &body, &start, &vec![0.5 / steps as f64; steps]);
            distance(&end, &reference)
        };
        let order = (error(coarse) / error(fine)).ln() / (fine as f64 / coarse as f64).ln();
        println!("{} stages, q {truncation:?}: order {order:.3}", tableau.stages());
        assert!((order - f64::from(expected)).abs() <= 0.1, "{tableau:?}, {truncation:?}: {order}");
    }
}

#[test]
fn orders_in_every_dimension() {
    fn measure<const N: usize>() {
        let mut numbers = Numbers(32);
        let body = body::<N>(&mut numbers);
        let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
        let reference = classical(&body, &start, 1.0, 4000);
        for (tableau, [coarse, fine]) in [
            (gauss(1), [20, 160]),
            (Tableau::rk3(), [40, 320]),
            (gauss(2), [10, 40]),
            (gauss(3), [5, 15]),
        ] {
            let mut stepper = vrkmk(tableau);
            let expected = f64::from(Stepper::<N>::order(&stepper));
            let mut error = |steps: usize| {
                let end = advance(&mut stepper, &body, &start, &vec![1.0 / steps as f64; steps]);
                (end.attitude - reference.attitude).norm()
                    + (end.momentum - reference.momentum).norm()
            };
            let order = (error(coarse) / error(fine)).ln() / (fine as f64 / coarse as f64).ln();
            println!("n = {N}: order {order:.3}");
            assert!((order - expected).abs() <= 0.1, "n = {N}: order {order}, not {expected}");
        }
    }
    measure::<2>();
    measure::<3>();
    measure::<4>();
    measure::<5>();
}

/// The dipole over many steps.
fn long_run(stepper: &mut dyn Stepper<3>, step_s: f64, steps: u64) -> Invariants {
    let (body, start) = dipole();
    let schedule = Schedule { step_s, steps, every: 1 };
    let observables = Observables {
        energy: true,
        orthogonality: true,
        momentum: true,
        sigma_min: false,
        pace: false,
        control: false,
        pointing: false,
        derivatives: false,
    };
    let mut seen = Invariants::default();
    let run =
        trajectory::integrate(&body, stepper, &start, schedule, observables, &mut seen, |_| true)
            .expect("the sink cannot fail");
    assert_eq!(run.ending, Ending::Completed);
    let energy = seen.energy.iter().fold(0.0_f64, |max, e| max.max(e.abs()));
    println!(
        "h {step_s:.4}, {steps} steps: energy {energy:.3e}, orthogonality {:.2e}, momentum {:.2e}, sweeps {:.2}",
        seen.orthogonality_max,
        seen.momentum_max,
        run.reached.iterations as f64 / steps as f64,
    );
    seen
}

#[test]
fn energy_errors_are_those_of_the_method() {
    // Largest error over 1e5 steps of an independent program. The last is round-off, a walk of 1e5 steps
    // of some 5e-16, and only a bound.
    let rows = [
        (gauss(1), 0.01, 1.0e-4, true),
        (Tableau::rk3(), 0.01, 7.7e-7, true),
        (gauss(2), 0.01, 1.31e-9, true),
        (gauss(3), 1.0 / 26.0, 3.5e-11, true),
        (gauss(3), 0.01, 3.3e-13, false),
    ];
    for (tableau, step_s, expected, reached) in rows {
        let seen = long_run(&mut vrkmk(tableau), step_s, 100_000);
        let energy = seen.energy.iter().fold(0.0_f64, |max, e| max.max(e.abs()));
        assert!(energy <= 1.5 * expected, "{energy:e}, {expected:e} expected");
        assert!(!reached || energy >= expected / 1.5, "{energy:e}, {expected:e} expected");
    }
}

#[test]
fn the_momentum_of_the_symmetry_is_kept() {
    for tableau in [gauss(1), Tableau::rk3(), gauss(2), gauss(3)] {
        let drift = long_run(&mut vrkmk(tableau), 0.01, 10_000).momentum_max;
        assert!(drift <= 1e-13, "{drift:e}");
    }
}

#[test]
fn only_the_product_of_exponentials_leaves_the_group() {
    let h = 1.0 / 26.0;
    let plain = |steps| long_run(&mut vrkmk(gauss(3)), h, steps).orthogonality_max;
    let (early, late) = (plain(1_000), plain(100_000));
    assert!(late >= 3.0 * early && late >= 1e-14, "{early:e}, {late:e}");
    let on_the_group: [Box<dyn Stepper<3>>; 2] =
        [Box::new(vrkmk(gauss(3)).projected()), Box::new(Vpd::new(gauss(3), StopRule::default()))];
    for mut stepper in on_the_group {
        let kept = long_run(stepper.as_mut(), h, 100_000).orthogonality_max;
        assert!(kept <= 2e-15, "{kept:e}");
    }
}

#[test]
fn a_failed_step_leaves_the_state_alone() {
    // Strongly unequal moments, far too large a step.
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 100.0 / (1 + i + j) as f64 });
    let body = RigidBody::<3>::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, -0.2, 0.5]) };
    for tableau in [Tableau::rk3(), gauss(2), gauss(3)] {
        let mut stepper = vrkmk(tableau);
        stepper.start(&start);
        let failure = stepper.step(&body, 1.0).expect_err("tens of radians in a step");
        let end = (stepper.attitude(), stepper.momentum());
        assert_eq!(end, (Some(start.attitude), start.momentum));
        assert!(failure.iterations > 0, "{failure:?}");
    }
    // No number, or one beyond any exponential, is not taken for a charge that was met.
    let (body, start) = dipole();
    for size in [f64::NAN, 1e200] {
        let mut stepper = vrkmk(gauss(2));
        stepper.start(&State { momentum: start.momentum * size, ..start.clone() });
        let failure = stepper.step(&body, 0.01).expect_err("not a number");
        assert_eq!(failure.code, FailureCode::NonFinite);
    }
}

/// The largest defect `|omega1 - omega0|` of the symplectic form over pairs of directions, by differences
/// of sixth order. Right-trivialised, with `delta g = e g` and `delta m = n`,
/// `omega = <n2, e1> - <n1, e2> - <m, [e1, e2]>`.
pub(crate) fn symplectic_defect<const N: usize, S: ?Sized>(
    stepper: &mut dyn Stepper<N, S>,
    system: &S,
    start: &State<N>,
    h: f64,
    e: f64,
) -> f64 {
    let dimension = so::dimension(N);
    let unit = |k: usize| {
        let mut coordinates = vec![0.0; dimension];
        coordinates[k] = 1.0;
        so::hat::<N>(&coordinates)
    };
    let zero = Mat::<N>::zeros();
    let directions: Vec<(Mat<N>, Mat<N>)> =
        (0..dimension).flat_map(|k| [(unit(k), zero), (zero, unit(k))]).collect();
    let m0 = so::conjugate(&start.attitude, &start.momentum);
    let mut end = |turn: &Mat<N>, push: &Mat<N>| {
        let attitude = so::exp(turn) * start.attitude;
        let momentum = so::conjugate(&attitude.transpose(), &(m0 + push));
        stepper.start(&State { attitude, momentum });
        stepper.step(system, h).expect("a small step");
        let g = stepper.attitude().expect("a scheme with an attitude");
        (g, so::conjugate(&g, &stepper.momentum()))
    };
    let (g1, m1) = end(&zero, &zero);
    let images: Vec<(Mat<N>, Mat<N>)> = directions
        .iter()
        .map(|(turn, push)| {
            let (mut dg, mut dm) = (zero, zero);
            for (k, weight) in [(1.0, 45.0), (2.0, -9.0), (3.0, 1.0)] {
                for sign in [1.0, -1.0] {
                    let (g, m) = end(&(turn * (sign * k * e)), &(push * (sign * k * e)));
                    dg += g * (sign * weight);
                    dm += m * (sign * weight);
                }
            }
            let scale = 1.0 / (60.0 * e);
            (so::asym(&(dg * g1.transpose())) * (0.5 * scale), dm * scale)
        })
        .collect();
    let form = |m: &Mat<N>, a: &(Mat<N>, Mat<N>), b: &(Mat<N>, Mat<N>)| {
        so::inner(&b.1, &a.0) - so::inner(&a.1, &b.0) - so::inner(m, &(a.0 * b.0 - b.0 * a.0))
    };
    let mut defect = 0.0_f64;
    for i in 0..directions.len() {
        for j in 0..i {
            let before = form(&m0, &directions[i], &directions[j]);
            defect = defect.max((form(&m1, &images[i], &images[j]) - before).abs());
        }
    }
    defect
}

/// The classical Runge-Kutta method in R^(n x n), for the test to see a scheme that keeps nothing.
struct Classical<const N: usize>(State<N>);

impl<const N: usize> Stepper<N> for Classical<N> {
    fn order(&self) -> u32 {
        4
    }

    fn start(&mut self, state: &State<N>) {
        self.0 = state.clone();
    }

    fn step(
        &mut self,
        body: &RigidBody<N>,
        h: f64,
    ) -> Result<vpd_solve::nonlinear::Convergence, vpd_solve::failure::Failure> {
        self.0 = classical(body, &self.0, h, 1);
        vpd_solve::nonlinear::fixed_point(StopRule::default(), || Ok(0.0))
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.0.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        self.0.momentum
    }
}

type Constructor<const N: usize> = fn(Tableau) -> Box<dyn Stepper<N>>;

/// Name, constructor, whether the scheme keeps the symplectic form. A new scheme is one row.
fn schemes<const N: usize>() -> [(&'static str, Constructor<N>, bool); 6] {
    [
        ("vpd", |tableau| Box::new(Vpd::new(tableau, StopRule::default())), true),
        (
            "vpd_lagrangian",
            |tableau| Box::new(VpdLagrangian::new(tableau, StopRule::default())),
            true,
        ),
        ("vrkmk", |tableau| Box::new(vrkmk(tableau)), true),
        ("vrkmk, T cut short", |tableau| Box::new(vrkmk(tableau).truncated(1)), true),
        ("rkmk", |_| Box::new(Rkmk::new(Tableau::rk4()).expect("explicit")), false),
        (
            "classical",
            |_| {
                let (attitude, momentum) = (Mat::identity(), Mat::zeros());
                Box::new(Classical(State { attitude, momentum }))
            },
            false,
        ),
    ]
}

/// Holds every scheme against its row of the table, with several tableaux.
pub(crate) fn check_symplecticity<const N: usize>(
    body: &RigidBody<N>,
    start: &State<N>,
    h: f64,
    e: f64,
) {
    for (name, constructor, symplectic) in schemes::<N>() {
        for tableau in [gauss(1), Tableau::rk3(), gauss(2), gauss(3), Tableau::rk4()] {
            let stages = tableau.stages();
            let mut stepper = constructor(tableau);
            let defect = symplectic_defect(stepper.as_mut(), body, start, h, e);
            println!("n = {N}, {name}, {stages} stages: {defect:.1e}");
            if symplectic {
                assert!(defect <= 1e-9, "n = {N}, {name}, {stages} stages: {defect:e}");
            } else {
                assert!(defect > 1e-6, "n = {N}, {name}, {stages} stages: {defect:e}");
            }
        }
    }
}

#[test]
fn variational_steps_keep_the_symplectic_form() {
    let (body3, _) = dipole();
    let attitude = so::exp(&so::hat::<3>(&[0.3, -0.5, 0.7]));
    let momentum = so::conjugate(&attitude.transpose(), &so::hat(&[0.4, -0.2, 0.1]));
    check_symplecticity(&body3, &State { attitude, momentum }, 1.0 / 26.0, 2e-3);
    let mut numbers = Numbers(33);
    let body4 = body::<4>(&mut numbers);
    let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * 4.0 };
    check_symplecticity(&body4, &start, 0.2, 1e-2);
}
