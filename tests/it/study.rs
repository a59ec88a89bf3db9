//! Studies: the program's own references against digits, orders from the table, and what a cancel does.

use serde_json::Value;
use vpd::plan::Plan;
use vpd::scenario::{SHIPPED, Scenario};
use vpd::study::precision::precision;
use vpd::study::reference::{Reference, ReferenceError};
use vpd::study::table::Table;
use vpd::study::{Scales, StudyError, Watch, usual_methods};

use crate::verification::reference;

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
        assert!(found.error <= 1e-12, "{name}: {:e}", found.error);
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
    let scene = shipped("dipole");
    let entries = usual_methods(&scene);
    let watch = Watch::default();
    let study = precision(&scene, &entries, Some(0.5), &watch).expect("a study");
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
    assert!(shown >= 10, "{shown} orders");
    assert_eq!(watch.done.into_inner(), watch.total.into_inner());
    let without_times = |table: &Table| {
        let mut table = table.clone();
        table.rows.iter_mut().for_each(|row| row.ns_per_step = None);
        table.to_csv()
    };
    let again = precision(&scene, &entries, Some(0.5), &Watch::default()).expect("a study");
    assert_eq!(without_times(&study.table), without_times(&again.table));
    let read: Value = serde_json::from_str(&study.table.to_json()).expect("JSON");
    assert_eq!(read.as_array().map(Vec::len), Some(study.table.rows.len()));
}

#[test]
fn a_cancelled_study_ends() {
    let scene = shipped("dipole");
    let watch = Watch { cancelled: true.into(), ..Watch::default() };
    let ended = precision(&scene, &usual_methods(&scene), Some(0.5), &watch);
    assert_eq!(ended, Err(StudyError::Cancelled));
}
