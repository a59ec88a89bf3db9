//! The forms of VPD against each other: Hamiltonian, Lagrangian, reduced.

use vpd_solve::hamiltonian::{Kinetic, RigidBody};
use vpd_solve::lagrangian::{self, Lagrangian, velocity_of_momentum};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::system::{Energy, System};
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{self, Observables, Sample, Schedule, Sink};

use crate::given::Numbers;
use crate::laws::body;

fn tableaux() -> [Tableau; 4] {
    let gauss = |stages| Tableau::gauss(stages).expect("1 to 8 stages");
    [gauss(1), Tableau::rk3(), gauss(2), gauss(4)]
}

fn free<const N: usize>() -> RigidBody<N> {
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.3 * (i + j) as f64) });
    RigidBody::new(Kinetic::Principal { weights }, Vec::new(), 0.0)
}

fn start<const N: usize>(numbers: &mut Numbers) -> State<N> {
    State { attitude: numbers.rotation(), momentum: numbers.skew() }
}

/// Takes both along from the same state, step by step, and returns the largest difference of a step.
fn difference<const N: usize>(
    body: &RigidBody<N>,
    a: &mut dyn Stepper<N>,
    b: &mut dyn Stepper<N>,
    start: &State<N>,
    steps: usize,
) -> f64 {
    a.start(start);
    let mut largest = 0.0_f64;
    for _ in 0..steps {
        let state = State { attitude: a.attitude().expect("carried"), momentum: a.momentum() };
        b.start(&state);
        a.step(body, 0.05).expect("a small step");
        b.step(body, 0.05).expect("a small step");
        let turned = a.attitude().zip(b.attitude()).map_or(0.0, |(a, b)| (a - b).amax());
        largest = largest.max(turned).max((a.momentum() - b.momentum()).amax());
    }
    largest
}

#[test]
fn the_lagrangian_form_is_the_same_map() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(31);
        let body = body::<N>(&mut numbers);
        let start = start(&mut numbers);
        for tableau in tableaux() {
            let mut hamiltonian = Vpd::new(tableau.clone(), StopRule::default());
            let mut lagrangian = VpdLagrangian::new(tableau, StopRule::default());
            let difference = difference(&body, &mut hamiltonian, &mut lagrangian, &start, 100);
            assert!(difference <= 1e-13, "n = {N}: {difference:e}");
        }
    }
    law::<2>();
    law::<3>();
    law::<4>();
    law::<5>();
}

#[test]
fn the_reduced_form_is_the_same_map_for_free_bodies() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(32);
        let start = start(&mut numbers);
        for tableau in tableaux() {
            let mut full = Vpd::new(tableau.clone(), StopRule::default());
            for with_attitude in [true, false] {
                let mut reduced =
                    VpdReduced::new(tableau.clone(), StopRule::default(), with_attitude);
                let difference = difference(&free::<N>(), &mut full, &mut reduced, &start, 200);
                assert!(difference <= 1e-13, "n = {N}: {difference:e}");
            }
        }
    }
    law::<2>();
    law::<3>();
    law::<4>();
    law::<5>();
    law::<8>();
}

#[test]
fn the_reduced_form_keeps_the_casimirs() {
    /// |mu|, tr(mu^2k), and for n = 4 the Pfaffian.
    fn casimirs<const N: usize>(mu: &Mat<N>) -> Vec<f64> {
        let (square, length) = (mu * mu, so::inner(mu, mu).sqrt());
        let mut found = vec![length, square.trace()];
        if N >= 4 {
            found.push((square * square).trace());
        }
        if N == 4 {
            let pfaffian =
                mu[(0, 1)] * mu[(2, 3)] - mu[(0, 2)] * mu[(1, 3)] + mu[(0, 3)] * mu[(1, 2)];
            found.push(pfaffian);
        }
        found
    }
    fn law<const N: usize>(steps: usize) {
        let mut numbers = Numbers(33);
        let (body, start) = (free::<N>(), start(&mut numbers));
        let then = casimirs(&start.momentum);
        let gauss = Tableau::gauss(2).expect("2 stages");
        let mut stepper = VpdReduced::new(gauss, StopRule::default(), false);
        stepper.start(&start);
        let mut largest = 0.0_f64;
        for _ in 0..steps {
            stepper.step(&body, 0.05).expect("a small step");
            let now = casimirs(&stepper.momentum());
            let relative = now.iter().zip(&then).map(|(now, then)| (now / then - 1.0).abs());
            largest = relative.fold(largest, f64::max);
        }
        println!("n = {N}: Casimirs kept to {largest:.1e} over {steps} steps");
        assert!(largest <= 1e-12, "n = {N}: {largest:e}");
    }
    law::<3>(100_000);
    law::<4>(100_000);
    law::<5>(100_000);
}

