//! Runs of several bodies, from their scenario to their log.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use vpd::advise::{self, Settled};
use vpd::log::reader::{Message, read_samples};
use vpd::plan::Plan;
use vpd::run::{Control, JobContext, Outcome, Summary, collect, execute};
use vpd::scenario::Scenario;
use vpd::study::Watch;
use vpd::verify;

pub(crate) fn shipped(name: &str) -> Value {
    let text = fs::read_to_string(format!("scenarios/{name}.json")).expect("shipped");
    serde_json::from_str(&text).expect("JSON")
}

pub(crate) fn plan(scenario: &Value) -> Plan {
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario");
    advise::plan(&scenario).expect("a plan")
}

pub(crate) fn run(scenario: &Value, log: &Path) -> Summary {
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
fn steps_by_hand_refuse_several_bodies() {
    let chain = Scenario::from_json(shipped("chain").to_string().as_bytes()).expect("good");
    let refused = vpd::run::Simulation::new(&chain).map(drop).expect_err("one body");
    assert_eq!(refused.pointer, "/scene/bodies");
}

/// The differences of two ends: attitudes, and positions in m.
fn apart(a: &Summary, b: &Summary) -> [f64; 2] {
    let mut most = [0.0_f64; 2];
    for (name, a) in &a.last.bodies {
        let b = &b.last.bodies[name];
        for (a, b) in a.attitude.iter().flatten().zip(b.attitude.iter().flatten()) {
            most[0] = most[0].max((a - b).abs());
        }
        for (a, b) in a.position.iter().zip(&b.position) {
            most[1] = most[1].max((a - b).abs());
        }
    }
    most
}

/// An accuracy is reached, against short steps of another tableau, and not by far more work than it takes.
#[test]
fn an_accuracy_chooses_method_and_step() {
    let folder = tempfile::tempdir().expect("a folder");
    // With the longest way of a body in it, in m.
    for (name, duration_s, error, way_m) in [
        ("tether", 60.0, 1e-6, 10.0),
        ("chain", 0.5, 1e-8, 1.0),
        ("compass-needles", 2.0, 1e-9, 0.0),
    ] {
        let mut scenario = shipped(name);
        let scene = scenario.as_object_mut().expect("an object");
        for key in ["method", "step_s", "log", "expect"] {
            scene.remove(key);
        }
        scenario["duration_s"] = json!(duration_s);
        let mut asked = scenario.clone();
        asked["accuracy"] = json!({ "error": error });
        let planned = plan(&asked);
        let advice = planned.advice.as_ref().expect("a choice");
        assert!(
            advice.expected_error <= error && advice.candidates.len() > 3,
            "{name}: {advice:?}"
        );
        let chosen = run(&asked, &folder.path().join(format!("{name}.mcap")));
        scenario["method"] = json!({ "name": "vpd", "tableau": "gauss6" });
        scenario["step_s"] = json!(duration_s / 1000.0);
        let exact = run(&scenario, &folder.path().join(format!("{name}-exact.mcap")));
        let [turned, moved_m] = apart(&chosen, &exact);
        assert!(
            turned <= error && moved_m <= error * f64::max(way_m, 1e-9),
            "{name}: {turned:e}, {moved_m:e} m"
        );
        // The step is the longest that does, or nearly: one of three times the length does not.
        let mut longer = scenario.clone();
        longer["method"] = serde_json::to_value(&planned.settled.method).expect("JSON");
        let steps = (duration_s / (3.0 * planned.step_s)).floor().max(1.0);
        longer["step_s"] = json!(duration_s / steps);
        let longer = run(&longer, &folder.path().join(format!("{name}-longer.mcap")));
        let missed =
            longer.outcome != Outcome::Succeeded || apart(&longer, &exact)[0] > 0.1 * error;
        assert!(missed, "{name}: {:?}", apart(&longer, &exact));
    }
}

/// Errors and work, borders and long runs of several bodies, as of one.
#[test]
fn studies_take_several_bodies() {
    let mut scenario = shipped("compass-needles");
    scenario["duration_s"] = json!(1);
    let scene = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
    let watch = Watch::default();
    let mut entries = vpd::study::usual_methods(&scene);
    let labels: Vec<String> = entries.iter().map(vpd::study::Entry::label).collect();
    let some = ["vpd gauss2", "vpd gauss3", "rk_projected rk8", "rkmk rk4", "splitting order 4"];
    for label in some {
        assert!(labels.iter().any(|entry| entry == label), "{label}: {labels:?}");
    }
    // Those of one body that several cannot run take no part.
    assert!(
        labels.iter().all(|label| !label.contains("lagrangian") && !label.contains("quaternion"))
    );
    entries.retain(|entry| some.contains(&entry.label().as_str()));
    let found =
        vpd::study::precision::precision(&scene, &entries, Some(0.5), &watch).expect("a study");
    for (line, entry) in entries.iter().enumerate() {
        if let Some(order) = found.measured_order(line) {
            let off = (order - f64::from(entry.order)).abs();
            assert!(off < 0.35, "{}: {order} for {}", entry.label(), entry.order);
        }
    }
    assert!((0..entries.len()).filter(|&line| found.measured_order(line).is_some()).count() > 2);
    let two =
        &entries[labels.iter().position(|label| label == "vpd gauss2").expect("there")..][..1];
    let map = vpd::study::stability::stability(&scene, two, &watch).expect("a map");
    let border = &map.borders[0];
    assert!(border.usable_step_s.is_some_and(|step_s| step_s > 0.01), "{border:?}");
    let long = vpd::study::long_term::long_term(&scene, two, &watch).expect("runs");
    assert_eq!(long.table.rows.len(), 1);
}

/// What nothing acts on is not solved with the others, which then end to the bit as without it.
#[test]
fn a_body_by_itself_moves_exactly_and_costs_the_others_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut alone = shipped("tether");
    alone["duration_s"] = json!(30);
    alone.as_object_mut().expect("an object").remove("method");
    let mut with = alone.clone();
    let drifter = json!({
        "name": "drifter", "mass": 3.0, "inertia": { "principal": [1.0, 2.0, 2.5] },
        "initial": { "position": [50, 0, 1], "velocity": [0.1, -0.2, 0.3], "angular_velocity": { "body": [0.3, 1.0, 0.02] } }
    });
    with["scene"]["bodies"].as_array_mut().expect("bodies").insert(1, drifter);
    let planned = plan(&with);
    let exact: Vec<bool> = planned.bodies.iter().map(|body| body.exact).collect();
    assert_eq!(exact, [false, true, false]);
    let ends = [("alone", &alone), ("with", &with)];
    let [without, beside] =
        ends.map(|(name, scenario)| run(scenario, &folder.path().join(format!("{name}.mcap"))));
    for name in ["primary", "secondary"] {
        assert_eq!(without.last.bodies[name], beside.last.bodies[name], "{name}");
    }
    let drifter = &beside.last.bodies["drifter"];
    for (x, expected) in drifter.position.iter().zip([53.0, -6.0, 10.0]) {
        assert!((x - expected).abs() < 1e-13, "{x}, {expected}");
    }
    // The same body in a scene of one.
    let one = json!({
        "name": "one", "step_s": 30.0, "steps": 1,
        "scene": { "inertia": { "principal": [1.0, 2.0, 2.5] }, "initial": { "angular_velocity": { "body": [0.3, 1.0, 0.02] } } }
    });
    let one = run(&one, &folder.path().join("one.mcap")).last.attitude.expect("an attitude");
    for (a, b) in one.iter().flatten().zip(drifter.attitude.iter().flatten()) {
        assert!((a - b).abs() < 1e-12, "{a}, {b}");
    }
    // A method that was asked for takes all.
    with["method"] = json!({ "name": "vpd", "tableau": "gauss2" });
    assert!(plan(&with).bodies.iter().all(|body| !body.exact));
    let log = folder.path().join("with.mcap");
    let verified = verify::verify(&log).expect("a run again");
    assert!(verified.same, "{verified:?}");
}

