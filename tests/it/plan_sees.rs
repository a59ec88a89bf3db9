//! No more is modelled than a scene needs: the simplifications of the plan, their messages, and
//! that no result changes.
//!
//! Each scene is run as it is planned and, by the solver itself, with every term as it is given.

use std::collections::BTreeSet;

use serde_json::{Value, json};
use vpd::log::reader::{Message, read_samples};
use vpd::log::schema::Channel;
use vpd::method::Integrator;
use vpd::plan::Plan;
use vpd::run::Outcome;
use vpd::scenario::{PotentialTerm, Scenario};
use vpd::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd::solve::nonlinear::StopRule;
use vpd::solve::so::{self, Mat, Vector};
use vpd::solve::state::State;
use vpd::solve::stepper::Stepper;
use vpd::solve::stepper::vpd::Vpd;
use vpd::solve::stepper::vpd_so3::VpdSo3;
use vpd::solve::tableau::Tableau;

use crate::scenarios::run;

const STEP_S: f64 = 0.01;
const STEPS: u64 = 200;
/// The largest change of attitude and momentum at the end.
const UNCHANGED: f64 = 1e-14;

fn uniform(weight: f64, body_point: [f64; 3], direction: [f64; 3]) -> Value {
    json!({"kind": "uniform", "weight": weight, "body_point": body_point, "direction": direction})
}

fn source(strength: f64, body_point: [f64; 3], position: [f64; 3]) -> Value {
    json!({"kind": "point_source", "strength": strength, "body_point": body_point, "position": position})
}

fn spring(stiffness: f64, rest_length: f64, body_point: [f64; 3], position: [f64; 3]) -> Value {
    json!({"kind": "spring", "stiffness": stiffness, "rest_length": rest_length, "body_point": body_point, "position": position})
}

fn gradient(strength: f64, direction: [f64; 3]) -> Value {
    json!({"kind": "gravity_gradient", "strength": strength, "direction": direction})
}

fn tumbling() -> Value {
    json!({
        "attitude": {"axis_angle": {"axis": [1, 0.3, 0.2], "angle_rad": 0.7}},
        "angular_velocity": {"body": [0.3, -0.5, 0.8]}
    })
}

/// Expected plan of a scene.
struct Row {
    name: &'static str,
    inertia: Value,
    potential: Vec<Value>,
    initial: Value,
    method: Value,
    /// Messages, and their place: a term's index, or `method` or `motion`.
    says: &'static [(&'static str, &'static str)],
    /// Number of terms that are still modelled.
    modelled: usize,
}

fn row(name: &'static str, potential: Vec<Value>, modelled: usize) -> Row {
    Row {
        name,
        inertia: json!({"principal": [1.0, 2.0, 2.5]}),
        potential,
        initial: tumbling(),
        method: json!({"name": "vpd", "tableau": "gauss4"}),
        says: &[],
        modelled,
    }
}

