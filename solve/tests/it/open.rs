//! Systems of a user's own: a potential next to the built-in terms, a Hamiltonian, a Lagrangian, through the same steps
//! and the same time loop.

use std::sync::Arc;

use vpd_solve::ensemble::Members;
use vpd_solve::failure::{Failure, FailureCode};
use vpd_solve::hamiltonian::{
    Hamiltonian, Kinetic, Law, Potential, RigidBody, Term, gradient_error,
};
use vpd_solve::lagrangian::{self, Lagrangian};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::lgvi::Lgvi;
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::splitting::Splitting;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vpd_so3::ensemble::VpdEnsemble;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::system::{Energy, System};
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{self, Ending, Observables, Sample, Schedule, Trajectory, integrate};

use crate::forms::{Charged, charged};
use crate::given::Numbers;
use crate::laws;

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn stop() -> StopRule {
    StopRule::default()
}

fn start<const N: usize>(numbers: &mut Numbers) -> State<N> {
    State { attitude: numbers.rotation(), momentum: numbers.skew() }
}

/// `stiffness / 2 (|g y - anchor| - length)^2`, written anew.
#[derive(Debug)]
struct OwnSpring<const N: usize> {
    stiffness: f64,
    length: f64,
    y: Vector<N>,
    anchor: Vector<N>,
}

impl<const N: usize> Potential<N> for OwnSpring<N> {
    fn energy(&self, g: &Mat<N>) -> f64 {
        let stretch = (g * self.y - self.anchor).norm() - self.length;
        0.5 * self.stiffness * stretch * stretch
    }

    fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let d = g * self.y - self.anchor;
        let slope = d * (self.stiffness * (1.0 - self.length / d.norm()));
        so::asym(&(g.transpose() * slope * self.y.transpose()))
    }

    fn space_vectors(&self) -> Vec<Vector<N>> {
        vec![self.anchor]
    }
}

/// `weight v . g y`, written anew, and silent about its symmetry.
#[derive(Debug)]
struct OwnWeight<const N: usize> {
    y: Vector<N>,
    v: Vector<N>,
}

impl<const N: usize> Potential<N> for OwnWeight<N> {
    fn energy(&self, g: &Mat<N>) -> f64 {
        self.v.dot(&(g * self.y))
    }

    fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        so::asym(&(g.transpose() * self.v * self.y.transpose()))
    }
}

fn kinetic<const N: usize>() -> Kinetic<N> {
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (2.0 + 0.2 * (i + j) as f64) });
    Kinetic::Principal { weights }
}

/// A body with three terms, and the same with two of them as potentials of one's own.
fn pair<const N: usize>(numbers: &mut Numbers) -> [RigidBody<N>; 2] {
    let far = |numbers: &mut Numbers| numbers.vector::<N>() + Vector::<N>::repeat(2.0);
    let (y, anchor) = (numbers.vector::<N>(), far(numbers));
    let (z, v) = (numbers.vector::<N>(), numbers.vector::<N>());
    let gravity =
        Law::GravityGradient { strength: 0.6, matrix: so::symmetric_part(&numbers.matrix()) };
    let kept = Term { law: gravity, space: numbers.vector() };
    let spring = Law::Spring { stiffness: 0.8, rest_length: 0.4, body_point: y };
    let weight = Law::Uniform { weight: 1.0, body_point: z };
    let terms =
        vec![kept.clone(), Term { law: spring, space: anchor }, Term { law: weight, space: v }];
    let own = RigidBody::new(kinetic(), vec![kept], 0.25)
        .with_potential(Arc::new(OwnSpring { stiffness: 0.8, length: 0.4, y, anchor }))
        .with_potential(Arc::new(OwnWeight { y: z, v }));
    [RigidBody::new(kinetic(), terms, 0.25), own]
}

