//! Tables over time: their interpolation, steps that end at their knots, and bodies at rest.

use std::convert::Infallible;

use vpd_solve::ensemble::{self, Sequential};
use vpd_solve::failure::FailureCode;
use vpd_solve::hamiltonian::{
    DrivenTerm, Factor, Interpolation, Kinetic, Law, Path, RigidBody, Table, Term, Torque,
};
use vpd_solve::nonlinear::{Rungs, StopRule};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::system::System;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{Ending, Observables, Sample, Schedule, Trajectory, integrate};

use crate::given::{Numbers, distance};
use crate::methods::{Method, methods};

const ALL: Observables = Observables {
    energy: true,
    orthogonality: true,
    momentum: true,
    sigma_min: false,
    pace: false,
    control: false,
    pointing: false,
    derivatives: false,
};

fn table(times: &[f64], values: &[f64], interpolation: Interpolation) -> Table<1> {
    Table::new(times.to_vec(), values.iter().map(|&v| [v]).collect(), interpolation)
}

fn about_z<const N: usize>() -> Mat<N> {
    let mut along = Mat::zeros();
    (along[(1, 0)], along[(0, 1)]) = (1.0, -1.0);
    along
}

fn pushed(body: RigidBody<3>, along: Mat<3>, spatial: bool, table: Table<1>) -> RigidBody<3> {
    body.with_torque(Torque::Table { along, spatial, table })
}

fn run<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    start: &State<N>,
    (time_s, steps): (f64, u64),
) -> (Vec<Sample<N>>, Trajectory<N>) {
    let mut samples = Vec::new();
    let schedule = Schedule { step_s: time_s / steps as f64, steps, every: 1 };
    let end = integrate(body, stepper, start, schedule, ALL, &mut samples, |_| true);
    let end = end.unwrap_or_else(|never: Infallible| match never {});
    (samples, end)
}

fn driven_methods() -> impl Iterator<Item = Method> {
    methods().into_iter().filter(Method::can_be_driven)
}

/// A factor shows the values of its table: those of SciPy 1.17's `PchipInterpolator`, and of the laws of the other two.
#[test]
fn tables_are_what_their_interpolation_says() {
    let (times, values) =
        ([-0.5, 0.0, 0.3, 1.0, 1.2, 2.0, 2.5], [1.0, 0.4, 1.2, 0.9, 0.9, -0.5, 3.0]);
    let law = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.0, 0.0, 1.0) };
    let value = |table: &Table<1>, t: f64| {
        let term = Term { law: law.clone(), space: Vector::<3>::new(0.0, 0.0, 1.0) };
        let factor = Factor::Table(table.clone());
        let driven = DrivenTerm { term, path: Path::Fixed, factor };
        let body = RigidBody::new(Kinetic::of_moments([1.0; 3]), Vec::new(), 0.0);
        let body = body.with_driven_term(driven);
        body.energy_at(t, &Mat::identity(), &Mat::zeros()).total()
    };
    let monotone = table(&times, &values, Interpolation::Monotone);
    for (t, expected) in PCHIP {
        let found = value(&monotone, t);
        assert!((found - expected).abs() < 4e-16, "{t}: {found} for {expected}");
    }
    let linear = table(&times, &values, Interpolation::Linear);
    assert!((value(&linear, 0.1) - (0.4 + 0.8 / 3.0)).abs() < 2e-16);
    let hold = table(&times, &values, Interpolation::Hold);
    let held = [-0.2, 0.0, 0.29, 0.3, 1.1, 2.49, 2.5].map(|t| value(&hold, t));
    assert_eq!(held, [1.0, 0.4, 0.4, 1.2, 0.9, -0.5, 3.0]);
    // A jump: what is at its time is what comes after it.
    for interpolation in [Interpolation::Monotone, Interpolation::Linear] {
        let block =
            table(&[0.0, 1.0, 1.0, 2.0, 2.0, 3.0], &[0.0, 0.0, 1.0, 1.0, 0.0, 0.0], interpolation);
        let seen = [0.5, 0.999, 1.0, 1.5, 1.999, 2.0, 3.0].map(|t| value(&block, t));
        assert_eq!(seen, [0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0], "{interpolation:?}");
    }
    // Between two times never outside of their values.
    let mut numbers = Numbers(77);
    for _ in 0..200 {
        let mut time = 0.0;
        let times: Vec<f64> = std::iter::repeat_with(|| {
            time += 1.001 + numbers.next();
            time
        })
        .take(9)
        .collect();
        let values: Vec<f64> = times.iter().map(|_| numbers.next().powi(3)).collect();
        let table = table(&times, &values, Interpolation::Monotone);
        for k in 0..8 {
            let (low, high) = (values[k].min(values[k + 1]), values[k].max(values[k + 1]));
            for part in 0..=50 {
                let t = times[k] + (times[k + 1] - times[k]) * f64::from(part) / 50.0;
                let found = value(&table, t);
                assert!(
                    found >= low - 1e-15 && found <= high + 1e-15,
                    "{found} of {low} to {high}"
                );
            }
        }
    }
}