fn rows() -> Vec<Row> {
    let weight = uniform(0.7, [0.1, 0.2, -0.9], [0.0, 0.0, 1.0]);
    let in_plane = json!({
        "attitude": {"axis_angle": {"axis": [0, 0, 1], "angle_rad": 0.4}},
        "angular_velocity": {"body": [0, 0, 1.0]}
    });
    let many = |k: usize| 0.01 * ((k % 7) as f64 - 2.5);
    let point = |k: usize| [0.1 * (k % 3) as f64, 0.3 - 0.1 * (k % 5) as f64, -0.02 * k as f64];
    vec![
        Row {
            says: &[
                ("1", "cancels with /scene/potential/2"),
                ("2", "cancels with /scene/potential/1"),
            ],
            ..row(
                "uniform fields that cancel",
                vec![
                    weight.clone(),
                    uniform(0.3, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
                    uniform(-0.1, [3.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
                ],
                1,
            )
        },
        Row {
            says: &[("1", "cancels with /scene/potential/2")],
            ..row(
                "sources that cancel",
                vec![
                    weight.clone(),
                    source(0.1, [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]),
                    source(-0.3, [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]),
                    source(0.2, [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]),
                ],
                1,
            )
        },
        Row {
            says: &[
                ("0", "others are merged into it"),
                ("299", "merged into /scene/potential/0: uniform fields add up"),
            ],
            ..row(
                "fields along one direction",
                (0..300)
                    .map(|k| {
                        uniform(
                            many(k),
                            point(k),
                            [0.0, 0.3 - 0.6 * (k % 2) as f64, 0.4 - 0.8 * (k % 2) as f64],
                        )
                    })
                    .collect(),
                1,
            )
        },
        Row {
            says: &[("299", "uniform fields add up")],
            ..row(
                "fields along any direction",
                (0..300)
                    .map(|k| {
                        uniform(
                            many(k),
                            point(k),
                            [0.01 * k as f64, 0.3 - 0.1 * (k % 4) as f64, 0.4],
                        )
                    })
                    .collect(),
                3,
            )
        },
        Row {
            says: &[("7", "merged into /scene/potential/0: uniform fields add up")],
            ..row(
                "fields at one body point",
                (0..8)
                    .map(|k| uniform(many(k) + 0.1, [0.3, 0.0, -1.0], [0.1 * k as f64, 0.3, 0.4]))
                    .collect(),
                1,
            )
        },
        Row {
            says: &[("299", "merged into /scene/potential/0: they act between the same points")],
            ..row(
                "one source three hundred times",
                vec![source(0.004, [0.3, 0.0, -1.0], [0.0, 0.2, -2.0]); 300],
                1,
            )
        },
        Row {
            says: &[("1", "they act between the same points")],
            ..row(
                "one spring twice",
                vec![spring(0.5, 0.5, [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]); 2],
                1,
            )
        },
        Row {
            says: &[("0", "merged into"), ("1", "a spring with rest length 0 is a uniform field")],
            ..row(
                "springs of no length at rest",
                vec![
                    uniform(1.0, [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]),
                    spring(0.5, 0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 2.0]),
                    spring(0.25, 0.0, [0.0, 1.0, 0.5], [0.0, 0.0, -1.0]),
                ],
                1,
            )
        },
        Row {
            says: &[("2", "pull equally in all directions")],
            ..row(
                "gradients from all sides",
                vec![
                    weight.clone(),
                    gradient(1.0, [0.6, 0.8, 0.0]),
                    gradient(0.25, [-1.6, 1.2, 0.0]),
                    gradient(4.0, [0.0, 0.0, 0.5]),
                ],
                1,
            )
        },
        Row {
            says: &[("1", "merged into /scene/potential/0: their directions are parallel")],
            ..row(
                "gradients along one direction",
                vec![
                    gradient(1.0, [1.0, 0.0, 0.0]),
                    json!({"kind": "gravity_gradient", "strength": 0.5, "direction": [-2.0, 0.0, 0.0],
                    "matrix": [[1, 0.1, 0], [0.1, 2, 0], [0, 0, 3]]}),
                ],
                1,
            )
        },
        Row {
            says: &[("1", "less than rounding")],
            ..row(
                "a strength below rounding",
                vec![weight, source(1e-30, [1.0, 0.0, 0.0], [0.0, 2.0, 0.0])],
                1,
            )
        },
        Row {
            inertia: json!({"principal": [1.0, 1.0, 1.0 + 2.0 * f64::EPSILON]}),
            says: &[("0", "a multiple of I, to rounding")],
            ..row("a sphere in its last digit", vec![gradient(1.0, [1.0, 0.0, 0.0])], 0)
        },
        Row {
            initial: in_plane.clone(),
            method: json!({"name": "vpd", "tableau": "gauss1"}),
            says: &[("motion", "stays in a plane")],
            ..row(
                "a pendulum in a plane",
                vec![
                    uniform(9.81, [0.2, -1.0, 0.0], [0.0, 1.0, 0.0]),
                    spring(4.0, 1.0, [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]),
                    gradient(0.4, [0.3, 1.0, 0.0]),
                ],
                3,
            )
        },
        Row {
            initial: in_plane.clone(),
            method: json!({}),
            says: &[("motion", "stays in a plane"), ("method", "vpd")],
            ..row(
                "the same by the program's choice",
                vec![source(-0.5, [0.2, -1.0, 0.0], [0.0, 2.0, 0.0])],
                1,
            )
        },
        Row {
            initial: json!({"attitude": {"axis_angle": {"axis": [0, 0, 1], "angle_rad": 0.0}}}),
            says: &[("motion", "at rest")],
            ..row("a body that hangs", vec![uniform(9.81, [0.0, 0.0, -1.0], [0.0, 0.0, 1.0])], 1)
        },
        Row {
            method: json!({}),
            says: &[("method", "splitting")],
            ..row("a free body", vec![], 0)
        },
    ]
}

fn scenario(row: &Row) -> Value {
    json!({
        "name": row.name,
        "scene": {"inertia": row.inertia, "potential": row.potential, "initial": row.initial},
        "method": row.method,
        "step_s": STEP_S,
        "steps": STEPS,
        "log": {"every": STEPS}
    })
}

/// Returns the body with every term as it is given.
fn as_given<const N: usize>(
    weights: Mat<N>,
    potential: &[PotentialTerm],
    inertia: &Mat<N>,
) -> RigidBody<N> {
    let point = |v: &[f64]| Vector::<N>::from_column_slice(v);
    // A new kind of term needs a row here only if it is in a scene of these tests.
    #[allow(unreachable_patterns)]
    let term = |term: &PotentialTerm| match term {
        PotentialTerm::Uniform(t) => Term {
            law: Law::Uniform { weight: t.weight, body_point: point(&t.body_point) },
            space: point(&t.direction),
        },
        PotentialTerm::PointSource(t) => Term {
            law: Law::PointSource { strength: t.strength, body_point: point(&t.body_point) },
            space: point(&t.position),
        },
        PotentialTerm::Spring(t) => Term {
            law: Law::Spring {
                stiffness: t.stiffness,
                rest_length: t.rest_length,
                body_point: point(&t.body_point),
            },
            space: point(&t.position),
        },
        PotentialTerm::GravityGradient(t) => Term {
            law: Law::GravityGradient {
                strength: t.strength.expect("given"),
                matrix: t.matrix.as_ref().map_or(*inertia, |m| Mat::from_fn(|i, j| m[i][j])),
            },
            space: point(&t.direction),
        },
        other => unreachable!("no row for {other:?}"),
    };
    RigidBody::new(Kinetic::Principal { weights }, potential.iter().map(term).collect(), 0.0)
}

fn carried<const N: usize>(
    body: &RigidBody<N>,
    stepper: &mut dyn Stepper<N>,
    start: &State<N>,
) -> (Mat<N>, Mat<N>) {
    stepper.start(start);
    for _ in 0..STEPS {
        stepper.step(body, STEP_S).expect("a small step");
    }
    (stepper.attitude().expect("carried"), stepper.momentum())
}

/// Returns attitude and momentum at the end of a run, with the energy at its start.
fn planned<const N: usize>(text: &str) -> (Mat<N>, Mat<N>, f64) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let summary = run(text, &directory.path().join("run.mcap"));
    assert_eq!(summary.outcome, Outcome::Succeeded, "{:?}", summary.diagnosis);
    let rows = summary.last.attitude.expect("an attitude");
    let momentum = summary.last.body_momentum;
    let skew = |i: usize, j: usize| momentum[i][j].as_f64().unwrap_or(f64::NAN);
    let momentum = if N == 3 {
        let vector: Vec<f64> = serde_json::from_value(momentum).expect("a vector");
        so::hat(&vector)
    } else {
        Mat::from_fn(skew)
    };
    let energy = summary.energy.expect("an energy").initial;
    (Mat::from_fn(|i, j| rows[i][j]), momentum, energy)
}

#[test]
fn what_the_plan_sees_is_said_and_changes_no_result() {
    for row in rows() {
        let text = scenario(&row).to_string();
        let given = Scenario::from_json(text.as_bytes()).expect("a good scenario");
        let plan = Plan::new(&given).expect("a plan");
        for (place, says) in row.says {
            let said = match *place {
                "method" => plan.formulation.method.as_str(),
                "motion" => plan.formulation.motion.words().unwrap_or("nothing"),
                index => &plan.potential[index.parse::<usize>().expect("an index")].why,
            };
            assert!(said.contains(says), "{}: {place} says {said}", row.name);
        }
        let kept = plan.potential.iter().filter(|term| term.kept).count();
        assert_eq!(kept, row.modelled, "{}", row.name);

        let moments: [f64; 3] =
            serde_json::from_value(row.inertia["principal"].clone()).expect("moments");
        let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] });
        let inertia = Mat::from_diagonal(&Vector::<3>::from(moments));
        let body = as_given(weights, &given.scene.potential, &inertia);
        let one = json!({"name": "start", "scene": scenario(&row)["scene"], "step_s": 1e-9, "steps": 1,
            "method": {"name": "splitting", "order": 2}});
        let start = start_of(&one);
        // The free body is exact, so any scheme that is exact to rounding is its measure.
        let stages = match row.name {
            "a free body" | "a sphere in its last digit" => 8,
            "a pendulum in a plane" => 1,
            "the same by the program's choice" => 2,
            _ => 4,
        };
        let gauss = Tableau::gauss(stages).expect("a tableau");
        // To the last digit: with one stage a sweep that is spared shows as 1e-13.
        let stop = StopRule { tolerance: 1e-16, stop_early: false, ..StopRule::default() };
        let mut stepper = VpdSo3::new(gauss, stop).expect("few stages");
        let (attitude, momentum) = carried(&body, &mut stepper, &start);
        let (got, got_momentum, energy) = planned::<3>(&text);
        let scale = so::inner(&start.momentum, &start.momentum).sqrt().max(1.0);
        let error = (got - attitude).amax().max((got_momentum - momentum).amax() / scale);
        println!("{:32} {error:.1e}", row.name);
        assert!(error <= UNCHANGED, "{}: {error:e}", row.name);
        let level = body.energy(&start.attitude, &start.momentum).total();
        assert!((energy - level).abs() <= 1e-13 * (1.0 + level.abs()), "{}: H", row.name);
    }
}

