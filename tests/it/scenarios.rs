//! Every shipped scenario is a test: it runs as a user runs it and meets its own `expect` block.

use std::ops::ControlFlow;
use std::path::Path;

use serde_json::{Value, json};
use vpd::advise;
use vpd::chart::draw_log;
use vpd::log::course::LogChart;
use vpd::log::reader::{Item, Message, read_samples};
use vpd::run::{Control, JobContext, Outcome, Summary, execute};
use vpd::scenario::{
    Accuracy, DrivenTerm, Ensemble, GravityGradient, Harmonic, Inertia, Orbit, PotentialTerm,
    SHIPPED, Scenario, Scene, Spring, Table, Viscous,
};

pub(crate) fn run(text: &str, log: &Path) -> Summary {
    let scenario = Scenario::from_json(text.as_bytes()).expect("a good scenario");
    let control = Control::default();
    let context = JobContext { log, control: &control };
    execute(&advise::plan(&scenario).expect("a plan"), &context).expect("the log can be written")
}

#[test]
fn shipped_scenarios_keep_to_what_they_expect() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    for (name, text) in SHIPPED {
        let scenario = Scenario::from_json(text.as_bytes()).expect("shipped scenarios are good");
        assert_eq!(scenario.name(), *name);
        assert!(scenario.expect.is_some(), "{name} expects nothing");
        let summary = run(text, &directory.path().join(format!("{name}.mcap")));
        assert_eq!(summary.outcome, Outcome::Succeeded, "{name}: {:?}", summary.diagnosis);
        assert!(summary.unmet.is_empty(), "{name}: {:?}", summary.unmet);
    }
}

/// On a circular orbit the balance of energy and the Jacobi integral are one, but for the quadrature of the work.
#[test]
fn a_circular_orbit_has_a_jacobi_integral() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let errors = |text: &str| {
        let log = directory.path().join("satellite.mcap");
        let _ = std::fs::remove_file(&log);
        run(text, &log);
        let mut errors = Vec::new();
        read_samples(&log, |_, message| {
            if let Message::Energy(energy) = message {
                errors.push((energy.error, energy.jacobi_error));
            }
        })
        .expect("a log");
        errors
    };
    let circular = errors(include_str!("../../scenarios/satellite.json"));
    assert!(circular.len() > 1000);
    let (mut jacobi, mut apart) = (0.0_f64, 0.0_f64);
    for (error, found) in circular {
        let found = found.expect("a circular orbit");
        (jacobi, apart) = (jacobi.max(found.abs()), apart.max((found - error).abs()));
    }
    println!("Jacobi {jacobi:e}, next to the balance {apart:e}");
    assert!(jacobi > 0.0 && jacobi <= 1e-10 && apart <= 1e-10, "{jacobi:e}, {apart:e}");
    let elliptic = errors(include_str!("../../scenarios/satellite-elliptic.json"));
    assert!(elliptic.iter().all(|(_, jacobi)| jacobi.is_none()));
}

/// The log of a scene with torques holds the energy and momentum put in: the errors are the
/// remainder, and the job record says so.
#[test]
fn what_is_put_in_is_logged() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("dual-spin.mcap");
    let summary = run(include_str!("../../scenarios/dual-spin.json"), &log);
    let (mut energies, mut momenta) = (Vec::new(), Vec::new());
    read_samples(&log, |_, message| match message {
        Message::Energy(energy) => energies.push(energy),
        Message::Momentum(momentum) => momenta.push(momentum),
        _ => {}
    })
    .expect("a log");
    assert!(energies.len() > 100 && momenta.len() == energies.len());
    let first = energies[0].total;
    let (mut lost, mut pushed) = (0.0_f64, 0.0_f64);
    for (energy, momentum) in energies.iter().zip(&momenta) {
        let work = energy.work.expect("a damper");
        assert!((energy.total - first - work - energy.error).abs() <= 1e-14);
        lost = lost.max(-work);
        assert_eq!(momentum.impulse.len(), 3);
        pushed = pushed.max(momentum.impulse.iter().map(|x| x * x).sum::<f64>().sqrt());
        assert!(momentum.drift.expect("nothing else acts") <= 1e-11, "{momentum:?}");
    }
    println!("the damper took {lost} J, turned the momentum by {pushed} N m s");
    assert!(lost > 0.1 && pushed > 1.0, "{lost}, {pushed}");
    assert!(summary.momentum.expect("logged").max_drift <= 1e-11);
    // The energy itself changes, and the summary says how far.
    let (seen, totals) = (summary.energy.expect("logged"), || energies.iter().map(|e| e.total));
    assert_eq!(
        [seen.least, seen.largest, seen.last],
        [totals().reduce(f64::min), totals().reduce(f64::max), totals().next_back()]
    );
    assert!(seen.largest.expect("seen") - seen.least.expect("seen") > 0.1);
    let found = vpd::log::inspect::inspect(&log).expect("a log");
    let job = found.job.expect("the record");
    assert!(job["energy_balance"].contains("work") && job["momentum_balance"].contains("impulse"));
    // The log of a scene without torques does not mention it.
    let still = directory.path().join("heavy-top.mcap");
    run(include_str!("../../scenarios/heavy-top.json"), &still);
    let found = vpd::log::inspect::inspect(&still).expect("a log");
    assert!(!found.job.expect("the record").contains_key("energy_balance"));
    read_samples(&still, |_, message| match message {
        Message::Energy(energy) => assert_eq!(energy.work, None),
        Message::Momentum(momentum) => assert!(momentum.impulse.is_empty()),
        _ => {}
    })
    .expect("a log");
}

