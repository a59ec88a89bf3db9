//! Scenes that once failed or ended wrongly, each with its right end: those of `tests/cases`.
//!
//! The ends are closed forms, or those of Dormand and Prince's eighth order (SciPy 1.17, tolerance 1e-13) from knot to knot.

use std::path::Path;

use serde_json::{Value, json};
use vpd::advise;
use vpd::run::{Outcome, Summary};
use vpd::scenario::Scenario;
use vpd::study::Watch;

use crate::cli;
use crate::scenarios::run;

fn text(name: &str) -> String {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cases").join(format!("{name}.json"));
    std::fs::read_to_string(path).expect("a case")
}

fn ended(text: &str) -> Summary {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let summary = run(text, &folder.path().join("case.mcap"));
    assert_eq!(summary.outcome, Outcome::Succeeded, "{:?}", summary.diagnosis);
    summary
}

fn momentum(summary: &Summary) -> [f64; 3] {
    let found = &summary.last.body_momentum;
    std::array::from_fn(|i| found[i].as_f64().expect("a number"))
}

/// Largest difference of the momentum from the right one, in parts of it.
fn off(summary: &Summary, right: [f64; 3]) -> f64 {
    let found = momentum(summary);
    let size = right.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    (0..3).fold(0.0, |most: f64, i| most.max((found[i] - right[i]).abs())) / size
}

#[test]
fn bodies_at_rest_set_off_or_stay() {
    let summary = ended(&text("rest-zero-torque"));
    assert!(off(&summary, [0.0, 0.0, 1.5 / 6.0]) < 1e-15, "{:?}", summary.last);
    let summary = ended(&text("rest-viscous"));
    assert_eq!(momentum(&summary), [0.0; 3]);
    // The torque falls within 1e-10 s: half of that is still given.
    let summary = ended(&text("braked-to-rest"));
    assert!((momentum(&summary)[2] + 1e-10).abs() < 1e-15, "{:?}", summary.last);
}

/// The energy of a body at rest, or nearly, is rounding or the field's: neither keeps an accuracy from being reached, and a run that stays
/// at rest has lost nothing.
#[test]
fn accuracies_are_reached_next_to_rest_in_fields() {
    let with_accuracy = |scene: &Value, error: f64| json!({ "name": "rest", "scene": scene, "duration_s": 10, "accuracy": { "error": error } });
    // A pendulum that hangs: its angle is tilt cos(sqrt(w r / J) t), to the third order in the tilt.
    for tilt in [1e-6, 1.00001e-6, 1e-4] {
        let scene = json!({
            "inertia": { "principal": [0.02, 0.02, 0.01] },
            "potential": [{ "kind": "uniform", "weight": 4.905, "body_point": [0, 0, -0.1], "direction": [0, 0, 1] }],
            "initial": { "attitude": { "axis_angle": { "axis": [1, 0, 0], "angle_rad": tilt } } },
        });
        let summary = ended(&with_accuracy(&scene, 1e-6).to_string());
        let angle = summary.last.attitude.expect("of one body")[2][1];
        let right = tilt * libm::cos((4.905_f64 * 0.1 / 0.02).sqrt() * 10.0);
        assert!((angle - right).abs() < 1e-6, "{tilt}: {angle} for {right}");
    }
    // Fields along the arm, which push nothing, whatever their factor.
    let table = json!({ "table": { "times_s": [0, 5, 10], "values": [0, 1, 0] } });
    let harmonic = json!({ "harmonic": { "mean": 0, "amplitude": 1, "rate_rad_s": 1 } });
    for factor in [table, harmonic] {
        let term = json!({ "kind": "uniform", "weight": 1, "body_point": [1, 0, 0], "direction": [1, 0, 0] });
        let scene = json!({ "inertia": { "principal": [1, 2, 3] }, "driven": [{ "term": term, "factor": factor }] });
        let mut document = with_accuracy(&scene, 1e-8);
        assert_eq!(momentum(&ended(&document.to_string())), [0.0; 3], "{factor}");
        document.as_object_mut().expect("an object").remove("accuracy");
        document["step_s"] = json!(0.1);
        assert_eq!(ended(&document.to_string()).warning, None, "{factor}");
    }
}