/// Searches end by counts of sweeps: if these seem cheap, a search takes minutes.
#[test]
fn the_sweeps_of_several_bodies_are_most_of_a_step() {
    let scene = Scenario::from_json(shipped("chain").to_string().as_bytes()).expect("good");
    let plan = vpd::plan::Plan::new(&scene).expect("a plan");
    // A step is taken to need this many of them.
    let swept_ns = 5.0 * plan.sweep_cost_ns();
    assert!(swept_ns > 0.5 * plan.step_ns, "{swept_ns} of {}", plan.step_ns);
}

/// A probe that falls past a planet: the distance of an orbit is known in closed form.
pub(crate) fn flyby(until: Value) -> Value {
    json!({
        "name": "flyby",
        "scene": {
            "bodies": [
                { "name": "planet", "pivot": [0, 0, 0], "inertia": { "principal": [1, 1, 1] } },
                { "name": "probe", "mass": 0.5, "inertia": { "principal": [0.1, 0.2, 0.25] },
                  "initial": { "position": [1, 0, 0], "velocity": [0, 0.5, 0], "angular_velocity": { "body": [0, 0, 0.3] } } },
            ],
            "potential": [
                { "kind": "point_source", "between": ["planet", "probe"], "points": [[0, 0, 0], [0, 0, 0]], "strength": -0.5 },
            ],
        },
        "method": { "name": "vpd", "tableau": "gauss6" },
        "until": until,
        "step_s": 0.02,
        "duration_s": 4,
        "log": { "every": 1 },
    })
}

