//! Answers that others have published or that are known in closed form, next to those of every method that can run the
//! case: `docs/cross-checks.md`, written by
//! `cargo test --release -p vpd-solve rewrite_the_cross_checks -- --ignored`.

use std::fmt::Write as _;
use std::fs;
use std::path::Path as File;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use vpd_solve::hamiltonian::{DrivenTerm, Factor, Kinetic, Law, Path, RigidBody, Term, Torque};
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
use vpd_solve::stepper::vpd_reduced::VpdReduced;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stepper::vrkmk::Vrkmk;
use vpd_solve::tableau::Tableau;

type Make = fn() -> Box<dyn Stepper<3>>;

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

/// Demands of a case on a method.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Asks {
    /// A body that nothing acts on.
    Free,
    /// A free body with wheels.
    FreeWithWheels,
    /// A potential.
    Potential,
    /// A body that changes with time, or is pushed.
    Driven,
}

/// A method of order 8.
struct Method {
    name: &'static str,
    make: Make,
    can: &'static [Asks],
}

const ALL: &[Asks] = &[Asks::Free, Asks::FreeWithWheels, Asks::Potential, Asks::Driven];
const STILL: &[Asks] = &[Asks::Free, Asks::Potential];
const FREE: &[Asks] = &[Asks::Free, Asks::FreeWithWheels];

/// One method of order 8 from each family. (`vpd_adaptive` wants a point source, and no case has
/// one.)
const METHODS: [Method; 12] = [
    Method {
        name: "`vpd`, n = 3 in lanes",
        make: || Box::new(VpdSo3::new(gauss(4), stop()).expect("few stages")),
        can: STILL,
    },
    Method { name: "`vpd`, as for any n", make: || Box::new(Vpd::new(gauss(4), stop())), can: ALL },
    Method {
        name: "`vpd_lagrangian`",
        make: || Box::new(VpdLagrangian::new(gauss(4), stop())),
        can: ALL,
    },
    Method {
        name: "`vpd_reduced`",
        make: || Box::new(VpdReduced::new(gauss(4), stop(), true)),
        can: FREE,
    },
    Method { name: "`vrkmk`", make: || Box::new(Vrkmk::new(gauss(4), stop())), can: ALL },
    Method {
        name: "`vrkmk_projected`",
        make: || Box::new(Vrkmk::new(gauss(4), stop()).projected()),
        can: ALL,
    },
    Method {
        name: "`quaternion_gauss`",
        make: || Box::new(QuaternionGauss::new(4, stop()).expect("4 stages")),
        can: STILL,
    },
    Method { name: "`splitting`", make: || Box::new(Splitting::new(8).expect("even")), can: STILL },
    Method { name: "`lgvi`", make: || Box::new(Lgvi::new(8, stop()).expect("even")), can: STILL },
    Method {
        name: "`rk`, `rk8`",
        make: || Box::new(Rk::new(Tableau::rk8(), false).expect("explicit")),
        can: ALL,
    },
    Method {
        name: "`rk_projected`, `rk8`",
        make: || Box::new(Rk::new(Tableau::rk8(), true).expect("explicit")),
        can: ALL,
    },
    Method {
        name: "`rkmk`, `rk8`",
        make: || Box::new(Rkmk::new(Tableau::rk8()).expect("explicit")),
        can: ALL,
    },
];

fn stop() -> StopRule {
    StopRule::default()
}

fn body(moments: [f64; 3], terms: Vec<Term<3>>) -> RigidBody<3> {
    RigidBody::new(Kinetic::of_moments(moments), terms, 0.0)
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

/// Angular velocity and attitude after `steps` steps, shown to `look` on the way.
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

/// The unit quaternion w, x, y, z of an attitude, with w of a sign.
fn quaternion(g: &Mat<3>, sign: f64) -> Vec<f64> {
    let g: Matrix3<f64> = Matrix3::from_fn(|i, j| g[(i, j)]);
    let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(g));
    let sign = if q.w * sign < 0.0 { -1.0 } else { 1.0 };
    [q.w, q.i, q.j, q.k].map(|x| sign * x).to_vec()
}

/// The modified Rodrigues parameters of an attitude, of the shorter turn.
fn rodrigues(g: &Mat<3>) -> Vec<f64> {
    let q = quaternion(g, 1.0);
    q[1..].iter().map(|x| x / (1.0 + q[0])).collect()
}

