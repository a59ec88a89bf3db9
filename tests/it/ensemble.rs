//! Ensembles: their members, their statistics, and that the log does not depend on how it was made.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::thread;

use prost::Message as _;
use serde_json::{Value, json};
use vpd::advise;
use vpd::export::{Choice, Format, export};
use vpd::log::members::{MemberOrder, MemberQuantity, Wanted, read_members};
use vpd::log::messages::{Energy, EnsembleStatistics, Member, State};
use vpd::log::part_path;
use vpd::log::reader::{self, Item};
use vpd::log::resume::last_checkpoint;
use vpd::log::schema::{BodyName, Channel, Topic};
use vpd::plan::Plan;
use vpd::run::{Control, JobContext, Outcome, RunError, Summary, execute};
use vpd::scenario::Scenario;

use crate::bad_scenarios::{dipole, so4};

fn ensemble(mut scene: Value, members: u64, steps: u64, method: &Value) -> Value {
    let fields = scene.as_object_mut().expect("an object");
    fields.remove("duration_s");
    fields.remove("expect");
    fields.insert("steps".into(), json!(steps));
    fields.insert("method".into(), method.clone());
    fields.insert("log".into(), json!({ "every": 10 }));
    let spread = json!({
        "members": members, "seed": 7, "attitude_spread_rad": 0.05, "momentum_spread": 0.02, "in_full": [3, 1]
    });
    fields.insert("ensemble".into(), spread);
    scene
}

/// Returns a scene with a wheel and a torque.
fn dual_spin() -> Value {
    serde_json::from_str(include_str!("../../scenarios/dual-spin.json")).expect("shipped")
}

fn checked(scenario: &Value) -> Scenario {
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scenario")
}

fn run(scenario: &Scenario, log: &Path) -> Summary {
    execute(
        &advise::plan(scenario).expect("a plan"),
        &JobContext { log, control: &Control::default() },
    )
    .expect("a log")
}

/// Contents of the log of an ensemble.
#[derive(Default)]
pub(crate) struct Contents {
    pub(crate) members: Vec<Member>,
    statistics: Vec<EnsembleStatistics>,
    /// The last state on each topic of states.
    states: BTreeMap<u64, State>,
    /// Samples of each member.
    samples: BTreeMap<u64, u64>,
    /// Log times, as they come.
    times: Vec<u64>,
}

pub(crate) fn contents(log: &Path) -> Contents {
    let mut found = Contents::default();
    let ending = reader::read(log, |item| {
        if let Item::Message { topic, data, time_ns, .. } = item {
            let Topic { member, channel, .. } = Topic::parse(topic).expect("a topic of ours");
            found.times.push(time_ns);
            match channel {
                Channel::EnsembleMembers => found.members.push(Member::decode(data).expect("ours")),
                Channel::EnsembleStatistics => {
                    found.statistics.push(EnsembleStatistics::decode(data).expect("ours"));
                }
                Channel::State => {
                    found.states.insert(member, State::decode(data).expect("ours"));
                    *found.samples.entry(member).or_default() += 1;
                }
                _ => {}
            }
        }
        ControlFlow::Continue(())
    });
    assert!(ending.expect("readable").finished);
    found
}

/// Returns the last attitude of each member, by number: in the log those that are logged in full come first.
pub(crate) fn ends(log: &Path) -> BTreeMap<u64, Vec<f64>> {
    let members = contents(log).members;
    members
        .into_iter()
        .map(|member| (member.member, member.last.map_or_else(Vec::new, |last| last.attitude)))
        .collect()
}

