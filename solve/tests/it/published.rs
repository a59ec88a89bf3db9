//! Answers that others have published or that are known in closed form, next to those of every method that can run the
//! case: the table of `docs/cross-checks.md`, printed by
//! `cargo test --release -p vpd-solve published -- --nocapture`.

use std::fmt::Write as _;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion};
use vpd_solve::hamiltonian::{DrivenTerm, Factor, Kinetic, Law, Path, RigidBody, Term, Torque};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::lgvi::Lgvi;
use vpd_solve::stepper::quaternion_gauss::QuaternionGauss;
use vpd_solve::stepper::rk::Rk;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::splitting::Splitting;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::State;

type Make = fn() -> Box<dyn Stepper<3>>;

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

/// Of each family one of order 8, and whether it can run what changes with time, is pushed or has wheels.
const METHODS: [(&str, Make, bool); 9] = [
    ("vpd, n = 3 in lanes", || Box::new(VpdSo3::new(gauss(4), stop()).expect("few stages")), false),
    ("vpd", || Box::new(Vpd::new(gauss(4), stop())), true),
    ("vpd_lagrangian", || Box::new(VpdLagrangian::new(gauss(4), stop())), true),
    ("vrkmk", || Box::new(Vrkmk::new(gauss(4), stop())), true),
    ("quaternion_gauss", || Box::new(QuaternionGauss::new(4, stop()).expect("4 stages")), false),
    ("splitting", || Box::new(Splitting::new(8).expect("even")), false),
    ("lgvi", || Box::new(Lgvi::new(8, stop()).expect("even")), false),
    ("rk8, projected", || Box::new(Rk::new(Tableau::rk8(), true).expect("explicit")), true),
    ("rkmk rk8", || Box::new(Rkmk::new(Tableau::rk8()).expect("explicit")), true),
];

fn stop() -> StopRule {
    StopRule::default()
}

fn body(moments: [f64; 3], terms: Vec<Term<3>>) -> RigidBody<3> {
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] });
    RigidBody::new(Kinetic::Principal { weights }, terms, 0.0)
}

fn uniform(weight: f64, body_point: [f64; 3], space: [f64; 3]) -> Term<3> {
    Term { law: Law::Uniform { weight, body_point: body_point.into() }, space: space.into() }
}

fn at(body: &RigidBody<3>, attitude: Mat<3>, omega: [f64; 3]) -> State<3> {
    State { attitude, momentum: body.momentum(&so::hat(&omega)) }
}

fn tilted(axis: [f64; 3], angle: f64) -> Mat<3> {
    so::exp(&so::hat(&axis.map(|x| x * angle)))
}

/// Angular velocity and attitude after so many steps, shown to `look` on the way.
fn run(
    stepper: &mut dyn Stepper<3>,
    body: &RigidBody<3>,
    start: &State<3>,
    (until, steps): (f64, u32),
    mut look: impl FnMut(f64, &Mat<3>, [f64; 3]),
) -> (Mat<3>, [f64; 3]) {
    let h = until / f64::from(steps);
    stepper.start(start);
    let mut end = (start.attitude, [0.0; 3]);
    for k in 0..steps {
        stepper.set_time(f64::from(k) * h);
        stepper.step(body, h).expect("a step that can be solved");
        let omega = so::vee(&body.velocity(&stepper.momentum()));
        let omega = [omega[0], omega[1], omega[2]];
        end = (stepper.attitude().expect("carried"), omega);
        look(f64::from(k + 1) * h, &end.0, omega);
    }
    end
}