type Steppers<const N: usize> = Vec<(&'static str, Box<dyn Stepper<N>>)>;

fn in_any_dimension<const N: usize>() -> Steppers<N> {
    vec![
        ("vpd gauss1", Box::new(Vpd::new(gauss(1), stop()))),
        ("vpd rk3", Box::new(Vpd::new(Tableau::rk3(), stop()))),
        ("vpd gauss4", Box::new(Vpd::new(gauss(4), stop()))),
        ("vpd_lagrangian gauss2", Box::new(VpdLagrangian::new(gauss(2), stop()))),
        ("vrkmk gauss2", Box::new(Vrkmk::new(gauss(2), stop()))),
        ("rkmk rk4", Box::new(Rkmk::new(Tableau::rk4()).expect("explicit"))),
        ("rk rk4", Box::new(Rk::new(Tableau::rk4(), false).expect("explicit"))),
        ("rk projected rk8", Box::new(Rk::new(Tableau::rk8(), true).expect("explicit"))),
    ]
}

fn for_three() -> Steppers<3> {
    let lanes = |stages| Box::new(VpdSo3::new(gauss(stages), stop()).expect("few stages"));
    let mut steppers = in_any_dimension::<3>();
    steppers.extend([
        ("vpd in lanes gauss1", lanes(1) as Box<dyn Stepper<3>>),
        ("vpd in lanes gauss2", lanes(2)),
        ("vpd in lanes gauss3", lanes(3)),
        ("vpd in lanes gauss4", lanes(4)),
        ("vpd in lanes gauss8", lanes(8)),
        ("splitting 4", Box::new(Splitting::new(4).expect("an order"))),
        ("lgvi 4", Box::new(Lgvi::new(4, stop()).expect("an order"))),
        ("quaternion_gauss 4", Box::new(QuaternionGauss::new(4, stop()).expect("stages"))),
    ]);
    steppers
}

fn run<const N: usize, Y: System<N> + ?Sized>(
    system: &Y,
    stepper: &mut dyn Stepper<N, Y>,
    start: &State<N>,
    step_s: f64,
    steps: u64,
) -> (Trajectory<N>, Vec<Sample<N>>) {
    let mut kept = Vec::new();
    let schedule = Schedule { step_s, steps, every: steps.div_ceil(1000) };
    let observables = Observables {
        energy: true,
        orthogonality: true,
        momentum: true,
        sigma_min: true,
        pace: false,
        control: false,
        pointing: false,
        derivatives: false,
    };
    let Ok(end) = integrate(system, stepper, start, schedule, observables, &mut kept, |_| true);
    (end, kept)
}

/// The largest difference of the states and energies of two runs.
fn apart<const N: usize>(a: &[Sample<N>], b: &[Sample<N>]) -> f64 {
    assert_eq!(a.len(), b.len());
    let pairs = a.iter().zip(b);
    pairs.fold(0.0, |most, (a, b)| {
        let turned = (a.attitude.expect("carried") - b.attitude.expect("carried")).amax();
        let energy = (a.energy.expect("asked").total() - b.energy.expect("asked").total()).abs();
        most.max(turned).max((a.momentum - b.momentum).amax()).max(energy)
    })
}

#[test]
fn a_copy_of_a_built_in_term_moves_the_body_as_the_term_does() {
    fn law<const N: usize>(steppers: fn() -> Steppers<N>) {
        let mut numbers = Numbers(51);
        let bodies = pair::<N>(&mut numbers);
        let start = start(&mut numbers);
        for ((name, mut one), (_, mut other)) in steppers().into_iter().zip(steppers()) {
            let (end, built_in) = run(&bodies[0], one.as_mut(), &start, 0.05, 40);
            assert_eq!(end.ending, Ending::Completed, "{name}, n = {N}");
            let (_, own) = run(&bodies[1], other.as_mut(), &start, 0.05, 40);
            let apart = apart(&built_in, &own);
            // Off the group, where the stages of these two are, two formulas for one law differ.
            let allowed = if name.starts_with("rk ") { 1e-4 } else { 1e-13 };
            assert!(apart <= allowed, "{name}, n = {N}: {apart:e}");
        }
    }
    law::<3>(for_three);
    law::<4>(in_any_dimension);
}

#[test]
fn a_potential_of_ones_own_is_its_derivative_beside_the_terms() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(52);
        let [built_in, own] = pair::<N>(&mut numbers);
        let (g, eta) = (numbers.rotation::<N>(), numbers.skew::<N>());
        let energy = |e: f64| {
            let turned = g * so::retraction(&(eta * e)).expect("small");
            own.energy(&turned, &Mat::zeros()).potential
        };
        let slope = (energy(1e-4) - energy(-1e-4)) / 2e-4;
        assert!((slope - so::inner(&own.gradient(&g), &eta)).abs() < 1e-7, "n = {N}");
        let spatial = own.spatial_gradient(&g) - built_in.spatial_gradient(&g);
        assert!(spatial.amax() < 1e-14, "n = {N}");
        assert!(!own.is_free());
        assert_eq!(own.work().gradients(), 2);
    }
    law::<2>();
    law::<3>();
    law::<5>();
}

