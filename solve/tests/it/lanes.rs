//! VPD for n = 3 in lanes: the same map as in matrices, the same bits on every instruction set (and those of Gauss
//! collocation on quaternions); and the rungs of the solver.

use std::collections::BTreeSet;

use fearless_simd::{Level, Simd};
use vpd_solve::ensemble::Members;
use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd_solve::nonlinear::{Rung, Rungs, StopRule};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::explicit_so3::{ExplicitEnsemble, ExplicitSo3};
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::splitting::Splitting;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_plane::{Plane, VpdPlane};
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vpd_so3::ensemble::VpdEnsemble;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::stepper::{Knots, Stepper};
use vpd_solve::tableau::Tableau;

use crate::driven;
use crate::given::{Numbers, dipole};
use crate::laws::{self, advance};

fn tableaux() -> Vec<Tableau> {
    let gauss = (1..=8).filter_map(Tableau::gauss);
    gauss.chain([Tableau::rk3(), Tableau::rk4()]).collect()
}

fn in_lanes(tableau: &Tableau, with_attitude: bool) -> VpdSo3 {
    let full = VpdSo3::new(tableau.clone(), StopRule::default()).expect("at most 8 stages");
    if with_attitude { full } else { full.reduced(false) }
}

/// A thin free body.
fn free() -> RigidBody<3> {
    let moments = [1.01, 1.0, 0.01];
    RigidBody::new(Kinetic::of_moments(moments), Vec::new(), 0.0)
}

#[test]
fn lanes_and_matrices_make_the_same_step() {
    let mut numbers = Numbers(7);
    let body = laws::body::<3>(&mut numbers);
    let mut worst = 0.0_f64;
    for tableau in tableaux() {
        for h in [0.02, 0.2] {
            let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * 4.0 };
            let mut matrices = Vpd::new(tableau.clone(), StopRule::default());
            let lanes = advance(&mut in_lanes(&tableau, true), &body, &start, &[h]);
            let matrices = advance(&mut matrices, &body, &start, &[h]);
            let attitude = (lanes.attitude - matrices.attitude).amax();
            let momentum = (lanes.momentum - matrices.momentum).amax();
            worst = worst.max(attitude).max(momentum);
        }
    }
    println!("largest difference of a step: {worst:e}");
    assert!(worst < 1e-13, "{worst:e}");
}

#[test]
fn the_reduced_form_in_lanes_is_that_in_matrices() {
    let mut numbers = Numbers(8);
    let body = free();
    for tableau in tableaux() {
        let start = State { attitude: Mat::identity(), momentum: numbers.skew() };
        let (mut lanes, stop) = (in_lanes(&tableau, false), StopRule::default());
        let mut matrices = VpdReduced::new(tableau, stop, false);
        for stepper in [&mut lanes as &mut dyn Stepper<3>, &mut matrices] {
            stepper.start(&start);
            stepper.step(&body, 0.02).expect("a small step");
        }
        let difference = (lanes.momentum() - matrices.momentum()).amax();
        assert!(difference < 1e-14, "{difference:e}");
        assert_eq!(lanes.attitude(), None);
    }
}

/// |mu| labels the coadjoint orbit of a free body for n = 3.
#[test]
fn the_reduced_form_stays_on_its_orbit() {
    let (body, mut numbers) = (free(), Numbers(10));
    for stages in [1, 2, 4, 8] {
        let mut stepper = in_lanes(&Tableau::gauss(stages).expect("a few stages"), false);
        stepper.start(&State { attitude: Mat::identity(), momentum: numbers.skew() });
        let length = |stepper: &VpdSo3| so::inner(&stepper.momentum(), &stepper.momentum()).sqrt();
        let before = length(&stepper);
        for _ in 0..100_000 {
            stepper.step(&body, 0.02).expect("a small step");
        }
        let change = (length(&stepper) / before - 1.0).abs();
        println!("{stages} stages: |mu| kept to {change:.1e} over 1e5 steps");
        assert!(change <= 1e-12, "{change:e}");
    }
}

