//! Speed next to accuracy, as ratios in one run: `cargo bench --bench ratios`; a part alone by its name, as in
//! `cargo bench --bench ratios -- largest_steps`.
//!
//! All on the dipole of the scenarios unless said otherwise; errors are |g - g_ref| + |p - p_ref|. Times are the least of
//! several repeats, in which all candidates take turns: the machine may be shared.

use std::time::Instant;

use fearless_simd::Level;
use serde_json::Value;
use vpd_solve::ensemble::Members;
use vpd_solve::hamiltonian::{
    DrivenTerm, Factor, Interpolation, Kinetic, Law, Path, RigidBody, Table, Term, Torque,
};
use vpd_solve::nonlinear::{Rungs, StopRule};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::explicit_so3::{ExplicitEnsemble, ExplicitSo3};
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::splitting::Splitting;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vpd_so3::ensemble::VpdEnsemble;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;

fn main() {
    let parts: [(&str, fn()); 11] = [
        ("against_vrkmk", against_vrkmk),
        ("one_trajectory", one_trajectory),
        ("any_dimension", any_dimension),
        ("driven", driven),
        ("free_bodies", free_bodies),
        ("long_run", long_run),
        ("ensembles", ensembles),
        ("explicit_ensembles", explicit_ensembles),
        ("ensemble_on_all_cores", ensemble_on_all_cores),
        ("largest_steps", largest_steps),
        ("growth", growth),
    ];
    // Arguments that cargo passes itself begin with dashes.
    let asked: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    for (name, part) in parts {
        if asked.is_empty() || asked.iter().any(|asked| asked == name) {
            part();
        }
    }
}

fn say(line: &str) {
    use std::io::Write;
    // A reader that has gone away is no failure of a bench.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn dipole() -> (RigidBody<3>, State<3>) {
    let moments = [1.01, 1.0, 0.01];
    let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
    let charge = Vector::<3>::new(0.0, 0.0, -1.5);
    let source = |strength: f64| Term {
        law: Law::PointSource { strength, body_point: Vector::<3>::new(0.0, 0.1 * strength, -1.0) },
        space: charge,
    };
    let weight = Term { law: Law::Uniform { weight: 1.0, body_point: vertical }, space: vertical };
    let terms = vec![weight, source(1.0), source(-1.0)];
    let attitude = Mat::<3>::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let start = State { attitude, momentum: so::hat(&[0.0, 0.0, -0.01]) };
    (RigidBody::new(Kinetic::of_moments(moments), terms, 0.0), start)
}

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn in_lanes(stages: usize, rungs: Rungs) -> VpdSo3 {
    let stop = StopRule { rungs, ..StopRule::default() };
    VpdSo3::new(gauss(stages), stop).expect("at most 8 stages")
}

/// The end after `steps` of `h`, and the iterations of a step; `None` if one fails.
fn end(
    stepper: &mut dyn Stepper<3>,
    (body, start): &(RigidBody<3>, State<3>),
    h: f64,
    steps: usize,
) -> Option<(State<3>, f64)> {
    stepper.start(start);
    let mut iterations = 0;
    for _ in 0..steps {
        iterations += stepper.step(body, h).ok()?.iterations;
    }
    let attitude = stepper.attitude()?;
    Some((State { attitude, momentum: stepper.momentum() }, f64::from(iterations) / steps as f64))
}

fn difference(a: &State<3>, b: &State<3>) -> f64 {
    let momentum = so::inner(&(a.momentum - b.momentum), &(a.momentum - b.momentum)).sqrt();
    let attitude = (a.attitude - b.attitude).singular_values().max();
    attitude + momentum
}

/// Seconds for `steps` steps.
fn seconds(
    stepper: &mut dyn Stepper<3>,
    scene: &(RigidBody<3>, State<3>),
    h: f64,
    steps: usize,
) -> f64 {
    let begun = Instant::now();
    end(stepper, scene, h, steps);
    begun.elapsed().as_secs_f64()
}

/// A method with a tableau and a step, what it reaches at t = 0.5, and its time for a unit of time.
struct Candidate {
    name: &'static str,
    stages: usize,
    steps: usize,
    error: f64,
    us: f64,
    stepper: Box<dyn Stepper<3>>,
}

