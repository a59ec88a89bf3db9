//! Air and sunlight on flat faces along an orbit, orbits whose node drifts, wheels with friction: ends computed by others, logs, what is
//! refused.

use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::thread;

use serde_json::{Value, json};
use vpd::advise;
use vpd::export::{Choice, Format, export};
use vpd::log::reader::{Message, read_samples};
use vpd::run::{Control, JobContext, Outcome, RunError, Summary, execute};
use vpd::scenario::Scenario;
use vpd::verify::verify;

use crate::ensemble::{contents, states};
use crate::sweep::{lines, number, succeeds};

fn run(scenario: &Value, log: &Path, control: &Control) -> Result<Summary, RunError> {
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario");
    let plan = advise::plan(&scenario).expect("a plan");
    execute(&plan, &JobContext { log, control })
}

fn shipped(name: &str) -> Value {
    let path = format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_slice(&fs::read(path).expect("a scenario")).expect("JSON")
}

fn refused(scenario: &Value) -> vpd::scenario::ScenarioError {
    match Scenario::from_json(scenario.to_string().as_bytes()) {
        Err(error) => error,
        Ok(scenario) => advise::plan(&scenario).expect_err("refused by the plan"),
    }
}

/// An elliptic orbit through air and light whose node drifts, with a magnet: four faces that turn in and out of the air, two of the light.
fn air_and_light() -> Value {
    serde_json::from_str(include_str!("orbit/air-and-light.json")).expect("JSON")
}

/// The attitude at the end, row by row, and the body momentum, by `docs/cubesat.py tests/it/orbit/air-and-light.json`: other formulas, and
/// DOP853 of SciPy 1.17.1 with a tolerance of 1e-13.
const END: [[f64; 3]; 3] = [
    [0.318775207378337, 0.8432238646843707, 0.4328462558317797],
    [0.24245681034703837, 0.36893296634068184, -0.8972754100404767],
    [-0.9162952920741038, 0.3909756774707425, -0.08683868578590492],
];
const END_MOMENTUM: [f64; 3] =
    [-0.0007286307197741504, -0.0004783726609597591, 0.00011547276064652249];

/// The end of a run is that of another program. A kink of the torque, where a face turns edge-on, leaves an error of second order.
#[test]
fn a_run_through_air_and_light_ends_where_another_program_has_it() {
    let place = tempfile::tempdir().expect("a directory");
    let error = |step_s: f64, method: Value| {
        let mut scenario = air_and_light();
        scenario["step_s"] = json!(step_s);
        scenario["method"] = method;
        let log = place.path().join("log.mcap");
        let _ = fs::remove_file(&log);
        let summary = run(&scenario, &log, &Control::default()).expect("a log");
        assert_eq!(summary.outcome, Outcome::Succeeded);
        let balance = summary.energy.expect("logged").max_abs_error;
        let end = summary.last.attitude.expect("computed");
        let mut last = None;
        read_samples(&log, |_, message| {
            if let Message::State(state) = message {
                last = Some(state.body_momentum);
            }
        })
        .expect("a log");
        let momentum = last.expect("a state");
        let size = END_MOMENTUM.iter().fold(0.0_f64, |size, x| size.max(x.abs()));
        let of_momentum = momentum.iter().zip(END_MOMENTUM).map(|(a, b)| (a - b).abs() / size);
        let of_attitude =
            end.iter().flatten().zip(END.iter().flatten()).map(|(a, b)| (a - b).abs());
        (of_attitude.chain(of_momentum).fold(0.0, f64::max), balance)
    };
    for method in [
        json!({ "name": "vpd", "tableau": "gauss3" }),
        json!({ "name": "vrkmk", "tableau": "gauss3" }),
        json!({ "name": "rkmk", "tableau": "rk8" }),
    ] {
        let [(coarse, _), (fine, balance)] = [1.0, 0.1].map(|step_s| error(step_s, method.clone()));
        println!("{method}: {coarse:e} in steps of 1 s, {fine:e} of 0.1 s; balance {balance:e} J");
        // By the square of the step: the faces of a tumbling body turn edge-on again and again.
        assert!(coarse < 3e-3 && fine < 3e-5, "{method}: {coarse:e}, {fine:e}");
        assert!(coarse / fine > 30.0, "{method}: {coarse:e}, {fine:e}");
        assert!(balance < 1e-12, "{method}: {balance:e}");
    }
}

