//! Where methods fail: the borders of the map, and what its classes mean.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use vpd::scenario::Scenario;
use vpd::solve::failure::FailureCode;
use vpd::study::stability::{Class, Judge, stability};
use vpd::study::{Entry, Watch, all_methods};

use crate::study::shipped;

/// Label → on the dipole the largest usable step and the smallest beyond it that was tried, in seconds.
type Borders = BTreeMap<String, [f64; 2]>;

fn recorded_at() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/dipole-borders.json")
}

#[test]
fn the_borders_of_the_dipole_are_where_they_were() {
    let scene = shipped("dipole");
    let watch = Watch::default();
    let judge = Judge::of(&scene, &watch).expect("scales");
    let text = std::fs::read(recorded_at()).expect("the recorded borders");
    let mut recorded: Borders = serde_json::from_slice(&text).expect("JSON");
    let mut missing = Vec::new();
    for entry in all_methods(&scene) {
        let label = entry.label();
        let Some([usable_s, broken_s]) = recorded.remove(&label) else {
            missing.push(label);
            continue;
        };
        let usable = |step_s: f64| {
            judge.cell(&entry, step_s, &watch).expect("the scene is planned").class.is_usable()
        };
        // Within 15 %: usable below, and broken somewhere just beyond. Further on a step may work by luck.
        assert!([0.7, 0.87].iter().all(|part| usable(part * usable_s)), "{label} below {usable_s}");
        let beyond = [1.0, 1.04, 1.09].iter().any(|part| !usable(part * broken_s));
        assert!(beyond, "{label} works beyond {broken_s}");
    }
    assert!(recorded.is_empty(), "not studied: {recorded:?}; see rewrite_the_borders");
    // Third order in matrices is off the group at every step of the map.
    assert_eq!(missing, ["rk rk3"], "no border recorded; see rewrite_the_borders");
}

/// Records the borders anew, after a change of a solver: `cargo test --release rewrite_the_borders -- --ignored`
#[test]
#[ignore = "writes a file that tests read: cargo test --release rewrite_the_borders -- --ignored"]
fn rewrite_the_borders() {
    let scene = shipped("dipole");
    let map = stability(&scene, &all_methods(&scene), &Watch::default()).expect("a map");
    let borders: Borders = map
        .borders
        .into_iter()
        .filter_map(|border| Some((border.label, [border.usable_step_s?, border.broken_step_s?])))
        .collect();
    let text = serde_json::to_string_pretty(&borders).expect("JSON") + "\n";
    std::fs::write(recorded_at(), text).expect("the file is written");
}

fn entry(scene: &Scenario, label: &str) -> Entry {
    let found = all_methods(scene).into_iter().find(|entry| entry.label() == label);
    found.unwrap_or_else(|| panic!("{label} does not run on the scene"))
}

#[test]
fn classes_mean_what_they_say() {
    let scene = shipped("dipole");
    let watch = Watch::default();
    let judge = Judge::of(&scene, &watch).expect("scales");
    let class = |label: &str, step_s: f64| {
        judge.cell(&entry(&scene, label), step_s, &watch).expect("the scene is planned").class
    };
    assert_eq!(class("quaternion_gauss gauss4", 0.05), Class::Stable);
    assert_eq!(class("splitting order 4", 0.05), Class::Stable);
    assert_eq!(class("rkmk rk4", 0.05), Class::EnergyDrifts);
    assert_eq!(class("rk rk4", 0.05), Class::LeftGroup);
    assert_eq!(class("rkmk rk4", 1.2), Class::BlewUp);
    assert!(matches!(class("quaternion_gauss gauss4", 1.0), Class::Failed(_)));
}

#[test]
fn a_turn_past_pi_that_looks_fine_is_refused() {
    // Steady spin: energy and orthogonality are exact whatever the attitude does, and past half a turn in a
    // step what is projected looks like a small one.
    let scene = serde_json::json!({
        "name": "spin", "step_s": 0.1, "steps": 1000,
        "scene": {
            "inertia": { "principal": [3.0, 2.0, 1.0] },
            "initial": { "angular_velocity": { "body": [0, 0, 1] } }
        }
    });
    let scene = Scenario::from_json(scene.to_string().as_bytes()).expect("a good scenario");
    let watch = Watch::default();
    let judge = Judge::of(&scene, &watch).expect("scales");
    let class = |label: &str, step_s: f64| {
        judge.cell(&entry(&scene, label), step_s, &watch).expect("planned").class
    };
    for step_s in [2.0, 3.3, 4.7] {
        assert_eq!(class("rk_projected rk4", step_s), Class::Failed(FailureCode::BranchJump));
    }
    assert_eq!(class("rk_projected rk4", 0.5), Class::Stable);
    for step_s in [3.3, 4.0, 4.7] {
        let class = class("vpd gauss1, fixed_point", step_s);
        assert!(matches!(class, Class::Failed(_)), "{step_s}: {class:?}");
    }
}