fn against_vrkmk() {
    say("\n## VPD against VRKMK at equal error at t = 0.5 (us for a unit of time)\n");
    let scene = dipole();
    let reference = end(&mut in_lanes(8, Rungs::Both), &scene, 0.5 / 64.0, 64).expect("solvable").0;
    let mut candidates = Vec::new();
    for stages in 1..=8 {
        for steps in [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1024] {
            let vrkmk = Vrkmk::<3>::new(gauss(stages), StopRule::default());
            let pair: [(_, Box<dyn Stepper<3>>); 2] =
                [("vpd", Box::new(in_lanes(stages, Rungs::Both))), ("vrkmk", Box::new(vrkmk))];
            for (name, mut stepper) in pair {
                let Some((state, _)) = end(stepper.as_mut(), &scene, 0.5 / steps as f64, steps)
                else {
                    continue;
                };
                let error = difference(&state, &reference);
                candidates.push(Candidate {
                    name,
                    stages,
                    steps,
                    error,
                    us: f64::INFINITY,
                    stepper,
                });
            }
        }
    }
    for _ in 0..7 {
        for Candidate { steps, us, stepper, .. } in &mut candidates {
            let repeats = (400 / *steps).max(1);
            let begun = Instant::now();
            for _ in 0..repeats {
                seconds(stepper.as_mut(), &scene, 0.5 / *steps as f64, *steps);
            }
            *us = us.min(begun.elapsed().as_secs_f64() * 2e6 / repeats as f64);
        }
    }
    let best = |name: &str, stages: Option<usize>, target: f64| {
        let reaching = candidates.iter().filter(|c| {
            c.name == name && c.error <= target && stages.is_none_or(|stages| c.stages == stages)
        });
        reaching.min_by(|a, b| a.us.total_cmp(&b.us))
    };
    say("| error | vpd | us | vrkmk | us | ratio |\n|---|---|---|---|---|---|");
    for target in [1e-4, 1e-6, 1e-8, 1e-10, 1e-12] {
        if let (Some(ours), Some(theirs)) = (best("vpd", None, target), best("vrkmk", None, target))
        {
            let row = |c: &Candidate| format!("gauss{}, 1/{}", c.stages, 2 * c.steps);
            say(&format!(
                "| {target:.0e} | {} | {:.1} | {} | {:.1} | {:.1} |",
                row(ours),
                ours.us,
                row(theirs),
                theirs.us,
                theirs.us / ours.us
            ));
        }
    }
    say("\nThe same tableau: time of vrkmk for that of vpd.\n");
    say("| tableau | 1e-4 | 1e-6 | 1e-8 | 1e-10 | 1e-12 |\n|---|---|---|---|---|---|");
    for stages in 1..=8 {
        let cells: Vec<String> = [1e-4, 1e-6, 1e-8, 1e-10, 1e-12]
            .iter()
            .map(|&target| {
                let pair = (best("vpd", Some(stages), target), best("vrkmk", Some(stages), target));
                match pair {
                    (Some(ours), Some(theirs)) => format!("{:.1}", theirs.us / ours.us),
                    _ => "-".to_owned(),
                }
            })
            .collect();
        say(&format!("| gauss{stages} | {} |", cells.join(" | ")));
    }
}

/// A point of the reference that the tests use.
fn known(point: &str) -> State<3> {
    let data: Value = serde_json::from_str(include_str!("../tests/data/dipole-reference.json"))
        .expect("the reference is JSON");
    let point = data.pointer(point).expect("a point");
    let number = |v: &Value| v.as_str().and_then(|text| text.parse().ok()).expect("a number");
    let momentum: Vec<f64> = (0..3).map(|i| number(&point["ptilde"][i])).collect();
    State { attitude: Mat::from_fn(|i, j| number(&point["g"][i][j])), momentum: so::hat(&momentum) }
}

fn one_trajectory() {
    say("\n## One trajectory (ns a step, us for a unit of time)\n");
    let scene = dipole();
    let short = known("/points/0.5");
    let long = known("/as_doubles/points/50");
    say(
        "The error at t = 50 is mostly rounding, grown a million times: the median, least and largest of 21 runs, of ten \
         steps fewer to ten steps more.\n",
    );
    say(
        "| tableau | h | tolerance | iterations | ns a step | us a unit | error t = 0.5 | error t = 50 |\n|---|---|---|---|---|---|---|---|",
    );
    for (stages, h, tolerance) in [
        (2, 0.01, 1e-15),
        (3, 0.01, 1e-15),
        (2, 0.125, 1e-15),
        (3, 0.125, 1e-15),
        (4, 0.1, 1e-15),
        (8, 0.1, 1e-15),
        (8, 0.2, 1e-15),
        (8, 0.2, 1e-14),
        (8, 0.2, 1e-13),
        (8, 0.2, 1e-12),
        (8, 0.25, 1e-15),
    ] {
        let stop = StopRule { tolerance, ..StopRule::default() };
        let mut stepper = VpdSo3::new(gauss(stages), stop).expect("at most 8 stages");
        let at = |stepper: &mut VpdSo3, t: f64| {
            let steps = (t / h).round() as usize;
            // A step that does not divide the time has no error there.
            ((steps as f64 * h - t).abs() < 1e-9).then(|| end(stepper, &scene, h, steps)).flatten()
        };
        let show =
            |error: Option<f64>| error.map_or("-".to_owned(), |error| format!("{error:.1e}"));
        let early = at(&mut stepper, 0.5).map(|found| difference(&found.0, &short));
        let iterations = at(&mut stepper, 50.0).map_or(f64::NAN, |found| found.1);
        let count = (50.0 / h).round() as usize;
        let mut errors: Vec<f64> = (count - 10..=count + 10)
            .filter_map(|steps| end(&mut stepper, &scene, 50.0 / steps as f64, steps))
            .map(|found| difference(&found.0, &long))
            .collect();
        errors.sort_by(f64::total_cmp);
        let late = (errors.len() == 21)
            .then(|| format!("{:.1e} ({:.1e} to {:.1e})", errors[10], errors[0], errors[20]));
        let steps = (50.0 / h) as usize;
        let least =
            (0..15).map(|_| seconds(&mut stepper, &scene, h, steps)).fold(f64::INFINITY, f64::min);
        say(&format!(
            "| gauss{stages} | {h} | {tolerance:.0e} | {iterations:.2} | {:.0} | {:.1} | {} | {} |",
            least * 1e9 / steps as f64,
            least * 1e6 / (steps as f64 * h),
            show(early),
            late.unwrap_or("-".to_owned()),
        ));
    }
}

