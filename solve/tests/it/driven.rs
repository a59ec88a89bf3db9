//! Scenes that change with time, are pushed, or have wheels: orders, balances, exact motions.

use vpd_solve::hamiltonian::{
    DrivenTerm, Factor, Kinetic, Law, Path, RigidBody, Table, Term, Torque,
};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::system::System;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::State;

use crate::given::Numbers;
use crate::vrkmk::symplectic_defect;

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn axis<const N: usize>(k: usize) -> Vector<N> {
    Vector::from_fn(|i, _| f64::from(u8::from(i == k)))
}

fn plain<const N: usize>() -> RigidBody<N> {
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (2.0 + 0.2 * (i + j) as f64) });
    RigidBody::new(Kinetic::Principal { weights }, Vec::new(), 0.3)
}

/// Every path, every factor, every law.
fn changing<const N: usize>() -> RigidBody<N> {
    let mut numbers = Numbers(31);
    let matrix = so::symmetric_part(&numbers.matrix());
    let turning = Path::Turning { plane: [axis(0), axis(1)], rate: 1.3 };
    let orbit = |eccentricity| Path::Orbit {
        across: axis(1),
        mean_motion: 0.9,
        eccentricity,
        mean_anomaly: 0.4,
    };
    // One cubic over the run: where two meet the order is at most four.
    let times = vec![-0.5, 0.0, 1.0, 1.5];
    let table = Table { times, values: vec![[1.0], [0.4], [1.2], [0.9]], smooth: true };
    let harmonic = Factor::Harmonic { mean: 1.0, amplitude: 0.3, rate: 2.1, phase: 0.5 };
    let driven = |law, space, path, factor| DrivenTerm { term: Term { law, space }, path, factor };
    let terms = [
        driven(
            Law::GravityGradient { strength: 0.8, matrix },
            axis(0),
            orbit(0.3),
            Factor::Constant,
        ),
        driven(
            Law::Uniform { weight: 0.7, body_point: numbers.vector() },
            numbers.vector(),
            turning,
            harmonic.clone(),
        ),
        driven(
            Law::Spring { stiffness: 0.6, rest_length: 0.5, body_point: numbers.vector() },
            axis(0) * 2.5,
            orbit(0.2),
            harmonic,
        ),
        driven(
            Law::PointSource { strength: 0.5, body_point: numbers.vector() },
            axis(0) * 3.0,
            orbit(0.1),
            Factor::Constant,
        ),
        driven(
            Law::Uniform { weight: 0.4, body_point: numbers.vector() },
            numbers.vector(),
            Path::Fixed,
            Factor::Table(table),
        ),
    ];
    terms.into_iter().fold(plain(), RigidBody::with_driven_term)
}

/// Every torque, in a potential.
fn pushed<const N: usize>() -> RigidBody<N> {
    let mut numbers = Numbers(32);
    let weight = Law::Uniform { weight: 0.7, body_point: numbers.vector() };
    // Straight: a corner within the run would cost the order.
    let table = Table { times: vec![-0.1, 2.0], values: vec![[0.1], [0.5]], smooth: false };
    let coefficients = Mat::from_fn(|i, j| if i == j { 0.0 } else { 0.1 + 0.02 * (i + j) as f64 });
    let torques = [
        Torque::Body(numbers.skew() * 0.4),
        Torque::Space(numbers.skew() * 0.4),
        Torque::Viscous(coefficients),
        Torque::OfMomentum(0.05),
        Torque::Table { along: numbers.skew(), in_space: true, table },
    ];
    let weight = DrivenTerm {
        term: Term { law: weight, space: axis(0) },
        path: Path::Fixed,
        factor: Factor::Constant,
    };
    torques.into_iter().fold(plain().with_driven_term(weight), RigidBody::with_torque)
}

fn with_wheels<const N: usize>() -> RigidBody<N> {
    let mut numbers = Numbers(33);
    let weight = DrivenTerm {
        term: Term {
            law: Law::Uniform { weight: 0.7, body_point: numbers.vector() },
            space: axis(0),
        },
        path: Path::Fixed,
        factor: Factor::Constant,
    };
    plain().with_driven_term(weight).with_wheels(numbers.skew())
}