/// A potential frees no direction unless it says so; the momentum among the freed directions is
/// conserved.
#[test]
fn what_a_potential_of_ones_own_frees_is_conserved() {
    let mut numbers = Numbers(53);
    let (y, anchor) = (numbers.vector::<4>(), numbers.vector::<4>() * 3.0);
    let spring = Arc::new(OwnSpring { stiffness: 0.8, length: 0.4, y, anchor });
    let body = RigidBody::new(kinetic::<4>(), Vec::new(), 0.0).with_potential(spring);
    let free = body.conserved_directions().expect("three directions");
    assert!((free * anchor).norm() < 1e-14 && (free.trace() - 3.0).abs() < 1e-14);
    let (_, samples) = run(&body, &mut Vpd::new(gauss(2), stop()), &start(&mut numbers), 0.05, 500);
    let drift = samples.iter().map(|sample| sample.momentum_drift.expect("conserved"));
    assert!(drift.fold(0.0, f64::max) < 1e-13);
    let silent = OwnWeight { y, v: anchor };
    assert!(body.with_potential(Arc::new(silent)).conserved_directions().is_none());
}

/// Members side by side make the steps of their own runs, to the bit.
#[test]
fn members_of_an_ensemble_see_a_potential_of_ones_own() {
    for stages in [1, 2, 4] {
        let mut numbers = Numbers(54);
        let [_, body] = pair::<3>(&mut numbers);
        let states: Vec<State<3>> = (0..5).map(|_| start(&mut numbers)).collect();
        let mut members = VpdEnsemble::new(&gauss(stages), stop()).expect("few stages");
        members.start(&states);
        for _ in 0..20 {
            members.step(&body, 0.0, 0.05, &[0, 1, 2, 3, 4], &mut |_, result| {
                result.expect("a small step");
            });
        }
        for (m, state) in states.iter().enumerate() {
            let mut own = VpdSo3::new(gauss(stages), stop()).expect("few stages");
            own.start(state);
            for _ in 0..20 {
                own.step(&body, 0.05).expect("a small step");
            }
            let member = members.member(m);
            assert_eq!(member.attitude(), own.attitude(), "{stages} stages, member {m}");
            assert_eq!(member.momentum(), own.momentum(), "{stages} stages, member {m}");
        }
    }
}

/// `H = <K nu, nu> / 2 + c <nu, nu>^2 / 4 + U(g)` with `nu = mu - g^T A g`: neither is there a kinetic part that is
/// quadratic in mu, nor one that leaves g alone. Without c it is the body in a magnetic field of [`Charged`].
struct Magnetic<const N: usize> {
    body: RigidBody<N>,
    quartic: f64,
    field: Mat<N>,
}

impl<const N: usize> Magnetic<N> {
    fn field(&self, g: &Mat<N>) -> Mat<N> {
        g.transpose() * self.field * g
    }
}

impl<const N: usize> System<N> for Magnetic<N> {
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        let nu = mu - self.field(g);
        let Energy { kinetic, potential } = self.body.energy(g, &nu);
        let square = so::inner(&nu, &nu);
        Energy { kinetic: kinetic + 0.25 * self.quartic * square * square, potential }
    }
}

impl<const N: usize> Hamiltonian<N> for Magnetic<N> {
    fn velocity(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        let nu = mu - self.field(g);
        self.body.velocity(&nu) + nu * (self.quartic * so::inner(&nu, &nu))
    }

    fn gradient(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        // d(g^T A g) = [b, eta], b = g^T A g; <-Omega, [b, eta]> = <[b, Omega], eta>
        let (b, omega) = (self.field(g), self.velocity(g, mu));
        b * omega - omega * b + self.body.gradient(g)
    }
}