/// The integrator for free bodies, without an attitude, against the full one with it.
/// A satellite whose pull comes from a fixed direction, from one on a circular or an elliptic orbit, next to a torque by a
/// table, and with a wheel; and the Lagrangian form.
fn satellites() -> [(&'static str, RigidBody<3>); 6] {
    let moments = [1.0, 1.4, 1.7];
    let matrix = Mat::from_diagonal(&Vector::<3>::from(moments));
    let motion = 0.5_f64;
    let law = Law::GravityGradient { strength: 3.0 * motion * motion, matrix };
    let toward = Vector::<3>::new(1.0, 0.0, 0.0);
    let term = Term { law, space: toward };
    let free = || RigidBody::new(Kinetic::of_moments(moments), Vec::new(), 0.0);
    let fixed = || RigidBody::new(Kinetic::of_moments(moments), vec![term.clone()], 0.0);
    let orbit = |eccentricity| Path::Orbit {
        across: Vector::<3>::new(0.0, 1.0, 0.0),
        mean_motion: motion,
        eccentricity,
        mean_anomaly: 0.3,
        node_rate: 0.0,
    };
    let on = |path| DrivenTerm { term: term.clone(), path, factor: Factor::Constant };
    let table = Table::new(vec![0.0, 1e6], vec![[1e-3], [2e-3]], Interpolation::Linear);
    let along = so::hat(&[0.3, 0.5, 0.2]);
    let push = Torque::Table { along, spatial: false, table };
    let wheels = so::hat(&[0.1, 0.2, 0.3]);
    [
        ("fixed", fixed()),
        ("circular orbit", free().with_driven_term(on(orbit(0.0)))),
        ("elliptic orbit", free().with_driven_term(on(orbit(0.1)))),
        ("fixed, torque by a table", fixed().with_torque(push)),
        ("fixed, wheels", fixed().with_wheels(wheels)),
        ("circular orbit, wheels", free().with_driven_term(on(orbit(0.0))).with_wheels(wheels)),
    ]
}

/// Times of a step in ns, all in turn: each scene alone and in ensembles of eight, in parts of the fixed one.
fn driven() {
    say(
        "\n## Driven bodies and wheels: a step next to that of a fixed term (ns, and as a ratio)\n",
    );
    say("The last column is the Lagrangian form of the same scene next to the Hamiltonian one.\n");
    say(
        "| scene | tableau | h | alone | ratio | a member of eight | ratio | Lagrangian | ratio |\n|---|---|---|---|---|---|---|---|---|",
    );
    let steps = 4000;
    for (stages, h) in [(1, 0.02), (2, 0.02), (2, 0.1), (3, 0.1), (4, 0.2), (8, 0.4)] {
        let scenes = satellites();
        let starts: Vec<State<3>> = (0..8)
            .map(|m| State {
                attitude: so::exp(&so::hat(&[0.1, 0.05 * f64::from(m), 0.2])),
                momentum: so::hat(&[0.2, 0.5 + 0.02 * f64::from(m), -0.3]),
            })
            .collect();
        let everybody: Vec<usize> = (0..8).collect();
        let mut least = vec![[f64::INFINITY; 3]; scenes.len()];
        for _ in 0..7 {
            for ((_, body), least) in scenes.iter().zip(&mut least) {
                let mut alone: [Box<dyn Stepper<3>>; 2] = [
                    Box::new(in_lanes(stages, Rungs::Both)),
                    Box::new(VpdLagrangian::new(gauss(stages), StopRule::default())),
                ];
                for (stepper, place) in alone.iter_mut().zip([0, 2]) {
                    stepper.start(&starts[0]);
                    let begun = Instant::now();
                    for k in 0..steps {
                        stepper.set_time(f64::from(k) * h);
                        stepper.step(body, h).expect("a moderate step");
                    }
                    least[place] = least[place].min(begun.elapsed().as_secs_f64());
                }
                let mut members = VpdEnsemble::new(&gauss(stages), StopRule::default()).expect("8");
                members.start(&starts);
                let begun = Instant::now();
                for k in 0..steps / 4 {
                    members.step(body, f64::from(k) * h, h, &everybody, &mut |_, result| {
                        result.expect("a moderate step");
                    });
                }
                least[1] = least[1].min(begun.elapsed().as_secs_f64() / 2.0);
            }
        }
        for ((name, _), own) in scenes.iter().zip(&least) {
            let ns = own.map(|seconds| seconds / f64::from(steps) * 1e9);
            say(&format!(
                "| {name} | gauss{stages} | {h} | {:.0} | {:.2} | {:.0} | {:.2} | {:.0} | {:.2} |",
                ns[0],
                own[0] / least[0][0],
                ns[1],
                own[1] / least[0][1],
                ns[2],
                own[2] / own[0],
            ));
        }
    }
}

fn free_bodies() {
    say("\n## The reduced form without an attitude against the full one with it, on a free body\n");
    say(
        "| n | tableau | h | full: ns a step | sweeps | reduced: ns a step | sweeps | full / reduced | momenta differ at t = 100 by | energy error, full | reduced |\n|---|---|---|---|---|---|---|---|---|---|---|",
    );
    for (stages, h) in
        [(1, 0.01), (2, 0.01), (2, 0.05), (2, 0.1), (3, 0.1), (4, 0.1), (4, 0.2), (8, 0.2)]
    {
        let mut full = in_lanes(stages, Rungs::Both);
        let mut reduced = full.clone().reduced(false);
        free_body::<3>(stages, h, [&mut full, &mut reduced]);
    }
    in_matrices::<4>(2, 0.01);
    in_matrices::<4>(2, 0.05);
    in_matrices::<4>(4, 0.1);
    in_matrices::<5>(2, 0.01);
}

/// VPD and VRKMK with the same tableau, on two springs in n dimensions.
fn any_dimension() {
    say("\n## VPD against VRKMK in n dimensions: us a step, and the error at t = 1\n");
    say(
        "| n | tableau | h | vpd | rounds | error | vrkmk | error | ratio |\n|---|---|---|---|---|---|---|---|---|",
    );
    for (stages, h) in [(2, 0.02), (4, 0.1), (8, 0.2)] {
        two_springs::<4>(stages, h);
        two_springs::<5>(stages, h);
        two_springs::<6>(stages, h);
        two_springs::<8>(stages, h);
        two_springs::<16>(stages, h);
    }
}

fn two_springs<const N: usize>(stages: usize, h: f64) {
    let weights =
        Mat::<N>::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (2.0 + 0.2 * (i + j) as f64) });
    let vector = |a: f64, b: f64| Vector::<N>::from_fn(|i, _| a + b * (i as f64 * 1.7).sin());
    let spring = |stiffness, rest_length, body_point, space| Term {
        law: Law::Spring { stiffness, rest_length, body_point },
        space,
    };
    let terms = vec![
        spring(0.8, 0.4, vector(0.1, 0.6), vector(1.0, -0.4)),
        spring(0.5, 0.1, vector(-0.3, 0.5), vector(-1.2, 0.3)),
    ];
    let body = RigidBody::new(Kinetic::Principal { weights }, terms, 0.0);
    let above = Mat::<N>::from_fn(|i, j| if i < j { 1.0 / (1 + i + j) as f64 } else { 0.0 });
    let momentum = above - above.transpose();
    let omega = body.velocity(&momentum);
    // One radian a second.
    let momentum = momentum / so::inner(&omega, &omega).sqrt();
    let start = State { attitude: Mat::identity(), momentum };
    let ahead = |stepper: &mut dyn Stepper<N>, h: f64| {
        stepper.start(&start);
        for _ in 0..(1.0 / h).round() as usize {
            stepper.step(&body, h).expect("solvable");
        }
        (stepper.attitude().expect("carried"), stepper.momentum())
    };
    let truth = ahead(&mut Vpd::new(gauss(8), StopRule::default()), 0.05);
    let mut vpd = Vpd::new(gauss(stages), StopRule::default());
    let mut vrkmk = Vrkmk::new(gauss(stages), StopRule::default());
    let mut errors = [0.0; 2];
    let mut least = [f64::INFINITY; 2];
    let mut rounds = 0;
    let steps = 20_000 / (N * N) + 20;
    for _ in 0..7 {
        for (k, stepper) in [&mut vpd as &mut dyn Stepper<N>, &mut vrkmk].into_iter().enumerate() {
            let end = ahead(stepper, h);
            errors[k] = (end.0 - truth.0).norm() + (end.1 - truth.1).norm();
            stepper.start(&start);
            let begun = Instant::now();
            let mut count = 0;
            for _ in 0..steps {
                count += stepper.step(&body, h).expect("solvable").iterations;
            }
            least[k] = least[k].min(begun.elapsed().as_secs_f64());
            rounds = if k == 0 { count } else { rounds };
        }
    }
    let us = |k: usize| least[k] * 1e6 / steps as f64;
    say(&format!(
        "| {N} | gauss{stages} | {h} | {:.2} | {:.2} | {:.1e} | {:.1} | {:.1e} | {:.1} |",
        us(0),
        f64::from(rounds) / steps as f64,
        errors[0],
        us(1),
        errors[1],
        us(1) / us(0),
    ));
}

