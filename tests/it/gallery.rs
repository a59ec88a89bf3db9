//! Scenes made to break methods: `tests/gallery` says for each method how it ends, and at which step.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::thread;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use vpd::log::reader::{Message, read_samples};
use vpd::plan::Plan;
use vpd::run::{Outcome, Summary};
use vpd::scenario::Scenario;

use crate::scenarios::run;

/// A scene, and the outcomes of methods on it.
#[derive(Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Room {
    about: String,
    scene: Value,
    cases: Vec<Case>,
}

/// A method at a step.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Case {
    method: Value,
    step_s: f64,
    steps: u64,
    every: u64,
    /// End of the case; absent only in a room that is not yet recorded by `rewrite_the_gallery`.
    #[serde(default)]
    ends: Ends,
}

/// End of a case.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
struct Ends {
    /// `succeeded`, the same with `energy lost`, a failure code, or `refused` and the pointer of the field.
    outcome: String,
    /// The step that failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    step: Option<u64>,
    /// The step that is advised.
    #[serde(skip_serializing_if = "Option::is_none")]
    advised_step_s: Option<f64>,
    /// Whether the same time in advised steps succeeds.
    #[serde(skip_serializing_if = "Option::is_none")]
    advice_works: Option<bool>,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/gallery")
}

fn rooms() -> Vec<(PathBuf, Room)> {
    let entries = fs::read_dir(folder()).expect("the gallery");
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.expect("readable").path()).collect();
    paths.sort();
    paths
        .into_iter()
        .map(|path| {
            let text = fs::read(&path).expect("readable");
            let room = serde_json::from_slice(&text);
            let room = room.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            (path, room)
        })
        .collect()
}

/// Returns the scenario of a case with `steps` steps.
fn scenario(room: &Room, case: &Case, step_s: f64, steps: u64, every: u64) -> String {
    json!({
        "name": "gallery", "scene": room.scene, "method": case.method, "step_s": step_s, "steps": steps,
        "log": { "every": every, "channels": ["/state", "/energy", "/orthogonality", "/log"], "compression": "none" }
    })
    .to_string()
}

/// Returns the states of a log, each number finite.
fn states(path: &Path) -> Vec<Vec<u64>> {
    let mut states = Vec::new();
    read_samples(path, |_, message| {
        if let Message::State(state) = message {
            let numbers = [state.attitude.as_slice(), state.body_momentum.as_slice()].concat();
            assert!(numbers.iter().all(|x| x.is_finite()), "{numbers:?}");
            states.push(numbers.into_iter().map(f64::to_bits).collect());
        }
    })
    .expect("a good log");
    states
}

/// Runs a case and asserts what must hold for every one.
fn observe(room: &Room, case: &Case) -> Ends {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("run.mcap");
    let text = scenario(room, case, case.step_s, case.steps, case.every);
    let refused = Scenario::from_json(text.as_bytes()).and_then(|scenario| Plan::new(&scenario));
    if let Err(error) = refused {
        return Ends { outcome: format!("refused {}", error.pointer), ..Ends::default() };
    }
    let summary = run(&text, &log);
    let Some(diagnosis) = &summary.diagnosis else {
        assert_eq!(summary.outcome, Outcome::Succeeded);
        assert_eq!(summary.samples, case.steps / case.every + 1);
        assert_eq!(states(&log).len() as u64, summary.samples);
        let outcome =
            if keeps_its_energy(&summary) { "succeeded" } else { "succeeded, energy lost" };
        assert!(
            stays_on_the_group(&summary) || case.method["name"] == "rk",
            "off the group: {text}"
        );
        assert!(keeps_its_energy(&summary) || summary.warning.is_some(), "nobody says so: {text}");
        return Ends { outcome: outcome.to_owned(), ..Ends::default() };
    };
    // The log holds all samples before the step, and the same as a run that was to end there.
    assert_eq!(case.every, 1, "a case that fails keeps every sample");
    assert_eq!(summary.samples, diagnosis.step);
    let kept = states(&log);
    assert_eq!(kept.len() as u64, diagnosis.step);
    if diagnosis.step > 1 {
        let shorter = directory.path().join("shorter.mcap");
        let text = scenario(room, case, case.step_s, diagnosis.step - 1, 1);
        assert_eq!(run(&text, &shorter).outcome, Outcome::Succeeded);
        assert!(states(&shorter) == kept, "the samples depend on how far the run was to go");
    }
    assert!(!diagnosis.cause.is_empty() && !diagnosis.advice.is_empty());
    let advice_works = diagnosis.advised_step_s.map(|advised| {
        assert!(advised < case.step_s, "{advised} advised in the place of {}", case.step_s);
        let steps = (case.steps as f64 * case.step_s / advised).ceil() as u64;
        let again = run(&scenario(room, case, advised, steps, steps), &log);
        assert!(stays_on_the_group(&again) || case.method["name"] == "rk", "{advised} of {text}");
        again.outcome == Outcome::Succeeded && keeps_its_energy(&again)
    });
    Ends {
        outcome: diagnosis.code.clone(),
        step: Some(diagnosis.step),
        advised_step_s: diagnosis.advised_step_s,
        advice_works,
    }
}