#[test]
fn every_member_ends_once_and_those_in_full_end_where_their_samples_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    for method in [
        json!({ "name": "vpd", "tableau": "gauss2" }),
        json!({ "name": "vpd", "tableau": "gauss4" }),
        json!({ "name": "vpd", "tableau": "gauss6" }),
        json!({ "name": "splitting", "order": 4 }),
    ] {
        let scenario = checked(&ensemble(dipole(), 21, 100, &method));
        let summary = run(&scenario, &log);
        assert_eq!(summary.outcome, Outcome::Succeeded);
        let Contents { mut members, statistics, states, samples, times } = contents(&log);
        assert!(times.is_sorted(), "log time goes forward");
        assert_eq!(samples, BTreeMap::from([(0, 11), (1, 11), (3, 11)]));
        for (member, state) in &states {
            let end = members.iter().find(|end| end.member == *member).expect("its end");
            assert_eq!(end.last.as_ref(), Some(state));
        }
        members.sort_by_key(|end| end.member);
        let numbers: Vec<u64> = members.iter().map(|end| end.member).collect();
        assert_eq!(numbers, (0..21).collect::<Vec<_>>());
        assert!(members.iter().all(|end| end.outcome == "succeeded" && end.steps == 100));
        let distinct: Vec<_> =
            members.windows(2).filter(|pair| pair[0].last != pair[1].last).collect();
        assert_eq!(distinct.len(), 20);
        let [start, end] = statistics.as_slice() else { panic!("two of them: {statistics:?}") };
        assert_eq!((start.members, end.members, end.failed), (21, 21, 0));
        let reported = summary.ensemble.expect("of an ensemble");
        assert_eq!((reported.members, reported.succeeded), (21, 21));
        assert_eq!(reported.attitude_spread_rad, end.attitude_spread_rad);
    }
}

/// A member does not depend on the others: not on their number, nor on which are logged in full.
#[test]
fn a_member_is_the_same_in_any_ensemble() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let mut free = dipole();
    free["scene"]["potential"] = json!([]);
    for (scene, method) in [
        (dipole(), json!({ "name": "vpd", "tableau": "gauss2" })),
        (free, json!({ "name": "auto", "tableau": "gauss2" })),
        (dual_spin(), json!({ "name": "vpd", "tableau": "gauss2" })),
        (dipole(), json!({ "name": "rk", "tableau": "rk4" })),
        (dual_spin(), json!({ "name": "rk_projected", "tableau": "rk8" })),
        (dipole(), json!({ "name": "rkmk", "tableau": "rk4" })),
        (dipole(), json!({ "name": "splitting", "order": 4 })),
    ] {
        let mut ends = Vec::new();
        for (members, in_full) in [
            (5, json!([])),
            (9, json!([3])),
            (17, json!([1, 2, 3, 4, 5, 6, 7])),
            (19, json!([2, 4])),
            (40, json!([1, 7, 8, 9, 10, 11, 12])),
        ] {
            let mut scenario = ensemble(scene.clone(), members, 60, &method);
            scenario["ensemble"]["in_full"] = in_full;
            run(&checked(&scenario), &log);
            let mut first: Vec<Member> =
                contents(&log).members.into_iter().filter(|end| end.member < 5).collect();
            first.sort_by_key(|end| end.member);
            ends.push(first);
        }
        assert_eq!(ends[0].len(), 5);
        assert!(ends.iter().all(|first| *first == ends[0]));
    }
}

/// The members are spread as was asked, about the scene as it stands.
#[test]
fn starts_are_spread_as_asked() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    for (scene, dimension) in [(dipole(), 3.0_f64), (so4(), 6.0)] {
        let nominal = Plan::new(&checked(&scene)).expect("a plan").steps;
        assert!(nominal > 0);
        run(
            &checked(&ensemble(scene, 2000, 1, &json!({ "name": "vpd", "tableau": "gauss1" }))),
            &log,
        );
        let Contents { members, statistics, .. } = contents(&log);
        let spread = statistics[0].attitude_spread_rad.expect("a mean");
        // 2000 members show a deviation to 1 or 2 %; the mean of turns is a little off the middle one.
        let expected = 0.05 * dimension.sqrt();
        assert!((spread / expected - 1.0).abs() < 0.05, "{spread} for {expected}");
        for deviation in &statistics[0].body_momentum_deviation {
            assert!((deviation / 0.02 - 1.0).abs() < 0.08, "{deviation}");
        }
        let nominal = members.iter().find(|end| end.member == 0).expect("member 0");
        let initial = nominal.initial.as_ref().expect("where it began");
        let middle = initial.attitude.iter().zip(&statistics[0].mean_attitude);
        let off = middle.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 5.0 * 0.05 / 2000_f64.sqrt(), "{off}");
    }
}

