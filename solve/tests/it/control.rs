//! Bodies under control: what stays by construction, the order, theory of linear control, checkpoints.

use std::f64::consts::PI;

use vpd_solve::control::{ControlLaw, Target};
use vpd_solve::hamiltonian::{
    Actuator, Control, DipoleField, Kinetic, Law, ReactionWheels, RigidBody, Term, magnetic_term,
};
use vpd_solve::kepler::Orbit;
use vpd_solve::noise::Noise;
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::{Checkpoint, State};
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::controlled::Controlled;
use vpd_solve::stepper::rkmk::Rkmk;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::stop::{Condition, Stop};
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{
    Ending, Observables, Origin, Sample, Schedule, Sink, Trajectory, integrate,
};

const ALL: Observables = Observables {
    energy: true,
    orthogonality: true,
    momentum: true,
    sigma_min: false,
    pace: false,
    control: true,
    pointing: true,
    derivatives: true,
};

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

fn lanes(stages: usize) -> Box<dyn Stepper<3>> {
    Box::new(VpdSo3::new(gauss(stages), StopRule::default()).expect("at most eight stages"))
}

fn turn<const N: usize>(angle: f64) -> Mat<N> {
    let mut x = Mat::zeros();
    (x[(0, 1)], x[(1, 0)]) = (-angle, angle);
    so::exp(&x)
}

fn noise(torque: f64) -> Option<Noise> {
    Some(Noise { seed: 3, stream: 0, attitude: 0.02, rate: 0.01, torque })
}

fn slew() -> ControlLaw {
    ControlLaw::Attitude { gain: 0.4, rate_gain: 1.1, integral_gain: 0.0, feed_forward: false }
}

fn control<const N: usize>(every_s: f64, law: ControlLaw, actuator: Actuator<N>) -> Control<N> {
    Control {
        every_s,
        delay_s: 0.0,
        quantum_n_m: 0.0,
        target: Some(Target::fixed(turn(0.9))),
        laws: vec![law],
        actuator,
        noise: None,
    }
}

fn wheels(torque_limit: f64, momentum_limit: f64) -> ReactionWheels<3> {
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.48, 0.64]];
    let momenta = vec![0.1, -0.2, 0.3, 0.05];
    ReactionWheels::new(&axes, vec![0.01; 4], momenta, torque_limit, momentum_limit)
        .expect("four axes span space")
}

fn moments() -> Kinetic<3> {
    Kinetic::of_moments([1.0, 1.7, 2.3])
}

fn field() -> DipoleField {
    let (sin, cos) = libm::sincos(1.2);
    DipoleField {
        moment_t_m3: 7.96e15,
        tilt_rad: 0.17,
        rotation_rad_s: 7.29e-5,
        orbit: Orbit {
            plane: [[1.0, 0.0, 0.0], [0.0, cos, sin]],
            semi_major_axis_m: 6.9e6,
            mean_motion_rad_s: 1.1e-3,
            eccentricity: 0.01,
            mean_anomaly_rad: 0.3,
            node_rate_rad_s: 0.0,
        },
    }
}

fn start<const N: usize>() -> State<N> {
    let momentum = Mat::from_fn(|i, j| {
        0.3 * (i as f64 - j as f64) + 0.05 * (j * j) as f64 - 0.05 * (i * i) as f64
    });
    State { attitude: turn(-0.4), momentum: so::asym(&momentum) * 0.5 }
}

fn run<const N: usize>(
    body: &RigidBody<N>,
    method: Box<dyn Stepper<N>>,
    start: &State<N>,
    (step_s, steps, every): (f64, u64, u64),
) -> (Vec<Sample<N>>, Trajectory<N>) {
    let mut stepper: Box<dyn Stepper<N>> = match body.control() {
        Some(_) => Box::new(controlled(method, body)),
        None => method,
    };
    let mut samples = Vec::new();
    let schedule = Schedule { step_s, steps, every };
    let end = integrate(body, stepper.as_mut(), start, schedule, ALL, &mut samples, |_| true);
    let Ok(end) = end;
    (samples, end)
}

