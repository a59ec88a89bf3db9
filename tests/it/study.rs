//! Studies: the program's own references against digits, orders from the table, and the effect of a
//! cancel.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::sync::atomic::Ordering;

use serde_json::{Value, json};
use vpd::method::Integrator;
use vpd::plan::Plan;
use vpd::scenario::{Coefficients, SHIPPED, Scenario, TableauChoice};
use vpd::study::long_term::long_term;
use vpd::study::precision::precision;
use vpd::study::reference::{Reference, ReferenceError};
use vpd::study::stability::{stability, stability_so_far};
use vpd::study::table::Table;
use vpd::study::{Entry, Scales, StudyError, Watch, all_methods, usual_methods};

use crate::cli::vpd;
use crate::given::reference;

pub(crate) fn shipped(name: &str) -> Scenario {
    let (_, text) = SHIPPED.iter().find(|(shipped, _)| *shipped == name).expect("shipped");
    Scenario::from_json(text.as_bytes()).expect("shipped scenarios are good")
}

fn reference_at(scene: &Scenario, time_s: f64) -> Result<Reference, StudyError> {
    let watch = Watch::default();
    Reference::at(scene, time_s, &Scales::of(scene, time_s, &watch)?, &watch)
}

#[test]
fn the_reference_of_the_dipole_meets_the_digits() {
    let ours = reference_at(&shipped("dipole"), 0.5).expect("a reference");
    let digits = reference();
    let attitude = (0..9).map(|k| ours.end().attitude[k] - digits.attitude[k]);
    let momentum = (0..9).map(|k| ours.end().momentum[k] - digits.momentum[k]);
    let error = attitude.chain(momentum).map(f64::abs).fold(0.0, f64::max);
    println!(
        "{error:.1e} from the digits, {:.1e} said, {:.1e} from vrkmk",
        ours.error, ours.cross_check
    );
    assert!(error <= 2e-15, "{error:e}");
    assert!(ours.error <= 1e-13 && ours.cross_check <= 1e-12);
}

#[test]
fn every_shipped_scene_has_a_reference() {
    for (name, _) in SHIPPED {
        let scene = shipped(name);
        // Studies are for one body.
        if scene.bodies().is_some() {
            continue;
        }
        let watch = Watch::default();
        let plan = Plan::new(&scene).expect("a plan");
        let duration_s = plan.steps as f64 * plan.step_s;
        let scales = Scales::of(&scene, duration_s, &watch).expect("scales");
        let time_s = duration_s.min(6.0 / scales.fastest_rad_s);
        let found = reference_at(&scene, time_s).expect(name);
        println!(
            "{name}: t = {time_s:.3}, error {:.1e}, cross-check {:.1e}, {} steps",
            found.error, found.cross_check, found.steps
        );
        // A face that turns edge-on is a kink in the torque: all steps are of second order there.
        let limit = if *name == "cubesat" { 1e-6 } else { 1e-12 };
        assert!(found.error <= limit, "{name}: {:e}", found.error);
    }
}