fn start<const N: usize>() -> State<N> {
    let mut numbers = Numbers(34);
    State { attitude: numbers.rotation(), momentum: numbers.skew() * 2.0 }
}

/// The state after one second, and by how much the energy changed less what was put in.
fn after<const N: usize>(
    stepper: &mut dyn Stepper<N>,
    body: &RigidBody<N>,
    steps: u32,
) -> (State<N>, f64) {
    let (h, start) = (1.0 / f64::from(steps), start());
    stepper.start(&start);
    for k in 0..steps {
        stepper.set_time(f64::from(k) * h);
        stepper.step(body, h).expect("a small step");
    }
    let (attitude, momentum) = (stepper.attitude().expect("carried"), stepper.momentum());
    let energy = |t, state: &State<N>| body.energy_at(t, &state.attitude, &state.momentum).total();
    let end = State { attitude, momentum };
    let balance = energy(1.0, &end) - energy(0.0, &start) - stepper.work();
    (end, balance)
}

fn distance<const N: usize>(a: &State<N>, b: &State<N>) -> f64 {
    (a.attitude - b.attitude).amax().max((a.momentum - b.momentum).amax())
}

/// All that can run such scenes, with the orders that they have.
fn methods<const N: usize>() -> Vec<(&'static str, Box<dyn Stepper<N>>, f64)> {
    let mut all: Vec<(&'static str, Box<dyn Stepper<N>>, f64)> = Vec::new();
    for stages in 1..=4 {
        let order = 2.0 * stages as f64;
        all.push(("vpd", Box::new(Vpd::new(gauss(stages), StopRule::default())), order));
        let lagrangian = VpdLagrangian::new(gauss(stages), StopRule::default());
        all.push(("vpd_lagrangian", Box::new(lagrangian), order));
        all.push(("vrkmk", Box::new(Vrkmk::new(gauss(stages), StopRule::default())), order));
    }
    all.push(("vpd rk3", Box::new(Vpd::new(Tableau::rk3(), StopRule::default())), 3.0));
    all.push(("rk4", Box::new(Rk::new(Tableau::rk4(), true).expect("explicit")), 4.0));
    all.push(("rk8", Box::new(Rk::new(Tableau::rk8(), true).expect("explicit")), 8.0));
    all.push(("rkmk rk4", Box::new(Rkmk::new(Tableau::rk4()).expect("explicit")), 4.0));
    all
}

#[test]
fn orders_of_state_and_balance() {
    fn law<const N: usize>(name: &str, body: &RigidBody<N>) {
        let (truth, off) = after(&mut Vpd::new(gauss(8), StopRule::default()), body, 20);
        assert!(off.abs() < 3e-14, "{name}, n = {N}: {off:e}");
        let explicit = after(&mut Rk::new(Tableau::rk8(), true).expect("explicit"), body, 400).0;
        let apart = distance(&truth, &explicit);
        assert!(apart < 3e-13, "{name}, n = {N}: {apart:e} from an explicit method");
        for (method, mut stepper, order) in methods::<N>() {
            let coarse = if order < 5.0 { 16 } else { 6 };
            let [(a, work_a), (b, work_b)] =
                [coarse, 2 * coarse].map(|steps| after(stepper.as_mut(), body, steps));
            let (a, b) = (distance(&a, &truth), distance(&b, &truth));
            let state = (a / b).log2();
            let work = (work_a / work_b).abs().log2();
            println!(
                "{name}, n = {N}: {method} of order {order}: {state:.2}, balance {work:.2} ({b:.1e}, {work_b:.1e})"
            );
            // Where rounding does not hide it.
            if b > 1e-12 {
                assert!(state > order - 0.12, "{name}, n = {N}, {method}: {state}");
            }
            // The balance of explicit methods may be lucky on the coarser steps.
            if work_b.abs() > 1e-12 && !method.contains("rk") {
                assert!(work > order - 0.1, "{name}, n = {N}, {method}: balance {work}");
            }
        }
    }
    law::<3>("changing", &changing());
    law::<4>("changing", &changing());
    law::<3>("pushed", &pushed());
    law::<4>("pushed", &pushed());
    law::<3>("wheels", &with_wheels());
    law::<4>("wheels", &with_wheels());
}

/// A torque `-c mu` slows the free motion down: it is that of `(1 - exp(-c t)) / c`, scaled by `exp(-c t)`.
#[test]
fn a_damped_free_body_follows_its_exact_motion() {
    const C: f64 = 0.1;
    fn law<const N: usize>() {
        let (free, start) = (plain::<N>(), start());
        let damped = free.clone().with_torque(Torque::OfMomentum(C));
        let (end, slowed) = (10.0, (1.0 - (-C * 10.0_f64).exp()) / C);
        let run = |body: &RigidBody<N>, until: f64| {
            let mut stepper = Vpd::new(gauss(6), StopRule::default());
            stepper.start(&start);
            for k in 0..200 {
                let h = until / 200.0;
                stepper.set_time(f64::from(k) * h);
                stepper.step(body, h).expect("a small step");
            }
            (stepper.attitude().expect("carried"), stepper.momentum())
        };
        let (g, mu) = run(&damped, end);
        let (exact_g, free_mu) = run(&free, slowed);
        let exact_mu = free_mu * (-C * end).exp();
        let off = (g - exact_g).amax().max((mu - exact_mu).amax() / start.momentum.amax());
        println!("n = {N}: {off:e}");
        assert!(off <= 1e-13, "n = {N}: {off:e}");
    }
    law::<3>();
    law::<4>();
    law::<5>();
}

/// Where all space vectors turn about one axis at a constant rate w, `H - w . m` is kept: Jacobi.
#[test]
fn the_integral_of_jacobi_is_kept() {
    const RATE: f64 = 0.7;
    let mut numbers = Numbers(41);
    let matrix = so::symmetric_part(&numbers.matrix());
    let turning = || Path::Turning { plane: [axis(0), axis(1)], rate: RATE };
    let gradient = Term { law: Law::GravityGradient { strength: 0.8, matrix }, space: axis(0) };
    let body = plain::<3>().with_driven_term(DrivenTerm {
        term: gradient,
        path: turning(),
        factor: Factor::Constant,
    });
    let (start, h) = (start(), 0.1);
    let mut stepper = Vpd::new(gauss(4), StopRule::default());
    stepper.start(&start);
    let energy = |t, g: &Mat<3>, mu: &Mat<3>| body.energy_at(t, g, mu).total();
    let jacobi = |t: f64, g: &Mat<3>, mu: &Mat<3>| {
        energy(t, g, mu) - RATE * so::vee(&so::conjugate(g, mu))[2]
    };
    let (first, begun) = (
        jacobi(0.0, &start.attitude, &start.momentum),
        energy(0.0, &start.attitude, &start.momentum),
    );
    let (mut off, mut balance, mut swing) = (0.0_f64, 0.0_f64, 0.0_f64);
    for k in 0..20_000_u32 {
        stepper.set_time(f64::from(k) * h);
        stepper.step(&body, h).expect("a small step");
        let t = f64::from(k + 1) * h;
        let (g, mu) = (stepper.attitude().expect("carried"), stepper.momentum());
        off = off.max((jacobi(t, &g, &mu) - first).abs());
        let now = energy(t, &g, &mu);
        balance = balance.max((now - begun - stepper.work()).abs());
        swing = swing.max((now - begun).abs());
    }
    println!("Jacobi {off:e}, balance {balance:e}, energy swings by {swing:e}");
    let frame = body.turning_frame().expect("all turns alike");
    assert!((frame - so::hat(&[0.0, 0.0, RATE])).norm() <= 1e-15, "{frame}");
    // A direction across the axis stands still, another strength changes: there is no such frame.
    let gravity = Law::Uniform { weight: 1.0, body_point: axis(0) };
    let leaning = |space| {
        body.clone().with_driven_term(DrivenTerm {
            term: Term { law: gravity.clone(), space },
            path: Path::Fixed,
            factor: Factor::Constant,
        })
    };
    assert_eq!(leaning(axis(1)).turning_frame(), None);
    let factor = Factor::Harmonic { mean: 1.0, amplitude: 0.1, rate: 1.0, phase: 0.0 };
    let term = Term { law: gravity.clone(), space: axis(0) };
    let pulsing = body.clone().with_driven_term(DrivenTerm { term, path: turning(), factor });
    assert_eq!(pulsing.turning_frame(), None);
    assert!(swing > 1e-2, "{swing:e}");
    assert!(off <= 1e-9, "{off:e}");
    assert!(balance <= 1e-9, "{balance:e}");
}

/// The reduced form of a free body with wheels keeps |mu|, and is the full form.
#[test]
fn a_free_gyrostat_keeps_its_orbit() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(51);
        let body = plain::<N>().with_wheels(numbers.skew());
        let start = start();
        let mut full = Vpd::new(gauss(2), StopRule::default());
        let mut reduced = VpdReduced::new(gauss(2), StopRule::default(), true);
        full.start(&start);
        reduced.start(&start);
        for _ in 0..10_000 {
            full.step(&body, 0.05).expect("a small step");
            reduced.step(&body, 0.05).expect("a small step");
        }
        let size = |mu: &Mat<N>| so::inner(mu, mu).sqrt();
        let kept = (size(&reduced.momentum()) / size(&start.momentum) - 1.0).abs();
        let apart = (full.momentum() - reduced.momentum()).amax();
        println!("n = {N}: |mu| to {kept:e}, full and reduced apart by {apart:e}");
        assert!(kept <= 1e-13, "n = {N}: {kept:e}");
        assert!(apart <= 1e-10, "n = {N}: {apart:e}");
    }
    law::<3>();
    law::<4>();
}

