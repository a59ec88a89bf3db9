//! Every method from one table: measured order, reversibility, failed steps; and the long runs of the comparison methods.

use std::time::Instant;

use vpd_solve::failure::FailureCode;
use vpd_solve::hamiltonian::{
    DrivenTerm, Factor, Interpolation, Kinetic, Law, Path, RigidBody, Table, Term, TimeScale,
    Torque,
};
use vpd_solve::nonlinear::{Rung, StopRule};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::explicit_so3::ExplicitSo3;
use vpd_solve::stepper::lgvi::Lgvi;
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::splitting::Splitting;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_adaptive::VpdAdaptive;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;

use crate::given::{Numbers, dipole, distance, reference};
use crate::laws::{advance, body};
use crate::verification::trend;

/// Makes a fresh stepper.
pub(crate) type Make<const N: usize> = Box<dyn Fn() -> Box<dyn Stepper<N>>>;

/// A method: its steppers in each dimension, and the results expected.
pub(crate) struct Method {
    pub(crate) name: &'static str,
    pub(crate) order: f64,
    pub(crate) three: Make<3>,
    /// n = 4 and 5, where the method runs there.
    pub(crate) beyond: Option<(Make<4>, Make<5>)>,
    /// Numbers of steps between which the order is measured: the dipole, half a second; and a body with one
    /// term of each kind, one second. The same number twice: too accurate for a slope, the error alone counts.
    steps: [[usize; 2]; 2],
    /// Is a step of -h the inverse of a step of h?
    pub(crate) symmetric: bool,
    /// Is the method for free bodies only?
    free: bool,
    /// The largest orthogonality error of the attitude after the runs for the order, times 1e-16;
    /// `None` where it leaves the group.
    on_group: Option<f64>,
    /// Deviation allowed of its slope from its order above round-off.
    pub(crate) slope: f64,
}

impl Method {
    fn new(name: &'static str, order: u32, steps: [[usize; 2]; 2], three: Make<3>) -> Self {
        Self {
            name,
            order: f64::from(order),
            three,
            beyond: None,
            steps,
            symmetric: false,
            free: false,
            on_group: Some(10.0),
            slope: 0.1,
        }
    }

    fn symmetric(self) -> Self {
        Self { symmetric: true, ..self }
    }

    fn for_free_bodies(self) -> Self {
        Self { free: true, ..self }
    }

    fn drifts_off_the_group_by_round_off(self) -> Self {
        Self { on_group: Some(300.0), ..self }
    }

    /// Can it run systems that change with time or are pushed?
    pub(crate) fn can_be_driven(&self) -> bool {
        self.beyond.is_some() && !self.free && !self.name.starts_with("vpd_adaptive")
    }

    /// Does it come from a variational principle?
    pub(crate) fn is_variational(&self) -> bool {
        self.name.starts_with('v')
    }

    /// The eighth order of twelve stages meets round-off before its slope is straight.
    fn nearly_straight(self) -> Self {
        Self { slope: 0.4, ..self }
    }

    fn leaves_the_group(self) -> Self {
        Self { on_group: None, ..self }
    }
}

/// A method for any n; the constructor is written once.
macro_rules! any_n {
    ($name:expr, $order:expr, $steps:expr, $make:expr) => {
        Method {
            beyond: Some((Box::new(|| Box::new($make)), Box::new(|| Box::new($make)))),
            ..Method::new($name, $order, $steps, Box::new(|| Box::new($make)))
        }
    };
}

/// An explicit method for any n, for n = 3 in vectors.
macro_rules! vectors {
    ($name:expr, $order:expr, $steps:expr, $make:expr, $three:expr) => {
        Method {
            three: Box::new(|| Box::new($three.expect("explicit"))),
            ..any_n!($name, $order, $steps, $make.expect("explicit"))
        }
    };
}

/// VPD, for n = 3 in lanes.
macro_rules! lanes {
    ($name:expr, $order:expr, $steps:expr, $tableau:expr) => {{
        let three = || VpdSo3::new($tableau, to_round_off()).expect("8 stages at most");
        Method {
            beyond: Some((
                Box::new(|| Box::new(Vpd::new($tableau, to_round_off()))),
                Box::new(|| Box::new(Vpd::new($tableau, to_round_off()))),
            )),
            ..Method::new($name, $order, $steps, Box::new(move || Box::new(three())))
        }
    }};
}