/// Steps that follow one another begin nearly where they end: fewer sweeps lead to the same place.
#[test]
fn the_reduced_form_begins_where_the_steps_before_lead() {
    fn law<const N: usize>(full: &mut dyn Stepper<N>, reduced: &mut dyn Stepper<N>, most: f64) {
        const STEPS: u32 = 2000;
        let (body, start) = (free::<N>(), start(&mut Numbers(35)));
        let end = |stepper: &mut dyn Stepper<N>| {
            stepper.start(&start);
            let sweeps = |_| stepper.step(&body, 0.05).expect("a small step").iterations;
            let sweeps: u32 = (0..STEPS).map(sweeps).sum();
            (f64::from(sweeps) / f64::from(STEPS), stepper.momentum())
        };
        let ((many, a), (few, b)) = (end(full), end(reduced));
        println!("n = {N}: {few:.2} sweeps a step instead of {many:.2}");
        assert!(few <= most * many, "n = {N}: {few} sweeps instead of {many}");
        let difference = (a - b).amax();
        assert!(difference <= 1e-11, "n = {N}: {difference:e}");
    }
    let stop = StopRule::default;
    let gauss = |stages| Tableau::gauss(stages).expect("1 to 8 stages");
    for stages in 1..=4 {
        let full = || VpdSo3::new(gauss(stages), stop()).expect("few stages");
        for with_attitude in [true, false] {
            law::<3>(&mut full(), &mut full().reduced(with_attitude), 0.7);
        }
    }
    let mut full = Vpd::new(Tableau::rk3(), stop());
    law::<4>(&mut full, &mut VpdReduced::new(Tableau::rk3(), stop(), true), 0.4);
}

/// A step of collocation that begins where the steps before lead ends where one from a guess does, in fewer rounds; also
/// where another body takes over.
#[test]
fn steps_of_collocation_begin_where_the_steps_before_lead() {
    fn law<const N: usize>(stages: usize, h: f64, most: f64) {
        let tableau = || Tableau::gauss(stages).expect("1 to 8 stages");
        let mut numbers = Numbers(36);
        let bodies = [(); 2].map(|()| body::<N>(&mut numbers));
        let mut follows = Vpd::<N>::new(tableau(), StopRule::default());
        follows.start(&start(&mut numbers));
        let (mut few, mut many, mut worst) = (0, 0, 0.0_f64);
        for step in 0..80 {
            let body = &bodies[step / 40];
            let before = State {
                attitude: follows.attitude().expect("carried"),
                momentum: follows.momentum(),
            };
            let mut alone = Vpd::<N>::new(tableau(), StopRule::default());
            alone.start(&before);
            few += follows.step(body, h).expect("a small step").iterations;
            many += alone.step(body, h).expect("a small step").iterations;
            let attitude = |stepper: &Vpd<N>| stepper.attitude().expect("carried");
            worst = worst
                .max((attitude(&follows) - attitude(&alone)).amax())
                .max((follows.momentum() - alone.momentum()).amax() / follows.momentum().amax());
        }
        println!("n = {N}, {stages} stages: {few} rounds instead of {many}, {worst:e} apart");
        assert!(f64::from(few) <= most * f64::from(many), "{few} rounds instead of {many}");
        assert!(worst <= 3e-15, "n = {N}, {stages} stages: {worst:e}");
    }
    for stages in 1..=3 {
        law::<4>(stages, 0.01, 0.75);
    }
    law::<5>(2, 0.01, 0.6);
    law::<8>(3, 0.01, 0.6);
    law::<4>(8, 0.1, 0.75);
    law::<5>(6, 0.1, 0.75);
    // Too far to lead anywhere, and nothing to gain.
    law::<4>(2, 0.4, 1.0);
    law::<4>(4, 0.01, 1.0);
}

/// Counts the samples that carry an attitude.
#[derive(Default)]
struct Attitudes(usize);

impl Sink<3> for Attitudes {
    type Error = std::convert::Infallible;

    fn record(&mut self, sample: &Sample<3>) -> Result<(), Self::Error> {
        self.0 += usize::from(sample.attitude.is_some());
        assert!(sample.energy_error.expect("asked for").abs() < 1e-9);
        assert!(sample.momentum_drift.expect("the orbit is conserved") < 1e-12);
        Ok(())
    }
}

#[test]
fn without_need_no_attitude_is_computed() {
    let start = start(&mut Numbers(34));
    let schedule = Schedule { step_s: 0.05, steps: 1000, every: 1 };
    let observables = Observables {
        energy: true,
        orthogonality: false,
        momentum: true,
        sigma_min: false,
        pace: false,
        control: false,
        pointing: false,
        derivatives: false,
    };
    let count = |with_attitude| {
        let gauss = Tableau::gauss(3).expect("3 stages");
        let mut stepper = VpdReduced::new(gauss, StopRule::default(), with_attitude);
        let mut sink = Attitudes::default();
        trajectory::integrate(
            &free(),
            &mut stepper,
            &start,
            schedule,
            observables,
            &mut sink,
            |_| true,
        )
        .expect("the sink cannot fail");
        sink.0
    };
    assert_eq!((count(false), count(true)), (0, 1001));
}

