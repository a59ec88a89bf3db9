//! Derivatives that a run carries along: against runs next to it, in its log, and through an interruption.

use std::path::Path;

use serde_json::{Value, json};
use vpd::advise;
use vpd::log::columns::{Columns, Values};
use vpd::log::course::{Course, LogChart};
use vpd::log::inspect::inspect;
use vpd::log::messages::State;
use vpd::run::{Control, JobContext, Outcome, Summary, collect, execute};
use vpd::scenario::{Scenario, with_changes};
use vpd::solve::so;
use vpd::verify::verify;

use crate::cli::vpd;
use crate::ensemble::contents;

/// A heavy body between two charges, which starts with a velocity.
fn scene() -> Value {
    json!({
        "name": "derivatives",
        "scene": {
            "inertia": { "principal": [1.0, 1.3, 1.7] },
            "potential": [
                { "kind": "uniform", "weight": 0.7, "body_point": [0.1, 0.2, 1], "direction": [0, 0, 1] },
                { "kind": "point_source", "strength": 0.5, "body_point": [0, 0.3, -1], "position": [0.5, 0, -2] },
                { "kind": "gravity_gradient", "strength": 0.4, "direction": [0, 0.6, 0.8] },
            ],
            "initial": { "angular_velocity": { "body": [0.3, -0.2, 0.5] } },
        },
        "method": { "name": "vpd", "tableau": "gauss4" },
        "step_s": 0.05,
        "steps": 100,
        "log": { "every": 10 },
        "derivatives": { "state": true, "parameters": [
            "/scene/inertia/principal/1",
            "/scene/potential/0/weight",
            "/scene/potential/1/body_point/2",
            "/scene/potential/1/position/0",
            "/scene/initial/angular_velocity/body/2",
        ] },
    })
}

fn accepted(scenario: &Value) -> Scenario {
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario")
}

fn in_memory(scenario: &Value) -> (Summary, Columns) {
    let plan = advise::plan(&accepted(scenario)).expect("a plan");
    collect(&plan, &Control::default()).expect("a run")
}

fn run(scenario: &Value, log: &Path) -> Summary {
    let plan = advise::plan(&accepted(scenario)).expect("a plan");
    execute(&plan, &JobContext { log, control: &Control::default() }).expect("a log")
}

/// The numbers of a quantity at the last sample.
fn last(columns: Columns, name: &str) -> Vec<f64> {
    let all = columns.into_all();
    let (_, values) = all.into_iter().find(|(found, _)| *found == name).expect("a column");
    let Values::Numbers { shape, values } = values else { panic!("{name} has numbers") };
    values[values.len() - shape.iter().product::<usize>()..].to_vec()
}

/// The change of the end with a field, left-trivialised: central differences of eighth order.
fn difference(pointer: &str) -> Vec<f64> {
    let mut plain = scene();
    plain.as_object_mut().expect("an object").remove("derivatives");
    let given = plain.pointer(pointer).and_then(Value::as_f64).expect("a number");
    let end = |value: f64| {
        let changed = with_changes(
            plain.to_string().as_bytes(),
            [(pointer.to_owned(), json!(value)), ("/method/name".to_owned(), json!("vpd"))],
        );
        let scenario = serde_json::from_slice(&changed.expect("a field")).expect("JSON");
        let (_, columns) = in_memory(&scenario);
        let g: so::Mat<3> = so::Mat::from_row_slice(&last(columns.clone(), "attitude"));
        (g, last(columns, "body_momentum"))
    };
    const E: f64 = 0.004;
    let (g1, _) = end(given);
    let coordinates = |e: f64| {
        let (g, mu) = end(given + e);
        let mut coordinates = so::vee(&so::skew(&so::transposed_product(&g1, &g)));
        coordinates.extend(mu);
        coordinates
    };
    let mut sum = vec![0.0; 6];
    for (k, weight) in (1..).zip([4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0]) {
        let e = E * f64::from(k);
        let pairs = coordinates(e).into_iter().zip(coordinates(-e));
        pairs
            .zip(&mut sum)
            .for_each(|((ahead, behind), sum)| *sum += weight * (ahead - behind) / E);
    }
    sum
}