const DEGREE: f64 = std::f64::consts::PI / 180.0;

fn brick(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    // The moments act by their ratios alone.
    let body = body([0.001_894_220, 0.006_211_019, 0.007_194_665], Vec::new());
    let start = at(&body, Mat::identity(), [10.0, 20.0, 30.0].map(|x| x * DEGREE));
    let (g, omega) = run(stepper, &body, &start, (30.0, 600), |_, _, _| {});
    [omega.map(|x| x / DEGREE).to_vec(), quaternion(&g, -1.0)].concat()
}

fn fast_top(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let weight = uniform(15.0 * 9.81, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
    let body = body([15.234_375, 0.468_75, 15.234_375], vec![weight]);
    let start = at(&body, Mat::identity(), [0.0, 150.0, -4.615_38]);
    let (g, _) = run(stepper, &body, &start, (2.0, 2000), |_, _, _| {});
    quaternion(&g, 1.0)
}

fn nodding_top(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    const PERIOD: f64 = 0.685_458_497_289_615;
    let body = body([5.0, 5.0, 1.0], vec![uniform(20.0, [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])]);
    let start = at(&body, tilted([1.0, 0.0, 0.0], 0.05), [0.0, 0.0, 50.0]);
    let tilt = |g: &Mat<3>| libm::atan2(libm::hypot(g[(0, 2)], g[(1, 2)]), g[(2, 2)]);
    let azimuth = |g: &Mat<3>| libm::atan2(g[(1, 2)], g[(0, 2)]);
    let (half, _) = run(stepper, &body, &start, (0.5 * PERIOD, 100), |_, _, _| {});
    let (whole, _) = run(stepper, &body, &start, (PERIOD, 200), |_, _, _| {});
    let energy = body.energy(&whole, &stepper.momentum()).total();
    let precession = azimuth(&whole) - azimuth(&start.attitude);
    vec![energy, tilt(&half), tilt(&whole), precession]
}

fn turning_over(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([1.0, 2.0, 3.0], Vec::new());
    let start = at(&body, Mat::identity(), [0.01, 1.0, 0.0]);
    let (g, end) = run(stepper, &body, &start, (41.509_219_529_338_5, 800), |_, _, _| {});
    [end.to_vec(), quaternion(&g, -1.0)].concat()
}

/// The largest and the smallest value of the integral on the way, and where the top is at t = 5.
fn kovalevskaya(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([2.0, 2.0, 1.0], vec![uniform(1.0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])]);
    // The third row of g is (0.6, 0, 0.8).
    let g = Mat::<3>::new(0.8, 0.0, -0.6, 0.0, 1.0, 0.0, 0.6, 0.0, 0.8);
    let start = at(&body, g, [0.3, 0.7, 1.1]);
    let (mut most, mut least) = (0.0_f64, f64::INFINITY);
    let (_, end) = run(stepper, &body, &start, (5.0, 250), |_, g, w| {
        let real = w[0] * w[0] - w[1] * w[1] - g[(2, 0)];
        let imaginary = 2.0 * w[0] * w[1] - g[(2, 1)];
        let integral = real * real + imaginary * imaginary;
        (most, least) = (most.max(integral), least.min(integral));
    });
    [vec![most, least], end.to_vec()].concat()
}

/// Returns where the square of a rate of growth, linear in some x, is zero; the rates are known at
/// two.
fn threshold([a, b]: [(f64, f64); 2]) -> f64 {
    let (squared_a, squared_b) = (a.1 * a.1, b.1 * b.1);
    a.0 - squared_a * (b.0 - a.0) / (squared_b - squared_a)
}

/// The spin from which on the shipped heavy top sleeps, by how fast it falls at two below.
fn sleeping_top(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([0.02, 0.02, 0.01], vec![uniform(4.905, [0.0, 0.0, 0.1], [0.0, 0.0, 1.0])]);
    let start = |spin: f64| at(&body, tilted([1.0, 0.0, 0.0], 1e-9), [0.0, 0.0, spin]);
    let mut lean = |spin: f64, time: f64| {
        let (g, _) = run(stepper, &body, &start(spin), (time, 2000), |_, _, _| {});
        libm::hypot(g[(0, 2)], g[(1, 2)])
    };
    let mut grows = |spin: f64, from: f64, to: f64| {
        (spin * spin, libm::log(lean(spin, to) / lean(spin, from)) / (to - from))
    };
    let found = threshold([grows(10.0, 2.4, 3.1), grows(15.0, 3.1, 4.0)]).sqrt();
    // On its two sides.
    assert!(lean(19.7, 40.0) > 1e-6 && lean(19.9, 40.0) < 1e-7);
    vec![found]
}