const PCHIP: [(f64, f64); 7] = [
    (-0.4, 0.7072),
    (0.1, 0.6074074074074075),
    (0.29, 1.1973925925925923),
    (0.5, 1.140524781341108),
    (1.1, 0.9),
    (1.7, -0.057031249999999756),
    (2.3, 1.0216923076923061),
];

/// A body that is pushed about its axis by a burn much shorter than the step, between two steps or within one.
#[test]
fn no_step_goes_over_a_burn() {
    let free = || RigidBody::<3>::new(Kinetic::of_moments([1.0, 1.0, 1.5]), Vec::new(), 0.0);
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.0, 0.0, 0.0015]) };
    let triangle = |at: f64, strength: f64| {
        table(
            &[0.0, at - 0.1, at, at + 0.1, 100.0],
            &[0.0, 0.0, strength, 0.0, 0.0],
            Interpolation::Linear,
        )
    };
    for (at, strength, velocity) in [(37.1, 2.0, 0.001 + 0.2 / 1.5), (50.0, 30.0, 2.001)] {
        let body = pushed(free(), about_z(), false, triangle(at, strength));
        for method in driven_methods() {
            // Of half a radian after the stronger burn.
            let counts = if velocity > 2.0 { [1000, 500, 400] } else { [200, 100, 50] };
            for steps in counts {
                let (samples, end) = run(&body, (method.three)().as_mut(), &start, (100.0, steps));
                let name = method.name;
                assert_eq!(end.ending, Ending::Completed, "{name}, {steps}");
                let found = end.reached.momentum[(1, 0)] / 1.5;
                assert!((found - velocity).abs() < 1e-12, "{name}, {steps}: {found}");
                let last = samples.last().expect("samples");
                let error = last.table_impulse_error.expect("a torque by a table");
                assert!(error.abs() < 1e-12, "{name}, {steps}: {error:e}");
            }
        }
    }
}

/// The order of each method, with knots at irrational times in every table: linear, held, monotone, with jumps, of torques and
/// of a factor; and the balances close.
#[test]
fn methods_keep_their_order_wherever_knots_lie() {
    let mut numbers = Numbers(5);
    let root = |k: f64| k.sqrt() / 2.0;
    let times = [-0.1, root(0.31), root(0.77), root(1.31), root(2.03), 1.0];
    let burn = table(&times, &[0.0, 0.3, -0.8, 0.9, 0.2, 0.5], Interpolation::Linear);
    let held =
        table(&[-1.0, root(0.5), root(1.7), 2.0], &[0.4, -0.3, 0.6, 0.0], Interpolation::Hold);
    let jumps = [0.0, root(0.2), root(0.2), root(1.1), root(2.9), 1.0];
    let smooth = table(&jumps, &[0.2, 0.9, -0.5, 0.3, 0.8, 0.1], Interpolation::Monotone);
    let factor =
        table(&[0.0, root(0.9), root(0.9), 1.0], &[1.0, 0.2, 1.4, 0.7], Interpolation::Linear);
    let body = RigidBody::<3>::new(Kinetic::of_moments([1.0, 1.3, 1.7]), Vec::new(), 0.0);
    let law = Law::Uniform { weight: 0.9, body_point: numbers.vector() };
    let term = Term { law, space: numbers.vector() };
    let body = body.with_driven_term(DrivenTerm {
        term,
        path: Path::Fixed,
        factor: Factor::Table(factor),
    });
    let body = pushed(body, numbers.skew(), false, burn);
    let body = pushed(body, numbers.skew(), true, held);
    let body = pushed(body, numbers.skew(), false, smooth);
    let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * 6.0 };
    let at_end = |stepper: &mut dyn Stepper<3>, steps: u64| {
        let (samples, end) = run(&body, stepper, &start, (1.0, steps));
        assert_eq!(end.ending, Ending::Completed);
        let last = samples.last().expect("samples").clone();
        let attitude = last.attitude.expect("carried");
        (State { attitude, momentum: last.momentum }, last)
    };
    let gauss8 = Tableau::gauss(8).expect("eight stages");
    let (truth, last) = at_end(&mut Vpd::new(gauss8, StopRule::default()), 60);
    assert!(last.energy_error.expect("energy").abs() < 3e-13, "{:?}", last.energy_error);
    let explicit = at_end(&mut Rk::new(Tableau::rk8(), true).expect("explicit"), 1200).0;
    let apart = distance(&truth, &explicit);
    assert!(apart < 1e-12, "{apart:e} from an explicit method");
    for method in driven_methods() {
        let coarse = match method.order as u32 {
            3 => 256,
            4 => 48,
            2 => 96,
            6 => 24,
            _ => 14,
        };
        // Not multiples of each other: knots fall elsewhere in the steps.
        let counts = [coarse, coarse * 3 / 2, coarse * 2 + 1, coarse * 3 + 1];
        let errors: Vec<(f64, f64)> = counts
            .iter()
            .map(|&steps| {
                let (end, last) = at_end((method.three)().as_mut(), steps);
                let impulse = last.table_impulse_error.expect("tables").abs();
                // By two points and more a piece is integrated as it is: it is a cubic.
                let exact = if method.order < 4.0 { 1e-3 } else { 1e-15 };
                assert!(impulse < exact, "{}, {steps}: {impulse:e}", method.name);
                ((steps as f64).log2(), distance(&end, &truth))
            })
            .filter(|(_, error)| *error > 3e-12)
            .map(|(steps, error)| (steps, error.log2()))
            .collect();
        if errors.len() < 3 {
            continue;
        }
        let count = errors.len() as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| errors.iter().map(of).sum::<f64>() / count;
        let (x, y) = (mean(|e| e.0), mean(|e| e.1));
        let slope = errors.iter().map(|e| (e.0 - x) * (e.1 - y)).sum::<f64>()
            / errors.iter().map(|e| (e.0 - x) * (e.0 - x)).sum::<f64>();
        println!("{}: {:.2} for {}", method.name, -slope, method.order);
        // Parts of a step differ in length from one number of steps to the next.
        assert!(-slope > method.order - 0.5, "{}: {slope}", method.name);
    }
}