#[test]
fn sensitivities_are_those_of_runs_next_to_it() {
    let (summary, columns) = in_memory(&scene());
    assert_eq!(summary.outcome, Outcome::Succeeded);
    let found = summary.derivatives.expect("asked for");
    assert!(found.symplectic_error < 1e-14, "{found:?}");
    let transition = last(columns.clone(), "transition");
    assert_eq!(transition.len(), 36);
    let sensitivity = last(columns, "sensitivity");
    let parameters = scene()["derivatives"]["parameters"].as_array().expect("a list").clone();
    assert_eq!(sensitivity.len(), 6 * parameters.len());
    for (column, pointer) in sensitivity.chunks_exact(6).zip(&parameters) {
        let pointer = pointer.as_str().expect("text");
        let expected = difference(pointer);
        let size = expected.iter().fold(0.0, |size: f64, x| size.max(x.abs()));
        assert!(size > 1e-3, "{pointer}: {expected:?}");
        for (x, expected) in column.iter().zip(&expected) {
            let error = (x - expected).abs() / size;
            assert!(error < 1e-9, "{pointer}: {x:e} for {expected:e}");
        }
    }
}

/// The states of a run do not depend on whether derivatives are carried along.
#[test]
fn derivatives_leave_the_states_alone() {
    let mut plain = scene();
    plain.as_object_mut().expect("an object").remove("derivatives");
    let states = [scene(), plain].map(|scenario| {
        let (_, columns) = in_memory(&scenario);
        [last(columns.clone(), "attitude"), last(columns, "body_momentum")]
    });
    assert_eq!(states[0], states[1]);
}

#[test]
fn the_log_has_a_channel_and_is_repeated() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("derivatives.mcap");
    let summary = run(&scene(), &log);
    let seen = inspect(&log).expect("readable");
    let channel = seen.topics.iter().find(|entry| entry.topic == "/derivatives");
    assert_eq!(channel.expect("logged").messages, summary.samples);
    assert!(verify(&log).expect("verified").same);
    let (columns, _) = Columns::read(&log, 0, &[]).expect("readable");
    let (_, in_memory) = in_memory(&scene());
    for name in ["transition", "sensitivity"] {
        assert_eq!(last(columns.clone(), name), last(in_memory.clone(), name), "{name}");
    }
}

/// The scene without derivatives, and the same for n = 4.
fn plain(n: usize) -> Value {
    let mut plain = scene();
    plain.as_object_mut().expect("an object").remove("derivatives");
    if n == 4 {
        plain["scene"] = json!({
            "inertia": { "second_moments": [1.0, 1.2, 1.5, 0.8] },
            "potential": [
                { "kind": "uniform", "weight": 0.7, "body_point": [0.1, 0.2, 1, 0.4], "direction": [0, 0, 1, 0] },
                { "kind": "spring", "stiffness": 0.5, "body_point": [0, 0.3, -1, 0], "position": [0.5, 0, -2, 1] },
            ],
            "initial": { "angular_velocity": {
                "body": [[0, 0.3, 0, 0.1], [-0.3, 0, 0.5, 0], [0, -0.5, 0, -0.2], [-0.1, 0, 0.2, 0]]
            } },
        });
    }
    plain
}