/// How far an attitude is from a unit quaternion w, x, y, z.
fn from_quaternion(g: &Mat<3>, [w, x, y, z]: [f64; 4]) -> f64 {
    let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
    let turn: Matrix3<f64> = *turn.matrix();
    let mut off = 0.0_f64;
    for i in 0..3 {
        for j in 0..3 {
            off = off.max((g[(i, j)] - turn[(i, j)]).abs());
        }
    }
    off
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// NASA's tumbling brick: check case 2 of the NESC.
fn brick(stepper: &mut dyn Stepper<3>) -> f64 {
    let degree = std::f64::consts::PI / 180.0;
    // The moments act by their ratios alone.
    let body = body([0.001_894_220, 0.006_211_019, 0.007_194_665], Vec::new());
    let start = at(&body, Mat::identity(), [10.0, 20.0, 30.0].map(|x| x * degree));
    let (g, omega) = run(stepper, &body, &start, (30.0, 600), |_, _, _| {});
    let published = [12.618_390_775_914_2, -17.397_474_761_611_4, 31.119_588_886_944_3];
    let q = [
        -0.881_147_185_310_424,
        0.470_182_527_766_693,
        0.011_728_252_324_871,
        0.048_687_539_472_084,
    ];
    apart(omega, published.map(|x| x * degree)).max(from_quaternion(&g, q))
}

/// The heavy top of Bruls and Cardona (2010) at t = 2.
fn fast_top(stepper: &mut dyn Stepper<3>) -> f64 {
    let weight = uniform(15.0 * 9.81, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
    let body = body([15.234_375, 0.468_75, 15.234_375], vec![weight]);
    let start = at(&body, Mat::identity(), [0.0, 150.0, -4.615_38]);
    let (g, _) = run(stepper, &body, &start, (2.0, 2000), |_, _, _| {});
    from_quaternion(
        &g,
        [
            0.122_947_135_041_533,
            -0.491_079_892_550_027,
            0.350_430_030_343_621,
            -0.787_986_887_550_486,
        ],
    )
}

/// The top of Simo and Wong (1991): how far it nods, in which time, and how far it precesses in that.
fn nodding_top(stepper: &mut dyn Stepper<3>) -> f64 {
    const PERIOD: f64 = 0.685_458_497_289_615;
    let body = body([5.0, 5.0, 1.0], vec![uniform(20.0, [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])]);
    let start = at(&body, tilted([1.0, 0.0, 0.0], 0.05), [0.0, 0.0, 50.0]);
    let energy = body.energy(&start.attitude, &start.momentum).total();
    let tilt = |g: &Mat<3>| g[(0, 2)].hypot(g[(1, 2)]).atan2(g[(2, 2)]);
    let azimuth = |g: &Mat<3>| g[(1, 2)].atan2(g[(0, 2)]);
    let (half, _) = run(stepper, &body, &start, (0.5 * PERIOD, 100), |_, _, _| {});
    let (whole, _) = run(stepper, &body, &start, (PERIOD, 200), |_, _, _| {});
    let precession = azimuth(&whole) - azimuth(&start.attitude);
    [
        (energy - 1_269.975_005_207_899) / energy,
        tilt(&half) - 0.054_551_690_224_3,
        tilt(&whole) - 0.05,
        precession - 0.286_107_687_800_661,
    ]
    .into_iter()
    .fold(0.0, |off: f64, x| off.max(x.abs()))
}

/// A body that turns over and over, after the time in which its angular velocity comes back.
fn turning_over(stepper: &mut dyn Stepper<3>) -> f64 {
    let body = body([1.0, 2.0, 3.0], Vec::new());
    let omega = [0.01, 1.0, 0.0];
    let start = at(&body, Mat::identity(), omega);
    let (g, end) = run(stepper, &body, &start, (41.509_219_529_338_5, 800), |_, _, _| {});
    let q = [-0.653_684_370_304_628, -0.003_783_789_195_234, -0.756_757_839_046_79, 0.0];
    apart(end, omega).max(from_quaternion(&g, q))
}

/// Kovalevskaya's top: its integral on the way, and where it is at t = 5.
fn kovalevskaya(stepper: &mut dyn Stepper<3>) -> f64 {
    let body = body([2.0, 2.0, 1.0], vec![uniform(1.0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])]);
    // The third row of g is (0.6, 0, 0.8).
    let g = Mat::<3>::new(0.8, 0.0, -0.6, 0.0, 1.0, 0.0, 0.6, 0.0, 0.8);
    let start = at(&body, g, [0.3, 0.7, 1.1]);
    let mut off = 0.0_f64;
    let (_, end) = run(stepper, &body, &start, (5.0, 250), |_, g, w| {
        let real = w[0] * w[0] - w[1] * w[1] - g[(2, 0)];
        let imaginary = 2.0 * w[0] * w[1] - g[(2, 1)];
        off = off.max((real * real + imaginary * imaginary - 1.1764).abs());
    });
    off.max(apart(end, [0.928_349_864_182_438, 0.294_912_509_859_295, -0.035_434_005_946_523]))
}

/// The shipped heavy top upright: below the threshold of its spin it falls, above it sleeps. The threshold, by bisection.
fn sleeping_top(stepper: &mut dyn Stepper<3>) -> f64 {
    let body = body([0.02, 0.02, 0.01], vec![uniform(4.905, [0.0, 0.0, 0.1], [0.0, 0.0, 1.0])]);
    let falls = |stepper: &mut dyn Stepper<3>, spin: f64| {
        let start = at(&body, tilted([1.0, 0.0, 0.0], 1e-9), [0.0, 0.0, spin]);
        let mut worst = 0.0_f64;
        run(stepper, &body, &start, (60.0, 6000), |_, g, _| {
            worst = worst.max(g[(0, 2)].hypot(g[(1, 2)]));
        });
        worst > 1e-6
    };
    let (mut low, mut high) = (19.7, 19.9);
    assert!(falls(stepper, low) && !falls(stepper, high));
    for _ in 0..5 {
        let middle = 0.5 * (low + high);
        if falls(stepper, middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    // Just below the threshold it falls too slowly to be seen: the bracket is what is known.
    0.5 * ((low + high) - 2.0 * 19.809_088_82).abs()
}

const RATE: f64 = 0.001_107;
const SATELLITE: [f64; 3] = [2100.0, 2000.0, 200.0];

/// The satellite on its orbit, axis 1 across its plane and axis 3 along the radius.
fn satellite(eccentricity: f64) -> RigidBody<3> {
    let matrix = Mat::<3>::new(2100.0, 0.0, 0.0, 0.0, 2000.0, 0.0, 0.0, 0.0, 200.0);
    let law = Law::GravityGradient { strength: 3.0 * RATE * RATE, matrix };
    let term = Term { law, space: Vector::<3>::new(0.0, 0.0, 1.0) };
    let across = Vector::<3>::new(0.0, -1.0, 0.0);
    let path = Path::Orbit { across, mean_motion: RATE, eccentricity, mean_anomaly: 0.0 };
    body(SATELLITE, Vec::new()).with_driven_term(DrivenTerm {
        term,
        path,
        factor: Factor::Constant,
    })
}

/// The axes of the orbit that turn with the radius, which stands at an angle from where it was.
fn orbiting(angle: f64) -> Mat<3> {
    tilted([1.0, 0.0, 0.0], angle)
}

/// Small librations on a circular orbit: the frequencies, in units of the orbit's.
fn librations(stepper: &mut dyn Stepper<3>) -> f64 {
    let body = satellite(0.0);
    let (steps, span) = (2000_u32, 60.0 / RATE);
    let h = span / f64::from(steps);
    let tilt = tilted([1.0, 0.0, 0.0], 1e-7)
        * tilted([0.0, 1.0, 0.0], 2e-7)
        * tilted([0.0, 0.0, 1.0], 1e-7);
    let start = at(&body, tilt, [RATE, 0.0, 0.0]);
    let (mut pitch, mut roll) = (Vec::new(), Vec::new());
    run(stepper, &body, &start, (span, steps), |t, g, _| {
        let off = orbiting(RATE * t).transpose() * g;
        pitch.push(0.5 * (off[(2, 1)] - off[(1, 2)]));
        roll.push(0.5 * (off[(0, 2)] - off[(2, 0)]));
    });
    // x(t - d) + x(t + d) = 2 cos(w d) x(t), and of two frequencies the same twice over.
    let d = 20;
    let second =
        |x: &[f64]| -> Vec<f64> { (d..x.len() - d).map(|k| x[k - d] + x[k + d]).collect() };
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let frequency = |cosine: f64| cosine.acos() / (f64::from(d as u32) * h) / RATE;
    let middle = &pitch[d..pitch.len() - d];
    let of_pitch = frequency(0.5 * dot(&second(&pitch), middle) / dot(middle, middle));
    let (once, twice) = (second(&roll), second(&second(&roll)));
    let (x, y) = (&roll[2 * d..roll.len() - 2 * d], &once[d..once.len() - d]);
    // twice = p y - q x with p the sum and q the product of the two 2 cos(w d).
    let (xx, xy, yy) = (dot(x, x), dot(x, y), dot(y, y));
    let (xz, yz) = (dot(x, &twice), dot(y, &twice));
    let determinant = xx * yy - xy * xy;
    let (p, q) = ((yz * xx - xz * xy) / determinant, -(xz * yy - yz * xy) / determinant);
    let root = (p * p / 4.0 - q).max(0.0).sqrt();
    let (fast, slow) = (frequency((p / 2.0 - root) / 2.0), frequency((p / 2.0 + root) / 2.0));
    apart([of_pitch, fast, slow], [1.603_567, 1.956_721, 0.704_446])
}

/// On an orbit of small eccentricity the pitch is forced to swing.
fn forced_pitch(stepper: &mut dyn Stepper<3>) -> f64 {
    let e = 1e-4;
    let sigma = (SATELLITE[1] - SATELLITE[2]) / SATELLITE[0];
    let amplitude = 2.0 * e / (3.0 * sigma - 1.0);
    let body = satellite(e);
    let at_pericentre = RATE * (1.0 - e * e).sqrt() / ((1.0 - e) * (1.0 - e));
    // On the forced motion at the pericentre: no pitch, at its fastest.
    let start = at(&body, Mat::identity(), [at_pericentre + amplitude * RATE, 0.0, 0.0]);
    let turns = 4.0;
    let (mut sine, mut count) = (0.0, 0.0);
    run(stepper, &body, &start, (turns * std::f64::consts::TAU / RATE, 800), |t, g, _| {
        let mean = RATE * t;
        // The equation of the centre, to the order that is asked.
        let radius = mean + 2.0 * e * mean.sin() + 1.25 * e * e * (2.0 * mean).sin();
        let off = orbiting(radius).transpose() * g;
        sine += off[(2, 1)].atan2(off[(1, 1)]) * mean.sin();
        count += 0.5;
    });
    (sine / count / e - 1.2727).abs()
}

/// A torque `-c mu` on the body that turns over.
fn damped(stepper: &mut dyn Stepper<3>) -> f64 {
    let body = body([1.0, 2.0, 3.0], Vec::new()).with_torque(Torque::OfMomentum(0.1));
    let start = at(&body, Mat::identity(), [0.01, 1.0, 0.0]);
    let (_, omega) = run(stepper, &body, &start, (10.0, 400), |_, _, _| {});
    apart(omega, [0.070_145_029_205_440_1, 0.361_148_849_704_252, -0.040_442_517_206_146_5])
}

/// A wheel on the middle axis: how fast the turn about it is left.
fn gyrostat(stepper: &mut dyn Stepper<3>) -> f64 {
    let wheel = 0.5;
    let body = body([1.0, 2.0, 3.0], Vec::new()).with_wheels(so::hat(&[0.0, wheel, 0.0]));
    let start = at(&body, Mat::identity(), [1e-9, 1.0, 0.0]);
    let mut sizes = Vec::new();
    run(stepper, &body, &start, (24.0, 480), |_, _, w| sizes.push(w[0].hypot(w[2])));
    // From t = 14 to 24: what falls has gone, and what grows is small still.
    let rate = (sizes[479] / sizes[279]).ln() / 10.0;
    (rate - 0.5).abs()
}

/// What is asked, whose answer it is, the case, to how much it is to be met, and whether it needs a driven method.
type Case = (&'static str, &'static str, fn(&mut dyn Stepper<3>) -> f64, f64, bool);

const CASES: [Case; 10] = [
    ("tumbling brick, t = 30 s", "NASA, NESC check case 2", brick, 1e-12, false),
    ("fast heavy top, t = 2 s", "Bruls and Cardona 2010; 15 digits", fast_top, 2e-9, false),
    (
        "nodding top: energy, nods, precession",
        "Simo and Wong 1991; quadrature",
        nodding_top,
        1e-10,
        false,
    ),
    ("body that turns over, after its period", "elliptic functions", turning_over, 1e-9, false),
    (
        "Kovalevskaya's top: integral, t = 5",
        "Kovalevskaya 1889; 15 digits",
        kovalevskaya,
        1e-11,
        false,
    ),
    ("sleeping top: threshold of the spin", "2 sqrt(J1 m g l) / J3", sleeping_top, 0.01, false),
    ("satellite: three libration frequencies", "linear theory", librations, 1e-6, true),
    (
        "satellite, e = 1e-4: forced pitch / e",
        "2 / (3 (J2 - J3) / J1 - 1)",
        forced_pitch,
        1e-3,
        true,
    ),
    ("damped body, t = 10 s", "exact", damped, 1e-12, true),
    ("wheel on the middle axis: growth rate", "linear theory", gyrostat, 1e-6, true),
];

#[test]
fn published_answers() {
    let mut table = String::from("| method |");
    for (what, ..) in CASES {
        let _ = write!(table, " {what} |");
    }
    let mut failures = Vec::new();
    for (name, make, driven) in METHODS {
        let _ = write!(table, "\n| {name} |");
        for (what, _, case, allowed, needs_driven) in CASES {
            if needs_driven && !driven {
                let _ = write!(table, " - |");
                continue;
            }
            let off = case(make().as_mut());
            let _ = write!(table, " {off:.1e} |");
            if !(off <= allowed) {
                failures.push(format!("{name}: {what}: {off:e}, {allowed:e} allowed"));
            }
        }
    }
    println!("{table}");
    assert!(failures.is_empty(), "{failures:#?}");
}
