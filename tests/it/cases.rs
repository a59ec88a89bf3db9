//! Scenes that once failed or ended wrongly, each with its right end: those of `tests/cases`.
//!
//! The ends are closed forms, or those of Dormand and Prince's eighth order (SciPy 1.17, tolerance 1e-13) from knot to knot.

use std::path::Path;

use serde_json::Value;
use vpd::advise;
use vpd::run::{Outcome, Summary};
use vpd::scenario::Scenario;

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

#[test]
fn a_needle_is_solved() {
    let summary = ended(&text("needle-1e-5"));
    let [x, y, axial] = momentum(&summary);
    assert!((x.hypot(y) - 0.5).abs() < 1e-14, "{:?}", summary.last);
    assert!((axial - 1e-6).abs() < 1e-13, "{:?}", summary.last);
}
