//! Scenes with control: their logs, their ends, what is refused.

use std::fs;
use std::sync::atomic::Ordering;
use std::thread;

use foxglove::messages::FrameTransforms;
use serde_json::{Value, json};
use vpd::advise;
use vpd::log::columns::Columns;
use vpd::log::course::{Course, LogChart};
use vpd::log::inspect::inspect;
use vpd::log::part_path;
use vpd::log::reader::{Message, read_samples};
use vpd::log::samples::{Curve, Window, read_course};
use vpd::run::{Control, JobContext, Outcome, RunError, Summary, execute};
use vpd::scenario::Scenario;
use vpd::verify::verify;

use crate::ensemble::{contents, ends, states};

fn shipped(name: &str) -> Value {
    let path = format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"));
    let mut scenario: Value =
        serde_json::from_slice(&fs::read(path).expect("a scenario")).expect("JSON");
    scenario.as_object_mut().expect("an object").remove("expect");
    scenario
}

fn accepted(scenario: &Value) -> Scenario {
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario")
}

fn run(scenario: &Value, log: &std::path::Path, control: &Control) -> Result<Summary, RunError> {
    let plan = advise::plan(&accepted(scenario)).expect("a plan");
    execute(&plan, &JobContext { log, control })
}

/// The slew ends where its condition holds; its log says so, shows the control at each sample, and is repeated by `verify`.
#[test]
fn a_slew_ends_where_it_points() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("slew.mcap");
    let summary = run(&shipped("slew"), &log, &Control::default()).expect("a log");
    assert_eq!(summary.outcome, Outcome::Succeeded);
    let stopped = summary.stopped.expect("before its time");
    assert!(stopped.contains("pointing error below 0.001 rad for 10 s"), "{stopped}");
    assert!(stopped.ends_with("(/until/0)") && summary.time_s < 590.0, "{stopped}");
    let drift = summary.momentum.expect("logged").max_drift;
    assert!(drift < 1e-15, "{drift:e}");
    // The summary has what the log has.
    let (mut saturated, mut last_error) = (0, None);
    read_samples(&log, |_, message| {
        if let Message::Control(seen) = message {
            saturated += u64::from(seen.saturated);
            last_error = seen.pointing_error_rad;
        }
    })
    .expect("a log");
    let control = summary.control.expect("logged");
    assert!(saturated > 0 && last_error.is_some_and(|error| error < 1e-3), "{saturated}");
    let told = (control.samples, control.saturated, control.pointing_error_rad);
    assert_eq!(told, (summary.samples, saturated, last_error));
    let seen = inspect(&log).expect("readable");
    let control = seen.topics.iter().find(|entry| entry.topic == "/control");
    assert_eq!(control.expect("logged").messages, summary.samples);
    // Charts of it go to the target.
    for (curve, components) in [
        (Curve::PointingError, 1),
        (Curve::ControlCommand, 4),
        (Curve::WheelMomenta, 4),
        (Curve::WheelSpeeds, 4),
    ] {
        let window = Window { from_s: 0.0, to_s: f64::MAX, points: 100 };
        let found = read_course(&log, curve, window, &|_| Vec::new(), &|| false);
        let found = found.expect("readable").expect("read");
        assert_eq!((found.low.len(), found.high.len()), (components, components), "{curve:?}");
        let (first, last) = (found.high[0][0], found.low[0].last().copied());
        if curve == Curve::PointingError {
            assert!(first > 1.0 && last.is_some_and(|last| last < 1e-3), "{first} {last:?}");
        }
    }
    assert!(verify(&log).expect("verified").same);
}

/// Interrupted wherever it may be, a run with control has the bytes of the whole one, with delays, and samples between steps.
#[test]
fn an_interrupted_run_has_the_same_bytes() {
    let place = tempfile::tempdir().expect("a directory");
    for name in ["slew", "detumble"] {
        let mut scenario = shipped(name);
        let fields = scenario.as_object_mut().expect("an object");
        fields.remove("until");
        fields.remove("duration_s");
        fields.insert("steps".to_owned(), json!(6000));
        fields.insert("log".to_owned(), json!({ "every": 1 }));
        scenario["scene"]["control"]["every_s"] = json!(1.3);
        scenario["scene"]["control"]["delay_s"] = json!(0.72);
        scenario["scene"]["control"]["noise"] =
            json!({ "seed": 4, "attitude_rad": 1e-3, "rate_rad_s": 1e-4, "torque_n_m": 1e-6 });
        scenario["pointing"] = json!({ "frame": { "orbit": {
            "from": [0, 0, 1], "towards": [0, -1, 0], "mean_motion_rad_s": 1e-3,
        } } });
        let whole = place.path().join(format!("{name}.mcap"));
        run(&scenario, &whole, &Control::default()).expect("a log");
        let cut = place.path().join(format!("{name}-cut.mcap"));
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
        assert!(fs::read(&whole).expect("whole") == fs::read(&cut).expect("cut"), "{name}");
    }
}