/// Interrupted or not, the CubeSat has the same bytes, which `verify` repeats; its ensemble has it as a member, to rounding.
#[test]
fn the_cubesat_has_the_same_bytes_again() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("cubesat");
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("expect");
    fields.remove("duration_s");
    fields.insert("steps".to_owned(), json!(6000));
    fields.insert("log".to_owned(), json!({ "every": 1 }));
    let [whole, cut] = ["whole.mcap", "cut.mcap"].map(|name| place.path().join(name));
    let summary = run(&scenario, &whole, &Control::default()).expect("a log");
    for step in [500, 1700, 3300, 5200] {
        let control = Control::default();
        let result = thread::scope(|scope| {
            let worker = scope.spawn(|| run(&scenario, &cut, &control));
            while control.steps_done.load(Ordering::Relaxed) < step && !worker.is_finished() {
                thread::yield_now();
            }
            control.interrupted.store(true, Ordering::Relaxed);
            worker.join().expect("no panic")
        });
        if result.is_ok() {
            break;
        }
    }
    if !cut.exists() {
        run(&scenario, &cut, &Control::default()).expect("a log");
    }
    assert!(fs::read(&whole).expect("whole") == fs::read(&cut).expect("cut"));
    assert!(verify(&whole).expect("verified").same);
    scenario["ensemble"] = json!({ "members": 9, "seed": 3, "attitude_spread_rad": 0.3 });
    let log = place.path().join("many.mcap");
    let many = run(&scenario, &log, &Control::default()).expect("a log");
    assert_eq!(many.ensemble.expect("an ensemble").succeeded, 9);
    // Side by side the sums over the stages are in another order.
    let [a, b] = [many.last, summary.last].map(|last| last.attitude.expect("computed").concat());
    let apart = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-12, "{apart:e}");
}

/// The plan says what acts and what the balance counts, and drag without an orbit of its own takes that of the field.
#[test]
fn the_plan_names_air_and_light() {
    let plan = |scenario: &Value| {
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        advise::plan(&scenario).expect("a plan")
    };
    let scenario = air_and_light();
    let planned = plan(&scenario);
    let why = |pointer: &str| {
        let line = planned.potential.iter().find(|line| line.pointer == pointer);
        line.map(|line| line.why.clone()).expect("a line of the plan")
    };
    assert_eq!(why("/scene/torques/0"), "a torque of the air along an orbit");
    assert_eq!(why("/scene/torques/1"), "a torque of sunlight");
    let balance = planned.balance.expect("it is pushed");
    assert!(balance.contains("the work of the torques"), "{balance}");
    let place = tempfile::tempdir().expect("a directory");
    let mut own = scenario.clone();
    own["scene"]["torques"][0]["drag"]["orbit"] =
        scenario["scene"]["field"]["dipole"]["orbit"].clone();
    let [a, b] = [("field", &scenario), ("own", &own)].map(|(name, scenario)| {
        let log = place.path().join(format!("{name}.mcap"));
        run(scenario, &log, &Control::default()).expect("a log").last
    });
    assert_eq!(a, b);
    let mut fast = scenario;
    fast["scene"]["torques"][1]["solar_pressure"]["factor"] =
        json!({ "harmonic": { "amplitude": 1, "rate_rad_s": 100 } });
    let warnings = plan(&fast).warnings;
    let warned = warnings.iter().any(|warning| warning.starts_with("/scene/torques/1 changes by"));
    assert!(warned, "{warnings:?}");
}