/// From a time to a later one the flow of a Hamiltonian that changes is symplectic; under torques it is not.
#[test]
fn symplectic_without_torques_alone() {
    fn law<const N: usize>() {
        let start = start::<N>();
        let methods: [fn() -> Box<dyn Stepper<N>>; 3] = [
            || Box::new(Vpd::new(gauss(2), StopRule::default())),
            || Box::new(VpdLagrangian::new(gauss(2), StopRule::default())),
            || Box::new(Vrkmk::new(gauss(2), StopRule::default())),
        ];
        for make in methods {
            let of =
                |body: &RigidBody<N>| symplectic_defect(make().as_mut(), body, &start, 0.1, 1e-2);
            let (changing, spinning, pushed) = (of(&changing()), of(&with_wheels()), of(&pushed()));
            println!("n = {N}: {changing:.1e}, wheels {spinning:.1e}, pushed {pushed:.1e}");
            assert!(changing <= 1e-9, "n = {N}: {changing:e}");
            assert!(spinning <= 1e-9, "n = {N}: {spinning:e}");
            assert!(pushed > 1e-4, "n = {N}: {pushed:e}");
        }
    }
    law::<3>();
    law::<4>();
}

/// One stage goes back the way it came, through the same times.
#[test]
fn the_midpoint_step_is_its_own_reverse() {
    fn law<const N: usize>(name: &str, body: &RigidBody<N>) {
        let (start, h) = (start::<N>(), 0.1);
        let mut stepper = Vpd::new(gauss(1), StopRule::default());
        stepper.start(&start);
        for k in 0..5 {
            stepper.set_time(f64::from(k) * h);
            stepper.step(body, h).expect("a small step");
        }
        for k in (1..=5).rev() {
            stepper.set_time(f64::from(k) * h);
            stepper.step(body, -h).expect("a small step");
        }
        let end =
            State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() };
        let off = distance(&end, &start);
        assert!(off <= 2e-14, "{name}, n = {N}: {off:e}");
        assert!(stepper.work().abs() <= 2e-14, "{name}, n = {N}: {:e}", stepper.work());
    }
    law::<3>("changing", &changing());
    law::<4>("changing", &changing());
    law::<3>("pushed", &pushed());
    law::<4>("wheels", &with_wheels());
}