/// The instruction sets of this machine.
fn levels() -> Vec<Level> {
    let detected = Level::new();
    #[cfg(target_arch = "x86_64")]
    let levels = [
        Some(Level::baseline()),
        detected.as_sse4_2().map(Simd::level),
        detected.as_avx2().map(Simd::level),
        detected.as_avx512().map(Simd::level),
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let levels = [Some(Level::baseline()), Some(detected)];
    let levels: Vec<Level> = levels.into_iter().flatten().collect();
    assert!(levels.len() >= 2 || cfg!(not(target_arch = "x86_64")), "only one instruction set");
    levels
}

#[test]
fn every_instruction_set_makes_the_same_bits() {
    let levels = levels();
    let (body, start) = dipole();
    // In a plane, where most numbers are zeros: these have a sign.
    let in_plane = State { momentum: so::hat(&[-0.1, -0.0, -0.0]), ..start };
    for start in [start, in_plane] {
        let end = |tableau: &Tableau, level: Option<Level>| {
            let mut stepper = in_lanes(tableau, true).on_level(level);
            let end = advance(&mut stepper, &body, &start, &[0.03; 50]);
            (bits(&end.attitude), bits(&end.momentum), stepper.sigma_min().map(f64::to_bits))
        };
        for tableau in tableaux() {
            let without_lanes = end(&tableau, None);
            for &level in &levels {
                assert_eq!(end(&tableau, Some(level)), without_lanes, "{level:?}");
            }
        }
        let on_quaternions = |stages: usize, level: Option<Level>| {
            let stepper = QuaternionGauss::new(stages, StopRule::default()).expect("1 to 8");
            let end = advance(&mut stepper.on_level(level), &body, &start, &[0.03; 50]);
            (bits(&end.attitude), bits(&end.momentum))
        };
        for stages in 1..=8 {
            let without_lanes = on_quaternions(stages, None);
            for &level in &levels {
                assert_eq!(on_quaternions(stages, Some(level)), without_lanes, "{level:?}");
            }
        }
    }
}

/// The step in any dimension has the same bits on every instruction set.
#[test]
fn matrices_in_lanes_have_the_same_bits_on_every_instruction_set() {
    fn law<const N: usize>() {
        let mut numbers = Numbers(21);
        let body = crate::laws::body::<N>(&mut numbers);
        let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
        for stages in 1..=8 {
            let end = |level: Option<Level>| {
                let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
                let stepper = Vpd::new(tableau, StopRule::default());
                // Steps that go on from the last one, and short ones, which start from the last nine.
                let steps = [[0.03; 20], [0.003; 20]].concat();
                let end = advance(&mut stepper.on_level(level), &body, &start, &steps);
                (bits(&end.attitude), bits(&end.momentum))
            };
            let without_lanes = end(None);
            for level in levels() {
                assert_eq!(end(Some(level)), without_lanes, "n = {N}, {stages} stages, {level:?}");
            }
        }
    }
    law::<4>();
    law::<5>();
    law::<6>();
    law::<8>();
}

/// So have driven bodies and wheels for n = 3, and their work.
#[test]
fn driven_bodies_have_the_same_bits_on_every_instruction_set() {
    for body in
        [driven::changing::<3>(), driven::pushed(), driven::in_streams(), driven::with_wheels()]
    {
        for tableau in tableaux() {
            let end = |level: Option<Level>| {
                let mut stepper = in_lanes(&tableau, true).on_level(level);
                let end = advance(&mut stepper, &body, &driven::start(), &[0.03; 30]);
                let numbers = [stepper.work(), stepper.table_impulse()].map(f64::to_bits);
                let impulse = stepper.impulse().expect("it has a clock");
                (bits(&end.attitude), bits(&end.momentum), numbers, bits(&impulse))
            };
            let without_lanes = end(None);
            for level in levels() {
                assert_eq!(end(Some(level)), without_lanes, "{level:?}");
            }
        }
    }
}

fn bits<const N: usize>(m: &Mat<N>) -> Vec<u64> {
    m.iter().map(|x| x.to_bits()).collect()
}

#[test]
fn a_free_body_keeps_its_spatial_momentum() {
    let mut numbers = Numbers(9);
    let body = free();
    let start = State { attitude: numbers.rotation(), momentum: numbers.skew() };
    for (stages, step_s) in [(3, 0.02), (8, 0.02), (8, 0.03)] {
        let mut stepper = in_lanes(&Tableau::gauss(stages).expect("up to 8 stages"), true);
        stepper.start(&start);
        let momentum = |stepper: &VpdSo3| {
            so::conjugate(&stepper.attitude().expect("carried"), &stepper.momentum())
        };
        let before = momentum(&stepper);
        for _ in 0..10_000 {
            stepper.step(&body, step_s).expect("a solvable step");
        }
        let lost = (momentum(&stepper) - before).amax();
        println!("{stages} stages, {step_s} s: {lost:e}");
        // Only the rounding of the reading is left.
        assert!(lost < 2e-15, "{stages} stages, {step_s} s: {lost:e}");
    }
}

/// Newton's method makes the step that the sweeps make.
#[test]
fn newton_and_sweeps_agree_where_both_get_there() {
    let (body, start) = dipole();
    let rule = |rungs| StopRule { rungs, ..StopRule::default() };
    for stages in [2, 3] {
        let tableau = || Tableau::gauss(stages).expect("a few stages");
        let steppers = |rungs| -> Vec<Box<dyn Stepper<3>>> {
            vec![
                Box::new(VpdSo3::new(tableau(), rule(rungs)).expect("a few stages")),
                Box::new(Vpd::new(tableau(), rule(rungs))),
                Box::new(VpdLagrangian::new(tableau(), rule(rungs))),
                Box::new(Vrkmk::new(tableau(), rule(rungs))),
            ]
        };
        let pairs = steppers(Rungs::FixedPoint).into_iter().zip(steppers(Rungs::Newton));
        for (k, (mut sweeps, mut newton)) in pairs.enumerate() {
            newton.start(&start);
            let solved = newton.step(&body, 0.05).expect("a step of moderate size");
            assert_eq!(solved.rung, Rung::Newton);
            assert!(solved.iterations <= 8, "{} corrections", solved.iterations);
            let newton = State {
                attitude: newton.attitude().expect("carried"),
                momentum: newton.momentum(),
            };
            let sweeps = advance(sweeps.as_mut(), &body, &start, &[0.05]);
            let difference = (newton.attitude - sweeps.attitude).amax();
            assert!(difference < 2e-15, "{k}: {difference:e}");
            assert!((newton.momentum - sweeps.momentum).amax() < 2e-15, "{k}");
        }
    }
}

/// In a plane Newton's method solves the steps of a pendulum itself; steps that it left would be explicit.
#[test]
fn newtons_method_solves_planar_steps() {
    let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
    let law = Law::Uniform { weight: 1.0, body_point: vertical };
    let weight = Term { law, space: vertical };
    let body = RigidBody::new(Kinetic::of_moments([1.0, 1.2, 0.8]), vec![weight], 0.0);
    let attitude = so::exp(&so::hat(&[1.0, 0.0, 0.0]));
    let start = State { attitude, momentum: so::hat(&[0.5, 0.0, 0.0]) };
    let plane = Plane::of(&body, &start).expect("it swings about one axis");
    for (stages, h) in [(1, 0.05), (2, 0.05), (1, 0.4), (2, 0.4)] {
        let tableau = Tableau::gauss(stages).expect("a few stages");
        let stop = StopRule { rungs: Rungs::Newton, ..StopRule::default() };
        let left = Box::new(Rk::new(Tableau::rk4(), false).expect("explicit"));
        let mut stepper = VpdPlane::new(plane.clone(), tableau, stop, left);
        stepper.start(&start);
        let mut corrections = 0;
        for step in 0..1000 {
            let solved = stepper.step(&body, h).expect("a step of moderate size");
            assert_eq!(solved.rung, Rung::Newton, "{stages} stages, {h}, step {step}");
            corrections += solved.iterations;
        }
        let mean = f64::from(corrections) / 1000.0;
        println!("{stages} stages, h = {h}: {mean} corrections a step");
        assert!(mean <= 5.0, "{stages} stages, {h}: {mean}");
    }
}

/// GL4 and GL6 at h = 0.125, 8 stages at h = 0.25: large steps are solved, and Newton's method takes few
/// corrections.
#[test]
fn large_steps_are_solved() {
    let (body, start) = dipole();
    for (stages, h, steps, most) in
        [(2, 0.125, 8_000, Some(5.0)), (3, 0.125, 8_000, Some(5.0)), (8, 0.25, 4_000, None)]
    {
        let tableau = || Tableau::gauss(stages).expect("a few stages");
        for rungs in [Rungs::FixedPoint, Rungs::Newton] {
            let rule = StopRule { rungs, ..StopRule::default() };
            let mut stepper = VpdSo3::new(tableau(), rule).expect("a few stages");
            stepper.start(&start);
            let mut iterations = 0;
            for step in 0..steps {
                let solved = stepper.step(&body, h);
                let solved =
                    solved.unwrap_or_else(|failure| panic!("{stages}, {step}: {failure:?}"));
                iterations += solved.iterations;
            }
            let mean = f64::from(iterations) / f64::from(steps);
            println!("{stages} stages, h = {h}, {rungs:?}: {mean:.2} a step");
            if let (Rungs::Newton, Some(most)) = (rungs, most) {
                assert!(mean <= most, "{mean}");
            }
        }
    }
}

/// The largest energy error of the dipole over `steps` steps of 0.1 with 8 stages.
fn energy_error(stepper: &mut dyn Stepper<3>, steps: u32) -> f64 {
    let (body, start) = dipole();
    let initial = body.energy(&start.attitude, &start.momentum).total();
    stepper.start(&start);
    let mut largest = 0.0_f64;
    for _ in 0..steps {
        stepper.step(&body, 0.1).expect("a step of moderate size");
        let attitude = stepper.attitude().expect("carried");
        let error = body.energy(&attitude, &stepper.momentum()).total() - initial;
        largest = largest.max(error.abs());
    }
    largest
}

#[test]
fn carried_sums_leave_no_drift() {
    let eight = || Tableau::gauss(8).expect("8 stages");
    let quaternions = energy_error(&mut in_lanes(&eight(), true), 100_000);
    let matrices = energy_error(&mut Vpd::new(eight(), StopRule::default()), 100_000);
    println!("1e5 steps: {quaternions:e} in quaternions, {matrices:e} in matrices");
    assert!(quaternions <= 3e-14, "{quaternions:e}");
    assert!(matrices <= 3e-14, "{matrices:e}");
}

/// Every member of an ensemble ends with the bits of its own run, or with its failure.
#[test]
fn members_are_their_own_runs_bit_for_bit() {
    let (body, start) = dipole();
    for (stages, h) in [(1, 0.02), (2, 0.05), (3, 0.1), (4, 0.1), (6, 0.15), (8, 0.2)] {
        let mut numbers = Numbers(stages as u64 + 11);
        // The last turns too fast for the step: it is stepped by itself, and fails.
        let states: Vec<State<3>> = (0..7)
            .map(|m| {
                let size = if m == 6 { 60.0 } else { 0.1 };
                let attitude = start.attitude * so::exp(&(numbers.skew() * 0.3));
                State { attitude, momentum: numbers.skew() * size }
            })
            .collect();
        let failures = together_and_alone(&body, &states, stages, h);
        assert!(failures.iter().all(|(m, _)| *m == 6), "{failures:?}");
    }
}

/// As above for bodies that are driven, steps that end at knots of their tables among them, and for wheels.
#[test]
fn driven_members_are_their_own_runs_bit_for_bit() {
    for body in
        [driven::changing::<3>(), driven::pushed(), driven::in_streams(), driven::with_wheels()]
    {
        for stages in [1, 2, 3, 4, 6] {
            let mut numbers = Numbers(stages as u64 + 41);
            // The last is stepped by itself, and fails.
            let states: Vec<State<3>> = (0..7)
                .map(|m| {
                    let size = if m == 6 { 900.0 } else { 2.0 };
                    State { attitude: numbers.rotation(), momentum: numbers.skew() * size }
                })
                .collect();
            let failures = together_and_alone(&body, &states, stages, 0.013);
            assert!(failures.iter().all(|(m, _)| *m == 6), "{failures:?}");
        }
    }
}

/// As above where sweeps solve a step that is refused: one member rests where it all but meets a
/// charge, too weak to push it.
#[test]
fn a_member_that_is_solved_and_refused_is_refused_as_by_itself() {
    let up = Vector::<3>::new(0.0, 0.0, 1.0);
    let charge = Term { law: Law::PointSource { strength: 1e-60, body_point: up }, space: up };
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 });
    let ball = RigidBody::new(Kinetic::Principal { weights }, vec![charge], 0.0);
    for stages in 1..=4 {
        let states: Vec<State<3>> = (0..8)
            .map(|m| {
                let (tilt, spin) = if m == 3 { (1e-9, 0.0) } else { (0.1, 0.1 * f64::from(m)) };
                State {
                    attitude: so::exp(&so::hat(&[tilt, 0.0, 0.0])),
                    momentum: so::hat(&[0.0, 0.0, spin]),
                }
            })
            .collect();
        let failures = together_and_alone(&ball, &states, stages, 0.1);
        assert_eq!(Vec::from_iter(failures), [(3, "potential_singularity")]);
    }
}