fn in_matrices<const N: usize>(stages: usize, h: f64) {
    let mut full = Vpd::<N>::new(gauss(stages), StopRule::default());
    let mut reduced = VpdReduced::new(gauss(stages), StopRule::default(), false);
    free_body(stages, h, [&mut full, &mut reduced]);
}

fn free_body<const N: usize>(stages: usize, h: f64, mut steppers: [&mut dyn Stepper<N>; 2]) {
    let weights =
        Mat::<N>::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.5 * (i + j) as f64) });
    let body = RigidBody::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
    let above = Mat::<N>::from_fn(|i, j| if i < j { 1.0 / (1 + i + j) as f64 } else { 0.0 });
    let start = State { attitude: Mat::identity(), momentum: above - above.transpose() };
    let energy = |momentum: &Mat<N>| body.energy(&start.attitude, momentum).total();
    let steps = (100.0 / h).round() as usize;
    let mut least = [f64::INFINITY; 2];
    let mut ends = [(Mat::zeros(), 0.0); 2];
    for _ in 0..7 {
        for (k, stepper) in steppers.iter_mut().enumerate() {
            stepper.start(&start);
            let begun = Instant::now();
            let mut sweeps = 0;
            for _ in 0..steps {
                sweeps += stepper.step(&body, h).expect("solvable").iterations;
            }
            least[k] = least[k].min(begun.elapsed().as_secs_f64());
            ends[k] = (stepper.momentum(), f64::from(sweeps) / steps as f64);
        }
    }
    let [a, b] = &ends;
    let error = |momentum| (energy(momentum) - energy(&start.momentum)).abs();
    say(&format!(
        "| {N} | gauss{stages} | {h} | {:.0} | {:.2} | {:.0} | {:.2} | {:.2} | {:.1e} | {:.1e} | {:.1e} |",
        least[0] * 1e9 / steps as f64,
        a.1,
        least[1] * 1e9 / steps as f64,
        b.1,
        least[0] / least[1],
        (a.0 - b.0).amax(),
        error(&a.0),
        error(&b.0),
    ));
}