/// Returns attitude and momentum at the start, as the program reads them.
fn start_of(scenario: &Value) -> State<3> {
    let initial = &scenario["scene"]["initial"];
    let turn = &initial["attitude"]["axis_angle"];
    let axis: [f64; 3] = serde_json::from_value(turn["axis"].clone()).expect("an axis");
    let half = 0.5 * turn["angle_rad"].as_f64().expect("an angle");
    let axis = Vector::<3>::from(axis).normalize() * libm::sin(half);
    let q = nalgebra::Quaternion::from_parts(libm::cos(half), axis);
    let moments: [f64; 3] =
        serde_json::from_value(scenario["scene"]["inertia"]["principal"].clone()).expect("moments");
    let omega: [f64; 3] =
        serde_json::from_value(initial["angular_velocity"]["body"].clone()).unwrap_or_default();
    let momentum: Vec<f64> = moments.iter().zip(omega).map(|(j, omega)| j * omega).collect();
    State { attitude: vpd::solve::so3::rotation(&q), momentum: so::hat(&momentum) }
}

#[test]
fn what_merges_for_three_merges_in_four_dimensions() {
    let potential = json!([
        {"kind": "spring", "stiffness": 4, "body_point": [1, 0, 0, 0], "position": [0, 2, 0, 0]},
        {"kind": "spring", "stiffness": 2, "body_point": [0, 0, 1, 0], "position": [0, 1, 0, 0]},
        {"kind": "uniform", "weight": 1, "body_point": [0, 0, 0, 1], "direction": [0, -3, 0, 0]},
        {"kind": "gravity_gradient", "strength": 1, "direction": [1, 0, 0, 0], "matrix": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 3, 0], [0, 0, 0, 4]]},
        {"kind": "gravity_gradient", "strength": -1, "direction": [-1, 0, 0, 0], "matrix": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 3, 0], [0, 0, 0, 4]]}
    ]);
    let d = [1.0, 2.0, 3.0, 4.0];
    let omega =
        [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.5], [0.0, 0.0, -0.5, 0.0]];
    let text = json!({
        "name": "four", "step_s": STEP_S, "steps": STEPS,
        "scene": {
            "inertia": {"second_moments": d}, "potential": potential,
            "initial": {"angular_velocity": {"body": omega}}
        }
    });
    let given = Scenario::from_json(text.to_string().as_bytes()).expect("a good scenario");
    let plan = Plan::new(&given).expect("a plan");
    let kept: Vec<bool> = plan.potential.iter().map(|term| term.kept).collect();
    assert_eq!(kept, [true, false, false, false, false]);
    assert_eq!(plan.free_directions, 3);
    let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (d[i] + d[j]) });
    let body = as_given::<4>(weights, &given.scene.potential, &Mat::identity());
    let momentum = Mat::from_fn(|i, j| omega[i][j] * (d[i] + d[j]));
    let start = State { attitude: Mat::identity(), momentum };
    let mut stepper = Vpd::new(Tableau::gauss(2).expect("a tableau"), StopRule::default());
    let (attitude, momentum) = carried(&body, &mut stepper, &start);
    let (got, got_momentum, _) = planned::<4>(&text.to_string());
    let error = (got - attitude).amax().max((got_momentum - momentum).amax());
    assert!(error <= UNCHANGED, "{error:e}");
}