/// Over a day the node of an orbit drifts at the rate of the formula: the field that coils see, and the frame of a path, follow it.
#[test]
fn the_node_drifts_by_oblateness() {
    let place = tempfile::tempdir().expect("a directory");
    let (a, e, n, i) = (7.2e6_f64, 0.02_f64, 1.0334e-3, 0.9_f64);
    let (j2, radius) = (1.08263e-3, 6378137.0);
    let ratio: f64 = radius / (a * (1.0 - e * e));
    let drift = -1.5 * n * j2 * ratio * ratio * i.cos();
    // Westwards, about four degrees a day.
    assert!((drift * 86400.0 / TAU * 360.0 + 4.06).abs() < 0.01, "{drift:e}");
    let place_at = |t: f64| {
        let anomaly = (0..60).fold(n * t, |anomaly: f64, _| n * t + e * anomaly.sin());
        let (x, y) = (a * (anomaly.cos() - e), a * (1.0 - e * e).sqrt() * anomaly.sin());
        let (sin, cos) = (0.3 + drift * t).sin_cos();
        [cos * x - sin * i.cos() * y, sin * x + cos * i.cos() * y, i.sin() * y]
    };
    let scenario = json!({
        "name": "day",
        "scene": {
            "inertia": { "principal": [1, 1, 1] },
            "field": { "dipole": { "moment_t_m3": 7.96e15, "orbit": {
                "semi_major_axis_m": a, "mean_motion_rad_s": n, "eccentricity": e, "inclination_rad": i, "node_rad": 0.3,
                "j2": { "j2": j2, "equatorial_radius_m": radius },
            } } },
            "control": {
                "every_s": 600, "laws": [{ "b_dot": { "gain_a_m2_s_per_t": 0 } }], "through": { "magnetorquers": {} },
            },
            "driven": [{
                "term": { "kind": "uniform", "weight": 0, "body_point": [0, 0, 1], "direction": [(0.3_f64).cos(), (0.3_f64).sin(), 0] },
                "path": { "orbit": {
                    "towards": [-(0.3_f64).sin() * i.cos(), (0.3_f64).cos() * i.cos(), i.sin()],
                    "mean_motion_rad_s": n, "eccentricity": e,
                    "j2": { "j2": j2, "equatorial_radius_m": radius, "semi_major_axis_m": a },
                } },
            }],
        },
        "pointing": { "orbit_frame": 0 },
        "method": { "name": "vpd", "tableau": "gauss2" },
        "step_s": 600, "duration_s": 86400, "log": { "every": 1 },
    });
    let log = place.path().join("log.mcap");
    run(&scenario, &log, &Control::default()).expect("a log");
    let (mut fields, mut frames) = (0, 0);
    read_samples(&log, |_, message| match message {
        Message::Control(control) => {
            let at = place_at(control.time_s);
            let r = at.iter().map(|x| x * x).sum::<f64>().sqrt();
            let x = at.map(|x| x / r);
            let d = [0.0, 0.0, -1.0];
            for k in 0..3 {
                let field = 7.96e15 / (r * r * r) * (3.0 * -x[2] * x[k] - d[k]);
                assert!((control.field[k] - field).abs() < 1e-15, "{}: {field}", control.time_s);
            }
            fields += 1;
        }
        Message::Pointing(pointing) => {
            let [w, x, y, z] = <[f64; 4]>::try_from(pointing.frame).expect("a quaternion");
            let time_s = 600.0 * f64::from(frames);
            // The second axis is against the angular momentum.
            let second =
                [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)];
            let (sin, cos) = (0.3 + drift * time_s).sin_cos();
            let normal = [i.sin() * sin, -i.sin() * cos, i.cos()];
            for k in 0..3 {
                assert!((second[k] + normal[k]).abs() < 1e-12, "{time_s}: {second:?}");
            }
            frames += 1;
        }
        _ => {}
    })
    .expect("a log");
    assert_eq!((fields, frames), (145, 145));
}

/// Friction in a wheel takes the nutation away and keeps the spatial momentum; samples closer together come closer to friction that is not
/// sampled, whose end is below.
#[test]
fn a_wheel_with_friction_damps_nutation() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("nutation-damper");
    scenario.as_object_mut().expect("an object").remove("expect");
    scenario["duration_s"] = json!(100);
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss3" });
    scenario["log"] = json!({ "every": 10 });
    // Of the same body with h' = -c w at all times: DOP853 of SciPy 1.17.1, tolerance 1e-13:
    //   J, j, c = np.array([100, 105, 150]), 2, 1; K = J - [j, 0, 0]; a = [1, 0, 0]
    //   Omega = (mu - a h) / K; mu' = cross(mu, Omega); h' = -c (h / j - Omega[0]), h(0) = j Omega[0](0)
    let [coarse, fine] = [0.1, 0.05].map(|every_s| {
        let mut scenario = scenario.clone();
        scenario["scene"]["control"]["every_s"] = json!(every_s);
        scenario["step_s"] = json!(every_s);
        let log = place.path().join(format!("{every_s}.mcap"));
        let summary = run(&scenario, &log, &Control::default()).expect("a log");
        let drift = summary.momentum.expect("logged").max_drift;
        assert!(drift < 2e-13, "{drift:e}");
        let mut last = Vec::new();
        read_samples(&log, |_, message| {
            if let Message::State(state) = message {
                last = state.body_momentum;
            }
        })
        .expect("a log");
        <[f64; 3]>::try_from(last).expect("three numbers")
    });
    let off = |end: [f64; 3]| {
        let apart = end.iter().zip(FRICTION_END).map(|(a, b)| (a - b).abs());
        apart.fold(0.0, f64::max)
    };
    let (ratio, limit) =
        (off(coarse) / off(fine), std::array::from_fn(|k| 2.0 * fine[k] - coarse[k]));
    println!(
        "{:e} and {:e} from continuous friction, {:e} in the limit",
        off(coarse),
        off(fine),
        off(limit)
    );
    // To the first order, and what is left of the second: of a momentum of 151.
    assert!((1.9..2.1).contains(&ratio) && off(fine) < 0.1 && off(limit) < 5e-3);
}