fn controlled<const N: usize>(method: Box<dyn Stepper<N>>, body: &RigidBody<N>) -> Controlled<N> {
    Controlled::new(method, body.clone()).expect("the body has a control")
}

fn distance<const N: usize>(a: &Sample<N>, b: &Sample<N>) -> f64 {
    let attitude = |x: &Sample<N>| x.attitude.expect("these schemes carry it");
    (attitude(a) - attitude(b)).amax() + (a.momentum - b.momentum).amax()
}

/// Motor torques are internal: through a slew of 1e5 samples with limits the spatial momentum stays to round-off.
#[test]
fn wheels_leave_the_spatial_momentum() {
    let wheels = Actuator::Wheels(wheels(0.05, 0.6));
    let body = RigidBody::new(moments(), Vec::new(), 0.0);
    let mut control = control(0.1, slew(), wheels);
    control.target = Some(Target {
        start: turn(0.3),
        plane: [Vector::from([1.0, 0.0, 0.0]), Vector::from([0.0, 0.8, 0.6])],
        rate: 0.02,
    });
    let body = body.with_control(control);
    let (samples, end) = run(&body, lanes(2), &start(), (0.05, 200_000, 40));
    assert_eq!(end.ending, Ending::Completed);
    let size = so::inner(&start::<3>().momentum, &start::<3>().momentum).sqrt();
    let drift = samples.iter().filter_map(|sample| sample.momentum_drift).fold(0.0, f64::max);
    assert!(drift <= 5e-15 * size, "{:e} of {size}", drift / size);
    assert!(samples.iter().any(|s| s.control.as_ref().is_some_and(|c| c.is_saturated)));
    let last = samples.last().and_then(|sample| sample.control.clone()).expect("a sample");
    let error = last.pointing_error_rad.expect("a target");
    assert!(error < 0.1, "it follows the target: {error} rad");
}

/// In lanes and in matrices, for each actuator, with delays and limits.
#[test]
fn lanes_and_matrices_agree() {
    let weight = Term {
        law: Law::Uniform { weight: 0.2, body_point: Vector::from([0.3, 0.1, -0.2]) },
        space: Vector::from([0.0, 0.0, 1.0]),
    };
    let field = field();
    let coils = Actuator::Magnetorquers { limit: 20.0, field };
    let b_dot = ControlLaw::BDot { gain: 3e5 };
    for (delay_s, law, actuator) in [
        (0.0, slew(), Actuator::Torque { limit: 0.3 }),
        (0.07, slew(), Actuator::Wheels(wheels(0.05, 0.6))),
        (0.2, slew(), Actuator::Wheels(wheels(f64::INFINITY, f64::INFINITY))),
        (0.05, b_dot, coils.clone()),
        (0.0, slew(), coils),
    ] {
        let mut control = control(0.2, law, actuator);
        control.delay_s = delay_s;
        control.noise = noise(0.01).filter(|_| delay_s > 0.0);
        let body = RigidBody::new(moments(), vec![weight.clone()], 0.0)
            .with_driven_term(magnetic_term(&[300.0, 0.0, 100.0], field))
            .with_control(control.clone());
        for stages in [1, 2, 3, 8] {
            let here = (0.1, 100, 100);
            let matrices = Box::new(Vpd::new(gauss(stages), StopRule::default()));
            let (a, end) = run(&body, lanes(stages), &start(), here);
            let (b, _) = run(&body, matrices, &start(), here);
            assert_eq!(end.ending, Ending::Completed);
            let (a, b) = (&a[1], &b[1]);
            assert!(distance(a, b) < 1e-12, "{delay_s} {law:?} {stages}: {:e}", distance(a, b));
            let work = |s: &Sample<3>| s.work.expect("it is driven");
            assert!((work(a) - work(b)).abs() < 1e-12, "{law:?}: {} {}", work(a), work(b));
            // A moment in a field, and motors, are counted by their work: the balance is the method's.
            let error = a.energy_error.expect("asked for").abs();
            let most = [0.1, 1e-3, 1e-5, 1e-11]
                [[1, 2, 3, 8].iter().position(|&s| s == stages).expect("in the list")];
            assert!(error < most, "{delay_s} {law:?} {stages}: {error:e}");
        }
    }
}