/// A condition that holds over the end of a run that is cut still counts from where it began to hold.
#[test]
fn a_stop_is_found_across_an_interruption() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("slew");
    scenario["until"] = json!([{ "rate_below_rad_s": 10.0, "for_s": 400.0 }]);
    let log = place.path().join("log.mcap");
    let control = Control::default();
    let cut = thread::scope(|scope| {
        let worker = scope.spawn(|| run(&scenario, &log, &control));
        while control.steps_done.load(Ordering::Relaxed) < 2500 && !worker.is_finished() {
            thread::yield_now();
        }
        control.interrupted.store(true, Ordering::Relaxed);
        worker.join().expect("no panic")
    });
    let summary = match cut {
        Ok(summary) => summary,
        Err(_) => run(&scenario, &log, &Control::default()).expect("a log"),
    };
    assert_eq!((summary.steps, summary.outcome), (4001, Outcome::Succeeded));
}

/// A body that swings about a principal axis, from rest: a pendulum of which all is known.
fn pendulum() -> Value {
    json!({
        "name": "pendulum",
        "scene": {
            "inertia": { "principal": [2, 3, 0.6] },
            "potential": [{ "kind": "uniform", "weight": 9.81, "body_point": [0, 0, -1], "direction": [0, 0, 1] }],
            "initial": { "attitude": { "axis_angle": { "axis": [0, 1, 0], "angle_rad": 1.2 } } }
        },
        "until": [{ "angle_above_rad": { "angle_rad": 1.2 }, "exact": true }],
        "duration_s": 2
    })
}

/// A quarter of the period of a pendulum: K(sin(a / 2)) / omega = pi / (2 omega agm(1, cos(a / 2))).
fn quarter_s(angle: f64, omega: f64) -> f64 {
    let (mut a, mut b) = (1.0, (0.5 * angle).cos());
    for _ in 0..10 {
        (a, b) = (0.5 * (a + b), f64::sqrt(a * b));
    }
    std::f64::consts::FRAC_PI_2 / (omega * a)
}

/// A stop within a step is where theory has it, for each method: to 1e-9 s where the method is that good, else by its order. The
/// last sample is as good as the others.
#[test]
fn a_stop_within_a_step_is_where_theory_has_it() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("log.mcap");
    let run_with = |scenario: &Value, method: &Value, step_s: f64| {
        let mut scenario = scenario.clone();
        scenario["method"] = method.clone();
        scenario["step_s"] = json!(step_s);
        // A whole number of steps.
        scenario["duration_s"] = json!(step_s * (2.0 / step_s).ceil());
        run(&scenario, &log, &Control::default()).expect("a log")
    };
    let swings_s = quarter_s(1.2, (9.81_f64 / 3.0).sqrt());
    let mut turning = pendulum();
    turning["scene"]["potential"] = json!([]);
    turning["scene"]["initial"] = json!({ "angular_velocity": { "body": [0, 0.9, 0] } });
    turning["until"][0]["angle_above_rad"]["angle_rad"] = json!(0.7);
    let turns_s = 0.7 / 0.9;
    for (scenario, exact_s, method, step_s) in [
        (pendulum(), swings_s, json!({ "name": "vpd", "tableau": "gauss4" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "vpd", "tableau": "gauss6" }), 0.13),
        (pendulum(), swings_s, json!({ "name": "vpd_lagrangian", "tableau": "gauss4" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "vrkmk", "tableau": "gauss4" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "rkmk", "tableau": "rk8" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "rk", "tableau": "rk8" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "rk_projected", "tableau": "rk8" }), 0.02),
        (pendulum(), swings_s, json!({ "name": "quaternion_gauss", "tableau": "gauss4" }), 0.02),
        (turning.clone(), turns_s, json!({ "name": "vpd_reduced", "tableau": "gauss4" }), 0.02),
        (turning.clone(), turns_s, json!({ "name": "vpd", "tableau": "gauss6" }), 0.3),
        (turning, turns_s, json!({ "name": "splitting" }), 0.3),
    ] {
        let name = method["name"].clone();
        let summary = run_with(&scenario, &method, step_s);
        let off_s = summary.time_s - exact_s;
        println!("{name} h = {step_s}: off by {off_s:.1e} s");
        assert!(off_s.abs() < 2e-9, "{name} {off_s:e}");
        assert_eq!(summary.steps, (exact_s / step_s).ceil() as u64);
        let said = format!("at t = {:.9} s (/until/0)", summary.time_s);
        assert!(summary.stopped.expect("stopped").ends_with(&said));
        let last_s = states(&log)[&0].last().map(|state| state.time_s);
        assert_eq!(last_s, Some(summary.time_s));
        assert!(verify(&log).expect("verified").same, "{name}");
        let energy = summary.energy.expect("logged").final_error;
        assert!(energy.abs() < 1e-9, "{name} {energy:e}");
        if name != "rk" {
            let orthogonality = summary.orthogonality.expect("logged").max;
            assert!(orthogonality < 2e-15, "{name} {orthogonality:e}");
        }
    }
    for (method, step_s, order) in [
        (json!({ "name": "vpd", "tableau": "gauss1" }), 0.05, 2),
        (json!({ "name": "lgvi" }), 0.05, 2),
        (json!({ "name": "splitting", "order": 2 }), 0.05, 2),
        // Its error passes through zero between these steps, and is that of its order at both.
        (json!({ "name": "splitting", "order": 4 }), 0.4, 4),
        (json!({ "name": "vpd", "tableau": "gauss2" }), 0.2, 4),
        (json!({ "name": "rkmk", "tableau": "rk4" }), 0.1, 4),
    ] {
        let off = |step_s| (run_with(&pendulum(), &method, step_s).time_s - swings_s).abs();
        let (long, short) = (off(step_s), off(0.25 * step_s));
        let slope = (long / short).log2() / 2.0;
        println!("{method}: off by {long:.1e} s and {short:.1e} s, order {slope:.2}");
        assert!(slope > f64::from(order) - 0.4, "{method} {slope}");
    }
}