#[test]
fn a_step_that_the_plane_cannot_solve_fails_as_in_three_dimensions() {
    let pendulum = |direction: [f64; 3]| {
        json!({
            "name": "pendulum", "step_s": 2.0, "steps": 50,
            "scene": {
                "inertia": {"principal": [1.0, 2.0, 2.5]},
                "potential": [uniform(9.81, [0.0, -1.0, 0.0], direction)],
                "initial": {"angular_velocity": {"body": [0, 0, 4.0]}}
            },
            "method": {"name": "vpd", "tableau": "gauss2"}
        })
    };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let ends = [[0.0, 1.0, 0.0], [0.0, 1.0, 1e-9]].map(|direction| {
        let text = pendulum(direction).to_string();
        run(&text, &directory.path().join("run.mcap")).diagnosis.expect("a step too large")
    });
    assert_eq!(ends[0].code, ends[1].code);
}

/// The plan states which conservation holds, and that one is logged.
#[test]
fn the_plan_says_what_is_kept() {
    let plan = |text: &str, changes: &[(&str, Value)]| {
        let mut scenario: Value = serde_json::from_str(text).expect("JSON");
        for (field, value) in changes {
            scenario["scene"][field] = value.clone();
        }
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        Plan::new(&scenario).expect("a plan")
    };
    let top = include_str!("../../scenarios/heavy-top.json");
    let circular = include_str!("../../scenarios/satellite.json");
    let elliptic = include_str!("../../scenarios/satellite-elliptic.json");
    let still = plan(top, &[]);
    assert_eq!((still.balance, still.momentum_balance, still.jacobi_integral), (None, None, None));
    let damped = json!([{ "viscous": { "coefficient": 1e-3 } }]);
    let pushed = plan(top, &[("torques", damped.clone())]);
    assert_eq!(pushed.free_directions, 2);
    assert_eq!(pushed.balance.expect("pushed"), "the energy less the work of the torques");
    let momentum = pushed.momentum_balance.expect("the weight leaves two directions");
    assert!(momentum.contains("2 directions") && momentum.contains("impulse"), "{momentum}");
    assert_eq!(pushed.jacobi_integral, None);
    let free = plan(top, &[("torques", damped), ("potential", json!([]))]);
    assert!(free.momentum_balance.expect("free").starts_with("the whole spatial momentum less"));
    let turning = plan(circular, &[]);
    assert!(turning.balance.expect("driven").contains("H + p_t"));
    assert!(turning.jacobi_integral.is_some() && turning.momentum_balance.is_none());
    assert_eq!(plan(elliptic, &[]).jacobi_integral, None);
    let pulled = plan(circular, &[("torques", json!([{ "of_momentum": { "rate_per_s": 1e-6 } }]))]);
    assert_eq!(pulled.jacobi_integral, None);
}