/// A method for n = 3.
macro_rules! three {
    ($name:expr, $order:expr, $steps:expr, $make:expr) => {
        Method::new($name, $order, $steps, Box::new(|| Box::new($make)))
    };
}

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

/// Own steps as long as those of the time loop, and every point source within a metre.
fn adaptive<const N: usize>(stages: usize) -> VpdAdaptive<N> {
    VpdAdaptive::new(gauss(stages), to_round_off(), TimeScale::new(vec![1.0; 8]))
}

fn to_round_off() -> StopRule {
    StopRule::default()
}

/// The table. A new method is one row.
#[rustfmt::skip]
pub(crate) fn methods() -> Vec<Method> {
    vec![
        lanes!("vpd gauss 1", 2, [[32, 256], [10, 80]], gauss(1)).symmetric(),
        lanes!("vpd gauss 2", 4, [[8, 128], [10, 40]], gauss(2)),
        lanes!("vpd gauss 3", 6, [[4, 16], [6, 24]], gauss(3)),
        lanes!("vpd gauss 4", 8, [[2, 8], [6, 12]], gauss(4)),
        lanes!("vpd gauss 5", 10, [[2, 4], [4, 7]], gauss(5)),
        any_n!("vpd rk3", 3, [[32, 256], [20, 160]], Vpd::new(Tableau::rk3(), to_round_off())),
        any_n!("vpd rk4", 4, [[64, 512], [20, 80]], Vpd::new(Tableau::rk4(), to_round_off())),
        any_n!("vpd_lagrangian gauss 1", 2, [[32, 256], [10, 80]], VpdLagrangian::new(gauss(1), to_round_off())).symmetric(),
        any_n!("vpd_lagrangian gauss 2", 4, [[8, 128], [10, 40]], VpdLagrangian::new(gauss(2), to_round_off())),
        any_n!("vpd_lagrangian rk3", 3, [[32, 256], [20, 160]], VpdLagrangian::new(Tableau::rk3(), to_round_off())),
        any_n!("vpd_lagrangian gauss 3", 6, [[4, 16], [6, 24]], VpdLagrangian::new(gauss(3), to_round_off())),
        any_n!("vpd_adaptive gauss 1", 2, [[64, 512], [10, 80]], adaptive(1)),
        any_n!("vpd_adaptive gauss 2", 4, [[32, 256], [20, 80]], adaptive(2)),
        any_n!("vpd_adaptive gauss 3", 6, [[8, 32], [12, 36]], adaptive(3)).nearly_straight(),
        any_n!("vpd_reduced gauss 1", 2, [[0, 0], [20, 160]], VpdReduced::new(gauss(1), to_round_off(), true)).for_free_bodies(),
        any_n!("vpd_reduced gauss 2", 4, [[0, 0], [10, 40]], VpdReduced::new(gauss(2), to_round_off(), true)).for_free_bodies(),
        any_n!("vpd_reduced rk3", 3, [[0, 0], [320, 1280]], VpdReduced::new(Tableau::rk3(), to_round_off(), true)).for_free_bodies(),
        any_n!("vpd_reduced gauss 3", 6, [[0, 0], [6, 24]], VpdReduced::new(gauss(3), to_round_off(), true)).for_free_bodies(),
        any_n!("vrkmk gauss 1", 2, [[32, 256], [10, 80]], Vrkmk::new(gauss(1), to_round_off())).symmetric()
            .drifts_off_the_group_by_round_off(),
        any_n!("vrkmk rk3", 3, [[64, 512], [40, 320]], Vrkmk::new(Tableau::rk3(), to_round_off()))
            .drifts_off_the_group_by_round_off(),
        any_n!("vrkmk gauss 2", 4, [[8, 128], [10, 40]], Vrkmk::new(gauss(2), to_round_off()))
            .drifts_off_the_group_by_round_off(),
        any_n!("vrkmk gauss 3", 6, [[8, 16], [6, 24]], Vrkmk::new(gauss(3), to_round_off()))
            .drifts_off_the_group_by_round_off(),
        any_n!("vrkmk_projected gauss 2", 4, [[8, 128], [10, 40]], Vrkmk::new(gauss(2), to_round_off()).projected()),
        vectors!("rkmk rk3", 3, [[64, 512], [40, 320]], Rkmk::new(Tableau::rk3()), ExplicitSo3::rkmk(Tableau::rk3())),
        vectors!("rkmk rk4", 4, [[64, 512], [40, 320]], Rkmk::new(Tableau::rk4()), ExplicitSo3::rkmk(Tableau::rk4())),
        vectors!("rk rk3", 3, [[64, 512], [40, 320]], Rk::new(Tableau::rk3(), false), ExplicitSo3::rk(Tableau::rk3(), false))
            .leaves_the_group(),
        vectors!("rk rk4", 4, [[64, 512], [40, 320]], Rk::new(Tableau::rk4(), false), ExplicitSo3::rk(Tableau::rk4(), false))
            .leaves_the_group(),
        vectors!("rk_projected rk3", 3, [[64, 512], [40, 320]], Rk::new(Tableau::rk3(), true), ExplicitSo3::rk(Tableau::rk3(), true)),
        vectors!("rk_projected rk4", 4, [[64, 512], [40, 320]], Rk::new(Tableau::rk4(), true), ExplicitSo3::rk(Tableau::rk4(), true)),
        vectors!("rkmk rk8", 8, [[4, 8], [10, 10]], Rkmk::new(Tableau::rk8()), ExplicitSo3::rkmk(Tableau::rk8())).nearly_straight(),
        vectors!("rk rk8", 8, [[6, 11], [10, 10]], Rk::new(Tableau::rk8(), false), ExplicitSo3::rk(Tableau::rk8(), false))
            .nearly_straight()
            .leaves_the_group(),
        vectors!("rk_projected rk8", 8, [[6, 11], [10, 10]], Rk::new(Tableau::rk8(), true), ExplicitSo3::rk(Tableau::rk8(), true)).nearly_straight(),
        three!("splitting 2", 2, [[32, 256], [20, 160]], ExplicitSo3::splitting(2).expect("even")).symmetric(),
        three!("splitting 4", 4, [[16, 128], [20, 80]], ExplicitSo3::splitting(4).expect("even")).symmetric(),
        three!("splitting 6", 6, [[8, 32], [8, 32]], ExplicitSo3::splitting(6).expect("even")).symmetric(),
        three!("splitting 8", 8, [[4, 8], [8, 12]], ExplicitSo3::splitting(8).expect("even")).symmetric(),
        three!("lgvi 2", 2, [[32, 256], [20, 160]], Lgvi::new(2, to_round_off()).expect("even")).symmetric(),
        three!("lgvi 4", 4, [[16, 128], [20, 80]], Lgvi::new(4, to_round_off()).expect("even")).symmetric(),
        three!("lgvi 6", 6, [[8, 32], [8, 32]], Lgvi::new(6, to_round_off()).expect("even")).symmetric(),
        three!("lgvi 8", 8, [[4, 8], [10, 16]], Lgvi::new(8, to_round_off()).expect("even")).symmetric(),
        three!("quaternion_gauss 1", 2, [[32, 256], [20, 160]], QuaternionGauss::new(1, to_round_off()).expect("1 to 8")).symmetric(),
        three!("quaternion_gauss 2", 4, [[8, 128], [10, 40]], QuaternionGauss::new(2, to_round_off()).expect("1 to 8")).symmetric(),
        three!("quaternion_gauss 3", 6, [[4, 16], [4, 16]], QuaternionGauss::new(3, to_round_off()).expect("1 to 8")).symmetric(),
        three!("quaternion_gauss 4", 8, [[2, 8], [3, 9]], QuaternionGauss::new(4, to_round_off()).expect("1 to 8")).symmetric(),
        three!("quaternion_gauss 5", 10, [[2, 2], [3, 5]], QuaternionGauss::new(5, to_round_off()).expect("1 to 8")).symmetric(),
        three!("quaternion_gauss 8", 16, [[1, 1], [2, 2]], QuaternionGauss::new(8, to_round_off()).expect("1 to 8")).symmetric(),
    ]
}