/// Wheels spin a body up until a step of it can no longer be solved: the smaller step that is advised was tried with the wheels and
/// the command of that time, and carries the run.
#[test]
fn a_body_that_its_wheels_spin_up_is_advised_a_step() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = json!({
        "name": "spun-up",
        "scene": {
            "inertia": { "principal": [1, 1.3, 0.8] },
            "control": {
                "every_s": 0.5,
                "target": { "turning": { "from": [1, 0, 0], "towards": [0, 1, 0], "rate_rad_s": 9 } },
                "laws": [{ "attitude": { "gain_n_m": 0, "rate_gain_n_m_s": 0.3 } }],
                "through": { "wheels": {
                    "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                    "moments_kg_m2": [0.05, 0.05, 0.05]
                } }
            },
            "initial": { "angular_velocity": { "body": [0.01, -0.02, 0.015] } }
        },
        "method": { "name": "vpd", "tableau": "gauss2", "solver": { "kind": "fixed_point" } },
        "step_s": 0.5,
        "duration_s": 60
    });
    let mut run_to = |name: &str, step_s: f64| {
        scenario["step_s"] = json!(step_s);
        run(&scenario, &place.path().join(name), &Control::default()).expect("a log")
    };
    let failed = run_to("long.mcap", 0.5);
    assert_eq!(failed.outcome, Outcome::Failed);
    let advised_s = failed.diagnosis.and_then(|found| found.advised_step_s).expect("an advice");
    println!("failed after {} steps; {advised_s} s advised", failed.steps);
    assert_eq!(run_to("short.mcap", advised_s).outcome, Outcome::Succeeded);
}

/// Steps of half a billion seconds, in which neighbouring numbers are farther apart than a stop is located to elsewhere.
#[test]
fn a_stop_is_located_in_the_longest_steps() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = pendulum();
    scenario["scene"]["potential"] = json!([]);
    scenario["scene"]["initial"] = json!({ "angular_velocity": { "body": [0, 9e-10, 0] } });
    scenario["until"][0]["angle_above_rad"]["angle_rad"] = json!(0.7);
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss6" });
    scenario["step_s"] = json!(5e8);
    scenario["duration_s"] = json!(2.5e9);
    let summary =
        run(&scenario, &place.path().join("log.mcap"), &Control::default()).expect("a log");
    let off_s = summary.time_s - 0.7 / 9e-10;
    println!("off by {off_s:e} s of {:e}", summary.time_s);
    // A turn of 1e-14 rad takes 1e-5 s.
    assert!(summary.stopped.is_some() && off_s.abs() < 1e-5, "{off_s:e}");
}

/// A stop within a step has the same bytes after an interruption anywhere, and the same time with other steps, also with samples of
/// the control within them.
#[test]
fn a_stop_within_a_step_has_the_same_bytes() {
    let place = tempfile::tempdir().expect("a directory");
    let (whole, cut) = (place.path().join("whole.mcap"), place.path().join("cut.mcap"));
    let mut scenario = shipped("slew");
    scenario["until"] = json!([{ "pointing_error_below_rad": 0.01, "exact": true }]);
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss4" });
    scenario["log"] = json!({ "every": 1 });
    let mut ends_s = Vec::new();
    for step_s in [0.15, 0.01, 0.003] {
        scenario["step_s"] = json!(step_s);
        scenario["duration_s"] = json!(150);
        let summary = run(&scenario, &whole, &Control::default()).expect("a log");
        ends_s.push(summary.time_s);
        let bytes = fs::read(&whole).expect("a log");
        let mut resumed = Vec::new();
        for part in [0.2, 0.5, 0.8, 0.97, 0.999] {
            let _ = fs::remove_file(&cut);
            fs::write(part_path(&cut), &bytes[..(part * bytes.len() as f64) as usize])
                .expect("written");
            let again = run(&scenario, &cut, &Control::default()).expect("a log");
            resumed.push(again.resumed_step);
            assert!(fs::read(&cut).expect("a log") == bytes, "{step_s}: cut at {part}");
        }
        println!("{step_s}: ended at {} s, resumed at {resumed:?}", summary.time_s);
        assert!(verify(&whole).expect("verified").same);
    }
    let apart = ends_s.iter().map(|end_s| (end_s - ends_s[2]).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-7, "{ends_s:?}");
}