/// Samples are ends of steps: a method keeps its order, though commands jump at each, wherever they lie.
#[test]
fn methods_keep_their_order() {
    let plain = control(0.31, slew(), Actuator::Wheels(wheels(0.05, 0.6)));
    let noisy = Control { noise: noise(0.02), ..plain.clone() };
    for of_wheels in [plain, noisy] {
        let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(of_wheels);
        keeps_its_order(&body);
    }
}

fn keeps_its_order(body: &RigidBody<3>) {
    // Thirteen samples; 26 steps lie on them, 30 steps do not.
    let time_s = 13.0 * 0.31;
    let (exact, _) = run(body, lanes(8), &start(), (time_s / 403.0, 403, 403));
    for (stages, few, many) in [(1, 26, 104), (2, 26, 104), (3, 13, 39)] {
        let error = |steps: u64| {
            let at = (time_s / steps as f64, steps, steps);
            let (found, _) = run(body, lanes(stages), &start(), at);
            distance(&found[1], &exact[1])
        };
        let order = (error(few) / error(many)).ln() / (many as f64 / few as f64).ln();
        let expected = 2.0 * stages as f64;
        assert!((order - expected).abs() < 0.5, "{stages} stages: order {order}");
        assert!(error(30) <= 1.5 * error(26), "{stages} stages: {} {}", error(30), error(26));
    }
    // Another method, of order 8, finds the same end.
    let rk8 = Rkmk::new(Tableau::rk8()).expect("it is explicit");
    let (found, _) = run(body, Box::new(rk8), &start(), (time_s / 208.0, 208, 208));
    assert!(distance(&found[1], &exact[1]) < 1e-12);
}

/// About one axis the loop is linear: its states at the samples are those of the matrix of theory (zero-order hold).
#[test]
fn a_small_slew_is_that_of_linear_theory() {
    let (inertia, every_s, gain, rate_gain) = (2.3, 0.4, 0.5, 0.9);
    let law = ControlLaw::Attitude { gain, rate_gain, integral_gain: 0.0, feed_forward: false };
    let mut control = control(every_s, law, Actuator::Torque { limit: f64::INFINITY });
    control.target = Some(Target::fixed(Mat::identity()));
    let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(control);
    let angle = 1e-6;
    let at = State { attitude: turn(angle), momentum: Mat::zeros() };
    let (samples, _) = run(&body, lanes(2), &at, (0.2, 400, 2));
    // x = (angle, rate): angle' = angle + T rate + T^2 / 2J torque, rate' = rate + T / J torque
    let mut x = [angle, 0.0];
    for sample in &samples {
        let g = sample.attitude.expect("it carries one");
        let found = [libm::asin(g[(1, 0)]), sample.momentum[(1, 0)] / inertia];
        for (found, x) in found.iter().zip(&x) {
            assert!((found - x).abs() < 1e-6 * angle, "{}: {found} {x}", sample.time_s);
        }
        let torque = -gain * x[0] - rate_gain * x[1];
        let t = every_s;
        x = [x[0] + t * x[1] + 0.5 * t * t / inertia * torque, x[1] + t / inertia * torque];
    }
}