/// Hamilton's equations as plain matrices by Gragg's extrapolated midpoint rule (Hairer, Norsett, Wanner,
/// Solving ODEs I, II.9): explicit, of order 16, and nothing in common with any method of the table.
fn extrapolated<const N: usize>(body: &RigidBody<N>, start: &State<N>, span: f64) -> State<N> {
    const BIG_STEPS: usize = 50;
    let mut seen = Vec::new();
    body.seen_from(&Mat::identity(), &mut seen);
    let rate = |(g, mu): &(Mat<N>, Mat<N>)| {
        let omega = body.velocity(mu);
        (g * omega, mu * omega - omega * mu - body.gradient_seen(g, &seen))
    };
    let add = |a: &(Mat<N>, Mat<N>), b: &(Mat<N>, Mat<N>), t: f64| (a.0 + b.0 * t, a.1 + b.1 * t);
    let big = span / BIG_STEPS as f64;
    let mut at = (start.attitude, start.momentum);
    for _ in 0..BIG_STEPS {
        // Changes since the start of the big step: rounding is relative to them.
        let mut row: Vec<(Mat<N>, Mat<N>)> = Vec::new();
        for k in 1..=8_usize {
            let parts = 2 * k;
            let h = big / parts as f64;
            let nothing = (Mat::zeros(), Mat::zeros());
            let mut before = nothing;
            let mut now = add(&nothing, &rate(&at), h);
            for _ in 1..parts {
                let next = add(&before, &rate(&add(&at, &now, 1.0)), 2.0 * h);
                (before, now) = (now, next);
            }
            // Aitken and Neville in h^2.
            let mut next = vec![now];
            for (j, old) in row.iter().enumerate() {
                let ratio = (k as f64 / (k - j - 1) as f64).powi(2);
                let change = add(&next[j], old, -1.0);
                next.push(add(&next[j], &change, 1.0 / (ratio - 1.0)));
            }
            row = next;
        }
        at = add(&at, &row[row.len() - 1], 1.0);
    }
    State { attitude: at.0, momentum: at.1 }
}

