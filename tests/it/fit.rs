//! Scenarios fitted to attitudes: what was put in comes out, within the errors that are said.

use std::fs;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use nalgebra::DMatrix;
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Value, json};
use vpd::fit::{Attitude, FitError, Question, fit, read};
use vpd::scenario::Scenario;
use vpd::solve::so::{self, Mat};

use crate::cli::{text, vpd};
use crate::scenarios::run;

/// A body that tumbles under a weight, over `duration_s`.
fn tumbling(moments: [f64; 3], duration_s: f64) -> Value {
    json!({
        "name": "tumbling", "step_s": 0.1, "duration_s": duration_s, "log": {"every": 1},
        "scene": {
            "inertia": {"principal": moments},
            "potential": [{"kind": "uniform", "weight": 0.5, "body_point": [0.1, 0.2, 0.3], "direction": [0, 0, 1]}],
            "initial": {
                "attitude": {"axis_angle": {"axis": [1, 2, 0], "angle_rad": 0.4}},
                "angular_velocity": {"body": [0.3, 1.0, -0.2]}
            }
        }
    })
}

fn scenario(value: &Value) -> Scenario {
    Scenario::from_json(value.to_string().as_bytes()).expect("a scenario")
}

/// The attitudes of a run of a scenario.
fn attitudes(value: &Value) -> Vec<Attitude> {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("true.mcap");
    run(&value.to_string(), &log);
    read(&log).expect("a log")
}

/// The same with errors about all axes.
fn noisy(seen: &[Attitude], deviation_rad: f64, seed: u64) -> Vec<Attitude> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let turned = |seen: &Attitude| {
        let turn: [f64; 3] = std::array::from_fn(|_| {
            let x: f64 = StandardNormal.sample(&mut random);
            deviation_rad * x
        });
        let g = Mat::<3>::from_fn(|i, j| seen.attitude[(i, j)]) * so::exp(&so::hat(&turn));
        let attitude = DMatrix::from_fn(3, 3, |i, j| g[(i, j)]);
        Attitude { time_s: seen.time_s, attitude }
    };
    seen.iter().map(turned).collect()
}

fn pointers<const K: usize>(fields: [&str; K]) -> Vec<String> {
    fields.map(str::to_owned).to_vec()
}

/// 200 attitudes with errors of 0.01 rad: of 100 seeds at least 95 have each moment within three standard errors, and the errors
/// are neither much too large nor much too small.
#[test]
fn an_inertia_is_found_within_its_errors() {
    let truth = [1.0, 2.0, 2.5];
    let seen = &attitudes(&tumbling(truth, 20.0))[1..];
    assert_eq!(seen.len(), 200);
    let begin = scenario(&tumbling([1.2, 1.8, 2.3], 20.0));
    let fields = pointers([
        "/scene/inertia/principal/0",
        "/scene/inertia/principal/1",
        "/scene/inertia/principal/2",
    ]);
    let (mut within, mut squares, mut largest) = (0, 0.0, 0.0_f64);
    for seed in 0..100 {
        let seen = noisy(seen, 0.01, seed);
        let question =
            Question { scenario: &begin, fields: &fields, start_attitude: false, seen: &seen };
        let found = fit(question).expect("a minimum");
        let off = found.fitted.iter().zip(truth);
        let off = off.map(|(one, truth)| (one.value - truth) / one.standard_error);
        let off: Vec<f64> = off.collect();
        within += usize::from(off.iter().all(|off| off.abs() < 3.0));
        squares += off.iter().map(|off| off * off).sum::<f64>() / 300.0;
        largest = largest.max(found.fitted[0].standard_error);
        assert!((0.9..1.1).contains(&(found.after_rad / 0.01 / 3.0_f64.sqrt())));
    }
    println!(
        "{within} of 100 within 3 sigma, mean square {squares:.2}, errors up to {largest:.1e}"
    );
    assert!(within >= 95, "{within}");
    // 300 numbers that are not all independent: 1 +- 0.15 is two of its deviations.
    assert!((0.75..1.25).contains(&squares), "{squares}");
    // Without errors it comes out as it went in.
    let question = Question { scenario: &begin, fields: &fields, start_attitude: false, seen };
    let found = fit(question).expect("a minimum");
    for (one, truth) in found.fitted.iter().zip(truth) {
        assert!((one.value - truth).abs() < 1e-10, "{one:?}");
    }
    assert!(found.after_rad < 1e-12 && found.before_rad > 0.1, "{found:?}");
}

