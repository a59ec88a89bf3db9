//! Steps that are too large: the step advised after the failure carries the run, and is not much
//! smaller than need be; and the messages about it.

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::Ordering;
use std::thread;

use serde_json::{Value, json};
use vpd::advise;
use vpd::run::{Control, JobContext, Outcome, Summary, execute};
use vpd::scenario::Scenario;
use vpd::solve::failure::FailureCode;
use vpd::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd::solve::nonlinear::{Rung, Rungs, StopRule};
use vpd::solve::so::{self, Mat, Vector};
use vpd::solve::state::State;
use vpd::solve::stepper::Stepper;
use vpd::solve::stepper::vpd_so3::VpdSo3;
use vpd::solve::tableau::Tableau;

use crate::given::Numbers;
use crate::scenarios::run;

/// A scene, a method, and a time for it.
struct Trial {
    scene: Value,
    method: Value,
    /// Time scale of the fastest motion, in seconds for a radian.
    quick_s: f64,
}

/// Returns scene number `k`: n = 3 to 5; springs, charges, fields, quick spins.
fn trial(k: u64) -> Trial {
    let mut numbers = Numbers(0x9e37_79b9_7f4a_7c15 ^ (k + 1).wrapping_mul(0x2545_f491_4f6c_dd1d));
    (0..20).for_each(|_| {
        numbers.next();
    });
    let n = [3, 3, 4, 3, 5][(k % 5) as usize];
    let mut between = |low: f64, high: f64| low + (high - low) * 0.5 * (1.0 + numbers.next());
    let moments: Vec<f64> = (0..n).map(|_| between(0.5, 1.5)).collect();
    let mut vector = |size: f64| -> Vec<f64> {
        let v: Vec<f64> = (0..n).map(|_| between(-1.0, 1.0)).collect();
        let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        v.iter().map(|x| x * size / length).collect()
    };
    let mut spin = 1.0;
    let (potential, frequency): (Vec<Value>, f64) = match (k / 5) % 4 {
        0 => {
            let stiffness = [3.0, 30.0, 300.0, 3000.0][(k / 20 % 4) as usize];
            let spring = json!({ "kind": "spring", "stiffness": stiffness, "rest_length": 0.5,
                "body_point": vector(1.0), "position": vector(1.8) });
            (vec![spring], f64::sqrt(stiffness))
        }
        1 => {
            let charges = [-0.5, 0.7].map(|strength| {
                json!({ "kind": "point_source", "strength": strength, "body_point": vector(1.0),
                    "position": vector(1.25) })
            });
            (charges.to_vec(), 8.0)
        }
        2 => {
            let field = json!({ "kind": "uniform", "weight": 5.0, "body_point": vector(1.0),
                "direction": vector(1.0) });
            (vec![field], f64::sqrt(5.0))
        }
        _ => {
            spin = [5.0, 20.0, 60.0][(k / 20 % 3) as usize];
            let spring = json!({ "kind": "spring", "stiffness": 2.0, "body_point": vector(1.0),
                "position": vector(1.5) });
            (vec![spring], 1.5)
        }
    };
    let planes: Vec<f64> = (0..n * (n - 1) / 2).map(|_| between(-spin, spin)).collect();
    let velocity = if n == 3 {
        json!(planes)
    } else {
        let mut rows = vec![vec![0.0; n]; n];
        let mut next = planes.iter();
        for i in 0..n {
            for j in i + 1..n {
                let x = next.next().copied().unwrap_or_default();
                (rows[i][j], rows[j][i]) = (x, -x);
            }
        }
        json!(rows)
    };
    let inertia = if n == 3 {
        json!({ "principal": [moments[1] + moments[2], moments[0] + moments[2], moments[0] + moments[1]] })
    } else {
        json!({ "second_moments": moments })
    };
    let tableau = ["gauss1", "gauss2", "gauss3", "gauss4"][(k % 4) as usize];
    let kind = ["auto", "fixed_point"][(k / 2 % 2) as usize];
    let names: &[&str] = if n == 3 {
        &["vpd", "vpd", "vrkmk", "quaternion_gauss", "lgvi"]
    } else {
        &["vpd", "vpd", "vrkmk"]
    };
    let method = match names[(k / 3) as usize % names.len()] {
        "lgvi" => json!({ "name": "lgvi", "order": 4 }),
        name @ "quaternion_gauss" => json!({ "name": name, "tableau": tableau }),
        name => json!({ "name": name, "tableau": tableau, "solver": { "kind": kind } }),
    };
    Trial {
        scene: json!({ "inertia": inertia, "potential": potential,
            "initial": { "angular_velocity": { "body": velocity } } }),
        method,
        quick_s: 1.0 / f64::max(frequency, spin),
    }
}