/// The motion of any member is kept in few points that hold its extremes.
#[test]
fn the_points_on_the_way_of_a_member_keep_the_extremes_of_its_samples() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let mut scenario = ensemble(dipole(), 12, 2000, &json!({ "name": "vpd", "tableau": "gauss2" }));
    scenario["log"]["every"] = json!(1);
    run(&checked(&scenario), &log);
    let (mut states, mut errors) = (Vec::new(), Vec::new());
    let read = reader::read(&log, |item| {
        if let Item::Message { topic, data, .. } = item {
            match Topic::parse(topic).expect("a topic of ours") {
                Topic { member: 3, channel: Channel::State, .. } => {
                    states.push(State::decode(data).expect("ours"));
                }
                Topic { member: 3, channel: Channel::Energy, .. } => {
                    errors.push(Energy::decode(data).expect("ours").error);
                }
                _ => {}
            }
        }
        ControlFlow::Continue(())
    });
    assert!(read.expect("readable").finished);
    let members = contents(&log).members;
    let way = |member: u64| {
        let end = members.iter().find(|end| end.member == member).expect("its end");
        end.way.clone().expect("its way")
    };
    let found = way(3);
    assert_eq!((states.len(), errors.len(), found.time_s.len()), (2001, 2001, 126));
    // 16 samples a point, behind the first.
    for (k, time_s) in found.time_s.iter().enumerate() {
        let last = 16 * k;
        let behind = if k == 0 { 0..=0 } else { last - 15..=last };
        let attitude: Vec<f32> = states[last].attitude.iter().map(|x| *x as f32).collect();
        assert_eq!(
            (*time_s, &found.attitude[9 * k..9 * k + 9]),
            (states[last].time_s, &attitude[..])
        );
        for axis in 0..3 {
            let cosine = states[behind.clone()].iter().map(|state| state.attitude[4 * axis]);
            let angle = libm::acos(cosine.fold(1.0, f64::min)) as f32;
            assert_eq!(found.axis_angle[3 * k + axis], angle);
        }
        let error = errors[behind.clone()].iter().copied();
        let error = error.reduce(|a, b| if b.abs() > a.abs() { b } else { a });
        assert_eq!(Some(found.energy_error[k]), error.map(|x| x as f32));
        let size = states[behind]
            .iter()
            .map(|state| state.angular_velocity.iter().map(|x| x * x).sum::<f64>().sqrt() as f32);
        let off = size.fold(0.0, f32::max) / found.angular_velocity[k] - 1.0;
        assert!(off.abs() < 1e-6, "{off}");
    }
    // The figures are the same for a member whose samples are not logged.
    let other = way(11);
    assert_eq!(other.time_s, found.time_s);
    assert_eq!(
        [other.attitude.len(), other.axis_angle.len(), other.momentum_drift.len()],
        [found.attitude.len(), found.axis_angle.len(), found.momentum_drift.len()]
    );
    assert_ne!(other.attitude, found.attitude);
}