/// Makes a hundred steps of the members together and of each by itself, without lanes; returns
/// which fail, and how.
fn together_and_alone(
    body: &RigidBody<3>,
    states: &[State<3>],
    stages: usize,
    h: f64,
) -> BTreeSet<(usize, &'static str)> {
    let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
    let ensemble = VpdEnsemble::new(&tableau, StopRule::default()).expect("1 to 8 stages");
    let own = in_lanes(&tableau, true).on_level(None);
    compare(&format!("{stages} stages"), body, states, h, &ensemble, &own)
}

/// As above, of any method. A member that has failed tries again for a while, and then is left behind.
fn compare<M: Members<3> + Clone, S: Stepper<3> + Clone>(
    name: &str,
    body: &RigidBody<3>,
    states: &[State<3>],
    h: f64,
    ensemble: &M,
    own: &S,
) -> BTreeSet<(usize, &'static str)> {
    let mut ensemble = ensemble.clone();
    ensemble.start(states);
    let mut going: Vec<usize> = (0..states.len()).collect();
    let mut together = Vec::new();
    let mut alone: Vec<S> = states
        .iter()
        .map(|state| {
            let mut stepper = own.clone();
            stepper.start(state);
            stepper
        })
        .collect();
    // Looked at after each step, and by another at times only: between them its lanes are ahead of its members.
    let mut unseen = ensemble.clone();
    let mut failures = BTreeSet::new();
    for step in 0..100 {
        let begun_s = f64::from(step) * h;
        unseen.step(body, begun_s, h, &going, &mut |_, _| {});
        ensemble.step(body, begun_s, h, &going, &mut |m, result| together.push((m, result)));
        assert_eq!(together.len(), going.len());
        for (m, result) in together.drain(..) {
            let own = Knots::default().step(body, &mut alone[m], begun_s, h);
            let own = own.map_err(|failure| failure.code);
            let result = result.map_err(|failure| failure.code);
            assert_eq!(own, result, "{name}, step {step}, member {m}");
            failures.extend(result.err().map(|code| (m, code.as_str())));
        }
        if step == 50 {
            going.retain(|m| failures.iter().all(|(failed, _)| failed != m));
        }
        let looked_at = [Some(&mut ensemble), (step % 7 == 1).then_some(&mut unseen)];
        for ensemble in looked_at.into_iter().flatten() {
            for (m, stepper) in alone.iter().enumerate() {
                let member = ensemble.member(m);
                assert_eq!(
                    stepper.attitude().as_ref().map(bits),
                    member.attitude().as_ref().map(bits),
                    "{name}, step {step}, member {m}"
                );
                assert_eq!(bits(&stepper.momentum()), bits(&member.momentum()));
                assert_eq!(stepper.sigma_min(), member.sigma_min());
                assert_eq!(stepper.work().to_bits(), member.work().to_bits());
                assert_eq!(stepper.table_impulse().to_bits(), member.table_impulse().to_bits());
                assert_eq!(
                    stepper.impulse().as_ref().map(bits),
                    member.impulse().as_ref().map(bits)
                );
            }
        }
    }
    println!("{name}, h = {h}: {failures:?}");
    failures
}