impl Trial {
    /// Returns the duration of the run: some swings.
    fn time_s(&self) -> f64 {
        40.0 * self.quick_s
    }

    fn run(&self, step_s: f64, directory: &Path) -> Summary {
        let steps = (self.time_s() / step_s).ceil() as u64;
        let scenario = json!({
            "name": "trial", "scene": self.scene, "method": self.method, "step_s": step_s, "steps": steps,
            "log": { "every": 1, "channels": ["/energy"], "compression": "none" }
        });
        run(&scenario.to_string(), &directory.join("trial.mcap"))
    }
}

/// Result of a trial.
#[derive(Debug)]
enum End {
    /// No step that was tried failed.
    NeverFails,
    /// A step failed, and nothing was advised; a step of the last size, if there is one, carries the run.
    Unadvised(f64, String, Option<f64>),
    /// A step of the first size failed, and one of the second was advised, which does not carry the run.
    Misled(f64, f64),
    /// A step of `caution` times the advised one would have sufficed.
    Advised { caution: f64 },
}

fn carries(summary: &Summary) -> bool {
    summary.outcome == Outcome::Succeeded && summary.warning.is_none()
}

fn end(trial: &Trial) -> End {
    let directory = tempfile::tempdir().expect("a temporary directory");
    // Larger and larger steps, until one fails.
    let mut failed_s = trial.quick_s * 0.5;
    let diagnosis = loop {
        if failed_s > 0.5 * trial.time_s() {
            return End::NeverFails;
        }
        if let Some(diagnosis) = trial.run(failed_s, directory.path()).diagnosis {
            break diagnosis;
        }
        failed_s *= 1.6;
    };
    // Down again, until one does not.
    let works = |down_to: f64| {
        let mut step_s = failed_s / 1.07;
        while step_s > down_to {
            if carries(&trial.run(step_s, directory.path())) {
                return Some(step_s);
            }
            step_s /= 1.07;
        }
        None
    };
    let Some(advised_s) = diagnosis.advised_step_s else {
        return End::Unadvised(failed_s, diagnosis.advice, works(failed_s / 100.0));
    };
    if !carries(&trial.run(advised_s, directory.path())) {
        return End::Misled(failed_s, advised_s);
    }
    End::Advised { caution: works(advised_s).unwrap_or(advised_s) / advised_s }
}

fn judged(scenes: u64, each: u64) {
    let todo = Mutex::new((0..scenes).map(|k| k * each).rev().collect::<Vec<_>>());
    let found = Mutex::new(Vec::new());
    thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let Some(k) = todo.lock().expect("no panic").pop() else { break };
                    let end = end(&trial(k));
                    println!("scene {k}: {end:?}");
                    found.lock().expect("no panic").push((k, end));
                }
            });
        }
    });
    let found = found.into_inner().expect("no panic");
    let mut cautions = Vec::new();
    let mut wrong = Vec::new();
    for (k, end) in &found {
        match end {
            End::Advised { caution } => cautions.push(*caution),
            End::Unadvised(failed_s, advice, Some(works_s)) => {
                wrong.push(format!("scene {k}: {failed_s} failed, {works_s} works: {advice}"));
            }
            End::Misled(failed_s, advised_s) => {
                wrong.push(format!("scene {k}: {failed_s} failed, and so did {advised_s}"));
            }
            End::NeverFails | End::Unadvised(..) => {}
        }
    }
    cautions.sort_by(f64::total_cmp);
    let (median, worst) = (cautions[cautions.len() / 2], cautions[cautions.len() - 1]);
    println!(
        "advised in {} of {}, median caution {median:.2}, worst {worst:.2}",
        cautions.len(),
        found.len()
    );
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(cautions.len() as u64 * 2 >= scenes, "{} of {scenes} fail", cautions.len());
    assert!(median <= 1.5, "{median}");
}