#[test]
fn a_time_beyond_the_horizon_is_refused() {
    // On this orbit errors grow 1e5 times from t = 0.5 to t = 50.
    match reference_at(&shipped("dipole"), 300.0) {
        Err(StudyError::Reference(ReferenceError::Chaotic { difference, .. })) => {
            assert!(difference > 1e-6)
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_table_shows_the_orders_and_repeats() {
    table_of("dipole", 0.5, 10);
}

/// The same for scenes that move, or have torques and a wheel.
#[test]
fn so_does_that_of_driven_scenes() {
    table_of("satellite-elliptic", 4000.0, 5);
    table_of("dual-spin", 10.0, 5);
}

/// Makes a study of a shipped scene up to a time, in which at least `orders` orders must show.
fn table_of(name: &str, until_s: f64, orders: usize) {
    let scene = shipped(name);
    let entries = usual_methods(&scene);
    let watch = Watch::default();
    let study = precision(&scene, &entries, Some(until_s), &watch).expect("a study");
    println!("{}", study.table.to_csv());
    let mut shown = 0;
    for (line, entry) in entries.iter().enumerate() {
        if let Some(order) = study.measured_order(line) {
            println!("{}: {order:.2}", entry.label());
            assert!((order - f64::from(entry.order)).abs() <= 0.2, "{}: {order}", entry.label());
            shown += 1;
        }
        let last = &study.table.rows[study.lines[line].end - 1];
        assert!(last.ns_per_step.is_some_and(|ns| ns > 0.0), "{}", entry.label());
        assert!(last.force_evaluations > 0, "{}", entry.label());
    }
    assert!(shown >= orders, "{shown} orders");
    assert_eq!(watch.done.into_inner(), watch.total.into_inner());
    let without_times = |table: &Table| {
        let mut table = table.clone();
        table.rows.iter_mut().for_each(|row| row.ns_per_step = None);
        table.to_csv()
    };
    let again = precision(&scene, &entries, Some(until_s), &Watch::default()).expect("a study");
    assert_eq!(without_times(&study.table), without_times(&again.table));
    let read: Value = serde_json::from_str(&study.table.to_json()).expect("JSON");
    assert_eq!(read.as_array().map(Vec::len), Some(study.table.rows.len()));
}

#[test]
fn a_cancelled_study_ends() {
    let scene = shipped("dipole");
    let watch = Watch::default();
    watch.cancelled.store(true, std::sync::atomic::Ordering::Relaxed);
    let ended = precision(&scene, &usual_methods(&scene), Some(0.5), &watch);
    assert_eq!(ended, Err(StudyError::Cancelled));
}

fn file(name: &str) -> String {
    format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn chart_studies_a_scenario() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = file("heavy-top");
    let few = [
        "--method",
        "vpd:gauss2",
        "--method",
        "splitting:4",
        "--method",
        "vpd:{\"a\": [[0.5]], \"b\": [1]}",
        "--until",
        "0.1",
        "--set",
        "/duration_s=1",
    ];
    let done = vpd(at, &[&["chart", &top, "-o", "study"], few.as_slice()].concat());
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let said = String::from_utf8(done.stdout).expect("text");
    assert!(said.starts_with("reference: t = 0.1 s"), "{said}");
    for name in ["order", "time", "forces", "energy", "orthogonality"] {
        let svg = std::fs::read_to_string(at.join(format!("study/{name}.svg"))).expect("a chart");
        for method in ["vpd gauss2", "splitting order 4", "vpd given"] {
            assert!(svg.contains(method), "{name}: {method}");
        }
        assert!(svg.matches("<polyline").count() >= 2, "{name}");
    }
    let table = std::fs::read_to_string(at.join("study/table.csv")).expect("a table");
    assert!(table.starts_with("method,tableau,order,solver,step_s,"), "{table}");
    let columns = |line: &str| line.split(',').count();
    assert!(table.lines().all(|line| columns(line) == 14), "{table}");
}

#[test]
fn stability_maps_a_scenario() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let done =
        vpd(at, &["stability", &file("dipole"), "--method", "splitting:2", "--method", "rkmk:rk4"]);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let said = String::from_utf8(done.stdout).expect("text");
    let borders = std::fs::read_to_string(at.join("borders.txt")).expect("the borders");
    assert!(said.starts_with(&borders) && borders.lines().count() == 3, "{said}");
    let map = std::fs::read_to_string(at.join("stability.svg")).expect("the map");
    for word in ["splitting order 2", "rkmk rk4", "blew up", "energy drifts", "largest usable step"]
    {
        assert!(map.contains(word), "{word}");
    }
    let table = std::fs::read_to_string(at.join("stability.csv")).expect("a table");
    assert_eq!(table.lines().count(), 1 + 2 * 24);
}

#[test]
fn studies_refuse_what_makes_none() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let log = at.join("a.mcap");
    std::fs::write(&log, b"\x89MCAP0\r\n").expect("written");
    let (dipole, log) = (file("dipole"), log.to_string_lossy().into_owned());
    for (arguments, code) in [
        (vec!["chart", &dipole, &log], 2),
        (vec!["chart", &dipole, "--method", "vpd:gauss9"], 2),
        (vec!["chart", &dipole, "--method", "rkmk:gauss2"], 2),
        (vec!["chart", "nothing.json"], 2),
        (vec!["chart", &dipole, "--until", "-1"], 2),
        (vec!["chart", &dipole, "--until", "1e-300"], 2),
        (vec!["chart", &dipole, "--until", "nan"], 2),
        (vec!["stability", &dipole, "--method", "euler"], 2),
        (vec!["stability", &dipole, "--method", "vpd:{\"a\": [[0.5]]}"], 2),
        (vec!["stability", &dipole, "--method", "vpd:{\"a\": [[0.5]], \"b\": [1]"], 2),
        (vec!["stability", &dipole, "--method", "vpd:{\"a\": [[0.5]], \"b\": [1]}newton"], 2),
        (vec!["stability", &dipole, "--method", "vpd:gauss2:newton:more"], 2),
        // No reference can be trusted there.
        (vec!["chart", &dipole, "--until", "300"], 1),
    ] {
        let done = vpd(at, &arguments);
        assert_eq!(done.status.code(), Some(code), "{arguments:?}");
        assert!(!done.stderr.is_empty() && done.stdout.is_empty(), "{arguments:?}");
    }
}

#[test]
fn a_run_shows_its_error_if_asked() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let done = vpd(at, &["run", &file("dipole"), "--set", "/steps=50", "--error", "--json"]);
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let summary: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    // Gauss 2 stages, h = 0.01, t = 0.5: 1.2e-9 in SI units.
    let error = summary["error"].as_f64().expect("an error");
    assert!((1e-10..1e-8).contains(&error), "{error:e}");
    // Where there is no reference the run stands, and says so.
    let far = ["run", &file("dipole"), "--set", "/steps=30000", "--error", "--json", "--force"];
    let done = vpd(at, &far);
    assert_eq!(done.status.code(), Some(1));
    assert!(!done.stderr.is_empty());
    let summary: Value = serde_json::from_slice(&done.stdout).expect("JSON");
    assert_eq!(summary["outcome"], "succeeded");
    assert!(summary["error"].is_null() && summary["error_below"].is_null(), "{summary}");
}