/// Attitude and velocity at the start, together with a moment, from attitudes at times that are no steps.
#[test]
fn a_start_is_found_too() {
    let truth = tumbling([1.0, 2.0, 2.5], 10.0);
    let seen = attitudes(&truth);
    let seen: Vec<Attitude> = seen.into_iter().step_by(3).collect();
    let mut begin = tumbling([1.1, 2.0, 2.5], 10.0);
    begin["step_s"] = json!(0.08);
    begin["scene"]["initial"] = json!({
        "attitude": {"axis_angle": {"axis": [1, 2, 0.3], "angle_rad": 0.6}},
        "angular_velocity": {"body": [0.25, 1.05, -0.1]}
    });
    begin["method"] = json!({"name": "vpd", "tableau": "gauss6"});
    let begin = scenario(&begin);
    let fields = pointers([
        "/scene/inertia/principal/0",
        "/scene/initial/angular_velocity/body/0",
        "/scene/initial/angular_velocity/body/1",
        "/scene/initial/angular_velocity/body/2",
    ]);
    let question =
        Question { scenario: &begin, fields: &fields, start_attitude: true, seen: &seen };
    let found = fit(question).expect("a minimum");
    // The attitudes are those of gauss4 or so in steps of 0.1 s: its error is left.
    let values: Vec<f64> = found.fitted.iter().map(|one| one.value).collect();
    for (value, truth) in values.iter().zip([1.0, 0.3, 1.0, -0.2]) {
        assert!((value - truth).abs() < 1e-5, "{values:?}");
    }
    assert!(found.after_rad < 1e-5, "{}", found.after_rad);
    // The scenario that comes out starts where the true one does.
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("fitted.mcap");
    run(text(&found.scenario.to_json()), &log);
    let first = &read(&log).expect("a log")[0].attitude;
    assert!((first - &seen[0].attitude).norm() < 1e-5);
}

#[test]
fn what_cannot_be_told_apart_is_named() {
    // A free body of a given velocity moves alike if all moments are doubled.
    let mut free = tumbling([1.0, 2.0, 2.5], 10.0);
    free["scene"]["potential"] = json!([]);
    free["method"] = json!({"name": "vpd", "tableau": "gauss6"});
    let seen = attitudes(&free);
    let fields = pointers([
        "/scene/inertia/principal/0",
        "/scene/inertia/principal/1",
        "/scene/inertia/principal/2",
    ]);
    let begin = scenario(&free);
    let question =
        |fields| Question { scenario: &begin, fields, start_attitude: false, seen: &seen };
    match fit(question(&fields)) {
        Err(FitError::Undetermined(named)) => assert_eq!(named, fields),
        other => panic!("{other:?}"),
    }
    let found = fit(question(&fields[..2])).expect("two of them are determined");
    assert!(found.after_rad < 1e-12);
}

#[test]
fn four_dimensions_are_fitted_likewise() {
    let four = |first: f64| {
        json!({
            "name": "four", "step_s": 0.05, "duration_s": 5, "log": {"every": 1},
            "scene": {
                "inertia": {"second_moments": [first, 0.7, 1.0, 1.3]},
                "initial": {"momentum": {"body": [[0, 1, 0.5, 0.2], [-1, 0, 0.3, -0.4], [-0.5, -0.3, 0, 0.6], [-0.2, 0.4, -0.6, 0]]}}
            }
        })
    };
    let seen = attitudes(&four(0.4));
    let begin = scenario(&four(0.5));
    let fields = pointers(["/scene/inertia/second_moments/0"]);
    let question =
        Question { scenario: &begin, fields: &fields, start_attitude: false, seen: &seen };
    let found = fit(question).expect("a minimum");
    assert!((found.fitted[0].value - 0.4).abs() < 1e-10, "{found:?}");
}