/// A step that fails in a later part leaves the state, the work and the impulse of its beginning.
#[test]
fn a_cut_step_that_fails_has_not_moved() {
    // Known until the middle of the third step, with a knot before.
    let late = table(&[0.0, 0.21, 0.25], &[1.0, 2.0, 3.0], Interpolation::Linear);
    let free = RigidBody::<3>::new(Kinetic::of_moments([1.0, 2.0, 3.0]), Vec::new(), 0.0);
    let body = pushed(free, so::hat(&[0.1, 0.7, 0.3]), false, late);
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, -0.2, 0.5]) };
    for method in driven_methods() {
        let name = method.name;
        let (samples, end) = run(&body, (method.three)().as_mut(), &start, (0.4, 4));
        let Ending::Failed(failure) = &end.ending else { panic!("{name}: {:?}", end.ending) };
        assert_eq!(failure.code, FailureCode::OutsideTable, "{name}");
        assert_eq!((end.reached.step, samples.len()), (2, 3), "{name}");
        let (_, two) = run(&body, (method.three)().as_mut(), &start, (0.2, 2));
        let (failed, whole) = (end.reached.state(), two.reached.state());
        assert!(distance(&failed, &whole) < 1e-15, "{name}");
        // Where samples are rare, the last is taken after the failure.
        let schedule = Schedule { step_s: 0.1, steps: 4, every: 100 };
        let mut rare = Vec::new();
        let stepper = &mut (method.three)();
        let end = integrate(&body, stepper.as_mut(), &start, schedule, ALL, &mut rare, |_| true);
        assert!(matches!(end.map(|end| end.ending), Ok(Ending::Failed(_))), "{name}");
        let (last, before) = (rare.last().expect("samples"), &samples[2]);
        assert_eq!(
            (last.step, last.work, last.impulse),
            (2, before.work, before.impulse),
            "{name}"
        );
        assert!((last.momentum - before.momentum).amax() < 1e-15, "{name}");
    }
}