/// The time at which the distance on the orbit of `flyby`, which begins at its farthest point 1 with mu = 1 and v = 1/2, falls to
/// `r`: by Kepler's equation, `a (1 - e cos E) = r`, `t = (E - e sin E) a^(3/2)` from the nearest point.
fn falls_to_s(r: f64) -> f64 {
    let (a, e): (f64, f64) = (1.0 / 1.75, 0.75);
    let anomaly = f64::acos((1.0 - r / a) / e);
    let motion = a.powf(-1.5);
    (std::f64::consts::PI - (anomaly - e * anomaly.sin())) / motion
}

#[test]
fn a_run_ends_where_two_bodies_are_near_enough() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("flyby.mcap");
    let limit = json!({ "distance_m": 0.4, "between": ["planet", "probe"] });
    let expected_s = falls_to_s(0.4);
    for name in ["vpd", "rkmk", "rk_projected", "splitting"] {
        let mut scenario = flyby(json!([{ "distance_below_m": limit, "exact": true }]));
        scenario["method"] = match name {
            "vpd" => json!({ "name": name, "tableau": "gauss6" }),
            "splitting" => json!({ "name": name, "order": 8 }),
            _ => json!({ "name": name, "tableau": "rk8" }),
        };
        let ended = run(&scenario, &log);
        assert_eq!(ended.outcome, Outcome::Succeeded);
        let off = ended.time_s - expected_s;
        println!("{name}: {:.12} s, {off:.1e} s off", ended.time_s);
        assert!(off.abs() < 3e-9, "{name}: {off:e}");
        let why = ended.stopped.expect("a condition");
        assert!(why.starts_with("distance of planet and probe below 0.4 m at t = "), "{why}");
        assert!(why.ends_with("(/until/0)"), "{why}");
        let at = &ended.last.bodies["probe"].position;
        let distance = at.iter().map(|x| x * x).sum::<f64>().sqrt();
        assert!((distance - 0.4).abs() < 1e-8, "{distance}");
        let verified = verify::verify(&log).expect("a run again");
        assert!(verified.same, "{verified:?}");
    }
    // After a step, and for some time.
    let step = run(&flyby(json!([{ "distance_below_m": limit }])), &log);
    assert_eq!(step.steps, (expected_s / 0.02).ceil() as u64);
    assert!((step.time_s - step.steps as f64 * 0.02).abs() < 1e-12);
    let held = run(&flyby(json!([{ "distance_below_m": limit, "for_s": 0.1 }])), &log);
    assert_eq!(held.steps, step.steps + 5);
    // From the other side, from points of bodies and of space.
    let farther = json!({ "distance_m": 0.2, "between": ["space", "probe"], "points": [[1, 0, 0], [0, 0, 0]] });
    let farther = run(&flyby(json!([{ "distance_above_m": farther, "exact": true }])), &log);
    let at = &farther.last.bodies["probe"].position;
    let distance = ((at[0] - 1.0).powi(2) + at[1].powi(2)).sqrt();
    assert!((distance - 0.2).abs() < 1e-8, "{distance}");
}