fn on_quaternions(stages: usize) -> QuaternionGauss {
    QuaternionGauss::new(stages, StopRule::default()).expect("1 to 8 stages")
}

/// The most accurate runs: the cost of an error, and the energy.
fn long_run() {
    at_equal_error();
    say("\n## Energy over 1,000,000 steps, looked at after each\n");
    say(
        "| method | h | largest error, 1e5 steps | 1e6 steps | at the end | sweeps a step |\n|---|---|---|---|---|---|",
    );
    for (stages, h) in [(6, 0.1), (8, 0.1), (8, 0.2)] {
        energy(&format!("vpd gauss{stages}"), &mut in_lanes(stages, Rungs::Both), h);
        energy(&format!("quaternion_gauss gauss{stages}"), &mut on_quaternions(stages), h);
    }
}

fn energy(name: &str, stepper: &mut dyn Stepper<3>, h: f64) {
    let (body, start) = dipole();
    stepper.start(&start);
    let initial = body.energy(&start.attitude, &start.momentum).total();
    let (mut largest, mut early, mut last, mut sweeps) = (0.0_f64, 0.0, 0.0, 0_u64);
    for step in 1..=1_000_000 {
        sweeps += u64::from(stepper.step(&body, h).expect("solvable").iterations);
        let attitude = stepper.attitude().expect("an attitude");
        last = body.energy(&attitude, &stepper.momentum()).total() - initial;
        largest = largest.max(last.abs());
        if step == 100_000 {
            early = largest;
        }
    }
    say(&format!(
        "| {name} | {h} | {early:.1e} | {largest:.1e} | {last:.1e} | {:.2} |",
        sweeps as f64 / 1e6
    ));
}

/// A method with a tolerance and a number of steps, what it reaches at t = 50, its time for a unit of time, and its sweeps.
struct Run {
    name: &'static str,
    stepper: Box<dyn Stepper<3>>,
    tolerance: f64,
    steps: usize,
    error: f64,
    us: f64,
    sweeps: f64,
}

