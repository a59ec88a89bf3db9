//! Ensembles of several bodies: their starts, their members, their log.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::Path;

use prost::Message as _;
use serde_json::{Value, json};
use vpd::advise;
use vpd::export::{Choice, Format, export};
use vpd::log::members::{MemberOrder, MemberQuantity, Wanted, read_members};
use vpd::log::messages::{BodyState, EnsembleStatistics, Member};
use vpd::log::part_path;
use vpd::log::reader::{self, Item};
use vpd::log::resume::last_checkpoint;
use vpd::log::schema::{Channel, Topic};
use vpd::run::{Outcome, Summary};
use vpd::scenario::Scenario;
use vpd::verify;

use crate::bodies_run::{plan, run, shipped};
use crate::ensemble;

/// A shipped scene as an ensemble of short runs.
fn of_members(name: &str, steps: u64, spread: &Value) -> Value {
    let mut scenario = shipped(name);
    let fields = scenario.as_object_mut().expect("an object");
    fields.remove("duration_s");
    fields.remove("expect");
    fields.insert("steps".into(), json!(steps));
    fields.insert("log".into(), json!({ "every": 5 }));
    fields.insert("ensemble".into(), spread.clone());
    scenario
}

/// What a log holds of its members.
#[derive(Default)]
struct Contents {
    members: BTreeMap<u64, Member>,
    statistics: Vec<EnsembleStatistics>,
    /// The last state of each body of each member that is logged in full, and the number of them.
    states: BTreeMap<(u64, String), (BodyState, u64)>,
    times: Vec<u64>,
}

fn contents(log: &Path) -> Contents {
    let mut found = Contents::default();
    let ending = reader::read(log, |item| {
        if let Item::Message { topic, data, time_ns, .. } = item {
            let Topic { member, channel, body } = Topic::parse(topic).expect("a topic of ours");
            found.times.push(time_ns);
            match channel {
                Channel::EnsembleMembers => {
                    let end = Member::decode(data).expect("ours");
                    assert!(found.members.insert(end.member, end).is_none(), "each ends once");
                }
                Channel::EnsembleStatistics => {
                    found.statistics.push(EnsembleStatistics::decode(data).expect("ours"));
                }
                Channel::BodyState => {
                    let body = body.expect("of a body").as_str().to_owned();
                    let state = BodyState::decode(data).expect("ours");
                    let count = found.states.get(&(member, body.clone())).map_or(0, |(_, k)| *k);
                    found.states.insert((member, body), (state, count + 1));
                }
                _ => {}
            }
        }
        ControlFlow::Continue(())
    });
    assert!(ending.expect("readable").finished);
    found
}

fn initial(member: &Member, body: usize) -> &BodyState {
    member.bodies[body].initial.as_ref().expect("where it began")
}

fn last(member: &Member, body: usize) -> &BodyState {
    member.bodies[body].last.as_ref().expect("where it ended")
}

/// The largest difference of two lists.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn succeeded(summary: &Summary) -> u64 {
    summary.ensemble.as_ref().expect("of an ensemble").succeeded
}