/// Members of an ensemble go over knots as they do alone, to the bit.
#[test]
fn members_meet_knots_as_they_do_alone() {
    let free = RigidBody::<3>::new(Kinetic::of_moments([1.0, 2.0, 3.0]), Vec::new(), 0.0);
    let burn =
        table(&[0.0, 0.33, 0.34, 0.77, 2.0], &[0.0, 0.0, 5.0, 1.0, 0.0], Interpolation::Monotone);
    let body = pushed(free, so::hat(&[0.1, 0.7, 0.3]), true, burn);
    let mut numbers = Numbers(9);
    let starts: Vec<State<3>> =
        (0..5).map(|_| State { attitude: numbers.rotation(), momentum: numbers.skew() }).collect();
    let stepper = || Box::new(Vpd::<3>::new(Tableau::gauss(2).expect("two"), StopRule::default()));
    let mut members = Sequential::new(std::array::from_fn(|_| stepper() as Box<dyn Stepper<3>>));
    let schedule = Schedule { step_s: 0.1, steps: 20, every: 1 };
    let mut seen = vec![Vec::new(); starts.len()];
    let ends = ensemble::integrate(
        &body,
        &mut members,
        &starts,
        schedule,
        ALL,
        |m, sample| {
            seen[m].push(sample.clone());
            Ok::<_, Infallible>(())
        },
        |_| true,
    );
    assert!(ends.is_ok());
    for (start, seen) in starts.iter().zip(seen) {
        let (alone, _) = run(&body, stepper().as_mut(), start, (2.0, 20));
        assert_eq!(alone, seen);
    }
}

/// Bodies that rest, that are pushed out of it, that are braked to it, and that hardly move at all.
#[test]
fn bodies_at_rest_stay_and_set_off() {
    fn law<const N: usize>(make: fn(&Method) -> Box<dyn Stepper<N>>) {
        let moments = std::array::from_fn(|i| 0.5 + 0.1 * i as f64);
        let free = RigidBody::<N>::new(Kinetic::of_second_moments(moments), Vec::new(), 0.0);
        let inertia = moments[0] + moments[1];
        let at_rest = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let moving =
            |momentum: f64| State { momentum: about_z::<N>() * momentum, ..at_rest.clone() };
        let ramp = table(&[0.0, 0.5, 1.0], &[0.0, 0.0, 1.0], Interpolation::Linear);
        let brake = table(&[0.0, 1.0, 1.0, 2.0], &[-0.5, -0.5, 0.0, 0.0], Interpolation::Linear);
        let torque = |table| Torque::Table { along: about_z(), spatial: false, table };
        let viscous = Mat::from_fn(|i, j| if i == j { 0.0 } else { 0.1 });
        let scenes = [
            ("none", free.clone(), at_rest.clone(), 0.0),
            ("viscous", free.clone().with_torque(Torque::Viscous(viscous)), at_rest.clone(), 0.0),
            (
                "of momentum",
                free.clone().with_torque(Torque::OfMomentum(0.3)),
                at_rest.clone(),
                0.0,
            ),
            ("ramp", free.clone().with_torque(torque(ramp.clone())), at_rest.clone(), 0.25),
            ("braked", free.clone().with_torque(torque(brake)), moving(0.5), 0.0),
            ("denormal", free.clone(), moving(5e-324), 5e-324),
            ("tiny", free.clone(), moving(1e-200), 1e-200),
            (
                "tiny, damped",
                free.clone().with_torque(Torque::OfMomentum(0.5)),
                moving(1e-15),
                1e-15 * (-0.5_f64).exp(),
            ),
        ];
        for (scene, body, start, momentum) in scenes {
            let is_driven = body.is_driven();
            for method in methods().into_iter().filter(|m| !is_driven || m.can_be_driven()) {
                if method.beyond.is_none() {
                    continue;
                }
                let name = format!("{scene}, n = {N}, {}", method.name);
                let (_, end) = run(&body, make(&method).as_mut(), &start, (1.0, 32));
                assert_eq!(end.ending, Ending::Completed, "{name}");
                let found = end.reached.momentum[(1, 0)];
                // By the order of the method, of h 0.5.
                let allowed = match scene {
                    "tiny, damped" => 1e-15 * 0.016_f64.powf(method.order).max(1e-12),
                    _ => 2e-15 * inertia,
                };
                assert!((found - momentum).abs() <= allowed, "{name}: {found:e} for {momentum:e}");
                let rest = end.reached.momentum - about_z::<N>() * found;
                assert!(rest.amax() <= 1e-16, "{name}: {rest}");
            }
        }
    }
    law::<3>(|method| (method.three)());
    law::<4>(|method| (method.beyond.as_ref().expect("any n").0)());
    law::<5>(|method| (method.beyond.as_ref().expect("any n").1)());
}