fn magnetic<const N: usize>(quartic: f64) -> Magnetic<N> {
    let Charged { body, field, .. } = charged(&mut Numbers(55));
    Magnetic { body, quartic, field }
}

#[test]
fn a_hamiltonian_of_ones_own_keeps_order_and_energy() {
    fn law<const N: usize>() {
        let system = magnetic::<N>(0.3);
        let start = start(&mut Numbers(56));
        let reference = {
            let mut fine = Vpd::new(gauss(6), stop());
            run(&system, &mut fine, &start, 0.005, 100).0.reached.state()
        };
        let rate = |g: &Mat<N>, mu: &Mat<N>| {
            let omega = system.velocity(g, mu);
            (g * omega, mu * omega - omega * mu - system.gradient(g, mu))
        };
        // The classical method knows nothing of the step.
        let (mut g, mut mu, h) = (start.attitude, start.momentum, 0.0005);
        for _ in 0..1000 {
            let (a, b) = rate(&g, &mu);
            let (c, d) = rate(&(g + a * (h / 2.0)), &(mu + b * (h / 2.0)));
            let (e, f) = rate(&(g + c * (h / 2.0)), &(mu + d * (h / 2.0)));
            let (k, l) = rate(&(g + e * h), &(mu + f * h));
            g += (a + (c + e) * 2.0 + k) * (h / 6.0);
            mu += (b + (d + f) * 2.0 + l) * (h / 6.0);
        }
        let apart = (g - reference.attitude).amax().max((mu - reference.momentum).amax());
        assert!(apart < 1e-11, "n = {N}: {apart:e}");
        for (tableau, order) in [(gauss(1), 2.0), (Tableau::rk3(), 3.0), (gauss(2), 4.0)] {
            let error = |steps: u64| {
                let mut stepper = Vpd::new(tableau.clone(), stop());
                let (end, samples) = run(&system, &mut stepper, &start, 0.5 / steps as f64, steps);
                assert_eq!(end.ending, Ending::Completed);
                let off_the_group = samples.iter().filter_map(|s| s.orthogonality_error);
                assert!(off_the_group.fold(0.0, f64::max) < 1e-14);
                let end = end.reached.state();
                (end.attitude - reference.attitude).norm()
                    + (end.momentum - reference.momentum).norm()
            };
            let measured = (error(16) / error(64)).log2() / 2.0;
            assert!((measured - order).abs() < 0.15, "n = {N}, order {order}: {measured}");
        }
        // A long run: the error of the energy stays what it was in the first tenth of it.
        let (end, samples) = run(&system, &mut Vpd::new(gauss(1), stop()), &start, 0.02, 20_000);
        assert_eq!(end.ending, Ending::Completed);
        let errors: Vec<f64> =
            samples.iter().map(|s| s.energy_error.expect("asked for").abs()).collect();
        let largest = |errors: &[f64]| errors.iter().copied().fold(0.0, f64::max);
        let (first, last) = (largest(&errors[..100]), largest(&errors[900..]));
        println!("n = {N}: energy off by {first:.1e} at first, {last:.1e} at last");
        assert!(last < 2.0 * first && last < 0.05, "n = {N}: {first:e}, {last:e}");
    }
    law::<3>();
    law::<4>();
}