#[test]
fn a_member_that_fails_is_told_and_the_others_go_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let mut scenario = ensemble(dipole(), 40, 50, &json!({ "name": "vpd", "tableau": "gauss2" }));
    scenario["step_s"] = json!(0.2);
    scenario["ensemble"]["momentum_spread"] = json!(0.15);
    let summary = run(&checked(&scenario), &log);
    let members = contents(&log).members;
    let reported = summary.ensemble.expect("of an ensemble");
    println!("{reported:?}");
    let (arrived, failed): (Vec<&Member>, Vec<&Member>) =
        members.iter().partition(|end| end.outcome == "succeeded");
    assert!(!failed.is_empty() && !arrived.is_empty(), "{} failed", failed.len());
    assert_eq!(summary.outcome, Outcome::Succeeded);
    assert_eq!(reported.failed.values().sum::<u64>(), failed.len() as u64);
    for end in failed {
        let diagnosis: Value = serde_json::from_str(&end.diagnosis).expect("a diagnosis");
        assert_eq!(diagnosis["code"], json!(end.outcome));
        assert_eq!(diagnosis["step"], json!(end.steps + 1));
        assert!(end.steps < 50 && end.last.as_ref().is_some_and(|last| last.attitude.len() == 9));
    }
    // No member gets through a step this large.
    scenario["step_s"] = json!(1000.0);
    scenario["method"]["tableau"] = json!("gauss1");
    let summary = run(&checked(&scenario), &log);
    assert_eq!(summary.outcome, Outcome::Failed);
    assert!(summary.diagnosis.is_some());
}

/// Each member ends at the first step where its own condition holds, with the bits of the run that goes on; those that no
/// condition stops make all their steps. Lanes, matrices, members one after the other; a wheel, noise.
#[test]
fn members_stop_where_their_own_condition_holds() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let angle = |from: &State, to: &State| {
        let cosine = from.attitude.iter().zip(&to.attitude).map(|(a, b)| a * b).sum::<f64>();
        ((cosine - 1.0) / 2.0).acos()
    };
    for (scene, method, steps) in [
        (dipole(), json!({ "name": "vpd", "tableau": "gauss2" }), 60),
        (dipole(), json!({ "name": "vpd", "tableau": "gauss6" }), 60),
        (dipole(), json!({ "name": "splitting", "order": 4 }), 60),
        (dipole(), json!({ "name": "rkmk", "tableau": "rk4" }), 60),
        (dual_spin(), json!({ "name": "vpd", "tableau": "gauss2" }), 60),
        (dual_spin(), json!({ "name": "rk_projected", "tableau": "rk8" }), 60),
    ] {
        let mut scenario = ensemble(scene, 20, steps, &method);
        scenario["log"]["every"] = json!(1);
        scenario["ensemble"]["in_full"] = json!([1, 2, 3, 4, 8, 9, 19]);
        scenario["ensemble"]["attitude_spread_rad"] = json!(0.6);
        scenario["ensemble"]["momentum_spread"] = json!(0.5);
        run(&checked(&scenario), &log);
        let (through, whole) = (states(&log), contents(&log).members);
        // The angle counts from the start of the scene for all. About half of those that are seen pass it.
        let nominal = &through[&0][0];
        let largest = |samples: &Vec<State>| {
            samples[1..].iter().map(|state| angle(nominal, state)).fold(0.0, f64::max)
        };
        let mut angles: Vec<f64> = through.values().map(largest).collect();
        angles.sort_by(f64::total_cmp);
        let limit = 0.5 * (angles[3] + angles[4]);
        scenario["until"] = json!([
            { "energy_error_above_j": 1e9 },
            { "angle_above_rad": { "angle_rad": limit } }
        ]);
        let summary = run(&checked(&scenario), &log);
        let Contents { members, statistics, .. } = contents(&log);
        let until = states(&log);
        let mut stopped = 0;
        for (number, samples) in &through {
            let first = (1..samples.len()).find(|&k| angle(nominal, &samples[k]) > limit);
            let last = first.unwrap_or(samples.len() - 1);
            assert!(until[number] == samples[..=last], "{number}: {first:?}");
            let end = members.iter().find(|end| end.member == *number).expect("its end");
            assert_eq!((end.steps, end.stopped_by), (last as u64, first.map(|_| 1)));
            assert_eq!(end.outcome, "succeeded");
        }
        for end in &members {
            stopped += u64::from(end.stopped_by.is_some());
            let before = whole.iter().find(|other| other.member == end.member).expect("its end");
            assert_eq!(end.stopped_by.is_none(), end == before, "{}", end.member);
        }
        println!("{stopped} of 20 stopped at {limit}");
        assert!(stopped > 0 && stopped < 20, "{stopped}");
        let reported = summary.ensemble.expect("of an ensemble");
        assert_eq!(reported.stopped, BTreeMap::from([("/until/1".to_owned(), stopped)]));
        assert_eq!((reported.succeeded, summary.outcome), (20, Outcome::Succeeded));
        // Mean and spread are over all, each where it ended.
        let [_, end] = statistics.as_slice() else { panic!("two of them: {statistics:?}") };
        assert_eq!(end.members, 20);
        for (i, mean) in end.mean_body_momentum.iter().enumerate() {
            let momentum = |end: &Member| end.last.as_ref().expect("a state").body_momentum[i];
            let sum: f64 = members.iter().map(momentum).sum();
            assert!((sum / 20.0 - mean).abs() < 1e-12 * (1.0 + mean.abs()), "{mean}");
        }
        // Charts show at each time the members that still run.
        let wanted = Wanted {
            quantity: MemberQuantity::AngularVelocity,
            axis: 0,
            order: MemberOrder::Member,
            offset: 0,
            limit: 20,
        };
        let shown = read_members(&log, wanted, &|| false).expect("readable").expect("read");
        for (k, time_s) in shown.time_s.iter().enumerate() {
            let running = members.iter().filter(|end| {
                let way = end.way.as_ref().expect("a way");
                way.time_s.get(k) == Some(time_s)
            });
            assert_eq!(shown.count[k], running.count() as u64, "{time_s}");
        }
    }
}

