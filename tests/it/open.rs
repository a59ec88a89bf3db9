//! User-defined systems in the program: the examples, their logs, and errors.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;

use serde_json::json;
use vpd::chart::{draw_logs, stability_map};
use vpd::log::inspect::inspect;
use vpd::run::{Control, JobContext, Outcome, Recording};
use vpd::scenario::{Inertia, Scenario, Scene};
use vpd::solve::failure::Failure;
use vpd::solve::hamiltonian::{Hamiltonian, Kinetic, Law, RigidBody, Term};
use vpd::solve::nonlinear::{Convergence, Rungs, StopRule};
use vpd::solve::so::{self, Mat, Vector};
use vpd::solve::state::State;
use vpd::solve::stepper::Stepper;
use vpd::solve::stepper::vpd::Vpd;
use vpd::solve::stepper::vpd_so3::VpdSo3;
use vpd::solve::system::{Energy, System};
use vpd::solve::tableau::Tableau;
use vpd::solve::trajectory::Schedule;
use vpd::study::own::{self, Candidate, Question};
use vpd::study::stability::stability;
use vpd::study::{Entry, Watch, all_methods};
use vpd::verify::verify;

#[path = "../../examples/custom_lagrangian.rs"]
mod custom_lagrangian;
#[path = "../../examples/custom_potential.rs"]
mod custom_potential;
#[path = "../../examples/read_a_log.rs"]
mod read_a_log;

#[test]
fn a_potential_of_ones_own_has_a_log_and_charts() {
    let folder = tempfile::tempdir().expect("a folder");
    let summary = custom_potential::run(folder.path()).expect("a run");
    assert_eq!(summary.outcome, Outcome::Succeeded);
    let energy = summary.energy.expect("logged");
    assert!(energy.max_abs_error > 0.0 && energy.max_abs_error < 1e-5, "{energy:?}");
    assert!(summary.orthogonality.expect("logged").max < 1e-14);
    assert!(summary.momentum.is_none(), "nothing was said to be conserved");

    let log = folder.path().join("cubic.mcap");
    let (states, error) = read_a_log::read(&log).expect("a finished log");
    assert_eq!((states, error), (1001, energy.max_abs_error));
    let sum = inspect(&log).expect("readable");
    assert!(sum.finished);
    assert_eq!(sum.job.expect("a record")["name"], "cubic");
    assert!(sum.topics.iter().any(|topic| topic.topic == "/tf"));
    let drawn =
        draw_logs(std::slice::from_ref(&log), &folder.path().join("charts")).expect("drawn");
    assert_eq!(drawn.len(), 2, "energy and orthogonality");
    assert!(folder.path().join("energy.svg").exists());
    let refused = verify(&log).expect_err("no scenario").to_string();
    assert_eq!(refused, "the log holds no scenario");
}

#[test]
fn a_lagrangian_of_ones_own_has_a_log() {
    let folder = tempfile::tempdir().expect("a folder");
    let summary = custom_lagrangian::run(folder.path()).expect("a run");
    assert_eq!((summary.outcome, summary.samples), (Outcome::Succeeded, 201));
    let energy = summary.energy.expect("logged");
    assert!(energy.max_abs_error > 0.0 && energy.max_abs_error < 1e-6, "{energy:?}");
    assert!(summary.orthogonality.expect("logged").max < 1e-14);
    let sum = inspect(&folder.path().join("charged.mcap")).expect("readable");
    assert!(sum.finished);
    let job = sum.job.expect("a record");
    assert_eq!(job["dimension"], "4");
    assert_eq!(job["system"], "quartic kinetic energy, field A");
}

/// A free body whose law is lost once it has turned by a right angle.
struct Lost;

impl System<3> for Lost {
    fn energy(&self, _g: &Mat<3>, mu: &Mat<3>) -> Energy {
        Energy { kinetic: 0.5 * so::inner(mu, mu), potential: 0.0 }
    }
}

impl Hamiltonian<3> for Lost {
    fn velocity(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
        if g[(0, 0)] > 0.0 { *mu } else { mu * f64::NAN }
    }