/// Every explicit method in vectors, and the same in matrices.
fn explicit() -> Vec<(String, ExplicitSo3, Box<dyn Stepper<3>>)> {
    let mut methods: Vec<(String, ExplicitSo3, Box<dyn Stepper<3>>)> = Vec::new();
    for (name, tableau) in
        [("rk3", Tableau::rk3()), ("rk4", Tableau::rk4()), ("rk8", Tableau::rk8())]
    {
        for projected in [false, true] {
            let vectors = ExplicitSo3::rk(tableau.clone(), projected).expect("explicit");
            let matrices = Rk::new(tableau.clone(), projected).expect("explicit");
            methods.push((
                format!("rk {name}, projected: {projected}"),
                vectors,
                Box::new(matrices),
            ));
        }
        let vectors = ExplicitSo3::rkmk(tableau.clone()).expect("explicit");
        let matrices = Rkmk::new(tableau).expect("explicit");
        methods.push((format!("rkmk {name}"), vectors, Box::new(matrices)));
    }
    for order in [2, 4, 6, 8] {
        let vectors = ExplicitSo3::splitting(order).expect("even");
        let matrices = Splitting::new(order).expect("even");
        methods.push((format!("splitting {order}"), vectors, Box::new(matrices)));
    }
    methods
}

/// On a body with one term of each kind, in principal axes and in others.
#[test]
fn explicit_methods_in_vectors_make_the_step_in_matrices() {
    let mut numbers = Numbers(71);
    let principal = laws::body::<3>(&mut numbers);
    let tensor = Mat::<3>::new(2.0, 0.3, -0.1, 0.3, 1.5, 0.2, -0.1, 0.2, 1.0);
    let tensor = Kinetic::of_tensor(tensor).expect("symmetric and positive definite");
    let up = Vector::<3>::new(0.0, 0.0, 1.0);
    let law = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.1, 0.2, 1.0) };
    let turned = RigidBody::new(tensor, vec![Term { law, space: up }], 0.0);
    for body in [principal, turned] {
        let mut differ = 0;
        for h in [0.01, 0.1] {
            let start = State { attitude: numbers.rotation(), momentum: numbers.skew() * 2.0 };
            for (name, mut vectors, mut matrices) in explicit() {
                let vectors = advance(&mut vectors, &body, &start, &[h; 3]);
                let matrices = advance(matrices.as_mut(), &body, &start, &[h; 3]);
                let apart = (vectors.attitude - matrices.attitude).amax();
                let apart = apart.max((vectors.momentum - matrices.momentum).amax());
                assert!(apart < 2e-14, "{name}, h = {h}: {apart:e}");
                differ += u32::from(apart > 0.0);
            }
        }
        // Else all steps in vectors were in doubt, and this compared nothing.
        assert!(differ > 5, "{differ}");
    }
}