/// Members stop within a step as a run by itself does, to the bit, in lanes and without; a condition that holds at the start ends
/// the run after its first step.
#[test]
fn members_stop_within_a_step_as_a_run_by_itself() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("log.mcap");
    for (method, every) in [
        (json!({ "name": "vpd", "tableau": "gauss2" }), 1),
        (json!({ "name": "vpd", "tableau": "gauss6" }), 7),
        (json!({ "name": "rkmk", "tableau": "rk4" }), 3),
    ] {
        let mut scenario = pendulum();
        scenario["method"] = method;
        scenario["step_s"] = json!(0.01);
        scenario["log"] = json!({ "every": every });
        // Not in a plane.
        scenario["scene"]["initial"]["angular_velocity"] = json!({ "body": [0.3, 0, 0.8] });
        let single = run(&scenario, &log, &Control::default()).expect("a log");
        scenario["ensemble"] =
            json!({ "members": 21, "seed": 3, "momentum_spread": 0.2, "in_full": [5, 6] });
        let many = run(&scenario, &log, &Control::default()).expect("a log");
        assert_eq!((many.stopped, many.last), (single.stopped, single.last));
        assert_eq!(many.ensemble.expect("an ensemble").stopped.get("/until/0"), Some(&21));
        let members = contents(&log).members;
        for end in &members {
            let last = end.last.as_ref().expect("a state");
            let start = &members.iter().find(|end| end.member == 0).expect("its end").initial;
            let start = start.as_ref().expect("a state");
            let cosine: f64 =
                start.attitude.iter().zip(&last.attitude).map(|(a, b)| a * b).sum::<f64>();
            let off = ((cosine - 1.0) / 2.0).acos() - 1.2;
            assert!(off.abs() < 1e-8, "{off:e}");
            assert!(last.time_s > (end.steps - 1) as f64 * 0.01);
            assert!(last.time_s < end.steps as f64 * 0.01);
        }
        scenario["ensemble"]["in_full"] = json!([]);
        run(&scenario, &log, &Control::default()).expect("a log");
        let mut others = contents(&log).members;
        let mut members = members;
        for ends in [&mut members, &mut others] {
            ends.sort_by_key(|end| end.member);
        }
        let last = |ends: &[vpd::log::messages::Member]| {
            ends.iter().map(|end| (end.steps, end.last.clone())).collect::<Vec<_>>()
        };
        assert_eq!(last(&members), last(&others));
    }
    let mut scenario = pendulum();
    scenario["step_s"] = json!(0.01);
    scenario["until"] = json!([{ "rate_below_rad_s": 100, "exact": true }]);
    let summary = run(&scenario, &log, &Control::default()).expect("a log");
    assert_eq!((summary.steps, summary.time_s), (1, 0.01));
    // Members in full that end within one step, not in the order of their numbers.
    let mut scenario = pendulum();
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss6" });
    scenario["step_s"] = json!(0.2);
    scenario["scene"]["initial"]["angular_velocity"] = json!({ "body": [0.3, 0, 0.8] });
    scenario["ensemble"] = json!({ "members": 8, "seed": 3, "momentum_spread": 0.02, "in_full": [1, 2, 3, 4, 5, 6, 7] });
    run(&scenario, &log, &Control::default()).expect("a log");
    let mut members = contents(&log).members;
    members.sort_by_key(|end| end.member);
    let ends = |end: &vpd::log::messages::Member| end.last.as_ref().map(|last| last.time_s);
    let in_order = members.windows(2).all(|pair| ends(&pair[0]) <= ends(&pair[1]));
    let in_one_step = members
        .windows(2)
        .any(|pair| pair[0].steps == pair[1].steps && ends(&pair[0]) > ends(&pair[1]));
    assert!(!in_order && in_one_step);
    assert!(verify(&log).expect("verified").same);
}

/// An ensemble under control: each member has its own controller, and its bits are those of its own run.
#[test]
fn members_have_controllers_of_their_own() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("slew");
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("until");
    fields.insert("duration_s".to_owned(), json!(30));
    let alone = place.path().join("alone.mcap");
    let single = run(&scenario, &alone, &Control::default()).expect("a log");
    scenario["ensemble"] = json!({ "members": 12, "seed": 3, "attitude_spread_rad": 0.3 });
    let log = place.path().join("log.mcap");
    let many = run(&scenario, &log, &Control::default()).expect("a log");
    assert_eq!(many.ensemble.expect("an ensemble").succeeded, 12);
    assert_eq!(many.last, single.last);
}

/// Members under control stop where they point, each with its own controller; the choice for an accuracy is that of the whole
/// duration, as if there were no stop.
#[test]
fn a_stop_stands_next_to_an_ensemble_and_an_accuracy() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("log.mcap");
    let single = run(&shipped("slew"), &log, &Control::default()).expect("a log");
    let mut many = shipped("slew");
    many["ensemble"] = json!({ "members": 12, "seed": 3, "attitude_spread_rad": 0.3 });
    let summary = run(&many, &log, &Control::default()).expect("a log");
    assert_eq!(summary.stopped, single.stopped);
    // A run begins anew at its checkpoints, a member does not.
    let [ours, alone] =
        [&summary, &single].map(|of| of.last.attitude.clone().expect("of one body"));
    for (a, b) in ours.iter().flatten().zip(alone.iter().flatten()) {
        assert!((a - b).abs() < 1e-12, "{ours:?} {alone:?}");
    }
    let reported = summary.ensemble.expect("an ensemble");
    assert_eq!(reported.stopped.get("/until/0"), Some(&12));
    let members = contents(&log).members;
    let steps: std::collections::BTreeSet<u64> = members.iter().map(|end| end.steps).collect();
    assert!(steps.len() > 6, "{steps:?}");
    assert!(verify(&log).expect("verified").same);
    let bytes = fs::read(&log).expect("a log");
    run(&many, &log, &Control::default()).expect("a log");
    assert!(fs::read(&log).expect("a log") == bytes);

    let mut scenario = shipped("slew");
    let fields = scenario.as_object_mut().expect("an object");
    for name in ["step_s", "method", "log"] {
        fields.remove(name);
    }
    fields.insert("duration_s".to_owned(), json!(40));
    fields.insert("accuracy".to_owned(), json!({ "error": 1e-6 }));
    fields.insert("until".to_owned(), json!([{ "pointing_error_below_rad": 1.5 }]));
    let stops = advise::plan(&accepted(&scenario)).expect("a plan");
    let summary = run(&scenario, &log, &Control::default()).expect("a log");
    assert!(summary.stopped.is_some() && summary.time_s < 40.0, "{summary:?}");
    assert!(verify(&log).expect("verified").same);
    scenario.as_object_mut().expect("an object").remove("until");
    let goes_on = advise::plan(&accepted(&scenario)).expect("a plan");
    assert_eq!((stops.step_s, stops.steps), (goes_on.step_s, goes_on.steps));
    assert_eq!(stops.formulation.method, goes_on.formulation.method);
}

