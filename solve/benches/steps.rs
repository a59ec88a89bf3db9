//! Nanoseconds of a step, and of its parts: `cargo bench --bench steps`.
//!
//! For a speed next to the accuracy it is reached at: `cargo bench --bench ratios`.

use divan::{Bencher, black_box};
use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::tableau::Tableau;

fn main() {
    divan::main();
}

/// A body with a weight and a charge, turning at about one radian a second.
fn body<const N: usize>() -> (RigidBody<N>, State<N>) {
    let weights =
        Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.1 * (i + j) as f64) });
    let vector = |seed: f64| Vector::<N>::from_fn(|i, _| (seed * (i + 1) as f64).rem_euclid(1.0));
    let terms = vec![
        Term { law: Law::Uniform { weight: 0.7, body_point: vector(0.414) }, space: vector(0.236) },
        Term {
            law: Law::PointSource { strength: 0.5, body_point: vector(0.732) },
            space: vector(0.646) * 3.0,
        },
    ];
    let momentum = so::asym(&Mat::from_fn(|i, j| (0.317 * (N * i + j) as f64).rem_euclid(1.0)));
    let momentum = momentum / so::inner(&momentum, &momentum).sqrt();
    (
        RigidBody::new(Kinetic::Principal { weights }, terms, 0.0),
        State { attitude: Mat::identity(), momentum },
    )
}

fn bench_steps<const N: usize>(bencher: Bencher, mut stepper: impl Stepper<N>) {
    let (body, start) = body::<N>();
    stepper.start(&start);
    bencher.bench_local(|| stepper.step(black_box(&body), 0.01).expect("a small step"));
}

/// n = 3, the stages in lanes.
#[divan::bench(args = 1..=8)]
fn step_for_three(bencher: Bencher, stages: usize) {
    let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
    let stepper = VpdSo3::new(tableau, StopRule::default()).expect("at most 8 stages");
    bench_steps(bencher, stepper);
}

/// Any n, two stages.
#[divan::bench(consts = [3, 4, 5, 8, 16])]
fn step<const N: usize>(bencher: Bencher) {
    let tableau = Tableau::gauss(2).expect("2 stages");
    bench_steps(bencher, Vpd::<N>::new(tableau, StopRule::default()));
}

/// n = 4.
#[divan::bench(args = 1..=8)]
fn step_in_four_dimensions(bencher: Bencher, stages: usize) {
    let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
    bench_steps(bencher, Vpd::<4>::new(tableau, StopRule::default()));
}

#[divan::bench(consts = [3, 4, 5, 8, 16])]
fn polar<const N: usize>(bencher: Bencher) {
    let a = Mat::<N>::identity() + body::<N>().1.momentum * 0.1;
    bencher.bench_local(|| so::polar(black_box(&a)));
}

#[divan::bench(consts = [3, 4, 5, 8, 16])]
fn lyapunov<const N: usize>(bencher: Bencher) {
    let c = body::<N>().1.momentum;
    let m = Mat::<N>::identity() + c.transpose() * c * 0.01;
    bencher.bench_local(|| so::lyapunov(black_box(&m), black_box(&c), &Mat::zeros()));
}

/// The floor: work that no method can do without.
#[divan::bench(consts = [3, 4, 5, 8, 16])]
fn gradient<const N: usize>(bencher: Bencher) {
    let (body, start) = body::<N>();
    let mut seen = Vec::new();
    body.seen_from(&start.attitude, &mut seen);
    bencher.bench_local(|| body.gradient_seen(black_box(&start.attitude), black_box(&seen)));
}