#[test]
fn every_member_ends_once_and_the_log_is_made_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    for (name, spread) in [
        ("tether", json!({ "position_spread_m": 0.1, "velocity_spread_m_s": 0.01 })),
        ("chain", json!({ "attitude_spread_rad": 0.1, "momentum_spread": 0.001 })),
        ("compass-needles", json!({ "attitude_spread_rad": 0.1 })),
    ] {
        let mut spread = spread;
        (spread["members"], spread["seed"]) = (json!(9), json!(7));
        spread["in_full"] = json!([3, 1]);
        let scenario = of_members(name, 40, &spread);
        let summary = run(&scenario, &log);
        assert_eq!((summary.outcome, succeeded(&summary)), (Outcome::Succeeded, 9), "{name}");
        let Contents { members, statistics, states, times } = contents(&log);
        assert!(times.is_sorted(), "log time goes forward");
        assert_eq!(members.keys().copied().collect::<Vec<_>>(), (0..9).collect::<Vec<_>>());
        let names: Vec<String> =
            plan(&scenario).bodies.iter().map(|body| body.name.clone()).collect();
        for number in [0, 1, 3] {
            let end = &members[&number];
            for (body, name) in names.iter().enumerate() {
                assert_eq!(end.bodies[body].name, *name);
                let (state, samples) = &states[&(number, name.clone())];
                // The quaternion of the end has its own sign.
                let quaternion = last(end, body).quaternion.clone();
                assert_eq!(&BodyState { quaternion, ..state.clone() }, last(end, body));
                assert_eq!(*samples, 9);
            }
        }
        assert_eq!(states.len(), 3 * names.len());
        let ends: Vec<&Member> = members.values().collect();
        let distinct = ends.windows(2).filter(|pair| pair[0].bodies != pair[1].bodies).count();
        assert_eq!(distinct, 8);
        let [start, end] = statistics.as_slice() else { panic!("two of them: {statistics:?}") };
        assert_eq!((start.members, end.members, end.failed), (9, 9, 0));
        assert_eq!(end.bodies.len(), names.len());
        let reported = summary.ensemble.expect("of an ensemble");
        for body in &end.bodies {
            let spread = &reported.bodies[&body.name];
            assert_eq!(spread.attitude_spread_rad, body.attitude_spread_rad);
            assert_eq!(spread.position_deviation_m, body.position_deviation);
        }
        let verified = verify::verify(&log).expect("a run again");
        assert!(verified.same, "{name}: {verified:?}");
    }
}

/// A body starts where it does in any ensemble, whatever others there are, and the first as the body of a scene of one.
#[test]
fn a_start_depends_on_the_member_and_the_body_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let spread = json!({
        "members": 6, "seed": 3, "attitude_spread_rad": 0.1, "momentum_spread": 0.2,
        "position_spread_m": 0.3, "velocity_spread_m_s": 0.1,
    });
    let two = of_members("tether", 5, &spread);
    run(&two, &log);
    let of_two = contents(&log).members;
    let mut more = two.clone();
    let mut third = more["scene"]["bodies"][1].clone();
    third["name"] = json!("third");
    third["initial"]["position"] = json!([0, 20, 0]);
    more["scene"]["bodies"].as_array_mut().expect("a list").push(third);
    more["ensemble"]["members"] = json!(11);
    run(&more, &log);
    let of_more = contents(&log).members;
    for (number, member) in &of_two {
        for body in 0..2 {
            assert_eq!(initial(member, body), initial(&of_more[number], body));
        }
    }
    let distinct = |a: &BodyState, b: &BodyState| apart(&a.attitude, &b.attitude) > 1e-4;
    assert!(distinct(initial(&of_more[&2], 1), initial(&of_more[&2], 2)));

    let mut one = shipped("heavy-top");
    let fields = one.as_object_mut().expect("an object");
    for key in ["duration_s", "expect", "log"] {
        fields.remove(key);
    }
    one["steps"] = json!(5);
    one["ensemble"] = json!({
        "members": 6, "seed": 3, "attitude_spread_rad": 0.1, "momentum_spread": 1e-5,
    });
    run(&one, &log);
    let alone = ensemble::contents(&log).members;
    let mut pinned = one.clone();
    let scene = &one["scene"];
    let mut weight = scene["potential"][0].clone();
    weight["body"] = json!("top");
    pinned["scene"] = json!({
        "bodies": [{
            "name": "top", "pivot": [0, 0, 0], "inertia": scene["inertia"], "initial": scene["initial"],
        }],
        "potential": [weight],
    });
    run(&pinned, &log);
    let found = contents(&log).members;
    for member in alone {
        let (begun, body) = (member.initial.expect("a start"), initial(&found[&member.member], 0));
        assert!(apart(&begun.attitude, &body.attitude) < 1e-15);
        assert!(apart(&begun.body_momentum, &body.body_momentum) < 1e-15);
    }
}