const RATE: f64 = 0.001_107;
const SATELLITE: [f64; 3] = [2100.0, 2000.0, 200.0];

/// The satellite on its orbit, axis 1 across its plane and axis 3 along the radius.
fn satellite(eccentricity: f64) -> RigidBody<3> {
    let matrix = Mat::<3>::new(2100.0, 0.0, 0.0, 0.0, 2000.0, 0.0, 0.0, 0.0, 200.0);
    let law = Law::GravityGradient { strength: 3.0 * RATE * RATE, matrix };
    let term = Term { law, space: Vector::<3>::new(0.0, 0.0, 1.0) };
    let across = Vector::<3>::new(0.0, -1.0, 0.0);
    let path =
        Path::Orbit { across, mean_motion: RATE, eccentricity, mean_anomaly: 0.0, node_rate: 0.0 };
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
fn librations(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
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
    let frequency = |cosine: f64| libm::acos(cosine) / (f64::from(d as u32) * h) / RATE;
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
    vec![of_pitch, frequency((p / 2.0 - root) / 2.0), frequency((p / 2.0 + root) / 2.0)]
}

/// On an orbit of small eccentricity the pitch is forced to swing: the amplitude in units of the eccentricity.
fn forced_pitch(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
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
        let radius = mean + 2.0 * e * libm::sin(mean) + 1.25 * e * e * libm::sin(2.0 * mean);
        let off = orbiting(radius).transpose() * g;
        sine += libm::atan2(off[(2, 1)], off[(1, 1)]) * libm::sin(mean);
        count += 0.5;
    });
    vec![sine / count / e]
}

/// A torque `-c mu` on the body that turns over.
fn damped(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([1.0, 2.0, 3.0], Vec::new()).with_torque(Torque::OfMomentum(0.1));
    let start = at(&body, Mat::identity(), [0.01, 1.0, 0.0]);
    run(stepper, &body, &start, (10.0, 400), |_, _, _| {}).1.to_vec()
}

/// A wheel on the middle axis: how fast the turn about it is left, and from which wheel on it is not.
fn gyrostat(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let mut grows = |wheel: f64| {
        let body = body([1.0, 2.0, 3.0], Vec::new()).with_wheels(so::hat(&[0.0, wheel, 0.0]));
        let start = at(&body, Mat::identity(), [1e-9, 1.0, 0.0]);
        let mut sizes = Vec::new();
        run(stepper, &body, &start, (24.0, 480), |_, _, w| sizes.push(libm::hypot(w[0], w[2])));
        // From t = 14 to 24: what falls has gone, and what grows is small still.
        (wheel * wheel, libm::log(sizes[479] / sizes[279]) / 10.0)
    };
    let half = grows(0.5);
    vec![half.1, threshold([half, grows(0.25)]).sqrt()]
}

/// Three functions of Jacobi's as a body that turns: `y1' = y2 y3, y2' = -y1 y3, y3' = -0.51 y1 y2` with
/// `Omega = (sqrt(1.53) y1, sqrt(0.51) y2, sqrt(3) y3)`.
fn detest(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([2.0, 3.0, 1.0], Vec::new());
    let scale = [1.53_f64, 0.51, 3.0].map(f64::sqrt);
    let start = at(&body, Mat::identity(), [0.0, scale[1], scale[2]]);
    let (_, omega) = run(stepper, &body, &start, (20.0, 800), |_, _, _| {});
    omega.iter().zip(scale).map(|(x, scale)| x / scale).collect()
}

/// A spacecraft that nothing turns.
fn spacecraft(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body([500.0, 200.0, 300.0], Vec::new());
    let start = at(&body, Mat::identity(), [0.5, -0.4, 0.7]);
    rodrigues(&run(stepper, &body, &start, (10.0, 400), |_, _, _| {}).0)
}