/// Each member of an ensemble has noise of its own, whatever members run next to it: that of a single run with its stream. The
/// log says which torque it was.
#[test]
fn members_have_noise_of_their_own() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("slew");
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("until");
    fields.insert("duration_s".to_owned(), json!(20));
    scenario["scene"]["control"]["noise"] =
        json!({ "seed": 9, "stream": 2, "attitude_rad": 1e-3, "torque_n_m": 1e-4 });
    let single = |stream: u64| {
        let mut scenario = scenario.clone();
        scenario["scene"]["control"]["noise"]["stream"] = json!(stream);
        let log = place.path().join(format!("{stream}.mcap"));
        let summary = run(&scenario, &log, &Control::default()).expect("a log");
        assert!(verify(&log).expect("verified").same);
        summary.last
    };
    let mut many = scenario.clone();
    many["ensemble"] = json!({ "members": 20, "in_full": [13, 4] });
    let log = place.path().join("log.mcap");
    let summary = run(&many, &log, &Control::default()).expect("a log");
    assert_eq!(summary.ensemble.expect("an ensemble").succeeded, 20);
    assert_eq!(summary.last, single(2));
    let ends = ends(&log);
    assert_eq!(ends.len(), 20);
    for (&m, end) in &ends {
        let alike = ends.values().filter(|other| *other == end).count();
        assert_eq!(alike, 1, "member {m}");
        if [1, 4, 13, 19].contains(&m) {
            let rows = single(2 + m).attitude.expect("computed").concat();
            assert_eq!(*end, rows, "member {m}");
        }
    }
    let mut disturbed = 0;
    read_samples(&place.path().join("2.mcap"), |_, message| {
        if let Message::Control(control) = message {
            assert_eq!(control.disturbance.len(), 3);
            disturbed += usize::from(control.disturbance.iter().all(|x| x.abs() < 1e-3));
        }
    })
    .expect("a log");
    assert!(disturbed > 100, "{disturbed}");
}

/// A satellite on an orbit shows where it points, from the angles that it starts with on: in the log, in its frames, in a table and as a
/// chart, and only if it is asked. The motion has the bits of the run that does not.
#[test]
fn a_satellite_shows_where_it_points() {
    let place = tempfile::tempdir().expect("a directory");
    let angles = [0.2, -0.1, 0.4];
    let scenario = json!({
        "name": "level",
        "scene": {
            "inertia": { "principal": [2.0, 2.2, 0.9] },
            "driven": [{
                "term": { "kind": "gravity_gradient", "direction": [0, 0, 1] },
                "path": { "orbit": { "towards": [0, -1, 0], "mean_motion_rad_s": 1e-3, "eccentricity": 0.1 } },
            }],
            "initial": { "orbit_frame": 0, "attitude": { "roll_pitch_yaw": { "angles_rad": angles } } },
        },
        "step_s": 10, "steps": 300, "log": { "every": 1 },
    });
    let mut asked = scenario.clone();
    asked["pointing"] = json!({ "orbit_frame": 0, "axis": [0, 0, 2], "towards": [0, 1, 0] });
    let logs = ["without.mcap", "with.mcap"].map(|name| place.path().join(name));
    // In one chunk of the log, at whose end the stepper starts anew.
    let without = run(&scenario, &logs[0], &Control::default()).expect("a log");
    let with = run(&asked, &logs[1], &Control::default()).expect("a log");
    assert_eq!(without.last, with.last);
    assert!(verify(&logs[1]).expect("verified").same);

    let (mut first, mut seen) = (None, 0);
    read_samples(&logs[1], |_, message| {
        if let Message::Pointing(pointing) = message {
            first.get_or_insert(pointing);
            seen += 1;
        }
    })
    .expect("a log");
    assert_eq!(seen, 301);
    let first = first.expect("a sample");
    let found = [first.roll_rad, first.pitch_rad, first.yaw_rad];
    for (found, right) in found.iter().zip(angles) {
        assert!((found - right).abs() < 1e-14, "{found} for {right}");
    }
    // The axis is z, turned by the angles: its part along y is -sin(roll) cos(yaw) + ...
    let [roll, pitch, yaw] = angles;
    let along = f64::cos(roll) * f64::sin(pitch) * f64::sin(yaw) - f64::sin(roll) * f64::cos(yaw);
    assert!((first.axis_error_rad.cos() - along).abs() < 1e-14);
    // At rest in space: the frame turns about -y at the pericentre, n (1 + e)^(1/2) / (1 - e)^(3/2).
    let turning = 1e-3 * f64::sqrt(1.1 / 0.729);
    let size = first.rate.iter().map(|x| x * x).sum::<f64>().sqrt();
    assert!((size - turning).abs() < 1e-15, "{size:e} for {turning:e}");

    let frames = |log: &std::path::Path| {
        let bytes = fs::read(log).expect("a log");
        let mut names = std::collections::BTreeSet::new();
        for message in mcap::MessageStream::new(&bytes).expect("an MCAP file") {
            let message = message.expect("a message");
            if message.channel.topic == "/tf" {
                let found: FrameTransforms =
                    prost::Message::decode(message.data.as_ref()).expect("frames");
                names.extend(found.transforms.into_iter().map(|frame| frame.child_frame_id));
            }
        }
        names.into_iter().collect::<Vec<_>>()
    };
    assert_eq!(frames(&logs[0]), ["body", "source/0"]);
    assert_eq!(frames(&logs[1]), ["body", "reference", "source/0"]);
    let drawn =
        |log: &std::path::Path| Course::of(log).expect("a log").has_line(LogChart::Pointing);
    assert!(!drawn(&logs[0]) && drawn(&logs[1]));
    let (columns, _) = Columns::read(&logs[1], 0, &[]).expect("a log");
    let names: Vec<String> =
        columns.into_all().into_iter().map(|(name, _)| name.into_owned()).collect();
    for name in ["axis_error_rad", "roll_rad", "pitch_rad", "yaw_rad", "relative_rate"] {
        assert!(names.iter().any(|column| column == name), "{name}: {names:?}");
    }
    let (columns, _) = Columns::read(&logs[0], 0, &[]).expect("a log");
    assert!(columns.into_all().iter().all(|(name, _)| name != "roll_rad"));
}

