//! An accuracy in the place of a method and a step: the choice is cheap, the same each time, and kept.

use serde_json::{Value, json};
use vpd::advise::{self, ErrorAtEnd, Obstacle, Settled, Unsettled, error_at_end};
use vpd::method::Integrator;
use vpd::plan::Plan;
use vpd::run::{Control, JobContext, Outcome, execute};
use vpd::scenario::{Scenario, ScenarioError};
use vpd::study::Watch;
use vpd::study::reference::Growth;

use crate::ensemble::ends;
use crate::given::Numbers;
use crate::scenarios::run;

fn scenario(value: &Value) -> Scenario {
    Scenario::from_json(value.to_string().as_bytes()).expect("a good scenario")
}

/// Returns a body with a potential of its own, in three dimensions or four.
fn scene(numbers: &mut Numbers, number: usize) -> Value {
    let n = if number % 8 == 7 { 4 } else { 3 };
    let mut list = |scale: f64| -> Vec<f64> { (0..n).map(|_| scale * numbers.next()).collect() };
    let moments: Vec<f64> = list(0.4).iter().map(|x| 1.0 + x).collect();
    let uniform =
        json!({"kind": "uniform", "weight": 2.0, "body_point": list(0.5), "direction": list(1.0)});
    let spring = json!({"kind": "spring", "stiffness": 3.0, "rest_length": 0.5, "body_point": list(1.0), "position": list(2.0)});
    let far: Vec<f64> = list(0.5).iter().map(|x| x + 2.0).collect();
    let charge =
        json!({"kind": "point_source", "strength": 0.8, "body_point": list(0.5), "position": far});
    let tide = json!({"kind": "gravity_gradient", "strength": 0.7, "direction": list(1.0)});
    let potential = match number % 5 {
        0 => json!([]),
        1 => json!([uniform]),
        2 => json!([uniform, spring]),
        3 => json!([charge, uniform]),
        _ => json!([tide, uniform]),
    };
    let mut omega = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..i {
            let x = 1.5 * numbers.next();
            (omega[i][j], omega[j][i]) = (x, -x);
        }
    }
    json!({
        "inertia": {"second_moments": moments},
        "potential": potential,
        "initial": {"angular_velocity": {"body": omega}}
    })
}

/// With an accuracy, samples come as far apart as is asked for, and the steps that are chosen fit.
#[test]
fn an_accuracy_is_sampled_as_asked() {
    let mut asked = json!({
        "name": "spaced",
        "scene": { "inertia": { "principal": [1, 2, 3] },
            "potential": [{ "kind": "uniform", "weight": 1, "body_point": [0, 0, 1], "direction": [1, 0, 0] }],
            "initial": { "angular_velocity": { "body": [0.01, 1, 0] } } },
        "accuracy": { "error": 1e-7 },
        "duration_s": 7
    });
    // Coarser than the steps, finer, and so that quarters of the run fall between.
    for (every_s, count) in [(0.7, 10), (0.001, 7000), (1.4, 5)] {
        asked["log"] = json!({ "every_s": every_s });
        let plan = advise::plan(&scenario(&asked)).expect("a plan");
        let spacing_s = plan.every as f64 * plan.step_s;
        assert!((spacing_s - every_s).abs() <= 1e-12, "{spacing_s} s, {every_s} s asked for");
        assert_eq!((plan.samples, plan.steps % count), (count + 1, 0), "{every_s} s");
    }
    let error = advise::error_at_end(&advise::plan(&scenario(&asked)).expect("a plan"));
    let (ErrorAtEnd::About(error) | ErrorAtEnd::Below(error)) = error.expect("a reference");
    assert!(error <= 1e-7, "{error:e}");
}

/// Adaptive steps that the program chooses fit, too.
#[test]
fn easy_steps_are_sampled_as_asked() {
    let mut flyby: Value =
        serde_json::from_str(include_str!("../../scenarios/flyby.json")).expect("shipped");
    let duration_s = scenario(&flyby).step_count() as f64 * scenario(&flyby).step_s.unwrap_or(0.0);
    for field in ["step_s", "steps", "step", "expect"] {
        flyby.as_object_mut().expect("an object").remove(field);
    }
    flyby["step"] = json!({ "adaptive": {} });
    flyby["duration_s"] = json!(duration_s);
    flyby["log"] = json!({ "every_s": duration_s / 7.0 });
    let plan = advise::plan(&scenario(&flyby)).expect("a plan");
    assert_eq!((plan.samples, plan.steps % 7), (8, 0));
}