const PUSHED_BODY: [f64; 3] = [900.0, 800.0, 600.0];
const PUSHED_FROM: [f64; 3] = [0.1, 0.2, -0.3];
const PUSHED_AT: [f64; 3] = [0.001, -0.01, 0.03];
const PUSH: [f64; 3] = [-1.0, 1.0, -1.0];

/// A spacecraft under a torque that is constant in its body.
fn pushed_spacecraft(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let body = body(PUSHED_BODY, Vec::new()).with_torque(Torque::Body(so::hat(&PUSH)));
    let [x, y, z] = PUSHED_FROM;
    let square = x * x + y * y + z * z;
    let g = tilted([x, y, z].map(|x| x / square.sqrt()), 4.0 * libm::atan(square.sqrt()));
    let start = at(&body, g, PUSHED_AT);
    rodrigues(&run(stepper, &body, &start, (600.0, 6000), |_, _, _| {}).0)
}

/// Solves the same by the classical Runge-Kutta method in modified Rodrigues parameters s, by steps
/// of 0.1 s, as that program does: `4 s' = (1 - |s|^2) Omega + 2 s x Omega + 2 (s . Omega) s`.
fn pushed_spacecraft_in_their_way() -> Vec<f64> {
    type Vec3 = nalgebra::Vector3<f64>;
    let moments = Vec3::from(PUSHED_BODY);
    let rate = |(s, w): (Vec3, Vec3)| {
        let turning = (w * (1.0 - s.dot(&s)) + s.cross(&w) * 2.0 + s * (2.0 * s.dot(&w))) * 0.25;
        let torque = Vec3::from(PUSH) - w.cross(&moments.component_mul(&w));
        (turning, torque.component_div(&moments))
    };
    let (mut at, h) = ((Vec3::from(PUSHED_FROM), Vec3::from(PUSHED_AT)), 0.1);
    let plus = |a: (Vec3, Vec3), b: (Vec3, Vec3), t: f64| (a.0 + b.0 * t, a.1 + b.1 * t);
    for _ in 0..6000 {
        let a = rate(at);
        let b = rate(plus(at, a, 0.5 * h));
        let c = rate(plus(at, b, 0.5 * h));
        let d = rate(plus(at, c, h));
        let sum = plus(plus(plus(a, b, 2.0), c, 2.0), d, 1.0);
        at = plus(at, sum, h / 6.0);
        // Past half a turn the other set is the shorter one.
        if at.0.dot(&at.0) > 1.0 {
            at.0 = -at.0 / at.0.dot(&at.0);
        }
    }
    at.0.as_slice().to_vec()
}

/// A pendulum with a damper in its hinge: its angle and how fast that changes.
fn damped_pendulum(stepper: &mut dyn Stepper<3>) -> Vec<f64> {
    let weight = uniform(9.80665, [0.5, 0.0, 0.0], [0.0, 1.0, 0.0]);
    let body = body([0.001, 0.251, 0.251], vec![weight])
        .with_torque(Torque::Viscous(Mat::from_element(0.1)));
    let start = at(&body, Mat::identity(), [0.0; 3]);
    let (g, omega) = run(stepper, &body, &start, (5.0, 1000), |_, _, _| {});
    vec![libm::atan2(g[(1, 0)], g[(0, 0)]), omega[2]]
}

/// A case with a known answer.
struct Case {
    title: &'static str,
    /// The scene.
    scene: &'static str,
    /// Source of the answer.
    source: &'static str,
    asks: Asks,
    run: fn(&mut dyn Stepper<3>) -> Vec<f64>,
    /// Each figure with the digits that are known of it.
    known: &'static [(&'static str, &'static str)],
    /// Difference allowed, relative to the figure where that is above one.
    allowed: f64,
    /// Remark on the differences.
    said: &'static str,
}