/// Motions that torques damp much faster than the body turns: implicit methods hardly damp in steps that pass over it.
#[test]
fn accuracies_see_what_damps_faster_than_it_turns() {
    let of_momentum = json!({ "of_momentum": { "rate_per_s": 10.0 } });
    // Next to a moment of 1.5 kg m^2.
    let viscous = json!({ "viscous": { "coefficient": 12.0 } });
    for (torque, rate) in [(of_momentum, 10.0), (viscous, 8.0)] {
        for (velocity, duration_s) in [(1e-15, 80.0), (1e-5, 60.0), (1e-5, 80.0), (0.1, 40.0)] {
            let scene = json!({
                "name": "damped",
                "scene": {
                    "inertia": { "principal": [1.2, 1.5, 0.9] },
                    "torques": [torque.clone()],
                    "initial": { "angular_velocity": { "body": [0, velocity, 0] } },
                },
                "accuracy": { "error": 1e-8 },
                "duration_s": duration_s,
            });
            let summary = ended(&scene.to_string());
            // w e^(-rate t) about a fixed axis
            let turned = velocity / rate * -libm::expm1(-rate * duration_s);
            let found = summary.last.attitude.expect("of one body")[0][2];
            let error = (found - libm::sin(turned)).abs();
            assert!(error <= 1e-8, "{velocity} rad/s, {duration_s} s: {found} for {turned}");
        }
    }
}

/// Bodies at rest wherever one may stand: of every n, in an ensemble, next to derivatives and under control.
#[test]
fn what_rests_sets_off_or_stays_in_every_kind_of_scene() {
    let scene = |inertia: Value| json!({ "name": "rest", "scene": { "inertia": inertia }, "step_s": 0.1, "steps": 3 });
    for n in (2..=16).chain([32]) {
        let moments: Vec<f64> = (0..n).map(|i| 1.0 + 0.1 * f64::from(i)).collect();
        let mut document = scene(json!({ "second_moments": moments }));
        let stays = ended(&document.to_string());
        let along = |x: f64| match n {
            3 => json!([0.0, 0.0, x]),
            _ => {
                let entry =
                    |i, j| f64::from(i32::from((i, j) == (1, 0)) - i32::from((i, j) == (0, 1)));
                (0..n)
                    .map(|i| (0..n).map(|j| x * entry(i, j)).collect())
                    .collect::<Vec<Vec<f64>>>()
                    .into()
            }
        };
        let numbers = |value: &Value| -> Vec<f64> {
            let flat = value.as_array().expect("a list").iter();
            flat.flat_map(|entry| match entry.as_array() {
                Some(row) => row.iter().map(|x| x.as_f64().expect("a number")).collect(),
                None => vec![entry.as_f64().expect("a number")],
            })
            .collect()
        };
        let momentum = |summary: &Summary| numbers(&summary.last.body_momentum);
        assert!(momentum(&stays).iter().all(|x| *x == 0.0), "n = {n}: {:?}", stays.last);
        // Nothing pushes in the first step; then a torque rises to one.
        let table =
            json!({ "times_s": [0, 0.1, 0.3], "values": [0, 0, 1], "interpolation": "linear" });
        document["scene"]["torques"] =
            json!([{ "table": { "along": { "body": along(1.0) }, "table": table } }]);
        let summary = ended(&document.to_string());
        for (found, right) in momentum(&summary).iter().zip(numbers(&along(0.1))) {
            assert!((found - right).abs() < 1e-15, "n = {n}: {:?}", summary.last);
        }
    }
    let inertia = json!({ "principal": [1, 2, 2.5] });
    let weight =
        json!({ "kind": "uniform", "weight": 1, "body_point": [0, 0, 1], "direction": [0, 0, 1] });
    let attitude = json!({ "attitude": { "gain_n_m": 0.1, "rate_gain_n_m_s": 0.5 } });
    let control = json!({
        "every_s": 0.2, "laws": [attitude], "target": { "attitude": { "quaternion": [1, 0, 0, 0] } },
        "through": { "wheels": {
            "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "moments_kg_m2": [0.002, 0.002, 0.002]
        } }
    });
    for (field, value) in [
        ("/ensemble", json!({ "members": 10, "attitude_spread_rad": 0.2 })),
        ("/derivatives", json!({ "state": true })),
        ("/scene/potential", json!([weight])),
        ("/scene/control", control),
        ("/accuracy", json!({ "error": 1e-9 })),
    ] {
        let mut document = scene(inertia.clone());
        let (parent, name) = field.rsplit_once('/').expect("a pointer");
        document.pointer_mut(parent).expect("there")[name] = value;
        if name == "accuracy" {
            let fields = document.as_object_mut().expect("an object");
            fields.remove("step_s");
            fields.remove("steps");
            fields.insert("duration_s".to_owned(), json!(2));
        }
        let summary = ended(&document.to_string());
        assert_eq!(momentum(&summary), [0.0; 3], "{field}");
        assert!(summary.ensemble.is_none_or(|all| all.succeeded == all.members), "{field}");
    }
}

