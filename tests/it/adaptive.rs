//! Adaptive steps near point sources: their plan, their log, and when they are advised.

use serde_json::{Value, json};
use vpd::advise::{self, Settled};
use vpd::log::reader::{Message, read_samples};
use vpd::plan::Plan;
use vpd::run::Outcome;
use vpd::scenario::Scenario;
use vpd::study::Watch;

use crate::scenarios::run;

fn flyby() -> Value {
    let mut flyby: Value =
        serde_json::from_str(include_str!("../../scenarios/flyby.json")).expect("shipped");
    flyby["steps"] = json!(400);
    flyby["expect"] = json!({});
    flyby
}

fn plan(scenario: &Value) -> Plan {
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario");
    advise::plan(&scenario).expect("a plan")
}

#[test]
fn the_plan_offers_them_where_they_pay() {
    let mut plain = flyby();
    plain.as_object_mut().expect("an object").remove("step");
    let warnings = plan(&plain).warnings;
    assert!(warnings.iter().any(|text| text.contains("\"adaptive\"")), "{warnings:?}");
    assert!(plan(&flyby()).warnings.is_empty());

    let mut dipole: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    assert!(plan(&dipole).warnings.is_empty());
    dipole["step"] = json!({ "adaptive": {} });
    let warnings = plan(&dipole).warnings;
    assert!(warnings.iter().any(|text| text.contains("do as well here")), "{warnings:?}");
}

/// A plan from a stored copy is the same as the one made without a run.
#[test]
fn a_plan_that_was_kept_says_the_same() {
    let mut plain = flyby();
    plain.as_object_mut().expect("an object").remove("step");
    let scenario = Scenario::from_json(plain.to_string().as_bytes()).expect("good");
    let settled = Settled::new(&scenario, &Watch::default()).expect("a plan");
    let text = serde_json::to_string(&settled).expect("JSON");
    let again: Settled = serde_json::from_str(&text).expect("the same");
    assert_eq!(
        serde_json::to_value(settled.plan().expect("a plan")).expect("JSON"),
        serde_json::to_value(again.plan().expect("a plan")).expect("JSON")
    );
}

#[test]
fn a_scenario_may_leave_all_of_it_to_the_program() {
    let mut short = flyby();
    let fields = short.as_object_mut().expect("an object");
    for field in ["step_s", "steps", "method"] {
        fields.remove(field);
    }
    short["duration_s"] = json!(8);
    short["step"] = json!({ "adaptive": {} });
    let plan = plan(&short);
    assert!((plan.steps as f64 * plan.step_s - 8.0).abs() < 1e-9);
    let own = plan.own_steps.expect("steps that adapt");
    assert!(own.largest_step_s > 0.01 && own.largest_step_s < 1.0, "{own:?}");
    // Only the point source has a length, that of its arm.
    assert_eq!(own.near_m.len(), 2);
    assert!(own.near_m[0] == 0.0 && (own.near_m[1] - 1.001_249).abs() < 1e-5, "{own:?}");
    let place = tempfile::tempdir().expect("a directory");
    let summary = run(&short.to_string(), &place.path().join("run.mcap"));
    assert_eq!(summary.outcome, Outcome::Succeeded);
    let energy = summary.energy.expect("logged").max_abs_error;
    assert!(energy < 1e-3, "{energy:e}");
}

/// Near the source the steps shorten by the power 3/2 of the distance, samples keep their times, and the energy stays.
#[test]
fn the_log_shows_how_time_passes() {
    let place = tempfile::tempdir().expect("a directory");
    let log = place.path().join("flyby.mcap");
    let summary = run(&flyby().to_string(), &log);
    assert_eq!((summary.outcome, summary.samples), (Outcome::Succeeded, 401));
    let (mut paces, mut times) = (Vec::new(), Vec::new());
    read_samples(&log, |_, message| match message {
        Message::Pace(pace) => paces.push(pace),
        Message::State(state) => times.push(state.time_s),
        _ => {}
    })
    .expect("a good log");
    assert_eq!(paces.len(), 401);
    assert!(times.iter().enumerate().all(|(k, &t)| t == k as f64 * 0.02), "{times:?}");
    assert!(paces.windows(2).all(|pair| pair[0].own_steps <= pair[1].own_steps));
    let least = paces.iter().map(|pace| pace.least_sigma).fold(1.0, f64::min);
    // This is at a hundredth of the arm.
    assert!(least > 5e-4 && least < 5e-3, "{least:e}");
    for pace in &paces {
        assert!(pace.sigma > 0.0 && pace.sigma <= 1.0 && pace.least_sigma <= 1.0, "{pace:?}");
        assert!(pace.step_s <= 0.5 && pace.time_error_s.abs() <= 1e-14, "{pace:?}");
    }
}