/// Returns whether the energy is unchanged, relative to its size. Methods that solve no equations
/// notice nothing.
fn keeps_its_energy(summary: &Summary) -> bool {
    summary.energy.is_some_and(|energy| energy.max_abs_error <= energy.initial.abs().max(1.0))
}

/// Returns whether every attitude is a rotation, but for rounding.
fn stays_on_the_group(summary: &Summary) -> bool {
    summary.orthogonality.is_none_or(|seen| seen.max <= 1e-11)
}

/// Applies a function to every case, on two threads, and returns the results in the order of the
/// cases.
fn everywhere<T: Send>(
    rooms: &[(PathBuf, Room)],
    work: impl Fn(&Room, &Case) -> T + Sync,
) -> Vec<Vec<T>> {
    let todo = rooms.iter().enumerate();
    let todo = todo.flat_map(|(i, (_, room))| (0..room.cases.len()).map(move |j| (i, j)));
    // The long cases stand last; they are begun first.
    let todo = Mutex::new(todo.collect::<Vec<_>>());
    let found = Mutex::new(Vec::new());
    thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                loop {
                    let Some((i, j)) = todo.lock().expect("no panic").pop() else { break };
                    let room = &rooms[i].1;
                    let done = work(room, &room.cases[j]);
                    found.lock().expect("no panic").push(((i, j), done));
                }
            });
        }
    });
    let mut found = found.into_inner().expect("no panic");
    found.sort_by_key(|(place, _)| *place);
    let mut result: Vec<Vec<T>> = rooms.iter().map(|_| Vec::new()).collect();
    for ((i, _), done) in found {
        result[i].push(done);
    }
    result
}

#[test]
fn every_case_of_the_gallery_ends_as_it_says() {
    let rooms = rooms();
    let observed = everywhere(&rooms, observe);
    let (mut cases, mut advised, mut works) = (0, 0, 0);
    let mut wrong = String::new();
    for ((path, room), observed) in rooms.iter().zip(observed) {
        for (case, seen) in room.cases.iter().zip(observed) {
            cases += 1;
            advised += u32::from(seen.advice_works.is_some());
            works += u32::from(seen.advice_works == Some(true));
            if seen != case.ends {
                let room = path.file_stem().unwrap_or_default().to_string_lossy();
                let _ = writeln!(wrong, "{room}, {} at {}: {seen:?}", case.method, case.step_s);
            }
        }
    }
    println!("{cases} cases, advice in {advised}, works in {works}");
    assert!(wrong.is_empty(), "not as the gallery says (see rewrite_the_gallery):\n{wrong}");
    assert!(cases >= 60, "{cases} cases");
    assert!(f64::from(works) >= 0.9 * f64::from(advised), "advice works in {works} of {advised}");
}

/// Writes down how every case ends, after a change of a solver; look at the difference before it is kept.
/// `cargo test --release rewrite_the_gallery -- --ignored`
#[test]
#[ignore = "writes files that tests read: cargo test --release rewrite_the_gallery -- --ignored"]
fn rewrite_the_gallery() {
    let mut rooms = rooms();
    let observed = everywhere(&rooms, observe);
    for ((path, room), observed) in rooms.iter_mut().zip(observed) {
        for (case, seen) in room.cases.iter_mut().zip(observed) {
            println!(
                "{} {} {}: {seen:?}",
                path.file_stem().unwrap_or_default().display(),
                case.method,
                case.step_s
            );
            case.ends = seen;
        }
        let cases: Vec<String> =
            room.cases.iter().map(|case| format!("    {}", json!(case))).collect();
        let text = format!(
            "{{\n  \"about\": {},\n  \"scene\": {},\n  \"cases\": [\n{}\n  ]\n}}\n",
            json!(room.about),
            json!(room.scene),
            cases.join(",\n")
        );
        fs::write(path, text).expect("the file is written");
    }
}
