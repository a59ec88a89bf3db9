//! An interrupted run is resumed, and its log does not show it.

use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::thread;

use serde_json::{Value, json};
use vpd::advise;
use vpd::log::inspect::inspect;
use vpd::log::part_path;
use vpd::log::resume::last_checkpoint;
use vpd::run::{Control, JobContext, Outcome, RunError, Summary, execute};
use vpd::scenario::Scenario;

/// Returns the dipole with a method that can run it.
fn dipole(method: &Value) -> Value {
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    scenario["method"] = method.clone();
    scenario["steps"] = json!(6000);
    scenario["log"] = json!({ "every": 1 });
    scenario
}

fn shipped(text: &str, steps: u64) -> Value {
    let mut scenario: Value = serde_json::from_str(text).expect("shipped");
    if let Some(fields) = scenario.as_object_mut() {
        fields.remove("duration_s");
        fields.remove("expect");
    }
    scenario["steps"] = json!(steps);
    scenario["log"] = json!({ "every": 1 });
    scenario
}

fn checked(scenario: &Value) -> Scenario {
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario")
}

fn run(scenario: &Scenario, log: &Path) -> Summary {
    execute(
        &advise::plan(scenario).expect("a plan"),
        &JobContext { log, control: &Control::default() },
    )
    .expect("a log")
}

/// Runs until about `step`, or to the end if that comes first.
fn run_until(scenario: &Scenario, log: &Path, step: u64) -> (Result<Summary, RunError>, Control) {
    let control = Control::default();
    let result = thread::scope(|scope| {
        let worker = scope.spawn(|| {
            execute(
                &advise::plan(scenario).expect("a plan"),
                &JobContext { log, control: &control },
            )
        });
        while control.steps_done.load(Ordering::Relaxed) < step && !worker.is_finished() {
            thread::yield_now();
        }
        control.interrupted.store(true, Ordering::Relaxed);
        worker.join().expect("no panic")
    });
    (result, control)
}

/// Samples far apart have a checkpoint at the start, which changes nothing: a run is that of the trial which chose its step.
#[test]
fn a_checkpoint_at_the_start_changes_no_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("run.mcap");
    for name in ["vpd", "quaternion_gauss", "vrkmk", "splitting"] {
        let method = match name {
            "splitting" => json!({ "name": name, "order": 4 }),
            _ => json!({ "name": name, "tableau": "gauss4" }),
        };
        let mut scenario = dipole(&method);
        scenario["scene"]["initial"]["attitude"] =
            json!({ "axis_angle": { "axis": [-0.693, -0.2784, -0.665], "angle_rad": 1.082 } });
        scenario["steps"] = json!(50);
        let ends = [50, 1_000_000].map(|every: u64| {
            scenario["log"] = json!({ "every": every });
            let summary = run(&checked(&scenario), &log);
            serde_json::to_value(&summary).expect("JSON")["final"].clone()
        });
        assert_eq!(ends[0], ends[1], "{name}");
    }
}

/// A kill leaves a beginning of the whole log: whatever beginning it is, the run that resumes it
/// ends with the whole.
fn resume_job(scenario: &Value, cuts: &[f64]) {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    let scenario = checked(scenario);
    let reference = run(&scenario, &whole);
    let bytes = fs::read(&whole).expect("a log");
    let mut furthest = 0;
    for part in cuts {
        let length = (part * bytes.len() as f64) as usize;
        fs::write(part_path(&cut), &bytes[..length]).expect("written");
        let step = last_checkpoint(&cut).expect("readable").unwrap_or(0);
        let summary = run(&scenario, &cut);
        assert_eq!(summary.resumed_step, step, "cut at {part}");
        assert!(fs::read(&cut).expect("a log") == bytes, "cut at {part}, resumed at {step}");
        let same = Summary {
            log: reference.log.clone(),
            wall_s: reference.wall_s,
            ns_per_step: reference.ns_per_step,
            resumed_step: 0,
            ..summary
        };
        assert_eq!(same, reference);
        furthest = furthest.max(step);
    }
    assert!(furthest > reference.steps / 4, "the furthest checkpoint was at {furthest}");
}

#[test]
fn every_method_goes_on_to_the_same_bytes() {
    let methods = [
        json!({ "name": "vpd", "tableau": "gauss2" }),
        json!({ "name": "vpd", "tableau": "gauss4" }),
        json!({ "name": "vpd_lagrangian", "tableau": "gauss2" }),
        json!({ "name": "vrkmk", "tableau": "gauss2" }),
        json!({ "name": "vrkmk_projected", "tableau": "rk3" }),
        json!({ "name": "rkmk" }),
        json!({ "name": "rk" }),
        json!({ "name": "rk_projected" }),
        json!({ "name": "splitting" }),
        json!({ "name": "lgvi" }),
        json!({ "name": "quaternion_gauss", "tableau": "gauss2" }),
    ];
    for method in methods {
        println!("{method}");
        resume_job(&dipole(&method), &[0.4, 0.9]);
    }
}