    fn gradient(&self, _g: &Mat<3>, _mu: &Mat<3>) -> Mat<3> {
        Mat::zeros()
    }
}

#[test]
fn what_goes_wrong_is_said_in_a_finished_log() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("lost.mcap");
    let stepper = || Vpd::new(Tableau::gauss(2).expect("2 stages"), StopRule::default());
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.0, 0.0, 1.0]) };
    let schedule = Schedule { step_s: 0.1, steps: 100, every: 0 };
    let recording = Recording {
        notes: BTreeMap::from([("name".to_owned(), "not the name".to_owned())]),
        ..Recording::new("lost")
    };
    let control = Control::default();
    let context = JobContext { log: &log, control: &control };
    let summary = recording.run(&Lost, &mut stepper(), &start, schedule, &context).expect("a log");
    assert_eq!(summary.outcome, Outcome::Failed);
    let diagnosis = summary.diagnosis.expect("a reason");
    assert_eq!((diagnosis.step, summary.samples), (summary.steps + 1, summary.steps + 1));
    assert!((15..=16).contains(&diagnosis.step), "{diagnosis}");
    assert!(diagnosis.advice.contains("no other step was tried"), "{diagnosis}");
    let sum = inspect(&log).expect("readable");
    assert!(sum.finished);
    assert_eq!(sum.outcome.expect("a record")["state"], "failed");
    assert_eq!(sum.job.expect("a record")["name"], "lost");

    // Cancelled, a run has a log; interrupted it has none, and leaves none.
    control.cancelled.store(true, Ordering::Relaxed);
    let summary = recording.run(&Lost, &mut stepper(), &start, schedule, &context).expect("a log");
    assert_eq!((summary.outcome, summary.steps), (Outcome::Cancelled, 0));
    std::fs::remove_file(&log).expect("it was there");
    let control = Control::default();
    control.interrupt();
    let context = JobContext { log: &log, control: &control };
    recording.run(&Lost, &mut stepper(), &start, schedule, &context).expect_err("interrupted");
    assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0);
}

/// The orders are 2, 4 and 6 by the table, against a reference that both forms of VPD agree on.
#[test]
fn work_and_precision_of_a_system_of_ones_own() {
    struct Field(Mat<3>);
    impl Field {
        fn seen(&self, g: &Mat<3>) -> Mat<3> {
            g.transpose() * self.0 * g
        }
    }
    impl System<3> for Field {
        fn energy(&self, g: &Mat<3>, mu: &Mat<3>) -> Energy {
            let nu = mu - self.seen(g);
            Energy { kinetic: 0.5 * so::inner(&nu, &nu), potential: 0.0 }
        }
    }
    impl Hamiltonian<3> for Field {
        fn velocity(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
            mu - self.seen(g)
        }

        fn gradient(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
            let (b, omega) = (self.seen(g), self.velocity(g, mu));
            b * omega - omega * b
        }
    }
    let vpd = |stages: usize| {
        move || -> Box<dyn Stepper<3, Field>> {
            Box::new(Vpd::new(Tableau::gauss(stages).expect("1 to 8"), StopRule::default()))
        }
    };
    let (one, two, three, six, eight) = (vpd(1), vpd(2), vpd(3), vpd(6), vpd(8));
    let candidate = |tableau, stepper| Candidate { name: "vpd", tableau, stepper };
    let initial = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, 0.5, 1.0]) };
    let question = Question {
        system: &Field(so::hat(&[0.4, 0.0, 0.7])),
        initial: &initial,
        time_s: 2.0,
        first_steps: 4,
        halvings: 5,
    };
    let found = own::precision(
        question,
        [&candidate("gauss8", &eight), &candidate("gauss6", &six)],
        &[candidate("gauss1", &one), candidate("gauss2", &two), candidate("gauss3", &three)],
        &Watch::default(),
    )
    .expect("a reference");
    assert!(found.error < 1e-12, "{:e}", found.error);
    for order in [2, 4, 6] {
        let rows = found.table.rows.iter().filter(|row| row.order == order);
        let errors: Vec<f64> = rows.filter_map(|row| row.error).collect();
        let measured = (errors[1] / errors[3]).log2() / 2.0;
        assert!((measured - f64::from(order)).abs() < 0.4, "order {order}: {measured}");
    }
    assert!(found.table.rows.iter().all(|row| row.ns_per_step.is_some()));
    assert!(found.table.to_csv().lines().count() == found.table.rows.len() + 1);
}