/// The plan names the figures that the log then holds, and no others.
#[test]
fn the_plan_says_what_the_channels_hold() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("run.mcap");
    let weight = uniform(0.7, [0.1, 0.2, -0.9], [0.0, 0.0, 1.0]);
    let source = source(0.1, [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]);
    let mut met = BTreeSet::new();
    for potential in [json!([]), json!([weight]), json!([weight, source])] {
        for method in Integrator::ALL {
            let text = json!({
                "name": "figures", "step_s": STEP_S, "steps": 3,
                "scene": {
                    "inertia": {"principal": [1.0, 2.0, 2.5]}, "potential": potential, "initial": tumbling()
                },
                "method": {"name": method.as_str()},
                "log": {"channels": ["/energy", "/momentum", "/solver"]}
            })
            .to_string();
            let plan = Scenario::from_json(text.as_bytes()).and_then(|given| Plan::new(&given));
            // Some methods are for free bodies or for point sources.
            let Ok(plan) = plan else { continue };
            let says = |topic: Channel, word: &str| {
                let channel = plan.channels.iter().find(|channel| channel.topic == topic);
                channel.expect("a logged channel").computes.contains(word)
            };
            run(&text, &log);
            let (mut has_sigma, mut has_drift) = (false, false);
            read_samples(&log, |_, message| match message {
                Message::Solver(solver) => has_sigma |= solver.sigma_min.is_some(),
                Message::Momentum(momentum) => has_drift |= momentum.drift.is_some(),
                _ => {}
            })
            .expect("a log");
            let name = method.as_str();
            assert_eq!(says(Channel::Solver, "singular value"), has_sigma, "{name}");
            let drifts = says(Channel::Momentum, "the drift") || says(Channel::Momentum, "how far");
            assert_eq!(drifts, has_drift, "{name} with {potential}");
            met.insert((name, has_sigma, has_drift));
        }
    }
    let names: BTreeSet<_> = met.iter().map(|row| row.0).collect();
    assert_eq!(names.len(), Integrator::ALL.len(), "{met:?}");
    for figures in [(true, true), (true, false), (false, true), (false, false)] {
        assert!(met.iter().any(|row| (row.1, row.2) == figures), "{figures:?}");
    }
}