/// Several bodies at rest: pinned, free, at the length of a spring, and hanging from each other.
#[test]
fn several_bodies_at_rest_stay() {
    let body =
        |name: &str| json!({ "name": name, "mass": 1, "inertia": { "principal": [1, 2, 2.5] } });
    let at = |name: &str, field: &str, place: Value| {
        let mut body = body(name);
        match field {
            "pivot" => body = json!({ "name": name, "inertia": body["inertia"], "pivot": place }),
            _ => body["initial"] = json!({ field: place }),
        }
        body
    };
    let ball = |of: [&str; 2], z: f64| json!({ "kind": "ball", "between": of, "points": [[0, 0, z], [0, 0, 0.25]] });
    let weight = |of: &str| json!({ "kind": "uniform", "body": of, "weight": 9.81, "body_point": [0, 0, 0], "direction": [0, 0, 1] });
    let spring = json!({ "kind": "spring", "between": ["a", "b"], "stiffness": 1, "rest_length": 3, "points": [[0, 0, 0], [0, 0, 0]] });
    let apart = |field| json!([at("a", field, json!([0, 0, 0])), at("b", field, json!([3, 0, 0]))]);
    for (name, scene) in [
        ("pinned", json!({ "bodies": apart("pivot") })),
        ("free", json!({ "bodies": apart("position") })),
        ("spring", json!({ "bodies": apart("position"), "potential": [spring] })),
        (
            "hanging",
            json!({
                "bodies": [body("a"), body("b")],
                "joints": [ball(["space", "a"], 1.0), ball(["a", "b"], -0.25)],
                "potential": [weight("a"), weight("b")]
            }),
        ),
    ] {
        for method in ["vpd", "rk_projected", "rkmk", "splitting"] {
            if (name, method) == ("hanging", "splitting") {
                continue;
            }
            let document = json!({
                "name": name, "scene": scene, "method": { "name": method }, "step_s": 0.1, "steps": 20
            });
            let summary = ended(&document.to_string());
            for (body, last) in &summary.last.bodies {
                assert_eq!(last.body_momentum, json!([0.0, 0.0, 0.0]), "{name}, {method}: {body}");
            }
        }
    }
}

/// Members of a sweep at rest succeed like runs.
#[test]
fn a_sweep_of_bodies_at_rest_succeeds() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let mut scenario: Value = serde_json::from_str(&text("rest-zero-torque")).expect("JSON");
    scenario["log"] = json!({ "every": 1 });
    let varied = json!({ "pointer": "/step_s", "values": { "list": [0.005, 0.01] } });
    let sweep = json!({ "scenario": scenario, "vary": [varied] });
    std::fs::write(folder.path().join("sweep.json"), sweep.to_string()).expect("written");
    let output = cli::vpd(folder.path(), &["sweep", "sweep.json", "-o", "table.csv"]);
    assert_eq!(output.status.code(), Some(0), "{}", cli::text(&output.stderr));
    let table = std::fs::read_to_string(folder.path().join("table.csv")).expect("a table");
    assert_eq!(table.lines().filter(|line| line.contains("succeeded")).count(), 2, "{table}");
}

/// A burn much shorter than what comes before it is not missed with an accuracy or with fixed steps, and the reports of both are right.
#[test]
fn burns_are_not_passed_over() {
    for (name, right, error) in [
        ("pulse-accuracy", [0.0, 0.0, 0.0015 + 0.2], 1e-12),
        ("pulse-called-chaotic", [0.0, 0.0, 0.0015 + 0.3], 1e-12),
        ("pulse-fixed-step", [0.0, 0.0, 0.0015 + 3.0], 1e-12),
        ("slow-pulse-missed-2", SLOW_2, 1e-4),
        ("slow-pulse-missed-10", SLOW_10, 1e-6),
    ] {
        let summary = ended(&text(name));
        let off = off(&summary, right);
        assert!(off <= error, "{name}: {off:e} off, {:?}", summary.last);
        let impulse = summary.table_impulse_max_error.expect("a torque by a table");
        assert!(impulse < 1e-13, "{name}: {impulse:e}");
    }
}

const SLOW_2: [f64; 3] = [0.027472944341536052, 0.03843718043865209, -0.017924634869506868];
const SLOW_10: [f64; 3] = [-0.03650729450069955, 0.03363357902977089, 0.006679701348948977];