#[test]
fn a_scenario_needs_no_json() {
    let inertia = Inertia::Principal([1.0, 2.0, 3.0]);
    let scenario = Scenario::of("free", Scene::free(inertia.clone()), 0.01, 100).expect("one");
    let text = scenario.to_json();
    assert_eq!(Scenario::from_json(&text).expect("the same"), scenario);
    let refused = Scenario::of("free", Scene::free(inertia), -0.01, 100).expect_err("a step");
    assert_eq!(refused.pointer, "/step_s");
}

/// The map of a scene, and of its body as a user-defined system, have the same borders.
#[test]
fn the_map_of_a_system_of_ones_own() {
    let watch = Watch::default();
    let text = json!({
        "name": "top", "step_s": 0.01, "steps": 100,
        "scene": {
            "inertia": {"principal": [2.0, 2.0, 1.0]},
            "potential": [{"kind": "uniform", "weight": 1.0, "body_point": [0.0, 0.0, 1.0], "direction": [0.3, 0.0, 1.0]}],
            "initial": {"momentum": {"body": [[0.0, -1.0, 0.5], [1.0, 0.0, -0.3], [-0.5, 0.3, 0.0]]}}
        }
    });
    let scene = Scenario::from_json(text.to_string().as_bytes()).expect("a scene");
    let entries: Vec<Entry> = all_methods(&scene)
        .into_iter()
        .filter(|entry| {
            ["vpd gauss1, fixed point", "vpd gauss2, fixed point"]
                .contains(&entry.label().replace('_', " ").as_str())
        })
        .collect();
    assert_eq!(
        entries.len(),
        2,
        "{:?}",
        all_methods(&scene).iter().map(Entry::label).collect::<Vec<_>>()
    );
    let of_scene = stability(&scene, &entries, &watch).expect("a map");

    let moments = [2.0, 2.0, 1.0];
    let law = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.0, 0.0, 1.0) };
    let field = Term { law, space: Vector::<3>::new(0.3, 0.0, 1.0) };
    let body = RigidBody::new(Kinetic::of_moments(moments), vec![field], 0.0);
    let momentum = so::hat(&[0.3, 0.5, 1.0]);
    let initial = State { attitude: Mat::identity(), momentum };
    let by = |stages: usize, rungs: Rungs| {
        move || -> Box<dyn Stepper<3>> {
            let stop = StopRule { rungs, ..StopRule::default() };
            Box::new(VpdSo3::new(Tableau::gauss(stages).expect("1 to 8"), stop).expect("lanes"))
        }
    };
    let (one, two) = (by(1, Rungs::FixedPoint), by(2, Rungs::FixedPoint));
    let eight = by(8, Rungs::Both);
    let candidate = |tableau, stepper| Candidate { name: "vpd", tableau, stepper };
    let question =
        Question { system: &body, initial: &initial, time_s: 20.0, first_steps: 40, halvings: 5 };
    let map = own::stability(
        question,
        &candidate("gauss8", &eight),
        &[candidate("gauss1", &one), candidate("gauss2", &two)],
        &watch,
    )
    .expect("a map");
    for (own, scene) in map.borders.iter().zip(&of_scene.borders) {
        let [own_s, scene_s] = [own, scene].map(|border| border.usable_step_s.expect("usable"));
        let ratio = own_s / scene_s;
        assert!((0.9..1.1).contains(&ratio), "{}: {own_s} and {scene_s}", own.label);
        assert_eq!(own.broken, scene.broken);
    }
    assert!(stability_map("top", &map).expect("drawn").contains("vpd gauss2"));
    assert_eq!(map.table().rows.len(), 2 * map.steps_s.len());
}