#[test]
fn they_are_advised_after_a_failure_near_a_charge_and_work() {
    let place = tempfile::tempdir().expect("a directory");
    let mut fixed = flyby();
    fixed.as_object_mut().expect("an object").remove("step");
    fixed["method"] = json!({ "name": "vpd", "tableau": "gauss2" });
    let failed = run(&fixed.to_string(), &place.path().join("fixed.mcap"));
    let diagnosis = failed.diagnosis.expect("a step that fails");
    let advised = diagnosis.advised_largest_step_s.expect("they help");
    assert!(diagnosis.advice.contains("vpd_adaptive"), "{diagnosis}");
    fixed["method"] = json!({ "name": "vpd_adaptive" });
    fixed["step"] = json!({ "adaptive": { "largest_step_s": advised } });
    let mended = run(&fixed.to_string(), &place.path().join("mended.mcap"));
    assert_eq!(mended.outcome, Outcome::Succeeded);
    assert!(mended.warning.is_none(), "{:?}", mended.warning);

    // Nothing is near where a step is too large for the dipole.
    let mut dipole: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    (dipole["step_s"], dipole["steps"], dipole["log"]["every"]) =
        (json!(0.9), json!(200), json!(1));
    dipole["method"] = json!({ "name": "vpd_lagrangian", "tableau": "gauss2" });
    let failed = run(&dipole.to_string(), &place.path().join("dipole.mcap"));
    let diagnosis = failed.diagnosis.expect("a step that fails");
    assert_eq!(diagnosis.advised_largest_step_s, None, "{diagnosis}");
}

/// An adaptive run that fails is advised a shorter longest step.
#[test]
fn of_steps_that_adapt_the_longest_may_be_too_long() {
    let place = tempfile::tempdir().expect("a directory");
    let mut long = flyby();
    long["method"] = json!({ "name": "vpd", "tableau": "gauss1" });
    long["step"] = json!({ "adaptive": { "largest_step_s": 30.0 } });
    let failed = run(&long.to_string(), &place.path().join("long.mcap"));
    let diagnosis = failed.diagnosis.expect("a step that fails");
    let advised = diagnosis.advised_step_s.expect("a shorter one");
    assert!(advised < 30.0 && diagnosis.advice.contains("largest_step_s"), "{diagnosis}");
    long["step"]["adaptive"]["largest_step_s"] = json!(advised);
    let mended = run(&long.to_string(), &place.path().join("mended.mcap"));
    assert_eq!(mended.outcome, Outcome::Succeeded, "{:?}", mended.diagnosis);
}

#[test]
fn an_accuracy_chooses_them_where_they_are_cheapest() {
    let place = tempfile::tempdir().expect("a directory");
    let mut asked = flyby();
    let fields = asked.as_object_mut().expect("an object");
    for field in ["step_s", "steps", "step", "method"] {
        fields.remove(field);
    }
    (asked["duration_s"], asked["accuracy"]) = (json!(8), json!({ "error": 1e-6 }));
    let plan = plan(&asked);
    assert_eq!(plan.formulation.method.as_str(), "vpd_adaptive", "{:?}", plan.advice);
    let found = advise::error_at_end(&plan).expect("a reference");
    let advise::ErrorAtEnd::About(error) = found else { panic!("{found:?}") };
    assert!(error <= 1e-6, "{error:e}");
    let summary = run(&asked.to_string(), &place.path().join("run.mcap"));
    assert_eq!(summary.outcome, Outcome::Succeeded);
}

/// Each member of an ensemble has its own energy at the start: it moves as it would alone.
#[test]
fn members_of_an_ensemble_move_as_they_would_alone() {
    let place = tempfile::tempdir().expect("a directory");
    let mut many = flyby();
    many["ensemble"] = json!({ "members": 12, "seed": 3, "attitude_spread_rad": 0.01 });
    let ensemble = run(&many.to_string(), &place.path().join("many.mcap"));
    let alone = run(&flyby().to_string(), &place.path().join("alone.mcap"));
    assert_eq!(ensemble.last, alone.last);
    let figures = ensemble.ensemble.expect("an ensemble");
    assert_eq!(figures.succeeded, 12);
    assert!(figures.energy_max_abs_error.is_some_and(|error| error < 1e-3), "{figures:?}");
}