#[rustfmt::skip]
const CASES: &[Case] = &[
    Case {
        title: "Tumbling brick",
        scene: "J = (0.001894220, 0.006211019, 0.007194665) slug ft^2, free, Omega(0) = (10, 20, 30) deg/s, t = 30 s",
        source: "NASA, NESC check case 2 (NASA/TM-2015-218675), its motion to 15 digits",
        asks: Asks::Free, run: brick, allowed: 1e-12,
        known: &[("Omega_1, deg/s", "12.6183907759142"), ("Omega_2", "-17.3974747616114"), ("Omega_3", "31.1195888869443"),
            ("q_w", "-0.881147185310424"), ("q_x", "0.470182527766693"), ("q_y", "0.011728252324871"), ("q_z", "0.048687539472084")],
        said: "",
    },
    Case {
        title: "Fast heavy top",
        scene: "m = 15 kg, centre (0, 1, 0), g = 9.81 along -z, J = (15.234375, 0.46875, 15.234375), Omega(0) = (0, 150, -4.61538), t = 2 s",
        source: "Bruls and Cardona (2010), J. Comput. Nonlinear Dynam. 5; to 15 digits",
        asks: Asks::Potential, run: fast_top, allowed: 2e-9,
        known: &[("q_w", "0.122947135041533"), ("q_x", "-0.491079892550027"), ("q_y", "0.350430030343621"), ("q_z", "-0.787986887550486")],
        said: "The top turns by 0.15 rad in each of 2,000 steps: what is left is the error of steps of order 8, not of the method.",
    },
    Case {
        title: "Nodding top",
        scene: "J = (5, 5, 1), m g l = 20, tilt 0.05, spin 50; half a nod and a whole one of 0.685458497289615 s",
        source: "Simo and Wong (1991), Int. J. Numer. Meth. Engng. 31; their figures by quadrature",
        asks: Asks::Potential, run: nodding_top, allowed: 1e-10,
        known: &[("energy, J", "1269.975005207899"), ("tilt after half a nod", "0.0545516902243"), ("after a whole one", "0.05"),
            ("precession in it", "0.286107687800661")],
        said: "",
    },
    Case {
        title: "A body that turns over",
        scene: "J = (1, 2, 3), free, Omega(0) = (0.01, 1, 0), t = 41.5092195293385 s, the period of Omega",
        source: "Jacobi's functions, to 15 digits",
        asks: Asks::Free, run: turning_over, allowed: 1e-9,
        known: &[("Omega_1", "0.01"), ("Omega_2", "1"), ("Omega_3", "0"), ("q_w", "-0.653684370304628"), ("q_x", "-0.003783789195234"),
            ("q_y", "-0.75675783904679"), ("q_z", "0")],
        said: "",
    },
    Case {
        title: "Kovalevskaya's top",
        scene: "J = (2, 2, 1), U = Gamma_1 with Gamma = g^T e_3, Gamma(0) = (0.6, 0, 0.8), Omega(0) = (0.3, 0.7, 1.1), t = 5 s",
        source: "the integral of Kovalevskaya (1889), (w1^2 - w2^2 - Gamma_1)^2 + (2 w1 w2 - Gamma_2)^2, most and least of it on the way; Omega to 15 digits",
        asks: Asks::Potential, run: kovalevskaya, allowed: 1e-11,
        known: &[("integral, most", "1.1764"), ("least", "1.1764"), ("Omega_1", "0.928349864182438"), ("Omega_2", "0.294912509859295"),
            ("Omega_3", "-0.035434005946523")],
        said: "",
    },
    Case {
        title: "Sleeping top",
        scene: "the shipped heavy top upright: J = (0.02, 0.02, 0.01), m g l = 0.4905; the spin from which on it sleeps",
        source: "linear theory, 2 sqrt(J1 m g l) / J3",
        asks: Asks::Potential, run: sleeping_top, allowed: 1e-6,
        known: &[("spin, rad/s", "19.8090888")],
        said: "Seen are the rates by which the top falls at spins of 10 and 15 rad/s. Their squares are linear in the square of the spin.",
    },
    Case {
        title: "Librations of a satellite",
        scene: "gravity gradient on a circular orbit, J = 2100 (pitch), 2000 (roll), 200 (yaw); frequencies in units of the orbit's",
        source: "linear theory: sqrt(3 (J_roll - J_yaw) / J_pitch), and the roots of the quartic of roll and yaw",
        asks: Asks::Driven, run: librations, allowed: 1e-6,
        known: &[("pitch", "1.603567451"), ("roll and yaw, fast", "1.956720511"), ("slow", "0.704446479")],
        said: "",
    },
    Case {
        title: "Forced pitch",
        scene: "the same satellite, eccentricity e = 1e-4; amplitude in units of e",
        source: "linear theory in e: 2 / (3 (J_roll - J_yaw) / J_pitch - 1)",
        asks: Asks::Driven, run: forced_pitch, allowed: 1e-4,
        known: &[("amplitude / e", "1.27273")],
        said: "The theory leaves out what is of the order of e = 1e-4 in this figure.",
    },
    Case {
        title: "Damped body",
        scene: "the body that turns over, under the torque -0.1 mu, t = 10 s",
        source: "exact: the free motion at (1 - exp(-c t)) / c, scaled by exp(-c t)",
        asks: Asks::Driven, run: damped, allowed: 1e-13,
        known: &[("Omega_1", "0.0701450292054401"), ("Omega_2", "0.361148849704252"), ("Omega_3", "-0.0404425172061465")],
        said: "",
    },
    Case {
        title: "Gyrostat",
        scene: "J = (1, 2, 3), turning about the middle axis by 1 rad/s, a wheel on that axis",
        source: "linear theory: with a wheel of 0.5 N m s the turn is left as exp(t / 2), and from one of 1 N m s on not at all",
        asks: Asks::FreeWithWheels, run: gyrostat, allowed: 1e-6,
        known: &[("rate, 1/s", "0.500000000"), ("wheel, N m s", "1.00000000")],
        said: "Seen are the rates with wheels of 0.5 and 0.25 N m s. Their squares are linear in the square of the wheel.",
    },
    Case {
        title: "Three functions of Jacobi",
        scene: "J = (2, 3, 1), free: Omega / (sqrt(1.53), sqrt(0.51), sqrt(3)) is (sn, cn, dn) of t, to the parameter 0.51; t = 20",
        source: "problem B5 of the tests for solvers of differential equations of Enright and Pryce (1987), ACM Trans. Math. Softw. 13, whose end values \
            other programs' tests repeat",
        asks: Asks::Free, run: detest, allowed: 1e-12,
        known: &[("sn", "-0.9396570798729192"), ("cn", "-0.3421177754000779"), ("dn", "0.7414126596199957")],
        said: "",
    },
    Case {
        title: "A free spacecraft",
        scene: "J = (500, 200, 300), Omega(0) = (0.5, -0.4, 0.7), t = 10 s; modified Rodrigues parameters",
        source: "the simulator Basilisk, its test `test_SCTransAndRotation` of `spacecraft`",
        asks: Asks::Free, run: spacecraft, allowed: 1e-9,
        known: &[("sigma_1", "0.373034285"), ("sigma_2", "-0.00239564413"), ("sigma_3", "0.208570797")],
        said: "",
    },
    Case {
        title: "A spacecraft under a torque",
        scene: "J = (900, 800, 600), a torque of (-1, 1, -1) N m in the body, Omega(0) = (0.001, -0.01, 0.03), from the modified Rodrigues parameters \
            (0.1, 0.2, -0.3), t = 600 s",
        source: "the simulator Basilisk, its test `test_extForceBodyAndTorque`",
        asks: Asks::Driven, run: pushed_spacecraft, allowed: 1e-6,
        known: &[("sigma_1", "0.491025978"), ("sigma_2", "-0.421586707"), ("sigma_3", "0.361459503")],
        said: "Not met in the seventh digit, for the step of that test. It is 0.1 s, by the classical Runge-Kutta method. The same method and step \
            in the parameters that it uses, which this test repeats, give its nine digits.",
    },
    Case {
        title: "A damped pendulum",
        scene: "1 kg at (0.5, 0, 0), J = (0.001, 0.251, 0.251), weight along -y with g = 9.80665, a damper of 0.1 N m s, from rest, t = 5 s",
        source: "the example `MultiBody.Examples.Elementary.Pendulum` of the Modelica Standard Library 4.0, its reference results, by DASSL to a tolerance \
            of 1e-6",
        asks: Asks::Driven, run: damped_pendulum, allowed: 3e-5,
        known: &[("angle", "-1.67963464183622"), ("rate, rad/s", "-2.31814702855536")],
        said: "Not met in the sixth digit, which is what the tolerance of those results gives: the methods here agree to twelve.",
    },
];