/// `omega(X1, X2) = <dmu1, xi2> - <dmu2, xi1> - <mu, [xi1, xi2]>`, the canonical form left-trivialised, before the step
/// and after it.
#[test]
fn the_step_of_a_hamiltonian_of_ones_own_is_symplectic() {
    fn law<const N: usize>(tableau: &Tableau) {
        let mut numbers = Numbers(57);
        let system = magnetic::<N>(0.3);
        let at = start::<N>(&mut numbers);
        let stepped = |state: &State<N>| {
            let mut stepper = Vpd::new(tableau.clone(), StopRule { stop_early: false, ..stop() });
            stepper.start(state);
            stepper.step(&system, 0.2).expect("a small step");
            State { attitude: stepper.attitude().expect("carried"), momentum: stepper.momentum() }
        };
        let form = |mu: &Mat<N>, [a, b]: [&(Mat<N>, Mat<N>); 2]| {
            so::inner(&a.1, &b.0) - so::inner(&b.1, &a.0) - so::inner(mu, &(a.0 * b.0 - b.0 * a.0))
        };
        let end = stepped(&at);
        let image = |(xi, change): &(Mat<N>, Mat<N>)| {
            let e = 1e-4;
            let moved = |e: f64| {
                stepped(&State {
                    attitude: at.attitude * so::exp(&(xi * e)),
                    momentum: at.momentum + change * e,
                })
            };
            let (ahead, behind) = (moved(e), moved(-e));
            let turned = end.attitude.transpose() * (ahead.attitude - behind.attitude);
            (so::asym(&turned) / (4.0 * e), (ahead.momentum - behind.momentum) / (2.0 * e))
        };
        let tangents: Vec<(Mat<N>, Mat<N>)> =
            (0..4).map(|_| (numbers.skew(), numbers.skew())).collect();
        for a in &tangents {
            for b in &tangents {
                let before = form(&at.momentum, [a, b]);
                let after = form(&end.momentum, [&image(a), &image(b)]);
                let change = (after - before).abs();
                assert!(change < 1e-7, "n = {N}: {before} becomes {after}");
            }
        }
    }
    for tableau in [gauss(1), gauss(2), Tableau::rk3()] {
        law::<3>(&tableau);
        law::<4>(&tableau);
    }
}

#[test]
fn both_forms_of_a_system_of_ones_own_agree() {
    fn law<const N: usize>() {
        let hamiltonian = magnetic::<N>(0.0);
        let Magnetic { body, field, .. } = magnetic::<N>(0.0);
        let lagrangian = Charged { body, quartic: 0.0, field };
        let start = start(&mut Numbers(58));
        for tableau in [gauss(1), Tableau::rk3(), gauss(3)] {
            let mut one = Vpd::new(tableau.clone(), stop());
            let mut other = VpdLagrangian::new(tableau, stop());
            let (_, one) = run(&hamiltonian, &mut one, &start, 0.05, 40);
            let (_, other) = run(&lagrangian, &mut other, &start, 0.05, 40);
            let apart = apart(&one, &other);
            assert!(apart <= 1e-12, "n = {N}: {apart:e}");
        }
        let (g, mu) = (start.attitude, start.momentum);
        let (own, found) = (hamiltonian.energy(&g, &mu), lagrangian.energy(&g, &mu));
        assert!((own.total() - found.total()).abs() < 1e-13, "n = {N}");
    }
    law::<2>();
    law::<3>();
    law::<4>();
}

/// A body, too, is one by its derivatives alone, behind a pointer.
#[test]
fn any_hamiltonian_may_stand_behind_a_pointer() {
    struct Plain(RigidBody<3>);
    impl System<3> for Plain {
        fn energy(&self, g: &Mat<3>, mu: &Mat<3>) -> Energy {
            self.0.energy(g, mu)
        }
    }
    impl Hamiltonian<3> for Plain {
        fn velocity(&self, _g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
            self.0.velocity(mu)
        }

        fn gradient(&self, g: &Mat<3>, _mu: &Mat<3>) -> Mat<3> {
            self.0.gradient(g)
        }
    }
    let mut numbers = Numbers(59);
    let body = laws::body::<3>(&mut numbers);
    let start = start(&mut numbers);
    let plain: Box<dyn Hamiltonian<3>> = Box::new(Plain(body.clone()));
    let mut stepper = Vpd::<3, dyn Hamiltonian<3>>::new(gauss(2), stop());
    let (_, own) = run(plain.as_ref(), &mut stepper, &start, 0.05, 100);
    let (_, built_in) = run(&body, &mut Vpd::new(gauss(2), stop()), &start, 0.05, 100);
    assert!(apart(&own, &built_in) < 1e-13);
}

/// Ways in which a user-defined law goes wrong.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Wrong {
    Energy,
    Velocity,
    Torque,
    /// The attitude is refused.
    Refused,
}

/// A free body, whose law goes wrong once it has turned far enough, or at once.
#[derive(Debug)]
struct Faulty {
    wrong: Wrong,
    at_once: bool,
}

impl Faulty {
    fn is_wrong(&self, wrong: Wrong, g: &Mat<3>) -> bool {
        self.wrong == wrong && (self.at_once || !(g[(0, 0)] > 0.5))
    }