/// The heavy top in 400 steps, and five methods.
fn top() -> (Scenario, Vec<Entry>) {
    let mut scene = shipped("heavy-top");
    (scene.steps, scene.duration_s) = (Some(400), None);
    let entries = usual_methods(&scene).into_iter().take(5).collect();
    (scene, entries)
}

#[test]
fn a_tableau_of_the_scene_takes_part() {
    let (mut scene, _) = top();
    let midpoint = Coefficients { a: vec![vec![0.5]], b: vec![1.0] };
    scene.method.tableau = Some(TableauChoice::Custom(midpoint));
    for entries in [usual_methods(&scene), all_methods(&scene)] {
        assert_eq!(entries[0].label(), "vpd given");
        assert!(entries.len() > 5 && entries[1..].iter().all(|entry| entry.tableau != "given"));
    }
}

#[test]
fn a_cancelled_map_keeps_the_methods_that_were_done() {
    let (scene, entries) = top();
    let two_threads = || Watch { threads: NonZeroUsize::new(2), ..Watch::default() };
    let whole = stability(&scene, &entries, &two_threads()).expect("a map").cells;
    let watch = two_threads();
    let map = std::thread::scope(|scope| {
        scope.spawn(|| {
            // Some of the methods are done by then, at most all of them.
            while watch.done.load(Ordering::Relaxed) < 2 * 24 + 12 {
                std::thread::yield_now();
            }
            watch.cancelled.store(true, Ordering::Relaxed);
        });
        stability_so_far(&scene, &entries, &watch).expect("a map")
    });
    assert!(!map.cells.is_empty() && map.cells.len() == map.borders.len());
    assert_eq!(map.cells[..], whole[..map.cells.len()]);
    let stopped = Watch::default();
    stopped.cancelled.store(true, Ordering::Relaxed);
    assert_eq!(stability_so_far(&scene, &entries, &stopped), Err(StudyError::Cancelled));
}