impl Case {
    /// Returns how far off figures are, relative to those that are above one.
    fn off(&self, found: &[f64]) -> f64 {
        assert_eq!(found.len(), self.known.len(), "{}", self.title);
        let off = |(x, (_, known)): (&f64, &(&str, &str))| {
            let known: f64 = known.parse().expect("a number");
            (x - known).abs() / known.abs().max(1.0)
        };
        // A NaN is none of the smaller ones.
        found.iter().zip(self.known).map(off).fold(0.0, |a, b| if b <= a { a } else { b })
    }

    /// A row of its table: as many digits as are known, and two more of short figures.
    fn row(&self, name: &str, found: &[f64]) -> String {
        let mut row = format!("| {name} |");
        for (x, (_, known)) in found.iter().zip(self.known) {
            let digits = known.split_once('.').map_or(0, |(_, after)| after.len());
            let digits = if digits < 5 { 15 } else { digits };
            let text = format!("{x:.digits$}");
            // Nothing is left of minus nothing.
            let zero = text.trim_start_matches('-').trim_matches(['0', '.']).is_empty();
            let _ = write!(row, " {} |", if zero { text.trim_start_matches('-') } else { &text });
        }
        let _ = writeln!(row, " {:.1e} |", self.off(found));
        row
    }
}