/// A body with quartic kinetic energy in a magnetic field A: no Hamiltonian is written down for it.
///
/// `L = <J Omega, Omega> / 2 + c <Omega, Omega>^2 / 4 + <g^T A g, Omega> - U(g)`
pub(crate) struct Charged<const N: usize> {
    pub(crate) body: RigidBody<N>,
    pub(crate) quartic: f64,
    pub(crate) field: Mat<N>,
}

impl<const N: usize> System<N> for Charged<N> {
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        lagrangian::energy(self, g, mu)
    }
}

impl<const N: usize> Lagrangian<N> for Charged<N> {
    fn value(&self, g: &Mat<N>, omega: &Mat<N>) -> f64 {
        let square = so::inner(omega, omega);
        let potential = self.body.energy(g, &Mat::zeros()).potential;
        0.5 * so::inner(&self.body.momentum(omega), omega)
            + 0.25 * self.quartic * square * square
            + so::inner(&(g.transpose() * self.field * g), omega)
            - potential
    }

    fn momentum(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        self.body.momentum(omega)
            + omega * (self.quartic * so::inner(omega, omega))
            + g.transpose() * self.field * g
    }

    fn force(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let b = g.transpose() * self.field * g;
        omega * b - b * omega - self.body.gradient(g)
    }
}

pub(crate) fn charged<const N: usize>(numbers: &mut Numbers) -> Charged<N> {
    Charged { body: body(numbers), quartic: 0.7, field: numbers.skew() }
}

#[test]
fn the_force_of_a_lagrangian_is_its_derivative() {
    let mut numbers = Numbers(35);
    let charged = charged::<4>(&mut numbers);
    let (g, omega, eta) = (numbers.rotation::<4>(), numbers.skew::<4>(), numbers.skew::<4>());
    let e = 1e-4;
    let turned = |e: f64| g * so::retraction(&(eta * e)).expect("small");
    let slope = |ahead: f64, behind: f64| (ahead - behind) / (2.0 * e);
    let along_g = slope(charged.value(&turned(e), &omega), charged.value(&turned(-e), &omega));
    assert!((along_g - so::inner(&charged.force(&g, &omega), &eta)).abs() < 1e-7);
    let along_omega =
        slope(charged.value(&g, &(omega + eta * e)), charged.value(&g, &(omega - eta * e)));
    assert!((along_omega - so::inner(&charged.momentum(&g, &omega), &eta)).abs() < 1e-7);
    let mu = charged.momentum(&g, &omega);
    let back = velocity_of_momentum(&charged, &g, &mu, &Mat::zeros()).expect("hyperregular");
    assert!((back - omega).amax() < 1e-13);
}

#[test]
fn the_lagrangian_form_needs_no_hamiltonian() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(36);
        let charged = charged::<N>(&mut numbers);
        let start = start(&mut numbers);
        let velocity = |g: &Mat<N>, p: &Mat<N>| {
            velocity_of_momentum(&charged, g, p, &Mat::zeros()).expect("hyperregular")
        };
        // Euler and Lagrange: g' = g Omega, p' = [p, Omega] + dL/dg, by the classical method.
        let slope = |g: &Mat<N>, p: &Mat<N>| {
            let omega = velocity(g, p);
            (g * omega, p * omega - omega * p + charged.force(g, &omega))
        };
        let (mut g, mut p) = (start.attitude, start.momentum);
        let h = 0.001;
        for _ in 0..500 {
            let (g1, p1) = slope(&g, &p);
            let (g2, p2) = slope(&(g + g1 * (h / 2.0)), &(p + p1 * (h / 2.0)));
            let (g3, p3) = slope(&(g + g2 * (h / 2.0)), &(p + p2 * (h / 2.0)));
            let (g4, p4) = slope(&(g + g3 * h), &(p + p3 * h));
            g += (g1 + (g2 + g3) * 2.0 + g4) * (h / 6.0);
            p += (p1 + (p2 + p3) * 2.0 + p4) * (h / 6.0);
        }
        let energy = |g: &Mat<N>, p: &Mat<N>| charged.energy(g, p).total();
        let error = |steps: usize| {
            let gauss = Tableau::gauss(2).expect("2 stages");
            let mut stepper = VpdLagrangian::new(gauss, StopRule::default());
            stepper.start(&start);
            for _ in 0..steps {
                stepper.step(&charged, 0.5 / steps as f64).expect("a small step");
            }
            let end = stepper.attitude().expect("carried");
            let drift =
                energy(&end, &stepper.momentum()) - energy(&start.attitude, &start.momentum);
            assert!(drift.abs() < 1e-5);
            (end - g).norm() + (stepper.momentum() - p).norm()
        };
        let order = (error(10) / error(40)).log2() / 2.0;
        assert!((order - 4.0).abs() <= 0.1, "n = {N}: order {order}");
    }
    law::<3>();
    law::<4>();
}