/// A scene that changes with time and has torques and a wheel gets its accuracy by a method that
/// can run it.
#[test]
fn driven_scenes_have_an_accuracy() {
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../scenarios/satellite-elliptic.json"))
            .expect("shipped");
    scenario["scene"]["torques"] = json!([{ "viscous": { "coefficient": 0.01 } }]);
    scenario["scene"]["wheels"] = json!([0.2, 0, 0]);
    scenario["duration_s"] = json!(20_000);
    let best = {
        let mut best = scenario.clone();
        best["method"] = json!({ "name": "vrkmk", "tableau": "gauss6" });
        best["step_s"] = json!(10);
        best
    };
    for field in ["method", "step_s", "expect"] {
        scenario.as_object_mut().expect("an object").remove(field);
    }
    scenario["accuracy"] = json!({ "error": 1e-8 });
    let end = |scenario: &Value| {
        let folder = tempfile::tempdir().expect("a folder");
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        let plan = advise::plan(&scenario).expect("a plan");
        let context =
            JobContext { log: &folder.path().join("log.mcap"), control: &Control::default() };
        let summary = execute(&plan, &context).expect("a log");
        (plan, summary.last.attitude.expect("carried"))
    };
    let (plan, reached) = end(&scenario);
    assert!(plan.formulation.method.facts().driven, "{}", plan.formulation.method.as_str());
    let (_, truth) = end(&best);
    let off = reached.iter().flatten().zip(truth.iter().flatten());
    let off = off.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    println!("{} {:?}: {off:e}", plan.formulation.method.as_str(), plan.formulation.tableau);
    assert!(off <= 1e-8, "{off:e}");
}

#[test]
fn accuracies_are_kept_on_forty_scenes() {
    let mut numbers = Numbers(40);
    let (mut kept, mut missed) = (0, Vec::new());
    for number in 0..40 {
        let error = [1e-4, 1e-6, 1e-8, 1e-10][number % 4];
        // One in five runs longer than its pilots.
        let duration_s = if number % 5 == 4 { 300.0 } else { 2.0 + number as f64 / 4.0 };
        let scenario = scenario(&json!({
            "name": format!("scene {number}"), "scene": scene(&mut numbers, number),
            "accuracy": {"error": error}, "duration_s": duration_s
        }));
        let plan = match advise::plan(&scenario) {
            Ok(plan) => plan,
            Err(refused) => {
                // The refusal comes beforehand, so no promise is broken; but it must not be the
                // usual case.
                println!("{number}: {refused}");
                missed.push(format!("{number}: {refused}"));
                continue;
            }
        };
        let reached = match error_at_end(&plan) {
            Ok(ErrorAtEnd::About(reached) | ErrorAtEnd::Below(reached)) => reached,
            Err(unknown) => {
                // The growth of errors cannot be predicted, so the accuracy does not count as
                // reached.
                println!("{number}: {unknown}");
                missed.push(format!("{number}: {unknown}"));
                continue;
            }
        };
        let chosen = &plan.formulation;
        let advice = plan.advice.expect("the choice is reported");
        println!(
            "{number}: {error:.0e} asked, {reached:.1e} reached, {:.1e} expected; {} {:?} order {}, step {:.3}, to {duration_s} ({:.0})",
            advice.expected_error,
            chosen.method.as_str(),
            chosen.tableau,
            chosen.order,
            plan.step_s,
            advice.pilot_time_s
        );
        if reached <= error {
            kept += 1;
        } else {
            missed.push(format!("{number}: {reached:e}"));
        }
    }
    println!("{kept} of 40 kept");
    assert!(kept >= 38, "{kept} of 40: {missed:?}");
}

fn accurate_dipole(error: f64, duration_s: f64) -> Value {
    let mut dipole: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    let map = dipole.as_object_mut().expect("an object");
    for field in ["method", "step_s", "steps", "expect", "log"] {
        map.remove(field);
    }
    dipole["accuracy"] = json!({ "error": error });
    dipole["duration_s"] = json!(duration_s);
    dipole
}

#[test]
fn a_run_with_an_accuracy_chooses_once_and_for_all() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let text = accurate_dipole(1e-8, 2.0).to_string();
    let paths = ["a.mcap", "b.mcap"].map(|file| directory.path().join(file));
    let [first, second] = paths.map(|path| {
        let summary = run(&text, &path);
        assert_eq!(summary.outcome, Outcome::Succeeded);
        assert!((summary.time_s - 2.0).abs() < 1e-12);
        std::fs::read(&path).expect("a log")
    });
    assert!(first == second, "the choice differs");
}

#[test]
fn the_choice_is_the_cheapest_of_those_tried() {
    let plan = advise::plan(&scenario(&accurate_dipole(1e-6, 2.0))).expect("a choice");
    let advice = plan.advice.expect("the choice is reported");
    let costs: Vec<f64> = advice.candidates.iter().filter_map(|tried| tried.cost_us).collect();
    assert!(costs.len() >= 2 && costs.is_sorted(), "{costs:?}");
    assert_eq!(advice.candidates[0].method, plan.formulation.method);
    assert!(advice.margin >= 1.2, "{}", advice.margin);
    let finer = advise::plan(&scenario(&accurate_dipole(1e-10, 2.0))).expect("a choice");
    let cost = finer.advice.and_then(|advice| advice.candidates[0].cost_us);
    // The cheapest method for one may be good enough for the other.
    assert!(cost.is_some_and(|cost| cost >= costs[0]), "{cost:?} {costs:?}");
}