/// Error after `span` in `steps` equal steps, and the orthogonality error there.
fn measure<const N: usize>(
    make: &Make<N>,
    body: &RigidBody<N>,
    start: &State<N>,
    reference: &State<N>,
    span: f64,
    steps: usize,
) -> (f64, f64) {
    let end = advance(make().as_mut(), body, start, &vec![span / steps as f64; steps]);
    let error =
        (end.attitude - reference.attitude).norm() + (end.momentum - reference.momentum).norm();
    (error, so::orthogonality_error(&end.attitude))
}

fn assert_order<const N: usize>(
    method: &Method,
    make: &Make<N>,
    (body, start, reference): (&RigidBody<N>, &State<N>, &State<N>),
    span: f64,
    [coarse, fine]: [usize; 2],
) {
    let name = method.name;
    let ((large, _), (small, orthogonality)) = (
        measure(make, body, start, reference, span, coarse),
        measure(make, body, start, reference, span, fine),
    );
    if let Some(bound) = method.on_group {
        assert!(orthogonality <= bound * 1e-16, "{name}, n = {N}: {orthogonality:e}");
    }
    if coarse == fine {
        println!("{name}, n = {N}: error {large:.2e} in {coarse} steps");
        assert!(large <= 1e-9, "{name}, n = {N}: {large:e}");
        return;
    }
    let order = (large / small).ln() / (fine as f64 / coarse as f64).ln();
    println!("{name}, n = {N}: order {order:.3}, errors {large:.2e} {small:.2e}");
    assert!((order - method.order).abs() <= method.slope, "{name}, n = {N}: order {order}");
}

#[test]
fn the_extrapolated_reference_meets_the_digits() {
    let (body, start) = dipole();
    let error = distance(&extrapolated(&body, &start, 0.5), &reference());
    assert!(error < 4e-15, "{error:e}");
}