/// Under noise the loop about one axis has the stationary covariance of theory, P = A P A^T + s^2 B B^T, whichever kind the noise
/// is of; the impulse of the torque noise is counted to round-off.
#[test]
fn a_noisy_loop_scatters_as_theory_says() {
    let (inertia, t, gain, rate_gain) = (2.3, 0.4, 0.5, 0.9);
    let law = ControlLaw::Attitude { gain, rate_gain, integral_gain: 0.0, feed_forward: false };
    let size = 1e-6;
    let none = Noise { seed: 11, ..Noise::default() };
    for noise in [
        Noise { attitude: size, ..none },
        Noise { rate: size, ..none },
        Noise { torque: size, ..none },
        Noise { attitude: 2.0 * size, rate: size, torque: 0.5 * size, ..none },
    ] {
        let mut control = control(t, law, Actuator::Torque { limit: f64::INFINITY });
        control.target = Some(Target::fixed(Mat::identity()));
        control.noise = Some(noise);
        let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(control);
        let at = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        let (samples, _) = run(&body, lanes(2), &at, (t, 200_000, 1));
        let b = [0.5 * t * t / inertia, t / inertia];
        let a = [[1.0 - b[0] * gain, t - b[0] * rate_gain], [-b[1] * gain, 1.0 - b[1] * rate_gain]];
        let variance = (gain * noise.attitude).powi(2)
            + (rate_gain * noise.rate).powi(2)
            + noise.torque * noise.torque;
        let mut p = [[0.0; 2]; 2];
        for _ in 0..1000 {
            let at = |i: usize, j: usize| {
                let carried: f64 =
                    (0..4).map(|k| a[i][k / 2] * p[k / 2][k % 2] * a[j][k % 2]).sum();
                carried + b[i] * b[j] * variance
            };
            p = [[at(0, 0), at(0, 1)], [at(1, 0), at(1, 1)]];
        }
        let late = &samples[1000..];
        let mean =
            |f: &dyn Fn(&Sample<3>) -> f64| late.iter().map(f).sum::<f64>() / late.len() as f64;
        let angle = |s: &Sample<3>| libm::asin(s.attitude.expect("it carries one")[(1, 0)]);
        let rate = |s: &Sample<3>| s.momentum[(1, 0)] / inertia;
        let found = [mean(&|s| angle(s) * angle(s)), mean(&|s| rate(s) * rate(s))];
        for (found, right) in found.iter().zip([p[0][0], p[1][1]]) {
            assert!((found / right - 1.0).abs() < 0.05, "{noise:?}: {found:e} for {right:e}");
        }
        let most = samples.iter().filter_map(|s| s.momentum_drift).fold(0.0, f64::max);
        assert!(most < 1e-10 * size, "{noise:?}: {most:e}");
    }
}

/// The time between samples at which the loop of theory becomes unstable: half a step before the small slew dies out, and
/// behind it grows.
#[test]
fn too_rare_samples_are_unstable_where_theory_says() {
    let (inertia, gain, rate_gain) = (2.3, 0.5, 0.9);
    // The characteristic polynomial z^2 + a z + b has a root outside the circle when b > 1 or b - |a| + 1 < 0 (Jury 1964).
    let stable = |t: f64| {
        let m = [
            [1.0 - 0.5 * t * t / inertia * gain, t - 0.5 * t * t / inertia * rate_gain],
            [-t / inertia * gain, 1.0 - t / inertia * rate_gain],
        ];
        let (trace, det) = (m[0][0] + m[1][1], m[0][0] * m[1][1] - m[0][1] * m[1][0]);
        det < 1.0 && trace.abs() < 1.0 + det
    };
    let (mut low, mut high) = (0.1, 20.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if stable(middle) { low = middle } else { high = middle }
    }
    let grows = |every_s: f64| {
        let law = ControlLaw::Attitude { gain, rate_gain, integral_gain: 0.0, feed_forward: false };
        let mut control = control(every_s, law, Actuator::Torque { limit: f64::INFINITY });
        control.target = Some(Target::fixed(Mat::identity()));
        let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(control);
        let at = State { attitude: turn(1e-9), momentum: Mat::zeros() };
        let (samples, _) = run(&body, lanes(2), &at, (every_s, 2000, 1));
        let angle = |s: &Sample<3>| s.attitude.expect("it carries one")[(1, 0)].abs();
        let most = |part: &[Sample<3>]| part.iter().map(angle).fold(0.0, f64::max);
        most(&samples[1900..]) > most(&samples[..100])
    };
    assert!(!grows(0.995 * low) && grows(1.005 * low), "the border of theory is {low} s");
}