/// Of an ensemble counts what a member costs among others: less than by itself where they go side by side in lanes.
#[test]
fn members_side_by_side_are_cheaper() {
    let alone = accurate_dipole(1e-8, 0.5);
    let mut together = alone.clone();
    together["ensemble"] = json!({ "members": 16, "attitude_spread_rad": 1e-9 });
    let [alone, together] = [alone, together].map(|asked| {
        let plan = advise::plan(&scenario(&asked)).expect("a choice");
        plan.advice.expect("the choice is reported").candidates
    });
    let mut compared = 0;
    for member in &together {
        let same = alone.iter().find(|run| {
            (run.method, &run.tableau, run.step_s)
                == (member.method, &member.tableau, member.step_s)
        });
        let costs = same.and_then(|run| Some((run.cost_us?, member.cost_us?)));
        let Some((by_itself, among_others)) = costs else { continue };
        let part = among_others / by_itself;
        println!("{:?} {}: {part:.2}", member.method, member.tableau);
        match member.method {
            Integrator::RkProjected | Integrator::Rkmk | Integrator::Splitting => {
                compared += 1;
                assert!(part < 0.4, "{member:?}: {part}");
            }
            Integrator::Lgvi | Integrator::QuaternionGauss => {
                assert!(part > 0.9, "{member:?}: {part}");
            }
            _ => {}
        }
    }
    assert!(compared > 0);
    let costs: Vec<f64> = together.iter().filter_map(|tried| tried.cost_us).collect();
    assert!(costs.is_sorted(), "{costs:?}");
}

#[test]
fn what_cannot_be_reached_is_refused() {
    // On this orbit round-off grows to 1e-11 by t = 50.
    let refused =
        advise::plan(&scenario(&accurate_dipole(1e-13, 50.0))).expect_err("too much asked");
    assert_eq!(refused.pointer, "/accuracy/error");
    assert!(refused.message.contains("1e-13"), "{}", refused.message);
}

#[test]
fn what_stands_in_the_way_has_its_figure() {
    let asked = scenario(&accurate_dipole(1e-13, 50.0));
    match Settled::new(&asked, &Watch::default()) {
        Err(Unsettled::OutOfReach {
            asked,
            why: Obstacle::Untold { least, time_s, until_s, .. },
        }) => {
            assert_eq!(asked, 1e-13);
            assert!(least > 1e-13 && time_s <= 50.0, "{least:e} {time_s}");
            assert!(until_s > 0.0 && until_s < 50.0, "{until_s}");
        }
        other => panic!("{other:?}"),
    }
}

/// A falling needle: explicit steps look cheapest in the first part of the run and fail later on; methods that were given up
/// next to them reach the accuracy.
#[test]
fn a_method_given_up_is_tried_again_where_the_cheaper_ones_fail() {
    let field =
        json!({"kind": "uniform", "weight": 1, "body_point": [0, 0, 0.5], "direction": [0, 0, 1]});
    let asked = |symplectic: bool| {
        json!({
            "name": "needle", "accuracy": {"error": 1e-6, "symplectic": symplectic}, "duration_s": 100.0,
            "log": {"every": 1_000_000, "channels": ["/state"]},
            "scene": {
                "inertia": {"principal": [1, 1, 1e-8]}, "potential": [field],
                "initial": {"angular_velocity": {"body": [0.3, 0.4, 0.1]}}
            }
        })
    };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let ends = [false, true].map(|symplectic| {
        let summary = run(&asked(symplectic).to_string(), &directory.path().join("log.mcap"));
        assert_eq!(summary.outcome, Outcome::Succeeded, "{:?}", summary.diagnosis);
        std::fs::remove_file(directory.path().join("log.mcap")).expect("a log");
        summary.last.body_momentum
    });
    for axis in 0..3 {
        let [a, b] = ends.each_ref().map(|end| end[axis].as_f64().expect("a number"));
        assert!((a - b).abs() < 2e-6, "{ends:?}");
    }
}

#[test]
fn a_choice_is_kept_to_the_bit() {
    let asked = scenario(&accurate_dipole(1e-6, 2.0));
    let settled = Settled::new(&asked, &Watch::default()).expect("a choice");
    let kept = serde_json::to_vec(&settled).expect("JSON");
    let read: Settled = serde_json::from_slice(&kept).expect("what was written");
    assert_eq!(read, settled);
    let json = |plan: &Plan| serde_json::to_string(plan).expect("JSON");
    let kept = [&settled, &read].map(|settled| settled.plan().expect("a plan"));
    assert_eq!(json(&kept[0]), json(&kept[1]));
    // Another choice differs in its timings, and in nothing else.
    let direct = advise::plan(&asked).expect("a plan").on_a_common_machine();
    assert_eq!(json(&kept[0].on_a_common_machine()), json(&direct));
}

#[test]
fn a_choice_that_was_stopped_is_none() {
    let asked = scenario(&accurate_dipole(1e-6, 2.0));
    let watch = Watch::default();
    watch.cancelled.store(true, std::sync::atomic::Ordering::Relaxed);
    assert_eq!(Settled::new(&asked, &watch), Err(Unsettled::Cancelled));
}

#[test]
fn a_search_may_cost_no_more_than_it_is_allowed() {
    let asked = scenario(&accurate_dipole(1e-10, 2.0));
    let allowing = |ns: u64| Watch { allowance_ns: Some(ns.into()), ..Watch::default() };
    let short = Settled::new(&asked, &allowing(1_000_000));
    let too_expensive = Obstacle::TooExpensive { allowed_s: 1e-3 };
    assert_eq!(short, Err(Unsettled::OutOfReach { asked: 1e-10, why: too_expensive }));
    let reported = ScenarioError::from(short.expect_err("too expensive"));
    assert_eq!(reported.pointer, "/accuracy/error");
    assert!(reported.message.contains("give `method`"), "{reported}");
    assert!(Settled::new(&asked, &allowing(1_000_000_000)).is_ok());
}