/// To first order an ensemble has the covariance that its run carries along, within what so many members leave open.
fn covariance_is_that_of_an_ensemble<const N: usize>() {
    const MEMBERS: usize = 4000;
    let (angle, momentum) = (1e-3, 2e-3);
    let spread = json!({ "attitude_spread_rad": angle, "momentum_spread": momentum });
    let folder = tempfile::tempdir().expect("a folder");

    let mut carried = plain(N);
    carried["derivatives"] = json!({ "state": true, "covariance": spread });
    let (summary, columns) = in_memory(&carried);
    let found = last(columns, "covariance");
    let rows = N * (N - 1);
    assert_eq!(found.len(), rows * rows);

    let mut many = plain(N);
    many["ensemble"] = spread;
    many["ensemble"]["members"] = json!(MEMBERS + 1);
    many["ensemble"]["seed"] = json!(3);
    let log = folder.path().join("ensemble.mcap");
    let members = run(&many, &log).ensemble.expect("of an ensemble");
    let mut ends: Vec<_> = contents(&log).members;
    ends.sort_by_key(|end| end.member);
    let ends: Vec<_> = ends
        .iter()
        .map(|end| end.last.as_ref().and_then(State::point::<N>).expect("its end"))
        .collect();
    let mut sums = vec![0.0; rows * rows];
    for end in &ends[1..] {
        let turn = so::transposed_product(&ends[0].attitude, &end.attitude);
        let mut change = so::vee(&so::skew(&turn));
        change.extend(so::vee(&(end.momentum - ends[0].momentum)));
        for (i, x) in change.iter().enumerate() {
            change.iter().enumerate().for_each(|(j, y)| sums[rows * i + j] += x * y);
        }
    }
    for i in 0..rows {
        for j in 0..rows {
            let [ii, jj, ij] = [(i, i), (j, j), (i, j)].map(|(i, j)| found[rows * i + j]);
            // The variance of a product of two normal numbers.
            let standard_error = ((ii * jj + ij * ij) / MEMBERS as f64).sqrt();
            let seen = sums[rows * i + j] / MEMBERS as f64;
            assert!((seen - ij).abs() < 5.0 * standard_error, "{N}: {i}, {j}: {seen:e} for {ij:e}");
            assert_eq!(ij, found[rows * j + i], "symmetric");
        }
    }
    let matrix = nalgebra::DMatrix::from_row_slice(rows, rows, &found);
    let variances = matrix.symmetric_eigenvalues();
    assert!(variances.min() > -1e-14 * variances.max(), "{variances}");

    let covariance = summary.covariance.expect("asked for");
    let spread = members.attitude_spread_rad.expect("known");
    let error = (covariance.attitude_spread_rad / spread - 1.0).abs();
    assert!(error < 5.0 / (2.0 * MEMBERS as f64).sqrt(), "{spread:e}, {covariance:?}");
    let largest = covariance.largest_attitude_deviation_rad;
    let d = rows / 2;
    let on_axes = (0..d).map(|i| found[(rows + 1) * i].sqrt()).fold(0.0, f64::max);
    assert!(on_axes <= largest * (1.0 + 1e-12) && largest <= covariance.attitude_spread_rad);
    // The chart of both is one of the same quantity.
    let single = folder.path().join("covariance.mcap");
    run(&carried, &single);
    let [of_run, of_members] = [&single, &log]
        .map(|log| Course::of(log).expect("readable").points(LogChart::Spread).to_vec());
    let near = |time_s: f64| of_run.iter().find(|point| (point.0 - time_s).abs() < 1e-6);
    let shared: Vec<_> = of_members.iter().filter_map(|at| near(at.0).zip(Some(at))).collect();
    assert!(shared.len() > 5, "{of_members:?}");
    for (of_run, of_members) in shared {
        // Half a percent is one standard error of the sum over the axes, or less than that.
        assert!((of_run.1 / of_members.1 - 1.0).abs() < 0.06, "{of_run:?}, {of_members:?}");
    }
}

#[test]
fn covariance_is_that_of_an_ensemble_in_three_dimensions() {
    covariance_is_that_of_an_ensemble::<3>();
}

#[test]
fn covariance_is_that_of_an_ensemble_in_four_dimensions() {
    covariance_is_that_of_an_ensemble::<4>();
}

/// A free body that turns about a principal axis: the turn about it is xi + t nu / J3, exactly.
#[test]
fn variance_about_a_principal_axis_grows_as_the_square_of_time() {
    let mut free = plain(3);
    free["scene"]["potential"] = json!([]);
    free["scene"]["initial"] = json!({ "angular_velocity": { "body": [0, 0, 0.9] } });
    let (angle, momentum) = (0.01, 0.03);
    free["derivatives"] = json!({
        "state": true, "covariance": { "attitude_spread_rad": angle, "momentum_spread": momentum }
    });
    let (_, columns) = in_memory(&free);
    let all: Vec<_> = columns.into_all();
    let numbers = |name: &str| -> Vec<f64> {
        let found = all.iter().find(|(found, _)| *found == name).expect("a column");
        let Values::Numbers { values, .. } = &found.1 else { panic!("{name} has numbers") };
        values.clone()
    };
    let (times, covariances) = (numbers("time_s"), numbers("covariance"));
    assert_eq!(times.len(), 11);
    for (t, found) in times.iter().zip(covariances.chunks_exact(36)) {
        let by_rate = momentum * t / 1.7;
        let expected = angle * angle + by_rate * by_rate;
        let error = (found[6 * 2 + 2] / expected - 1.0).abs();
        assert!(error < 1e-10, "{t}: {error:e}");
        assert!((found[6 * 5 + 5] / (momentum * momentum) - 1.0).abs() < 1e-12);
        assert!((found[6 * 2 + 5] - momentum * by_rate).abs() < 1e-12);
    }
}