/// Joint points of every member meet at its start and at its end.
#[test]
fn joints_hold_in_every_member() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("chain.mcap");
    let spread = json!({
        "members": 12, "attitude_spread_rad": 0.3, "momentum_spread": 0.01,
    });
    run(&of_members("chain", 40, &spread), &log);
    for member in contents(&log).members.values() {
        for state in [initial, last] {
            let point = |body: usize, z: f64| -> Vec<f64> {
                let state = state(member, body);
                (0..3).map(|i| state.position[i] + state.attitude[3 * i + 2] * z).collect()
            };
            assert!(apart(&point(0, -0.25), &point(1, 0.25)) < 1e-15);
        }
    }
}

/// The starts have the spread that was asked for: 2000 members show a deviation to 1 or 2 %.
#[test]
fn starts_are_spread_as_asked() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("tether.mcap");
    let spread = json!({
        "members": 2000, "seed": 7, "attitude_spread_rad": 0.05, "momentum_spread": 0.02,
        "position_spread_m": 0.3, "velocity_spread_m_s": 0.01,
    });
    run(&of_members("tether", 1, &spread), &log);
    let Contents { members, statistics, .. } = contents(&log);
    let near = |found: f64, expected: f64| {
        assert!((found / expected - 1.0).abs() < 0.08, "{found} for {expected}");
    };
    for body in &statistics[0].bodies {
        near(body.attitude_spread_rad.expect("a mean"), 0.05 * 3_f64.sqrt());
        body.body_momentum_deviation.iter().for_each(|&found| near(found, 0.02));
        body.position_deviation.iter().for_each(|&found| near(found, 0.3));
        body.velocity_deviation.iter().for_each(|&found| near(found, 0.01));
    }
    let off = apart(&statistics[0].bodies[1].mean_position, &initial(&members[&0], 1).position);
    assert!(off < 5.0 * 0.3 / 2000_f64.sqrt(), "{off}");
    // What is drawn for one body says nothing of the other.
    let correlation = members.values().map(|member| {
        let off = |body: usize| {
            initial(member, body).position[0] - initial(&members[&0], body).position[0]
        };
        off(0) * off(1) / (0.3 * 0.3)
    });
    let correlation = correlation.sum::<f64>() / 2000.0;
    assert!(correlation.abs() < 4.0 / 2000_f64.sqrt(), "{correlation}");
}

/// A member is the run that begins where it began.
#[test]
fn a_member_is_a_run_of_its_own() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("tether.mcap");
    let spread = json!({
        "members": 5, "attitude_spread_rad": 0.3, "momentum_spread": 0.1, "position_spread_m": 0.1,
    });
    let scenario = of_members("tether", 40, &spread);
    run(&scenario, &log);
    let members = contents(&log).members;
    for number in [0, 4] {
        let member = &members[&number];
        let mut alone = scenario.clone();
        alone.as_object_mut().expect("an object").remove("ensemble");
        for body in 0..2 {
            let begun = initial(member, body);
            let rows: Vec<&[f64]> = begun.attitude.chunks(3).collect();
            alone["scene"]["bodies"][body]["initial"] = json!({
                "attitude": { "matrix": rows }, "momentum": { "body": begun.body_momentum },
                "position": begun.position, "linear_momentum": begun.linear_momentum,
            });
        }
        let alone = run(&alone, &folder.path().join("alone.mcap")).last;
        for (body, name) in ["primary", "secondary"].iter().enumerate() {
            let (end, found) = (last(member, body), &alone.bodies[*name]);
            assert!(apart(&found.attitude.concat(), &end.attitude) < 1e-13);
            assert!(apart(&found.position, &end.position) < 1e-13);
        }
    }
}