/// The reference of this scene alone takes many seconds, its steps milliseconds.
#[test]
fn a_long_choice_is_stopped_in_the_middle() {
    let mut numbers = Numbers(60);
    let n = 16;
    let mut list = |scale: f64| -> Vec<f64> { (0..n).map(|_| scale * numbers.next()).collect() };
    let spring = |list: &mut dyn FnMut(f64) -> Vec<f64>| json!({"kind": "spring", "stiffness": 3.0, "rest_length": 0.5, "body_point": list(1.0), "position": list(2.0)});
    let springs: Vec<Value> = (0..60).map(|_| spring(&mut list)).collect();
    let asked = scenario(&json!({
        "name": "springs",
        "scene": {"inertia": {"second_moments": vec![1.0; n]}, "potential": springs},
        "accuracy": {"error": 1e-6},
        "duration_s": 1e3,
    }));
    let watch = Watch::default();
    let stop = watch.cancelled.clone();
    let choice = std::thread::scope(|scope| {
        let settling = scope.spawn(|| Settled::new(&asked, &watch));
        std::thread::sleep(std::time::Duration::from_millis(200));
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
        settling.join().expect("no panic")
    });
    assert_eq!(choice, Err(Unsettled::Cancelled));
}

/// More steps than a run may have.
#[test]
fn a_choice_that_cannot_be_run_is_none() {
    let asked = scenario(&json!({
        "name": "fast for long",
        "scene": {
            "inertia": {"principal": [1.0, 1.1, 1.3]},
            "initial": {"angular_velocity": {"body": [1e5, 2e5, 3e5]}}
        },
        "accuracy": {"error": 1e-2},
        "duration_s": 2e9,
        "log": {"every": 1_000_000_000_000_u64},
    }));
    match Settled::new(&asked, &Watch::default()) {
        Err(Unsettled::OutOfReach { why, .. }) => println!("{why}"),
        other => panic!("{other:?}"),
    }
}

/// Runs of 60 to 800 s whose ends are known independently: Taylor series in 80-bit floats, with the growth of a
/// perturbation of the start.
const LONG_RUNS: &str = include_str!("../data/long-runs.json");

/// Returns the error of a run's end, as an accuracy means it.
fn missed(run: &Value, summary: &Value) -> f64 {
    let number = |value: &Value| value.as_f64().expect("a number");
    let numbers = |rows: &Value| -> Vec<f64> {
        let rows = rows.as_array().expect("rows");
        rows.iter().flat_map(|row| row.as_array().expect("a row").iter().map(number)).collect()
    };
    let apart = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>()
    };
    let (attitude, reached) = (numbers(&run["attitude"]), numbers(&summary["final"]["attitude"]));
    let n = run["attitude"].as_array().map_or(0, Vec::len);
    let given = &summary["final"]["body_momentum"];
    let momentum: Vec<f64> = if n == 3 {
        [(2, 1.0), (1, -1.0), (0, 1.0)].map(|(k, sign)| sign * number(&given[k])).to_vec()
    } else {
        (0..n).flat_map(|i| (0..i).map(move |j| number(&given[i][j]))).collect()
    };
    let expected: Vec<f64> = run["momentum_below_diagonal"]
        .as_array()
        .map(|entries| entries.iter().map(number).collect())
        .unwrap_or_default();
    (0.5 * apart(&attitude, &reached)).sqrt()
        + apart(&momentum, &expected).sqrt() / number(&run["largest_momentum"])
}

#[test]
fn accuracies_of_long_runs_are_met_or_refused_with_their_time() {
    let runs: Vec<Value> = serde_json::from_str(LONG_RUNS).expect("JSON");
    let directory = tempfile::tempdir().expect("a temporary directory");
    let (mut met, mut refused) = (0, 0);
    for (number, known) in runs.iter().enumerate() {
        for error in [1e-4, 1e-6, 1e-8] {
            let asked = json!({
                "name": "long", "scene": known["scene"], "duration_s": known["duration_s"],
                "accuracy": {"error": error}, "log": {"every": 1_000_000, "channels": ["/state"]}
            });
            let duration_s = known["duration_s"].as_f64().expect("a number");
            let grown = known["perturbation_grows_by"].as_f64().expect("a number");
            match Settled::new(&scenario(&asked), &Watch::default()) {
                Ok(settled) => {
                    let summary = run(&asked.to_string(), &directory.path().join("log.mcap"));
                    let summary = serde_json::to_value(&summary).expect("JSON");
                    let reached = missed(known, &summary);
                    let told = error_at_end(&settled.plan().expect("a plan"));
                    println!("{number}: {error:.0e} asked, {reached:.1e} reached, told {told:?}");
                    assert!(reached <= error, "{number}: {reached:e} for {error:e}");
                    let is_true = match told {
                        Ok(ErrorAtEnd::About(told)) => (told / 3.0..3.0 * told).contains(&reached),
                        Ok(ErrorAtEnd::Below(bound)) => reached <= bound,
                        Err(_) => false,
                    };
                    assert!(is_true, "{number}: {reached:e}, told {told:?}");
                    met += 1;
                }
                Err(Unsettled::OutOfReach {
                    why: Obstacle::Untold { until_s, growth, .. },
                    ..
                }) => {
                    let doubles_s =
                        known["doubles_until_s"][format!("{error:e}")].as_f64().expect("a number");
                    println!(
                        "{number}: {error:.0e} until {until_s:.0} s, by the growth {doubles_s:.0} of {duration_s} s; {growth}"
                    );
                    assert!(matches!(growth, Growth::Exponential { .. }), "{number}: {growth}");
                    // The error comes from a rounding of the start and from roundings on the way: a
                    // few dozen times that.
                    assert!(60.0 * grown * f64::EPSILON > error, "{number}: {grown:e}");
                    assert!(
                        (until_s / doubles_s - 1.0).abs() < 0.3,
                        "{number}: {until_s} {doubles_s}"
                    );
                    refused += 1;
                }
                Err(other) => panic!("{number}: {other}"),
            }
        }
    }
    println!("{met} met, {refused} refused");
    assert!(met >= 16 && refused >= 4, "{met} met, {refused} refused");
}