/// The body momentum after 100 s.
const FRICTION_END: [f64; 3] = [-9.704923526579904, 0.18489728689778606, 151.01582788680304];

/// What is not as it must be is named, with what was given and what is allowed.
#[test]
fn bad_orbits_and_faces_are_refused_at_their_field() {
    let (drag, light) = ("/scene/torques/0/drag", "/scene/torques/1/solar_pressure");
    let orbit = "/scene/field/dipole/orbit";
    let full = json!({ "j2": 1e-3, "equatorial_radius_m": 6e6, "semi_major_axis_m": 7e6 });
    for (at, key, value, pointer, words) in [
        (drag, "/faces", json!([]), "/faces", "0 faces given, 1 to 1000"),
        (drag, "/faces/0/normal", json!([0, 0, 0]), "/faces/0/normal", "a direction needs"),
        (drag, "/faces/0/area_m2", json!(-1), "/faces/0/area_m2", "at least 0"),
        (drag, "/faces/0/centre_m", json!([1, 2]), "/faces/0/centre_m", ""),
        (drag, "/faces/1/coefficient", json!(-2), "/faces/1/coefficient", "-2.0 given"),
        (drag, "/density_kg_m3", json!(-1e-12), "/density_kg_m3", "at least 0"),
        (drag, "/density_kg_m3", json!("thin"), "/density_kg_m3", ""),
        (drag, "/wind", json!([0, 0, 1]), "/wind", "wind"),
        (
            drag,
            "/factor/harmonic/amplitude",
            json!(1.5),
            "/factor/harmonic/amplitude",
            "1.5 given about a mean of 1.0; the factor must not fall below 0",
        ),
        (
            drag,
            "/factor",
            json!({ "table": { "times_s": [0, 9000], "values": [1, -1] } }),
            "/factor/table/values/1",
            "-1.0 given",
        ),
        (
            drag,
            "/factor",
            json!({ "table": { "times_s": [0, 10], "values": [1, 1] } }),
            "/factor/table/times_s/1",
            "must cover the run",
        ),
        (drag, "/orbit", json!({ "semi_major_axis_m": 7e6 }), "/orbit", "mean_motion_rad_s"),
        (light, "/sun", json!([0, 0, 0]), "/sun", "a direction needs"),
        (light, "/pressure_n_m2", json!(-1), "/pressure_n_m2", "at least 0"),
        (light, "/faces/0/specular", json!(1.2), "/faces/0/specular", "from 0 to 1"),
        (light, "/faces/0/specular", json!(0.4), "/faces/0", "which must be 1"),
        (orbit, "/j2/j2", json!(0.7), "/j2/j2", "0.7 given"),
        (orbit, "/j2/equatorial_radius_m", json!(0), "/j2/equatorial_radius_m", "above 0"),
        (orbit, "/j2/equatorial_radius_m", json!(6.9e6), "/j2/equatorial_radius_m", "pericentre"),
        (orbit, "/j2", json!({ "j2": 1e-3 }), "/j2", "equatorial_radius_m"),
        (orbit, "/j2", json!(true), "/j2", ""),
        (orbit, "/j2", full.clone(), "/j2/semi_major_axis_m", "leave it out"),
    ] {
        let mut scenario = air_and_light();
        let (parent, name) = key.rsplit_once('/').expect("a pointer");
        let parent = scenario.pointer_mut(&format!("{at}{parent}")).expect("it is there");
        parent[name] = value;
        let error = refused(&scenario);
        assert_eq!(error.pointer, format!("{at}{pointer}"), "{key}: {error}");
        assert!(error.message.contains(words), "{key}: {error}");
    }
    let mut alone = air_and_light();
    alone["scene"].as_object_mut().expect("an object").remove("field");
    let error = refused(&alone);
    assert_eq!(error.pointer, drag);
    assert!(error.message.contains("missing field `orbit`"), "{error}");
    let mut flat = air_and_light();
    flat["scene"] = json!({
        "inertia": { "second_moments": [1, 2] },
        "torques": [flat["scene"]["torques"][1].clone()],
    });
    let error = refused(&flat);
    assert_eq!(error.pointer, "/scene/torques/0/solar_pressure");
    assert!(error.message.contains("n = 3"), "{error}");
    // On a path, which has no semi-major axis of its own.
    let on_path = |j2: Value| {
        json!({
            "name": "path",
            "scene": {
                "inertia": { "principal": [1, 2, 3] },
                "driven": [{
                    "term": { "kind": "gravity_gradient", "direction": [1, 0, 0] },
                    "path": { "orbit": { "towards": [0, 1, 1], "mean_motion_rad_s": 1e-3, "j2": j2 } },
                }],
            },
            "step_s": 1, "steps": 10,
        })
    };
    let at = "/scene/driven/0/path/orbit/j2";
    let error = refused(&on_path(json!({ "j2": 1e-3, "equatorial_radius_m": 6e6 })));
    assert_eq!(error.pointer, at);
    let mut low = full;
    low["semi_major_axis_m"] = json!(5e6);
    assert_eq!(refused(&on_path(low)).pointer, format!("{at}/equatorial_radius_m"));
    // Friction without wheels, without their moments, or so strong that it turns them back.
    let friction = |c: f64| json!({ "wheel_friction": { "coefficient_n_m_s": c } });
    let mut damper = shipped("nutation-damper");
    damper["scene"]["control"]["laws"] = json!([friction(1e6)]);
    let error = refused(&damper);
    let at = "/scene/control/laws/0/wheel_friction";
    assert_eq!(error.pointer, format!("{at}/coefficient_n_m_s"));
    assert!(error.message.contains("1000000.0 given"), "{error}");
    damper["scene"]["control"]["laws"] = json!([friction(0.01)]);
    damper["scene"]["control"]["through"]["wheels"]
        .as_object_mut()
        .expect("an object")
        .remove("moments_kg_m2");
    assert_eq!(refused(&damper).pointer, "/scene/control/through/wheels/moments_kg_m2");
    damper["scene"]["control"]["through"] = json!("torque");
    assert_eq!(refused(&damper).pointer, at);
}