/// `vpd` with two stages, but for a half turn about the body's third axis after some of the late steps: still a rotation, of
/// the same energy where the body is symmetric.
struct Straying {
    steps: Box<dyn Stepper<3>>,
    made: u32,
}

impl Stepper<3> for Straying {
    fn order(&self) -> u32 {
        self.steps.order()
    }

    fn start(&mut self, state: &State<3>) {
        self.steps.start(state);
        self.made = 0;
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let solved = self.steps.step(body, h)?;
        self.made += 1;
        if self.made > 2000 && self.made % 100 == 1 {
            let mut attitude = self.steps.attitude().expect("carried");
            attitude.column_mut(0).neg_mut();
            attitude.column_mut(1).neg_mut();
            self.steps.start(&State { attitude, momentum: self.steps.momentum() });
        }
        Ok(solved)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        self.steps.attitude()
    }

    fn momentum(&self) -> Mat<3> {
        self.steps.momentum()
    }
}

#[test]
fn late_steps_that_end_elsewhere_are_told() {
    let law = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.0, 0.0, 1.0) };
    let field = Term { law, space: Vector::<3>::new(0.3, 0.0, 1.0) };
    let body = RigidBody::new(Kinetic::of_moments([2.0, 2.0, 1.0]), vec![field], 0.0);
    let initial = State { attitude: Mat::identity(), momentum: so::hat(&[0.0, 0.0, 1.0]) };
    let by = |stages: usize| {
        move || -> Box<dyn Stepper<3>> {
            let tableau = Tableau::gauss(stages).expect("1 to 8");
            Box::new(VpdSo3::new(tableau, StopRule::default()).expect("lanes"))
        }
    };
    let (two, eight) = (by(2), by(8));
    let straying = || -> Box<dyn Stepper<3>> { Box::new(Straying { steps: two(), made: 0 }) };
    let candidate = |name, stepper| Candidate { name, tableau: "gauss", stepper };
    let question =
        Question { system: &body, initial: &initial, time_s: 20.0, first_steps: 40, halvings: 5 };
    let map = own::stability(
        question,
        &candidate("exact", &eight),
        &[candidate("as it is", &two), candidate("straying", &straying)],
        &Watch::default(),
    )
    .expect("a map");
    let classes = |k: usize| map.cells[k][..8].iter().map(|cell| cell.class.as_str());
    assert!(classes(0).all(|class| class == "stable"), "{:?}", classes(0).collect::<Vec<_>>());
    let told = classes(1).all(|class| class == "wrong_branch");
    assert!(told, "{:?}", classes(1).collect::<Vec<_>>());
}

#[test]
fn a_start_that_is_no_state_is_refused_before_a_log_is_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("refused.mcap");
    let context = JobContext { log: &log, control: &Control::default() };
    let body = RigidBody::new(Kinetic::of_moments([1.0, 2.0, 2.5]), Vec::new(), 0.0);
    let refused = |attitude: Mat<3>, step_s| {
        let mut stepper =
            VpdSo3::new(Tableau::gauss(2).expect("2 stages"), StopRule::default()).expect("lanes");
        let start = State { attitude, momentum: so::hat(&[0.0, 0.1, 1.0]) };
        let schedule = Schedule { step_s, steps: 3, every: 1 };
        let run = Recording::new("refused").run(&body, &mut stepper, &start, schedule, &context);
        run.err().map(|error| (error.code(), error.to_string()))
    };
    let four_digits = Mat::identity() * 1.0001;
    let (code, text) = refused(four_digits, 0.1).expect("no rotation");
    assert_eq!(code, "invalid_input");
    assert!(text.contains("2.0e-4"), "{text}");
    for step_s in [0.0, -0.1, f64::NAN] {
        assert_eq!(refused(Mat::identity(), step_s).expect("no step").0, "invalid_input");
    }
    assert!(!log.exists() && !folder.path().join("refused.mcap.part").exists());
    assert_eq!(refused(Mat::identity(), 0.1), None);
}