/// A run too long to be seen to its end is followed far past its reference, and made with more care than the same for that time.
#[test]
fn what_cannot_be_seen_to_its_end_is_made_with_care() {
    let runs: Vec<Value> = serde_json::from_str(LONG_RUNS).expect("JSON");
    let springs = runs.last().expect("the last of them");
    let [seen, unseen] = [748.1, 150_000.0].map(|duration_s| {
        let asked = json!({
            "name": "long", "scene": springs["scene"], "duration_s": duration_s,
            "accuracy": {"error": 1e-4}, "log": {"every": 1_000_000, "channels": ["/state"]}
        });
        let plan = advise::plan(&scenario(&asked)).expect("a plan");
        let pilot_time_s = plan.advice.expect("the choice is reported").pilot_time_s;
        (plan.formulation.order, plan.step_s, pilot_time_s)
    });
    println!("{seen:?} {unseen:?}");
    assert_eq!(seen.2, 748.1);
    assert!((5_000.0..150_000.0).contains(&unseen.2), "{}", unseen.2);
    assert!(unseen.0 >= seen.0 && unseen.1 < seen.1, "{seen:?} {unseen:?}");
}

/// Solutions to round-off came near each other here by luck, and runs were accepted that missed the
/// accuracy.
#[test]
fn what_a_rounding_of_the_start_grows_past_is_refused() {
    let spring = |stiffness: f64, body_point: [f64; 3], position: [f64; 3]| json!({"kind": "spring", "stiffness": stiffness, "body_point": body_point, "position": position});
    let three_springs = json!({
        "name": "springs", "accuracy": {"error": 1e-8}, "duration_s": 475.9,
        "scene": {
            "inertia": {"matrix": [
                [0.700867, -0.0544059, -0.0327044],
                [-0.0544059, 0.450449, -0.0378175],
                [-0.0327044, -0.0378175, 0.726484]
            ]},
            "potential": [
                spring(0.3918, [0.2731, -0.7365, 0.368], [-0.3616, -0.2975, 0.5111]),
                spring(0.3225, [-0.1549, -0.4104, 0.05109], [1.245, -0.7926, -0.7459]),
                spring(0.3893, [0.1437, 0.1341, 0.2529], [0.9808, -0.0711, -1.613])
            ],
            "initial": {
                "attitude": {"quaternion": [0.22998644021102368, -0.38638709444493186, 0.7687889380879693, -0.4547249929782143]},
                "angular_velocity": {"body": [-0.1171, -1.174, 0.05938]}
            }
        }
    });
    let four_laws = json!({
        "name": "laws", "accuracy": {"error": 1e-6}, "duration_s": 272.2,
        "scene": {
            "inertia": {"matrix": [
                [0.776206, 0.0304267, 0.0087872],
                [0.0304267, 0.63261, 0.105675],
                [0.0087872, 0.105675, 0.942584]
            ]},
            "potential": [
                {"kind": "gravity_gradient", "strength": 0.08168, "direction": [-0.04404, -0.9794, 0.1971],
                 "matrix": [[2.216, -1.086, -0.2062], [-1.086, 0.4002, -0.2541], [-0.2062, -0.2541, 1.248]]},
                {"kind": "point_source", "strength": 0.01126, "body_point": [0.3222, -0.02984, 0.3446], "position": [-0.4171, 0.4226, -0.4558]},
                {"kind": "uniform", "weight": 0.09327, "body_point": [-0.4061, 0.1454, -0.07528], "direction": [-0.5003, 0.8582, -0.1149]},
                {"kind": "spring", "stiffness": 0.02424, "rest_length": 0.8844, "body_point": [0.282, 0.4452, -0.2865], "position": [-0.2446, -2.505, -1.247]}
            ],
            "initial": {"angular_velocity": {"body": [1.69, 0.3227, -0.5345]}}
        }
    });
    // The member of an ensemble whose start is moved twelve times as far as in most directions.
    let source = |strength: f64, body_point: [f64; 3], position: [f64; 3]| json!({"kind": "point_source", "strength": strength, "body_point": body_point, "position": position});
    let three_sources = json!({
        "name": "sources", "accuracy": {"error": 1e-6}, "duration_s": 80.76,
        "scene": {
            "inertia": {"principal": [0.4046, 0.5711, 0.7641]},
            "potential": [
                source(-0.4476, [0.02429, 0.779, 0.3973], [-0.1537, 0.2234, 0.03333]),
                source(0.1876, [0.222, 0.1963, 0.0636], [-0.361, 0.4162, 0.06901]),
                source(-0.304, [0.1357, 0.5819, 0.2104], [-0.1356, -0.1724, 0.04993])
            ],
            "initial": {
                "attitude": {"quaternion": [0.917972843913229, -0.13645017029268924, -0.3274393783903562, -0.17745608567837765]},
                "momentum": {"body": [0.7559262725266104, -0.9881397142043008, -0.7541622664207842]}
            }
        }
    });
    for asked in [three_springs, four_laws, three_sources] {
        let duration_s = asked["duration_s"].as_f64().expect("a number");
        match Settled::new(&scenario(&asked), &Watch::default()) {
            Err(Unsettled::OutOfReach {
                why: Obstacle::Untold { until_s, growth, .. }, ..
            }) => {
                assert!(matches!(growth, Growth::Exponential { .. }), "{growth}");
                assert!(until_s > 0.5 * duration_s && until_s < duration_s, "{until_s}");
            }
            other => panic!("{other:?}"),
        }
    }
}