#[test]
fn the_command_fits_a_table_and_writes_a_scenario() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).expect("written");
    run(&tumbling([1.0, 2.0, 2.5], 10.0).to_string(), &folder.join("true.mcap"));
    write("begin.json", &tumbling([1.2, 2.0, 2.5], 10.0).to_string());
    let exported = vpd(folder, &["export", "true.mcap", "-o", "true.csv"]);
    assert_eq!(exported.status.code(), Some(0), "{}", text(&exported.stderr));
    // A table of other columns, in another order, of quaternions alone.
    let mut turned = String::from("quaternion_x,quaternion_y,quaternion_z,quaternion_w,time_s\n");
    for Attitude { time_s, attitude } in read(&folder.join("true.mcap")).expect("a log") {
        let rotation = nalgebra::Matrix3::from_fn(|i, j| attitude[(i, j)]);
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(rotation);
        let q = nalgebra::UnitQuaternion::from_rotation_matrix(&rotation);
        turned += &format!("{},{},{},{},{time_s}\n", -q.i, -q.j, -q.k, -q.w);
    }
    write("quaternions.csv", &turned);
    for table in ["true.mcap", "true.csv", "quaternions.csv"] {
        let field = "/scene/inertia/principal/0";
        let arguments = [
            "fit",
            "begin.json",
            "--to",
            table,
            "--fields",
            field,
            "-o",
            "fitted.json",
            "--force",
            "--chart",
            "fit.svg",
        ];
        let found = vpd(folder, &arguments);
        assert_eq!(found.status.code(), Some(0), "{table}: {}", text(&found.stderr));
        assert!(text(&found.stdout).starts_with(field), "{}", text(&found.stdout));
        let fitted = fs::read(folder.join("fitted.json")).expect("written");
        let fitted: Value = serde_json::from_slice(&fitted).expect("JSON");
        let value = fitted.pointer(field).and_then(Value::as_f64).expect("a number");
        assert!((value - 1.0).abs() < 1e-10, "{table}: {value}");
        assert_eq!(vpd(folder, &["plan", "fitted.json"]).status.code(), Some(0));
        assert!(fs::read_to_string(folder.join("fit.svg")).expect("drawn").contains("after"));
    }
    write("no-time.csv", "quaternion_w,quaternion_x,quaternion_y,quaternion_z\n1,0,0,0\n");
    write("half.csv", "time_s,quaternion_w,quaternion_x,quaternion_y\n0,1,0,0\n");
    write(
        "words.csv",
        "time_s,quaternion_w,quaternion_x,quaternion_y,quaternion_z\n0,1,0,0,north\n",
    );
    write(
        "back.csv",
        "time_s,quaternion_w,quaternion_x,quaternion_y,quaternion_z\n1,1,0,0,0\n0.5,1,0,0,0\n",
    );
    write("zero.csv", "time_s,quaternion_w,quaternion_x,quaternion_y,quaternion_z\n1,0,0,0,0\n");
    write("few.csv", "time_s,quaternion_w,quaternion_x,quaternion_y,quaternion_z\n");
    let pair = "/scene/inertia/principal/0";
    for (table, field, words) in [
        ("no-time.csv", pair, "time_s is needed"),
        ("half.csv", pair, "quaternion_z is needed"),
        ("words.csv", pair, "attitude 1: \"north\" given for quaternion_z, a number is needed"),
        ("back.csv", pair, "attitude 2: t = 0.5 s given after 1 s"),
        ("zero.csv", pair, "attitude 1: is no rotation"),
        ("few.csv", pair, "0 attitudes given"),
        ("absent.csv", pair, "absent.csv"),
        ("true.csv", "/scene/inertia/principal/7", "\"/scene/inertia/principal/7\" given"),
        ("true.csv", "/step_s", "\"/step_s\" given"),
    ] {
        let refused = vpd(folder, &["fit", "begin.json", "--to", table, "--fields", field]);
        assert_eq!(refused.status.code(), Some(2), "{table} {field}");
        assert!(
            text(&refused.stderr).contains(words),
            "{table} {field}: {}",
            text(&refused.stderr)
        );
        assert!(!text(&refused.stderr).contains("panic"));
    }
}