/// Attitude and damping act in any dimension.
/// Its angle grows with the turn beyond a quarter, where the skew part, which the law sees, falls; half a turn is farthest away.
#[test]
fn the_angle_to_a_target_is_that_of_the_rotation() {
    fn of<const N: usize>() {
        let entries: Vec<f64> = (0..so::dimension(N)).map(|k| 1.0 / (1 + k) as f64).collect();
        let axis = so::hat::<N>(&entries);
        let axis = axis / so::inner(&axis, &axis).sqrt();
        for size in [1e-9, 0.5, 1.0, 2.0, 3.1] {
            let (_, found) = Target::fixed(Mat::identity()).error(0.0, &so::exp(&(axis * size)));
            assert!((found - size).abs() < 1e-14 * (1.0 + size), "n = {N}: {found} for {size}");
        }
        let half = Mat::<N>::from_fn(|i, j| f64::from(i == j) * if i < 2 { -1.0 } else { 1.0 });
        let (_, found) = Target::fixed(Mat::identity()).error(0.0, &half);
        assert!((found - PI).abs() < 1e-14, "n = {N}: {found}");
    }
    of::<2>();
    of::<3>();
    of::<4>();
    of::<5>();
    of::<8>();
}

#[test]
fn a_body_of_four_dimensions_comes_to_rest_on_its_target() {
    let kinetic = Kinetic::<4>::of_second_moments([0.5, 0.7, 0.9, 1.2]);
    let mut control = control(0.1, slew(), Actuator::Torque { limit: 1.0 });
    control.laws.push(ControlLaw::Damping { rate_gain: 0.3 });
    let target = control.target.clone().expect("given");
    let body = RigidBody::new(kinetic, Vec::new(), 0.0).with_control(control);
    let at = State { attitude: turn(-0.2), momentum: start::<4>().momentum * 0.3 };
    let method = Box::new(Vpd::new(gauss(2), StopRule::default()));
    let (samples, _) = run(&body, method, &at, (0.1, 1000, 100));
    let last = samples.last().expect("there is one");
    assert!(target.error(100.0, &last.attitude.expect("it carries one")).1 < 1e-9);
    assert!(last.momentum.amax() < 1e-9);
}

/// Keeps samples and one checkpoint.
struct Kept {
    samples: Vec<Sample<3>>,
    at: u64,
    checkpoint: Option<Checkpoint<3>>,
}

impl Sink<3> for Kept {
    type Error = std::convert::Infallible;

    fn record(&mut self, sample: &Sample<3>) -> Result<(), Self::Error> {
        self.samples.push(sample.clone());
        Ok(())
    }

    fn wants_checkpoint(&self) -> bool {
        self.samples.last().is_some_and(|sample| sample.step == self.at)
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<3>) -> Result<(), Self::Error> {
        self.checkpoint = Some(checkpoint.clone());
        Ok(())
    }
}

/// A run that goes on from a checkpoint has the bits of the whole one, wherever the checkpoint lies between samples.
#[test]
fn a_resumed_run_is_the_whole_one() {
    let mut control = control(0.35, slew(), Actuator::Wheels(wheels(0.05, 0.6)));
    control.delay_s = 0.12;
    let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(control);
    let coils = Actuator::Magnetorquers { limit: 20.0, field: field() };
    let mut b_dot = self::control(0.35, ControlLaw::BDot { gain: 3e5 }, coils);
    b_dot.delay_s = 0.35;
    b_dot.noise = noise(0.03);
    let detumbled = RigidBody::new(moments(), Vec::new(), 0.0).with_control(b_dot);
    let mut shaken = self::control(0.35, slew(), Actuator::Torque { limit: 0.2 });
    shaken.noise = noise(0.03);
    let shaken = RigidBody::new(moments(), Vec::new(), 0.0).with_control(shaken);
    for body in [body, detumbled, shaken] {
        for at in [0, 1, 7, 14, 33] {
            let schedule = Schedule { step_s: 0.1, steps: 60, every: 1 };
            let mut whole = Kept { samples: Vec::new(), at, checkpoint: None };
            let mut stepper = controlled(lanes(2), &body);
            let Ok(_) =
                integrate(&body, &mut stepper, &start(), schedule, ALL, &mut whole, |_| true);
            let checkpoint = whole.checkpoint.expect("one was wanted");
            let mut rest = Vec::new();
            let mut stepper = controlled(lanes(2), &body);
            let origin = Origin { initial: &start(), checkpoint: Some(&checkpoint) };
            let Ok(_) = integrate(&body, &mut stepper, origin, schedule, ALL, &mut rest, |_| true);
            assert_eq!(rest, whole.samples[at as usize + 1..], "from step {at}");
        }
    }
}