/// Scenes with air, light, a node that drifts, friction in a wheel, coils and control, shortened.
fn short(name: &str) -> Value {
    let mut scenario = if name == "air-and-light" { air_and_light() } else { shipped(name) };
    let fields = scenario.as_object_mut().expect("an object");
    for name in ["expect", "duration_s", "until"] {
        fields.remove(name);
    }
    fields.insert("steps".to_owned(), json!(400));
    fields.insert("log".to_owned(), json!({ "every": 4 }));
    scenario
}

/// Coefficients of what acts, and of control, are fields as others: a member of a sweep is the run with its value, to the bit, and
/// another value is another motion.
#[test]
fn coefficients_are_fields_of_sweeps() {
    for (name, pointer, values) in [
        ("air-and-light", "/scene/torques/0/drag/density_kg_m3", [1e-12, 1e-10]),
        ("air-and-light", "/scene/torques/0/drag/faces/0/coefficient", [1.5, 2.5]),
        ("air-and-light", "/scene/torques/1/solar_pressure/pressure_n_m2", [0.0, 4.5e-6]),
        ("air-and-light", "/scene/torques/1/solar_pressure/faces/1/area_m2", [0.1, 0.3]),
        ("air-and-light", "/scene/field/dipole/orbit/j2/j2", [0.0, 2e-3]),
        ("nutation-damper", "/scene/control/laws/0/wheel_friction/coefficient_n_m_s", [0.5, 1.0]),
        ("slew", "/scene/control/laws/0/attitude/gain_n_m", [0.04, 0.08]),
        ("slew", "/scene/control/laws/0/attitude/rate_gain_n_m_s", [0.4, 0.9]),
        ("slew", "/scene/control/every_s", [0.1, 0.25]),
        ("detumble", "/scene/control/laws/0/b_dot/gain_a_m2_s_per_t", [2e4, 5e4]),
    ] {
        let place = tempfile::tempdir().expect("a directory");
        let at = place.path();
        let scenario = short(name);
        fs::write(at.join("scene.json"), scenario.to_string()).expect("writable");
        let sweep = json!({
            "scenario": "scene.json",
            "vary": [{ "name": "varied", "pointer": pointer, "values": { "list": values } }]
        });
        fs::write(at.join("sweep.json"), sweep.to_string()).expect("writable");
        succeeds(at, &["sweep", "sweep.json"]);
        let lines = lines(at, "sweep.csv");
        let mut ends = Vec::new();
        for (line, value) in lines.iter().zip(values) {
            let mut scenario = scenario.clone();
            *scenario.pointer_mut(pointer).expect("a field") = json!(value);
            let log = at.join("log.mcap");
            let summary = run(&scenario, &log, &Control::default()).expect("a log");
            let momentum = summary.last.body_momentum.as_array().expect("a vector").clone();
            let momentum: Vec<f64> = momentum.iter().filter_map(Value::as_f64).collect();
            let cells = ["x", "y", "z"].map(|axis| number(line, &format!("body_momentum_{axis}")));
            assert_eq!(momentum, cells, "{pointer} {value}");
            assert_eq!(number(line, "varied"), value);
            assert_eq!(number(line, "time_s"), summary.time_s);
            ends.push(momentum);
        }
        assert_ne!(ends[0], ends[1], "{pointer}");
    }
}