/// Adaptive steps share the rounding of an energy, which a passage multiplies by 1e8; both of their
/// families had it. The end is that of Taylor series in 80-bit floats, known to 5e-12.
#[test]
fn a_reference_past_point_sources_knows_the_rounding_of_its_energy() {
    let source = |strength: f64, body_point: [f64; 3], position: [f64; 3]| json!({"kind": "point_source", "strength": strength, "body_point": body_point, "position": position});
    let asked = json!({
        "name": "passages", "accuracy": {"error": 5e-8}, "duration_s": 109.6,
        "log": {"every": 1_000_000, "channels": ["/state"]},
        "scene": {
            "inertia": {"principal": [0.5084, 0.7128, 0.839]},
            "potential": [
                source(0.004692, [0.3182, 0.1604, 0.514], [-0.6025, -0.1406, 0.2788]),
                source(0.05397, [-0.4884, 0.3355, 0.2613], [-0.2772, -1.04, -0.6556]),
                source(-0.002466, [0.1756, 0.3081, 0.2854], [0.1736, -0.06621, 0.446])
            ],
            "initial": {
                "attitude": {"axis_angle": {"axis": [0.1953, 0.05038, -0.9795], "angle_rad": 0.6875}},
                "angular_velocity": {"body": [0.2315, 2.064, -0.3047]}
            }
        }
    });
    let known = json!({
        "attitude": [
            [-0.207853136915756, 0.09054973610683976, -0.973959865069019],
            [0.7361786829046353, 0.6701138258309115, -0.09480721104987293],
            [0.6440792034455672, -0.7367144668874369, -0.20594604625406912]
        ],
        "momentum_below_diagonal": [-1.0760422465034347, -0.8548455309441525, 0.5760856737104644],
        "largest_momentum": 1.4
    });
    let directory = tempfile::tempdir().expect("a temporary directory");
    let summary = run(&asked.to_string(), &directory.path().join("log.mcap"));
    let reached = missed(&known, &serde_json::to_value(&summary).expect("JSON"));
    assert!(reached <= 5e-8, "{reached:e}");
}

/// Explicit steps of eighth order, next to which VPD is checked, know this end to 1e-10 at best: their round-off was taken for
/// what can be known, and 1e-9 was refused. A rounding of the start grows to 4e-13. The end is that of Taylor series in 80-bit
/// floats from knot to knot, known to 2e-15.
#[test]
fn the_round_off_of_explicit_steps_is_not_what_can_be_known_of_a_burn() {
    let burn = json!({
        "along": {"space": [-0.2329918741653768, -0.5269515551585677, 0.8173352097449811]},
        "table": {
            "times_s": [0.0, 64.815531960409, 65.49190650903225, 65.73674763698806, 3404.0],
            "values": [0.0, 0.27210353127753023, 0.13605176563876512, 0, 0.0], "interpolation": "hold"
        }
    });
    let turned =
        [-0.5956510647805234, 0.15807813775837318, -0.785446802922238, 0.057309956970045366];
    let asked = json!({
        "name": "burn", "accuracy": {"error": 1e-9}, "duration_s": 3404.0,
        "log": {"every": 1_000_000, "channels": ["/state"]},
        "scene": {
            "inertia": {"principal": [0.805852403783377, 0.3350162060360464, 0.8485408588412309]},
            "torques": [{"table": burn}],
            "initial": {
                "attitude": {"quaternion": turned},
                "angular_velocity": {"body": [0.018058622847132215, -0.02633659480840313, -0.049888607164397636]}
            }
        }
    });
    let known = json!({
        "attitude": [
            [-0.8179431725418511, -0.30659286938925784, 0.4867954179445745],
            [0.25188859579406364, -0.9515997263801622, -0.176096837172322],
            [0.5172244211182089, -0.021418991406271654, 0.8555817465362803]
        ],
        "momentum_below_diagonal": [0.13089364278100088, -0.14991974705914668, 0.13531983575145465],
        "largest_momentum": 0.24066685319453418
    });
    let directory = tempfile::tempdir().expect("a temporary directory");
    let summary = run(&asked.to_string(), &directory.path().join("log.mcap"));
    let reached = missed(&known, &serde_json::to_value(&summary).expect("JSON"));
    assert!(reached <= 1e-9, "{reached:e}");
}