/// A given matrix, with correlations and a part that is certain, and parameters: by the matrices of the same log.
#[test]
fn covariance_is_carried_by_the_transition_and_the_sensitivities() {
    // C C^T of three columns: of rank three.
    let factor = nalgebra::DMatrix::from_row_slice(
        6,
        3,
        &[
            0.2, 0.0, 0.1, -0.1, 0.3, 0.0, 0.0, 0.0, 0.2, 0.4, 0.1, 0.0, 0.0, -0.2, 0.0, 0.0, 0.0,
            0.0,
        ],
    );
    let start = &factor * factor.transpose();
    let rows: Vec<Vec<f64>> = start.row_iter().map(|row| row.iter().copied().collect()).collect();
    let spreads = [0.1, 0.0, 0.2, 0.05, 0.3];
    let mut given = scene();
    given["derivatives"]["covariance"] = json!({ "matrix": rows, "parameter_spreads": spreads });
    let (_, columns) = in_memory(&given);
    let matrix = |name: &str, columns_of: usize| {
        let numbers = last(columns.clone(), name);
        nalgebra::DMatrix::from_row_slice(numbers.len() / columns_of, columns_of, &numbers)
    };
    let transition = matrix("transition", 6);
    let sensitivity = matrix("sensitivity", 6).transpose();
    let weights = nalgebra::DVector::from_iterator(5, spreads.iter().map(|x| x * x));
    let expected = &transition * &start * transition.transpose()
        + &sensitivity * nalgebra::DMatrix::from_diagonal(&weights) * sensitivity.transpose();
    let found = matrix("covariance", 6);
    assert!((&found - &expected).amax() < 1e-12 * expected.amax(), "{found} {expected}");
    // Without the start, of the parameters alone.
    given["derivatives"]["covariance"] = json!({ "parameter_spreads": spreads });
    given["derivatives"]["state"] = json!(false);
    let (summary, columns) = in_memory(&given);
    let numbers = last(columns, "covariance");
    let found = nalgebra::DMatrix::from_row_slice(6, 6, &numbers);
    let expected =
        &sensitivity * nalgebra::DMatrix::from_diagonal(&weights) * sensitivity.transpose();
    assert!((&found - &expected).amax() < 1e-12 * expected.amax(), "{found} {expected}");
    assert!(summary.derivatives.is_none() && summary.covariance.is_some());
}

/// All exponents of a run, by the command line: of regular motion zero, of chaotic motion in pairs; what has no derivatives is
/// refused.
#[test]
fn lyapunov_exponents_of_a_scenario() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = folder.path();
    let exponents = |scenario: &Value| -> Value {
        std::fs::write(at.join("scene.json"), scenario.to_string()).expect("writable");
        let output = vpd(at, &["lyapunov", "scene.json", "--json"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("JSON")
    };
    let numbers = |found: &Value, field: &str| -> Vec<f64> {
        found[field].as_array().expect("a list").iter().filter_map(Value::as_f64).collect()
    };
    let mut free = scene();
    free.as_object_mut().expect("fields").remove("derivatives");
    free["scene"]["potential"] = json!([]);
    free["steps"] = json!(16_000);
    let found = exponents(&free);
    // What grows like t has exponents that fall like log(t) / t.
    let most = 2.0 * 800.0_f64.ln() / 800.0;
    assert_eq!(numbers(&found, "exponents_per_s").len(), 6);
    assert!(numbers(&found, "exponents_per_s").iter().all(|x| x.abs() < most), "{found}");
    assert!(found["sum_per_s"].as_f64().expect("a number").abs() < 1e-12, "{found}");
    assert_eq!(found["time_s"], json!(800.0));
    let text = std::fs::read_to_string("scenarios/dipole.json").expect("shipped");
    let mut dipole: Value = serde_json::from_str(&text).expect("JSON");
    dipole.as_object_mut().expect("fields").remove("expect");
    (dipole["step_s"], dipole["steps"]) = (json!(0.01), json!(20_000));
    dipole.as_object_mut().expect("fields").remove("duration_s");
    let found = exponents(&dipole);
    let (all, errors) =
        (numbers(&found, "exponents_per_s"), numbers(&found, "standard_errors_per_s"));
    assert!(all[0] > 3.0 * errors[0], "{found}");
    assert!((0..6).all(|i| (all[i] + all[5 - i]).abs() < 0.05), "{found}");
    // In words, and refused.
    let output = vpd(at, &["lyapunov", "scene.json", "--set", "/steps=100"]);
    let words = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(words.lines().filter(|line| line.contains("standard error")).count(), 6, "{words}");
    let output = vpd(
        at,
        &["lyapunov", "scene.json", "--set", r#"/scene/torques=[{"viscous":{"coefficient":1}}]"#],
    );
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2));
    assert!(words.contains("/derivatives") && words.contains("`scene.torques`"), "{words}");
}