/// The samples of each member that is logged in full.
pub(crate) fn states(log: &Path) -> BTreeMap<u64, Vec<State>> {
    let mut found: BTreeMap<u64, Vec<State>> = BTreeMap::new();
    let ending = reader::read(log, |item| {
        if let Item::Message { topic, data, .. } = item
            && let Some(Topic { member, channel: Channel::State, .. }) = Topic::parse(topic)
        {
            found.entry(member).or_default().push(State::decode(data).expect("ours"));
        }
        ControlFlow::Continue(())
    });
    assert!(ending.expect("readable").finished);
    found
}

/// A table of members says which condition stopped each, and when.
#[test]
fn the_table_of_members_names_the_condition() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("ensemble.mcap");
    let method = json!({ "name": "vpd", "tableau": "gauss2" });
    let mut scenario = ensemble(dipole(), 9, 60, &method);
    scenario["ensemble"]["momentum_spread"] = json!(0.5);
    scenario["until"] = json!([{ "angle_above_rad": { "angle_rad": 0.5 } }]);
    run(&checked(&scenario), &log);
    let choice = Choice { channels: vec![Channel::EnsembleMembers], member: 0 };
    let mut text = Vec::new();
    export(&log, &choice, Format::Csv, &mut text).expect("a table");
    let text = String::from_utf8(text).expect("text");
    let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let names = lines.next().expect("a head");
    let column = |name: &str| names.iter().position(|found| *found == name).expect("a column");
    let members = contents(&log).members;
    for (line, end) in lines.zip(&members) {
        let condition = if end.stopped_by.is_some() { "/until/0" } else { "" };
        assert_eq!(line[column("stopped_by")], condition);
        let time_s: f64 = line[column("time_s")].parse().expect("a number");
        assert_eq!(Some(time_s), end.last.as_ref().map(|last| last.time_s));
    }
    assert!(members.iter().any(|end| end.stopped_by.is_some()));
}