/// A kill leaves a beginning of the whole log; the run that resumes it ends with the whole.
#[test]
fn an_interrupted_ensemble_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    let spread = json!({
        "members": 600, "attitude_spread_rad": 0.1, "position_spread_m": 0.1, "in_full": [5],
    });
    let mut scenario = of_members("tether", 60, &spread);
    scenario["log"]["every"] = json!(1);
    let reference = run(&scenario, &whole);
    let bytes = fs::read(&whole).expect("a log");
    let mut steps = Vec::new();
    for part in [0.05, 0.3, 0.7, 0.999] {
        let _ = fs::remove_file(&cut);
        let beginning = &bytes[..(part * bytes.len() as f64) as usize];
        fs::write(part_path(&cut), beginning).expect("written");
        let found = last_checkpoint(&cut).expect("readable").unwrap_or(0);
        let summary = run(&scenario, &cut);
        assert_eq!(summary.resumed_step, found);
        assert!(fs::read(&cut).expect("a log") == bytes, "cut at {part}, resumed at {found}");
        assert_eq!(summary.ensemble, reference.ensemble);
        assert_eq!(summary.last, reference.last);
        steps.push(found);
    }
    println!("resumed at the steps {steps:?}");
    assert!(steps[3] > steps[0] && steps[3] > 0);
}

/// The estimated size of a log is that of the log, within a third.
#[test]
fn the_size_of_the_log_is_known_before() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("tether.mcap");
    let spread = json!({ "members": 400, "attitude_spread_rad": 0.1, "position_spread_m": 0.1 });
    let scenario = of_members("tether", 200, &spread);
    let planned = plan(&scenario);
    run(&scenario, &log);
    let bytes = fs::metadata(&log).expect("a log").len() as f64;
    let ratio = planned.log_bytes as f64 / bytes;
    println!("{} bytes planned, {bytes} found", planned.log_bytes);
    assert!((0.67..1.5).contains(&ratio), "{ratio}");
    assert_eq!(planned.total_steps(), 80_000);
}

/// A member that cannot go on is told, and the others end.
#[test]
fn a_member_that_fails_is_told_and_the_others_go_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("chain.mcap");
    let spread = json!({ "members": 12, "seed": 1, "momentum_spread": 0.3 });
    let mut scenario = of_members("chain", 60, &spread);
    scenario["step_s"] = json!(0.02);
    let summary = run(&scenario, &log);
    let ends = summary.ensemble.expect("of an ensemble");
    println!("{} succeeded, failed: {:?}", ends.succeeded, ends.failed);
    assert_eq!(ends.succeeded + ends.failed.values().sum::<u64>(), 12);
    assert!(!ends.failed.is_empty() && ends.succeeded > 0);
    for member in contents(&log).members.values().filter(|end| end.outcome != "succeeded") {
        let diagnosis: Value = serde_json::from_str(&member.diagnosis).expect("a diagnosis");
        assert_eq!(diagnosis["code"], json!(member.outcome));
        assert_eq!(diagnosis["step"], json!(member.steps + 1));
    }
}

#[test]
fn tables_and_quantities_name_the_bodies() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("tether.mcap");
    let spread = json!({ "members": 7, "position_spread_m": 0.2, "in_full": [2] });
    run(&of_members("tether", 50, &spread), &log);
    let table = |channel: Channel, member: u64| {
        let mut text = Vec::new();
        let choice = Choice { channels: vec![channel], member };
        export(&log, &choice, Format::Csv, &mut text).expect("a table");
        String::from_utf8(text).expect("text")
    };
    let text = table(Channel::EnsembleMembers, 0);
    let head: Vec<&str> = text.lines().next().expect("a head").split(',').collect();
    for name in ["primary_initial_position_x", "secondary_position_z", "primary_attitude_1_1"] {
        assert!(head.contains(&name), "{name} in {head:?}");
    }
    assert_eq!(text.lines().count(), 8);
    let text = table(Channel::EnsembleStatistics, 0);
    assert!(text.contains("secondary_position_deviation_x"), "{text}");
    assert_eq!(table(Channel::BodyState, 2).lines().count(), 12);

    let members = contents(&log).members;
    let asked = |quantity: MemberQuantity| {
        let wanted = Wanted { quantity, axis: 0, order: MemberOrder::Member, offset: 0, limit: 10 };
        read_members(&log, wanted, &|| false).expect("readable").expect("not stopped")
    };
    for quantity in MemberQuantity::ALL {
        let found = asked(quantity);
        assert_eq!((found.rows.len(), found.time_s.len()), (7, found.rows[0].values.len()));
    }
    let found = asked(MemberQuantity::PlaceDistance);
    assert_eq!(found.rows[0].largest, Some(0.0));
    for row in &found.rows[1..] {
        // At the start, the body that is farther from its place in member 0.
        let far = |body: usize| -> f64 {
            let [mine, its] =
                [row.member, 0].map(|number| &initial(&members[&number], body).position);
            mine.iter().zip(its).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
        };
        let most = f64::max(far(0), far(1));
        assert!((f64::from(row.values[0]) - most).abs() < 1e-6, "{} for {most}", row.values[0]);
    }
}