#[test]
fn an_expectation_that_is_not_met_is_said() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let text = include_str!("../../scenarios/heavy-top.json").replace("1e-9", "1e-15");
    let summary = run(&text, &directory.path().join("top.mcap"));
    assert_eq!(summary.unmet.len(), 1, "{:?}", summary.unmet);
    assert!(summary.unmet[0].starts_with("energy_error_max"), "{:?}", summary.unmet);
}

#[test]
fn every_shipped_file_is_listed_and_the_schema_is_current() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
    let mut found: Vec<String> = std::fs::read_dir(&folder)
        .expect("the folder of scenarios")
        .map(|entry| entry.expect("readable").file_name().into_string().expect("a plain name"))
        .filter_map(|name| name.strip_suffix(".json").map(str::to_owned))
        .filter(|name| name != "scenario.schema")
        .collect();
    found.sort();
    let listed: Vec<&str> = SHIPPED.iter().map(|(name, _)| *name).collect();
    assert_eq!(found, listed);
    let kept =
        std::fs::read_to_string(folder.join("scenario.schema.json")).expect("the schema is kept");
    let kept: serde_json::Value = serde_json::from_str(&kept).expect("JSON");
    assert!(
        kept == vpd::scenario::schema(),
        "write it anew: vpd schema > scenarios/scenario.schema.json"
    );
}

#[test]
fn canonical_text_reads_back_to_the_same_scenario() {
    for (name, text) in SHIPPED {
        let scenario = Scenario::from_json(text.as_bytes()).expect("shipped scenarios are good");
        let again = Scenario::from_json(&scenario.to_json()).expect("canonical text is good");
        assert_eq!(scenario, again, "{name}");
    }
}

#[test]
fn constant_terms_are_dropped_and_their_energy_kept() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let scene = |potential: &str| {
        format!(
            r#"{{"name":"constant","scene":{{"inertia":{{"principal":[3,2,1]}},"potential":[{potential}],
            "initial":{{"momentum":{{"body":[0.1,0.2,0.3]}}}}}},"step_s":0.1,"steps":10}}"#
        )
    };
    let constant = r#"{"kind":"point_source","strength":2,"body_point":[0,0,1],"position":[0,0,0]},
        {"kind":"gravity_gradient","strength":4,"direction":[0,0,1],"matrix":[[0.5,0,0],[0,0.5,0],[0,0,0.5]]},
        {"kind":"uniform","weight":0,"body_point":[0,0,1],"direction":[0,0,1]}"#;
    let with = run(&scene(constant), &directory.path().join("with.mcap"));
    let without = run(&scene(""), &directory.path().join("without.mcap"));
    let energy = |summary: &Summary| summary.energy.expect("logged").initial;
    // The expected energy: 2 / 1 + 4 / 2 * 0.5
    assert!((energy(&with) - energy(&without) - 3.0).abs() < 1e-15);
    assert_eq!(with.last, without.last);
}

#[test]
fn what_nobody_asked_for_is_not_computed() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let text = include_str!("../../scenarios/heavy-top.json")
        .replace(r#""log": { "every": 10 }"#, r#""log": { "every": 10, "channels": ["/state"] }"#);
    let path = directory.path().join("top.mcap");
    let summary = run(&text, &path);
    assert_eq!((summary.energy, summary.orthogonality, summary.momentum), (None, None, None));
    let inspection = vpd::log::inspect::inspect(&path).expect("a good log");
    let topics: Vec<&str> = inspection.topics.iter().map(|topic| topic.topic.as_str()).collect();
    assert_eq!(topics, ["/state"]);
}