/// So with what drives a body, and what that puts in. Stages by [`Rk`] are off the group, where torques in space are of another
/// form.
#[test]
fn explicit_methods_in_vectors_make_the_driven_step_in_matrices() {
    for body in
        [driven::changing::<3>(), driven::pushed(), driven::in_streams(), driven::with_wheels()]
    {
        for (name, mut vectors, mut matrices) in explicit() {
            if !name.starts_with("rk") {
                continue;
            }
            let ends = [&mut vectors as &mut dyn Stepper<3>, matrices.as_mut()].map(|stepper| {
                let end = advance(stepper, &body, &driven::start(), &[0.005; 4]);
                let put_in = [stepper.work(), stepper.table_impulse()];
                (end, put_in, stepper.impulse().expect("it has a clock"))
            });
            let [(end, put_in, impulse), (other, other_put_in, other_impulse)] = ends;
            let apart = (end.attitude - other.attitude).amax();
            let apart = apart.max((end.momentum - other.momentum).amax());
            let apart = apart.max((impulse - other_impulse).amax());
            let works = put_in.iter().zip(&other_put_in).map(|(a, b)| (a - b).abs());
            let apart = works.fold(apart, f64::max);
            println!("{name}: {apart:.1e}");
            let off_group = if name.starts_with("rkmk") { 0.0 } else { 1e-6 };
            assert!(apart < 1e-13 + off_group, "{name}: {apart:e}");
        }
    }
}