/// The plan says what noise there is, drops what no law reads, and names the balance with it.
#[test]
fn the_plan_sees_noise() {
    let told = |name: &str, noise: Value| {
        let mut scenario = shipped(name);
        scenario["scene"]["control"]["noise"] = noise;
        let plan = advise::plan(&accepted(&scenario)).expect("a plan");
        let line = plan.potential.iter().find(|term| term.pointer == "/scene/control/noise");
        let line = line.expect("a line");
        (line.kept, line.why.clone(), plan.momentum_balance)
    };
    let (kept, why, balance) = told("slew", json!({ "rate_rad_s": 1e-4 }));
    assert!(kept && why == "changes what the laws read" && balance.is_none(), "{why} {balance:?}");
    let (kept, why, balance) = told("slew", json!({ "torque_n_m": 1e-4 }));
    assert!(kept && why.starts_with("a torque that is held"), "{why}");
    assert!(balance.expect("a torque acts").contains("less the impulse of the torques"));
    let (kept, why, _) = told("detumble", json!({ "attitude_rad": 1e-4, "rate_rad_s": 1e-4 }));
    assert!(!kept && why.starts_with("no law reads"), "{why}");
}

/// An accuracy is reached on the controlled scene: trial runs have the same control.
#[test]
fn an_accuracy_is_that_of_the_controlled_scene() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = shipped("slew");
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("until");
    fields.remove("step_s");
    fields.remove("method");
    fields.remove("log");
    fields.insert("duration_s".to_owned(), json!(40));
    fields.insert("accuracy".to_owned(), json!({ "error": 1e-8 }));
    let found = run(&scenario, &place.path().join("a.mcap"), &Control::default()).expect("a log");
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("accuracy");
    fields.insert("step_s".to_owned(), json!(0.01));
    fields.insert("method".to_owned(), json!({ "name": "rkmk", "tableau": "rk8" }));
    let exact = run(&scenario, &place.path().join("b.mcap"), &Control::default()).expect("a log");
    let rows = |summary: &Summary| summary.last.attitude.clone().expect("computed").concat();
    let (found, exact) = (rows(&found), rows(&exact));
    let error = found.iter().zip(&exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(error < 1e-8, "{error:e}");
}