#[test]
fn conditions_of_a_body_are_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("flyby.mcap");
    // The probe turns about an axis of inertia at 0.3 rad/s.
    let angle = json!([
        { "body": "planet", "angle_above_rad": { "angle_rad": 0.1 } },
        { "body": "probe", "angle_above_rad": { "angle_rad": 0.31 }, "exact": true },
    ]);
    let ended = run(&flyby(angle), &log);
    assert!((ended.time_s - 0.31 / 0.3).abs() < 3e-9, "{}", ended.time_s);
    let why = ended.stopped.expect("a condition");
    assert!(why.starts_with("angle of probe above 0.31 rad at t = 1.0333"), "{why}");
    let rate = json!([{ "body": "planet", "rate_below_rad_s": 0.1 }]);
    let ended = run(&flyby(rate), &log);
    assert_eq!((ended.steps, ended.stopped.is_some()), (1, true), "it is at rest");
    let energy = json!([{ "energy_error_above_j": 1e-30 }]);
    let ended = run(&flyby(energy), &log);
    assert!(ended.stopped.expect("a condition").starts_with("energy error above"));
}

/// A condition that must hold for some time is resumed in the middle of it, to the same bytes.
#[test]
fn a_run_that_waits_for_its_condition_is_resumed() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    let limit = json!({ "distance_m": 0.9, "between": ["planet", "probe"] });
    let mut scenario = flyby(json!([{ "distance_below_m": limit, "for_s": 1.0 }]));
    scenario["step_s"] = json!(0.0002);
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss2" });
    let reference = run(&scenario, &whole);
    assert!(reference.stopped.is_some());
    let bytes = fs::read(&whole).expect("a log");
    let mut resumed = Vec::new();
    for part in [0.5, 0.9] {
        let _ = fs::remove_file(&cut);
        let beginning = &bytes[..(part * bytes.len() as f64) as usize];
        fs::write(vpd::log::part_path(&cut), beginning).expect("written");
        let summary = run(&scenario, &cut);
        assert!(fs::read(&cut).expect("a log") == bytes, "cut at {part}");
        assert_eq!(summary.stopped, reference.stopped);
        resumed.push(summary.resumed_step);
    }
    println!("resumed at the steps {resumed:?} of {}", reference.steps);
    assert!(resumed[1] > reference.steps - 5000, "while it holds: {resumed:?}");
}