    fn or_nan(&self, wrong: Wrong, g: &Mat<3>, value: Mat<3>) -> Mat<3> {
        if self.is_wrong(wrong, g) { value * f64::NAN } else { value }
    }

    fn verdict(&self, g: &Mat<3>) -> Result<(), Failure> {
        if self.is_wrong(Wrong::Refused, g) {
            Err(Failure::new(FailureCode::PotentialSingularity, None, g[(0, 0)], 0.5))
        } else {
            Ok(())
        }
    }
}

impl System<3> for Faulty {
    fn energy(&self, g: &Mat<3>, mu: &Mat<3>) -> Energy {
        let kinetic = 0.5 * so::inner(mu, mu);
        let kinetic = if self.is_wrong(Wrong::Energy, g) { f64::NAN } else { kinetic };
        Energy { kinetic, potential: 0.0 }
    }

    fn check(&self, g: &Mat<3>) -> Result<(), Failure> {
        self.verdict(g)
    }
}

impl Hamiltonian<3> for Faulty {
    fn velocity(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
        self.or_nan(Wrong::Velocity, g, *mu)
    }

    fn gradient(&self, g: &Mat<3>, _mu: &Mat<3>) -> Mat<3> {
        self.or_nan(Wrong::Torque, g, Mat::zeros())
    }
}

impl Lagrangian<3> for Faulty {
    fn value(&self, _g: &Mat<3>, omega: &Mat<3>) -> f64 {
        0.5 * so::inner(omega, omega)
    }

    fn momentum(&self, g: &Mat<3>, omega: &Mat<3>) -> Mat<3> {
        self.or_nan(Wrong::Velocity, g, *omega)
    }

    fn force(&self, g: &Mat<3>, _omega: &Mat<3>) -> Mat<3> {
        self.or_nan(Wrong::Torque, g, Mat::zeros())
    }
}

impl Potential<3> for Faulty {
    fn energy(&self, g: &Mat<3>) -> f64 {
        if self.is_wrong(Wrong::Energy, g) { f64::NAN } else { 0.0 }
    }

    fn gradient(&self, g: &Mat<3>) -> Mat<3> {
        self.or_nan(Wrong::Torque, g, Mat::zeros())
    }

    fn check(&self, g: &Mat<3>) -> Result<(), Failure> {
        self.verdict(g)
    }
}

/// The run ends with a name, and all that was sampled before are numbers.
#[test]
fn a_law_that_goes_wrong_ends_the_run_with_a_name() {
    let start = State { attitude: Mat::<3>::identity(), momentum: so::hat(&[0.1, 0.2, 1.0]) };
    let judge = |what: &str, faulty: &Faulty, (end, samples): (Trajectory<3>, Vec<Sample<3>>)| {
        let Ending::Failed(failure) = end.ending else {
            panic!("{what}, {faulty:?}: {:?}", end.ending)
        };
        let named = match faulty.wrong {
            Wrong::Refused => &[FailureCode::PotentialSingularity][..],
            // A NaN looks like a number that has grown out of all bounds.
            _ => &[FailureCode::NonFinite, FailureCode::Diverged],
        };
        assert!(named.contains(&failure.code), "{what}, {faulty:?}: {failure:?}");
        let at_start = faulty.at_once && faulty.wrong == Wrong::Energy;
        assert_eq!(samples.is_empty(), at_start, "{what}, {faulty:?}");
        assert_eq!(end.reached.step == 0, faulty.at_once, "{what}, {faulty:?}");
        for sample in &samples {
            assert!(sample.attitude.expect("carried").iter().all(|x| x.is_finite()));
            assert!(sample.momentum.iter().all(|x| x.is_finite()));
            assert!(sample.energy.expect("asked for").total().is_finite());
        }
    };
    for at_once in [false, true] {
        for wrong in [Wrong::Energy, Wrong::Velocity, Wrong::Torque, Wrong::Refused] {
            let law = Faulty { wrong, at_once };
            let ended = run(&law, &mut Vpd::new(gauss(2), stop()), &start, 0.05, 100);
            judge("hamiltonian", &law, ended);
            let ended = run(&law, &mut VpdLagrangian::new(gauss(2), stop()), &start, 0.05, 100);
            judge("lagrangian", &law, ended);
        }
        for wrong in [Wrong::Energy, Wrong::Torque, Wrong::Refused] {
            for (name, mut stepper) in for_three() {
                let law = Arc::new(Faulty { wrong, at_once });
                let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 });
                let body = RigidBody::new(Kinetic::Principal { weights }, Vec::new(), 0.0)
                    .with_potential(law.clone());
                let ended = run(&body, stepper.as_mut(), &start, 0.05, 100);
                judge(name, &law, ended);
            }
        }
    }
}