/// A thruster burns for 70 s in the middle of hours, far from the first part of the run, that trial runs see. The right end is that
/// of steps of half a second with four stages: those of a second end 5e-14 from it.
#[test]
fn a_late_burn_is_seen_by_accuracies_and_by_the_error_of_a_run() {
    let burn = json!({"times_s": [0, 600, 603, 667, 670, 17000], "values": [0, 0, 4e-4, 4e-4, 0, 0], "interpolation": "linear"});
    let given = |fields: &Value| {
        let mut scenario = json!({
            "name": "thruster", "duration_s": 17000, "log": {"every": 1_000_000, "channels": ["/state"]},
            "scene": {
                "inertia": {"principal": [1, 1.3, 1.7]},
                "initial": {"angular_velocity": {"body": [0.002, 0.01, -0.004]}},
                "torques": [{"table": {"along": {"body": [0.3, -0.5, 0.8]}, "table": burn}}]
            }
        });
        for (field, value) in fields.as_object().expect("an object") {
            scenario[field] = value.clone();
        }
        scenario
    };
    let directory = tempfile::tempdir().expect("a temporary directory");
    let end = |fields: &Value| {
        let path = directory.path().join("log.mcap");
        let summary = run(&given(fields).to_string(), &path);
        assert_eq!(summary.outcome, Outcome::Succeeded, "{fields}: {:?}", summary.diagnosis);
        std::fs::remove_file(path).expect("a log");
        let list = |value: Value| -> Vec<f64> { serde_json::from_value(value).expect("numbers") };
        (summary.last.attitude.expect("logged").concat(), list(summary.last.body_momentum))
    };
    let right = end(&json!({"method": {"name": "vpd", "tableau": "gauss4"}, "step_s": 0.5}));
    let size = |of: &[f64]| of.iter().map(|x| x * x).sum::<f64>().sqrt();
    // The turn between the two, and the difference of the momenta in parts of the momentum.
    let missed = |end: &(Vec<f64>, Vec<f64>)| {
        let apart =
            |a: &[f64], b: &[f64]| size(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>());
        apart(&end.0, &right.0) / 2.0_f64.sqrt() + apart(&end.1, &right.1) / size(&right.1)
    };
    for error in [1e-6, 1e-8] {
        let reached = missed(&end(&json!({"accuracy": {"error": error}})));
        assert!(reached <= error, "{error:e} asked, {reached:e} reached");
    }
    // The first steps have the knots inside of them, the others have some at their ends.
    for step_s in [8.0, 10.0] {
        let fields = json!({"method": {"name": "vpd", "tableau": "gauss2"}, "step_s": step_s});
        let plan = advise::plan(&scenario(&given(&fields))).expect("a plan");
        let reached = missed(&end(&fields));
        let told = error_at_end(&plan).expect("a reference");
        let ErrorAtEnd::About(told) = told else { panic!("{told:?}, {reached:e} reached") };
        assert!(told > reached / 2.0 && told < 2.0 * reached, "{told:e} told, {reached:e} reached");
    }
}