/// Where a ramp sets a body off, some unknowns are solved long before the rest: Newton's method goes on for these.
#[test]
fn newtons_method_alone_sets_a_body_off() {
    let ramp = table(&[0.0, 0.5, 1.0], &[0.0, 0.0, 1.0], Interpolation::Linear);
    let body = RigidBody::<3>::new(Kinetic::of_moments([1.0, 1.0, 1.5]), Vec::new(), 0.0);
    let body = pushed(body, about_z(), false, ramp);
    let start = State { attitude: Mat::identity(), momentum: Mat::zeros() };
    let stop = StopRule { rungs: Rungs::Newton, ..StopRule::default() };
    for stages in 1..=8 {
        for steps in [10, 50, 100, 125, 250, 1000] {
            let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
            let (_, end) = run(&body, &mut Vpd::<3>::new(tableau, stop), &start, (1.0, steps));
            let name = format!("{stages} stages, {steps} steps");
            assert_eq!(end.ending, Ending::Completed, "{name}");
            let found = end.reached.momentum[(1, 0)];
            assert!((found - 0.25).abs() <= 1e-15 * steps as f64, "{name}: {found}");
        }
    }
}

/// A momentum that falls by ten a second for 80 s ends below the smallest number, and no step on the way fails.
#[test]
fn what_is_damped_away_is_gone() {
    fn law<const N: usize>(make: fn(&Method) -> Box<dyn Stepper<N>>) {
        let moments = std::array::from_fn(|i| 0.5 + 0.1 * i as f64);
        let free = RigidBody::<N>::new(Kinetic::of_second_moments(moments), Vec::new(), 0.0);
        let body = free.with_torque(Torque::OfMomentum(10.0));
        let momentum = Numbers(41).skew() * 0.3;
        let start = State { attitude: Mat::identity(), momentum };
        for method in driven_methods() {
            let (_, end) = run(&body, make(&method).as_mut(), &start, (80.0, 5120));
            assert_eq!(end.ending, Ending::Completed, "n = {N}, {}", method.name);
            let left = end.reached.momentum.amax();
            assert!(left < 1e-300, "n = {N}, {}: {left:e}", method.name);
        }
    }
    law::<3>(|method| (method.three)());
    law::<5>(|method| (method.beyond.as_ref().expect("any n").1)());
}

/// A body at the minimum of its springs, but for the rounding of their torques, stays there.
#[test]
fn a_body_at_the_bottom_stays_there() {
    let mut numbers = Numbers(12);
    let moments = [0.5, 0.6, 0.7, 0.8, 0.9];
    let attitude: Mat<5> = numbers.rotation();
    let body_point: Vector<5> = numbers.vector();
    let law = Law::Spring { stiffness: 3.0, rest_length: 0.0, body_point };
    let term = Term { law, space: so::to_space(&attitude, &body_point) };
    let body = RigidBody::<5>::new(Kinetic::of_second_moments(moments), vec![term], 0.0);
    let start = State { attitude, momentum: Mat::zeros() };
    for stages in 1..=8 {
        let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
        let mut stepper = Vpd::<5>::new(tableau, StopRule::default());
        let (samples, end) = run(&body, &mut stepper, &start, (4.0, 64));
        assert_eq!(end.ending, Ending::Completed);
        let most = samples.iter().map(|s| s.momentum.amax()).fold(0.0, f64::max);
        assert!(most < 1e-14, "{stages} stages: {most:e}");
    }
}

/// A thin body, turned by 0.01 to 0.1 rad a step: the solver of n = 3 goes as far as the one in matrices, and the momentum
/// about the axis stays, as does the length of the whole.
#[test]
fn thin_bodies_are_solved() {
    for (thin, step_s) in
        [(1e-3, 0.2), (1e-4, 0.2), (1e-5, 0.1), (1e-6, 0.1), (1e-7, 0.05), (1e-8, 0.02)]
    {
        let body = RigidBody::<3>::new(Kinetic::of_moments([1.0, 1.0, thin]), Vec::new(), 0.0);
        let momentum = so::hat(&[0.3, 0.4, 0.1 * thin]);
        let start = State { attitude: Mat::identity(), momentum };
        for stages in [1, 2, 4, 8] {
            let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
            let mut stepper = VpdSo3::new(tableau, StopRule::default()).expect("lanes");
            let (samples, end) = run(&body, &mut stepper, &start, (100.0 * step_s, 100));
            let name = format!("J3 = {thin:e}, {stages} stages");
            assert_eq!(end.ending, Ending::Completed, "{name}");
            let drift = samples.iter().filter_map(|s| s.momentum_drift).fold(0.0, f64::max);
            assert!(drift < 2e-15, "{name}: {drift:e}");
            let axial = end.reached.momentum[(1, 0)];
            // A rounding of the whole turns the body about its thin axis, and that moves the whole.
            let known = 1e-13_f64.max(1e-19 / thin);
            assert!((axial - 0.1 * thin).abs() < known, "{name}: {axial:e}");
        }
    }
}