#[test]
fn a_log_carries_its_charts_as_they_are_drawn_from_it() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("top.mcap");
    run(include_str!("../../scenarios/heavy-top.json"), &path);
    let mut attached = Vec::new();
    vpd::log::reader::read(&path, |item| {
        if let Item::Attachment { name, data } = item {
            attached.push((name.to_owned(), data.to_vec()));
        }
        ControlFlow::Continue(())
    })
    .expect("a good log");
    let drawn = [LogChart::Energy, LogChart::Orthogonality].map(|which| {
        (which.file().to_owned(), draw_log(&path, which).expect("a chart").into_bytes())
    });
    assert_eq!(attached[0].0, "scenario.json");
    assert!(attached[1..] == drawn, "the charts in the log are not those drawn from it");
    // Less than the schemas of the channels.
    assert!(drawn.iter().all(|(_, svg)| svg.len() < 40_000));
}

#[test]
fn a_failed_run_keeps_its_samples_and_says_why() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let text = include_str!("../../scenarios/dipole.json")
        .replace("\"step_s\": 0.01", "\"step_s\": 0.5")
        .replace("\"every\": 10", "\"every\": 1");
    let path = directory.path().join("dipole.mcap");
    let summary = run(&text, &path);
    let diagnosis = summary.diagnosis.expect("half a second is too long a step");
    assert_eq!(summary.outcome, Outcome::Failed);
    assert_eq!(diagnosis.step, summary.steps + 1);
    assert_eq!(summary.samples, summary.steps + 1);
    let inspection = vpd::log::inspect::inspect(&path).expect("a good log");
    assert!(inspection.finished);
    assert_eq!(inspection.samples, summary.samples);
    let outcome = inspection.outcome.expect("the log says how it ended");
    assert_eq!(outcome["code"], diagnosis.code);
    // The advice works.
    let advised = diagnosis.advised_step_s.expect("a smaller step helps");
    let text = text.replace("\"step_s\": 0.5", &format!("\"step_s\": {advised}"));
    let text = text.replace("\"steps\": 100000", "\"steps\": 2000");
    let again = run(&text, &path);
    assert_eq!(again.outcome, Outcome::Succeeded, "{advised}: {:?}", again.diagnosis);
}

#[test]
fn the_same_scenario_gives_the_same_bytes() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    for (name, text) in SHIPPED {
        let paths = ["a.mcap", "b.mcap"].map(|file| directory.path().join(file));
        let [first, second] = paths.map(|path| {
            run(text, &path);
            std::fs::read(&path).expect("a log")
        });
        assert!(first == second, "{name}");
    }
}