#[test]
fn orders_on_the_dipole() {
    let (body, start) = dipole();
    let reference = reference();
    for method in methods().into_iter().filter(|method| !method.free) {
        assert_eq!(f64::from((method.three)().order()), method.order, "{}", method.name);
        let scene = (&body, &start, &reference);
        assert_order(&method, &method.three, scene, 0.5, method.steps[0]);
    }
}

#[test]
fn orders_in_three_four_and_five_dimensions() {
    fn scene<const N: usize>(free: bool) -> (RigidBody<N>, State<N>, State<N>) {
        let mut numbers = Numbers(21);
        let (body, vigour) = if free {
            let weight = |i, j| if i == j { 0.0 } else { 1.0 / (0.2 + 0.9 * (i + j) as f64) };
            let kinetic = Kinetic::Principal { weights: Mat::from_fn(weight) };
            (RigidBody::new(kinetic, Vec::new(), 0.0), 3.0)
        } else {
            (body::<N>(&mut numbers), 1.0)
        };
        let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * vigour };
        let reference = extrapolated(&body, &start, 1.0);
        (body, start, reference)
    }
    let scenes = [false, true].map(|free| (scene::<3>(free), scene::<4>(free), scene::<5>(free)));
    for method in methods() {
        let (three, four, five) = &scenes[usize::from(method.free)];
        let steps = method.steps[1];
        assert_order(&method, &method.three, (&three.0, &three.1, &three.2), 1.0, steps);
        if let Some((make4, make5)) = &method.beyond {
            assert_order(&method, make4, (&four.0, &four.1, &four.2), 1.0, steps);
            assert_order(&method, make5, (&five.0, &five.1, &five.2), 1.0, steps);
        }
    }
}

#[test]
fn symmetric_methods_go_back_the_way_they_came() {
    let (body, start) = dipole();
    for method in methods().into_iter().filter(|method| !method.free) {
        let path: Vec<f64> = [0.02; 10].into_iter().chain([-0.02; 10]).collect();
        let end = advance((method.three)().as_mut(), &body, &start, &path);
        let defect = distance(&end, &start);
        let forth_and_back = advance((method.three)().as_mut(), &body, &start, &[0.05, -0.05]);
        let at_large = distance(&forth_and_back, &start);
        println!("{}: {defect:.2e}; one step of 0.05 s and back: {at_large:.2e}", method.name);
        if method.symmetric {
            assert!(defect < 3e-14, "{}: {defect:e}", method.name);
        }
    }
}

#[test]
fn failed_steps_leave_the_state_alone() {
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 });
    let at_the_charge = Vector::<3>::new(0.0, 0.0, 1.0);
    let charge = Term {
        law: Law::PointSource { strength: 1.0, body_point: at_the_charge },
        space: at_the_charge,
    };
    let met = RigidBody::<3>::new(Kinetic::Principal { weights }, vec![charge.clone()], 0.0);
    let free = RigidBody::<3>::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
    let plane = [at_the_charge, Vector::<3>::new(1.0, 0.0, 0.0)];
    let moving = free.clone().with_driven_term(DrivenTerm {
        term: charge,
        path: Path::Turning { plane, rate: 1.0 },
        factor: Factor::Constant,
    });
    // Known until the middle of the step.
    let table = Table::new(vec![-1.0, 0.02], vec![[1.0], [2.0]], Interpolation::Linear);
    let late = free.clone().with_torque(Torque::Table {
        along: so::hat(&[0.0, 0.0, 1.0]),
        spatial: true,
        table,
    });
    let law = Law::GravityGradient { strength: 1.0, matrix: Mat::from_diagonal_element(1.0) };
    let open = free.clone().with_driven_term(DrivenTerm {
        term: Term { law, space: at_the_charge },
        path: Path::Orbit {
            across: plane[1],
            mean_motion: 1.0,
            eccentricity: 1.0,
            mean_anomaly: 0.5,
            node_rate: 0.0,
        },
        factor: Factor::Constant,
    });
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, -0.2, 0.5]) };
    let huge = State { attitude: Mat::identity(), momentum: so::hat(&[1e200, -1e200, 1e200]) };
    for method in methods() {
        let cases = [("a charge met", &met, &start, 0.0), ("overflow", &free, &huge, 1e120)];
        let driven = [
            ("a moving charge met", &moving, &start, 0.0),
            ("a table read outside", &late, &start, 0.1),
            ("an open orbit", &open, &start, 0.1),
        ];
        let cases = cases.into_iter().chain(driven.into_iter().filter(|_| method.can_be_driven()));
        for (what, body, start, h) in cases {
            if method.free && !body.is_free() {
                continue;
            }
            let mut stepper = (method.three)();
            stepper.start(start);
            let before = (stepper.attitude(), stepper.momentum());
            let failure = stepper.step(body, h).expect_err(method.name);
            assert_eq!((stepper.attitude(), stepper.momentum()), before, "{}", method.name);
            println!("{}, {what}: {}", method.name, failure.code);
            match what {
                "a table read outside" => assert_eq!(failure.code, FailureCode::OutsideTable),
                "an open orbit" => assert_eq!(failure.code, FailureCode::OpenOrbit),
                _ => {}
            }
        }
    }
}