/// A checkpoint of another control, as a file may hold one, begins the control anew and ends nothing.
#[test]
fn a_checkpoint_of_another_control_is_no_panic() {
    let of_wheels = control(0.1, slew(), Actuator::Wheels(wheels(0.05, 0.6)));
    let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(of_wheels);
    let none = vpd_solve::control::ControlState::default();
    let of_torque = control(0.1, slew(), Actuator::Torque { limit: 1.0 });
    let mut other =
        controlled(lanes(2), &RigidBody::new(moments(), Vec::new(), 0.0).with_control(of_torque));
    other.start(&start());
    for state in [Some(none), other.control().cloned(), None] {
        let checkpoint = Checkpoint { control: state, ..Checkpoint::at_start(&start()) };
        let mut stepper = controlled(lanes(2), &body);
        stepper.resume(&checkpoint);
        stepper.step(&body, 0.1).expect("a small step");
        assert_eq!(stepper.control().map(|state| state.samples), Some(2));
    }
}

/// A moment along the change of the field takes the spin out of a body: the rates fall to a few turns of the orbit.
#[test]
fn b_dot_detumbles() {
    let coils = Actuator::Magnetorquers { limit: 1.0, field: field() };
    let kinetic = Kinetic::of_moments([0.03, 0.04, 0.05]);
    let control = control(1.0, ControlLaw::BDot { gain: 2e5 }, coils);
    let body = RigidBody::new(kinetic, Vec::new(), 0.0).with_control(control);
    let at = State { attitude: turn(0.1), momentum: start::<3>().momentum * 0.01 };
    let (samples, end) = run(&body, lanes(3), &at, (0.5, 24_000, 2000));
    assert_eq!(end.ending, Ending::Completed);
    let rate = |s: &Sample<3>| {
        let omega = s.angular_velocity.expect("a body has one");
        so::inner(&omega, &omega).sqrt()
    };
    let (first, last) = (rate(&samples[0]), rate(samples.last().expect("there is one")));
    assert!(first > 0.1 && last < 0.02, "{first} {last}");
}

/// Conditions end a run at the first step where they have held long enough.
#[test]
fn a_stop_ends_the_run() {
    let of_torque = control(0.1, slew(), Actuator::Torque { limit: 0.5 });
    let target = of_torque.target.clone().expect("given");
    let below = Stop {
        condition: Condition::PointingErrorBelow(target.clone(), 1e-3),
        for_s: 2.0,
        exact: false,
    };
    let body = RigidBody::new(moments(), Vec::new(), 0.0).with_control(of_torque);
    let (all, _) = run(&body, lanes(2), &start(), (0.1, 600, 1));
    let near =
        |s: &Sample<3>| target.error(s.time_s, &s.attitude.expect("it carries one")).1 < 1e-3;
    let body = body.with_stops(vec![
        Stop { condition: Condition::EnergyErrorAbove(1.0), for_s: 0.0, exact: false },
        below,
        Stop {
            condition: Condition::AngleAbove(Target::fixed(Mat::identity()), PI),
            for_s: 0.0,
            exact: false,
        },
    ]);
    let (samples, end) = run(&body, lanes(2), &start(), (0.1, 600, 10));
    assert_eq!(end.ending, Ending::Stopped(1));
    let last = samples.last().expect("there is one");
    let first = all.windows(21).position(|held| held.iter().all(near)).expect("it settles");
    assert_eq!(last.step, first as u64 + 20);
    let free = RigidBody::new(moments(), Vec::new(), 0.0).with_stops(vec![Stop {
        condition: Condition::RateBelow(10.0),
        for_s: 0.0,
        exact: false,
    }]);
    let (_, end) = run(&free, lanes(2), &start(), (0.1, 600, 10));
    assert_eq!((end.ending, end.reached.step), (Ending::Stopped(0), 1));
}