/// Inertia that no body can have is computed with, and a warning is shown everywhere.
#[test]
fn inertia_that_no_body_has_is_warned_of() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let warned = |inertia: &str| {
        let text =
            format!(r#"{{"name":"a","scene":{{"inertia":{inertia}}},"step_s":0.1,"steps":10}}"#);
        let path = directory.path().join("log.mcap");
        run(&text, &path);
        let mut said = Vec::new();
        vpd::log::reader::read(&path, |item| {
            if let Item::Message { topic: "/log", data, .. } = item {
                said.push(String::from_utf8_lossy(data).into_owned());
            }
            ControlFlow::Continue(())
        })
        .expect("a good log");
        said.iter().any(|text| text.contains("no rigid body has this inertia"))
    };
    assert!(warned(r#"{"principal":[1,2,4]}"#));
    assert!(warned(r#"{"second_moments":[1,2,3,-0.5]}"#));
    assert!(!warned(r#"{"principal":[1,2,3]}"#));
    assert!(!warned(r#"{"principal":[1.01,1,0.01]}"#));
    assert!(!warned(r#"{"second_moments":[0,1,2,3]}"#));
}

/// The largest n: every method of any n makes the same motion there, on the group.
#[test]
fn thirty_two_dimensions_are_a_scene_like_any() {
    const N: usize = 32;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let vector =
        |a: f64, b: f64| -> Vec<f64> { (0..N).map(|i| a + b * (i as f64 * 1.7).sin()).collect() };
    let entry = |i: usize, j: usize| 0.3 * (j as f64 - i as f64) / (1 + i + j) as f64;
    let momentum: Vec<Vec<f64>> = (0..N).map(|i| (0..N).map(|j| entry(i, j)).collect()).collect();
    let end = |name: &str, tableau: &str| {
        let scenario = serde_json::json!({
            "name": "large",
            "scene": {
                "inertia": { "second_moments": vector(2.0, 0.5) },
                "potential": [{"kind": "spring", "stiffness": 0.8, "rest_length": 0.4,
                               "body_point": vector(0.1, 0.6), "position": vector(1.0, -0.4)}],
                "initial": { "momentum": { "body": momentum } },
            },
            "method": { "name": name, "tableau": tableau },
            "step_s": 0.01,
            "steps": 4,
        });
        let log = directory.path().join(format!("{name}-{tableau}.mcap"));
        let summary = run(&scenario.to_string(), &log);
        assert_eq!(summary.outcome, Outcome::Succeeded, "{name}: {:?}", summary.diagnosis);
        let mut last = Vec::new();
        read_samples(&log, |_, message| {
            if let Message::State(state) = message {
                last = state.attitude;
            }
        })
        .expect("a log");
        assert_eq!(last.len(), N * N);
        last
    };
    let apart = |a: &[f64], b: &[f64]| {
        a.iter().zip(b).fold(0.0_f64, |largest, (a, b)| largest.max((a - b).abs()))
    };
    let reference = end("vpd", "gauss8");
    let identity = |e: usize| if e.is_multiple_of(N + 1) { 1.0 } else { 0.0 };
    let turned = reference.iter().enumerate().map(|(e, x)| (x - identity(e)).abs());
    assert!(turned.fold(0.0, f64::max) > 1e-3, "it does not move");
    for (name, tableau, bound) in [
        ("vpd", "gauss2", 1e-9),
        ("vpd", "rk3", 1e-7),
        ("vrkmk", "gauss2", 1e-9),
        ("rkmk", "rk8", 1e-13),
        ("rk_projected", "rk8", 1e-13),
    ] {
        let found = apart(&reference, &end(name, tableau));
        assert!(found <= bound, "{name} {tableau}: {found:e}");
    }
}

/// A scenario made in Rust from the required fields is the one made from JSON, with the same
/// defaults.
#[test]
fn what_is_left_away_in_rust_is_what_json_has() {
    fn same<T: serde::de::DeserializeOwned + PartialEq + std::fmt::Debug>(made: T, json: Value) {
        assert_eq!(made, serde_json::from_value(json).expect("all that is needed"));
    }
    let (point, place) = (|| vec![0.0, 0.0, 0.1], || vec![0.0, 2.0, 0.0]);
    let spring = || Spring::of(4.0, point(), place());
    let written = json!({ "stiffness": 4, "body_point": point(), "position": place() });
    same(spring(), written.clone());
    same(GravityGradient::of(0.3, place()), json!({ "strength": 0.3, "direction": place() }));
    let mut term = written;
    term["kind"] = json!("spring");
    let inertia = || Inertia::Principal([1.0, 2.0, 3.0]);
    let scene = json!({ "inertia": { "principal": [1, 2, 3] } });
    same(Scene::free(inertia()), scene.clone());
    let mut driven = scene.clone();
    driven["driven"] = json!([{ "term": term }]);
    let read = json!({ "name": "s", "scene": driven, "step_s": 0.01, "steps": 10 });
    let read = Scenario::from_json(read.to_string().as_bytes()).expect("good");
    assert_eq!(read.scene.driven, [DrivenTerm::of(PotentialTerm::Spring(spring()))]);
    same(Orbit::of(place(), 0.1), json!({ "towards": place(), "mean_motion_rad_s": 0.1 }));
    same(Harmonic::of(0.5, 2.0), json!({ "amplitude": 0.5, "rate_rad_s": 2 }));
    same(Table::of(vec![0.0, 1.0], vec![1.0, 2.0]), json!({ "times_s": [0, 1], "values": [1, 2] }));
    same(Viscous::default(), json!({}));
    same(Ensemble::of(10), json!({ "members": 10 }));
    same(Accuracy::of(1e-8), json!({ "error": 1e-8 }));
    let made = Scenario::of("s", Scene::free(inertia()), 0.01, 10).expect("good");
    same(made, json!({ "name": "s", "scene": scene, "step_s": 0.01, "steps": 10 }));
    let free = Scene::free(inertia());
    let made = Scenario::to_accuracy("s", free, Accuracy::of(1e-8), 10.0).expect("good");
    let accuracy = json!({ "error": 1e-8 });
    same(made, json!({ "name": "s", "scene": scene, "accuracy": accuracy, "duration_s": 10 }));
}