#[test]
fn implicit_tableaux_are_no_explicit_methods() {
    assert!(Rkmk::<3>::new(gauss(2)).is_none());
    assert!(Rk::<4>::new(gauss(1), true).is_none());
    assert!(Splitting::new(5).is_none());
    assert!(Lgvi::new(0, to_round_off()).is_none());
    assert!(QuaternionGauss::new(9, to_round_off()).is_none());
}

#[test]
fn an_inertia_tensor_is_a_turned_frame_for_the_other_methods_too() {
    // The same body in principal axes and in axes turned by r: g' = g r, mu' = r^T mu r.
    let moments = [2.0, 1.5, 0.7];
    let mut numbers = Numbers(22);
    let (r, g) = (numbers.rotation::<3>(), numbers.rotation::<3>());
    let (mu, y, v) = (numbers.skew::<3>(), numbers.vector::<3>(), numbers.vector::<3>());
    let field = |body_point| vec![Term { law: Law::Uniform { weight: 2.0, body_point }, space: v }];
    let principal = RigidBody::new(Kinetic::of_moments(moments), field(y), 0.0);
    let tensor = |moments| r.transpose() * Mat::<3>::from_diagonal(&Vector::<3>::from(moments)) * r;
    let (inertia, inverse) = (tensor(moments), tensor(moments.map(|j: f64| 1.0 / j)));
    let turned =
        RigidBody::new(Kinetic::Tensor { inertia, inverse }, field(r.transpose() * y), 0.0);
    for method in methods() {
        let steps = [0.05; 40];
        let start = State { attitude: g, momentum: mu };
        let a = advance((method.three)().as_mut(), &principal, &start, &steps);
        let start = State { attitude: g * r, momentum: r.transpose() * mu * r };
        let b = advance((method.three)().as_mut(), &turned, &start, &steps);
        let defect = (a.attitude * r - b.attitude)
            .amax()
            .max((r.transpose() * a.momentum * r - b.momentum).amax());
        println!("{}: {defect:.1e}", method.name);
        assert!(defect < 1e-13, "{}: {defect:e}", method.name);
    }
}

/// The energy errors of 1e5 steps of the dipole and the largest orthogonality error of every hundredth.
struct LongRun {
    energy: Vec<f64>,
    orthogonality: f64,
}

fn long_run(name: &str, stepper: &mut dyn Stepper<3>, h: f64) -> LongRun {
    const STEPS: usize = 100_000;
    let (body, start) = dipole();
    let initial = body.energy(&start.attitude, &start.momentum).total();
    let mut run = LongRun { energy: Vec::with_capacity(STEPS), orthogonality: 0.0 };
    stepper.start(&start);
    let mut iterations = 0;
    let begun = Instant::now();
    for step in 0..STEPS {
        let solved = stepper.step(&body, h);
        iterations += solved.unwrap_or_else(|failure| panic!("{name}: {failure:?}")).iterations;
        let g = stepper.attitude().expect("carried");
        run.energy.push(body.energy(&g, &stepper.momentum()).total() - initial);
        if step % 100 == 99 {
            run.orthogonality = run.orthogonality.max(so::orthogonality_error(&g));
        }
    }
    let per_step = begun.elapsed().as_nanos() / STEPS as u128;
    let (slope, deviation) = trend(&run.energy);
    println!(
        "{name} h {h:.4}: energy {:.2e}, trend {slope:.1e} +- {deviation:.1e}, orthogonality {:.1e}, iterations {:.2}, {per_step} ns a step with its energy",
        run.worst(),
        run.orthogonality,
        f64::from(iterations) / STEPS as f64,
    );
    run
}