#[test]
fn derivatives_go_on_to_the_same_bytes() {
    let mut scenario = dipole(&json!({ "name": "vpd", "tableau": "gauss3" }));
    let parameters = ["/scene/inertia/principal/2", "/scene/potential/1/strength"];
    scenario["derivatives"] = json!({
        "state": true,
        "parameters": parameters,
        "covariance": { "attitude_spread_rad": 0.01, "parameter_spreads": [0.1, 0] },
    });
    resume_job(&scenario, &[0.4, 0.9]);
}

#[test]
fn a_log_with_an_overview_goes_on_to_the_same_bytes() {
    let mut long = dipole(&json!({ "name": "vpd", "tableau": "gauss2" }));
    long["steps"] = json!(70_000);
    resume_job(&long, &[0.6]);
}

#[test]
fn every_dimension_and_compression_goes_on_to_the_same_bytes() {
    resume_job(&shipped(include_str!("../../scenarios/so4-free.json"), 4000), &[0.9]);
    resume_job(&shipped(include_str!("../../scenarios/so5-spring.json"), 3000), &[0.9]);
    for compression in ["lz4", "none"] {
        let mut scenario = dipole(&json!({ "name": "vpd" }));
        scenario["log"]["compression"] = json!(compression);
        resume_job(&scenario, &[0.01, 0.3, 0.6, 0.9, 0.995, 1.0]);
    }
    // The steps before are no part of a checkpoint.
    let mut free = shipped(include_str!("../../scenarios/free-body.json"), 60_000);
    free["method"] = json!({ "name": "vpd_reduced" });
    resume_job(&free, &[0.4, 0.9]);
    // No attitude is carried, no state logged.
    let mut free = shipped(include_str!("../../scenarios/so4-free.json"), 60_000);
    free["log"]["channels"] = json!(["/energy", "/momentum"]);
    resume_job(&free, &[0.9]);
}

/// Time and what was put into the energy are part of a checkpoint.
#[test]
fn driven_scenes_go_on_to_the_same_bytes() {
    let satellite = shipped(include_str!("../../scenarios/satellite-elliptic.json"), 4000);
    for name in ["vpd", "vpd_lagrangian", "vrkmk", "rkmk", "rk_projected"] {
        let mut satellite = satellite.clone();
        satellite["method"] = json!({ "name": name });
        println!("{name}");
        resume_job(&satellite, &[0.4, 0.9]);
    }
    resume_job(&shipped(include_str!("../../scenarios/dual-spin.json"), 3900), &[0.4, 0.9]);
    // A checkpoint keeps no sign of a zero that stands alone; no byte may depend on one.
    let mut zeros = satellite;
    zeros["scene"]["torques"] = json!([
        { "constant": { "body": [-0.0, -0.0, 0.0] } },
        { "table": { "along": { "space": [0, -1, 0] }, "table": { "times_s": [0, 1e9], "values": [-0.0, -0.0] } } },
    ]);
    zeros["scene"]["initial"] = json!({ "angular_velocity": { "body": [-0.0, 0.0011, -0.0] } });
    zeros["method"] = json!({ "name": "vpd" });
    resume_job(&zeros, &[0.4, 0.9]);
}

#[test]
fn several_bodies_go_on_to_the_same_bytes() {
    for method in ["vpd", "rk_projected", "rkmk", "splitting"] {
        println!("{method}");
        let mut tether = shipped(include_str!("../../scenarios/tether.json"), 3000);
        tether["method"] = json!({ "name": method });
        resume_job(&tether, &[0.05, 0.4, 0.9]);
    }
    resume_job(&shipped(include_str!("../../scenarios/chain.json"), 3000), &[0.4, 0.9]);
    resume_job(&shipped(include_str!("../../scenarios/compass-needles.json"), 1500), &[0.4, 0.9]);
}

/// With adaptive steps a checkpoint holds the end of the last of them, next to the sample that was
/// taken aside.
#[test]
fn steps_that_adapt_go_on_to_the_same_bytes() {
    for tableau in ["gauss2", "gauss4", "rk3"] {
        let mut flyby = shipped(include_str!("../../scenarios/flyby.json"), 6000);
        flyby["method"] = json!({ "name": "vpd", "tableau": tableau });
        flyby["step"]["adaptive"]["largest_step_s"] = json!(0.05);
        println!("{tableau}");
        resume_job(&flyby, &[0.2, 0.6, 0.9]);
    }
}