/// A block by the default of tables, and one by jumps, push as long as they say, and never backwards.
#[test]
fn blocks_do_not_overshoot() {
    for name in ["smooth-default-overshoots", "table-jump"] {
        let summary = ended(&text(name));
        assert!(off(&summary, [0.0, 0.0, 1.1]) < 1e-14, "{name}: {:?}", summary.last);
    }
}

/// A factor that swings 24 times a step moves energy to and fro: where trial runs found the steps, no warning is due; where a
/// step was given, the plan says which step shows the swings.
#[test]
fn fast_factors_are_seen() {
    let scene = text("fast-harmonic-accuracy");
    let summary = ended(&scene);
    assert!((momentum(&summary)[2] - 0.015).abs() < 1e-6, "{:?}", summary.last);
    assert_eq!(summary.warning, None);
    let mut given: Value = serde_json::from_str(&scene).expect("JSON");
    given.as_object_mut().expect("an object").remove("accuracy");
    for (step_s, warned) in [(0.01, true), (1e-3, true), (1e-4, false)] {
        given["step_s"] = step_s.into();
        let scenario = Scenario::from_json(given.to_string().as_bytes()).expect("a scenario");
        let plan = advise::plan(&scenario).expect("a plan");
        let told = plan.warnings.iter().any(|warning| warning.contains("/scene/driven/0"));
        assert_eq!(told, warned, "{step_s}: {:?}", plan.warnings);
    }
}

/// Two steps of 1e5 s each end where those of 10 s do.
#[test]
fn large_steps_of_a_free_body_end_where_small_ones_do() {
    let mut scenario: Value = serde_json::from_str(&text("free-large-step")).expect("JSON");
    let large = ended(&scenario.to_string());
    scenario["step_s"] = json!(10.0);
    scenario["steps"] = json!(20_000);
    let small = ended(&scenario.to_string());
    // 4e4 rad, of which a double has 1e-11 rad.
    assert!(off(&large, momentum(&small)) < 1e-9, "{:?}, {:?}", large.last, small.last);
}

#[test]
fn a_byte_order_mark_is_no_part_of_a_scenario() {
    let marked = text("bom");
    assert!(marked.starts_with('\u{feff}'));
    let plain = ended(marked.trim_start_matches('\u{feff}'));
    assert_eq!(ended(&marked).last, plain.last);
}

/// A log that Python's `mcap` 1.6 wrote, without chunks.
#[test]
fn a_log_of_another_program_is_called_so() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/cases");
    let output = cli::vpd(&folder, &["inspect", "foreign-unchunked.mcap"]);
    let said = cli::text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("an MCAP file of another program (mcap-python/1.6.0)"), "{said}");
}

#[test]
fn a_needle_is_solved() {
    let summary = ended(&text("needle-1e-5"));
    let [x, y, axial] = momentum(&summary);
    assert!((x.hypot(y) - 0.5).abs() < 1e-14, "{:?}", summary.last);
    assert!((axial - 1e-6).abs() < 1e-13, "{:?}", summary.last);
}

/// A table that ends with the run: the map of the scene goes no further than that, and finds usable steps.
#[test]
fn a_map_ends_with_the_tables() {
    let spun = r#"{"initial":{"angular_velocity":{"body":[0.3,2,0.1]}}}"#;
    for start in [None, Some(spun)] {
        let mut scenario: Value = serde_json::from_str(&text("rest-zero-torque")).expect("JSON");
        if let Some(start) = start {
            let start: Value = serde_json::from_str(start).expect("JSON");
            scenario["scene"]["initial"] = start["initial"].clone();
        }
        let scene = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        let mut entries = vpd::study::all_methods(&scene);
        entries.retain(|entry| {
            ["vpd_lagrangian gauss2", "rk_projected rk4"].contains(&entry.label().as_str())
        });
        assert_eq!(entries.len(), 2);
        let map = vpd::study::stability::stability(&scene, &entries, &Watch::default());
        let map = map.expect("a map");
        assert!(map.steps_s.iter().all(|step_s| *step_s <= 1.0 / 15.0), "{:?}", map.steps_s);
        for (border, cells) in map.borders.iter().zip(&map.cells) {
            assert!(border.usable_step_s.is_some_and(|step_s| step_s > 0.01), "{border:?}");
            let outside = cells.iter().any(|cell| cell.class.as_str() == "outside_table");
            assert!(!outside, "{border:?}");
        }
    }
}