/// What is not as it must be is named, with what was given and what is allowed.
#[test]
fn bad_control_is_refused_at_its_field() {
    for (name, pointer, value, at, words) in [
        ("slew", "/scene/control/every_s", json!(0), "/scene/control/every_s", "0.0 given"),
        (
            "slew",
            "/scene/control/every_s",
            json!(1e-9),
            "/scene/control/every_s",
            "samples in a step",
        ),
        ("slew", "/scene/control/delay_s", json!(0.2), "/scene/control/delay_s", "from 0 to"),
        ("slew", "/scene/control/laws", json!([]), "/scene/control/laws", "1 to 10"),
        ("slew", "/scene/control/target", Value::Null, "/scene/control/target", ""),
        (
            "slew",
            "/scene/control/laws/0",
            json!({ "b_dot": { "gain_a_m2_s_per_t": 1 } }),
            "/scene/control/laws/0/b_dot",
            "magnetorquers alone",
        ),
        (
            "slew",
            "/scene/control/through/wheels/axes",
            json!([[1, 0, 0], [0, 1, 0], [1, 1, 0], [1, -1, 0]]),
            "/scene/control/through/wheels/axes",
            "must span space",
        ),
        (
            "slew",
            "/scene/control/through/wheels/moments_kg_m2",
            json!([5, 5, 5, 5]),
            "/scene/control/through/wheels/moments_kg_m2",
            "includes its wheels",
        ),
        (
            "slew",
            "/scene/control/through/wheels/moments_kg_m2",
            json!([1]),
            "/scene/control/through/wheels/moments_kg_m2",
            "1 numbers given for 4",
        ),
        (
            "slew",
            "/scene/control/through/wheels/limit_n_m",
            json!(-1),
            "/scene/control/through/wheels/limit_n_m",
            "above 0",
        ),
        (
            "slew",
            "/scene/control/noise",
            json!({ "seed": 1 }),
            "/scene/control/noise",
            "no deviation above 0",
        ),
        (
            "slew",
            "/scene/control/noise",
            json!({ "torque_n_m": -1 }),
            "/scene/control/noise/torque_n_m",
            "at least 0",
        ),
        (
            "slew",
            "/scene/control/noise",
            json!({ "attitude_rad": 4 }),
            "/scene/control/noise/attitude_rad",
            "from 0 to pi",
        ),
        (
            "slew",
            "/scene/control/noise",
            json!({ "stream": 1_u64 << 60, "rate_rad_s": 1 }),
            "/scene/control/noise/stream",
            "at most 9007199254740991",
        ),
        ("detumble", "/pointing", json!({}), "/pointing", "needs `frame` or `orbit_frame`"),
        ("slew", "/pointing", json!({ "axis": [0, 0, 0] }), "/pointing/axis", ""),
        ("slew", "/pointing", json!({ "orbit_frame": 0 }), "/pointing/orbit_frame", "(0 given"),
        (
            "slew",
            "/pointing",
            json!({ "frame": { "turning": { "from": [1, 0, 0], "towards": [2, 0, 0], "rate_rad_s": 1 } } }),
            "/pointing/frame/turning/towards",
            "parallel",
        ),
        (
            "slew",
            "/pointing",
            json!({ "orbit_frame": 0, "frame": { "attitude": { "quaternion": [1, 0, 0, 0] } } }),
            "/pointing/orbit_frame",
            "one of the two",
        ),
        (
            "slew",
            "/log",
            json!({ "channels": ["/pointing"] }),
            "/log/channels/0",
            "with `pointing`",
        ),
        ("slew", "/until/0", json!({ "for_s": 1 }), "/until/0", "0 conditions given"),
        (
            "slew",
            "/until/0",
            json!({ "energy_error_above_j": 1, "rate_below_rad_s": 1 }),
            "/until/0",
            "2 conditions given",
        ),
        (
            "detumble",
            "/until",
            json!([{ "pointing_error_below_rad": 0.1 }]),
            "/until/0/pointing_error_below_rad",
            "needs a target",
        ),
        (
            "slew",
            "/until/0",
            json!({ "rate_below_rad_s": 1, "for_s": 1, "exact": true }),
            "/until/0/exact",
            "leave out",
        ),
        (
            "flyby",
            "/until",
            json!([{ "rate_below_rad_s": 1, "exact": true }]),
            "/until/0/exact",
            "steps that adapt",
        ),
        ("detumble", "/scene/field", Value::Null, "/scene", ""),
        (
            "detumble",
            "/scene/field/dipole/orbit/eccentricity",
            json!(1),
            "/scene/field/dipole/orbit/eccentricity",
            "from 0 to 0.99",
        ),
        (
            "detumble",
            "/scene/field/dipole/orbit/from",
            json!([1, 0, 0]),
            "/scene/field/dipole/orbit",
            "",
        ),
        ("slew", "/log", json!({ "channels": ["/pace"] }), "/log/channels/0", "steps that adapt"),
        ("dipole", "/log", json!({ "channels": ["/control"] }), "/log/channels/0", "with control"),
        ("slew", "/method/name", json!("lgvi"), "/method", "lgvi"),
    ] {
        let mut scenario = shipped(name);
        let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
        let parent = scenario.pointer_mut(parent).expect("it is there");
        match parent {
            Value::Object(fields) if value.is_null() => {
                fields.remove(key);
            }
            Value::Object(fields) => {
                fields.insert(key.to_owned(), value.clone());
            }
            Value::Array(items) => items[key.parse::<usize>().expect("a number")] = value.clone(),
            _ => unreachable!("a place for a value"),
        }
        let text = scenario.to_string();
        let error = match Scenario::from_json(text.as_bytes()) {
            Err(error) => error,
            Ok(scenario) => advise::plan(&scenario).expect_err("refused by the plan"),
        };
        assert!(error.pointer.starts_with(at), "{pointer}: {error}");
        assert!(error.message.contains(words), "{pointer}: {error}");
    }
}