/// Steps that adapt, from the scenario to the log: the orbit of `flyby` comes back to its start after a period. Samples keep their times, and
/// `/pace` shows how the steps shorten.
#[test]
fn steps_adapt_to_bodies_that_come_close() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("run.mcap");
    let mut scenario = flyby(json!([]));
    // Nearer, and a whole number of steps of a revolution: a = 1 / (2 - v^2), e = 1 - v^2.
    let speed = 0.2_f64;
    scenario["scene"]["bodies"][1]["initial"]["velocity"] = json!([0, speed, 0]);
    let period_s = std::f64::consts::TAU * (1.0 / (2.0 - speed * speed)).powf(1.5);
    scenario.as_object_mut().expect("an object").remove("duration_s");
    (scenario["step_s"], scenario["steps"]) = (json!(period_s / 50.0), json!(100));
    scenario["method"] = json!({ "name": "vpd", "tableau": "gauss8" });
    scenario["step"] = json!({ "adaptive": { "largest_step_s": period_s / 12.0 } });
    let planned = plan(&scenario);
    assert_eq!(planned.formulation.method.as_str(), "vpd_adaptive");
    // The distance at the start, which is the longest, is above half of the long axis.
    assert_eq!(planned.own_steps.expect("they adapt").near_m, [1.0]);
    let summary = run(&scenario, &log);
    assert_eq!((summary.outcome, summary.samples), (Outcome::Succeeded, 101));
    let place = &summary.last.bodies["probe"].position;
    let off = ((place[0] - 1.0).powi(2) + place[1].powi(2) + place[2].powi(2)).sqrt();
    assert!(off < 1e-9, "{off:e}");
    let (mut paces, mut times) = (Vec::new(), Vec::new());
    read_samples(&log, |_, message| match message {
        Message::Pace(pace) => paces.push(pace),
        Message::BodyState(state) => times.push(state.time_s),
        _ => {}
    })
    .expect("a good log");
    // Of each of the two bodies.
    assert_eq!((paces.len(), times.len()), (101, 202));
    assert!(times.iter().enumerate().all(|(k, &t)| t == (k / 2) as f64 * (period_s / 50.0)));
    let least = paces.iter().map(|pace| pace.least_sigma).fold(1.0, f64::min);
    // At the pericentre, v^2 / (2 - v^2) = 0.0204: sigma is its power 3/2, but for the length of a step.
    assert!(least > 2.9e-3 && least < 2e-2, "{least:e}");
    assert!(paces.windows(2).all(|pair| pair[0].own_steps <= pair[1].own_steps));
    assert!(paces.iter().all(|pace| pace.time_error_s.abs() <= 1e-14));
    // The method by its name, with a step and a length of its own.
    scenario.as_object_mut().expect("an object").remove("step");
    scenario["method"]["name"] = json!("vpd_adaptive");
    let own = plan(&scenario).own_steps.expect("they adapt");
    assert_eq!(own.largest_step_s, period_s / 50.0);
    scenario["step"] = json!({ "adaptive": { "near_m": [0.7] } });
    assert_eq!(plan(&scenario).own_steps.expect("they adapt").near_m, [0.7]);
    // From the nearest point, half of the long axis is longer than the distance.
    let (near, fast) = (speed * speed / (2.0 - speed * speed), (2.0 - speed * speed) / speed);
    scenario["step"] = json!({ "adaptive": {} });
    scenario["scene"]["bodies"][1]["initial"]["position"] = json!([near, 0, 0]);
    scenario["scene"]["bodies"][1]["initial"]["velocity"] = json!([0, fast, 0]);
    let own = plan(&scenario).own_steps.expect("they adapt");
    assert!((own.near_m[0] - 1.0 / (2.0 - speed * speed)).abs() < 1e-9, "{own:?}");
}

#[test]
fn all_of_the_steps_may_be_left_to_the_program() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut scenario = flyby(json!([{
        "distance_below_m": { "distance_m": 0.3, "between": ["planet", "probe"] }
    }]));
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("step_s");
    fields.remove("method");
    scenario["step"] = json!({ "adaptive": {} });
    let planned = plan(&scenario);
    assert!(planned.step_s > 0.01 && planned.step_s < 1.0, "{}", planned.step_s);
    let summary = run(&scenario, &folder.path().join("run.mcap"));
    assert_eq!(summary.outcome, Outcome::Succeeded);
    assert!(summary.stopped.is_some(), "they come near");
    let late_s = summary.time_s - falls_to_s(0.3);
    assert!(late_s >= 0.0 && late_s < planned.step_s, "{late_s}");
    // Members of an ensemble go on alike.
    scenario["ensemble"] = json!({ "members": 5, "seed": 2, "position_spread_m": 0.01 });
    let many = run(&scenario, &folder.path().join("many.mcap"));
    assert_eq!(many.ensemble.expect("an ensemble").succeeded, 5);
    assert_eq!(many.last, summary.last);
}

/// The longest step is what a failed run is told to shorten.
#[test]
fn of_several_bodies_the_longest_step_may_be_too_long() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut long = flyby(json!([]));
    long["method"] = json!({ "name": "vpd", "tableau": "gauss2" });
    long["step"] = json!({ "adaptive": { "largest_step_s": 30.0 } });
    let failed = run(&long, &folder.path().join("long.mcap"));
    let diagnosis = failed.diagnosis.expect("a step that fails");
    let advised = diagnosis.advised_step_s.expect("a shorter one");
    assert!(advised < 30.0 && diagnosis.advice.contains("largest_step_s"), "{diagnosis}");
    long["step"]["adaptive"]["largest_step_s"] = json!(advised);
    let mended = run(&long, &folder.path().join("mended.mcap"));
    assert_eq!(mended.outcome, Outcome::Succeeded, "{:?}", mended.diagnosis);
}