/// Every member of an ensemble of an explicit method ends with the bits of its own run, or with its failure.
#[test]
fn explicit_members_are_their_own_runs_bit_for_bit() {
    let (body, start) = dipole();
    for (name, method, _) in explicit() {
        for level in levels().into_iter().map(Some).chain([None]) {
            let ensemble = ExplicitEnsemble::new(method.clone()).on_level(level);
            for count in [1, 3, 7, 8] {
                let mut numbers = Numbers(count as u64 + 11);
                let states: Vec<State<3>> = (0..count)
                    .map(|_| State {
                        attitude: start.attitude * so::exp(&(numbers.skew() * 0.3)),
                        // Some turn too fast for a step in vectors.
                        momentum: numbers.skew() * if numbers.next() > 0.5 { 1.0 } else { 0.1 },
                    })
                    .collect();
                let failures = compare(&name, &body, &states, 0.02, &ensemble, &method);
                assert!(name.contains("projected: true") || failures.is_empty(), "{failures:?}");
            }
        }
    }
}

/// As above for bodies that are driven, steps that end at knots of their tables among them, and for wheels.
#[test]
fn driven_explicit_members_are_their_own_runs_bit_for_bit() {
    for body in
        [driven::changing::<3>(), driven::pushed(), driven::in_streams(), driven::with_wheels()]
    {
        for (name, method, _) in explicit().into_iter().filter(|(name, ..)| name.starts_with("rk"))
        {
            let mut numbers = Numbers(43);
            let states: Vec<State<3>> = (0..7)
                .map(|_| State { attitude: numbers.rotation(), momentum: numbers.skew() * 2.0 })
                .collect();
            let ensemble = ExplicitEnsemble::new(method.clone());
            let failures = compare(&name, &body, &states, 0.013, &ensemble, &method);
            assert!(failures.is_empty(), "{failures:?}");
        }
    }
}