impl LongRun {
    fn worst(&self) -> f64 {
        self.energy.iter().fold(0.0, |max, e| max.max(e.abs()))
    }

    /// Does the energy have a trend beyond chance?
    fn drifts(&self) -> bool {
        let (slope, deviation) = trend(&self.energy);
        slope.abs() > 3.0 * deviation
    }
}

#[test]
fn the_other_methods_reach_their_energy_figures() {
    let stop = to_round_off();
    let runs: [(&str, Box<dyn Stepper<3>>, f64, f64); 4] = [
        ("splitting 4", Box::new(ExplicitSo3::splitting(4).expect("even")), 0.01, 2.4e-10),
        ("lgvi 4", Box::new(Lgvi::new(4, stop).expect("even")), 0.01, 2.0e-9),
        (
            "quaternion_gauss 4",
            Box::new(QuaternionGauss::new(4, stop).expect("1 to 8")),
            1.0 / 26.0,
            1.5e-14,
        ),
        (
            "quaternion_gauss 8",
            Box::new(QuaternionGauss::new(8, stop).expect("1 to 8")),
            0.2,
            2.5e-13,
        ),
    ];
    for (name, mut stepper, h, figure) in runs {
        let run = long_run(name, stepper.as_mut(), h);
        assert!(run.worst() <= 2.0 * figure, "{name}: {:e}", run.worst());
        // Round-off walks, and a walk has a trend of its own; of the 8 stages nothing else is left.
        let (slope, _) = trend(&run.energy);
        let change = slope.abs() * 50.0;
        let walk = 2e-16 * (50.0 / h).sqrt();
        assert!(name.ends_with('8') || change <= 0.2 * run.worst() + walk, "{name}: {change:e}");
        assert!(run.orthogonality <= 2e-15, "{name}: {:e}", run.orthogonality);
    }
}

#[test]
fn explicit_methods_leave_the_group_or_drift_where_vpd_does_neither() {
    let rk4 = Tableau::rk4;
    let h = 0.01;
    let mut vpd = Vpd::new(gauss(2), to_round_off());
    let ours = long_run("vpd gauss 2", &mut vpd, h);
    assert!(!ours.drifts() && ours.orthogonality <= 2e-15);
    let mut rkmk = ExplicitSo3::rkmk(rk4()).expect("explicit");
    let run = long_run("rkmk rk4", &mut rkmk, h);
    assert!(run.drifts() && run.orthogonality <= 2e-15);
    let mut rk = ExplicitSo3::rk(rk4(), false).expect("explicit");
    let run = long_run("rk rk4", &mut rk, h);
    assert!(run.drifts() && run.orthogonality > 1e-9);
    let mut projected = ExplicitSo3::rk(rk4(), true).expect("explicit");
    let run = long_run("rk_projected rk4", &mut projected, h);
    assert!(run.drifts() && run.orthogonality <= 2e-15);
}

#[test]
fn steppers_say_how_they_solved_the_step() {
    let (body, start) = dipole();
    for method in methods() {
        let mut stepper = (method.three)();
        stepper.start(&start);
        let solved = stepper.step(&body, 0.01).expect("a small step");
        let explicit = ["rk", "splitting"].iter().any(|name| method.name.starts_with(name));
        // The first guess of many stages leaves one sweep to do at a small step.
        stepper.start(&start);
        let larger = stepper.step(&body, 0.05).expect("not too large a step");
        let most = solved.iterations.max(larger.iterations);
        assert!((most == 1) == explicit, "{}", method.name);
        let rung = match method.name {
            _ if explicit => Rung::Explicit,
            name if name.starts_with("lgvi") => Rung::Newton,
            _ => Rung::FixedPoint,
        };
        assert_eq!(solved.rung, rung, "{}", method.name);
    }
}