/// A kill leaves a beginning of the whole log; the run that resumes it ends with the whole, and
/// does not run members again whose end it holds.
#[test]
fn an_interrupted_ensemble_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    for (scene, name, tableau) in
        [(dipole(), "vpd", "gauss3"), (dual_spin(), "vpd", "gauss2"), (dual_spin(), "rkmk", "rk4")]
    {
        let method = json!({ "name": name, "tableau": tableau });
        let mut scenario = ensemble(scene, 1500, 60, &method);
        scenario["log"]["every"] = json!(1);
        // Some members stop before their time.
        scenario["until"] = json!([{ "angle_above_rad": { "angle_rad": 0.5 } }]);
        let scenario = checked(&scenario);
        let reference = run(&scenario, &whole);
        let bytes = fs::read(&whole).expect("a log");
        let mut steps = Vec::new();
        for part in [0.05, 0.3, 0.7, 0.999] {
            let _ = fs::remove_file(&cut);
            fs::write(part_path(&cut), &bytes[..(part * bytes.len() as f64) as usize])
                .expect("written");
            let found = last_checkpoint(&cut).expect("readable").unwrap_or(0);
            let summary = run(&scenario, &cut);
            assert_eq!(summary.resumed_step, found);
            assert!(fs::read(&cut).expect("a log") == bytes, "cut at {part}, resumed at {found}");
            assert_eq!(summary.ensemble, reference.ensemble);
            steps.push(found);
        }
        println!("resumed at the steps {steps:?}");
        assert!(steps[3] > steps[0] && steps[3] > 0);
    }
}

#[test]
fn an_ensemble_is_interrupted_and_cancelled_as_any_run() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    let scenario =
        checked(&ensemble(dipole(), 300, 200, &json!({ "name": "vpd", "tableau": "gauss2" })));
    run(&scenario, &whole);
    let stop = |cancel: bool, after: u64| {
        let control = Control::default();
        thread::scope(|scope| {
            let worker = scope.spawn(|| {
                execute(
                    &advise::plan(&scenario).expect("a plan"),
                    &JobContext { log: &cut, control: &control },
                )
            });
            while control.steps_done.load(Ordering::Relaxed) < after && !worker.is_finished() {
                thread::yield_now();
            }
            if cancel {
                control.cancelled.store(true, Ordering::Relaxed);
            } else {
                control.interrupted.store(true, Ordering::Relaxed);
            }
            worker.join().expect("no panic")
        })
    };
    for after in [100, 20_000] {
        match stop(false, after) {
            Err(RunError::Interrupted) => assert!(part_path(&cut).exists()),
            other => println!("it was quicker: {other:?}"),
        }
        run(&scenario, &cut);
        assert!(fs::read(&cut).expect("a log") == fs::read(&whole).expect("a log"));
        fs::remove_file(&cut).expect("removed");
    }
    let summary = stop(true, 20_000).expect("a finished log");
    let Contents { members, statistics, .. } = contents(&cut);
    if summary.outcome == Outcome::Cancelled {
        assert!(members.len() < 300 && statistics.len() == 1);
    }
}

#[test]
fn topics_of_members_are_read_as_they_are_written() {
    for member in [0, 1, 99_999] {
        for channel in Channel::all() {
            let body = channel.is_of_each_body().then_some("mast-2_b").and_then(BodyName::of);
            let topic = Topic { member, channel, body };
            assert_eq!(Topic::parse(&topic.name()), Some(topic));
        }
    }
    for name in [
        "/members",
        "/members/",
        "/members/0/state",
        "/members/x/state",
        "/members/3",
        "/members/3/",
        "/imu",
        "/bodies/*/state",
        "/bodies//state",
        "/bodies/2nd/state",
        "/bodies/a/b/state",
        "/bodies/mast/energy",
        "/scene/bodies/a.b",
    ] {
        assert_eq!(Topic::parse(name), None, "{name}");
    }
}