#[test]
fn an_advised_step_carries_the_run() {
    judged(20, 7);
}

/// The advised step is used as it is, in the place of `step_s`: the duration is a whole number of
/// it, and so is the time between samples.
#[test]
fn an_advised_step_divides_the_duration() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("dipole.mcap");
    // The last has no divisor of two digits.
    for (duration_s, step_s) in [(10.0, 1.0), (7.0, 0.7), (12.6, 0.6), (9.001, 9.001 / 9.0)] {
        let mut scenario: Value =
            serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
        scenario.as_object_mut().expect("an object").remove("steps");
        (scenario["duration_s"], scenario["step_s"]) = (json!(duration_s), json!(step_s));
        (scenario["log"], scenario["expect"]) = (json!({ "every_s": 2.0 * step_s }), json!({}));
        let failed = run(&scenario.to_string(), &log);
        let diagnosis = failed.diagnosis.expect("too long a step");
        let advised = diagnosis.advised_step_s.expect("a smaller step helps");
        scenario["step_s"] = json!(advised);
        let accepted = Scenario::from_json(scenario.to_string().as_bytes());
        assert!(accepted.is_ok(), "{duration_s} s in steps of {advised} s: {accepted:?}");
        let again = run(&scenario.to_string(), &log);
        assert!(carries(&again), "{duration_s} s in steps of {advised} s: {:?}", again.diagnosis);
    }
}

/// `cargo test --release advised_steps_of_two_hundred_scenes -- --ignored --nocapture`
#[test]
#[ignore = "half a minute: cargo test --release advised_steps_of_two_hundred_scenes -- --ignored --nocapture"]
fn advised_steps_of_two_hundred_scenes() {
    judged(200, 1);
}

/// Returns a stiff spring, with steps that cannot be made.
fn stiff() -> Value {
    json!({
        "name": "stiff",
        "scene": {
            "inertia": { "principal": [1.0, 1.2, 0.8] },
            "potential": [{ "kind": "spring", "stiffness": 1e6, "rest_length": 0.5,
                "body_point": [0, 0, -1], "position": [0, 0, -1.6] }],
            "initial": {
                "attitude": { "axis_angle": { "axis": [1, 0, 0], "angle_rad": 0.2 } },
                "angular_velocity": { "body": [0, 0, 1.0] }
            }
        },
        "method": { "name": "vpd", "tableau": "gauss2", "solver": { "kind": "fixed_point" } },
        "step_s": 0.01, "steps": 400
    })
}

#[test]
fn the_cause_names_the_stiffness_where_that_is_it() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("run.mcap");
    let summary = run(&stiff().to_string(), &log);
    let diagnosis = summary.diagnosis.expect("the step is too large");
    assert!(diagnosis.cause.contains("the potential is stiff"), "{}", diagnosis.cause);
    // A quick spin is not stiff.
    let mut quick = stiff();
    quick["scene"]["potential"] = json!([]);
    quick["scene"]["initial"]["angular_velocity"] = json!({ "body": [300.0, 300.0, 1.0] });
    quick["method"]["name"] = json!("vpd");
    let summary = run(&quick.to_string(), &log);
    let diagnosis = summary.diagnosis.expect("the step is too large");
    assert!(!diagnosis.cause.contains("stiff"), "{}", diagnosis.cause);
}