/// The beginning of `docs/cross-checks.md`, and what is missed.
fn page() -> (String, Vec<String>) {
    let mut page = String::from(INTRODUCTION);
    let mut missed = Vec::new();
    for case in CASES {
        let Case { title, scene, source, asks, run, known, allowed, said } = case;
        let _ = write!(page, "\n## {title}\n\nScene: {scene}.\n\nKnown from: {source}.\n\n| |");
        let names = known.iter().map(|(name, _)| format!(" {name} |")).collect::<String>();
        let _ =
            writeln!(page, "{names} largest difference |\n|---|{}---|", "---|".repeat(known.len()));
        let digits = known.iter().map(|(_, digits)| format!(" {digits} |")).collect::<String>();
        let _ = writeln!(page, "| known |{digits} |");
        for method in METHODS.iter().filter(|method| method.can.contains(asks)) {
            let found = run((method.make)().as_mut());
            page += &case.row(method.name, &found);
            let off = case.off(&found);
            if !(off <= *allowed) {
                missed.push(format!("{}: {title}: {off:e}, {allowed:e} allowed", method.name));
            }
        }
        if !said.is_empty() {
            let _ = writeln!(page, "\n{said}");
        }
    }
    (page, missed)
}

const INTRODUCTION: &str = "\
# Cross-checks: answers of others, and of this program

One test computes every figure of this page and compares it with what is known; it fails if a case is missed, or if this page
is not what it computed. The second command writes the page anew:

```sh skip
cargo test --release -p vpd-solve cross_checks
cargo test --release -p vpd-solve rewrite_the_cross_checks -- --ignored
```

Moments are about the fixed point, quaternions are w, x, y, z, the attitude at the start is the identity unless it is said. A
method is taken with order 8 (four stages of Gauss, its composition, or the explicit `rk8`), with a few hundred to a few
thousand steps. Each table has the methods that can run its scene. The difference is the largest one of the row, relative to
figures that are above one.
";

/// Heading of the part of the page that is written by hand.
const BY_HAND: &str = "\n## Next to other simulators\n";

fn file() -> std::path::PathBuf {
    File::new(env!("CARGO_MANIFEST_DIR")).join("../docs/cross-checks.md")
}

#[test]
fn cross_checks() {
    let (page, missed) = page();
    assert!(missed.is_empty(), "{missed:#?}");
    let theirs = pushed_spacecraft_in_their_way();
    let case = CASES.iter().find(|case| case.title == "A spacecraft under a torque");
    let off = case.expect("in the table").off(&theirs);
    println!("in their way {off:e}");
    assert!(off <= 1e-9, "{off:e}");
    let kept = fs::read_to_string(file()).expect("the page");
    let kept = kept.split_once(BY_HAND).map_or(kept.as_str(), |(before, _)| before);
    for (line, kept) in page.lines().zip(kept.lines()) {
        assert_eq!(line, kept, "see rewrite_the_cross_checks");
    }
    assert_eq!(page.len(), kept.len(), "see rewrite_the_cross_checks");
}

/// Writes what the program computes; look at the difference before it is kept.
#[test]
#[ignore = "writes a file that a test reads: cargo test --release rewrite_the_cross_checks -- --ignored"]
fn rewrite_the_cross_checks() {
    let (page, missed) = page();
    println!("{missed:#?}");
    let kept = fs::read_to_string(file()).unwrap_or_default();
    let by_hand = kept.find(BY_HAND).map_or("", |at| &kept[at..]);
    fs::write(file(), page + by_hand).expect("the page is written");
}