/// One member rests where it all but meets a charge, another turns too fast; the others go on as by themselves.
#[test]
fn an_explicit_member_that_fails_leaves_the_others_alone() {
    let up = Vector::<3>::new(0.0, 0.0, 1.0);
    let charge = Term { law: Law::PointSource { strength: 1e-60, body_point: up }, space: up };
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 });
    let ball = RigidBody::new(Kinetic::Principal { weights }, vec![charge], 0.0);
    let states: Vec<State<3>> = (0..8)
        .map(|m| {
            let (tilt, spin) = match m {
                3 => (1e-9, 0.0),
                5 => (0.1, 1e300),
                m => (0.1, 0.1 * f64::from(m)),
            };
            State {
                attitude: so::exp(&so::hat(&[tilt, 0.0, 0.0])),
                momentum: so::hat(&[0.0, 0.0, spin]),
            }
        })
        .collect();
    for (name, method, _) in explicit() {
        let ensemble = ExplicitEnsemble::new(method.clone());
        let failures = compare(&name, &ball, &states, 0.1, &ensemble, &method);
        let failed: Vec<usize> = failures.iter().map(|(m, _)| *m).collect();
        assert_eq!(failed, [3, 5], "{name}: {failures:?}");
        assert!(failures.contains(&(3, "potential_singularity")), "{name}: {failures:?}");
    }
}