/// One digit of a coefficient is wrong: the order falls, and the plan says so.
#[test]
fn the_plan_warns_of_coefficients_of_a_low_order() {
    let warned = |a: Value, b: Value| {
        let mut scenario: Value =
            serde_json::from_str(include_str!("../../scenarios/heavy-top.json")).expect("JSON");
        scenario["method"] = json!({ "name": "vpd", "tableau": { "a": a, "b": b } });
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        let warnings = Plan::new(&scenario).expect("a plan").warnings;
        warnings.iter().any(|warning| warning.contains("check its coefficients"))
    };
    let radau = |last: f64| json!([[0.25, -0.25], [0.25, last]]);
    assert!(!warned(radau(5.0 / 12.0), json!([0.25, 0.75])));
    assert!(warned(radau(0.45), json!([0.25, 0.75])));
    assert!(!warned(json!([[0.5]]), json!([1])));
}

/// Degrees in a field of radians: a quarter of a turn becomes fourteen turns, and the plan says so.
#[test]
fn the_plan_warns_of_angles_of_more_than_a_turn() {
    let warned = |attitude: Value| {
        let mut scenario: Value =
            serde_json::from_str(include_str!("../../scenarios/heavy-top.json")).expect("JSON");
        scenario["scene"]["initial"]["attitude"] = attitude;
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        let warnings = Plan::new(&scenario).expect("a plan").warnings;
        warnings.iter().any(|warning| warning.contains("14.3 turns"))
    };
    let about = |field: &str| json!({ "axis_angle": { "axis": [1, 0, 0], field: 90 } });
    assert!(warned(about("angle_rad")));
    assert!(!warned(about("angle_deg")));
    assert!(warned(json!({ "roll_pitch_yaw": { "angles_rad": [0, -90, 1] } })));
    assert!(!warned(json!({ "euler": { "sequence": "zxz", "angles_rad": [0.5, -3, 6.2] } })));

    let mut pair: Value =
        serde_json::from_str(include_str!("../../scenarios/tether.json")).expect("JSON");
    pair["scene"]["bodies"][1]["initial"]["attitude"] = about("angle_rad");
    let scenario = Scenario::from_json(pair.to_string().as_bytes()).expect("good");
    let warnings = Plan::new(&scenario).expect("a plan").warnings;
    let name = pair["scene"]["bodies"][1]["name"].as_str().expect("a name");
    assert!(warnings.iter().any(|warning| warning.contains(name)), "{warnings:?}");
}