/// Tables hold what acts, and so do the members of an ensemble, whose members in full are exported as a run is.
#[test]
fn what_acts_is_in_tables_and_ensembles() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("log.mcap");
    for (name, columns) in [
        ("air-and-light", vec!["energy_work", "momentum_impulse_x"]),
        ("nutation-damper", vec!["control_command_1", "wheel_momenta_1", "wheel_speeds_1"]),
        ("slew", vec!["control_command_1", "pointing_error_rad", "wheel_momenta_3"]),
        ("detumble", vec!["control_command_1", "control_field_z"]),
    ] {
        let mut scenario = short(name);
        scenario["ensemble"] = json!({
            "members": 11, "seed": 3, "attitude_spread_rad": 0.3, "momentum_spread": 1e-3, "in_full": [3]
        });
        let many = run(&scenario, &log, &Control::default()).expect("a log");
        assert_eq!(many.ensemble.expect("an ensemble").succeeded, 11, "{name}");
        let members = contents(&log).members;
        let states = states(&log);
        for member in [0, 3] {
            let mut text = Vec::new();
            let choice = Choice { channels: Vec::new(), member };
            let found = export(&log, &choice, Format::Csv, &mut text).expect("a table");
            assert_eq!(found.rows, 101, "{name}");
            for column in &columns {
                let has = found.columns.iter().any(|found| found.starts_with(column));
                assert!(has, "{name}: {column} of {:?}", found.columns);
            }
            let text = String::from_utf8(text).expect("text");
            let row: Vec<&str> = text.lines().last().expect("a row").split(',').collect();
            let column = found.columns.iter().position(|name| name == "body_momentum_x");
            let cell: f64 = row[column.expect("a column")].parse().expect("a number");
            let end = members.iter().find(|end| end.member == member).expect("its end");
            let last = end.last.as_ref().expect("a state");
            assert_eq!(cell, last.body_momentum[0]);
            // The quaternions of a way have the sign that is nearer to the one before.
            let shown = states[&member].last().expect("a state");
            assert_eq!(
                (&shown.attitude, &shown.body_momentum),
                (&last.attitude, &last.body_momentum)
            );
        }
        scenario.as_object_mut().expect("an object").remove("ensemble");
        let single = run(&scenario, &log, &Control::default()).expect("a log");
        let [a, b] = [many.last, single.last].map(|last| last.attitude.expect("computed").concat());
        // Side by side the sums over the stages are in another order.
        let apart = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(apart < 1e-12, "{name} {apart:e}");
    }
}