/// A Lagrangian whose momentum says nothing of the velocity has no motion.
#[test]
fn a_lagrangian_that_is_not_hyperregular_is_refused() {
    struct Degenerate;
    impl System<3> for Degenerate {
        fn energy(&self, g: &Mat<3>, mu: &Mat<3>) -> Energy {
            lagrangian::energy(self, g, mu)
        }
    }
    impl Lagrangian<3> for Degenerate {
        fn value(&self, _g: &Mat<3>, omega: &Mat<3>) -> f64 {
            omega[(1, 0)]
        }

        fn momentum(&self, _g: &Mat<3>, _omega: &Mat<3>) -> Mat<3> {
            so::hat(&[0.0, 0.0, 1.0])
        }

        fn force(&self, _g: &Mat<3>, _omega: &Mat<3>) -> Mat<3> {
            Mat::zeros()
        }
    }
    let mut stepper = VpdLagrangian::new(gauss(1), stop());
    let state = State { attitude: Mat::identity(), momentum: so::hat(&[0.0, 0.0, 1.0]) };
    stepper.start(&state);
    let failure = stepper.step(&Degenerate, 0.1).expect_err("no velocity");
    assert_eq!(failure.code, FailureCode::Diverged);
    assert_eq!(stepper.attitude(), Some(state.attitude));
    // Without the energy the loop asks nothing else of the law.
    let schedule = Schedule { step_s: 0.1, steps: 1, every: 1 };
    let observables = Observables {
        energy: false,
        orthogonality: true,
        momentum: false,
        sigma_min: false,
        pace: false,
        control: false,
        pointing: false,
        derivatives: false,
    };
    let mut kept = Vec::new();
    let Ok(end) = trajectory::integrate(
        &Degenerate,
        &mut stepper,
        &state,
        schedule,
        observables,
        &mut kept,
        |_| true,
    );
    assert!(matches!(end.ending, Ending::Failed(_)) && kept.len() == 1);
}

/// A hinge whose gradient is wrong by a factor.
#[derive(Debug)]
struct Hinge(f64);

impl<const N: usize> Potential<N> for Hinge {
    fn energy(&self, g: &Mat<N>) -> f64 {
        0.5 * g[(0, N - 1)].powi(2)
    }

    fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let mut slope = Mat::zeros();
        slope[(0, N - 1)] = self.0 * g[(0, N - 1)];
        so::asym(&so::transposed_product(g, &slope))
    }
}

#[test]
fn a_wrong_gradient_is_found_by_differences() {
    fn found<const N: usize>() {
        let g = start::<N>(&mut Numbers(83)).attitude;
        let error = |factor| gradient_error(&Hinge(factor), &g);
        assert!(error(1.0) < 1e-8, "n = {N}: {:e}", error(1.0));
        assert!((error(-1.0) - 2.0).abs() < 1e-8 && (error(0.5) - 0.5).abs() < 1e-8, "n = {N}");
        assert!(error(f64::NAN).is_nan());
    }
    found::<2>();
    found::<3>();
    found::<5>();
}

#[test]
fn what_is_no_state_is_known() {
    let good = start::<4>(&mut Numbers(84));
    assert!(good.defect() < 1e-14, "{:e}", good.defect());
    let with = |attitude, momentum| State { attitude, momentum }.defect();
    let mut mirror = Mat::identity();
    mirror[(0, 0)] = -1.0;
    assert_eq!(with(good.attitude * mirror, good.momentum), 2.0);
    assert!(with(good.attitude * 1.001, good.momentum) > 1e-3);
    assert!(with(good.attitude, good.momentum + Mat::identity()) > 0.1);
    assert!(with(good.attitude * f64::NAN, good.momentum).is_nan());
}