/// Wheels turn the faster the longer a command acts: the angular velocity is that of the moment wherever it is shown, between
/// samples of the control and with a delay, next to differences of the attitude.
#[test]
fn angular_velocities_are_those_of_the_moment() {
    let place = tempfile::tempdir().expect("a directory");
    for delay_s in [0.0, 0.05] {
        let mut scenario = json!({
            "name": "delay", "step_s": 0.005, "duration_s": 1.0, "log": {"every": 1},
            "scene": {
                "inertia": {"principal": [4.2, 3.6, 1.5]},
                "control": {
                    "every_s": 0.1, "delay_s": delay_s,
                    "target": {"attitude": {"axis_angle": {"axis": [1, 2, -1], "angle_deg": 120}}},
                    "laws": [{"attitude": {"gain_n_m": 0.08, "rate_gain_n_m_s": 0.8}}],
                    "through": {"wheels": {"axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "moments_kg_m2": [0.002, 0.002, 0.002]}}
                },
                "initial": {"angular_velocity": {"body": [0.01, -0.02, 0.015]}}
            }
        });
        let log = place.path().join(format!("{delay_s}.mcap"));
        run(&scenario, &log, &Control::default()).expect("a log");
        let mut seen = Vec::new();
        read_samples(&log, |_, message| {
            if let Message::State(state) = message {
                seen.push((state.attitude.clone(), state.angular_velocity.clone()));
            }
        })
        .expect("readable");
        assert_eq!(seen.len(), 201);
        let matrix = |rows: &[f64]| nalgebra::Matrix3::from_row_slice(rows);
        for three in seen.windows(3) {
            // log(g-^T g+) / 2 h is off by h^2 / 6 of the second rate, and by h of a jump of the first.
            let turn = matrix(&three[0].0).transpose() * matrix(&three[2].0);
            let differences = [
                turn[(2, 1)] - turn[(1, 2)],
                turn[(0, 2)] - turn[(2, 0)],
                turn[(1, 0)] - turn[(0, 1)],
            ];
            for (shown, difference) in three[1].1.iter().zip(differences) {
                let off = (shown - difference / (4.0 * 0.005)).abs();
                assert!(off < 6e-5, "delay {delay_s}: {off:e}");
            }
        }
        let size = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>().sqrt();
        let largest = seen.iter().map(|(_, velocity)| size(velocity)).fold(0.0, f64::max);
        // In the score of a sweep ..
        let sweep = json!({
            "scenario": scenario,
            "vary": [{"pointer": "/scene/initial/angular_velocity/body/0", "values": {"list": [0.01]}}],
            "scores": [{"name": "speed", "measure": {"largest": "angular_speed"}}]
        });
        fs::write(place.path().join("sweep.json"), sweep.to_string()).expect("written");
        let swept = crate::cli::vpd(place.path(), &["sweep", "sweep.json", "--force"]);
        assert_eq!(swept.status.code(), Some(0));
        let table = fs::read_to_string(place.path().join("sweep.csv")).expect("a table");
        let speed: f64 =
            table.trim_end().rsplit(',').next().expect("a cell").parse().expect("a number");
        assert!((speed - largest).abs() < 1e-12, "{speed} for {largest}");
        // .. and at the end of a member.
        scenario["ensemble"] = json!({"members": 2, "seed": 1, "attitude_spread_rad": 0.01});
        let log = place.path().join(format!("{delay_s} members.mcap"));
        run(&scenario, &log, &Control::default()).expect("a log");
        let members = contents(&log).members;
        let last = members[0].last.as_ref().expect("a state");
        for (member, run) in last.angular_velocity.iter().zip(&seen[200].1) {
            assert!((member - run).abs() < 1e-12, "{member} for {run}");
        }
    }
}

/// A run of many samples is planned, also where a step holds many; its estimate counts each sample once. Orbits that contradict each
/// other are warned of.
#[test]
fn long_runs_under_control_are_planned() {
    let mut slew = shipped("slew");
    slew.as_object_mut().expect("an object").remove("until");
    for step_s in [0.1, 20.0] {
        slew["step_s"] = json!(step_s);
        slew["duration_s"] = json!(12_000);
        let plan = advise::plan(&accepted(&slew)).expect("120,000 samples of the control");
        let steps_s = 1e-9 * plan.step_ns * plan.steps as f64;
        assert!(plan.run_s < 2.0 * steps_s + 2.0, "{step_s}: {} of {steps_s}", plan.run_s);
    }
    // Steps end at the samples: a step that holds 200 is these, and ends at the last of them.
    slew["duration_s"] = json!(100);
    let place = tempfile::tempdir().expect("a directory");
    let ends = [0.1, 5.0, 20.0, 50.0].map(|step_s| {
        slew["step_s"] = json!(step_s);
        let log = place.path().join(format!("{step_s}.mcap"));
        let summary = run(&slew, &log, &Control::default()).expect("a log");
        assert_eq!(summary.control.expect("logged").samples, summary.steps + 1, "{step_s}");
        let last = &summary.last.body_momentum;
        [0, 1, 2].map(|axis| last[axis].as_f64().expect("a number"))
    });
    for end in &ends[1..] {
        let apart = (0..3).map(|axis| (end[axis] - ends[0][axis]).abs()).fold(0.0, f64::max);
        assert!(apart < 1e-15, "{ends:?}");
    }
    let orbit = |mean_motion: f64| json!({ "from": [0, 0, 1], "towards": [0, -1, 0], "mean_motion_rad_s": mean_motion });
    slew["scene"]["driven"] = json!([{
        "term": { "kind": "gravity_gradient", "direction": [0, 0, 1] },
        "path": { "orbit": { "towards": [0, -1, 0], "mean_motion_rad_s": 1.1e-3 } },
    }]);
    for (mean_motion, warned) in [(1.1e-3, false), (1.105e-3, false), (6.3e-2, true)] {
        slew["scene"]["control"]["target"] = json!({ "orbit": orbit(mean_motion) });
        let plan = advise::plan(&accepted(&slew)).expect("a plan");
        let found =
            plan.warnings.iter().any(|warning| warning.contains("one body is on one orbit"));
        assert_eq!(found, warned, "{mean_motion}: {:?}", plan.warnings);
    }
}
