//! Runs of several bodies, from their scenario to their log.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use vpd::advise::{self, Settled};
use vpd::plan::Plan;
use vpd::run::{Control, JobContext, Outcome, Summary, collect, execute};
use vpd::scenario::Scenario;
use vpd::study::Watch;
use vpd::verify;

fn shipped(name: &str) -> Value {
    let text = fs::read_to_string(format!("scenarios/{name}.json")).expect("shipped");
    serde_json::from_str(&text).expect("JSON")
}

fn plan(scenario: &Value) -> Plan {
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario");
    advise::plan(&scenario).expect("a plan")
}

fn run(scenario: &Value, log: &Path) -> Summary {
    let control = Control::default();
    execute(&plan(scenario), &JobContext { log, control: &control }).expect("a log")
}

#[test]
fn a_chain_is_planned_run_logged_and_verified() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("chain.mcap");
    let mut scenario = shipped("chain");
    scenario["duration_s"] = json!(2);
    let planned = plan(&scenario);
    let holds: Vec<&str> = planned.bodies.iter().map(|body| body.hold).collect();
    assert_eq!(holds, ["jointed"; 3]);
    // Gravity and the point it hangs from are along the vertical.
    assert_eq!(planned.free_directions, 2);
    let summary = run(&scenario, &log);
    assert_eq!(summary.outcome, Outcome::Succeeded);
    assert!(summary.unmet.is_empty(), "{:?}", summary.unmet);
    assert_eq!(summary.last.bodies.len(), 3);
    let [upper, middle] = ["upper", "middle"].map(|name| &summary.last.bodies[name]);
    // The joint between them, from both.
    let point = |body: &vpd::run::FinalBody, z: f64| -> Vec<f64> {
        (0..3).map(|i| body.position[i] + body.attitude[i][2] * z).collect()
    };
    for (a, b) in point(upper, -0.25).iter().zip(point(middle, 0.25)) {
        assert!((a - b).abs() < 1e-15, "{a}, {b}");
    }
    let written = serde_json::to_value(&summary).expect("JSON");
    for field in ["attitude", "body_momentum", "position", "linear_momentum"] {
        assert!(written["final"]["bodies"]["lower"][field].is_array(), "{field}");
    }
    let verified = verify::verify(&log).expect("a run again");
    assert!(verified.same, "{verified:?}");
}

/// A service stores what it has settled, and reads it back without the order of a file.
#[test]
fn what_is_settled_is_read_back() {
    for name in ["chain", "tether", "gyroscope-on-a-string", "compass-needles"] {
        let scenario = Scenario::from_json(shipped(name).to_string().as_bytes()).expect("good");
        let settled = Settled::new(&scenario, &Watch::default()).expect("settled");
        let stored = serde_json::to_string(&settled).expect("JSON");
        let read: Settled = serde_json::from_str(&stored).expect("what was written");
        assert_eq!(read, settled, "{name}");
    }
}

/// The samples in memory are those of the log.
#[test]
fn samples_in_memory_end_where_the_log_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut scenario = shipped("tether");
    scenario["duration_s"] = json!(60);
    let logged = run(&scenario, &folder.path().join("tether.mcap"));
    let (kept, columns) = collect(&plan(&scenario), &Control::default()).expect("samples");
    assert_eq!(kept.last, logged.last);
    assert_eq!(columns.len(), usize::try_from(logged.samples).expect("few"));
}

#[test]
fn one_pinned_body_is_the_scene_of_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let alone = {
        let mut top = shipped("heavy-top");
        top["duration_s"] = json!(1);
        top
    };
    let mut pinned = alone.clone();
    let one = &alone["scene"];
    let mut weight = one["potential"][0].clone();
    weight["body"] = json!("top");
    pinned["scene"] = json!({
        "bodies": [{
            "name": "top", "pivot": [0, 0, 0], "inertia": one["inertia"], "initial": one["initial"],
        }],
        "potential": [weight],
    });
    let alone = run(&alone, &folder.path().join("alone.mcap")).last;
    let pinned = run(&pinned, &folder.path().join("pinned.mcap")).last;
    let attitude = alone.attitude.expect("carried");
    let pairs = attitude.iter().flatten().zip(pinned.bodies["top"].attitude.iter().flatten());
    for (a, b) in pairs {
        assert!((a - b).abs() < 1e-11, "{a}, {b}");
    }
}

#[test]
fn a_step_that_cannot_be_made_is_a_result_with_advice_that_works() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("chain.mcap");
    let mut scenario = shipped("chain");
    scenario["step_s"] = json!(0.5);
    scenario["log"] = json!({ "every": 1 });
    let failed = run(&scenario, &log);
    assert_eq!(failed.outcome, Outcome::Failed);
    let diagnosis = failed.diagnosis.expect("a cause");
    let advised = diagnosis.advised_step_s.expect("a step that was tried");
    assert!(diagnosis.advice.contains("step_s"), "{}", diagnosis.advice);
    scenario["step_s"] = json!(advised);
    scenario["duration_s"] = json!(advised * (1.0_f64 / advised).floor());
    assert_eq!(run(&scenario, &folder.path().join("again.mcap")).outcome, Outcome::Succeeded);
}

#[test]
fn a_start_that_has_no_energy_is_refused() {
    let mut pair = shipped("binary-asteroid");
    pair["scene"]["bodies"][1]["initial"]["position"] =
        pair["scene"]["bodies"][0]["initial"]["position"].clone();
    let scenario = Scenario::from_json(pair.to_string().as_bytes()).expect("a good form");
    let refused = advise::plan(&scenario).expect_err("they meet");
    assert_eq!(refused.pointer, "/scene/bodies");
    let mut chain = shipped("chain");
    chain["scene"]["bodies"][1]["initial"] = json!({ "momentum": { "body": [0, 0, 1] } });
    let scenario = Scenario::from_json(chain.to_string().as_bytes()).expect("a good form");
    let refused = advise::plan(&scenario).expect_err("it depends on the others");
    assert_eq!(refused.pointer, "/scene/bodies/1/initial/momentum");
}

/// What is for one body says so.
#[test]
fn studies_and_sweeps_refuse_several_bodies() {
    let chain = Scenario::from_json(shipped("chain").to_string().as_bytes()).expect("good");
    let refused = vpd::study::measure::effort(&chain).expect_err("one body");
    assert_eq!(refused.pointer, "/scene/bodies");
    let refused = vpd::run::Simulation::new(&chain).map(drop).expect_err("one body");
    assert_eq!(refused.pointer, "/scene/bodies");
}