/// The same of several bodies, on their way and where a run waits for a condition.
#[test]
fn several_bodies_in_steps_that_adapt_go_on_to_the_same_bytes() {
    for (tableau, largest_step_s) in [("gauss2", 0.02), ("gauss4", 0.1)] {
        let mut flyby = crate::bodies_run::flyby(json!([]));
        (flyby["step_s"], flyby["duration_s"]) = (json!(0.005), json!(20));
        flyby["method"] = json!({ "name": "vpd", "tableau": tableau });
        flyby["step"] = json!({ "adaptive": { "largest_step_s": largest_step_s } });
        resume_job(&flyby, &[0.2, 0.6, 0.9]);
        let between = json!(["planet", "probe"]);
        flyby["until"] = json!([{ "distance_below_m": { "distance_m": 1e-3, "between": between }, "for_s": 0.1 }]);
        resume_job(&flyby, &[0.6]);
        // Charts have what the log has.
        flyby["log"]["channels"] = json!(["/bodies/*/state"]);
        resume_job(&flyby, &[0.6]);
    }
}

#[test]
fn an_interrupted_run_leaves_what_it_promised() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, parts) = (folder.path().join("whole.mcap"), folder.path().join("parts.mcap"));
    let mut scenario = dipole(&json!({ "name": "vpd" }));
    scenario["steps"] = json!(40_000);
    let scenario = checked(&scenario);
    run(&scenario, &whole);
    let mut resumed = 0;
    for stop in [8_000, 8_100, 20_000] {
        let (result, control) = run_until(&scenario, &parts, stop);
        // If the run was quicker than the interruption there is nothing to see.
        if result.is_ok() {
            break;
        }
        assert!(matches!(result, Err(RunError::Interrupted)), "{result:?}");
        assert!(!parts.exists());
        let found = last_checkpoint(&parts).expect("readable").unwrap_or_default();
        let durable_step = control.durable_step.load(Ordering::Relaxed);
        assert!(durable_step <= found, "{durable_step} was promised, {found} is there");
        assert!(found >= resumed);
        resumed = found;
    }
    assert_eq!(run(&scenario, &parts).outcome, Outcome::Succeeded);
    assert!(fs::read(&whole).expect("a log") == fs::read(&parts).expect("a log"));
}

#[test]
fn a_run_that_fails_or_is_cancelled_after_an_interruption_ends_with_a_finished_log() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("log.mcap");
    let scenario = checked(&dipole(&json!({ "name": "vpd" })));
    run(&scenario, &log);
    fs::rename(&log, part_path(&log)).expect("renamed");
    let control = Control::default();
    control.cancelled.store(true, Ordering::Relaxed);
    let summary = execute(
        &advise::plan(&scenario).expect("a plan"),
        &JobContext { log: &log, control: &control },
    )
    .expect("a log");
    assert_eq!(summary.outcome, Outcome::Cancelled);
    assert!(summary.resumed_step > 0 && summary.steps == summary.resumed_step);
    let found = inspect(&log).expect("readable");
    assert!(found.finished, "{found}");
    assert_eq!(found.samples, summary.samples);
}

#[test]
fn what_another_job_or_a_bad_disk_left_is_not_resumed_runs() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let scenario = checked(&dipole(&json!({ "name": "vpd" })));
    run(&scenario, &at("whole.mcap"));
    let whole = fs::read(at("whole.mcap")).expect("a log");
    let left = whole[..whole.len() * 9 / 10].to_vec();
    let mut other = dipole(&json!({ "name": "vpd" }));
    other["step_s"] = json!(0.005);
    let other = checked(&other);
    run(&other, &at("other.mcap"));

    // The log of another job is begun anew.
    fs::write(part_path(&at("other-again.mcap")), &left).expect("written");
    assert_eq!(run(&other, &at("other-again.mcap")).resumed_step, 0);
    assert!(
        fs::read(at("other-again.mcap")).expect("a log")
            == fs::read(at("other.mcap")).expect("a log")
    );

    // Cut anywhere, or with a bit flipped anywhere: resumed before the damage, or begun anew.
    let seed = 0x5eed_0005_u64;
    println!("seed {seed:#x}");
    let mut random = seed;
    let (mut anew, mut resumed_runs) = (0, 0);
    for k in 0..60 {
        let draw = super::log::next(&mut random) as usize;
        let mut bytes = left.clone();
        if k % 2 == 0 {
            bytes.truncate(draw % left.len());
        } else {
            bytes[draw % left.len()] ^= 1 << ((draw >> 40) % 8);
        }
        fs::write(part_path(&at("log.mcap")), bytes).expect("written");
        let summary = run(&scenario, &at("log.mcap"));
        *if summary.resumed_step == 0 { &mut anew } else { &mut resumed_runs } += 1;
        assert!(fs::read(at("log.mcap")).expect("a log") == whole, "seed {seed:#x}, case {k}");
    }
    println!("{resumed_runs} resumed, {anew} begun anew");
    assert!(anew > 0 && resumed_runs > 0, "{resumed_runs} resumed, {anew} begun anew");
}