/// Eight stages in lanes at an error of 1e-10 at t = 50: which step gets there, and its time.
fn at_equal_error() {
    say("\n## Eight stages: error at t = 50 and time (us for a unit of time)\n");
    say(
        "The error is the median of 41 runs, of twenty steps fewer to twenty steps more: rounding grows a million times. The \
         ratio is that of the cheapest rows with at most 1e-10.\n",
    );
    say(
        "| method | tolerance | steps | h | error | us | ns a step | sweeps |\n|---|---|---|---|---|---|---|---|",
    );
    let scene = dipole();
    let reference = known("/as_doubles/points/50");
    let mut rows: Vec<Run> = Vec::new();
    let tolerances = [1e-15, 1e-13, 1e-12];
    let steps = [180, 190, 200, 220, 250, 300, 400];
    for (tolerance, steps) in tolerances.into_iter().flat_map(|t| steps.map(|steps| (t, steps))) {
        let stop = StopRule { tolerance, ..StopRule::default() };
        let vpd = VpdSo3::new(gauss(8), stop).expect("at most 8 stages");
        let gauss = QuaternionGauss::new(8, stop).expect("at most 8 stages");
        let pair: [(&'static str, Box<dyn Stepper<3>>); 2] =
            [("vpd", Box::new(vpd)), ("quaternion_gauss", Box::new(gauss))];
        for (name, mut stepper) in pair {
            let run = |count: usize| end(stepper.as_mut(), &scene, 50.0 / count as f64, count);
            let ends: Vec<_> = (steps - 20..=steps + 20).filter_map(run).collect();
            let mut errors: Vec<f64> =
                ends.iter().map(|(state, _)| difference(state, &reference)).collect();
            errors.sort_by(f64::total_cmp);
            if errors.len() == 41 {
                rows.push(Run {
                    name,
                    stepper,
                    tolerance,
                    steps,
                    error: errors[20],
                    us: f64::INFINITY,
                    sweeps: ends[20].1,
                });
            }
        }
    }
    for _ in 0..40 {
        for Run { stepper, steps, us, .. } in &mut rows {
            let once = seconds(stepper.as_mut(), &scene, 50.0 / *steps as f64, *steps);
            *us = us.min(once * 1e6 / 50.0);
        }
    }
    for Run { name, tolerance, steps, error, us, sweeps, .. } in &rows {
        let (h, ns) = (50.0 / *steps as f64, us * 5e4 / *steps as f64);
        say(&format!(
            "| {name} | {tolerance:.0e} | {steps} | {h:.4} | {error:.1e} | {us:.2} | {ns:.0} | {sweeps:.2} |"
        ));
    }
    let cheapest = |of: &str| {
        let reaching = rows.iter().filter(|run| run.name == of && run.error <= 1e-10);
        reaching.map(|run| run.us).fold(f64::INFINITY, f64::min)
    };
    let (ours, theirs) = (cheapest("vpd"), cheapest("quaternion_gauss"));
    say(&format!("\nvpd {ours:.2}, quaternion_gauss {theirs:.2}: ratio {:.2}", ours / theirs));
}

/// Eight members that begin about where the dipole does.
fn spread() -> Vec<State<3>> {
    let (_, start) = dipole();
    let turned = |m: i32| {
        let turn = so::exp(&so::hat(&[0.01 * f64::from(m), -0.02, 0.005 * f64::from(m)]));
        State { attitude: start.attitude * turn, momentum: start.momentum }
    };
    (0..8).map(turned).collect()
}

/// Each thread with eight members at a time, as ensembles run: one step of eight stages to t = 0.5.
fn ensemble_on_all_cores() {
    const GROUPS: usize = 2000;
    let (scene, h) = (dipole(), 0.5);
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get);
    let states = spread();
    say(&format!(
        "\n## Ensembles to t = 0.5, one step of gauss8 (us a unit and member)\n\n| tolerance | error | one core | {cores} |\n|---|---|---|---|"
    ));
    for tolerance in [1e-15, 1e-13, 1e-12] {
        let stop = StopRule { tolerance, ..StopRule::default() };
        let mut alone = VpdSo3::new(gauss(8), stop).expect("8 stages");
        let error = end(&mut alone, &scene, h, 1).expect("solvable").0;
        let error = difference(&error, &known("/points/0.5"));
        let group = || {
            // A body of its own: it counts its torques.
            let (body, _) = dipole();
            let mut ensemble = VpdEnsemble::new(&gauss(8), stop).expect("8 stages");
            let everybody: Vec<usize> = (0..states.len()).collect();
            for _ in 0..GROUPS {
                ensemble.start(&states);
                ensemble.step(&body, 0.0, h, &everybody, &mut |_, result| assert!(result.is_ok()));
            }
        };
        let times = [1, cores].map(|threads| {
            let once = |_| {
                let begun = Instant::now();
                std::thread::scope(|scope| {
                    for _ in 0..threads {
                        scope.spawn(group);
                    }
                });
                begun.elapsed().as_secs_f64()
            };
            let least = (0..7).map(once).fold(f64::INFINITY, f64::min);
            least * 1e6 / ((threads * GROUPS * states.len()) as f64 * h)
        });
        say(&format!("| {tolerance:.0e} | {error:.1e} | {:.2} | {:.2} |", times[0], times[1]));
    }
}

fn ensembles() {
    say("\n## Eight members in lanes against one at a time, a core (us a unit and member)\n");
    say(
        "Alone a member has its stages in lanes; in pairs, with SSE2, two of them at a time; without lanes one number after \
         the other, compiled for any x86-64. Three stages leave one of four lanes idle where they are in lanes.\n",
    );
    say(
        "| tableau | h | in lanes | alone | in pairs | without lanes | alone / lanes | in pairs / lanes | without / lanes | without / alone |\n|---|---|---|---|---|---|---|---|---|---|",
    );
    let scene = dipole();
    let (body, _) = &scene;
    let states = spread();
    for (stages, h) in [(1, 0.01), (2, 0.01), (2, 0.05), (3, 0.05), (4, 0.1), (8, 0.1), (8, 0.25)] {
        let steps = (20.0 / h) as usize;
        let mut ensemble = VpdEnsemble::new(&gauss(stages), StopRule::default()).expect("8 stages");
        let level = [Some(Level::new()), Some(Level::baseline()), None];
        let mut steppers = level.map(|level| in_lanes(stages, Rungs::Both).on_level(level));
        let mut least = [f64::INFINITY; 4];
        let everybody: Vec<usize> = (0..states.len()).collect();
        for _ in 0..7 {
            ensemble.start(&states);
            let begun = Instant::now();
            for _ in 0..steps {
                // Steps that fail do so together as well as alone.
                ensemble.step(body, 0.0, h, &everybody, &mut |_, _| {});
            }
            least[0] = least[0].min(begun.elapsed().as_secs_f64());
            for (stepper, least) in steppers.iter_mut().zip(&mut least[1..]) {
                let begun = Instant::now();
                for state in &states {
                    stepper.start(state);
                    for _ in 0..steps {
                        let _ = stepper.step(body, h);
                    }
                }
                *least = least.min(begun.elapsed().as_secs_f64());
            }
        }
        let [together, alone, pairs, without] =
            least.map(|least| least * 1e6 / (steps as f64 * h * 8.0));
        say(&format!(
            "| gauss{stages} | {h} | {together:.2} | {alone:.2} | {pairs:.2} | {without:.2} | {:.2} | {:.2} | {:.2} | {:.2} |",
            alone / together,
            pairs / together,
            without / together,
            without / alone
        ));
    }
}

/// A method in vectors, and the same in matrices.
type Explicit = (Option<ExplicitSo3>, Box<dyn Stepper<3>>);

fn rk(tableau: Tableau, projected: bool) -> Explicit {
    let matrices = Rk::new(tableau.clone(), projected).expect("explicit");
    (ExplicitSo3::rk(tableau, projected), Box::new(matrices))
}

fn rkmk(tableau: Tableau) -> Explicit {
    let matrices = Rkmk::new(tableau.clone()).expect("explicit");
    (ExplicitSo3::rkmk(tableau), Box::new(matrices))
}

fn splitting(order: u32) -> Explicit {
    let matrices = Splitting::new(order).expect("even");
    (ExplicitSo3::splitting(order), Box::new(matrices))
}

fn explicit_ensembles() {
    say(
        "\n## Eight members of explicit methods in lanes against one at a time, a core (ns a step and member)\n",
    );
    say(
        "| method | h | in lanes | alone | in matrices | alone / lanes | matrices / lanes | matrices / alone |\n|---|---|---|---|---|---|---|---|",
    );
    let (body, _) = &dipole();
    let states = spread();
    let everybody: Vec<usize> = (0..states.len()).collect();
    let methods = [
        ("`rk`, `rk4`", 0.01, rk(Tableau::rk4(), false)),
        ("`rk`, `rk8`", 0.02, rk(Tableau::rk8(), false)),
        ("`rk_projected`, `rk4`", 0.01, rk(Tableau::rk4(), true)),
        ("`rk_projected`, `rk8`", 0.02, rk(Tableau::rk8(), true)),
        ("`rkmk`, `rk4`", 0.01, rkmk(Tableau::rk4())),
        ("`rkmk`, `rk8`", 0.02, rkmk(Tableau::rk8())),
        ("`splitting`, order 2", 0.01, splitting(2)),
        ("`splitting`, order 4", 0.01, splitting(4)),
        ("`splitting`, order 8", 0.02, splitting(8)),
    ];
    for (name, h, (vectors, mut matrices)) in methods {
        // Short, and often: on a machine that is shared a long stretch is never without others.
        let steps = 64;
        let mut alone = vectors.expect("few stages");
        let mut ensemble = ExplicitEnsemble::new(alone.clone());
        let mut least = [f64::INFINITY; 3];
        for _ in 0..300 {
            ensemble.start(&states);
            let begun = Instant::now();
            for _ in 0..steps {
                ensemble.step(body, 0.0, h, &everybody, &mut |_, _| {});
            }
            least[0] = least[0].min(begun.elapsed().as_secs_f64());
            let one_by_one: [&mut dyn Stepper<3>; 2] = [&mut alone, matrices.as_mut()];
            for (stepper, least) in one_by_one.into_iter().zip(&mut least[1..]) {
                let begun = Instant::now();
                for state in &states {
                    stepper.start(state);
                    for _ in 0..steps {
                        let _ = stepper.step(body, h);
                    }
                }
                *least = least.min(begun.elapsed().as_secs_f64());
            }
        }
        let [together, alone, matrices] = least.map(|least| least * 1e9 / (f64::from(steps) * 8.0));
        say(&format!(
            "| {name} | {h} | {together:.0} | {alone:.0} | {matrices:.0} | {:.1} | {:.1} | {:.2} |",
            alone / together,
            matrices / together,
            matrices / alone
        ));
    }
}

/// The largest step at which 10,000 steps are solved, by bisection, and whether the solver alone is the limit.
fn largest_steps() {
    say("\n## Largest step solved over 10,000 steps\n");
    say(
        "In matrices is the step of any n, here with n = 3; nested sweeps in lanes, Newton's method, and one after the other.\n",
    );
    say(
        "| scene | tableau | matrices | nested | newton | both | nested / matrices | both / matrices |\n|---|---|---|---|---|---|---|---|",
    );
    let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
    let body = |moments: [f64; 3], weight: f64| {
        let law = Law::Uniform { weight, body_point: vertical };
        RigidBody::new(Kinetic::of_moments(moments), vec![Term { law, space: vertical }], 0.0)
    };
    let tilt = so::exp(&so::hat(&[0.5, 0.0, 0.0]));
    let spinning = |spin: [f64; 3]| State { attitude: tilt, momentum: so::hat(&spin) };
    let scenes = [
        ("dipole", dipole()),
        ("heavy top", (body([1.0, 1.0, 0.5], 1.0), spinning([0.0, 0.1, 2.0]))),
        ("thin body", (body([1.0, 1.0, 1e-3], 1.0), spinning([0.1, 0.2, 1e-3]))),
    ];
    for (name, scene) in &scenes {
        for stages in [2, 3, 8] {
            let largest = |make: &dyn Fn() -> Box<dyn Stepper<3>>| {
                let (mut low, mut high) = (1e-3_f64, 4.0_f64);
                while high / low > 1.05 {
                    let middle = (low * high).sqrt();
                    match end(make().as_mut(), scene, middle, 10_000) {
                        Some(_) => low = middle,
                        None => high = middle,
                    }
                }
                low
            };
            let stop = StopRule { rungs: Rungs::FixedPoint, ..StopRule::default() };
            let matrices = largest(&|| Box::new(Vpd::<3>::new(gauss(stages), stop)));
            let [nested, newton, both] = [Rungs::FixedPoint, Rungs::Newton, Rungs::Both]
                .map(|rungs| largest(&|| Box::new(in_lanes(stages, rungs))));
            say(&format!(
                "| {name} | gauss{stages} | {matrices:.3} | {nested:.3} | {newton:.3} | {both:.3} | {:.1} | {:.1} |",
                nested / matrices,
                both / matrices
            ));
        }
    }
}

/// Shows how the time of a step grows with n and with the stages.
fn growth() {
    say("\n## Growth of a step with n (two stages, h = 0.01)\n");
    say("| n | ns a step | sweeps | power since the row above |\n|---|---|---|---|");
    fn row<const N: usize>(before: Option<(usize, f64)>) -> Option<(usize, f64)> {
        let weights =
            Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1.0 + 0.1 * (i + j) as f64) });
        let vector =
            |seed: f64| Vector::<N>::from_fn(|i, _| (seed * (i + 1) as f64).rem_euclid(1.0));
        let law = Law::Uniform { weight: 0.7, body_point: vector(0.414) };
        let terms = vec![Term { law, space: vector(0.236) }];
        let body = RigidBody::new(Kinetic::Principal { weights }, terms, 0.0);
        let momentum = so::asym(&Mat::from_fn(|i, j| (0.317 * (N * i + j) as f64).rem_euclid(1.0)));
        let momentum = momentum / so::inner(&momentum, &momentum).sqrt();
        let mut stepper = Vpd::<N>::new(gauss(2), StopRule::default());
        let (mut least, mut sweeps) = (f64::INFINITY, 0.0);
        for _ in 0..5 {
            stepper.start(&State { attitude: Mat::identity(), momentum });
            let begun = Instant::now();
            let mut iterations = 0;
            for _ in 0..100 {
                iterations += stepper.step(&body, 0.01).map_or(0, |solved| solved.iterations);
            }
            least = least.min(begun.elapsed().as_secs_f64() * 1e7);
            sweeps = f64::from(iterations) / 100.0;
        }
        let power = before.map_or("-".to_owned(), |(n, ns)| {
            format!("{:.2}", (least / ns).ln() / (N as f64 / n as f64).ln())
        });
        say(&format!("| {N} | {least:.0} | {sweeps:.1} | {power} |"));
        Some((N, least))
    }
    let mut before = row::<4>(None);
    before = row::<8>(before);
    before = row::<16>(before);
    row::<32>(before);
}