#[test]
fn studies_do_not_depend_on_threads() {
    let (scene, entries) = top();
    let on = |threads| Watch { threads: NonZeroUsize::new(threads), ..Watch::default() };
    let long = |threads| long_term(&scene, &entries, &on(threads)).expect("a study");
    let (one, three) = (long(1), long(3));
    assert_eq!(one.table.to_csv(), three.table.to_csv());
    assert_eq!(one, three);
    let map = |threads| stability(&scene, &entries[..3], &on(threads)).expect("a map");
    assert_eq!(map(1), map(3));
    let untimed = |threads| {
        let found = precision(&scene, &entries, Some(0.05), &on(threads));
        let mut found = found.expect("a study");
        assert!(found.table.rows.iter().any(|row| row.ns_per_step.is_some()));
        found.table.rows.iter_mut().for_each(|row| row.ns_per_step = None);
        found
    };
    assert_eq!(untimed(1), untimed(3));
}

/// Every method of the list takes part for n = 3, those of any n for n = 4 too, and each shows its order there.
#[test]
fn each_method_is_of_its_order_in_the_dimensions_that_it_takes() {
    let scene = |n: usize, kind: &str| {
        let vector = |x: f64| (0..n).map(|i| (x + i as f64).sin()).collect::<Vec<_>>();
        let skew = |i: usize, j: usize| match i.cmp(&j) {
            std::cmp::Ordering::Less => ((1 + i + 2 * j) as f64).cos(),
            std::cmp::Ordering::Equal => 0.0,
            std::cmp::Ordering::Greater => -((1 + j + 2 * i) as f64).cos(),
        };
        let momentum: Vec<Vec<f64>> =
            (0..n).map(|i| (0..n).map(|j| skew(i, j)).collect()).collect();
        let term = match kind {
            "uniform" => {
                json!({"kind": "uniform", "weight": 1.5, "body_point": vector(0.4), "direction": vector(0.9)})
            }
            _ => {
                json!({"kind": "point_source", "strength": 0.5, "body_point": vector(0.4), "position": vector(0.9).iter().map(|x| 3.0 * x).collect::<Vec<_>>()})
            }
        };
        let second_moments: Vec<f64> = (0..n).map(|i| 0.4 + 0.3 * i as f64).collect();
        let scenario = json!({
            "name": "any", "step_s": 0.01, "steps": 100,
            "scene": {
                "inertia": {"second_moments": second_moments},
                "potential": if kind == "free" { json!([]) } else { json!([term]) },
                "initial": {"momentum": {"body": momentum}},
            }
        });
        Scenario::from_json(scenario.to_string().as_bytes()).expect("a scene")
    };
    for (n, three) in [(3, true), (4, false)] {
        let mut seen = BTreeSet::new();
        for kind in ["uniform", "free", "source"] {
            let scene = scene(n, kind);
            let mut entries = all_methods(&scene);
            entries.retain(|entry| entry.order == 4);
            let found = precision(&scene, &entries, Some(1.0), &Watch::default()).expect("a study");
            for (line, entry) in entries.iter().enumerate() {
                // One that is exact on a free body shows none.
                let Some(order) = found.measured_order(line) else {
                    assert!(kind == "free", "{} for n = {n}: no order", entry.label());
                    continue;
                };
                assert!((order - 4.0).abs() < 0.3, "{} for n = {n}: {order}", entry.label());
                seen.insert(entry.integrator.as_str());
            }
        }
        println!("{n}: {seen:?}");
        for method in Integrator::ALL {
            let takes = three || !method.facts().three;
            assert_eq!(seen.contains(method.as_str()), takes, "{} for n = {n}", method.as_str());
        }
    }
}