/// The motion diverges within a few of the points at which solutions are compared.
#[test]
fn chaos_at_the_beginning_of_a_long_run_is_told_from_a_power() {
    let spring = json!({"kind": "spring", "stiffness": 3.0, "rest_length": 0.5, "body_point": [0.3, 0.2, 0.6], "position": [0.5, -1.0, 1.0]});
    let field = json!({"kind": "uniform", "weight": 2.0, "body_point": [0.1, 0.0, 0.5], "direction": [1.0, 0.0, 0.0]});
    let asked = scenario(&json!({
        "name": "chaos", "accuracy": {"error": 1e-8}, "duration_s": 800.0,
        "scene": {
            "inertia": {"principal": [1.0, 1.4, 2.0]}, "potential": [spring, field],
            "initial": {"angular_velocity": {"body": [0.2, 0.9, 0.4]}}
        },
    }));
    match Settled::new(&asked, &Watch::default()) {
        Err(Unsettled::OutOfReach { why: Obstacle::Untold { until_s, growth, .. }, .. }) => {
            assert!(matches!(growth, Growth::Exponential { .. }), "{growth}");
            assert!(until_s > 100.0 && until_s < 400.0, "{until_s}");
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_member_of_an_ensemble_keeps_the_accuracy() {
    let spring = json!({"kind": "spring", "stiffness": 3.0, "rest_length": 0.5, "body_point": [0.3, 0.2, 0.6], "position": [0.5, -1.0, 1.0]});
    let scene = json!({
        "inertia": {"principal": [1.0, 1.4, 2.0]}, "potential": [spring],
        "initial": {"angular_velocity": {"body": [0.2, 0.9, 0.4]}}
    });
    let mut asked = json!({
        "name": "members", "scene": scene, "accuracy": {"error": 1e-6}, "duration_s": 12.0,
        "ensemble": {"members": 24, "seed": 5, "attitude_spread_rad": 0.6, "momentum_spread": 0.6},
    });
    let settled = every_member_keeps_it(&asked);
    // The nominal run alone is content with less.
    asked.as_object_mut().expect("an object").remove("ensemble");
    let nominal = advise::plan(&scenario(&asked)).expect("within reach").settled;
    assert!(settled.steps > nominal.steps, "{:?} {:?}", settled.steps, nominal.steps);
}

/// With 300 steps the error of member 1 is 1.2e-7 by luck; with the 320 that member 3 needs, 1.4e-6.
#[test]
fn a_member_keeps_the_accuracy_with_the_step_of_another() {
    let gradient = json!({"kind": "gravity_gradient", "strength": 0.001384, "direction": [0.6504, 0.7489, 0.127]});
    let spring = json!({"kind": "spring", "stiffness": 0.000864, "rest_length": 0.2171, "body_point": [-0.4344, 0.4856, 0.6741], "position": [0.7287, -0.4278, 0.1243]});
    let turned = [-0.3314890693805942, 0.7596160969991281, 0.516008866835336, 0.21640986901782297];
    let scene = json!({
        "inertia": {"principal": [0.233, 0.2954, 0.2732]}, "potential": [gradient, spring],
        "initial": {"attitude": {"quaternion": turned}, "angular_velocity": {"space": [0.06278, -0.2933, 0.205]}}
    });
    every_member_keeps_it(&json!({
        "name": "luck", "scene": scene, "accuracy": {"error": 1e-6}, "duration_s": 247.3,
        "ensemble": {"members": 11, "seed": 13, "attitude_spread_rad": 0.01329, "momentum_spread": 0.002565},
    }));
}

/// Errors of member 1 grow two million times: a second family of solutions scatters by 4e-10, while two of the first agree to
/// 1e-12. Both are far below the error asked for.
#[test]
fn a_reference_that_scatters_is_good_enough_for_a_larger_error() {
    let matrix =
        json!([[-0.2203, 0.3555, -0.05998], [0.3555, 0.0491, 0.5803], [-0.05998, 0.5803, -1.951]]);
    let gradient = json!({"kind": "gravity_gradient", "strength": 1.516, "direction": [-0.8642, 0.2452, -0.4393], "matrix": matrix});
    let turned =
        [0.8251120958845196, -0.09385895226616972, -0.5532152401266619, 0.06582875052856427];
    let scene = json!({
        "inertia": {"principal": [1.149, 0.6654, 1.3308]}, "potential": [gradient],
        "initial": {"attitude": {"quaternion": turned}, "angular_velocity": {"body": [0.5694, -0.6422, -0.1339]}}
    });
    every_member_keeps_it(&json!({
        "name": "scattered", "scene": scene, "accuracy": {"error": 1e-4}, "duration_s": 89.36,
        "ensemble": {"members": 11, "seed": 12, "attitude_spread_rad": 0.06482, "momentum_spread": 0.3155},
    }));
}

/// Returns the scenario with the chosen method and step, with which every member keeps the accuracy.
fn every_member_keeps_it(asked: &Value) -> Scenario {
    let error = asked["accuracy"]["error"].as_f64().expect("a number");
    let members = asked["ensemble"]["members"].as_u64().expect("a number") as usize;
    let Plan { settled, advice, .. } = advise::plan(&scenario(asked)).expect("within reach");
    let advice = advice.expect("the choice is reported");
    assert!(advice.expected_error <= error, "{:e}", advice.expected_error);
    // Half the step moves no member by more than the requested error.
    let mut finer = settled.clone();
    finer.steps = settled.steps.map(|steps| 2 * steps);
    finer.step_s = settled.step_s.map(|step_s| 0.5 * step_s);
    let ended = |of: &Scenario| {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("log.mcap");
        run(&String::from_utf8(of.to_json()).expect("text"), &path);
        ends(&path)
    };
    let (coarse, fine) = (ended(&settled), ended(&finer));
    assert_eq!((coarse.len(), fine.len()), (members, members));
    for (member, (a, b)) in coarse.values().zip(fine.values()).enumerate() {
        let apart = (0.5 * a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>()).sqrt();
        assert!(apart <= error, "member {member}: {apart:e}");
    }
    settled
}

#[test]
fn symplectic_keeps_to_symplectic_methods() {
    let mut asked = accurate_dipole(1e-6, 20.0);
    asked["accuracy"]["symplectic"] = json!(true);
    let tried = |asked: &Value| {
        let plan = advise::plan(&scenario(asked)).expect("within reach");
        plan.advice.expect("the choice is reported").candidates
    };
    let (symplectic, any) = (tried(&asked), tried(&accurate_dipole(1e-6, 20.0)));
    assert!(symplectic.iter().all(|tried| tried.method.facts().symplectic), "{symplectic:?}");
    assert!(any.iter().any(|tried| !tried.method.facts().symplectic), "{any:?}");
}
