//! Stability maps: the borders of methods, and the meaning of the classes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use vpd::scenario::Scenario;
use vpd::solve::failure::FailureCode;
use vpd::study::stability::{Class, Judge, stability};
use vpd::study::{Entry, Watch, all_methods};

use crate::study::shipped;

/// Label → on the dipole the largest usable step and the smallest beyond it that was tried, in
/// seconds.
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
        // Within 15 %: usable below, where a step resonance may take some of three, and broken somewhere just beyond.
        // Further on a step may work by luck.
        let below = [0.6, 0.7, 0.87].iter().any(|part| usable(part * usable_s));
        assert!(below, "{label} below {usable_s}");
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
    // Steady spin: energy and orthogonality are exact whatever the attitude does, and past half a
    // turn in a step the projected turn looks like a small one.
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

/// Returns a pendulum in a plane with a spring, pushed by `push_rad_s` from where it hangs, and
/// omega of its small swings.
fn spring_pendulum(push_rad_s: f64) -> (Scenario, f64) {
    let (weight, stiffness, length, anchor) = (9.81, 4.0, 0.5, [0.5, -2.0]);
    // U of an angle, J = 1, by differences.
    let potential = |angle: f64| {
        let [x, y] = [libm::sin(angle), -libm::cos(angle)];
        let [dx, dy] = [x - anchor[0], y - anchor[1]];
        let stretch = (dx * dx + dy * dy).sqrt() - length;
        weight * y + 0.5 * stiffness * stretch * stretch
    };
    let d = 1e-3;
    let slope = |angle: f64| (potential(angle + d) - potential(angle - d)) / (2.0 * d);
    let curvature = |angle: f64| {
        (potential(angle + d) - 2.0 * potential(angle) + potential(angle - d)) / (d * d)
    };
    let rest = (0..50).fold(0.1, |angle, _| angle - slope(angle) / curvature(angle).abs());
    assert!(slope(rest).abs() < 1e-6 && curvature(rest) > 0.0, "{rest}");
    let scene = serde_json::json!({
        "name": "spring-pendulum", "step_s": 0.05, "duration_s": 200,
        "scene": {
            "inertia": { "principal": [0.6, 0.5, 1.0] },
            "potential": [
                { "kind": "uniform", "weight": weight, "body_point": [0, -1, 0], "direction": [0, 1, 0] },
                { "kind": "spring", "stiffness": stiffness, "rest_length": length, "body_point": [0, -1, 0],
                  "position": [anchor[0], anchor[1], 0] }
            ],
            "initial": {
                "attitude": { "axis_angle": { "axis": [0, 0, 1], "angle_rad": rest } },
                "angular_velocity": { "body": [0, 0, push_rad_s] }
            }
        }
    });
    let scene = Scenario::from_json(scene.to_string().as_bytes()).expect("a good scenario");
    (scene, curvature(rest).sqrt())
}

/// Resonances lie where the scheme turns its linear oscillator by 2 pi / m: the phase of Gauss's
/// rational approximants of exp(i x) is pi / 2 and 2 pi / 3 there.
#[test]
fn step_resonances_are_marked() {
    // Pushed harder, one stage is past its border before three steps make a swing.
    let cases = [
        ("gauss1", 0.06, [2.00, 3.46]),
        ("gauss2", 0.15, [1.58, 2.14]),
        ("gauss3", 0.15, [1.57, 2.10]),
    ];
    for (tableau, push_rad_s, expected) in cases {
        let (scene, omega) = spring_pendulum(push_rad_s);
        let entry = all_methods(&scene)
            .into_iter()
            .find(|entry| entry.label() == format!("vpd {tableau}, newton"))
            .expect("it runs on the scene");
        let map = stability(&scene, &[entry], &Watch::default()).expect("a map");
        let border = &map.borders[0];
        for resonance in &border.resonances {
            let [from, to] = resonance.window_s.map(|step_s| omega * step_s);
            println!(
                "{}: m = {}, h w from {from:.3} to {to:.3}, {:.1e} J in the place of {:.1e}",
                border.label,
                resonance.steps_per_swing,
                resonance.energy_error,
                resonance.usual_energy_error
            );
        }
        for expected in expected {
            let marked = border.resonances.iter().any(|resonance| {
                let [from, to] = resonance.window_s.map(|step_s| omega * step_s);
                from < expected && expected < to && to < 1.1 * from
            });
            assert!(marked, "{}: {expected} is not in {:?}", border.label, border.resonances);
        }
    }
}