#[test]
fn a_search_ends_when_the_run_is_cancelled() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let scenario = Scenario::from_json(stiff().to_string().as_bytes()).expect("a good scenario");
    let log = directory.path().join("run.mcap");
    // Cancelled before the first sweep of the search, which alone notices it.
    let control = Control::default();
    control.settling.cancelled.store(true, Ordering::Relaxed);
    let context = JobContext { log: &log, control: &control };
    let summary = execute(&advise::plan(&scenario).expect("a plan"), &context)
        .expect("the log can be written");
    let diagnosis = summary.diagnosis.expect("the step is too large");
    assert_eq!(diagnosis.advised_step_s, None);
    assert!(diagnosis.advice.contains("no step is advised"), "{}", diagnosis.advice);
}

#[test]
fn lost_energy_is_noticed_without_its_channel() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let warning = |scene: Value, channels: Value| {
        let scenario = json!({
            "name": "near", "scene": scene, "method": { "name": "splitting", "order": 4 },
            "step_s": 0.01, "steps": 200, "log": { "channels": channels }
        });
        let summary = run(&scenario.to_string(), &directory.path().join("run.mcap"));
        assert_eq!(summary.outcome, Outcome::Succeeded);
        assert_eq!(summary.energy.is_some(), channels[0] == "/energy");
        summary.warning
    };
    // A charge swings past one that attracts it, at a millionth of its arm.
    let past = |distance: f64| {
        json!({
            "inertia": { "principal": [1.0, 1.0, 0.5] },
            "potential": [{ "kind": "point_source", "strength": -1.0, "body_point": [0, 0, -1],
                "position": [0, 0, -1.0 - distance] }],
            "initial": {
                "attitude": { "axis_angle": { "axis": [1, 0, 0], "angle_rad": 0.5 } },
                "angular_velocity": { "body": [-1.0, 0, 0] }
            }
        })
    };
    for channels in [json!(["/energy"]), json!(["/state"])] {
        assert!(warning(past(1e-6), channels.clone()).is_some(), "{channels}");
        assert_eq!(warning(past(0.5), channels), None);
    }
    // It is at rest in the end as at the beginning: nothing is lost.
    let mut swing = past(0.5);
    swing["initial"]["angular_velocity"] = json!({ "body": [0, 0, 0] });
    assert_eq!(warning(swing, json!(["/state"])), None);
    // The warning for a body with torques uses its balance.
    let pushed = |distance: f64, damping: f64| {
        let mut scene = past(distance);
        scene["torques"] = json!([{ "viscous": { "coefficient": damping } }]);
        let scenario = json!({
            "name": "pushed", "scene": scene, "method": { "name": "rk", "tableau": "rk4" },
            "step_s": 0.01, "steps": 200, "log": { "channels": ["/energy"] }
        });
        run(&scenario.to_string(), &directory.path().join("run.mcap")).warning
    };
    assert!(pushed(1e-6, 0.05).is_some());
    assert_eq!(pushed(0.5, 0.05), None);
}