/// The step for an accuracy is one for every member.
#[test]
fn an_accuracy_is_kept_by_every_member() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = 1e-7;
    let spread =
        json!({ "members": 4, "seed": 2, "attitude_spread_rad": 0.3, "momentum_spread": 0.1 });
    let mut scenario = of_members("tether", 1, &spread);
    let fields = scenario.as_object_mut().expect("an object");
    for key in ["method", "step_s", "steps", "log"] {
        fields.remove(key);
    }
    scenario["duration_s"] = json!(20);
    let mut exact = scenario.clone();
    scenario["accuracy"] = json!({ "error": error });
    let asked = Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario");
    let planned = advise::plan(&asked).expect("a choice");
    assert!(planned.advice.expect("a choice").expected_error <= error);
    let log = folder.path().join("tether.mcap");
    run(&scenario, &log);
    let chosen = contents(&log).members;
    exact["method"] = json!({ "name": "vpd", "tableau": "gauss6" });
    exact["step_s"] = json!(0.02);
    run(&exact, &log);
    for (number, end) in contents(&log).members {
        for body in 0..2 {
            let off = apart(&last(&end, body).attitude, &last(&chosen[&number], body).attitude);
            assert!(off <= error, "member {number}: {off:e}");
        }
    }
}

/// Members end where their own condition holds, and the log says which.
#[test]
fn members_stop_where_their_own_condition_holds() {
    let folder = tempfile::tempdir().expect("a folder");
    let (log, cut) = (folder.path().join("tether.mcap"), folder.path().join("cut.mcap"));
    let spread = json!({
        "members": 30, "position_spread_m": 0.02, "velocity_spread_m_s": 0.02, "in_full": [3, 4],
    });
    // In two seconds the tether pulls about half of them so near.
    let mut scenario = of_members("tether", 20, &spread);
    let limit = json!({ "distance_m": 4.82, "between": ["primary", "secondary"] });
    scenario["until"] = json!([{ "distance_below_m": limit, "exact": true }]);
    let summary = run(&scenario, &log);
    let ends = summary.ensemble.as_ref().expect("of an ensemble");
    let members = contents(&log).members;
    let stopped: Vec<&Member> = members.values().filter(|end| end.stopped_by == Some(0)).collect();
    assert_eq!(ends.stopped.get("/until/0").copied(), Some(stopped.len() as u64));
    assert!(stopped.len() > 3 && stopped.len() < 30, "{}", stopped.len());
    for end in stopped {
        let [one, other] = [0, 1].map(|body| &last(end, body).position);
        let squares = one.iter().zip(other).map(|(a, b)| (a - b) * (a - b));
        let distance = squares.sum::<f64>().sqrt();
        assert!((4.82 - 1e-8..4.82).contains(&distance), "{distance}");
        let in_steps = last(end, 0).time_s / 0.1;
        assert!((in_steps - in_steps.round()).abs() > 1e-9, "{in_steps}");
    }
    let bytes = fs::read(&log).expect("a log");
    fs::write(part_path(&cut), &bytes[..bytes.len() * 9 / 10]).expect("written");
    run(&scenario, &cut);
    assert!(fs::read(&cut).expect("a log") == bytes);
    let verified = verify::verify(&log).expect("a run again");
    assert!(verified.same, "{verified:?}");
}