#[test]
fn a_second_root_is_refused() {
    let vpd = |stages: usize, rungs: Rungs, start: &State<3>| {
        let tableau = Tableau::gauss(stages).expect("1 to 8 stages");
        let stop = StopRule { rungs, ..StopRule::default() };
        let mut stepper = VpdSo3::new(tableau, stop).expect("at most 8 stages");
        stepper.start(start);
        stepper
    };
    let mut numbers = Numbers(88_172_645_463_325_252);
    let (mut refused, mut solved, mut furthest) = (0, 0, 0.0_f64);
    for scene in 0..48_usize {
        let [a, b, c] = [0.6, 0.6, 0.5].map(|part| part * numbers.next());
        let moments = [(1.0 + b) + (0.8 + c), (1.0 + a) + (0.8 + c), (1.0 + a) + (1.0 + b)];
        let weight = |i: usize, j: usize| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] };
        let mut on_sphere = |radius: f64| {
            let v = Vector::<3>::new(numbers.next(), numbers.next(), numbers.next());
            v * (radius / v.norm())
        };
        let terms = (0..2).map(|_| {
            let (body_point, space) = (on_sphere(1.0), on_sphere(1.4));
            let law = match scene % 3 {
                0 => Law::Spring { stiffness: 20.0, rest_length: 0.5, body_point },
                1 => Law::PointSource { strength: -1.0, body_point },
                _ => Law::Uniform { weight: 6.0, body_point },
            };
            Term { law, space }
        });
        let terms = terms.collect();
        let body = RigidBody::new(Kinetic::Principal { weights: Mat::from_fn(weight) }, terms, 0.0);
        let mut three =
            |size: f64| [numbers.next(), numbers.next(), numbers.next()].map(|x| x * size);
        let start =
            State { attitude: so::exp(&so::hat(&three(1.0))), momentum: so::hat(&three(2.0)) };
        let stages = [2, 4][scene / 3 % 2];
        for h in (0..14).map(|k| 0.1 * 1.15_f64.powi(k + 1)) {
            let mut stepper = vpd(stages, Rungs::Newton, &start);
            for _ in 0..60 {
                let before = State {
                    attitude: stepper.attitude().expect("carried"),
                    momentum: stepper.momentum(),
                };
                let rung = match stepper.step(&body, h) {
                    Ok(convergence) => convergence.rung,
                    Err(failure) => {
                        refused += u32::from(failure.code == FailureCode::SecondRoot);
                        break;
                    }
                };
                assert_eq!(rung, Rung::Newton);
                solved += 1;
                let mut short = vpd(4, Rungs::Both, &before);
                if (0..16).all(|_| short.step(&body, h / 16.0).is_ok()) {
                    let [a, b] =
                        [&stepper, &short].map(|stepper| stepper.attitude().expect("carried"));
                    furthest = furthest.max((0.5 * (a - b).norm_squared()).sqrt());
                }
            }
        }
    }
    println!("{refused} refused, {solved} solved, the furthest off by {furthest:.2}");
    // Second roots are off by 0.5 to 1.4.
    assert!(refused > 0 && furthest < 0.6, "{refused} refused, {furthest}");
}

/// No direction is free here, so nothing but the spatial momentum itself shows that it is beyond all numbers.
#[test]
fn a_sample_beyond_all_numbers_ends_the_run_and_not_the_program() {
    let spring = |stiffness: f64, body_point: [f64; 3], position: [f64; 3]| json!({"kind": "spring", "stiffness": stiffness, "rest_length": 0.5, "body_point": body_point, "position": position});
    let scenario = json!({
        "name": "beyond all numbers",
        "scene": {
            "inertia": {"principal": [1, 1.5, 2]},
            "potential": [
                spring(3e4, [1.0, 0.0, 0.0], [2.0, 0.3, 0.1]),
                spring(4e4, [0.0, 1.0, 0.0], [0.0, 3.0, 0.2]),
                spring(4e4, [0.0, 0.0, 1.0], [0.3, 0.2, 2.0])
            ],
            "initial": {"angular_velocity": {"body": [1, 2, 3]}}
        },
        "method": {"name": "rk", "tableau": "rk4"},
        "step_s": 0.2,
        "steps": 40,
        "log": {"every": 1}
    });
    let folder = tempfile::tempdir().expect("a temporary directory");
    let summary = run(&scenario.to_string(), &folder.path().join("log.mcap"));
    assert_eq!(summary.outcome, Outcome::Failed);
    let diagnosis = summary.diagnosis.expect("it failed");
    assert_eq!(diagnosis.code, FailureCode::NonFinite.as_str());
    assert!(summary.samples >= 1 && diagnosis.advised_step_s.is_some(), "{diagnosis}");
}
